"""Sequential float64 simulator of the contact model tyre (SPEC section 15): the oracle for the batched kernel.

It computes one trajectory and one pose at a time in plain NumPy, and shares no code with the kernel. Poses along the
arcs and the heights' datum are those of travjax.traversal.reference. `robot` and `actions` are any objects with the
attributes of travjax.Robot and travjax.ActionSpace; a robot's `overhang_height` (None is its ride height) and
`nose_rise` (0) may be left out.

A tie must not depend on how sin and cos round: bounds of places and of heights have a slack of 1e-9 m.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from travjax.traversal.reference import (
    UNKNOWN_MARGINS,
    Margins,
    TrajectoryMargins,
    above_centre,
    collected,
    poses,
    window,
)

EVEN = 1e-5  # metres, by which parts of a rise may differ and still be equal
TIE = 1e-9  # metres, and cells where a place is counted in cells
TURN_PART = math.radians(5.0)  # the largest turn between two poses of a point turn
DIRECTIONS = tuple((row, col) for row in (-1, 0, 1) for col in (-1, 0, 1) if row or col)


@dataclass(frozen=True)
class PoseState:
    """How a robot stands at one pose (section 15); numbers are NaN and nodes None unless it is known.

    resting:        [4] metres, resting heights R of the wheels FL, FR, RL, RR, which the pose plane is fitted to
    centre, roll_slope, pitch_slope: the pose plane: its height at the robot's centre in metres, its slopes to the
                    right and forward
    clearance:      metres, obstacle margin of the pose, and `clearance_node` (row, col) where it is
    step:           metres, step margin of the pose, and `step_node` (row, col) where it is
    known:          False if a tyre, the outline or the ground around a wheel's centre has an unknown node
    """

    resting: np.ndarray
    centre: float
    roll_slope: float
    pitch_slope: float
    clearance: float
    clearance_node: tuple[int, int] | None
    step: float
    step_node: tuple[int, int] | None
    known: bool

    @property
    def tilt(self) -> float:
        """The angle between the pose plane and the horizontal in radians."""
        return math.atan(math.hypot(self.roll_slope, self.pitch_slope))


UNKNOWN_POSE = PoseState(np.full(4, math.nan), math.nan, math.nan, math.nan, math.nan, None, math.nan, None, False)


@dataclass(frozen=True)
class Ground:
    """Heights of a map, the same with gaps `filled`, and its steps: [rows, cols] metres, NaN unknown (section 15)."""

    heights: np.ndarray
    filled: np.ndarray
    steps: np.ndarray


# Trajectories


def simulate(
    heights,
    robot,
    actions,
    trajectories: Iterable[int] | None = None,
    cell_size: float = 0.0625,
    turn: bool = True,
    on_progress: Callable[[int], object] | None = None,
) -> Margins:
    """Simulates trajectories (all unless given) one after the other on one map, and returns their margins (section 15).

    heights: [rows, cols] metres; `on_progress` is called after each trajectory with the number done so far.

    Raises ValueError as simulate_trajectory does.
    """
    heights = above_centre(heights)
    ground = ground_of(heights, robot, cell_size)
    if trajectories is None:
        trajectories = range(actions.turns * len(actions.radii) ** 2)
    results = []
    for trajectory in trajectories:
        results.append(_margins(ground, robot, actions, int(trajectory), cell_size, turn))
        if on_progress is not None:
            on_progress(len(results))
    return collected(results)


def simulate_trajectory(
    heights, robot, actions, trajectory: int, cell_size: float = 0.0625, turn: bool = True
) -> TrajectoryMargins:
    """Simulates one trajectory, with its point turn unless `turn` is False, and returns its margins (section 15).

    heights: [rows, cols] metres, both odd, the centre node at x = y = 0; NaN is unknown ground.

    Raises ValueError if the map has no centre node, if the action space has no such trajectory, or if the overall
    outline or a tyre leaves the map.
    """
    heights = above_centre(heights)
    ground = ground_of(heights, robot, cell_size)
    return _margins(ground, robot, actions, trajectory, cell_size, turn)


def turn_poses(actions, trajectory: int) -> np.ndarray:
    """Computes the poses [n, 3] of a trajectory's point turn: x = y = 0 metres, headings in radians, from 0 on.

    The turn goes the shorter way round, anticlockwise where both are equal; its poses are those of the fewest equal
    parts of 2 pi / turns that are at most 5 degrees each.
    """
    turn, one = trajectory // len(actions.radii) ** 2, 2.0 * math.pi / actions.turns
    if 2 * turn > actions.turns:
        turn -= actions.turns
    parts = math.ceil(one / TURN_PART - TIE)
    headings = one / parts * np.arange(abs(turn) * parts + 1) * np.sign(turn)
    return np.stack([np.zeros_like(headings), np.zeros_like(headings), headings], axis=1)


def _margins(ground: Ground, robot, actions, trajectory: int, cell_size: float, turn: bool) -> TrajectoryMargins:
    path = poses(actions, trajectory)
    if turn:
        path = np.concatenate([turn_poses(actions, trajectory), path])
    for x, y, heading in path.tolist():
        _check_on_map(ground.heights, robot, x, y, heading, cell_size)

    step, obstacle, tilt = 0.0, -math.inf, 0.0
    for x, y, heading in path.tolist():
        state = pose_state(ground, robot, x, y, heading, cell_size)
        if not state.known:
            return UNKNOWN_MARGINS
        step = max(step, state.step)
        obstacle = max(obstacle, state.clearance)
        tilt = max(tilt, state.tilt)
    return TrajectoryMargins(step, obstacle, tilt, known=True)


def _reach(robot) -> tuple[float, float]:
    """Returns how far the overall outline and the tyres reach to the right and forward of the centre, in metres."""
    right = max(robot.overall_width, robot.track + robot.wheel_width) / 2.0
    return right, max(robot.overall_length, robot.wheelbase + robot.wheel_diameter) / 2.0


def _check_on_map(heights: np.ndarray, robot, x: float, y: float, heading: float, cell_size: float) -> None:
    rows, cols = heights.shape
    right, forward = _reach(robot)
    sin, cos = abs(math.sin(heading)), abs(math.cos(heading))
    reach = abs(x) + right * cos + forward * sin, abs(y) + right * sin + forward * cos
    half_size = cols // 2 * cell_size, rows // 2 * cell_size
    if reach[0] > half_size[0] + TIE or reach[1] > half_size[1] + TIE:
        raise ValueError(f"the robot reaches {reach} m in x, y, allowed on this map are {half_size} m")


# Poses


def ground_of(heights, robot, cell_size: float = 0.0625) -> Ground:
    """Returns what a robot drives on: heights [rows, cols] in metres, both odd, NaN is unknown ground."""
    heights, radius = np.asarray(heights, dtype=np.float64), robot.wheel_diameter / 2.0
    return Ground(heights, filled(heights, radius, cell_size), step_heights(heights, radius, cell_size))


def pose_state(ground: Ground, robot, x: float, y: float, heading: float, cell_size: float = 0.0625) -> PoseState:
    """Computes how the robot stands at one pose: its resting heights, pose plane, clearance and step (section 15).

    x, y in metres, heading in radians
    """
    heights = ground.heights
    radius, half_width, half_cell = robot.wheel_diameter / 2.0, robot.wheel_width / 2.0, cell_size / 2.0
    rows, cols, u, v = _nodes_around(heights.shape, math.hypot(*_reach(robot)) + cell_size, x, y, heading, cell_size)
    z, steps = heights[rows, cols], ground.steps[rows, cols]

    on_tyres, in_rectangles = [], np.zeros_like(z, dtype=bool)
    for right, forward in _wheels(robot):
        a, b = u - right, v - forward
        on_tyres.append((np.abs(a) <= half_width + half_cell + TIE) & (np.abs(b) <= radius + half_cell + TIE))
        in_rectangles |= (np.abs(a) <= half_width + TIE) & (np.abs(b) <= radius + TIE)
    in_length = np.abs(v) <= robot.overall_length / 2.0 + half_cell + TIE
    outline = in_length & (np.abs(u) <= robot.overall_width / 2.0 + half_cell + TIE) & ~in_rectangles
    under = [_bilinear(ground.filled, place, cell_size) for place in _wheel_centres(robot, x, y, heading)]
    touched = np.logical_or.reduce([outline, *on_tyres])
    if np.isnan(z[touched]).any() or np.isnan(under).any():
        return UNKNOWN_POSE

    resting, plane = under, _least_squares_plane(under, robot)
    for _ in range(2):
        resting = [
            _resting_height(z[tyre], u[tyre] - right, v[tyre] - forward, plane[1:], radius, half_cell)
            for tyre, (right, forward) in zip(on_tyres, _wheels(robot), strict=True)
        ]
        plane = _least_squares_plane(resting, robot)
    centre, roll_slope, pitch_slope = plane

    above_plane = z - (centre + roll_slope * u + pitch_slope * v)
    clearances = np.where(outline, above_plane - (_underside(robot, u, v) - robot.ride_height), -math.inf)
    reached = np.full_like(z, -math.inf)
    for tyre, (_, forward) in zip(on_tyres, _wheels(robot), strict=True):
        touches = tyre & (steps >= _drop(v - forward, radius, half_cell) - TIE)
        reached = np.where(touches, steps, reached)
    clearance, clearance_node = _largest(clearances, rows.start, cols.start)
    step, step_node = _largest(reached, rows.start, cols.start)
    return PoseState(
        np.array(resting), centre, roll_slope, pitch_slope, clearance, clearance_node, step, step_node, known=True
    )


def _nodes_around(shape, radius: float, x: float, y: float, heading: float, cell_size: float):
    """Returns slices of the rows and columns within `radius` of a place, and their nodes' u and v in metres."""
    rows, cols = window(y, radius, shape[0], cell_size), window(x, radius, shape[1], cell_size)
    east = (np.arange(cols.start, cols.stop) - shape[1] // 2) * cell_size - x
    north = ((np.arange(rows.start, rows.stop) - shape[0] // 2) * cell_size - y)[:, None]
    sin, cos = math.sin(heading), math.cos(heading)
    return rows, cols, east * cos + north * sin, north * cos - east * sin


def _wheels(robot) -> tuple[tuple[float, float], ...]:
    """Returns the wheel centres (right, forward) in metres, in the order FL, FR, RL, RR."""
    right, forward = robot.track / 2.0, robot.wheelbase / 2.0
    return (-right, forward), (right, forward), (-right, -forward), (right, -forward)


def _wheel_centres(robot, x: float, y: float, heading: float) -> list[tuple[float, float]]:
    """Returns the wheel centres (x, y) on the map in metres, in the order FL, FR, RL, RR."""
    sin, cos = math.sin(heading), math.cos(heading)
    return [(x + u * cos - v * sin, y + u * sin + v * cos) for u, v in _wheels(robot)]


def _bilinear(heights: np.ndarray, place: tuple[float, float], cell_size: float) -> float:
    """Returns the height at a place (x, y), bilinear between the four nodes around it; NaN if one is unknown."""
    rows, cols = heights.shape
    col, row = place[0] / cell_size + cols // 2, place[1] / cell_size + rows // 2
    west, south = min(math.floor(col + TIE), cols - 2), min(math.floor(row + TIE), rows - 2)
    east, north = col - west, row - south
    weights = np.outer([1.0 - north, north], [1.0 - east, east])
    return float((weights * heights[south : south + 2, west : west + 2]).sum())


def _least_squares_plane(wheel_heights, robot) -> tuple[float, float, float]:
    """Fits the least-squares plane to the wheels: centre height, roll slope (right), pitch slope (forward)."""
    design = np.column_stack([np.ones(4), np.array(_wheels(robot))])
    centre, roll_slope, pitch_slope = np.linalg.solve(design.T @ design, design.T @ np.asarray(wheel_heights))
    return float(centre), float(roll_slope), float(pitch_slope)


def _drop(b: np.ndarray, radius: float, half_cell: float) -> np.ndarray:
    """Returns how high the tyre's surface is above its lowest line at nodes `b` metres forward of its centre."""
    beside = np.clip(np.abs(b) - half_cell, 0.0, radius)
    return radius - np.sqrt(radius**2 - beside**2)


def _resting_height(z, a, b, slopes: tuple[float, float], radius: float, half_cell: float) -> float:
    """Returns the height of the pose plane under a wheel's centre when its tyre touches one of its nodes."""
    roll_slope, pitch_slope = slopes
    return float((z - pitch_slope * b - roll_slope * a - _drop(b, radius, half_cell)).max())


def _underside(robot, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Returns the height of the outline's underside above the pose plane at places (u, v) in metres."""
    overhang_height = getattr(robot, "overhang_height", None)
    nose_rise = getattr(robot, "nose_rise", 0.0)
    in_width = np.abs(u) <= robot.chassis_width / 2.0 + TIE
    in_chassis = in_width & (np.abs(v) <= robot.chassis_length / 2.0 + TIE)
    underside = np.where(
        in_chassis, robot.ride_height, robot.ride_height if overhang_height is None else overhang_height
    )
    if not nose_rise:
        return underside
    axle, end = robot.wheelbase / 2.0, robot.overall_length / 2.0
    return underside + nose_rise * np.clip((np.abs(v) - axle) / (end - axle), 0.0, 1.0)


def _largest(values: np.ndarray, first_row: int, first_col: int) -> tuple[float, tuple[int, int] | None]:
    """Returns the largest value and its node (row, col) on the map; no node where all are -inf."""
    row, col = np.unravel_index(np.argmax(values), values.shape)
    value = float(values[row, col])
    return value, None if value == -math.inf else (int(row) + first_row, int(col) + first_col)


# Steps of the map


def step_heights(heights, radius: float, cell_size: float = 0.0625) -> np.ndarray:
    """Computes the step S [rows, cols] in metres at each node, for tyres of `radius` metres; NaN at unknown nodes."""
    heights = filled(heights, radius, cell_size)
    steps = np.zeros_like(heights)
    for direction in DIRECTIONS:
        length = cell_size * math.hypot(*direction)
        most = max(2, _nodes_within(radius, length))
        z = {k: _shifted(heights, k * direction[0], k * direction[1]) for k in range(-2 * most, 2 * most + 1)}
        for first in range(-most, 0):
            for last in range(first + most + 1):
                n = last - first
                rise, before, after = z[last] - z[first], z[first] - z[first - n], z[last + n] - z[last]
                gentle = rise - np.fmax(np.fmax(before, after), 0.0)  # fmax and fmin leave out what is unknown
                steep = rise - np.fmax(np.fmin(before, after), n * length)
                parts = [z[k + 1] - z[k] for k in range(first, last)]
                belongs = np.all([parts[-first - 1] >= part - EVEN for part in parts], axis=0)
                if n > 1:
                    belongs &= rise > n * length
                steps = np.where(belongs, np.fmax(steps, np.fmax(gentle, steep)), steps)
    return np.where(np.isnan(heights), np.nan, steps)


def filled(heights, radius: float, cell_size: float = 0.0625) -> np.ndarray:
    """Fills gaps that tyres of `radius` metres bridge: [rows, cols] metres, NaN at unknown nodes."""
    heights = np.asarray(heights, dtype=np.float64)
    result = heights.copy()
    for direction in ((0, 1), (1, 0), (1, 1), (1, -1)):
        most = _nodes_within(radius, cell_size * math.hypot(*direction))

        def rim(nodes: int, sign: int, direction=direction) -> np.ndarray:
            """The rim `nodes` away on one side, as it goes on falling towards the middle."""
            at, beyond = (
                _shifted(heights, sign * k * direction[0], sign * k * direction[1]) for k in (nodes, nodes + 1)
            )
            return at + nodes * np.fmin(0.0, at - beyond)

        for i in range(1, most):
            for j in range(1, most - i + 1):
                result = np.fmax(result, np.minimum(rim(i, -1), rim(j, 1)))
    return np.where(np.isnan(heights), np.nan, result)


def _nodes_within(radius: float, length: float) -> int:
    return max(1, math.floor((radius + TIE) / length))


def _shifted(heights: np.ndarray, rows: int, cols: int) -> np.ndarray:
    """Returns at each node the height `rows` and `cols` nodes further; NaN where that is off the map."""
    reach = max(abs(rows), abs(cols))
    padded = np.pad(heights, reach, constant_values=np.nan)
    south, west = reach + rows, reach + cols
    return padded[south : south + heights.shape[0], west : west + heights.shape[1]]
