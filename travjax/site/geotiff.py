"""Arrays of a site as cloud-optimised GeoTIFF, with a description of each band (SPEC section 13)."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from travjax.config import InputError, require_installed
from travjax.files import atomic_write, save_text

STRIP = 512
"""Rows that are written at once."""


@dataclass(frozen=True)
class Frame:
    """Where the cells of a north-up raster lie: x, y of the middle of the south-west cell, metres; its size; and the
    coordinate system, None for none.
    """

    origin: tuple[float, float]
    cell_size: float
    crs: str | None

    def corner(self, rows: int) -> tuple[float, float]:
        """Returns x, y of the outer corner of the north-west cell of so many rows."""
        half = self.cell_size / 2
        return self.origin[0] - half, self.origin[1] + (rows - 1) * self.cell_size + half


def rasterio() -> ModuleType:
    """Returns the module rasterio; raises InputError that says how to install it where it is missing."""
    require_installed("rasterio", "rasterio", "geo")
    import rasterio
    import rasterio.shutil

    return rasterio


def save_geotiff(
    path: Path,
    bands: np.ndarray,
    names: Sequence[str],
    frame: Frame,
    nodata: float,
    tags: Mapping[str, Any] | None = None,
    colours: Mapping[str, str] | None = None,
) -> Path:
    """Writes bands [b, rows, cols], row 0 in the north, whole or not at all.

    names:   descriptions of the bands; tags: what else to say in the file
    colours: "#rrggbb" of the values 0, 1, 2 ... of a single band of bytes, by what these stand for; their names go to a
             file beside it, NAME.tif.aux.xml, where GDAL looks for them
    Raises InputError when it cannot be written.
    """
    engine = rasterio()
    rows, cols = bands.shape[1:]
    x, y = frame.corner(rows)
    profile = {
        "driver": "GTiff",
        "count": len(bands),
        "height": rows,
        "width": cols,
        "dtype": bands.dtype.name,
        "nodata": nodata,
        "transform": engine.Affine(frame.cell_size, 0, x, 0, -frame.cell_size, y),
        "tiled": True,
        "bigtiff": "if_safer",
        "interleave": "band",
    }
    predictor = "FLOATING_POINT" if bands.dtype.kind == "f" else "STANDARD"
    with _input_error(path), atomic_write(path) as temporary, engine.Env(GDAL_PAM_ENABLED=False):
        plain = temporary.with_name("plain.tif")
        with engine.open(plain, "w", crs=frame.crs, **profile) as file:
            if colours:
                file.write_colormap(1, {code: tuple(bytes.fromhex(c[1:])) for code, c in enumerate(colours.values())})
            for top in range(0, rows, STRIP):
                strip = np.ascontiguousarray(bands[:, top : top + STRIP])
                file.write(strip, window=engine.windows.Window(0, top, cols, strip.shape[1]))
            file.descriptions = tuple(names)
            file.update_tags(**(tags or {}))
        engine.shutil.copy(
            plain,
            temporary,
            driver="COG",
            compress="DEFLATE",
            level=1,
            predictor=predictor,
            num_threads="ALL_CPUS",
            overview_resampling="nearest",
            bigtiff="if_safer",
        )
    if colours:
        categories = "".join(f"<Category>{escape(name)}</Category>" for name in colours)
        band = f'<PAMRasterBand band="1"><CategoryNames>{categories}</CategoryNames></PAMRasterBand>'
        save_text(path.with_name(f"{path.name}.aux.xml"), f"<PAMDataset>{band}</PAMDataset>\n")
    return path


@contextmanager
def _input_error(path: Path) -> Iterator[None]:
    from rasterio.errors import CRSError, RasterioError

    try:
        yield
    except CRSError as error:
        raise InputError(f"{path}: crs: {error}") from None
    except UnicodeEncodeError:
        raise InputError(f"{path}: name: must be UTF-8, which GDAL wants; choose another") from None
    except RasterioError as error:
        raise InputError(f"{path}: cannot be written: {error}") from None
