"""Plans by the action space: over a plane, around a wall, never over unknown ground, and what is said without one."""

import math

import numpy as np
import pytest

from tests.planning.sites import NODES, SPACING, parted, plane, walled
from travjax.config import InputError
from travjax.planning.action_space import ActionSpacePlanner, State, TrajectorySearch
from travjax.planning.no_path import NoPathError
from travjax.planning.path import PosedLeg, drive
from travjax.planning.planner import Planner
from travjax.simulation.actions import ActionSpace
from travjax.site.ground import ArrayGround

ORIGIN = (100.0, 200.0)
START, GOAL = (101.6, 202.05), (101.93, 206.4)
FEW = ActionSpace(turns=8, arc_lengths=(0.6, 0.6), radii=(math.inf, 0.8, -0.8))
"""An action space for small sites, for which the tests are quick."""

SHORT_WALL = walled(gap=4.5)
AROUND = (102.6, 202.0, 1.0), (102.6, 206.4, -2.0)
"""A wall on the west side of a site, and two points on either side of it, not far from its end."""


def planner(heights: np.ndarray, actions: ActionSpace = FEW, contact: str = "nearest", **options) -> ActionSpacePlanner:
    """A planner of a small site."""
    site = ArrayGround(heights.astype(np.float32), 1000.0, SPACING, ORIGIN)
    return ActionSpacePlanner(Planner(site, contact=contact), actions, quiet=True, **options)


def bumpy() -> np.ndarray:
    """Ground with stones that some trajectories fail on."""
    rng = np.random.default_rng(3)
    ground = plane()
    ground[rng.integers(22, 45, 12), rng.integers(4, 24, 12)] = 0.3
    return ground


# ---- Paths


@pytest.mark.parametrize(("actions", "longer"), [(ActionSpace(), 1.04), (FEW, 1.12)])
def test_over_a_plane_the_path_is_nearly_straight(actions, longer):
    found = planner(plane(), actions).plan(START, GOAL)
    assert math.dist(START, GOAL) - 0.13 <= found.path.length <= longer * math.dist(START, GOAL)
    assert found.checks["poses that exceed a limit"] == found.checks["motions refused before"] == 0
    turned = sum(leg.turned for leg in found.legs)
    assert found.cost == pytest.approx(found.path.length + 0.3 * turned, abs=1e-6)


def test_a_path_may_have_more_states_than_python_has_stack():
    pose, state = np.zeros(3), State(np.zeros(3))
    legs = [PosedLeg(str(number), False, pose[None], 0.0, 0.0) for number in range(3000)]
    for leg in legs:
        state = State(pose, legs=(leg,), before=state)
    assert state.path() == legs


def test_the_path_begins_exactly_at_the_start_and_ends_near_the_goal():
    found = planner(plane()).plan((*START, 1.0), (*GOAL, -2.0))
    np.testing.assert_allclose(found.path.pose[0], [*START, 1.0], atol=1e-9)
    assert math.dist(found.path.pose[-1, :2], GOAL) <= 0.125 + 1e-9
    assert found.path.pose[-1, 2] == pytest.approx(2 * math.pi - 2.0)
    assert [(point.x, point.y) for point in found.points] == [START, GOAL]


def test_poses_follow_each_other_without_a_jump():
    path = planner(SHORT_WALL).plan(*AROUND).path
    away = np.hypot(*np.diff(path.pose[:, :2], axis=0).T)
    turned = np.abs(np.remainder(np.diff(path.pose[:, 2]) + math.pi, 2 * math.pi) - math.pi)
    assert away.max() <= 0.06 + 1e-9
    assert turned.max() <= math.radians(5) + 1e-9
    turning = np.array(["turn" in name for name in path.motion])[1:]
    assert (turned[turning] > 0).all() and (away[turning] == 0).all() and (away[~turning] > 0).all()
    assert path.distance[-1] == pytest.approx(away.sum(), rel=1e-3)


def test_the_path_leads_around_a_wall_and_each_pose_is_safe():
    found = planner(SHORT_WALL).plan(*AROUND)
    x, y = found.path.pose[:, :2].T - np.reshape(ORIGIN, (2, 1))
    assert (x[(y > 3.5) & (y < 4.5)] > 3.5).all()
    assert not found.path.exceeds.any() and found.path.known.all() and found.path.share.max() <= 1


def test_what_the_sequential_simulators_refuse_is_not_driven():
    planned = planner(bumpy())
    found = planned.plan(START, GOAL)
    assert found.checks["motions refused before"] > 0
    path, _ = drive(found.legs, found.legs[0].at[0], planned.costs.ground, planned.site)
    assert not path.exceeds.any()
    np.testing.assert_array_equal(path.pose, found.path.pose)


def test_point_turns_sweep_over_no_obstacle():
    ground = plane()
    ground[35, 29] = 0.5  # ahead and to the left, where a corner of the robot would sweep over it
    at = np.array([4.0, 4.0, math.radians(-5)])
    turn, _ = TrajectorySearch(planner(plane()), at, at)._turns(at)
    np.testing.assert_allclose(np.degrees(turn), [5, 50, 95, 140, -175, -130, -85, -40], atol=1e-6)
    turn, _ = TrajectorySearch(planner(ground), at, at)._turns(at)
    np.testing.assert_allclose(np.degrees(turn), [5, np.inf, np.inf, np.inf, np.inf, np.inf, -85, -40], atol=1e-6)


def test_a_goal_at_the_start_needs_no_motion():
    found = planner(plane()).plan(START, (START[0] + 0.05, START[1]))
    assert found.legs == () and found.cost == 0 and len(found.path.z) == 1


def test_a_goal_is_reached_close_to_a_wall_behind_it():
    goal = (ORIGIN[0] + 1.5, ORIGIN[1] + 3.0)
    found = planner(walled(), ActionSpace()).plan((ORIGIN[0] + 1.5, ORIGIN[1] + 1.0), goal)
    assert math.dist(found.path.pose[-1, :2], goal) <= 0.125 + 1e-9
    assert not found.path.exceeds.any()


def test_points_may_be_rows_and_columns_of_nodes():
    found = planner(plane()).plan((16, 12), (48, 16), "rowcol")
    np.testing.assert_allclose(found.path.pose[0, :2], [ORIGIN[0] + 1.5, ORIGIN[1] + 2.0], atol=1e-9)


# ---- None


@pytest.mark.parametrize(("heights", "reason"), [(parted(), "unknown ground"), (walled(gap=0.0), "step")])
def test_where_there_is_no_way_the_search_gives_up_and_says_why(heights, reason):
    why = rf"gave up after 40 trajectories; .* trajectories that fail: .*{reason}"
    with pytest.raises(NoPathError, match=why) as error:
        planner(heights, most=40).plan(START, GOAL)
    rows = np.nonzero(error.value.reached.places.any(axis=1))[0]
    assert rows.min() >= 0 and rows.max() * 0.25 < 4.0
    assert error.value.reached.frontier.shape == error.value.reached.places.shape


def test_a_search_ends_where_nothing_leads_on():
    ground = np.full((NODES, NODES), np.nan)
    ground[8:24, 4:22] = 0.0  # the robot can stand there and turn, and no trajectory fits
    ground[40:60, 4:22] = 0.0
    with pytest.raises(NoPathError, match="nothing is left to go on from"):
        planner(ground, ActionSpace()).plan(START, (ORIGIN[0] + 1.6, ORIGIN[1] + 6.3))


def test_a_start_and_a_goal_where_the_robot_cannot_stand_are_named():
    on_the_wall = (ORIGIN[0] + 3.0, ORIGIN[1] + 3.8)
    with pytest.raises(InputError, match=r"start = .*the robot cannot stand there"):
        planner(walled()).plan(on_the_wall, GOAL)
    with pytest.raises(NoPathError, match=r"goal = .*the robot cannot stand there"):
        planner(walled()).plan(START, on_the_wall)
    with pytest.raises(InputError, match=r"goal = .*on the site"):
        planner(walled()).plan(START, (0.0, 0.0))


def test_unknown_ground_cannot_have_a_cost():
    site = ArrayGround(plane().astype(np.float32), 0.0, SPACING)
    with pytest.raises(InputError, match="unknown_cost = 2"):
        ActionSpacePlanner(Planner(site, unknown_cost=2.0))


# ---- Legs of any poses


def test_a_leg_of_poses_is_driven_like_any_other():
    planned = planner(plane())
    poses = np.column_stack([np.full(5, 3.0), np.linspace(3, 3.2, 5), np.zeros(5)])
    path, owner = drive([PosedLeg("forward", False, poses, 0.2, 0.0)], poses[0], planned.costs.ground, planned.site)
    assert owner == [0] * 5 and set(path.motion) == {"forward"} and path.length == pytest.approx(0.2)
    np.testing.assert_allclose(path.share, 0, atol=1e-9)
    np.testing.assert_allclose(path.z, 1000)
