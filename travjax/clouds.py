"""Point clouds as rasters: text of x, y, z, PLY, LAS and LAZ (SPEC section 11).

x is east, y is north, z is up, whatever the order of the points. Points that stand on a lattice (a raster that was
written as points) are that raster. Others are averaged in square cells around multiples of the cell size, which keeps
detail that is finer than a cell from showing as steps; a cell without points is unknown.
"""

import re
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from travjax.config import InputError
from travjax.grid import Grid
from travjax.raster import (
    COARSEST,
    Raster,
    agreed_cell_size,
    require_heights,
    require_size,
)

TEXT = (".xyz", ".txt", ".csv", ".pts")
SUFFIXES = (*TEXT, ".ply", ".las", ".laz")

NAMES = {
    "x": ("x", "east", "easting"),
    "y": ("y", "north", "northing"),
    "z": ("z", "elevation", "height", "altitude"),
    "degrees": ("lat", "latitude", "lon", "long", "longitude"),
}
"""What the header of a text may call its columns."""

NOISE = (7, 18)
"""Classes of LAS points that are no ground: low and high noise."""

TRIANGLES = {"face": {"vertex_indices": 3, "vertex_index": 3}}
"""Lists of a PLY file that are passed over at once if they are as long as that."""

POINTS_A_CELL = 2
"""On average; at this density an eighth of the cells has none, and those are small holes."""

LARGEST = 2**28
"""Cells: a square kilometre at 0.0625 m, 2 GiB."""

CHUNK = 2_000_000
"""Points of a LAS file in memory with all that they hold."""


class Points(NamedTuple):
    """x, y and z [n], as the file stores them, and the coordinate system of rasterio, or None."""

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    crs: Any = None


def read_cloud(path: Path, form: str, options, grid: Grid) -> Raster:
    """The points of a file as a raster; cell_size, scale (height_scale) and nodata as `load_dem` takes them.

    Points whose z is NaN or nodata are left out. Raises InputError when the file cannot be read or is cut short, its
    coordinates are not finite, in degrees or feet, or in too large steps, and when the points are too few, or too far
    apart for a raster.
    """
    cell_size, scale, nodata = options.cell_size, options.height_scale, options.nodata
    read = {"text": _read_text, "ply": _read_ply, "las": _read_las}[form]
    x, y, z, crs = read(path)
    _require_fine_steps(x, y)
    z = z.astype(np.float64)
    known = ~np.isnan(z)
    if nodata is not None:
        known &= ~np.isclose(z, nodata, rtol=1e-6, atol=1e-6)
    x, y, z = x[known].astype(np.float64), y[known].astype(np.float64), z[known] * (scale or 1.0)
    require_heights(z)
    _require_metres(x, y, grid)
    raster = _lattice(x, y, z)
    if raster is None:
        raster = _averaged(x, y, z, cell_size or _cell_size(x, y, grid.spacing))
    else:
        agreed_cell_size(raster.cell_size, cell_size)
    fewest = int(grid.size / max(raster.cell_size, COARSEST)) ** 2
    if len(z) < fewest:
        raise InputError(f"points = {len(z)}: must be at least {fewest}, as many as a window has cells")
    return Raster(raster.heights, raster.cell_size, raster.origin, None)


def _require_fine_steps(x: np.ndarray, y: np.ndarray) -> None:
    """Refuses coordinates too large for the float32 that they are stored as."""
    for name, values in (("x", x), ("y", y)):
        if values.dtype == np.float32:
            largest = np.nanmax(np.abs(values), initial=0)
            if np.isfinite(largest) and np.spacing(largest) > 0.01:
                raise InputError(
                    f"{name} = {largest:g}: is stored in steps of {np.spacing(largest):g} m (float32): must be double, "
                    "or relative to a place nearby"
                )


def _require_metres(x: np.ndarray, y: np.ndarray, grid: Grid) -> None:
    """Refuses coordinates that are not finite or look like degrees, and sites smaller than a window."""
    for name, values in (("x", x), ("y", y)):
        near = np.abs(values) < 1e9
        if not near.all():
            raise InputError(f"{name} = {values[~near][0]:g}: must be finite, below 1e9 m")
    east, north = np.ptp(x), np.ptp(y)
    if max(east, north) < grid.size / 10 and np.abs(x).max() <= 180 and np.abs(y).max() <= 90:
        raise InputError(
            f"x, y = {x[0]:.6g}, {y[0]:.6g} within {east:.3g} x {north:.3g}: look like degrees; must be metres "
            "(reproject to a UTM zone, say)"
        )
    require_size(east, north, grid)


def _lattice(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Raster | None:
    """The raster that the points are, if most of them have a neighbour one step east and none has a double."""
    axes = [_regular(values) for values in (x, y)]
    (west, across, cols), (south, along, rows) = axes
    if not cols * rows or cols * rows > LARGEST or abs(across - along) > 1e-3 * across:
        return None
    place = np.rint((y - south) / along).astype(np.int64) * cols + np.rint((x - west) / across).astype(np.int64)
    taken = np.zeros((rows, cols), bool)
    taken.ravel()[place] = True
    neighbours = np.count_nonzero(taken[:, 1:] & taken[:, :-1])
    if np.count_nonzero(taken) < len(z) or neighbours < len(z) / 2:
        return None
    heights = np.full((rows, cols), np.nan)
    heights.ravel()[place] = z
    return Raster(heights, float(across), (float(west), float(south)))


def _regular(values: np.ndarray) -> tuple[float, float, int]:
    """(least, step, number of levels) of values on a regular scale but for rounding; 0 levels of others.

    Of the steps that the rounding leaves room for, the one with the fewest digits.
    """
    levels = np.unique(values)
    gaps = np.diff(levels)
    wide = gaps[gaps > 1e-4]  # metres; what is nearer is the same level with another rounding
    if not wide.size:
        return levels[0], 0.0, 0
    number = np.concatenate([[0], np.cumsum(np.round(gaps / wide.min()))])
    step = (levels[-1] - levels[0]) / number[-1]
    away = np.abs(levels - levels[0] - step * number).max()
    doubt = 2 * away / number[-1] + 1e-12
    step = next(shorter for digits in range(16) if abs((shorter := round(float(step), digits)) - step) <= doubt)
    return levels[0], step, int(number[-1]) + 1 if away < 0.1 * step else 0


def _cell_size(x: np.ndarray, y: np.ndarray, finest: float) -> float:
    """Metres, whole millimetres above `finest`: cells that hold POINTS_A_CELL at the site's usual density.

    That is the median of blocks that would hold 16 points each if these were spread evenly. A twentieth of the points
    on each side does not count, so that a few astray have no say.
    """
    ends = [np.quantile(values, (0.05, 0.95)) for values in (x, y)]
    area = np.prod([high - low for low, high in ends])
    if not area:
        return finest
    inner = np.all([(low <= values) & (values <= high) for values, (low, high) in zip((x, y), ends, strict=True)], 0)
    edge = 4 * np.sqrt(area / np.count_nonzero(inner))
    (col, _), (row, _) = (_cells(values[inner], edge) for values in (x, y))
    held = np.bincount(row * (col.max() + 1) + col)
    cell = edge * np.sqrt(POINTS_A_CELL / np.median(held[held > 0]))
    return max(finest, float(np.ceil(1000 * cell) / 1000))


def _cells(values: np.ndarray, edge: float) -> tuple[np.ndarray, int]:
    """(number of the cell that each value lies in [n], number of the first): cells around the multiples of the edge."""
    number = np.floor(values / edge + 0.5).astype(np.int64)
    first = int(number.min())
    return number - first, first


def _averaged(x: np.ndarray, y: np.ndarray, z: np.ndarray, cell_size: float) -> Raster:
    """The mean height of the points in each cell, NaN where there are none."""
    east, north = np.ptp(x), np.ptp(y)
    if (east / cell_size + 2) * (north / cell_size + 2) > LARGEST:
        raise InputError(
            f"size = {east:g} x {north:g} m: must be at most {LARGEST} cells of {cell_size:g} m; is a point astray?"
        )
    (col, first_col), (row, first_row) = (_cells(values, cell_size) for values in (x, y))
    rows, cols = int(row.max()) + 1, int(col.max()) + 1
    place = row * cols + col
    count = np.bincount(place, minlength=rows * cols)
    heights = np.bincount(place, weights=z, minlength=rows * cols)
    heights = np.divide(heights, count, out=np.full(rows * cols, np.nan), where=count > 0)
    origin = (first_col * cell_size, first_row * cell_size)
    return Raster(heights.reshape(rows, cols), float(cell_size), origin)


def _installed(module: str, package: str = "") -> ModuleType:
    try:
        return import_module(module)
    except ImportError:
        raise InputError(f"reading it needs {module}: pip install {package or module}") from None


# ---- Text


def _read_text(path: Path) -> Points:
    """Columns split by semicolons, commas or blanks; before them a header, the number of points, # and // lines."""
    try:
        skipped, stated, header, first = _beginning(path)
        separator = _separator(first)
        columns = _columns(header) if header else [0, 1, 2]
        table = np.loadtxt(path, delimiter=separator, skiprows=skipped, usecols=columns, ndmin=2, encoding="utf-8-sig")
    except InputError:
        raise
    except UnicodeDecodeError:
        raise InputError(f"cannot be read as {path.suffix}: it is no text") from None
    except ValueError as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"cannot be read as a table of x, y, z: {reason} (rows count from 0)") from None
    if stated is not None and len(table) != stated:
        raise InputError(f"points = {len(table)}: must be {stated}, as its first line says; it is cut short")
    return Points(*table.T)


def _beginning(path: Path) -> tuple[int, int | None, str, str]:
    """(lines before the first of numbers, number of points that a line states or None, header or "", that line)."""
    stated, header = None, ""
    with path.open(encoding="utf-8-sig") as file:
        for number, line in enumerate(file):
            text = line.strip()
            fields = _fields(text.lstrip("#/"))
            if text.startswith(("#", "//")):
                header = text.lstrip("#/ ") if _is_header(fields) else header
            elif len(fields) == 1 and fields[0].isdigit():
                stated = int(fields[0])
            elif sum(map(_is_number, fields)) >= 3:
                return number, stated, header, text
            elif text:
                header = text
    raise InputError(f"cannot be read as {path.suffix}: no line of it holds three numbers")


def _separator(line: str) -> str | None:
    return next((mark for mark in (";", ",") if mark in line), None)


def _fields(line: str) -> list[str]:
    """The columns of a line, without the unit that a name may carry, quotes and case."""
    fields = line.strip().split(_separator(line))
    return [re.sub(r"[\[(].*", "", field).strip(" \"'").lower() for field in fields] or [""]


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _is_header(fields: list[str]) -> bool:
    """Whether these are the names of at least x, y and z."""
    return all(any(field in NAMES[axis] for field in fields) for axis in "xyz")


def _columns(header: str) -> list[int]:
    """Where x, y and z stand."""
    fields = _fields(header)
    degrees = [field for field in fields if field in NAMES["degrees"]]
    if degrees:
        raise InputError(f"column {degrees[0]!r}: is in degrees; reproject it to metres (a UTM zone, say) first")
    if not _is_header(fields):
        raise InputError(
            f"header = {header[:60]!r}: must name x, y, z (or easting, northing, elevation), or be left out"
        )
    return [next(i for i, field in enumerate(fields) if field in NAMES[axis]) for axis in "xyz"]


# ---- PLY and LAS


def _read_ply(path: Path) -> Points:
    """The vertices; faces are passed over."""
    plyfile = _installed("plyfile")
    try:
        try:
            data = plyfile.PlyData.read(path, known_list_len=TRIANGLES)
        except plyfile.PlyElementParseError:
            data = plyfile.PlyData.read(path)  # lists of other lengths: slower
    except (plyfile.PlyParseError, ValueError, EOFError) as error:
        raise InputError(f"cannot be read as .ply: {str(error).splitlines()[0]}") from None
    if "vertex" not in data:
        raise InputError(f"no element `vertex`; it holds: {', '.join(element.name for element in data) or 'nothing'}")
    vertices = data["vertex"].data
    names = [name for name in vertices.dtype.names or () if vertices.dtype[name].kind in "iuf"]
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"vertex: must have numbers x, y, z; it has: {', '.join(names) or 'none'}")
    return Points(*(np.asarray(vertices[axis]) for axis in "xyz"))


def _read_las(path: Path) -> Points:
    """All points but noise and those withheld, a chunk at a time."""
    laspy = _installed("laspy", "'laspy[lazrs]'")
    if path.suffix.lower() == ".laz":
        _installed("lazrs")
    try:
        with laspy.open(path) as file:
            crs, stated, read, parts = _las_crs(file.header), file.header.point_count, 0, [np.zeros((3, 0))]
            for points in file.chunk_iterator(CHUNK):
                read += len(points)
                kept = ~np.isin(np.asarray(points.classification), NOISE) & (np.asarray(points.withheld) == 0)
                parts.append(np.stack([np.asarray(points[axis])[kept] for axis in "xyz"]))
    except InputError:
        raise
    except laspy.LaspyException as error:
        raise InputError(f"cannot be read as {path.suffix}: {str(error).splitlines()[0]}") from None
    except (ValueError, RuntimeError):  # of lazrs, or of a last record in part
        raise InputError(f"cannot be read as {path.suffix}: it is cut short or damaged") from None
    if read != stated:
        raise InputError(f"points = {read}: must be {stated}, as its header says; it is cut short")
    x, y, z = np.concatenate(parts, axis=1)
    return Points(x, y, z, crs)


def _las_crs(header: Any) -> Any:
    """The coordinate system of the header: its WKT, else the EPSG code and the units of its GeoTIFF keys, or None."""
    records = [*header.vlrs, *(header.evlrs or ())]
    described = [record.string for record in records if type(record).__name__ == "WktCoordinateSystemVlr"]
    described = [wkt for wkt in described if wkt.strip()]
    directories = [record.geo_keys for record in records if type(record).__name__ == "GeoKeyDirectoryVlr"]
    keys = {key.id: key.value_offset for keys in directories for key in keys}
    if not described and not keys:
        return None
    rasterio = _installed("rasterio")
    code = keys.get(3072, 0) if keys.get(1024) != 2 else keys.get(2048, 0)
    try:
        if described:
            return rasterio.crs.CRS.from_wkt(described[0])
        if 1024 <= code < 32767:
            return rasterio.crs.CRS.from_epsg(code)
    except rasterio.errors.CRSError as error:
        raise InputError(f"crs: cannot be understood: {str(error).splitlines()[0]}") from None
    if keys.get(1024) == 2:
        raise InputError("crs: is in degrees; reproject it to metres (a UTM zone, say) first")
    if keys.get(3076, 9001) != 9001:
        raise InputError(f"crs: is in units of EPSG:{keys[3076]}, no metres; reproject it to metres first")
    return None
