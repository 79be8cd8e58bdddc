"""A baseline predictor without a robot model: logistic regression on the slope and step of the ground on the path."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize

from travjax.data.sampling import Samples
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid

SAMPLES_AT_ONCE = 4096


def slope_and_step(
    heights: Float[np.ndarray, "n rows cols"], samples: Samples, actions: ActionSpace, grid: Grid
) -> Float[np.ndarray, "k 2"]:
    """Returns the largest ground slope [rad] along each path, and the largest height change between poses [m].

    Both are taken at the nodes nearest to the robot's centre; unknown ground is ignored.
    """
    place = np.floor(actions.poses(np.arange(len(actions)))[..., :2] / grid.spacing + grid.cells / 2 + 0.5).astype(int)
    result = np.empty((len(samples[0]), 2))
    for start in range(0, len(result), SAMPLES_AT_ONCE):
        part = slice(start, start + SAMPLES_AT_ONCE)
        maps, which = np.unique(samples[0][part], return_inverse=True)
        chosen = heights[maps].astype(np.float64)
        slope = np.hypot(*np.gradient(chosen, grid.spacing, axis=(1, 2)))
        col, row = np.moveaxis(place[samples[1][part]], -1, 0)
        slopes, ground = (field[which[:, None], row, col] for field in (slope, chosen))
        result[part, 0] = np.nan_to_num(np.arctan(slopes)).max(axis=1)
        result[part, 1] = np.nan_to_num(np.abs(np.diff(ground, axis=1))).max(axis=1)
    return result


@dataclass(frozen=True)
class LogisticRegression:
    """Predicts the probability of each event from features [k, f]: sigmoid(weights . features / scale + bias).

    weights: [3, f + 1], the bias last; scale: [f] standard deviations of the training features
    """

    weights: np.ndarray
    scale: np.ndarray

    @staticmethod
    def fit(features: Float[np.ndarray, "k f"], failed: Bool[np.ndarray, "k 3"]) -> "LogisticRegression":
        """Fits by maximum likelihood, with a penalty that matters only where the events are separable."""
        scale = np.maximum(features.std(axis=0), 1e-9)
        inputs = _with_one(features / scale)

        def loss(weights, target):
            logits = inputs @ weights
            value = np.logaddexp(0, logits).mean() - (logits * target).mean() + 1e-6 * weights @ weights
            return value, inputs.T @ (_sigmoid(logits) - target) / len(inputs) + 2e-6 * weights

        start = np.zeros(inputs.shape[1])
        fitted = [minimize(loss, start, args=(target,), jac=True, method="L-BFGS-B").x for target in failed.T * 1.0]
        return LogisticRegression(np.array(fitted), scale)

    def probabilities(self, features: Float[np.ndarray, "k f"]) -> Float[np.ndarray, "k 3"]:
        """Returns the probability of each event for each sample."""
        return _sigmoid(_with_one(features / self.scale) @ self.weights.T)


def _with_one(features: np.ndarray) -> np.ndarray:
    return np.concatenate([features, np.ones((len(features), 1))], axis=1)


def _sigmoid(logits: np.ndarray) -> np.ndarray:
    return 0.5 * (1 + np.tanh(logits / 2))
