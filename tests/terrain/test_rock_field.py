"""Rock fields: what comes from which seed, what a landform changes, the two sites, and bad input."""

from dataclasses import replace

import numpy as np
import pytest

from travjax.config import InputError
from travjax.simulation.events import EVENTS
from travjax.simulation.grid import Grid
from travjax.terrain.rock_field import (
    RANGES,
    SITES,
    RockFieldParams,
    rock_field,
    sample_rock_field,
    site_heights,
)
from travjax.terrain.styles import STYLES, generate_terrain
from travjax.traversal.traverse import failures, simulate

PLAIN = RockFieldParams(rock_abundance=0.0)


def windows(heights: np.ndarray) -> np.ndarray:
    """Windows of 8 x 8 m side by side, [n, 129, 129]."""
    rows, cols = (range(0, edge - 128, 128) for edge in heights.shape)
    return np.stack([heights[row : row + 129, col : col + 129] for row in rows for col in cols])


def test_parameters_and_seed_give_the_same_ground_whatever_else_is_made():
    params = sample_rock_field(7)
    first = rock_field(params, 7, (129, 97), 0.0625)
    rock_field(sample_rock_field(8), 8, (65, 65), 0.125)
    np.testing.assert_array_equal(rock_field(sample_rock_field(7), 7, (129, 97), 0.0625), first)
    assert first.shape == (129, 97) and first.dtype == np.float64 and np.isfinite(first).all()
    assert first[64, 48] == 0


def test_seeds_give_other_parameters_and_other_ground():
    params = [sample_rock_field(seed) for seed in range(50)]
    assert len(set(params)) == 50
    assert not np.array_equal(rock_field(PLAIN, 0, (33, 33), 0.1), rock_field(PLAIN, 1, (33, 33), 0.1))
    for name, (low, high) in RANGES.items():
        drawn = [getattr(one, name) for one in params]
        assert low <= min(drawn) < low + 0.1 * (high - low) and high >= max(drawn) > high - 0.1 * (high - low)


def test_a_landform_changes_without_the_others():
    shape = (257, 257)
    relief = rock_field(PLAIN, 3, shape, 0.1)
    rocks = rock_field(replace(PLAIN, rock_abundance=0.05), 3, shape, 0.1)
    added = rocks - relief - (rocks - relief).min()  # relative to the middle, which may be on a rock
    assert (added < 1e-9).mean() > 0.9 and added.max() > 0.1
    half = rock_field(replace(PLAIN, roughness=PLAIN.roughness / 2), 3, shape, 0.1)
    np.testing.assert_allclose(half, relief / 2, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("landform", "within"),
    [
        ({"rock_abundance": 0.05}, 1e-9),
        ({"rut_density": 0.1}, 1e-9),
        ({"crater_density": 0.03}, 0.03),  # what a crater levels is measured at the nodes
    ],
)
def test_the_same_landforms_come_at_any_spacing(landform, within):
    params = RockFieldParams(**{"roughness": 0.0, "rock_abundance": 0.0} | landform)
    coarse, fine = (rock_field(params, 5, (cells + 1, cells + 1), 16 / cells) for cells in (128, 256))
    assert np.ptp(coarse) > 0.05
    np.testing.assert_allclose(fine[::2, ::2], coarse, rtol=0, atol=within)


def test_no_rock_lies_in_a_rut():
    tracks = RockFieldParams(roughness=0.0, rock_abundance=0.0, rut_density=0.05)
    rocky = replace(tracks, rock_abundance=0.3, smallest_rock=0.1, largest_rock=0.2)
    bare, covered = (rock_field(params, 4, (401, 401), 0.05) for params in (tracks, rocky))
    bare, covered = bare - np.median(bare), covered - np.median(bare)
    bottom = bare < bare.min() * 0.9
    assert bottom.any() and np.ptp((covered - bare)[bottom]) < 0.02


@pytest.mark.parametrize("name", SITES)
def test_sites_can_be_made_again_and_hold_every_failure(name):
    heights = site_heights(name)
    east, north = SITES[name].size
    assert heights.shape == (north * 16 + 1, east * 16 + 1)
    np.testing.assert_array_equal(site_heights(name), heights)
    failed = np.asarray(failures(simulate(windows(heights).astype(np.float32))))
    assert 0.08 < failed.any(axis=-1).mean() < 0.35
    assert dict(zip(EVENTS, failed.mean(axis=(0, 1)) > 0.001, strict=True)) == dict.fromkeys(EVENTS, True)


@pytest.mark.parametrize(
    ("field", "value", "allowed"),
    [
        ("hurst", 0, "a number above 0 and at most 1"),
        ("hurst", "rough", "a number above 0 and at most 1"),
        ("roughness", -0.1, "a length in metres from 0 to 10"),
        ("rock_abundance", 0.6, "a share from 0 to 0.5"),
        ("smallest_rock", 0.01, "a length in metres from 0.02 to 10"),
        ("largest_rock", 0.05, "a length in metres from 0.1 to 10"),
        ("rock_height", 0, "a number above 0 and at most 1"),
        ("crater_density", float("nan"), "a number from 0 to 1"),
        ("largest_crater", 0.5, "a length in metres from 1 to 100"),
        ("crater_freshness", 1.1, "a number from 0 to 1"),
        ("ledge_density", -1, "a number from 0 to 1"),
        ("highest_ledge", True, "a length in metres from 0.05 to 10"),
        ("deepest_rut", 0.01, "a length in metres from 0.05 to 1"),
    ],
)
def test_bad_parameters_are_named(field, value, allowed):
    with pytest.raises(InputError, match=f"^{field} = .*: must be {allowed}$"):
        RockFieldParams(**{field: value})


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"params": {}}, "params = {}: must be a RockFieldParams"),
        ({"seed": -1}, "seed = -1: must be an integer from 0 to 4294967295"),
        ({"seed": [1, 2]}, "seed = [1, 2]: must be an integer from 0 to 4294967295"),
        ({"shape": (1, 9)}, "shape = (1, 9): must be (rows, cols), whole numbers from 2, at most 16785409 nodes"),
        ({"shape": (9000, 9000)}, "shape = (9000, 9000): must be (rows, cols), whole numbers from 2"),
        ({"spacing": 0.02}, "spacing = 0.02: must be metres, from 0.03 to 1"),
    ],
)
def test_bad_arguments_are_named(changed, said):
    with pytest.raises(InputError) as error:
        rock_field(**({"params": PLAIN, "seed": 0, "shape": (9, 9), "spacing": 0.1} | changed))
    assert str(error.value).startswith(said)


def test_it_is_a_style_that_needs_no_parameters():
    grid = Grid(4, 0.125)
    maps = generate_terrain("rock_field", [3, 9], grid=grid)
    assert maps.shape == (2, 33, 33) and maps.dtype == np.float32
    np.testing.assert_array_equal(generate_terrain(["rock_field"] * 2, [9, 3], grid=grid)[::-1], maps)
    alone = rock_field(sample_rock_field(9), 9, grid.shape, grid.spacing)
    np.testing.assert_array_equal(maps[1], alone.astype(np.float32))
    assert "rock_field" not in STYLES


@pytest.mark.parametrize(
    ("style", "seeds", "others", "said"),
    [
        (["rock_field", "wavy"], [1, 2], {}, "style beside rock_field = ['wavy']: must be left out"),
        ("rock_field", [1], {"world": 8}, "world = 8: must be left out for rock_field"),
        ("rock_field", [-1], {}, "seeds = [-1]: must be one or more integers from 0"),
        (["rock_field"] * 2, [1], {}, "style = '2 styles for 1 seeds'"),
        ("rock_field", [1], {"grid": Grid(8, 0.02)}, "spacing = 0.02: must be metres, from 0.03 to 1"),
        ("rock_field", [1], {"grid": 8}, "grid = 8: must be a travjax.Grid"),
    ],
)
def test_bad_arguments_of_the_style_are_named(style, seeds, others, said):
    with pytest.raises(InputError) as error:
        generate_terrain(style, seeds, **others)
    assert str(error.value).startswith(said)


def test_a_site_that_is_none_is_named():
    with pytest.raises(InputError, match="^site = 'moon': must be one of bedrock_flats, crater_plain$"):
        site_heights("moon")
