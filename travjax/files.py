"""Files that are written whole or not at all, and paths that a user gives.

A file is first written to a hidden folder beside its place, .travjax-unfinished-XXXXXXXX, which is locked as long as
its process lives. The next process that writes there removes such folders of dead processes.
"""

import ctypes
import hashlib
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

import numpy as np

from travjax.config import InputError
from travjax.locks import lock_file

UNFINISHED = ".travjax-unfinished-"
LOCK = ".travjax-lock"
REPLACED = ".travjax-replaced"
"""Names of a folder for unfinished files and, within it, of its lock and of a folder being replaced by renames."""

PRESETS = Path(__file__).parent / "presets"
"""The presets that come with the package, in a folder for each kind."""


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yields a temporary path to write to, which becomes `path` when the block ends well and is removed otherwise.

    Raises InputError when it cannot be written: a full disk, a folder in the way.
    """
    with _input_error(path), _unfinished(path.parent) as unfinished:
        temporary = unfinished / path.name
        yield temporary
        temporary.replace(path)


@contextmanager
def atomic_write_folder(folder: Path, replaceable: Callable[[Path], bool]) -> Iterator[Path]:
    """Yields a temporary folder to write to, which becomes `folder` when the block ends well and is removed otherwise.

    Where the file system can exchange two names, either the old or the new folder is in place at any moment; elsewhere,
    if the process is killed, the next one that writes there or calls `put_back` restores the old folder.
    Raises InputError when it cannot be written, or when a file or a folder that is not `replaceable` lies there.
    """
    place = resolved(folder)
    with _input_error(folder):
        place.parent.mkdir(parents=True, exist_ok=True)
        with _unfinished(place.parent) as unfinished:
            if place.exists() and not (place.is_dir() and (not any(place.iterdir()) or replaceable(place))):
                raise InputError(
                    f"{folder}: holds something else: must be a new or empty folder, or an older one of its kind"
                )
            temporary = unfinished / place.name
            temporary.mkdir()
            yield temporary
            if not place.exists() or not _exchanged(temporary, place):
                if place.exists():
                    (unfinished / REPLACED).mkdir()
                    place.rename(unfinished / REPLACED / place.name)
                temporary.rename(place)


def put_back(folder: Path) -> None:
    """Restores a folder that a process was replacing when it was killed."""
    place = resolved(folder)
    if not place.exists():
        _remove_remains(place.parent)


@contextmanager
def _input_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None


@contextmanager
def _unfinished(folder: Path) -> Iterator[Path]:
    """Yields a hidden folder of this process within a folder, for what is being written; it is removed at the end."""
    _remove_remains(folder)
    place, lock = _locked_folder(folder)
    try:
        yield place
    finally:
        _bring_back_replaced(place)
        lock.close()  # network file systems keep open files, and with them their folder
        shutil.rmtree(place, ignore_errors=True)


def _locked_folder(folder: Path) -> tuple[Path, IO[str]]:
    while True:
        place = Path(tempfile.mkdtemp(prefix=UNFINISHED, dir=folder))
        try:
            lock, locked = lock_file(place / LOCK)
        except FileNotFoundError:  # another process took the folder, not yet locked, for remains
            continue
        except OSError:
            shutil.rmtree(place, ignore_errors=True)
            raise
        if locked is not False:
            return place, lock
        lock.close()


def _remove_remains(folder: Path) -> None:
    """Removes from a folder the unfinished files of dead processes."""
    with suppress(OSError):
        found = [place for place in folder.iterdir() if re.fullmatch(rf"{re.escape(UNFINISHED)}\w{{8}}", place.name)]
        for place in found:
            _remove_if_dead(place)


def _remove_if_dead(place: Path) -> None:
    with suppress(OSError):  # no permission, or another process removed it meanwhile
        lock, locked = lock_file(place / LOCK)
        with lock:
            if locked:
                _bring_back_replaced(place)
                shutil.rmtree(place, ignore_errors=True)
        place.rmdir()  # network file systems may have kept it


def _bring_back_replaced(unfinished: Path) -> None:
    """Moves a folder that was to be replaced back to its place, if that is free."""
    with suppress(OSError):
        for old in (unfinished / REPLACED).iterdir():
            if not os.path.lexists(unfinished.parent / old.name):
                old.rename(unfinished.parent / old.name)


def _exchanged(one: Path, other: Path) -> bool:
    """Exchanges two names atomically; returns False where the system or the file system cannot."""
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE of Linux
    try:
        rename = ctypes.CDLL(None).renameat2
    except (OSError, AttributeError):
        return False
    return rename(here, os.fsencode(one), here, os.fsencode(other), exchange) == 0


_HELD: set[Path] = set()
"""Folders that this process holds."""


@contextmanager
def held(folder: Path, option: str = "--out") -> Iterator[None]:
    """Reserves a folder, made if need be, for this process while the block runs; the block may reserve it again.

    option: name of the folder in messages
    Raises InputError that names process and host when another process has it, or when it cannot be written to.
    """
    place = resolved(folder)
    if place in _HELD:
        yield
        return
    new = not place.exists()
    path = output_folder(folder) / LOCK
    try:
        with _input_error(path):
            lock, locked = lock_file(path)
        with lock:
            if locked is False:
                raise InputError(
                    f"{option} {folder}: in use by {_holder(lock)}; allowed: a folder that no other run uses"
                )
            with suppress(OSError):  # the next write reports a full disk
                lock.truncate(0)
                lock.write(f"process {os.getpid()} on {socket.gethostname()}")
                lock.flush()
            _HELD.add(place)
            try:
                yield
            finally:
                _HELD.remove(place)
                path.unlink(missing_ok=True)
    finally:
        if new:
            with suppress(OSError):  # it may not be empty
                place.rmdir()


def _holder(lock: IO[str]) -> str:
    lock.seek(0)
    return lock.read(200).strip() or "another process"


def output_folder(path: str | Path) -> Path:
    """Creates the folder if need be, and removes the unfinished files of dead processes in it.

    Raises InputError when it cannot be written to.
    """
    folder = user_path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise InputError(
            f"--out {folder}: cannot be written: {error.strerror}; allowed: a folder you may write to"
        ) from None
    _remove_remains(folder)
    return folder


def require_replaceable(path: Path, ours: Callable[[Path], bool], option: str, what: str) -> None:
    """Raises InputError where a file that the user did not name and travjax did not write would be replaced.

    option: option that led to its name, and its value; what: the thing that would be written
    """
    if os.path.lexists(path) and not (path.is_file() and ours(path)):
        raise InputError(
            f"{option}: {path} is in the way, and no {what} of travjax; allowed: another name, or none there"
        )


def first_lines(path: Path, count: int) -> list[str]:
    """Returns the first lines of a text file, fewer if it has no more, and none if it cannot be read."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            return [file.readline(1000).rstrip("\n") for _ in range(count)]
    except OSError:
        return []


def user_path(path: str | Path) -> Path:
    """Expands ~ in a path that a user gives; without a home it stays as it is."""
    return Path(os.path.expanduser(path))


def resolved(path: Path) -> Path:
    """Returns the path without symbolic links. Raises InputError when one of them leads to itself."""
    try:
        return path.resolve()
    except (OSError, RuntimeError):  # the latter occurs up to Python 3.12
        raise InputError(f"{path}: a symbolic link that leads to itself; allowed: a folder, or a new one") from None


def find_data(name: str, what: str, allowed: str = "a file here or under TRAVJAX_DATA") -> Path:
    """Finds the file of that name, here or under TRAVJAX_DATA.

    Raises InputError that says what it is, where it was looked for, and what is allowed.
    """
    data = os.environ.get("TRAVJAX_DATA")
    for place in [user_path(name)] + ([user_path(data) / name] if data else []):
        if place.is_file():
            return place
    where = f"nor under TRAVJAX_DATA={data}" if data else "and TRAVJAX_DATA is not set"
    raise InputError(f"{what} {name}: no such file here, {where}; allowed: {allowed}")


def find_preset(given: str | Path, kind: str) -> Path:
    """Returns the file of a preset that is given by its path, or by a name such as "laptop" in PRESETS/KIND.

    Raises InputError, which lists the names, when there is no preset of that name. A path is returned unchecked.
    """
    if Path(given).suffix.lower() == ".toml":
        return user_path(given)
    presets = {path.stem: path for path in sorted((PRESETS / kind).glob("*.toml"))}
    if str(given) not in presets:
        raise InputError(f"preset {given}: no such {kind} preset; allowed: {', '.join(presets)}, or a .toml file")
    return presets[str(given)]


def sha256(path: Path) -> str:
    """Returns the SHA-256 of a file in hexadecimal; reads the file piece by piece."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def cache_folder() -> Path | None:
    """Returns the user's cache folder for files that can be made again, or None for a user without a home."""
    home = os.path.expanduser("~") if os.environ.get("HOME") != "" else ""
    given = os.environ.get("XDG_CACHE_HOME", "")
    # The XDG standard says to ignore relative paths.
    place = given if os.path.isabs(given) else os.path.join(home, ".cache")
    return Path(place) / "travjax" if os.path.isabs(place) else None


def save_text(path: Path, text: str) -> Path:
    """Writes a text file, whole or not at all; characters of file names that UTF-8 lacks are escaped."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")
    return path


def save_npz(path: Path, **arrays) -> Path:
    """Writes arrays to one .npz file, whole or not at all."""
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)
    return path
