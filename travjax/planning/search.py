"""The search for the cheapest path: A* from state to state, compiled by numba.

A state is the number (row * cols + col) * H + heading. The costs of motions are computed tile by tile when the search
first comes to a tile, so it stops and says so where they are missing, and goes on afterwards.

The bound that leads A* is the cheapest way to the goal if the robot needed no heading: it does not exceed the cost of
any path (`bounds`), and a path that A* finds is therefore the cheapest.
"""

from collections.abc import Iterable, Iterator
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Float32
from numba import njit

from travjax.planning.motions import MotionLattice, Moves

FOUND, EXHAUSTED, MISSING = 0, 1, 2
"""How a part of a search ends: all goals are reached, nothing is left to go on from, costs of a tile are missing."""

NOWHERE = 0xFFFF
"""Stands for no step: a state where a path begins, or to which none leads."""

AHEAD = 8
"""Places between those on the way to the goals whose costs are computed beforehand."""


class Costs(Protocol):
    """The costs of motions, computed tile by tile."""

    cost: Float32[np.ndarray, "places motions"]
    evaluated: Bool[np.ndarray, "tile_rows tile_cols"]
    tile: int

    def evaluate(self, places: Iterable[int]) -> None:
        """Computes the costs of motions from the first of some places at least, and of those around it."""


class Search:
    """A search on a lattice of places; rows, cols: of the places.

    bound:   [rows, cols] of each place to the goals, at most what a path costs; inf where there is none
    best:    [states] cost of the cheapest path to a state found so far, inf for none
    closed:  [states] whether that is the cheapest path of all
    arrived: [states] number of the step that it ends with, heading * M + step, or NOWHERE
    """

    def __init__(self, moves: Moves, headings: int, bound: Float[np.ndarray, "rows cols"]):
        self.moves, self.headings, self.bound = moves, headings, np.ascontiguousarray(bound, float)
        self.rows, self.cols = bound.shape
        states = self.bound.size * headings
        self.best = np.full(states, np.inf)
        self.closed = np.zeros(states, bool)
        self.arrived = np.full(states, NOWHERE, np.uint16)
        self._heap = np.empty(1024), np.empty(1024, np.int64)
        self._size = 0

    def start(self, state: int, cost: float = 0.0) -> None:
        """Lets the search begin in a state, after a path of some cost."""
        bound = float(self.bound.flat[state // self.headings])
        if cost < self.best[state] and np.isfinite(bound):
            self.best[state] = cost
            keys, states, self._size = _push(*self._heap, self._size, cost + bound, state)
            self._heap = keys, states

    def run(self, costs: Costs, goals: Iterable[int] | None, every: bool = False) -> int:
        """Goes on until a goal is reached, or every one; without goals, until nothing is left.

        Returns how many of the goals are reached.
        """
        wanted = np.zeros(len(self.best) if goals is not None else 0, bool)
        chosen = np.array(sorted(goals) if goals is not None else [], np.int64)
        wanted[chosen] = ~self.closed[chosen]
        moves = self.moves
        fields = (moves.motion, moves.rows, moves.cols, moves.end, moves.from_rows, moves.from_cols, moves.factor)
        while True:
            reached = int(self.closed[chosen].sum())
            left = len(chosen) - reached if every else int(reached == 0 and len(chosen) > 0)
            if goals is not None and left == 0:
                return reached
            shape = self.rows, self.cols, self.headings
            ended, place, *self._heap, self._size = _advance(
                *self._heap, self._size, self.best, self.arrived, self.closed, self.bound.ravel(), costs.cost,
                costs.evaluated, costs.tile, fields, shape, wanted, left,
            )  # fmt: skip
            if ended != MISSING:
                return int(self.closed[chosen].sum())
            costs.evaluate(self._next_places(place, costs.tile))

    def _next_places(self, place: int, tile: int) -> Iterator[int]:
        """Yields a place, and where the search probably needs costs soon.

        These are places on the way to the goals of a robot that needs no heading, or around if the bound knows no way.
        """
        yield place
        while 0 < self.bound.flat[place] < np.inf:
            row, col = divmod(place, self.cols)
            top, left = max(row - AHEAD, 0), max(col - AHEAD, 0)
            near = self.bound[top : row + AHEAD + 1, left : col + AHEAD + 1]
            down, right = divmod(int(near.argmin()), near.shape[1])
            next_place = (top + down) * self.cols + left + right
            if next_place == place:
                return
            place = next_place
            yield place
        row, col = divmod(place, self.cols)
        for rows, cols in ((0, tile), (tile, 0), (0, -tile), (-tile, 0)):
            if 0 <= row + rows < self.rows and 0 <= col + cols < self.cols:
                yield place + rows * self.cols + cols

    def step_to(self, state: int) -> tuple[int, int, int] | None:
        """Returns how the cheapest path arrives in a state: state before, its heading's step; None where it begins."""
        arrived = int(self.arrived[state])
        if arrived == NOWHERE:
            return None
        place, _ = divmod(state, self.headings)
        heading, step = divmod(arrived, self.moves.motion.shape[1])
        row, col = divmod(place, self.cols)
        row, col = row - int(self.moves.rows[heading, step]), col - int(self.moves.cols[heading, step])
        return (row * self.cols + col) * self.headings + heading, heading, step

    def path_to(self, state: int) -> list[tuple[int, int, int]]:
        """Returns the steps of the cheapest path to a state: the state before each, its heading and step."""
        steps = []
        while (before := self.step_to(state)) is not None:
            steps.append(before)
            state = before[0]
        return steps[::-1]


def bounds(
    lattice: MotionLattice, standing: Float[np.ndarray, "rows cols"], goals: Iterable[int], forwards: bool = False
) -> Float[np.ndarray, "rows cols"]:
    """Returns the cheapest way from every place to goals for a robot that needs no heading; inf where there is none.

    standing: factor of cost at each place, at its best heading, at least 1; inf where the robot cannot stand
    goals:    numbers of places, row * cols + col; forwards: the way from these places to every place instead
    Source: the projection of the search's graph on places. A motion's cost is at least its own times the larger factor
    of the places where it begins and ends.
    """
    ways: dict[tuple[int, int], float] = {}
    moves, sign = lattice.moves, 1 if forwards else -1
    for heading, step in zip(*np.nonzero(moves.motion >= 0), strict=True):
        way = sign * int(moves.rows[heading, step]), sign * int(moves.cols[heading, step])
        cost = lattice.costs[moves.motion[heading, step]] * moves.factor[heading, step]
        if way != (0, 0):
            ways[way] = min(cost, ways.get(way, np.inf))
    offsets = np.array(list(ways), np.int64)
    return _place_bounds(
        np.ascontiguousarray(standing, float), np.array(sorted(goals), np.int64), offsets, np.array([*ways.values()])
    )


@njit(cache=True)
def _push(keys, states, size, key, state):  # pragma: no cover - compiled
    """Adds an entry to a binary heap, which grows as it needs to."""
    if size == len(keys):
        more_keys, more_states = np.empty(2 * size), np.empty(2 * size, np.int64)
        more_keys[:size], more_states[:size] = keys, states
        keys, states = more_keys, more_states
    at = size
    while at > 0:
        above = (at - 1) >> 1
        if keys[above] <= key:
            break
        keys[at], states[at] = keys[above], states[above]
        at = above
    keys[at], states[at] = key, state
    return keys, states, size + 1


@njit(cache=True)
def _pop(keys, states, size):  # pragma: no cover - compiled
    """Takes the smallest entry, the first, out of a binary heap; returns the new size."""
    size -= 1
    key, state = keys[size], states[size]
    at = 0
    while True:
        below = 2 * at + 1
        if below >= size:
            break
        if below + 1 < size and keys[below + 1] < keys[below]:
            below += 1
        if keys[below] >= key:
            break
        keys[at], states[at] = keys[below], states[below]
        at = below
    keys[at], states[at] = key, state
    return size


@njit(cache=True)
def _advance(
    keys, states, size, best, arrived, closed, bound, cost, evaluated, tile, fields, shape, wanted, left
):  # pragma: no cover - compiled
    """Goes on with a search; returns how it ended, the place it stopped at, and the heap."""
    motion, step_rows, step_cols, ends, from_rows, from_cols, factor = fields
    rows, cols, headings = shape
    steps = motion.shape[1]
    while size > 0:
        state = states[0]
        if closed[state]:
            size = _pop(keys, states, size)
            continue
        place, heading = state // headings, state % headings
        row, col = place // cols, place % cols
        for step in range(steps):  # before anything changes: all costs have to be there
            if motion[heading, step] < 0:
                continue
            from_row, from_col = row + from_rows[heading, step], col + from_cols[heading, step]
            inside = 0 <= from_row < rows and 0 <= from_col < cols
            if inside and not evaluated[from_row // tile, from_col // tile]:
                return MISSING, from_row * cols + from_col, keys, states, size
        size = _pop(keys, states, size)
        closed[state] = True
        for step in range(steps):
            number = motion[heading, step]
            to_row, to_col = row + step_rows[heading, step], col + step_cols[heading, step]
            if number < 0 or not (0 <= to_row < rows and 0 <= to_col < cols):
                continue
            to_place = to_row * cols + to_col
            to_state = to_place * headings + ends[heading, step]
            if closed[to_state]:
                continue
            begins = (row + from_rows[heading, step]) * cols + col + from_cols[heading, step]
            total = best[state] + factor[heading, step] * cost[begins, number]
            key = total + bound[to_place]
            if total < best[to_state] and key < np.inf:
                best[to_state] = total
                arrived[to_state] = heading * steps + step
                keys, states, size = _push(keys, states, size, key, to_state)
        if left > 0 and wanted[state]:
            left -= 1
            if left == 0:
                return FOUND, place, keys, states, size
    return EXHAUSTED, -1, keys, states, size


@njit(cache=True)
def _place_bounds(standing, goals, offsets, costs):  # pragma: no cover - compiled
    """Dijkstra's algorithm from places of goals, over the offsets of motions."""
    rows, cols = standing.shape
    bound = np.full((rows, cols), np.inf)
    closed = np.zeros((rows, cols), np.bool_)
    keys, places, size = np.empty(1024), np.empty(1024, np.int64), 0
    for goal in goals:
        bound[goal // cols, goal % cols] = 0
        keys, places, size = _push(keys, places, size, 0.0, goal)
    while size > 0:
        key, place = keys[0], places[0]
        size = _pop(keys, places, size)
        row, col = place // cols, place % cols
        if closed[row, col]:
            continue
        closed[row, col] = True
        for way in range(len(costs)):
            to_row, to_col = row + offsets[way, 0], col + offsets[way, 1]
            if not (0 <= to_row < rows and 0 <= to_col < cols) or closed[to_row, to_col]:
                continue
            total = key + costs[way] * max(standing[row, col], standing[to_row, to_col])
            if total < bound[to_row, to_col]:
                bound[to_row, to_col] = total
                keys, places, size = _push(keys, places, size, total, to_row * cols + to_col)
    return bound
