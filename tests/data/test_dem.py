"""Real elevation maps: axes, origins, windows, resampling, holes, and the one line for each file that is none."""

import hashlib
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from hypothesis import assume, given
from hypothesis import strategies as st

import travjax
from tests.points import CLOUDS, points_of
from travjax.config import InputError
from travjax.data.dem import load_dem
from travjax.rasters.formats import OTHERS
from travjax.simulation.grid import Grid

CELL = 0.0625
NODES = 129
WEST, SOUTH = 5000.25, 7000.5
"""Metres: the centre of the south-west value of the files made here, unless they say otherwise."""


def write_geotiff(path: Path, heights: np.ndarray, cell: float = CELL, **options) -> Path:
    """Heights [rows, cols] with row 0 in the south, or bands [n, rows, cols] of them, as a GeoTIFF."""
    bands = heights if heights.ndim == 3 else heights[None]
    north = SOUTH + (bands.shape[1] - 1) * cell
    profile = dict(
        driver="GTiff",
        width=bands.shape[2],
        height=bands.shape[1],
        count=len(bands),
        dtype=bands.dtype,
        transform=Affine(cell, 0, WEST - cell / 2, 0, -cell, north + cell / 2),
    )
    tags = options.pop("tags", {})
    with rasterio.open(path, "w", **profile | options) as file:
        file.update_tags(**tags)
        file.write(bands[:, ::-1])
    return path


def write_ascii(path: Path, heights: np.ndarray, cell: float = CELL, **header) -> Path:
    """Heights [rows, cols] with row 0 in the south as an ESRI ASCII grid; other header lines replace these."""
    fields = dict(ncols=heights.shape[1], nrows=heights.shape[0], xllcorner=WEST - cell / 2, yllcorner=SOUTH - cell / 2)
    lines = [f"{key} {value}" for key, value in (fields | dict(cellsize=cell) | header).items() if value is not None]
    lines += [" ".join(f"{value:.9g}" for value in row) for row in heights[::-1]]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_npz(path: Path, heights: np.ndarray, cell: float = CELL, **arrays) -> Path:
    np.savez(path, **dict(heights=heights, cell_size=cell, origin=(WEST, SOUTH)) | arrays)
    return path


def write_npy(path: Path, heights: np.ndarray) -> Path:
    np.save(path, heights)
    return path


FORMATS: dict[str, Callable] = {"tif": write_geotiff, "asc": write_ascii, "npz": write_npz, "npy": write_npy}


def absolute(windows) -> np.ndarray:
    """Heights as they stand in the file, float64."""
    return windows.heights.astype(np.float64) + windows.height_offset


def uneven(rows: int, cols: int) -> np.ndarray:
    """A map whose values are all different, exact in float32 even after an offset was subtracted."""
    return (np.random.default_rng(0).permutation(rows * cols).reshape(rows, cols) / 64).astype(np.float32)


def nodes(windows, grid: Grid = Grid()) -> tuple[np.ndarray, np.ndarray]:
    """x and y of all nodes of all windows, as origins and the grid say: [n, rows, cols] each."""
    along = grid.spacing * np.arange(grid.nodes)
    x, y = windows.origins.T[..., None, None]
    return np.broadcast_arrays(x + along, y + along[:, None])


# ---- Axes, origins, windows


def write_png(path: Path, heights: np.ndarray) -> Path:
    """16 bits, in units of 1/64 m."""
    from PIL import Image

    Image.fromarray((64 * heights[::-1]).astype(np.uint16)).save(path)
    return path


EVERY_FORMAT: dict[str, tuple[str, Callable, dict]] = {
    "GeoTIFF": ("site.tif", write_geotiff, {}),
    "ASCII grid": ("site.asc", write_ascii, {}),
    "npz": ("site.npz", write_npz, {}),
    "npy": ("site.npy", write_npy, {"cell_size": CELL}),
    "16-bit PNG": ("site.png", write_png, {"cell_size": CELL, "height_scale": 1 / 64}),
} | {
    form: (name, lambda path, heights, write=write: write(path, points_of(heights, CELL, WEST, SOUTH)), {})
    for form, (name, write) in CLOUDS.items()
}
"""A file name, a writer and how the file is to be read."""


@pytest.mark.parametrize("form", EVERY_FORMAT)
def test_rows_go_north_and_columns_east_in_every_format(tmp_path, form):
    name, write, options = EVERY_FORMAT[form]
    heights = uneven(NODES + 3, NODES + 7)
    windows = load_dem(write(tmp_path / name, heights), stride=0.125, **options)
    assert len(windows.heights) == 2 * 4
    for one, (x, y) in zip(absolute(windows), windows.origins - windows.origins[0], strict=True):
        row, col = round(y / CELL), round(x / CELL)
        np.testing.assert_array_equal(one, heights[row : row + NODES, col : col + NODES])
    placed = (0, 0) if "cell_size" in options else (WEST, SOUTH)
    np.testing.assert_allclose(windows.origins[0], placed, rtol=0, atol=1e-9)
    assert windows.origins[1].tolist() == pytest.approx([placed[0] + 0.125, placed[1]], abs=1e-9)


def test_the_last_line_of_an_ascii_grid_is_the_southernmost_row(tmp_path):
    path = tmp_path / "site.asc"
    path.write_text("ncols 3\nnrows 3\nxllcorner 10\nyllcorner 20\ncellsize 0.0625\n7 8 9\n4 5 6\n1 2 3\n")
    windows = load_dem(path, grid=Grid(0.125, CELL))
    assert absolute(windows).tolist() == [[[1, 2, 3], [4, 5, 6], [7, 8, 9]]]
    assert windows.origins.tolist() == [[10.03125, 20.03125]]


def test_the_first_row_of_a_geotiff_is_the_northernmost(tmp_path):
    path = tmp_path / "site.tif"
    stored = np.array([[7, 8, 9], [4, 5, 6], [1, 2, 3]], np.float32)
    profile = dict(driver="GTiff", width=3, height=3, count=1, dtype="float32")
    with rasterio.open(path, "w", **profile, transform=Affine(CELL, 0, 10, 0, -CELL, 20.1875)) as file:
        file.write(stored, 1)
    windows = load_dem(path, grid=Grid(0.125, CELL))
    assert absolute(windows).tolist() == [[[1, 2, 3], [4, 5, 6], [7, 8, 9]]]
    assert windows.origins.tolist() == [[10.03125, 20.03125]]


def test_the_first_row_of_an_npy_is_the_southernmost(tmp_path):
    path = write_npy(tmp_path / "site.npy", np.arange(1, 10).reshape(3, 3))
    windows = load_dem(path, grid=Grid(0.125, CELL), cell_size=CELL)
    assert absolute(windows).tolist() == [[[1, 2, 3], [4, 5, 6], [7, 8, 9]]]


@pytest.mark.parametrize(
    "write",
    [
        lambda folder, heights: write_geotiff(folder / "site.tif", heights),
        lambda folder, heights: write_geotiff(folder / "site.tif", heights, tags={"AREA_OR_POINT": "Point"}),
        lambda folder, heights: write_ascii(folder / "site.asc", heights),
        lambda folder, heights: write_ascii(
            folder / "site.asc", heights, xllcorner=None, yllcorner=None, xllcenter=WEST, yllcenter=SOUTH
        ),
        lambda folder, heights: write_npz(folder / "site.npz", heights),
    ],
    ids=["GeoTIFF", "GeoTIFF of points", "ASCII grid by corner", "ASCII grid by centre", "npz"],
)
def test_an_origin_is_the_centre_of_the_south_west_value(tmp_path, write):
    windows = load_dem(write(tmp_path, uneven(NODES + 16, NODES + 32)), stride=1.0)
    expected = [[WEST + east, SOUTH + north] for north in (0, 1) for east in (0, 1, 2)]
    np.testing.assert_allclose(windows.origins, expected, rtol=0, atol=1e-9)
    assert windows.origins.dtype == np.float64


def test_a_file_without_a_place_has_its_origin_at_zero(tmp_path):
    assert load_dem(write_npy(tmp_path / "site.npy", uneven(129, 129)), cell_size=CELL).origins.tolist() == [[0, 0]]


@pytest.mark.parametrize(
    ("rows", "cols", "stride", "at_rows", "at_cols"),
    [
        (129, 129, 8, [0], [0]),
        (256, 256, 8, [0], [0]),
        (257, 257, 8, [0, 128], [0, 128]),
        (129, 385, 8, [0], [0, 128, 256]),
        (385, 200, 8, [0, 128, 256], [0]),
        (257, 193, 4, [0, 64, 128], [0, 64]),
        (256, 192, 4, [0, 64], [0]),
        (161, 129, 1.01, [0, 16, 32], [0]),
        (161, 129, 0.99, [0, 16, 32], [0]),
        (131, 130, 0.0625, [0, 1, 2], [0, 1]),
        (300, 300, 1000, [0], [0]),
    ],
)
def test_windows_start_in_the_south_west_and_partial_ones_are_dropped(tmp_path, rows, cols, stride, at_rows, at_cols):
    heights = uneven(rows, cols)
    windows = load_dem(write_geotiff(tmp_path / "site.tif", heights), stride)
    corners = [(row, col) for row in at_rows for col in at_cols]
    assert windows.heights.shape == (len(corners), NODES, NODES)
    for one, origin, (row, col) in zip(absolute(windows), windows.origins, corners, strict=True):
        np.testing.assert_array_equal(one, heights[row : row + NODES, col : col + NODES])
        np.testing.assert_allclose(origin, [WEST + CELL * col, SOUTH + CELL * row], rtol=0, atol=1e-9)


def test_the_stride_is_8_m_unless_given(tmp_path):
    windows = load_dem(write_geotiff(tmp_path / "site.tif", uneven(257, 257)))
    assert np.ptp(windows.origins, axis=0).tolist() == [8, 8]


@pytest.mark.parametrize("grid", [Grid(2.0, CELL), Grid(3.0, 0.125), Grid(8.0, 0.03125)])
def test_windows_have_the_size_and_spacing_of_the_grid(tmp_path, grid):
    windows = load_dem(write_geotiff(tmp_path / "site.tif", uneven(140, 150)), 2.0, grid=grid)
    assert windows.heights.shape[1:] == grid.shape
    fitting = [int((cells * CELL - grid.size) / 2.0) + 1 for cells in (139, 149)]
    assert len(windows.heights) == fitting[0] * fitting[1]


def test_maps_of_a_3d_npz_are_cut_one_by_one(tmp_path):
    heights = np.stack([uneven(129, 257), uneven(129, 257) + 1000])
    windows = load_dem(write_npz(tmp_path / "maps.npz", heights))
    expected = np.stack([one[:, start : start + 129] for one in heights for start in (0, 128)])
    np.testing.assert_array_equal(absolute(windows), expected)
    np.testing.assert_allclose(windows.origins, [[WEST, SOUTH], [WEST + 8, SOUTH]] * 2, rtol=0, atol=1e-9)


# ---- Values


def test_values_at_the_same_spacing_come_through_unchanged(tmp_path):
    heights = np.random.default_rng(1).standard_normal((NODES, NODES)).astype(np.float32)
    windows = load_dem(write_geotiff(tmp_path / "site.tif", heights))
    assert windows.heights.dtype == np.float32
    assert windows.height_offset == 0
    np.testing.assert_array_equal(windows.heights[0], heights)


@pytest.mark.parametrize("dtype", ["int16", "int32", "uint8", "float32", "float64"])
@pytest.mark.parametrize("suffix", ["tif", "npz"])
def test_heights_of_every_number_type_are_read(tmp_path, suffix, dtype):
    heights = (uneven(NODES, NODES) * 64 % 200).astype(dtype)
    windows = load_dem(FORMATS[suffix](tmp_path / f"site.{suffix}", heights))
    np.testing.assert_array_equal(absolute(windows)[0], heights)


@pytest.mark.parametrize("cell", [CELL, 0.05])
def test_a_site_at_2000_m_keeps_millimetres(tmp_path, cell):
    relief = np.random.default_rng(2).uniform(-1e-3, 1e-3, (180, 180))
    windows = load_dem(write_npz(tmp_path / "high.npz", 2000.4 + relief, cell))
    low = load_dem(write_npz(tmp_path / "low.npz", 0.4 + relief, cell))
    assert windows.height_offset == 2000
    # float32 has steps of 3e-8 at 0.4 m and of 1.2e-4 at 2000 m
    np.testing.assert_allclose(windows.heights, low.heights, rtol=0, atol=1e-7)
    assert windows.heights.std() > 3e-4


def test_the_height_offset_is_shared_by_all_windows(tmp_path):
    heights = np.zeros((129, 257)) + np.where(np.arange(257) < 128, 500.0, 560.0)
    windows = load_dem(write_npz(tmp_path / "site.npz", heights))
    assert windows.heights[1].mean() - windows.heights[0, :, :128].mean() == pytest.approx(60, abs=1e-3)


@pytest.mark.parametrize("cell", [0.094, 0.03, 0.05, 0.0625, 0.125, 0.1])
def test_a_plane_at_another_spacing_stays_that_plane(tmp_path, cell):
    count = round(19 / cell)
    along = cell * np.arange(count)
    plane = lambda x, y: 3 + 0.3 * (y - SOUTH) - 0.2 * (x - WEST)
    windows = load_dem(write_npz(tmp_path / "site.npz", plane(WEST + along, SOUTH + along[:, None]), cell))
    assert len(windows.heights) == 4
    assert windows.cell_size == cell
    # Smoothing reaches 2 values of 0.03 m (4 standard deviations of half a cell) beyond the file's edge: 3 nodes.
    # Elsewhere all that is left is the rounding of heights under 8 m to float32.
    inner = np.s_[:, 3:, 3:]
    np.testing.assert_allclose(absolute(windows)[inner], plane(*nodes(windows))[inner], rtol=0, atol=1e-6)


def test_resampling_does_not_lift_the_edge_of_a_slope_by_more_than_its_rise_over_one_cell(tmp_path):
    slope = 0.3 * 0.03 * np.arange(300)[:, None] * np.ones(300)
    windows = load_dem(write_npz(tmp_path / "site.npz", slope, 0.03))
    expected = 0.3 * CELL * np.arange(NODES)[:, None] * np.ones(NODES)
    np.testing.assert_allclose(absolute(windows)[0], expected, rtol=0, atol=0.3 * 0.03)


def test_coarser_values_stay_and_the_nodes_between_are_bilinear(tmp_path):
    heights = np.random.default_rng(3).standard_normal((65, 65))
    between = load_dem(write_npz(tmp_path / "site.npz", heights, 0.125))
    one = absolute(between)[0]
    np.testing.assert_allclose(one[::2, ::2], heights, rtol=0, atol=1e-6)
    np.testing.assert_allclose(one[1::2, ::2], (heights[1:] + heights[:-1]) / 2, rtol=0, atol=1e-6)
    np.testing.assert_allclose(one[::2, 1::2], (heights[:, 1:] + heights[:, :-1]) / 2, rtol=0, atol=1e-6)
    centre = (heights[1:, 1:] + heights[1:, :-1] + heights[:-1, 1:] + heights[:-1, :-1]) / 4
    np.testing.assert_allclose(one[1::2, 1::2], centre, rtol=0, atol=1e-6)


def test_a_finer_source_is_smoothed_before_it_is_sampled(tmp_path):
    noise = np.random.default_rng(4).standard_normal((290, 290))
    windows = load_dem(write_npz(tmp_path / "site.npz", noise, 0.03))
    # Bilinear sampling alone leaves (2/3)^2 = 0.44 of the variance on average; the mean of a 0.0625 m square 0.23.
    assert 0.1 < windows.heights.var() < 0.3
    assert abs(absolute(windows).mean() - noise.mean()) < 0.03


def test_checksum_and_path_tell_the_file(tmp_path):
    path = write_geotiff(tmp_path / "site.tif", uneven(NODES, NODES))
    windows = load_dem(str(path))
    assert windows.path == str(path)
    assert windows.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_load_dem_is_public():
    assert travjax.load_dem is load_dem


# ---- Unknown ground


def patchy() -> np.ndarray:
    """A map with an unknown square of 1 m, too large to be filled."""
    heights = uneven(NODES, NODES)
    heights[30:46, 50:66] = np.nan
    return heights


@pytest.mark.parametrize(
    ("write", "options"),
    [
        (lambda folder, marked: write_geotiff(folder / "a.tif", marked(np.nan)), {}),
        (lambda folder, marked: write_geotiff(folder / "a.tif", marked(np.nan), nodata=np.nan), {}),
        (lambda folder, marked: write_geotiff(folder / "a.tif", marked(-9999), nodata=-9999), {}),
        (lambda folder, marked: write_geotiff(folder / "a.tif", marked(-3.4e38), nodata=np.float32(-3.4e38)), {}),
        (lambda folder, marked: write_geotiff(folder / "a.tif", marked(-9999)), {"nodata": -9999}),
        (lambda folder, marked: write_geotiff(folder / "a.tif", marked(0)), {"nodata": 0}),
        (lambda folder, marked: write_ascii(folder / "a.asc", marked(-9999), NODATA_value=-9999), {}),
        (lambda folder, marked: write_npz(folder / "a.npz", marked(np.nan)), {}),
        (lambda folder, marked: write_npz(folder / "a.npz", marked(-32768)), {"nodata": -32768}),
        (lambda folder, marked: write_npy(folder / "a.npy", marked(1e20)), {"nodata": 1e20, "cell_size": CELL}),
    ],
    ids=[
        "NaN in a GeoTIFF",
        "NaN declared",
        "-9999 declared",
        "-3.4e38 declared",
        "-9999 given",
        "0 given",
        "-9999 declared in an ASCII grid",
        "NaN in an npz",
        "-32768 given for an npz",
        "1e20 given for an npy",
    ],
)
def test_missing_values_become_nan(tmp_path, write, options):
    heights = patchy() + 1
    marked = lambda value: np.where(np.isnan(heights), value, heights).astype(np.float32)
    options = {name: float(np.float32(value)) for name, value in options.items()}
    windows = load_dem(write(tmp_path, marked), **options)
    np.testing.assert_array_equal(absolute(windows)[0], heights)
    assert windows.unknown == pytest.approx(16 * 16 / NODES**2, rel=1e-12)
    assert windows.filled == 0


def test_a_declared_and_a_given_missing_value_both_count(tmp_path):
    heights = patchy() + 1
    marked = np.where(np.isnan(heights), -9999, heights).astype(np.float32)
    marked[100:116, 10:26] = 0
    windows = load_dem(write_geotiff(tmp_path / "site.tif", marked, nodata=-9999), nodata=0)
    assert windows.unknown == pytest.approx(2 * 16 * 16 / NODES**2, rel=1e-12)


def test_whole_numbers_with_a_missing_value_become_nan(tmp_path):
    heights = np.random.default_rng(5).integers(0, 100, (NODES, NODES)).astype(np.int16)
    heights[30:46, 50:66] = -32768
    windows = load_dem(write_geotiff(tmp_path / "site.tif", heights, nodata=-32768))
    np.testing.assert_array_equal(np.isnan(windows.heights[0]), heights == -32768)


def test_a_node_between_coarser_values_is_unknown_where_one_of_them_is(tmp_path):
    heights = np.random.default_rng(6).standard_normal((65, 65))
    heights[20:30, 40:44] = np.nan
    windows = load_dem(write_npz(tmp_path / "site.npz", heights, 0.125), fill_holes=False)
    expected = np.zeros((NODES, NODES), bool)
    expected[2 * 20 - 1 : 2 * 29 + 2, 2 * 40 - 1 : 2 * 43 + 2] = True
    np.testing.assert_array_equal(np.isnan(windows.heights[0]), expected)


def test_smoothing_takes_nothing_from_unknown_ground(tmp_path):
    along = 0.03 * np.arange(290)
    heights = 5 + 0.3 * along[:, None] - 0.2 * along
    heights[100:140, 60:100] = np.nan
    windows = load_dem(write_npz(tmp_path / "site.npz", heights, 0.03))
    x, y = nodes(windows)
    error = np.abs(absolute(windows) - (5 + 0.3 * (y - SOUTH) - 0.2 * (x - WEST)))[0, 3:, 3:]
    # 1.2 m of unknown ground, and a node's distance around it at most
    assert (1.2 / CELL - 2) ** 2 < np.isnan(error).sum() < (1.2 / CELL + 2) ** 2
    assert np.nanmax(error) < 0.3 * 0.03


# ---- Holes


def holes_of(unknown: np.ndarray) -> list[list[tuple[int, int]]]:
    """The 8-connected groups of unknown nodes, by flood fill."""
    left = {(int(row), int(col)) for row, col in np.argwhere(unknown)}
    groups = []
    while left:
        group, frontier = [], [left.pop()]
        while frontier:
            row, col = frontier.pop()
            group.append((row, col))
            near = {(row + down, col + right) for down in (-1, 0, 1) for right in (-1, 0, 1)} & left
            left -= near
            frontier.extend(near)
        groups.append(group)
    return groups


def is_filled(hole: list[tuple[int, int]], known: np.ndarray, cell: float) -> bool:
    """Whether every node of a hole lies within 0.125 m of a known node; `known` holds rows and columns [k, 2]."""
    return all((np.hypot(*(known - node).T) * cell).min() <= 0.125 + 1e-9 for node in hole)


def around(hole: list[tuple[int, int]], unknown: np.ndarray) -> list[tuple[int, int]]:
    """The known nodes that touch a hole."""
    near = {(row + down, col + right) for row, col in hole for down in (-1, 0, 1) for right in (-1, 0, 1)}
    rows, cols = unknown.shape
    return [(row, col) for row, col in near if 0 <= row < rows and 0 <= col < cols and not unknown[row, col]]


def inside(hole: list[tuple[int, int]], shape: tuple[int, int]) -> bool:
    """Whether a hole stays off the map's border."""
    return all(0 < row < shape[0] - 1 and 0 < col < shape[1] - 1 for row, col in hole)


EDGE = 22
"""Values along the edge of the maps with random holes."""


@st.composite
def random_holes(draw) -> np.ndarray:
    """Unknown nodes: single ones, thin and thick bars, alone or grown together."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    unknown = random.random((EDGE, EDGE)) < draw(st.sampled_from([0.0, 0.02, 0.1, 0.3, 0.6]))
    for _ in range(draw(st.integers(0, 7))):
        row, col = random.integers(0, EDGE, 2)
        height, width = random.integers(1, [[7, 7], [2, 12], [12, 3]][random.integers(3)])
        unknown[row : row + height, col : col + width] = True
    assume(unknown.any() and not unknown.all())
    return unknown


def load_small(heights: np.ndarray, cell: float, **options):
    """Heights [22, 22] through a file, as one window at their own spacing."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_npz(Path(folder) / "site.npz", heights, cell)
        return load_dem(path, grid=Grid((EDGE - 1) * cell, cell), **options)


@given(unknown=random_holes(), cell=st.sampled_from([0.0625, 0.05, 0.094, 0.125, 0.03]))
def test_a_hole_is_filled_exactly_when_all_of_it_is_near_known_ground(unknown, cell):
    heights = np.where(unknown, np.nan, np.random.default_rng(0).uniform(-0.4, 0.4, unknown.shape))
    windows = load_small(heights, cell)
    one, known = absolute(windows)[0], np.argwhere(~unknown)
    np.testing.assert_array_equal(one[~unknown], heights[~unknown].astype(np.float32))
    filled = 0
    for hole in holes_of(unknown):
        values = [one[node] for node in hole]
        if is_filled(hole, known, cell):
            neighbours = [heights[node] for node in around(hole, unknown)]
            assert min(neighbours) - 1e-6 <= min(values) <= max(values) <= max(neighbours) + 1e-6
            filled += len(hole)
        else:
            assert np.isnan(values).all()
    assert windows.filled == pytest.approx(filled / unknown.size, abs=1e-12)
    assert windows.unknown == pytest.approx((unknown.sum() - filled) / unknown.size, abs=1e-12)


@given(unknown=random_holes(), cell=st.sampled_from([0.0625, 0.05, 0.03]))
def test_a_filled_hole_in_a_plane_inside_the_map_is_that_plane(unknown, cell):
    along = cell * np.arange(EDGE)
    plane = 0.4 * along[:, None] - 0.3 * along
    one = absolute(load_small(np.where(unknown, np.nan, plane), cell))[0]
    for hole in holes_of(unknown):
        if inside(hole, unknown.shape):
            values, expected = (np.array([field[node] for node in hole]) for field in (one, plane))
            np.testing.assert_allclose(values[~np.isnan(values)], expected[~np.isnan(values)], rtol=0, atol=1e-6)


@given(unknown=random_holes())
def test_holes_stay_when_they_are_not_to_be_filled(unknown):
    heights = np.where(unknown, np.nan, 0.25)
    windows = load_small(heights, CELL, fill_holes=False)
    np.testing.assert_array_equal(absolute(windows)[0], heights)
    assert windows.filled == 0
    assert windows.unknown == pytest.approx(unknown.mean(), abs=1e-12)


@pytest.mark.parametrize(("width", "filled"), [(1, True), (4, True), (5, False)])
def test_a_long_gap_of_four_nodes_is_filled_and_one_of_five_is_not(tmp_path, width, filled):
    heights = uneven(NODES, NODES)
    heights[20 : 20 + width, 10:90] = np.nan
    windows = load_dem(write_npz(tmp_path / "site.npz", heights))
    assert np.isnan(windows.heights).any() != filled
    assert windows.filled == pytest.approx(filled * 80 * width / NODES**2, abs=1e-12)


def test_holes_that_touch_at_a_corner_are_one(tmp_path):
    heights = uneven(NODES, NODES)
    heights[20:30, 20:30] = np.nan
    heights[30, 30] = np.nan
    windows = load_dem(write_npz(tmp_path / "site.npz", heights))
    np.testing.assert_array_equal(np.isnan(windows.heights[0]), np.isnan(heights))


def test_holes_are_judged_in_the_file_before_it_is_resampled(tmp_path):
    heights = np.zeros((100, 100))
    heights[40, 40] = np.nan
    heights[60:63, 60:63] = np.nan
    windows = load_dem(write_npz(tmp_path / "site.npz", heights, 0.094))
    # The middle of 3 x 3 values of 0.094 m is 0.188 m from known ground, a single value 0.094 m.
    assert windows.filled == pytest.approx(1e-4, rel=1e-9)
    assert np.isnan(windows.heights).any()


@pytest.mark.parametrize("border", ["south", "north", "west", "east"])
@pytest.mark.parametrize("width", [1, 2])
def test_a_strip_missing_along_the_border_is_filled_from_the_ground_beside_it(tmp_path, border, width):
    hills = np.sin(np.arange(NODES) / 5) * np.ones((NODES, 1))
    heights = hills.copy()
    heights[:width, 1:-1] = np.nan
    turn = {"south": lambda z: z, "north": np.flipud, "west": np.transpose, "east": lambda z: np.fliplr(z.T)}[border]
    windows = load_dem(write_npz(tmp_path / "site.npz", turn(heights)))
    # The hills run across the strip: the ground beside a node is as high, and rises at most 0.2 m in a cell.
    np.testing.assert_allclose(absolute(windows)[0], turn(hills), rtol=0, atol=0.2 * width)


# ---- Coordinate systems

LOCAL = 'LOCAL_CS["yard",UNIT["metre",1]]'


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:25832", LOCAL, None])
def test_a_system_in_metres_or_none_is_taken_and_named(tmp_path, crs):
    windows = load_dem(write_geotiff(tmp_path / "site.tif", uneven(NODES, NODES), crs=crs))
    if crs is None:
        assert windows.crs is None
    else:
        assert windows.crs.startswith(crs[:15])


def test_an_npz_names_its_system(tmp_path):
    path = write_npz(tmp_path / "site.npz", uneven(NODES, NODES), crs="EPSG:32632")
    assert load_dem(path).crs == "EPSG:32632"


# ---- Bad input


def refusal(path: Path, **options) -> str:
    """The one line that says what is wrong, less the name of the file that it starts with."""
    with pytest.raises(InputError) as raised:
        load_dem(path, **options)
    message = str(raised.value)
    assert message.startswith(f"{path}: ")
    assert len(message.splitlines()) == 1
    return message.removeprefix(f"{path}: ")


FLAT = np.zeros((NODES, NODES), np.float32)
WITH = lambda value: np.where(uneven(NODES, NODES) == 0, value, uneven(NODES, NODES)).astype(np.float32)


def test_a_missing_file_is_named(tmp_path):
    assert refusal(tmp_path / "none.tif") == "no such file"
    assert refusal(tmp_path / "none.npz") == "no such file"


@pytest.mark.parametrize("name", ["folder", "folder.tif", "folder.npz"])
def test_a_folder_is_no_elevation_map(tmp_path, name):
    (tmp_path / name).mkdir()
    assert refusal(tmp_path / name)


@pytest.mark.parametrize("content", ["", "not a map\nat all\n", "II*\0"])
@pytest.mark.parametrize("suffix", ["tif", "asc", "png", "e57"])
def test_a_text_is_no_raster(tmp_path, suffix, content):
    path = tmp_path / f"site.{suffix}"
    path.write_text(content)
    line = refusal(path)
    assert line.startswith("not a raster that can be read: ")
    if "not recognized" in line:
        assert f"; beside GDAL's formats: {OTHERS}" in line


@pytest.mark.parametrize("content", ["", "PK", "not a map\nat all\n"])
@pytest.mark.parametrize("suffix", ["npy", "npz"])
def test_a_text_is_no_array(tmp_path, suffix, content):
    path = tmp_path / f"site.{suffix}"
    path.write_text(content)
    assert "cannot be read" in refusal(path)


@pytest.mark.parametrize("share", [0.001, 0.02, 0.5, 0.99])
@pytest.mark.parametrize("suffix", ["tif", "npy", "npz"])
def test_a_file_cut_short_cannot_be_read(tmp_path, suffix, share):
    path = FORMATS[suffix](tmp_path / f"site.{suffix}", np.random.default_rng(0).standard_normal((NODES, NODES)))
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert "read" in refusal(path)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_a_damaged_npz_cannot_be_read(tmp_path, save):
    path = tmp_path / "site.npz"
    save(path, heights=np.random.default_rng(0).standard_normal((NODES, NODES)), cell_size=CELL)
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 64] = bytes(64)
    path.write_bytes(content)
    assert "cannot be read" in refusal(path)


@pytest.mark.parametrize("bands", [2, 3, 4])
def test_a_picture_is_no_elevation_map(tmp_path, bands):
    path = write_geotiff(tmp_path / "site.tif", np.zeros((bands, NODES, NODES), np.uint8))
    assert refusal(path).startswith(f"bands = {bands}: must be 1")


def test_a_photograph_is_no_elevation_map(tmp_path):
    from PIL import Image

    Image.fromarray(np.zeros((NODES, NODES, 3), np.uint8)).save(tmp_path / "photo.jpg")
    assert refusal(tmp_path / "photo.jpg", cell_size=CELL).startswith("bands = 3: must be 1")


def test_an_npz_without_heights_is_refused_with_what_it_holds(tmp_path):
    np.savez(tmp_path / "site.npz", z=FLAT, cell_size=CELL)
    assert refusal(tmp_path / "site.npz") == "no array `heights`; it holds: z, cell_size"
    np.savez(tmp_path / "site.npz")
    assert refusal(tmp_path / "site.npz") == "no array `heights`; it holds: nothing"


@pytest.mark.parametrize(
    ("heights", "dtype", "shape"),
    [
        (FLAT > 0, "bool", "[129, 129]"),
        (FLAT.astype(complex), "complex128", "[129, 129]"),
        (FLAT.astype("U4"), "<U4", "[129, 129]"),
        (FLAT.astype("M8[s]"), "datetime64", "[129, 129]"),
        (FLAT[0], "float32", "[129]"),
        (FLAT[0, 0], "float32", "[]"),
        (FLAT[None, None], "float32", "[1, 1, 129, 129]"),
        (FLAT[:0], "float32", "[0, 129]"),
        (FLAT[None][:0], "float32", "[0, 129, 129]"),
    ],
)
@pytest.mark.parametrize("suffix", ["npz", "npy"])
def test_an_array_of_another_type_or_shape_is_refused(tmp_path, suffix, heights, dtype, shape):
    message = refusal(FORMATS[suffix](tmp_path / f"site.{suffix}", heights), cell_size=CELL)
    assert message.startswith("heights: ")
    assert dtype in message
    assert shape in message


def test_arrays_that_would_run_code_are_refused(tmp_path):
    np.savez(tmp_path / "site.npz", heights=np.array([[{}]]), cell_size=CELL)
    assert refusal(tmp_path / "site.npz")


def test_complex_heights_of_a_raster_are_refused(tmp_path):
    assert "complex64" in refusal(write_geotiff(tmp_path / "site.tif", FLAT.astype(np.complex64)))


def test_a_missing_cell_size_is_said_to_be_missing(tmp_path):
    np.savez(tmp_path / "site.npz", heights=FLAT)
    for path in (tmp_path / "site.npz", write_npy(tmp_path / "site.npy", FLAT)):
        assert refusal(path).startswith("cell_size is missing: give it (--cell-size METRES)")


def test_a_raster_that_is_not_georeferenced_wants_a_cell_size(tmp_path):
    from PIL import Image

    heights = uneven(NODES, NODES) % 250
    Image.fromarray(heights[::-1].astype(np.uint8)).save(tmp_path / "site.png")
    assert refusal(tmp_path / "site.png", height_scale=0.5).startswith("cell_size is missing: ")
    assert refusal(tmp_path / "site.png", cell_size=CELL).startswith("height_scale is missing: a PNG holds no metres")
    windows = load_dem(tmp_path / "site.png", cell_size=CELL, height_scale=0.5)
    np.testing.assert_array_equal(absolute(windows)[0], 0.5 * np.floor(heights))
    assert windows.origins.tolist() == [[0, 0]]


def test_scale_and_offset_of_a_band_are_applied(tmp_path):
    millimetres = np.round(uneven(NODES, NODES) * 1000).astype(np.int32)
    path = write_geotiff(tmp_path / "site.tif", millimetres)
    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets = (0.001,), (100.0,)
    np.testing.assert_allclose(absolute(load_dem(path))[0], 100 + millimetres / 1000, rtol=0, atol=1e-5)


def test_a_system_in_feet_is_refused(tmp_path):
    for crs in ("EPSG:2263", 'LOCAL_CS["yard",UNIT["foot",0.3048]]'):
        path = write_geotiff(tmp_path / "site.tif", uneven(NODES, NODES), crs=crs)
        assert "is in units of 0.3048" in refusal(path)


def test_a_cell_size_that_contradicts_the_file_is_refused(tmp_path):
    for path in (
        write_geotiff(tmp_path / "site.tif", uneven(NODES, NODES)),
        write_npz(tmp_path / "site.npz", uneven(NODES, NODES)),
    ):
        assert refusal(path, cell_size=0.05) == "cell_size = 0.05: must be left out: the file says 0.0625"
        assert load_dem(path, cell_size=CELL).cell_size == CELL


def test_a_nodata_value_is_compared_as_the_file_holds_it(tmp_path):
    heights = uneven(NODES, NODES).astype(np.float32)
    heights[:40, :40] = -99.9
    windows = load_dem(write_geotiff(tmp_path / "site.tif", heights), nodata=-99.9)
    assert np.isnan(windows.heights[0, :30, :30]).all()
    assert np.isfinite(windows.heights[0, 45:, 45:]).all()


def test_maps_of_an_npz_keep_their_own_origins(tmp_path):
    heights = np.stack([uneven(NODES, NODES)] * 2)
    path = write_npz(tmp_path / "maps.npz", heights, origin=[[1.0, 2.0], [9.0, 2.0]], height_offset=[5.0, 7.0])
    windows = load_dem(path)
    assert windows.origins.tolist() == [[1, 2], [9, 2]]
    np.testing.assert_allclose(windows.heights[1] - windows.heights[0], 2, rtol=0, atol=1e-5)


def test_a_stride_below_the_spacing_is_refused(tmp_path):
    path = write_npz(tmp_path / "site.npz", uneven(NODES, NODES))
    with pytest.raises(InputError, match="^stride = 0.01: must be at least the spacing of the nodes, 0.0625 m$"):
        load_dem(path, stride=0.01)


@pytest.mark.parametrize("value", [0, -0.0625, np.nan, np.inf, 1001, "0.0625", [0.1, 0.2], True, 1j])
def test_a_bad_cell_size_in_an_npz_is_named(tmp_path, value):
    message = refusal(write_npz(tmp_path / "site.npz", FLAT, value))
    assert message.startswith("cell_size = ")
    assert "metres" in message
    assert str(np.asarray(value).tolist()).strip("'")[:4] in message


@pytest.mark.parametrize("value", [0, -0.0625, np.nan, np.inf, 1001, "0.0625", True])
def test_a_bad_cell_size_given_is_named(tmp_path, value):
    with pytest.raises(InputError, match=rf"^(.*: )?cell_size = {value!r}: must be metres, above 0 and at most 1000$"):
        load_dem(write_npy(tmp_path / "site.npy", FLAT), cell_size=value)


@pytest.mark.parametrize("origin", [(1, 2, 3), 1.0, (np.nan, 0), (np.inf, 0), ("west", "south"), (1j, 0)])
def test_a_bad_origin_in_an_npz_is_named(tmp_path, origin):
    message = refusal(write_npz(tmp_path / "site.npz", FLAT, origin=origin))
    assert message.startswith("origin = ")
    assert message.endswith("must be x, y of the south-west value")


@pytest.mark.parametrize("across", [0.07, 0.0626])
def test_cells_that_are_not_square_are_refused_with_both_sizes(tmp_path, across):
    path = write_geotiff(tmp_path / "site.tif", FLAT, transform=Affine(across, 0, 0, 0, -0.0625, 0))
    assert refusal(path) == f"cell_size = {across:g} x 0.0625: must be square"


@pytest.mark.parametrize(
    "transform",
    [
        Affine(0.06, 0.02, 0, 0.02, -0.06, 0),
        Affine(0, CELL, 0, CELL, 0, 0),
        Affine(-CELL, 0, 0, 0, -CELL, 0),
        Affine(-CELL, 0, 0, 0, CELL, 0),
    ],
    ids=["rotated", "on its side", "mirrored", "turned"],
)
def test_a_raster_that_does_not_run_east_or_is_rotated_is_refused(tmp_path, transform):
    message = refusal(write_geotiff(tmp_path / "site.tif", FLAT, transform=transform))
    assert message.startswith(f"transform = ({transform.a}, {transform.b}, ")
    assert message.endswith("must run east and south without rotation")


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:4258"])
def test_a_geographic_system_is_refused(tmp_path, crs):
    message = refusal(write_geotiff(tmp_path / "site.tif", FLAT, 1e-6, crs=crs))
    assert message.startswith(f"crs = {crs}: is in degrees")


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_map_without_known_ground_is_refused(tmp_path, suffix):
    options = dict(nodata=-9999, cell_size=CELL) if suffix == "npy" else dict(nodata=-9999)
    message = refusal(FORMATS[suffix](tmp_path / f"site.{suffix}", FLAT - 9999), **options)
    assert message.startswith("heights: all unknown")
    if suffix != "asc":
        path = FORMATS[suffix](tmp_path / f"site.{suffix}", FLAT * np.nan)
        assert refusal(path, **options).startswith("heights: all unknown")


@pytest.mark.parametrize(
    "value", [np.inf, -np.inf, 1e6, -1e6, -3.4028235e38, 1e20, 30_001, -12_001, -9999, -99_999, -32_768, 9999]
)
@pytest.mark.parametrize("suffix", ["tif", "npz"])
def test_heights_that_are_none_are_refused_by_value(tmp_path, suffix, value):
    message = refusal(FORMATS[suffix](tmp_path / f"site.{suffix}", WITH(value)))
    assert message.startswith(f"heights = {np.float32(value):g}: ")
    assert "--nodata" in message


@pytest.mark.parametrize("value", [30_000, -12_000, 9998])
def test_high_and_deep_heights_are_taken(tmp_path, value):
    windows = load_dem(write_npz(tmp_path / "site.npz", WITH(value)))
    assert (absolute(windows) == value).any()


@pytest.mark.parametrize(("rows", "cols"), [(128, 129), (129, 128), (40, 40), (1, 1)])
@pytest.mark.parametrize("suffix", ["tif", "npz"])
def test_a_map_smaller_than_a_window_is_refused_with_its_size(tmp_path, suffix, rows, cols):
    message = refusal(FORMATS[suffix](tmp_path / f"site.{suffix}", uneven(rows, cols)))
    assert message == f"size = {(cols - 1) * CELL:g} x {(rows - 1) * CELL:g} m: must be at least 8 x 8 m, node to node"


def test_a_map_that_falls_short_only_after_resampling_is_refused(tmp_path):
    message = refusal(write_npz(tmp_path / "site.npz", uneven(86, 85), 0.094))
    assert message.startswith("size = ")
    assert load_dem(write_npz(tmp_path / "site.npz", uneven(87, 87), 0.094)).heights.shape == (1, NODES, NODES)


@pytest.mark.parametrize("suffix", ["tif", "asc", "npz"])
def test_coarse_cells_are_refused_unless_allowed(tmp_path, suffix):
    path = FORMATS[suffix](tmp_path / f"site.{suffix}", uneven(90, 90), 0.2)
    message = refusal(path)
    assert message.startswith("cell_size = 0.2: must be at most 0.125 m")
    assert "--allow-coarse" in message
    assert load_dem(path, allow_coarse=True).heights.shape == (4, NODES, NODES)


@pytest.mark.parametrize("stride", [0, -8, np.nan, np.inf, 2e6, "8", None, True])
def test_a_bad_stride_is_refused(tmp_path, stride):
    path = write_npz(tmp_path / "site.npz", FLAT)
    with pytest.raises(InputError, match=rf"^stride = {stride!r}: must be a distance in metres, above 0"):
        load_dem(path, stride)


def test_a_raster_without_rasterio_is_refused_with_what_to_install(tmp_path, monkeypatch):
    raster, array = write_geotiff(tmp_path / "site.tif", FLAT), write_npz(tmp_path / "site.npz", FLAT)
    monkeypatch.setitem(sys.modules, "rasterio", None)
    message = refusal(raster)
    assert "rasterio" in message
    assert "pip install rasterio" in message
    assert len(load_dem(array).heights) == 1


# ---- A real file


def test_the_mars_yard_is_cut_into_windows():
    path = Path(os.environ.get("TRAVJAX_DATA", ""), "terrain", "mars_yard.tif")
    if "TRAVJAX_DATA" not in os.environ or not path.is_file():
        pytest.skip("needs terrain/mars_yard.tif in the folder that TRAVJAX_DATA names")
    windows = load_dem(path)
    with rasterio.open(path) as file:
        bounds, values = file.bounds, file.read(1)
    assert windows.cell_size == pytest.approx(0.094, abs=5e-4)
    assert windows.crs.startswith("EPSG:32")
    assert len(windows.heights) == int((bounds.right - bounds.left) / 8) * int((bounds.top - bounds.bottom) / 8)
    half = windows.cell_size / 2
    np.testing.assert_allclose(windows.origins[0], [bounds.left + half, bounds.bottom + half], rtol=0, atol=1e-6)
    # The south-west value is the file's, and bilinear values do not leave the range of the source.
    assert absolute(windows)[0, 0, 0] == pytest.approx(values[-1, 0], abs=1e-4)
    assert np.nanmin(values) - 1e-4 <= np.nanmin(absolute(windows)) < np.nanmax(absolute(windows))
    assert np.nanmax(absolute(windows)) <= np.nanmax(values) + 1e-4
