"""grid_map_msgs/GridMap in recordings of ROS: ROS 1 .bag, ROS 2 .db3 and .mcap, read and written without ROS.

Rows of a GridMap run along -x and its columns along -y, from the corner with the largest x and y; its layers may be
circular buffers. Here, row 0 is the southernmost and column 0 the westernmost.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from travjax.config import InputError, require
from travjax.rasters.raster import InMetres, Raster, agreed_cell_size
from travjax.rasters.reading_options import DemOptions
from travjax.rasters.recordings import Kind, header, kind_of, pose, rosbags, typestore, write_message

TYPE = "grid_map_msgs/msg/GridMap"

DEFINITIONS = {
    "grid_map_msgs/msg/GridMapInfo": """float64 resolution
float64 length_x
float64 length_y
geometry_msgs/Pose pose
""",
    TYPE: """std_msgs/Header header
grid_map_msgs/GridMapInfo info
string[] layers
string[] basic_layers
std_msgs/Float32MultiArray[] data
uint16 outer_start_index
uint16 inner_start_index
""",
}
"""Definitions of the messages as ROS 2 has them, for recordings that do not carry them."""

LISTED = 400
"""Characters of names that a message lists, at most."""

TURNED = 1e-3
"""Radians, the largest angle of a map's pose that counts as none."""


def grid_map_types() -> Any:
    """Returns the message types of ROS 2, and those of grid_map."""
    return typestore(DEFINITIONS)


def read_grid_map(path: Path, options: DemOptions) -> Raster:
    """Reads a layer of a recorded GridMap: the latest message, or the latest until options.time.

    Raises InputError when the recording is damaged or holds no GridMap, when topic or layer have to be chosen, and when
    the map is turned.
    """
    engine = rosbags()
    try:
        with engine.highlevel.AnyReader([path], default_typestore=grid_map_types()) as reader:
            message = _message(reader, options)
            return raster_of(message, options)
    except InputError:
        raise
    except Exception as error:  # rosbags raises whatever its parsers do
        raise InputError(f"cannot be read as a recording of ROS: {str(error)[:160] or type(error).__name__}") from None


def _message(reader: Any, options: DemOptions) -> Any:
    """Returns the message to use."""
    found = [one for one in reader.connections if one.msgtype == TYPE]
    require(bool(found), "topics", sorted({one.msgtype for one in reader.connections}), f"some of type {TYPE}")
    topic = _chosen("topic", options.topic, sorted({one.topic for one in found}))
    found = [one for one in found if one.topic == topic]
    until = math.inf if options.time is None else reader.start_time + 1e9 * options.time
    latest = None
    for connection, time, raw in reader.messages(connections=found):
        if time <= until:
            latest = connection, raw
    require(
        latest is not None, "time", options.time, "seconds from the start of the recording, at or after the first map"
    )
    assert latest is not None
    return reader.deserialize(latest[1], latest[0].msgtype)


def raster_of(message: Any, options: DemOptions) -> Raster:
    """Returns a layer of a GridMap, a message of rosbags or of ROS.

    Raises InputError when the layer has to be chosen, or is not there, and when the map is turned.
    """
    layers = list(message.layers)
    require(len(layers) > 0, "layers", layers, "at least one")
    info, index = message.info, layers.index(_chosen("layer", options.layer, layers))
    turned = info.pose.orientation
    angle = 2 * math.atan2(math.hypot(turned.x, turned.y, turned.z), abs(turned.w)) if turned.w or turned.z else 0.0
    require(angle < TURNED, "pose, orientation", round(math.degrees(angle), 3), "0 degrees; turn the map first")
    cell_size = agreed_cell_size(float(info.resolution), options.cell_size)
    heights = _unrolled(message.data[index], message.outer_start_index, message.inner_start_index)[::-1, ::-1].T
    rows, cols = heights.shape
    centre = info.pose.position
    origin = float(centre.x) - (cols - 1) / 2 * cell_size, float(centre.y) - (rows - 1) / 2 * cell_size
    scale = 1.0 if options.height_scale is None else options.height_scale
    frame = str((message if hasattr(message, "header") else info).header.frame_id)  # it lies in ROS 1 within info
    values = InMetres(np.ascontiguousarray(heights), scale, nodata=options.nodata)
    return Raster(values, cell_size, origin, None, (f"frame {frame!r}",), frame=frame)


def _chosen(what: str, given: str | None, names: list[str]) -> str:
    """Returns the given name, or the only one there is; raises InputError that lists the names."""
    listed = " or ".join(names)
    if len(listed) > LISTED:
        listed = f"{listed[:LISTED].rpartition(' or ')[0] or listed[:LISTED]} ... ({len(names)} in all)"
    if given is None and len(names) > 1:
        raise InputError(f"{what}: must be chosen (--{what}): {listed}")
    name = names[0] if given is None else given
    require(name in names, what, name, listed)
    return name


def _unrolled(layer: Any, outer: int, inner: int) -> np.ndarray:
    """Returns a layer [rows along -x, columns along -y] without the circular buffer's shifts."""
    dims = {dim.label: int(dim.size) for dim in layer.layout.dim}
    require(dims.keys() == {"column_index", "row_index"}, "layout", list(dims), "column_index and row_index")
    rows, cols, values = dims["row_index"], dims["column_index"], np.asarray(layer.data, np.float32)
    require(values.size == rows * cols, "data", values.size, f"{rows} x {cols} values")
    by_column = layer.layout.dim[0].label == "column_index"
    array = values.reshape(cols, rows).T if by_column else values.reshape(rows, cols)
    return np.roll(array, (-int(outer), -int(inner)), axis=(0, 1))


def write_grid_map(
    path: Path, layers: Mapping[str, np.ndarray], cell_size: float, origin: tuple[float, float], frame: str = "map"
) -> None:
    """Writes layers [rows, cols] as one message on the topic /grid_map; path: a new file, .mcap or .db3.

    origin: x, y of the south-west cell's middle, metres
    """
    store = grid_map_types()
    kind = kind_of(store)
    message = grid_map_message(kind, header(kind, frame), layers, cell_size, origin)
    write_message(path, "/grid_map", TYPE, message, store)


def grid_map_message(
    kind: Kind, header: Any, layers: Mapping[str, np.ndarray], cell_size: float, origin: tuple[float, float]
) -> Any:
    """Returns layers [rows, cols] as one message with a header.

    origin: x, y of the south-west cell's middle, metres
    """
    rows, cols = next(iter(layers.values())).shape
    x, y = origin[0] + (cols - 1) / 2 * cell_size, origin[1] + (rows - 1) / 2 * cell_size
    info = kind("grid_map_msgs/msg/GridMapInfo")(
        resolution=cell_size, length_x=cols * cell_size, length_y=rows * cell_size, pose=pose(kind, x, y)
    )
    dimension = kind("std_msgs/msg/MultiArrayDimension")
    dims = [
        dimension(label="column_index", size=rows, stride=rows * cols),
        dimension(label="row_index", size=cols, stride=cols),
    ]
    layout = kind("std_msgs/msg/MultiArrayLayout")(dim=dims, data_offset=0)
    values = [np.ascontiguousarray(layer[::-1, ::-1], np.float32).ravel() for layer in layers.values()]
    return kind(TYPE)(
        header=header,
        info=info,
        layers=list(layers),
        basic_layers=[],
        data=[kind("std_msgs/msg/Float32MultiArray")(layout=layout, data=one) for one in values],
        outer_start_index=0,
        inner_start_index=0,
    )
