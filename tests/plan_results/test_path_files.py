"""Paths as files, read again by other libraries and compared with the poses of their motions."""

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from pyproj import Transformer

from travjax.config import InputError
from travjax.plan_results.path_files import COLUMNS, save_csv, save_geojson, save_gpx, save_path, save_ros_path
from travjax.planning.endpoints import endpoint
from travjax.planning.motions import Motions
from travjax.planning.path import Leg, drive
from travjax.planning.planner import Plan, Planner
from travjax.site.ground import ArrayGround

UTM, ORIGIN, LEVEL, NODE, STRIDE = "EPSG:32632", (510_000.03, 5_200_000.07), 512.25, 0.0625, 0.25
GPX = "{http://www.topografix.com/GPX/1/1}"
START, VIA = (10, 12), (14, 12)
"""Rows and columns of places that the plan begins at and passes."""


def ground_of(crs: str | None = UTM, origin=ORIGIN, frame: str | None = None, unknown: bool = False) -> ArrayGround:
    """A slope, steeper to the north than to the east; unknown: of the robot's left wheels when it begins."""
    x, y = np.meshgrid(np.arange(0, 7.01, NODE), np.arange(0, 6.51, NODE))
    heights = 0.05 * x + 0.1 * y
    if unknown:
        heights[(x < 2.8) & (y < 3.2)] = np.nan
    return ArrayGround(heights.astype(np.float32), LEVEL, NODE, origin, crs, frame)


def driven(ground: ArrayGround, motions: Sequence[str] | None = None, interval: float = 0.06) -> tuple[Plan, Planner]:
    """A plan of given motions, and the planner that it could be of."""
    planner = Planner(ground, motions=Motions(reverse=True), contact="nearest", interval=interval, unknown_cost=3.0)
    names = [*["straight"] * 4, "turn_left", "turn_left", "left", "straight", "reverse_straight", "turn_right", "right"]
    at, heading, legs = START, 0, list[Leg]()
    for name in names if motions is None else motions:
        back = name.startswith("reverse_") or name == "turn_right"
        called = "turn_left" if name == "turn_right" else name.removeprefix("reverse_")
        number = (heading - 1) % 16 if name == "turn_right" else heading
        motion = next(one for one in planner.lattice.all if (one.name, one.heading) == (called, number))
        begin = (at[0] - motion.rows, at[1] - motion.cols) if back else at
        legs.append(Leg(*begin, motion, back))
        at = begin if back else (at[0] + motion.rows, at[1] + motion.cols)
        heading = motion.heading if back else motion.end
    path, _ = drive(legs, np.array([START[1] * STRIDE, START[0] * STRIDE, 0.0]), ground, planner.setup)
    rowcol = [(4 * row, 4 * col) for row, col in (START, VIA, at)]
    points = [
        endpoint(name, one, planner.costs, "rowcol")
        for name, one in zip(("start", "via 1", "goal"), rowcol, strict=True)
    ]
    return Plan(path, tuple(legs), 12.5, tuple(points), "", 0), planner


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open(newline="", encoding="utf-8") as text:
        return list(csv.DictReader(text))


def to_site(positions: Sequence[Sequence[float]]) -> np.ndarray:
    """x and y of longitudes and latitudes."""
    longitude, latitude = np.array([position[:2] for position in positions]).T
    return np.stack(Transformer.from_crs("EPSG:4326", UTM, always_xy=True).transform(longitude, latitude), axis=1)


def places_of(plan: Plan) -> np.ndarray:
    """x, y, z of a path where it moves, poses in one place taken together."""
    poses = np.column_stack([plan.path.pose[:, :2], plan.path.z])
    return np.array([poses[0], *(b for a, b in pairwise(poses) if math.hypot(*(b - a)[:2]) > 1e-9)])


# ---- path.csv


def test_a_table_holds_every_pose(tmp_path):
    plan, planner = driven(ground_of())
    assert save_csv(tmp_path / "path.csv", plan.path) == tmp_path / "path.csv"
    rows = rows_of(tmp_path / "path.csv")
    assert list(rows[0]) == list(COLUMNS) and (tmp_path / "path.csv").read_text().count("\n") == len(rows) + 1
    poses = np.concatenate([leg.poses(0.06, STRIDE)[number > 0 :] for number, leg in enumerate(plan.legs)])
    names = [leg.name for number, leg in enumerate(plan.legs) for _ in leg.poses(0.06, STRIDE)[number > 0 :]]
    assert [row["primitive"] for row in rows] == names
    value = {name: np.array([float(row[name]) for row in rows]) for name in COLUMNS if name != "primitive"}
    np.testing.assert_allclose(value["x"], ORIGIN[0] + poses[:, 0], rtol=0, atol=6e-5)
    np.testing.assert_allclose(value["y"], ORIGIN[1] + poses[:, 1], rtol=0, atol=6e-5)
    np.testing.assert_allclose(value["z"], LEVEL + 0.05 * poses[:, 0] + 0.1 * poses[:, 1], rtol=0, atol=0.01)
    off = np.remainder(value["heading_deg"] - np.degrees(poses[:, 2]) + 180, 360) - 180
    assert np.abs(off).max() < 6e-5 and value["heading_deg"].min() >= 0 and value["heading_deg"].max() < 360
    for name in ("distance", "step", "obstacle", "tilt"):
        np.testing.assert_allclose(value[name], getattr(plan.path, name), rtol=0, atol=6e-5)
    assert value["distance"][-1] == pytest.approx(plan.path.length, abs=6e-5)


@pytest.mark.parametrize("interval", [0.06, 0.2])
def test_rows_of_a_table_are_close_together(tmp_path, interval):
    plan, planner = driven(ground_of(), interval=interval)
    rows = rows_of(save_csv(tmp_path / "path.csv", plan.path))
    for before, row in pairwise(rows):
        moved = math.hypot(float(row["x"]) - float(before["x"]), float(row["y"]) - float(before["y"]))
        along = float(row["distance"]) - float(before["distance"])
        turned = (float(row["heading_deg"]) - float(before["heading_deg"]) + 180) % 360 - 180
        if row["primitive"].startswith("turn_"):
            assert moved == along == 0 and 0 < abs(turned) <= 360 / 16 / 4 + 1e-3
            assert (turned > 0) == (row["primitive"] == "turn_left") and float(row["step"]) == 0
        else:
            assert moved - 3e-4 <= along <= interval + 1e-3
            assert abs(turned) <= math.degrees(along / 1.0) + 1e-3  # the smallest radius is a metre
            middle = math.radians(float(before["heading_deg"]) + turned / 2)
            ahead = -math.sin(middle), math.cos(middle)
            forward = sum(
                (float(row[name]) - float(before[name])) * part for name, part in zip("xy", ahead, strict=True)
            )
            assert (forward < 0) == row["primitive"].startswith("reverse_")


def test_what_is_unknown_reads_as_nan(tmp_path):
    plan, planner = driven(ground_of(unknown=True))
    known = plan.path.known
    assert known.any() and not known.all()
    file = save_csv(tmp_path / "path.csv", plan.path)
    table = np.genfromtxt(file, delimiter=",", names=True, dtype=None, encoding="utf-8")
    for name in ("z", "obstacle", "tilt"):
        np.testing.assert_array_equal(np.isnan(table[name]), ~known)
    np.testing.assert_array_equal(np.isnan(table["step"]), np.isnan(plan.path.step))
    assert "nan" in file.read_text() and np.isfinite(table["x"]).all()


def test_a_heading_just_below_a_full_turn_is_none(tmp_path):
    plan, _ = driven(ground_of(), ["straight"])
    pose = plan.path.pose - [0, 0, 1e-9]
    rows = rows_of(save_csv(tmp_path / "path.csv", replace(plan.path, pose=pose % [1e9, 1e9, 2 * math.pi])))
    assert {row["heading_deg"] for row in rows} == {"0.0000"}


# ---- GeoJSON and GPX


def test_geojson_leads_back_to_the_poses(tmp_path):
    plan, planner = driven(ground_of())
    file = save_geojson(tmp_path / "path.geojson", plan, planner)
    collection = json.loads(file.read_text())
    assert set(collection) == {"type", "features"} and collection["type"] == "FeatureCollection"
    line, *points = collection["features"]
    assert line["type"] == "Feature" and line["geometry"]["type"] == "LineString"
    at = line["geometry"]["coordinates"]
    assert all(9 < longitude < 10 and 46 < latitude < 47 for longitude, latitude, _ in at)
    expected = places_of(plan)
    np.testing.assert_allclose(to_site(at), expected[:, :2], rtol=0, atol=1e-3)
    np.testing.assert_allclose([position[2] for position in at], expected[:, 2], rtol=0, atol=1e-4)
    assert line["properties"] == {
        "length_m": pytest.approx(plan.path.length, abs=1e-4),
        "cost": 12.5,
        "robot": "Seekur Jr",
        "contact": "nearest",
    }
    assert [point["properties"]["name"] for point in points] == ["start", "via 1", "goal"]
    assert {point["geometry"]["type"] for point in points} == {"Point"}
    where = to_site([point["geometry"]["coordinates"] for point in points])
    np.testing.assert_allclose(where, [(one.x, one.y) for one in plan.points], rtol=0, atol=1e-3)
    assert points[0]["geometry"]["coordinates"] == at[0] and points[2]["geometry"]["coordinates"] == at[-1]


def test_gpx_has_the_order_of_its_schema_and_the_places_of_geojson(tmp_path):
    plan, planner = driven(ground_of())
    root = ElementTree.parse(save_gpx(tmp_path / "path.gpx", plan, planner)).getroot()
    assert root.tag == f"{GPX}gpx" and root.get("version") == "1.1" and root.get("creator") == "travjax"
    assert [child.tag for child in root] == [f"{GPX}wpt"] * 3 + [f"{GPX}trk"]
    assert [child.tag for child in root[3]] == [f"{GPX}name", f"{GPX}desc", f"{GPX}trkseg"]
    assert all([child.tag for child in point] == [f"{GPX}ele", f"{GPX}name"] for point in root[:3])
    assert [point.findtext(f"{GPX}name") for point in root[:3]] == ["start", "via 1", "goal"]
    track = list(root[3][2])
    assert all(point.tag == f"{GPX}trkpt" and [child.tag for child in point] == [f"{GPX}ele"] for point in track)
    geojson = json.loads(save_geojson(tmp_path / "path.geojson", plan, planner).read_text())["features"]
    line, *points = (one["geometry"]["coordinates"] for one in geojson)
    for elements, positions in ((track, line), (root[:3], points)):
        found = [[float(point.get(key, "")) for key in ("lon", "lat")] + [float(point[0].text)] for point in elements]
        np.testing.assert_array_equal(found, positions)


def test_places_on_unknown_ground_have_no_height(tmp_path):
    plan, planner = driven(ground_of(unknown=True))
    known = np.isfinite(places_of(plan)[:, 2])
    line, start, *_ = json.loads(save_geojson(tmp_path / "path.geojson", plan, planner).read_text())["features"]
    assert [len(position) for position in line["geometry"]["coordinates"]] == np.where(known, 3, 2).tolist()
    assert len(start["geometry"]["coordinates"]) == 2
    root = ElementTree.parse(save_gpx(tmp_path / "path.gpx", plan, planner)).getroot()
    assert [len(point) for point in root.iter(f"{GPX}trkpt")] == known.astype(int).tolist()
    assert "nan" not in (tmp_path / "path.gpx").read_text() + (tmp_path / "path.geojson").read_text().lower()


def test_a_path_of_one_place_is_a_line_nevertheless(tmp_path):
    plan, planner = driven(ground_of(), [])
    line = json.loads(save_geojson(tmp_path / "path.geojson", plan, planner).read_text())["features"][0]["geometry"]
    assert line["type"] == "LineString" and len(line["coordinates"]) == 2
    assert len(rows_of(save_csv(tmp_path / "path.csv", plan.path))) == 1


@pytest.mark.parametrize(
    ("crs", "origin", "reason"),
    [
        (None, ORIGIN, "no coordinate system says where on earth the site lies"),
        ('LOCAL_CS["yard",UNIT["metre",1]]', (0.0, 0.0), "no coordinate system says where on earth the site lies"),
        ("+proj=eqc +R=3396190 +units=m", (4000.0, 5000.0), 'crs = "unknown": lies on another body than the earth'),
        (UTM, (3.0, 5.0), "crs = EPSG:32632: x, y = 6, 7.5: count from an origin of the site's own"),
    ],
)
def test_sites_that_do_not_lie_on_earth_get_a_table_and_a_reason(tmp_path, crs, origin, reason):
    plan, planner = driven(ground_of(crs, origin))
    (tmp_path / "path.gpx").write_text("of an earlier plan")
    files, lines = save_path(tmp_path, plan, planner)
    assert files == [tmp_path / "path.csv"] and sorted(tmp_path.iterdir()) == files
    assert lines == [f"path.geojson and path.gpx: not written: {reason}"]
    for save in (save_geojson, save_gpx):
        with pytest.raises(InputError, match="site: .*: must be a coordinate system") as raised:
            save(tmp_path / "path.out", plan, planner)
        assert len(str(raised.value).splitlines()) == 1
    assert sorted(tmp_path.iterdir()) == files


def test_a_projection_around_the_site_lies_on_earth(tmp_path):
    plan, planner = driven(ground_of("+proj=tmerc +lat_0=47 +lon_0=9 +datum=WGS84 +units=m", (0.0, 0.0)))
    _, lines = save_path(tmp_path, plan, planner)
    position = json.loads((tmp_path / "path.geojson").read_text())["features"][1]["geometry"]["coordinates"]
    assert not lines and position[:2] == pytest.approx([9, 47], abs=1e-4)


# ---- ROS


@pytest.mark.parametrize("name", ["plan.mcap", "plan.db3"])
@pytest.mark.parametrize("frame", [None, "odom"])
def test_ros_reads_the_poses(tmp_path, name, frame):
    highlevel = pytest.importorskip("rosbags.highlevel", reason="the extra ros is not installed")
    from rosbags.typesys import Stores, get_typestore

    plan, planner = driven(ground_of(frame=frame))
    assert save_ros_path(tmp_path / name, plan, planner) == tmp_path / name
    assert list(tmp_path.iterdir()) == [tmp_path / name]
    with highlevel.AnyReader([tmp_path / name], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        ((connection, _, raw),) = reader.messages()
        message = reader.deserialize(raw, connection.msgtype)
    assert (connection.topic, connection.msgtype) == ("/plan", "nav_msgs/msg/Path")
    assert {one.header.frame_id for one in [message, *message.poses]} == {frame or "map"}
    assert len(message.poses) == len(plan.path.z)
    for stamped, pose, z in zip(message.poses, plan.path.pose, plan.path.z, strict=True):
        at, turned = stamped.pose.position, stamped.pose.orientation
        assert (at.x, at.y, at.z) == pytest.approx((*pose[:2], z), abs=1e-9)
        assert turned.x == turned.y == 0 and turned.z**2 + turned.w**2 == pytest.approx(1)
        ahead = 1 - 2 * turned.z**2, 2 * turned.z * turned.w  # x and y of the robot's own +x
        assert ahead == pytest.approx((-math.sin(pose[2]), math.cos(pose[2])), abs=1e-9)


def test_ros_gets_finite_heights_on_unknown_ground(tmp_path):
    highlevel = pytest.importorskip("rosbags.highlevel", reason="the extra ros is not installed")
    plan, planner = driven(ground_of(unknown=True))
    nowhere = replace(plan.path, known=plan.path.known & False, z=plan.path.z * np.nan)
    first = plan.path.z[plan.path.known][0]
    for name, path, expected in (("some.mcap", plan.path, first), ("none.mcap", nowhere, 0)):
        with highlevel.AnyReader([save_ros_path(tmp_path / name, replace(plan, path=path), planner)]) as reader:
            ((connection, _, raw),) = reader.messages()
            heights = [one.pose.position.z for one in reader.deserialize(raw, connection.msgtype).poses]
        assert np.isfinite(heights).all() and heights[0] == expected


def test_other_recordings_are_refused(tmp_path):
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    plan, planner = driven(ground_of(), ["straight"])
    with pytest.raises(InputError, match="must be a file in a folder that exists, its name ending in .mcap"):
        save_ros_path(tmp_path / "plan.bag", plan, planner)


# ---- All of a plan


def test_a_plan_is_written_into_a_new_folder(tmp_path):
    planner = Planner(ground_of(), motions=Motions(turns=(0,)), headings=8, contact="nearest")
    east, north = ORIGIN
    plan = planner.plan((east + 2, north + 2), (east + 4.5, north + 3.5, -math.pi / 2))
    files, lines = save_path(tmp_path / "new", plan, planner)
    assert [file.name for file in files] == ["path.csv", "path.geojson", "path.gpx"] and not lines
    assert sorted((tmp_path / "new").iterdir()) == files
    first, *_, last = rows_of(files[0])
    for row, at in ((first, (2, 2)), (last, (4.5, 3.5))):
        assert (float(row["x"]) - east, float(row["y"]) - north) == pytest.approx(at, abs=1e-3)
    assert float(last["heading_deg"]) == 270
    assert json.loads(files[1].read_text())["features"][0]["properties"]["cost"] == pytest.approx(plan.cost, abs=1e-4)
