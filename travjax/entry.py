"""Shared by all programs of travjax: one line for bad input, exit codes, the compilation cache, and a quiet XLA.

JAX is imported only where it is used, because `quiet_xla` has to run first.
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
    """A parser that reports errors in one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


def quiet_xla() -> None:
    """Lets XLA print only fatal errors, unless TF_CPP_MIN_LOG_LEVEL is set; to be called before JAX is imported.

    When XLA reads compiled code from the cache, it logs an error about two tuning hints that are not processor
    features ("+prefer-no-gather is not supported on the host machine").
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def settle_streams() -> None:
    """Opens closed standard streams, lest a file take their place, and makes all of them accept any character."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
    sys.stdout, sys.stderr = _settled(sys.stdout, 1), _settled(sys.stderr, 2)


def _settled(stream: IO[str] | None, number: int) -> IO[str]:
    """Returns the stream, or a new one if there is none; it escapes characters that its encoding lacks."""
    stream = stream or open(number, "w", closefd=False)
    if hasattr(stream, "reconfigure"):  # a stream of a test may lack it
        stream.reconfigure(errors="backslashreplace")
    return stream


def guarded(work: Callable[[], int | None]) -> int:
    """Runs a program; returns its exit code, 0 for None, and 2 for bad input, which is reported in one line."""
    settle_streams()
    with signals.raised():
        try:
            from travjax.jax_flags import usual_flags  # imports JAX, which takes a second

            with usual_flags():
                code = work()
            sys.stdout.flush()
        except InputError as error:
            return _ended(2, str(error))
        except BrokenPipeError:  # nobody reads the output any more
            _drop_output()
            return 1
        except OSError as error:  # a name that is too long, no permission
            return _ended(2, f"{error.filename or 'a file'}: {error.strerror or error}")
        except (MemoryError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):  # raised by XLA
                raise
            return _ended(2, _out_of_memory(error))
        except KeyboardInterrupt as error:
            warnings.simplefilter("ignore")  # Python warns about interrupted coroutines
            return _ended(*signals.ending(error))
    return code or 0


def _ended(code: int, line: str) -> int:
    """Prints in one line why a program ends; returns its exit code."""
    with suppress(OSError):  # nobody may be there to read it
        print(one_line(f"travjax: {line}"), file=sys.stderr)
    try:
        sys.stdout.flush()
    except OSError:
        _drop_output()
    return code


def _drop_output() -> None:
    """Discards output that is still to be printed, so that Python does not try again when it exits."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _out_of_memory(error: MemoryError | RuntimeError) -> str:
    """Returns one line on an out-of-memory error; its first note, by `config.naming`, says what was read or made."""
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
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")  # a full disk causes them


def _give_matplotlib_a_folder() -> None:
    """Gives matplotlib a folder; it fails without a home, and prints warnings if it cannot write there."""
    if "MPLCONFIGDIR" not in os.environ:
        os.environ["MPLCONFIGDIR"] = tempfile.mkdtemp(prefix="travjax-matplotlib-")
        atexit.register(shutil.rmtree, os.environ["MPLCONFIGDIR"], ignore_errors=True)
