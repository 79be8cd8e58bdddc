"""Point clouds of every format against rasters, what is left out of them, and the one line for each bad file."""

import sys

import numpy as np
import pytest

from tests.points import (
    CELL,
    CLOUDS,
    MESHES,
    SMALL,
    SOUTH,
    WEST,
    cloud,
    line_of,
    points_of,
    read,
    refusal,
    saved,
    uneven,
    write_ply,
    write_text,
)
from travjax.config import InputError
from travjax.point_clouds.clouds import SUFFIXES, cloud_of_arrays
from travjax.rasters.reading_options import DemOptions


@pytest.mark.parametrize("form", CLOUDS)
def test_points_of_a_raster_are_that_raster_in_every_format(tmp_path, form):
    name, write = CLOUDS[form]
    heights = uneven(19, 23)
    heights[3:9, 5:7] = np.nan
    raster = read(write(tmp_path / name, points_of(heights, CELL, WEST, SOUTH)))
    np.testing.assert_array_equal(raster.heights, heights)
    assert raster.cell_size == CELL
    assert raster.origin == (WEST, SOUTH)
    assert raster.crs is None


# ---- What is left out


@pytest.mark.parametrize("form", CLOUDS)
@pytest.mark.parametrize("mark", [-9999, 0.5])
def test_points_with_the_missing_value_are_unknown(tmp_path, form, mark):
    name, write = CLOUDS[form]
    heights = uneven(20, 24) + 1
    marked = heights.copy()
    marked[4:8, 4:8], heights[4:8, 4:8] = mark, np.nan
    path = write(tmp_path / name, points_of(marked, CELL))
    np.testing.assert_array_equal(read(path, nodata=mark).heights, heights)


@pytest.mark.parametrize("nodata", [-99.9, -3.4028235e38])
def test_a_missing_value_is_found_in_single_precision(tmp_path, nodata):
    heights = uneven(20, 24)
    heights[4:8, 4:8] = nodata
    raster = read(write_ply(tmp_path / "site.ply", points_of(heights, CELL), "f4"), nodata=nodata)
    assert np.isnan(raster.heights).sum() == 16


def test_points_without_a_height_are_left_out_wherever_they_are(tmp_path):
    heights = uneven(20, 24)
    nothing = np.full((5, 3), np.nan)
    path = saved(tmp_path, np.vstack([points_of(heights, CELL), nothing, [[1e9, 0, np.nan]]]))
    np.testing.assert_array_equal(read(path).heights, heights)
    text = write_text(tmp_path / "site.xyz", np.vstack([[[1, 1, np.nan]], points_of(heights, CELL), nothing]))
    np.testing.assert_array_equal(read(text).heights, heights)


def test_heights_are_scaled(tmp_path):
    heights = uneven(20, 24)
    path = saved(tmp_path, points_of(heights * 1000, CELL))
    np.testing.assert_allclose(read(path, scale=0.001).heights, heights, rtol=0, atol=1e-12)


# ---- Arrays of an .npz file


def in_arrays(arrays: dict, **options):
    return cloud_of_arrays({name: np.asarray(value) for name, value in arrays.items()}, DemOptions(**options), SMALL)


def test_points_in_arrays_are_that_raster(tmp_path):
    heights = uneven(19, 23)
    points = points_of(heights, CELL, 500_000, 5_200_000)
    x, y, z = points.T
    for arrays in ({"points": points}, {"x": x, "y": y, "z": z}, {"z": z, "points": points}):
        raster = in_arrays(arrays | {"crs": "EPSG:32632"})
        np.testing.assert_array_equal(raster.heights, heights)
        assert raster.origin == (500_000, 5_200_000)
        assert raster.crs == "EPSG:32632"
    raster = in_arrays({"points": points, "classification": np.where(np.arange(len(points)) < 40, 5, 2)})
    assert np.isnan(raster.heights).sum() == 40


@pytest.mark.parametrize(
    ("arrays", "line"),
    [
        ({"a": [1.0]}, "no array `points`, nor x, y, z; it holds: a"),
        ({}, "no array `points`, nor x, y, z; it holds: nothing"),
        ({"points": np.zeros((4, 2))}, "points: float64 [4, 2]: must be numbers [n, 3]"),
        ({"points": np.array([["a", "b", "c"]])}, "points: <U1 [1, 3]: must be numbers [n, 3]"),
        ({"x": [1.0], "y": [1.0, 2.0], "z": [1.0]}, "y: float64 [2]: must be numbers [n], as many as x"),
        ({"x": [1.0], "y": [1.0], "z": [1j]}, "z: complex128 [1]: must be numbers [n], as many as x"),
        ({"points": np.zeros((4, 3)), "classification": [1, 2]}, "classification: int64 [2]: must be numbers [n]"),
        ({"points": np.zeros((2, 3)), "classification": [1, 300]}, "classification: must be whole numbers from 0"),
        ({"points": cloud(2000) + [500_000, 7_000_000, 0], "crs": "EPSG:3857"}, "crs = EPSG:3857: a metre on the"),
        ({"points": cloud(2000), "crs": "EPSG:4978"}, "crs = EPSG:4978: is geocentric"),
        ({"points": cloud(2000), "crs": "no system"}, "crs: cannot be understood: "),
        ({"points": np.zeros((0, 3))}, "heights: all unknown"),
    ],
)
def test_arrays_that_are_no_cloud_are_refused(arrays, line):
    with pytest.raises(InputError) as raised:
        in_arrays(arrays)
    assert str(raised.value).startswith(line)


@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f2", ">f2"])
def test_types_too_coarse_for_the_coordinates_are_refused_in_either_byte_order(kind):
    points = cloud(2000, 8.0, at=(5000.0 if "2" in kind else 500_000.0, 0))
    with pytest.raises(InputError, match=r"^x = \d+: is stored in steps of .* m \(float"):
        in_arrays({"points": points.astype(kind)})


@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f8", ">f8"])
def test_either_byte_order_is_read(kind):
    heights = uneven(19, 23)
    np.testing.assert_array_equal(in_arrays({"points": points_of(heights, CELL).astype(kind)}).heights, heights)


# ---- Which axis is up


@pytest.mark.parametrize("form", ["XYZ", "PLY", "LAS", "PCD"])
def test_a_cloud_whose_y_points_up_is_turned_when_told_and_named_when_not(tmp_path, form):
    name, write = CLOUDS[form]
    x, y = np.meshgrid(CELL * np.arange(40), CELL * np.arange(50))
    heights = np.round((0.02 * x + 0.03 * np.sin(3 * y)) * 128) / 128
    points = points_of(heights, CELL, 3.0, -2.0)
    path = write(tmp_path / name, points[:, [0, 2, 1]] * [1, 1, -1])  # x east, y up, z south
    raster = read(path, up="y")
    np.testing.assert_array_equal(raster.heights, heights)
    assert raster.origin == (3.0, -2.0)
    assert raster.notes == ()
    assert line_of(path).endswith("; its points lie flat along x and z: if y points up, say so (--up=y)")


def test_high_ground_whose_y_points_up_gets_a_line(tmp_path):
    x, y = np.meshgrid(0.2 * np.arange(200), 0.2 * np.arange(200))
    points = points_of(5 * np.sin(x / 9) * np.cos(y / 7), 0.2)[:, [0, 2, 1]] * [1, 1, -1]
    raster = read(saved(tmp_path, points), cell_size=0.2)
    assert raster.notes[0] == "its points lie flat along x and z: if y points up, say so (--up=y)"


@pytest.mark.parametrize("slope", [0.0, 0.2, 0.45])
def test_slopes_are_not_taken_for_clouds_whose_y_points_up(tmp_path, slope):
    x, y, z = cloud(20_000, 4.0).T
    assert read(saved(tmp_path, np.stack([x, y, 0.1 * z + slope * y], axis=1))).notes == ()
    assert read(saved(tmp_path, np.stack([x, y / 2, 0.1 * z + slope * y], axis=1))).notes == ()


# ---- Systems


@pytest.mark.parametrize("scale", [1e-6, 1e-9, 0.0])
def test_clouds_of_no_size_are_refused(tmp_path, scale):
    for at in (0, 5e5):
        assert refusal(saved(tmp_path, cloud(3000) * [scale, scale, 1] + [at, at, 0])).startswith(
            ("x, y = ", "size = ")
        )


# ---- Bad input


@pytest.mark.parametrize("form", [form for form in CLOUDS if form not in ("XYZ", "text", "CSV")])
@pytest.mark.parametrize("share", [0.001, 0.02, 0.5, 0.9, 0.999])
def test_a_cloud_cut_short_is_refused(tmp_path, form, share):
    name, write = CLOUDS[form]
    path = write(tmp_path / name, points_of(uneven(40, 50), CELL))
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert "read" in refusal(path) or "cut short" in refusal(path)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan, 1e300])
def test_coordinates_that_are_not_finite_are_refused(tmp_path, axis, value):
    points = cloud(500)
    points[7, axis] = value
    assert refusal(saved(tmp_path, points)) == f"{'xy'[axis]} = {value:g}: must be finite, below 1e9 m"


@pytest.mark.parametrize("value", [np.inf, -np.inf, 1e6, -9999, -99_999, -32_768])
@pytest.mark.parametrize("form", ["PLY", "XYZ"])
def test_heights_that_are_none_are_refused_before_they_are_averaged(tmp_path, form, value):
    name, write = CLOUDS[form]
    points = cloud(2000)
    points[7, 2] = value
    line = refusal(write(tmp_path / name, points))
    assert line.startswith(f"heights = {value:g}: ")
    assert "--nodata" in line


def test_coordinates_that_look_like_degrees_are_refused(tmp_path):
    degrees = cloud(2000) * [1e-5, 1e-5, 1] + [8.54, 47.37, 0]
    line = refusal(saved(tmp_path, degrees))
    assert line.startswith("x, y = 8.54")
    assert "look like degrees; must be metres" in line
    assert refusal(saved(tmp_path, degrees + [431_000, 0, 0])).startswith("size = 1.99")


def test_a_cloud_smaller_than_a_window_is_refused(tmp_path):
    assert refusal(saved(tmp_path, cloud(2000, 0.9))).startswith("size = 0.89")
    assert refusal(saved(tmp_path, cloud(2000) * [1, 0, 1])).startswith("size = 1.99")
    assert refusal(saved(tmp_path, cloud(1))).startswith("x, y = ")


@pytest.mark.parametrize(
    ("cell", "line"), [(1e-5, "134217728 cells of 1e-05 m"), (1000, "268435456 nodes of 0.0625 m")]
)
def test_cells_and_nodes_are_bounded_before_memory_is_taken(tmp_path, cell, line):
    path = saved(tmp_path, cloud(8000, 2.0 if cell < 1 else 40_000.0))
    assert line in refusal(path, cell_size=cell, allow_coarse=True)


@pytest.mark.parametrize(
    ("form", "module", "package"),
    [
        ("OBJ", "trimesh", "trimesh"),
        ("LAS", "laspy", "'laspy[lazrs]'"),
        ("LAZ", "laspy", "'laspy[lazrs]'"),
        ("LAZ", "lazrs", "lazrs"),
    ],
)
def test_a_missing_library_is_named_with_what_to_install(tmp_path, monkeypatch, form, module, package):
    name, write = (CLOUDS | MESHES)[form]
    path = write(tmp_path / name, points_of(uneven(20, 24), CELL))
    monkeypatch.setitem(sys.modules, module, None)
    assert refusal(path) == f"reading it needs {module}: pip install {package}"


def test_text_ply_and_pcd_need_no_library(tmp_path, monkeypatch):
    heights = uneven(20, 24)
    paths = [
        write(tmp_path / name, points_of(heights, CELL))
        for name, write in (CLOUDS[form] for form in ("XYZ", "PLY", "PLY in text", "PCD", "PCD, compressed"))
    ]
    for module in ("plyfile", "laspy", "lazrs", "rasterio", "trimesh"):
        monkeypatch.setitem(sys.modules, module, None)
    for path in paths:
        np.testing.assert_array_equal(read(path).heights, heights)


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    for suffix in SUFFIXES:
        assert refusal(tmp_path / f"none{suffix}") == "no such file"
        (tmp_path / f"folder{suffix}").mkdir()
        assert refusal(tmp_path / f"folder{suffix}") == "is a folder; allowed: a file"
