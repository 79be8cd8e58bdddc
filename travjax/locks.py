"""File locks of the operating system: they end with the process that holds them, however it ends.

A process id does not show whether a process is alive: each container has a process 1, and hosts share volumes.
"""

import fcntl
import os
from pathlib import Path
from typing import IO


def lock_file(path: Path) -> tuple[IO[str], bool | None]:
    """Opens a file, which is made if need be, and locks it until it is closed.

    Returns the file, and True if it is locked, False if another process holds the lock, or None where the file system
    has no locks. Raises OSError when it cannot be opened.
    """
    while True:
        file = path.open("a+", encoding="utf-8", errors="replace")
        locked = _lock(file)
        if locked is False or _lies_at(file, path):
            return file, locked
        file.close()  # the process that held the lock has removed it


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
