"""The commands of `travjax`, a module each: `add(commands)` adds its parser, `run(arguments)` does it.

A command parses its words, calls a function of the library and prints what it returns. Parsers of all commands are
built for each of them, so a module imports what is slow to import (matplotlib, flax) where it is used. Options that
several commands and experiments have are in travjax/options.py; cli.py lists the commands.
"""
