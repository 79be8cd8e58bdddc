"""Messages of ROS, and recordings of them by the package rosbags, without ROS."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from travjax.config import require, require_installed

SUFFIXES = (".mcap", ".db3")
"""What the names of recordings that can be written end in."""

Kind = Callable[[str], Any]
"""Returns the class of messages by its name, such as nav_msgs/msg/Path: one of rosbags, or of ROS itself."""


def rosbags() -> ModuleType:
    """Returns the package rosbags; raises InputError that says how to install it where it is missing."""
    require_installed("rosbags", "rosbags", "ros")
    import rosbags.highlevel
    import rosbags.rosbag2
    import rosbags.typesys

    return rosbags


def typestore(definitions: Mapping[str, str]) -> Any:
    """Returns the message types of ROS 2, and further ones by their name and definition."""
    types = rosbags().typesys
    store = types.get_typestore(types.Stores.ROS2_HUMBLE)
    for name, text in definitions.items():
        store.register(types.get_types_from_msg(text, name))
    return store


def kind_of(store: Any) -> Kind:
    """Returns what finds the classes of rosbags among the message types of `typestore`."""
    return store.types.__getitem__


def require_recording(field: str, path: Path) -> None:
    """Raises InputError, which begins with the field, unless a recording can be written there."""
    rosbags()
    fits = path.suffix in SUFFIXES and path.parent.is_dir() and not path.is_dir()
    require(fits, field, str(path), f"a file in a folder that exists, its name ending in {' or '.join(SUFFIXES)}")


def header(kind: Kind, frame: str) -> Any:
    """Returns the header of a message in a frame, at time 0."""
    return kind("std_msgs/msg/Header")(stamp=kind("builtin_interfaces/msg/Time")(sec=0, nanosec=0), frame_id=frame)


def pose(kind: Kind, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> Any:
    """Returns a pose of something level; x, y, z: metres; yaw: radians, anticlockwise from +x."""
    half = yaw / 2
    return kind("geometry_msgs/msg/Pose")(
        position=kind("geometry_msgs/msg/Point")(x=x, y=y, z=z),
        orientation=kind("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=math.sin(half), w=math.cos(half)),
    )


def write_message(path: Path, topic: str, kind: str, message: Any, store: Any) -> None:
    """Writes one message of a kind at time 0; path: a new file, .mcap or .db3."""
    engine = rosbags().rosbag2
    folder = path.with_name(f"{path.name}.bag")
    plugin = engine.StoragePlugin.SQLITE3 if path.suffix == ".db3" else engine.StoragePlugin.MCAP
    with engine.Writer(folder, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection(topic, kind, typestore=store)
        writer.write(connection, 0, store.serialize_cdr(message, kind))
    next(file for file in folder.iterdir() if file.suffix == path.suffix).rename(path)
