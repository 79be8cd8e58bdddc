"""GridMap in recordings of ROS 1 and ROS 2: orientation, circular buffers, and what has to be chosen."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.commandline import run_words
from travjax.config import InputError
from travjax.data.dem import load_dem
from travjax.rasters.grid_maps import DEFINITIONS, TYPE, grid_map_types, read_grid_map, write_grid_map
from travjax.rasters.reading_options import DemOptions
from travjax.rasters.recordings import rosbags
from travjax.simulation.grid import Grid

pytest.importorskip("rosbags", reason="the extra ros is not installed")

CELL = 0.1
INFO = "grid_map_msgs/msg/GridMapInfo"


def heights() -> np.ndarray:
    """An asymmetric raster of 5 x 7 heights, row 0 in the south, with an unknown one."""
    ground = np.arange(35, dtype=np.float32).reshape(5, 7) ** 1.5 / 10
    ground[1, 2] = np.nan
    return ground


def recorded(path: Path, maps, *, topic="/grid_map", shift=(0, 0), turn=0.0, ros1=False, definitions=True) -> Path:
    """Writes messages, one a second; each is layers by name, laid out node by node as grid_map's sources say."""
    engine = rosbags()
    store = grid_map_types()
    if ros1:
        types = engine.typesys
        store = types.get_typestore(types.Stores.ROS1_NOETIC)
        stamped = {
            "grid_map_msgs/msg/GridMapInfo": "std_msgs/Header header\n" + DEFINITIONS["grid_map_msgs/msg/GridMapInfo"]
        }
        plain = {TYPE: DEFINITIONS[TYPE].replace("std_msgs/Header header\n", "")}
        for name, text in (stamped | plain).items():
            store.register(types.get_types_from_msg(text, name))
    kinds = store.types

    def message(layers: dict[str, np.ndarray]):
        rows, cols = next(iter(layers.values())).shape  # of the heights: y, x
        data = []
        for layer in layers.values():
            values = np.empty(rows * cols, np.float32)
            for j in range(cols):  # row of the GridMap, along -x
                for i in range(rows):  # column, along -y
                    row, col = (j + shift[0]) % cols, (i + shift[1]) % rows
                    values[col * cols + row] = layer[rows - 1 - i, cols - 1 - j]
            dims = [("column_index", rows, rows * cols), ("row_index", cols, cols)]
            layout = kinds["std_msgs/msg/MultiArrayLayout"](
                [kinds["std_msgs/msg/MultiArrayDimension"](*d) for d in dims], 0
            )
            data.append(kinds["std_msgs/msg/Float32MultiArray"](layout, values))
        stamp = kinds["builtin_interfaces/msg/Time"](0, 0)
        header = kinds["std_msgs/msg/Header"](*((0,) if ros1 else ()), stamp, "odom")
        quaternion = kinds["geometry_msgs/msg/Quaternion"](0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2))
        pose = kinds["geometry_msgs/msg/Pose"](kinds["geometry_msgs/msg/Point"](10.0, -3.0, 0.0), quaternion)
        size = CELL, cols * CELL, rows * CELL, pose
        info = kinds["grid_map_msgs/msg/GridMapInfo"](*((header, *size) if ros1 else size))
        rest = info, list(layers), [], data, shift[0], shift[1]
        return kinds[TYPE](*(rest if ros1 else (header, *rest)))

    if ros1:
        from rosbags.rosbag1 import Writer

        with Writer(path) as writer:
            connection = writer.add_connection(topic, TYPE, typestore=store)
            for second, layers in enumerate(maps):
                writer.write(connection, second * 10**9, store.serialize_ros1(message(layers), TYPE))
        return path
    plugin = engine.rosbag2.StoragePlugin
    folder = path.with_suffix(".folder")
    with engine.rosbag2.Writer(
        folder, version=9, storage_plugin=plugin.SQLITE3 if path.suffix == ".db3" else plugin.MCAP
    ) as writer:
        connection = writer.add_connection(topic, TYPE, typestore=store)
        for second, layers in enumerate(maps):
            writer.write(connection, second * 10**9, store.serialize_cdr(message(layers), TYPE))
    next(file for file in folder.iterdir() if file.suffix == path.suffix).rename(path)
    if not definitions:
        import sqlite3

        with sqlite3.connect(path) as database:
            database.execute("DELETE FROM message_definitions")
    return path


def read(path: Path, **options) -> np.ndarray:
    raster = read_grid_map(path, DemOptions(**options))
    return raster.heights[: raster.heights.shape[0], : raster.heights.shape[1]]


@pytest.mark.parametrize("shift", [(0, 0), (3, 2)])
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("map.bag", {"ros1": True}),
        ("map.mcap", {}),
        ("map.db3", {}),
        ("old.db3", {"definitions": False}),
    ],
)
def test_every_recording_gives_the_same_array(tmp_path, name, settings, shift):
    path = recorded(tmp_path / name, [{"elevation": heights()}], shift=shift, **settings)
    np.testing.assert_array_equal(read(path), heights())
    raster = read_grid_map(path, DemOptions())
    assert raster.cell_size == CELL
    assert raster.origin == pytest.approx((10 - 3 * CELL, -3 - 2 * CELL))
    assert raster.notes == ("frame 'odom'",)


@pytest.mark.parametrize("name", ["map.mcap", "map.db3"])
def test_what_is_written_is_read_back(tmp_path, name):
    write_grid_map(tmp_path / name, {"a": heights(), "b": -heights()}, CELL, (9.7, -3.2))
    np.testing.assert_array_equal(read(tmp_path / name, layer="b"), -heights())
    assert read_grid_map(tmp_path / name, DemOptions(layer="a")).origin == pytest.approx((9.7, -3.2))


def test_load_dem_reads_a_recording(tmp_path):
    ground = np.random.default_rng(0).normal(size=(41, 51)).astype(np.float32)
    path = recorded(tmp_path / "map.mcap", [{"elevation": ground}])
    windows = load_dem(path, 4.0, grid=Grid(4, CELL))
    assert len(windows) == 1 and windows.origins[0] == pytest.approx((10 - 25 * CELL, -3 - 20 * CELL))
    np.testing.assert_allclose(windows.heights[0], ground[:41, :41] - windows.height_offset, atol=1e-6)


def test_the_latest_map_is_read_unless_a_time_is_given(tmp_path):
    maps = [{"elevation": heights() + second} for second in range(3)]
    path = recorded(tmp_path / "map.mcap", maps)
    np.testing.assert_allclose(read(path), heights() + 2)
    np.testing.assert_allclose(read(path, time=1.5), heights() + 1)
    np.testing.assert_allclose(read(path, time=0), heights())


@pytest.mark.parametrize(
    ("settings", "options", "message"),
    [
        ({}, {"layer": "height"}, "layer = 'height': must be elevation or variance"),
        ({}, {}, r"layer: must be chosen \(--layer\): elevation or variance$"),
        ({}, {"layer": "elevation", "topic": "/map"}, "topic = '/map': must be /grid_map"),
        ({"turn": 0.2}, {"layer": "elevation"}, "pose, orientation = 11.459: must be 0 degrees"),
    ],
)
def test_what_has_to_be_chosen_is_named(tmp_path, settings, options, message):
    path = recorded(tmp_path / "map.mcap", [{"elevation": heights(), "variance": heights()}], **settings)
    with pytest.raises(InputError, match=message):
        read(path, **options)


def test_all_layers_are_listed_unless_they_are_very_many(tmp_path):
    names = [f"uncertainty_of_kind_{number}" for number in range(12)]
    write_grid_map(tmp_path / "few.mcap", dict.fromkeys(names, heights()), CELL, (0.0, 0.0))
    with pytest.raises(InputError, match=rf"--layer\): {' or '.join(names)}$"):
        read(tmp_path / "few.mcap")
    with pytest.raises(InputError, match=rf"^layer = 'other': must be {' or '.join(names)}$"):
        read(tmp_path / "few.mcap", layer="other")
    many = [f"layer_{number}" for number in range(200)]
    write_grid_map(tmp_path / "many.mcap", dict.fromkeys(many, heights()), CELL, (0.0, 0.0))
    with pytest.raises(InputError, match=r"layer_0 or layer_1 or .* or layer_\d+ \.\.\. \(200 in all\)$"):
        read(tmp_path / "many.mcap")


def test_other_recordings_and_damaged_ones_are_one_line(tmp_path):
    path = recorded(tmp_path / "map.mcap", [{"elevation": heights()}])
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match="cannot be read as a recording of ROS"):
        read(tmp_path / "cut.mcap")
    code, _, err = run_words("label", tmp_path / "cut.mcap", "--out", tmp_path / "out")
    assert code == 2 and err.count("\n") == 1 and "cut.mcap" in err


def test_a_missing_library_is_named(monkeypatch, tmp_path):
    path = recorded(tmp_path / "map.mcap", [{"elevation": heights()}])
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r'rosbags: not installed; needed: pip install "travjax\[ros\]"'):
        read(path)


def test_bad_options_are_named():
    with pytest.raises(InputError, match="time = -1: must be seconds from 0"):
        replace(DemOptions(), time=-1)
    with pytest.raises(InputError, match="layer = '': must be a name"):
        DemOptions(layer="")
