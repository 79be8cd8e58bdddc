"""Point clouds and meshes for tests: the same points in every format that is read."""

import struct
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import plyfile
import pytest
import trimesh

from travjax.config import InputError
from travjax.data.dem import load_dem
from travjax.point_clouds.clouds import read_cloud
from travjax.rasters.raster import Raster
from travjax.rasters.reading_options import DemOptions
from travjax.simulation.grid import Grid


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
    path: Path, points: np.ndarray, scale: float = 2**-7, records=(), point_format: int = 3, **fields
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


def write_pcd(path: Path, points: np.ndarray, data: str = "binary", kind: str = "f8", viewpoint: str = "") -> Path:
    """With a field before and after the coordinates, one of them of three numbers."""
    names = [("normal", kind, (3,)), ("x", kind), ("y", kind), ("z", kind), ("label", "u1")]
    table = np.zeros(len(points), names)
    for axis, values in zip("xyz", points.T, strict=True):
        table[axis] = values
    size, letter = np.dtype(kind).itemsize, np.dtype(kind).kind.upper()
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS normal x y z label\n"
        f"SIZE {size} {size} {size} {size} 1\nTYPE {letter} {letter} {letter} {letter} U\nCOUNT 3 1 1 1 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\n{viewpoint}POINTS {len(points)}\nDATA {data}\n"
    ).encode()
    if data == "ascii":
        body = "".join(f"0 0 0 {x:.9g} {y:.9g} {z:.9g} 1\n" for x, y, z in points.tolist()).encode()
    elif data == "binary":
        body = table.tobytes()
    else:
        columns = b"".join(np.ascontiguousarray(table[name[0]]).tobytes() for name in names)
        folded = lzf_folded(columns)
        body = struct.pack("<II", len(folded), len(columns)) + folded
    path.write_bytes(header + body)
    return path


def lzf_folded(content: bytes) -> bytes:
    """LZF as LibLZF writes it: literals, and copies of what lies up to 8192 bytes back, short and long ones."""
    out, literals, at, seen = bytearray(), bytearray(), 0, {}

    def flush():
        for start in range(0, len(literals), 32):
            some = literals[start : start + 32]
            out.extend([len(some) - 1, *some])
        literals.clear()

    while at < len(content):
        key = content[at : at + 3]
        back = at - seen.get(key, -10_000)
        seen[key] = at
        if len(key) == 3 and back <= 8192:
            length = 3
            while length < 264 and at + length < len(content) and content[at + length] == content[at + length - back]:
                length += 1
            flush()
            high, low = divmod(back - 1, 256)
            more = length - 2
            out.extend([(more << 5) + high, low] if more < 7 else [(7 << 5) + high, more - 7, low])
            at += length
        else:
            literals.append(content[at])
            at += 1
    flush()
    return bytes(out)


def triangles_of(points: np.ndarray) -> np.ndarray:
    """The triangles [m, 3] between points on a square lattice, each a number of a point."""
    cell = np.diff(np.unique(points[:, 0]))[0]
    col, row = np.rint((points[:, :2] - points[:, :2].min(axis=0)) / cell).astype(int).T
    number = np.full((row.max() + 1, col.max() + 1), -1)
    number[row, col] = np.arange(len(points))
    corners = [number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]]
    pairs = [np.stack([corners[i].ravel() for i in three], axis=1) for three in ((0, 1, 2), (0, 2, 3))]
    faces = np.concatenate(pairs)
    return faces[(faces >= 0).all(axis=1)]


def write_obj(path: Path, points: np.ndarray, faces: np.ndarray | None = None) -> Path:
    """With a material library that is not there."""
    faces = triangles_of(points) if faces is None else faces
    lines = ["# OBJ", "mtllib none.mtl", *(f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()), "usemtl rock"]
    path.write_text("\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist())]) + "\n")
    return path


def write_mesh(path: Path, points: np.ndarray) -> Path:
    """STL, or glTF with y up as it has to be, by trimesh."""
    vertices = points[:, [0, 2, 1]] * [1, 1, -1] if path.suffix in (".glb", ".gltf") else points
    mesh = trimesh.Trimesh(vertices, triangles_of(points), process=False)
    if path.suffix == ".gltf":
        files = trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh), embed_buffers=True)
        path.write_bytes(files["model.gltf"])
    else:
        path.write_bytes(mesh.export(file_type=path.suffix[1:]))
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
    "LAZ 1.4": ("site.laz", lambda path, points: write_las(path, points, point_format=6)),
    "PCD": ("site.pcd", write_pcd),
    "PCD, text": ("site.pcd", lambda path, points: write_pcd(path, points, "ascii")),
    "PCD, compressed": ("site.pcd", lambda path, points: write_pcd(path, points, "binary_compressed")),
}
"""A file name and a writer for each format of points."""

MESHES: dict[str, tuple[str, Callable[[Path, np.ndarray], Path]]] = {
    "OBJ": ("site.obj", write_obj),
    "STL": ("site.stl", write_mesh),
    "GLB": ("site.glb", write_mesh),
    "glTF": ("site.gltf", write_mesh),
}
"""A file name and a writer for each format of meshes; the points stand on a lattice."""


# ---- How they are read

CELL = 0.0625
WEST, SOUTH = 5000.25, 7000.5
SMALL = Grid(1.0, CELL)
"""Windows of 17 x 17 nodes."""


def read(path: Path, cell_size=None, scale=None, nodata=None, grid: Grid = SMALL, **more) -> Raster:
    return read_cloud(path, form_of(path), DemOptions(cell_size, scale, nodata, **more), grid)


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


def refusal(path: Path, **options) -> str:
    """The one line that says what is wrong, less the name of the file that it starts with."""
    with pytest.raises(InputError) as raised:
        load_dem(path, grid=SMALL, **options)
    message = str(raised.value)
    assert message.startswith(f"{path}: ")
    assert len(message.splitlines()) == 1
    return message.removeprefix(f"{path}: ")


def line_of(path: Path, **options) -> str:
    """The one line of `read_cloud`, which takes all options."""
    with pytest.raises(InputError) as raised:
        read(path, **options)
    message = str(raised.value)
    assert len(message.splitlines()) == 1 and message.isprintable()
    return message
