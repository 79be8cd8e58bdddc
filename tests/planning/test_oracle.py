"""The planner on small sites: a path where exhaustive search over the sequential simulators has one, and as cheap."""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tests.planning.oracle import Exhaustive, angle, check_plan
from travjax.planning.motions import Motions
from travjax.planning.no_path import NoPathError
from travjax.planning.planner import Plan, Planner
from travjax.simulation.robot import Robot
from travjax.site.ground import ArrayGround

ROBOT = replace(
    Robot.load("leo_rover"), chassis_length=0.66, max_step=0.1, overall_length=0.72, max_roll=math.radians(11)
)
"""Longer than wide, and easily turned over sideways."""

STRIDE, HEADINGS = 0.5, 8
USUAL = Motions(radius=0.5)
DRIVES = Motions(radius=0.5, point_turns=False)
BOTH_WAYS = Motions(radius=0.5, point_turns=False, reverse=True, reversing=1.5)

CONTACTS = ("nearest", "tyre")


def flat(rows: int = 65, cols: int = 65) -> np.ndarray:
    return np.zeros((rows, cols), np.float32)


def rough(seed: int, height: float = 0.05, rows: int = 73, cols: int = 66) -> np.ndarray:
    """Hills, blocks and holes."""
    rng = np.random.default_rng(seed)
    hills = gaussian_filter(rng.normal(size=(rows, cols)), 4)
    heights = hills / hills.std() * height + 0.1 * STRIDE / 8 * np.arange(cols)
    for _ in range(7):
        row, col, tall, wide = rng.integers((rows, cols, 6, 6))
        heights[row : row + tall, col : col + wide] += 0.25
    row, col = rng.integers((rows, cols))
    heights[row : row + 4, col : col + 5] = np.nan
    return heights.astype(np.float32)


def maze() -> np.ndarray:
    """Two walls, with a way round each."""
    heights = flat(121, 97)
    heights[38:40, :62] = heights[80:82, 35:] = 0.4
    return heights


def gap() -> np.ndarray:
    """A thick wall across with a gap of 0.6 m: the robot fits through along y, and cannot turn in it."""
    heights = flat()
    heights[26:39, :] = 0.4
    heights[26:39, 28:37] = 0
    return heights


def bank() -> np.ndarray:
    """A bank across, 20 degrees steep on both sides."""
    rise = np.clip(0.9 - np.abs(np.arange(65) - 32) * 0.0625, 0, None) * math.tan(math.radians(20))
    return np.repeat(rise[:, None], 65, axis=1).astype(np.float32)


def unknown_strip() -> np.ndarray:
    """Flat ground in two parts, with unknown ground between them and a way round in the east."""
    heights = flat(65, 81)
    heights[30:34, :64] = np.nan
    return heights


@lru_cache(maxsize=4)
def planners(site: str, contact: str, motions: Motions = USUAL, unknown_cost: float | None = None):
    """A site's planner, and the exhaustive one."""
    name, _, seed = site.partition(" ")
    heights = globals()[name](*([int(seed), 0.03 if contact == "nearest" else 0.08] if seed else []))
    ground = ArrayGround(heights, 12.5, 0.0625, (100.25, -40.0))
    planner = Planner(
        ground,
        ROBOT,
        motions,
        headings=HEADINGS,
        stride=STRIDE,
        contact=contact,
        interval=0.25,
        unknown_cost=unknown_cost,
    )
    return planner, Exhaustive(planner)


def compared(planner: Planner, oracle: Exhaustive, *points: tuple[int, ...]) -> Plan | None:
    """Plans past points (row, column, heading or none) of places, and compares with the exhaustive planner."""
    given = [
        (100.25 + col * STRIDE, -40 + row * STRIDE, *(2 * math.pi * h / HEADINGS for h in heading))
        for row, col, *heading in points
    ]
    wanted = oracle.cheapest([(row, col, heading[0] if heading else None) for row, col, *heading in points])
    try:
        plan = planner.plan(given[0], given[-1], given[1:-1])
    except NoPathError:
        assert wanted == math.inf
        return None
    assert plan.cost == pytest.approx(wanted, rel=1e-4, abs=1e-9)
    errors = check_plan(plan, planner)
    assert errors["share"] <= 1 + 1e-6
    numbers = [planner.lattice.all.index(leg.motion) for leg in plan.legs]
    factors = [planner.lattice.motions.reversing if leg.backwards and not leg.turning else 1.0 for leg in plan.legs]
    costs = [oracle.cost(number, leg.row, leg.col) for number, leg in zip(numbers, plan.legs, strict=True)]
    assert plan.cost == pytest.approx(np.dot(costs, factors), rel=1e-4, abs=1e-9)
    return plan


@pytest.mark.parametrize(
    ("contact", "seed", "motions"),
    [("nearest", 1, USUAL), ("nearest", 2, DRIVES), ("nearest", 3, BOTH_WAYS)],
)
def test_paths_over_rough_ground_are_found_where_there_are_any_and_are_the_cheapest(contact, seed, motions):
    planner, oracle = planners(f"rough {seed}", contact, motions)
    rng, found = np.random.default_rng(seed), []
    states = [state for state in np.ndindex(*oracle.shape, HEADINGS) if min(state[:2]) > 0 and oracle.stands(*state)]
    for number in range(12 if contact == "nearest" else 3):
        start, goal = (states[index] for index in rng.integers(len(states), size=2))
        either = slice(None) if number % 2 else slice(2)  # with headings, and without
        found.append(compared(planner, oracle, start[either], goal[either]) is not None)
    assert any(found)


@pytest.mark.parametrize("motions", [USUAL, BOTH_WAYS])
def test_mazes(motions):
    planner, oracle = planners("maze", "nearest", motions)
    plan = compared(planner, oracle, (2, 4), (13, 8, 0))
    assert plan is not None and plan.path.length > 9.5  # 5.9 m if there were no walls


def test_a_gap_is_passed_in_the_one_direction_in_which_it_is_wide_enough():
    planner, oracle = planners("gap", "nearest")
    plan = compared(planner, oracle, (2, 2), (6, 6))
    assert plan is not None
    inside = np.abs(plan.path.pose[:, 1] - (-40 + 2)) < 0.4
    assert inside.any()
    assert max(min(angle(h), angle(h - math.pi)) for h in plan.path.pose[inside, 2]) < 0.3
    assert compared(planner, oracle, (2, 2), (4, 4, 0)) is not None
    for heading in (2, 6):
        with pytest.raises(NoPathError, match="cannot stand there in heading"):
            planner.plan((101.25, -39), (102.25, -38, 2 * math.pi * heading / HEADINGS))
    planner, oracle = planners("gap", "nearest", DRIVES)
    assert compared(planner, oracle, (2, 2), (4, 4, 4)) is None  # it would have to turn round on the other side


@pytest.mark.parametrize("contact", CONTACTS)
def test_a_bank_is_crossed_straight_where_a_slant_would_turn_the_robot_over(contact):
    planner, oracle = planners("bank", contact)
    plan = compared(planner, oracle, (1, 1), (7, 7))
    assert plan is not None
    on_bank = plan.path.tilt > math.radians(17)
    assert on_bank.sum() >= 6
    assert max(min(angle(h), angle(h - math.pi)) for h in plan.path.pose[on_bank, 2]) < math.radians(40)
    on_a_slope = planner.costs.standing[0][:, 3, 4]
    assert np.isfinite(on_a_slope[[0, 4]]).all() and np.isinf(on_a_slope[1::2]).all()


@pytest.mark.parametrize("contact", CONTACTS)
def test_a_start_that_is_the_goal(contact):
    planner, oracle = planners("bank", contact)
    plan = compared(planner, oracle, (1, 3), (1, 3))
    assert plan is not None and plan.cost == 0 and plan.legs == () and len(plan.path.pose) == 1
    plan = compared(planner, oracle, (1, 3, 1), (1, 3, 4))
    assert plan is not None and [leg.name for leg in plan.legs] == ["turn_left"] * 3
    assert plan.cost >= 0.3 * 3 * math.pi / 4


@pytest.mark.parametrize("contact", CONTACTS)
def test_unknown_ground_is_crossed_only_where_that_has_a_price_and_is_cheaper(contact):
    points = (2, 1), (6, 1)
    ways = {}
    for unknown_cost in (None, 1.0, 10.0) if contact == "nearest" else (None, 1.0):
        planner, oracle = planners("unknown_strip", contact, DRIVES, unknown_cost)
        plan = compared(planner, oracle, *points)
        assert plan is not None
        ways[unknown_cost] = plan
    assert ways[None].path.known.all() and ways[None].path.length > 8
    assert not ways[1.0].path.known.all() and ways[1.0].path.length < 5
    assert contact == "tyre" or ways[10.0].path.known.all()


def test_points_on_the_way_are_passed_in_the_headings_that_suit_the_whole_path():
    planner, oracle = planners("maze", "nearest", USUAL)
    assert compared(planner, oracle, (2, 4), (3, 9), (13, 8)) is not None
    assert compared(planner, oracle, (2, 4, 0), (13, 4), (7, 6, 1), (3, 3)) is not None
    alone = compared(planner, oracle, (2, 4, 0), (3, 3, 4))
    past = compared(planner, oracle, (2, 4, 0), (3, 3), (3, 3, 4))
    assert alone is not None and past is not None and past.cost >= alone.cost - 1e-6


def test_a_robot_that_cannot_turn_on_the_spot_drives_backwards_out_of_a_dead_end():
    planner, oracle = planners("gap", "nearest", BOTH_WAYS)
    plan = compared(planner, oracle, (4, 4, 0), (2, 4, 0))
    assert plan is not None and {leg.name for leg in plan.legs} == {"reverse_straight"}
    assert plan.path.length == pytest.approx(1) and plan.cost >= 1.5


def test_costs_computed_beforehand_lead_to_the_same_path():
    planner, _ = planners("maze", "nearest", USUAL)
    lazy = planner.plan((102.25, -39), (104.25, -33.5))
    for row in range(0, planner.costs.shape[0], planner.costs.tile):
        planner.costs.evaluate([row * planner.costs.shape[1]])
    assert planner.costs.evaluated.all()
    ready = planner.plan((102.25, -39), (104.25, -33.5))
    assert ready.cost == lazy.cost and ready.legs == lazy.legs
