"""The `tyre` contact model: wheels with radius and width, and the whole outline (SPEC section 15).

heights and steps of a map, and the table of some poses (tyre_tables.py) -> the pose plane on the resting heights of the
four wheels, the step and the clearance at each pose. tyre_trajectories.py makes the margins of trajectories of them;
the letters in shapes are explained in footprint.py. N is the number of poses.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from travjax.batching import rounded
from travjax.simulation.events import Nodes, larger
from travjax.simulation.footprint import Layout
from travjax.simulation.robot import Robot
from travjax.simulation.tyre_tables import Places, TyreTable
from travjax.traversal.arcs import (
    UNKNOWN_HEIGHT,
    Lanes,
    Poses,
    on_map,
    read,
)
from travjax.traversal.steps import step_heights, without_gaps

ROUNDS = 2
"""How often wheels are put on the ground: slopes follow from resting heights, and resting heights from slopes."""

NODES_AT_ONCE = 8
"""Nodes of a tyre or an outline that are read in one step of a scan."""


@partial(jax.tree_util.register_dataclass, data_fields=["row", "col", "height"], meta_fields=[])
@dataclass(frozen=True)
class Scan:
    """Places in the order of a scan: [..., steps, N, places]."""

    row: jax.Array
    col: jax.Array
    height: jax.Array


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["centre", "offset", "axes", "corner", "within", "tyres", "outline"],
    meta_fields=[],
)
@dataclass(frozen=True)
class TyreChunks:
    """A TyreTable on the device, cut into chunks of poses: [C, ...] each."""

    centre: jax.Array
    offset: jax.Array
    axes: jax.Array
    corner: jax.Array
    within: jax.Array
    tyres: Scan
    outline: Scan


def tyre_chunks(table: TyreTable, chunks: int) -> TyreChunks:
    """Cuts a table into chunks of equally many poses, and puts it on the device; N must be a multiple of `chunks`."""

    def cut(array: np.ndarray) -> jax.Array:
        return jnp.asarray(array.reshape(chunks, -1, *array.shape[1:]))

    def scan(places: Places) -> Scan:
        return Scan(
            *(jnp.asarray(_scan_order(array.reshape(chunks, -1, array.shape[1]))) for array in vars(places).values())
        )

    return TyreChunks(
        centre=cut(table.centre),
        offset=cut(table.offset),
        axes=cut(table.axes),
        corner=cut(table.corner),
        within=cut(table.within),
        tyres=scan(table.tyres),
        outline=scan(table.outline),
    )


def _scan_order(array: np.ndarray) -> np.ndarray:
    """Reorders [C, N, K] to [C, steps, N, places], with about NODES_AT_ONCE places in a step."""
    chunks, poses, count = array.shape
    steps = -(-count // NODES_AT_ONCE)
    each = -(-count // steps)
    array = np.pad(array, ((0, 0), (0, 0), (0, steps * each - count)), mode="edge")
    return array.reshape(chunks, poses, steps, each).transpose(0, 2, 1, 3)


@dataclass(frozen=True)
class Ground:
    """What the robot drives on, [nodes, lanes] metres each, above the map's centre and UNKNOWN_HEIGHT where unknown.

    filled: heights of steps.without_gaps; steps: of steps.step_heights
    """

    heights: Lanes
    filled: Lanes
    steps: Lanes


def fields(heights: Float[Array, "n r c"], robot: Robot, spacing: float) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns the heights, filled heights and steps of maps, [n, rows, cols] metres each, UNKNOWN_HEIGHT where unknown.

    heights: metres, UNKNOWN_HEIGHT where unknown
    """
    radius = robot.wheel_diameter / 2
    filled = without_gaps(heights, radius, spacing)
    return heights, jnp.where(jnp.isnan(filled), UNKNOWN_HEIGHT, filled), step_heights(filled, radius, spacing)


def settle(
    ground: Ground,
    chunk: TyreChunks,
    robot: Robot,
    layout: Layout,
    where: bool = False,
) -> Poses:
    """Puts the robot on the ground at the poses of one chunk; contacts are the wheels' resting heights.

    where: whether to find the nodes too
    """
    grid = layout.grid
    cols, spacing, wheelbase, track = grid.nodes, grid.spacing, robot.wheelbase, robot.track
    right, forward = (jnp.array(signs)[None, :, None] for signs in ([-1, 1, -1, 1], [1, 1, -1, -1]))
    cos, sin = chunk.axes[:, :1], chunk.axes[:, 1:]

    def slopes(wheels: jax.Array) -> tuple[jax.Array, jax.Array]:
        front_left, front_right, rear_left, rear_right = (wheels[:, wheel] for wheel in range(4))
        pitch = ((front_left + front_right) - (rear_left + rear_right)) * (0.5 / wheelbase)
        roll = ((front_right + rear_right) - (front_left + rear_left)) * (0.5 / track)
        return pitch, roll

    def a_cell(pitch: jax.Array, roll: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the rise of the pose plane from a node to the next, east and north."""
        east = (roll * cos - rounded(pitch * sin)) * spacing
        north = (roll * sin + rounded(pitch * cos)) * spacing
        return jax.lax.optimization_barrier((east, north))

    def at_centre(east: jax.Array, north: jax.Array) -> jax.Array:
        """Returns how much higher the plane is at the robot's centre than at the node nearest to it."""
        return rounded(east * chunk.offset[:, :1]) + rounded(north * chunk.offset[:, 1:])

    start, highest = _under_wheels(ground.filled, chunk, cols)
    pitch, roll = (jnp.where(highest < UNKNOWN_HEIGHT / 2, slope, 0) for slope in slopes(start))
    for round_ in range(ROUNDS):
        east, north = a_cell(pitch, roll)
        last = round_ == ROUNDS - 1
        above, step, wheel = _on_tyres(
            ground.heights, ground.steps if last else None, east, north, chunk, cols, where and last
        )
        highest = larger(highest, above.max(axis=1))
        # A plane with the slopes so far lies at `above` under each wheel: their differences are what the slopes lack.
        plane = at_centre(east, north)[:, None] + rounded(pitch[:, None] * forward * (wheelbase / 2))
        rest = above + plane + rounded(roll[:, None] * right * (track / 2))
        more = slopes(above)
        pitch, roll = (
            jnp.where(highest < UNKNOWN_HEIGHT / 2, slope + lacking, 0)
            for slope, lacking in zip((pitch, roll), more, strict=True)
        )
    middle = (rest[:, 0] + rest[:, 1] + rest[:, 2] + rest[:, 3]) / 4
    east, north = a_cell(pitch, roll)
    level = jax.lax.optimization_barrier(middle - at_centre(east, north))
    clearance, body = _clearance(ground.heights, level, east, north, chunk, cols, where)
    nodes = None
    if where:
        centre = jnp.broadcast_to(chunk.centre[:, None], body.shape)
        nodes = Nodes((on_map(wheel, layout),), on_map(body, layout), on_map(centre, layout))
    contact = [jnp.where(highest < UNKNOWN_HEIGHT / 2, rest[:, wheel], UNKNOWN_HEIGHT) for wheel in range(4)]
    return Poses(contact, step, pitch, roll, pitch * pitch + rounded(roll * roll), clearance, nodes)


def _under_wheels(heights: Lanes, chunk: TyreChunks, cols: int) -> tuple[jax.Array, jax.Array]:
    """Returns the ground under the wheels' centres, bilinear between nodes [N, 4, lanes], and its highest node."""
    x, y = chunk.within[..., :1], chunk.within[..., 1:]
    weights = ((1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y)
    nodes = [read(heights, chunk.corner + offset) for offset in (0, 1, cols, cols + 1)]
    ground = sum(rounded(node * weight) for node, weight in zip(nodes, weights, strict=True))
    highest = nodes[0]
    for node in nodes[1:]:
        highest = larger(highest, node)
    return jax.lax.optimization_barrier((ground, highest.max(axis=1)))


def _on_tyres(heights: Lanes, steps: Lanes | None, east, north, chunk: TyreChunks, cols: int, where: bool):
    """Returns the height at which a plane through each pose's central node touches the tyres [N, 4, lanes], the largest
    step that they reach, and its node [N, lanes]; no step where `steps` is None, and no node unless `where`.
    """
    centre = jnp.repeat(chunk.centre, 4)
    east, north = (jnp.repeat(slope, 4, axis=0) for slope in (east, north))

    def scan(largest, places: Scan):
        above, reached, at = largest
        for k in range(places.row.shape[-1]):
            node, plane = _plane_at(centre, east, north, places, k, cols)
            drop = places.height[:, k, None]
            above = larger(read(heights, node) - plane - drop, above)
            if steps is not None:
                step = read(steps, node)
                step = jnp.where(step >= drop, step, 0)
                at = jnp.where(step > reached, node[:, None], at) if where else at
                reached = larger(step, reached)
        return (above, reached, at), None

    nowhere = jnp.broadcast_to(centre[:, None], east.shape) if where else None
    first = jnp.full_like(east, -UNKNOWN_HEIGHT), jnp.zeros_like(east), nowhere
    above, reached, at = jax.lax.scan(scan, first, chunk.tyres)[0]
    above, reached = (field.reshape(-1, 4, field.shape[-1]) for field in (above, reached))
    if at is not None:
        largest = reached.argmax(axis=1, keepdims=True)
        at = jnp.take_along_axis(at.reshape(reached.shape), largest, axis=1)[:, 0]
    return jax.lax.optimization_barrier((above, reached.max(axis=1), at))


def _clearance(heights: Lanes, level, east, north, chunk: TyreChunks, cols: int, where: bool):
    """Returns the largest height of a node of the outline above the pose plane and what is allowed there, and the node
    in the view [N, lanes]; no node unless `where`.
    """

    def scan(best, places: Scan):
        highest, at = best
        for k in range(places.row.shape[-1]):
            node, plane = _plane_at(chunk.centre, east, north, places, k, cols)
            above = read(heights, node) - (level + plane) - places.height[:, k, None]
            at = jnp.where(above > highest, node[:, None], at) if where else at
            highest = larger(above, highest)
        return (highest, at), None

    nowhere = jnp.broadcast_to(chunk.centre[:, None], level.shape) if where else None
    return jax.lax.scan(scan, (jnp.full_like(level, -UNKNOWN_HEIGHT), nowhere), chunk.outline)[0]


def _plane_at(centre, east, north, places: Scan, k: int, cols: int) -> tuple[jax.Array, jax.Array]:
    """Returns the k-th node of every pose [N], and the height of the pose plane there above `centre` [N, lanes]."""
    row, col = places.row[:, k].astype(jnp.int32), places.col[:, k].astype(jnp.int32)
    plane = rounded(east * col[:, None].astype(jnp.float32)) + rounded(north * row[:, None].astype(jnp.float32))
    return centre + row * cols + col, plane
