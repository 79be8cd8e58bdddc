"""Rasters that GDAL reads, through rasterio, by drivers of local pixels only (SPEC section 11).

A file that is given as data must not act: drivers that fetch from the network or refer to other files are not asked,
and a file beside the raster that GDAL would open by itself is looked at first.
"""

import os
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from travjax.config import InputError, require
from travjax.memory import require_memory
from travjax.rasters.coordinates import name_of, parsed, require_height_unit_named, require_metric
from travjax.rasters.formats import OTHERS
from travjax.rasters.raster import HeightSource, InMetres, Raster, agreed_cell_size, is_real, marks_nothing
from travjax.rasters.reading_options import DemOptions

PICTURES = ("BMP", "GIF", "BIGGIF", "JP2OpenJPEG", "JPEG", "PNG", "PNM", "SGI", "WEBP")
"""Drivers of pictures, which hold no metres; most are read from the first row on, so they are read at once."""

DRIVERS = (
    *("GTiff", "AAIGrid", "GRASSASCIIGrid", "EHdr", "ENVI", "HFA", "netCDF", "USGSDEM", "DTED", "SRTMHGT", "BT"),
    *("GSAG", "GSBG", "GS7BG", "SAGA", "RST", "ZMap", "SIGDEM", "HF2", "PCRaster", "NWT_GRD", "ISG", "GXF"),
    *PICTURES,
)
"""Drivers of GDAL whose pixels lie in the file itself, or beside it under its own name."""

SIDECARS = (".msk", ".ovr")
"""What GDAL opens beside a raster by any driver, whatever the raster's own."""

TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

HDF5 = b"\x89HDF\r\n\x1a\n"

WHOLE = 2**24
"""Cells up to which a raster is held in memory; larger ones are read from the file as they are needed."""

CACHE_MIB = 256
"""Pixels that GDAL keeps, so that neighbouring parts of a large file are not read again."""


def read_raster(path: Path, options: DemOptions) -> Raster:
    """Reads one band of a raster as heights; options as `load_dem` takes them.

    Raises InputError when rasterio is not installed, for a driver that GDAL does not have, when the file cannot be read
    or refers to others, is a picture without its scales, is in degrees, feet or another system whose metre is none on
    the ground, or does not run east and, without rotation, north or south.
    """
    _require_closed(path)
    if not str(path).isprintable() and any("\ud800" <= letter <= "\udfff" for letter in str(path)):
        raise InputError("name: must be UTF-8, which GDAL wants; rename the file")
    with _gdal() as gdal:
        _require_known(options.gdal_drivers, gdal)
        file, placed = _opened(str(path.absolute()), (*DRIVERS, *options.gdal_drivers))
        if not file.count and file.subdatasets:
            file, placed = _variable(path, file, options.band)
        band = _band(file, options.band)
        dtype = np.dtype(file.dtypes[band - 1])
        if not is_real(dtype):
            raise InputError(f"heights: {dtype}: must be numbers")
        _require_whole(path, file)
        _require_metres(file, band, placed, options)
        _require_no_degrees(file)
        crs = parsed(file.crs.to_wkt()) if file.crs else None
        cell_size, origin, southern = _place(file, placed, options.cell_size)
        east, north = (origin[k] + cell_size * (edge - 1) / 2 for k, edge in enumerate(file.shape[::-1]))
        require_metric(crs, east, north, options.height_scale is not None)
        scale = file.scales[band - 1] if options.height_scale is None else options.height_scale
        in_metres = scale, file.offsets[band - 1]
        if np.prod(file.shape) <= WHOLE or file.driver in PICTURES:
            require_memory(3 * int(np.prod(file.shape)) * dtype.itemsize, f"{file.width} x {file.height} pixels")
            heights: HeightSource = _in_metres(_read(file, band), in_metres, options.nodata, southern)
        else:
            heights = _FromFile(file, band, in_metres, options.nodata, southern)
    return Raster(heights, cell_size, origin, name_of(crs), marks_nothing(options.nodata, dtype))


# ---- GDAL


@contextmanager
def _gdal() -> Iterator[Any]:
    """Configures GDAL, and turns whatever it cannot read into one line; yields rasterio's environment."""
    try:
        import rasterio
    except ImportError:
        raise InputError("reading it needs rasterio: pip install rasterio; .npy and .npz need nothing") from None
    try:
        with rasterio.Env(GDAL_CACHEMAX=CACHE_MIB, AAIGRID_DATATYPE="Float64") as gdal:
            _use_own_database()
            yield gdal
    except rasterio.errors.RasterioError as error:
        raise InputError(f"not a raster that can be read: {_first_line(error.__cause__ or error)}") from None


def _first_line(error: BaseException) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


def _use_own_database() -> None:
    """Takes the coordinate systems that rasterio brings, whatever PROJ_DATA says; feet become metres without them."""
    import rasterio
    from rasterio import _env

    own = Path(rasterio.__file__).with_name("proj_data")
    if (own / "proj.db").is_file():
        _env.set_proj_data_search_path(str(own))
    try:
        rasterio.crs.CRS.from_epsg(32632)
    except rasterio.errors.CRSError as error:
        data = {name: os.environ[name] for name in ("PROJ_DATA", "PROJ_LIB") if name in os.environ}
        raise InputError(f"PROJ, as rasterio uses it, finds no coordinate systems with {data}: {error}") from None


def _require_known(names: tuple[str, ...], gdal: Any) -> None:
    """Raises InputError for a name of no driver; GDAL would ignore it."""
    known = {driver.lower() for driver in gdal.drivers()} if names else set()
    for name in names:
        allowed = "a driver of GDAL by its short name, such as BAG, of those that rasterio was built with"
        require(name.lower() in known, "gdal_drivers", name, allowed)


def _opened(name: str, drivers: tuple[str, ...]) -> tuple[Any, bool]:
    """Opens the data set, and tells whether it is georeferenced: if not, GDAL's numbers for its place mean nothing."""
    import rasterio

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            file = rasterio.io.DatasetReader(name, driver=list(drivers))
        except rasterio.errors.RasterioIOError as error:
            reason = _first_line(error.__cause__ or error)
            if "not recognized" in reason:
                reason = f"{reason.rstrip('.')} (--gdal-driver NAME adds one); beside GDAL's formats: {OTHERS}"
            raise InputError(f"not a raster that can be read: {reason}") from None
    missing = any(issubclass(warning.category, rasterio.errors.NotGeoreferencedWarning) for warning in caught)
    return file, not (missing or file.transform.is_identity)


def _require_closed(path: Path) -> None:
    """Refuses a file whose pixels lie elsewhere, or beside which lies something that GDAL would open as well."""
    for name in {f"{path}{suffix}" for suffix in SIDECARS} | {str(path.with_suffix(suffix)) for suffix in SIDECARS}:
        if os.path.isfile(name) and name != str(path):
            with open(name, "rb") as file:
                if not file.read(4).startswith(TIFF):
                    raise InputError(f"{name} beside it: must be a TIFF, or not be there: GDAL would open it")
    with path.open("rb") as file:
        if file.read(len(HDF5)) == HDF5:
            _require_own_data(path)


def _require_own_data(path: Path) -> None:
    """Refuses an HDF5 file (netCDF 4) that links to other files or keeps its data in them."""
    try:
        import h5py
    except ImportError:
        raise InputError("reading netCDF 4 needs h5py, to look for links to other files: pip install h5py") from None

    def visit(name: str, group: Any) -> None:
        for key in group:
            link = group.get(key, getlink=True)
            if isinstance(link, h5py.ExternalLink):
                raise InputError(f"{name}{key}: is a link to another file, {link.filename!r}; allowed: data of its own")
            if isinstance(link, h5py.SoftLink):
                continue  # to what is visited at its own place
            item = group[key]
            if isinstance(item, h5py.Dataset) and (item.external or item.is_virtual):
                raise InputError(f"{name}{key}: keeps its data in another file; allowed: data of its own")
            if isinstance(item, h5py.Group) and item.id not in seen:
                seen.add(item.id)
                visit(f"{name}{key}/", item)

    seen: set[Any] = set()
    try:
        with h5py.File(path, "r") as file:
            visit("", file)
    except InputError:
        raise
    except Exception as error:  # h5py raises whatever its C library and its own lookups do on damaged files
        raise InputError(f"not a raster that can be read: {_first_line(error)}") from None


# ---- Bands


class _FromFile:
    """Heights of a band that are read from the file as they are asked for; see HeightSource."""

    def __init__(self, file: Any, band: int, in_metres: tuple[float, float], nodata: float | None, southern: bool):
        self._file, self._band, self._in_metres = file, band, in_metres
        self._nodata, self._southern = nodata, southern

    @property
    def shape(self) -> tuple[int, ...]:
        return self._file.shape

    def __getitem__(self, part: tuple[slice, slice]) -> np.ndarray:
        from rasterio.windows import Window

        rows, cols = part
        edge = self.shape[0]
        north = rows if self._southern else slice(edge - rows.stop, edge - rows.start)
        with _gdal():
            window = Window.from_slices((north.start, north.stop), (cols.start, cols.stop))
            read = _read(self._file, self._band, window)
        return _in_metres(read, self._in_metres, self._nodata, self._southern)[:, :]


def _read(file: Any, band: int, window: Any = None) -> np.ma.MaskedArray:
    """Reads the pixels of a band; those that are unknown or fully transparent are masked."""
    read = file.read(band, window=window, masked=True)
    for other in file.indexes:
        if other != band and _is_opacity(file, other):  # GDAL masks by it for whole numbers alone
            read = np.ma.masked_where(file.read(other, window=window) == 0, read)
    return read


def _in_metres(
    read: np.ma.MaskedArray, in_metres: tuple[float, float], nodata: float | None, southern: bool
) -> InMetres:
    """Pixels as heights; in_metres: scale and offset."""
    unknown = np.ma.getmaskarray(read)
    return InMetres(read.data, *in_metres, unknown if unknown.any() else None, nodata, southern)


def _variable(path: Path, file: Any, name: int | str | None) -> tuple[Any, bool]:
    """Finds the variable of that name in a netCDF file that has several."""
    found = {subdataset.rpartition(":")[2]: subdataset for subdataset in file.subdatasets}
    variable = str(name).partition(":")[0]
    require(variable in found, "--band", name, f"a variable of the file: {', '.join(found)}")
    require('"' not in str(path), "name", path.name, "without quotation marks, for a netCDF of several variables")
    return _opened(f'NETCDF:"{path.absolute()}":{variable}', ("netCDF",))


def _band(file: Any, wanted: int | str | None) -> int:
    """Returns the number, from 1, of the band that holds the heights."""
    if isinstance(wanted, str) and file.driver == "netCDF":
        wanted = int(wanted.partition(":")[2] or 0) if wanted.partition(":")[2].isdigit() else None
    names = [description or "" for description in file.descriptions]
    if isinstance(wanted, str) and wanted.isdigit():
        wanted = int(wanted)
    if isinstance(wanted, str):
        require(
            wanted in names, "--band", wanted, f"one of {', '.join(filter(None, names)) or 'numbers: none has a name'}"
        )
        return names.index(wanted) + 1
    if wanted is not None:
        require(wanted <= file.count, "--band", wanted, f"at most {file.count}, the number of bands")
        return wanted
    alone = [band for band in file.indexes if not _is_opacity(file, band)]
    if len(alone) == 1:
        return alone[0]
    if _is_grey(file):
        return 1
    named = f" ({', '.join(names)})" if any(names) else ""
    raise InputError(
        f"bands = {file.count}: must be 1, or one of them named{named}: give it (--band 1 to {file.count})"
    )


def _is_opacity(file: Any, band: int) -> bool:
    from rasterio.enums import ColorInterp

    return file.count > 1 and file.colorinterp[band - 1] == ColorInterp.alpha


def _is_grey(file: Any) -> bool:
    """Tells whether a picture with colours or an opacity holds a single grey channel that is not one flat colour."""
    if set(file.dtypes) - {"uint8", "uint16"} or file.count > 4:
        return False
    colours = [band for band in file.indexes if not _is_opacity(file, band)]
    lowest, highest = np.inf, -np.inf
    for _, window in file.block_windows(1):
        first, *others = file.read(colours, window=window)
        if not all(np.array_equal(first, other) for other in others):
            return False
        lowest, highest = min(lowest, first.min()), max(highest, first.max())
    return lowest < highest


def _require_metres(file: Any, band: int, placed: bool, options: DemOptions) -> None:
    """Refuses values that nothing says to be metres: pictures, and units of a band that are none or others."""
    scaled = options.height_scale is not None
    bare = not placed and not file.crs and file.driver == "GTiff"
    grey = file.count > 1 and options.band is None and set(file.dtypes) <= {"uint8", "uint16"}
    if not scaled and (file.driver in PICTURES or bare or grey):
        what = f"a {file.driver}" if not bare else "a TIFF without a place on the ground"
        raise InputError(f"height_scale is missing: {what} holds no metres; give it (--height-scale METRES)")
    tags = file.tags(band)
    if tags.get("positive") == "down" or "depth" in tags.get("standard_name", ""):
        raise InputError(f"band {band}: holds depths, which run down; turn them into heights first")
    require_height_unit_named(f"band {band}", file.units[band - 1], scaled)


def _require_whole(path: Path, file: Any) -> None:
    """Refuses a raw raster that is cut short: GDAL reads what is missing as 0."""
    if file.driver == "ENVI":
        size = file.height * file.width * sum(np.dtype(kind).itemsize for kind in file.dtypes)
        require(path.stat().st_size >= size, "bytes", path.stat().st_size, f"at least {size}, as its header says")


def _require_no_degrees(file: Any) -> None:
    """Refuses a netCDF whose axes are in degrees, of which GDAL makes no coordinate system."""
    for name, unit in file.tags().items():
        if name.endswith("#units") and re.fullmatch(r"degrees?_(north|east|N|E)", unit):
            raise InputError(
                f"{name.partition('#')[0]} = {unit}: is in degrees; reproject it to metres (a UTM zone, say)"
            )


def _place(file: Any, placed: bool, cell_size: float | None) -> tuple[float, tuple[float, float], bool]:
    """Returns (cell size, x and y of the south-west value, whether the first row is the southernmost)."""
    transform = file.transform
    if not placed:
        if cell_size is None:
            raise InputError("cell_size is missing: the file is not georeferenced; give it (--cell-size METRES)")
        return float(cell_size), (0.0, 0.0), False
    if not np.isfinite(tuple(transform)).all() or transform.b or transform.d or transform.a <= 0 or not transform.e:
        raise InputError(
            f"transform = {tuple(transform)[:6]}: may run east and north, else must run east and south without rotation"
        )
    southern = transform.e > 0
    if abs(transform.a - abs(transform.e)) > 1e-4 * transform.a:
        raise InputError(f"cell_size = {transform.a:g} x {abs(transform.e):g}: must be square")
    row = 0 if southern else file.shape[0] - 1
    west, south = transform.c + transform.a / 2, transform.f + transform.e * (row + 0.5)
    return agreed_cell_size(transform.a, cell_size), (float(west), float(south)), southern
