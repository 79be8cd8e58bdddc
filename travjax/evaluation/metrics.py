"""Metrics of predicted probabilities: confusion, recall, average precision, calibration (SPEC section 10).

A sample is predicted to fail if its probability is at least the threshold, here and in everything that is printed.
Probabilities and failures are [s, k], with events in the robot's order; "overall" pools the events (micro-average).
Where no sample fails, recall, precision, F1 and average precision are undefined: NaN. Only NumPy is needed.
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from travjax.config import require, require_number
from travjax.simulation.events import EVENTS

OVERALL = "overall"
NAMES = (*EVENTS, OVERALL)
THRESHOLD = 0.5
RECALLS = (0.9, 0.99)
"""Recalls that thresholds are found for, unless others are given."""

CURVE_POINTS = 300
"""The number of points of a precision-recall curve that an Evaluation keeps."""

Columns = dict[str, tuple[np.ndarray, np.ndarray]]
"""Probabilities and failures by event, and for all events together."""


@dataclass(frozen=True)
class Confusion:
    """Counts of safe samples predicted safe (tn) or failing (fp), and of failures predicted safe (fn), failing (tp)."""

    tn: int
    fp: int
    fn: int
    tp: int

    def __add__(self, other: "Confusion") -> "Confusion":
        return Confusion(self.tn + other.tn, self.fp + other.fp, self.fn + other.fn, self.tp + other.tp)

    @property
    def samples(self) -> int:
        return self.tn + self.fp + self.fn + self.tp

    @property
    def failures(self) -> float:
        """Share of the samples that fail."""
        return _ratio(self.fn + self.tp, self.samples)

    @property
    def accuracy(self) -> float:
        return _ratio(self.tn + self.tp, self.samples)

    @property
    def recall(self) -> float:
        return _ratio(self.tp, self.fn + self.tp)

    @property
    def precision(self) -> float:
        """NaN if no sample is predicted to fail, and also if none fails, where the paper leaves it out."""
        return _ratio(self.tp, self.fp + self.tp) if self.fn + self.tp else math.nan

    @property
    def f1(self) -> float:
        return _ratio(2 * self.tp, 2 * self.tp + self.fp + self.fn) if self.fn + self.tp else math.nan


FIGURES = ("accuracy", "recall", "precision", "f1", "failures")
"""Names of the properties of a confusion that are reported."""


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def with_overall(confusions: Mapping[str, Confusion]) -> dict[str, Confusion]:
    """Adds "overall", the sum, to the confusions of the events."""
    return {**confusions, OVERALL: sum(confusions.values(), Confusion(0, 0, 0, 0))}


PAPER_SYNTHETIC = with_overall(
    {
        "step": Confusion(3126951, 113457, 13615, 201689),
        "obstacle": Confusion(3211837, 53842, 9644, 180389),
        "tilt": Confusion(3425479, 15806, 163, 14264),
    }
)
"""The paper's synthetic test set (SPEC section 10)."""

PAPER_REAL = with_overall(
    {
        "step": Confusion(132880, 811, 109, 48),
        "obstacle": Confusion(132622, 521, 269, 436),
        "tilt": Confusion(133735, 113, 0, 0),
    }
)
"""The paper's 44 real maps, predicted by the network that was transferred to them."""


@dataclass(frozen=True)
class Curve:
    """Precision and recall at every threshold where the recall changes: the distinct probabilities of the failures.

    threshold: [k] decreasing; precision, recall: [k], recall increasing to 1. Empty if no sample fails.
    """

    threshold: Float[np.ndarray, " k"]
    precision: Float[np.ndarray, " k"]
    recall: Float[np.ndarray, " k"]

    @property
    def average_precision(self) -> float:
        """Mean precision over recall without interpolation: the sum of recall increments x precision. NaN if empty."""
        if not len(self.recall):
            return math.nan
        return float(np.diff(self.recall, prepend=0) @ self.precision)

    def threshold_for_recall(self, recall: float) -> float:
        """Returns the highest threshold that reaches the recall; NaN if no sample fails."""
        require_number("recall", recall, 0, 1, "a share above 0 and at most 1")
        if not len(self.recall):
            return math.nan
        return float(self.threshold[np.searchsorted(self.recall, recall)])

    def recall_at_precision(self, precision: float) -> float:
        """Returns the largest recall at that precision or a higher one, 0 where it is not reached; NaN if empty."""
        if not len(self.recall):
            return math.nan
        return float(self.recall[self.precision >= precision].max(initial=0.0))

    def thinned(self, points: int = CURVE_POINTS) -> "Curve":
        """Keeps at most that many points, spread evenly over the curve, with both ends."""
        last = len(self.recall) - 1
        kept = np.unique(np.linspace(0, last, min(points, last + 1)).round().astype(int))
        return Curve(self.threshold[kept], self.precision[kept], self.recall[kept])


@dataclass(frozen=True)
class Calibration:
    """Predicted against observed failures: samples in bins of equal width by their probability.

    count: [b] samples; probability: [b] their mean probability; observed: [b] share that fails. NaN in empty bins.
    """

    count: Int[np.ndarray, " b"]
    probability: Float[np.ndarray, " b"]
    observed: Float[np.ndarray, " b"]

    @property
    def edges(self) -> np.ndarray:
        """Bounds of the bins, [b + 1]; a probability on a bound belongs to the bin above it, 1 to the last bin."""
        return np.linspace(0, 1, len(self.count) + 1)

    @property
    def error(self) -> float:
        """The expected calibration error (ECE): mean distance of probability from observed share over the samples."""
        distance = np.abs(self.probability - self.observed)
        return float(np.nansum(self.count * distance) / self.count.sum())


@dataclass(frozen=True)
class Scores:
    """The confusion at the threshold, and the average precision, of one event or overall."""

    confusion: Confusion
    average_precision: float


@dataclass(frozen=True)
class OperatingPoint:
    """The highest threshold that reaches the wanted recall, and the confusion there."""

    wanted: float
    threshold: float
    confusion: Confusion


@dataclass(frozen=True)
class Evaluation:
    """All metrics of one predictor on one set of samples; the dicts have the keys of the events and "overall".

    any_failure: share of the samples with any failure; curves keep CURVE_POINTS points
    points:      operating points at each wanted recall and at the paper's recall, by increasing recall
    groups:      for each group of samples, scores by event and "overall"
    recall_at_paper_precision: the largest recall at the precision that the paper reports, where it reports one
    """

    samples: int
    any_failure: float
    threshold: float
    scores: dict[str, Scores]
    curves: dict[str, Curve]
    points: dict[str, tuple[OperatingPoint, ...]]
    calibration: dict[str, Calibration]
    groups: dict[str, dict[str, Scores]] = field(default_factory=dict)
    recall_at_paper_precision: dict[str, float] = field(default_factory=dict)

    @property
    def average_precision(self) -> dict[str, float]:
        """Average precision by event, "overall", and as "mean" over the events that have failures."""
        by_name = {name: scores.average_precision for name, scores in self.scores.items()}
        defined = [value for name, value in by_name.items() if name != OVERALL and not math.isnan(value)]
        return {**by_name, "mean": _ratio(sum(defined), len(defined))}

    @property
    def f1(self) -> dict[str, float]:
        """F1 by event and "overall"."""
        return {name: scores.confusion.f1 for name, scores in self.scores.items()}


def confusion(probabilities: np.ndarray, failed: np.ndarray, threshold: float = THRESHOLD) -> Confusion:
    """Counts the confusion of all elements of two arrays of one shape; probability >= threshold predicts failure."""
    predicted = probabilities >= threshold
    positive = int(np.count_nonzero(predicted))
    tp = int(np.count_nonzero(predicted & failed))
    fn = int(np.count_nonzero(failed)) - tp
    return Confusion(failed.size - positive - fn, positive - tp, fn, tp)


def confusions(
    probabilities: Float[np.ndarray, "s k"],
    failed: Bool[np.ndarray, "s k"],
    threshold: float | Sequence[float] = THRESHOLD,
    events: Sequence[str] = EVENTS,
) -> dict[str, Confusion]:
    """Counts the confusion of each event, and overall; `threshold` is one for all events, or one for each."""
    thresholds = np.broadcast_to(threshold, len(events)).tolist()
    return with_overall(
        {name: confusion(probabilities[:, e], failed[:, e], thresholds[e]) for e, name in enumerate(events)}
    )


def precision_recall_curve(probabilities: np.ndarray, failed: np.ndarray) -> Curve:
    """Computes the curve of all elements of two arrays of one shape; equal probabilities pass a threshold together."""
    failures, safe = np.sort(probabilities[failed]), np.sort(probabilities[~failed])
    threshold = np.unique(failures)[::-1]
    tp = len(failures) - np.searchsorted(failures, threshold)
    fp = len(safe) - np.searchsorted(safe, threshold)
    return Curve(threshold, tp / (tp + fp), tp / max(len(failures), 1))


def average_precision(probabilities: np.ndarray, failed: np.ndarray) -> float:
    """Computes average precision (scikit-learn's definition) over two arrays of one shape; NaN if nothing fails."""
    return precision_recall_curve(probabilities, failed).average_precision


def threshold_for_recall(probabilities: np.ndarray, failed: np.ndarray, recall: float) -> float:
    """Returns the highest threshold at which predictions find that share of the failures; NaN if nothing fails."""
    return precision_recall_curve(probabilities, failed).threshold_for_recall(recall)


def calibration(probabilities: np.ndarray, failed: np.ndarray, bins: int = 10) -> Calibration:
    """Bins all elements of two arrays of one shape by probability."""
    probability = np.ravel(probabilities).astype(np.float64)
    number = np.minimum((probability * bins).astype(np.int64), bins - 1)
    count = np.bincount(number, minlength=bins)
    total = np.bincount(number, probability, minlength=bins)
    fails = np.bincount(number[np.ravel(failed)], minlength=bins)
    samples = np.where(count, count, np.nan)
    return Calibration(count, total / samples, fails / samples)


def evaluate(
    probabilities: Float[np.ndarray, "s k"],
    failed: Bool[np.ndarray, "s k"],
    groups: Sequence[str] | np.ndarray | None = None,
    *,
    events: Sequence[str] = EVENTS,
    recalls: Sequence[float] = RECALLS,
    paper: Mapping[str, Confusion] | None = PAPER_SYNTHETIC,
    threshold: float = THRESHOLD,
) -> Evaluation:
    """Computes all metrics of predicted probabilities [s, k] of samples with known failures [s, k].

    groups:  [s] the group of each sample, such as its style
    events:  names of the k events
    recalls: recalls to find thresholds for, in addition to those of `paper`
    Raises InputError when shapes differ, there is no sample, or a probability is outside 0 to 1.
    """
    probabilities, failed = _checked(probabilities, failed, len(events))
    columns = {name: (probabilities[:, e], failed[:, e]) for e, name in enumerate(events)}
    columns[OVERALL] = (probabilities, failed)
    curves = {name: precision_recall_curve(*column) for name, column in columns.items()}
    counts = confusions(probabilities, failed, threshold, events)
    wanted = {name: {*recalls, *_recall_of(paper, name)} for name in columns}
    return Evaluation(
        samples=len(failed),
        any_failure=float(failed.any(axis=1).mean()),
        threshold=threshold,
        scores={name: Scores(counts[name], curves[name].average_precision) for name in columns},
        curves={name: curve.thinned() for name, curve in curves.items()},
        points={name: _points(*column, curves[name], wanted[name]) for name, column in columns.items()},
        calibration={name: calibration(*column) for name, column in columns.items()},
        groups={} if groups is None else _of_groups(columns, groups, threshold),
        recall_at_paper_precision={
            name: curve.recall_at_precision(paper[name].precision)
            for name, curve in curves.items()
            if paper and name in paper and paper[name].precision > 0
        },
    )


def _recall_of(paper: Mapping[str, Confusion] | None, name: str) -> set[float]:
    """Returns the recall that the paper reports, if any."""
    return {round(paper[name].recall, 3)} if paper and name in paper and paper[name].recall > 0 else set()


def _points(probabilities, failed, curve: Curve, recalls: Iterable[float]) -> tuple[OperatingPoint, ...]:
    points = [(recall, curve.threshold_for_recall(recall)) for recall in sorted(recalls)]
    return tuple(OperatingPoint(*point, confusion(probabilities, failed, point[1])) for point in points)


def _of_groups(columns: Columns, groups, threshold: float) -> dict[str, dict[str, Scores]]:
    members, samples = np.asarray(groups), len(columns[OVERALL][1])
    require(members.shape == (samples,), "groups", members.shape, f"one name for each of {samples} samples")
    return {
        str(group): {name: _scores(p[of], failed[of], threshold) for name, (p, failed) in columns.items()}
        for group, of in _masks(members)
    }


def _masks(members: np.ndarray) -> Iterable[tuple[str, np.ndarray]]:
    """Yields each name and the mask of its members, by first appearance; names are few, so nothing is sorted."""
    left = np.ones(len(members), bool)
    while left.any():
        name = members[left.argmax()]
        of = members == name
        left &= ~of
        yield name, of


def _scores(probabilities: np.ndarray, failed: np.ndarray, threshold: float) -> Scores:
    return Scores(confusion(probabilities, failed, threshold), average_precision(probabilities, failed))


def _checked(probabilities, failed, events: int) -> tuple[np.ndarray, np.ndarray]:
    probabilities, failed = np.asarray(probabilities), np.asarray(failed)
    allowed = f"[s, {events}], at least one sample"
    require(failed.ndim == 2 and failed.shape[1] == events and len(failed) > 0, "failed", failed.shape, allowed)
    require(failed.dtype == bool, "failed", failed.dtype, "of dtype bool")
    require(probabilities.shape == failed.shape, "probabilities", probabilities.shape, f"{failed.shape}, as failed is")
    probabilities = probabilities.astype(np.result_type(probabilities, np.float32), copy=False)
    wrong = ~((probabilities >= 0) & (probabilities <= 1))
    require(not wrong.any(), "probabilities", probabilities[wrong][:1].tolist(), "from 0 to 1")
    return probabilities, failed


def json_ready(value):
    """Converts an Evaluation or part of one, with derived figures, to dicts, lists and numbers; None if not finite."""
    if isinstance(value, np.ndarray | np.generic):
        return json_ready(value.tolist())
    if dataclasses.is_dataclass(value):
        derived = {Confusion: FIGURES, Calibration: ("error",), Evaluation: ("average_precision",)}
        names = [*(entry.name for entry in dataclasses.fields(value)), *derived.get(type(value), ())]
        return {name: json_ready(getattr(value, name)) for name in names}
    if isinstance(value, Mapping):
        return {name: json_ready(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [json_ready(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
