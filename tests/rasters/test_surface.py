"""The ground at the nodes of maps: what resampling keeps and takes away, small holes, and tiles."""

import numpy as np
import pytest

from travjax.rasters.holes import SmallHoles
from travjax.rasters.raster import Raster
from travjax.rasters.surface import Surface

SPACING = 0.0625


def wave(length: float, cell: float, turn: float, size: float = 6.0) -> np.ndarray:
    """A wave of amplitude 1 m and this length, running `turn` radians from east: [rows, cols], rows a third longer."""
    x, y = np.meshgrid(cell * np.arange(round(size / cell)), cell * np.arange(round(4 / 3 * size / cell)))
    return np.sin(2 * np.pi * (np.cos(turn) * x + np.sin(turn) * y) / length)


def nodes(heights: np.ndarray, cell: float, fill_holes: bool = True) -> np.ndarray:
    """All nodes of a raster's surface, from its south-west one on: [rows, cols]."""
    surface = Surface(Raster(heights, cell), SPACING, 0.0, fill_holes)
    edge = min(surface.shape)
    rows, cols = (range(0, max(count - edge, 0) + 1) for count in surface.shape)
    whole = np.full(surface.shape, np.nan)
    for row in {0, rows[-1]}:
        for col in {0, cols[-1]}:
            whole[row : row + edge, col : col + edge] = surface.nodes(slice(row, row + edge), slice(col, col + edge))
    return whole


def inside(heights: np.ndarray) -> np.ndarray:
    """Away from the border, where a wave goes on."""
    return heights[4:-4, 4:-4]


# ---- Anti-aliasing


@pytest.mark.parametrize("turn", [0.0, 0.6, np.pi / 2])
@pytest.mark.parametrize("cell", [0.01, 0.015625, 0.02])
def test_waves_that_the_new_spacing_cannot_show_are_taken_away(cell, turn):
    for length in (0.04, 0.05, 0.0625):
        left = inside(nodes(wave(length, cell, turn), cell))
        assert np.abs(left).max() < 0.2
        assert abs(left.mean()) < 0.01


@pytest.mark.parametrize("turn", [0.0, 0.6, np.pi / 2])
@pytest.mark.parametrize("cell", [0.01, 0.02, 0.05])
def test_waves_of_many_nodes_stay(cell, turn):
    found = nodes(wave(1.0, cell, turn), cell)
    expected = wave(1.0, SPACING, turn)[: found.shape[0], : found.shape[1]]
    np.testing.assert_allclose(inside(found), inside(expected), rtol=0, atol=0.03)


def test_picking_values_would_show_a_wave_that_is_not_there():
    assert np.abs(inside(wave(0.06, 0.0125, 0.0)[::5, ::5])).max() > 0.9


@pytest.mark.parametrize("cell", [0.0125, 0.05, 0.0625, 0.1, 0.125])
def test_resampling_keeps_the_place_of_the_south_west_value(cell):
    heights = np.arange(100.0)[:, None] * cell + 2 * np.arange(120.0) * cell
    found = nodes(heights, cell)
    rows, cols = found.shape
    assert (rows - 1) * SPACING <= 99 * cell + 1e-9 < rows * SPACING
    assert (cols - 1) * SPACING <= 119 * cell + 1e-9 < cols * SPACING
    expected = np.arange(rows)[:, None] * SPACING + 2 * np.arange(cols) * SPACING
    np.testing.assert_allclose(inside(found), inside(expected), rtol=0, atol=1e-6)


# ---- Holes


def test_small_holes_are_filled_and_counted_and_others_stay():
    heights = 0.3 * np.arange(20.0)[:, None] + 0.1 * np.arange(30.0)
    holed = heights.copy()
    holed[5, 5] = holed[8:10, 12:20] = np.nan
    holed[14:19, 3:8] = np.nan
    assert Surface(Raster(holed, SPACING), SPACING, 0.0, True).filled == 17
    found = nodes(holed, SPACING)
    np.testing.assert_allclose(found[:14], heights[:14], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(np.isnan(found[14:]), np.isnan(holed[14:]))
    np.testing.assert_array_equal(np.isnan(nodes(holed, SPACING, False)), np.isnan(holed))


@pytest.mark.parametrize(("cell", "wide"), [(0.0625, 4), (0.1, 2), (0.125, 2), (0.25, 2), (0.5, 2)])
def test_a_hole_is_filled_up_to_0_125_m_or_a_cell_from_known_ground(cell, wide):
    heights = np.zeros((40, 40))
    heights[10, 10] = heights[20:30, 20 : 20 + wide] = np.nan
    holes = SmallHoles(heights, cell)
    assert holes.count == 1 + 10 * wide
    assert holes.within(slice(0, 20), slice(0, 40))[10, 10]
    assert holes.within(slice(30, 40), slice(0, 40)) is None
    heights[20:30, 20 + wide] = np.nan
    assert SmallHoles(heights, cell).count == 1


# ---- Tiles


def rough(rows: int, cols: int, unknown: float) -> np.ndarray:
    random = np.random.default_rng(3)
    heights = random.normal(0, 0.1, (rows, cols)) + np.arange(cols) * 0.05
    heights[random.random((rows, cols)) < unknown] = np.nan
    heights[20:40, 7:60] = np.nan
    return heights


@pytest.mark.parametrize("cell", [0.0625, 0.02, 0.1, 0.3])
@pytest.mark.parametrize("unknown", [0.0, 0.03, 0.25])
def test_tiles_and_parts_of_any_size_are_the_raster_made_at_once(monkeypatch, cell, unknown):
    heights = rough(150, 190, unknown)
    whole = nodes(heights, cell)
    monkeypatch.setattr("travjax.rasters.surface.TILE", 37)
    monkeypatch.setattr("travjax.rasters.raster.PART", 190 * 11)
    np.testing.assert_allclose(nodes(heights, cell), whole, rtol=0, atol=1e-6)


def test_a_hole_over_many_parts_is_judged_as_one(monkeypatch):
    heights = np.zeros((60, 30))
    heights[2:50, 10:12] = heights[50:58, 5:20] = np.nan  # a crack that ends in a pit
    heights[2:50, 20] = np.nan
    monkeypatch.setattr("travjax.rasters.raster.PART", 30 * 4)
    assert SmallHoles(heights, SPACING).count == 0
    heights[50, 5:20] = 0
    assert SmallHoles(heights, SPACING).count == 48 * 3


def test_windows_over_tiles_are_cut_from_them(monkeypatch):
    heights = np.arange(100 * 120.0).reshape(100, 120)
    monkeypatch.setattr("travjax.rasters.surface.TILE", 16)
    surface = Surface(Raster(heights, SPACING), SPACING, 5.0, True)
    for row, col in ((0, 0), (15, 15), (16, 31), (59, 79), (3, 70)):
        expected = (heights[row : row + 41, col : col + 41] - 5).astype(np.float32)
        np.testing.assert_array_equal(surface.nodes(slice(row, row + 41), slice(col, col + 41)), expected)
