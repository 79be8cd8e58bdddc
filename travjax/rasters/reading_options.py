"""How a file of heights is to be read, beyond what it says itself."""

import math
from dataclasses import dataclass

from travjax.config import require, require_number

AXES_UP = ("y", "z")


@dataclass(frozen=True)
class DemOptions:
    """What `load_dem` is told about a file.

    cell_size:    metres, for files that do not say; of a point cloud the cells in which points are averaged
    height_scale: metres per unit of the file's values, if the file does not say
    nodata:       a value that marks unknown ground, if the file does not declare it; NaN always does
    band:         number from 1, or description, of a band of a raster; name of a variable of a netCDF file
    classes:      of LAS points that are ground; ground alone where the file has it beside others, unless given
    up:           axis of a point cloud or mesh that points up, "z" unless given
    gdal_drivers: drivers of GDAL that may read the file beside those of local pixels
    topic, layer: of a recording of ROS, the GridMap to read; the only ones unless given
    time:         seconds from the start of a recording, until which the latest map is read; its end unless given

    Raises InputError that names field, value and what is allowed.
    """

    cell_size: float | None = None
    height_scale: float | None = None
    nodata: float | None = None
    band: int | str | None = None
    classes: tuple[int, ...] | None = None
    up: str | None = None
    gdal_drivers: tuple[str, ...] = ()
    topic: str | None = None
    layer: str | None = None
    time: float | None = None

    def __post_init__(self):
        for name in ("cell_size", "height_scale"):
            if getattr(self, name) is not None:
                require_number(name, getattr(self, name), 0, 1000, "metres, above 0 and at most 1000")
        if self.nodata is not None and self.nodata != self.nodata:  # NaN is unknown ground in any case
            object.__setattr__(self, "nodata", None)
        if self.nodata is not None:
            require_number("nodata", self.nodata, -math.inf, math.inf, "a number: finite, or nan")
        numbered = isinstance(self.band, int) and not isinstance(self.band, bool) and 1 <= self.band < 2**16
        named = isinstance(self.band, str) and bool(self.band)
        require(self.band is None or numbered or named, "band", self.band, "a number from 1 to 65535, or a name")
        if self.classes is not None:
            codes = isinstance(self.classes, tuple) and all(
                type(code) is int and 0 <= code < 256 for code in self.classes
            )
            require(codes and bool(self.classes), "classes", self.classes, "codes from 0 to 255, as in (2, 9)")
        names = isinstance(self.gdal_drivers, tuple) and all(isinstance(name, str) for name in self.gdal_drivers)
        require(names, "gdal_drivers", self.gdal_drivers, 'names of drivers, as in ("BAG",)')
        for name in ("topic", "layer"):
            value = getattr(self, name)
            require(value is None or isinstance(value, str) and bool(value), name, value, "a name")
        if self.time is not None:
            require_number("time", self.time, -1e-9, 1e9, "seconds from 0")
        require(self.up is None or self.up in AXES_UP, "up", self.up, f"one of {', '.join(AXES_UP)}")
