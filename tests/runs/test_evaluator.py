"""Evaluation: which samples, whose probabilities, and the figures of both."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression as Oracle

from tests import field_runs
from tests.commandline import FEW
from tests.small_training import GRID, HUSKY, PRESET, SETUP, dataset, estimator, forward, run_of
from travjax.config import InputError, require
from travjax.data.sampling import balanced_subset
from travjax.devices import Devices
from travjax.evaluation.baselines import slope_and_step
from travjax.evaluation.metrics import PAPER_SYNTHETIC, average_precision
from travjax.models.input_images import render_inputs
from travjax.models.variables import split_model
from travjax.runs.evaluator import Evaluator
from travjax.simulation.actions import ActionSpace
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup
from travjax.traversal.traverse import unpacked


@pytest.fixture(scope="module")
def evaluator() -> Evaluator:
    return Evaluator.from_run(run_of(), dataset(), Devices.all())


def pairs(samples) -> list[tuple[int, int]]:
    return list(zip(*map(np.ndarray.tolist, samples), strict=True))


# ---- Samples


def test_all_samples_are_every_known_trajectory_of_the_test_maps(evaluator):
    known = np.asarray(unpacked(dataset().labels)[1])
    wanted = {(m, t) for m in np.flatnonzero(dataset().split == 2) for t in range(len(FEW)) if known[m, t]}
    found = pairs(evaluator.samples(0, 0))
    assert len(found) == len(wanted) and set(found) == wanted


def test_some_samples_are_so_many_trajectories_of_so_many_test_maps(evaluator):
    everything = set(pairs(evaluator.samples(0, 0)))
    for maps, each, wanted in ((3, 5, 15), (0, 4, 6 * 4), (2, 0, 2 * len(FEW)), (99, 99, len(everything))):
        found = pairs(evaluator.samples(maps, each))
        assert len(set(found)) == len(found) == wanted
        assert set(found) <= everything
        assert found == pairs(evaluator.samples(maps, each))


def test_another_seed_draws_other_samples(evaluator):
    other = replace(evaluator, run=run_of(seed=1))
    assert pairs(other.samples(3, 5)) != pairs(evaluator.samples(3, 5))


def test_failures_are_as_frequent_as_they_are(evaluator):
    """Not as in the balanced subset, of which two in three fail."""
    samples = evaluator.samples(0, 9)
    natural = evaluator.failed(evaluator.samples(0, 0)).any(axis=1).mean()
    assert evaluator.failed(samples).any(axis=1).mean() == pytest.approx(natural, abs=0.08)
    assert natural < 0.4


def test_failures_are_those_of_the_labels(evaluator):
    samples = evaluator.samples(0, 0)
    wanted = [[dataset().labels[m, t] >> event & 1 for event in range(3)] for m, t in pairs(samples)]
    np.testing.assert_array_equal(evaluator.failed(samples), np.array(wanted, bool))


def test_a_data_set_without_test_maps_is_refused():
    data = replace(dataset(), split=np.minimum(dataset().split, 1))
    with pytest.raises(InputError, match="test") as raised:
        Evaluator.from_run(run_of(), data, Devices.all()).samples(0, 0)
    assert "\n" not in str(raised.value)


def test_the_paper_stands_beside_its_own_robot_and_actions_on_synthetic_maps_only(evaluator):
    assert evaluator.paper is None
    papers = replace(run_of(), setup=Setup(Robot.load("seekur_jr"), ActionSpace(), GRID))
    assert replace(evaluator, run=papers).paper == PAPER_SYNTHETIC
    assert replace(evaluator, run=papers, dataset=replace(dataset(), config=None)).paper is None


def test_a_figure_takes_no_longer_than_the_evaluation(evaluator):
    """18 trajectories a map, 3 radii; every third or sixth would leave out arcs."""
    assert [evaluator.every(2, samples) for samples in (100, 36, 35, 18, 9, 8, 1)] == [1, 1, 2, 2, 4, 5, 5]
    papers = replace(evaluator, run=replace(run_of(), setup=replace(SETUP, actions=ActionSpace())))
    assert [papers.every(2, samples) for samples in (400, 3042, 6083, 6084)] == [6, 2, 2, 1]
    some = ActionSpace().split(np.arange(0, 3042, 6))
    assert [len(np.unique(part)) for part in some] == [18, 13, 13]


def test_every_so_many_trajectories_are_those_of_all(evaluator):
    maps, network = evaluator.to_show(2), estimator()
    some = evaluator.whole_maps(network, maps, every=5)
    np.testing.assert_allclose(some, evaluator.whole_maps(network, maps)[:, ::5], rtol=0, atol=1e-6)


def test_a_batch_that_the_devices_cannot_share_is_refused(monkeypatch):
    monkeypatch.setattr(
        "travjax.devices.Devices.check_batch", lambda self, size: require(size == 9, "batch_size", size, "9")
    )
    with pytest.raises(InputError, match="batch_size = 8"):
        Evaluator.from_run(run_of(), dataset(), Devices.all())


@pytest.mark.parametrize(
    "other", [{"robot": replace(HUSKY, track=0.6)}, {"actions": replace(FEW, turns=3)}, {"grid": replace(GRID, size=5)}]
)
def test_a_data_set_of_something_else_is_refused(other):
    with pytest.raises(InputError, match=f"^{next(iter(other))} of the data set: ") as raised:
        Evaluator.from_run(replace(run_of(), setup=replace(SETUP, **other)), dataset(), Devices.all())
    assert "\n" not in str(raised.value)


# ---- Probabilities


def test_probabilities_are_those_of_a_forward_pass_on_images(evaluator):
    samples, counts = evaluator.samples(4, 5), []
    actual = evaluator.probabilities(estimator(), samples, counts.append)
    images = render_inputs(dataset().heights, *samples, HUSKY, FEW, grid=GRID, elevation_scale=0.5)
    wanted = 1 / (1 + np.exp(-np.asarray(forward(*split_model(estimator()), images), np.float64)))
    assert actual.shape == (20, 3) and wanted.std() > 0.01
    np.testing.assert_allclose(actual, wanted, atol=1e-4)
    assert counts == [8, 8, 4]


def test_probabilities_do_not_depend_on_their_company(evaluator):
    samples = evaluator.samples(4, 5)
    one = evaluator.probabilities(estimator(), samples)
    few = evaluator.probabilities(estimator(), tuple(index[13:16] for index in samples))
    np.testing.assert_allclose(few, one[13:16], atol=1e-6)


def test_the_estimator_is_left_as_it_was(evaluator):
    images = np.zeros((2, *GRID.shape, 3), np.float32)
    before = np.asarray(forward(*split_model(estimator(7)), images))
    evaluator.probabilities(estimator(7), evaluator.samples(1, 3))
    np.testing.assert_array_equal(forward(*split_model(estimator(7)), images), before)


def test_the_baseline_is_a_regression_on_balanced_training_samples(evaluator):
    samples, data = evaluator.samples(0, 0), dataset()
    known = balanced_subset(data.labels, data.maps_of("train"), 0, each=3, failing=2)
    features, others = (slope_and_step(data.heights, part, FEW, GRID) for part in (known, samples))
    actual, scale = evaluator.regression(samples), features.std(axis=0)
    for event in range(3):
        oracle = Oracle(C=1e5, tol=1e-10, max_iter=2000).fit(features / scale, evaluator.failed(known)[:, event])
        np.testing.assert_allclose(actual[:, event], oracle.predict_proba(others / scale)[:, 1], atol=0.02)


def test_the_baseline_takes_no_more_training_samples_than_it_should(evaluator, monkeypatch):
    taken = []

    def counted(heights, samples, *rest):
        taken.append(len(np.unique(samples[0])))
        return slope_and_step(heights, samples, *rest)

    monkeypatch.setattr("travjax.runs.evaluator.slope_and_step", counted)
    monkeypatch.setattr("travjax.runs.evaluator.REGRESSION_SAMPLES", 15)
    evaluator.regression(evaluator.samples(0, 0))
    assert taken[0] == 15 // PRESET.training.trajectories_per_map


# ---- Scores


def test_scores_are_by_event_and_by_style(evaluator):
    samples = evaluator.samples(0, 0)
    probability = np.random.default_rng(0).random((len(samples[0]), 3))
    scores, failed = evaluator.scores(probability, samples, [0.7]), evaluator.failed(samples)
    assert scores.samples == len(failed)
    for number, event in enumerate(("step", "obstacle", "tilt")):
        wanted = average_precision(probability[:, number], failed[:, number])
        assert scores.scores[event].average_precision == pytest.approx(wanted)
        assert 0.7 in {point.wanted for point in scores.points[event]}
    styles = dataset().group[samples[0]]
    assert set(scores.groups) == set(styles)
    for style, inner in scores.groups.items():
        confusion = inner["step"].confusion
        assert confusion.samples == (styles == style).sum()
        assert confusion.tp + confusion.fn == failed[styles == style, 0].sum()


def test_a_data_set_whose_labels_say_known_where_its_map_is_unknown_is_refused():
    data = field_runs.dataset()
    heights = np.array(data.heights)
    heights[data.maps_of("test")[0], : GRID.nodes // 2] = np.nan
    spoilt = Evaluator.from_run(field_runs.RUN, replace(data, heights=heights), Devices.all())
    with pytest.raises(InputError, match="^data set, margins = 'NaN': must be known trajectories alone"):
        spoilt.margins(field_runs.estimator(), spoilt.samples(0, 0))
