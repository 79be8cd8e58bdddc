"""Real elevation maps: read a file, fill small holes, resample, cut into windows (SPEC section 11).

Files are converted to one convention: row 0 is the southernmost, column 0 the westernmost, and a value belongs to the
centre of its pixel. Rasters that GDAL reads declare their orientation; .npy and .npz follow grid.py; for points, x is
east and y is north. The type of a file is recognised by its content.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from travjax.config import InputError, require, require_number
from travjax.files import sha256, user_path
from travjax.memory import require_memory
from travjax.point_clouds.clouds import cloud_of_arrays, read_cloud
from travjax.rasters.array_files import rasters_of, read_npy, read_npz
from travjax.rasters.formats import unfolded
from travjax.rasters.gdal_files import read_raster
from travjax.rasters.grid_maps import read_grid_map
from travjax.rasters.raster import Raster, Survey, require_fine, require_known, require_size, survey
from travjax.rasters.reading_options import DemOptions
from travjax.rasters.surface import Surface
from travjax.simulation.grid import Grid, require_grid

MOST_WINDOWS = 2**20
"""The largest number of windows of one file."""

FAR_APART = 100.0
"""Metres: if the maps of a file differ by more in height, each gets a height offset of its own."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Square maps cut out of a DEM, and where each comes from.

    origins:       [n, 2] float64 x, y of each window's south-west node
    cell_size:     metres between values in the file; the windows are at the grid's spacing
    crs:           coordinate system as the file names it, or None; one for each window if the file names several
    height_offset: metres, subtracted from the file's heights in float64; [n, 1, 1] where each map has its own
                   offset
    covered:       share of the file's area that lies in some window
    filled:        share of all cells that were interpolated in small holes
    unknown:       share of all cells that remain unknown
    path, sha256:  the file and its checksum
    notes:         lines about how the file was read that its user should know
    """

    origins: np.ndarray
    cell_size: float
    crs: str | None | tuple[str | None, ...]
    height_offset: float | np.ndarray
    covered: float
    filled: float
    unknown: float
    path: str
    sha256: str
    notes: tuple[str, ...]
    _grid: Grid
    _surfaces: list[Surface]
    _corners: np.ndarray  # [n, 3] surface, row, col

    def __len__(self) -> int:
        """Returns the number of windows."""
        return len(self._corners)

    @cached_property
    def heights(self) -> np.ndarray:
        """All windows at once, [n, rows, cols] float32 metres above `height_offset`, NaN unknown.

        Raises InputError when they do not fit into memory; `read` reads only some of them.
        """
        size = 4 * len(self) * self._grid.nodes**2
        require_memory(size, f"{self.path}: {len(self)} windows", "; take a larger stride, or some at a time")
        return self.read(slice(None))

    def read(self, which: slice | np.ndarray) -> np.ndarray:
        """Reads some of the windows, [k, rows, cols] as in `heights`; fastest in their own order."""
        corners = self._corners[which]
        cut = np.empty((len(corners), *self._grid.shape), np.float32)
        with naming_file(Path(self.path)):
            for window, (surface, row, col) in zip(cut, corners.tolist(), strict=True):
                window[...] = self._surfaces[surface].nodes(*(slice(at, at + self._grid.nodes) for at in (row, col)))
        return cut

    def systems(self, which: slice | np.ndarray = slice(None)) -> np.ndarray:
        """Returns the name of the coordinate system of some of the windows, [k], "" for none."""
        names = self.crs if isinstance(self.crs, tuple) else (self.crs,)
        return np.broadcast_to(np.array([name or "" for name in names]), len(self))[which]

    def offsets(self, which: slice | np.ndarray = slice(None)) -> np.ndarray:
        """Returns the height offset of some of the windows, [k] metres."""
        return np.broadcast_to(np.ravel(self.height_offset), len(self))[which]


def load_dem(
    path: str | Path,
    stride: float = 8.0,
    *,
    grid: Grid = Grid(),
    cell_size: float | None = None,
    height_scale: float | None = None,
    nodata: float | None = None,
    fill_holes: bool = True,
    allow_coarse: bool = False,
    band: int | str | None = None,
    classes: tuple[int, ...] | None = None,
    up: str | None = None,
    gdal_drivers: tuple[str, ...] = (),
    topic: str | None = None,
    layer: str | None = None,
    time: float | None = None,
) -> Windows:
    """Cuts a DEM into windows of the grid's size, starting at its south-west corner; partial windows are dropped.

    Windows of a large raster are read from the file when they are asked for.

    path:         GeoTIFF or another raster of local pixels that GDAL reads; .npy, or .npz with `heights` ([rows, cols],
                  or several maps [n, rows, cols] that are cut one by one) and `cell_size`; a point cloud or a mesh as
                  clouds.py reads it; any of them may be compressed with gzip
    stride:       metres between the origins of neighbouring windows, rounded to whole cells
    cell_size:    metres, for files that do not state it; for a point cloud that is not a regular lattice, the cells in
                  which points are averaged: unless given, the grid's spacing, or cells that hold two points on
                  average if those are larger
    height_scale: metres per unit of the file's values; 1, or what the file states, unless given; required for pictures
    nodata:       a value that marks unknown ground, if the file does not declare it
    fill_holes:   interpolate holes in which every cell lies within 0.125 m, or one cell, of known ground
    allow_coarse: accept cells larger than 0.125 m
    band:         number from 1, or description, of a band; name of a netCDF variable, "name:2" for its second band
    classes:      classes of LAS points to use; unless given, ground only, if the file has classified ground
    up:           "y" if that axis of a point cloud or mesh points up; "z" unless given
    gdal_drivers: GDAL drivers that may read the file besides those in gdal_files.DRIVERS
    topic, layer: of a recording of ROS with a GridMap (.bag, .db3, .mcap); the only ones unless given
    time:         seconds from the start of a recording, until which the latest map is read; its end unless given
    Raises InputError when the file is missing, is not an elevation map, is in degrees, feet or a system whose units are
    not metres on the ground, has no cell size, a non-square or too large one, or one that differs from the given, has
    infinite or absurd heights or no known ones, is smaller than one window, or does not fit into memory.
    """
    path = user_path(path)
    require_number("stride", stride, 0, 1e6, "a distance in metres, above 0")
    require(stride > grid.spacing - 1e-9, "stride", stride, f"at least the spacing of the nodes, {grid.spacing:g} m")
    require_grid(grid)
    options = DemOptions(cell_size, height_scale, nodata, band, classes, up, gdal_drivers, topic, layer, time)
    with naming_file(path):
        rasters = read_rasters(path, options, grid)
        for raster in rasters:
            require_fine(raster.cell_size, allow_coarse)
            north, east = ((edge - 1) * raster.cell_size for edge in raster.heights.shape)
            require_size(east, north, grid)
        corners, covered = _corners(rasters, stride, grid)
        surveys = [survey(raster.heights) for raster in rasters]
        require_known(sum(found.known for found in surveys))
        offsets = height_offsets(rasters, surveys)
        base = [
            0.0 if raster.height_offset is not None else offset for raster, offset in zip(rasters, offsets, strict=True)
        ]
        surfaces = [
            Surface(raster, grid.spacing, above, fill_holes and raster.height_offset is None)
            for raster, above in zip(rasters, base, strict=True)
        ]
        checksum = sha256(path)
    cells = np.array([raster.heights.shape for raster in rasters]).prod(axis=1)
    filled = np.array([surface.filled for surface in surfaces])
    missing = cells - filled - [found.known for found in surveys]
    origins = np.array([raster.origin for raster in rasters])
    systems = {raster.crs for raster in rasters}
    return Windows(
        origins=origins[corners[:, 0]] + grid.spacing * corners[:, :0:-1],
        cell_size=rasters[0].cell_size,
        crs=rasters[0].crs if len(systems) == 1 else tuple(rasters[one].crs for one in corners[:, 0]),
        height_offset=offsets[0] if len(set(offsets)) == 1 else np.array(offsets)[corners[:, 0], None, None],
        covered=covered,
        filled=float(np.mean(filled / cells)),
        unknown=float(np.mean(missing / cells)),
        path=str(path),
        sha256=checksum,
        notes=tuple(note for raster in rasters for note in raster.notes),
        _grid=grid,
        _surfaces=surfaces,
        _corners=corners,
    )


@contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Prefixes errors about a file with its name."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except MemoryError as error:
        raise InputError(f"{path}: does not fit into memory: {error}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None


def read_rasters(path: Path, options: DemOptions, grid: Grid) -> list[Raster]:
    """Reads the rasters of a file according to its content; grid: smallest map, and cells of points."""
    if path.is_dir():
        raise InputError("is a folder; allowed: a file")
    if not path.is_file():
        raise InputError("no such file")
    with unfolded(path) as (readable, form):
        if form == "npy":
            rasters = read_npy(readable, options)
        elif form == "npz":
            rasters = _read_archive(readable, options, grid)
        elif form == "recording":
            rasters = [read_grid_map(readable, options)]
        elif form == "raster":
            rasters = [read_raster(readable, options)]
        else:
            rasters = [read_cloud(readable, form, options, grid)]
        if readable != path:  # a temporary copy, which will be deleted
            rasters = [replace(raster, heights=_all(raster)) for raster in rasters]
    return rasters


def _all(raster: Raster) -> np.ndarray:
    rows, cols = raster.heights.shape
    require_memory(8 * rows * cols, f"{rows} x {cols} heights", "; unpack it first")
    return np.array(raster.heights[0:rows, 0:cols])


def _read_archive(path: Path, options: DemOptions, grid: Grid) -> list[Raster]:
    """Reads the maps or the points in an .npz."""
    entries, names = read_npz(path)
    if "heights" in entries:
        return rasters_of(entries, options, names)
    if "points" in entries or {"x", "y", "z"} <= set(entries):
        return [cloud_of_arrays(entries, options, grid)]
    raise InputError(f"no array `heights`; it holds: {', '.join(names) or 'nothing'}")


def _corners(rasters: list[Raster], stride: float, grid: Grid) -> tuple[np.ndarray, float]:
    """Returns (raster, row, column) of the south-west node of each window, [n, 3], and the share that they cover."""
    step, found, covered = round(stride / grid.spacing), [], []
    for index, raster in enumerate(rasters):
        nodes = [int((edge - 1) * raster.cell_size / grid.spacing + 1e-6) + 1 for edge in raster.heights.shape]
        rows, cols = (np.arange(0, edge - grid.cells, step) for edge in nodes)
        if len(rows) * len(cols) > MOST_WINDOWS:
            raise InputError(f"windows = {len(rows) * len(cols)}: must be at most {MOST_WINDOWS}; take a larger stride")
        row, col = (places.ravel() for places in np.meshgrid(rows, cols, indexing="ij"))
        found.append(np.stack([np.full(len(row), index), row, col], axis=1))
        across = [(len(starts) - 1) * min(step, grid.cells) + grid.cells for starts in (rows, cols)]
        covered.append(np.prod(across) / np.prod(np.array(nodes) - 1))
    return np.concatenate(found), float(np.mean(covered))


def height_offsets(rasters: list[Raster], surveys: list[Survey]) -> list[float]:
    """Returns the height offset of each raster in whole metres: the same for all unless they are FAR_APART."""
    if rasters[0].height_offset is not None:
        return [raster.height_offset or 0.0 for raster in rasters]
    medians = np.array([found.median for found in surveys])
    common = float(np.nanmedian(medians).round()) + 0.0
    if np.nanmax(np.abs(medians - common)) <= FAR_APART:
        return [common] * len(rasters)
    return [common if np.isnan(median) else float(median.round()) + 0.0 for median in medians]
