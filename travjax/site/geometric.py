"""The geometric cost map of UNSTR-NAV, as a baseline: slope, roughness and obstacle of a disc, without headings.

At each place a plane is fitted to the nodes within half the robot's diagonal. Roughness is the Euclidean norm of their
distances from it, over 5 and the ride height; slope its angle over 36 degrees; obstacle the largest distance above it,
over the ride height. Each counts from 0 to 255, rounded down, and the cost is their mean, or 255 where one exceeds 245.
Source: github.com/picchius94/unstruct_navigation, class Traversability_Map.
"""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from travjax import progress
from travjax.evaluation.tables import rows_table
from travjax.files import held, output_folder, save_text
from travjax.jax_flags import usual_flags
from travjax.simulation.robot import Robot
from travjax.site.costs import KINDS, UNKNOWN_COST, band_names, kinds_of
from travjax.site.geotiff import Frame, rasterio, save_geotiff
from travjax.site.ground import Ground, SiteGround
from travjax.site.kernel import SiteSetup, by_place, lanes_of, tiles_of
from travjax.site.mapping import require_not_written
from travjax.site.nav2 import save_nav2
from travjax.traversal.arcs import read

RESIDUAL_RATIO, STEEPEST, LARGEST, FORBIDDEN = 5.0, 36.0, 245, 255
"""What roughness is divided by, degrees that count as slope 1, the largest test that is allowed, and the cost above."""

BANDS = ("roughness", "slope", "obstacle", "cost")
"""Names of the values of a place, 0 to 255 each."""


def disc(robot: Robot, spacing: float) -> np.ndarray:
    """Returns the nodes around a place that the tests see: [n, 2] rows and columns."""
    radius = math.hypot(robot.overall_length, robot.overall_width) / 2
    reach = math.floor(radius / spacing + 1e-9)
    row, col = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    inside = np.hypot(row, col) * spacing <= radius + 1e-9
    return np.stack([row[inside], col[inside]], axis=-1)


@usual_flags()
def geometric_tile(ground: Float[np.ndarray, "n n"], setup: SiteSetup) -> Float[Array, "4 places places"]:
    """Computes the tests and the cost of the places of a tile, of its ground in metres, NaN where unknown.

    Returns BANDS, float32; NaN where a node of the disc is unknown.
    """
    offsets, grid = disc(setup.robot, setup.spacing), setup.grid
    nodes = (offsets + grid.cells // 2) @ (grid.nodes, 1)
    return _costs(jnp.asarray(ground), jnp.asarray(nodes), jnp.asarray(offsets * setup.spacing, jnp.float32), setup)


@partial(jax.jit, static_argnames="setup")
def _costs(ground: jax.Array, nodes: jax.Array, offsets: jax.Array, setup: SiteSetup) -> jax.Array:
    lanes, around = lanes_of(ground, setup), len(ground) // setup.step
    middle = read(lanes, nodes[len(nodes) // 2])
    zero, squares = jnp.zeros_like(middle), (offsets**2).sum(axis=0)

    def sums(total, node):
        at, (north, east) = node
        height = read(lanes, at) - middle
        return (total[0] + height, total[1] + north * height, total[2] + east * height), None

    level, north, east = jax.lax.scan(sums, (zero, zero, zero), (nodes, offsets))[0]
    level, north, east = level / len(nodes), north / squares[0], east / squares[1]

    def errors(largest, node):
        at, (y, x) = node
        error = read(lanes, at) - middle - (level + north * y + east * x)
        return (largest[0] + error * error, jnp.maximum(largest[1], error)), None

    residual, highest = jax.lax.scan(errors, (zero, zero - jnp.inf), (nodes, offsets))[0]
    slope = jnp.degrees(jnp.arctan(jnp.hypot(north, east))) / STEEPEST
    clearance = setup.robot.ride_height
    shares = jnp.stack([jnp.sqrt(residual) / RESIDUAL_RATIO / clearance, slope, highest / clearance])
    tests = jnp.floor(255 * jnp.minimum(shares, 1))
    cost = jnp.where((tests > LARGEST).any(axis=0), FORBIDDEN, jnp.floor(tests.mean(axis=0)))
    cost = jnp.where(jnp.isnan(residual), jnp.nan, cost)
    return by_place(jnp.concatenate([tests, cost[None]]), around, around - 2 * setup.halo)


def geometric_bands(
    ground: Ground, setup: SiteSetup, on_progress: Callable[[], object] = lambda: None
) -> Float[np.ndarray, "4 rows cols"]:
    """Computes BANDS of all places of a site, NaN where unknown; on_progress: is called after each tile."""
    lattice = setup.lattice(ground.shape)
    bands = np.full((len(BANDS), *lattice), np.nan, np.float32)
    for tile in tiles_of(lattice, setup):
        found = geometric_tile(ground.part(*tile.ground(setup)), setup)
        bands[(..., *tile.within(lattice))] = tile.cropped(found, lattice)
        on_progress()
    return bands


def save_geometric(site: SiteGround, setup: SiteSetup, out: str | Path) -> Path:
    """Writes the geometric cost map of a site, geometric.tif and one for Nav2; returns the folder.

    Beside a map of passes of the same site, robot and places in the folder, it prints and writes how far they agree.
    Raises InputError when rasterio is missing, or when something cannot be read or written.
    """
    rasterio()
    require_not_written(site, [Path(out) / "geometric.tif"])
    lattice = setup.lattice(site.shape)
    with held(folder := output_folder(out)):
        with progress.bar("mapping", len(tiles_of(lattice, setup)), "tile") as bar:
            bands = geometric_bands(site, setup, bar.update)
        bands, frame = bands[:, ::-1], Frame(site.origin, setup.stride, site.crs)
        cost = bands[-1]
        percent = np.where(np.isnan(cost), UNKNOWN_COST, np.floor(np.nan_to_num(cost) * (100 / FORBIDDEN)))
        table = _comparison(folder / "map.tif", cost, setup, site)
        written = [
            save_geotiff(folder / "geometric.tif", bands, BANDS, frame, float("nan"), {"robot": setup.robot.name}),
            *save_nav2(folder / "nav2", {"geometric": percent.astype(np.uint8)}, frame),
        ]
        if table:
            progress.say(f"The geometric map beside that of passes:\n{table}\n")
            written.append(save_text(folder / "geometric.txt", table + "\n"))
    progress.wrote(*written)
    return folder


def _comparison(path: Path, cost: np.ndarray, setup: SiteSetup, site: SiteGround) -> str:
    """Returns a table of what the geometric map says of places that are passable in every direction, some and none.

    It is empty unless a map of passes of the same site, robot and places lies in the folder.
    """
    if not path.is_file():
        return ""
    with rasterio().open(path) as file:
        same = file.shape == cost.shape and file.descriptions[:2] == band_names(setup.robot)[:2]
        if not same or (file.tags().get("robot"), file.tags().get("site_sha256")) != (setup.robot.name, site.sha256):
            return ""
        passable, known = file.read([1, 2])
    kinds, rows = kinds_of(passable, known), []
    for kind, name in enumerate(KINDS[:3]):
        here = (kinds == kind) & ~np.isnan(cost)
        forbidden = f"{np.mean(cost[here] == FORBIDDEN):.1%}" if here.any() else "-"
        rows.append({"passable in": name, "places": int(here.sum()), "forbidden by the geometric map": forbidden})
    return rows_table(rows)
