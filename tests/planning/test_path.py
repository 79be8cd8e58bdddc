"""Paths: legs that join, poses at the interval, and what the sequential simulators say of them on the whole site."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tests.planning.oracle import check_path
from travjax.planning.motions import MotionLattice, Motions
from travjax.planning.path import Leg, drive
from travjax.simulation.robot import Robot
from travjax.site.ground import ArrayGround
from travjax.site.kernel import SiteSetup
from travjax.site.primitives import PointTurn

ROBOT = Robot.load("leo_rover")
LATTICE = MotionLattice(Motions(radius=0.5, reverse=True), 16, 0.25)


@pytest.fixture(scope="module")
def ground() -> ArrayGround:
    """Rough ground of 150 x 193 nodes with holes, in coordinates of a map."""
    rng = np.random.default_rng(2)
    heights = 0.3 * gaussian_filter(rng.normal(size=(150, 193)), 3) + 0.02 * np.arange(193)
    heights[rng.random(heights.shape) < 0.01] += 0.1
    heights[70:90, 30:33] = np.nan
    return ArrayGround(heights.astype(np.float32), 1800.25, 0.0625, (354.125, -520.5))


def wandering(count: int, rows: int, cols: int, seed: int) -> list[Leg]:
    """Random legs that follow each other within a lattice of places: drives, drives backwards, turns."""
    rng, moves = np.random.default_rng(seed), LATTICE.moves
    row, col, heading = rows // 2, cols // 2, 0
    legs = []
    while len(legs) < count:
        step = int(rng.integers(moves.motion.shape[1]))
        to_row, to_col = row + int(moves.rows[heading, step]), col + int(moves.cols[heading, step])
        if moves.motion[heading, step] < 0 or not (0 <= to_row < rows and 0 <= to_col < cols):
            continue
        begins = row + int(moves.from_rows[heading, step]), col + int(moves.from_cols[heading, step])
        motion = LATTICE.all[moves.motion[heading, step]]
        legs.append(Leg(*begins, motion, bool(moves.backwards[heading, step])))
        row, col, heading = to_row, to_col, int(moves.end[heading, step])
    return legs


@pytest.mark.parametrize("contact", ["nearest", "tyre"])
def test_poses_are_what_the_sequential_simulators_say_on_the_whole_site(ground, contact):
    setup = SiteSetup(replace(ROBOT, max_roll=0.3), (PointTurn(0.0),), interval=0.09, contact=contact)
    legs = wandering(90, *setup.lattice(ground.shape), seed=1)
    path, owner = drive(legs, legs[0].poses(1, setup.stride)[0], ground, setup)
    check_path(path, legs, ground, setup, LATTICE.headings)
    assert path.known.any() and not path.known.all()
    assert path.exceeds.any() and not path.exceeds[path.known].all()
    assert {leg.name for leg in legs} == {
        *("straight", "left", "right", "turn_left", "turn_right"),
        *("reverse_straight", "reverse_left", "reverse_right"),
    }
    assert owner == sorted(owner) and owner[-1] == len(legs) - 1


def test_parts_of_the_site_are_cut_out_without_a_trace(ground, monkeypatch):
    setup = SiteSetup(ROBOT, (PointTurn(0.0),), interval=0.2, contact="nearest")
    legs = wandering(60, *setup.lattice(ground.shape), seed=4)
    path, _ = drive(legs, legs[0].poses(1, setup.stride)[0], ground, setup)
    for window in (0.3, 100.0):
        monkeypatch.setattr("travjax.planning.path.WINDOW", window)
        other, _ = drive(legs, legs[0].poses(1, setup.stride)[0], ground, setup)
        for name in ("pose", "z", "step", "obstacle", "tilt", "known", "distance"):
            np.testing.assert_allclose(getattr(other, name), getattr(path, name), atol=1e-9)


def test_a_path_without_legs_is_one_pose(ground):
    setup = SiteSetup(ROBOT, (PointTurn(0.0),), contact="nearest")
    path, owner = drive([], np.array([5.0, 4.0, 1.0]), ground, setup)
    assert len(path.pose) == 1 and owner == [0] and path.motion == ("none",) and path.length == 0
    np.testing.assert_allclose(path.pose[0], [359.125, -516.5, 1.0])
    check_path(path, [], ground, setup, 16)


def test_legs_backwards_have_the_same_poses_the_other_way_round():
    for motion in LATTICE.all[::5]:
        there, back = (Leg(3, 4, motion, backwards).poses(0.06, 0.25) for backwards in (False, True))
        np.testing.assert_array_equal(there, back[::-1])
        assert math.hypot(there[0, 0] - 1.0, there[0, 1] - 0.75) == 0
