"""One trajectory pose by pose: where the wheels are, how the robot leans, what comes close to its body.

It is computed by the sequential simulators (reference.py, tyre_reference.py), so its largest values are the margins of
`simulate` to rounding.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from travjax.config import require
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import HIGHEST, Grid
from travjax.simulation.heights import Heights, as_maps
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup
from travjax.traversal import reference, tyre_reference


@dataclass(frozen=True)
class Traverse:
    """The poses of one trajectory, p of them; lengths in metres, angles in radians, nodes as (row, column) of the map.

    Numbers are NaN and nodes -1 at poses that touch unknown ground.

    pose:     [p, 3] x, y and heading
    turning:  how many of the first poses belong to the point turn, without its last one, the start of the first arc
    contact:  [p, 4] height of the ground under the wheels FL, FR, RL, RR, or at which they rest, above the map's centre
    pitch, roll, tilt: [p] slopes of the pose plane, forward, to the right and in all, as angles
    step:     [p] of `nearest` the largest change of a contact since the pose before, of `tyre` the largest step reached
    obstacle: [p] the highest node under the body above the pose plane, less what is allowed beyond the ride height
    step_node, obstacle_node: [p, 2] where these are
    known:    [p] False where the pose touches unknown ground
    """

    pose: Float[np.ndarray, "p 3"]
    turning: int
    contact: Float[np.ndarray, "p 4"]
    pitch: Float[np.ndarray, " p"]
    roll: Float[np.ndarray, " p"]
    tilt: Float[np.ndarray, " p"]
    step: Float[np.ndarray, " p"]
    obstacle: Float[np.ndarray, " p"]
    step_node: Int[np.ndarray, "p 2"]
    obstacle_node: Int[np.ndarray, "p 2"]
    known: Bool[np.ndarray, " p"]


def traverse(
    heights: Heights,
    trajectory: int,
    robot: Robot | str | None = None,
    actions: ActionSpace | None = None,
    *,
    grid: Grid = Grid(),
    contact: str | None = None,
    turn: bool = True,
) -> Traverse:
    """Simulates one trajectory on one map, and returns what happens at each of its poses.

    heights: [rows, cols] metres, and the other arguments as of `simulate`; trajectory: its index
    Source: SPEC sections 5 and 15. Raises InputError as `simulate` does, and when there is no such trajectory.
    """
    setup = Setup.chosen(robot, actions, grid, contact, turn)
    setup.require_fit()
    maps, alone = as_maps(heights, grid)
    require(alone, "heights", np.shape(heights), f"one map, {grid.shape}")
    whole = isinstance(trajectory, int | np.integer) and not isinstance(trajectory, bool)
    allowed = f"a whole number from 0 to {len(setup.actions) - 1}"
    require(whole and 0 <= trajectory < len(setup.actions), "trajectory", trajectory, allowed)
    ground = np.asarray(maps[0], float)
    ground = reference.above_centre(np.where(np.abs(ground) <= HIGHEST, ground, np.nan))
    path = setup.actions.poses(trajectory)
    if setup.contact.model == "tyre":
        turning = tyre_reference.turn_poses(setup.actions, trajectory)[:-1] if setup.contact.turn else path[:0]
        return at_poses(ground, np.concatenate([turning, path]), setup.robot, grid.spacing, "tyre", len(turning))
    return at_poses(ground, path, setup.robot, grid.spacing, "nearest")


def at_poses(
    ground: Float[np.ndarray, "rows cols"],
    poses: Float[np.ndarray, "p 3"],
    robot: Robot,
    spacing: float,
    contact: str,
    turning: int = 0,
) -> Traverse:
    """Simulates any poses that follow each other, and returns what happens at each of them.

    ground:  [rows, cols] float64 metres, both odd, the middle node at x = y = 0; NaN where unknown
    poses:   x, y and heading; turning: how many of the first belong to a point turn
    spacing: metres between nodes; contact: contact model
    """
    by = _by_tyre if contact == "tyre" else _by_nearest
    return by(ground, poses, robot, spacing, turning)


def _by_nearest(ground: np.ndarray, poses: np.ndarray, robot: Robot, spacing: float, turning: int) -> Traverse:
    states = [reference.pose_state(ground, robot, x, y, heading, spacing) for x, y, heading in poses.tolist()]
    contact = np.array([state.contacts for state in states])
    change = np.abs(np.diff(contact, axis=0, prepend=contact[:1]))
    step_node = np.take_along_axis(np.array([s.nodes for s in states]), change.argmax(axis=1)[:, None, None], axis=1)
    return _traverse(states, poses, turning, contact, change.max(axis=1), step_node[:, 0])


def _by_tyre(ground: np.ndarray, poses: np.ndarray, robot: Robot, spacing: float, turning: int) -> Traverse:
    whole = tyre_reference.ground_of(ground, robot, spacing)
    states = [tyre_reference.pose_state(whole, robot, x, y, heading, spacing) for x, y, heading in poses.tolist()]
    contact, step = np.array([state.resting for state in states]), np.array([state.step for state in states])
    return _traverse(states, poses, turning, contact, step, np.array([s.step_node or (-1, -1) for s in states]))


def _traverse(states, poses: np.ndarray, turning: int, contact, step, step_node) -> Traverse:
    known = np.array([state.known for state in states])

    def field(value: Callable) -> np.ndarray:
        return np.where(known, [value(state) for state in states], np.nan)

    def nodes(node: np.ndarray) -> np.ndarray:
        return np.where(known[:, None], node, -1)

    return Traverse(
        pose=poses,
        turning=turning,
        contact=np.where(known[:, None], contact, np.nan),
        pitch=field(lambda state: np.arctan(state.pitch_slope)),
        roll=field(lambda state: np.arctan(state.roll_slope)),
        tilt=field(lambda state: state.tilt),
        step=np.where(known, step, np.nan),
        obstacle=field(lambda state: state.clearance),
        step_node=nodes(step_node),
        obstacle_node=nodes(np.array([state.clearance_node or (-1, -1) for state in states])),
        known=known,
    )
