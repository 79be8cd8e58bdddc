"""What every program of travjax shares: one line for bad input, exit codes, the compilation cache, and a quiet XLA.

JAX is imported where it is used, since `quiet_xla` has to come before it.
"""

import argparse
import os
import sys
from collections.abc import Callable
from typing import NoReturn

from travjax.config import InputError
from travjax.files import cache_folder, output_folder


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


def quiet_xla() -> None:
    """Leaves only fatal errors of XLA to print, unless TF_CPP_MIN_LOG_LEVEL says otherwise; before JAX is imported.

    When it reads compiled code back from the cache, XLA logs an error over two tuning hints that are no processor
    features ("+prefer-no-gather is not supported on the host machine").
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def guarded(work: Callable[[], object]) -> int:
    """Does the work of a program; returns the exit code, 2 for bad input, which is said in one line."""
    import jax

    from travjax.flags import usual_flags

    try:
        with usual_flags():
            work()
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


def use_compilation_cache() -> None:
    """Compiled code is kept between runs, so that a second start is quick; JAX_COMPILATION_CACHE_DIR moves it."""
    import jax

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        cache = cache_folder() / "jax"
        try:
            output_folder(cache)
        except InputError:
            return
        jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
