"""The commands of `travjax`, a module each: `add(commands)` adds its parser, `run(arguments)` does it.

Parsers of all commands are built for each of them, so a module imports what is slow to import (matplotlib, flax) where
it is used. What several commands share is in options.py; cli.py lists the commands and turns an InputError into one
line.
"""
