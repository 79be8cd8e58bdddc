"""Paths as files: a table of poses, GeoJSON, GPX, and nav_msgs/Path in recordings of ROS (SPEC section 14).

Each file is written whole or not at all. GeoJSON and GPX give longitude, latitude (WGS 84) and the heights of the site,
so they exist only where the site's coordinates say where on the earth it lies.
"""

import json
import math
from pathlib import Path as FilePath
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float, Int

from travjax.config import InputError
from travjax.files import atomic_write, output_folder, save_text
from travjax.planning.endpoints import from_earth
from travjax.planning.path import Path
from travjax.planning.planner import Plan, Planner
from travjax.rasters.coordinates import why_not_on_earth
from travjax.rasters.recordings import Kind, header, kind_of, pose, require_recording, typestore, write_message
from travjax.site.ground import Site

COLUMNS = ("x", "y", "z", "heading_deg", "distance", "primitive", "step", "obstacle", "tilt")
"""Columns of path.csv."""

TOPIC, KIND = "/plan", "nav_msgs/msg/Path"
"""Where a path is in a recording, and its type."""

GPX = {
    "version": "1.1",
    "creator": "travjax",
    "xmlns": "http://www.topografix.com/GPX/1/1",
    "xmlns:xsi": "http://www.w3.org/2001/XMLSchema-instance",
    "xsi:schemaLocation": "http://www.topografix.com/GPX/1/1 http://www.topografix.com/GPX/1/1/gpx.xsd",
}
"""Attributes of a GPX file."""


def save_path(folder: str | FilePath, plan: Plan, planner: Planner) -> tuple[list[FilePath], list[str]]:
    """Writes path.csv, path.geojson and path.gpx into a folder, which is made if need be.

    planner: that found the plan
    Returns the files, and lines that say what was not written and why; files of that name from an earlier plan are
    removed then. Raises InputError when something cannot be written.
    """
    folder = output_folder(folder)
    files = [save_csv(folder / "path.csv", plan.path)]
    drawn = {folder / "path.geojson": save_geojson, folder / "path.gpx": save_gpx}
    reason = _why_not_on_earth(plan, planner.costs.ground)
    if reason is None:
        return files + [save(file, plan, planner) for file, save in drawn.items()], []
    for file in drawn:
        file.unlink(missing_ok=True)
    return files, [f"{' and '.join(file.name for file in drawn)}: not written: {reason}"]


def save_csv(file: FilePath, path: Path) -> FilePath:
    """Writes the poses of a path as a table with a line of COLUMNS; returns the file.

    Metres, degrees anticlockwise from +y (north) from 0 to 360, and for the tilt radians; `nan` where the ground is
    unknown, which pandas, NumPy and float() read as NaN.
    """
    x, y, heading = path.pose.T
    places = [_rounded(values, 4) for values in (x, y, path.z, np.degrees(heading))]
    places[3] %= 360
    margins = [_rounded(values, 6) for values in (path.step, path.obstacle, path.tilt)]
    text = [
        *([f"{value:.4f}" for value in values] for values in (*places, _rounded(path.distance, 4))),
        path.motion,
        *([f"{value:.6f}" for value in values] for values in margins),
    ]
    lines = (",".join(row) for row in zip(*text, strict=True))
    return save_text(file, "".join(f"{line}\n" for line in (",".join(COLUMNS), *lines)))


def save_geojson(file: FilePath, plan: Plan, planner: Planner) -> FilePath:
    """Writes a path as GeoJSON: a line, and the points where it begins, passes and ends; returns the file.

    Positions without a height lie on unknown ground. A path of one place is a line of two positions there.
    Raises InputError where the site does not say where on the earth it lies. Source: RFC 7946.
    """
    line, points = _positions(plan, planner.costs.ground)
    setup = planner.setup
    properties = {
        "length_m": round(plan.path.length, 4),
        "cost": round(plan.cost, 4),
        "robot": setup.robot.name,
        "contact": setup.contact,
    }
    features = [
        feature("LineString", line if len(line) > 1 else 2 * line, properties),
        *(feature("Point", at, {"name": one.name}) for one, at in zip(plan.points, points, strict=True)),
    ]
    collection = {"type": "FeatureCollection", "features": features}
    return save_text(file, json.dumps(collection, allow_nan=False, indent=1) + "\n")


def save_gpx(file: FilePath, plan: Plan, planner: Planner) -> FilePath:
    """Writes a path as GPX 1.1: a track, and the points where it begins, passes and ends; returns the file.

    Points without an elevation lie on unknown ground.
    Raises InputError where the site does not say where on the earth it lies.
    """
    line, points = _positions(plan, planner.costs.ground)
    root = ElementTree.Element("gpx", GPX)
    for one, at in zip(plan.points, points, strict=True):
        ElementTree.SubElement(_gpx_point(root, "wpt", at), "name").text = one.name
    track = ElementTree.SubElement(root, "trk")
    ElementTree.SubElement(track, "name").text = planner.setup.robot.name
    ElementTree.SubElement(track, "desc").text = f"{plan.path.length:.2f} m, {planner.setup.contact}"
    segment = ElementTree.SubElement(track, "trkseg")
    for at in line:
        _gpx_point(segment, "trkpt", at)
    ElementTree.indent(root, " ")
    with atomic_write(file) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="UTF-8", xml_declaration=True)
    return file


def save_ros_path(file: FilePath, plan: Plan, planner: Planner) -> FilePath:
    """Writes a path as one message nav_msgs/Path on the topic /plan, in the frame of the site or "map"; returns the
    file.

    file: .mcap or .db3
    Raises InputError when rosbags is missing, and when the file cannot be written.
    """
    require_recording("path", file)
    store = typestore({})
    kind = kind_of(store)
    message = path_message(kind, header(kind, planner.costs.ground.frame or "map"), plan.path)
    with atomic_write(file) as temporary:
        write_message(temporary, TOPIC, KIND, message, store)
    return file


def path_message(kind: Kind, header: Any, path: Path) -> Any:
    """Returns a path as a message nav_msgs/Path, of which each pose has the same header.

    Yaw counts from +x, as everywhere in ROS. On unknown ground the height is that between the nearest poses on known
    ground.
    """
    z = np.where(path.known, path.z, 0)
    if path.known.any():
        between = np.interp(path.distance, path.distance[path.known], path.z[path.known])
        z = np.where(path.known, path.z, between)
    stamped = kind("geometry_msgs/msg/PoseStamped")
    poses = [
        stamped(header=header, pose=pose(kind, x, y, height, heading + math.pi / 2))
        for (x, y, heading), height in zip(path.pose.tolist(), z.tolist(), strict=True)
    ]
    return kind(KIND)(header=header, poses=poses)


def feature(kind: str, coordinates: list, properties: dict[str, Any]) -> dict[str, Any]:
    """Returns a feature of GeoJSON with a geometry of some kind."""
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def _rounded(values: Float[np.ndarray, " p"], digits: int) -> Float[np.ndarray, " p"]:
    """Returns rounded values, without negative zeros."""
    return np.round(values, digits) + 0.0


def _why_not_on_earth(plan: Plan, ground: Site) -> str | None:
    return why_not_on_earth(ground.crs, *plan.path.pose[0, :2].tolist())


def _positions(plan: Plan, ground: Site) -> tuple[list[list[float]], list[list[float]]]:
    """Returns where on earth a path leads, place by place, and where its points are."""
    reason = _why_not_on_earth(plan, ground)
    if reason is not None:
        raise InputError(f"site: {reason}: must be a coordinate system that says where on the earth it lies")
    path = plan.path
    moved = np.diff(path.distance, prepend=-1) > 0  # a point turn stays in one place
    nearest = [int(np.hypot(path.pose[:, 0] - one.x, path.pose[:, 1] - one.y).argmin()) for one in plan.points]
    return _on_earth(path, moved.nonzero()[0], ground), _on_earth(path, np.array(nearest), ground)


def _on_earth(path: Path, rows: Int[np.ndarray, " r"], ground: Site) -> list[list[float]]:
    """Returns the longitude, latitude and, where it is known, height of some poses."""
    x, y, _ = path.pose[rows].T
    longitude, latitude = from_earth(ground.crs).transform(x, y, direction="INVERSE", errcheck=True)
    at = np.stack([np.round(longitude, 9), np.round(latitude, 9), np.round(path.z[rows], 4)], axis=1).tolist()
    return [position if math.isfinite(position[2]) else position[:2] for position in at]


def _gpx_point(parent: ElementTree.Element, tag: str, at: list[float]) -> ElementTree.Element:
    longitude, latitude, *height = at
    point = ElementTree.SubElement(parent, tag, lat=f"{latitude:.9f}", lon=f"{longitude:.9f}")
    for value in height:
        ElementTree.SubElement(point, "ele").text = f"{value:.4f}"
    return point
