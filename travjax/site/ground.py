"""The ground of a whole site at the spacing of nodes, read part by part (SPEC section 11)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from travjax.config import InputError, require, to_json
from travjax.data.dem import height_offsets, naming_file, read_rasters
from travjax.files import sha256, user_path
from travjax.rasters.raster import Raster, Survey, require_fine, require_known, survey
from travjax.rasters.reading_options import DemOptions
from travjax.rasters.surface import Surface
from travjax.simulation.grid import Grid
from travjax.simulation.heights import as_site


class Ground(Protocol):
    """Heights of a site, of which parts are read as they are asked for."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of nodes."""

    def part(self, rows: slice, cols: slice) -> Float[np.ndarray, "r c"]:
        """Returns the heights of some rows and columns, float32 metres; NaN where unknown, and off the site."""


@dataclass(frozen=True, eq=False)
class ArrayGround:
    """A site in memory: heights [rows, cols], float32 metres above `height_offset`, NaN where unknown.

    spacing, origin, crs, frame: as of SiteGround
    """

    heights: Float[np.ndarray, "rows cols"]
    height_offset: float = 0.0
    spacing: float = 0.0625
    origin: tuple[float, float] = (0.0, 0.0)
    crs: str | None = None
    frame: str | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of nodes."""
        rows, cols = self.heights.shape
        return rows, cols

    def part(self, rows: slice, cols: slice) -> Float[np.ndarray, "r c"]:
        """Returns some rows and columns; NaN off the site."""
        cut = np.full((rows.stop - rows.start, cols.stop - cols.start), np.nan, np.float32)
        wanted, there = (rows, cols), []
        for part, edge in zip(wanted, self.shape, strict=True):
            there.append(slice(max(part.start, 0), max(min(part.stop, edge), 0)))
        inside = [slice(a.start - b.start, a.stop - b.start) for a, b in zip(there, wanted, strict=True)]
        cut[tuple(inside)] = self.heights[tuple(there)]
        return cut


@dataclass(frozen=True, eq=False)
class SiteGround:
    """An elevation map of a site in a file.

    spacing:       metres between nodes; origin: x, y of the south-west node
    crs:           coordinate system as the file names it, or None
    cell_size:     metres between values in the file
    height_offset: metres, subtracted from the file's heights
    path, sha256:  the file and its checksum; reading: the options it was read with, and what was found, for JSON
    frame:         of a recording of ROS, else None
    notes:         lines about how it was read
    """

    spacing: float
    origin: tuple[float, float]
    crs: str | None
    cell_size: float
    height_offset: float
    path: str
    sha256: str
    reading: Mapping[str, Any]
    frame: str | None
    notes: tuple[str, ...]
    _surface: Surface = field(repr=False)

    @staticmethod
    def open(
        path: str | Path,
        spacing: float | None = None,
        *,
        reading: DemOptions = DemOptions(),
        fill_holes: bool = True,
        allow_coarse: bool = False,
    ) -> "SiteGround":
        """Opens the elevation map of a site, whatever `load_dem` reads, as one raster.

        spacing: metres between nodes; 0.0625 unless given, or the file's cells where these are coarse and allowed
        reading, fill_holes, allow_coarse: as the options of `load_dem`
        Raises InputError as `load_dem` does, and when the file holds several maps.
        """
        path = user_path(path)
        nodes = 0.0625 if spacing is None else spacing
        with naming_file(path):
            rasters = read_rasters(path, reading, Grid(2 * nodes, nodes))
            require(len(rasters) == 1, "maps", len(rasters), "one for a site")
            raster = rasters[0]
            if spacing is None and allow_coarse:
                nodes = max(nodes, raster.cell_size)
            surface, offset, found = _surface_of(raster, nodes, fill_holes, allow_coarse)
            checksum = sha256(path)
        return SiteGround(
            spacing=float(nodes),
            origin=(float(raster.origin[0]), float(raster.origin[1])),
            crs=raster.crs,
            cell_size=float(raster.cell_size),
            height_offset=float(offset),
            path=str(path),
            sha256=checksum,
            reading=to_json(reading) | {"fill_holes": fill_holes, "found": [repr(one) for one in vars(found).values()]},
            frame=raster.frame,
            notes=raster.notes,
            _surface=surface,
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of nodes."""
        return self._surface.shape

    def part(self, rows: slice, cols: slice) -> Float[np.ndarray, "r c"]:
        """Returns some rows and columns; NaN off the site. Raises InputError when the file cannot be read."""
        with naming_file(Path(self.path)):
            return self._surface.nodes(rows, cols)


def ground_of(raster: Raster, spacing: float = 0.0625) -> ArrayGround:
    """Returns the ground of a raster in memory, as `SiteGround.open` does that of a file.

    spacing: metres between nodes
    Raises InputError as that does.
    """
    surface, offset, _ = _surface_of(raster, spacing, fill_holes=True, allow_coarse=False)
    rows, cols = surface.shape
    heights = surface.nodes(slice(0, rows), slice(0, cols))
    return ArrayGround(heights, offset, spacing, raster.origin, raster.crs, raster.frame)


def _surface_of(raster: Raster, spacing: float, fill_holes: bool, allow_coarse: bool) -> tuple[Surface, float, Survey]:
    """Returns the nodes of a raster, the metres that they count from, and what the raster holds."""
    require_fine(raster.cell_size, allow_coarse)
    if min(raster.heights.shape) < 2:
        raise InputError(f"shape = {raster.heights.shape}: must be at least 2 x 2 values")
    found = survey(raster.heights)
    require_known(found.known)
    offset = height_offsets([raster], [found])[0]
    above = 0.0 if raster.height_offset is not None else offset
    return Surface(raster, spacing, above, fill_holes and raster.height_offset is None), offset, found


Site = ArrayGround | SiteGround
"""The ground of a site with what is known of it."""


def open_site(site: str | Path | Site | Float[np.ndarray, "rows cols"], spacing: float | None = None) -> Site:
    """Returns the ground of a site: of a file as `SiteGround.open` does, or of heights [rows, cols] in metres.

    spacing: metres between nodes; 0.0625 unless given
    """
    if isinstance(site, str | Path):
        return SiteGround.open(site, spacing)
    if isinstance(site, ArrayGround | SiteGround):
        return site
    return ArrayGround(*as_site(site), 0.0625 if spacing is None else spacing)
