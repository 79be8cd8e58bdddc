"""Progress bars for those who watch, and lines that do not run into them."""

import sys
from typing import Any

from tqdm import tqdm

from travjax.config import one_line

Bar = tqdm

LONGEST_PATH = 5000
"""Characters, somewhat more than a system takes."""


def bar(what: str, total: float | None, unit: str, quiet: bool = False, **options: Any) -> Bar:
    """Makes a progress bar on standard error if that is a terminal: in a log file each update would be a new line."""
    watched = sys.stderr is not None and sys.stderr.isatty()
    return tqdm(desc=what, total=total, unit=unit, disable=quiet or not watched, **options)


def wrote(*paths: object) -> None:
    """Prints where files were written, a line each whatever their names hold."""
    for path in paths:
        print(one_line(path, LONGEST_PATH))


def say(text: str) -> None:
    """Prints a line above the bars."""
    if sys.stdout is not None:
        tqdm.write(text)
