"""Rasters of heights: what holds for every format (SPEC section 11).

Row 0 is the southernmost, column 0 the westernmost: north is +row, east is +col, whichever way a file is stored.
Heights are read part by part, so that a raster may be larger than memory.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from travjax.config import InputError, require, require_number
from travjax.simulation.grid import HIGHEST, MARKERS, Grid

COARSEST = 0.125
"""Metres: cells larger than this do not show a step or a rock."""

LOWEST = -12_000.0
"""Metres: what is deeper is no height; HIGHEST is in grid.py."""

STORED_MARKERS = (-9999, -99999, -32768, -32767)
"""The same among numbers that are scaled to metres, in which 9999 may well be a height."""

PART = 2**22
"""Cells of a raster that are in memory at once while it is read through: 32 MiB."""

SAMPLE = 2**24
"""Known heights of which the median is taken; of larger rasters every second, third ... value counts."""


class HeightSource(Protocol):
    """Metres [rows, cols], NaN unknown, of which parts are read as they are asked for; an array is one."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, cols)."""

    def __getitem__(self, part: tuple[slice, slice]) -> np.ndarray:
        """Reads a part of the raster, [rows, cols] float64; the bounds of both slices are whole numbers from 0."""


@dataclass(frozen=True)
class Raster:
    """Heights of one file in this package's convention.

    heights:       [rows, cols] float64 metres, NaN unknown
    cell_size:     metres between neighbouring values
    origin:        x, y of heights[0, 0], the south-west value
    crs:           coordinate system as the file names it, or None
    notes:         lines about how the file was read that its user should know
    height_offset: metres above which the heights are counted already, where it is a window that was written so
    frame:         name of the frame of a recording of ROS, else None
    """

    heights: HeightSource
    cell_size: float
    origin: tuple[float, float] = (0.0, 0.0)
    crs: str | None = None
    notes: tuple[str, ...] = ()
    height_offset: float | None = None
    frame: str | None = None


class InMetres:
    """Values of a file as heights, turned into metres part by part; see HeightSource.

    values:   [rows, cols] numbers of any type, in memory or mapped from a file
    scale:    metres a unit
    offset:   metres, added
    unknown:  [rows, cols] bool, or None
    nodata:   value that marks unknown ground as well, or None; one that the type cannot hold marks nothing
    southern: whether row 0 of the values is the southernmost
    """

    def __init__(
        self,
        values: np.ndarray,
        scale: float = 1.0,
        offset: float = 0.0,
        unknown: np.ndarray | None = None,
        nodata: float | None = None,
        southern: bool = True,
    ):
        order = slice(None) if southern else slice(None, None, -1)
        self._values = values[order]
        self._unknown = None if unknown is None else unknown[order]
        self._scale, self._offset, self._nodata = scale, offset, as_stored(nodata, values.dtype)

    @property
    def shape(self) -> tuple[int, ...]:
        return self._values.shape

    def __getitem__(self, part: tuple[slice, slice]) -> np.ndarray:
        values = self._values[part]
        with np.errstate(invalid="ignore"):  # of a NaN that signals, in damaged files
            heights = values.astype(np.float64)
        if self._scale != 1:
            heights *= self._scale
        if self._offset:
            heights += self._offset
        if self._unknown is not None:
            heights[self._unknown[part]] = np.nan
        if self._nodata is not None:
            heights[values == self._nodata] = np.nan
        if self._scale != 1 or self._offset:
            marked = np.isin(values, STORED_MARKERS) & ~np.isnan(heights)
            for bad in values[marked][:1].tolist():
                raise InputError(
                    f"heights = {bad:g}, as stored: is a usual mark of unknown ground, not declared as such; "
                    "if it marks unknown ground, say so (--nodata=VALUE)"
                )
        return heights


def as_stored(nodata: float | None, dtype: np.dtype) -> np.generic | None:
    """Returns the value as that number type holds it, or None where it cannot; only fractions may be rounded."""
    if nodata is None:
        return None
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        whole = float(nodata).is_integer() and limits.min <= int(nodata) <= limits.max
        return dtype.type(int(nodata)) if whole else None
    return dtype.type(nodata) if abs(nodata) <= float(np.finfo(dtype).max) else None


def marks_nothing(nodata: float | None, dtype: np.dtype) -> tuple[str, ...]:
    """Returns a note where a value that was given to mark unknown ground cannot occur among numbers of that type."""
    missed = nodata is not None and as_stored(nodata, dtype) is None
    return (f"nodata = {nodata:g} marks nothing: the file holds {dtype.name}",) if missed else ()


def is_real(dtype: np.dtype) -> bool:
    """Tells whether numbers of that type can be heights."""
    return dtype.kind in "iuf"


def parts(heights: HeightSource, beyond: int = 0) -> Iterator[tuple[slice, slice, np.ndarray]]:
    """Reads heights through from south to north, some rows at a time.

    Yields the rows, where they stand in the part that was read, and that part [rows, cols] with up to `beyond` rows
    more on both sides.
    """
    rows, cols = heights.shape
    count = max(PART // max(cols, 1), 1)
    for start in range(0, rows, count):
        stop = min(start + count, rows)
        first, last = max(start - beyond, 0), min(stop + beyond, rows)
        yield slice(start, stop), slice(start - first, stop - first), heights[first:last, 0:cols]


@dataclass(frozen=True)
class Survey:
    """What a raster holds.

    known:           number of cells whose height is known
    lowest, highest: metres, of these; NaN where there are none
    median:          metres, of these or of a SAMPLE of them; NaN where there are none
    """

    known: int
    lowest: float
    highest: float
    median: float


def survey(heights: HeightSource) -> Survey:
    """Reads a raster through; raises InputError when a height cannot be one, or is an undeclared mark of none."""
    every = max(int(np.prod(heights.shape)) // SAMPLE, 1)
    known, lowest, highest, sampled = 0, np.inf, -np.inf, []
    for _, _, part in parts(heights):
        values = part[~np.isnan(part)]
        if values.size:
            known += values.size
            lowest, highest = min(lowest, values.min()), max(highest, values.max())
            sampled.append(values[::every].copy())  # not a view, which would keep all of them
    if not known:
        return Survey(0, np.nan, np.nan, np.nan)
    require_heights(np.array([lowest, highest]))
    return Survey(known, float(lowest), float(highest), float(np.median(np.concatenate(sampled))))


def require_heights(known: np.ndarray) -> None:
    """Raises InputError unless there are heights, [n] without NaN, and all of them can be the ground's."""
    require_known(known.size)
    for bad in (known.min(), known.max()):
        hint = "if it marks unknown ground, say so (--nodata=VALUE)"
        if not LOWEST <= bad <= HIGHEST:
            raise InputError(f"heights = {bad:g}: must lie between {LOWEST:g} and {HIGHEST:g} m; {hint}")
        if round(float(bad), 6) in MARKERS:
            raise InputError(f"heights = {bad:g}: is a usual mark of unknown ground, not declared as such; {hint}")


def require_known(count: int) -> None:
    """Raises InputError when no height of a file is known."""
    if not count:
        raise InputError("heights: all unknown (NaN or nodata): must hold some known ground")


def require_size(east: float, north: float, grid: Grid) -> None:
    """Raises InputError when a site of these metres, node to node, holds no window."""
    if min(north, east) < grid.size - 1e-6:
        raise InputError(
            f"size = {east:g} x {north:g} m: must be at least {grid.size:g} x {grid.size:g} m, node to node"
        )


def require_fine(cell_size: float, allow_coarse: bool) -> None:
    """Raises InputError for cells that do not show a step, unless they are allowed."""
    if cell_size > COARSEST + 1e-9 and not allow_coarse:
        raise InputError(f"cell_size = {cell_size:g}: must be at most {COARSEST:g} m (--allow-coarse takes it)")


def agreed_cell_size(of_file: float, given: float | None) -> float:
    """Returns the file's cell size; raises InputError for a bad one, or when the given one contradicts it."""
    require_number("cell_size", of_file, 0, 1000, "metres, above 0 and at most 1000")
    if given is not None:
        require(abs(given - of_file) < 1e-4 * of_file, "cell_size", given, f"left out: the file says {of_file:g}")
    return of_file
