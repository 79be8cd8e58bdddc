"""Rasters of heights: what holds for every format, small holes filled, other spacings (SPEC section 11).

Row 0 is the southernmost, column 0 the westernmost: north is +row, east is +col, whichever way a file is stored.
"""

import re
from dataclasses import dataclass, replace

import numpy as np

from travjax.config import InputError, require, require_number
from travjax.grid import HIGHEST, MARKERS, Grid

FILL_DISTANCE = 0.125
"""Metres: a hole is filled when each of its nodes is this near to known ground."""

COARSEST = 0.125
"""Metres: cells larger than this do not show a step or a rock."""

LOWEST = -12_000.0
"""Metres: what is deeper is no height; HIGHEST is in grid.py."""


@dataclass(frozen=True)
class Raster:
    """Heights of one file in this package's convention.

    heights:   [rows, cols] float64 metres, NaN unknown
    cell_size: metres between neighbouring values
    origin:    x, y of heights[0, 0], the south-west value
    crs:       coordinate system as the file names it, or None
    """

    heights: np.ndarray
    cell_size: float
    origin: tuple[float, float] = (0.0, 0.0)
    crs: str | None = None


def require_heights(known: np.ndarray) -> None:
    """Raises InputError unless there are heights, [n] without NaN, and all of them can be the ground's."""
    if not known.size:
        raise InputError("heights: all unknown (NaN or nodata): must hold some known ground")
    for bad in (known.min(), known.max()):
        hint = "if it marks unknown ground, say so (--nodata=VALUE)"
        if not LOWEST <= bad <= HIGHEST:
            raise InputError(f"heights = {bad:g}: must lie between {LOWEST:g} and {HIGHEST:g} m; {hint}")
        if round(float(bad), 6) in MARKERS:
            raise InputError(f"heights = {bad:g}: is a usual mark of unknown ground, not declared as such; {hint}")


def require_size(east: float, north: float, grid: Grid) -> None:
    """Raises InputError when a site of these metres, node to node, holds no window."""
    if min(north, east) < grid.size - 1e-6:
        raise InputError(
            f"size = {east:g} x {north:g} m: must be at least {grid.size:g} x {grid.size:g} m, node to node"
        )


def agreed_cell_size(of_file: float, given: float | None) -> float:
    """The file's cell size; raises InputError for a bad one, or when the one given contradicts it."""
    require_number("cell_size", of_file, 0, 1000, "metres, above 0 and at most 1000")
    if given is not None:
        require(abs(given - of_file) < 1e-4 * of_file, "cell_size", given, f"left out: the file says {of_file:g}")
    return of_file


def crs_name(crs) -> str | None:
    """A coordinate system of rasterio by its code, else as WKT; of one joined with a height system its own part."""
    if crs is None:
        return None
    horizontal = re.search(r'AUTHORITY\["EPSG","(\d+)"\]\],VERT_CS\[', crs.to_wkt())
    return f"EPSG:{horizontal[1]}" if horizontal else crs.to_string()


def require_metric(crs, heights_scaled: bool) -> None:
    """Raises InputError for degrees and feet; no system, or a local one that names no unit, is taken as metres.

    heights_scaled: whether a height scale was given, so that the system's unit of height does not count
    """
    if crs is None:
        return
    name = str(crs_name(crs))
    name = name.partition("[")[2].partition(",")[0] or name
    if crs.is_geographic:
        raise InputError(f"crs = {name}: is in degrees; reproject it to metres (a UTM zone, say) first")
    unit, metres = crs.units_factor
    if unit.lower() != "unknown" and abs(metres - 1) > 1e-9:
        raise InputError(f"crs = {name}: is in units of {metres:g} m ({unit}); reproject it to metres first")
    vertical = re.search(r'VERT_CS\[.*UNIT\["([^"]*)",([0-9.eE+-]+)', crs.to_wkt())
    if vertical and abs(float(vertical[2]) - 1) > 1e-9 and not heights_scaled:
        raise InputError(
            f"crs = {name}: has heights in units of {float(vertical[2]):g} m ({vertical[1]}); "
            f"give that (--height-scale={vertical[2]})"
        )


def without_small_holes(raster: Raster) -> tuple[Raster, float]:
    """Interpolates holes whose every node lies within FILL_DISTANCE of known ground; also the share of nodes filled."""
    unknown = np.isnan(raster.heights)
    if not unknown.any():
        return raster, 0.0
    from scipy import ndimage  # takes 0.3 s to import

    far = ndimage.distance_transform_edt(unknown, sampling=raster.cell_size) > FILL_DISTANCE + 1e-9
    hole, holes = ndimage.label(unknown, np.ones((3, 3)))
    deep = np.zeros(holes + 1, bool)
    deep[hole[far]] = True
    small = unknown & ~deep[hole]
    if not small.any():
        return raster, 0.0
    return replace(raster, heights=_interpolated(raster.heights, small)), float(small.mean())


def _interpolated(heights: np.ndarray, holes: np.ndarray) -> np.ndarray:
    """Heights where each node of a hole is the mean of its four neighbours: a plane stays one, no new extremes arise.

    What lies outside the raster does not count. Nodes beside a hole are known or of the same hole.
    """
    from scipy.sparse import csc_matrix, diags
    from scipy.sparse.linalg import spsolve

    row, col = np.nonzero(holes)
    number = np.full(holes.shape, -1)
    number[holes] = np.arange(len(row))
    level = heights[~np.isnan(heights)].mean()
    neighbours, known = np.zeros(len(row)), np.zeros(len(row))
    links = []
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        r, c = row + down, col + right
        inside = (r >= 0) & (r < holes.shape[0]) & (c >= 0) & (c < holes.shape[1])
        beside = np.flatnonzero(inside)
        neighbours += inside
        other = number[r[beside], c[beside]]
        ground = other < 0
        known[beside[ground]] += heights[r[beside[ground]], c[beside[ground]]] - level
        links.append(np.stack([beside[~ground], other[~ground]]))
    here, there = np.concatenate(links, axis=1)
    coupling = csc_matrix((np.ones(len(here)), (here, there)), (len(row), len(row)))
    filled = heights.copy()
    filled[holes] = spsolve(diags(neighbours, format="csc") - coupling, known) + level
    return filled


def resample(raster: Raster, spacing: float) -> Raster:
    """Bilinear values at another spacing, from the same south-west node; smoothed first where the source is finer.

    A node is unknown where a value that it is made from is.
    """
    ratio = spacing / raster.cell_size
    if abs(ratio - 1) < 1e-6:
        return raster
    from scipy import ndimage  # takes 0.3 s to import

    unknown = np.isnan(raster.heights)
    level = np.nanmedian(raster.heights)
    heights, share = np.where(unknown, 0.0, raster.heights - level), (~unknown).astype(float)
    if ratio > 1:
        sigma = (ratio - 1) / 2
        heights, share = (ndimage.gaussian_filter(field, sigma, mode="nearest") for field in (heights, share))
        heights = np.divide(heights, share, out=heights, where=share > 0)
    rows, cols = (np.arange(int((edge - 1) / ratio + 1e-6) + 1) * ratio for edge in raster.heights.shape)
    at = np.meshgrid(rows, cols, indexing="ij")
    values = ndimage.map_coordinates(heights, at, order=1, mode="nearest")
    missing = ndimage.map_coordinates(unknown.astype(float), at, order=1, mode="nearest") > 1e-6
    return replace(raster, heights=np.where(missing, np.nan, values + level), cell_size=spacing)
