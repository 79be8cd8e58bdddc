"""The command `travjax`: one line for bad input, exit codes, and the compilation cache; commands/ does the work."""

import argparse
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

import jax

import travjax
from travjax.commands import bench, dataset, evaluate, label, terrain, train, weights
from travjax.config import InputError
from travjax.files import cache_folder, output_folder

COMMANDS = (terrain, label, dataset, weights, train, evaluate, bench)
"""In the order in which the help lists them."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code, 2 for bad input."""
    try:
        arguments = _parser().parse_args(argv)
        _use_compilation_cache()
        arguments.run(arguments)
    except InputError as error:
        print(f"travjax: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of our output has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:  # a name too long, no permission
        print(f"travjax: {error.filename or 'a file'}: {error.strerror or error}", file=sys.stderr)
        return 2
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        if isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        reason = str(error).partition("\n")[0][:200]
        print(f"travjax: out of memory: {reason}; try fewer maps or a smaller batch_size", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("travjax: interrupted", file=sys.stderr)
        return 130
    return 0


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="travjax", description="Which trajectories of a wheeled robot will fail, and why.")
    parser.add_argument("--version", action="version", version=f"travjax {travjax.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)
    for command in COMMANDS:
        command.add(commands)
    return parser


def _use_compilation_cache() -> None:
    """Compiled code is kept between runs, so that a second start is quick; JAX_COMPILATION_CACHE_DIR moves it."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        cache = cache_folder() / "jax"
        try:
            output_folder(cache)
        except InputError:
            return
        jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
