"""Lattices and averages of points, what is left out of them, and sizes that are refused."""

import numpy as np
import pytest

from tests.points import CELL, SMALL, cloud, points_of, read, refusal, saved, uneven, write_text
from travjax.data.dem import load_dem
from travjax.simulation.grid import Grid

# ---- Lattices


def test_x_is_east_and_y_is_north_and_z_is_up(tmp_path):
    (tmp_path / "site.xyz").write_text("10 20 1\n10.1 20 2\n10.2 20 3\n10 20.1 4\n10.1 20.1 5\n10.2 20.1 6\n")
    raster = read(tmp_path / "site.xyz", grid=Grid(0.1, 0.1))
    assert raster.heights.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert raster.origin == (10, 20)
    assert raster.cell_size == pytest.approx(0.1, abs=1e-12)


@pytest.mark.parametrize(
    ("cell", "form"),
    [
        (0.1, "%.2f"),
        (1 / 12, "%.3f"),
        (0.0625, "%.3f"),
        (0.125, "%.2f"),
        (0.05, "%.2f"),
        (0.0625, "%.2f"),
        (0.1, "%.17g"),
        (1 / 12, "%.17g"),
    ],
)
def test_a_lattice_is_found_although_its_coordinates_are_rounded(tmp_path, cell, form):
    heights = np.round(uneven(60, 80))
    raster = read(write_text(tmp_path / "site.xyz", points_of(heights, cell, 431_000.1, 5_203_000.7), form=form))
    np.testing.assert_array_equal(raster.heights, heights)
    assert raster.cell_size == (pytest.approx(cell, abs=1e-3 / 60) if cell == 1 / 12 else cell)
    np.testing.assert_allclose(raster.origin, (431_000.1, 5_203_000.7), rtol=0, atol=0.005)


def test_a_lattice_may_lack_rows_and_columns_and_be_computed_with_rounding_errors(tmp_path):
    heights = uneven(40, 50)
    heights[10:15], heights[:, [3, 20, 21, 22]] = np.nan, np.nan
    points = points_of(heights, 0.1)
    points[::2, :2] = points[::2, :2] * 3 / 3 + 1e-9
    raster = read(saved(tmp_path, points))
    np.testing.assert_array_equal(raster.heights, heights)


@pytest.mark.parametrize("kind", ["cells that are not square", "sparse millimetres", "jitter"])
def test_points_on_no_lattice_are_averaged(tmp_path, kind):
    points = points_of(np.zeros((40, 40)), 0.05)
    millimetres = np.round(cloud(2500), 3)
    millimetres = millimetres[np.unique(millimetres[:, :2], axis=0, return_index=True)[1]]
    points = {
        "cells that are not square": points * [1, 1.3, 1],
        "sparse millimetres": millimetres,
        "jitter": points + 0.02 * np.random.default_rng(1).random((1600, 1))[:, [0, 0, 0]],
    }[kind]
    raster = read(saved(tmp_path, points), cell_size=0.2)
    assert raster.cell_size == 0.2
    np.testing.assert_allclose(np.array(raster.origin) / 0.2, np.round(np.array(raster.origin) / 0.2), atol=1e-9)


def test_a_lattice_may_lack_half_of_its_nodes(tmp_path):
    heights = KERB.copy()
    heights[np.random.default_rng(0).random(KERB.shape) < 0.5] = np.nan
    np.testing.assert_array_equal(read(saved(tmp_path, points_of(heights, CELL))).heights, heights)


def test_a_cell_size_that_contradicts_a_lattice_is_refused(tmp_path):
    path = saved(tmp_path, points_of(uneven(20, 20), 0.1))
    assert refusal(path, cell_size=0.05) == "cell_size = 0.05: must be left out: the file says 0.1"
    assert read(path, cell_size=0.1).cell_size == pytest.approx(0.1)


# ---- Lattices with something else among them

KERB = np.where(np.arange(161) // 2 == 30, 0.15, 0.0) * np.ones((161, 1)) + 1.0
"""10 x 10 m with a kerb of 0.15 m."""

LATTICE = points_of(KERB, CELL, 431_000, 5_203_000)
SOME = np.random.default_rng(5).permutation(len(LATTICE))
ZEROS = np.zeros((300, 3))
REPEATED = LATTICE[SOME[:500]]
OFF_NODES = LATTICE[SOME[500:900]] + [0.02, 0.013, 0.3]
BIRDS = LATTICE[SOME[900:905]] + [0, 0, 2.5]
OTHER_HEIGHTS = LATTICE[SOME[1000:1400]] + [0, 0, 0.04]
FAR = np.array([[431_400.0, 5_203_004.0, 1.0], [431_005.0, 5_202_000.0, 3.0]])
AMONG = {
    "one repeated": (REPEATED[:1], "1 point repeated exactly: taken once"),
    "many repeated": (REPEATED, "500 points repeated exactly: taken once"),
    "all repeated": (LATTICE, "25921 points repeated exactly: taken once"),
    "rows at the borders of tiles": (LATTICE[LATTICE[:, 1] == 5_203_004], "161 points repeated exactly: taken once"),
    "off the nodes": (OFF_NODES, "400 points off the lattice of 0.0625 m left out"),
    "noise": (BIRDS, "5 of 25921 nodes of the lattice hold several heights: their mean is taken"),
    "other heights": (OTHER_HEIGHTS, "400 of 25921 nodes of the lattice hold several heights: their mean is taken"),
    "invalid returns": (ZEROS, "points at exactly (0, 0, 0) are invalid returns: left out"),
    "far away": (FAR, "2 points apart from all others left out, as at x, y = 431005, 5202000, 1000 m beside the site"),
    "all of these": (
        np.vstack([REPEATED, OFF_NODES, BIRDS, OTHER_HEIGHTS, ZEROS, FAR]),
        "405 of 25921 nodes of the lattice hold several heights: their mean is taken",
    ),
}
"""What else a file holds, and the line that says so."""


@pytest.mark.parametrize("among", AMONG)
def test_a_lattice_stays_one_whatever_a_few_points_are(tmp_path, among):
    others, note = AMONG[among]
    raster = read(saved(tmp_path, np.random.default_rng(1).permutation(np.vstack([LATTICE, others]))))
    assert raster.cell_size == CELL
    assert raster.origin == (431_000, 5_203_000)
    different = np.abs(raster.heights - KERB) > 1e-9
    assert np.count_nonzero(different) == {"noise": 5, "other heights": 400, "all of these": 405}.get(among, 0)
    assert any(line.startswith(note) for line in raster.notes)
    nodes = different.copy()
    nodes[:, 1:] |= different[:, :-1]
    steps = np.abs(np.diff(raster.heights, axis=1))[~nodes[:, 1:]]
    np.testing.assert_allclose(steps[steps > 1e-9], 0.15, rtol=0, atol=1e-9)


def test_a_clean_lattice_has_no_notes(tmp_path):
    assert read(saved(tmp_path, LATTICE)).notes == ()


def test_heights_of_a_shared_node_are_averaged_without_repeats(tmp_path):
    node = LATTICE[7]
    others = node + np.array([[0, 0, 0.3], [0, 0, 0.3], [0, 0, 0.6]])
    raster = read(saved(tmp_path, np.vstack([LATTICE, others])))
    col, row = np.rint((node[:2] - raster.origin) / CELL).astype(int)
    assert raster.heights[row, col] == pytest.approx(node[2] + 0.3, abs=1e-9)


def test_two_lattices_of_the_same_nodes_that_overlap_stay_one(tmp_path):
    east = points_of(KERB[:, :100], CELL)
    west = points_of(KERB[:, 70:] + 0.02, CELL, 70 * CELL)
    raster = read(saved(tmp_path, np.vstack([east, west])))
    np.testing.assert_allclose(raster.heights[:, :70], KERB[:, :70], rtol=0, atol=1e-9)
    np.testing.assert_allclose(raster.heights[:, 70:100], KERB[:, 70:100] + 0.01, rtol=0, atol=1e-9)


def test_invalid_returns_within_a_site_are_left_out(tmp_path):
    around = points_of(KERB, CELL, -5, -5)
    raster = read(saved(tmp_path, np.vstack([around, ZEROS])))
    np.testing.assert_array_equal(raster.heights, KERB)
    assert "points at exactly (0, 0, 0) are invalid returns: left out" in raster.notes
    scattered = cloud(9000, at=(-1, -1))
    clean = read(saved(tmp_path, scattered))
    np.testing.assert_array_equal(read(saved(tmp_path, np.vstack([scattered, ZEROS]))).heights, clean.heights)


def test_ground_at_the_origin_is_kept(tmp_path):
    raster = read(saved(tmp_path, points_of(KERB - 1, CELL)))
    np.testing.assert_array_equal(raster.heights, KERB - 1)
    assert raster.notes == ()


# ---- Points apart


@pytest.mark.parametrize("away", [(990, 990), (-60, 4), (4, 1e6), (4, -25)])
def test_a_stray_point_is_left_out_and_named(tmp_path, away):
    points = cloud(20_000, 9.0)
    path = saved(tmp_path, np.vstack([points, [*away, 2.0]]))
    raster = read(path, grid=Grid(8.0, CELL))
    np.testing.assert_array_equal(raster.heights, read(saved(tmp_path, points), grid=Grid(8.0, CELL)).heights)
    assert raster.notes[0].startswith(
        f"1 point apart from all others left out, as at x, y = {away[0]:.10g}, {away[1]:.10g}, "
    )
    assert len(load_dem(path, grid=Grid(8.0, CELL), allow_coarse=True).heights) == 1


def test_points_beside_the_site_are_kept(tmp_path):
    points = cloud(20_000, 9.0)
    raster = read(saved(tmp_path, np.vstack([points, [14.0, 4.0, 2.0]])), grid=Grid(8.0, CELL))
    assert raster.notes == ()
    assert raster.heights.shape[1] > 14 / raster.cell_size - 1


def test_a_second_site_is_kept(tmp_path):
    raster = read(saved(tmp_path, np.vstack([cloud(8000), cloud(2000, at=(30, 0))])))
    assert raster.notes == ()
    assert raster.heights.shape[1] > 30 / CELL


def test_points_that_are_sparse_as_a_whole_are_kept(tmp_path):
    coarse = points_of(uneven(40, 40), 1.0)
    assert read(saved(tmp_path, coarse)).heights.shape == (40, 40)


# ---- Coarse coordinates


def test_a_cloud_with_rounded_coordinates_is_refused_unless_its_cells_are_as_large(tmp_path):
    points = cloud(9000)
    path = saved(tmp_path, np.round(points * [10, 10, 1e3]) / [10, 10, 1e3])
    line = refusal(path)
    assert line.startswith("x = ")
    assert "is given in steps of 0.1 m, 95% of the points share their place: must be given to 0.01 m" in line
    assert read(path, 0.1).cell_size == 0.1
    assert read(saved(tmp_path, np.round(points, 2))).cell_size == CELL


def test_few_points_in_single_precision_are_refused_whatever_their_digits(tmp_path):
    points = cloud(3000, 12.0, at=(500_000, 5_200_000)).astype(np.float32).astype(float)
    line = refusal(write_text(tmp_path / "site.xyz", points, form="%.4f"))
    assert "is given in steps of 0.5 m" in line


def test_profiles_on_regular_lines_are_averaged(tmp_path):
    points = cloud(20_000)
    assert read(saved(tmp_path, np.round(points * [1e3, 10, 1e3]) / [1e3, 10, 1e3])).cell_size == CELL


def test_one_coordinate_of_six_digits_is_refused(tmp_path):
    points = cloud(9000, 12.0, at=(0, 5_200_000))
    line = refusal(write_text(tmp_path / "site.xyz", points, form="%.6g"))
    assert "is given in steps of 10 m" in line


def test_a_text_of_six_digits_is_refused(tmp_path):
    points = cloud(9000, 12.0, at=(500_000, 5_200_000))
    line = refusal(write_text(tmp_path / "site.xyz", points, form="%g"))
    assert line.startswith("y = 52000")
    assert "is given in steps of 10 m" in line


def test_so_few_points_that_hardly_a_cell_has_one_are_refused(tmp_path):
    strewn = np.random.default_rng(0).uniform(0, 400, (300, 3)) * [1, 1, 0]
    line = refusal(saved(tmp_path, np.vstack([cloud(2000), strewn])), cell_size=0.1)
    assert line.startswith("points = ")
    assert line.endswith(" cells of 0.1 m; are points astray?")


# ---- Averages


def averages(points: np.ndarray, cell: float) -> dict[tuple[float, float], float]:
    """Mean z by the centre x, y of the cell, a point at a time."""
    cells: dict[tuple[float, float], list[float]] = {}
    for x, y, z in points.tolist():
        centre = (round(cell * np.floor(x / cell + 0.5), 6), round(cell * np.floor(y / cell + 0.5), 6))
        cells.setdefault(centre, []).append(z)
    return {centre: float(np.mean(values)) for centre, values in cells.items()}


@pytest.mark.parametrize("at", [(0, 0), (-1.03, -7.77), (431_000.4, 5_203_000.9)])
@pytest.mark.parametrize("cell", [0.05, 0.0625, 0.11])
def test_a_cell_is_the_mean_of_its_points_and_unknown_without_any(tmp_path, cell, at):
    points = cloud(1500, at=at)
    raster = read(saved(tmp_path, points), cell)
    west, south = raster.origin
    found = {
        (round(west + cell * col, 6), round(south + cell * row, 6)): height
        for (row, col), height in np.ndenumerate(raster.heights)
        if not np.isnan(height)
    }
    assert found == pytest.approx(averages(points, cell), abs=1e-9)
    assert np.isnan(raster.heights).any()


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_the_points_does_not_matter(tmp_path, seed):
    points = cloud(1600, seed=seed)
    one = read(saved(tmp_path, points, "one"))
    other = read(saved(tmp_path, np.random.default_rng(seed).permutation(points), "other"))
    assert (one.origin, one.cell_size) == (other.origin, other.cell_size)
    np.testing.assert_allclose(one.heights, other.heights, rtol=0, atol=1e-12)


def test_detail_finer_than_a_cell_is_averaged_out_and_coarser_one_stays(tmp_path):
    x, y = 3 * np.random.default_rng(0).random((2, 100_000))
    coarse = lambda x: 0.1 * np.sin(2 * np.pi * x / 1.0)
    ripple = 0.1 * np.sin(2 * np.pi * x / 0.02)
    raster = read(saved(tmp_path, np.stack([x, y, coarse(x) + ripple], axis=1)))
    inner = raster.heights[1:-1, 1:-1]
    expected = coarse(raster.origin[0] + CELL * np.arange(1, raster.heights.shape[1] - 1))
    assert raster.cell_size == CELL
    # The nearest point alone would leave an error of 0.07 m; that of a mean of 43 points is 0.01 m.
    assert np.sqrt(np.mean((inner - expected) ** 2)) < 0.02
    assert np.std(inner) > 0.06


def test_a_finer_lattice_is_smoothed_before_it_is_sampled(tmp_path):
    x, y = np.meshgrid(0.0125 * np.arange(300), 0.0125 * np.arange(300))
    coarse, ripple = 0.1 * np.sin(2 * np.pi * x / 1.0), 0.1 * np.sin(2 * np.pi * (x + 0.4 * y) / 0.045)
    path = saved(tmp_path, points_of(coarse + ripple, 0.0125))
    windows = load_dem(path, grid=Grid(3.0, CELL))
    assert windows.cell_size == pytest.approx(0.0125)
    expected = 0.1 * np.sin(2 * np.pi * CELL * np.arange(49))
    error = (windows.heights.astype(float) + windows.height_offset - expected)[:, 2:, 2:]
    assert np.sqrt(np.mean(error**2)) < 0.02  # the ripple's own is 0.07


@pytest.mark.parametrize(("density", "cell"), [(2000, CELL), (600, CELL), (200, 0.1), (50, 0.2), (2, 1.0)])
def test_cells_hold_two_points_on_average_and_are_no_finer_than_the_grid(tmp_path, density, cell):
    size = (8000 / density) ** 0.5
    raster = read(saved(tmp_path, cloud(8000, size)), grid=Grid(1.0, CELL))
    assert raster.cell_size == (cell if cell == CELL else pytest.approx(cell, rel=0.1))


def test_a_few_points_astray_do_not_coarsen_the_cells(tmp_path):
    astray = np.array([[60.0, 2.0, 2.0], [2.0, -40.0, 2.0]])
    assert read(saved(tmp_path, np.vstack([cloud(8000), astray]))).cell_size == CELL


def test_cells_without_points_are_small_holes_that_load_dem_fills(tmp_path):
    windows = load_dem(saved(tmp_path, cloud(60_000, 9.0)), grid=Grid(8.0, CELL))
    assert windows.heights.shape == (1, 129, 129)
    assert 0.03 < windows.filled < 0.2
    assert windows.unknown == 0
    x, y = windows.origins[0][:, None] + CELL * np.arange(129)
    truth = 2 + 0.4 * y[:, None] - 0.2 * x + 0.3 * np.sin(5 * x)
    # Slopes of up to 1.7: a mean stands at its points' middle, 0.01 m beside the node.
    assert np.sqrt(np.mean((windows.heights[0] + windows.height_offset - truth) ** 2)) < 0.03


# ---- Sizes


def test_too_few_points_for_a_window_are_refused(tmp_path):
    line = refusal(saved(tmp_path, cloud(40)), cell_size=0.1)
    assert line == "points = 40: must be at least 64, as many as a window has cells"


def test_points_too_far_apart_are_refused_unless_coarse_cells_are_allowed(tmp_path):
    path = saved(tmp_path, cloud(3000, 8.0))
    line = refusal(path)
    assert line.startswith("cell_size = 0.2")
    assert "must be at most 0.125 m (--allow-coarse takes it)" in line
    assert len(load_dem(path, 1.0, grid=SMALL, allow_coarse=True).heights)


def test_an_absurd_extent_is_refused(tmp_path):
    path = saved(tmp_path, np.vstack([cloud(8000), cloud(8000, at=(4e6, 5e6))]))
    line = refusal(path)
    assert line.startswith("size = 4e+06 x 5e+06 m: must be at most 268435456 nodes of 0.0625 m")
    assert "is a point astray?" in line
