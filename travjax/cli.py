"""The command `travjax`; its subcommands are in commands/, and entry.py reports bad input."""

import argparse
from collections.abc import Sequence

import travjax
from travjax.commands import (
    bench,
    dataset,
    evaluate,
    export,
    label,
    map,
    physics,
    plan,
    predict,
    terrain,
    train,
    weights,
)
from travjax.config import naming
from travjax.entry import Parser, guarded, use_compilation_cache

COMMANDS = (terrain, label, map, plan, dataset, weights, train, evaluate, export, predict, physics, bench)
"""The commands in the order in which the help lists them."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command.

    Returns the exit code: 2 for bad input, 1 where `plan` finds no path or `physics` finds the robot's model wrong.
    """

    def work() -> int | None:
        arguments = _parser().parse_args(argv)
        use_compilation_cache()
        with naming(arguments.command):
            return arguments.run(arguments)

    return guarded(work)


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="travjax", description="Which trajectories of a wheeled robot will fail, and why.")
    parser.add_argument("--version", action="version", version=f"travjax {travjax.__version__}")
    commands = parser.add_subparsers(required=True, dest="command", metavar="COMMAND", parser_class=Parser)
    for command in COMMANDS:
        command.add(commands)
    return parser
