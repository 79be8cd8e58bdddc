"""Rasters: what resampling keeps and takes away, and what holds for heights, sizes and coordinate systems."""

import numpy as np
import pytest
from rasterio.crs import CRS

from travjax.config import InputError
from travjax.grid import Grid
from travjax.raster import (
    Raster,
    agreed_cell_size,
    crs_name,
    require_heights,
    require_metric,
    require_size,
    resample,
    without_small_holes,
)

SPACING = 0.0625


def wave(length: float, cell: float, turn: float, size: float = 6.0) -> np.ndarray:
    """A wave of amplitude 1 m and this length, running `turn` radians from east: [rows, cols], rows a third longer."""
    x, y = np.meshgrid(cell * np.arange(round(size / cell)), cell * np.arange(round(4 / 3 * size / cell)))
    return np.sin(2 * np.pi * (np.cos(turn) * x + np.sin(turn) * y) / length)


def inside(raster: Raster) -> np.ndarray:
    """Away from the border, where a wave goes on."""
    return raster.heights[4:-4, 4:-4]


# ---- Anti-aliasing


@pytest.mark.parametrize("turn", [0.0, 0.6, np.pi / 2])
@pytest.mark.parametrize("cell", [0.01, 0.015625, 0.02])
def test_waves_that_the_new_spacing_cannot_show_are_taken_away(cell, turn):
    for length in (0.04, 0.05, 0.0625):
        left = inside(resample(Raster(wave(length, cell, turn), cell), SPACING))
        assert np.abs(left).max() < 0.2
        assert abs(left.mean()) < 0.01


@pytest.mark.parametrize("turn", [0.0, 0.6, np.pi / 2])
@pytest.mark.parametrize("cell", [0.01, 0.02, 0.05])
def test_waves_of_many_nodes_stay(cell, turn):
    raster = resample(Raster(wave(1.0, cell, turn), cell), SPACING)
    expected = Raster(wave(1.0, SPACING, turn), SPACING)
    rows, cols = raster.heights.shape
    np.testing.assert_allclose(inside(raster), expected.heights[:rows, :cols][4:-4, 4:-4], rtol=0, atol=0.03)


def test_picking_values_would_show_a_wave_that_is_not_there():
    picked = Raster(wave(0.06, 0.0125, 0.0)[::5, ::5], SPACING)
    assert np.abs(inside(picked)).max() > 0.9


@pytest.mark.parametrize("cell", [0.0125, 0.05, 0.0625, 0.1, 0.125])
def test_resampling_keeps_the_place_of_the_south_west_value(cell):
    heights = np.arange(100.0)[:, None] * cell + 2 * np.arange(120.0) * cell
    raster = resample(Raster(heights, cell, (3.0, 4.0), "EPSG:32632"), SPACING)
    assert (raster.origin, raster.cell_size, raster.crs) == (
        (3.0, 4.0),
        SPACING if cell != SPACING else cell,
        "EPSG:32632",
    )
    rows, cols = raster.heights.shape
    assert (rows - 1) * SPACING <= 99 * cell + 1e-9 < rows * SPACING
    assert (cols - 1) * SPACING <= 119 * cell + 1e-9 < cols * SPACING
    expected = np.arange(rows)[:, None] * SPACING + 2 * np.arange(cols) * SPACING
    np.testing.assert_allclose(inside(raster), expected[4:-4, 4:-4], rtol=0, atol=1e-6)


# ---- Holes


def test_small_holes_are_filled_and_counted_and_others_stay():
    heights = 0.3 * np.arange(20.0)[:, None] + 0.1 * np.arange(30.0)
    holed = heights.copy()
    holed[5, 5] = holed[8:10, 12:20] = np.nan
    holed[14:19, 3:8] = np.nan
    raster, filled = without_small_holes(Raster(holed, SPACING, (1.0, 2.0), "EPSG:32632"))
    assert filled == pytest.approx(17 / 600)
    np.testing.assert_allclose(raster.heights[:14], heights[:14], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(np.isnan(raster.heights[14:]), np.isnan(holed[14:]))
    assert (raster.cell_size, raster.origin, raster.crs) == (SPACING, (1.0, 2.0), "EPSG:32632")


def test_a_raster_without_holes_is_left_alone():
    whole, wide = np.zeros((20, 20)), np.zeros((20, 20))
    wide[5:15, 5:15] = np.nan
    for heights in (whole, wide):
        raster = Raster(heights, SPACING)
        assert without_small_holes(raster) == (raster, 0.0)


# ---- Checks


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


# ---- Coordinate systems


@pytest.mark.parametrize(
    ("system", "name"),
    [("EPSG:32632", "EPSG:32632"), ("EPSG:25832+7837", "EPSG:25832"), ("EPSG:5555", "EPSG:25832")],
)
def test_a_system_joined_with_one_of_heights_goes_by_its_own_name(system, name):
    crs = CRS.from_string(system)
    require_metric(crs, False)
    assert crs_name(crs) == name


def test_a_system_without_a_code_goes_by_its_text():
    assert str(crs_name(CRS.from_wkt('LOCAL_CS["yard",UNIT["metre",1]]'))).startswith('LOCAL_CS["yard"')
    assert crs_name(None) is None


@pytest.mark.parametrize(
    ("system", "start"),
    [
        ("EPSG:4326", "crs = EPSG:4326: is in degrees; reproject"),
        ("EPSG:2263", "crs = EPSG:2263: is in units of 0.3048"),
        ("EPSG:2263+6360", "crs = EPSG:2263: is in units of 0.3048"),
        ('LOCAL_CS["yard",UNIT["foot",0.3048]]', 'crs = "yard": is in units of 0.3048 m (foot)'),
    ],
)
@pytest.mark.parametrize("scaled", [True, False])
def test_degrees_and_feet_are_refused(system, start, scaled):
    assert line(require_metric, CRS.from_string(system), scaled).startswith(start)


def test_heights_in_feet_are_refused_unless_they_are_scaled():
    crs = CRS.from_string("EPSG:25832+6360")
    assert line(require_metric, crs, False).startswith("crs = EPSG:25832: has heights in units of 0.3048")
    require_metric(crs, True)
    require_metric(None, False)
