"""The predictor to beat against a slow loop over poses and scikit-learn's logistic regression."""

import math

import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression as Oracle

from tests.commandline import FEW
from tests.small_training import GRID, dataset
from travjax.data.sampling import every_sample
from travjax.evaluation import baselines
from travjax.evaluation.baselines import LogisticRegression, slope_and_step

RANDOM = np.random.default_rng(0)


def slowly(heights: np.ndarray, trajectory: int) -> tuple[float, float]:
    """Largest slope and change of height along one path, node by node, from central differences."""
    slopes, ground = [], []
    rows, cols = GRID.shape
    for x, y, _ in FEW.poses(np.array([trajectory]))[0]:
        axis = np.asarray(GRID.axis())
        row, col = int(np.abs(axis - y).argmin()), int(np.abs(axis - x).argmin())
        up, down = min(row + 1, rows - 1), max(row - 1, 0)
        right, left = min(col + 1, cols - 1), max(col - 1, 0)
        along_y = (float(heights[up, col]) - float(heights[down, col])) / ((up - down) * GRID.spacing)
        along_x = (float(heights[row, right]) - float(heights[row, left])) / ((right - left) * GRID.spacing)
        slopes.append(math.atan(math.hypot(along_x, along_y)))
        ground.append(float(heights[row, col]))
    return max(slopes), max(abs(b - a) for a, b in zip(ground, ground[1:], strict=False))


def test_slope_and_step_are_those_of_a_slow_loop(monkeypatch):
    monkeypatch.setattr(baselines, "SAMPLES_AT_ONCE", 7)
    data = dataset()
    samples = RANDOM.integers(0, 30, 40), RANDOM.integers(0, len(FEW), 40)
    wanted = [slowly(data.heights[index], trajectory) for index, trajectory in zip(*samples, strict=True)]
    np.testing.assert_allclose(slope_and_step(data.heights, samples, FEW, GRID), wanted, rtol=1e-5, atol=1e-7)


def test_a_plane_has_its_slope_everywhere():
    y, x = np.meshgrid(GRID.axis(), GRID.axis(), indexing="ij")
    for heading in np.arange(4) * np.pi / 2:
        heights = (0.3 * (x * np.cos(heading) + y * np.sin(heading)) + 7)[None].astype(np.float32)
        samples = np.zeros(len(FEW), int), np.arange(len(FEW))
        slope, step = slope_and_step(heights, samples, FEW, GRID).T
        np.testing.assert_allclose(slope, math.atan(0.3), rtol=1e-4)
        assert (step <= 0.3 * 2 * GRID.spacing + 1e-5).all()


def test_flat_ground_has_neither_slope_nor_step():
    samples = np.zeros(len(FEW), int), np.arange(len(FEW))
    np.testing.assert_array_equal(slope_and_step(np.full((1, *GRID.shape), 3.0), samples, FEW, GRID), 0)


def test_unknown_ground_does_not_count():
    heights = np.full((1, *GRID.shape), 3.0, np.float32)
    heights[0, :, ::3] = np.nan
    samples = np.zeros(len(FEW), int), np.arange(len(FEW))
    np.testing.assert_array_equal(slope_and_step(heights, samples, FEW, GRID), 0)


# ---- The regression


def noisy(count: int = 3000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Features of very different scale, and failures that follow from them with noise."""
    random = np.random.default_rng(seed)
    features = random.standard_normal((count, 2)) * (0.3, 0.01) + (0.5, 0.02)
    logits = np.stack([9 * features[:, 0] - 5, 300 * features[:, 1] - 8, 3 - 200 * features[:, 1]], axis=1)
    return features, random.random((count, 3)) < 1 / (1 + np.exp(-logits))


def test_the_regression_is_that_of_scikit_learn():
    features, failed = noisy()
    others, _ = noisy(500, seed=1)
    actual = LogisticRegression.fit(features, failed).probabilities(others)
    scale = features.std(axis=0)
    for event in range(3):
        oracle = Oracle(C=1e6, tol=1e-10, max_iter=2000).fit(features / scale, failed[:, event])
        np.testing.assert_allclose(actual[:, event], oracle.predict_proba(others / scale)[:, 1], atol=2e-3)


def test_the_regression_does_not_depend_on_the_units():
    features, failed = noisy()
    one = LogisticRegression.fit(features, failed).probabilities(features)
    other = LogisticRegression.fit(features * (1000, 0.001), failed).probabilities(features * (1000, 0.001))
    np.testing.assert_allclose(one, other, atol=1e-4)


def test_an_event_that_never_happens_is_unlikely_and_one_that_always_happens_is_likely():
    features, failed = noisy()
    failed[:, 0], failed[:, 1] = False, True
    probability = LogisticRegression.fit(features, failed).probabilities(features)
    assert probability[:, 0].max() < 0.05 and probability[:, 1].min() > 0.95


def test_separable_events_and_constant_features_end_in_numbers():
    features = np.stack([np.linspace(-1, 1, 50), np.ones(50)], axis=1)
    failed = np.repeat((features[:, :1] > 0.01), 3, axis=1)
    probability = LogisticRegression.fit(features, failed).probabilities(features)
    assert np.isfinite(probability).all()
    assert ((probability > 0.5) == failed).all()


def test_it_orders_the_paths_of_the_data_set_better_than_chance():
    data = dataset()
    samples = every_sample(data.labels, data.maps_of("train"))
    failed = np.stack([(data.labels[samples] >> event) & 1 for event in range(3)], axis=1).astype(bool)
    features = slope_and_step(data.heights, samples, FEW, GRID)
    probability = LogisticRegression.fit(features, failed).probabilities(features)
    for event in range(3):
        fails, safe = probability[failed[:, event], event], probability[~failed[:, event], event]
        assert (fails[:, None] > safe).mean() > 0.6


@pytest.mark.parametrize("logit", [-1000.0, 1000.0])
def test_the_sigmoid_does_not_overflow(logit):
    regression = LogisticRegression(np.array([[logit, 0.0, 0.0]]), np.ones(2))
    np.testing.assert_array_equal(regression.probabilities(np.ones((1, 2))), [[float(logit > 0)]])
