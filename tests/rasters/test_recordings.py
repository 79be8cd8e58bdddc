"""Recordings of ROS: poses, and where a recording can be written."""

import math

import pytest

from travjax.config import InputError
from travjax.rasters.recordings import header, kind_of, pose, require_recording, typestore, write_message

pytest.importorskip("rosbags", reason="the extra ros is not installed")


@pytest.mark.parametrize("yaw", [0.0, 0.5, -2.0, math.pi, 6.0])
def test_the_yaw_of_a_pose_counts_from_x(yaw):
    made = pose(kind_of(typestore({})), 1.0, 2.0, 3.0, yaw)
    z, w = made.orientation.z, made.orientation.w
    assert (made.position.x, made.position.y, made.position.z) == (1, 2, 3)
    assert made.orientation.x == made.orientation.y == 0
    assert (w**2 - z**2, 2 * z * w) == pytest.approx((math.cos(yaw), math.sin(yaw)))


@pytest.mark.parametrize("name", ["out.mcap", "out.db3"])
def test_a_message_is_read_back(tmp_path, name):
    from rosbags.highlevel import AnyReader

    store = typestore({"mine_msgs/msg/Numbers": "std_msgs/Header header\nfloat64[] numbers\n"})
    numbers = store.types["std_msgs/msg/Float64"](2.5)
    write_message(tmp_path / name, "/number", "std_msgs/msg/Float64", numbers, store)
    with AnyReader([tmp_path / name], default_typestore=store) as reader:
        ((connection, time, raw),) = reader.messages()
        assert (connection.topic, time, reader.deserialize(raw, connection.msgtype).data) == ("/number", 0, 2.5)
    assert "mine_msgs/msg/Numbers" in store.types and header(kind_of(store), "odom").frame_id == "odom"


@pytest.mark.parametrize("name", ["out.bag", "none/out.mcap", "folder.mcap"])
def test_a_recording_is_a_file_of_its_kind_in_a_folder_that_exists(tmp_path, name):
    (tmp_path / "folder.mcap").mkdir()
    require_recording("--out", tmp_path / "out.mcap")
    with pytest.raises(InputError, match=r"^--out = .*: must be a file in a folder that exists, its name ending in"):
        require_recording("--out", tmp_path / name)
