"""How well margins tell which trajectories fail when they are driven: weighted scores, by margin and by event.

All functions take trajectories that were sampled and driven, and what one contact model says of them.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from travjax.physics.labelling import Outcomes

BANDS = (0.0, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, np.inf)
"""Bounds of the largest margin in limits, by which outcomes are tabulated."""

FACTORS = np.round(np.arange(0.6, 2.61, 0.05), 2)
"""Factors on all limits that are tried."""

EVENT_FACTORS = np.round(np.arange(0.7, 2.01, 0.1), 1)
"""Factors on the limit of each event that are tried."""


@dataclass(frozen=True)
class Driven:
    """Trajectories that were driven, and their margins.

    margins: in limits; failed: whether each failed when driven
    weight: how many trajectories each stands for; map: of each
    """

    margins: Float[np.ndarray, "k e"]
    failed: Bool[np.ndarray, " k"]
    weight: Float[np.ndarray, " k"]
    map: Int[np.ndarray, " k"]

    def only(self, chosen: Bool[np.ndarray, " k"]) -> "Driven":
        """Returns the chosen trajectories."""
        return Driven(*(values[chosen] for values in vars(self).values()))

    @property
    def largest(self) -> Float[np.ndarray, " k"]:
        """The largest margin of each."""
        return self.margins.max(axis=-1)

    def share_failed(self, chosen: Bool[np.ndarray, " k"]) -> float | None:
        """Returns the weighted share of the chosen trajectories that failed; None when there are none."""
        return float(np.average(self.failed[chosen], weights=self.weight[chosen])) if chosen.any() else None

    def scores(self, factors: float | Float[np.ndarray, " e"] = 1.0) -> dict[str, float]:
        """Returns precision, recall and F1 of margins above their limits times a factor, for all or for each event."""
        return scores(np.any(self.margins > factors, axis=-1), self.failed, self.weight)


def scores(predicted: Bool[np.ndarray, " k"], failed: np.ndarray, weight: np.ndarray | float = 1.0) -> dict[str, float]:
    """Returns weighted precision, recall and F1 of what is predicted to fail [k]."""
    weight = np.broadcast_to(weight, failed.shape)
    hit, said, are = (float(weight[mask].sum()) for mask in (predicted & failed, predicted, failed))
    return {
        "precision": hit / said if said else 0.0,
        "recall": hit / are if are else 0.0,
        "F1": 2 * hit / (said + are) if said + are else 0.0,
    }


def agreement(driven: Driven) -> dict[str, float]:
    """Returns the scores, and the factor on all limits that has the best F1 on this very sample, with F1 and recall."""
    tried = [driven.scores(factor) for factor in FACTORS]
    factor, best = max(zip(FACTORS.tolist(), tried, strict=True), key=lambda pair: pair[1]["F1"])
    return driven.scores() | {"factor": factor, "best F1": best["F1"], "its recall": best["recall"]}


def event_factors(driven: Driven, names: Sequence[str]) -> dict[str, float]:
    """Returns the factors on the events' limits with the best F1 on every other map, and the scores on the others."""
    chosen = np.unique(driven.map, return_inverse=True)[1] % 2 == 0
    half = driven.only(chosen)
    tried = itertools.product(EVENT_FACTORS.tolist(), repeat=len(names))
    best = max(tried, key=lambda factors: half.scores(np.array(factors))["F1"])
    return dict(zip(names, best, strict=True)) | driven.only(~chosen).scores(np.array(best))


def by_margin(driven: Driven) -> dict[str, float | None]:
    """Returns the share that failed by the largest margin in limits."""
    which = np.searchsorted(BANDS, driven.largest, side="right") - 1
    bounds = zip(BANDS, BANDS[1:], strict=False)
    return {f"{low:g} to {high:g}": driven.share_failed(which == band) for band, (low, high) in enumerate(bounds)}


def by_event(driven: Driven, names: Sequence[str]) -> dict[str, float | None]:
    """Returns the share that failed of those that exceed the limit of one event alone."""
    over = driven.margins > 1
    alone = over.sum(axis=-1) == 1
    return {f"{name} alone": driven.share_failed(over[:, event] & alone) for event, name in enumerate(names)}


def repeats(first: Outcomes, second: Outcomes) -> dict[str, float | int | None]:
    """Returns how well trajectories that are driven twice agree with themselves."""
    index = {pair: i for i, pair in enumerate(zip(first.map.tolist(), first.trajectory.tolist(), strict=True))}
    pairs = np.array([index[pair] for pair in zip(second.map.tolist(), second.trajectory.tolist(), strict=True)], int)
    both = first.started[pairs] & second.started
    one, other = first.failed[pairs][both], second.failed[both]
    return {
        "driven twice": int(both.sum()),
        "same answer": float((one == other).mean()) if len(one) else None,
        "F1 of one against the other": scores(one, other)["F1"] if len(one) else None,
    }
