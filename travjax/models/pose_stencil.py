"""The nodes that the hazard field is read from at every pose of the action space: static tables, as in footprint.py.

A failure at a pose depends on the ground under the wheels, the ground under them one path interval before, and the
ground under the chassis. The stencil of a pose holds the node nearest to each of these places.
"""

from dataclasses import dataclass
from functools import lru_cache, partial

import jax
import numpy as np
from jaxtyping import Int

from travjax.simulation.actions import arc_poses
from travjax.simulation.footprint import nearest
from travjax.simulation.grid import Grid
from travjax.simulation.setup import Setup

ACROSS, ALONG = 2, 5
"""Places under the chassis, evenly spread over its width and length."""

STENCIL_NODES = 8 + ACROSS * ALONG
"""Nodes of a stencil: the wheels FL, FR, RL, RR, the same one interval before, and those under the chassis."""

Nodes = Int[np.ndarray, "*p s"]


@partial(jax.tree_util.register_dataclass, data_fields=["nodes"], meta_fields=["first_poses", "second_arcs"])
@dataclass(frozen=True)
class Stencil:
    """The stencils of all poses, first arc by first arc; shapes use the letters of footprint.py.

    nodes:       [F, P, s] int32 nodes (row * cols + col): for each first arc its own poses, then those of each of
                 its second arcs, so that trajectories come in the order of the action space
    first_poses: number of poses of a first arc, including the junction
    second_arcs: number of second arcs after each first one
    """

    nodes: Nodes | jax.Array
    first_poses: int
    second_arcs: int


@lru_cache(maxsize=8)
def stencil(setup: Setup) -> Stencil:
    """Builds the table; raises InputError when a trajectory leaves the map or turns inside the robot."""
    setup.node_table()  # checks that robot, actions and grid fit together
    actions, radii = setup.actions, np.asarray(setup.actions.radii)
    every = np.arange(len(radii))
    turn, first = np.divmod(np.arange(actions.turns * len(radii)), len(radii))
    own = actions.first_poses(turn, first)
    following = actions.second_poses(turn[:, None], first[:, None], every)
    parts = [nodes_at(own, radii[first][:, None], setup)]
    parts.append(nodes_at(following, radii[:, None], setup))
    nodes = np.concatenate([part.reshape(len(turn), -1, STENCIL_NODES) for part in parts], axis=1)
    nodes.setflags(write=False)
    return Stencil(nodes, own.shape[1], len(radii))


def nodes_at(poses: np.ndarray, radius: np.ndarray, setup: Setup) -> Nodes:
    """Returns the stencils of poses [..., 3] on arcs of signed radius [...]: [..., s] int32.

    Places off the map are moved to its edge. The pose before is always on the same arc, at the junction as well.
    """
    robot, grid = setup.robot, setup.grid
    back = np.array([-setup.actions.interval])
    before = arc_poses(poses, np.broadcast_to(radius, poses.shape[:-1]), back)[..., 0, :]
    wheels = np.array(robot.wheel_positions())
    right = robot.chassis_width * (np.arange(ACROSS) + 0.5 - ACROSS / 2) / ACROSS
    forward = robot.chassis_length * (np.arange(ALONG) + 0.5 - ALONG / 2) / ALONG
    chassis = np.stack(np.meshgrid(right, forward, indexing="ij"), axis=-1).reshape(-1, 2)
    places = [_nodes(poses, wheels, grid), _nodes(before, wheels, grid), _nodes(poses, chassis, grid)]
    return np.concatenate(places, axis=-1)


def _nodes(poses: np.ndarray, places: np.ndarray, grid: Grid) -> np.ndarray:
    """Returns the nodes nearest to places [k, 2] (right, forward) of the robot at poses [..., 3]: [..., k]."""
    x, y, heading = (poses[..., axis, None] for axis in range(3))
    sin, cos, (right, forward) = np.sin(heading), np.cos(heading), places.T
    node = lambda coordinate: np.clip(nearest(coordinate, grid), 0, grid.cells)
    row, col = node(y + sin * right + cos * forward), node(x + cos * right - sin * forward)
    return (row * grid.nodes + col).astype(np.int32)
