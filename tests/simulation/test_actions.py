"""The action space: its counts and indices, and poses that can be worked out by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from travjax.config import InputError
from travjax.simulation.actions import ActionSpace, arc_poses
from travjax.traversal import reference

LENGTH = 1.65
TIGHTEST = 2 * LENGTH / math.pi
"""A quarter circle."""

OTHER_SPACES = {
    "five turns": ActionSpace(turns=5),
    "one straight trajectory": ActionSpace(turns=1, radii=(math.inf,)),
    "unpaired radii": ActionSpace(turns=4, radii=(-1.0, math.inf, 2.5)),
    "arcs of different length": ActionSpace(turns=3, arc_lengths=(0.9, 2.0), radii=(1.0, -3.0), interval=0.25),
    "interval divides the arcs": ActionSpace(turns=2, arc_lengths=(0.6, 0.9), interval=0.1),
    "interval is an arc": ActionSpace(turns=2, arc_lengths=(0.5, 0.5), radii=(math.inf, 1.0), interval=0.5),
}

other_spaces = pytest.mark.parametrize("actions", OTHER_SPACES.values(), ids=OTHER_SPACES)


def end_of(turn=0, first=0, second=0) -> np.ndarray:
    actions = ActionSpace()
    return actions.poses(actions.index(turn, first, second))[-1]


def test_the_paper_has_3042_trajectories():
    assert len(ActionSpace()) == 18 * 13 * 13 == 3042


def test_the_paper_has_13_radii_that_alternate_left_and_right():
    grown = np.array([0, 0, 0.1, 0.1, 0.2, 0.2, 0.5, 0.5, 1.0, 1.0, 1.8, 1.8])
    radii = np.array(ActionSpace().radii)
    assert radii[0] == math.inf
    np.testing.assert_allclose(radii[1:], (TIGHTEST + grown) * ([1, -1] * 6), rtol=0, atol=1e-12)


def test_a_trajectory_has_57_poses_29_of_them_with_the_junction():
    actions = ActionSpace()
    assert len(actions.first_stations()) == 29
    assert len(actions.second_stations()) == 28
    assert actions.poses(0).shape == (57, 3)
    assert actions.poses(0).dtype == np.float64


def test_stations_lie_6_centimetres_apart_and_end_with_the_arc():
    actions = ActionSpace()
    every = np.append(0.06 * np.arange(28), LENGTH)
    np.testing.assert_allclose(actions.first_stations(), every, rtol=0, atol=1e-12)
    np.testing.assert_allclose(actions.second_stations(), every[1:], rtol=0, atol=1e-12)


def test_an_end_on_a_multiple_of_the_interval_is_one_station():
    actions = ActionSpace(arc_lengths=(0.3, 0.6), interval=0.1)
    np.testing.assert_allclose(actions.first_stations(), [0, 0.1, 0.2, 0.3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(actions.second_stations(), [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], rtol=0, atol=1e-12)


@pytest.mark.parametrize("count", range(1, 40))
def test_rounding_adds_no_station_before_the_end_of_an_arc(count):
    """0.54 / 0.06 is 9.000000000000002 in floating point, for one."""
    actions = ActionSpace(arc_lengths=(round(0.06 * count, 2), 2.0))
    assert len(actions.first_stations()) == count + 1


def test_the_second_arc_counts_fastest():
    actions = ActionSpace()
    assert [actions.index(*arcs) for arcs in [(0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0)]] == [0, 1, 13, 169]
    assert actions.index(17, 12, 12) == 3041


@given(st.integers(0, 3041))
def test_index_and_split_are_inverse(trajectory):
    actions = ActionSpace()
    turn, first, second = actions.split(trajectory)
    assert 0 <= turn < 18 and 0 <= first < 13 and 0 <= second < 13
    assert actions.index(turn, first, second) == trajectory


@other_spaces
def test_every_trajectory_of_another_space_has_its_own_arcs(actions):
    turn, first, second = actions.split(np.arange(len(actions)))
    np.testing.assert_array_equal(actions.index(turn, first, second), np.arange(len(actions)))
    assert len(set(zip(turn.tolist(), first.tolist(), second.tolist(), strict=True))) == len(actions)
    assert turn.max() == actions.turns - 1
    assert first.max() == second.max() == len(actions.radii) - 1


def test_the_robot_starts_at_the_origin_and_faces_y():
    np.testing.assert_array_equal(ActionSpace().poses(0)[0], [0, 0, 0])


def test_straight_ahead_goes_along_y():
    path = ActionSpace().poses(0)
    np.testing.assert_allclose(path[:, [0, 2]], 0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(path[[28, 56], 1], [LENGTH, 2 * LENGTH], rtol=0, atol=1e-12)
    assert (np.diff(path[:, 1]) > 0).all()


@pytest.mark.parametrize(("first", "left"), [(1, 1), (2, -1)])
def test_a_positive_radius_turns_left(first, left):
    """A quarter circle to the left, then straight on: towards -x, heading 90 degrees anticlockwise."""
    expected = [-left * (TIGHTEST + LENGTH), TIGHTEST, left * math.pi / 2]
    np.testing.assert_allclose(end_of(first=first), expected, rtol=0, atol=1e-12)


def test_two_quarter_circles_make_a_half_circle_or_an_s():
    np.testing.assert_allclose(end_of(first=1, second=1), [-2 * TIGHTEST, 0, math.pi], rtol=0, atol=1e-12)
    np.testing.assert_allclose(end_of(first=1, second=2), [-2 * TIGHTEST, 2 * TIGHTEST, 0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("turn", range(18))
def test_point_turns_are_20_degrees_anticlockwise_each(turn):
    heading = math.radians(20 * turn)
    expected = [-2 * LENGTH * math.sin(heading), 2 * LENGTH * math.cos(heading), heading]
    np.testing.assert_allclose(end_of(turn=turn), expected, rtol=0, atol=1e-12)


def test_the_point_turn_is_not_simulated():
    actions = ActionSpace()
    starts = actions.poses(np.arange(len(actions)))[:, 0]
    np.testing.assert_array_equal(starts[:, :2], 0)


def test_a_third_of_a_circle_by_hand():
    actions = ActionSpace(turns=1, radii=(3 * LENGTH / (2 * math.pi),))
    radius = actions.radii[0]
    expected = [-1.5 * radius, math.sqrt(0.75) * radius, 2 * math.pi / 3]
    np.testing.assert_allclose(actions.poses(0)[28], expected, rtol=0, atol=1e-12)


def test_a_very_wide_arc_is_nearly_straight():
    wide = ActionSpace(turns=1, radii=(1e9, math.inf))
    np.testing.assert_allclose(wide.poses(0), wide.poses(3), rtol=0, atol=1e-8)


def test_arcs_start_where_and_as_the_robot_stands():
    path = arc_poses(np.array([1.0, 2.0, math.pi / 2]), np.array(2.0), np.array([0.0, math.pi]))
    np.testing.assert_allclose(path, [[1, 2, math.pi / 2], [-1, 0, math.pi]], rtol=0, atol=1e-12)


def test_poses_of_many_trajectories_are_those_of_each():
    actions = ActionSpace()
    trajectories = np.array([[0, 17, 500], [3041, 169, 1234]])
    many = actions.poses(trajectories)
    assert many.shape == (2, 3, 57, 3)
    np.testing.assert_array_equal(many[1, 2], actions.poses(1234))


def test_first_and_second_poses_join_to_a_trajectory():
    actions = ActionSpace()
    path = actions.poses(actions.index(3, 5, 7))
    np.testing.assert_array_equal(actions.first_poses(3, 5), path[:29])
    np.testing.assert_array_equal(actions.second_poses(3, 5, 7), path[29:])


@given(st.integers(0, 3041))
def test_poses_agree_with_the_sequential_simulator(trajectory):
    path = ActionSpace().poses(trajectory)
    np.testing.assert_allclose(path, reference.poses(ActionSpace(), trajectory), rtol=0, atol=1e-12)


@other_spaces
def test_poses_of_another_space_agree_with_the_sequential_simulator(actions):
    for trajectory in range(0, len(actions), 7):
        expected = reference.poses(actions, trajectory)
        np.testing.assert_allclose(actions.poses(trajectory), expected, rtol=0, atol=1e-12)


def test_a_file_makes_an_action_space(tmp_path):
    path = tmp_path / "actions.toml"
    path.write_text("turns = 4\narc_lengths = [1.0, 2]\nradii = [inf, 1.5, -1.5]\ninterval = 0.1")
    assert ActionSpace.load(path) == ActionSpace(4, (1.0, 2), (math.inf, 1.5, -1.5), 0.1)


def test_a_file_may_leave_the_paper_values_out(tmp_path):
    path = tmp_path / "actions.toml"
    path.write_text("turns = 36")
    assert ActionSpace.load(path) == ActionSpace(turns=36)


def test_a_wrong_value_in_a_file_is_named_with_the_file(tmp_path):
    path = tmp_path / "actions.toml"
    path.write_text("turns = 0")
    with pytest.raises(InputError, match="actions.toml: turns = 0: must be a whole number from 1 to 3600$"):
        ActionSpace.load(path)


@pytest.mark.parametrize("as_radii", [list, np.array])
def test_lists_and_arrays_become_tuples(as_radii):
    actions = ActionSpace(turns=np.int64(4), arc_lengths=[1, 2], radii=as_radii([math.inf, 1.5]))
    assert actions == ActionSpace(turns=4, arc_lengths=(1.0, 2.0), radii=(math.inf, 1.5))
    assert hash(actions) == hash(ActionSpace(turns=4, arc_lengths=(1.0, 2.0), radii=(math.inf, 1.5)))


@pytest.mark.parametrize("trajectory", [-1, 3042, [0, 5000]])
def test_a_trajectory_that_is_none_is_refused(trajectory):
    for function in (ActionSpace().split, ActionSpace().poses):
        with pytest.raises(InputError, match="^trajectory = .*: must be from 0 to 3041$"):
            function(np.array(trajectory))


def test_equal_action_spaces_are_one_key():
    assert {ActionSpace(): 1}[ActionSpace(turns=18)] == 1


@pytest.mark.parametrize("turns", [0, -1, 3601, 2.0, "18", None, True])
def test_a_bad_number_of_turns_is_refused(turns):
    with pytest.raises(InputError, match="^turns = .*: must be a whole number from 1 to 3600$"):
        ActionSpace(turns=turns)


@pytest.mark.parametrize("arc_lengths", [1.65, (1.65,), (1.0, 1.0, 1.0), None, "ab"])
def test_other_than_two_arcs_are_refused(arc_lengths):
    with pytest.raises(InputError, match="^arc_lengths = .*: must be two lengths in metres$"):
        ActionSpace(arc_lengths=arc_lengths)


@pytest.mark.parametrize("length", [0, 1e-40, -1, 1001, math.nan, math.inf, "1", None, True])
@pytest.mark.parametrize("arc", [0, 1])
def test_a_bad_arc_length_is_refused(length, arc):
    lengths = (length, 1.65) if arc == 0 else (1.65, length)
    with pytest.raises(InputError, match="^arc_lengths = .*: must be a length in metres from 0.001 to 1000$"):
        ActionSpace(arc_lengths=lengths)


@pytest.mark.parametrize("radii", [(), 1.5, None, "abc"])
def test_no_radii_are_refused(radii):
    with pytest.raises(InputError, match="^radii = .*: must be a list of one or more radii in metres$"):
        ActionSpace(radii=radii)


@pytest.mark.parametrize(
    "radius",
    [0, 1e-40, -0.0009, 1e13, pytest.param(10**5000, id="digits"), -math.inf, math.nan, "1", None, True, (1.0,)],
)
def test_a_bad_radius_is_refused(radius):
    allowed = r"a radius in metres from 0.001 to 1e12, \+ or -; inf is straight"
    with pytest.raises(InputError, match=f"^radii = .*: must be {allowed}$"):
        ActionSpace(radii=(1.5, radius))


def test_a_radius_twice_is_refused():
    with pytest.raises(InputError, match="^radii = .*: must be different from each other$"):
        ActionSpace(radii=(1.5, math.inf, 1.5))


@pytest.mark.parametrize("interval", [0, 1e-40, -0.06, 0.51, math.nan, math.inf, "0.06", None, True])
def test_a_bad_interval_is_refused(interval):
    with pytest.raises(
        InputError, match="^interval = .*: must be a length in metres, from 0.001 and at most an arc's length$"
    ):
        ActionSpace(arc_lengths=(0.5, 1.0), interval=interval)


def test_an_interval_that_makes_thousands_of_poses_is_refused():
    assert ActionSpace(turns=1, arc_lengths=(0.5, 1.0), interval=0.001).poses(0).shape == (1501, 3)
    with pytest.raises(InputError, match="^interval = 0.00199: must be at least a thousandth of an arc, 0.002 m$"):
        ActionSpace(turns=1, arc_lengths=(0.5, 2.0), interval=0.00199)


def test_too_many_trajectories_are_refused():
    assert len(ActionSpace(turns=1, radii=tuple(range(1, 1001)))) == 1_000_000
    with pytest.raises(InputError, match="^turns x radii x radii = 1002001: must be at most 1000000 trajectories$"):
        ActionSpace(turns=1, radii=tuple(range(1, 1002)))
