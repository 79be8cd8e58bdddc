"""Point clouds for tests: the same points in every format that is read."""

from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import plyfile


def points_of(heights: np.ndarray, cell: float, west: float = 0.0, south: float = 0.0) -> np.ndarray:
    """A raster's known values as points [n, 3], x, y, z, in no order."""
    row, col = np.nonzero(~np.isnan(heights))
    points = np.stack([west + cell * col, south + cell * row, heights[row, col]], axis=1)
    return np.random.default_rng(0).permutation(points)


def write_text(path: Path, points: np.ndarray, separator: str = " ", header: str = "", form: str = "%.9g") -> Path:
    lines = [separator.join(form % value for value in point) for point in points.tolist()]
    path.write_text("\n".join([header, *lines] if header else lines) + "\n")
    return path


def write_pts(path: Path, points: np.ndarray) -> Path:
    """With the number of points in the first line, intensity and colours."""
    return write_text(path, np.hstack([points, np.full((len(points), 4), 7)]), header=str(len(points)))


def write_ply(path: Path, points: np.ndarray, kind: str = "f8", elements=(), **options) -> Path:
    """Vertices with a property before and after the coordinates; elements are (name, array) before and after them."""
    names = ("quality", "x", "y", "z", "label")
    vertices = np.zeros(len(points), [(name, kind) for name in names])
    for axis, values in zip("xyz", points.T, strict=True):
        vertices[axis] = values
    described = [plyfile.PlyElement.describe(array, name) for name, array in (("vertex", vertices), *elements)]
    plyfile.PlyData(described, **options).write(path)
    return path


def write_las(
    path: Path, points: np.ndarray, scale: float = 2**-6, records=(), point_format: int = 3, **fields
) -> Path:
    """Coordinates to multiples of the scale; fields are other dimensions of the points, records go into the header."""
    header = laspy.LasHeader(point_format=point_format, version="1.4" if point_format > 5 else "1.2")
    header.scales, header.offsets = np.full(3, scale), np.floor(points.min(axis=0))
    header.vlrs.extend(records)
    file = laspy.LasData(header)
    file.x, file.y, file.z = points.T
    for name, values in fields.items():
        setattr(file, name, values)
    file.write(path)
    return path


CLOUDS: dict[str, tuple[str, Callable[[Path, np.ndarray], Path]]] = {
    "XYZ": ("site.xyz", write_text),
    "text": ("site.txt", lambda path, points: write_text(path, points, "\t")),
    "CSV": ("site.csv", lambda path, points: write_text(path, points[:, [1, 2, 0]], ",", "northing,height,easting")),
    "PTS": ("site.pts", write_pts),
    "PLY in text": ("site.ply", lambda path, points: write_ply(path, points, text=True)),
    "PLY": ("site.ply", lambda path, points: write_ply(path, points, byte_order="<")),
    "PLY, big-endian": ("site.ply", lambda path, points: write_ply(path, points, byte_order=">")),
    "LAS": ("site.las", write_las),
    "LAS 1.4": ("site.las", lambda path, points: write_las(path, points, point_format=6)),
    "LAZ": ("site.laz", write_las),
}
"""A file name and a writer for each format."""
