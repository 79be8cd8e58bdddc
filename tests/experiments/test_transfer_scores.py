"""Scores of the transfer experiment against numbers worked out by hand."""

import json
import math

import numpy as np
import pytest

from tests.evaluation.test_map_figures import colours, pixels, within
from tests.evaluation.test_score_figures import labelled_lines
from tests.small_training import loads
from travjax.evaluation.metrics import NAMES, Confusion, json_ready, with_overall
from travjax.experiments.transfer_scores import (
    ALL,
    Results,
    arms_table,
    events_table,
    mean_and_spread,
    results_json,
    transfer_figure,
)

SAFE = Confusion(10, 0, 0, 0)


def row(epoch: int, validation: float | None, **sites: Confusion) -> dict:
    """A row of metrics.jsonl: the obstacle event of each site has the counts, the others are ten safe samples."""
    scored = {}
    for site, counts in sites.items():
        confusions = with_overall({"step": SAFE, "obstacle": counts, "tilt": SAFE})
        scored[site] = {
            name: {"confusion": json_ready(one), "average_precision": None} for name, one in confusions.items()
        }
    made = {"epoch": epoch, "eval_sets": scored}
    return made if epoch == 0 else made | {"average_precision": {"overall": validation}}


def counts(tp: int, fp: int, fails: int = 4) -> Confusion:
    """Scores of ten samples of which so many fail."""
    return Confusion(10 - fails - fp, fp, fails - tp, tp)


def results(arm: str = "random") -> Results:
    """Two seeds of an arm on two sites. F1 on "hill": 0, 1/2, 1 and 0, 4/7, 2/5; on "plain": 0, 0, 1 twice."""
    first = [
        row(0, None, hill=counts(0, 0), plain=counts(0, 0, 1)),
        row(1, 0.9, hill=counts(2, 2), plain=counts(0, 1, 1)),
        row(2, 0.8, hill=counts(4, 0), plain=counts(1, 0, 1)),
    ]
    second = [
        row(0, None, hill=counts(0, 0), plain=counts(0, 0, 1)),
        row(1, 0.3, hill=counts(2, 1), plain=counts(0, 0, 1)),
        row(2, 0.7, hill=counts(1, 0), plain=counts(1, 0, 1)),
    ]
    return Results.from_rows({arm: {0: first, 1: second}})


def test_f1_of_each_seed_and_epoch_pools_the_events():
    hill = [[0, 2 * 2 / (4 + 2 + 2), 1], [0, 2 * 2 / (4 + 1 + 2), 2 / (2 + 0 + 3)]]
    np.testing.assert_allclose(results().f1("random", "hill"), hill)
    np.testing.assert_allclose(results().f1("random", "plain"), [[0, 0, 1], [0, 0, 1]])


def test_the_sites_together_add_their_counts():
    assert results().sites == ["hill", "plain", ALL]
    together = results().arms["random"][0].epochs[1].held_out[ALL]
    assert together["obstacle"] == counts(2, 2) + counts(0, 1, 1)
    assert together["overall"].samples == 60
    one = Results.from_rows({"random": {0: [row(0, None, hill=SAFE), row(1, 0.5, hill=SAFE)]}})
    assert one.sites == ["hill"]


def test_the_best_epoch_is_that_of_the_held_out_site_and_the_chosen_one_that_of_the_validation():
    assert [epoch.number for epoch in results().best("random", "hill")] == [2, 1]
    assert [epoch.number for epoch in results().best("random", "plain")] == [2, 2]
    assert [epoch.number for epoch in results().chosen("random")] == [1, 2]
    assert [epoch.number for epoch in results().first("random")] == [0, 0]


def test_the_first_state_is_never_the_best_epoch():
    falling = [row(0, None, hill=counts(4, 0)), row(1, None, hill=counts(1, 0)), row(2, None, hill=counts(0, 0))]
    made = Results.from_rows({"random": {0: falling}})
    assert made.best("random", "hill")[0].number == made.chosen("random")[0].number == 1


def test_always_fails_finds_every_failure_and_its_precision_is_their_share():
    always = results().always("hill")
    assert always == Confusion(0, 26, 0, 4)
    assert always.f1 == pytest.approx(2 * 4 / (2 * 4 + 26))
    assert results().always("hill", "obstacle") == Confusion(0, 6, 0, 4)


def test_the_table_of_arms_holds_means_spreads_and_the_way_to_one():
    table = arms_table(results())
    lines = [line.split("  ") for line in table.splitlines()]
    cut = [[cell.strip() for cell in line if cell.strip()] for line in lines]
    random = next(line for line in cut if line[0] == "random")
    always = 8 / 34
    best = [1, 4 / 7]
    way = [(value - always) / (1 - always) for value in best]
    spread = np.std(best, ddof=1)
    assert random[1:3] == ["2, 1", f"{np.mean(best):.3f} ± {spread:.3f}"]
    assert f"{np.mean(way):.3f} ± {np.std(way, ddof=1):.3f}" in random
    assert f"{np.mean([0.5, 0.4]):.3f} ± {np.std([0.5, 0.4], ddof=1):.3f}" in random
    assert next(line for line in cut if line[:2] == ["hill", "always fails"])[2:] == [f"{always:.3f}", "1.000", "0.133"]
    assert next(line for line in cut if line[0] == "ImageNet + synthetic") == [
        "ImageNet + synthetic", "0.46", "0.76", "0.31"
    ]  # fmt: skip
    assert [line for line in cut if line[:1] == ["paper: its own"]][0][1:] == ["random", "near 0"]


def test_the_table_of_events_has_the_papers_figures_below_and_says_what_its_dashes_mean():
    table = events_table(results(), "random")
    lines = [line for line in table.splitlines() if "paper, transferred" in line]
    assert [line.split()[-5:] for line in lines] == [
        ["0.993", "0.306", "0.056", "0.094", "0.002"],
        ["0.994", "0.618", "0.456", "0.525", "0.010"],
        ["0.999", "-", "-", "-", "-"],
        ["0.995", "0.561", "0.251", "0.347", "0.004"],
    ]
    obstacle = next(line for line in table.splitlines() if line.split()[:1] == ["obstacle"])
    assert obstacle.split() == ["obstacle", "40.00%", "untrained", "0.600", "0.000", "-", "0.000", "0.571"]
    assert "- step on hill: no trajectory fails, so recall, precision and F1 are undefined" in table
    assert "obstacle on hill" not in table
    assert "- tilt in the paper: no sample fails, so its figures are undefined" in table


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([0.5], "0.500"),
        ([0.5, 0.5], "0.500"),
        ([0.25, 0.75], "0.500 ± 0.354"),
        ([0.5, math.nan], "-"),
    ],
)
def test_the_mean_of_seeds_with_their_spread(values, text):
    assert mean_and_spread(values) == text


def test_the_json_holds_every_epoch_and_can_be_read_by_any_reader():
    made = loads(json.dumps(results_json(results()), allow_nan=False))
    seed = made["arms"]["random"]["1"]
    assert seed["best_epoch"] == {"hill": 1, "plain": 2, ALL: 2}
    assert seed["validation_epoch"] == 2
    assert [epoch["number"] for epoch in seed["epochs"]] == [0, 1, 2]
    assert seed["epochs"][1]["held_out"]["hill"]["obstacle"]["tp"] == 2
    assert set(seed["epochs"][1]["held_out"]["hill"]) == set(NAMES)
    assert seed["epochs"][0]["held_out"]["hill"]["step"]["f1"] is None
    assert made["always_fails"]["hill"]["obstacle"]["tp"] == 4


# ---- The figure


def test_the_f1_of_each_arm_is_drawn_with_the_band_of_its_seeds_and_the_predictor_that_always_fails(tmp_path):
    rows = results().arms["random"]
    made = Results({"random": rows, "ImageNet": {0: rows[1]}})
    figure = transfer_figure(made, {"random": "tab:gray", "ImageNet": "tab:blue"})
    image = pixels(figure, tmp_path)
    assert [ax.get_title().split(":")[0] for ax in figure.axes] == made.sites
    for ax, site in zip(figure.axes, made.sites, strict=True):
        drawn = labelled_lines(ax)
        f1 = made.f1("random", site)
        np.testing.assert_allclose(drawn["random"], ([0, 1, 2], f1.mean(axis=0)))
        np.testing.assert_allclose(drawn["ImageNet"][1], f1[1])
        assert set(drawn["always fails"][1]) == {made.always(site).f1}
        band = ax.collections[0].get_paths()[0].vertices
        for epoch in range(3):
            edges = band[band[:, 0] == epoch, 1]
            assert (edges.min(), edges.max()) == pytest.approx((f1[:, epoch].min(), f1[:, epoch].max()))
        assert colours(within(ax, image)) > 20
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == [*made.arms, "always fails"]
