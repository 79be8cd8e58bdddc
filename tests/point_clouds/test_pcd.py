"""PCD files: the three ways they store points, LZF, and the one line for each that is damaged."""

from pathlib import Path

import numpy as np
import pytest

from tests.points import CELL, lzf_folded, points_of, read, refusal, uneven, write_pcd
from travjax.config import InputError
from travjax.point_clouds.pcd import lzf

HEIGHTS = uneven(20, 24)
POINTS = points_of(HEIGHTS, CELL)
WAYS = ("ascii", "binary", "binary_compressed")


@pytest.mark.parametrize("data", WAYS)
@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_points_are_read_in_every_way(tmp_path, data, kind):
    raster = read(write_pcd(tmp_path / "site.pcd", POINTS, data, kind))
    np.testing.assert_array_equal(raster.heights, HEIGHTS)
    assert raster.notes == ()


@pytest.mark.parametrize("data", WAYS)
def test_places_without_a_return_are_left_out(tmp_path, data):
    nothing = np.full((40, 3), np.nan)
    raster = read(write_pcd(tmp_path / "site.pcd", np.vstack([nothing, POINTS, nothing]), data))
    np.testing.assert_array_equal(raster.heights, HEIGHTS)


def test_a_viewpoint_is_named_and_not_applied(tmp_path):
    raster = read(write_pcd(tmp_path / "site.pcd", POINTS, viewpoint="VIEWPOINT 1 2 3 1 0 0 0\n"))
    np.testing.assert_array_equal(raster.heights, HEIGHTS)
    assert raster.notes == ("VIEWPOINT 1 2 3 1 0 0 0 is not applied: x, y, z are taken as they are stored",)
    assert read(write_pcd(tmp_path / "site.pcd", POINTS, viewpoint="VIEWPOINT 0 0 0 1 0 0 0\n")).notes == ()


def edited(path: Path, old: bytes, new: bytes) -> Path:
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new, 1))
    return path


@pytest.mark.parametrize("data", WAYS)
@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (b"POINTS 480", b"POINTS 481", "POINTS = 481: "),
        (b"POINTS 480", b"POINTS " + b"9" * 22, "POINTS = 9999999999999999999999: "),
        (b"POINTS 480", b"POINTS " + b"9" * 4900, "cannot be read as PCD: header: "),
        (b"POINTS 480", b"POINTS -1", "cannot be read as PCD: header: POINTS must be a number"),
        (b"FIELDS normal x y z label", b"FIELDS normal x y w label", "FIELDS: must hold numbers x, y, z; it holds: "),
        (b"COUNT 3", b"COUNT 70000", "cannot be read as PCD: header: COUNT must be from 1 to 65535"),
        (b"COUNT 3 1", b"COUNT 3", "cannot be read as PCD: header: FIELDS, SIZE, TYPE and COUNT must be as many"),
        (b"TYPE F F F F", b"TYPE F F F Q", "cannot be read as PCD: header: TYPE and SIZE must be"),
        (b"DATA ", b"DATA x", "cannot be read as PCD: header: POINTS must be a number, DATA ascii"),
    ],
)
def test_headers_that_do_not_fit_are_refused(tmp_path, data, old, new, line):
    assert refusal(edited(write_pcd(tmp_path / "site.pcd", POINTS, data), old, new)).startswith(line)


def test_compressed_data_that_claims_more_is_refused(tmp_path):
    path = write_pcd(tmp_path / "site.pcd", POINTS, "binary_compressed")
    at = path.read_bytes().index(b"binary_compressed\n") + 18
    content = bytearray(path.read_bytes())
    content[at : at + 4] = b"\xff\xff\xff\xff"
    path.write_bytes(content)
    assert refusal(path).startswith("POINTS = 480: must take the ")
    content[at : at + 4] = (1000).to_bytes(4, "little")
    path.write_bytes(content)
    assert refusal(path) == "cannot be read as PCD: its compressed data is damaged"


@pytest.mark.parametrize(
    "content", [b"", b"a", bytes(1000), bytes(range(256)) * 40, b"abcabcabcabd" * 30, b"aab" * 4000]
)
def test_lzf_unfolds_what_was_folded(content):
    folded = lzf_folded(content)
    assert lzf(folded, len(content)) == content
    for size in {0, len(content) - 1, len(content) + 1} - {len(content), -1}:
        with pytest.raises(InputError, match="damaged"):
            lzf(folded, size)


def test_lzf_copies_what_it_has_just_written():
    assert lzf(bytes([0, 97, 0x20 + (1 << 5), 0]), 5) == b"aaaaa"  # one letter, then four from one back
    assert lzf(bytes([1, 97, 98, 7 << 5, 3, 1]), 14) == b"ab" * 7  # two letters, then twelve from two back


@pytest.mark.parametrize("folded", [b"\x20\x00", b"\x05ab", b"\xe0", b"\x00a\xe0\x01", b"\x00a\x3f\xff"])
def test_lzf_that_points_before_its_start_or_ends_early_is_refused(folded):
    with pytest.raises(InputError, match="damaged"):
        lzf(folded, 10)
