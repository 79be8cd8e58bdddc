"""What every program of travjax shares: one line for bad input, exit codes, the compilation cache, and a quiet XLA.

JAX is imported where it is used, since `quiet_xla` has to come before it.
"""

import argparse
import atexit
import os
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import IO, NoReturn

from travjax import signals
from travjax.config import InputError, one_line
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


def settle_streams() -> None:
    """Opens standard streams that were closed, or a file would take their place; none refuses a letter."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    sys.stdout, sys.stderr = _settled(sys.stdout, 1), _settled(sys.stderr, 2)


def _settled(stream: IO[str] | None, number: int) -> IO[str]:
    """Returns the stream, or one in place of none; it escapes letters of file names that its encoding lacks."""
    stream = stream or open(number, "w", closefd=False)
    if hasattr(stream, "reconfigure"):  # not that of a test
        stream.reconfigure(errors="backslashreplace")
    return stream


def guarded(work: Callable[[], object]) -> int:
    """Does the work of a program; returns the exit code, 2 for bad input, which is said in one line."""
    settle_streams()
    with signals.raised():
        try:
            from travjax.jax_flags import usual_flags  # imports JAX, which takes a second

            with usual_flags():
                work()
            sys.stdout.flush()
        except InputError as error:
            return _ended(2, str(error))
        except BrokenPipeError:  # the reader of our output has gone
            _drop_output()
            return 1
        except OSError as error:  # a name too long, no permission
            return _ended(2, f"{error.filename or 'a file'}: {error.strerror or error}")
        except (MemoryError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):  # XLA's
                raise
            return _ended(2, _out_of_memory(error))
        except KeyboardInterrupt as error:
            warnings.simplefilter("ignore")  # Python's, of coroutines that were cut off
            return _ended(*signals.ending(error))
    return 0


def _ended(code: int, line: str) -> int:
    """Says in one line why a program ends; returns its exit code."""
    with suppress(OSError):  # nobody is there to read it
        print(one_line(f"travjax: {line}"), file=sys.stderr)
    try:
        sys.stdout.flush()
    except OSError:
        _drop_output()
    return code


def _drop_output() -> None:
    """Lets what is still to be printed go nowhere, so that Python does not try again at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _out_of_memory(error: MemoryError | RuntimeError) -> str:
    """Returns one line; the error's first note, of `config.naming`, says what was read or made."""
    what = "".join(f"{note}: " for note in getattr(error, "__notes__", [])[:1])
    reason = str(error).partition("\n")[0][:200]
    return f"{what}out of memory{reason and ': '}{reason}; try fewer maps or a smaller batch_size"


def use_compilation_cache() -> None:
    """Keeps compiled code between runs, so that a second start is quick; JAX_COMPILATION_CACHE_DIR moves it."""
    import jax

    cache, moved = cache_folder(), "JAX_COMPILATION_CACHE_DIR" in os.environ
    if cache and not moved:
        try:
            jax.config.update("jax_compilation_cache_dir", str(output_folder(cache / "jax")))
        except InputError:
            cache = None
    if cache is None:
        _give_matplotlib_a_folder()
        if not moved:
            return
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")  # a full disk


def _give_matplotlib_a_folder() -> None:
    """Gives it a folder, since it fails without a home and says much of one that cannot be written to."""
    if "MPLCONFIGDIR" not in os.environ:
        os.environ["MPLCONFIGDIR"] = tempfile.mkdtemp(prefix="travjax-matplotlib-")
        atexit.register(shutil.rmtree, os.environ["MPLCONFIGDIR"], ignore_errors=True)
