"""Which grid nodes the robot touches at every simulated pose: the static tables behind the traverse kernel.

Poses of the action space -> the node under each wheel and the nodes under the chassis, as NumPy arrays that depend only
on robot geometry, action space and grid (SPEC sections 4 and 5). Everything is computed in float64.

With an even number of point turns the action space is symmetric under a rotation of the map by 180 degrees, and with
radii in +- pairs under mirroring. Tables then need only one arc of each set of symmetric arcs (an orbit), and the
kernel simulates it on the map and on its rotated and mirrored images side by side (the "views" below).

Dimensions of arrays, here, in tyre_tables.py and in the package traversal:

    T   trajectories of the action space
    F   first arcs of a table, one of each orbit
    R   second arcs after each first one, as many as there are radii
    S1  simulated poses of a first arc, the junction included
    S2  simulated poses of a second arc after the junction
    P   poses of a first arc and all its second arcs, S1 + R S2: its own, then second arc by second arc
    V   views of the map
    K   runs of neighbouring chassis nodes that cover a pose, M single chassis nodes beside them
    C   chunks of a table, which the kernel simulates one after the other
    A   first arcs of a chunk
    E   failure events of the robot
    n   maps; "lanes" are the V n views of all maps, side by side
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np

from travjax.config import InputError, require
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot

TIE = 1e-9
"""Slack (cells for wheels, metres for the chassis) so that ties do not depend on the rounding of sin and cos."""

RUN = 4
"""Nodes side by side in one row that the kernel may read at once."""


@dataclass(frozen=True)
class View:
    """The original map, or the map rotated by 180 degrees, mirrored left to right, or both (rotated first)."""

    turned: bool = False
    mirrored: bool = False

    @property
    def flipped(self) -> tuple[int, ...]:
        """The axes of [row, col] that are reversed in this view."""
        return ((0,) if self.turned else ()) + ((1,) if self.turned != self.mirrored else ())

    def arc(self, turn, first, actions: ActionSpace):
        """Returns the (turn, first radius) on the original map that (turn, first) in this view corresponds to."""
        if self.mirrored:
            turn, first = -turn, _opposite(actions)[first]
        if self.turned:
            turn = turn + actions.turns // 2
        return turn % actions.turns, first

    def second(self, second, actions: ActionSpace):
        """Returns the second radius on the original map that `second` in this view corresponds to."""
        return _opposite(actions)[second] if self.mirrored else second

    def trajectories(self, actions: ActionSpace) -> np.ndarray:
        """Returns the trajectory on the original map that each one in this view corresponds to: [t] indices."""
        turn, first, second = actions.split(np.arange(len(actions)))
        turn, first = self.arc(turn, first, actions)
        return actions.index(turn, first, self.second(second, actions))


@dataclass(frozen=True)
class Layout:
    """How the results of a NodeTable are arranged; static to `jit`."""

    grid: Grid
    views: tuple[View, ...]
    poses: int  # P
    first_poses: int  # S1
    second_arcs: int  # R


@dataclass(frozen=True)
class NodeTable:
    """Nodes and pose constants of first arcs and their second arcs; node = row * cols + col.

    poses:   [F, P, 3] x, y in metres and heading in radians, in the view
    wheels:  [F, P, 4, V] int32 node under the wheels FL, FR, RL, RR, on the original map
    centre:  [F, P] int32 node nearest to the robot's centre, in the view
    offset:  [F, P, 2] float32 vector from that node to the robot's centre, (x, y) in cells
    axes:    [F, P, 2] float32 cos and sin of the heading
    chassis: [F, P, 3, rows] int16 (row, first column, number of columns) of the nodes under the chassis, row by row,
             rows and columns counted from `centre`
    source:  [T] int32 index of every trajectory in the flattened results [F, R, V]
    """

    poses: np.ndarray
    wheels: np.ndarray
    centre: np.ndarray
    offset: np.ndarray
    axes: np.ndarray
    chassis: np.ndarray
    source: np.ndarray
    layout: Layout

    def __post_init__(self):
        for array in vars(self).values():
            if isinstance(array, np.ndarray):
                array.setflags(write=False)


@lru_cache(maxsize=8)
def node_table(robot: Robot, actions: ActionSpace, grid: Grid) -> NodeTable:
    """Builds the table of a robot, action space and grid (0.1 s for the defaults, so it is not kept on disk).

    Raises InputError when a radius turns inside the robot or a trajectory leaves the map.
    """
    inside = f"at least half the track of {robot.name}, {robot.track / 2:g} m: a smaller one turns inside the robot"
    for radius in actions.radii:
        require(abs(radius) >= robot.track / 2, "radii", radius, inside)
    views = views_of(actions)
    turn, first = _first_arcs(actions, views)
    poses = _poses(actions, turn, first, np.arange(len(actions.radii)))
    return _table(
        poses,
        _chassis_rows(poses.reshape(-1, 3), robot, grid, f"arc_lengths = {actions.arc_lengths}"),
        _wheel_nodes(actions, views, turn, first, robot, grid),
        _source(actions, views, turn, first),
        Layout(grid, views, poses.shape[1], len(actions.first_stations()), len(actions.radii)),
    )


def pose_table(poses: np.ndarray, robot: Robot, grid: Grid) -> NodeTable:
    """Builds the table of paths that are given by their poses, [F, P, 3], without second arcs and further views.

    Raises InputError when one of them leaves the map.
    """
    right, forward = np.array(robot.wheel_positions()).T
    rows = _chassis_rows(poses.reshape(-1, 3), robot, grid, "poses")
    wheels = _nodes_under(poses, right, forward, grid, "poses")[..., None]
    layout = Layout(grid, (View(),), poses.shape[1], poses.shape[1], 0)
    return _table(poses, rows, wheels, np.arange(len(poses)), layout)


def _table(poses: np.ndarray, rows: tuple[np.ndarray, ...], wheels, source: np.ndarray, layout: Layout) -> NodeTable:
    """Completes a NodeTable; rows: of `_chassis_rows`."""
    grid, flat = layout.grid, poses.reshape(-1, 3)
    row, start, count = rows
    centre = np.floor(flat[:, 1::-1] / grid.spacing + grid.cells / 2 + 0.5).astype(np.int32)
    chassis = np.stack([row - centre[:, :1], start - centre[:, 1:], count], axis=1).astype(np.int16)
    by_arc = lambda array: np.ascontiguousarray(array).reshape(*poses.shape[:2], *array.shape[1:])
    return NodeTable(
        poses=poses,
        wheels=wheels.astype(np.int32),
        centre=by_arc(centre[:, 0] * grid.nodes + centre[:, 1]),
        offset=by_arc((flat[:, :2] / grid.spacing + grid.cells / 2 - centre[:, ::-1]).astype(np.float32)),
        axes=by_arc(np.stack([np.cos(flat[:, 2]), np.sin(flat[:, 2])], axis=-1).astype(np.float32)),
        chassis=by_arc(chassis),
        source=source,
        layout=layout,
    )


def _poses(actions: ActionSpace, turn: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Computes the poses of first arcs [F] and of all their second arcs [R]: [F, S1 + R S2, 3]."""
    own = actions.first_poses(turn, first)
    following = actions.second_poses(turn[:, None], first[:, None], second)
    return np.concatenate([own, following.reshape(len(turn), -1, 3)], axis=1)


def _opposite(actions: ActionSpace) -> np.ndarray:
    """Returns, for each radius, the position in `radii` of the radius with the opposite sign."""
    radii = list(actions.radii)
    return np.array([i if math.isinf(r) else radii.index(-r) for i, r in enumerate(radii)])


def views_of(actions: ActionSpace) -> tuple[View, ...]:
    """Returns the views under which an action space is symmetric; the original map comes first."""
    turned = (False, True) if actions.turns % 2 == 0 else (False,)
    paired = all(math.isinf(radius) or -radius in actions.radii for radius in actions.radii)
    return tuple(View(t, m) for m in ((False, True) if paired else (False,)) for t in turned)


def _first_arcs(actions: ActionSpace, views: tuple[View, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Picks one (turn, first radius) of each orbit under the views: [F] each."""
    seen: set[tuple[int, int]] = set()
    chosen = []
    for turn, first in product(range(actions.turns), range(len(actions.radii))):
        if (turn, first) not in seen:
            chosen.append((turn, first))
            seen.update((int(t), int(f)) for t, f in (view.arc(turn, first, actions) for view in views))
    turns, firsts = np.array(chosen).T
    return turns, firsts


def _source(actions: ActionSpace, views: tuple[View, ...], turn: np.ndarray, first: np.ndarray) -> np.ndarray:
    radii = len(actions.radii)
    source = np.full(len(actions), -1, np.int32)
    arc, second = np.arange(len(turn))[:, None], np.arange(radii)
    for v, view in enumerate(views):
        true_turn, true_first = view.arc(turn, first, actions)
        index = actions.index(true_turn[:, None], true_first[:, None], view.second(second, actions))
        source[index] = (arc * radii + second) * len(views) + v
    return source


def _wheel_nodes(actions, views, turn, first, robot: Robot, grid: Grid) -> np.ndarray:
    """Finds the nodes nearest to the wheels, [F, P, 4, V], view by view: ties go to +x, +y of the original map."""
    right, forward = np.array(robot.wheel_positions()).T
    nodes = []
    for view in views:
        true_turn, true_first = view.arc(turn, first, actions)
        poses = _poses(actions, true_turn, true_first, view.second(np.arange(len(actions.radii)), actions))
        aside = -right if view.mirrored else right
        nodes.append(_nodes_under(poses, aside, forward, grid, f"arc_lengths = {actions.arc_lengths}"))
    return np.stack(nodes, axis=-1)


def _nodes_under(poses: np.ndarray, right: np.ndarray, forward: np.ndarray, grid: Grid, what: str) -> np.ndarray:
    """Finds the nodes nearest to places of the robot (right, forward) [4] at poses [..., 3]: [..., 4]."""
    x, y, heading = (poses[..., axis, None] for axis in range(3))
    sin, cos = np.sin(heading), np.cos(heading)
    col = nearest(x + cos * right - sin * forward, grid)
    row = nearest(y + sin * right + cos * forward, grid)
    _check_inside(row, col, grid, what)
    return row * grid.nodes + col


def nearest(coordinate: np.ndarray, grid: Grid) -> np.ndarray:
    """Returns the row or column of the node nearest to a y or x [m], even one off the map; ties go to +y, +x."""
    return np.floor(coordinate / grid.spacing + grid.cells / 2 + 0.5 + TIE).astype(int)


def _chassis_rows(poses: np.ndarray, robot: Robot, grid: Grid, what: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the chassis nodes of each pose row by row: row, first column and number of columns, [P, rows] each."""
    width, length = robot.chassis_width / 2 + TIE, robot.chassis_length / 2 + TIE
    reach = math.ceil(math.hypot(width, length) / grid.spacing)
    x, y, heading = (poses[:, axis, None] for axis in range(3))
    row = np.floor(y / grid.spacing + grid.cells / 2).astype(int) + np.arange(-reach, reach + 2)
    dy = (row - grid.cells / 2) * grid.spacing - y
    sin, cos = np.sin(heading), np.cos(heading)
    # |dx cos + dy sin| <= width and |dy cos - dx sin| <= length, each an interval of dx
    low_u, high_u = _interval(cos, -width - dy * sin, width - dy * sin)
    low_v, high_v = _interval(-sin, -length - dy * cos, length - dy * cos)
    start = np.ceil((x + np.maximum(low_u, low_v)) / grid.spacing + grid.cells / 2).astype(int)
    stop = np.floor((x + np.minimum(high_u, high_v)) / grid.spacing + grid.cells / 2).astype(int)
    count = np.maximum(stop - start + 1, 0)
    bare = ~count.any(axis=1)
    if bare.any():
        raise InputError(
            f"spacing = {grid.spacing:g}: too coarse for {robot.name}, no node under its chassis at "
            f"{bare.sum()} poses; allowed: up to {min(robot.chassis_width, robot.chassis_length) / math.sqrt(2):.3g} m"
        )
    _check_inside(row[count > 0], np.concatenate([start[count > 0], stop[count > 0]]), grid, what)
    return row, start, count


def _interval(factor: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ends of {dx: low <= factor * dx <= high} for low < high; 1e6 stands for infinity."""
    factor = np.where(np.abs(factor) < 1e-12, 1e-12, factor)
    a, b = np.clip(low / factor, -1e6, 1e6), np.clip(high / factor, -1e6, 1e6)
    return np.minimum(a, b), np.maximum(a, b)


def _check_inside(row: np.ndarray, col: np.ndarray, grid: Grid, what: str) -> None:
    outside = max(-row.min(), -col.min(), row.max() - grid.cells, col.max() - grid.cells)
    if outside > 0:
        raise InputError(
            f"{what}: trajectories leave the {grid.size:g} m map by {outside * grid.spacing:g} m; "
            "allowed: arcs short enough for wheels and chassis to stay on it, or a larger map (--size)"
        )


def chassis_places(chassis: np.ndarray, run: int) -> tuple[np.ndarray, np.ndarray]:
    """Covers the chassis nodes of every pose with runs of `run` neighbours in a row, and with single nodes elsewhere.

    chassis: [F, P, 3, rows] as in NodeTable. Returns (runs [F, P, 2, K], singles [F, P, 2, M]): the (row, column) of
    the first node of each run and of each single node. Runs in a row may overlap, and entries that a pose does not need
    repeat another of its own. All nodes are single (K = 0) when `run` is 1 or some pose has no row that wide.
    """
    flat = chassis.reshape(-1, 3, chassis.shape[-1])
    row, start, count = flat.transpose(1, 0, 2)
    fits = np.asarray(count >= run)
    fits &= run > 1 and fits.any(axis=1).all()
    runs, singles = _places(row, start, np.where(fits, count, 0), run), _places(row, start, np.where(fits, 0, count), 1)
    anywhere = np.take_along_axis(flat[:, :2], np.argmax(count > 0, axis=1)[:, None, None], axis=2)
    narrow: np.ndarray = np.any(np.where(fits, 0, count), axis=1, keepdims=True)
    singles = np.where(narrow[..., None], singles, anywhere.astype(singles.dtype))
    return runs.reshape(*chassis.shape[:2], 2, -1), singles.reshape(*chassis.shape[:2], 2, -1)


def _places(row: np.ndarray, start: np.ndarray, count: np.ndarray, run: int) -> np.ndarray:
    """Covers [start, start + count) in each row with runs of `run` columns: [P, rows] arrays give [P, 2, K]."""
    places = -(-count // run)
    used = places.sum(axis=1)
    table = np.zeros((2, len(row), used.max()), np.int16)
    pose, line = np.nonzero(places)
    repeats = places[pose, line]
    within = np.minimum(_counting(repeats) * run, np.repeat(count[pose, line] - run, repeats))
    slot = np.repeat(pose, repeats), _counting(used)
    table[0][slot] = np.repeat(row[pose, line], repeats)
    table[1][slot] = np.repeat(start[pose, line], repeats) + within
    if used.max():
        table = np.where(np.arange(used.max()) < used[:, None], table, table[:, :, :1])
    small = np.abs(table).max(initial=0) < 128
    return table.astype(np.int8 if small else np.int16).transpose(1, 0, 2)


def _counting(lengths: np.ndarray) -> np.ndarray:
    """Counts from 0 for each length in turn: [2, 3] gives 0 1 0 1 2."""
    return np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
