"""Meshes as rasters: the surface of OBJ, STL and glTF files as seen from above (SPEC section 11).

Nothing outside the file is opened: no materials, no textures, no buffers in other files.
"""

import base64
import json
import warnings
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from travjax.config import InputError
from travjax.point_clouds.points import installed, reason_of
from travjax.rasters.raster import Raster

COMPONENTS = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
"""Bytes of a number of a glTF accessor, by its code."""

ITEMS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
"""Numbers in an item of a glTF accessor."""

HARMLESS = ("KHR_materials", "KHR_texture", "KHR_lights", "EXT_texture", "KHR_xmp")
"""What the names of glTF extensions begin with that change no shape."""

MOST_COVERED = 2**31
"""Nodes that all triangles of a mesh lie above, one over the other."""

NODES_AT_ONCE = 2**19
EDGE = 1e-6
"""Share of a cell: nodes as near as that to a triangle's edge lie on it."""


class Mesh(NamedTuple):
    """Corners [n, 3] of the triangles [m, 3], and the axis that the format says is up, or None."""

    vertices: np.ndarray
    faces: np.ndarray
    up: str | None


def read_mesh(path: Path) -> Mesh:
    """Reads the triangles of an OBJ, STL, glTF or GLB file, which what is in it tells apart; points where it has none.

    Raises InputError when it cannot be read, or needs another file.
    """
    trimesh = installed("trimesh")
    content = path.read_bytes()
    kind = _kind(content, path.suffix.lower())
    if kind in ("glb", "gltf"):
        _require_whole(content, kind)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scene = trimesh.load_scene(
                BytesIO(content), file_type=kind, process=False, maintain_order=True, skip_materials=True
            )
            parts = [_placed(scene, node) for node in scene.graph.nodes_geometry]
    except MemoryError:
        raise
    except Exception as error:  # of whatever kind: trimesh names none
        raise InputError(f"cannot be read as {kind.upper()}: {reason_of(error)}") from None
    if not parts:
        raise InputError(f"cannot be read as {kind.upper()}: it holds no triangles")
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + start for (_, faces), start in zip(parts, starts, strict=False)])
    return Mesh(vertices, faces, "y" if kind in ("glb", "gltf") else None)


def _kind(content: bytes, suffix: str) -> str:
    start = content[:512].lstrip(b"\xef\xbb\xbf \t\r\n")
    if start.startswith(b"glTF"):
        return "glb"
    if start.startswith(b"{"):
        return "gltf"
    triangles = int.from_bytes(content[80:84], "little")
    if suffix == ".stl" or start.startswith(b"solid") or (len(content) > 84 and len(content) == 84 + 50 * triangles):
        return "stl"
    return "obj"


def _placed(scene: Any, node: Any) -> tuple[np.ndarray, np.ndarray]:
    """Returns (vertices as a node of the scene places them, faces); points and lines have no faces."""
    transform, name = scene.graph[node]
    geometry = scene.geometry[name]
    vertices = np.asarray(geometry.vertices, np.float64)
    if not np.array_equal(transform, np.eye(4)):
        vertices = vertices @ transform[:3, :3].T + transform[:3, 3]
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"vertices: {list(vertices.shape)}: must be x, y, z")
    faces = np.asarray(getattr(geometry, "faces", ()), np.int64).reshape(-1, 3)
    if faces.size and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ValueError(f"a face names vertex {faces.max()} of {len(vertices)}")
    return vertices, faces


def _require_whole(content: bytes, kind: str) -> None:
    """Raises InputError unless all that a glTF file names is in it, and as long as it says."""
    try:
        tree, binary = _tree(content, kind)
        lengths = [_length(buffer, binary if number == 0 else None) for number, buffer in enumerate(tree["buffers"])]
        views, accessors = tree["bufferViews"], tree["accessors"]
        for number, view in enumerate(views):
            start, size = view.get("byteOffset", 0), view["byteLength"]
            if min(start, size, view["buffer"]) < 0 or start + size > lengths[view["buffer"]]:
                raise InputError(f"bufferViews {number} = {size} bytes: must lie in its buffer; it is cut short")
        if sum(view["byteLength"] for view in views) > 4 * len(content) + 1024:
            raise InputError("bufferViews: must not be longer together than the file")
        for number, accessor in enumerate(accessors):
            _require_accessor(f"accessors {number}", accessor, views)
        children = [child for node in tree.get("nodes", []) for child in node.get("children", [])]
        if len(set(children)) < len(children):
            raise InputError("nodes: must have one parent each")
        for name in tree.get("extensionsRequired", []):
            if not str(name).startswith(HARMLESS):
                raise InputError(f"extensionsRequired = {str(name)[:60]!r}: is not read; store it without")
    except (KeyError, TypeError, IndexError, AttributeError, ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"cannot be read as {kind.upper()}: {type(error).__name__}: {reason_of(error)}") from None


def _tree(content: bytes, kind: str) -> tuple[dict[str, Any], bytes | None]:
    """Reads (the JSON, the binary part of a GLB file)."""
    if kind == "gltf":
        return json.loads(content.decode("utf-8-sig")), None
    size = int.from_bytes(content[12:16], "little")
    binary = content[20 + size :]
    if content[16:20] != b"JSON" or len(content) < 20 + size or int.from_bytes(content[8:12], "little") > len(content):
        raise InputError("cannot be read as GLB: it is cut short")
    length = int.from_bytes(binary[:4], "little")
    if binary and length > len(binary) - 8:
        raise InputError(f"cannot be read as GLB: {length} bytes of data: it is cut short")
    return json.loads(content[20 : 20 + size]), binary[8 : 8 + length]


def _length(buffer: dict[str, Any], binary: bytes | None) -> int:
    """Returns the bytes that a buffer holds, which is the binary part of a GLB file or part of the JSON."""
    uri = buffer.get("uri")
    if uri is None:
        held = len(binary or b"")
    elif isinstance(uri, str) and uri.startswith("data:") and "base64," in uri:
        held = len(base64.b64decode(uri.partition("base64,")[2]))
    else:
        raise InputError(f"buffers: uri = {str(uri)[:60]!r}: must be in the file itself (store it as .glb)")
    if held < buffer["byteLength"]:
        raise InputError(f"buffers = {buffer['byteLength']} bytes: must be the {held} there; it is cut short")
    return held


def _require_accessor(name: str, accessor: dict[str, Any], views: list[dict[str, Any]]) -> None:
    item = COMPONENTS[accessor["componentType"]] * ITEMS[accessor["type"]]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise InputError(f"{name}: is sparse or without data: must be stored in full")
    view, count, start = views[accessor["bufferView"]], accessor["count"], accessor.get("byteOffset", 0)
    stride = view.get("byteStride", item)
    if type(count) is not int or count < 1 or start < 0 or stride < item or accessor["bufferView"] < 0:
        raise InputError(f"{name} = {count}: must be numbers, one after the other")
    if start + (count - 1) * stride + item > view["byteLength"]:
        raise InputError(f"{name} = {count}: must fit into {view['byteLength']} bytes; it is cut short")


# ---- Surface


def surface(corners: np.ndarray, cell_size: float, shape: tuple[int, int]) -> Raster:
    """Returns the highest point of triangles above each node, from their own south-west corner; NaN beside them.

    corners: [m, 3, 3] metres, x, y, z of the triangles' corners
    shape:   rows and columns of the raster
    """
    west, south = corners[..., :2].min(axis=(0, 1))
    nodes = (corners - [west, south, 0]) / [cell_size, cell_size, 1]
    nodes = np.take_along_axis(nodes, np.argsort(nodes[..., 1], axis=1)[..., None], axis=1)  # from south to north
    plane = _planes(nodes)
    nodes, plane = nodes[~np.isnan(plane[:, 0])], plane[~np.isnan(plane[:, 0])]  # upright ones have no area from above
    boxes = np.prod(np.ptp(nodes[..., :2], axis=1) + 1, axis=1)
    if boxes.sum() > MOST_COVERED:
        raise InputError(f"triangles = {len(nodes)}: cover more than {MOST_COVERED} nodes, one over the other")
    heights = np.full(shape, -np.inf)
    lowest, highest = nodes[..., 2].min(axis=1), nodes[..., 2].max(axis=1)
    for chosen, row, first, number in _spans(nodes, shape):
        col = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number) + np.repeat(first, number)
        chosen, row = np.repeat(chosen, number), np.repeat(row, number)
        east, north, level = plane[chosen].T
        values = level + east * (col - nodes[chosen, 0, 0]) + north * (row - nodes[chosen, 0, 1])
        np.maximum.at(heights, (row, col), np.clip(values, lowest[chosen], highest[chosen]))
    heights[np.isinf(heights)] = np.nan
    return Raster(heights, float(cell_size), (float(west), float(south)))


def _planes(nodes: np.ndarray) -> np.ndarray:
    """Slopes per node to the east and the north, and height of the first corner [m, 3]; NaN of upright triangles."""
    (u1, v1, z1), (u2, v2, z2) = ((nodes[:, corner] - nodes[:, 0]).T for corner in (1, 2))
    area = u1 * v2 - u2 * v1
    extent = np.maximum(np.abs(u1) + np.abs(u2), np.abs(v1) + np.abs(v2))
    flat = np.abs(area) > 1e-12 * extent**2
    east = np.divide(z1 * v2 - z2 * v1, area, out=np.full(len(nodes), np.nan), where=flat)
    north = np.divide(u1 * z2 - u2 * z1, area, out=np.full(len(nodes), np.nan), where=flat)
    return np.stack([east, north, nodes[:, 0, 2]], axis=1)


def _spans(nodes: np.ndarray, shape: tuple[int, int]) -> Iterator[tuple[np.ndarray, ...]]:
    """Yields (triangle, row, first column, number of columns) of the nodes on triangles, about NODES_AT_ONCE at a
    time.
    """
    first = np.maximum(np.ceil(nodes[:, 0, 1] - EDGE), 0).astype(np.int64)
    last = np.minimum(np.floor(nodes[:, 2, 1] + EDGE), shape[0] - 1).astype(np.int64)
    for some in _portions(np.maximum(last - first + 1, 0)):
        number = np.maximum(last[some] - first[some] + 1, 0)
        chosen = np.repeat(np.arange(some.start, some.stop), number)
        row = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number) + np.repeat(first[some], number)
        south, middle, north = (nodes[chosen, corner] for corner in range(3))
        at = np.clip(row, south[:, 1], north[:, 1])
        long = _crossing(south, north, at)
        short = np.where(at < middle[:, 1], _crossing(south, middle, at), _crossing(middle, north, at))
        west = np.maximum(np.ceil(np.minimum(long, short) - EDGE), 0).astype(np.int64)
        east = np.minimum(np.floor(np.maximum(long, short) + EDGE), shape[1] - 1).astype(np.int64)
        across = np.maximum(east - west + 1, 0)
        for part in _portions(across):
            yield chosen[part], row[part], west[part], across[part]


def _crossing(one: np.ndarray, other: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Returns the columns where edges [n, 3] cross a row; an edge along the row counts from its first corner."""
    rise = other[:, 1] - one[:, 1]
    share = np.divide(at - one[:, 1], rise, out=np.zeros(len(at)), where=rise > 0)
    return one[:, 0] + np.clip(share, 0, 1) * (other[:, 0] - one[:, 0])


def _portions(sizes: np.ndarray) -> Iterator[slice]:
    """Slices whose sizes sum up to about NODES_AT_ONCE."""
    ends = np.cumsum(sizes)
    start = 0
    while start < len(sizes):
        before = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, before + NODES_AT_ONCE, side="right")))
        stop = min(stop, start + NODES_AT_ONCE)
        yield slice(start, stop)
        start = stop
