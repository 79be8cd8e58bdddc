"""Printed tables against numbers worked out by hand."""

import re

import numpy as np
import pytest

from travjax.evaluation.metrics import PAPER_REAL, PAPER_SYNTHETIC, evaluate
from travjax.evaluation.tables import (
    PAPER_SHARES,
    baselines_table,
    calibration_line,
    groups_table,
    metrics_table,
    paper_table,
    rows_table,
    shares_table,
    threshold_table,
)

STEP, OBSTACLE, TILT = range(3)
HEADINGS = ["", "maps", "step", "obstacle", "tilt", "any failure", "maps with none", "known"]


def cells(table: str) -> dict[str, list[str]]:
    """The lines of a table by their first cell, cut where the dashed line says that columns stand."""
    lines = table.splitlines()
    columns = [match.span() for match in re.finditer("-+", lines[1])]
    rows = [[line[start:end].strip() for start, end in columns] for line in lines if not line.startswith("--")]
    return {first: rest for first, *rest in rows}


def ten_trajectories(maps: int) -> tuple[np.ndarray, np.ndarray]:
    """No failures, all known: failed [maps, 10, 3], known [maps, 10]."""
    return np.zeros((maps, 10, 3), bool), np.ones((maps, 10), bool)


def test_shares_are_those_worked_out_by_hand():
    failed, known = ten_trajectories(4)
    failed[0, :1, STEP] = True  # map 0, rough: trajectory 0 fails by step and tilt, 1 to 3 by obstacle
    failed[0, :1, TILT] = True
    failed[0, 1:4, OBSTACLE] = True
    failed[2, 5:7, TILT] = True  # map 2, rough: two by tilt; maps 1 and 3, smooth: none
    table = cells(shares_table(["rough", "smooth", "rough", "smooth"], failed, known))
    assert table[""] == HEADINGS[1:]
    assert table["rough"] == ["2", "5.00%", "15.00%", "15.00%", "30.00%", "0.0%", "100.0%"]
    assert table["smooth"] == ["2", "0.00%", "0.00%", "0.00%", "0.00%", "100.0%", "100.0%"]
    assert table["overall"] == ["4", "2.50%", "7.50%", "7.50%", "15.00%", "50.0%", "100.0%"]


def test_unknown_trajectories_do_not_count():
    failed, known = ten_trajectories(2)
    known[0, 2:] = False
    failed[0, 0, STEP] = True
    table = cells(shares_table(["a", "b"], failed, known))
    assert table["a"] == ["1", "50.00%", "0.00%", "0.00%", "50.00%", "0.0%", "20.0%"]
    # 1 of the 12 known ones, not the mean of the maps' shares
    assert table["overall"] == ["2", "8.33%", "0.00%", "0.00%", "8.33%", "50.0%", "60.0%"]


def test_a_failure_of_an_unknown_trajectory_does_not_count():
    failed, known = ten_trajectories(1)
    known[0, 5:] = False
    failed[0, 5:] = True
    assert cells(shares_table(["a"], failed, known))["a"] == [
        "1",
        "0.00%",
        "0.00%",
        "0.00%",
        "0.00%",
        "100.0%",
        "50.0%",
    ]


def test_maps_without_known_trajectories_are_none_without_failures():
    failed, known = ten_trajectories(3)
    known[0] = False
    failed[1, 0, STEP] = True
    line = cells(shares_table(["a"] * 3, failed, known))["a"]
    assert line[HEADINGS.index("maps with none") - 1] == "50.0%"
    assert line[0] == "3"


def test_a_group_that_is_all_unknown_has_no_shares():
    failed, known = ten_trajectories(2)
    known[0] = False
    table = cells(shares_table(["dark", "bright"], failed, known))
    assert table["dark"] == ["1", "-", "-", "-", "-", "-", "0.0%"]
    assert table["overall"][1:5] == ["0.00%"] * 4


def test_the_papers_shares_stand_below():
    table = shares_table(["a"], *ten_trajectories(1))
    assert cells(table)["paper's test set"] == ["", "6.23%", "5.50%", "0.42%", "9.60%", "", ""]
    assert table.splitlines()[-1].startswith("paper's test set")
    assert PAPER_SHARES == {"step": 0.0623, "obstacle": 0.0550, "tilt": 0.0042, "any failure": 0.096}


@pytest.mark.parametrize("as_groups", [list, tuple, np.array])
def test_groups_stand_in_the_order_in_which_they_come(as_groups):
    failed, known = ten_trajectories(4)
    table = shares_table(as_groups(["wavy", "rough", "wavy", "a"]), failed, known)
    firsts = [line.split("  ")[0] for line in table.splitlines()[2:]]
    assert firsts == ["wavy", "rough", "a", "overall", "paper's test set"]


def test_one_group_needs_no_overall_line():
    assert "overall" not in shares_table(["a", "a"], *ten_trajectories(2))


def test_rows_have_the_headings_and_order_of_the_columns():
    rows = [{"a": "x", "b": 1, "unused": 9}, {"a": "y", "b": 2}]
    assert rows_table(rows, {"b": "second", "a": "first"}).split() == [
        *("second", "first"),
        *("--------", "-------"),
        *("1", "x", "2", "y"),
    ]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, ""),
        (0.0123456, "0.01235"),
        (1234.5678, "1,235"),
        (12345.678, "12,346"),
        (1234567, "1,234,567"),
        (0, "0"),
        (0.0, "0"),
        ("1.50", "1.50"),
    ],
)
def test_a_number_has_four_digits_and_none_is_blank(value, text):
    assert cells(rows_table([{"a": "row", "b": value}], {"a": "", "b": "a heading"}))["row"] == [text]


# ---- Evaluation


def ten_samples() -> tuple[np.ndarray, np.ndarray]:
    """Ten samples, step: four fail, three found and one false alarm; obstacle: two fail, none found; tilt: none."""
    probabilities, failed = np.full((10, 3), 0.1), np.zeros((10, 3), bool)
    failed[:4, STEP] = failed[:2, OBSTACLE] = True
    probabilities[1:4, STEP] = [0.9, 0.8, 0.7]
    probabilities[9, STEP] = 0.75
    probabilities[0, STEP] = 0.2
    return probabilities, failed


def lines(table: str) -> list[list[str]]:
    """The rows of a table, cut into cells; notes below it are left out."""
    shown = table.split("\n- ")[0].splitlines()
    rule = next(number for number, line in enumerate(shown) if line.startswith("--"))
    columns = [match.span() for match in re.finditer("-+", shown[rule])]
    return [[line[start:end].strip() for start, end in columns] for line in shown[rule + 1 :]]


def notes(table: str) -> list[str]:
    return table.split("\n- ")[1:]


def test_metrics_are_those_worked_out_by_hand():
    table = metrics_table(evaluate(*ten_samples()), paper=None)
    step, obstacle, tilt, overall = lines(table)
    # Failures stand at ranks 1, 2, 4 and 5: (1 + 1 + 3/4 + 4/5) / 4. Bins from the lowest, samples times distance:
    # (5 x 0.1 + 1 x 0.8 + 2 x |0.725 - 0.5| + 1 x 0.2 + 1 x 0.1) / 10.
    assert step[:8] == ["step", "0.800", "0.750", "0.750", "0.750", "40.00%", "0.887", "0.205"]
    assert step[8:] == ["5", "1", "1", "3"]
    assert obstacle == ["obstacle", "0.800", "0.000", "-", "0.000", "20.00%", "0.200", "0.100", "8", "0", "2", "0"]
    assert tilt == ["tilt", "1.000", "-", "-", "-", "0.00%", "-", "0.100", "10", "0", "0", "0"]
    assert overall[1:6] == ["0.867", "0.500", "0.750", "0.600", "20.00%"]
    assert overall[8:] == ["23", "1", "3", "3"]


def test_dashes_are_explained_below():
    assert notes(metrics_table(evaluate(*ten_samples()))) == [
        "obstacle: no sample is predicted to fail, so precision is undefined",
        "tilt: no sample fails, so the figures with a dash are undefined",
    ]
    probabilities, failed = ten_samples()
    failed[0] = True
    probabilities[0] = 0.6
    assert notes(metrics_table(evaluate(probabilities, failed))) == []
    real = notes(metrics_table(evaluate(probabilities, failed), PAPER_REAL))
    assert real == ["tilt in the paper: no sample fails, so the figures with a dash are undefined"]


def test_the_papers_figures_stand_below_each():
    rows = lines(metrics_table(evaluate(*ten_samples())))
    assert [row[0] for row in rows] == ["step", "paper", "obstacle", "paper", "tilt", "paper", "overall", "paper"]
    counts = ["3,126,951", "113,457", "13,615", "201,689"]
    assert rows[1][1:] == ["0.963", "0.937", "0.640", "0.760", "6.23%", "", "", *counts]
    assert rows[7][1:5] == ["0.980", "0.944", "0.684", "0.793"]
    real = lines(metrics_table(evaluate(*ten_samples()), PAPER_REAL))
    assert real[7][1:5] == ["0.995", "0.561", "0.251", "0.347"]
    assert real[5][1:5] == ["0.999", "-", "-", "-"]


def test_thresholds_are_those_worked_out_by_hand():
    table = threshold_table(evaluate(*ten_samples(), recalls=(0.5, 0.75)))
    rows = {(row[0], row[1]): row[2:] for row in lines(table)}
    assert rows["step", "0.500"] == ["0.8", "0.500", "1.000", "0.667", "20.00%", ""]
    assert rows["step", "0.750"] == ["0.7", "0.750", "0.750", "0.750", "40.00%", ""]
    assert rows["step", "0.937"] == ["0.2", "1.000", "0.800", "0.889", "50.00%", "0.640"]
    assert rows["obstacle", "0.949"] == ["0.1", "1.000", "0.200", "0.333", "100.00%", "0.770"]
    assert rows["tilt", "0.500"] == ["-", "-", "-", "-", "-", ""]
    assert rows["tilt", "0.989"][-1] == "0.474"
    assert rows["overall", "0.944"][-1] == "0.684"
    assert notes(table) == ["tilt: no sample fails, so the figures with a dash are undefined"]


def test_precision_and_recall_at_the_papers_are_those_worked_out_by_hand():
    table = paper_table(evaluate(*ten_samples()), PAPER_SYNTHETIC)
    assert {row[0]: row[1:] for row in lines(table)} == {
        "step": ["0.937", "0.640", "0.800", "1.000"],
        "obstacle": ["0.949", "0.770", "0.200", "0.000"],
        "tilt": ["0.989", "0.474", "-", "-"],
        "overall": ["0.944", "0.684", "0.200", "0.667"],
    }
    assert notes(table) == ["tilt: no sample fails, so the figures with a dash are undefined"]


@pytest.mark.parametrize(
    ("probability", "failures", "wanted"),
    [
        (0.5, 5, "right on average, 1.00 times the frequency"),
        (0.54, 5, "right on average, 1.08 times the frequency"),
        (0.6, 5, "too high on average, 1.20 times the frequency"),
        (0.4, 5, "too low on average, 0.80 times the frequency"),
        (0.4, 0, "too high on average, no sample fails"),
    ],
)
def test_calibration_says_what_was_measured(probability, failures, wanted):
    failed = np.zeros((10, 3), bool)
    failed[:failures] = True
    line = calibration_line(evaluate(np.full((10, 3), probability), failed, paper=None))
    assert f"step {probability:.4f} ({failures / 10:.4f}), obstacle " in line
    assert f"Overall the probabilities are {wanted}; reliability.png" in line and "\n" not in line


def test_calibration_of_each_event_is_its_own():
    probabilities, failed = np.tile([0.1, 0.2, 0.3], (10, 1)), np.zeros((10, 3), bool)
    failed[:2, OBSTACLE], failed[:1, TILT] = True, True
    line = calibration_line(evaluate(probabilities, failed, paper=None))
    assert "step 0.1000 (0.0000), obstacle 0.2000 (0.2000), tilt 0.3000 (0.1000), overall 0.2000 (0.1000). " in line


def test_a_name_is_one_line_of_a_table():
    failed, known = ten_trajectories(2)
    names = ["a\nb\x1b[31m", "\udcff" + "n" * 5000]
    lines = shares_table(names, failed, known, as_in_paper=False).splitlines()
    assert len(lines) == 5 and lines[2].startswith("a\\nb\\x1b[31m ")
    assert lines[3].startswith("\\udcffnn") and len(lines[3]) < 200
    lines.append(groups_table(evaluate(np.zeros((2, 3)), failed[:, 0], names, paper=None)))
    assert "\n".join(lines).replace("\n", " ").isprintable()


def test_groups_are_those_worked_out_by_hand():
    table = groups_table(evaluate(*ten_samples(), ["wavy"] * 5 + ["rough"] * 5))
    wavy, rough, everything = lines(table)
    assert wavy[:5] == ["wavy", "5", "80.00%", "40.00%", "0.00%"]
    assert wavy[5:9] == ["0.857", "0.000", "-", "0.667"]
    assert rough == ["rough", "5", "0.00%", "0.00%", "0.00%", *["-"] * 8]
    assert everything[:2] == ["all", "10"]
    assert everything[9:12] == ["0.887", "0.200", "-"]
    assert notes(table) == [
        "step: no sample fails in rough",
        "obstacle: no sample fails in rough",
        "tilt: no sample fails in wavy, rough, all",
    ]


def test_baselines_stand_with_their_average_precisions():
    probabilities, failed = ten_samples()
    predictors = {"network": probabilities, "constant": np.full((10, 3), 0.3)}
    table = baselines_table({name: evaluate(one, failed).average_precision for name, one in predictors.items()})
    network, constant = lines(table)
    assert network[:4] == ["network", "0.887", "0.200", "-"]
    assert constant == ["constant", "0.400", "0.200", "-", "0.200", "0.300"]
    assert notes(table) == ["tilt: no sample fails, so average precision is undefined"]
