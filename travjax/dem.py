"""Real elevation maps: read a DEM, fill small holes, resample, cut into windows (SPEC section 11).

Files are brought to one convention: row 0 is the southernmost, column 0 the westernmost, a value stands at its pixel's
centre. GeoTIFF and whatever else rasterio reads run from north to south and are flipped; .npy and .npz are as grid.py;
of points, x is east and y is north.
"""

import warnings
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from travjax.clouds import SUFFIXES, read_cloud
from travjax.config import InputError, require, require_number
from travjax.dem_options import DemOptions
from travjax.files import sha256
from travjax.grid import Grid
from travjax.raster import (
    COARSEST,
    Raster,
    agreed_cell_size,
    crs_name,
    require_heights,
    require_metric,
    require_size,
    resample,
    without_small_holes,
)


@dataclass(frozen=True)
class Windows:
    """Square maps cut out of a DEM, and where each comes from.

    heights:       [n, rows, cols] float32 metres above `height_offset`, NaN unknown
    origins:       [n, 2] float64 x, y of each window's south-west node
    cell_size:     metres between values in the file; the windows are at the grid's spacing
    crs:           coordinate system as the file names it, or None
    height_offset: metres, subtracted from the file's heights in float64
    covered:       share of the file's area that lies in some window
    filled:        share of all nodes that was interpolated in small holes
    unknown:       share of all nodes that stays unknown
    path, sha256:  the file and its checksum
    """

    heights: np.ndarray
    origins: np.ndarray
    cell_size: float
    crs: str | None
    height_offset: float
    covered: float
    filled: float
    unknown: float
    path: str
    sha256: str


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
) -> Windows:
    """Cuts a DEM into windows of the grid's size, starting at its south-west corner; partial windows are dropped.

    path:         GeoTIFF or another raster that rasterio reads (an ASCII grid, a 16-bit PNG); .npy, or .npz with
                  `heights` ([rows, cols], or several maps [n, rows, cols] that are cut one by one) and `cell_size`; a
                  point cloud as clouds.py reads it: text (.xyz, .txt, .csv, .pts), .ply, .las, .laz
    stride:       metres between the origins of neighbouring windows, rounded to whole cells
    cell_size:    metres, for files that do not say; of a point cloud the cells in which points are averaged, unless
                  they stand on a lattice: the grid's spacing, or what holds two points on average if that is more
    height_scale: metres per unit of the file's values; 1, or what the file says, unless given; a PNG needs it
    nodata:       a value that marks unknown ground, if the file does not declare it
    fill_holes:   interpolate holes whose every node lies within 0.125 m of known ground
    allow_coarse: take cells larger than 0.125 m
    Raises InputError when the file is missing, is no elevation map, is in degrees or feet, has no, a non-square or too
    large a cell size or not the given one, infinite or absurd heights or none at all, or is smaller than one window.
    """
    path = Path(path)
    require_number("stride", stride, 0, 1e6, "a distance in metres, above 0")
    require(stride > grid.spacing - 1e-9, "stride", stride, f"at least the spacing of the nodes, {grid.spacing:g} m")
    for name, value in (("cell_size", cell_size), ("height_scale", height_scale)):
        if value is not None:
            require_number(name, value, 0, 1000, "metres, above 0 and at most 1000")
    try:
        read = _read(path, cell_size, height_scale, nodata, grid)
        rasters = [_checked(raster, grid, allow_coarse) for raster in read]
        offset = float(np.nanmedian([np.nanmedian(raster.heights) for raster in rasters]).round()) + 0.0
        parts = [_windows(raster, stride, grid, offset, fill_holes) for raster in rasters]
        checksum = sha256(path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    heights, origins, covered, filled, unknown = zip(*parts, strict=True)
    return Windows(
        heights=np.concatenate(heights),
        origins=np.concatenate(origins),
        cell_size=rasters[0].cell_size,
        crs=rasters[0].crs,
        height_offset=offset,
        covered=float(np.mean(covered)),
        filled=float(np.mean(filled)),
        unknown=float(np.mean(unknown)),
        path=str(path),
        sha256=checksum,
    )


def _windows(raster: Raster, stride: float, grid: Grid, offset: float, fill_holes: bool):
    """(heights, origins, share covered, share filled, share unknown) of one raster."""
    raster, filled = without_small_holes(raster) if fill_holes else (raster, 0.0)
    raster = resample(raster, grid.spacing)
    heights = (raster.heights - offset).astype(np.float32)
    step = round(stride / grid.spacing)
    rows, cols = (range(0, edge - grid.cells, step) for edge in heights.shape)
    corners = np.array([(row, col) for row in rows for col in cols])
    cut = np.stack([heights[row : row + grid.nodes, col : col + grid.nodes] for row, col in corners])
    across = [(len(starts) - 1) * min(step, grid.cells) + grid.cells for starts in (rows, cols)]
    covered = np.prod(across) / np.prod(np.array(heights.shape) - 1)
    origins = np.array(raster.origin) + grid.spacing * corners[:, ::-1]
    return cut, origins, covered, filled, np.isnan(heights).mean()


def _read(path: Path, cell_size: float | None, scale: float | None, nodata: float | None, grid: Grid) -> list[Raster]:
    if path.is_dir():
        raise InputError("is a folder; allowed: a file")
    if not path.is_file():
        raise InputError("no such file")
    if path.suffix.lower() in (".npy", ".npz"):
        return _read_numpy(path, cell_size, scale, nodata)
    if path.suffix.lower() in SUFFIXES:
        return [read_cloud(path, _form(path), DemOptions(cell_size, scale, nodata), grid)]
    return [_read_raster(path, cell_size, scale, nodata)]


def _form(path: Path) -> str:
    suffix = path.suffix.lower()
    forms = {".ply": "ply", ".las": "las", ".laz": "las", ".pcd": "pcd"}
    mesh = suffix in (".obj", ".stl", ".gltf", ".glb")
    return "mesh" if mesh else forms.get(suffix, "text")


def _read_numpy(path: Path, cell_size: float | None, scale: float | None, nodata: float | None) -> list[Raster]:
    try:
        with path.open("rb") as file:
            loaded = np.load(file, allow_pickle=False)
            wanted = ("heights", "cell_size", "origin", "crs", "height_offset")
            one = isinstance(loaded, np.ndarray)
            entries = {"heights": loaded} if one else {name: loaded[name] for name in wanted if name in loaded}
            names = [] if one else list(loaded)
    except (ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        reason = "it is no such file, or cut short" if "pickled" in str(error) else str(error) or "it is cut short"
        raise InputError(f"cannot be read as {path.suffix}: {reason.splitlines()[0]}") from None
    if "heights" not in entries:
        raise InputError(f"no array `heights`; it holds: {', '.join(names) or 'nothing'}")
    heights = entries["heights"]
    if heights.ndim not in (2, 3) or not heights.size or not _is_real(heights):
        raise InputError(
            f"heights: {heights.dtype} {list(heights.shape)}: must be numbers [rows, cols] or [n, rows, cols]"
        )
    maps = _in_metres(heights.reshape(-1, *heights.shape[-2:]), scale or 1.0, 0.0, nodata)
    each = len(maps)
    if "cell_size" in entries:
        stored = _numbers(entries["cell_size"], "cell_size", "one number of metres", (1,))[0]
        cell_size = agreed_cell_size(stored, cell_size)
    elif cell_size is None:
        raise InputError("cell_size is missing: give it (--cell-size METRES), or store `cell_size` in the .npz")
    origins = _numbers(
        entries.get("origin", np.zeros(2)), "origin", "x, y of the south-west value", (2,), (each, 2)
    ).reshape(-1, 2)
    offsets = _numbers(entries.get("height_offset", np.zeros(1)), "height_offset", "metres", (1,), (each,))
    crs = str(np.ravel(entries["crs"])[0]) or None if np.size(entries.get("crs", ())) else None
    described = zip(maps, np.broadcast_to(origins, (each, 2)), np.broadcast_to(offsets, each), strict=True)
    return [Raster(one + offset, cell_size, (float(x), float(y)), crs) for one, (x, y), offset in described]


def _is_real(array: np.ndarray) -> bool:
    return array.dtype.kind in "iuf"


def _numbers(value: np.ndarray, name: str, allowed: str, *shapes: tuple[int, ...]) -> np.ndarray:
    """Finite numbers of one of the shapes; a single one counts as [1]."""
    array = np.atleast_1d(value)
    fits = array.shape in shapes and _is_real(array) and bool(np.isfinite(array).all())
    require(fits, name, value.tolist(), allowed)
    return array.astype(float)


def _in_metres(values: np.ndarray, scale: float, offset: float, nodata: float | None) -> np.ndarray:
    """float64 heights; `nodata` is compared as the file's number type holds it."""
    heights = values.astype(np.float64) * scale + offset
    if nodata is not None:
        heights[values == np.asarray(nodata).astype(values.dtype)] = np.nan
    return heights


def _read_raster(path: Path, cell_size: float | None, scale: float | None, nodata: float | None) -> Raster:
    try:
        import rasterio
    except ImportError:
        raise InputError("reading it needs rasterio: pip install rasterio; .npy and .npz need nothing") from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(path) as file:
                require(file.count == 1, "bands", file.count, "1: an elevation map, not a picture")
                values, transform, crs = file.read(1, masked=True), file.transform, file.crs
                scales, offsets, driver = file.scales, file.offsets, file.driver
    except rasterio.errors.RasterioError as error:
        reason = str(error.__cause__ or error).splitlines()[0]
        unknown = f"; beside GDAL's formats: .npy, .npz, {', '.join(SUFFIXES)}" if "not recognized" in reason else ""
        raise InputError(f"not a raster that can be read: {reason}{unknown}") from None
    if not _is_real(values):
        raise InputError(f"heights: {values.dtype}: must be numbers")
    if driver in ("PNG", "JPEG", "GIF", "BMP", "WEBP") and scale is None:
        raise InputError(f"height_scale is missing: a {driver} holds no metres; give it (--height-scale METRES)")
    require_metric(crs, scale is not None)
    if transform.is_identity:
        if cell_size is None:
            raise InputError("cell_size is missing: the file is not georeferenced; give it (--cell-size METRES)")
        west, south = 0.0, 0.0
    elif transform.b or transform.d or transform.a <= 0 or transform.e >= 0:
        raise InputError(f"transform = {tuple(transform)[:6]}: must run east and south without rotation")
    elif abs(transform.a + transform.e) > 1e-4 * transform.a:
        raise InputError(f"cell_size = {transform.a:g} x {-transform.e:g}: must be square")
    else:
        cell_size = agreed_cell_size(transform.a, cell_size)
        west, south = rasterio.transform.xy(transform, len(values) - 1, 0)
    heights = _in_metres(values.data, scales[0] if scale is None else scale, offsets[0], nodata)
    heights[np.ma.getmaskarray(values)] = np.nan
    return Raster(heights[::-1], float(cell_size), (float(west), float(south)), crs_name(crs))


def _checked(raster: Raster, grid: Grid, allow_coarse: bool) -> Raster:
    require_heights(raster.heights[~np.isnan(raster.heights)])
    if raster.cell_size > COARSEST + 1e-9 and not allow_coarse:
        raise InputError(f"cell_size = {raster.cell_size:g}: must be at most {COARSEST:g} m (--allow-coarse takes it)")
    north, east = ((edge - 1) * raster.cell_size for edge in raster.heights.shape)
    require_size(east, north, grid)
    return raster
