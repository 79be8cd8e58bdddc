"""Maps of whole sites: simulated tile by tile, and written for GIS and navigation (SPEC section 13)."""

from collections.abc import Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from travjax import progress
from travjax.config import one_line, require, require_installed, require_length, require_number, to_json
from travjax.evaluation import map_figures
from travjax.evaluation.tables import rows_table
from travjax.files import atomic_write, held, output_folder, resolved, save_text
from travjax.memory import require_memory
from travjax.rasters.grid_maps import write_grid_map
from travjax.rasters.raster import COARSEST
from travjax.rasters.recordings import require_recording
from travjax.simulation.contact import spacing_note
from travjax.simulation.robot import Robot
from travjax.simulation.setup import chosen_robot
from travjax.site import site_figures
from travjax.site.costs import KINDS, UNKNOWN_COST, band_names, kinds_of
from travjax.site.geotiff import Frame, rasterio, save_geotiff
from travjax.site.ground import Site, SiteGround, open_site
from travjax.site.kernel import SiteSetup, contact_of, tiles_of
from travjax.site.nav2 import over_headings, save_nav2
from travjax.site.primitives import straight_passes
from travjax.site.store import Store
from travjax.site.tiling import executor, parts_of

UNKNOWN_EVENT = 255
"""Stands in blocking.tif for places without a known heading."""


@dataclass(frozen=True, eq=False)
class SiteMap:
    """What a map says of the places of a site; rows run north, columns east.

    bands:    by the names of costs.band_names, [rows, cols] float32 each: counts of headings, costs 0 to 100, margins
              as shares of their limits, and the number of the blocking event, 0 for none; NaN where unknown
    costs:    [headings, rows, cols] 0 to 100, 255 where unknown
    heights:  [rows, cols] float64 metres, of the ground at the places, NaN unknown
    headings: radians, anticlockwise from +y; x, y: metres, of the columns and rows; crs: None for none
    """

    bands: Mapping[str, Float[np.ndarray, "rows cols"]]
    costs: UInt8[np.ndarray, "h rows cols"]
    heights: Float[np.ndarray, "rows cols"]
    headings: Float[np.ndarray, " h"]
    x: Float[np.ndarray, " cols"]
    y: Float[np.ndarray, " rows"]
    crs: str | None

    def shares(self) -> dict[str, float]:
        """Returns the shares of places that are passable in every known direction, in some, in none, and unknown."""
        return _shares(self.bands["passable_headings"], self.bands["known_headings"])

    def to_xarray(self):
        """Returns an xarray.Dataset with the bands, `cost` and `elevation`.

        Raises InputError that says how to install xarray where it is missing.
        """
        require_installed("xarray", "xarray", "xarray")
        import xarray

        values: dict[str, tuple] = {name: (("y", "x"), band) for name, band in self.bands.items()}
        values |= {"cost": (("heading", "y", "x"), self.costs), "elevation": (("y", "x"), self.heights)}
        coordinates = {"x": self.x, "y": self.y, "heading": np.degrees(self.headings)}
        return xarray.Dataset(values, coordinates, {"crs": self.crs or ""})


def setup_of(
    robot: Robot | str | None,
    headings: int = 16,
    stride: float | None = None,
    spacing: float = 0.0625,
    contact: str | None = None,
) -> SiteSetup:
    """Returns the setup of a map: a straight pass in each heading.

    stride:  metres between places; 0.25 m unless given, or as many nodes as make that up
    contact: "tyre" unless given here or by the robot
    Raises InputError that names argument, value and what is allowed.
    """
    require_number("spacing", spacing, 0, 1000, "metres, above 0 and at most 1000")
    chosen, places = chosen_robot(robot), SiteSetup.usual_stride(spacing) if stride is None else stride
    require_length("stride", places, 0.001, 1000)
    return SiteSetup(chosen, straight_passes(headings, places), spacing, places, contact=contact_of(chosen, contact))


def map_site(
    site: str | Path | Site | Float[np.ndarray, "rows cols"],
    robot: Robot | str | None = None,
    *,
    headings: int = 16,
    stride: float | None = None,
    spacing: float | None = None,
    contact: str | None = None,
) -> SiteMap:
    """Maps where a robot can drive on a whole site, and in which direction.

    site:     an elevation map that `load_dem` reads, a `SiteGround`, or heights [rows, cols] in metres, row 0 south
    robot:    a Robot, or the name or file of one; the Seekur Jr unless given
    headings: number of headings, evenly around the circle; stride: metres between places (0.25); spacing: metres
              between nodes (0.0625)
    contact:  contact model, "tyre" or "nearest"; that of the robot's file unless given, or else "tyre"
    Source: SPEC section 13. Raises InputError as `SiteGround.open` and `simulate_site` do.
    """
    ground = open_site(site, spacing)
    setup = setup_of(robot, headings, stride, ground.spacing, contact)
    names, lattice = band_names(setup.robot), setup.lattice(ground.shape)
    bands = np.full((len(names), *lattice), np.nan, np.float32)
    costs = np.full((headings, *lattice), UNKNOWN_COST, np.uint8)
    heights = np.full(lattice, np.nan)
    with executor() as pool:
        for _, part in parts_of(ground, setup, pool):
            place = ..., *part.tile.within(lattice)
            bands[place], costs[place] = part.bands, part.costs
            heights[place] = part.heights.astype(float) + ground.height_offset
    x, y = (start + setup.stride * np.arange(count) for start, count in zip(ground.origin, lattice[::-1], strict=True))
    angles = 2 * np.pi * np.arange(headings) / headings
    return SiteMap(dict(zip(names, bands, strict=True)), costs, heights, angles, x, y, ground.crs)


def save_map(
    site: SiteGround,
    setup: SiteSetup,
    out: str | Path,
    grid_map: Path | None = None,
    scheduler: str | None = None,
) -> Path:
    """Maps a site and writes GeoTIFFs, the maps for Nav2, figures and shares; returns the folder.

    Memory does not grow with the site; a run that was stopped goes on with the tiles that are missing.
    grid_map:  file of ROS 2, .mcap or .db3, that gets the bands and the elevation as layers of a GridMap
    scheduler: of a Dask cluster that simulates the tiles, as of tiling.executor
    Raises InputError when rasterio is missing, or rosbags for a GridMap, or when something cannot be read or written.
    """
    rasterio()
    if grid_map is not None:
        require_recording("--grid-map", grid_map)
    rasters = [Path(out) / name for name in ("map.tif", "headings.tif", "blocking.tif")]
    require_not_written(site, [*rasters, *([grid_map] if grid_map else [])])
    with executor(scheduler) as pool, held(folder := output_folder(out)):
        store = _simulated(site, setup, folder, pool)
        written = _written(store, site, setup, folder)
        if grid_map is not None:
            written.append(_save_grid_map(grid_map, store, site, setup))
        store.remove()
    progress.wrote(*written)
    return folder


def require_not_written(site: SiteGround, files: Iterable[Path]) -> None:
    """Raises InputError where one of the files to be written is the site's own."""
    for file in files:
        other = resolved(file) != resolved(Path(site.path))
        require(other, "--out", str(file.parent), f"a folder other than that of the site, {site.path}")


def _simulated(site: SiteGround, setup: SiteSetup, folder: Path, pool: tuple[Executor, int]) -> Store:
    lattice, names = setup.lattice(site.shape), band_names(setup.robot)
    tiles = tiles_of(lattice, setup)
    settings = {
        "site": site.sha256,
        "reading": site.reading,
        "setup": to_json(setup),
        "tiles": [len(tiles), tiles[0].edge],
        "travjax": version("travjax"),
    }
    store = Store.open(folder, settings, len(names), len(setup.primitives), lattice, len(tiles))
    with progress.bar("mapping", len(tiles), "tile", initial=int(store.done.sum())) as bar:
        for number, part in parts_of(site, setup, pool, set(np.flatnonzero(store.done).tolist())):
            store.add(number, part)
            bar.update()
    return store


def _written(store: Store, site: SiteGround, setup: SiteSetup, folder: Path) -> list[Path]:
    frame, names = Frame(site.origin, setup.stride, site.crs), band_names(setup.robot)
    degrees = [np.degrees(primitive.heading) for primitive in setup.primitives]
    events = ", ".join(f"{code} {name}" for code, name in enumerate(("none", *setup.robot.event_names)))
    tags = {
        "robot": setup.robot.name,
        "contact": setup.contact,
        "site": one_line(Path(site.path).name),
        "travjax": version("travjax"),
        "spacing": setup.spacing,
        "site_sha256": site.sha256,
        "blocking_event": events,
    }
    bands = dict(zip(names, store.bands, strict=True))
    shares = _shares(bands["passable_headings"], bands["known_headings"])
    table = rows_table([{"passable in": name, "share of places": f"{share:.1%}"} for name, share in shares.items()])
    count = f"{len(degrees)} headings" if len(degrees) > 1 else "1 heading"
    heading = f"{setup.robot.name}, {setup.contact}, {count}, places {setup.stride:g} m apart"
    progress.say(f"{heading}\n{table}\n")
    what = heading, Path(site.path).name
    layers = [f"heading {angle:g} deg" for angle in degrees]
    passable = site_figures.passable_figure(store.heights, bands, store.costs, frame, what)
    blocking = site_figures.blocking_figure(store.heights, bands, frame, setup.robot.event_names, what)
    return [
        save_geotiff(folder / "map.tif", store.bands, names, frame, float("nan"), tags),
        save_geotiff(folder / "headings.tif", store.costs, layers, frame, UNKNOWN_COST, tags),
        _save_blocking(folder / "blocking.tif", bands["blocking_event"], setup.robot, frame, tags),
        *save_nav2(folder / "nav2", over_headings(store.costs), frame),
        map_figures.save(passable, folder / "map.png"),
        map_figures.save(blocking, folder / "why.png"),
        save_text(folder / "shares.txt", f"{heading}\n{table}\n"),
    ]


def _save_blocking(path: Path, blocking: np.ndarray, robot: Robot, frame: Frame, tags: Mapping[str, Any]) -> Path:
    """Writes the numbers of blocking events [rows, cols] as bytes with the colours of why.png and their names."""
    codes = np.full((1, *blocking.shape), UNKNOWN_EVENT, np.uint8)
    np.copyto(codes[0], blocking, where=~np.isnan(blocking), casting="unsafe")
    colours = dict(zip(("none", *robot.event_names), site_figures.EVENT_COLOURS, strict=False))
    return save_geotiff(path, codes, ("blocking_event",), frame, UNKNOWN_EVENT, tags, colours)


def _save_grid_map(path: Path, store: Store, site: SiteGround, setup: SiteSetup) -> Path:
    require_memory(4 * store.bands.nbytes, f"{path}: {store.bands.nbytes} bytes of layers", "; leave --grid-map out")
    layers = dict(zip(band_names(setup.robot), store.bands[:, ::-1], strict=True))
    layers["elevation"] = store.heights[::-1] + np.float32(site.height_offset)
    with atomic_write(path) as temporary:
        write_grid_map(temporary, layers, setup.stride, site.origin, site.frame or "map")
    return path


def _shares(passable: np.ndarray, known: np.ndarray) -> dict[str, float]:
    counts = np.zeros(len(KINDS))
    for top in range(0, len(known), 512):
        kinds = kinds_of(passable[top : top + 512], known[top : top + 512])
        counts += np.bincount(kinds.ravel(), minlength=len(KINDS))
    return dict(zip(KINDS, (counts / known.size).tolist(), strict=True))


def say_notes(site: SiteGround, setup: SiteSetup) -> None:
    """Prints how a site was read, and what its cells or the spacing of nodes mean for the events."""
    for line in (*site.notes, coarse_note(site, setup.robot) or spacing_note(setup.contact, setup.spacing)):
        if line:
            progress.say(f"{site.path}: {line}")


def coarse_note(site: SiteGround, robot: Robot) -> str | None:
    """Returns a line about what the events mean on a site whose cells are coarse; None where they are not."""
    if site.cell_size <= COARSEST:
        return None
    return (
        f"cells of {site.cell_size:g} m: tilt is that of ground averaged over {site.cell_size:g} m (wheelbase "
        f"{robot.wheelbase:g} m); steps and obstacles narrower than two cells are not seen"
    )
