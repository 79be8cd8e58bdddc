"""From maps to lanes, and from poses to the margins of trajectories: what the contact models share (SPEC section 5).

In memory the maps of a batch and their views (footprint.py) lie side by side as the fastest axis, the "lanes", so that
one table entry reads one row of memory. First arcs are simulated once for all the second arcs that follow them. A
contact model (nearest.py, tyre.py) finds the pose plane, steps and clearance at the poses of a few first arcs at a
time; footprint.py explains the letters in shapes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial, reduce
from itertools import pairwise

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from travjax.simulation.events import Event, Margins, Nodes, Pose, Where, larger
from travjax.simulation.footprint import Layout
from travjax.simulation.grid import HIGHEST, Grid

UNKNOWN_HEIGHT = 1e30
"""Stands for an unknown height inside the kernel: a maximum keeps it, whereas NaN would need a second pass."""


def above_centre(maps: jax.Array, grid: Grid) -> jax.Array:
    """Returns heights relative to each map's centre, [n, rows, cols] metres; UNKNOWN_HEIGHT where unknown."""
    centre = maps[:, grid.cells // 2, grid.cells // 2, None, None]
    return jnp.where(jnp.abs(maps) <= HIGHEST, maps - jnp.where(jnp.isfinite(centre), centre, 0), UNKNOWN_HEIGHT)


def node_lanes(fields: jax.Array) -> jax.Array:
    """Puts fields [n, rows, cols] of maps side by side: [nodes, n]."""
    # Without the barrier XLA recomputes the array for every element that is gathered from it.
    return jax.lax.optimization_barrier(fields.reshape(len(fields), -1).T)


@partial(jax.tree_util.register_dataclass, data_fields=["heights", "start"], meta_fields=["length"])
@dataclass(frozen=True)
class Shifted:
    """Lanes that are places of one large map: a node, counted from each place, is a stretch of memory.

    heights: [m] of the map, in such an order that places side by side see nodes side by side
    start:   [nodes] int32 where the stretch of a node begins
    length:  number of lanes
    """

    heights: Float[Array, " m"]
    start: Int[Array, " nodes"]
    length: int


Lanes = jax.Array | Shifted
"""Heights of maps or places side by side: [nodes, lanes], or `Shifted`."""


def read(lanes: Lanes, nodes: Int[Array, "*k"]) -> Float[Array, "*k lanes"]:
    """Reads nodes of all lanes."""
    if not isinstance(lanes, Shifted):
        return lanes.at[nodes].get(mode="promise_in_bounds")
    start = read(lanes.start, nodes)
    if start.ndim == 0:
        return jax.lax.dynamic_slice(lanes.heights, (start,), (lanes.length,))
    stretches = jax.lax.GatherDimensionNumbers((start.ndim,), (), (0,))
    mode = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return jax.lax.gather(lanes.heights, start[..., None], stretches, (lanes.length,), mode=mode)


def view_lanes(by_node: jax.Array, layout: Layout) -> jax.Array:
    """Puts maps [nodes, n] and their rotated and mirrored images side by side: [nodes, lanes]."""
    image = by_node.reshape(*layout.grid.shape, -1)
    images = jnp.concatenate([jnp.flip(image, view.flipped) for view in layout.views], axis=-1)
    return jax.lax.optimization_barrier(images.reshape(len(by_node), -1))


@dataclass(frozen=True)
class Poses:
    """The robot at all poses of a few first arcs, [A P, lanes] each; see events.Pose.

    contact: of the four wheels
    step:    metres, largest step at each pose; None where it is the change of contact heights between poses
    nodes:   where, on the original map; None unless it is asked for
    """

    contact: Sequence[jax.Array]
    step: jax.Array | None
    pitch: jax.Array
    roll: jax.Array
    steepness: jax.Array
    clearance: jax.Array
    nodes: Nodes | None = None


def arc_maxima(poses: Poses, layout: Layout, events: tuple[Event, ...]) -> tuple[jax.Array, jax.Array | None]:
    """Returns the largest value of each event, and the largest height of contacts and clearances, along both arcs.

    [E + 1, A, R, lanes], R = 1 without second arcs, and [2, E, A, R, lanes] the number of the pose and the node where
    each event is largest, if nodes are asked for.
    """
    arcs = _arc_poses(poses, layout)
    # The barrier keeps XLA from recomputing the maxima of a first arc for each second arc.
    maxima = [jax.lax.optimization_barrier(pose_maxima(arc, events)) for arc in arcs if arc]
    if poses.nodes is None:
        return reduce(larger, maxima), None
    places = [pose_places(arc, events, first) for arc, first in zip(arcs, (0, layout.first_poses), strict=True)]
    later = maxima[1][:-1] > maxima[0][:-1]
    return larger(*maxima), jnp.where(later, places[1], places[0])


def pose_maxima(poses: Sequence[Pose], events: tuple[Event, ...]) -> jax.Array:
    """Returns the largest value of each event, and the largest height of contacts and clearances: [E + 1, ...]."""
    values = [reduce(larger, map(event.value, poses)) for event in events]
    # Contacts and clearance are each reduced over the poses first: the obstacle event shares the largest clearance.
    ground = zip(*((*pose.contact, pose.clearance) for pose in poses), strict=True)
    return jnp.stack([*values, reduce(larger, (reduce(larger, heights) for heights in ground))])


def pose_places(poses: Sequence[Pose], events: tuple[Event, ...], first: int) -> jax.Array:
    """Returns the number of the pose, counted from `first`, and the node where each event is largest: [2, E, ...]."""
    places = []
    for event in events:
        largest, node = event.value(poses[0]), event.node(poses[0])
        number = jnp.full_like(node, first)
        for count, pose in enumerate(poses[1:], first + 1):
            value = event.value(pose)
            more = value > largest
            number, node = jnp.where(more, count, number), jnp.where(more, event.node(pose), node)
            largest = larger(value, largest)
        places.append(jnp.stack([number, node]))
    return jnp.stack(places, axis=1)


def _arc_poses(poses: Poses, layout: Layout) -> tuple[list[Pose], ...]:
    """Returns the poses along the first arcs, their arrays [A, 1, lanes], and along the second arcs, [A, R, lanes].

    XLA does not compute fields that no event uses.
    """

    def along(field: jax.Array) -> tuple[list[jax.Array], list[jax.Array]]:
        field = field.reshape(-1, layout.poses, field.shape[-1])
        first, second = field[:, : layout.first_poses], field[:, layout.first_poses :]
        each = (layout.poses - layout.first_poses) // max(layout.second_arcs, 1)
        second = second.reshape(len(second), layout.second_arcs, each, second.shape[-1])
        along_first = [first[:, pose, None] for pose in range(first.shape[1])]
        return along_first, [second[:, :, pose] for pose in range(second.shape[2])]

    wheels = [along(field) for field in poses.contact]
    first, second = (list(zip(*(wheel[part] for wheel in wheels), strict=True)) for part in (0, 1))
    if poses.step is None:
        pairs = pairwise([first[0], *first]), pairwise([first[-1], *second])
        changes = tuple([_changes(before, after) for before, after in part] for part in pairs)
    else:
        changes = tuple([(field,) for field in part] for part in along(poses.step))
    others = [along(field) for field in (poses.pitch, poses.roll, poses.steepness, poses.clearance)]
    if poses.nodes is None:
        nodes: tuple = ([None] * len(first), [None] * len(second))
    else:
        *wheels, body, centre = (along(field) for field in (*poses.nodes.wheels, poses.nodes.body, poses.nodes.centre))
        under = [list(zip(*(wheel[part] for wheel in wheels), strict=True)) for part in (0, 1)]
        nodes = tuple(
            [Nodes(*fields) for fields in zip(under[part], body[part], centre[part], strict=True)] for part in (0, 1)
        )
    return tuple(
        [Pose(*at) for at in zip(contact, changes[part], *(other[part] for other in others), nodes[part], strict=True)]
        for part, contact in enumerate((first, second))
    )


def _changes(before: tuple[jax.Array, ...], after: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    return tuple(b - a for a, b in zip(before, after, strict=True))


def margins_from(maxima: jax.Array, events: tuple[Event, ...]) -> Margins:
    """Makes margins of the largest values of events and of the highest ground that is touched, [E + 1, n, t]."""
    *largest, highest = maxima
    known = highest < UNKNOWN_HEIGHT / 2
    margins = [event.margin(value) for event, value in zip(events, largest, strict=True)]
    step, obstacle, tilt, *optional = (jnp.where(known, margin, jnp.nan) for margin in margins)
    return Margins(step, obstacle, tilt, known, tuple(optional), tuple(event.name for event in events))


def by_trajectory(maxima: jax.Array, source: jax.Array, maps: int) -> jax.Array:
    """Puts results of chunks of first arcs, [C, E, A, R, lanes], in the order of trajectories: [E, n, t].

    source: NodeTable.source; maps: n
    """
    by_map = maxima.transpose(1, 0, 2, 3, 4).reshape(maxima.shape[1], -1, maps)
    return by_map[:, source].transpose(0, 2, 1)


def on_map(nodes: jax.Array, layout: Layout) -> jax.Array:
    """Turns nodes in the views of maps, [A P, lanes], into nodes of the maps."""
    rows, cols = layout.grid.shape
    by_view = nodes.reshape(len(nodes), len(layout.views), -1)
    row, col = by_view // cols, by_view % cols
    turned, mirrored = (jnp.array([axis in view.flipped for view in layout.views])[:, None] for axis in (0, 1))
    return (jnp.where(turned, rows - 1 - row, row) * cols + jnp.where(mirrored, cols - 1 - col, col)).reshape(
        nodes.shape
    )


def where_of(places: jax.Array, known: jax.Array, cols: int) -> Where:
    """Makes Where of pose numbers and nodes [2, E, n, t]."""
    pose, node = jnp.where(known, places, -1).transpose(0, 2, 3, 1)
    return Where(pose, jnp.stack([node // cols, jnp.where(node < 0, -1, node % cols)], axis=-1))
