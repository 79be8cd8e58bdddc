"""LAS and LAZ files: classes, coordinate systems, and the one line for each that is damaged."""

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct, WktCoordinateSystemVlr
from rasterio.crs import CRS

from tests.points import CELL, line_of, points_of, read, refusal, uneven, write_las, write_text
from travjax.point_clouds import las


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
    monkeypatch.setattr(las, "POINTS_AT_ONCE", 100)
    heights = uneven(20, 24)
    path = write_las(tmp_path / f"site.{suffix}", points_of(heights, CELL))
    np.testing.assert_array_equal(read(path).heights, heights)


# ---- Classes


GROUND_HEIGHTS = uneven(20, 24)
POINTS = points_of(GROUND_HEIGHTS, CELL)


def forest(path: Path, classes: dict[int, int], form: int = 6) -> tuple[Path, np.ndarray]:
    """Points of which the first so many are of each class, 5 m above the ground, and the ground as class 2."""
    points, codes = POINTS.copy(), np.full(len(POINTS), 2)
    start = 0
    for code, number in classes.items():
        codes[start : start + number] = code
        start += number
    points[:start, 2] += 5
    return write_las(path, points, point_format=form, classification=codes), codes


@pytest.mark.parametrize("form", [3, 6])
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_ground_alone_is_taken_where_a_file_has_it_beside_others(tmp_path, suffix, form):
    path, codes = forest(tmp_path / f"site.{suffix}", {1: 20, 5: 30, 9: 4, 17: 6, 7: 3}, form=form)
    raster = read(path)
    known = ~np.isnan(raster.heights)
    assert np.count_nonzero(known) == np.count_nonzero(codes == 2)
    np.testing.assert_array_equal(raster.heights[known], GROUND_HEIGHTS[known])
    assert raster.notes == (
        "ground alone is taken: 60 of 480 points, of classes 1,5,9,17, are left out (--classes=1,2,5,9,17 takes them)",
    )


def test_key_points_and_roads_are_ground(tmp_path):
    codes = np.full(len(POINTS), 2)
    codes[:40], codes[40:60], codes[60:70] = 8, 11, 5
    raster = read(write_las(tmp_path / "site.las", POINTS, classification=codes))
    assert np.isnan(raster.heights).sum() == 10


@pytest.mark.parametrize("wanted", [(2,), (2, 9), (5,), (7,), (2, 30)])
def test_the_classes_that_are_wanted_are_taken(tmp_path, wanted):
    path, codes = forest(tmp_path / "site.las", {5: 200, 9: 40, 7: 100})
    raster = read(path, CELL, classes=wanted)
    assert np.count_nonzero(~np.isnan(raster.heights)) == np.isin(codes, wanted).sum()
    assert raster.notes == ()


def test_classes_that_no_point_has_are_refused(tmp_path):
    path, _ = forest(tmp_path / "site.las", {5: 30})
    assert line_of(path, classes=(6, 9)) == "classes = 6,9: must be among those of its points: 2,5"
    line = line_of(write_text(tmp_path / "site.xyz", POINTS), classes=(2,))
    assert line == "classes = 2: must be left out: its points have no classes"


def test_vegetation_without_any_ground_counts_and_is_named(tmp_path):
    path = write_las(tmp_path / "site.las", POINTS, classification=np.where(np.arange(480) < 100, 5, 1))
    raster = read(path)
    np.testing.assert_array_equal(raster.heights, GROUND_HEIGHTS)
    assert raster.notes == ("no point is called ground: classes 1,5 all count as ground (--classes takes some)",)


def test_files_without_classes_have_no_notes(tmp_path):
    for code in (0, 1, 2):
        path = write_las(tmp_path / "site.las", POINTS, classification=np.full(480, code))
        assert read(path).notes == ()


def test_too_few_ground_points_are_refused_with_what_is_left_out(tmp_path):
    codes = np.where(np.arange(480) < 20, 2, 1)
    line = line_of(write_las(tmp_path / "site.las", POINTS, classification=codes), cell_size=CELL)
    assert line.startswith(
        "points = 20: must be at least 64, as many as a window has cells; ground alone is taken: 460"
    )


# ---- Steps


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_coarse_steps_are_refused(tmp_path, axis):
    path = write_las(tmp_path / "site.las", POINTS)
    content = bytearray(path.read_bytes())
    content[131 + 8 * axis : 139 + 8 * axis] = struct.pack("<d", 0.02)
    path.write_bytes(content)
    name = "xyz"[axis]
    assert refusal(path) == f"scale of {name} = 0.02: is stored in steps of 0.02 m: must be at most 0.01 m"


@pytest.mark.parametrize("scale", [0.0, -0.001, np.nan, np.inf])
def test_scales_that_are_none_are_refused(tmp_path, scale):
    path = write_las(tmp_path / "site.las", POINTS)
    content = bytearray(path.read_bytes())
    content[131:139] = struct.pack("<d", scale)
    path.write_bytes(content)
    assert refusal(path).startswith("scales = ")


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


def keys(numbers: dict[int, int | float]) -> list[laspy.VLR]:
    """Records of GeoTIFF keys; numbers with a point stand in the record of doubles."""
    doubles = [value for value in numbers.values() if isinstance(value, float)]
    directory = [1, 1, 0, len(numbers)]
    for key, value in sorted(numbers.items()):
        directory += [key, 34736, 1, doubles.index(value)] if isinstance(value, float) else [key, 0, 1, value]
    records = [laspy.VLR("LASF_Projection", 34735, "", struct.pack(f"<{len(directory)}H", *directory))]
    return records + [laspy.VLR("LASF_Projection", 34736, "", struct.pack(f"<{len(doubles)}d", *doubles))]


UTM = {1024: 1, 3072: 32632}
TRANSVERSE = {1024: 1, 3072: 32767, 3075: 1, 2048: 4326, 3076: 9001, 3080: 9.0, 3081: 0.0, 3083: 0.0}
STATED = {
    "metres": (UTM | {4099: 9001}, None),
    "height system in metres": (UTM | {4096: 5703}, None),
    "old number of a height system": (UTM | {4096: 5103, 4099: 9001}, None),
    "user-defined height system": (UTM | {4096: 32767, 4099: 9001}, None),
    "feet": (UTM | {4099: 9002}, "crs: GeoKey 4099: has heights in units of 0.3048 m (foot); give that"),
    "US feet": (UTM | {4099: 9003}, "crs: GeoKey 4099: has heights in units of 0.304801 m (US survey foot); give"),
    "height system in US feet": (UTM | {4096: 6360}, "crs = EPSG:6360: has heights in units of 0.304801 m"),
    "unit over the system's": (UTM | {4096: 5703, 4099: 9002}, "crs: GeoKey 4099: has heights in units of 0.3048 m"),
    "unit without a system": ({4099: 9003}, "crs: GeoKey 4099: has heights in units of 0.304801 m"),
    "no known unit": (UTM | {4099: 32767}, "crs: GeoKey 4099 = 32767: must be a known unit of length"),
    "unit over that of the code": (UTM | {3076: 9002}, "crs: is in units of 0.3048 m (GeoKey 3076); reproject it"),
    "degrees alone": ({2048: 4326}, "crs = EPSG:4326: is in degrees"),
    "depths": (UTM | {4096: 5706}, "crs = EPSG:5706: has depths, which run down"),
    "geocentric": ({1024: 3, 2048: 4978}, "crs: is geocentric: its z is no height; convert it to metres"),
    "geocentric without a code": ({1024: 3}, "crs: is geocentric: its z is no height"),
    "geocentric as projected": ({1024: 1, 3072: 4978}, "crs = EPSG:4978: is geocentric: its z is no height"),
    "heights alone": ({1024: 1, 3072: 5703}, "crs = EPSG:5703: is a Vertical CRS"),
    "Web Mercator": ({1024: 1, 3072: 3857}, "crs = EPSG:3857: a metre on the ground is"),
    "a unit by its size": (
        {1024: 1, 3072: 32767, 3076: 32767, 3077: 0.9},
        "crs: is in units of 0.9 m (GeoKey 3076); reproject it",
    ),
    "transverse Mercator": (TRANSVERSE | {3092: 0.9996, 3082: 500000.0}, None),
    "Mercator": (
        {1024: 1, 3072: 32767, 3075: 7, 3076: 9001, 3080: 0.0, 3082: 0.0, 3083: 0.0},
        "a metre on the ground is 1.5",
    ),
}
"""GeoTIFF keys, and what their refusal holds or None."""


@pytest.mark.parametrize("stated", STATED)
@pytest.mark.parametrize("extended", [False, True])
def test_what_geotiff_keys_state_is_heard(tmp_path, monkeypatch, stated, extended):
    monkeypatch.setenv("PROJ_DATA", str(tmp_path))
    numbers, line = STATED[stated]
    points = points_of(uneven(20, 24), CELL, 500_000, 6_200_000)
    path = write_las(tmp_path / "site.las", points, point_format=6, records=[] if extended else keys(numbers))
    if extended:
        add_extended(path, keys(numbers))
    if line is None:
        assert read(path).heights.shape == (20, 24)
    else:
        message = refusal(path)
        assert line in message
        if "has heights in units of" in message:
            scale = float(message.partition("--height-scale=")[2].rstrip(")"))
            assert np.nanmax(read(path, scale=scale).heights) == pytest.approx(uneven(20, 24).max() * scale)


def test_a_height_scale_stands_for_units_that_are_not_known(tmp_path):
    path = write_las(tmp_path / "site.las", POINTS, records=keys({1024: 1, 4099: 32767}))
    assert refusal(path).endswith("must be a known unit of length; give metres a unit (--height-scale=METRES)")
    np.testing.assert_array_equal(read(path, scale=0.5).heights, GROUND_HEIGHTS / 2)


def add_extended(path: Path, records: list[laspy.VLR]) -> None:
    """Appends records behind the points of a LAS 1.4 file."""
    content = bytearray(path.read_bytes())
    content[235:247] = struct.pack("<QI", len(content), len(records))
    for record in records:
        body = record.record_data_bytes()
        content += struct.pack("<H16sHQ32s", 0, record.user_id.encode(), record.record_id, len(body), b"") + body
    path.write_bytes(content)


@pytest.mark.parametrize("name", ["EPSG:25832+6360", "EPSG:4978", "EPSG:3857", "EPSG:2263"])
def test_systems_behind_the_points_are_heard(tmp_path, name):
    path = write_las(tmp_path / "site.las", points_of(uneven(20, 24), CELL, 500_000, 5_200_000), point_format=6)
    add_extended(path, [laspy.VLR("LASF_Projection", 2112, "", CRS.from_string(name).to_wkt().encode() + b"\0")])
    assert refusal(path).startswith("crs = EPSG:")


# ---- Bad input


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


def test_a_mark_of_unknown_ground_in_a_las_file_is_refused(tmp_path):
    points = points_of(uneven(20, 24), CELL)
    points[7, 2] = -9999
    assert refusal(write_las(tmp_path / "site.las", points, 0.001)).startswith("heights = -9999: is a usual mark")


def edited(path: Path, at: int, layout: str, *values) -> Path:
    content = bytearray(path.read_bytes())
    content[at : at + struct.calcsize(layout)] = struct.pack(layout, *values)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("at", "layout", "value", "line"),
    [
        (25, "<B", 10, "version = 1.10: must be 1.0 to 1.4"),
        (24, "<B", 2, "version = 2.2: must be 1.0 to 1.4"),
        (94, "<H", 60_000, "offset to points = "),
        (96, "<I", 2**32 - 1, "offset to points = 4294967295: must lie behind the header, in its "),
        (100, "<I", 2**32 - 1, "records = 4294967295: must lie between header and points"),
        (104, "<B", 40, "point format = 40 of 34 bytes: must be 0 to 10"),
        (105, "<H", 3, "point format = 3 of 3 bytes: must be 0 to 10"),
        (107, "<I", 2**32 - 1, "points = 480: must be 4294967295, as its header says; it is cut short"),
        (155, "<d", np.inf, "offsets = (inf, "),
    ],
)
def test_a_las_header_is_compared_with_the_size_of_the_file(tmp_path, at, layout, value, line):
    path = edited(write_las(tmp_path / "site.las", POINTS), at, layout, value)
    assert refusal(path).startswith(line)


def test_a_record_longer_than_the_file_is_refused(tmp_path):
    path = write_las(tmp_path / "site.las", POINTS, records=[wkt("EPSG:32632")])
    edited(path, 227 + 20, "<H", 65_535)
    assert refusal(path) == "record 1 = 65535 bytes: must lie in the file; it is cut short"


@pytest.mark.parametrize("form", [3, 6])
@pytest.mark.parametrize("value", [2**32 - 1, 2**31, 10_000])
def test_a_chunk_table_is_compared_with_the_size_of_the_file(tmp_path, form, value):
    path = write_las(tmp_path / "site.laz", POINTS, point_format=form)
    content = path.read_bytes()
    start = struct.unpack("<I", content[96:100])[0]
    table = struct.unpack("<q", content[start : start + 8])[0]
    edited(path, table + 4, "<I", value)
    assert refusal(path).startswith(f"chunks = {value}: must be at most ")


@pytest.mark.parametrize("value", [0, -2, 5, 2**40, -(2**63)])
def test_a_chunk_table_that_lies_elsewhere_is_refused(tmp_path, value):
    path = write_las(tmp_path / "site.laz", POINTS)
    start = struct.unpack("<I", path.read_bytes()[96:100])[0]
    assert refusal(edited(path, start, "<q", value)).startswith(f"chunk table at {value}: must lie behind the points")


@pytest.mark.parametrize(
    ("at", "layout", "value"),
    [(0, "<H", 1), (12, "<I", 2**31), (12, "<I", 0), (32, "<H", 60_000), (34, "<H", 77), (36, "<H", 65_535)],
)
@pytest.mark.parametrize("form", [3, 6])
def test_the_record_of_the_compression_is_compared_with_the_points(tmp_path, form, at, layout, value):
    path = write_las(tmp_path / "site.laz", POINTS, point_format=form)
    record = path.read_bytes().index(b"laszip encoded") + 52
    line = refusal(edited(path, record + at, layout, value))
    assert line.startswith(("cannot be read as LAZ: ", "points of a chunk = 2147483648: must be at most 4194304"))


def test_layers_longer_than_their_chunk_are_refused(tmp_path):
    path = write_las(tmp_path / "site.laz", POINTS, point_format=6)
    start = struct.unpack("<I", path.read_bytes()[96:100])[0]
    edited(path, start + 8 + 30 + 4, "<I", 2**32 - 1)
    assert refusal(path).startswith("chunk 1 = ")


def test_a_panic_of_the_decompressor_is_one_line(tmp_path, monkeypatch):
    class PanicException(BaseException):
        pass

    def panic(*_):
        raise PanicException("called `Result::unwrap()` on an `Err` value")

    path = write_las(tmp_path / "site.laz", POINTS)
    monkeypatch.setattr(las, "_kept", panic)
    assert refusal(path) == "cannot be read as LAZ: it is cut short or damaged"
