"""The search: as cheap as Dijkstra's algorithm on the explicit graph, with a bound that never exceeds what is true."""

import math
from collections.abc import Iterable

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from travjax.planning.motions import MotionLattice, Motions
from travjax.planning.search import Search, bounds
from travjax.site.primitives import PointTurn

LATTICES = [
    MotionLattice(Motions(radius=0.5), 8, 0.25),
    MotionLattice(Motions(radius=0.5, point_turns=False), 8, 0.25),
    MotionLattice(Motions(radius=0.5, point_turns=False, reverse=True, reversing=1.5), 8, 0.25),
    MotionLattice(Motions(radius=1.0, turning=2), 16, 0.25),
]
ROWS, COLS = 23, 31


class FakeCosts:
    """Random costs of motions, known tile by tile: those of tiles that were not asked for are nonsense.

    A motion costs at least its own times the larger factor of the places where it begins and ends.
    """

    tile = 5

    def __init__(self, lattice: MotionLattice, seed: int, failing: float = 0.25):
        rng = np.random.default_rng(seed)
        self.lattice, self.asked = lattice, 0
        standing = 1 + rng.random((ROWS, COLS)) ** 3
        standing[rng.random((ROWS, COLS)) < failing] = np.inf
        self.standing = standing.astype(np.float32)
        self.whole = np.full((ROWS * COLS, len(lattice.all)), np.inf, np.float32)
        for number, motion in enumerate(lattice.all):
            for row in range(max(0, -motion.rows), ROWS - max(0, motion.rows)):
                for col in range(max(0, -motion.cols), COLS - max(0, motion.cols)):
                    ends = standing[row, col], standing[row + motion.rows, col + motion.cols]
                    if rng.random() < 0.9:
                        factor = max(*ends, 1 + rng.random())
                        self.whole[row * COLS + col, number] = lattice.costs[number] * np.float32(factor)
        self.cost = np.full_like(self.whole, -1000)
        self.evaluated = np.zeros((-(-ROWS // self.tile), -(-COLS // self.tile)), bool)

    def evaluate(self, places: Iterable[int]) -> None:
        """Knows the costs of the tile of the first place."""
        row, col = divmod(next(iter(places)), COLS)
        tile = row // self.tile, col // self.tile
        assert not self.evaluated[tile]
        self.asked += 1
        self._know(*tile)

    def evaluate_all(self) -> "FakeCosts":
        for row, col in np.ndindex(self.evaluated.shape):
            self._know(row, col)
        return self

    def _know(self, row: int, col: int) -> None:
        self.evaluated[row, col] = True
        known = self.evaluated.repeat(self.tile, axis=0).repeat(self.tile, axis=1)[:ROWS, :COLS].ravel()
        self.cost[known] = self.whole[known]

    def graph(self) -> csr_array:
        """Returns the cheapest edge between any two states, [states, states]."""
        cheapest: dict[tuple[int, int], float] = {}
        headings, motions = self.lattice.headings, self.lattice.motions
        for number, motion in enumerate(self.lattice.all):
            turning = isinstance(motion.primitive, PointTurn)
            for place in np.flatnonzero(np.isfinite(self.whole[:, number])).tolist():
                begin = place * headings + motion.heading
                end = (place + motion.rows * COLS + motion.cols) * headings + motion.end
                ways = [(begin, end, 1.0)]
                if turning or motions.reverse:
                    ways.append((end, begin, 1.0 if turning else motions.reversing))
                for *edge, factor in ways:
                    key, cost = (edge[0], edge[1]), factor * float(self.whole[place, number])
                    cheapest[key] = min(cost, cheapest.get(key, math.inf))
        (begins, ends), states = zip(*cheapest, strict=True), ROWS * COLS * headings
        return csr_array((list(cheapest.values()), (begins, ends)), shape=(states, states))


def states_of(lattice: MotionLattice, row: int, col: int) -> list[int]:
    return [(row * COLS + col) * lattice.headings + heading for heading in range(lattice.headings)]


def searched(costs: FakeCosts, starts: dict[int, float], goals: list[int], every: bool = False) -> Search:
    lattice = costs.lattice
    places = {goal // lattice.headings for goal in goals}
    search = Search(lattice.moves, lattice.headings, bounds(lattice, costs.standing, places))
    for state, cost in starts.items():
        search.start(state, cost)
    search.run(costs, goals, every)
    return search


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("lattice", LATTICES, ids=range(len(LATTICES)))
def test_paths_are_as_cheap_as_those_of_dijkstra_and_found_where_there_are_any(lattice, seed):
    costs = FakeCosts(lattice, seed)
    graph, rng, found = costs.graph(), np.random.default_rng(seed), 0
    for _ in range(8):
        start = int(rng.integers(ROWS * COLS * lattice.headings))
        goals = states_of(lattice, int(rng.integers(ROWS)), int(rng.integers(COLS)))[:: int(rng.choice([1, 3, 8]))]
        wanted = dijkstra(graph, indices=start)
        search = searched(costs, {start: 0.0}, goals)
        reached = [goal for goal in goals if search.closed[goal]]
        assert bool(reached) == bool(np.isfinite(wanted[goals]).any())
        if reached:
            found += 1
            best = min(reached, key=lambda goal: search.best[goal])
            assert search.best[best] == pytest.approx(wanted[goals].min(), rel=1e-6)
            assert_path(search, costs, start, best)
    assert found > 0


def assert_path(search: Search, costs: FakeCosts, start: int, goal: int) -> None:
    """Checks that the steps to a state follow each other, and add up to its cost."""
    moves, total, at = costs.lattice.moves, 0.0, start
    for state, heading, step in search.path_to(goal):
        assert state == at and state % costs.lattice.headings == heading
        row, col = divmod(state // costs.lattice.headings, COLS)
        begins = (row + moves.from_rows[heading, step]) * COLS + col + moves.from_cols[heading, step]
        total += moves.factor[heading, step] * float(costs.whole[begins, moves.motion[heading, step]])
        row, col = row + moves.rows[heading, step], col + moves.cols[heading, step]
        at = int((row * COLS + col) * costs.lattice.headings + moves.end[heading, step])
    assert at == goal and total == pytest.approx(search.best[goal], rel=1e-9)


@pytest.mark.parametrize("lattice", LATTICES, ids=range(len(LATTICES)))
def test_the_bound_never_exceeds_the_cost_to_go_and_is_consistent(lattice):
    for seed, failing in ((0, 0.0), (1, 0.2), (2, 0.4)):
        costs = FakeCosts(lattice, seed, failing)
        graph, goal = costs.graph(), (ROWS // 2 - seed, COLS // 3 + seed)
        bound = bounds(lattice, costs.standing, [goal[0] * COLS + goal[1]])
        to_go = dijkstra(graph.T.tocsr(), indices=states_of(lattice, *goal), min_only=True)
        of_state = bound.ravel().repeat(lattice.headings)
        assert (of_state <= to_go * (1 + 1e-6)).all()
        edges = graph.tocoo()
        begin, end = edges.row[np.isfinite(of_state[edges.col])], edges.col[np.isfinite(of_state[edges.col])]
        cost = edges.data[np.isfinite(of_state[edges.col])]
        assert (of_state[begin] <= (cost + of_state[end]) * (1 + 1e-6)).all()
        assert bound[goal] == 0 and np.isfinite(bound).any()


def test_the_bound_is_what_straight_drives_cost_on_easy_ground():
    lattice = LATTICES[0]
    bound = bounds(lattice, np.ones((ROWS, COLS)), [0])
    assert bound[10, 0] == pytest.approx(2.5) and bound[0, 10] == pytest.approx(2.5)
    assert bound[10, 10] == pytest.approx(2.5 * math.sqrt(2))


def test_the_bound_from_a_place_is_that_to_it_for_motions_in_all_directions():
    costs = FakeCosts(LATTICES[0], 5)
    np.testing.assert_allclose(
        bounds(LATTICES[0], costs.standing, [40], forwards=True), bounds(LATTICES[0], costs.standing, [40])
    )


@pytest.mark.parametrize("lattice", LATTICES, ids=range(len(LATTICES)))
def test_results_do_not_depend_on_when_costs_are_computed(lattice):
    starts, goals = {state: 0.0 for state in states_of(lattice, 3, 3)}, states_of(lattice, 15, 12)
    lazy, ready = FakeCosts(lattice, 8, 0.1), FakeCosts(lattice, 8, 0.1).evaluate_all()
    some, all_known = (searched(costs, starts, goals) for costs in (lazy, ready))
    assert 0 < lazy.asked < lazy.evaluated.size and ready.asked == 0
    np.testing.assert_array_equal(some.best, all_known.best)
    np.testing.assert_array_equal(some.closed, all_known.closed)
    goal = min(goals, key=lambda state: some.best[state])
    assert math.isfinite(some.best[goal]) and some.path_to(goal) == all_known.path_to(goal)


@pytest.mark.parametrize("lattice", LATTICES, ids=range(len(LATTICES)))
def test_all_goals_are_reached_from_several_beginnings_of_different_costs(lattice):
    costs = FakeCosts(lattice, 11, 0.1)
    starts = {
        state: float(cost) for state, cost in zip(states_of(lattice, 4, 20), range(lattice.headings), strict=True)
    }
    goals = states_of(lattice, 12, 5)
    each = dijkstra(costs.graph(), indices=list(starts))
    wanted = (each + np.array(list(starts.values()))[:, None]).min(axis=0)[goals]
    search = searched(costs, starts, goals, every=True)
    found = np.where(search.closed[goals], search.best[goals], np.inf)
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
    assert np.isfinite(wanted).any()


@pytest.mark.parametrize("lattice", LATTICES, ids=range(len(LATTICES)))
def test_a_search_back_from_the_goal_knows_the_cost_to_go_of_all_states(lattice):
    costs = FakeCosts(lattice, 4, 0.15)
    goals = states_of(lattice, 12, 5)
    search = Search(lattice.moves_back, lattice.headings, np.zeros((ROWS, COLS)))
    for goal in goals:
        search.start(goal)
    search.run(costs, None)
    wanted = dijkstra(costs.graph().T.tocsr(), indices=goals, min_only=True)
    np.testing.assert_allclose(search.best, wanted, rtol=1e-6)
    assert np.isfinite(wanted).sum() > len(goals)


def test_a_start_at_the_goal_costs_nothing_and_has_no_steps():
    lattice = LATTICES[0]
    state = states_of(lattice, 7, 7)[2]
    search = searched(FakeCosts(lattice, 0, 0.0), {state: 0.0}, [state])
    assert search.closed[state] and search.best[state] == 0 and search.path_to(state) == []
