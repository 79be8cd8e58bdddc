"""The site kernel: margins of motion primitives from every place of a site, without cutting windows.

Places are every k-th node of a raster in both directions, so the poses of a primitive lie the same way between nodes
everywhere, and one table serves all places. A tile of places is simulated at once: its places are the lanes of the
traverse kernels, and a node, counted from each place, is one stretch of memory once the heights are sorted by row and
column modulo k (`sorted_by_phase`).
"""

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from travjax.config import require, require_number
from travjax.jax_flags import usual_flags
from travjax.simulation.contact import Contact
from travjax.simulation.events import Margins
from travjax.simulation.footprint import Layout, View, pose_table
from travjax.simulation.grid import Grid
from travjax.simulation.heights import as_site
from travjax.simulation.robot import Robot
from travjax.simulation.setup import chosen_robot
from travjax.simulation.tyre_tables import tyre_table
from travjax.site import ground as grounds
from travjax.site.ground import ArrayGround
from travjax.site.primitives import PointTurn, Primitive, all_poses, straight_passes
from travjax.traversal.arcs import UNKNOWN_HEIGHT, Shifted, arc_maxima, margins_from
from travjax.traversal.nearest import NearestChunks, nearest_chunks, poses_on_nodes
from travjax.traversal.steps import reach_of_steps
from travjax.traversal.tyre import Ground, TyreChunks, fields, settle, tyre_chunks

TILE = 128
"""Places along an edge of a tile, at most."""

TILE_NODES = 4096
"""Nodes along an edge of a tile with what is around it, about, at most."""

WIDEST = 512
"""Nodes that the robot with its poses may span: tables grow with the square."""


@dataclass(frozen=True)
class SiteSetup:
    """Everything that the margins of a site depend on, apart from the heights.

    spacing: metres between nodes; stride: metres between places, a whole number of nodes
    interval: metres between simulated poses; contact: the contact model

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    robot: Robot
    primitives: tuple[Primitive | PointTurn, ...]
    spacing: float = 0.0625
    stride: float = 0.25
    interval: float = 0.06
    contact: str = "tyre"

    def __post_init__(self):
        Contact.from_model(self.contact)
        require(len(self.primitives) > 0, "primitives", self.primitives, "at least one")
        require_number("spacing", self.spacing, 0, 1000, "metres, above 0 and at most 1000")
        require_number("interval", self.interval, 0.001, 1000, "metres from 0.001 to 1000")
        ratio = self.stride / self.spacing
        whole = self.stride > 0 and round(ratio) >= 1 and abs(ratio - round(ratio)) < 1e-6
        require(whole, "stride", self.stride, f"a whole number of nodes, {self.spacing:g} m each")
        self._require_span()

    def _require_span(self) -> None:
        """Raises InputError where the robot at its poses spans more than WIDEST nodes, and names what makes it so."""
        most = WIDEST // 2 - 2
        room = most * self.spacing - self._outline
        if self._farthest <= room:
            return
        spans = f"at which {self.robot.name} with its passes spans {WIDEST} nodes"
        passes = self._farthest <= self.stride / 2 + 1e-9
        if room < self.spacing / 2 or passes and math.isclose(self.stride, self.usual_stride(self.spacing)):
            finest = (self._farthest + self._outline) / most
            require(False, "spacing", self.spacing, f"at least {finest:.2g} m, {spans}")
        spans = f"{spans} of {self.spacing:g} m"
        if passes:
            longest = math.floor(2 * room / self.spacing) * self.spacing
            require(False, "stride", self.stride, f"at most {longest:g} m, {spans}")
        require(False, "primitives, reach", round(self._farthest, 3), f"at most {room:.3g} m from a place, {spans}")

    @staticmethod
    def usual_stride(spacing: float) -> float:
        """Returns the metres between places unless something else is wanted: 0.25, or as many nodes as make that up."""
        return math.ceil(0.25 / spacing - 1e-6) * spacing

    @property
    def step(self) -> int:
        """Nodes between neighbouring places."""
        return round(self.stride / self.spacing)

    @cached_property
    def grid(self) -> Grid:
        """A grid around a place that holds all poses."""
        half = math.ceil((self._farthest + self._outline) / self.spacing) + 2
        return Grid(2 * half * self.spacing, self.spacing)

    @cached_property
    def _farthest(self) -> float:
        """Metres from a place to the farthest pose."""
        poses = all_poses(self.primitives, self.interval)
        return float(np.hypot(poses[..., 0], poses[..., 1]).max())

    @property
    def _outline(self) -> float:
        """Metres from the robot's centre to its farthest point."""
        robot = self.robot
        width = max(robot.overall_width, robot.track + robot.wheel_width, robot.chassis_width)
        length = max(robot.overall_length, robot.wheelbase + robot.wheel_diameter, robot.chassis_length)
        return math.hypot(width, length) / 2

    @cached_property
    def halo(self) -> int:
        """Places around a tile whose ground its margins depend on."""
        steps = reach_of_steps(self.robot.wheel_diameter / 2, self.spacing) if self.contact == "tyre" else 0
        return math.ceil((self.grid.cells // 2 + steps) / self.step)

    def lattice(self, nodes: tuple[int, int]) -> tuple[int, int]:
        """Returns the number of rows and columns of places on a raster of so many rows and columns of nodes."""
        rows, cols = ((count - 1) // self.step + 1 for count in nodes)
        return rows, cols


@dataclass(frozen=True)
class Tile:
    """A square of places: the row and column of its south-west one, and the places along its edge."""

    row: int
    col: int
    edge: int

    def within(self, lattice: tuple[int, int]) -> tuple[slice, slice]:
        """Returns its rows and columns on a lattice of so many rows and columns."""
        return (
            slice(self.row, min(self.row + self.edge, lattice[0])),
            slice(self.col, min(self.col + self.edge, lattice[1])),
        )

    def cropped(self, values, lattice: tuple[int, int]):
        """Returns those of its values [..., edge, edge] whose places are on a lattice of so many rows and columns."""
        rows, cols = self.within(lattice)
        return values[..., : rows.stop - rows.start, : cols.stop - cols.start]

    def ground(self, setup: SiteSetup) -> tuple[slice, slice]:
        """Returns the rows and columns of nodes that its margins depend on, which may lie beyond the raster."""
        starts = [(place - setup.halo) * setup.step for place in (self.row, self.col)]
        count = (self.edge + 2 * setup.halo) * setup.step
        return slice(starts[0], starts[0] + count), slice(starts[1], starts[1] + count)


def tiles_of(lattice: tuple[int, int], setup: SiteSetup) -> list[Tile]:
    """Covers a lattice of (rows, columns) with tiles of one size, row by row from the south-west."""
    fitting = max(TILE_NODES // setup.step - 2 * setup.halo, 1)
    edge = min(TILE, max(8, 1 << (max(lattice) - 1).bit_length()), 1 << (fitting.bit_length() - 1))
    return [Tile(row, col, edge) for row in range(0, lattice[0], edge) for col in range(0, lattice[1], edge)]


@usual_flags()
def simulate_site(
    heights: Float[np.ndarray, "rows cols"],
    robot: Robot | str | None = None,
    primitives: Sequence[Primitive] | None = None,
    *,
    spacing: float = 0.0625,
    stride: float = 0.25,
    interval: float = 0.06,
    contact: str | None = None,
) -> Margins:
    """Simulates motion primitives from every place of a site.

    heights:    [rows, cols] metres, NaN or masked where unknown, row 0 in the south; any size
    robot:      a Robot, or the name or file of one; the Seekur Jr unless given
    primitives: a straight pass in each of 16 headings unless given
    spacing:    metres between nodes; stride: metres between places, which are every so many nodes from the south-west
    interval:   metres between simulated poses
    contact:    "nearest" (SPEC section 5) or "tyre" (15); that of the robot's file unless given, or else "tyre"
    Returns NumPy arrays [primitives, rows, cols] of places, unknown where a primitive touches unknown ground or leaves
    the raster. Source: SPEC section 13.
    Raises InputError when heights are not a raster of possible heights, and for bad arguments.
    """
    chosen = chosen_robot(robot)
    passes = straight_passes(stride=stride) if primitives is None else tuple(primitives)
    setup = SiteSetup(chosen, passes, spacing, stride, interval, contact_of(chosen, contact))
    return site_margins(ArrayGround(*as_site(heights)), setup)


@usual_flags()
def site_margins(ground: grounds.Ground, setup: SiteSetup) -> Margins:
    """Simulates all primitives from every place of a site; returns NumPy arrays [primitives, rows, cols] of places."""
    lattice, events = setup.lattice(ground.shape), setup.robot.events
    found = [np.full((len(setup.primitives), *lattice), np.nan, np.float32) for _ in events]
    known = np.zeros((len(setup.primitives), *lattice), bool)
    tiles = tiles_of(lattice, setup)
    with ThreadPoolExecutor(workers()) as pool:
        simulated = pool.map(lambda tile: tile_margins(ground.part(*tile.ground(setup)), setup), tiles)
        for tile, margins in zip(tiles, simulated, strict=True):
            place = ..., *tile.within(lattice)
            for field, event in zip(found, events, strict=True):
                field[place] = tile.cropped(margins[event.name], lattice)
            known[place] = tile.cropped(margins.known, lattice)
    step, obstacle, tilt, *optional = found
    return Margins(step, obstacle, tilt, known, tuple(optional), setup.robot.event_names)  # type: ignore[arg-type]


def contact_of(robot: Robot, contact: str | None) -> str:
    """Returns the contact model of a site: the given one, else that of the robot's file, else `tyre`."""
    return contact or robot.contact or "tyre"


def workers() -> int:
    """Returns how many tiles are simulated side by side: one a core, since the kernel of a tile uses one."""
    return (os.cpu_count() or 1) if jax.default_backend() == "cpu" else 1


@usual_flags()
def tile_margins(ground: Float[np.ndarray, "n n"], setup: SiteSetup) -> Margins:
    """Simulates all primitives from the places of a tile on its ground, metres and NaN where unknown.

    Returns [primitives, places, places] arrays.
    """
    chunks, layout = _tables(setup)
    return _simulate(jnp.asarray(ground), chunks, setup, layout)


@lru_cache(maxsize=4)
def _tables(setup: SiteSetup) -> tuple[NearestChunks | TyreChunks, Layout]:
    """Puts the tables of all primitives on the device, a chunk for each."""
    poses, robot, grid = all_poses(setup.primitives, setup.interval), setup.robot, setup.grid
    with jax.ensure_compile_time_eval():
        if setup.contact == "tyre":
            layout = Layout(grid, (View(),), poses.shape[1], poses.shape[1], 0)
            return tyre_chunks(tyre_table(poses.reshape(-1, 3), robot, grid), len(poses)), layout
        table = pose_table(poses, robot, grid)
        return nearest_chunks(table, 1, single=True), table.layout


@partial(jax.jit, static_argnames=("setup", "layout"))
def _simulate(ground: jax.Array, chunks: NearestChunks | TyreChunks, setup: SiteSetup, layout: Layout) -> Margins:
    robot, around = setup.robot, len(ground) // setup.step
    places = around - 2 * setup.halo
    heights = jnp.where(jnp.isnan(ground), UNKNOWN_HEIGHT, ground)
    lanes = partial(lanes_of, setup=setup)
    if isinstance(chunks, TyreChunks):
        site = Ground(*(lanes(field[0]) for field in fields(heights[None], robot, setup.spacing)))
        settled = lambda chunk: settle(site, chunk, robot, layout)
    else:
        nodes = lanes(heights)
        settled = lambda chunk: poses_on_nodes(nodes, nodes, chunk, robot.wheelbase, robot.track, layout)
    maxima = jax.lax.map(lambda chunk: arc_maxima(settled(chunk), layout, robot.events)[0][:, 0, 0], chunks)
    return margins_from(by_place(maxima.transpose(1, 0, 2), around, places), robot.events)


def lanes_of(field: Float[jax.Array, "n n"], setup: SiteSetup) -> Shifted:
    """Returns the ground of a tile as lanes, its places, of nodes in the grid around each; see `by_place`."""
    around = len(field) // setup.step
    start = jnp.asarray(_starts(setup, setup.grid, around))
    heights = sorted_by_phase(field, setup.step, 2 * setup.halo)
    return Shifted(heights, start, (around - 2 * setup.halo) * around)


def by_place(lanes: jax.Array, around: int, places: int) -> jax.Array:
    """Puts values of lanes [..., lanes] in rows and columns of places; around: of those and what is around them."""
    return lanes.reshape(*lanes.shape[:-1], places, around)[..., :places]


def sorted_by_phase(field: Float[jax.Array, "n n"], step: int, spare: int) -> Float[jax.Array, " m"]:
    """Sorts nodes by their row and column modulo `step`, and puts `spare` numbers behind them.

    Rows of places follow each other with the places around the tile between them; lanes there are computed and dropped.
    """
    around = len(field) // step
    phases = field.reshape(around, step, around, step).transpose(1, 3, 0, 2)
    return jax.lax.optimization_barrier(jnp.pad(phases.ravel(), (0, spare)))


def _starts(setup: SiteSetup, grid: Grid, around: int) -> np.ndarray:
    """Returns where the stretch of each node of the grid around a place begins: [nodes] int32."""
    offset = np.arange(grid.nodes) - grid.cells // 2
    phase, place = offset % setup.step, offset // setup.step + setup.halo
    row = phase * setup.step * around**2 + place * around
    col = phase * around**2 + place
    return (row[:, None] + col).ravel().astype(np.int32)
