"""Arrays of heights in .npy and .npz files, as grid.py has them: rows to the north, columns to the east.

An .npz holds `heights` [rows, cols], or maps [n, rows, cols], and `cell_size`; `origin` (x, y of the south-west value),
`height_offset` and `crs` are optional, one for all maps or one for each. What `travjax label` and `travjax terrain`
wrote comes back as it was.
"""

import math
import sys
import tokenize
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from travjax.config import InputError, require
from travjax.memory import require_memory
from travjax.rasters.coordinates import require_metric_named
from travjax.rasters.raster import InMetres, Raster, agreed_cell_size, is_real, marks_nothing
from travjax.rasters.reading_options import DemOptions
from travjax.simulation.heights import require_close

WANTED = ("heights", "cell_size", "origin", "crs", "height_offset")
"""Arrays of an .npz that say something about heights."""

LARGE = 2**30
"""Bytes from which on an array must not unfold to more than UNFOLDED times what it takes in the file."""

UNFOLDED = 50

Entries = dict[str, np.ndarray]


def read_npy(path: Path, options: DemOptions) -> list[Raster]:
    """Returns the array as rasters, mapped from the file; raises InputError when it is none, or has no cell size."""
    with _reading(path):
        with path.open("rb") as file:
            size = _require_whole(file, path.name, path.stat().st_size)
            mapped = np.load(path, mmap_mode="r" if size else None, allow_pickle=False)  # nothing cannot be mapped
    return rasters_of({"heights": mapped}, options)


def read_npz(path: Path) -> tuple[Entries, list[str]]:
    """Returns the arrays of an .npz that are WANTED, or are points, and the names of all.

    Raises InputError when it is damaged, or when an array is larger than it can be or than memory.
    """
    with _reading(path), zipfile.ZipFile(path) as archive:
        members = {name.removesuffix(".npy"): name for name in archive.namelist()}
        wanted = WANTED if "heights" in members else (*WANTED, "points", "x", "y", "z", "classification")
        return {name: _member(archive, members[name]) for name in wanted if name in members}, list(members)


def rasters_of(entries: Entries, options: DemOptions, names: list[str] | None = None) -> list[Raster]:
    """Returns a raster for each map of the arrays of one file; raises InputError for those that do not fit together.

    names: of all arrays of the file; where `config` is among them, travjax wrote it, and heights stay as they are
    """
    heights = entries["heights"]
    if heights.ndim not in (2, 3) or not heights.size or not is_real(heights.dtype):
        raise InputError(
            f"heights: {heights.dtype} {list(heights.shape)}: must be numbers [rows, cols] or [n, rows, cols]"
        )
    if heights.dtype.itemsize == 2:
        require_close(heights)
    maps = heights.reshape(-1, *heights.shape[-2:])
    each, cell_size = len(maps), options.cell_size
    if "cell_size" in entries:
        stored = _numbers(entries["cell_size"], "cell_size", "one number of metres", (1,))[0]
        cell_size = agreed_cell_size(stored, cell_size)
    elif cell_size is None:
        raise InputError("cell_size is missing: give it (--cell-size METRES), or store `cell_size` in the .npz")
    origins = _numbers(
        entries.get("origin", np.zeros(2)), "origin", "x, y of the south-west value", (2,), (each, 2)
    ).reshape(-1, 2)
    offsets = _numbers(entries.get("height_offset", np.zeros(1)), "height_offset", "metres", (1,), (each,))
    systems = _systems(entries, each)
    ours = "config" in (names or ()) and "height_offset" in entries
    scale, notes = options.height_scale or 1.0, marks_nothing(options.nodata, heights.dtype)
    rasters = []
    places = np.broadcast_to(origins, (each, 2))
    for name in dict.fromkeys(systems):
        there = places if len(systems) == 1 else places[[name == other for other in systems]]
        x, y = there.mean(axis=0).tolist()
        require_metric_named(name, x, y, options.height_scale is not None)
    for index, one in enumerate(maps):
        (x, y), offset = places[index], offsets[index % len(offsets)]
        crs = systems[index % len(systems)] if systems else None
        values = InMetres(one, scale, 0.0 if ours else offset, nodata=options.nodata)
        rasters.append(Raster(values, cell_size, (float(x), float(y)), crs, notes, float(offset) if ours else None))
        notes = ()
    return rasters


def _systems(entries: Entries, each: int) -> list[str | None]:
    """Reads the coordinate system of all maps, or of each; returns an empty list where there is none."""
    crs = np.ravel(entries["crs"]) if "crs" in entries else np.zeros(0, "U1")
    if crs.dtype.kind not in "US" and crs.size:
        raise InputError(f"crs: {crs.dtype}: must be a text, or one for each map")
    texts = [text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text) for text in crs.tolist()]
    require(len(texts) in (0, 1, each), "crs", f"{len(texts)} texts", f"one for all maps, or {each}")
    return [text or None for text in texts]


def _numbers(value: np.ndarray, name: str, allowed: str, *shapes: tuple[int, ...]) -> np.ndarray:
    """Reads finite numbers of one of the shapes; a single one counts as [1]."""
    array = np.atleast_1d(value)
    fits = array.shape in shapes and is_real(array.dtype) and bool(np.isfinite(array).all())
    require(fits, name, value.tolist(), allowed)
    return array.astype(float)


# ---- Files


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turns whatever NumPy and zipfile raise on a file into one line."""
    try:
        yield
    except (InputError, FileNotFoundError, PermissionError):
        raise
    except MemoryError as error:
        raise InputError(f"does not fit into memory: {error}") from None
    except Exception as error:  # header and archive are parsed by a dozen modules, each with exceptions of its own
        reason = str(error)
        if "pickle" in reason or isinstance(error, EOFError | tokenize.TokenError):
            reason = "it is no such file, or cut short"
        reason = next(iter(reason.splitlines()), "") or type(error).__name__
        raise InputError(f"cannot be read as {path.suffix}: {reason}") from None


def _member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """Reads one array of an archive, once what it claims agrees with what is there."""
    described = archive.getinfo(name)
    if described.file_size > max(LARGE, UNFOLDED * described.compress_size):
        raise InputError(
            f"{name}: {described.compress_size} bytes that claim to unfold to {described.file_size}: "
            f"must be at most {UNFOLDED} times as many, from {LARGE} on"
        )
    require_memory(described.file_size, name)
    with archive.open(described) as file:
        _require_whole(file, name, described.file_size)
    with archive.open(described) as file:
        array = np.lib.format.read_array(file, allow_pickle=False)
    if array.dtype.kind == "U":
        letters = np.atleast_1d(array).view(f"{array.dtype.byteorder}u4")
        if letters.size and letters.max() > sys.maxunicode:
            raise InputError(f"{name}: holds numbers that are no letters: must be text")
    return array


def _require_whole(file: IO[bytes], name: str, size: int) -> int:
    """Returns the bytes of the array of an open .npy file; raises InputError unless these are what its header says.

    size: of the file
    """
    version = np.lib.format.read_magic(file)
    readers: dict[tuple[int, int], Any] = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    require(version in readers, f"{name}: version", version, "(1, 0) or (2, 0)")
    shape, _, dtype = readers[version](file)
    claimed, there = math.prod(int(edge) for edge in shape) * dtype.itemsize, size - file.tell()
    if claimed != there and not dtype.hasobject:
        raise InputError(f"cannot be read: {name} holds {there} bytes of numbers, and {claimed} by its header")
    return claimed
