"""From maps to lanes, and from poses to the margins of trajectories: what the contact models share (SPEC section 5).

In memory the maps of a batch and their views (footprint.py) lie side by side as the fastest axis, the "lanes", so that
one table entry reads one row of memory. First arcs are simulated once for all the second arcs that follow them. A
contact model (nearest.py, tyre.py) finds the pose plane, steps and clearance at the poses of a few first arcs at a
time; footprint.py explains the letters in shapes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise

import jax
import jax.numpy as jnp

from travjax.simulation.events import Event, Margins, Pose, larger
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
    """

    contact: Sequence[jax.Array]
    step: jax.Array | None
    pitch: jax.Array
    roll: jax.Array
    steepness: jax.Array
    clearance: jax.Array


def arc_maxima(poses: Poses, layout: Layout, events: tuple[Event, ...]) -> jax.Array:
    """Returns the largest value of each event, and the largest height of contacts and clearances, along both arcs.

    [E + 1, A, R, lanes]
    """
    # The barrier keeps XLA from recomputing the maxima of a first arc for each second arc.
    maxima = [jax.lax.optimization_barrier(pose_maxima(arc, events)) for arc in _arc_poses(poses, layout)]
    return larger(*maxima)


def pose_maxima(poses: Sequence[Pose], events: tuple[Event, ...]) -> jax.Array:
    """Returns the largest value of each event, and the largest height of contacts and clearances: [E + 1, ...]."""
    values = [reduce(larger, map(event.value, poses)) for event in events]
    # Contacts and clearance are each reduced over the poses first: the obstacle event shares the largest clearance.
    ground = zip(*((*pose.contact, pose.clearance) for pose in poses), strict=True)
    return jnp.stack([*values, reduce(larger, (reduce(larger, heights) for heights in ground))])


def _arc_poses(poses: Poses, layout: Layout) -> tuple[list[Pose], ...]:
    """Returns the poses along the first arcs, their arrays [A, 1, lanes], and along the second arcs, [A, R, lanes].

    XLA does not compute fields that no event uses.
    """

    def along(field: jax.Array) -> tuple[list[jax.Array], list[jax.Array]]:
        field = field.reshape(-1, layout.poses, field.shape[-1])
        first, second = field[:, : layout.first_poses], field[:, layout.first_poses :]
        second = second.reshape(len(second), layout.second_arcs, -1, second.shape[-1])
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
    return tuple(
        [Pose(*fields) for fields in zip(contact, changes[part], *(other[part] for other in others), strict=True)]
        for part, contact in enumerate((first, second))
    )


def _changes(before: tuple[jax.Array, ...], after: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    return tuple(b - a for a, b in zip(before, after, strict=True))


def margins_of(maxima: jax.Array, events: tuple[Event, ...]) -> Margins:
    """Makes margins of the largest values of events and of the highest ground that is touched, [E + 1, n, t]."""
    *largest, highest = maxima
    known = highest < UNKNOWN_HEIGHT / 2
    margins = [event.margin(value) for event, value in zip(events, largest, strict=True)]
    step, obstacle, tilt, *optional = (jnp.where(known, margin, jnp.nan) for margin in margins)
    return Margins(step, obstacle, tilt, known, tuple(optional), tuple(event.name for event in events))


def by_trajectory(maxima: jax.Array, source: jax.Array, maps: int) -> jax.Array:
    """Puts the maxima of chunks of first arcs, [C, E + 1, A, R, lanes], in the order of trajectories: [E + 1, n, t].

    source: NodeTable.source; maps: n
    """
    by_map = maxima.transpose(1, 0, 2, 3, 4).reshape(maxima.shape[1], -1, maps)
    return by_map[:, source].transpose(0, 2, 1)
