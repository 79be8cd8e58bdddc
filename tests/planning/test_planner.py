"""Plans: where they begin, pass and end, what their paths are, and what is said where there is none."""

import math

import numpy as np
import pytest

import travjax
from tests.planning.sites import NODES, SETTINGS, SPACING, parted, plane, walled
from travjax.config import InputError
from travjax.planning.endpoints import endpoint
from travjax.planning.judges import UNKNOWN
from travjax.planning.motions import Motions
from travjax.planning.no_path import NoPathError
from travjax.planning.planner import Planner, plan
from travjax.planning.to_go import CostToGo
from travjax.site.ground import ArrayGround

START, GOAL = (2.0, 1.5), (2.0, 6.5)


def planner(heights: np.ndarray, **changes) -> Planner:
    """A planner of a small site, whose south-west node lies at (0, 0)."""
    settings = {name: value for name, value in SETTINGS.items() if name != "spacing"}
    return Planner(ArrayGround(heights.astype(np.float32), 0.0, SPACING), **(settings | changes))


@pytest.fixture(scope="module")
def around_the_wall() -> travjax.Plan:
    return planner(walled()).plan(START, GOAL)


# ---- Paths


def test_on_level_ground_the_path_is_straight_and_costs_its_length():
    found = plan(plane(), START, GOAL, **SETTINGS)
    assert found.cost == pytest.approx(5.0) and found.path.length == pytest.approx(5.0)
    assert set(found.path.motion) == {"straight"}
    np.testing.assert_allclose(found.path.pose[[0, -1]], [[*START, 0], [*GOAL, 0]], atol=1e-9)
    assert found.checks == {
        "poses simulated": len(found.path.z),
        "poses that exceed a limit": 0,
        "poses on unknown ground": 0,
        "motions refused before": 0,
    }


def test_the_path_leads_around_a_wall(around_the_wall):
    x, y = around_the_wall.path.pose[:, :2].T
    assert (x[(y > 3.5) & (y < 4.5)] > 6.25).all()
    assert around_the_wall.path.length > 9


def test_rows_follow_each_other_without_a_jump(around_the_wall):
    path = around_the_wall.path
    away = np.hypot(*np.diff(path.pose[:, :2], axis=0).T)
    turned = np.abs(np.remainder(np.diff(path.pose[:, 2]) + math.pi, 2 * math.pi) - math.pi)
    assert away.max() <= 0.06 + 1e-9
    assert turned[away < 1e-9].max(initial=0) <= 2 * math.pi / 8 / 4 + 1e-9
    assert turned[away > 0].max() < 0.07  # 6 cm of an arc of 1 m
    assert np.all(np.diff(path.distance) >= away - 1e-9)


def test_steps_are_zero_at_the_start_and_in_turns():
    ground = np.random.default_rng(0).normal(scale=0.01, size=(NODES, NODES))
    found = planner(ground).plan((2.0, 2.0, math.pi), (2.0, 6.0, math.pi / 2))
    turning = np.array([name.startswith("turn") for name in found.path.motion])
    assert turning.any() and found.path.step[0] == 0 and (found.path.step[turning] == 0).all()
    assert (found.path.step[1:][~turning[1:]] > 0).any() and (found.path.tilt[turning] > 0).all()


def test_heights_of_the_path_are_those_of_the_site():
    y = np.arange(NODES)[:, None] * SPACING
    found = planner(np.broadcast_to(0.1 * y + 712.0, (NODES, NODES))).plan(START, GOAL)
    np.testing.assert_allclose(found.path.z, 712 + 0.1 * found.path.pose[:, 1], atol=0.1 * SPACING)
    assert np.degrees(found.path.tilt).max() == pytest.approx(
        math.degrees(math.atan(0.1)), abs=1.2
    )  # wheels go by the nearest node


def test_a_given_heading_is_kept_at_both_ends():
    found = planner(plane()).plan((*START, math.pi / 2), (*GOAL, -math.pi / 2))
    assert found.path.pose[0, 2] == pytest.approx(math.pi / 2)
    assert found.path.pose[-1, 2] == pytest.approx(3 * math.pi / 2)


def test_points_to_pass_are_passed_in_their_order():
    found = planner(plane()).plan(START, GOAL, via=[(6.0, 2.0), (6.0, 6.0)])
    passed = [np.hypot(*(found.path.pose[:, :2] - point).T).argmin() for point in ((6.0, 2.0), (6.0, 6.0))]
    assert passed[0] < passed[1]
    assert [point.name for point in found.points] == ["start", "via 1", "via 2", "goal"]


def test_a_path_to_where_one_is_has_one_pose():
    found = planner(plane()).plan(START, START)
    assert found.cost == 0 and len(found.path.z) == 1 and found.path.motion == ("none",) and not found.legs


def test_a_robot_that_may_reverse_backs_out_of_where_it_cannot_turn():
    motions = Motions(point_turns=False, reverse=True, radius=1.0)
    found = planner(plane(), motions=motions).plan((4.0, 4.0, 0.0), (4.0, 3.0, 0.0))
    assert set(found.path.motion) == {"reverse_straight"}
    assert found.cost == pytest.approx(2.0) and found.path.length == pytest.approx(1.0)


def test_a_motion_that_the_sequential_simulators_refuse_is_left_out(monkeypatch):
    planned = planner(plane())
    straight = planned.plan(START, GOAL)
    from travjax.planning import planner as module

    drive, refused = module.drive, []

    def refusing(legs, *rest):
        path, owner = drive(legs, *rest)
        if not refused:
            refused.append(legs[3])
            path.exceeds[owner.index(3)] = True
        return path, owner

    monkeypatch.setattr(module, "drive", refusing)
    found = planned.plan(START, GOAL)
    assert refused[0] not in found.legs and found.cost > straight.cost
    assert found.checks["motions refused before"] == 1


# ---- Where there is none


def test_no_path_leads_over_unknown_ground_unless_it_may():
    closed = planner(parted())
    with pytest.raises(NoPathError, match="unknown ground or the site's edge 100%") as caught:
        closed.plan(START, GOAL)
    reached = caught.value.reached
    assert reached.nearest[0] * 0.25 < 4 and set(np.unique(reached.frontier)) == {0, UNKNOWN}
    found = planner(parted(), unknown_cost=1.0).plan(START, GOAL)
    assert (~found.path.known).sum() == found.checks["poses on unknown ground"] > 0
    assert np.isnan(found.path.tilt[~found.path.known]).all()
    assert found.cost > 5.0


def test_the_reason_is_the_wall():
    with pytest.raises(NoPathError) as caught:
        planner(walled(gap=0)).plan(START, GOAL)
    error = caught.value
    assert "even if headings did not matter" in str(error)
    assert "obstacle" in str(error) or "step" in str(error) or "tilt" in str(error)
    assert error.reached.places[6, 8] and not error.reached.places[26, 8]
    beside = error.reached.frontier[error.reached.nearest[0] + 1 :, error.reached.nearest[1]]
    assert beside[0] in (1, 2, 3)


def test_a_goal_that_headings_bar_is_told_apart_from_one_that_nothing_reaches():
    motions = Motions(turns=(0, 1, -1), point_turns=False, radius=1.5)
    ground = walled(gap=1.0)
    ground[:, NODES - 22 : NODES - 20] = 1.0  # a corridor beside the edge, too narrow to enter it by an arc
    ground[:20, NODES - 22 : NODES - 20] = 0.0
    with pytest.raises(NoPathError) as caught:
        planner(ground, motions=motions).plan((2.0, 1.5, math.pi), (7.5, 6.5, math.pi))
    assert "no path from start (2, 1.5) to goal (7.5, 6.5)" in str(caught.value)
    assert "even if headings did not matter" not in str(caught.value)


def test_a_start_that_fails_is_refused_with_the_nearest_that_works():
    with pytest.raises(
        InputError, match=r"start = \(2.0, 4.0\): the robot cannot stand there in any heading"
    ) as caught:
        planner(walled()).plan((2.0, 4.0), GOAL)
    assert "the nearest place where it can is (" in str(caught.value)


def test_a_goal_that_fails_has_no_path():
    with pytest.raises(NoPathError, match=r"goal = \(2.0, 4.0\): the robot cannot stand there"):
        planner(walled()).plan(START, (2.0, 4.0))


# ---- Points


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((9.0, 2.0), r"start = \(9.0, 2.0\): must be on the site, from \(0, 0\) to \(8, 8\); it is at \(9, 2\)"),
        ((2.0,), "start = .*: must be two numbers, or three with a heading"),
        ("2 3", "start = '2 3': must be two numbers"),
        ((math.nan, 2.0), "start = nan: must be finite numbers"),
        ((2.0, "north"), "start = 'north': must be finite numbers"),
    ],
)
def test_points_off_the_site_and_other_values_are_refused(given, message):
    with pytest.raises(InputError, match=message):
        planner(plane()).plan(given, GOAL)


def test_rows_and_columns_count_nodes_from_the_south_west():
    costs = planner(plane()).costs
    point = endpoint("goal", (8, 16), costs, "rowcol")
    assert (point.x, point.y, point.row, point.col) == (2.0, 1.0, 4, 8)


def test_latitude_and_longitude_are_those_of_the_sites_system():
    from pyproj import Transformer

    ground = ArrayGround(plane().astype(np.float32), 0.0, SPACING, (500_000.0, 5_000_000.0), "EPSG:32632")
    costs = Planner(ground, headings=8, contact="nearest").costs
    east, north = 500_003.0, 5_000_002.0
    longitude, latitude = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True).transform(east, north)
    point = endpoint("goal", (latitude, longitude), costs, "latlon")
    assert (point.col, point.row) == (12, 8)
    with pytest.raises(InputError, match="the site has no coordinate system"):
        endpoint("goal", (latitude, longitude), planner(plane()).costs, "latlon")
    with pytest.raises(InputError, match="degrees of latitude"):
        endpoint("goal", (longitude + 100, latitude), costs, "latlon")


# ---- The cost to go


def test_the_cost_to_go_answers_every_start():
    planned = planner(walled())
    to_go = CostToGo(planned, GOAL)
    for start in ((2.0, 1.5), (6.0, 2.0), (1.0, 7.0), (2.0, 1.5, math.pi)):
        direct, by_table = planned.plan(start, GOAL), to_go.plan(start)
        assert by_table.cost == pytest.approx(direct.cost, abs=1e-9)
        assert by_table.path.pose[0, :2] == pytest.approx(start[:2])
    row, col = (round(value / 0.25) for value in (1.5, 2.0))
    assert to_go.best[row, col] == pytest.approx(planned.plan(START, GOAL).cost)
    assert np.isinf(to_go.best[16, 4]) and np.isnan(to_go.direction[16, 4])
    assert to_go.best[26, 8] == 0
    assert to_go.direction[26, 4] == pytest.approx(3 * math.pi / 2)  # east, straight to the goal


def test_the_cost_to_go_leads_on_where_point_turns_cost_nothing():
    to_go = CostToGo(planner(plane(), motions=Motions(turning=0.0, reverse=True)), (4.0, 4.0))
    row, col = np.array([(16, 8), (24, 16), (16, 24), (8, 16)]).T  # west, north, east, south of the goal
    np.testing.assert_allclose(to_go.direction[row, col], np.radians([270, 180, 90, 0]), atol=1e-9)


def test_no_path_in_the_cost_to_go_is_an_error_like_that_of_a_plan():
    to_go = CostToGo(planner(walled(gap=0)), GOAL)
    with pytest.raises(NoPathError, match="no path from start"):
        to_go.plan(START)
    with pytest.raises(NoPathError, match="goal = .*cannot stand there"):
        CostToGo(planner(walled()), (2.0, 4.0))


def test_unknown_ground_hides_no_wall_and_no_edge_of_the_site():
    hidden = walled(gap=0)
    hidden[27:31] = hidden[34:38] = np.nan  # the wall in the shadow of its own scan
    with pytest.raises(NoPathError, match="obstacle|step|tilt"):
        planner(hidden, unknown_cost=1.0).plan(START, GOAL)
    with pytest.raises(NoPathError):  # not around it either, half off the site
        planner(walled(gap=0), unknown_cost=1.0).plan(START, GOAL)
