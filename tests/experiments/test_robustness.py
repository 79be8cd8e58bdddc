"""Simulators and estimators on corrupted maps: scores against direct computation, and the choice of the filter."""

import numpy as np
import pytest

from tests.commandline import FEW
from tests.field_runs import RUN, estimator
from tests.small_training import GRID, HUSKY, SETUP
from travjax.data.provenance import Site, SitesConfig
from travjax.data.sensor_noise import CLEAN, CORRUPTIONS, FILTERS
from travjax.evaluation.metrics import OVERALL
from travjax.experiments.robustness import BenchmarkMaps, average_precisions, by_margins, of_samples, of_sites
from travjax.runs.predictor import Predictor
from travjax.traversal.traverse import simulate


@pytest.fixture(scope="module")
def ground() -> BenchmarkMaps:
    return BenchmarkMaps.synthetic(10, 3, SETUP)


def test_the_ground_is_that_of_the_simulator(ground):
    margins = np.asarray(simulate(ground.heights, HUSKY, FEW, grid=GRID).events())
    np.testing.assert_array_equal(ground.margins, margins)
    np.testing.assert_array_equal(ground.failed, margins > np.asarray(HUSKY.limits, np.float32))
    assert 0 < ground.failed.mean() < 0.5 and ground.known.all()


def test_the_simulator_is_exact_on_the_clean_map_alone(ground):
    assert ground.scores(ground.simulated(ground.seen(CLEAN, 0)))[OVERALL].f1 == 1
    assert ground.scores(ground.simulated(ground.seen("noise 5 cm", 0)))[OVERALL].f1 < 0.9


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_corruptions_are_the_same_each_time_and_know_all_nodes(ground, name):
    seen = ground.seen(name, 1)
    np.testing.assert_array_equal(seen, ground.seen(name, 1))
    assert np.isfinite(seen).all() and (name == CLEAN) == bool((seen == ground.heights).all())
    if name not in (CLEAN, "0.125 m"):
        assert (seen != ground.seen(name, 2)).any()


def test_the_best_filter_has_the_largest_f1(ground):
    seen = ground.seen("noise 5 cm", 1)
    found = {name: ground.scores(ground.simulated(smooth(seen)))[OVERALL].f1 for name, smooth in FILTERS.items()}
    best = ground.best_filter(seen)
    assert found[best] == max(found.values()) > found["no filter"]
    assert ground.best_filter(ground.heights) == "no filter"


def test_margins_fail_above_their_limits(ground):
    np.testing.assert_array_equal(by_margins(ground.margins, HUSKY) > 0.5, ground.failed)
    assert average_precisions(by_margins(ground.margins, HUSKY), ground.failed)[OVERALL] == pytest.approx(1)


def test_samples_of_an_estimator_are_those_of_whole_maps(ground):
    predictor = Predictor(RUN, estimator())
    samples = (np.array([0, 0, 7]), np.array([2, 5, 1]))
    whole = predictor.predict(ground.heights).probability
    np.testing.assert_allclose(of_samples(predictor, ground.heights, samples), whole[samples], atol=1e-5)


# ---- Real ground


@pytest.fixture(scope="module")
def sites(tmp_path_factory) -> SitesConfig:
    """Windows of synthetic maps as sites: two of one map each with a hole, one of 3 x 2 windows."""
    folder = tmp_path_factory.mktemp("sites")
    heights = BenchmarkMaps.synthetic(10, 5, SETUP).heights
    small = heights[3].copy()
    small[20:24, 5:25] = np.nan
    large = np.concatenate([np.concatenate([heights[8], heights[9][:, 1:]], axis=1)] * 2)[: 48 + 1]
    for name, one in (("small", small), ("large", large)):
        np.savez(folder / f"{name}.npz", heights=one, cell_size=GRID.spacing)
    strips = {"test_strip": ("north", 4.0)}
    site = (Site(str(folder / "large.npz"), **strips), Site(str(folder / "small.npz"), name="little"))
    return SitesConfig(site, stride=2.0, fill_holes=False)


def test_every_window_of_a_site_is_there_once_whatever_it_is_for(sites):
    grounds = of_sites(sites, 100, 0, SETUP)
    assert {site: len(ground.heights) for site, ground in grounds.items()} == {"large": 6, "little": 1}
    with np.load(sites.site[0].file) as file:
        whole = file["heights"]
    for index, (row, col) in enumerate((row, col) for row in (0, 16) for col in (0, 16, 32)):
        window = whole[row : row + 33, col : col + 33]
        found = grounds["large"].heights[index]
        np.testing.assert_allclose(found - found[0, 0], window - window[0, 0], atol=1e-5)


def test_windows_are_drawn_by_the_seed_and_no_window_twice(sites):
    every = of_sites(sites, 100, 0, SETUP)["large"].heights
    few = [of_sites(sites, 3, seed, SETUP)["large"].heights for seed in (0, 0, 1, 2, 3)]
    assert all(len(windows) == 3 for windows in few)
    np.testing.assert_array_equal(few[0], few[1])
    drawn = [tuple(int(np.flatnonzero((every == one).all(axis=(1, 2)))[0]) for one in windows) for windows in few]
    assert all(len(set(one)) == 3 for one in drawn) and len(set(drawn)) > 1


def test_unknown_ground_counts_in_no_score_and_is_filled_for_the_methods(sites):
    ground = of_sites(sites, 100, 0, SETUP)["little"]
    with np.load(sites.site[1].file) as file:
        heights = file["heights"][None]
    margins = simulate(heights, HUSKY, FEW, grid=GRID)
    np.testing.assert_array_equal(ground.known, np.asarray(margins.known))
    assert 0 < ground.known.mean() < 1 and np.isfinite(ground.heights).all()
    fails = np.ones(ground.failed.shape, np.float32)
    counts = ground.scores(fails)
    assert counts[OVERALL].samples == 3 * ground.known.sum()
    assert counts["obstacle"].tp == (np.asarray(margins.obstacle)[ground.known] > HUSKY.ride_height).sum()
    assert ground.scores(ground.simulated(ground.seen(CLEAN, 0)))[OVERALL].accuracy == 1
