"""Archives that are written batch by batch."""

import numpy as np
import pytest

from travjax import memory
from travjax.config import InputError
from travjax.npz_stream import NpzStream


def batches() -> list[dict[str, np.ndarray]]:
    """Two batches of three maps and of two, whose names differ in length."""
    random = np.random.default_rng(0)
    whole = {
        "heights": random.normal(size=(5, 33, 33)).astype(np.float32),
        "failed": random.random((5, 700, 3)) < 0.1,
        "group": np.array(["a", "b", "a", "longer", "longer"]),
        "origin": random.normal(size=(5, 2)),
    }
    return [{name: array[part] for name, array in whole.items()} for part in (slice(0, 3), slice(3, 5))]


def test_what_is_added_in_batches_is_one_archive_and_leaves_nothing_else(tmp_path):
    first, second = batches()
    with NpzStream(tmp_path / "a.npz", 5, 10_000, "maps") as stream:
        stream.append(first)
        stream.append(second)
        arrays = stream.arrays
        for name in first:
            np.testing.assert_array_equal(arrays[name], np.concatenate([first[name], second[name]]))
        assert stream.save(cell_size=0.0625, config="{}") == tmp_path / "a.npz"
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]
    with np.load(tmp_path / "a.npz") as saved:
        assert set(saved) == {*first, "cell_size", "config"}
        for name in first:
            np.testing.assert_array_equal(saved[name], np.concatenate([first[name], second[name]]))
            assert saved[name].dtype == np.concatenate([first[name], second[name]]).dtype
        assert float(saved["cell_size"]) == 0.0625
        assert str(saved["config"]) == "{}"


def test_flags_are_compressed(tmp_path):
    with NpzStream(tmp_path / "a.npz", 100, 9126, "maps") as stream:
        stream.append({"failed": np.zeros((100, 3042, 3), bool)})
        stream.save()
    assert (tmp_path / "a.npz").stat().st_size < 9126 * 100 / 50


def test_what_was_not_saved_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), NpzStream(tmp_path / "a.npz", 5, 10_000, "maps") as stream:
        stream.append(batches()[0])
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_a_disk_that_is_too_small_is_said_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(memory.shutil, "disk_usage", lambda folder: memory.shutil._ntuple_diskusage(2**40, 0, 10**6))
    with pytest.raises(InputError, match="1000 maps take up to 19 MiB: must be at most 1 MiB, which is free$"):
        NpzStream(tmp_path / "a.npz", 1000, 10_000, "maps")
