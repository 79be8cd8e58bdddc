"""The contact model tyre: the batched kernel against its sequential reference, and grounds whose margins are known."""

import math
from dataclasses import replace

import jax
import numpy as np
import pytest

import travjax
from tests.conftest import HUSKY, LEO_ROVER, SEEKUR_JR
from travjax.config import InputError
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.setup import Setup
from travjax.traversal import tyre_reference
from travjax.traversal.traverse import failures, margins_of, places_of, simulate
from travjax.traversal.tyre_trajectories import turn_poses

STRAIGHT = ActionSpace(turns=8, radii=(math.inf,), interval=0.1)
ONE_AHEAD = replace(STRAIGHT, turns=1)
AHEAD_AND_BACK = ActionSpace(turns=2, radii=(math.inf,), interval=0.3)
SPACINGS = (0.04, 0.0625, 0.1)

SETUPS = {
    "Seekur Jr": Setup.chosen(SEEKUR_JR, ActionSpace(turns=6, radii=(math.inf, 1.2, -1.2)), Grid(), "tyre"),
    "Husky, odd turns": Setup.chosen(HUSKY, ActionSpace(turns=5, interval=0.11), Grid(), "tyre"),
    "Leo Rover, unpaired radii, coarse": Setup.chosen(
        replace(LEO_ROVER, nose_rise=0.03, overhang_height=0.06, max_roll=0.3),
        ActionSpace(turns=6, radii=(math.inf, 1.5, -0.9), interval=0.1),
        Grid(8, 0.1),
        "tyre",
    ),
    "without turns, fine": Setup.chosen(
        SEEKUR_JR, ActionSpace(turns=4, radii=(2.0, -2.0), interval=0.3), Grid(8, 0.05), "tyre", turn=False
    ),
}


PLANES = (10, 28, 40, 60)
"""Degrees."""


@pytest.fixture(scope="module", params=SETUPS)
def case(request):
    """A setup, three rough maps of its grid, one with a hole, and PLANES, and their margins."""
    setup = SETUPS[request.param]
    x, y = np.meshgrid(setup.grid.axis(), setup.grid.axis())
    maps = np.stack([*(rough(setup.grid, seed) for seed in range(3)), *(plane(x, y, degrees) for degrees in PLANES)])
    maps = maps.astype(np.float32)
    maps[1, 20:24, 60:64] = np.nan
    return setup, maps, places_of(maps, setup)


def rough(grid: Grid, seed: int) -> np.ndarray:
    """Waves, noise and terraces, [rows, cols] float32 metres."""
    x, y = np.meshgrid(grid.axis(), grid.axis())
    noise = np.random.default_rng(seed).standard_normal(grid.shape)
    waves = 0.15 * np.sin(2 * x + seed) * np.cos(1.5 * y) + 0.1 * np.round(np.sin(x + 2 * y))
    return (waves + 0.02 * noise).astype(np.float32)


def some_of(count: int, of: int) -> list[int]:
    return np.random.default_rng(0).permutation(of)[:count].tolist()


# Against the reference


def test_margins_are_those_of_the_sequential_reference(case):
    setup, maps, (margins, _) = case
    sample = some_of(8, len(setup.actions))
    for index, heights in enumerate(maps[:3]):
        expected = tyre_reference.simulate(
            heights, setup.robot, setup.actions, sample, setup.grid.spacing, turn=setup.contact.turn
        )
        np.testing.assert_array_equal(np.asarray(margins.known)[index, sample], expected.known)
        for event in ("step", "obstacle", "tilt"):
            found = np.asarray(margins[event])[index, sample]
            np.testing.assert_allclose(found, getattr(expected, event), rtol=0, atol=1e-5, err_msg=event)
    assert not np.asarray(margins.known)[1].all(), "a trajectory crosses the hole"


def test_where_is_where_the_pose_by_pose_simulation_has_the_margin(case):
    setup, maps, (margins, where) = case
    robot, actions, grid = setup.robot, setup.actions, setup.grid
    options = dict(grid=grid, contact="tyre", turn=setup.contact.turn)
    for trajectory in some_of(3, len(actions)):
        poses = travjax.traverse(maps[0], trajectory, robot, actions, **options)
        for event, name in enumerate(("step", "obstacle", "tilt")):
            pose, node = np.asarray(where.pose)[0, trajectory, event], np.asarray(where.node)[0, trajectory, event]
            along = getattr(poses, name)
            assert along[pose + poses.turning] == pytest.approx(along.max(), abs=1e-5)
            assert along.max() == pytest.approx(float(margins[name][0, trajectory]), abs=1e-5)
            if name != "tilt":
                at = poses.step_node if name == "step" else poses.obstacle_node
                there = maps[0][tuple(node)], maps[0][tuple(at[pose + poses.turning])]
                assert tuple(node) == tuple(at[pose + poses.turning]) or there[0] == pytest.approx(there[1], abs=0.3)


def test_unknown_trajectories_are_nowhere(case):
    _, _, (margins, where) = case
    unknown = ~np.asarray(margins.known)
    assert (np.asarray(where.pose)[unknown] == -1).all() and (np.asarray(where.node)[unknown] == -1).all()
    assert np.isnan(np.asarray(margins.events())[unknown]).all()


def test_margins_do_not_depend_on_the_batch_or_on_asking_where(case):
    setup, maps, (margins, _) = case
    for index, one in enumerate(maps[:3]):
        alone, together = margins_of(one, setup).events(), np.asarray(margins.events())[index]
        np.testing.assert_allclose(alone, together, rtol=0, atol=1e-6)


def test_a_mirrored_map_has_the_margins_of_the_mirrored_trajectories(case):
    setup, maps, (margins, _) = case
    if not any(view.mirrored for view in setup.views):
        pytest.skip("this action space is not its own mirror image")
    mirrored, _ = places_of(maps[:, :, ::-1], setup)  # margins_of would have to be compiled
    view = next(view for view in setup.views if view.mirrored and not view.turned)
    true = view.trajectories(setup.actions)
    np.testing.assert_allclose(np.asarray(mirrored.events()), np.asarray(margins.events())[:, true], rtol=0, atol=2e-6)


# Grounds whose margins are known, all of a grid in one batch

KERBS = (0, 20, 45, 70, 90)
WITHIN = {
    "tyre's edge": lambda x, y: 1.5 * ((x > 0.37) & (x < 0.43)),
    "tyre": lambda x, y: 1.5 * ((x > 0.25) & (x < 0.36)),
    "ahead of the chassis": lambda x, y: 1.5 * (y > 3.3 + 0.53),  # at the end of the path, within the overall length
    "rock": lambda x, y: 0.3 * (np.hypot(x - 0.3, y - 1.5) < 0.1),
}


def plane(x, y, degrees: float):
    return math.tan(math.radians(degrees)) * (0.6 * x + 0.8 * y)


def kerb(x, y, towards: float, height: float = 0.13):
    sin, cos = math.sin(math.radians(towards)), math.cos(math.radians(towards))
    return height * (x * sin + y * cos > 0.9)


def rock_beside(x, y):
    return 0.3 * (np.hypot(x - 0.6, y) < 0.1)


@pytest.fixture(scope="module", params=SPACINGS)
def grounds(request):
    """Margins by name of the ground, [8] trajectories each, at one spacing."""
    grid = Grid(8, request.param)
    x, y = np.meshgrid(grid.axis(), grid.axis())
    named = {("plane", degrees): plane(x, y, degrees) for degrees in PLANES}
    named |= {("kerb", towards): kerb(x, y, towards) for towards in KERBS}
    named |= {("within", name): ground(x, y) for name, ground in WITHIN.items()}
    named |= {"rock beside": rock_beside(x, y), "stairs": 0.17 * np.floor(y / 0.28)}
    named |= {"trench": -0.5 * (np.abs(y - 1.5) < 0.51 * grid.spacing)}
    margins = simulate(np.stack(list(named.values())), SEEKUR_JR, STRAIGHT, grid=grid, contact="tyre")
    return {name: jax.tree.map(lambda field: np.asarray(field)[i], margins) for i, name in enumerate(named)}  # noqa: B023


@pytest.mark.parametrize("degrees", PLANES)
def test_a_plane_has_no_step_its_own_tilt_and_no_obstacle(grounds, degrees):
    assert_plane(grounds["plane", degrees], degrees)


def test_a_plane_is_a_plane_for_other_robots_and_on_arcs(case):
    setup, _, (margins, _) = case
    robot = setup.robot
    lower = robot.ride_height - (robot.overhang_height or robot.ride_height)
    for index, degrees in enumerate(PLANES, start=3):
        assert_plane(jax.tree.map(lambda field: np.asarray(field)[index], margins), degrees, lower)  # noqa: B023


def assert_plane(margins, degrees: float, lower: float = 0) -> None:
    """No step, the plane's tilt, and no obstacle but by how much the outline is lower than the chassis."""
    assert np.max(margins.step) < 1e-5
    np.testing.assert_allclose(np.degrees(margins.tilt), degrees, atol=0.01)
    np.testing.assert_allclose(margins.obstacle, lower, rtol=0, atol=1e-5)


@pytest.mark.parametrize("towards", KERBS)
def test_a_kerb_has_its_height_from_any_direction_and_at_any_spacing(grounds, towards):
    step = grounds["kerb", towards].step
    assert 0 < (step > 0).sum() < len(step)
    np.testing.assert_allclose(step[step > 0], 0.13, atol=1e-6)


@pytest.mark.parametrize("name", WITHIN)
def test_what_lies_within_the_outline_is_never_safe(grounds, name):
    assert np.asarray(failures(grounds["within", name], SEEKUR_JR))[0].any()


def test_a_point_turn_meets_a_rock_beside_the_robot(grounds):
    failed = np.asarray(failures(grounds["rock beside"], SEEKUR_JR))[:, :2].any(axis=-1)
    assert failed[4] and not failed[0], "half a turn, and none"


def test_point_turns_can_be_left_out():
    x, y = np.meshgrid(Grid().axis(), Grid().axis())
    margins = simulate(rock_beside(x, y), SEEKUR_JR, AHEAD_AND_BACK, contact="tyre", turn=False)
    assert not np.asarray(failures(margins, SEEKUR_JR))[1].any(), "after half a turn"


def test_stairs_fail_and_a_narrow_trench_does_not(grounds):
    assert grounds["stairs"].step[0] == pytest.approx(0.17, abs=1e-5)
    assert grounds["trench"].step[0] == 0 and grounds["trench"].tilt[0] < 0.02


LOW = replace(SEEKUR_JR, nose_rise=None, max_step=0.5)
"""All of its outline is as low as its chassis."""


@pytest.fixture(scope="module")
def bump_and_post() -> np.ndarray:
    """Ahead of the chassis at the end of the path, and there between chassis and tyre: [2, 129, 129] metres."""
    x, y = np.meshgrid(Grid().axis(), Grid().axis())
    bump = 0.2 * ((np.abs(x) < 0.2) & (y > 3.3 + 0.5))
    post = 0.15 * ((np.abs(x - 0.25) < 0.02) & (np.abs(y - 3.75) < 0.02))
    return np.stack([bump, post])


@pytest.fixture(scope="module")
def under_low(bump_and_post):
    """Margins of LOW straight on: [2, 1]."""
    return simulate(bump_and_post, LOW, ONE_AHEAD, contact="tyre", turn=False)


def test_the_ends_of_the_body_may_rise(bump_and_post, under_low):
    high = replace(LOW, nose_rise=0.15)
    assert bool(failures(under_low, LOW)[0, 0, 1])
    assert not bool(failures(simulate(bump_and_post, high, ONE_AHEAD, contact="tyre", turn=False), high)[0, 0, 1])


def test_what_is_beside_the_chassis_counts_with_its_own_height(bump_and_post, under_low):
    above = simulate(bump_and_post, replace(LOW, overhang_height=0.3), ONE_AHEAD, contact="tyre", turn=False)
    assert float(under_low.obstacle[1, 0]) == pytest.approx(0.15, abs=1e-5) and above.obstacle[1, 0] <= 0


@pytest.mark.parametrize(
    ("spacing", "heights", "cells"), [(0.0625, (0.26, 0.2), 2), (0.1, (0.28,), 2), (0.04, (0.25,), 3)]
)
def test_a_steep_face_of_a_few_cells_is_a_step_for_small_wheels(spacing, heights, cells):
    grid = Grid(8, spacing)
    y = np.broadcast_to(grid.axis()[:, None], grid.shape)
    faces = [height * np.clip((y - 10 * spacing) / (cells * spacing), 0, 1) for height in heights]
    margins = simulate(np.stack(faces), LEO_ROVER, ONE_AHEAD, grid=grid, contact="tyre", turn=False)
    assert np.min(margins.step) > LEO_ROVER.max_step


# Point turns


def test_turns_go_the_shorter_way_in_parts_of_at_most_five_degrees():
    headings, passed, left = turn_poses(ActionSpace())
    assert len(headings) == 72 and np.allclose(np.diff(np.degrees(headings)), 5)
    degrees = np.degrees(headings)
    assert set(degrees[passed[2]].round()) == {0, 5, 10, 15, 20, 25, 30, 35, 40}
    assert set(degrees[passed[17]].round()) == {0, 355, 350, 345, 340}
    assert passed[9].sum() == 37 and degrees[passed[9]].max() == pytest.approx(180)
    assert left[2][passed[2]].tolist() == [8, 7, 6, 5, 4, 3, 2, 1, 0] and left[17][0] == 4


# Choosing it


def test_the_robots_file_decides_unless_an_argument_does():
    ground = rough(Grid(), 0)
    own = replace(SEEKUR_JR, contact="tyre")
    by_file = simulate(ground, own, AHEAD_AND_BACK, turn=False)
    by_argument = simulate(ground, SEEKUR_JR, AHEAD_AND_BACK, contact="tyre", turn=False)
    np.testing.assert_array_equal(by_file.step, by_argument.step)
    paper = simulate(ground, own, AHEAD_AND_BACK, contact="nearest")
    np.testing.assert_array_equal(paper.step, simulate(ground, SEEKUR_JR, AHEAD_AND_BACK).step)
    assert not np.array_equal(paper.step, by_file.step)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"turn": "no"}, "turn = 'no': must be true or false"),
        ({"contact": ""}, "contact = '': must be"),
        ({"contact": "wheel"}, 'contact = "?\'?wheel.*: must be "nearest" or "tyre"'),
        ({"robot": replace(SEEKUR_JR, wheelbase=1.3)}, "nose_rise = 0.1: must be left out where overall_length is at"),
        ({"robot": replace(SEEKUR_JR, overall_width=0.4)}, "overall_width = 0.4: must be at least chassis_width"),
        ({"actions": ActionSpace(arc_lengths=(1.65, 1.8))}, "outline leaves the map"),
    ],
)
def test_bad_input_is_named(change, message):
    arguments = {"robot": SEEKUR_JR, "actions": ONE_AHEAD, "contact": "tyre"} | change
    with pytest.raises(InputError, match=message):
        simulate(np.zeros(Grid().shape), **arguments)
