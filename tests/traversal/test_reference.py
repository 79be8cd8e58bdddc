"""The sequential simulator against hand-computed poses and grounds, and a whole-map least-squares oracle."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from travjax.traversal import reference

CELL = 0.0625
LENGTH = 1.65
TIGHTEST = 2.0 * LENGTH / math.pi
QUARTERS = range(4)


def seekur_jr(**changes):
    numbers = {
        "wheelbase": 0.425, "track": 0.663, "chassis_length": 1.051, "chassis_width": 0.440,
        "ride_height": 0.108, "max_step": 0.12, "max_tilt": math.atan(0.75),
    }  # fmt: skip
    return SimpleNamespace(**(numbers | changes))


def action_space(**changes):
    radii = [math.inf]
    for extra in (0.0, 0.1, 0.2, 0.5, 1.0, 1.8):
        radii += [TIGHTEST + extra, -(TIGHTEST + extra)]
    numbers = {"turns": 18, "arc_lengths": (LENGTH, LENGTH), "radii": tuple(radii), "interval": 0.06}
    return SimpleNamespace(**(numbers | changes))


def straight(**changes):
    """Point turns by 0, 90, 180, 270 degrees, then straight ahead: the trajectory index is the quarter."""
    return action_space(**({"turns": 4, "radii": (math.inf,)} | changes))


def flat():
    return np.zeros((129, 129))


def node(right, forward, quarter=0):
    """Index of the node (right, forward) cells from the centre in the frame turned by `quarter` x 90 deg."""
    for _ in range(quarter):
        right, forward = -forward, right
    return 64 + forward, 64 + right


def plane_map(slope_x, slope_y, shape=(129, 129)):
    rows, cols = np.indices(shape)
    return slope_x * CELL * (cols - shape[1] // 2) + slope_y * CELL * (rows - shape[0] // 2)


def rough_map(seed=0, shape=(129, 129), scale=0.1):
    return scale * np.random.default_rng(seed).standard_normal(shape)


def values(margins):
    return np.array([margins.step, margins.obstacle, margins.tilt])


# Poses


def test_every_trajectory_has_57_poses_from_the_origin():
    actions = action_space()
    for trajectory in range(0, 3042, 13):
        path = reference.poses(actions, trajectory)
        assert path.shape == (57, 3)
        assert path.dtype == np.float64
        np.testing.assert_allclose(path[0], [0.0, 0.0, 2.0 * math.pi * (trajectory // 169) / 18])


def test_straight_poses():
    path = reference.poses(action_space(), 0)
    distances = [0.06 * k for k in range(28)] + [LENGTH + 0.06 * k for k in range(28)] + [2.0 * LENGTH]
    np.testing.assert_allclose(path[:, 1], distances, atol=1e-12)
    np.testing.assert_allclose(path[:, [0, 2]], 0.0, atol=1e-12)


@pytest.mark.parametrize(("radius", "side"), [(1, -1.0), (2, 1.0)])
def test_quarter_circle(radius, side):
    path = reference.poses(action_space(), radius * 13)
    turned = 0.06 / TIGHTEST
    second = [side * TIGHTEST * (1.0 - math.cos(turned)), TIGHTEST * math.sin(turned), -side * turned]
    np.testing.assert_allclose(path[1], second, atol=1e-12)
    np.testing.assert_allclose(path[28], [side * TIGHTEST, TIGHTEST, -side * math.pi / 2.0], atol=1e-12)
    np.testing.assert_allclose(path[-1], [side * (TIGHTEST + LENGTH), TIGHTEST, -side * math.pi / 2.0], atol=1e-12)


def test_s_curve_of_two_quarter_circles():
    path = reference.poses(action_space(), 1 * 13 + 2)
    np.testing.assert_allclose(path[-1], [-2.0 * TIGHTEST, 2.0 * TIGHTEST, 0.0], atol=1e-12)


def test_point_turn_is_anticlockwise():
    actions = straight()
    ends = [reference.poses(actions, quarter)[-1] for quarter in QUARTERS]
    reach = 2.0 * LENGTH
    expected = [
        [0.0, reach, 0.0],
        [-reach, 0.0, 0.5 * math.pi],
        [0.0, -reach, math.pi],
        [reach, 0.0, 1.5 * math.pi],
    ]
    np.testing.assert_allclose(ends, expected, atol=1e-12)


def test_trajectory_index_counts_second_arc_fastest():
    actions = action_space()
    path = reference.poses(actions, (5 * 13 + 3) * 13 + 8)
    headings = np.cumsum([5 * math.radians(20.0), LENGTH / actions.radii[3], LENGTH / actions.radii[8]])
    np.testing.assert_allclose(path[[0, 28, -1], 2], headings, atol=1e-12)


@pytest.mark.parametrize(("length", "count"), [(0.6, 10), (0.61, 11), (0.66, 11), (0.3, 5), (0.05, 1)])
def test_arc_end_is_no_pose_of_its_own_before_the_junction(length, count):
    actions = straight(arc_lengths=(length, 0.06))
    path = reference.poses(actions, 0)
    assert path.shape == (count + 2, 3)
    np.testing.assert_allclose(path[-2:, 1], [length, length + 0.06], atol=1e-12)


@pytest.mark.parametrize("trajectory", [-1, 3042])
def test_trajectory_outside_the_action_space_is_refused(trajectory):
    with pytest.raises(ValueError, match="trajectory is"):
        reference.poses(action_space(), trajectory)


# Flat ground and constant slopes


@pytest.mark.parametrize("trajectory", [0, 500, 3041])
def test_flat_ground(trajectory):
    margins = reference.simulate_trajectory(np.full((129, 129), 3.7), seekur_jr(), action_space(), trajectory)
    assert margins == reference.TrajectoryMargins(0.0, 0.0, 0.0, True)


@pytest.mark.parametrize("quarter", QUARTERS)
@pytest.mark.parametrize("slope", [(0.3, 0.0), (0.0, -0.3), (0.2, 0.5), (-0.4, 0.1)])
def test_constant_slope_with_wheels_on_nodes_is_exact(quarter, slope):
    robot = seekur_jr(wheelbase=8 * CELL, track=10 * CELL)
    actions = straight(arc_lengths=(16 * CELL, 16 * CELL), interval=CELL)
    margins = reference.simulate_trajectory(plane_map(*slope), robot, actions, quarter)
    along = slope[1] if quarter % 2 == 0 else slope[0]
    assert margins.tilt == pytest.approx(math.atan(math.hypot(*slope)), abs=1e-12)
    assert margins.obstacle == pytest.approx(0.0, abs=1e-12)
    assert margins.step == pytest.approx(abs(along) * CELL, abs=1e-12)


@pytest.mark.parametrize("trajectory", [0, 1, 1234, 3041])
@pytest.mark.parametrize("slope", [(0.3, 0.0), (0.0, -0.3), (0.25, 0.4), (-0.4, 0.1)])
def test_constant_slope_within_the_error_of_the_nearest_node(trajectory, slope):
    """A contact node lies within half a cell of the wheel in x and in y, so a contact height is wrong by at
    most error = (|slope_x| + |slope_y|) cell / 2. The plane is linear in the contacts, exact for exact ones:
    contact i has the weight 1/4 +- u/(2t) +- v/(2b) in its value at (u, v), so that value is wrong by at most
    error times the sum of the absolute weights, which is convex and hence largest at a corner of the chassis.
    The weights of the contacts in p and q are 1/(2b) and 1/(2t), four each.
    """
    robot = seekur_jr()
    error = (abs(slope[0]) + abs(slope[1])) * CELL / 2.0
    roll = robot.chassis_width / (4.0 * robot.track)
    pitch = robot.chassis_length / (4.0 * robot.wheelbase)
    obstacle_bound = error * sum(abs(0.25 + i * roll + j * pitch) for i in (-1, 1) for j in (-1, 1))
    slope_bound = math.hypot(2.0 * error / robot.wheelbase, 2.0 * error / robot.track)

    margins = reference.simulate_trajectory(plane_map(*slope), robot, action_space(), trajectory)
    assert abs(margins.obstacle) <= obstacle_bound
    assert abs(math.tan(margins.tilt) - math.hypot(*slope)) <= slope_bound


# Edges and rocks


@pytest.mark.parametrize("quarter", QUARTERS)
@pytest.mark.parametrize("height", [0.15, -0.15])
def test_edge_across_the_path(quarter, height):
    """Both front wheels stand on the edge before the rear ones do."""
    heights = flat()
    for right in range(-64, 65):
        for forward in range(16, 65):
            heights[node(right, forward, quarter)] = height
    margins = reference.simulate_trajectory(heights, seekur_jr(), straight(), quarter)
    assert margins.step == pytest.approx(0.15, abs=1e-12)
    assert margins.tilt == pytest.approx(math.atan(0.15 / 0.425), abs=1e-12)


def test_edge_along_the_path_tilts_without_a_step():
    heights = flat()
    heights[:, 66:] = 0.15
    margins = reference.simulate_trajectory(heights, seekur_jr(), straight(), 0)
    assert margins.step == 0.0
    assert margins.tilt == pytest.approx(math.atan(0.15 / 0.663), abs=1e-12)


def test_step_across_the_arc_junction():
    """Front wheels stand on row 29 at s = 1.62 and on row 30 from s = 1.65; the rear ones end on row 28."""
    heights = flat()
    heights[64 + 30 :] = 0.15
    actions = straight(arc_lengths=(LENGTH, 0.3))
    margins = reference.simulate_trajectory(heights, seekur_jr(), actions, 0)
    assert margins.step == pytest.approx(0.15, abs=1e-12)


@pytest.mark.parametrize("quarter", QUARTERS)
@pytest.mark.parametrize("right", [-3, 0, 3])
def test_rock_under_the_chassis_only(quarter, right):
    heights = flat()
    heights[node(right, 16, quarter)] = 0.2
    margins = reference.simulate_trajectory(heights, seekur_jr(), straight(), quarter)
    assert values(margins) == pytest.approx([0.0, 0.2, 0.0], abs=1e-12)


@pytest.mark.parametrize("quarter", QUARTERS)
@pytest.mark.parametrize(("right", "forward"), [(-4, 16), (4, 16), (-6, 16), (6, 16), (0, -9), (0, 62)])
def test_rock_missed_by_chassis_and_wheels(quarter, right, forward):
    """Chassis nodes: within 3 cells to the side, from -8 to +61 cells along; wheels roll 5 cells aside."""
    heights = flat()
    heights[node(right, forward, quarter)] = 0.2
    margins = reference.simulate_trajectory(heights, seekur_jr(), straight(), quarter)
    assert values(margins) == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)


@pytest.mark.parametrize("forward", [-8, 61])
def test_rock_at_the_ends_of_the_chassis(forward):
    heights = flat()
    heights[node(0, forward)] = 0.2
    assert reference.simulate_trajectory(heights, seekur_jr(), straight(), 0).obstacle == pytest.approx(0.2)


@pytest.mark.parametrize("quarter", QUARTERS)
def test_rock_under_one_wheel(quarter):
    heights = flat()
    heights[node(-5, 16, quarter)] = 0.1
    margins = reference.simulate_trajectory(heights, seekur_jr(), straight(), quarter)
    assert margins.step == pytest.approx(0.1, abs=1e-12)
    assert margins.tilt == pytest.approx(math.atan(math.hypot(0.1 / 0.85, 0.1 / 1.326)), abs=1e-12)


def test_pit_under_the_chassis_is_no_obstacle():
    heights = flat()
    heights[64:, 62:67] = -1.0
    margins = reference.simulate_trajectory(heights, seekur_jr(), straight(), 0)
    assert values(margins) == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)


def test_obstacle_is_negative_where_the_chassis_straddles_a_trench():
    heights = flat()
    heights[:, 61:68] = -1.0
    margins = reference.simulate_trajectory(heights, seekur_jr(), straight(), 0)
    assert margins.obstacle == pytest.approx(-1.0, abs=1e-12)


# Rough ground against an oracle over the whole map


def whole_map_margins(heights, robot, actions, trajectory, cell_size):
    rows, cols = np.indices(heights.shape)
    nodes = np.stack([cols - heights.shape[1] // 2, rows - heights.shape[0] // 2], axis=-1) * cell_size
    b, t = robot.wheelbase, robot.track
    wheels = np.array([[-t, b], [t, b], [-t, -b], [t, -b]]) / 2.0
    contacts, excess, tilts = [], [], []
    for x, y, heading in reference.poses(actions, trajectory):
        right = np.array([math.cos(heading), math.sin(heading)])
        forward = np.array([-math.sin(heading), math.cos(heading)])
        centres = [x, y] + wheels @ np.stack([right, forward])
        nearest = [np.abs(nodes - centre).max(axis=-1).argmin() for centre in centres]
        contacts.append(heights.ravel()[nearest])
        design = np.column_stack([np.ones(4), wheels])
        z, q, p = np.linalg.lstsq(design, contacts[-1], rcond=None)[0]
        u, v = (nodes - [x, y]) @ right, (nodes - [x, y]) @ forward
        under = (np.abs(u) <= robot.chassis_width / 2.0) & (np.abs(v) <= robot.chassis_length / 2.0)
        excess.append((heights - z - q * u - p * v)[under].max())
        normal = np.array([-q, -p, 1.0])
        tilts.append(math.acos(1.0 / np.linalg.norm(normal)))
    return [np.abs(np.diff(contacts, axis=0)).max(), max(excess), max(tilts)]


@pytest.mark.parametrize(
    ("shape", "cell_size", "trajectory"),
    [((129, 129), CELL, 0), ((129, 129), CELL, 777), ((101, 123), 0.08, 1501), ((163, 161), 0.05, 3041)],
)
def test_rough_ground_agrees_with_the_whole_map_oracle(shape, cell_size, trajectory):
    heights = rough_map(trajectory, shape)
    margins = reference.simulate_trajectory(heights, seekur_jr(), action_space(), trajectory, cell_size)
    expected = whole_map_margins(heights, seekur_jr(), action_space(), trajectory, cell_size)
    np.testing.assert_allclose(values(margins), expected, rtol=0.0, atol=1e-10)


def test_mirrored_ground_and_trajectory():
    """Left and right change places: k becomes -k and each radius its opposite."""
    heights = rough_map()
    first = reference.simulate_trajectory(heights, seekur_jr(), action_space(), (4 * 13 + 3) * 13 + 6)
    mirrored = heights[:, ::-1]
    mirror = reference.simulate_trajectory(mirrored, seekur_jr(), action_space(), (14 * 13 + 4) * 13 + 5)
    np.testing.assert_allclose(values(first), values(mirror), rtol=0.0, atol=1e-12)


def test_ground_turned_by_180_degrees():
    heights = rough_map()
    first = reference.simulate_trajectory(heights, seekur_jr(), action_space(), (4 * 13 + 3) * 13 + 6)
    turned = heights[::-1, ::-1]
    second = reference.simulate_trajectory(turned, seekur_jr(), action_space(), (13 * 13 + 3) * 13 + 6)
    np.testing.assert_allclose(values(first), values(second), rtol=0.0, atol=1e-12)


def test_a_site_offset_changes_nothing():
    heights = rough_map()
    low = reference.simulate_trajectory(heights, seekur_jr(), action_space(), 901)
    high = reference.simulate_trajectory(heights + 2000.0, seekur_jr(), action_space(), 901)
    np.testing.assert_allclose(values(low), values(high), rtol=0.0, atol=1e-9)


def test_an_offset_that_float64_holds_exactly_changes_no_bit():
    heights = np.round(rough_map() * 2**20) / 2**20
    low = reference.simulate_trajectory(heights, seekur_jr(), action_space(), 901)
    high = reference.simulate_trajectory(heights + 2000.0, seekur_jr(), action_space(), 901)
    assert low == high


def test_float32_heights_are_differenced_in_float64():
    heights = rough_map().astype(np.float32)
    single = reference.simulate_trajectory(heights, seekur_jr(), action_space(), 901)
    double = reference.simulate_trajectory(heights.astype(np.float64), seekur_jr(), action_space(), 901)
    assert single == double


# Unknown ground


@pytest.mark.parametrize("quarter", QUARTERS)
@pytest.mark.parametrize(
    ("right", "forward"), [(-5, 16), (5, 16), (-5, -3), (5, 56), (0, 0), (3, 16), (0, -8), (-3, 61)]
)
def test_a_touched_unknown_node_makes_the_trajectory_unknown(quarter, right, forward):
    heights = rough_map()
    heights[node(right, forward, quarter)] = np.nan
    margins = reference.simulate_trajectory(heights, seekur_jr(), straight(), quarter)
    assert margins.known is False
    assert np.isnan(values(margins)).all()


def test_an_unknown_contact_counts_where_no_node_lies_under_the_chassis():
    """At the last two poses, 0.32 and 0.8 cells past a row, the right front wheel stands on row 56."""
    robot = seekur_jr(chassis_length=0.02, chassis_width=0.02)
    heights = flat()
    heights[node(5, 57)] = np.nan
    assert reference.simulate_trajectory(heights, robot, straight(), 0).known
    heights[node(5, 56)] = np.nan
    assert not reference.simulate_trajectory(heights, robot, straight(), 0).known


def test_untouched_unknown_nodes_change_nothing():
    heights = rough_map()
    holes = heights.copy()
    holes[:, [58, 60, 68, 70]] = np.nan
    holes[:55] = np.nan
    holes[126:] = np.nan
    expected = reference.simulate_trajectory(heights, seekur_jr(), straight(), 0)
    assert expected.known
    assert reference.simulate_trajectory(holes, seekur_jr(), straight(), 0) == expected


def test_a_map_without_known_ground():
    margins = reference.simulate_trajectory(np.full((129, 129), np.nan), seekur_jr(), action_space(), 0)
    assert not margins.known


# Ties


@pytest.mark.parametrize("quarter", QUARTERS)
@pytest.mark.parametrize(("column", "touched"), [(-5, False), (-4, True), (4, False), (5, True)])
def test_a_wheel_between_two_nodes_takes_the_one_in_positive_x_and_y(quarter, column, touched):
    """The wheels roll along x (or y) = -4.5 and 4.5 cells, up to the rounding of sin and cos."""
    robot = seekur_jr(track=9 * CELL)
    heights = flat()
    if quarter % 2 == 0:
        heights[:, 64 + column] = 0.1
    else:
        heights[64 + column] = 0.1
    margins = reference.simulate_trajectory(heights, robot, straight(), quarter)
    assert margins.tilt == pytest.approx(math.atan(0.1 / robot.track) if touched else 0.0, abs=1e-12)
    assert margins.step == 0.0


@pytest.mark.parametrize("quarter", QUARTERS)
def test_a_wheel_in_the_middle_of_a_step_of_the_path(quarter):
    """Only the last pose has the front wheels 20.5 cells ahead: on 21 towards +x or +y, else still on 20."""
    robot = seekur_jr(wheelbase=9 * CELL)
    actions = straight(arc_lengths=(8 * CELL, 8 * CELL), interval=CELL)
    heights = flat()
    for right in range(-64, 65):
        heights[node(right, 21, quarter)] = 0.1
    heights[node(0, 21, quarter)] = 0.0
    margins = reference.simulate_trajectory(heights, robot, actions, quarter)
    assert margins.step == pytest.approx(0.1 if quarter in (0, 3) else 0.0, abs=1e-12)


@pytest.mark.parametrize("quarter", QUARTERS)
@pytest.mark.parametrize(("right", "forward"), [(-3, 40), (3, 40), (0, 40), (-3, -8), (3, -8), (0, -8)])
def test_a_node_on_the_edge_of_the_chassis_is_under_it(quarter, right, forward):
    """The chassis ends 8 cells ahead of the last pose, 32 cells along, and 8 cells behind the first one."""
    robot = seekur_jr(chassis_width=6 * CELL, chassis_length=16 * CELL)
    heights = flat()
    heights[node(right, forward, quarter)] = 0.2
    margins = reference.simulate_trajectory(heights, robot, straight(arc_lengths=(1.0, 1.0)), quarter)
    assert margins.obstacle == pytest.approx(0.2, abs=1e-12)


# Maps and robots that do not fit


@pytest.mark.parametrize("shape", [(128, 129), (129, 128), (2, 129, 129), (129,)])
def test_a_map_without_a_centre_node_is_refused(shape):
    with pytest.raises(ValueError, match="heights has shape"):
        reference.simulate_trajectory(np.zeros(shape), seekur_jr(), action_space(), 0)


def test_a_map_that_the_robot_leaves_is_refused():
    """The straight trajectory needs 3.3 + 0.57 m ahead, and 0.57 m to the sides."""
    narrow = reference.simulate_trajectory(np.zeros((129, 21)), seekur_jr(), straight(), 0)
    assert narrow.known
    with pytest.raises(ValueError, match="robot reaches"):
        reference.simulate_trajectory(np.zeros((121, 129)), seekur_jr(), straight(), 0)
    with pytest.raises(ValueError, match="robot reaches"):
        reference.simulate_trajectory(np.zeros((129, 21)), seekur_jr(), straight(), 1)


# Several trajectories, and labels


def test_simulate_runs_the_trajectories_asked_for_in_order():
    heights = rough_map()
    heights[node(0, 40)] = np.nan
    asked, done = [1700, 0, 2030], []
    margins = reference.simulate(heights, seekur_jr(), action_space(), asked, on_progress=done.append)
    assert done == [1, 2, 3]
    assert margins.known.tolist() == [True, False, True]
    assert margins.known.dtype == bool
    for name in ("step", "obstacle", "tilt"):
        array = getattr(margins, name)
        assert array.dtype == np.float64
        for entry, trajectory in zip(array, asked, strict=True):
            single = reference.simulate_trajectory(heights, seekur_jr(), action_space(), trajectory)
            np.testing.assert_equal(entry, getattr(single, name))


def test_simulate_takes_all_trajectories_and_the_cell_size():
    actions = action_space(turns=2, radii=(math.inf, TIGHTEST))
    heights = rough_map(shape=(163, 163))
    margins = reference.simulate(heights, seekur_jr(), actions, cell_size=0.05)
    assert margins.step.shape == margins.obstacle.shape == margins.tilt.shape == margins.known.shape == (8,)
    last = reference.simulate_trajectory(heights, seekur_jr(), actions, 7, 0.05)
    assert margins.obstacle[7] == last.obstacle


def test_label_order_and_strict_limits():
    robot = seekur_jr()
    limits = np.array([robot.max_step, robot.ride_height, robot.max_tilt])
    step, obstacle, tilt = (limits + 1e-9 * np.vstack([np.zeros(3), np.eye(3)])).T
    margins = reference.Margins(step, obstacle, tilt, np.ones(4, dtype=bool))
    expected = np.vstack([np.zeros(3), np.eye(3)]).astype(bool)
    np.testing.assert_array_equal(reference.label(margins, robot), expected)
    unknown = reference.Margins(step, obstacle, tilt, np.zeros(4, dtype=bool))
    assert not reference.label(unknown, robot).any()


def test_label_is_false_where_unknown():
    heights = rough_map(scale=1.0)
    heights[node(0, 40)] = np.nan
    failed = reference.label(reference.simulate(heights, seekur_jr(), straight()), seekur_jr())
    assert failed.shape == (4, 3)
    assert failed.dtype == bool
    assert failed.tolist() == [[False] * 3] + [[True] * 3] * 3
