"""Locks of the operating system on files: they end with the process that has them, however it ends.

A process id tells nothing of who is alive: each container has a process 1, and hosts share volumes.
"""

import fcntl
import os
from pathlib import Path
from typing import IO


def lock_file(path: Path) -> tuple[IO[str], bool | None]:
    """Opens a file, which is made if need be, and locks it until it is closed.

    Returns the file, and True, False where another process has it locked, or None where there are no locks: some file
    systems have none. Raises OSError when it cannot be opened.
    """
    while True:
        file = path.open("a+", encoding="utf-8", errors="replace")
        locked = _lock(file)
        if locked is False or _lies_at(file, path):
            return file, locked
        file.close()  # removed by the process that had it locked until now


def _lock(file: IO[str]) -> bool | None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        return None
    return True


def _lies_at(file: IO[str], path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
