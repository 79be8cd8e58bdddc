"""Printed tables against numbers worked out by hand."""

import re

import numpy as np
import pytest

from travjax.report import PAPER_SHARES, rows_table, shares_table

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
