"""Why there is no path: how far the search got, and what stands in the way there."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int, UInt8
from scipy.ndimage import binary_dilation

from travjax.planning.costs import MotionCosts
from travjax.planning.endpoints import Endpoint, in_the_way_named, place_text, why_not_standing
from travjax.planning.judges import UNKNOWN
from travjax.planning.search import Search, bounds


@dataclass(frozen=True, eq=False)
class Reached:
    """What can be reached from where a path was to begin; rows run north, columns east.

    places:   [rows, cols] that can be reached
    frontier: [rows, cols] what stands in the way to places that cannot be reached but lie next to those that can: 0 is
              nothing, 1, 2, 3 ... the robot's event of this number, judges.UNKNOWN unknown ground
    nearest:  row and column of the reached place that is nearest to the goal
    """

    places: Bool[np.ndarray, "rows cols"]
    frontier: UInt8[np.ndarray, "rows cols"]
    nearest: tuple[int, int]


class NoPathError(Exception):
    """There is no path; the message says how far the search got and what stands in the way."""

    def __init__(self, message: str, reached: Reached, start: Endpoint, goal: Endpoint):
        super().__init__(message)
        self.reached, self.start, self.goal = reached, start, goal


def cannot_stand(start: Endpoint, goal: Endpoint, costs: MotionCosts) -> NoPathError:
    """Returns the error for a goal at which the robot cannot stand."""
    return NoPathError(why_not_standing(goal, costs), no_path(start, goal, costs).reached, start, goal)


def no_path(start: Endpoint, goal: Endpoint, costs: MotionCosts, search: Search | None = None) -> NoPathError:
    """Returns the error that says why there is no path.

    search: that ran until nothing was left to go on from; without it, or where no place leads to the goal whatever the
            heading, places count as reached that are connected with the start whatever the heading
    """
    by_state = search is not None and math.isfinite(search.bound[start.row, start.col])
    places, counts = _by_states(search, costs) if by_state and search else _by_places(start, costs)
    reached = reached_places(places, counts, goal, costs)
    return NoPathError(_message(start, goal, reached, by_state, costs), reached, start, goal)


def reached_places(
    places: Bool[np.ndarray, "rows cols"],
    counts: Int[np.ndarray, "codes rows cols"],
    goal: Endpoint,
    costs: MotionCosts,
) -> Reached:
    """Returns what is reached, from the places and how often each event is in the way next to them, unknown last."""
    frontier = np.array([0, *_codes(costs)], np.uint8)[np.where(counts.any(axis=0), 1 + counts.argmax(axis=0), 0)]
    rows, cols = np.nonzero(places)
    best = int(np.hypot(rows - goal.row, cols - goal.col).argmin())
    return Reached(places, frontier, (int(rows[best]), int(cols[best])))


def _message(start: Endpoint, goal: Endpoint, reached: Reached, by_state: bool, costs: MotionCosts) -> str:
    row, col = reached.nearest
    away = math.hypot(row - goal.row, col - goal.col) * costs.lattice.stride
    whatever = "" if by_state else ", even if headings did not matter"
    text = (
        f"no path from {start.name} {place_text(start.x, start.y)} to {goal.name} {place_text(goal.x, goal.y)}: "
        f"{reached.places.sum()} of {reached.places.size} places can be reached{whatever}; "
    )
    if away > 0:
        text += f"the nearest to {goal.name} is {place_text(*costs.at(row, col))}, {away:.2f} m from it"
    else:
        text += f"{goal.name} is one of them, but not in the heading that is wanted"
    codes, counts = np.unique(reached.frontier[reached.frontier > 0], return_counts=True)
    order = np.argsort(-counts)
    shares = [f"{in_the_way_named(int(codes[k]), costs)} {counts[k] / counts.sum():.0%}" for k in order]
    return f"{text}; {'in the way: ' + ', '.join(shares) if shares else 'the site ends there'}"


def _by_places(start: Endpoint, costs: MotionCosts) -> tuple[np.ndarray, np.ndarray]:
    """Returns the places that are connected with the start whatever the heading, and what is next to them.

    Of the latter, how often each event is in the way over the headings: [events + 1, rows, cols], unknown ground last.
    """
    from_start = bounds(costs.lattice, costs.easiest, [start.row * costs.shape[1] + start.col], forwards=True)
    places = np.isfinite(from_start)
    return places, standing_beside(places, costs)


def standing_beside(places: Bool[np.ndarray, "rows cols"], costs: MotionCosts) -> Int[np.ndarray, "codes rows cols"]:
    """Returns how often, over the headings, each event keeps the robot from standing next to places, unknown last."""
    beside = binary_dilation(places, np.ones((3, 3))) & ~np.isfinite(costs.easiest)
    return np.stack([(costs.standing[1] == code).sum(axis=0) for code in _codes(costs)]) * beside


def _codes(costs: MotionCosts) -> tuple[int, ...]:
    """Returns what may stand in the way: the numbers of the robot's events, unknown ground last."""
    return (*range(1, 1 + len(costs.robot.events)), UNKNOWN)


def _by_states(search: Search, costs: MotionCosts) -> tuple[np.ndarray, np.ndarray]:
    """Returns the places that the search reached, and how often each event ended a motion to another place."""
    rows, cols = costs.shape
    closed, moves = search.closed.reshape(rows, cols, -1), search.moves
    places = np.asarray(closed.any(axis=-1))
    codes = _codes(costs)
    counts = np.zeros((len(codes), rows, cols), np.int32)
    for heading, step in zip(*np.nonzero(moves.motion >= 0), strict=True):
        row, col = np.nonzero(closed[..., heading])
        begin_row, begin_col = row + moves.from_rows[heading, step], col + moves.from_cols[heading, step]
        end_row, end_col = row + moves.rows[heading, step], col + moves.cols[heading, step]
        inside = [
            (0 <= r) & (r < rows) & (0 <= c) & (c < cols) for r, c in ((begin_row, begin_col), (end_row, end_col))
        ]
        on_site = inside[0] & inside[1]
        begin = begin_row[on_site] * cols + begin_col[on_site]
        end = end_row[on_site], end_col[on_site]
        code = np.where(places[end], 0, costs.in_the_way[begin, moves.motion[heading, step]])
        for number, one in enumerate(codes):
            np.add.at(counts[number], tuple(at[code == one] for at in end), 1)
    return places, counts
