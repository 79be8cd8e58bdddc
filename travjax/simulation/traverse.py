"""The traverse simulator: every trajectory of a batch of maps in one pass (SPEC section 5).

heights -> the four wheel contacts and the pose plane at each pose -> largest step, obstacle and tilt of each arc ->
margins of all trajectories -> failures. First arcs are simulated once for all the second arcs that follow them.

In memory the maps of a batch and their views (footprint.py) lie side by side as the fastest axis, the "lanes", so that
one table entry reads one row of memory. A few first arcs are simulated at a time, so that their poses stay in the
cache. BUILD_NOTES.md has the measurements behind this layout; footprint.py explains the letters in shapes.
"""

from dataclasses import dataclass
from functools import lru_cache, partial, reduce
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, UInt8

from travjax.batching import in_batches, rounded
from travjax.jax_flags import usual_flags
from travjax.simulation.actions import ActionSpace
from travjax.simulation.events import PAPER, UNKNOWN_LABEL, Event, Margins, Pose, label_bit, larger
from travjax.simulation.footprint import RUN, Layout, View, chassis_places
from travjax.simulation.grid import HIGHEST, Grid
from travjax.simulation.heights import Heights, as_maps
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup, chosen_robot

FEW_MAPS = 2
"""For up to this many maps, RUN neighbouring nodes are read at once: the lanes alone do not fill a vector register."""

POSES_AT_ONCE = 200_000
"""Poses times lanes that a CPU simulates at once: a float32 array of them fits in the second-level cache of a core."""

NODES_AT_ONCE = 8
"""Chassis places read in one step of the scan: enough to save memory traffic, few enough to stay in registers."""

UNKNOWN_HEIGHT = 1e30
"""Stands for an unknown height inside the kernel: a maximum keeps it, whereas NaN would need a second pass."""


@usual_flags()
def simulate(
    heights: Heights,
    robot: Robot | str | None = None,
    actions: ActionSpace | None = None,
    *,
    grid: Grid = Grid(),
) -> Margins:
    """Simulates every trajectory on every map, and returns the margins.

    heights: [n, rows, cols] or [rows, cols] metres, NaN or masked where unknown; laid out as in grid.py. Any array of
             numbers, or nested lists; float64 heights are taken relative to the map's centre before they become
             float32, so a site at 2000 m loses nothing
    robot:   a Robot, or the name or file of one; the Seekur Jr unless given
    actions: the paper's action space unless given
    Returns [n, t] arrays, or [t] for one map. Source: SPEC section 5.
    Raises InputError when heights do not have the grid's shape or are not numbers, when they are infinite, beyond 30 km
    or a common marker of unknown ground such as -9999 (in a jax array, whose values are not checked, such heights count
    as unknown), and when a trajectory leaves the map or turns inside the robot.
    """
    return margins_of(heights, Setup.chosen(robot, actions, grid))


@usual_flags()
def margins_of(heights: Heights, setup: Setup) -> Margins:
    """Simulates every trajectory of a setup on every map; takes the heights and raises the errors of `simulate`."""
    maps, alone = as_maps(heights, setup.grid)
    robot, layout = setup.robot, setup.node_table().layout

    def simulate_batch(batch: jax.Array) -> Margins:
        chunks, source = _device_tables(setup, len(batch))
        return _simulate(batch, chunks, source, robot.wheelbase, robot.track, layout, robot.events)

    margins = in_batches(simulate_batch, maps)
    return jax.tree.map(lambda margin: margin[0], margins) if alone else margins


@usual_flags()
def failures(margins: Margins, robot: Robot | str | None = None) -> Bool[Array, "*n t k"]:
    """Tells which margins exceed the robot's limits, in the order of its events; False where unknown.

    Raises InputError when the margins lack one of the robot's events.
    """
    robot = chosen_robot(robot)
    chosen = jnp.stack([margins[name] for name in robot.event_names], axis=-1)
    return chosen > jnp.asarray(robot.limits, jnp.float32)


@usual_flags()
def label(
    heights: Heights,
    robot: Robot | str | None = None,
    actions: ActionSpace | None = None,
    *,
    grid: Grid = Grid(),
) -> Bool[Array, "*n t k"]:
    """Tells which trajectories fail on every map; takes the arguments and raises the errors of `simulate`.

    Returns [n, t, 3] for step, obstacle and tilt, and more columns where the robot has limits for further events. Also
    False where a trajectory is unknown, so read it together with `simulate(...).known`.
    """
    return failures(simulate(heights, robot, actions, grid=grid), robot)


@usual_flags()
@jax.jit
def packed(failed: Bool[Array, "*n t k"], known: Bool[Array, "*n t"]) -> UInt8[Array, "*n t"]:
    """Packs labels into a byte per trajectory: bits 0 to 2 step, obstacle and tilt, 3 unknown, 4 on further events."""
    bits = [failed[..., event].astype(jnp.uint8) << label_bit(event) for event in range(failed.shape[-1])]
    return reduce(jnp.bitwise_or, bits, jnp.where(known, jnp.uint8(0), jnp.uint8(UNKNOWN_LABEL)))


@usual_flags()
def unpacked(labels, robot: Robot | str | None = None) -> tuple[Bool[Array, "*n t k"], Bool[Array, "*n t"]]:
    """Unpacks labels that `packed` made for a robot, [n, t] uint8, into (failed, known)."""
    labels, count = jnp.asarray(labels), len(chosen_robot(robot).events)
    bits = jnp.array([1 << label_bit(event) for event in range(count)], jnp.uint8)
    return (labels[..., None] & bits) > 0, (labels & UNKNOWN_LABEL) == 0


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["wheels", "centre", "offset", "axes", "runs", "singles"],
    meta_fields=[],
)
@dataclass(frozen=True)
class _Chunks:
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


@lru_cache(maxsize=8)
def _device_tables(setup: Setup, maps: int) -> tuple[_Chunks, jax.Array]:
    """Puts the chunks of a NodeTable for batches of `maps` maps, and its `source`, on the device."""
    table = setup.node_table()
    runs, singles = chassis_places(table.chassis, RUN if maps <= FEW_MAPS else 1)
    arcs = len(table.centre)
    if jax.default_backend() == "cpu":
        arcs = min(arcs, max(1, round(POSES_AT_ONCE / (maps * len(table.layout.views) * table.layout.poses))))
    padding = -len(table.centre) % arcs

    def cut(array):
        array = np.concatenate([array, array[:1].repeat(padding, axis=0)])
        return array.reshape(len(array) // arcs, arcs * array.shape[1], *array.shape[2:])

    with jax.ensure_compile_time_eval():  # gives arrays, not tracers, even when the caller is being traced
        chunks = _Chunks(
            wheels=jnp.asarray(cut(table.wheels).transpose(0, 2, 1, 3)),
            centre=jnp.asarray(cut(table.centre)),
            offset=jnp.asarray(cut(table.offset)),
            axes=jnp.asarray(cut(table.axes)),
            runs=jnp.asarray(_scan_order(cut(runs))),
            singles=jnp.asarray(_scan_order(cut(singles))),
        )
        return chunks, jnp.asarray(table.source)


def _scan_order(places: np.ndarray) -> np.ndarray:
    """Reorders [C, A P, 2, K] to [C, steps, A P, 2, places], with about NODES_AT_ONCE places in a step."""
    chunks, poses, _, count = places.shape
    steps = -(-count // NODES_AT_ONCE)
    places = np.concatenate([places, places[..., :1].repeat(-count % max(steps, 1), axis=-1)], axis=-1)
    each = places.shape[-1] // max(steps, 1)
    return places.reshape(chunks, poses, 2, steps, each).transpose(0, 3, 1, 2, 4)


@partial(jax.jit, static_argnames=("layout", "events"))
def _simulate(
    maps, chunks: _Chunks, source, wheelbase, track, layout: Layout, events: tuple[Event, ...] = PAPER
) -> Margins:
    grid = layout.grid
    centre = maps[:, grid.cells // 2, grid.cells // 2, None, None]
    heights = jnp.where(jnp.abs(maps) <= HIGHEST, maps - jnp.where(jnp.isfinite(centre), centre, 0), UNKNOWN_HEIGHT)
    # Without these barriers XLA recomputes both arrays for every element that is gathered from them.
    by_node = jax.lax.optimization_barrier(heights.reshape(len(maps), -1).T)
    views = jax.lax.optimization_barrier(_view_lanes(by_node, layout.views, grid))

    def simulate_chunk(chunk: _Chunks) -> jax.Array:
        contact = jax.lax.optimization_barrier(_contacts(by_node, chunk.wheels))
        plane = _pose_planes(contact, chunk, wheelbase, track, grid.spacing)
        clearance = _highest_above(views, plane, chunk, grid.nodes)
        return _arc_maxima(contact, plane, clearance, layout, events)

    maxima = jax.lax.map(simulate_chunk, chunks).transpose(1, 0, 2, 3, 4).reshape(len(events) + 1, -1, len(maps))
    *largest, highest = maxima[:, source].transpose(0, 2, 1)
    known = highest < UNKNOWN_HEIGHT / 2
    margins = [event.margin(value) for event, value in zip(events, largest, strict=True)]
    step, obstacle, tilt, *optional = (jnp.where(known, margin, jnp.nan) for margin in margins)
    return Margins(step, obstacle, tilt, known, tuple(optional), tuple(event.name for event in events))


def _view_lanes(by_node: jax.Array, views: tuple[View, ...], grid: Grid) -> jax.Array:
    """Puts the map and its rotated and mirrored images side by side: [nodes, lanes]."""
    image = by_node.reshape(*grid.shape, -1)
    return jnp.concatenate([jnp.flip(image, view.flipped) for view in views], axis=-1).reshape(len(by_node), -1)


def _contacts(by_node: jax.Array, wheels: jax.Array) -> jax.Array:
    """Gathers the contact heights of the wheels: [4, A P, lanes]."""
    heights = by_node.at[wheels].get(mode="promise_in_bounds")
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


def _pose_planes(contact: jax.Array, chunk: _Chunks, wheelbase, track, spacing: float) -> _Planes:
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


def _highest_above(views: jax.Array, plane: _Planes, chunk: _Chunks, cols: int) -> jax.Array:
    """Returns the largest height of a chassis node above the pose plane: [A P, lanes]."""
    highest = _scan_places(views, plane, chunk.centre, chunk.singles, 1, cols)
    if not len(chunk.runs):
        return highest
    in_runs = _scan_places(views, plane, chunk.centre, chunk.runs, RUN, cols)
    return reduce(larger, jnp.split(in_runs, RUN, axis=1), highest)


def _scan_places(views, plane: _Planes, centre, places, run: int, cols: int) -> jax.Array:
    """Returns the largest height above the pose plane over all places, for each of `run` nodes: [A P, run * lanes]."""
    nodes = jnp.concatenate([jnp.roll(views, -k, axis=0) for k in range(run)], axis=1)
    aside = jnp.repeat(jnp.arange(run, dtype=jnp.float32), views.shape[1])
    level, east, north = (jnp.tile(field, (1, run)) for field in (plane.level, plane.east, plane.north))

    def step(highest, group):
        for k in range(group.shape[-1]):
            row, col = group[:, 0, k], group[:, 1, k]
            height = nodes.at[centre + row.astype(jnp.int32) * cols + col].get(mode="promise_in_bounds")
            columns = col.astype(jnp.float32)[:, None] + aside
            above = height - (level + east * columns + north * row.astype(jnp.float32)[:, None])
            highest = larger(above, highest)
        return highest, None

    return jax.lax.scan(step, jnp.full_like(level, -UNKNOWN_HEIGHT), places)[0]


def _arc_maxima(
    contact: jax.Array, plane: _Planes, clearance: jax.Array, layout: Layout, events: tuple[Event, ...]
) -> jax.Array:
    """Returns the largest value of each event, and the largest height of contacts and chassis nodes, along both arcs.

    [E + 1, A, R, lanes]
    """
    maxima = []
    for poses in _arc_poses(contact, plane, clearance, layout):
        values = [reduce(larger, map(event.value, poses)) for event in events]
        # Contacts and clearance are each reduced along the arc first: the obstacle event shares the largest clearance.
        ground = zip(*((*pose.contact, pose.clearance) for pose in poses), strict=True)
        highest = reduce(larger, (reduce(larger, heights) for heights in ground))
        # The barrier keeps XLA from recomputing the maxima of a first arc for each second arc.
        maxima.append(jax.lax.optimization_barrier(jnp.stack([*values, highest])))
    return larger(*maxima)


def _arc_poses(contact: jax.Array, plane: _Planes, clearance: jax.Array, layout: Layout) -> tuple[list[Pose], ...]:
    """Returns the poses along the first arcs, their arrays [A, 1, lanes], and along the second arcs, [A, R, lanes].

    XLA does not compute fields that no event uses.
    """

    def along(field: jax.Array) -> tuple[list[jax.Array], list[jax.Array]]:
        field = field.reshape(-1, layout.poses, field.shape[-1])
        first, second = field[:, : layout.first_poses], field[:, layout.first_poses :]
        second = second.reshape(len(second), layout.second_arcs, -1, second.shape[-1])
        along_first = [first[:, pose, None] for pose in range(first.shape[1])]
        return along_first, [second[:, :, pose] for pose in range(second.shape[2])]

    wheels = [along(field) for field in contact]
    others = [along(field) for field in (plane.pitch, plane.roll, plane.steepness, clearance)]
    first, second = (list(zip(*(wheel[part] for wheel in wheels), strict=True)) for part in (0, 1))
    arcs = []
    for part, heights in enumerate(([first[0], *first], [first[-1], *second])):
        rest = zip(*(field[part] for field in others), strict=True)
        arcs.append([Pose(b, _changes(a, b), *more) for (a, b), more in zip(pairwise(heights), rest, strict=True)])
    return tuple(arcs)


def _changes(before: tuple[jax.Array, ...], after: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    return tuple(b - a for a, b in zip(before, after, strict=True))
