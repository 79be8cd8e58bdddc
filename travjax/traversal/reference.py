"""Sequential float64 traverse simulator: the oracle for the batched kernel and the baseline of the benchmarks.

It computes SPEC section 5 (static poses on a height map) for the action space of SPEC section 4 in the frames of
SPEC section 1, one trajectory and one pose at a time as the simulator of Visca et al. 2021 does.
It is plain NumPy and shares no code with the rest of the package; `robot` and `actions` are any objects with
the attributes of travjax.Robot and travjax.ActionSpace.

A tie must not depend on how sin and cos round: a wheel within 1e-9 cells below the middle between two nodes
takes the node on the +x or +y side, and a node within 1e-9 m outside the chassis rectangle lies under it.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

WHEEL_TIE = 1e-9  # cells
CHASSIS_TIE = 1e-9  # metres
ARC_END = 1e-9  # metres


@dataclass(frozen=True)
class TrajectoryMargins:
    """Margins of one trajectory: step, obstacle in metres, tilt in radians; NaN unless known (section 5)."""

    step: float
    obstacle: float
    tilt: float
    known: bool


@dataclass(frozen=True)
class Margins:
    """Margins of n trajectories: step, obstacle [n] metres, tilt [n] radians, all float64; known [n] bool."""

    step: np.ndarray
    obstacle: np.ndarray
    tilt: np.ndarray
    known: np.ndarray


UNKNOWN_MARGINS = TrajectoryMargins(step=math.nan, obstacle=math.nan, tilt=math.nan, known=False)


def poses(actions, trajectory: int) -> np.ndarray:
    """Computes the poses of one trajectory: [57, 3] with x, y in metres and the heading in radians (section 4).

    Raises ValueError for a trajectory index that the action space does not have.
    """
    radii = len(actions.radii)
    if not 0 <= trajectory < actions.turns * radii**2:
        raise ValueError(f"trajectory is {trajectory}, allowed are 0 to {actions.turns * radii**2 - 1}")
    turn, arcs = divmod(trajectory, radii**2)
    first, second = divmod(arcs, radii)
    first_length, second_length = actions.arc_lengths

    start = np.array([0.0, 0.0, 2.0 * math.pi * turn / actions.turns])
    junction = _along_arc(start, actions.radii[first], np.array([first_length]))[0]
    first_arc = _along_arc(start, actions.radii[first], _distances(first_length, actions.interval))
    second_distances = np.append(_distances(second_length, actions.interval), second_length)
    second_arc = _along_arc(junction, actions.radii[second], second_distances)
    return np.concatenate([first_arc, second_arc])


def _distances(length: float, interval: float) -> np.ndarray:
    """Returns the distances of the poses along an arc without its end: multiples of the interval below the length."""
    multiples = interval * np.arange(math.ceil(length / interval) + 1)
    return multiples[multiples < length - ARC_END]


def _along_arc(start: np.ndarray, radius: float, distances: np.ndarray) -> np.ndarray:
    """Computes poses [n, 3] at `distances` [n] along an arc of signed radius (+ left, inf straight) from `start`."""
    x, y, heading = start
    if math.isinf(radius):
        forward, left, turned = distances, np.zeros_like(distances), np.zeros_like(distances)
    else:
        turned = distances / radius
        forward, left = radius * np.sin(turned), radius * (1.0 - np.cos(turned))
    sin, cos = math.sin(heading), math.cos(heading)
    east = x - forward * sin - left * cos
    north = y + forward * cos - left * sin
    return np.stack([east, north, heading + turned], axis=1)


def simulate_trajectory(heights, robot, actions, trajectory: int, cell_size: float = 0.0625) -> TrajectoryMargins:
    """Simulates one trajectory on one map and returns its margins (section 5).

    heights: [rows, cols] metres, both odd, the centre node at x = y = 0; NaN is unknown ground.

    Raises ValueError if the map has no centre node, or if the circle around wheels and chassis leaves the map.
    """
    heights = above_centre(heights)
    path = poses(actions, trajectory)
    _check_on_map(heights, robot, path, cell_size)

    step, obstacle, tilt = 0.0, -math.inf, 0.0
    previous = None
    for x, y, heading in path.tolist():
        state = pose_state(heights, robot, x, y, heading, cell_size)
        if not state.known:
            return UNKNOWN_MARGINS
        if previous is not None:
            step = max(step, *(abs(now - before) for now, before in zip(state.contacts, previous, strict=True)))
        obstacle = max(obstacle, state.clearance)
        tilt = max(tilt, state.tilt)
        previous = state.contacts
    return TrajectoryMargins(step, obstacle, tilt, known=True)


@dataclass(frozen=True)
class PoseState:
    """How the robot stands at one pose: lengths in metres; numbers are NaN unless known (section 5).

    contacts: heights of the nodes under the wheels FL, FR, RL, RR; nodes: (row, col) of each
    centre, roll_slope, pitch_slope: the pose plane: its height at the robot's centre, its slopes right and forward
    clearance: the highest node under the chassis above the pose plane; clearance_node: (row, col) of it
    """

    contacts: list[float]
    nodes: list[tuple[int, int]]
    centre: float
    roll_slope: float
    pitch_slope: float
    clearance: float
    clearance_node: tuple[int, int]
    known: bool

    @property
    def tilt(self) -> float:
        """The angle between the pose plane and the horizontal in radians."""
        return math.atan(math.hypot(self.roll_slope, self.pitch_slope))


def pose_state(heights: np.ndarray, robot, x: float, y: float, heading: float, cell_size: float = 0.0625) -> PoseState:
    """Computes how the robot stands at one pose (section 5); heights as of `above_centre`."""
    nodes = _wheel_nodes(heights, robot, x, y, heading, cell_size)
    contacts = [heights.item(*node) for node in nodes]
    plane = _pose_plane(contacts, robot)
    clearance, highest = _highest_above_plane(heights, robot, plane, x, y, heading, cell_size)
    known = not (math.isnan(sum(contacts)) or math.isnan(clearance))
    return PoseState(contacts, nodes, *plane, clearance, highest, known)


def above_centre(heights) -> np.ndarray:
    """Returns float64 heights [rows, cols] relative to the centre node, or to some known node if the centre is unknown.

    Raises ValueError if the map has no centre node.
    """
    heights = np.asarray(heights, dtype=np.float64)
    if heights.ndim != 2 or heights.shape[0] % 2 == 0 or heights.shape[1] % 2 == 0:
        raise ValueError(f"heights has shape {heights.shape}, allowed is [rows, cols], both odd")
    datum = heights[heights.shape[0] // 2, heights.shape[1] // 2]
    if np.isnan(datum):
        known = heights[~np.isnan(heights)]
        datum = known[0] if known.size else 0.0
    return heights - datum


def _circumradius(robot) -> float:
    """Returns the radius of the circle around the robot's centre that contains the wheel centres and the chassis."""
    wheels = math.hypot(robot.track, robot.wheelbase)
    return max(wheels, math.hypot(robot.chassis_width, robot.chassis_length)) / 2.0


def _check_on_map(heights: np.ndarray, robot, path: np.ndarray, cell_size: float) -> None:
    rows, cols = heights.shape
    half_size = np.array([cols // 2, rows // 2]) * cell_size
    reach = np.abs(path[:, :2]).max(axis=0) + _circumradius(robot)
    if np.any(reach > half_size + CHASSIS_TIE):
        raise ValueError(f"the robot reaches {reach} m in x, y, allowed on this map are {half_size} m")


def _wheel_nodes(heights, robot, x: float, y: float, heading: float, cell_size: float) -> list[tuple[int, int]]:
    """Returns (row, col) of the nodes nearest to the wheel centres, in the order FL, FR, RL, RR."""
    sin, cos = math.sin(heading), math.cos(heading)
    rows, cols = heights.shape
    right, forward = robot.track / 2.0, robot.wheelbase / 2.0
    nodes = []
    for u, v in ((-right, forward), (right, forward), (-right, -forward), (right, -forward)):
        col = (x + u * cos - v * sin) / cell_size + cols // 2
        row = (y + u * sin + v * cos) / cell_size + rows // 2
        nodes.append((_nearest(row), _nearest(col)))
    return nodes


def _nearest(coordinate: float) -> int:
    return math.floor(coordinate + 0.5 + WHEEL_TIE)


def _pose_plane(contacts: list[float], robot) -> tuple[float, float, float]:
    """Fits the least-squares plane to the contacts: centre height, roll slope (right), pitch slope (forward)."""
    front_left, front_right, rear_left, rear_right = contacts
    centre = (front_left + front_right + rear_left + rear_right) / 4.0
    roll_slope = ((front_right + rear_right) - (front_left + rear_left)) / (2.0 * robot.track)
    pitch_slope = ((front_left + front_right) - (rear_left + rear_right)) / (2.0 * robot.wheelbase)
    return centre, roll_slope, pitch_slope


def _highest_above_plane(heights, robot, plane, x: float, y: float, heading: float, cell_size: float):
    """Returns the largest height of a node under the chassis above the pose plane, NaN if one of them is unknown, and
    (row, col) of that node.
    """
    sin, cos = math.sin(heading), math.cos(heading)
    radius = _circumradius(robot)
    rows = window(y, radius, heights.shape[0], cell_size)
    cols = window(x, radius, heights.shape[1], cell_size)
    east = (np.arange(cols.start, cols.stop) - heights.shape[1] // 2) * cell_size - x
    north = ((np.arange(rows.start, rows.stop) - heights.shape[0] // 2) * cell_size - y)[:, None]
    u = east * cos + north * sin
    v = north * cos - east * sin
    within_width = np.abs(u) <= robot.chassis_width / 2.0 + CHASSIS_TIE
    within_length = np.abs(v) <= robot.chassis_length / 2.0 + CHASSIS_TIE
    centre, roll_slope, pitch_slope = plane
    above_plane = heights[rows, cols] - (centre + roll_slope * u + pitch_slope * v)
    under = np.where(within_width & within_length, above_plane, -math.inf)
    row, col = np.unravel_index(under.argmax(), under.shape)  # the first NaN, if there is one
    return float(under[row, col]), (int(row) + rows.start, int(col) + cols.start)


def window(position: float, radius: float, nodes: int, cell_size: float) -> slice:
    """Returns the nodes of one axis within `radius` of `position`, and one more on either side against rounding."""
    first = math.ceil((position - radius) / cell_size) + nodes // 2 - 1
    last = math.floor((position + radius) / cell_size) + nodes // 2 + 1
    return slice(max(first, 0), min(last, nodes - 1) + 1)


def simulate(
    heights,
    robot,
    actions,
    trajectories: Iterable[int] | None = None,
    cell_size: float = 0.0625,
    on_progress: Callable[[int], object] | None = None,
) -> Margins:
    """Simulates trajectories (all unless given) one after the other on one map, and returns their margins (section 5).

    heights: [rows, cols] metres; `on_progress` is called after each trajectory with the number done so far.

    Raises ValueError as simulate_trajectory does.
    """
    if trajectories is None:
        trajectories = range(actions.turns * len(actions.radii) ** 2)
    results = []
    for trajectory in trajectories:
        results.append(simulate_trajectory(heights, robot, actions, int(trajectory), cell_size))
        if on_progress is not None:
            on_progress(len(results))
    return collected(results)


def collected(results: list[TrajectoryMargins]) -> Margins:
    """Puts the margins of single trajectories into arrays."""
    return Margins(
        step=np.array([result.step for result in results], dtype=np.float64),
        obstacle=np.array([result.obstacle for result in results], dtype=np.float64),
        tilt=np.array([result.tilt for result in results], dtype=np.float64),
        known=np.array([result.known for result in results], dtype=bool),
    )


def label(margins: Margins, robot) -> np.ndarray:
    """Returns failures [n, 3] bool in the order (step, obstacle, tilt), False where unknown (section 5)."""
    failed = np.stack(
        [
            margins.step > robot.max_step,
            margins.obstacle > robot.ride_height,
            margins.tilt > robot.max_tilt,
        ],
        axis=-1,
    )
    return failed & margins.known[..., None]
