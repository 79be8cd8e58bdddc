"""The batched traverse simulator against the sequential float64 one, and grounds whose margins are known."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.conftest import SETUPS
from travjax.config import InputError
from travjax.simulation.actions import ActionSpace
from travjax.simulation.events import EVENTS, Margins
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.terrain.styles import STYLES, generate_terrain
from travjax.traversal import reference
from travjax.traversal.traverse import failures, label, packed, simulate, unpacked

SEEKUR_JR = Robot.load("seekur_jr")
PAPER = ActionSpace()
CELL = Grid().spacing
X, Y = np.meshgrid(Grid().axis(), Grid().axis())
AHEAD, BACK = 0, PAPER.index(9, 0, 0)
"""Straight on, and straight on after half a turn."""

ON_NODES = replace(SEEKUR_JR, track=10 * CELL, wheelbase=6 * CELL)
"""Its wheels stand on nodes wherever its centre does, as long as it faces along an axis."""

ALONG_AXES = ActionSpace(turns=4, radii=(math.inf,), arc_lengths=(16 * CELL, 24 * CELL), interval=CELL)


def flat() -> np.ndarray:
    return np.zeros(Grid().shape, np.float32)


def rough_ground(grid: Grid, seed: int) -> np.ndarray:
    """Waves, noise and terraces, [rows, cols] float32 metres."""
    x, y = np.meshgrid(grid.axis(), grid.axis())
    noise = np.random.default_rng(seed).standard_normal(grid.shape)
    waves = 0.15 * np.sin(2 * x + seed) * np.cos(1.5 * y) + 0.1 * np.round(np.sin(x + 2 * y))
    return (waves + 0.02 * noise).astype(np.float32)


def some_of(actions: ActionSpace, count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).permutation(len(actions))[:count]


def as_array(margins: Margins, sample=slice(None)) -> np.ndarray:
    """Step, obstacle and tilt of some trajectories of one map: [n, 3]."""
    return np.stack([margins[event] for event in EVENTS], axis=-1)[sample]


def assert_same(margins: Margins, expected: Margins, atol=1e-6):
    np.testing.assert_array_equal(margins.known, expected.known)
    for event in EVENTS:
        np.testing.assert_allclose(margins[event], expected[event], rtol=0, atol=atol, err_msg=event)


def assert_agrees(margins: Margins, expected: reference.Margins, sample, robot: Robot):
    """Margins of one map as the sequential simulator has them, and failures but for those on the very limit."""
    wanted = np.stack([expected.step, expected.obstacle, expected.tilt], axis=-1)
    np.testing.assert_array_equal(np.asarray(margins.known)[sample], expected.known)
    np.testing.assert_allclose(as_array(margins, sample), wanted, rtol=0, atol=1e-4)
    differs = np.asarray(failures(margins, robot))[sample] != reference.label(expected, robot)
    on_limit = np.abs(wanted - robot.limits) <= 1e-4
    assert not (differs & ~on_limit).any()


@pytest.fixture(scope="module")
def oracle(maps) -> dict[str, tuple[np.ndarray, reference.Margins]]:
    """Some trajectories of each map and their margins in the sequential simulator."""
    samples = {name: some_of(PAPER, 200, seed) for seed, name in enumerate(maps)}
    return {name: (s, reference.simulate(maps[name], SEEKUR_JR, PAPER, s)) for name, s in samples.items()}


@pytest.fixture(scope="module")
def together(maps) -> Margins:
    """Margins of all the maps, simulated in one batch."""
    return simulate(np.stack(list(maps.values())))


def of_map(margins: Margins, index) -> Margins:
    return jax.tree.map(lambda margin: np.asarray(margin)[index], margins)


# Against the sequential simulator


def test_one_map_agrees_with_the_sequential_simulator(maps, oracle, map_name):
    sample, expected = oracle[map_name]
    assert_agrees(simulate(maps[map_name]), expected, sample, SEEKUR_JR)


def test_every_map_of_a_batch_agrees_with_the_sequential_simulator(maps, oracle, together, map_name):
    sample, expected = oracle[map_name]
    assert_agrees(of_map(together, list(maps).index(map_name)), expected, sample, SEEKUR_JR)


def test_the_maps_show_all_outcomes(maps, oracle):
    """A comparison with the sequential simulator says little where nothing fails."""
    outcomes = {name: reference.label(expected, SEEKUR_JR) for name, (_, expected) in oracle.items()}
    shares = np.array([failed.mean(axis=0) for failed in outcomes.values()])
    assert (shares.mean(axis=0) > 0.02).all()
    assert (shares.max(axis=1) > 0.02).all()
    assert all((~failed.any(axis=-1)).mean() > 0.1 for failed in outcomes.values())
    assert 0.1 < oracle["holes"][1].known.mean() < 0.9


def assert_setup_agrees(setup, count):
    robot, actions, grid = setup.robot, setup.actions, setup.grid
    heights = np.stack([rough_ground(grid, seed) for seed in range(count)])
    margins = simulate(heights, robot, actions, grid=grid)
    assert margins.step.shape == (count, len(actions))
    sample = some_of(actions, 30)
    expected = reference.simulate(heights[-1], robot, actions, sample, grid.spacing)
    assert_agrees(of_map(margins, -1), expected, sample, robot)


def test_other_setups_agree_with_the_sequential_simulator(setup):
    assert_setup_agrees(setup, 1)


@pytest.mark.parametrize(
    "setup", ["odd number of turns", "ties and quarter circles", "chassis longer than 127 nodes"], indirect=True
)
def test_batches_of_other_setups_agree_with_the_sequential_simulator(setup):
    assert_setup_agrees(setup, 3)


@pytest.mark.gpu
def test_a_gpu_agrees_with_the_sequential_simulator(maps, oracle):
    margins = simulate(np.stack(list(maps.values())))
    assert margins.step.devices() <= set(jax.devices("gpu"))
    for index, (sample, expected) in enumerate(oracle.values()):
        assert_agrees(of_map(margins, index), expected, sample, SEEKUR_JR)


# Grounds whose margins are known


@pytest.mark.parametrize("height", [0.0, 5.3, -1200.0])
def test_flat_ground_has_no_margins(height):
    margins = simulate(flat() + np.float32(height))
    assert margins.known.all()
    np.testing.assert_array_equal(margins.step, 0)
    np.testing.assert_array_equal(margins.tilt, 0)
    np.testing.assert_allclose(margins.obstacle, 0, rtol=0, atol=1e-6)
    assert not failures(margins).any()


@pytest.mark.parametrize(("east", "north"), [(0.3, 0), (0, -0.3), (0.2, 0.2), (-0.35, 0.1), (0.05, 0.6)])
def test_a_constant_slope_tilts_the_robot_by_it(east, north):
    """Contacts are read at the nearest node, at most half a cell away along x and y: e metres off.

    The plane's level is then off by at most e, its pitch by 2e / wheelbase and its roll by 2e / track.
    """
    margins = simulate(east * X + north * Y)
    e = (abs(east) + abs(north)) * CELL / 2
    b, t = SEEKUR_JR.wheelbase, SEEKUR_JR.track
    tilt = math.atan(math.hypot(east, north))
    np.testing.assert_allclose(margins.tilt, tilt, rtol=0, atol=2 * e * math.hypot(1 / b, 1 / t))
    above = e * (1 + SEEKUR_JR.chassis_length / b + SEEKUR_JR.chassis_width / t)
    np.testing.assert_allclose(margins.obstacle, 0, rtol=0, atol=above)
    outer_wheel = 1 + math.hypot(b, t) / 2 / min(map(abs, PAPER.radii))
    assert np.max(margins.step) <= math.hypot(east, north) * PAPER.interval * outer_wheel + 2 * e


@pytest.mark.parametrize(("east", "north"), [(0.3, 0), (0, -0.3), (0.2, 0.2), (-0.35, 0.1), (0.05, 0.6)])
def test_tilt_is_the_slope_itself_where_wheels_stand_on_nodes(east, north):
    margins = simulate(east * X + north * Y, ON_NODES, ALONG_AXES)
    np.testing.assert_allclose(margins.tilt, math.atan(math.hypot(east, north)), rtol=0, atol=1e-6)
    np.testing.assert_allclose(margins.obstacle, 0, rtol=0, atol=1e-6)
    along = [abs(slope) * CELL for slope in (north, east, north, east)]
    np.testing.assert_allclose(margins.step, along, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("height", "fails"), [(0.119, False), (0.121, True), (-0.119, False), (-0.121, True)])
def test_a_step_is_met_by_those_who_drive_over_it(height, fails):
    """Up or down 1 m ahead, and nothing behind."""
    heights = np.where(Y >= 1, height, 0).astype(np.float32)
    margins, failed = simulate(heights), label(heights)
    assert float(margins.step[AHEAD]) == pytest.approx(abs(height), abs=1e-7)
    assert bool(failed[AHEAD, EVENTS.index("step")]) is fails
    np.testing.assert_allclose(as_array(margins)[BACK], 0, rtol=0, atol=1e-7)


def rock(x, y, height) -> np.ndarray:
    """Flat ground with one node raised."""
    return np.where((X == x) & (Y == y), height, 0).astype(np.float32)


@pytest.mark.parametrize(("height", "fails"), [(0.107, False), (0.109, True)])
def test_a_rock_that_the_wheels_miss_is_met_by_the_chassis(height, fails):
    heights = rock(0, 2, height)
    margins = simulate(heights)
    np.testing.assert_allclose(as_array(margins)[AHEAD], [0, height, 0], rtol=0, atol=1e-7)
    np.testing.assert_array_equal(label(heights)[AHEAD], [False, fails, False])
    np.testing.assert_allclose(as_array(margins)[BACK], 0, rtol=0, atol=1e-7)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_rock_in_the_way_of_a_wheel_is_a_step_and_tilts(side):
    """The wheels roll 5.3 cells beside the middle; the chassis is 3.5 cells wide on either side."""
    margins = simulate(rock(side * 5 * CELL, 2, 0.1))
    slope = math.hypot(0.05 / SEEKUR_JR.wheelbase, 0.05 / SEEKUR_JR.track)
    np.testing.assert_allclose(as_array(margins)[AHEAD, [0, 2]], [0.1, math.atan(slope)], rtol=0, atol=1e-6)


@pytest.mark.parametrize("cells", [-7, -4, 4, 7])
def test_a_rock_between_chassis_and_wheels_or_outside_is_not_met(cells):
    margins = simulate(rock(cells * CELL, 2, 0.5))
    np.testing.assert_allclose(as_array(margins)[AHEAD], 0, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("width", "length", "cols", "rows", "count"),
    [(0.44, 1.051, 3, 8, 1), (0.3, 1.051, 2, 8, 1), (0.3, 0.3, 2, 2, 1), (0.3, 1.051, 2, 8, 3)],
)
def test_ground_that_wheels_and_chassis_do_not_touch_does_not_matter(width, length, cols, rows, count):
    """Walls all around a corridor for the chassis and two ruts for the wheels, 3.3 m long, just where they pass."""
    row, col = Y / CELL, X / CELL
    chassis = (abs(col) <= cols) & (row >= -rows) & (row <= (3.3 + length / 2) / CELL)
    wheels = (abs(col) == 5) & (row >= -3) & (row <= 56)
    heights = np.where(chassis | wheels, 0, 1).astype(np.float32)
    robot = replace(SEEKUR_JR, chassis_width=width, chassis_length=length)
    margins = simulate(np.stack([heights] * count), robot, ActionSpace(turns=2, radii=(math.inf,), interval=0.11))
    np.testing.assert_allclose(margins.events()[:, AHEAD], 0, rtol=0, atol=1e-7)


@pytest.mark.parametrize("side", [-1, 1])
def test_turning_towards_a_rock_meets_it(side):
    """At the end of a quarter circle to its side stands a rock, away from all other quarter circles."""
    end = 2 * PAPER.arc_lengths[0] / math.pi
    heights = np.where(np.hypot(X - side * end, Y - end) < 0.2, 1.0, 0).astype(np.float32)
    towards = {-1: 1, 1: 2}[side]
    obstacle = np.asarray(simulate(heights).obstacle)
    assert obstacle[PAPER.index(0, towards, 0)] > 0.5
    assert obstacle[PAPER.index(0, 3 - towards, 0)] == 0
    assert obstacle[AHEAD] == 0


def test_the_robot_turns_anticlockwise():
    """After 80 degrees it drives west, after 280 degrees east."""
    obstacle = np.asarray(simulate(rock(-2, 2 * CELL * 3, 1.0)).obstacle)
    assert obstacle[PAPER.index(4, 0, 0)] == pytest.approx(1)
    assert obstacle[PAPER.index(14, 0, 0)] == 0


def test_a_trench_under_the_chassis_is_no_obstacle():
    heights = np.where(np.abs(X) < 4 * CELL, -1, 0).astype(np.float32)
    np.testing.assert_allclose(as_array(simulate(heights))[AHEAD], [0, -1, 0], rtol=0, atol=1e-7)


# Symmetries


def turned(trajectory, actions=PAPER, part=2):
    """The trajectory that looks the same on the map turned by one `part`-th of a circle, anticlockwise."""
    turn, first, second = actions.split(trajectory)
    return actions.index((turn + actions.turns // part) % actions.turns, first, second)


def mirrored(trajectory, actions=PAPER):
    """The trajectory that looks the same on the map mirrored left to right."""
    opposite = np.array([actions.radii.index(-r if math.isfinite(r) else r) for r in actions.radii])
    turn, first, second = actions.split(trajectory)
    return actions.index(-turn % actions.turns, opposite[first], opposite[second])


def of_trajectories(margins: Margins, trajectories) -> Margins:
    return jax.tree.map(lambda margin: np.asarray(margin)[trajectories], margins)


def assert_permuted(heights, image, permutation, actions=PAPER):
    """The image of a map has the margins of the map in other places, and the same failures but on the very limit."""
    margins, of_image = simulate(heights, None, actions), simulate(image, None, actions)
    assert_same(of_trajectories(of_image, permutation), margins, atol=1e-5)
    on_limit = np.abs(as_array(margins) - SEEKUR_JR.limits) <= 1e-5
    differs = np.asarray(failures(of_image))[permutation] != failures(margins)
    assert not (differs & ~on_limit).any()


@st.composite
def grounds(draw) -> np.ndarray:
    """A synthetic map, sometimes with noise or holes."""
    seed = draw(st.integers(0, 2**32 - 1))
    heights = np.array(generate_terrain(draw(st.sampled_from(STYLES)), seed)[0])
    rng = np.random.default_rng(seed)
    heights += draw(st.sampled_from([0, 0.01, 0.05])) * rng.standard_normal(heights.shape)
    heights[rng.random(heights.shape) < draw(st.sampled_from([0, 0.001]))] = np.nan
    return heights


EVERY = np.arange(len(PAPER))


@given(grounds())
def test_turning_the_map_by_180_degrees_permutes_the_trajectories(heights):
    assert_permuted(heights, heights[::-1, ::-1], turned(EVERY))


@given(grounds())
def test_mirroring_the_map_permutes_the_trajectories(heights):
    assert_permuted(heights, heights[:, ::-1], mirrored(EVERY))


@given(grounds())
def test_turning_the_map_by_90_degrees_permutes_the_trajectories(heights):
    """No view of the tables turns by 90 degrees; anticlockwise is clockwise for rows that count downwards."""
    actions = ActionSpace(turns=4, radii=(math.inf, 1.5, -1.5, 3.0), interval=0.13)
    assert_permuted(heights, np.rot90(heights, -1), turned(np.arange(len(actions)), actions, part=4), actions)


@given(grounds(), st.floats(-100, 100))
def test_raising_the_map_changes_nothing(heights, height):
    assert_same(simulate(heights.astype(float) + height), simulate(heights.astype(float)), atol=1e-5)


# Batches


@pytest.fixture(scope="module")
def pool(maps) -> tuple[np.ndarray, Margins]:
    """70 maps, each different from the others, and their margins in one batch."""
    rng = np.random.default_rng(0)
    named = list(maps.values())
    several = [np.roll(named[k % 7], k, axis=1) * rng.choice([-1, 1]) * rng.uniform(0.5, 1) for k in range(70)]
    heights = np.stack(several).astype(np.float32)
    return heights, simulate(heights)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 32, 33, 70])
def test_margins_do_not_depend_on_the_batch(pool, count):
    heights, margins = pool
    chosen = np.random.default_rng(count).permutation(70)[:count]
    assert_same(simulate(heights[chosen]), of_map(margins, chosen))


@given(st.lists(st.integers(0, 69), min_size=3, max_size=8))
def test_margins_do_not_depend_on_the_position_in_the_batch(pool, chosen):
    heights, margins = pool
    assert_same(simulate(heights[chosen]), of_map(margins, np.array(chosen)))


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("paper", 12),
        ("unpaired radii", 7),
        ("odd turns and unpaired radii", 7),
        ("fine large map", 7),
        ("coarse small map", 7),
    ],
)
def test_a_map_has_the_same_bits_in_any_batch(name, count):
    """Loops over few maps and views are compiled in other ways than those over many: these differed in 1e-8 m."""
    setup = SETUPS[name]
    robot, actions, grid = setup.robot, setup.actions, setup.grid
    heights = np.stack([rough_ground(grid, seed) for seed in range(count)])
    wanted = simulate(heights, robot, actions, grid=grid)
    for fewer in (1, 2, 4, 7):
        assert_same(simulate(heights[:fewer], robot, actions, grid=grid), of_map(wanted, slice(fewer)), atol=0)


@pytest.mark.parametrize("count", [1, 7])
def test_the_same_call_gives_the_same_bits(maps, count):
    heights = np.stack(list(maps.values()))[:count]
    assert_same(simulate(heights), simulate(heights), atol=0)


def test_one_map_has_no_leading_axis(maps):
    heights = maps["rough"]
    alone, batch = simulate(heights), simulate(heights[None])
    assert alone.step.shape == alone.obstacle.shape == alone.tilt.shape == alone.known.shape == (3042,)
    assert batch.step.shape == (1, 3042)
    assert alone.events().shape == label(heights).shape == (3042, 3)
    assert label(heights[None]).shape == (1, 3042, 3)
    assert_same(of_map(batch, 0), alone, atol=0)


# Input


@pytest.mark.parametrize("convert", [jnp.asarray, np.float64, np.ndarray.tolist, np.asfortranarray])
def test_heights_may_be_any_array_of_numbers(maps, convert):
    heights = maps["holes"]
    assert_same(simulate(convert(heights)), simulate(heights))


@pytest.mark.parametrize("dtype", [np.int32, np.int64, np.uint8, np.float16, object])
def test_whole_metres_may_be_of_any_type(dtype):
    heights = np.round(2 + np.sin(X) + np.cos(Y))
    assert heights.min() == 0 and heights.max() == 4
    assert_same(simulate(heights.astype(dtype)), simulate(heights.astype(np.float32)))


def test_jax_arrays_of_whole_metres_are_numbers_too():
    heights = np.round(2 + np.sin(X) + np.cos(Y)).astype(np.int32)
    assert_same(simulate(jnp.asarray(heights)), simulate(heights))


@pytest.mark.parametrize("count", [None, 3])
def test_a_site_at_2000_metres_loses_nothing(maps, count):
    heights = maps["holes"].astype(np.float64)
    if count is not None:
        heights = np.stack([heights, 2 * heights, heights[::-1]])
    high = simulate(heights + 2000)
    assert np.asarray(high.known).mean() < 0.9
    assert_same(high, simulate(heights))


@pytest.mark.parametrize("convert", [np.asarray, jnp.asarray])
def test_float32_heights_at_1000_metres_lose_nothing_that_they_hold(maps, convert):
    heights = np.round(maps["rough"] * 2**12) / np.float32(2**12)
    assert_same(simulate(convert(heights + np.float32(1000))), simulate(heights))


def test_masked_nodes_are_unknown(maps):
    heights = maps["holes"]
    masked = np.ma.masked_invalid(heights)
    assert_same(simulate(masked), simulate(heights))
    assert_same(simulate(np.ma.masked_array(np.nan_to_num(heights), masked.mask)), simulate(heights))


@pytest.mark.parametrize("value", [np.inf, -np.inf, 30_001, -3.4e38])
@pytest.mark.parametrize("node", [(100, 64), (100, 69), (64, 64)], ids=["chassis", "wheel", "centre"])
def test_heights_of_jax_arrays_that_are_none_are_unknown(value, node):
    heights, unknown = jnp.asarray(flat()).at[node].set(value), jnp.asarray(flat()).at[node].set(jnp.nan)
    margins = simulate(heights)
    assert not margins.known[AHEAD]
    assert_same(margins, simulate(unknown), atol=0)


def test_a_robot_may_be_named(maps):
    heights, robot = maps["scattered_sharp"], Robot.load("leo_rover")
    actions = SETUPS["unpaired radii"].actions
    assert_same(simulate(heights, "leo_rover", actions), simulate(heights, robot, actions), atol=0)
    np.testing.assert_array_equal(label(heights, "leo_rover", actions), label(heights, robot, actions))


def test_heights_are_not_changed(maps):
    heights = maps["holes"].astype(np.float64) + 2000
    before = heights.copy()
    simulate(heights)
    np.testing.assert_array_equal(heights, before)


@pytest.mark.parametrize("shape", [(128, 128), (129, 128), (129,), (1, 1, 129, 129), (3, 65, 65), ()])
def test_maps_of_another_shape_than_the_grid_are_refused(shape):
    allowed = r"\[129, 129\] or \[n, 129, 129\], a 8 m map at 0.0625 m$"
    with pytest.raises(InputError, match=rf"^heights: shape \[.*\]: must be {allowed}"):
        simulate(np.zeros(shape))


def test_a_map_of_another_grid_needs_that_grid():
    actions = ActionSpace(turns=1, radii=(math.inf,), arc_lengths=(0.5, 0.5))
    assert simulate(np.zeros((33, 33)), None, actions, grid=Grid(4, 0.125)).step.shape == (1,)
    with pytest.raises(InputError, match=r"^heights: shape \[33, 33\]: must be \[129, 129\]"):
        simulate(np.zeros((33, 33)), None, actions)


def test_zero_maps_are_refused():
    with pytest.raises(InputError, match="^heights: zero maps: must be at least one$"):
        simulate(np.zeros((0, 129, 129)))


@pytest.mark.parametrize("dtype", [bool, complex, str, "datetime64[s]"])
def test_what_is_no_number_is_refused(dtype):
    with pytest.raises(InputError, match=r"^heights: dtype .*: must be numbers \(metres\)$"):
        simulate(flat().astype(int).astype(dtype))


@pytest.mark.parametrize("value", [np.inf, -np.inf, 30_001, -3.4e38])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_height_that_is_none_is_refused(value, dtype):
    heights = flat().astype(dtype)
    heights[3, 5] = value
    with pytest.raises(InputError, match="^heights = .*: must be metres between -30000 and 30000, or NaN where"):
        simulate(heights)


def test_trajectories_that_leave_the_map_are_refused():
    with pytest.raises(InputError, match="^arc_lengths = .*: trajectories leave the 4 m map"):
        simulate(np.zeros((65, 65)), grid=Grid(4))


def test_radii_inside_the_robot_are_refused():
    with pytest.raises(InputError, match="^radii = 0.3: must be at least half the track"):
        simulate(flat(), None, ActionSpace(radii=(0.3,)))


# Unknown ground


@pytest.mark.parametrize(("x", "y"), [(0, 2), (5 * CELL, 2), (-5 * CELL, -1), (CELL, 52 * CELL), (2, 1), (-4, -4)])
def test_an_unknown_node_makes_those_unknown_that_touch_it(maps, x, y):
    """All others keep their margins, bit for bit."""
    heights = maps["rough"].copy()
    before = simulate(heights)
    heights[(X == x) & (Y == y)] = np.nan
    margins = simulate(heights)
    known, sample = np.asarray(margins.known), some_of(PAPER, 60)
    assert_agrees(margins, reference.simulate(heights, SEEKUR_JR, PAPER, sample), sample, SEEKUR_JR)
    assert np.isnan(as_array(margins, ~known)).all()
    assert not label(heights)[~known].any()
    assert_same(of_trajectories(margins, known), of_trajectories(before, known), atol=0)
    assert known.all() == ((x, y) == (-4, -4))
    assert known[AHEAD] == ((x, y) not in [(0, 2), (5 * CELL, 2), (CELL, 52 * CELL)])


def test_unknown_ground_of_one_map_is_known_on_the_others(maps):
    heights = np.stack([maps["rough"], np.full_like(flat(), np.nan), maps["wavy"]])
    margins = simulate(heights)
    assert margins.known[0].all() and not margins.known[1].any() and margins.known[2].all()
    assert_same(of_map(margins, 0), simulate(maps["rough"]))


@pytest.mark.parametrize("count", [1, 3])
def test_a_map_of_unknown_ground_has_no_margins(count):
    heights = np.full((count, 129, 129), np.nan, np.float32)
    margins = simulate(heights)
    assert not margins.known.any()
    assert np.isnan(margins.events()).all()
    assert not label(heights).any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_trajectory_starts_on_the_centre(maps, dtype):
    heights = maps["rough"].astype(dtype)
    heights[64, 64] = np.nan
    assert not simulate(heights).known.any()


def test_an_unknown_node_under_one_wheel_at_the_start_is_enough():
    """It lies under the rear left wheel; turned by 20 degrees to the right, wheels and chassis pass beside it."""
    heights = flat()
    heights[64 - 3, 64 - 5] = np.nan
    known = simulate(heights).known
    assert not known[AHEAD]
    assert known[PAPER.index(17, 0, 0)]


# Failures


def test_failures_are_margins_above_the_limits_in_the_order_of_events():
    robot = replace(SEEKUR_JR, max_step=0.1, ride_height=0.2, max_tilt=0.3)
    above, below = np.nextafter(np.float32(robot.limits), 1), np.float32(robot.limits)
    step, obstacle, tilt = np.where(np.eye(3, dtype=bool), above[:, None], below[:, None])
    failed = failures(Margins(step, obstacle, tilt, np.ones(3, bool)), robot)
    assert failed.dtype == bool
    assert EVENTS == ("step", "obstacle", "tilt")
    np.testing.assert_array_equal(failed, np.eye(3, dtype=bool))


def test_nothing_fails_where_unknown():
    nothing = np.full(4, np.nan, np.float32)
    assert not failures(Margins(nothing, nothing, nothing, np.zeros(4, bool))).any()


def test_a_label_is_the_failures_of_the_margins(maps):
    heights = maps["scattered_sharp"]
    timid = replace(SEEKUR_JR, max_step=0.05, ride_height=0.05, max_tilt=0.2)
    np.testing.assert_array_equal(label(heights), failures(simulate(heights)))
    np.testing.assert_array_equal(label(heights, timid), failures(simulate(heights), timid))
    assert (np.asarray(label(heights, timid)) & ~np.asarray(label(heights))).any(axis=0).all()


def test_the_default_is_the_seekur_jr_and_the_paper_actions(maps):
    assert_same(simulate(maps["rough"]), simulate(maps["rough"], SEEKUR_JR, PAPER), atol=0)


@given(st.integers(0, 15))
def test_labels_are_packed_in_four_bits(bits):
    *failed, unknown = (np.array([[bits >> k & 1]], bool) for k in range(4))
    labels = packed(jnp.concatenate(failed, axis=-1)[:, None, :], jnp.asarray(~unknown))
    assert labels.dtype == jnp.uint8
    assert labels.tolist() == [[bits]]


def test_packed_labels_are_unpacked_as_they_were(maps):
    heights = np.stack([maps["holes"], maps["scattered_sharp"]])
    failed, known = label(heights), simulate(heights).known
    labels = packed(failed, known)
    assert labels.shape == (2, 3042)
    again = unpacked(labels)
    np.testing.assert_array_equal(again[0], failed)
    np.testing.assert_array_equal(again[1], known)
