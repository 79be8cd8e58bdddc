"""The `nearest` contact model, the paper's: a wheel touches the node nearest to its centre (SPEC section 5).

heights -> the four wheel contacts and the pose plane at each pose -> largest step, obstacle and tilt of each arc ->
margins of all trajectories. A few first arcs are simulated at a time, so that their poses stay in the cache.
BUILD_NOTES.md has the measurements behind this layout; arcs.py explains lanes, footprint.py the letters in shapes.
"""

from dataclasses import dataclass
from functools import lru_cache, partial, reduce

import jax
import jax.numpy as jnp
import numpy as np

from travjax.batching import rounded
from travjax.simulation.events import PAPER, Event, Margins, Nodes, Where, larger
from travjax.simulation.footprint import RUN, Layout, NodeTable, chassis_places
from travjax.simulation.setup import Setup
from travjax.traversal.arcs import (
    UNKNOWN_HEIGHT,
    Lanes,
    Poses,
    Shifted,
    above_centre,
    arc_maxima,
    by_trajectory,
    margins_from,
    node_lanes,
    on_map,
    read,
    view_lanes,
    where_of,
)

FEW_MAPS = 2
"""For up to this many maps, RUN neighbouring nodes are read at once: the lanes alone do not fill a vector register."""

POSES_AT_ONCE = 200_000
"""Poses times lanes that a CPU simulates at once: a float32 array of them fits in the second-level cache of a core."""

NODES_AT_ONCE = 8
"""Chassis places read in one step of the scan: enough to save memory traffic, few enough to stay in registers."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["wheels", "centre", "offset", "axes", "runs", "singles"],
    meta_fields=[],
)
@dataclass(frozen=True)
class NearestChunks:
    """The pose arrays of a NodeTable cut into chunks, laid out in the order in which they are read.

    wheels: [C, 4, A P, V]; centre, offset, axes: [C, A P, ...]; runs, singles: [C, steps, A P, 2, places], where steps
    are those of the kernel's scan
    """

    wheels: jax.Array
    centre: jax.Array
    offset: jax.Array
    axes: jax.Array
    runs: jax.Array
    singles: jax.Array


def nearest_margins(maps: jax.Array, setup: Setup, where: bool) -> tuple[Margins, Where | None]:
    """Simulates every trajectory on a batch of maps [n, rows, cols]; `where` also finds where margins are reached."""
    chunks, source = _device_tables(setup, len(maps), where or len(maps) > FEW_MAPS)
    robot, layout = setup.robot, setup.node_table().layout
    return _simulate(maps, chunks, source, robot.wheelbase, robot.track, layout, robot.events, where)


@lru_cache(maxsize=8)
def _device_tables(setup: Setup, maps: int, single: bool) -> tuple[NearestChunks, jax.Array]:
    """Puts the chunks of a NodeTable for batches of `maps` maps, and its `source`, on the device.

    single: whether chassis nodes are read one by one, without runs
    """
    table = setup.node_table()
    arcs = len(table.centre)
    if jax.default_backend() == "cpu":
        arcs = min(arcs, max(1, round(POSES_AT_ONCE / (maps * len(table.layout.views) * table.layout.poses))))
    with jax.ensure_compile_time_eval():  # gives arrays, not tracers, even when the caller is being traced
        return nearest_chunks(table, arcs, single), jnp.asarray(table.source)


def nearest_chunks(table: NodeTable, arcs: int, single: bool) -> NearestChunks:
    """Cuts a table into chunks of so many arcs, and puts it on the device.

    single: whether chassis nodes are read one by one, without runs
    """
    runs, singles = chassis_places(table.chassis, 1 if single else RUN)
    padding = -len(table.centre) % arcs

    def cut(array):
        array = np.concatenate([array, array[:1].repeat(padding, axis=0)])
        return array.reshape(len(array) // arcs, arcs * array.shape[1], *array.shape[2:])

    return NearestChunks(
        wheels=jnp.asarray(cut(table.wheels).transpose(0, 2, 1, 3)),
        centre=jnp.asarray(cut(table.centre)),
        offset=jnp.asarray(cut(table.offset)),
        axes=jnp.asarray(cut(table.axes)),
        runs=jnp.asarray(_scan_order(cut(runs))),
        singles=jnp.asarray(_scan_order(cut(singles))),
    )


def _scan_order(places: np.ndarray) -> np.ndarray:
    """Reorders [C, A P, 2, K] to [C, steps, A P, 2, places], with about NODES_AT_ONCE places in a step."""
    chunks, poses, _, count = places.shape
    steps = -(-count // NODES_AT_ONCE)
    places = np.concatenate([places, places[..., :1].repeat(-count % max(steps, 1), axis=-1)], axis=-1)
    each = places.shape[-1] // max(steps, 1)
    return places.reshape(chunks, poses, 2, steps, each).transpose(0, 3, 1, 2, 4)


@partial(jax.jit, static_argnames=("layout", "events", "where"))
def _simulate(
    maps,
    chunks: NearestChunks,
    source,
    wheelbase,
    track,
    layout: Layout,
    events: tuple[Event, ...] = PAPER,
    where: bool = False,
) -> tuple[Margins, Where | None]:
    grid = layout.grid
    # In the code of a caller these are constants: XLA would compute with them beforehand, with other last bits.
    chunks, wheelbase, track = jax.lax.optimization_barrier((chunks, wheelbase, track))
    by_node = node_lanes(above_centre(maps, grid))
    views = view_lanes(by_node, layout)

    def simulate_chunk(chunk: NearestChunks) -> tuple[jax.Array, jax.Array | None]:
        return arc_maxima(poses_on_nodes(by_node, views, chunk, wheelbase, track, layout, where), layout, events)

    maxima, places = jax.lax.map(simulate_chunk, chunks)
    margins = margins_from(by_trajectory(maxima, source, len(maps)), events)
    if places is None:
        return margins, None
    places = jnp.stack([by_trajectory(places[:, part], source, len(maps)) for part in (0, 1)])
    return margins, where_of(places, margins.known, grid.nodes)


def poses_on_nodes(
    by_node: Lanes,
    views: Lanes,
    chunk: NearestChunks,
    wheelbase: float | jax.Array,
    track: float | jax.Array,
    layout: Layout,
    where: bool = False,
) -> Poses:
    """Puts the robot on the nodes of maps, and of their views, at the poses of one chunk.

    where: whether to find the nodes too
    """
    grid = layout.grid
    contact = jax.lax.optimization_barrier(_contacts(by_node, chunk.wheels))
    plane = _pose_planes(contact, chunk, wheelbase, track, grid.spacing)
    if where:
        clearance, body = _highest_node(views, plane, chunk, grid.nodes)
        nodes = _nodes(chunk, body, layout)
    else:
        clearance, nodes = _highest_above(views, plane, chunk, grid.nodes), None
    return Poses(contact, None, plane.pitch, plane.roll, plane.steepness, clearance, nodes)


def _nodes(chunk: NearestChunks, body: jax.Array, layout: Layout) -> Nodes:
    """Returns where the robot touches the ground at every pose: [A P, lanes] nodes of the map each."""
    maps = body.shape[1] // len(layout.views)
    wheels = tuple(jnp.repeat(wheel, maps, axis=1) for wheel in chunk.wheels)
    centre = jnp.broadcast_to(chunk.centre[:, None], body.shape)
    return Nodes(wheels, on_map(body, layout), on_map(centre, layout))


def _contacts(by_node: Lanes, wheels: jax.Array) -> jax.Array:
    """Gathers the contact heights of the wheels: [4, A P, lanes]."""
    heights = read(by_node, wheels)
    return heights.reshape(*heights.shape[:2], -1)


@dataclass(frozen=True)
class _Planes:
    """Pose planes: height = level + east * columns + north * rows from the node `centre`; [A P, lanes] each.

    pitch, roll, steepness: as in events.Pose
    """

    level: jax.Array
    east: jax.Array
    north: jax.Array
    pitch: jax.Array
    roll: jax.Array
    steepness: jax.Array


def _pose_planes(contact: jax.Array, chunk: NearestChunks, wheelbase, track, spacing: float) -> _Planes:
    """Fits the least-squares planes to the four contacts.

    Each sum includes at most one unrounded product, so that a map gives the same bits in any batch, however the loop is
    compiled.
    """
    front_left, front_right, rear_left, rear_right = contact
    pitch = ((front_left + front_right) - (rear_left + rear_right)) * (0.5 / wheelbase)
    roll = ((front_right + rear_right) - (front_left + rear_left)) * (0.5 / track)
    cos, sin = chunk.axes[:, :1], chunk.axes[:, 1:]
    east = (roll * cos - rounded(pitch * sin)) * spacing
    north = (roll * sin + rounded(pitch * cos)) * spacing
    steepness = pitch * pitch + rounded(roll * roll)
    east, north, steepness = jax.lax.optimization_barrier((east, north, steepness))
    middle = (front_left + front_right + rear_left + rear_right) / 4
    level = middle - rounded(east * chunk.offset[:, :1]) - north * chunk.offset[:, 1:]
    return _Planes(jax.lax.optimization_barrier(level), east, north, pitch, roll, steepness)


def _highest_above(views: Lanes, plane: _Planes, chunk: NearestChunks, cols: int) -> jax.Array:
    """Returns the largest height of a chassis node above the pose plane: [A P, lanes]."""
    highest = _scan_places(views, plane, chunk.centre, chunk.singles, 1, cols)
    if not len(chunk.runs):
        return highest
    in_runs = _scan_places(views, plane, chunk.centre, chunk.runs, RUN, cols)
    return reduce(larger, jnp.split(in_runs, RUN, axis=1), highest)


def _highest_node(views: Lanes, plane: _Planes, chunk: NearestChunks, cols: int) -> tuple[jax.Array, jax.Array]:
    """Returns the largest height of a chassis node above the pose plane, and that node in the view: [A P, lanes] each.

    All places of the chunk are single.
    """

    def step(best, group):
        highest, at = best
        for k in range(group.shape[-1]):
            row, col = group[:, 0, k].astype(jnp.int32), group[:, 1, k].astype(jnp.int32)
            node = chunk.centre + row * cols + col
            height = read(views, node)
            level = plane.level + plane.east * col[:, None].astype(jnp.float32)
            above = height - (level + plane.north * row[:, None].astype(jnp.float32))
            at = jnp.where(above > highest, node[:, None], at)
            highest = larger(above, highest)
        return (highest, at), None

    lowest = jnp.full_like(plane.level, -UNKNOWN_HEIGHT)
    return jax.lax.scan(step, (lowest, jnp.zeros(lowest.shape, jnp.int32)), chunk.singles)[0]


def _scan_places(views: Lanes, plane: _Planes, centre, places, run: int, cols: int) -> jax.Array:
    """Returns the largest height above the pose plane over all places, for each of `run` nodes: [A P, run * lanes]."""
    nodes = views
    if not isinstance(views, Shifted):
        nodes = jnp.concatenate([jnp.roll(views, -k, axis=0) for k in range(run)], axis=1)
    aside = jnp.repeat(jnp.arange(run, dtype=jnp.float32), plane.level.shape[1])
    level, east, north = (jnp.tile(field, (1, run)) for field in (plane.level, plane.east, plane.north))

    def step(highest, group):
        for k in range(group.shape[-1]):
            row, col = group[:, 0, k], group[:, 1, k]
            height = read(nodes, centre + row.astype(jnp.int32) * cols + col)
            columns = col.astype(jnp.float32)[:, None] + aside
            above = height - (level + east * columns + north * row.astype(jnp.float32)[:, None])
            highest = larger(above, highest)
        return highest, None

    return jax.lax.scan(step, jnp.full_like(level, -UNKNOWN_HEIGHT), places)[0]
