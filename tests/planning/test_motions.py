"""Motions: they end on places, keep to their radius, and lose no state of an open plane."""

import math
from itertools import product

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from tests.planning.oracle import length_of, turned_by
from travjax.config import InputError
from travjax.planning.biarcs import biarc
from travjax.planning.motions import FARTHEST, MOST_TURN, Motion, MotionLattice, Motions
from travjax.site.primitives import PointTurn

LATTICES = [
    MotionLattice(),
    MotionLattice(Motions(radius=0.5), 8, 0.25),
    MotionLattice(Motions(radius=0.5, point_turns=False), 8, 0.5),
    MotionLattice(Motions(radius=0.5, point_turns=False), 12, 0.25),
    MotionLattice(Motions(point_turns=False), 16, 0.25),
    MotionLattice(Motions(radius=0.5, point_turns=False), 24, 0.25),
    MotionLattice(Motions(point_turns=False, reverse=True), 16, 0.25),
    MotionLattice(Motions((0,), point_turns=True), 16, 0.25),
    MotionLattice(Motions((0, 1), 0.5, point_turns=False), 8, 0.25),  # a robot that cannot turn to the right
    MotionLattice(Motions((0, 2, -2, 4, -4), 0.5), 16, 0.3),
    MotionLattice(Motions((0, 3, -3), 0.5, point_turns=False), 16, 0.25),
    MotionLattice(Motions(radius=0.5), 4, 0.25),
]


def name(lattice: MotionLattice) -> str:
    motions = lattice.motions
    how = f"{'with' if motions.point_turns else 'without'}-point-turns{'-reverse' if motions.reverse else ''}"
    return f"{lattice.headings}-{'/'.join(map(str, motions.turns))}-{how}"


def steps(motion: Motion, motions: Motions) -> list[tuple[int, int, int, int]]:
    """Where a motion leads: heading before and after, rows and columns."""
    there = [(motion.heading, motion.end, motion.rows, motion.cols)]
    if isinstance(motion.primitive, PointTurn) or motions.reverse:
        there.append((motion.end, motion.heading, -motion.rows, -motion.cols))
    return there


def parts_of_window(lattice: MotionLattice, half: int) -> np.ndarray:
    """Numbers of the parts of an open window within which every state reaches every other: [rows, cols, headings]."""
    count, headings = 2 * half + 1, lattice.headings
    row, col = np.divmod(np.arange(count**2), count)
    begins, ends = [], []
    for motion in lattice.all:
        for before, after, rows, cols in steps(motion, lattice.motions):
            inside = (0 <= row + rows) & (row + rows < count) & (0 <= col + cols) & (col + cols < count)
            begins.append((row * count + col)[inside] * headings + before)
            ends.append(((row + rows) * count + col + cols)[inside] * headings + after)
    begin, end = np.concatenate(begins), np.concatenate(ends)
    graph = csr_array((np.ones(len(begin), bool), (begin, end)), shape=(count**2 * headings,) * 2)
    return connected_components(graph, connection="strong")[1].reshape(count, count, headings)


@pytest.mark.parametrize("lattice", LATTICES, ids=name)
def test_every_state_of_an_open_plane_can_be_reached(lattice):
    half = max(12, math.ceil(lattice.headings * max(map(length_of, lattice.drives)) / lattice.stride / 3))
    parts = parts_of_window(lattice, half)
    middle = parts[
        half - 1 : half + 2, half - 1 : half + 2
    ]  # with its neighbours in all headings, and so on from there
    assert (middle == parts[half, half, 0]).all()


@pytest.mark.parametrize(
    ("turns", "headings", "point_turns", "share"),
    [
        ((0, 2, -2), 16, False, "50%"),  # of the headings
        ((0, 4, -4), 12, False, None),  # turns by more than 90 degrees
        ((2, -2), 16, False, "12%"),
        ((3, -3), 16, False, "25%"),  # all headings, but not at all places
        ((0,), 16, False, "0%"),
        ((1,), 16, False, "0%"),  # round and round
        ((0, 1, -1), 6, True, "50%"),
        ((0,), 1, True, "0%"),
        ((0, 1, -1), 3, True, None),
        ((5,), 16, True, None),
    ],
)
def test_motions_that_lose_states_are_refused(turns, headings, point_turns, share):
    allowed = (
        "such that every heading and place can be reached" if share else f"at most {headings // 4} of {headings} he"
    )
    with pytest.raises(InputError, match=rf"^turns = .*: must be {allowed}") as error:
        MotionLattice(Motions(turns, 0.5, point_turns), headings, 0.25)
    assert share is None or str(error.value).endswith(f"with {headings} headings {share} can")


def test_what_is_refused_for_half_its_states_has_no_more(monkeypatch):
    monkeypatch.setattr("travjax.planning.motions._require_all_reached", lambda lattice: None)
    for turns, headings, share in (((0, 2, -2), 16, 2), ((3, -3), 16, 4), ((0, 1, -1), 6, 2)):
        lattice = MotionLattice(Motions(turns, 0.5, point_turns=headings == 6), headings, 0.25)
        parts, half = parts_of_window(lattice, 40), 40
        middle = parts[half - 2 : half + 2, half - 2 : half + 2]
        assert np.mean(middle == middle[0, 0, 0]) == pytest.approx(1 / share)


@pytest.mark.parametrize("lattice", LATTICES, ids=name)
def test_motions_lead_in_all_directions(lattice):
    """Some way of going through all motions, each at least once, leads back to where it began."""
    ways = [step for motion in lattice.all for step in steps(motion, lattice.motions)]
    flow = np.zeros((lattice.headings + 2, len(ways)))
    for number, (before, after, rows, cols) in enumerate(ways):
        flow[before, number] += 1
        flow[after, number] -= 1
        flow[-2:, number] = rows, cols
    assert linprog(np.zeros(len(ways)), A_eq=flow, b_eq=np.zeros(len(flow)), bounds=(1, None)).success


@pytest.mark.parametrize("lattice", LATTICES, ids=name)
def test_motions_begin_and_end_in_states(lattice):
    for motion in lattice.all:
        poses = motion.primitive.poses(0.06)
        np.testing.assert_allclose(poses[0], [0, 0, lattice.angles[motion.heading]], atol=1e-12)
        end = motion.cols * lattice.stride, motion.rows * lattice.stride
        np.testing.assert_allclose(poses[-1, :2], end, atol=1e-11)
        assert abs(math.remainder(poses[-1, 2] - lattice.angles[motion.end], 2 * math.pi)) < 1e-11
        assert motion.length == pytest.approx(length_of(motion), abs=1e-9)
        assert motion.turned == pytest.approx(turned_by(motion), abs=1e-8)
        if isinstance(motion.primitive, PointTurn):
            assert np.diff(poses[:, 2]).max() <= min(2 * math.pi / lattice.headings / 4, math.radians(5)) + 1e-12


@pytest.mark.parametrize("lattice", LATTICES[::3], ids=name)
def test_drives_are_the_shortest_that_keep_the_radius(lattice):
    line = range(-FARTHEST, FARTHEST + 1)
    for motion in lattice.drives[:: max(1, len(lattice.drives) // 12)]:
        turn = math.remainder(lattice.angles[motion.end] - lattice.angles[motion.heading], 2 * math.pi)
        shortest = math.inf
        for rows, cols in product(line, line):
            if (rows, cols) == (0, 0):
                continue
            start = lattice.angles[motion.heading]
            arcs = biarc(start, np.array([cols, rows]) * lattice.stride, start + turn)
            if arcs is None or min(abs(arc.radius) for arc in arcs) < lattice.motions.radius - 1e-9:
                continue
            if abs(sum(arc.turn for arc in arcs) - turn) < 1e-6 and sum(abs(a.turn) for a in arcs) <= MOST_TURN + 1e-9:
                shortest = min(shortest, sum(arc.length for arc in arcs))
        assert motion.length == pytest.approx(shortest, abs=1e-9)


@pytest.mark.parametrize("headings", [8, 12, 16])
def test_drives_turned_by_a_right_angle_are_as_long(headings):
    lattice = MotionLattice(Motions(radius=0.5, turns=(0, 1, -1, headings // 4)), headings, 0.25)
    for drives in (lattice.straights, *np.array_split(np.array(lattice.curves), 3)):
        lengths = np.array([motion.length for motion in drives]).reshape(4, -1)
        np.testing.assert_allclose(lengths, lengths[:1].repeat(4, axis=0), atol=1e-9)


def test_a_quarter_of_a_circle_keeps_its_radius():
    lattice = MotionLattice(Motions(radius=0.5), 4, 0.25)
    for motion in lattice.curves:
        assert (abs(motion.rows), abs(motion.cols)) == (2, 2)
        assert motion.length == pytest.approx(math.pi / 4)


def test_costs_are_those_of_the_docstring():
    lattice = MotionLattice(Motions(radius=0.5, turning=0.7, reverse=True, reversing=3), 8, 0.25)
    for motion, cost in zip(lattice.all, lattice.costs, strict=True):
        assert cost == pytest.approx(length_of(motion) + 0.7 * turned_by(motion))
    moves = lattice.moves
    real = moves.motion >= 0
    turns = np.array([isinstance(motion.primitive, PointTurn) for motion in lattice.all])
    reversing = (moves.backwards == 1) & ~turns[moves.motion]
    assert (moves.factor[real] == np.where(reversing, 3, 1)[real]).all()
    assert real.sum() == 2 * len(lattice.all)


@pytest.mark.parametrize("lattice", LATTICES, ids=name)
def test_moves_and_moves_back_are_the_same_steps(lattice):
    def listed(moves, back: bool) -> list[tuple]:
        found = []
        for heading, step in zip(*np.nonzero(moves.motion >= 0), strict=True):
            rows, cols, end = moves.rows[heading, step], moves.cols[heading, step], moves.end[heading, step]
            begin = moves.from_rows[heading, step], moves.from_cols[heading, step]
            how = moves.motion[heading, step], moves.factor[heading, step], moves.backwards[heading, step]
            if back:  # seen from the place where the step begins
                found.append((end, heading, -rows, -cols, begin[0] - rows, begin[1] - cols, *how))
            else:
                found.append((heading, end, rows, cols, *begin, *how))
        return sorted(tuple(map(float, one)) for one in found)

    wanted = [step for motion in lattice.all for step in steps(motion, lattice.motions)]
    forwards = listed(lattice.moves, back=False)
    assert forwards == listed(lattice.moves_back, back=True)
    assert sorted(one[:4] for one in forwards) == sorted(tuple(map(float, one)) for one in wanted)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (dict(turns=()), "turns = ()"),
        (dict(turns=(0, 0)), "different from each other"),
        (dict(turns=(0.5,)), "turns = 0.5: must be a whole number"),
        (dict(radius=0), "radius = 0"),
        (dict(radius=math.nan), "radius = nan"),
        (dict(point_turns=1), "point_turns = 1: must be true or false"),
        (dict(turning=-1), "turning = -1: must be a number from 0"),
        (dict(risk=math.inf), "risk = inf"),
        (dict(reversing=0.9), "reversing = 0.9: must be a number from 1"),
    ],
)
def test_wrong_motions_are_named(values, message):
    with pytest.raises(InputError, match=message.replace("(", r"\(").replace(")", r"\)")):
        Motions(**values)


def test_a_radius_that_no_drive_within_reach_keeps_is_named():
    with pytest.raises(
        InputError, match=r"^radius = 20: must be a radius that a drive from 0 degrees by 1 of 16 headi"
    ):
        MotionLattice(Motions(radius=20))


def test_motions_are_read_from_a_file(tmp_path):
    file = tmp_path / "motions.toml"
    file.write_text("turns = [0, 2, -2]\nradius = 0.7\nreverse = true\n")
    assert Motions.load(file) == Motions((0, 2, -2), 0.7, reverse=True)
