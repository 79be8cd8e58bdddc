"""The trajectories of the `tyre` contact model: their arcs, and the point turns at their start (SPEC section 15).

maps -> the robot at all poses (tyre.py) -> largest step, obstacle and tilt of arcs and turns -> margins.
"""

import math
from dataclasses import dataclass
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from travjax.simulation.actions import ActionSpace
from travjax.simulation.events import Margins, Pose, Where, larger
from travjax.simulation.footprint import Layout, View
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup
from travjax.simulation.tyre_tables import tyre_table
from travjax.traversal.arcs import (
    UNKNOWN_HEIGHT,
    Poses,
    above_centre,
    arc_maxima,
    by_trajectory,
    margins_from,
    node_lanes,
    pose_maxima,
    view_lanes,
    where_of,
)
from travjax.traversal.tyre import Ground, TyreChunks, fields, settle, tyre_chunks

POSES_AT_ONCE = 50_000
"""Poses times lanes that a CPU simulates at once; BUILD_NOTES.md has the measurement."""

TURN_STEP = math.radians(5)
"""Largest angle between poses of a point turn."""


def tyre_margins(maps: jax.Array, setup: Setup, where: bool) -> tuple[Margins, Where | None]:
    """Simulates every trajectory on a batch of maps [n, rows, cols]; `where` also finds where margins are reached."""
    chunks, source = _arc_chunks(setup, len(maps))
    turns = _turns(setup) if setup.contact.turn else None
    return _simulate(maps, chunks, source, turns, setup.robot, setup.node_table().layout, where)


@lru_cache(maxsize=8)
def _arc_chunks(setup: Setup, maps: int) -> tuple[TyreChunks, jax.Array]:
    """Puts the tables of all arcs for batches of `maps` maps, and the `source` of trajectories, on the device."""
    table = setup.node_table()
    arcs = table.poses.shape[0]
    if jax.default_backend() == "cpu":
        arcs = min(arcs, max(1, round(POSES_AT_ONCE / (maps * len(table.layout.views) * table.layout.poses))))
    padding = table.poses[:1].repeat(-len(table.poses) % arcs, axis=0)
    poses = np.concatenate([table.poses, padding])
    with jax.ensure_compile_time_eval():  # gives arrays, not tracers, even when the caller is being traced
        chunks = tyre_chunks(tyre_table(poses.reshape(-1, 3), setup.robot, setup.grid), len(poses) // arcs)
        return chunks, jnp.asarray(table.source)


@partial(jax.tree_util.register_dataclass, data_fields=["chunk", "passed", "left", "turn"], meta_fields=[])
@dataclass(frozen=True)
class _Turns:
    """The poses of all point turns, which lie around the circle, in one chunk.

    passed: [turns, N] which poses each turn passes through; left: [turns, N] how many poses are left from there to its
            end; turn: [t] the turn of each trajectory
    """

    chunk: TyreChunks
    passed: Bool[Array, "turns N"]
    left: Int[Array, "turns N"]
    turn: jax.Array


@lru_cache(maxsize=8)
def _turns(setup: Setup) -> _Turns:
    """Puts the tables of the point turns on the device."""
    headings, passed, left = turn_poses(setup.actions)
    poses = np.stack([np.zeros_like(headings), np.zeros_like(headings), headings], axis=-1)
    with jax.ensure_compile_time_eval():
        chunk = jax.tree.map(lambda array: array[0], tyre_chunks(tyre_table(poses, setup.robot, setup.grid), 1))
        turn = setup.actions.split(np.arange(len(setup.actions)))[0]
        return _Turns(chunk, *map(jnp.asarray, (passed, left, turn)))


def turn_poses(actions: ActionSpace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Computes the headings of the poses of all point turns: [N] radians, evenly around the circle.

    Also returns which of them each turn passes, and how many are left from there to its end: [turns, N] each. A turn
    goes the shorter way round, the half circle anticlockwise.
    """
    parts = math.ceil(2 * math.pi / actions.turns / TURN_STEP - 1e-9)
    count = actions.turns * parts
    place, end = np.arange(count), np.arange(actions.turns)[:, None] * parts
    anticlockwise = 2 * end <= count
    passed = np.where(anticlockwise, place <= end, (place >= end) | (place == 0))
    left = np.where(anticlockwise, end - place, np.where(place == 0, count, place) - end)
    return 2 * math.pi * place / count, passed, left


@partial(jax.jit, static_argnames=("robot", "layout", "where"))
def _simulate(
    maps, chunks: TyreChunks, source, turns: _Turns | None, robot: Robot, layout: Layout, where: bool
) -> tuple[Margins, Where | None]:
    grid, events = layout.grid, robot.events
    # In the code of a caller tables are constants: XLA would compute with them beforehand, with other last bits.
    chunks, turns = jax.lax.optimization_barrier((chunks, turns))
    lanes = [node_lanes(field) for field in fields(above_centre(maps, grid), robot, grid.spacing)]
    ground, views = Ground(*lanes), Ground(*(view_lanes(field, layout) for field in lanes))

    def simulate_chunk(chunk: TyreChunks) -> tuple[jax.Array, jax.Array | None]:
        return arc_maxima(settle(views, chunk, robot, layout, where), layout, events)

    maxima, places = jax.lax.map(simulate_chunk, chunks)
    maxima = by_trajectory(maxima, source, len(maps))
    if places is not None:
        places = jnp.stack([by_trajectory(places[:, part], source, len(maps)) for part in (0, 1)])
    if turns is not None:
        turning = settle(ground, turns.chunk, robot, Layout(grid, (View(),), 0, 0, 0), where)
        maxima, places = _with_turns(maxima, places, turning, turns, events)
    margins = margins_from(maxima, events)
    return margins, None if places is None else where_of(places, margins.known, grid.nodes)


def _with_turns(maxima, places, poses: Poses, turns: _Turns, events) -> tuple[jax.Array, jax.Array | None]:
    """Puts the point turns of trajectories into maxima [E + 1, n, t] and places [2, E, n, t]."""
    assert poses.step is not None
    slopes = poses.pitch, poses.roll, poses.steepness
    pose = Pose(tuple(poses.contact), (poses.step,), *slopes, poses.clearance, poses.nodes)
    passed = jnp.where(turns.passed[..., None], pose_maxima([pose], events)[:, None], -UNKNOWN_HEIGHT)
    turning = passed.max(axis=2)[:, turns.turn].transpose(0, 2, 1)
    if places is not None:
        at = passed[:-1].argmax(axis=2)  # [E, turns, n]
        number = -jnp.take_along_axis(turns.left[None, ..., None], at[:, :, None], axis=2)[:, :, 0]
        nodes = jnp.stack([event.node(pose) for event in events])
        node = jnp.take_along_axis(nodes[:, None], at[:, :, None], axis=2)[:, :, 0]
        turned = jnp.stack([number, node])[:, :, turns.turn].transpose(0, 1, 3, 2)
        places = jnp.where(turning[:-1] > maxima[:-1], turned, places)
    return larger(turning, maxima), places
