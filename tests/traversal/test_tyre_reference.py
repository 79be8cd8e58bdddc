"""The sequential simulator of the contact model tyre against planes, kerbs, walls, stairs, trenches and symmetries."""

import math
from dataclasses import replace

import numpy as np
import pytest

from travjax import ActionSpace, Robot
from travjax.traversal import tyre_reference as tyre
from travjax.traversal.reference import label

ROBOT = replace(Robot.load("seekur_jr"), nose_rise=None)
RADIUS = ROBOT.wheel_diameter / 2.0
SPACINGS = [0.04, 0.0625, 0.1]
STRAIGHT = ActionSpace(turns=4, arc_lengths=(0.3, 0.3), radii=(math.inf,), interval=0.06)
CURVED = ActionSpace(turns=18, arc_lengths=(0.5, 0.4), radii=(math.inf, 0.6, -0.6), interval=0.1)
POSES = [(0.0, 0.0, 0.0), (0.13, -0.21, 0.4), (-0.3, 0.017, 2.0), (0.05, 0.11, math.radians(45.0))]


class Carrier:
    """The Seekur Jr with other numbers, also such that Robot does not have."""

    def __init__(self, **changes):
        self.__dict__.update(vars(ROBOT) | changes)


def nodes(spacing, half=2.0):
    """Coordinates x, y [rows, cols] of the nodes of a map in metres."""
    places = np.arange(-round(half / spacing), round(half / spacing) + 1) * spacing
    return np.meshgrid(places, places)


def plane(spacing, degrees, azimuth, half=2.0):
    x, y = nodes(spacing, half)
    return math.tan(math.radians(degrees)) * (x * math.cos(azimuth) + y * math.sin(azimuth))


def kerb(spacing, height, azimuth=math.pi / 2.0, distance=0.55, half=2.0):
    """Flat ground, and from `distance` metres on in the direction `azimuth` ground that is `height` metres higher."""
    x, y = nodes(spacing, half)
    return height * (x * math.cos(azimuth) + y * math.sin(azimuth) > distance + 1e-6)


def inner(steps, spacing):
    """Steps of nodes from which the whole reach of the definition lies on the map."""
    margin = math.ceil(2.0 * RADIUS / spacing) + 1
    return steps[margin:-margin, margin:-margin]


def simulated(heights, actions=STRAIGHT, trajectory=0, spacing=0.0625, robot=ROBOT, turn=True):
    return tyre.simulate_trajectory(heights, robot, actions, trajectory, spacing, turn)


def failures(margins):
    return label(tyre.Margins(*(np.array([value]) for value in vars(margins).values())), ROBOT)[0].tolist()


# Poses of the point turn


@pytest.mark.parametrize(
    ("k", "end", "count"), [(0, 0.0, 1), (1, 20.0, 5), (9, 180.0, 37), (10, -160.0, 33), (17, -20.0, 5)]
)
def test_the_turn_goes_the_shorter_way_in_parts_of_five_degrees(k, end, count):
    turned = tyre.turn_poses(CURVED, k * 9)
    np.testing.assert_allclose(turned[:, 2], np.radians(np.linspace(0.0, end, count)), atol=1e-12)
    assert not turned[:, :2].any()


def test_parts_of_a_turn_are_equal_and_at_most_five_degrees():
    turned = tyre.turn_poses(ActionSpace(turns=7, arc_lengths=(0.3, 0.3), radii=(math.inf,)), 1)
    parts = np.degrees(np.diff(turned[:, 2]))
    np.testing.assert_allclose(parts, 360.0 / 7.0 / 11.0)


# Planes


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("degrees", [0.0, 25.0, 40.0, 50.0, 60.0])
def test_planes_have_their_tilt_no_step_and_no_obstacle(spacing, degrees):
    for azimuth in np.radians([0.0, 33.0, 90.0, 135.0, 260.0]):
        heights = plane(spacing, degrees, azimuth)
        ground = tyre.ground_of(heights, ROBOT, spacing)
        assert inner(ground.steps, spacing).max() < 1e-9
        for pose in POSES:
            state = tyre.pose_state(ground, ROBOT, *pose, spacing)
            assert state.step < 1e-9
            assert state.tilt == pytest.approx(math.radians(degrees), abs=1e-9)
            assert state.clearance == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("trajectory", [0, 44, 85, 160])
def test_trajectories_on_a_plane(trajectory):
    margins = simulated(plane(0.0625, 30.0, 1.0), CURVED, trajectory)
    assert margins.step < 1e-9
    assert margins.obstacle <= 1e-9
    assert margins.tilt == pytest.approx(math.radians(30.0), abs=1e-9)
    assert margins.known


@pytest.mark.parametrize("spacing", SPACINGS)
def test_steps_of_a_plane_are_zero_up_to_the_edges_of_the_map(spacing):
    steps = tyre.step_heights(plane(spacing, 40.0, 0.7), RADIUS, spacing)
    corner = 2 * math.floor(RADIUS / spacing + 1e-9)  # there both before and after may be off the map
    for rows in (slice(None, corner), slice(-corner, None)):
        steps[rows, :corner] = steps[rows, -corner:] = 0.0
    assert steps.max() < 1e-9


# Kerbs, walls, stairs, trenches


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("azimuth", np.radians([90.0, 75.0, 52.0, 45.0, 120.0]))
@pytest.mark.parametrize("height", [0.05, 0.11, 0.2])
def test_the_step_of_a_kerb_is_its_height(spacing, azimuth, height):
    margins = simulated(kerb(spacing, height, azimuth), spacing=spacing)
    assert margins.step == pytest.approx(height, abs=1e-9)
    assert failures(margins)[0] is (height > ROBOT.max_step)


@pytest.mark.parametrize("spacing", SPACINGS)
def test_down_a_kerb_counts_as_up(spacing):
    margins = simulated(kerb(spacing, 0.11, -math.pi / 2.0, -0.55), spacing=spacing)
    assert margins.step == pytest.approx(0.11, abs=1e-9)


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("degrees", [10.0, 30.0])
def test_a_kerb_up_or_along_a_slope_keeps_its_height(spacing, degrees):
    for azimuth in (math.pi / 2.0, 0.0):
        heights = plane(spacing, degrees, azimuth) + kerb(spacing, 0.15)
        steps = inner(tyre.step_heights(heights, RADIUS, spacing), spacing)
        assert steps.max() == pytest.approx(0.15, abs=1e-9)


def test_a_node_under_a_tyre_counts_only_where_the_tyre_reaches_it():
    """A kerb's first upper node 0.25 m before a wheel's centre is 0.15 m behind the tyre's lowest line at most."""
    for ahead, touched in ((0.15, True), (0.21, False), (0.25, False)):
        spacing = 0.01
        heights = kerb(spacing, 0.11, distance=ROBOT.wheelbase / 2.0 + ahead, half=1.0)
        state = tyre.pose_state(tyre.ground_of(heights, ROBOT), ROBOT, 0.0, 0.0, 0.0, spacing)
        assert (state.step > 0.0) is touched


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("shift", np.arange(0.37, 0.431, 0.01))
def test_a_wall_in_the_band_of_a_tyre_is_never_safe(spacing, shift):
    """The wall begins at the first node from `shift` on whose cell the tyre overlaps, or is one node thick."""
    x, _ = nodes(spacing)
    first = np.ceil(shift / spacing - 1e-9) * spacing
    if first - spacing / 2.0 > (ROBOT.track + ROBOT.wheel_width) / 2.0:
        first -= spacing
    for wall in (x > first - 1e-6, np.abs(x - first) < 1e-6):
        margins = simulated(1.5 * wall, spacing=spacing)
        assert failures(margins)[0]
        assert margins.step == pytest.approx(1.5, abs=1e-9)


@pytest.mark.parametrize("x", np.linspace(0.37, 0.43, 7))
def test_a_wall_anywhere_in_the_band_is_never_safe_on_fine_maps(x):
    east, _ = nodes(0.02, half=1.5)
    margins = simulated(1.5 * (east > x - 1e-6), spacing=0.02, trajectory=0, turn=False)
    assert any(failures(margins)) == (x < 0.4275)  # half a cell beside the tyre


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("quarter", range(4))
def test_a_wall_before_the_nose_at_the_end_of_the_path_is_never_safe(spacing, quarter):
    """It stands within the overall length, beyond the chassis where the grid has such a node, and beyond the tyres."""
    x, y = nodes(spacing)
    right, forward = [(x, y), (y, -x), (-x, -y), (-y, x)][quarter]
    end = 0.6 + ROBOT.overall_length / 2.0 + spacing / 2.0  # a node stands for its cell
    first = np.floor(end / spacing + 1e-9) * spacing
    assert first > 0.6 + ROBOT.wheelbase / 2.0 + RADIUS
    margins = simulated(1.5 * (forward > first - 1e-6), trajectory=quarter, spacing=spacing)
    assert failures(margins)[1]
    beyond = simulated(1.5 * (forward > first + spacing - 1e-6), trajectory=quarter, spacing=spacing)
    assert not any(failures(beyond))


@pytest.mark.parametrize("angle", np.radians(np.arange(0.0, 360.0, 17.0)))
def test_a_rock_beside_a_robot_that_turns_is_never_safe(angle):
    heights = np.zeros((65, 65))
    heights[32 + round(0.4 * math.sin(angle) / 0.0625), 32 + round(0.4 * math.cos(angle) / 0.0625)] = 0.3
    back = ActionSpace(turns=2, arc_lengths=(0.06, 0.06), radii=(math.inf,), interval=0.06)
    assert any(failures(simulated(heights, back, 1)))


def test_a_turn_sees_what_its_start_and_end_do_not():
    heights = np.zeros((65, 65))
    heights[32, 41] = 0.3  # 0.56 m to the right
    back = ActionSpace(turns=2, arc_lengths=(0.06, 0.06), radii=(math.inf,), interval=0.06)
    assert any(failures(simulated(heights, back, 1)))
    assert not any(failures(simulated(heights, back, 1, turn=False)))


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("azimuth", np.radians([90.0, 60.0, 45.0]))
def test_stairs_fail_by_step(spacing, azimuth):
    x, y = nodes(spacing)
    along = x * math.cos(azimuth) + y * math.sin(azimuth) - 0.5
    heights = 0.17 * np.clip(np.ceil(along / 0.28), 0, None)
    margins = simulated(heights, spacing=spacing)
    assert margins.step >= 0.17 - 1e-9
    assert failures(margins)[0]


@pytest.mark.parametrize("along", [False, True])
def test_a_trench_of_one_node_is_no_step(along):
    heights = np.zeros((65, 65))
    if along:
        heights[:, 37] = -0.3
    else:
        heights[40] = -0.3
    margins = simulated(heights)
    assert margins.step == 0.0
    assert not any(failures(margins))


@pytest.mark.parametrize("spacing", SPACINGS)
def test_a_rise_within_the_radius_is_one_step(spacing):
    """It takes two cells, each of which alone is as steep as the other; a long bank is a slope."""
    _, y = nodes(spacing)
    rise = 0.3 * np.clip(y / (2.0 * spacing), 0.0, 1.0)
    assert tyre.step_heights(rise, RADIUS, spacing).max() == pytest.approx(0.3)
    bank = 0.7 * np.clip(y, 0.0, 1.0)
    assert inner(tyre.step_heights(bank, RADIUS, spacing), spacing).max() < 1e-9


def test_a_trench_wider_than_the_radius_is_a_step():
    for count, step in ((2, 0.0), (3, 0.3)):
        heights = np.zeros((65, 65))
        heights[40 : 40 + count] = -0.3
        assert tyre.step_heights(heights, RADIUS).max() == step
        assert simulated(heights).step == step


def test_a_stone_of_one_node_has_its_height():
    heights = np.zeros((65, 65))
    heights[38, 37] = 0.13
    steps = tyre.step_heights(heights, RADIUS)
    assert steps[38, 37] == pytest.approx(0.13)
    assert np.count_nonzero(steps) == 1
    assert simulated(heights).step == pytest.approx(0.13)


def test_filling_gaps_leaves_planes_and_edges_as_they_are():
    downhill = kerb(0.1, 0.2) + plane(0.1, -20.0, math.pi / 2)
    for heights in (plane(0.1, 30.0, 2.0), kerb(0.1, 0.2, 1.0), kerb(0.1, 1.0, 4.0, -0.3), downhill):
        for radius in (0.1, 0.2, 0.3, 0.5):
            found = tyre.filled(heights, radius, 0.1)
            middle = slice(5, -5)  # rims at the map's edge are level
            np.testing.assert_allclose(found[middle, middle], heights[middle, middle], atol=1e-12)


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize(("slope", "height"), [(0.2, 0.15), (0.4, 0.2), (0.7, 0.25)])
@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_a_kerb_whose_upper_side_is_downhill_loses_at_most_the_slope_of_a_cell(spacing, slope, height, degrees):
    azimuth = math.radians(degrees)
    heights = kerb(spacing, height, azimuth) + plane(spacing, -math.degrees(math.atan(slope)), azimuth)
    step = inner(tyre.step_heights(heights, RADIUS, spacing), spacing).max()
    assert height - slope * spacing - 1e-9 <= step <= height + 1e-9


def bank(spacing, degrees, azimuth, foot, length=math.inf):
    """Flat ground, and from `foot` metres on in the direction `azimuth` a bank, `length` metres long on the map."""
    x, y = nodes(spacing, half=1.2)
    along = x * math.cos(azimuth) + y * math.sin(azimuth) - foot
    return math.tan(math.radians(degrees)) * np.clip(along, 0.0, length)


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("degrees", [62.0, 68.0, 75.0, 80.0])
@pytest.mark.parametrize("azimuth", np.radians([0.0, 20.0, 45.0, 63.0]))
def test_a_steep_bank_under_the_right_wheels_is_never_safe(spacing, degrees, azimuth):
    """The robot drives along its foot or its crest, of which at most 0.03 m of the tyre's width is on the near side."""
    for foot in (0.0, 0.1, 0.2, 0.24, 0.27):
        for sign, length in ((1.0, math.inf), (1.0, 0.45), (-1.0, math.inf)):
            ground = tyre.ground_of(sign * bank(spacing, degrees, azimuth, foot, length), ROBOT, spacing)
            state = tyre.pose_state(ground, ROBOT, 0.0, 0.0, azimuth, spacing)
            assert any(failures(tyre.TrajectoryMargins(state.step, state.clearance, state.tilt, known=True)))


@pytest.mark.parametrize("spacing", SPACINGS)
def test_the_steps_of_a_steep_bank_lie_at_its_foot_and_do_not_depend_on_rounding(spacing):
    """Each of its rises over N cells from the flat is N (tan - 1) d larger than one of 45 degrees."""
    most = math.floor(RADIUS / spacing + 1e-9)
    for foot in np.arange(0, 6) * spacing:
        steps = tyre.step_heights(bank(spacing, 65.0, 0.0, foot), RADIUS, spacing)
        first = steps.shape[1] // 2 + round(foot / spacing) + 1
        expected = most * spacing * (math.tan(math.radians(65.0)) - 1.0)
        np.testing.assert_allclose(steps[5:-5, first : first + most], expected, atol=1e-9)


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("blurred", [0.5, 0.3, 0.25])
def test_a_drop_beside_the_tyre_is_no_step(spacing, blurred):
    """The last node before the drop is the first one that the tyre does not reach, or the one before it."""
    x, _ = nodes(spacing)
    edge = math.floor((ROBOT.track + ROBOT.wheel_width + spacing) / 2.0 / spacing + 1e-9) * spacing
    for last, step in ((edge + spacing, 0.0), (edge, 0.5)):
        drop = np.where(x > last + 1.5 * spacing, -0.5, np.where(x > last + 0.5 * spacing, -blurred, 0.0))
        margins = simulated(drop, spacing=spacing)
        assert margins.step == pytest.approx(step, abs=1e-9)
        assert failures(margins) == [step > 0.0, False, False]


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("middle", [0.1, 0.4, 0.9])
def test_a_blurred_kerb_keeps_its_height(spacing, middle):
    _, y = nodes(spacing)
    blurred = 0.25 * np.where(y > 0.5 + 1e-6, 1.0, np.where(y > 0.5 - spacing + 1e-6, middle, 0.0))
    for heights in (blurred, blurred.T, blurred[::-1], blurred.T[:, ::-1]):
        assert tyre.step_heights(heights, RADIUS, spacing).max() == pytest.approx(0.25)
    assert simulated(blurred, spacing=spacing).step == pytest.approx(0.25)


@pytest.mark.parametrize("spacing", SPACINGS)
def test_a_short_face_of_forty_degrees_is_no_step(spacing):
    """It is higher than the limit, but a wheel rolls up it; one of 50 degrees counts."""
    _, y = nodes(spacing)
    for degrees, most in ((40.0, 0.1), (50.0, None)):
        face = np.clip(math.tan(math.radians(degrees)) * y, 0.0, 0.16)
        step = tyre.step_heights(face, RADIUS, spacing).max()
        assert step < most + 1e-9 if most else step > 0.1


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("depth", [0.2, 2.0, 5.0])
def test_a_bridged_trench_under_the_wheels_does_not_bend_the_pose(spacing, depth):
    """A tyre spans a trench along it; into one across it sinks between the rims as far as its roundness allows."""
    x, y = nodes(spacing)
    for k in range(math.ceil(0.2 / spacing), math.floor(0.45 / spacing) + 1, 2):
        trench = np.where(np.abs(x - k * spacing) < spacing / 2.0, -depth, 0.0)
        state = tyre.pose_state(tyre.ground_of(trench, ROBOT, spacing), ROBOT, 0.0, 0.0, 0.0, spacing)
        assert (state.step, state.tilt) == (0.0, 0.0)
    across = simulated(np.where(np.abs(y - spacing * 5) < spacing / 2.0, -depth, 0.0), spacing=spacing)
    assert across.step == 0.0
    assert across.tilt < math.radians(1.0)


@pytest.mark.parametrize("spacing", SPACINGS)
def test_labels_are_the_same_at_every_spacing(spacing):
    grounds = {
        "plane": (plane(spacing, 36.0, 0.5), [False, False, False]),
        "steep": (plane(spacing, 38.0, 0.5), [False, False, True]),
        "low": (kerb(spacing, 0.1), [False, False, False]),
        "high": (kerb(spacing, 0.13), [True, True, False]),
        "wall": (kerb(spacing, 1.5, 0.3), [True, True, True]),
    }
    for name, (heights, expected) in grounds.items():
        assert failures(simulated(heights, spacing=spacing)) == expected, name


# The outline


def test_the_overhang_and_the_nose_have_their_own_clearance():
    """The node lies 0.5625 m ahead of the robot: beyond the chassis, within the outline."""
    heights = np.zeros((33, 33))
    heights[16 + 9, 16] = 0.15
    share = (9 * 0.0625 - ROBOT.wheelbase / 2.0) / ((ROBOT.overall_length - ROBOT.wheelbase) / 2.0)
    for changes, lower in (
        ({}, 0.0),
        ({"overhang_height": 0.128}, 0.02),
        ({"nose_rise": 0.05}, 0.05 * share),
        ({"overhang_height": 0.128, "nose_rise": 0.05}, 0.02 + 0.05 * share),
    ):
        state = tyre.pose_state(tyre.ground_of(heights, Carrier(**changes)), Carrier(**changes), 0.0, 0.0, 0.0)
        assert state.clearance == pytest.approx(0.15 - lower)
        assert state.clearance_node == (25, 16)


def test_ground_within_the_rectangle_of_a_tyre_is_no_obstacle():
    """A stone 0.1625 m before a wheel's centre, where the tyre's surface is 0.05 m high."""
    heights = np.zeros((33, 33))
    heights[16 + 6, 16 + 5] = 0.12
    state = tyre.pose_state(tyre.ground_of(heights, ROBOT), ROBOT, 0.0, 0.0, 0.0)
    assert state.step == pytest.approx(0.12)
    assert state.step_node == (22, 21)
    np.testing.assert_allclose(state.resting, [0.01, 0.06, 0.01, 0.01], atol=0.005)
    narrow = tyre.pose_state(tyre.ground_of(heights, ROBOT), Carrier(wheel_width=0.03), 0.0, 0.0, 0.0)
    assert narrow.clearance_node == (22, 21)  # beside the tyre's rectangle and within the outline
    assert state.clearance_node != (22, 21)
    assert state.clearance < narrow.clearance


def test_a_tyre_touches_half_a_cell_before_its_front():
    for forward, touched in ((7, True), (8, False)):  # 0.225 and 0.2875 m before a wheel's centre
        heights = np.zeros((33, 33))
        heights[16 + forward, 16 + 5] = 1.5
        assert (tyre.pose_state(tyre.ground_of(heights, ROBOT), ROBOT, 0.0, 0.0, 0.0).step == 1.5) is touched


@pytest.mark.parametrize("trajectory", range(4))
def test_an_outline_that_leaves_the_map_is_refused(trajectory):
    with pytest.raises(ValueError, match="the robot reaches"):
        simulated(np.zeros((39, 39)), trajectory=trajectory)
    assert simulated(np.zeros((41, 41)), trajectory=trajectory).known


# Unknown ground


def test_an_unknown_node_that_is_touched_makes_the_trajectory_unknown():
    for right, forward, known in ((7, 3, False), (0, 0, False), (6, 18, False), (0, -9, False), (8, 3, True)):
        heights = np.zeros((65, 65))
        heights[32 + forward, 32 + right] = np.nan
        margins = simulated(heights)
        assert margins.known is known
        assert np.isnan(margins.step) == (not known)


def test_the_turn_touches_unknown_ground_as_well():
    heights = np.zeros((65, 65))
    heights[32, 41] = np.nan
    back = ActionSpace(turns=2, arc_lengths=(0.06, 0.06), radii=(math.inf,), interval=0.06)
    assert not simulated(heights, back, 1).known
    assert simulated(heights, back, 1, turn=False).known


def test_steps_beside_unknown_ground():
    """What is unknown before or after a rise is taken from the other side, and unknown ground is no step itself."""
    slope = plane(0.0625, 35.0, math.pi / 2.0)
    slope[30] = np.nan
    steps = tyre.step_heights(slope, RADIUS)
    assert np.isnan(steps[30]).all()
    assert np.nanmax(steps[4:-4, 4:-4]) < 1e-9
    edge = kerb(0.0625, 0.2)
    edge[(slice(None), 20)] = np.nan
    assert np.nanmax(tyre.step_heights(edge, RADIUS)) == pytest.approx(0.2)


def test_a_map_of_unknown_ground():
    margins = simulated(np.full((65, 65), np.nan))
    assert not margins.known


# Symmetries


def rough(seed, scale=0.05):
    return scale * np.random.default_rng(seed).standard_normal((65, 65))


def values(margins):
    return [margins.step, margins.obstacle, margins.tilt]


@pytest.mark.parametrize("seed", range(3))
def test_mirrored_ground_and_trajectory(seed):
    heights = rough(seed)
    first = simulated(heights, CURVED, (4 * 3 + 1) * 3 + 2)
    mirrored = simulated(heights[:, ::-1], CURVED, (14 * 3 + 2) * 3 + 1)
    np.testing.assert_allclose(values(first), values(mirrored), atol=1e-12)


def test_ground_turned_by_180_degrees_without_the_turn():
    heights = rough(3)
    first = simulated(heights, CURVED, (4 * 3 + 1) * 3 + 2, turn=False)
    turned = simulated(heights[::-1, ::-1], CURVED, (13 * 3 + 1) * 3 + 2, turn=False)
    np.testing.assert_allclose(values(first), values(turned), atol=1e-12)


def test_a_site_offset_changes_nothing():
    heights = rough(4)
    low, high = simulated(heights, CURVED, 40), simulated(heights + 2000.0, CURVED, 40)
    np.testing.assert_allclose(values(low), values(high), atol=1e-9)


def test_many_trajectories_are_one_after_the_other():
    heights, done = rough(5), []
    margins = tyre.simulate(heights, ROBOT, CURVED, [3, 40], on_progress=done.append)
    assert done == [1, 2]
    for column, trajectory in enumerate((3, 40)):
        expected = simulated(heights, CURVED, trajectory)
        assert [margins.step[column], margins.obstacle[column], margins.tilt[column]] == values(expected)
    assert margins.known.all()
    assert len(tyre.simulate(np.zeros((41, 41)), ROBOT, STRAIGHT).step) == 4
