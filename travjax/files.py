"""Files that are written whole or not at all."""

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from travjax.config import InputError


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A temporary name beside `path` to write to; it becomes `path` when the block ends well, else it is removed.

    Raises InputError when it cannot be written: a full disk, a folder in the way.
    """
    temporary = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def folder_written_whole(folder: Path, replaceable: Callable[[Path], bool]) -> Iterator[Path]:
    """A temporary folder beside `folder` to write to; it becomes `folder` when the block ends well, else it is removed.

    Raises InputError when it cannot be written, or when a file or a folder that is not `replaceable` lies there.
    """
    place = folder.resolve()
    temporary, aside = (place.with_name(f".{os.getpid()}-{mark}{place.name}") for mark in ("", "old-"))
    try:
        taken = place.exists() and not (place.is_dir() and (not any(place.iterdir()) or replaceable(place)))
        if taken:
            raise InputError(
                f"{folder}: holds something else: must be a new or empty folder, or an older one of its kind"
            )
        place.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()
        yield temporary
        if place.exists():
            place.rename(aside)
        temporary.rename(place)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if aside.exists() and not place.exists():
            aside.rename(place)
        shutil.rmtree(aside, ignore_errors=True)


def output_folder(path: str | Path) -> Path:
    """Creates the folder if need be. Raises InputError when it cannot be written to."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".{os.getpid()}-probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(
            f"--out {folder}: cannot be written: {error.strerror}; allowed: a folder you may write to"
        ) from None
    return folder


def find_data(name: str, what: str, allowed: str = "a file here or under TRAVJAX_DATA") -> Path:
    """The file of that name, here or under TRAVJAX_DATA.

    Raises InputError that says what it is, where it was looked for, and what is allowed.
    """
    data = os.environ.get("TRAVJAX_DATA")
    for place in [Path(name)] + ([Path(data) / name] if data else []):
        if place.is_file():
            return place
    where = f"nor under TRAVJAX_DATA={data}" if data else "and TRAVJAX_DATA is not set"
    raise InputError(f"{what} {name}: no such file here, {where}; allowed: {allowed}")


def find_preset(given: str, experiment: str) -> Path:
    """The file of a preset: `given` is a path, or a name such as "laptop" for experiments/EXPERIMENT/laptop.toml here.

    Raises InputError that lists the names when there is no such file.
    """
    if Path(given).suffix == ".toml":
        if Path(given).is_file():
            return Path(given)
        raise InputError(f"preset {given}: no such file")
    folder = Path("experiments") / experiment
    path = folder / f"{given}.toml"
    if path.is_file():
        return path
    names = ", ".join(sorted(found.stem for found in folder.glob("*.toml") if found.is_file()))
    elsewhere = f"a .toml file, or a name in a folder where {folder} holds presets"
    allowed = f"{names}, or a .toml file" if names else elsewhere
    raise InputError(f"preset {given}: no {path} here; allowed: {allowed}")


def sha256(path: Path) -> str:
    """The checksum of a file, in hexadecimal; it is read piece by piece."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def cache_folder() -> Path:
    """Where the user's machine keeps what can be made again."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "travjax"


def save_npz(path: Path, **arrays) -> Path:
    """Writes arrays to one .npz file, whole or not at all."""
    with written_whole(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)
    return path
