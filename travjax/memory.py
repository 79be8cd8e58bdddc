"""Checks, before work begins, whether memory and disk are large enough for it."""

import os
import shutil
import sys
from pathlib import Path

from travjax.config import InputError

CGROUP = Path("/sys/fs/cgroup/memory.max")
"""File in which Linux states how much memory a container may use."""


def available() -> int:
    """Returns the bytes of memory that are available now, as far as the system tells."""
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError):  # on Windows nothing is known, and nothing refused
        return sys.maxsize
    try:
        fields = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        total = min(total, int(fields["MemAvailable"].split()[0]) * 1024)
    except (OSError, KeyError, ValueError):  # not Linux
        pass
    try:
        total = min(total, int(CGROUP.read_text()))
    except (OSError, ValueError):  # no container, or "max"
        pass
    return total


def require_memory(size: int, what: str, hint: str = "") -> None:
    """Raises InputError when the `size` bytes that `what` needs do not fit into memory now."""
    there = available()
    if size > there:
        raise InputError(
            f"{what}: takes {_shown(size)} of memory: must be at most {_shown(there)}, which is free{hint}"
        )


def require_disk(size: int, folder: Path, what: str) -> None:
    """Raises InputError when the `size` bytes that `what` needs do not fit on the disk of a folder."""
    there = shutil.disk_usage(folder).free
    if size > there:
        raise InputError(f"{folder}: {what} take up to {_shown(size)}: must be at most {_shown(there)}, which is free")


def _shown(size: int) -> str:
    if size < 2**19:
        return f"{size / 2**10:.0f} KiB"
    return f"{size / 2**30:.1f} GiB" if size >= 2**29 else f"{size / 2**20:.0f} MiB"
