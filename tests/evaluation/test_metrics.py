"""Metrics against scikit-learn, slow loops, and the figures that the paper prints."""

import json
import math
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn import metrics as sk

from travjax.config import InputError
from travjax.evaluation import metrics
from travjax.evaluation.metrics import NAMES, PAPER_REAL, PAPER_SYNTHETIC, Confusion, evaluate
from travjax.simulation.events import EVENTS

KINDS = {
    "separable in part": dict(share=(0.2, 0.1, 0.3), separation=2.0),
    "useless": dict(share=(0.5, 0.5, 0.5), separation=0.0),
    "worse than chance": dict(share=(0.3, 0.3, 0.3), separation=-2.0),
    "extreme imbalance": dict(share=(0.0005, 0.002, 0.0002), separation=3.0),
    "many ties": dict(share=(0.2, 0.1, 0.02), separation=2.0, decimals=1),
    "two values": dict(share=(0.2, 0.1, 0.02), separation=2.0, decimals=0),
}


def sample(count=20_000, share=(0.2, 0.1, 0.02), separation=2.0, decimals=None, seed=0, dtype=np.float32):
    """Probabilities [count, 3] and failures that go with them more or less; at least one failure and one not."""
    draw = np.random.default_rng(seed)
    failed = draw.random((count, 3)) < share
    failed[:2] = [[True] * 3, [False] * 3]
    score = draw.standard_normal(failed.shape) + separation * failed - 2
    probabilities = 1 / (1 + np.exp(-score))
    return (probabilities if decimals is None else probabilities.round(decimals)).astype(dtype), failed


@pytest.fixture(params=KINDS)
def kind(request):
    """Each kind of sample in turn: probabilities, failed."""
    return sample(**KINDS[request.param])


@st.composite
def small_samples(draw):
    """A few samples of one event with at least one failure; probabilities from few values, so that ties are common."""
    values = st.sampled_from([0.0, 0.1, 0.25, 0.5, 0.75, 1.0])
    pairs = draw(st.lists(st.tuples(values, st.booleans()), min_size=1, max_size=12))
    pairs.append((draw(values), True))
    probabilities, failed = zip(*pairs, strict=True)
    return np.array(probabilities, np.float32), np.array(failed)


# ---- The paper's figures


PRINTED = {
    "step": (0.963, 0.937, 0.640, 0.760),
    "obstacle": (0.982, 0.950, 0.770, 0.850),
    "tilt": (0.995, 0.989, 0.474, 0.641),
    "overall": (0.980, 0.944, 0.684, 0.793),
}
PRINTED_REAL = {
    "step": (0.993, 0.306, 0.056, 0.094),
    "obstacle": (0.994, 0.618, 0.456, 0.525),
    "tilt": (0.999, math.nan, math.nan, math.nan),
    "overall": (0.995, 0.561, 0.251, 0.347),
}


def figures(counts: Confusion) -> tuple[float, ...]:
    return counts.accuracy, counts.recall, counts.precision, counts.f1


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("paper", "printed"), [(PAPER_SYNTHETIC, PRINTED), (PAPER_REAL, PRINTED_REAL)])
def test_the_papers_counts_give_the_figures_that_it_prints(paper, printed, name):
    # Its obstacle recall is .9492 by its counts and printed as .950.
    slack = 0.0008 if (paper is PAPER_SYNTHETIC and name == "obstacle") else 0.0005 + 1e-9
    np.testing.assert_allclose(figures(paper[name]), printed[name], rtol=0, atol=slack)


def test_overall_is_the_sum_over_the_events():
    assert PAPER_SYNTHETIC["overall"] == Confusion(9764267, 183105, 23422, 396342)
    assert PAPER_REAL["overall"] == Confusion(399237, 1445, 378, 484)
    assert list(PAPER_SYNTHETIC) == list(PAPER_REAL) == [*EVENTS, "overall"]


@pytest.mark.parametrize(("event", "share"), [("step", 0.0623), ("obstacle", 0.0550), ("tilt", 0.0042)])
def test_the_papers_shares_of_failures(event, share):
    assert PAPER_SYNTHETIC[event].failures == pytest.approx(share, abs=5e-5)
    assert PAPER_SYNTHETIC[event].samples == 1136 * 3042


# ---- Confusion


@pytest.mark.parametrize("threshold", [0.1, 0.5, 0.9])
def test_a_confusion_is_scikit_learns(kind, threshold):
    probabilities, failed = kind
    found = metrics.confusions(probabilities, failed, threshold)
    for e, event in enumerate(EVENTS):
        truth, predicted = failed[:, e], probabilities[:, e] >= threshold
        counts = found[event]
        assert [counts.tn, counts.fp, counts.fn, counts.tp] == sk.confusion_matrix(truth, predicted).ravel().tolist()
        assert counts.accuracy == pytest.approx(sk.accuracy_score(truth, predicted))
        assert counts.recall == pytest.approx(sk.recall_score(truth, predicted))
        assert counts.f1 == pytest.approx(sk.f1_score(truth, predicted))
        if predicted.any():
            assert counts.precision == pytest.approx(sk.precision_score(truth, predicted))
    assert found["overall"].f1 == pytest.approx(sk.f1_score(failed, probabilities >= threshold, average="micro"))


def test_a_probability_on_the_threshold_is_predicted_to_fail():
    assert metrics.confusion(np.array([0.5, 0.49]), np.array([True, True])) == Confusion(0, 0, 1, 1)


def test_each_event_may_have_its_own_threshold():
    probabilities, failed = sample()
    found = metrics.confusions(probabilities, failed, [0.2, 0.5, 0.8])
    for e, threshold in enumerate((0.2, 0.5, 0.8)):
        assert found[EVENTS[e]] == metrics.confusion(probabilities[:, e], failed[:, e], threshold)


def test_what_is_undefined_is_nan():
    nothing_fails = Confusion(9, 1, 0, 0)
    assert nothing_fails.accuracy == 0.9
    assert all(math.isnan(figure) for figure in figures(nothing_fails)[1:])
    nothing_predicted = Confusion(8, 0, 2, 0)
    assert (nothing_predicted.recall, nothing_predicted.f1) == (0, 0)
    assert math.isnan(nothing_predicted.precision)


# ---- Precision and recall


def test_average_precision_is_scikit_learns(kind):
    probabilities, failed = kind
    for e in range(3):
        expected = sk.average_precision_score(failed[:, e], probabilities[:, e])
        assert metrics.average_precision(probabilities[:, e], failed[:, e]) == pytest.approx(expected, abs=1e-12)
    expected = sk.average_precision_score(failed, probabilities, average="micro")
    assert metrics.average_precision(probabilities, failed) == pytest.approx(expected, abs=1e-12)


@given(small_samples())
def test_average_precision_of_few_samples_is_scikit_learns(pair):
    assert metrics.average_precision(*pair) == pytest.approx(sk.average_precision_score(*pair[::-1]), abs=1e-12)


def test_the_curve_is_scikit_learns_where_the_recall_changes(kind):
    probabilities, failed = kind[0][:, 0], kind[1][:, 0]
    precision, recall, threshold = sk.precision_recall_curve(failed, probabilities)
    changes = np.flatnonzero(np.diff(recall))[::-1]  # scikit-learn's recall falls to 0
    curve = metrics.precision_recall_curve(probabilities, failed)
    np.testing.assert_array_equal(curve.threshold, threshold[changes])
    np.testing.assert_allclose(curve.precision, precision[changes], rtol=1e-12)
    np.testing.assert_allclose(curve.recall, recall[changes], rtol=1e-12)


def test_a_perfect_predictor_has_average_precision_1():
    _, failed = sample()
    assert metrics.average_precision(failed.astype(np.float32), failed) == 1


def test_a_constant_predictor_has_the_share_of_failures():
    _, failed = sample()
    assert metrics.average_precision(np.full(failed.shape, 0.3), failed) == pytest.approx(failed.mean())


def test_a_thinned_curve_keeps_ends_and_points():
    curve = metrics.precision_recall_curve(*sample())
    thin = curve.thinned(50)
    assert len(thin.recall) == 50
    assert np.isin(thin.threshold, curve.threshold).all()
    assert (thin.recall[0], thin.recall[-1]) == (curve.recall[0], 1)
    assert np.diff(thin.recall).max() < 0.05
    assert len(thin.thinned(1000).recall) == 50


@pytest.mark.parametrize("recall", [0.001, 0.5, 0.9, 0.944, 0.99, 1.0])
def test_a_threshold_reaches_its_recall_and_the_next_higher_does_not(kind, recall):
    for e in range(3):
        probabilities, failed = kind[0][:, e], kind[1][:, e]
        threshold = metrics.threshold_for_recall(probabilities, failed, recall)
        assert metrics.confusion(probabilities, failed, threshold).recall >= recall
        higher = float(np.nextafter(np.float32(threshold), np.float32(2)))
        assert metrics.confusion(probabilities, failed, higher).recall < recall


def test_a_recall_that_a_count_of_failures_hits_exactly_needs_no_more():
    """944 of 1000 failures are a recall of 0.944, whatever the rounding."""
    probabilities = np.linspace(1, 0.001, 1000, dtype=np.float32)
    for found in range(1, 1001):
        threshold = metrics.threshold_for_recall(probabilities, np.ones(1000, bool), found / 1000)
        assert threshold == probabilities[found - 1]


@pytest.mark.parametrize("recall", [0, -0.1, 1.1, math.nan, "0.9"])
def test_a_recall_that_is_no_share_is_refused(recall):
    with pytest.raises(InputError, match="recall = .*: must be a share above 0 and at most 1"):
        metrics.threshold_for_recall(*sample(10), recall)


# ---- Calibration


@pytest.mark.parametrize("bins", [1, 10, 15])
def test_calibration_is_that_of_a_slow_loop(kind, bins):
    probabilities, failed = kind[0][:2000, 0], kind[1][:2000, 0]
    found = metrics.calibration(probabilities, failed, bins)
    error = 0.0
    for b in range(bins):
        inside = [i for i, p in enumerate(probabilities.tolist()) if min(int(p * bins), bins - 1) == b]
        assert found.count[b] == len(inside)
        if inside:
            mean = sum(float(probabilities[i]) for i in inside) / len(inside)
            observed = sum(bool(failed[i]) for i in inside) / len(inside)
            assert (found.probability[b], found.observed[b]) == pytest.approx((mean, observed))
            error += len(inside) / len(probabilities) * abs(mean - observed)
        else:
            assert np.isnan([found.probability[b], found.observed[b]]).all()
    assert found.error == pytest.approx(error)
    np.testing.assert_allclose(found.edges, [b / bins for b in range(bins + 1)])


def test_bounds_belong_to_the_bin_above_and_one_to_the_last():
    assert metrics.calibration(np.array([0, 0.5, 1]), np.zeros(3, bool), 2).count.tolist() == [1, 2]


def test_probabilities_that_are_true_are_calibrated_and_halved_ones_are_not():
    draw = np.random.default_rng(0)
    probabilities = draw.random((200_000, 3))
    failed = draw.random(probabilities.shape) < probabilities
    assert metrics.calibration(probabilities, failed).error < 0.005
    assert metrics.calibration(probabilities / 2, failed).error == pytest.approx(0.25, abs=0.005)


# ---- Evaluation


def test_an_evaluation_holds_what_its_parts_say(kind):
    probabilities, failed = kind
    found = evaluate(probabilities, failed)
    assert found.samples == len(failed)
    assert found.any_failure == failed.any(axis=1).mean()
    assert {name: scores.confusion for name, scores in found.scores.items()} == metrics.confusions(*kind)
    for name, column in zip(NAMES, [*((probabilities[:, e], failed[:, e]) for e in range(3)), kind], strict=True):
        assert found.scores[name].average_precision == metrics.average_precision(*column)
        assert found.calibration[name].error == metrics.calibration(*column).error
        assert len(found.curves[name].recall) <= metrics.CURVE_POINTS
        for point in found.points[name]:
            assert point.threshold == metrics.threshold_for_recall(*column, point.wanted)
            assert point.confusion == metrics.confusion(*column, point.threshold)
    assert found.average_precision["mean"] == pytest.approx(sk.average_precision_score(failed, probabilities))
    assert found.f1["overall"] == found.scores["overall"].confusion.f1
    assert found.groups == {}


def test_thresholds_are_found_for_the_wanted_recalls_and_the_papers():
    found = evaluate(*sample(), recalls=(0.95, 0.5))
    assert {name: [point.wanted for point in points] for name, points in found.points.items()} == {
        "step": [0.5, 0.937, 0.95],
        "obstacle": [0.5, 0.949, 0.95],
        "tilt": [0.5, 0.95, 0.989],
        "overall": [0.5, 0.944, 0.95],
    }
    real = evaluate(*sample(), recalls=(0.5,), paper=PAPER_REAL).points
    assert [point.wanted for point in real["tilt"]] == [0.5]
    assert [point.wanted for point in real["step"]] == [0.306, 0.5]
    assert [point.wanted for point in evaluate(*sample(), recalls=(0.5,), paper=None).points["step"]] == [0.5]


@pytest.mark.parametrize("as_groups", [list, np.array])
def test_groups_are_evaluated_on_their_own_in_the_order_in_which_they_come(as_groups):
    probabilities, failed = sample(3000)
    names = ["wavy", "rough", "a"] * 1000
    found = evaluate(probabilities, failed, as_groups(names))
    assert list(found.groups) == ["wavy", "rough", "a"]
    for start, name in enumerate(found.groups):
        assert found.groups[name] == evaluate(probabilities[start::3], failed[start::3]).scores
    total = sum((scores["step"].confusion for scores in found.groups.values()), Confusion(0, 0, 0, 0))
    assert total == found.scores["step"].confusion


def test_the_order_of_samples_does_not_matter():
    probabilities, failed = sample(**KINDS["many ties"])
    shuffle = np.random.default_rng(1).permutation(len(failed))
    one, other = (
        metrics.json_ready(evaluate(*pair))
        for pair in ((probabilities, failed), (probabilities[shuffle], failed[shuffle]))
    )
    assert one.pop("calibration")["step"]["error"] == pytest.approx(other.pop("calibration")["step"]["error"])
    assert one == other


@pytest.mark.parametrize("dtype", [np.float16, np.float64, jnp.bfloat16])
def test_other_precisions_of_probabilities_are_taken(dtype):
    probabilities, failed = sample(500)
    rounded = (
        np.asarray(jnp.asarray(probabilities).astype(dtype)) if dtype is jnp.bfloat16 else probabilities.astype(dtype)
    )
    found = evaluate(rounded, failed)
    expected = sk.average_precision_score(failed, rounded.astype(np.float64), average="micro")
    assert found.average_precision["overall"] == pytest.approx(expected, abs=1e-12)
    assert evaluate(jnp.asarray(probabilities), jnp.asarray(failed)).samples == 500


@pytest.mark.parametrize(
    ("probabilities", "failed"), [([1.0, 0.2, 0.5], [True, False, True]), ([0.0, 0.0, 0.0], [True, True, False])]
)
def test_one_sample_is_enough(probabilities, failed):
    found = evaluate(np.array([probabilities], np.float32), np.array([failed]), ["one"])
    for e, event in enumerate(EVENTS):
        precision = found.average_precision[event]
        assert precision == 1 if failed[e] else math.isnan(precision)
    assert found.average_precision["mean"] == 1
    json.dumps(metrics.json_ready(found), allow_nan=False)


def test_an_event_without_failures_is_nan_and_counts_in_no_mean():
    probabilities, failed = sample()
    failed[:, 2] = False
    found = evaluate(probabilities, failed)
    assert math.isnan(found.average_precision["tilt"])
    assert math.isnan(found.f1["tilt"])
    assert all(math.isnan(point.threshold) for point in found.points["tilt"])
    both = [found.average_precision[event] for event in ("step", "obstacle")]
    assert found.average_precision["mean"] == pytest.approx(np.mean(both))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an event without failures
        expected = sk.average_precision_score(failed, probabilities, average="micro")
    assert found.average_precision["overall"] == pytest.approx(expected)


def test_a_sample_without_any_failure_has_no_mean():
    found = evaluate(np.full((5, 3), 0.2), np.zeros((5, 3), bool))
    assert all(math.isnan(value) for value in found.average_precision.values())
    assert found.scores["overall"].confusion == Confusion(15, 0, 0, 0)


def fine() -> dict:
    return {"probabilities": np.full((4, 3), 0.5, np.float32), "failed": np.zeros((4, 3), bool)}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"failed": np.zeros((4, 2), bool)}, r"failed = \(4, 2\): must be \[s, 3\]"),
        ({"failed": np.zeros((0, 3), bool)}, r"failed = \(0, 3\): must be .*at least one sample"),
        ({"failed": np.zeros((4, 3))}, "failed = dtype.*: must be of dtype bool"),
        ({"probabilities": np.zeros((5, 3))}, r"probabilities = \(5, 3\): must be \(4, 3\), as failed is"),
        ({"probabilities": np.full((4, 3), 1.5)}, r"probabilities = \[1.5\]: must be from 0 to 1"),
        ({"probabilities": np.full((4, 3), np.nan)}, r"probabilities = \[nan\]: must be from 0 to 1"),
        ({"groups": ["a", "b"]}, r"groups = \(2,\): must be one name for each of 4 samples"),
    ],
)
def test_bad_input_is_refused(changed, message):
    evaluate(**fine())
    with pytest.raises(InputError, match=message):
        evaluate(**{**fine(), **changed})


# ---- JSON


def test_json_has_every_figure_and_null_where_undefined():
    probabilities, failed = sample(300)
    failed[:, 2] = False
    found = evaluate(probabilities, failed, ["a"] * 300)
    read = json.loads(json.dumps(metrics.json_ready(found), allow_nan=False))
    step = read["scores"]["step"]["confusion"]
    counts = found.scores["step"].confusion
    assert step == {
        **{"tn": counts.tn, "fp": counts.fp, "fn": counts.fn, "tp": counts.tp, "accuracy": counts.accuracy},
        **{"recall": counts.recall, "precision": counts.precision, "f1": counts.f1, "failures": counts.failures},
    }
    assert read["scores"]["tilt"]["average_precision"] is None
    assert read["scores"]["tilt"]["confusion"]["recall"] is None
    assert read["points"]["tilt"][0]["threshold"] is None
    assert read["average_precision"]["mean"] == found.average_precision["mean"]
    assert read["calibration"]["step"]["error"] == found.calibration["step"].error
    assert read["groups"]["a"]["step"]["confusion"]["tp"] == counts.tp
    np.testing.assert_array_equal(np.float32(read["curves"]["step"]["threshold"]), found.curves["step"].threshold)


def test_json_of_what_is_not_finite_is_null():
    assert metrics.json_ready({"a": [math.nan, math.inf, np.float32(1.5), np.int64(3), True, None, "b"]}) == {
        "a": [None, None, 1.5, 3, True, None, "b"]
    }


def test_the_recall_at_a_precision_is_the_largest_that_keeps_it():
    curve = metrics.Curve(
        np.array([0.9, 0.8, 0.5, 0.1]), np.array([0.5, 1.0, 0.75, 0.6]), np.array([0.2, 0.4, 0.6, 1.0])
    )
    assert [curve.recall_at_precision(wanted) for wanted in (0.5, 0.7, 0.75, 0.76, 1.0)] == [1.0, 0.6, 0.6, 0.4, 0.4]
    assert metrics.Curve(*np.array([[0.9], [0.5], [1.0]])).recall_at_precision(0.6) == 0
    empty = np.zeros(0)
    assert math.isnan(metrics.Curve(empty, empty, empty).recall_at_precision(0.5))


def test_recalls_are_given_at_the_precisions_that_the_paper_reports():
    probabilities, failed = sample()
    found = evaluate(probabilities, failed).recall_at_paper_precision
    assert tuple(found) == NAMES
    for e, event in enumerate(EVENTS):
        curve = metrics.precision_recall_curve(probabilities[:, e], failed[:, e])
        assert found[event] == curve.recall_at_precision(metrics.PAPER_SYNTHETIC[event].precision)
    assert list(evaluate(probabilities, failed, paper=PAPER_REAL).recall_at_paper_precision) == [
        "step",
        "obstacle",
        "overall",
    ]
    assert evaluate(probabilities, failed, paper=None).recall_at_paper_precision == {}
