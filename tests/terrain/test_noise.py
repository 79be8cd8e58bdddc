"""OpenSimplex in JAX against the `opensimplex` package."""

from functools import partial

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from opensimplex import OpenSimplex
from opensimplex.internals import _init

from travjax.config import InputError
from travjax.terrain.noise import SEEDS, noise2, noise_on_axes, permutation_table, permutations

seeds = st.integers(0, SEEDS - 1)
coordinates = st.floats(-31.96875, 31.96875, width=32)


def expected_noise(seed, x, y) -> np.ndarray:
    """The package's noise at each of the points (x, y), in float64."""
    noise = OpenSimplex(int(seed)).noise2
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    return np.array([noise(*point) for point in zip(x.flat, y.flat, strict=True)]).reshape(x.shape)


def random_points(seed, count, reach=32) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-reach, reach, (2, count)).astype(np.float32)


def points_beside_cell_edges(seed, count) -> np.ndarray:
    """Points within a few float32 steps of the edges of lattice cells, where x or y is an integer after the skew."""
    rng = np.random.default_rng(seed)
    skew = (1 / 3**0.5 - 1) / 2
    along = rng.uniform(-20, 20, count)
    across = (rng.integers(-12, 13, count) - along * skew) / (1 + skew)
    across = across.astype(np.float32) + rng.integers(-2, 3, count) * np.spacing(across.astype(np.float32))
    points = np.stack([along, across]).astype(np.float32)
    return np.where(rng.random(count) < 0.5, points, points[::-1])


@pytest.mark.parametrize("seed", [0, 1, 2, 42, 255, 256, 4999, 9998, 9999, -1, 2**31, 2**62])
def test_permutations_are_those_of_the_package(seed):
    np.testing.assert_array_equal(permutations([seed])[0], _init(seed)[0])


@given(seeds)
def test_permutations_of_any_terrain_seed_are_those_of_the_package(seed):
    np.testing.assert_array_equal(permutations([seed])[0], _init(seed)[0])


def test_permutations_of_many_seeds_are_those_of_each():
    several = [9999, 0, 7, 7]
    tables = permutations(several)
    assert tables.shape == (4, 256)
    assert tables.dtype == np.uint8
    for seed, table in zip(several, tables, strict=True):
        np.testing.assert_array_equal(table, permutations([seed])[0])


def test_the_table_holds_the_permutation_of_every_terrain_seed():
    table = np.asarray(permutation_table())
    assert table.shape == (SEEDS, 256) == (10_000, 256)
    np.testing.assert_array_equal(np.sort(table, axis=1), np.tile(np.arange(256), (SEEDS, 1)))
    for seed in (0, 1, 5000, 9999):
        np.testing.assert_array_equal(table[seed], _init(seed)[0])


@given(seeds, coordinates, coordinates)
def test_noise_at_any_point_is_that_of_the_package(seed, x, y):
    assert float(noise2(seed, x, y)) == pytest.approx(expected_noise(seed, x, y), abs=1e-5)


@given(seeds)
def test_noise_at_many_points_is_that_of_the_package(seed):
    x, y = random_points(seed, 400)
    np.testing.assert_allclose(noise2(seed, x, y), expected_noise(seed, x, y), rtol=0, atol=1e-5)


@given(seeds)
def test_noise_is_that_of_the_package_beside_the_edges_of_lattice_cells(seed):
    x, y = points_beside_cell_edges(seed, 1000)
    np.testing.assert_allclose(noise2(seed, x, y), expected_noise(seed, x, y), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("seed", "x", "y"),
    [
        (2734, 18.78025245666504, -5.111440658569336),
        (5609, -23.534481048583984, -12.119058609008789),
        (1982, -22.580638885498047, 29.452112197875977),
    ],
)
def test_noise_is_that_of_the_package_where_rounding_could_mix_two_cells(seed, x, y):
    """Here x or y lies within 2e-6 of an integer after the skew, and floor differs with a fused multiply-add."""
    assert float(noise2(seed, x, y)) == pytest.approx(OpenSimplex(seed).noise2(x, y), abs=1e-5)


def test_noise_is_zero_on_the_vertices_of_the_lattice():
    unskew = (3**0.5 - 1) / 2
    i, j = np.meshgrid(np.arange(-3, 4), np.arange(-3, 4))
    values = noise2(5, i + (i + j) * unskew, j + (i + j) * unskew)
    np.testing.assert_allclose(values, 0, rtol=0, atol=2e-6)


def test_noise_fills_most_of_minus_one_to_one():
    values = np.asarray(noise2(3, *random_points(3, 40_000)))
    assert -1 <= values.min() < -0.8
    assert 0.8 < values.max() <= 1
    assert abs(values.mean()) < 0.05


def test_noise_of_many_seeds_is_that_of_each():
    several = [0, 9999, 17]
    x, y = random_points(1, 60).reshape(2, 6, 10)
    values = noise2(several, x, y)
    assert values.shape == (3, 6, 10)
    for seed, value in zip(several, values, strict=True):
        np.testing.assert_allclose(value, noise2(seed, x, y), rtol=0, atol=1e-6)
        np.testing.assert_allclose(value, expected_noise(seed, x, y), rtol=0, atol=1e-5)


def test_one_seed_adds_no_axis():
    assert noise2(3, np.zeros(5), np.zeros(5)).shape == (5,)
    assert noise2([3], np.zeros(5), np.zeros(5)).shape == (1, 5)
    assert noise2(np.int32(3), 0.5, 0.5).shape == ()


@pytest.mark.parametrize("seed", [1.0, "1", None, True, [], [[1]], [1.5]])
def test_a_bad_seed_is_refused(seed):
    with pytest.raises(InputError, match="^seed = .*: must be an integer, or a list of integers$"):
        noise2(seed, 0.5, 0.5)


on_axes = jax.jit(noise_on_axes, static_argnames="reach")

WAYS = {"few cells, many points": (4.0, 50, 40), "many cells, few points": (30.0, 20, 15)}
"""Noise on axes looks cells up in a small table where these are fewer than the points: (reach, rows, columns)."""

both_ways = pytest.mark.parametrize(("reach", "rows", "cols"), WAYS.values(), ids=WAYS)


@both_ways
@pytest.mark.parametrize("seed", [0, 4321, 9999])
def test_noise_on_axes_is_noise_at_their_points(seed, reach, rows, cols):
    rng = np.random.default_rng(seed)
    x, y = (rng.uniform(-reach, reach, count).astype(np.float32) for count in (cols, rows))
    values = on_axes(permutations([seed])[0], x, y, reach=reach)
    assert values.shape == (rows, cols)
    np.testing.assert_allclose(values, expected_noise(seed, x[None, :], y[:, None]), rtol=0, atol=1e-5)


@both_ways
def test_noise_on_axes_is_right_at_the_ends_of_the_reach(reach, rows, cols):
    x, y = (np.linspace(-reach, reach, count, dtype=np.float32) for count in (cols, rows))
    values = on_axes(permutations([11])[0], x, y, reach=reach)
    np.testing.assert_allclose(values, expected_noise(11, x[None, :], y[:, None]), rtol=0, atol=1e-5)


@both_ways
@pytest.mark.parametrize("seed", range(4))
def test_noise_on_axes_is_right_beside_the_edges_of_lattice_cells(seed, reach, rows, cols):
    points = points_beside_cell_edges(seed, 4000)
    x, y = points[:, np.abs(points).max(axis=0) <= reach]
    x, y = x[:cols], y[:rows]
    values = on_axes(permutations([seed])[0], x, y, reach=reach)
    np.testing.assert_allclose(values, expected_noise(seed, x[None, :], y[:, None]), rtol=0, atol=1e-5)


def test_both_ways_to_noise_on_axes_agree():
    x, y = random_points(2, 40, reach=4)
    permutation = permutations([77])[0]
    few, many = (partial(on_axes, permutation, x, y, reach=reach)() for reach in (4.0, 31.0))
    np.testing.assert_allclose(few, many, rtol=0, atol=1e-6)
