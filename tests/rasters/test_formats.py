"""What a file is, by its content."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from travjax import load_dem
from travjax.config import InputError
from travjax.rasters.formats import form_of
from travjax.simulation.grid import Grid

SMALL = Grid(1.0, 0.0625)
HEIGHTS = np.arange(17 * 20).reshape(17, 20) / 64
GRID = "ncols 20\nnrows 17\nxllcorner 3\nyllcorner 4\ncellsize 0.0625\nNODATA_value -9999\n" + "\n".join(
    " ".join(f"{value:.6f}" for value in row) for row in HEIGHTS[::-1]
)


def heights_of(path: Path, **options) -> np.ndarray:
    windows = load_dem(path, stride=0.0625, grid=SMALL, **options)
    return (windows.heights + windows.height_offset)[0]


def test_an_arc_grid_is_one_whatever_it_is_called(tmp_path):
    for name in ("a.asc", "a.txt", "a.xyz", "a.csv", "a.dat", "a.grd", "a"):
        (tmp_path / name).write_text(GRID)
        np.testing.assert_allclose(heights_of(tmp_path / name), HEIGHTS[:, :17], atol=1e-6)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_an_arc_grid_may_begin_with_a_byte_order_mark(tmp_path, encoding):
    (tmp_path / "a.asc").write_text(GRID, encoding)
    np.testing.assert_allclose(heights_of(tmp_path / "a.asc"), HEIGHTS[:, :17], atol=1e-6)


def test_an_arc_grid_may_have_decimal_commas(tmp_path):
    (tmp_path / "a.asc").write_text(GRID.replace(".", ","))
    np.testing.assert_allclose(heights_of(tmp_path / "a.asc"), HEIGHTS[:, :17], atol=1e-6)


@pytest.mark.parametrize("name", ["a.asc.gz", "a.npy.gz", "a.npz.gz", "b.gz"])
def test_a_file_that_is_packed_is_unpacked(tmp_path, name):
    inner = tmp_path / name.removesuffix(".gz")
    if name.startswith("a.asc") or name == "b.gz":
        inner.write_text(GRID)
    elif "npy" in name:
        np.save(inner, HEIGHTS)
    else:
        np.savez(inner, heights=HEIGHTS)
    (tmp_path / name).write_bytes(gzip.compress(inner.read_bytes()))
    np.testing.assert_allclose(heights_of(tmp_path / name, cell_size=0.0625), HEIGHTS[:, :17], atol=1e-6)


def test_a_packed_file_that_is_damaged_or_unfolds_to_too_much_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.npy.gz"
    np.save(tmp_path / "a.npy", HEIGHTS)
    packed = gzip.compress((tmp_path / "a.npy").read_bytes())
    for content, reason in ((packed[:-20], "cannot be read as .gz"), (gzip.compress(packed), "more than once")):
        path.write_bytes(content)
        with pytest.raises(InputError, match=reason) as raised:
            load_dem(path, grid=SMALL, cell_size=0.0625)
        assert str(raised.value).startswith(f"{path}: ")
    monkeypatch.setattr("travjax.rasters.formats.MOST_UNFOLDED", 1000)
    path.write_bytes(packed)
    with pytest.raises(InputError, match="unfolds to more than 1000 bytes"):
        load_dem(path, grid=SMALL, cell_size=0.0625)


@pytest.mark.parametrize(
    ("content", "name", "form"),
    [
        (b"1 2 3\n4 5 6\n", "a.dat", "text"),
        (b"N E Z\n1 2 3\n", "a.asc", "text"),
        (b"# comment\n\n1;2;3\n", "a", "text"),
        (b"\xef\xbb\xbfx,y,z\n1,2,3\n", "a.csv", "text"),
        ("x y z\n1 2 3\n".encode("utf-16"), "a.txt", "text"),
        (b"ply\nformat ascii 1.0\n", "a.xyz", "ply"),
        (b"\xef\xbb\xbfply\nformat ascii 1.0\n", "a.ply", "ply"),
        (b"LASF....", "a.laz", "las"),
        (b"LASF....", "a.tif", "las"),
        (b"# .PCD v0.7\nVERSION 0.7\n", "a.txt", "pcd"),
        (b"VERSION .7\nFIELDS x y z\n", "a.pcd", "pcd"),
        (b"glTF\x02\0\0\0", "a.glb", "mesh"),
        (b"v 1 2 3\n", "a.obj", "mesh"),
        (b"solid a\n", "a.stl", "mesh"),
        (b"II*\0....", "a.xyz", "raster"),
        (b"\x89PNG\r\n\x1a\n\0", "a.csv", "raster"),
        (b"<VRTDataset>", "a.tif", "raster"),
        (b"\x93NUMPY", "a.tif", "npy"),
        (b"PK\x03\x04", "a", "npz"),
        (b"", "a.npz", "npz"),
        (b"", "a.xyz", "text"),
        (b"", "a.tif", "raster"),
    ],
)
def test_content_decides(tmp_path, content, name, form):
    (tmp_path / name).write_bytes(content)
    assert form_of(tmp_path / name) == form
