"""The network's input images against a float64 rendering from SPEC section 6, and images whose look is known."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from tests.conftest import CELL, HUSKY, SEEKUR_JR, SETUPS
from travjax.config import InputError
from travjax.models import input_images
from travjax.models.input_images import assemble, elevation_channel, render_inputs, trajectory_bank, trajectory_channels
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup

PAPER = ActionSpace()
LEVEL = 1 / 255
TOLERANCE = LEVEL / 2 + 3e-4
"""Half a level of a byte, and float32 geometry (SPEC section 6)."""

STEP = 2.5e-4
"""Metres of path between the points of the float64 rendering; between them paths are taken as straight."""

SMALL = Setup(HUSKY, ActionSpace(turns=4, radii=(math.inf, 0.7, -0.7), arc_lengths=(0.6, 0.5)), Grid(4, 0.125))
"""36 trajectories on maps of 33 x 33 nodes."""

ON_NODES = replace(SEEKUR_JR, track=10 * CELL, wheelbase=6 * CELL, wheel_width=3 * CELL, chassis_width=7 * CELL)
"""Its wheels pass over nodes when it drives straight on."""

CLOSE_TO_HALF_THE_TRACK = (SEEKUR_JR.track / 2, -SEEKUR_JR.track / 2, SEEKUR_JR.track / 2 + 1e-3)
SHORT = replace(SEEKUR_JR, wheelbase=0.01)
"""Its inner wheels turn on the spot where the radius is half the track."""

TURNING_SETUPS = {
    "more than half a circle": Setup(SEEKUR_JR, ActionSpace(turns=2, radii=(0.5, -0.5, 0.9), interval=0.1)),
    "more than a full circle": Setup(
        SEEKUR_JR, ActionSpace(turns=3, radii=(math.inf, 0.4, -0.4), arc_lengths=(2.6, 3.0), interval=0.1)
    ),
    "half the track": Setup(SEEKUR_JR, ActionSpace(turns=2, radii=CLOSE_TO_HALF_THE_TRACK, interval=0.1)),
    "wheels on the spot": Setup(SHORT, ActionSpace(turns=2, radii=CLOSE_TO_HALF_THE_TRACK, interval=0.1)),
    "wide wheels": Setup(
        replace(HUSKY, wheel_width=0.7, ride_height=0.4), ActionSpace(turns=3, radii=(1.0, -1.5), interval=0.1)
    ),
    "thin wheels": Setup(replace(HUSKY, wheel_width=0.01), ActionSpace(turns=3, radii=(1.0, -1.5), interval=0.1)),
    "an odd number of cells": Setup(HUSKY, ActionSpace(turns=3, radii=(1.0, -1.5), interval=0.1), Grid(7.8, 0.2)),
}


# The float64 rendering


def path(robot_place: complex, actions: ActionSpace, trajectory: int) -> np.ndarray:
    """Points x + iy along the way of one place (right + i forward) of the robot, arcs from start to end: [n]."""
    arcs, second = divmod(trajectory, len(actions.radii))
    turn, first = divmod(arcs, len(actions.radii))
    position, right, points = 0j, np.exp(2j * math.pi * turn / actions.turns), []
    for length, radius in zip(actions.arc_lengths, (actions.radii[first], actions.radii[second]), strict=True):
        along = np.linspace(0, length, math.ceil(length / STEP) + 1)
        rights = right * np.exp(1j * along / radius)
        centres = position + (1j * right * along if math.isinf(radius) else radius * (rights - right))
        points.append(centres + rights * robot_place)
        position, right = centres[-1], rights[-1]
    return np.concatenate(points)


def nodes_of(grid: Grid) -> np.ndarray:
    """Every node as x + iy: [rows, cols]."""
    axis = -grid.size / 2 + grid.spacing * np.arange(round(grid.size / grid.spacing) + 1)
    return axis + 1j * axis[:, None]


def distance(points: np.ndarray, nodes: np.ndarray, reach: float) -> np.ndarray:
    """Metres from each node to the line through the points, inf beyond `reach`: to the segments at the nearest few."""
    tree = cKDTree(np.stack([points.real, points.imag], axis=-1))
    flat = nodes.ravel()
    gap, index = tree.query(np.stack([flat.real, flat.imag], axis=-1), k=4, distance_upper_bound=reach + 0.01)
    near = np.isfinite(gap[:, 0])
    index = np.minimum(index[near], len(points) - 1)
    start = points[np.clip(np.concatenate([index - 1, index], axis=-1), 0, len(points) - 2)]
    along = points[np.clip(np.concatenate([index, index + 1], axis=-1), 1, len(points) - 1)] - start
    from_start = flat[near, None] - start
    share = (along.conj() * from_start).real / np.maximum(np.abs(along) ** 2, 1e-30)
    result = np.full(flat.shape, np.inf)
    result[near] = np.abs(from_start - np.clip(share, 0, 1) * along).min(axis=-1)
    return np.where(result < reach, result, np.inf).reshape(nodes.shape)


def fading(distances: np.ndarray, half_width: float) -> np.ndarray:
    """SPEC's g(d; h)."""
    return np.maximum(0, (np.exp(-3 * distances / half_width) - math.exp(-3)) / (1 - math.exp(-3)))


def wheel_distances(robot: Robot, actions: ActionSpace, grid: Grid, trajectory: int) -> np.ndarray:
    """Metres to the ways of the wheels [front or rear, left or right, rows, cols], inf beyond half a wheel's width."""
    places = np.array([[-1 + 1j, 1 + 1j], [-1 - 1j, 1 - 1j]])
    places = places.real * robot.track / 2 + 1j * places.imag * robot.wheelbase / 2
    reach, nodes = robot.wheel_width / 2, nodes_of(grid)
    return np.array([[distance(path(place, actions, trajectory), nodes, reach) for place in axle] for axle in places])


def rendered(setup: Setup, trajectory: int) -> np.ndarray:
    """Channels 2 and 3: [rows, cols, 2]."""
    robot, actions, grid = setup.robot, setup.actions, setup.grid
    half_track = robot.track / 2
    centre = fading(distance(path(0, actions, trajectory), nodes_of(grid), half_track), half_track)
    front, rear = fading(wheel_distances(robot, actions, grid, trajectory), robot.wheel_width / 2).max(axis=1)
    return np.stack([centre, (front + rear) / 2], axis=-1)


def relative_elevation(heights: np.ndarray, scale: float) -> np.ndarray:
    """Channel 1 of one map: [rows, cols]."""
    heights = np.asarray(heights, np.float64)
    rows, cols = np.nonzero(~np.isnan(heights))
    if not rows.size:
        return np.zeros(heights.shape)
    middle = (len(heights) - 1) // 2
    nearest = np.argmin(np.hypot(rows - middle, cols - middle))
    return np.nan_to_num(np.clip((heights - heights[rows[nearest], cols[nearest]]) / scale, -4, 4))


def assert_rendered(images, setup: Setup, trajectories):
    assert images.shape == (len(trajectories), *setup.grid.shape, 2)
    assert images.dtype == np.uint8
    for image, trajectory in zip(np.asarray(images), trajectories, strict=True):
        expected = rendered(setup, int(trajectory))
        np.testing.assert_allclose(image / 255, expected, rtol=0, atol=TOLERANCE, err_msg=f"trajectory {trajectory}")


def channels(setup: Setup, trajectories) -> np.ndarray:
    """Channels 2 and 3 of trajectories as travjax draws them, uint8."""
    return np.asarray(trajectory_channels(setup, np.asarray(trajectories)))


def some_of(actions: ActionSpace, count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).permutation(len(actions))[:count]


def test_the_float64_rendering_knows_straight_lines_and_circles():
    """The oracle itself where distances are plain: beside, before and after a line, in and out of a circle."""
    nodes = np.array([0.1 + 0.5j, -0.2 - 0.1j, 1.3j + 0.1, 2 + 0j])
    line = distance(path(0, ActionSpace(arc_lengths=(0.6, 0.4)), 0), nodes, 1.0)
    np.testing.assert_allclose(line, [0.1, math.hypot(0.2, 0.1), math.hypot(0.3, 0.1), np.inf], atol=1e-12)
    circle = ActionSpace(turns=1, radii=(0.5,), arc_lengths=(2.0, 1.5))
    np.testing.assert_allclose(distance(path(0.1, circle, 0), nodes, 3), np.abs(np.abs(nodes + 0.5) - 0.6), atol=1e-6)
    with_wheels = path(0.2 + 0.3j, ActionSpace(turns=4, radii=(math.inf,)), 1)  # faces -x: right is +y, forward -x
    np.testing.assert_allclose(with_wheels[[0, -1]], [-0.3 + 0.2j, -3.6 + 0.2j], atol=1e-12)


# Channels 2 and 3 against it


def test_random_trajectories_of_the_paper_are_as_rendered():
    sample = some_of(PAPER, 36)
    assert_rendered(channels(SETUPS["paper"], sample), SETUPS["paper"], sample)


def test_straight_tightest_widest_and_s_shaped_trajectories_are_as_rendered():
    arcs = [(0, 0), (1, 1), (2, 2), (1, 2), (2, 1), (11, 12), (0, 1), (2, 0), (5, 8)]
    sample = [PAPER.index(turn, *pair) for turn, pair in zip((0, 0, 4, 0, 13, 9, 17, 2, 6), arcs, strict=True)]
    assert_rendered(channels(SETUPS["paper"], sample), SETUPS["paper"], sample)


def test_trajectories_of_other_setups_are_as_rendered(setup):
    sample = some_of(setup.actions, 4)
    assert_rendered(channels(setup, sample), setup, sample)


@pytest.mark.parametrize("name", TURNING_SETUPS)
def test_trajectories_that_turn_far_are_as_rendered(name):
    setup = TURNING_SETUPS[name]
    sample = some_of(setup.actions, 6)
    assert_rendered(channels(setup, sample), setup, sample)


def test_trajectories_that_hardly_turn_are_as_rendered():
    """The centres of their circles lie far off the map, where float32 sees little."""
    radii = (math.inf, 30.0, -300.0, 1e3, -2e3, 1e4, -1e6)
    setup = Setup(SEEKUR_JR, ActionSpace(turns=3, radii=radii, interval=0.1))
    sample = setup.actions.index(np.arange(7) % 3, np.arange(7), np.arange(7)[::-1])
    assert_rendered(channels(setup, sample), setup, sample)


lengths = st.floats(0.2, 2.5)


@settings(max_examples=12)
@given(
    track=st.floats(0.1, 1.0),
    wheelbase=st.floats(0.01, 1.0),
    wheel_width=st.floats(0.02, 0.5),
    arc_lengths=st.tuples(lengths, lengths),
    tightness=st.floats(1, 20),
    turn=st.integers(0, 6),
    arcs=st.tuples(st.integers(0, 2), st.integers(0, 2)),
)
def test_any_robot_and_arcs_are_as_rendered(track, wheelbase, wheel_width, arc_lengths, tightness, turn, arcs):
    radius = tightness * track / 2
    above = {"ride_height": 1.0}  # so that wheels of any track stand below the chassis
    robot = replace(SEEKUR_JR, track=track, wheelbase=wheelbase, wheel_width=wheel_width, **above)
    actions = ActionSpace(turns=7, radii=(math.inf, radius, -radius), arc_lengths=arc_lengths, interval=0.1)
    setup, sample = Setup(robot, actions, Grid(8, 0.125)), [actions.index(turn, *arcs)]
    assert_rendered(channels(setup, sample), setup, sample)


# Images whose look is known


def test_a_straight_trajectory_has_a_closed_form():
    x, y = np.meshgrid(Grid().axis(), Grid().axis())
    length = sum(PAPER.arc_lengths)

    def along(right, forward, half_width):
        """g of the distance to a line that runs straight on from (right, forward)."""
        return fading(np.hypot(x - right, y - np.clip(y, forward, forward + length)), half_width)

    half_track, half_base, half_width = ON_NODES.track / 2, ON_NODES.wheelbase / 2, ON_NODES.wheel_width / 2
    axles = [
        np.maximum(along(-half_track, forward, half_width), along(half_track, forward, half_width))
        for forward in (half_base, -half_base)
    ]
    image = channels(Setup(ON_NODES, PAPER), [0])[0] / 255
    np.testing.assert_allclose(image[..., 0], along(0, 0, half_track), rtol=0, atol=LEVEL / 2 + 1e-5)
    np.testing.assert_allclose(image[..., 1], (axles[0] + axles[1]) / 2, rtol=0, atol=LEVEL / 2 + 1e-5)


def test_wheels_are_1_where_a_front_and_a_rear_wheel_pass_and_half_where_one_does():
    """Straight on along columns of nodes: the rear wheels start, and the front wheels end, a wheelbase apart."""
    wheels = channels(Setup(ON_NODES, PAPER), [0])[0, ..., 1]
    y = Grid().axis()
    half_base, length = ON_NODES.wheelbase / 2, sum(PAPER.arc_lengths)
    both = (y >= half_base) & (y <= length - half_base)
    one = (y >= -half_base) & (y <= length + half_base)
    away = (y < -half_base - ON_NODES.wheel_width / 2) | (y > length + half_base + ON_NODES.wheel_width / 2)
    for col in (64 - 5, 64 + 5):
        assert (wheels[both, col] == 255).all()
        before = one & ~both & (np.abs(y - np.clip(y, half_base, length - half_base)) >= ON_NODES.wheel_width / 2)
        assert before.sum() >= 6
        assert np.isin(wheels[before, col], (127, 128)).all()
        assert not wheels[away, col].any()
    assert set(np.nonzero(wheels == 255)[1]) == {64 - 5, 64 + 5}


@pytest.mark.parametrize("arcs", [(1, 2), (3, 0), (2, 2)])
def test_wheels_are_above_half_only_where_a_front_and_a_rear_wheel_pass(arcs):
    trajectory = PAPER.index(5, *arcs)
    wheels = channels(SETUPS["paper"], [trajectory])[0, ..., 1] / 255
    front, rear = wheel_distances(SEEKUR_JR, PAPER, Grid(), trajectory).min(axis=1)
    both, either = np.isfinite(front) & np.isfinite(rear), np.isfinite(front) | np.isfinite(rear)
    assert (wheels > 0.5 + LEVEL).sum() > 40
    assert both[wheels > 0.5 + LEVEL].all()
    assert (np.maximum(front, rear)[wheels > 0.99] < 1e-3).all()
    assert not wheels[~either].any()


@pytest.mark.parametrize("arcs", [(0, 0), (1, 1), (2, 9)])
def test_the_trajectory_is_0_from_the_wheel_track_outwards_and_above_0_within(arcs):
    trajectory = PAPER.index(7, *arcs)
    image = channels(SETUPS["paper"], [trajectory])[0, ..., 0]
    half_track = SEEKUR_JR.track / 2
    away = distance(path(0, PAPER, trajectory), nodes_of(Grid()), 1.0)
    assert not image[away >= half_track].any()
    assert image[away < 0.95 * half_track].all()
    assert (image[away < 1e-4] >= 254).all()


def test_the_robot_itself_is_on_the_path():
    centres = channels(SETUPS["paper"], some_of(PAPER, 40, seed=1))[:, 64, 64, 0]
    np.testing.assert_array_equal(centres, 255)


def assert_same_images(images, expected):
    """Equal but for roundings to the other level."""
    np.testing.assert_allclose(images.astype(int), expected.astype(int), rtol=0, atol=1)
    assert (images != expected).mean() < 1e-3


def test_opposite_radii_mirror_the_image():
    opposite = np.array([0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11])
    first, second = np.divmod(some_of(replace(PAPER, turns=1), 40), 13)
    images = channels(SETUPS["paper"], PAPER.index(0, first, second))
    mirrored = channels(SETUPS["paper"], PAPER.index(0, opposite[first], opposite[second]))
    assert_same_images(mirrored, images[:, :, ::-1])
    assert (mirrored != images).any()


def test_half_a_turn_more_turns_the_image_by_180_degrees():
    turn, first, second = PAPER.split(some_of(PAPER, 40))
    images = channels(SETUPS["paper"], PAPER.index(turn, first, second))
    turned = channels(SETUPS["paper"], PAPER.index((turn + 9) % 18, first, second))
    assert_same_images(turned, images[:, ::-1, ::-1])


@pytest.mark.parametrize("turn", [1, 2, 3])
def test_a_point_turn_turns_the_image_and_leaves_no_trace(turn):
    """Rows run north, so quarter turns anticlockwise are clockwise ones for NumPy."""
    setup = Setup(SEEKUR_JR, ActionSpace(turns=4, radii=(math.inf, 1.2, -1.2)))
    first, second = np.divmod(np.arange(9), 3)
    ahead = channels(setup, setup.actions.index(0, first, second))
    turned = channels(setup, setup.actions.index(turn, first, second))
    assert_same_images(turned, np.rot90(ahead, -turn, axes=(1, 2)))


def test_a_trajectory_looks_the_same_in_any_batch():
    sample = some_of(PAPER, 7)
    images = channels(SETUPS["paper"], sample)
    for index in range(7):
        np.testing.assert_array_equal(channels(SETUPS["paper"], sample[index : index + 1])[0], images[index])
    np.testing.assert_array_equal(channels(SETUPS["paper"], sample[::-1]), images[::-1])


def test_trajectories_that_are_none_are_refused():
    for trajectory in (-1, len(SMALL.actions)):
        with pytest.raises(InputError, match=f"^trajectory = .*: must be from 0 to {len(SMALL.actions) - 1}$"):
            trajectory_channels(SMALL, np.array([0, trajectory]))


# The bank


@pytest.fixture(scope="module")
def bank(tmp_path_factory) -> np.ndarray:
    return trajectory_bank(SMALL, cache=tmp_path_factory.mktemp("bank"))


def listing(folder) -> list[str]:
    return sorted(str(one.relative_to(folder)) for one in folder.rglob("*") if not one.is_dir())


def identity(file):
    return file.stat().st_ino, file.stat().st_mtime_ns


def only_file(folder):
    (name,) = listing(folder)
    return folder / name


def test_the_bank_holds_every_trajectory_in_order(bank):
    assert bank.shape == (36, 33, 33, 2)
    assert bank.dtype == np.uint8
    np.testing.assert_array_equal(bank, channels(SMALL, np.arange(36)))
    assert_rendered(bank, SMALL, np.arange(36))


def test_the_bank_is_kept_on_disk_and_used_again(tmp_path, bank):
    first = trajectory_bank(SMALL, cache=tmp_path)
    file = only_file(tmp_path)
    before = identity(file)
    again = trajectory_bank(SMALL, cache=tmp_path)
    np.testing.assert_array_equal(first, bank)
    np.testing.assert_array_equal(again, bank)
    assert again.dtype == np.uint8
    assert identity(file) == before


def test_a_kept_bank_is_not_drawn_anew(tmp_path, bank, monkeypatch):
    trajectory_bank(SMALL, cache=tmp_path)
    monkeypatch.setattr(input_images, "trajectory_channels", None)
    np.testing.assert_array_equal(trajectory_bank(SMALL, cache=tmp_path), bank)


def test_a_missing_cache_folder_is_made(tmp_path, bank):
    folder = tmp_path / "some" / "where"
    np.testing.assert_array_equal(trajectory_bank(SMALL, cache=folder), bank)
    assert len(listing(folder)) == 1


@pytest.mark.parametrize(
    "other",
    [
        replace(SMALL, robot=replace(HUSKY, wheel_width=0.13)),
        replace(SMALL, robot=replace(HUSKY, track=0.6)),
        replace(SMALL, robot=replace(HUSKY, wheelbase=0.6)),
        replace(SMALL, actions=replace(SMALL.actions, radii=(math.inf, -0.7, 0.7))),
        replace(SMALL, actions=replace(SMALL.actions, arc_lengths=(0.5, 0.6))),
        replace(SMALL, grid=Grid(4.8, 0.15)),
    ],
    ids=["wheel width", "track", "wheelbase", "radii", "arc lengths", "grid"],
)
def test_each_configuration_has_a_bank_of_its_own(tmp_path, bank, other):
    """Even one of the same shape."""
    trajectory_bank(SMALL, cache=tmp_path)
    kept = trajectory_bank(other, cache=tmp_path)
    assert kept.shape == bank.shape
    assert (kept != bank).any()
    np.testing.assert_array_equal(kept, channels(other, np.arange(36)))
    np.testing.assert_array_equal(trajectory_bank(SMALL, cache=tmp_path), bank)


def half(data: bytes) -> bytes:
    return data[: len(data) // 2]


def without_end(data: bytes) -> bytes:
    return data[:-1]


def with_another_byte(data: bytes) -> bytes:
    """One bit of the images flipped."""
    at = 2 * len(data) // 3
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


def nothing(data: bytes) -> bytes:
    return b""


def text(data: bytes) -> bytes:
    return b"not a bank\n" * 1000


@pytest.mark.parametrize("damaged", [half, without_end, with_another_byte, nothing, text])
def test_a_damaged_bank_is_made_anew(tmp_path, bank, damaged):
    trajectory_bank(SMALL, cache=tmp_path)
    file = only_file(tmp_path)
    whole = file.read_bytes()
    file.write_bytes(damaged(whole))
    np.testing.assert_array_equal(trajectory_bank(SMALL, cache=tmp_path), bank)
    assert only_file(tmp_path) == file
    assert file.read_bytes() == whole


def test_a_bank_of_another_configuration_under_its_name_is_made_anew(tmp_path, bank):
    other = replace(SMALL, robot=replace(HUSKY, wheel_width=0.13))
    trajectory_bank(SMALL, cache=tmp_path / "own")
    trajectory_bank(other, cache=tmp_path / "other")
    file = only_file(tmp_path / "own")
    file.write_bytes(only_file(tmp_path / "other").read_bytes())
    np.testing.assert_array_equal(trajectory_bank(SMALL, cache=tmp_path / "own"), bank)


def test_an_array_of_another_kind_under_its_name_is_made_anew(tmp_path, bank):
    trajectory_bank(SMALL, cache=tmp_path)
    file = only_file(tmp_path)
    with file.open("wb") as opened:
        np.save(opened, np.zeros((3, 4), np.float32))
    np.testing.assert_array_equal(trajectory_bank(SMALL, cache=tmp_path), bank)


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_interrupted_bank_leaves_no_file(tmp_path, error):
    def interrupted(*_):
        raise error

    with pytest.raises(error):
        trajectory_bank(SMALL, cache=tmp_path, on_progress=interrupted)
    assert listing(tmp_path) == []


def test_a_cache_that_cannot_be_written_is_done_without(tmp_path, bank):
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        np.testing.assert_array_equal(trajectory_bank(SMALL, cache=folder), bank)
    assert listing(tmp_path) == ["file"]


def test_the_bank_is_kept_in_the_users_cache_unless_told_otherwise(tmp_path, bank, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    np.testing.assert_array_equal(trajectory_bank(SMALL), bank)
    assert only_file(tmp_path).is_relative_to(tmp_path / "travjax")


def test_progress_counts_all_trajectories_drawn_or_read(tmp_path):
    for _ in range(2):
        counts = []
        trajectory_bank(SMALL, cache=tmp_path, on_progress=counts.append)
        assert sum(counts) == 36


def test_a_kept_bank_cannot_be_changed_by_its_user(tmp_path, bank):
    """One user's change would be in the images of the next."""
    for _ in range(2):
        mine = trajectory_bank(SMALL, cache=tmp_path)
        if mine.flags.writeable:
            mine[:] = 0
    np.testing.assert_array_equal(trajectory_bank(SMALL, cache=tmp_path), bank)


# Channel 1


def rolling(grid: Grid = Grid(), seed: int = 0) -> np.ndarray:
    """A known map of 12 m of relief, float32 metres."""
    x, y = np.meshgrid(grid.axis(), grid.axis())
    noise = np.random.default_rng(seed).standard_normal(grid.shape)
    return (6 * np.sin(x + seed) * np.cos(0.5 * y) + 0.1 * noise).astype(np.float32)


def holed(grid: Grid = Grid(), seed: int = 0) -> np.ndarray:
    """The same with holes, one of them around the centre with one known node nearest to it."""
    x, y = np.meshgrid(grid.axis(), grid.axis())
    heights = rolling(grid, seed)
    heights[np.random.default_rng(seed).random(grid.shape) < 0.02] = np.nan
    heights[np.hypot(x - 0.1, y + 0.05) < 0.5] = np.nan
    return heights


def tied(centre: tuple[int, int, int, int]) -> np.ndarray:
    """Five unknown nodes in a cross at the centre and given heights around them, all others 9 m."""
    heights = np.full(Grid().shape, 9.0, np.float32)
    heights[[64, 64, 64, 63, 65], [63, 64, 65, 64, 64]] = np.nan
    heights[[63, 63, 65, 65], [63, 65, 63, 65]] = centre
    return heights


@pytest.mark.parametrize("scale", [1.0, 0.25, 3.0])
def test_elevation_is_as_defined(scale):
    heights = np.stack([rolling(), rolling(seed=1), holed(), holed(seed=1)])
    channel = np.asarray(elevation_channel(jnp.asarray(heights), scale))
    expected = np.stack([relative_elevation(one, scale) for one in heights])
    assert channel.dtype == np.float32
    assert np.abs(expected).max() == 4 or scale > 1
    np.testing.assert_allclose(channel, expected, rtol=0, atol=1e-5)


def test_elevation_of_other_grids_is_as_defined():
    for grid in (Grid(4, 0.125), Grid(10, 0.05)):
        heights = np.stack([holed(grid, seed) for seed in range(3)])
        expected = np.stack([relative_elevation(one, 1.0) for one in heights])
        np.testing.assert_allclose(elevation_channel(jnp.asarray(heights), 1.0), expected, rtol=0, atol=1e-5)


def test_elevation_is_clipped_after_scaling():
    heights = np.zeros(Grid().shape, np.float32)
    heights[0, :6] = 3, -3, 5, -5, 100, -100
    channel = np.asarray(elevation_channel(jnp.asarray(heights[None]), 1.0))[0]
    np.testing.assert_array_equal(channel[0, :6], [3, -3, 4, -4, 4, -4])
    channel = np.asarray(elevation_channel(jnp.asarray(heights[None]), 2.0))[0]
    np.testing.assert_array_equal(channel[0, :6], [1.5, -1.5, 2.5, -2.5, 4, -4])
    assert channel[64, 64] == 0


def test_unknown_nodes_are_0():
    heights = np.full(Grid().shape, 7.0, np.float32)
    heights[64, 64] = 5
    heights[[0, 10, 64], [0, 20, 65]] = np.nan
    channel = np.asarray(elevation_channel(jnp.asarray(heights[None]), 1.0))[0]
    np.testing.assert_array_equal(channel[[0, 10, 64], [0, 20, 65]], 0)
    assert np.isin(channel, (0, 2)).all()
    assert (channel == 0).sum() == 4


def test_an_unknown_centre_has_the_height_of_the_nearest_known_node():
    heights = np.full(Grid().shape, 9.0, np.float32)
    heights[60:69, 62:67] = np.nan
    heights[62, 64] = 8  # two nodes away, those at 9 m three and more
    channel = np.asarray(elevation_channel(jnp.asarray(heights[None]), 1.0))[0]
    assert channel[62, 64] == 0
    assert channel[64, 67] == channel[0, 0] == 1
    assert channel[64, 64] == 0


def test_nearest_is_by_distance_and_not_by_rows_or_cells():
    """(2, 2) nodes away is nearer than (0, 3); (0, 2) is nearer than both."""
    heights = np.full(Grid().shape, np.nan, np.float32)
    heights[66, 66], heights[64, 67] = 1, 2
    assert np.asarray(elevation_channel(jnp.asarray(heights[None]), 1.0))[0, 64, 67] == 1
    heights[64, 62] = 3
    np.testing.assert_array_equal(
        np.asarray(elevation_channel(jnp.asarray(heights[None]), 1.0))[0, [66, 64, 64], [66, 67, 62]], [-2, -1, 0]
    )


@pytest.mark.parametrize("corner", range(4))
def test_of_equally_near_nodes_it_is_one_of_them(corner):
    around = np.roll([0, 1, 2, 3], corner)
    channel = np.asarray(elevation_channel(jnp.asarray(tied(tuple(around))[None]), 1.0))[0]
    assert 0 in channel[[63, 63, 65, 65], [63, 65, 63, 65]]
    assert np.ptp(channel[[63, 63, 65, 65], [63, 65, 63, 65]]) == 3


def test_a_wholly_unknown_map_is_0():
    heights = np.stack([np.full(Grid().shape, np.nan, np.float32), holed()])
    channel = np.asarray(elevation_channel(jnp.asarray(heights), 1.0))
    assert not channel[0].any()
    np.testing.assert_allclose(channel[1], relative_elevation(holed(), 1.0), rtol=0, atol=1e-5)


def test_elevation_can_be_traced():
    heights = jnp.asarray(np.stack([rolling(), holed()]))
    plain = elevation_channel(heights, 0.5)
    np.testing.assert_allclose(jax.jit(elevation_channel)(heights, 0.5), plain, rtol=0, atol=1e-6)


# Whole images


@pytest.fixture(scope="module")
def small_maps() -> np.ndarray:
    """Four maps of the small setup, the last with holes and an unknown centre."""
    return np.stack([*(rolling(SMALL.grid, seed) for seed in range(3)), holed(SMALL.grid)])


MAP_INDEX = np.array([2, 0, 3, 3, 1])
TRAJECTORY_INDEX = np.array([0, 35, 7, 20, 35])


def expected_images(heights, setup: Setup, map_index, trajectory_index, scale=1.0) -> np.ndarray:
    return np.stack(
        [
            np.concatenate([relative_elevation(heights[m], scale)[..., None], rendered(setup, int(t))], axis=-1)
            for m, t in zip(map_index, trajectory_index, strict=True)
        ]
    )


def small_images(heights, map_index=MAP_INDEX, trajectory_index=TRAJECTORY_INDEX, **options) -> np.ndarray:
    robot, actions, grid = SMALL.robot, SMALL.actions, SMALL.grid
    return np.asarray(render_inputs(heights, map_index, trajectory_index, robot, actions, grid=grid, **options))


def test_images_of_the_paper_are_as_defined():
    heights = np.stack([rolling(), holed()])
    map_index, trajectory_index = np.array([0, 1, 1]), some_of(PAPER, 3)
    images = render_inputs(heights, map_index, trajectory_index)
    assert isinstance(images, jax.Array)
    assert images.shape == (3, 129, 129, 3)
    assert images.dtype == jnp.float32
    expected = expected_images(heights, SETUPS["paper"], map_index, trajectory_index)
    np.testing.assert_allclose(images[..., 0], expected[..., 0], rtol=0, atol=1e-5)
    np.testing.assert_allclose(images[..., 1:], expected[..., 1:], rtol=0, atol=TOLERANCE)


@pytest.mark.gpu
def test_images_of_a_gpu_are_as_defined():
    heights = np.stack([rolling(), holed()])
    map_index, trajectory_index = np.array([0, 1, 1]), some_of(PAPER, 3)
    images = render_inputs(heights, map_index, trajectory_index)
    assert images.devices() <= set(jax.devices("gpu"))
    expected = expected_images(heights, SETUPS["paper"], map_index, trajectory_index)
    np.testing.assert_allclose(images, expected, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("scale", [1.0, 0.4])
def test_images_of_another_setup_are_as_defined(small_maps, scale):
    images = small_images(small_maps, elevation_scale=scale)
    expected = expected_images(small_maps, SMALL, MAP_INDEX, TRAJECTORY_INDEX, scale)
    np.testing.assert_allclose(images, expected, rtol=0, atol=TOLERANCE)


def test_values_are_in_their_ranges():
    heights = 3 * np.stack([rolling(), rolling(seed=1), holed(), holed(seed=1)])
    images = np.asarray(render_inputs(heights, np.arange(len(heights)), some_of(PAPER, len(heights))))
    assert np.isfinite(images).all()
    assert images[..., 0].min() == -4 and images[..., 0].max() == 4
    assert images[..., 1:].min() == 0 and images[..., 1].max() == 1


def test_rows_run_north_and_columns_east():
    """Straight on runs up the middle column, and a hill in the north-east is in the last row and column."""
    actions, grid = SMALL.actions, SMALL.grid
    heights = np.zeros(grid.shape)
    heights[-1, -1] = 2
    image = small_images(heights, 0, 0)
    assert image[-1, -1, 0] == 2 and np.count_nonzero(image[..., 0]) == 1
    end = sum(actions.arc_lengths)
    np.testing.assert_array_equal(image[:, 16, 1] == 1, (grid.axis() >= 0) & (grid.axis() <= end))
    np.testing.assert_array_equal(image, small_images(heights[None], 0, 0))


def test_an_image_does_not_depend_on_the_batch(small_maps):
    images = small_images(small_maps)
    for index, (m, t) in enumerate(zip(MAP_INDEX, TRAJECTORY_INDEX, strict=True)):
        alone = small_images(small_maps[m], 0, t)
        np.testing.assert_allclose(images[index], alone, rtol=0, atol=1e-6)
    order = np.array([3, 1, 1, 4])
    again = small_images(small_maps[::-1], 3 - MAP_INDEX[order], TRAJECTORY_INDEX[order])
    np.testing.assert_allclose(again, images[order], rtol=0, atol=1e-6)


def test_a_scalar_index_holds_for_all(small_maps):
    images = small_images(small_maps, 3, TRAJECTORY_INDEX)
    np.testing.assert_array_equal(images, small_images(small_maps, np.full(5, 3), TRAJECTORY_INDEX))
    images = small_images(small_maps, MAP_INDEX, 7)
    np.testing.assert_array_equal(images, small_images(small_maps, MAP_INDEX, np.full(5, 7)))


@pytest.mark.parametrize("kind", [int, np.int32, np.uint8, np.array, jnp.asarray])
def test_two_scalar_indices_give_one_image(small_maps, kind):
    image = small_images(small_maps, kind(3), kind(7))
    assert image.shape == (33, 33, 3)
    np.testing.assert_array_equal(image, small_images(small_maps, [3], [7])[0])


@pytest.mark.parametrize("convert", [np.ndarray.tolist, jnp.asarray, np.uint16, np.int64])
def test_indices_may_be_any_whole_numbers(small_maps, convert):
    images = small_images(small_maps, convert(MAP_INDEX), convert(TRAJECTORY_INDEX))
    np.testing.assert_array_equal(images, small_images(small_maps))


@pytest.mark.parametrize("convert", [jnp.asarray, np.float64, np.ndarray.tolist, np.asfortranarray])
def test_heights_may_be_any_array_of_numbers(small_maps, convert):
    np.testing.assert_allclose(small_images(convert(small_maps)), small_images(small_maps), rtol=0, atol=1e-6)


def test_a_site_at_2000_metres_loses_nothing(small_maps):
    heights = small_maps.astype(np.float64)
    known = MAP_INDEX < 3
    high, low = small_images(heights + 2000), small_images(heights)
    np.testing.assert_allclose(high[known], low[known], rtol=0, atol=1e-6)
    np.testing.assert_allclose(high, low, rtol=0, atol=1e-3)  # the unknown centre costs float32's 0.1 mm at 2000 m


def test_float32_heights_at_1000_metres_lose_nothing_that_they_hold(small_maps):
    heights = np.round(small_maps * 2**12) / np.float32(2**12)
    np.testing.assert_allclose(small_images(heights + np.float32(1000)), small_images(heights), rtol=0, atol=1e-6)


def test_masked_nodes_are_unknown(small_maps):
    masked = np.ma.masked_invalid(small_maps)
    assert masked.mask.any()
    filled = np.ma.masked_array(np.nan_to_num(small_maps, nan=50.0), masked.mask)
    np.testing.assert_allclose(small_images(filled), small_images(small_maps), rtol=0, atol=1e-6)


@pytest.mark.parametrize("value", [np.inf, -np.inf, 30_001, -3.4e38])
@pytest.mark.parametrize("node", [(20, 3), (16, 16)], ids=["aside", "centre"])
def test_heights_of_jax_arrays_that_are_none_are_unknown(small_maps, value, node):
    """As they are to `simulate`."""
    heights = jnp.asarray(small_maps[0])
    image = small_images(heights.at[node].set(value), 0, 0)
    np.testing.assert_array_equal(image, small_images(heights.at[node].set(jnp.nan), 0, 0))


def test_a_robot_may_be_named(small_maps):
    named = render_inputs(small_maps, 0, 5, "husky_a200", SMALL.actions, grid=SMALL.grid)
    np.testing.assert_array_equal(named, small_images(small_maps, 0, 5))


def test_heights_are_not_changed(small_maps):
    heights = small_maps.astype(np.float64) + 2000
    before = heights.copy()
    small_images(heights)
    np.testing.assert_array_equal(heights, before)


def test_images_in_float64_mode_are_the_same(small_maps):
    images = small_images(small_maps)
    with jax.enable_x64(True):
        in_float64_mode = small_images(small_maps)
    assert in_float64_mode.dtype == np.float32
    np.testing.assert_allclose(in_float64_mode[..., 0], images[..., 0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(in_float64_mode[..., 1:], images[..., 1:], rtol=0, atol=LEVEL + 1e-6)


# Assembly on the device


def test_assembled_images_are_those_of_render_inputs(small_maps, bank):
    images = assemble(
        jnp.asarray(small_maps), jnp.asarray(bank), jnp.array(MAP_INDEX), jnp.array(TRAJECTORY_INDEX), 0.4
    )
    assert images.shape == (5, 33, 33, 3)
    assert images.dtype == jnp.float32
    np.testing.assert_allclose(images, small_images(small_maps, elevation_scale=0.4), rtol=0, atol=1e-6)


def test_images_are_assembled_under_jit_and_the_bank_is_no_constant(small_maps, bank):
    """A large array that is closed over would be folded into the program."""
    arguments = (small_maps, bank, MAP_INDEX, TRAJECTORY_INDEX)
    arguments = (*map(jnp.asarray, arguments), 0.4)
    np.testing.assert_allclose(jax.jit(assemble)(*arguments), assemble(*arguments), rtol=0, atol=1e-6)
    constants = jax.make_jaxpr(assemble)(*arguments).consts
    assert sum(np.size(constant) for constant in constants) <= SMALL.grid.nodes**2
    other = assemble(arguments[0], jnp.zeros_like(arguments[1]), *arguments[2:])
    assert not np.asarray(other)[..., 1:].any()


# Input


@pytest.mark.parametrize("index", [-1, 4, [0, 4], [-1, 0]])
def test_maps_that_are_none_are_refused(small_maps, index):
    with pytest.raises(InputError, match=r"^map_index = .*: must be .*0 to 3"):
        small_images(small_maps, index, [0, 1] if isinstance(index, list) else 0)


@pytest.mark.parametrize("index", [-1, 36, [0, 36], [-1, 0]])
def test_trajectories_out_of_range_are_refused(small_maps, index):
    with pytest.raises(InputError, match=r"^trajectory_index = .*: must be .*0 to 35"):
        small_images(small_maps, [0, 1] if isinstance(index, list) else 0, index)


@pytest.mark.parametrize("name", ["map_index", "trajectory_index"])
@pytest.mark.parametrize("index", [1.0, [0.0, 1.0], "1", True, None, 1j, [], [[0, 1], [1, 0]]], ids=repr)
def test_indices_that_are_no_whole_numbers_are_refused(small_maps, name, index):
    indices = {"map_index": 0, "trajectory_index": 0} | {name: index}
    with pytest.raises(InputError, match=f"^{name}") as refusal:
        small_images(small_maps, **indices)
    assert "\n" not in str(refusal.value)


def test_as_many_maps_as_trajectories_are_asked_for(small_maps):
    with pytest.raises(InputError, match="map_index.*trajectory_index|trajectory_index.*map_index"):
        small_images(small_maps, [0, 1], [0, 1, 2])


@pytest.mark.parametrize("scale", [0, -1.0, math.nan, math.inf, "1", None])
def test_scales_that_are_none_are_refused(small_maps, scale):
    with pytest.raises(InputError, match="^elevation_scale = .*: must be .*metres"):
        small_images(small_maps, 0, 0, elevation_scale=scale)


def test_maps_of_another_grid_are_refused(small_maps):
    with pytest.raises(InputError, match=r"^heights: shape \[4, 33, 33\]: must be \[129, 129\]"):
        render_inputs(small_maps, 0, 0)
