"""Which grid nodes the robot touches at every simulated pose: the static tables behind the traverse kernel.

Poses of the action space -> the node under each wheel and the nodes under the chassis, as NumPy arrays that depend on
robot geometry, action space and grid only (SPEC sections 4 and 5). Everything is computed in float64.

An even number of point turns maps the action space onto itself when the map is turned by 180 degrees, and a set of radii
that comes in +- pairs does so when the map is mirrored. Tables are then needed for one arc of each orbit only, and the
kernel simulates it on the map and on its turned and mirrored images side by side (the "views" below).
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from travjax.actions import ActionSpace
from travjax.config import InputError, require
from travjax.grid import Grid
from travjax.robot import Robot

TIE = 1e-9
"""Slack (cells for wheels, metres for the chassis) so that ties do not hang on the rounding of sin and cos."""

RUN = 4
"""Nodes side by side in one row that the kernel may read at once."""


@dataclass(frozen=True)
class View:
    """The map as it is, turned by 180 degrees, mirrored left to right, or both (turned first)."""

    turned: bool = False
    mirrored: bool = False

    @property
    def flipped(self) -> tuple[int, ...]:
        """Axes of [row, col] that run the other way in this view."""
        return (0,) * self.turned + (1,) * (self.turned != self.mirrored)

    def arc(self, turn, first, actions: ActionSpace):
        """The (turn, first radius) of the map as it is that look like (turn, first) in this view."""
        if self.mirrored:
            turn, first = -turn, _opposite(actions)[first]
        if self.turned:
            turn = turn + actions.turns // 2
        return turn % actions.turns, first

    def second(self, second, actions: ActionSpace):
        """The second radius of the map as it is that looks like `second` in this view."""
        return _opposite(actions)[second] if self.mirrored else second


@dataclass(frozen=True)
class Layout:
    """How the results of a NodeTable are arranged; static to `jit`."""

    grid: Grid
    views: tuple[View, ...]
    poses: int
    """P, simulated poses of a first arc and all its second arcs."""
    first_poses: int
    """S1, simulated poses of the first arc itself, the junction included."""
    second_arcs: int
    """R, second arcs after each first one."""


@dataclass(frozen=True)
class NodeTable:
    """Nodes and pose constants of F first arcs, each with its own S1 poses and the R S2 poses of its second arcs.

    P = S1 + R S2 poses of a first arc: its own, then second arc by second arc; V views; node = row * cols + col.

    wheels:  [F, P, 4, V] int32 node under the wheels FL, FR, RL, RR, in the map as it is
    centre:  [F, P] int32 node nearest to the robot's centre, in the view
    offset:  [F, P, 2] float32 centre minus that node, (x, y) in cells
    axes:    [F, P, 2] float32 cos and sin of the heading
    runs:    [F, P, 2, K] int8 or int16 (row, col) from `centre` to the first of RUN neighbouring chassis nodes
    singles: [F, P, 2, M] the same for chassis nodes one by one: those that are in no run
    every:   [F, P, 2, N] the same for all chassis nodes one by one
             (unused places repeat another one of the same pose)
    source:  [T] int32 position of every trajectory in results flattened from [F, R, V]
    """

    wheels: np.ndarray
    centre: np.ndarray
    offset: np.ndarray
    axes: np.ndarray
    runs: np.ndarray
    singles: np.ndarray
    every: np.ndarray
    source: np.ndarray
    layout: Layout


@lru_cache(maxsize=8)
def node_table(robot: Robot, actions: ActionSpace, grid: Grid) -> NodeTable:
    """Builds the table (0.4 s for the defaults, so it is not kept on disk).

    Raises InputError when a radius turns inside the robot or a trajectory leaves the map.
    """
    inside = f"at least half the track of {robot.name}, {robot.track / 2:g} m: a smaller one turns inside the robot"
    for radius in actions.radii:
        require(abs(radius) >= robot.track / 2, "radii", radius, inside)
    views = _views(actions)
    turn, first = _first_arcs(actions, views)
    poses = _poses(actions, turn, first, np.arange(len(actions.radii)))
    flat = poses.reshape(-1, 3)
    row, start, count = _chassis_rows(flat, robot, grid)
    centre = np.floor(flat[:, 1::-1] / grid.spacing + grid.cells / 2 + 0.5).astype(np.int32)
    row, start = row - centre[:, :1], start - centre[:, 1:]
    by_arc = lambda array: np.ascontiguousarray(array).reshape(*poses.shape[:2], *array.shape[1:])
    return NodeTable(
        wheels=_wheel_nodes(actions, views, turn, first, robot, grid),
        centre=by_arc(centre[:, 0] * grid.nodes + centre[:, 1]),
        offset=by_arc((flat[:, :2] / grid.spacing + grid.cells / 2 - centre[:, ::-1]).astype(np.float32)),
        axes=by_arc(np.stack([np.cos(flat[:, 2]), np.sin(flat[:, 2])], axis=-1).astype(np.float32)),
        runs=by_arc(_places(row, start, np.where(count >= RUN, count, 0), RUN)),
        singles=by_arc(_places(row, start, np.where(count < RUN, count, 0), 1)),
        every=by_arc(_places(row, start, count, 1)),
        source=_source(actions, views, turn, first),
        layout=Layout(grid, views, poses.shape[1], len(actions.first_stations()), len(actions.radii)),
    )


def _poses(actions: ActionSpace, turn: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Poses of first arcs [F] and of all their second arcs [R]: [F, S1 + R S2, 3]."""
    own = actions.first_poses(turn, first)
    following = actions.second_poses(turn[:, None], first[:, None], second)
    return np.concatenate([own, following.reshape(len(turn), -1, 3)], axis=1)


def _opposite(actions: ActionSpace) -> np.ndarray:
    """Position in `radii` of each radius with the other sign."""
    radii = list(actions.radii)
    return np.array([i if math.isinf(r) else radii.index(-r) for i, r in enumerate(radii)])


def _views(actions: ActionSpace) -> tuple[View, ...]:
    turned = (False, True) if actions.turns % 2 == 0 else (False,)
    paired = all(math.isinf(radius) or -radius in actions.radii for radius in actions.radii)
    return tuple(View(t, m) for m in ((False, True) if paired else (False,)) for t in turned)


def _first_arcs(actions: ActionSpace, views: tuple[View, ...]) -> tuple[np.ndarray, np.ndarray]:
    """One (turn, first radius) of each orbit under the views: [F] each."""
    seen, chosen = set(), []
    for arc in np.ndindex(actions.turns, len(actions.radii)):
        if arc not in seen:
            chosen.append(arc)
            seen.update((int(t), int(f)) for t, f in (view.arc(*arc, actions) for view in views))
    turn, first = np.array(chosen).T
    return turn, first


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
    """Nodes nearest to the wheels, [F, P, 4, V]; true poses view by view, since ties go to +x, +y of the true map."""
    right, forward = np.array(robot.wheel_positions()).T
    nodes = []
    for view in views:
        poses = _poses(actions, *view.arc(turn, first, actions), view.second(np.arange(len(actions.radii)), actions))
        x, y, heading = (poses[..., axis, None] for axis in range(3))
        sin, cos, aside = np.sin(heading), np.cos(heading), -right if view.mirrored else right
        col = _nearest(x + cos * aside - sin * forward, grid)
        row = _nearest(y + sin * aside + cos * forward, grid)
        _check_inside(row, col, grid)
        nodes.append(row * grid.nodes + col)
    return np.stack(nodes, axis=-1).astype(np.int32)


def _nearest(coordinate: np.ndarray, grid: Grid) -> np.ndarray:
    return np.floor(coordinate / grid.spacing + grid.cells / 2 + 0.5 + TIE).astype(int)


def _chassis_rows(poses: np.ndarray, robot: Robot, grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The chassis nodes of each pose, row by row: row [P, rows], first column and number of columns [P, rows]."""
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
    _check_inside(row[count > 0], np.concatenate([start[count > 0], stop[count > 0]]), grid)
    return row, start, count


def _interval(factor: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends of {dx: low <= factor * dx <= high}; low < high. Far away stands for infinite."""
    factor = np.where(np.abs(factor) < 1e-12, 1e-12, factor)
    a, b = np.clip(low / factor, -1e6, 1e6), np.clip(high / factor, -1e6, 1e6)
    return np.minimum(a, b), np.maximum(a, b)


def _check_inside(row: np.ndarray, col: np.ndarray, grid: Grid) -> None:
    outside = max(-row.min(), -col.min(), row.max() - grid.cells, col.max() - grid.cells)
    if outside > 0:
        raise InputError(
            f"actions: trajectories leave the {grid.size:g} m map by {outside * grid.spacing:g} m; "
            "allowed: arcs short enough for wheels and chassis to stay on it"
        )


def _places(row: np.ndarray, start: np.ndarray, count: np.ndarray, run: int) -> np.ndarray:
    """Covers the column intervals [start, start + count) of every pose by places of `run` neighbouring nodes.

    row, start, count: [P, rows] with count 0 or at least run. Returns [P, 2, K] (row, col) of each place's first node.
    The last place of an interval may overlap the one before; unused places repeat the pose's first one.
    """
    places = -(-count // run)
    used = places.sum(axis=1)
    table = np.zeros((len(row), 2, used.max()), int)
    if used.max():
        pose, line = np.nonzero(places)
        repeats = places[pose, line]
        step = _counting(repeats)
        pose, line = np.repeat(pose, repeats), np.repeat(line, repeats)
        col = start[pose, line] + np.minimum(step * run, count[pose, line] - run)
        table[pose, :, _counting(used)] = np.stack([row[pose, line], col], axis=-1)
        table = np.where(np.arange(used.max()) < used[:, None, None], table, table[:, :, :1])
    return table.astype(np.int8 if np.abs(table).max(initial=0) < 128 else np.int16)


def _counting(lengths: np.ndarray) -> np.ndarray:
    """0, 1, ... for each length in turn: [2, 3] gives 0 1 0 1 2."""
    return np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
