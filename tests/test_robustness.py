"""Simulators and estimators on corrupted maps: scores against direct computation, and the choice of the filter."""

import numpy as np
import pytest
from commandline import FEW
from field_runs import RUN, estimator
from training import GRID, HUSKY

from travjax.metrics import OVERALL
from travjax.predictor import Predictor
from travjax.robustness import CLEAN, CORRUPTIONS, FILTERS, Ground, average_precisions, by_margins, of_samples, score
from travjax.traverse import simulate


@pytest.fixture(scope="module")
def ground() -> Ground:
    return Ground.synthetic(10, 3, HUSKY, FEW, GRID)


def test_the_ground_is_that_of_the_simulator(ground):
    margins = np.asarray(simulate(ground.heights, HUSKY, FEW, grid=GRID).events())
    np.testing.assert_array_equal(ground.margins, margins)
    np.testing.assert_array_equal(ground.failed, margins > np.asarray(HUSKY.limits, np.float32))
    assert 0 < ground.failed.mean() < 0.5


def test_the_simulator_is_exact_on_the_clean_map_alone(ground):
    assert score(ground.simulated(ground.seen(CLEAN, 0)), ground.failed).f1 == 1
    assert score(ground.simulated(ground.seen("noise 5 cm", 0)), ground.failed).f1 < 0.9


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_corruptions_are_the_same_each_time_and_know_all_nodes(ground, name):
    seen = ground.seen(name, 1)
    np.testing.assert_array_equal(seen, ground.seen(name, 1))
    assert np.isfinite(seen).all() and (name == CLEAN) == bool((seen == ground.heights).all())
    if name not in (CLEAN, "0.125 m"):
        assert (seen != ground.seen(name, 2)).any()


def test_the_best_filter_has_the_largest_f1(ground):
    seen = ground.seen("noise 5 cm", 1)
    found = {name: score(ground.simulated(smooth(seen)), ground.failed).f1 for name, smooth in FILTERS.items()}
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
