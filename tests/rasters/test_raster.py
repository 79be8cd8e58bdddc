"""Rasters: what holds for heights, sizes and cells of every format, and values as metres."""

import numpy as np
import pytest

from travjax.config import InputError
from travjax.rasters.raster import (
    InMetres,
    agreed_cell_size,
    as_stored,
    marks_nothing,
    parts,
    require_fine,
    require_heights,
    require_size,
    survey,
)
from travjax.simulation.grid import Grid


def line(check, *arguments) -> str:
    with pytest.raises(InputError) as raised:
        check(*arguments)
    assert len(str(raised.value).splitlines()) == 1
    return str(raised.value)


@pytest.mark.parametrize(
    ("heights", "start"),
    [
        ([], "heights: all unknown"),
        ([0, np.inf], "heights = inf: must lie between -12000 and 30000 m"),
        ([0, -12_001], "heights = -12001: must lie"),
        ([0, -9999], "heights = -9999: is a usual mark of unknown ground"),
        ([0, -9999.0000000001], "heights = -9999: is a usual mark of unknown ground"),
    ],
)
def test_heights_that_are_none_are_refused(heights, start):
    assert line(require_heights, np.array(heights, float)).startswith(start)


def test_heights_of_the_ground_are_taken():
    require_heights(np.array([-11_999.0, 29_999.0, -9998.9]))


def test_a_site_smaller_than_a_window_is_refused():
    assert line(require_size, 8.0, 7.9, Grid()) == "size = 8 x 7.9 m: must be at least 8 x 8 m, node to node"
    require_size(8.0, 8.0, Grid())


def test_a_cell_size_must_agree_with_the_files():
    assert agreed_cell_size(0.05, None) == agreed_cell_size(0.05, 0.05) == 0.05
    assert line(agreed_cell_size, 0.05, 0.06) == "cell_size = 0.06: must be left out: the file says 0.05"
    assert line(agreed_cell_size, 0.0, None).startswith("cell_size = 0.0: must be metres")


def test_coarse_cells_are_refused_unless_allowed():
    assert line(require_fine, 0.2, False).startswith("cell_size = 0.2: must be at most 0.125 m")
    require_fine(0.2, True)
    require_fine(0.125, False)


# ---- Values in metres

WHOLE = np.s_[0:2, 0:3]


def test_values_become_metres_and_unknown_ones_nan():
    values = np.array([[1, 2, 3], [4, 5, 6]], ">i2")
    unknown = np.array([[False, True, False], [False, False, False]])
    heights = InMetres(values, 0.5, 10.0, unknown, nodata=6)
    np.testing.assert_array_equal(heights[WHOLE], [[10.5, np.nan, 11.5], [12, 12.5, np.nan]])
    np.testing.assert_array_equal(heights[1:2, 0:2], [[12, 12.5]])
    assert heights.shape == (2, 3)
    assert heights[WHOLE].dtype == np.float64


def test_rows_that_run_south_are_turned():
    heights = InMetres(np.array([[1.0, 2], [3, 4]]), unknown=np.array([[True, False], [False, False]]), southern=False)
    np.testing.assert_array_equal(heights[0:2, 0:2], [[3, 4], [np.nan, 2]])


@pytest.mark.parametrize(
    ("nodata", "dtype", "stored"),
    [
        (65535, "i2", None),
        (65535, "u2", 65535),
        (-9999, "u1", None),
        (0.5, "i4", None),
        (1e10, "i4", None),
        (-32768, ">i2", -32768),
        (-99.9, "f4", np.float32(-99.9)),
        (1e300, "f4", None),
        (1e300, "f8", 1e300),
        (None, "f4", None),
    ],
)
def test_a_mark_that_the_number_type_cannot_hold_marks_nothing(nodata, dtype, stored):
    found = as_stored(nodata, np.dtype(dtype))
    assert (found is None) if stored is None else (found == stored)
    note = marks_nothing(nodata, np.dtype(dtype))
    assert bool(note) == (stored is None and nodata is not None)
    zeros = InMetres(np.zeros((2, 3), dtype), nodata=nodata)[WHOLE]
    assert not np.isnan(zeros).any()


# ---- Reading through


def test_parts_are_all_rows_once_with_those_beside_them(monkeypatch):
    monkeypatch.setattr("travjax.rasters.raster.PART", 12)
    heights = np.arange(44.0).reshape(11, 4)
    seen = []
    for rows, own, part in parts(heights, 2):
        np.testing.assert_array_equal(part[own], heights[rows])
        assert len(part) == min(rows.stop + 2, 11) - max(rows.start - 2, 0)
        seen.extend(range(rows.start, rows.stop))
    assert seen == list(range(11))


def test_a_survey_counts_and_measures_what_is_known(monkeypatch):
    monkeypatch.setattr("travjax.rasters.raster.PART", 12)
    heights = np.arange(44.0).reshape(11, 4)
    heights[0] = np.nan
    found = survey(heights)
    assert (found.known, found.lowest, found.highest, found.median) == (40, 4, 43, 23.5)
    assert survey(np.full((3, 3), np.nan)).known == 0
    heights[5, 2] = -9999
    assert line(survey, heights).startswith("heights = -9999: is a usual mark of unknown ground")
