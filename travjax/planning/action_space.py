"""The authors' way to plan, as a baseline: A* over the trajectories of an action space, 3042 from each state.

A state is any pose, on no lattice. All trajectories from it are labelled at once on a window of ground around it; those
that fail are dropped, and the ends of the others are new states. A cell of position and heading is gone on from once.
It finds a path, seldom the cheapest, and may miss one.

Headings: the turn of a trajectory ends in one of the action space's headings, counted from north and not from where the
robot faces. So windows need no rotation, and the robot can face the same ways from everywhere.
Positions: a window is centred on the node nearest to the state, so its heights are those of the site, and the
trajectories are displaced by half a node at most. Resampling the ground at the state's position would keep them in
place but flatten what is narrow: with the contact model `tyre`, on a Mars yard, steps came out 3 mm lower on average
and by the nearest node the same; with `nearest` neither way was clearly closer.
The sequential simulators therefore decide, on the site's own nodes: a trajectory is simulated by them, with the point
turn before it, when the search would go on from its end. Where it fails, the search goes on without it.

As in UNSTR-NAV, the way still to go counts as the straight line to the goal over the worst ground that is safe, which
leads straight on rather than to the cheapest path, and each pose of a trajectory may be the one that reaches the goal.
Unlike there, the robot turns on the spot at each state, not only at the first, and labels replace its cost map.
Source: github.com/picchius94/unstruct_navigation, class A_star_Graph.
"""

import heapq
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from travjax.config import InputError, require, require_number, shown
from travjax.planning.endpoints import Endpoint, endpoint, on_site, place_text, standing
from travjax.planning.judges import UNKNOWN_NAME
from travjax.planning.motions import TURN_PART
from travjax.planning.no_path import NoPathError, Reached, cannot_stand, reached_places, standing_beside
from travjax.planning.path import Path, PosedLeg, drive
from travjax.planning.planner import Plan, Planner
from travjax.progress import bar
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.setup import Setup
from travjax.site.primitives import Primitive
from travjax.traversal.traverse import failures, margins_of

MOST = 1000
"""Trajectories that the sequential simulators try before the search gives up."""

PARTS = 4
"""Parts of a trajectory's length, and of the circle, that cells of position and heading extend over."""

BEYOND = 8
"""Trajectories from a state that are tried as far as the goal although they fail somewhere, perhaps behind it."""


@dataclass(frozen=True, eq=False)
class State:
    """Where the robot may be.

    pose: x and y in metres from the site's south-west node, heading in radians, NaN where any will do
    cost: of the path to it; legs: the last of that path, after those to the state `before`
    """

    pose: Float[np.ndarray, " 3"]
    cost: float = 0.0
    legs: tuple[PosedLeg, ...] = ()
    before: "State | None" = None

    def path(self) -> list[PosedLeg]:
        """Returns all legs of the path to it."""
        legs: list[PosedLeg] = []
        state: State | None = self
        while state is not None:
            legs[:0] = state.legs
            state = state.before
        return legs


@dataclass(frozen=True, eq=False)
class Ways:
    """The ways on from a state, the most promising first.

    promise:    cost of the path and of the way still to go; trajectory: its index; last: number of its last pose
    turn:       radians of the point turn before it
    cell:       of the grid of states where it ends, -1 at the goal
    """

    state: State
    promise: Float[np.ndarray, " w"]
    trajectory: Int[np.ndarray, " w"]
    last: Int[np.ndarray, " w"]
    turn: Float[np.ndarray, " w"]
    cell: Int[np.ndarray, " w"]


class ActionSpacePlanner:
    """Plans paths on one site by the trajectories of an action space.

    planner: of the same site; its robot, contact model and stride hold, and of its motions what turning and risk cost
    actions: the paper's action space unless given; most: trajectories that the sequential simulators try at most
    quiet:   whether no progress is shown
    window:  setup that labels the trajectories from a state; poses: [t, p, 3] of its t trajectories, from x = y = 0
    length:  [p] metres up to each pose; turned: [t, p] radians up to there, to the left and right added up

    Raises InputError where robot, action space and nodes do not fit together, and where unknown ground has a cost.
    """

    def __init__(self, planner: Planner, actions: ActionSpace | None = None, *, most: int = MOST, quiet: bool = False):
        self.costs, self.site, self.actions = planner.costs, planner.setup, actions or ActionSpace()
        require(planner.unknown_cost is None, "unknown_cost", planner.unknown_cost, "left out")
        require_number("most", most, 0, 10**9, "a number of trajectories above 0")
        self.planner, self.motions, self.most, self.quiet = planner, planner.lattice.motions, most, quiet
        along, spacing = self.actions.arc_lengths, self.site.spacing
        around = replace(self.site, primitives=(Primitive(0.0, ((math.inf, sum(along)),)),))
        grid = Grid(2 * around.halo * around.step * spacing, spacing)
        self.window = Setup.chosen(self.site.robot, self.actions, grid, self.site.contact, turn=False)
        self.window.require_fit()
        self.poses = self.actions.poses(np.arange(len(self.actions)))
        self.length = np.append(self.actions.first_stations(), along[0] + self.actions.second_stations())
        self.turned = np.abs(np.diff(self.poses[..., 2], axis=1, prepend=self.poses[:, :1, 2])).cumsum(axis=1)

    def plan(self, start: Any, goal: Any, coordinates: str = "site") -> Plan:
        """Plans a path that begins exactly at the start and ends within half a stride of the goal.

        start, goal, coordinates: as of `plan`; a heading at the goal is turned to on the spot
        Raises NoPathError where nothing is left to go on from, or after `most` trajectories, and InputError for points
        off the site and where the robot cannot stand at the start.
        """
        points = self._point("start", start, coordinates), self._point("goal", goal, coordinates)
        search = TrajectorySearch(self, *(self._pose(point) for point in points))
        if not search.can_stand():
            self.planner.require_standing(points[0])
            raise InputError(f"start = {shown(points[0].given)}: the robot cannot stand exactly there")
        if not standing(points[1], self.costs):
            raise cannot_stand(*points, self.costs)
        found = search.run()
        if found is None:
            raise self._no_path(*points, search)
        path, state = found
        method = f"{len(self.actions)} trajectories from each state"
        return Plan(path, tuple(state.path()), state.cost, points, method, search.refused)

    def _point(self, name: str, given: Any, coordinates: str) -> Endpoint:
        """Returns a point, exactly where it was given."""
        nearest, ground = endpoint(name, given, self.costs, coordinates), self.costs.ground
        x, y = on_site(name, nearest.given, ground, coordinates)
        return replace(nearest, x=x, y=y)

    def _pose(self, point: Endpoint) -> Float[np.ndarray, " 3"]:
        origin, heading = self.costs.ground.origin, point.given[2] if len(point.given) == 3 else math.nan
        return np.array([point.x - origin[0], point.y - origin[1], heading])

    def _no_path(self, start: Endpoint, goal: Endpoint, search: "TrajectorySearch") -> NoPathError:
        reached = search.reached(goal)
        x, y = self.costs.at(*reached.nearest)
        ended = "nothing is left to go on from"
        if search.tried >= self.most:
            ended = f"gave up after {search.tried} trajectories"
        failed = {name: count for name, count in search.failed.items() if count}
        shares = [f"{name} {failed[name] / search.labelled:.0%}" for name in sorted(failed, key=lambda k: -failed[k])]
        text = (
            f"no path from start {place_text(start.x, start.y)} to goal {place_text(goal.x, goal.y)} by trajectories "
            f"of the action space: {ended}; {reached.places.sum()} of {reached.places.size} places are reached, the "
            f"nearest to goal is {place_text(x, y)}, {math.hypot(goal.x - x, goal.y - y):.2f} m from it; trajectories "
            f"that fail: {', '.join(shares) or 'none'}"
        )
        return NoPathError(text, reached, start, goal)


class TrajectorySearch:
    """The search for one path, from pose to pose, x and y counted from the site's south-west node.

    tried, refused: trajectories that the sequential simulators tried, and refused
    labelled:       trajectories that were labelled; failed: how many of them by each event, or on unknown ground
    """

    def __init__(self, planner: ActionSpacePlanner, start: Float[np.ndarray, " 3"], goal: Float[np.ndarray, " 3"]):
        self.planner, self.start, self.goal = planner, start, goal
        self.ground, self.setup, self.actions = planner.costs.ground, planner.site, planner.actions
        self.headings = self.actions.heading(np.arange(self.actions.turns))
        self.tried = self.refused = self.labelled = 0
        self.failed = dict.fromkeys((*self.setup.robot.event_names, UNKNOWN_NAME), 0)
        self._places = np.zeros(planner.costs.shape, bool)
        self._mark(start[None])
        self._closed: set[int] = set()
        self._ways: list[Ways] = []
        self._heap: list[tuple[float, int, int]] = []

    def can_stand(self) -> bool:
        """Whether the robot can stand at the start, in its heading or in any of the action space."""
        return bool(self._standing(self.start, self.headings if np.isnan(self.start[2]) else self.start[2:])[0].any())

    def run(self) -> tuple[Path, State] | None:
        """Searches for a path; returns it with the state where it ends, or None."""
        self._expand(State(self.start))
        with bar("planning", self.planner.most, "trajectory", self.planner.quiet) as progress:
            while self._heap and self.tried < self.planner.most:
                _, number, rank = heapq.heappop(self._heap)
                ways = self._ways[number]
                self._push(number, rank + 1)
                if ways.cell[rank] in self._closed:
                    continue
                self.tried += 1
                progress.update()
                state = self._follow(ways, rank)
                if state is not None and ways.cell[rank] >= 0:
                    self._closed.add(int(ways.cell[rank]))
                    self._expand(state)
                elif state is not None and (path := self._driven(state.path(), state.pose)[0]) is not None:
                    return path, state
                else:
                    self.refused += 1
        return None

    def reached(self, goal: Endpoint) -> Reached:
        """Returns the places that the paths found so far lead over."""
        costs = self.planner.costs
        return reached_places(self._places, standing_beside(self._places, costs), goal, costs)

    def _push(self, number: int, rank: int) -> None:
        if rank < len(self._ways[number].promise):
            heapq.heappush(self._heap, (float(self._ways[number].promise[rank]), number, rank))

    def _expand(self, state: State) -> None:
        """Labels the trajectories from a state, and adds the ways on from there."""
        planner, weights = self.planner, self.planner.motions
        factor, passes = self._labels(state.pose)
        turn, turning = (np.repeat(field, len(self.actions) // self.actions.turns) for field in self._turns(state.pose))
        before, free = state.cost + weights.turning * np.abs(turn) * turning, np.isfinite(turn)
        poses = planner.poses + [*state.pose[:2], 0.0]
        away = np.hypot(*(poses[..., axis] - self.goal[axis] for axis in (0, 1)))
        nearest = away.argmin(axis=1)
        near = free & (away.min(axis=1) <= self.setup.stride / 2)
        whole, through, beyond = (np.flatnonzero(some) for some in (free & passes, near & passes, near & ~passes))
        beyond = beyond[np.argsort(before[beyond] + planner.length[nearest[beyond]])[:BEYOND]]
        trajectory = np.concatenate([whole, through, beyond])
        at_goal = np.arange(len(trajectory)) >= len(whole)
        last = np.where(at_goal, nearest[trajectory], poses.shape[1] - 1)
        end = poses[trajectory, last]
        driving = planner.length[last] + weights.turning * planner.turned[trajectory, last]
        turning_there = weights.turning * np.abs(self._left_to_turn(end[:, 2])) * factor[trajectory]
        to_go = np.where(at_goal, turning_there, (1 + weights.risk) * away[trajectory, last])
        promise = before[trajectory] + driving * factor[trajectory] + to_go
        cell = np.where(at_goal, -1, self._cells(end))
        order = np.argsort(promise, kind="stable")
        self._ways.append(Ways(state, *(field[order] for field in (promise, trajectory, last, turn[trajectory], cell))))
        self._push(len(self._ways) - 1, 0)

    def _labels(self, pose: Float[np.ndarray, " 3"]) -> tuple[Float[np.ndarray, " t"], Bool[np.ndarray, " t"]]:
        """Returns the factor of cost of all trajectories from a pose, and which of them pass."""
        window, spacing = self.planner.window, self.setup.spacing
        half = window.grid.cells // 2
        col, row = (math.floor(float(value) / spacing + 0.5) for value in pose[:2])
        cut = self.ground.part(slice(row - half, row + half + 1), slice(col - half, col + half + 1))
        margins = margins_of(cut, window)
        failed, known = np.asarray(failures(margins, window.robot)), np.asarray(margins.known)
        share = (np.asarray(margins.events()) / window.robot.limits).max(axis=-1)
        self.labelled += len(known)
        for name, count in zip(self.failed, [*failed.sum(axis=0), (~known).sum()], strict=True):
            self.failed[name] += int(count)
        passes = known & ~failed.any(axis=-1)
        return 1 + self.planner.motions.risk * np.where(passes, np.minimum(share, 1), 1) ** 2, passes

    def _turns(self, pose: Float[np.ndarray, " 3"]) -> tuple[Float[np.ndarray, " h"], Float[np.ndarray, " h"]]:
        """Returns the point turn to each heading of the action space, inf where the robot fails, and what risk adds.

        It is the shorter one, by the sequential simulators: the other one sweeps over the same ground, and more.
        """
        if np.isnan(pose[2]):
            return np.zeros(len(self.headings)), np.ones(len(self.headings))
        angle = (self.headings - pose[2] + math.pi) % (2 * math.pi) - math.pi
        parts = np.arange(math.ceil(2 * math.pi / TURN_PART - 1e-9))
        part = 2 * math.pi / len(parts)
        free, share = self._standing(pose, pose[2] + part * parts)
        worst = np.where(free, np.minimum(share, 1), np.inf)
        to_left, to_right = (np.maximum.accumulate(worst[sign * parts]) for sign in (1, -1))
        swept = (np.abs(angle) / part + 1e-6).astype(int)
        worst = np.where(angle >= 0, to_left[swept], to_right[swept])
        return np.where(np.isfinite(worst), angle, np.inf), 1 + self.planner.motions.risk * worst**2

    def _standing(
        self, pose: Float[np.ndarray, " 3"], headings: Float[np.ndarray, " h"]
    ) -> tuple[Bool[np.ndarray, " h"], Float[np.ndarray, " h"]]:
        """Returns whether the robot can stand in each heading, and the largest margin as a share of its limit."""
        poses = np.column_stack([np.broadcast_to(pose[:2], (len(headings), 2)), headings])
        path, _ = drive([PosedLeg("turn", True, poses, 0.0, 0.0)], poses[0], self.ground, self.setup)
        return path.known & ~path.exceeds, path.share

    def _follow(self, ways: Ways, rank: int) -> State | None:
        """Returns the state that a way leads to, None where the sequential simulators refuse it."""
        trajectory, last, turn = (field[rank].item() for field in (ways.trajectory, ways.last, ways.turn))
        planner = self.planner
        poses = planner.poses[trajectory, : last + 1] + [*ways.state.pose[:2], 0.0]
        legs = _turn(poses[0], turn, ends=True)
        if last > 0:
            length, turned = float(planner.length[last]), float(planner.turned[trajectory, last])
            legs.append(PosedLeg(f"trajectory_{trajectory}", False, poses, length, turned))
        if ways.cell[rank] < 0:
            legs += _turn(poses[-1], float(self._left_to_turn(poses[-1, 2])))
        path, shares = self._driven(legs, poses[0])
        if path is None:
            return None
        self._mark(path.pose[:, :2] - self.ground.origin)
        weights, cost = planner.motions, ways.state.cost
        for leg, share in zip(legs, shares, strict=True):
            cost += (leg.length + weights.turning * leg.turned) * (1 + weights.risk * min(share, 1) ** 2)
        end = legs[-1].at[-1] if legs else poses[0]
        return State(end, cost, tuple(legs), ways.state)

    def _driven(self, legs: list[PosedLeg], pose: Float[np.ndarray, " 3"]) -> tuple[Path | None, list[float]]:
        """Returns the path along legs, and the largest share of a limit in each; None where a pose is not safe."""
        path, owner = drive(legs, legs[0].at[0] if legs else pose, self.ground, self.setup)
        shares = np.zeros(len(legs))
        if legs:
            np.fmax.at(shares, owner, path.share)
        return (path if (path.known & ~path.exceeds).all() else None), shares.tolist()

    def _left_to_turn(self, heading: Any) -> Any:
        """Returns the radians from headings to that at the goal, 0 where any will do."""
        left = (self.goal[2] - heading + math.pi) % (2 * math.pi) - math.pi
        return np.where(np.isnan(self.goal[2]), 0.0, left)

    def _cells(self, poses: Float[np.ndarray, "w 3"]) -> Int[np.ndarray, " w"]:
        """Returns the numbers of the cells of position and heading that poses lie in."""
        edge = np.array([*[self.planner.length[-1] / PARTS] * 2, 2 * math.pi / PARTS])
        col, row, heading = np.floor(poses / edge + 0.5).astype(int).T
        return (row * 2**24 + col) * PARTS + heading % PARTS

    def _mark(self, points: Float[np.ndarray, "p 2"]) -> None:
        """Notes the places that a path leads over."""
        cols, rows = np.floor(points[:, :2].T / self.setup.stride + 0.5).astype(int)
        last_row, last_col = (count - 1 for count in self._places.shape)
        self._places[np.clip(rows, 0, last_row), np.clip(cols, 0, last_col)] = True


def _turn(pose: Float[np.ndarray, " 3"], angle: float, ends: bool = False) -> list[PosedLeg]:
    """Returns the point turn that begins in a pose, or ends there; none where there is nothing to turn."""
    if abs(angle) < 1e-9:
        return []
    poses = np.repeat(pose[None], max(math.ceil(abs(angle) / TURN_PART - 1e-9), 1) + 1, axis=0)
    poses[:, 2] += np.linspace(0, angle, len(poses)) - (angle if ends else 0)
    return [PosedLeg("turn_left" if angle > 0 else "turn_right", True, poses, 0.0, abs(angle))]
