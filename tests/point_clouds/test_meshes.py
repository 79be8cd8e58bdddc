"""Meshes of every format against the raster that they are of."""

import json
import socket
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.points import CELL, MESHES, line_of, points_of, read, refusal, triangles_of, uneven, write_mesh, write_obj
from travjax.point_clouds import meshes
from travjax.point_clouds.meshes import surface
from travjax.simulation.grid import Grid


@pytest.mark.parametrize("form", MESHES)
def test_a_mesh_of_a_raster_is_that_raster_in_every_format(tmp_path, form):
    name, write = MESHES[form]
    heights = uneven(19, 23)
    heights[3:9, 5:7] = np.nan
    west, south = (0.0, 0.0) if form == "OBJ" else (2.0, -3.0)
    raster = read(write(tmp_path / name, points_of(heights, CELL, west, south)))
    known = ~np.isnan(raster.heights)
    np.testing.assert_allclose(raster.heights[known], heights[known], rtol=0, atol=1e-6)
    assert np.isnan(heights[~known]).all()
    assert np.count_nonzero(known) >= np.count_nonzero(~np.isnan(heights))
    assert (raster.cell_size, raster.origin) == (CELL, (west, south))


PLANE = np.array([0.31, -0.17, 5.0])
"""Slopes to the east and the north, and height at the origin."""


def on_plane(places: np.ndarray) -> np.ndarray:
    return np.hstack([places, (places @ PLANE[:2] + PLANE[2])[:, None]])


@pytest.mark.parametrize("turned", [0.0, 0.3, 0.8])
def test_two_triangles_are_a_whole_site(tmp_path, turned):
    corners = np.array([[0, 0], [13, 0], [13, 11], [0, 11.0]])
    corners = corners @ [[np.cos(turned), np.sin(turned)], [-np.sin(turned), np.cos(turned)]]
    path = write_obj(tmp_path / "site.obj", on_plane(corners), np.array([[0, 1, 2], [0, 2, 3]]))
    raster = read(path, grid=Grid(8.0, CELL))
    rows, cols = raster.heights.shape
    x, y = raster.origin[0] + CELL * np.arange(cols), raster.origin[1] + CELL * np.arange(rows)[:, None]
    known = ~np.isnan(raster.heights)
    truth = PLANE[0] * x + PLANE[1] * y + PLANE[2]
    np.testing.assert_allclose(raster.heights[known], np.broadcast_to(truth, known.shape)[known], rtol=0, atol=1e-9)
    assert np.count_nonzero(known) * CELL**2 == pytest.approx(143, rel=0.02)
    assert raster.notes == ("2 triangles are taken as they are seen from above",)
    assert np.count_nonzero(~known) == 0 or turned


def slow(corners: np.ndarray, shape: tuple[int, int], cell: float) -> np.ndarray:
    """The highest triangle above each node, a node at a time."""
    heights = np.full(shape, np.nan)
    west, south = corners[..., :2].min(axis=(0, 1))
    for (row, col), _ in np.ndenumerate(heights):
        place = np.array([west + cell * col, south + cell * row])
        for a, b, c in corners:
            sides = np.array([b[:2] - a[:2], c[:2] - a[:2]]).T
            if abs(np.linalg.det(sides)) < 1e-12:
                continue
            u, v = np.linalg.solve(sides, place - a[:2])
            if min(u, v, 1 - u - v) > -1e-9:
                heights[row, col] = np.nanmax([heights[row, col], a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2])])
    return heights


@pytest.mark.parametrize("seed", range(4))
def test_the_highest_surface_counts(monkeypatch, seed):
    random = np.random.default_rng(seed)
    corners = random.uniform(0, 3, (40, 3, 3))
    corners[::4] = np.round(corners[::4] * 4) / 4  # edges along rows and on nodes, upright triangles
    corners[1, :, 1] = corners[1, 0, 1]
    if seed:
        monkeypatch.setattr(meshes, "NODES_AT_ONCE", 50)
    raster = surface(corners, 0.125, (25, 25))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = slow(corners, (25, 25), 0.125)
    np.testing.assert_allclose(raster.heights, expected, rtol=0, atol=1e-5)
    assert np.isnan(expected).any()


def test_polygons_and_other_spellings_of_faces_are_read(tmp_path):
    heights = uneven(19, 23)
    points = points_of(heights, CELL)
    faces = triangles_of(points) + 1
    half = len(faces) // 2
    path = write_obj(tmp_path / "site.obj", points, np.zeros((0, 3), int))
    lines = [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in faces[:half].tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces[half:] - len(points) - 1).tolist()]
    path.write_text(path.read_text() + "\n".join(lines) + "\n")
    np.testing.assert_allclose(read(path).heights, heights, rtol=0, atol=1e-9)


def test_an_obj_of_points_alone_is_a_cloud(tmp_path):
    heights = uneven(19, 23)
    raster = read(write_obj(tmp_path / "site.obj", points_of(heights, CELL), np.zeros((0, 3), int)))
    np.testing.assert_array_equal(raster.heights, heights)
    assert raster.notes == ("it has no triangles: its points are taken",)


def test_points_of_a_gltf_have_y_up_too(tmp_path):
    heights = uneven(19, 23)
    points = points_of(heights, CELL)[:, [0, 2, 1]] * [1, 1, -1]
    (tmp_path / "site.glb").write_bytes(trimesh.Scene(trimesh.PointCloud(points)).export(file_type="glb"))
    np.testing.assert_allclose(read(tmp_path / "site.glb").heights, heights, rtol=0, atol=1e-6)


def test_a_mesh_lies_where_its_scene_puts_it(tmp_path):
    scene, move = trimesh.Scene(), np.eye(4)
    move[:3, 3] = 100, 2, 50  # east, up, south
    scene.add_geometry(trimesh.creation.box((10, 1, 10)), transform=move)
    (tmp_path / "site.glb").write_bytes(scene.export(file_type="glb"))
    raster = read(tmp_path / "site.glb")
    assert raster.origin == (95, -55)
    np.testing.assert_allclose(raster.heights, np.full((161, 161), 2.5), rtol=0, atol=1e-6)


def test_an_stl_in_text_is_read(tmp_path):
    heights = uneven(19, 23)
    points = points_of(heights, CELL)
    mesh = trimesh.Trimesh(points, triangles_of(points), process=False)
    (tmp_path / "site.stl").write_text(mesh.export(file_type="stl_ascii"))
    np.testing.assert_allclose(read(tmp_path / "site.stl").heights, heights, rtol=0, atol=1e-6)


def test_up_is_as_the_format_says_unless_it_is_given(tmp_path):
    x, y = np.meshgrid(CELL * np.arange(40), CELL * np.arange(50))
    heights = 0.02 * x + 0.03 * np.sin(3 * y)
    points = points_of(heights, CELL)
    expected = read(write_mesh(tmp_path / "site.glb", points))
    np.testing.assert_allclose(expected.heights, heights, rtol=0, atol=1e-6)
    turned = points[:, [0, 2, 1]] * [1, 1, -1]
    path = write_obj(tmp_path / "site.obj", turned, triangles_of(points))
    raster = read(path, up="y")
    np.testing.assert_allclose(raster.heights, heights, rtol=0, atol=1e-9)
    assert line_of(path).endswith("; its points lie flat along x and z: if y points up, say so (--up=y)")
    flat = write_mesh(tmp_path / "site.stl", points)
    np.testing.assert_allclose(read(flat, up="z").heights, heights, rtol=0, atol=1e-6)


def test_cells_of_a_mesh_are_as_large_as_given(tmp_path):
    path = write_obj(tmp_path / "site.obj", on_plane(np.array([[0, 0], [13, 0], [0, 11.0]])), np.array([[0, 1, 2]]))
    assert read(path, 0.03).cell_size == 0.03
    assert "must be at most 134217728 cells of 1e-05 m" in refusal(path, cell_size=1e-5)


# ---- Nothing outside the file


def gltf(tmp_path: Path) -> tuple[Path, dict]:
    path = write_mesh(tmp_path / "site.gltf", points_of(uneven(20, 24), CELL))
    return path, json.loads(path.read_text())


@pytest.mark.parametrize(
    "uri", ["other.bin", "http://127.0.0.1:9/a.bin", "file:///etc/passwd", "../a.bin", "data:,abc"]
)
def test_buffers_in_other_files_are_refused(tmp_path, monkeypatch, uri):
    path, tree = gltf(tmp_path)
    (tmp_path / "other.bin").write_bytes(bytes(10**6))
    tree["buffers"][0]["uri"] = uri
    path.write_text(json.dumps(tree))
    opened = []
    monkeypatch.setattr(socket.socket, "connect", lambda *_: opened.append(_))
    assert refusal(path) == f"buffers: uri = {uri!r}: must be in the file itself (store it as .glb)"
    assert not opened


def test_material_libraries_are_not_opened(tmp_path):
    heights = uneven(20, 24)
    path = write_obj(tmp_path / "site.obj", points_of(heights, CELL))
    (tmp_path / "none.mtl").mkdir()  # cannot be read as a file
    np.testing.assert_allclose(read(path).heights, heights, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda tree: tree["accessors"][0].update(count=10**12), "accessors 0 = 1000000000000: must fit into "),
        (lambda tree: tree["accessors"][0].update(count=-1), "accessors 0 = -1: must be numbers"),
        (lambda tree: tree["accessors"][1].pop("bufferView"), "accessors 1: is sparse or without data"),
        (lambda tree: tree["accessors"][0].update(sparse={}), "accessors 0: is sparse or without data"),
        (lambda tree: tree["bufferViews"][0].update(byteLength=10**15), "bufferViews 0 = 1000000000000000 bytes"),
        (lambda tree: tree["bufferViews"][0].update(byteOffset=-4), "bufferViews 0 = "),
        (lambda tree: tree["buffers"][0].update(byteLength=10**15), "buffers = 1000000000000000 bytes: must be the"),
        (
            lambda tree: tree.update(extensionsRequired=["KHR_draco_mesh_compression"]),
            "extensionsRequired = 'KHR_draco",
        ),
        (lambda tree: tree["nodes"].append({"children": [0, 0]}), "nodes: must have one parent each"),
        (lambda tree: tree.pop("buffers"), "cannot be read as GLTF: KeyError"),
        (lambda tree: tree.update(accessors=7), "cannot be read as GLTF: TypeError"),
    ],
)
def test_counts_in_gltf_are_compared_with_the_file(tmp_path, change, line):
    path, tree = gltf(tmp_path)
    change(tree)
    path.write_text(json.dumps(tree))
    assert refusal(path).startswith(line)


def test_json_that_is_too_deep_is_refused(tmp_path):
    path = tmp_path / "site.gltf"
    path.write_text('{"a":' + "[" * 100_000)
    assert refusal(path).startswith("cannot be read as GLTF: ")


@pytest.mark.parametrize("form", ["STL", "GLB", "glTF"])
@pytest.mark.parametrize("share", [0.001, 0.02, 0.5, 0.9, 0.999])
def test_a_mesh_cut_short_is_refused(tmp_path, form, share):
    name, write = MESHES[form]
    path = write(tmp_path / name, points_of(uneven(40, 50), CELL))
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert "cannot be read as" in refusal(path)


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".glb", ".gltf"])
@pytest.mark.parametrize(
    "content", [b"", b"II*\0\xff\xfe", b"glTF" + bytes(40), bytes(range(256)) * 9, b"solid\nfacet", b"{}"]
)
def test_bytes_that_are_no_mesh_are_refused(tmp_path, suffix, content):
    path = tmp_path / f"site{suffix}"
    path.write_bytes(content)
    assert "cannot be read as" in refusal(path)


def test_faces_of_vertices_that_are_not_there_are_refused(tmp_path):
    path = write_obj(tmp_path / "site.obj", on_plane(np.array([[0, 0], [13, 0], [0, 11.0]])), np.array([[0, 1, 7]]))
    assert refusal(path).startswith("cannot be read as OBJ: ")


def test_classes_of_a_mesh_are_refused(tmp_path):
    path = write_obj(tmp_path / "site.obj", on_plane(np.array([[0, 0], [13, 0], [0, 11.0]])), np.array([[0, 1, 2]]))
    assert line_of(path, classes=(2,)) == "classes = (2,): must be left out: a mesh has none"
