"""Point clouds against rasters and a slow average, what is left out of them, and the one line for each bad file."""

import sys
from pathlib import Path

import laspy
import numpy as np
import pytest
from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct, WktCoordinateSystemVlr
from points import CLOUDS, MESHES, points_of, write_las, write_ply, write_text
from rasterio.crs import CRS

from travjax import las
from travjax.clouds import SUFFIXES, read_cloud
from travjax.config import InputError
from travjax.dem import load_dem
from travjax.dem_options import DemOptions
from travjax.grid import Grid

CELL = 0.0625
WEST, SOUTH = 5000.25, 7000.5
SMALL = Grid(1.0, CELL)
"""Windows of 17 x 17 nodes."""


def read(path: Path, cell_size=None, scale=None, nodata=None, grid: Grid = SMALL):
    return read_cloud(path, form_of(path), DemOptions(cell_size, scale, nodata), grid)


def form_of(path: Path) -> str:
    """What `read_cloud` is to be told about a file of a usual suffix."""
    forms = {".ply": "ply", ".las": "las", ".laz": "las", ".pcd": "pcd"}
    mesh = path.suffix.lower() in (".obj", ".stl", ".gltf", ".glb")
    return "mesh" if mesh else forms.get(path.suffix.lower(), "text")


def uneven(rows: int, cols: int) -> np.ndarray:
    """Values that are all different and multiples of 1/64."""
    return np.random.default_rng(0).permutation(rows * cols).reshape(rows, cols) / 64


def cloud(number: int, size: float = 2.0, seed: int = 0, at=(0.0, 0.0)) -> np.ndarray:
    """Points [n, 3] anywhere on a rough slope."""
    x, y = size * np.random.default_rng(seed).random((2, number))
    return np.stack([x + at[0], y + at[1], 2 + 0.4 * y - 0.2 * x + 0.3 * np.sin(5 * x)], axis=1)


def saved(folder: Path, points: np.ndarray, name: str = "site.npy") -> Path:
    """The fastest way to a file of arbitrary points: PLY in double precision."""
    return write_ply((folder / name).with_suffix(".ply"), points)


# ---- Lattices


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


def test_x_is_east_and_y_is_north_and_z_is_up(tmp_path):
    (tmp_path / "site.xyz").write_text("10 20 1\n10.1 20 2\n10.2 20 3\n10 20.1 4\n10.1 20.1 5\n10.2 20.1 6\n")
    raster = read(tmp_path / "site.xyz", grid=Grid(0.1, 0.1))
    assert raster.heights.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert raster.origin == (10, 20)
    assert raster.cell_size == pytest.approx(0.1, abs=1e-12)


@pytest.mark.parametrize(
    ("cell", "form"),
    [(0.1, "%.2f"), (1 / 12, "%.3f"), (0.0625, "%.3f"), (0.125, "%.2f"), (0.1, "%.17g"), (1 / 12, "%.17g")],
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


def test_a_cell_size_that_contradicts_a_lattice_is_refused(tmp_path):
    path = saved(tmp_path, points_of(uneven(20, 20), 0.1))
    assert refusal(path, cell_size=0.05) == "cell_size = 0.05: must be left out: the file says 0.1"
    assert read(path, cell_size=0.1).cell_size == pytest.approx(0.1)


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


@pytest.mark.parametrize("form", [3, 6])
def test_noise_and_withheld_points_of_a_las_file_are_left_out(tmp_path, form):
    points = points_of(uneven(20, 24), CELL)
    classes, withheld = np.full(len(points), 1), np.zeros(len(points), bool)
    classes[:9] = [0, 1, 3, 6, 9, 7, 18, 7, 18]
    withheld[9:12] = True
    fields = {"classification": classes, "withheld": withheld, "point_format": form}
    raster = read(write_las(tmp_path / "site.las", points, **fields))
    col, row = np.round(points[5:12, :2] / CELL).astype(int).T
    assert np.isnan(raster.heights[row, col]).all()
    assert np.isnan(raster.heights).sum() == 7


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_a_las_file_is_read_a_chunk_at_a_time(tmp_path, monkeypatch, suffix):
    monkeypatch.setattr(las, "CHUNK", 100)
    heights = uneven(20, 24)
    path = write_las(tmp_path / f"site.{suffix}", points_of(heights, CELL))
    np.testing.assert_array_equal(read(path).heights, heights)


# ---- Text

PLAIN = "0 0 1\n1 0 2\n0 1 3\n1 1 4\n"
SPELLINGS = {
    "blanks": PLAIN,
    "tabs, blanks and empty lines": "\n0\t0  1\n1 0 2\n\n0 1 3 \n 1 1 4",
    "Windows lines": PLAIN.replace("\n", "\r\n"),
    "commas": PLAIN.replace(" ", ","),
    "commas and blanks": PLAIN.replace(" ", ", "),
    "semicolons": PLAIN.replace(" ", ";"),
    "trailing commas": PLAIN.replace(" ", ",").replace("\n", ",\n"),
    "exponents": PLAIN.replace("0 0 1", "0e0 0.0 +1.0E+00"),
    "byte-order mark": "\ufeff" + PLAIN,
    "comments": "# made by hand\n// or not\n0 0 1\n1 0 2\n# half\n0 1 3\n1 1 4 # end\n",
    "header": "x y z\n" + PLAIN,
    "header with units, quotes and capitals": '"X [m]","Y (m)","Height (m)"\n' + PLAIN.replace(" ", ","),
    "header in another order": "id,z,y,x\n0,1,0,0\n1,2,0,1\n2,3,1,0\n3,4,1,1\n",
    "header in a comment": "//Y X Z\n0 0 1\n0 1 2\n1 0 3\n1 1 4\n",
    "header with words beside": "name,easting,northing,elevation\na,0,0,1\nb,1,0,2\nc,0,1,3\nd,1,1,4\n",
    "colours": "0 0 1 255 255 255\n1 0 2 0 0 0\n0 1 3 0 0 0\n1 1 4 9 9 9\n",
    "number of points": "4\n" + PLAIN,
}


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("suffix", [".xyz", ".TXT", ".csv", ".pts"])
def test_text_is_read_however_it_is_spelled(tmp_path, spelling, suffix):
    path = tmp_path / f"site{suffix}"
    path.write_text(SPELLINGS[spelling], encoding="utf-8", newline="")
    assert read(path, grid=Grid(1.0, 1.0)).heights.tolist() == [[1, 2], [3, 4]]


@pytest.mark.parametrize(
    ("content", "line"),
    {
        "": "cannot be read as text: no line of it holds three numbers",
        "not a map\nat all\n": "cannot be read as text: no line of it holds three numbers",
        "0 0 1\n1 0\n": "cannot be read as a table of x, y, z: ",
        "0 0 1\n1 0 two\n": "cannot be read as a table of x, y, z: could not convert string 'two' to float64 at row 1",
        "0 0\n1 1\n": "cannot be read as text: no line of it holds three numbers",
        "0,0;1,5\n": "cannot be read as text: no line of it holds three numbers",
        "a,b,c\n1,2,3\n": "header = 'a,b,c': must name x, y, z (or easting, northing, elevation), or be left out",
        "x,y\n1,2,3\n": "header = 'x,y': must name x, y, z",
        "lat,lon,height\n1,2,3\n": "column 'lat': is in degrees; reproject it to metres",
        "9\n" + PLAIN: "points = 4: must be 9, as its first line says; it is cut short",
        "3\nwater\nO 0 0 0\nH 0 1 0\nH 1 0 0\n": "header = 'water': must name x, y, z",
    }.items(),
)
def test_a_text_that_is_no_cloud_is_refused(tmp_path, content, line):
    path = tmp_path / "site.xyz"
    path.write_text(content)
    assert refusal(path).startswith(line)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("content", [b"", b"II*\0\xff\xfe", b"ply\n", b"LASF" + bytes(400), bytes(range(256)) * 9])
def test_bytes_that_are_no_cloud_are_refused(tmp_path, suffix, content):
    path = tmp_path / f"site{suffix}"
    path.write_bytes(content)
    assert refusal(path).startswith(("cannot be read as", "version = 0.0: must be 1.0 to 1.4"))


# ---- PLY

QUADS = np.array([([0, 1, 2, 3],), ([1, 2, 3, 4, 5],)], [("vertex_indices", object)])
TRIANGLES = np.array([([0, 1, 2],), ([1, 2, 3],)], [("vertex_indices", "i4", (3,))])


@pytest.mark.parametrize("faces", [TRIANGLES, QUADS], ids=["triangles", "other polygons"])
@pytest.mark.parametrize("text", [True, False])
def test_faces_of_a_ply_are_passed_over(tmp_path, text, faces):
    heights = uneven(20, 24)
    write_ply(tmp_path / "site.ply", points_of(heights, CELL), "f4", [("face", faces)], text=text)
    np.testing.assert_array_equal(read(tmp_path / "site.ply").heights, heights)


def test_a_ply_without_points_is_refused_with_what_it_holds(tmp_path):
    import plyfile

    path = tmp_path / "site.ply"
    plyfile.PlyData([plyfile.PlyElement.describe(TRIANGLES, "face")]).write(path)
    assert refusal(path) == "no element `vertex`; it holds: face"
    plyfile.PlyData([plyfile.PlyElement.describe(np.zeros(3, [("x", "f4"), ("y", "f4")]), "vertex")]).write(path)
    assert refusal(path) == "vertex: must have numbers x, y, z; it has: x, y"
    assert refusal(write_ply(path, np.zeros((0, 3)))).startswith(("heights: all unknown", "cannot be read"))


def test_single_precision_that_cannot_hold_the_coordinates_is_refused(tmp_path):
    points = points_of(uneven(20, 24), CELL, 431_000, 5_203_000)
    line = refusal(write_ply(tmp_path / "site.ply", points, "f4"))
    assert line.startswith("x = 431001: is stored in steps of 0.03125 m (float32): must be double, or relative to")
    assert read(write_ply(tmp_path / "site.ply", points - [431_000, 5_203_000, 0], "f4")).cell_size == CELL


# ---- Coordinate systems


def keyed(**keys: int) -> GeoKeyDirectoryVlr:
    """A record of GeoTIFF keys: model (1 projected, 2 in degrees), code or geographic, unit."""
    numbers = {"model": 1024, "geographic": 2048, "code": 3072, "unit": 3076}
    record = GeoKeyDirectoryVlr()
    record.geo_keys = [
        GeoKeyEntryStruct(id=numbers[name], tiff_tag_location=0, count=1, value_offset=value)
        for name, value in keys.items()
    ]
    record.geo_keys_header.number_of_keys = len(keys)
    return record


def wkt(name: str) -> WktCoordinateSystemVlr:
    return WktCoordinateSystemVlr(CRS.from_string(name).to_wkt())


@pytest.mark.parametrize(
    ("record", "crs"),
    [
        (wkt("EPSG:32632"), "EPSG:32632"),
        (wkt("EPSG:25832+7837"), "EPSG:25832"),
        (wkt("EPSG:5555"), "EPSG:25832"),
        (WktCoordinateSystemVlr(""), None),
        (keyed(model=1, code=32632, geographic=4326), "EPSG:32632"),
        (keyed(model=1, code=32767, unit=9001), None),
        (keyed(model=1), None),
    ],
    ids=["WKT", "with heights", "with heights, one code", "empty", "keys", "keys without a code", "no keys"],
)
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_a_las_file_names_its_system(tmp_path, suffix, record, crs):
    raster = read(write_las(tmp_path / f"site.{suffix}", points_of(uneven(20, 24), CELL), records=[record]))
    assert raster.crs == crs


@pytest.mark.parametrize(
    ("record", "line"),
    [
        (wkt("EPSG:4326"), "crs = EPSG:4326: is in degrees"),
        (keyed(model=2, geographic=4326), "crs = EPSG:4326: is in degrees"),
        (keyed(model=2), "crs: is in degrees"),
        (wkt("EPSG:2263"), "crs = EPSG:2263: is in units of 0.3048"),
        (keyed(model=1, code=2263), "crs = EPSG:2263: is in units of 0.3048"),
        (keyed(model=1, code=32767, unit=9002), "crs: is in units of 0.3048 m (GeoKey 3076)"),
        (keyed(model=1, code=1025), "crs: cannot be understood: "),
        (WktCoordinateSystemVlr("PROJCS[nonsense"), "crs: cannot be understood: "),
    ],
    ids=["degrees", "degrees by key", "degrees without a code", "feet", "feet by key", "feet alone", "code", "WKT"],
)
def test_a_las_file_in_degrees_or_feet_is_refused(tmp_path, record, line):
    path = write_las(tmp_path / "site.las", points_of(uneven(20, 24), CELL), records=[record])
    assert refusal(path).startswith(line)


def test_heights_in_feet_want_their_scale(tmp_path):
    heights = uneven(20, 24)
    path = write_las(tmp_path / "site.las", points_of(heights, CELL), records=[wkt("EPSG:25832+6360")])
    line = refusal(path)
    assert line.startswith("crs = EPSG:25832: has heights in units of 0.3048")
    scale = float(line.partition("--height-scale=")[2].rstrip(")"))
    np.testing.assert_allclose(read(path, scale=scale).heights, heights * 1200 / 3937, rtol=0, atol=1e-9)


# ---- Bad input


def refusal(path: Path, **options) -> str:
    """The one line that says what is wrong, less the name of the file that it starts with."""
    with pytest.raises(InputError) as raised:
        load_dem(path, grid=SMALL, **options)
    message = str(raised.value)
    assert message.startswith(f"{path}: ")
    assert len(message.splitlines()) == 1
    return message.removeprefix(f"{path}: ")


@pytest.mark.parametrize("form", [form for form in CLOUDS if form not in ("XYZ", "text", "CSV")])
@pytest.mark.parametrize("share", [0.001, 0.02, 0.5, 0.9, 0.999])
def test_a_cloud_cut_short_is_refused(tmp_path, form, share):
    name, write = CLOUDS[form]
    path = write(tmp_path / name, points_of(uneven(40, 50), CELL))
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert "read" in refusal(path) or "cut short" in refusal(path)


def test_a_las_file_cut_between_two_points_is_refused(tmp_path):
    path = write_las(tmp_path / "site.las", points_of(uneven(20, 24), CELL))
    with laspy.open(path) as file:
        size = file.header.point_format.size
    path.write_bytes(path.read_bytes()[: -3 * size])
    assert refusal(path) == "points = 477: must be 480, as its header says; it is cut short"


def test_a_damaged_laz_file_is_refused(tmp_path):
    path = write_las(tmp_path / "site.laz", points_of(uneven(40, 50), CELL))
    content = path.read_bytes()
    path.write_bytes(content[:-3000])
    assert refusal(path).startswith("chunk table at ")
    content = bytearray(content)
    content[-400:-300] = bytes(100)
    path.write_bytes(content)
    assert "it is cut short or damaged" in refusal(path)


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


def test_a_mark_of_unknown_ground_in_a_las_file_is_refused(tmp_path):
    points = points_of(uneven(20, 24), CELL)
    points[7, 2] = -9999
    assert refusal(write_las(tmp_path / "site.las", points, 0.001)).startswith("heights = -9999: is a usual mark")


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
