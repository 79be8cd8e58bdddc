"""Progress bars on terminals, and printed lines that do not disturb them."""

import sys
from typing import Any

from tqdm import tqdm

from travjax.config import one_line

Bar = tqdm

LONGEST_PATH = 5000
"""Most characters of a printed path, somewhat more than systems allow."""


def bar(what: str, total: float | None, unit: str, quiet: bool = False, **options: Any) -> Bar:
    """Makes a progress bar on standard error if that is a terminal: in a log file each update would be a new line."""
    watched = sys.stderr is not None and sys.stderr.isatty()
    return tqdm(desc=what, total=total, unit=unit, disable=quiet or not watched, **options)


def wrote(*paths: object) -> None:
    """Prints where files were written, in one line each, whatever characters their names have."""
    for path in paths:
        print(one_line(path, LONGEST_PATH))


def say(text: str) -> None:
    """Prints a line above the bars."""
    if sys.stdout is not None:
        tqdm.write(text)
