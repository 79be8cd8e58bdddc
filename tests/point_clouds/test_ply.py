"""PLY files: what is passed over, and the one line for each that is damaged."""

from pathlib import Path

import numpy as np
import plyfile
import pytest

from tests.points import CELL, points_of, read, refusal, uneven, write_ply

QUADS = np.array([([0, 1, 2, 3],), ([1, 2, 3, 4, 5],)], [("vertex_indices", object)])
TRIANGLES = np.array([([0, 1, 2],), ([1, 2, 3],)], [("vertex_indices", "i4", (3,))])


@pytest.mark.parametrize("faces", [TRIANGLES, QUADS], ids=["triangles", "other polygons"])
@pytest.mark.parametrize("text", [True, False])
def test_faces_of_a_ply_are_passed_over(tmp_path, text, faces):
    heights = uneven(20, 24)
    write_ply(tmp_path / "site.ply", points_of(heights, CELL), "f4", [("face", faces)], text=text)
    np.testing.assert_array_equal(read(tmp_path / "site.ply").heights, heights)


def test_a_ply_without_points_is_refused_with_what_it_holds(tmp_path):

    path = tmp_path / "site.ply"
    plyfile.PlyData([plyfile.PlyElement.describe(TRIANGLES, "face")]).write(path)
    assert refusal(path) == "no element `vertex`; it holds: face"
    plyfile.PlyData([plyfile.PlyElement.describe(np.zeros(3, [("x", "f4"), ("y", "f4")]), "vertex")]).write(path)
    assert refusal(path) == "vertex: must have numbers x, y, z; it has: x, y"
    assert refusal(write_ply(path, np.zeros((0, 3)))).startswith(("heights: all unknown", "cannot be read"))


def test_single_precision_that_cannot_hold_the_coordinates_is_refused(tmp_path):
    points = points_of(uneven(20, 24), CELL, 431_000, 5_203_000)
    line = refusal(write_ply(tmp_path / "site.ply", points, "f4"))
    assert line.startswith("x = 431001: is stored in steps of 0.03125 m (float32): must be double, or relative to")
    assert read(write_ply(tmp_path / "site.ply", points - [431_000, 5_203_000, 0], "f4")).cell_size == CELL


VERTICES = "element vertex 480\nproperty double x\nproperty double y\nproperty double z\n"
HEIGHTS = uneven(20, 24)
POINTS = points_of(HEIGHTS, CELL)


def ply(path: Path, header: str | bytes, body: bytes = POINTS.tobytes(), order: str = "binary_little_endian") -> Path:
    """A file with these lines between `format` and `end_header`."""
    lines = header.encode() if isinstance(header, str) else header
    path.write_bytes(f"ply\nformat {order} 1.0\n".encode() + lines + b"end_header\n" + body)
    return path


@pytest.mark.parametrize(
    "line",
    ["comment Autor: Jürgen".encode(), "comment Autor: Jürgen".encode("latin-1"), b"obj_info \xff\xfe\x00", b"comment"],
)
@pytest.mark.parametrize("place", [0, 1])
def test_comments_may_hold_anything(tmp_path, line, place):
    lines = VERTICES.encode()
    header = line + b"\n" + lines if place == 0 else lines + line + b"\n"
    np.testing.assert_array_equal(read(ply(tmp_path / "site.ply", header)).heights, HEIGHTS)


def test_names_may_be_in_capitals_and_lines_of_windows(tmp_path):
    header = VERTICES.replace(" x", " X").replace(" y\n", " Y\n").replace(" z", " Z").replace("\n", "\r\n")
    np.testing.assert_array_equal(read(ply(tmp_path / "site.ply", header)).heights, HEIGHTS)


@pytest.mark.parametrize("place", ["before", "behind the header"])
@pytest.mark.parametrize("text", [False, True])
def test_byte_order_marks_are_passed_over(tmp_path, place, text):
    body = "".join(f"{x:.17g} {y:.17g} {z:.17g}\n" for x, y, z in POINTS.tolist()).encode()
    mark = b"\xef\xbb\xbf"
    behind = (mark if place != "before" else b"") + (body if text else POINTS.tobytes())
    path = ply(tmp_path / "site.ply", VERTICES, behind, "ascii" if text else "binary_little_endian")
    if place == "before":
        path.write_bytes(mark + path.read_bytes())
    np.testing.assert_array_equal(read(path).heights, HEIGHTS)


def test_lists_before_the_vertices_are_passed_over(tmp_path):
    for faces in (TRIANGLES, QUADS):
        vertices = np.zeros(480, [(axis, "f8") for axis in "xyz"])
        vertices["x"], vertices["y"], vertices["z"] = POINTS.T
        elements = [plyfile.PlyElement.describe(array, name) for array, name in ((faces, "face"), (vertices, "vertex"))]
        for text in (False, True):
            plyfile.PlyData(elements, text=text).write(tmp_path / "site.ply")
            raster = read(tmp_path / "site.ply")
            np.testing.assert_array_equal(raster.heights, HEIGHTS)
            assert raster.notes[0].startswith("2 faces are passed over: its vertices are taken as points")


@pytest.mark.parametrize("count", [0, 5, 10**22])
def test_elements_without_properties_are_passed_over(tmp_path, count):
    path = ply(tmp_path / "site.ply", f"element nothing {count}\n" + VERTICES)
    np.testing.assert_array_equal(read(path).heights, HEIGHTS)
    text = ply(tmp_path / "site.ply", f"element nothing {count}\n" + VERTICES, b"0 0 1\n" * 480, "ascii")
    assert refusal(text)


def test_classes_of_vertices_are_heard(tmp_path):
    table = np.zeros(480, [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("c", "<f4")])
    table["x"], table["y"], table["z"] = POINTS.T
    table["c"] = np.where(np.arange(480) < 30, 5, 2)
    raster = read(ply(tmp_path / "site.ply", VERTICES + "property float scalar_Classification\n", table.tobytes()))
    assert np.isnan(raster.heights).sum() == 30


@pytest.mark.parametrize("order", ["<", ">"])
def test_single_precision_is_refused_in_either_byte_order(tmp_path, order):
    points = points_of(uneven(20, 24), CELL, 431_000, 5_203_000)
    assert "is stored in steps of 0.03125 m (float32)" in refusal(
        write_ply(tmp_path / "site.ply", points, "f4", byte_order=order)
    )


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("count", [481, 2**31, 10**22, 10**24])
def test_counts_are_compared_with_the_size_of_the_file(tmp_path, text, count):
    header = VERTICES.replace("480", str(count))
    order = "ascii" if text else "binary_little_endian"
    line = refusal(ply(tmp_path / "site.ply", header, b"0 0 1\n" * 480 if text else POINTS.tobytes(), order))
    assert "it is cut short" in line


@pytest.mark.parametrize(
    ("header", "line"),
    [
        ("element vertex -3\n", "line 3 of its header: 'element vertex -3'"),
        ("element vertex " + "9" * 40 + "\n", "line 3 of its header: "),
        ("element vertex 3\nproperty complex x\n", "line 4 of its header: 'property complex x'"),
        ("property float x\n", "line 3 of its header: 'property float x'"),
        ("nonsense \x07\n", "line 3 of its header: 'nonsense \\x07'"),
        ("element face 0\nproperty list uchar int vertex_indices\n", "no element `vertex`; it holds: face"),
        ("element vertex 1\nproperty list uchar float x\nproperty float y\n", "vertex: must have numbers x, y, z"),
        ("element vertex 480\nproperty list uchar float n\n" + VERTICES[19:], "vertex: has lists of different lengths"),
    ],
)
def test_headers_that_are_none_are_refused(tmp_path, header, line):
    message = refusal(ply(tmp_path / "site.ply", header, 2 * POINTS.tobytes()))
    assert line in message
    assert message.isprintable()


def test_a_header_without_an_end_is_refused(tmp_path):
    path = tmp_path / "site.ply"
    path.write_bytes(b"ply\nformat ascii 1.0\n" + b"comment x\n" * 200_000)
    assert "of its header" in refusal(path)
