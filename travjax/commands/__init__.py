"""The commands of `travjax`, one module each: `add(commands)` adds its parser, `run(arguments)` runs it.

In: the options of a command line. Out: files in a folder, and printed lines.
Stands on all other packages except experiments/.

A command parses its options, calls a function of the library and prints what it returns. Every start builds the parsers
of all commands, so a module imports slow packages (matplotlib, flax) only where it uses them. Options that several
commands and experiments share are in travjax/options.py; cli.py lists the commands.
"""
