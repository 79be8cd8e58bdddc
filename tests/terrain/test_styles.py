"""Terrain against Algorithm 1 in float64 on the `opensimplex` package, and parameters against the table of styles."""

import subprocess
import sys
from dataclasses import fields, replace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from opensimplex import OpenSimplex

from travjax.config import InputError
from travjax.simulation.grid import Grid
from travjax.terrain.styles import STYLES, TerrainParams, elevation, generate_terrain, sample_params
from travjax.traversal.traverse import simulate

FIELDS = [field.name for field in fields(TerrainParams)]

TABLE = {
    "mountain_crater": dict(
        perc_obstacles=[(0.15, 0.2)],
        smooth_transition=[(0.2, 1)],
        distribution_x=[(0.05, 0.1)],
        distribution_y=[(0.05, 0.1)],
        height_obstacles=[(2, 6), (-6, -2)],
        smooth_mountains=[(1, 6)],
        smooth_plains=[(0.3, 1)],
        slopes_variation=[(0.05, 0.5)],
        max_slope_variation=[(0.3, 0.3)],
    ),
    "smooth": dict(
        perc_obstacles=[(0.05, 0.1)],
        smooth_transition=[(0.3, 0.3)],
        distribution_x=[(0.85, 0.85)],
        distribution_y=[(0.85, 0.85)],
        height_obstacles=[(0.5, 0.5)],
        smooth_mountains=[(0.2, 0.2)],
        smooth_plains=[(0.4, 0.9)],
        slopes_variation=[(0.08, 0.8)],
        max_slope_variation=[(0.08, 0.4)],
    ),
    "rough": dict(
        perc_obstacles=[(0.1, 0.15)],
        smooth_transition=[(0.1, 0.1)],
        distribution_x=[(0.7, 0.85)],
        distribution_y=[(0.7, 0.85)],
        height_obstacles=[(0.5, 1.5)],
        smooth_mountains=[(0.1, 0.1)],
        smooth_plains=[(0.03, 0.05)],
        slopes_variation=[(0.03, 0.06)],
        max_slope_variation=[(0.05, 0.5)],
    ),
    "wavy": dict(
        perc_obstacles=[(0.1, 0.1)],
        smooth_transition=[(0.1, 0.1)],
        distribution_x=[(0.7, 0.7)],
        distribution_y=[(0.7, 0.7)],
        height_obstacles=[(1, 1)],
        smooth_mountains=[(0.1, 0.1)],
        smooth_plains=[(0.3, 0.35), (0.4, 0.7)],
        slopes_variation=[(0.45, 0.55), (0.8, 1)],
        max_slope_variation=[(0.5, 0.5)],
    ),
    "scattered_sharp": dict(
        perc_obstacles=[(0.1, 0.17)],
        smooth_transition=[(0.3, 0.3)],
        distribution_x=[(0.85, 0.9)],
        distribution_y=[(0.85, 0.9)],
        height_obstacles=[(0.3, 2.5)],
        smooth_mountains=[(0.1, 0.2)],
        smooth_plains=[(0.4, 0.4)],
        slopes_variation=[(0.5, 0.5)],
        max_slope_variation=[(0.4, 0.4)],
    ),
}
"""The table of SPEC section 2: for every field one range, or one for each half of the maps."""

PLAIN = TerrainParams(
    perc_obstacles=0.3,
    smooth_transition=0.5,
    distribution_x=0.6,
    distribution_y=0.8,
    height_obstacles=1.5,
    smooth_mountains=0.15,
    smooth_plains=0.4,
    slopes_variation=0.5,
    max_slope_variation=0.4,
)

each_style = pytest.mark.parametrize("style", STYLES)


def algorithm_1(params: TerrainParams, noise_seed, x, y, size=8.0) -> np.ndarray:
    """SPEC section 2 in float64 for one map: [len(y), len(x)] metres."""
    noise2 = OpenSimplex(int(noise_seed)).noise2
    lo, hi = 1 / size, size

    def noise(f_x, f_y):
        return np.array([[noise2(one_x / f_x, one_y / f_y) for one_x in x] for one_y in y])

    one = {field: float(getattr(params, field)) for field in FIELDS}
    s_w = (noise((lo - hi) * one["distribution_x"] + hi, (lo - hi) * one["distribution_y"] + hi) + 1) / 2
    start = one["perc_obstacles"] - 0.2 * one["smooth_transition"]
    end = one["perc_obstacles"] + 0.2 * one["smooth_transition"]
    w = np.clip((s_w - start) / (end - start), 0, 1)
    f = (hi - lo) * one["smooth_plains"] + lo
    plains = ((noise(f, f) + 1) * one["max_slope_variation"] * 0.15 * size) ** one["slopes_variation"] - 0.8
    f = (hi - lo) * one["smooth_mountains"] + lo
    mountains = (noise(f, f) + 1) / 2 * one["height_obstacles"]
    return plains * w + mountains * (1 - w)


def one_of(params: TerrainParams, index: int) -> TerrainParams:
    return TerrainParams(*(np.asarray(getattr(params, field))[index] for field in FIELDS))


def test_maps_of_one_world_are_the_same_where_they_overlap():
    params, noise_seeds = sample_params(STYLES, range(5))
    small = np.asarray(generate_terrain(STYLES, range(5)))
    large = np.asarray(generate_terrain(STYLES, range(5), grid=Grid(16), world=8))
    np.testing.assert_array_equal(large[:, 64:193, 64:193], small)
    again = elevation(params, noise_seeds, grid=Grid(16), world=8.0)
    np.testing.assert_array_equal(again, large)
    grown = np.asarray(generate_terrain(STYLES, range(5), grid=Grid(16)))
    np.testing.assert_array_equal(generate_terrain(STYLES, range(5), grid=Grid(16), world=16), grown)
    assert not np.array_equal(grown[:, 64:193, 64:193], small)


def test_a_larger_map_of_the_same_world_is_algorithm_1_with_its_size():
    params, noise_seeds = sample_params("rough", 3)
    heights = np.asarray(generate_terrain("rough", 3, grid=Grid(12, 0.125), world=8))[0]
    axis = Grid(12, 0.125).axis()[::8]
    expected = algorithm_1(one_of(params, 0), noise_seeds[0], axis, axis, 8)
    np.testing.assert_allclose(heights[::8, ::8], expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("world", [0, 0.99, 1001, -8, np.nan, np.inf, "8", True])
def test_a_bad_world_is_refused(world):
    with pytest.raises(InputError, match="^world = .*: must be a map size in metres from 1 to 1000$"):
        generate_terrain("rough", 0, world=world)


def assert_is_algorithm_1(heights, params: TerrainParams, noise_seed, grid=Grid(), every=1, offset=0):
    """Compares every so many rows and columns of one map."""
    axis = grid.axis()[offset::every]
    expected = algorithm_1(params, noise_seed, axis, axis, grid.size)
    np.testing.assert_allclose(heights[offset::every, offset::every], expected, rtol=0, atol=1e-4)


@pytest.fixture(scope="module")
def sampled() -> dict[str, dict[str, np.ndarray]]:
    """Parameters of 500 seeds of every style, and their noise seeds."""
    result = {}
    for style in STYLES:
        params, noise_seeds = sample_params(style, range(500))
        result[style] = {field: np.asarray(getattr(params, field)) for field in FIELDS}
        result[style]["noise_seed"] = np.asarray(noise_seeds)
    return result


@each_style
def test_maps_are_those_of_algorithm_1(style):
    seeds = range(1000, 1032)
    params, noise_seeds = sample_params(style, seeds)
    heights = np.asarray(generate_terrain(style, seeds))
    assert heights.shape == (32, 129, 129)
    assert heights.dtype == np.float32
    for index, one in enumerate(heights):
        assert_is_algorithm_1(one, one_of(params, index), noise_seeds[index], every=8, offset=index % 8)


@each_style
def test_every_node_of_a_map_is_that_of_algorithm_1(style):
    params, noise_seeds = sample_params(style, 7)
    assert_is_algorithm_1(np.asarray(generate_terrain(style, 7))[0], one_of(params, 0), noise_seeds[0])


@pytest.mark.parametrize(
    "grid", [Grid(4, 0.125), Grid(8, 0.25), Grid(5, 0.2), Grid(12, 0.125)], ids=["small", "coarse", "odd", "large"]
)
def test_maps_of_other_grids_are_those_of_algorithm_1(grid):
    params, noise_seeds = sample_params(STYLES, range(5))
    heights = np.asarray(generate_terrain(STYLES, range(5), grid=grid))
    assert heights.shape == (5, *grid.shape)
    for index, one in enumerate(heights):
        assert_is_algorithm_1(one, one_of(params, index), noise_seeds[index], grid, every=4, offset=index % 4)


def unit(low, high):
    return st.floats(low, high, width=32)


@given(
    st.builds(
        TerrainParams,
        perc_obstacles=unit(0, 1),
        smooth_transition=unit(0.125, 1),
        distribution_x=unit(0, 1),
        distribution_y=unit(0, 1),
        height_obstacles=unit(-6, 6),
        smooth_mountains=unit(0, 6),
        smooth_plains=unit(0, 1),
        slopes_variation=unit(0.0625, 1),
        max_slope_variation=unit(0.0625, 0.5),
    ),
    st.integers(0, 9999),
)
def test_elevation_is_algorithm_1_for_any_parameters(params, noise_seed):
    heights = elevation(params, noise_seed)
    assert heights.shape == (129, 129)
    assert_is_algorithm_1(heights, params, noise_seed, every=16, offset=noise_seed % 16)


@each_style
@pytest.mark.parametrize("field", FIELDS)
def test_sampled_parameters_fill_the_ranges_of_the_table(sampled, style, field):
    values = sampled[style][field]
    inside = [(values >= low - 1e-6) & (values <= high + 1e-6) for low, high in TABLE[style][field]]
    assert np.logical_or.reduce(inside).all()
    for (low, high), chosen in zip(TABLE[style][field], inside, strict=True):
        assert values[chosen].min() == pytest.approx(low, abs=0.05 * (high - low) + 1e-6)
        assert values[chosen].max() == pytest.approx(high, abs=0.05 * (high - low) + 1e-6)


@each_style
def test_the_table_has_every_field_of_every_style(style):
    assert list(TABLE[style]) == FIELDS
    assert set(TABLE) == set(STYLES)


@pytest.mark.parametrize(("style", "field"), [("mountain_crater", "height_obstacles"), ("wavy", "smooth_plains")])
def test_both_halves_of_a_style_occur_about_equally_often(sampled, style, field):
    (_, high), _ = sorted(TABLE[style][field])
    assert 0.4 < (sampled[style][field] <= high + 1e-6).mean() < 0.6


def test_the_pairs_of_wavy_maps_go_together(sampled):
    short = sampled["wavy"]["smooth_plains"] < 0.375
    low = sampled["wavy"]["slopes_variation"] < 0.7
    np.testing.assert_array_equal(short, low)


@each_style
def test_fields_vary_independently_of_each_other(sampled, style):
    """Correlation of 500 independent pairs is under 0.2 but for one case in 100,000."""
    two_halves = {"wavy": ["smooth_plains", "slopes_variation"]}.get(style, [])
    varied = [f for f in FIELDS if f not in two_halves and max(high - low for low, high in TABLE[style][f]) > 0]
    values = [sampled[style][field] for field in (*varied, "noise_seed")]
    correlation = np.corrcoef(values) - np.eye(len(values))
    assert np.abs(correlation).max() < 0.2


@each_style
def test_noise_seeds_spread_over_all_of_them(sampled, style):
    noise_seeds = sampled[style]["noise_seed"]
    assert np.issubdtype(noise_seeds.dtype, np.integer)
    assert 0 <= noise_seeds.min() < 200
    assert 9800 < noise_seeds.max() < 10_000
    assert len(set(noise_seeds.tolist())) > 450


def test_a_seed_means_something_else_in_every_style(sampled):
    noise_seeds = np.array([sampled[style]["noise_seed"] for style in STYLES])
    for first in range(len(STYLES)):
        for second in range(first):
            assert (noise_seeds[first] == noise_seeds[second]).mean() < 0.02


def test_styles_are_those_of_the_paper():
    assert set(STYLES) == {"mountain_crater", "smooth", "rough", "wavy", "scattered_sharp"}


def test_a_map_is_the_elevation_of_its_parameters():
    np.testing.assert_array_equal(generate_terrain("wavy", 3), elevation(*sample_params("wavy", 3)))


@pytest.mark.parametrize("count", [3, 33, 70])
def test_a_map_is_the_same_in_any_batch(count):
    rng = np.random.default_rng(count)
    seeds, styles = rng.integers(0, 2**32, count), rng.choice(STYLES, count)
    together = np.asarray(generate_terrain(styles, seeds))
    for index in {0, count // 2, count - 1}:
        alone = generate_terrain(str(styles[index]), int(seeds[index]))[0]
        np.testing.assert_allclose(together[index], alone, rtol=0, atol=1e-6)


def test_the_same_call_gives_the_same_bits():
    first, second = (np.asarray(generate_terrain(STYLES, range(5))) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_one_style_stands_for_all_seeds_and_a_range_for_a_list():
    expected = generate_terrain(["rough"] * 3, [4, 5, 6])
    np.testing.assert_array_equal(generate_terrain("rough", range(4, 7)), expected)
    np.testing.assert_array_equal(generate_terrain("rough", np.array([4, 5, 6], np.uint8)), expected)
    np.testing.assert_array_equal(generate_terrain("rough", jnp.array([4, 5, 6])), expected)


def test_one_seed_gives_a_batch_of_one_map():
    np.testing.assert_array_equal(generate_terrain("smooth", 9), generate_terrain("smooth", [9]))
    assert generate_terrain("smooth", 9).shape == (1, 129, 129)


def test_different_seeds_give_different_maps():
    heights = np.asarray(generate_terrain("smooth", [0, 1, 2**32 - 1]))
    assert np.abs(heights[0] - heights[1]).max() > 0.1
    assert np.abs(heights[0] - heights[2]).max() > 0.1


def test_numbers_give_one_map_and_arrays_a_batch():
    assert elevation(PLAIN, 5).shape == (129, 129)
    assert elevation(PLAIN, [5]).shape == (1, 129, 129)
    assert elevation(replace(PLAIN, height_obstacles=np.ones(1)), 5).shape == (1, 129, 129)


def test_numbers_stand_for_all_maps_of_a_batch():
    heights = elevation(replace(PLAIN, height_obstacles=np.array([0.5, 1.5])), [5, 6])
    low, high = replace(PLAIN, height_obstacles=0.5), PLAIN
    np.testing.assert_allclose(heights, jnp.stack([elevation(low, 5), elevation(high, 6)]), rtol=0, atol=1e-6)


def test_the_first_and_the_last_noise_seed_are_allowed():
    ends = elevation(PLAIN, [0, 9999])
    assert_is_algorithm_1(ends[0], PLAIN, 0, every=16)
    assert_is_algorithm_1(ends[1], PLAIN, 9999, every=16)


def test_a_sharp_transition_leaves_no_hole():
    """The noise is 0 at the centre of every map, so the mixing noise is exactly perc_obstacles = 0.5 there."""
    sharp = replace(PLAIN, perc_obstacles=0.5, smooth_transition=0.0)
    assert np.isfinite(elevation(sharp, range(4))).all()


def test_plains_without_slope_are_level():
    level = replace(PLAIN, perc_obstacles=0.0, smooth_transition=0.0, max_slope_variation=0.0)
    np.testing.assert_allclose(elevation(level, 3), -0.8, rtol=0, atol=1e-6)


@pytest.mark.parametrize("style", ["plain", "", "Rough", ["rough", "plain"], ["rough", 3]])
def test_an_unknown_style_is_refused_with_the_known_ones(style):
    allowed = "mountain_crater, smooth, rough, wavy, scattered_sharp"
    with pytest.raises(InputError, match=f"^style = .*: must be one of {allowed}$"):
        generate_terrain(style, [1, 2])


@pytest.mark.parametrize("seeds", [[], range(0), np.zeros(0, int), [[1, 2]], np.zeros((2, 2), int)])
def test_no_list_of_seeds_is_refused(seeds):
    with pytest.raises(InputError, match="(?s)^seeds = .*: must be one or more integers from 0 to 4294967295$"):
        generate_terrain("rough", seeds)


@pytest.mark.parametrize("seeds", [-1, [3, -1], 2**32, [0, 2**32], 2**70, 1.0, [1, 2.5], "1", None, True, [False]])
def test_bad_seeds_are_refused(seeds):
    with pytest.raises(InputError, match="^seeds = .*: must be one or more integers from 0 to 4294967295$"):
        generate_terrain("rough", seeds)


@pytest.mark.parametrize("seeds", [np.zeros((2, 2), int), -np.ones(40, int)])
def test_a_refusal_of_an_array_is_one_line(seeds):
    with pytest.raises(InputError) as raised:
        generate_terrain("rough", seeds)
    assert "\n" not in str(raised.value)


def test_the_largest_seed_is_allowed():
    assert np.isfinite(generate_terrain("rough", [0, 2**32 - 1])).all()


@pytest.mark.parametrize("styles", [["rough"], ["rough", "wavy", "smooth"], []])
def test_another_number_of_styles_than_of_seeds_is_refused(styles):
    with pytest.raises(InputError, match=f"^style = '{len(styles)} styles for 2 seeds': must be one, or one a seed$"):
        generate_terrain(styles, [1, 2])


@pytest.mark.parametrize("noise_seed", [-1, 10_000, [3, 10_000], 2.0, "3", None, True, []])
def test_a_bad_noise_seed_is_refused(noise_seed):
    with pytest.raises(InputError, match="^noise_seed = .*: must be an integer from 0 to 9999$"):
        elevation(PLAIN, noise_seed)


@pytest.mark.parametrize("field", [f for f in FIELDS if f != "height_obstacles" and not f.startswith("distribution")])
@pytest.mark.parametrize("value", [-0.1, np.array([0.5, -0.1])], ids=["number", "array"])
def test_a_negative_parameter_is_refused(field, value):
    with pytest.raises(InputError, match=f"^{field} = .*: must be at least 0$"):
        elevation(replace(PLAIN, **{field: value}), 3)


def test_craters_are_allowed():
    craters = replace(PLAIN, height_obstacles=-2.0)
    assert_is_algorithm_1(elevation(craters, 3), craters, 3, every=16)


@pytest.mark.parametrize("field", ["distribution_x", "distribution_y"])
@pytest.mark.parametrize("value", [-0.01, 1.01])
def test_a_distribution_outside_0_to_1_is_refused(field, value):
    with pytest.raises(InputError, match=f"^{field} = .*: must be from 0 to 1$"):
        elevation(replace(PLAIN, **{field: value}), 3)


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("value", [np.nan, np.inf, np.array([0.5, np.nan])], ids=["nan", "inf", "array"])
def test_a_parameter_that_is_not_finite_is_refused(field, value):
    with pytest.raises(InputError, match=f"^{field} = .*: must be finite$"):
        elevation(replace(PLAIN, **{field: value}), 3)


def test_arrays_of_two_axes_are_refused():
    with pytest.raises(InputError, match=r"^params = 'arrays of shape \(2, 3\)': must be numbers or \[n\] arrays$"):
        elevation(replace(PLAIN, height_obstacles=np.ones((2, 3))), 3)


def test_the_maps_are_the_same_where_float64_is_enabled():
    program = (
        "import jax, numpy, travjax; jax.config.update('jax_enable_x64', True); "
        "z = travjax.generate_terrain('rough', [3, 4]); m = travjax.simulate(z); "
        "print(z.dtype, m.step.dtype, *(repr(float(v)) for v in (z[0, 5, 7], z[1, 100, 3], m.tilt[1, 17])))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    heights = generate_terrain("rough", [3, 4])
    expected = heights[0, 5, 7], heights[1, 100, 3], simulate(heights).tilt[1, 17]
    heights_type, margin_type, *values = done.stdout.split()
    assert (heights_type, margin_type) == ("float32", "float32")
    np.testing.assert_allclose([float(value) for value in values], np.array(expected), rtol=0, atol=1e-6)
