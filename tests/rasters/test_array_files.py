"""Arrays of heights: .npy and .npz, whole and damaged, and what travjax wrote itself."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from travjax import load_dem
from travjax.config import InputError
from travjax.simulation.grid import Grid

SMALL = Grid(1.0, 0.0625)


def uneven(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 0.05, shape)


def refusal(path: Path, **options) -> str:
    with pytest.raises(InputError) as raised:
        load_dem(path, grid=SMALL, **options)
    message = str(raised.value)
    assert message.startswith(f"{path}: ")
    assert len(message.splitlines()) == 1
    return message.removeprefix(f"{path}: ")


def test_what_label_wrote_of_two_sites_comes_back_bit_for_bit(tmp_path):
    heights = uneven(0, 2, 17, 17).astype(np.float32)
    heights[1, 3:9, :6] = np.nan
    heights[1, 12, 12] = np.nan  # a hole that was kept
    np.savez(
        tmp_path / "labels.npz",
        heights=heights,
        cell_size=0.0625,
        origin=[[5e5, 5e6], [3e5, 4e6]],
        height_offset=[100.0, 2300.0],
        crs=["EPSG:32632", "EPSG:32633"],
        config="{}",
    )
    windows = load_dem(tmp_path / "labels.npz", grid=SMALL)
    np.testing.assert_array_equal(windows.heights, heights)
    assert windows.crs == ("EPSG:32632", "EPSG:32633")
    assert windows.systems().tolist() == ["EPSG:32632", "EPSG:32633"]
    assert windows.offsets().tolist() == [100, 2300]
    np.testing.assert_allclose((windows.heights + windows.height_offset)[1, 0, 6:], heights[1, 0, 6:] + 2300, atol=1e-9)


def test_a_window_that_is_wholly_unknown_comes_back(tmp_path):
    heights = uneven(0, 3, 17, 17).astype(np.float32)
    heights[1] = np.nan
    np.savez(tmp_path / "labels.npz", heights=heights, cell_size=0.0625, height_offset=np.full(3, 7.0), config="{}")
    windows = load_dem(tmp_path / "labels.npz", grid=SMALL)
    np.testing.assert_array_equal(windows.heights, heights)
    assert windows.height_offset == 7
    assert windows.unknown == pytest.approx(1 / 3)
    np.savez(tmp_path / "none.npz", heights=heights[1], cell_size=0.0625)
    assert refusal(tmp_path / "none.npz").startswith("heights: all unknown")


def test_maps_far_apart_in_height_keep_their_precision(tmp_path):
    relief = uneven(0, 17, 17) / 1000
    np.savez(tmp_path / "a.npz", heights=np.stack([relief, relief + 2200]), cell_size=0.0625)
    windows = load_dem(tmp_path / "a.npz", grid=SMALL)
    np.testing.assert_allclose(windows.heights[1], windows.heights[0], rtol=0, atol=1e-9)
    assert windows.offsets().tolist() == [0, 2200]


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:2263", "EPSG:4978", "my yard"])
def test_the_system_of_an_npz_is_checked(tmp_path, crs):
    np.savez(tmp_path / "a.npz", heights=uneven(0, 17, 17), cell_size=0.0625, crs=crs)
    assert refusal(tmp_path / "a.npz").startswith("crs")


def test_systems_must_be_one_or_one_for_each_map(tmp_path):
    for crs, start in (
        (["EPSG:32632"] * 3, "crs = '3 texts': must be one for all maps, or 2"),
        ([1.0], "crs: float64"),
    ):
        np.savez(tmp_path / "a.npz", heights=uneven(0, 2, 17, 17), cell_size=0.0625, crs=crs)
        assert refusal(tmp_path / "a.npz").startswith(start)


@pytest.mark.parametrize("dtype", [">f4", ">f8", ">i2", "<u2"])
@pytest.mark.parametrize("suffix", ["npy", "npz"])
def test_numbers_of_either_byte_order_are_read(tmp_path, dtype, suffix):
    heights = np.arange(17 * 17).reshape(17, 17).astype(dtype)
    path = tmp_path / f"a.{suffix}"
    np.save(path, heights) if suffix == "npy" else np.savez(path, heights=heights)
    windows = load_dem(path, grid=SMALL, cell_size=0.0625, height_scale=0.01)
    np.testing.assert_allclose(windows.heights[0] + windows.height_offset, heights * 0.01, atol=1e-6)


@pytest.mark.parametrize(("dtype", "nodata"), [("u1", -9999), ("i2", 65535), ("i2", 0.4), ("u2", -1)])
def test_a_mark_that_wraps_hides_nothing_and_is_said(tmp_path, dtype, nodata):
    heights = np.full((17, 17), np.asarray(nodata).astype("i8").astype(dtype))
    heights[:4] = 3
    np.save(tmp_path / "a.npy", heights)
    windows = load_dem(tmp_path / "a.npy", grid=SMALL, cell_size=0.0625, height_scale=0.01, nodata=nodata)
    assert windows.unknown == 0
    assert windows.notes == (f"nodata = {nodata:g} marks nothing: the file holds {np.dtype(dtype).name}",)


# ---- Damage

HEADERS = {
    "token": "{'descr': '<f4', 'fortran_order': False, 'shape': (24, 20",
    "overflow": "{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999999999999, 1)}",
    "memory": "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 1000000)}",
    "negative": "{'descr': '<f4', 'fortran_order': False, 'shape': (-4, -4)}",
    "true": "{'descr': '<f4', 'fortran_order': False, 'shape': (True, 16)}",
    "objects": "{'descr': '|O', 'fortran_order': False, 'shape': (4, 4)}",
}


def npy(header: str) -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(64)


@pytest.mark.parametrize("name", HEADERS)
@pytest.mark.parametrize("suffix", ["npy", "npz"])
def test_a_header_that_lies_is_one_line(tmp_path, name, suffix):
    path = tmp_path / f"a.{suffix}"
    if suffix == "npy":
        path.write_bytes(npy(HEADERS[name]))
    else:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("heights.npy", npy(HEADERS[name]))
    assert "read" in refusal(path, cell_size=0.0625)


def test_a_member_that_unfolds_to_far_more_than_it_takes_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("travjax.rasters.array_files.LARGE", 2**16)
    np.savez_compressed(tmp_path / "a.npz", heights=np.zeros((1000, 1000)), cell_size=0.0625)
    assert "must be at most 50 times as many" in refusal(tmp_path / "a.npz")


def test_a_member_that_does_not_fit_into_memory_is_said_before_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr("travjax.memory.available", lambda: 1000)
    np.savez(tmp_path / "a.npz", heights=uneven(0, 17, 17), cell_size=0.0625)
    assert refusal(tmp_path / "a.npz").startswith("heights.npy: takes 2 KiB of memory: must be at most 1 KiB")


def test_a_text_of_numbers_that_are_no_letters_is_one_line(tmp_path):
    header = b"\x93NUMPY\x01\x00" + (72).to_bytes(2, "little")
    described = b"{'descr': '<U2', 'fortran_order': False, 'shape': ()}".ljust(71) + b"\n"
    np.savez(tmp_path / "a.npz", heights=uneven(0, 17, 17), cell_size=0.0625)
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
        archive.writestr("crs.npy", header + described + b"\xff" * 8)
    assert refusal(tmp_path / "a.npz") == "crs.npy: holds numbers that are no letters: must be text"


def test_a_nan_that_signals_is_unknown_without_a_warning(tmp_path):
    heights = uneven(0, 17, 17).astype(np.float32)
    heights.view(np.uint32)[3, 4] = 0x7F800001
    np.save(tmp_path / "a.npy", heights)
    windows = load_dem(tmp_path / "a.npy", grid=SMALL, cell_size=0.0625, fill_holes=False)
    assert np.isnan(windows.heights).sum() == 1


def test_heights_of_two_bytes_in_coarse_steps_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", (uneven(0, 17, 17) + 300).astype(np.float16))
    assert refusal(tmp_path / "a.npy", cell_size=0.0625).startswith("heights = 300.25: is stored in steps of 0.25 m")


@pytest.mark.parametrize("mark", [-9999, -32768, -32767])
def test_a_mark_is_looked_for_among_the_numbers_as_they_are_stored(tmp_path, mark):
    heights = np.full((17, 17), 9999, np.int16)  # 99.99 m
    heights[3, 4] = mark
    np.save(tmp_path / "a.npy", heights)
    options = dict(cell_size=0.0625, height_scale=0.01)
    assert refusal(tmp_path / "a.npy", **options).startswith(f"heights = {mark}, as stored: is a usual mark of unknown")
    windows = load_dem(tmp_path / "a.npy", grid=SMALL, nodata=mark, fill_holes=False, **options)
    assert np.isnan(windows.heights).sum() == 1


def test_a_npy_of_another_name_and_an_npz_called_npy_are_read(tmp_path):
    np.save(tmp_path / "a.npy", uneven(0, 17, 17))
    (tmp_path / "a.npy").rename(tmp_path / "a.dat")
    np.savez(tmp_path / "b.npz", heights=uneven(0, 17, 17), cell_size=0.0625)
    (tmp_path / "b.npz").rename(tmp_path / "b.npy")
    first, second = load_dem(tmp_path / "a.dat", grid=SMALL, cell_size=0.0625), load_dem(tmp_path / "b.npy", grid=SMALL)
    np.testing.assert_array_equal(first.heights, second.heights)


@pytest.mark.parametrize("digits", [4, 5])
def test_a_lattice_of_points_that_jitter_by_half_a_millimetre_keeps_a_kerb(tmp_path, digits):
    x, y = np.meshgrid(np.arange(33) * 0.0625, np.arange(33) * 0.0625)
    random = np.random.default_rng(0)
    moved = [(axis + random.uniform(-5e-4, 5e-4, axis.shape)).ravel() for axis in (x, y)]
    points = np.stack([*moved, np.where(x > 1, 0.15, 0).ravel()], axis=1)
    np.savetxt(tmp_path / "a.xyz", points, fmt=f"%.{digits}f")
    windows = load_dem(tmp_path / "a.xyz", grid=Grid(2.0, 0.0625))
    assert windows.cell_size == 0.0625
    assert np.abs(np.diff(windows.heights[0], axis=1)).max() == pytest.approx(0.15, abs=1e-6)
