"""What a file claims and does not hold, and what it points to: one line, and no memory taken for it."""

import io
import json
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from travjax.config import InputError
from travjax.resnet.weight_files import open_arrays, write_safetensors

MEGABYTE = 1 << 20


def refusal(path: Path, *names: str) -> str:
    """The one line on a file, or on one of its arrays."""
    with pytest.raises(InputError) as error, open_arrays(path) as file:
        for name in names:
            file.arrays[name].read()
    assert "\n" not in str(error.value) and len(str(error.value)) < 500
    return str(error.value)


def npy(array: np.ndarray) -> bytes:
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


# Zip files of NumPy


def npz(path: Path, parts: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in parts.items():
            archive.writestr(f"{name}.npy", content)
    return path


def test_arrays_are_known_before_they_are_read(tmp_path):
    path = npz(tmp_path / "a.npz", {"large": npy(np.zeros((256, MEGABYTE // 4), np.float32)), "one": npy(np.ones(3))})
    tracemalloc.start()
    with open_arrays(path) as file:
        assert {name: (stored.shape, stored.dtype) for name, stored in file.arrays.items()} == {
            "large": ((256, MEGABYTE // 4), "float32"),
            "one": ((3,), "float64"),
        }
        np.testing.assert_array_equal(file.arrays["one"].read(), np.ones(3))
    assert tracemalloc.get_traced_memory()[1] < 10 * MEGABYTE
    tracemalloc.stop()


@pytest.mark.parametrize("shape", ["(100000000000,)", "(4,)", "(2, -3)", "(-1, -3)"])
def test_a_shape_that_its_part_does_not_bear_out_is_refused(tmp_path, shape):
    told = npy(np.zeros(3)).replace(b"(3,), }" + b" " * (len(shape) - 4), shape.encode() + b", }")
    assert len(told) == len(npy(np.zeros(3)))
    assert "must be as long as it is stored, 152 bytes" in refusal(npz(tmp_path / "a.npz", {"a": told}))


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compression_is_refused(tmp_path, method):
    assert refusal(npz(tmp_path / "a.npz", {"a": npy(np.zeros(3))}, method)).startswith("a.npy: must be stored or")


def test_two_arrays_of_one_name_are_refused(tmp_path):
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", npy(np.zeros(3)))
        archive.writestr("a.npy", npy(np.ones(3)))
    assert refusal(tmp_path / "a.npz").startswith("holds two parts of one name")


def test_an_altered_array_is_noticed(tmp_path):
    path = npz(tmp_path / "a.npz", {"a": npy(np.arange(3.0))}, zipfile.ZIP_STORED)
    content = path.read_bytes().replace(struct.pack("<d", 2), struct.pack("<d", 3))
    path.write_bytes(content)
    assert "Bad CRC-32" in refusal(path, "a")


# safetensors


def header(told: dict, content: bytes = b"") -> bytes:
    text = json.dumps(told).encode()
    return struct.pack("<Q", len(text)) + text + content


ONE = {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}


@pytest.mark.parametrize(
    "content",
    [
        struct.pack("<Q", 1 << 62) + b"{}",
        struct.pack("<Q", 90 << 20) + b"{}",
        b"\xff" * 20,
        header({"a": ONE | {"shape": [1 << 40]}}, bytes(8)),
        header({"a": ONE | {"shape": [1 << 40], "data_offsets": [0, 1 << 42]}}, bytes(8)),
        header({"a": ONE, "b": ONE}, bytes(8)),
        header({"a": ONE | {"data_offsets": [8, 16]}}, bytes(16)),
        header({"a": ONE}, bytes(7)),
        header({"a": ONE}, bytes(9)),
        header({"a": ONE | {"dtype": "F31"}}, bytes(8)),
        header({"a": ONE, "__metadata__": {"travjax": "[" * 100_000}}, bytes(8)),
        header({"a": ONE, "__metadata__": {"travjax": "[3]"}}, bytes(8)),
    ],
    ids=range(12),
)
def test_a_header_that_lies_is_refused(tmp_path, content):
    (tmp_path / "a.safetensors").write_bytes(content)
    assert refusal(tmp_path / "a.safetensors").startswith("cannot be read as .safetensors, damaged or something else: ")


def test_names_are_one_line_whatever_they_hold(tmp_path):
    (tmp_path / "a.safetensors").write_bytes(header({"a\nb\x1b[31m" * 99: ONE | {"shape": [3]}}, bytes(8)))
    assert "\x1b" not in refusal(tmp_path / "a.safetensors")


NOTES = {"epsilon": 1e-5, "text": "ü"}
ARRAYS = {"a": np.arange(5, dtype=np.float32), "b/c": np.float32([[1, -2]])}


def test_what_is_written_is_read_back_with_its_checksums(tmp_path):
    write_safetensors(tmp_path / "a.safetensors", ARRAYS, NOTES)
    with open_arrays(tmp_path / "a.safetensors") as file:
        assert file.checked and file.notes == NOTES and file.arrays.keys() == ARRAYS.keys()
        for name, array in ARRAYS.items():
            np.testing.assert_array_equal(file.arrays[name].read(), array)
    save_file(ARRAYS, tmp_path / "b.safetensors")
    with open_arrays(tmp_path / "b.safetensors") as file:
        assert not file.checked and file.notes == {}


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_none_are_not_written(tmp_path, value):
    path = tmp_path / "a.safetensors"
    with pytest.raises(InputError) as error:
        write_safetensors(path, ARRAYS | {"b/c": np.float32([[1, value]])}, NOTES)
    assert str(error.value).startswith(f"{path}: b/c = {value}: must be finite throughout")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("sums", "wrong"),
    [(sums, "is missing") for sums in ([], "x", 3, {}, {"__metadata__": None, "a": "0"})]
    + [({"__metadata__": told}, "is not the one that the file gives") for told in (5, "", "0" * 64)],
)
def test_checksums_that_are_none_are_refused(tmp_path, sums, wrong):
    notes = {"travjax": json.dumps(NOTES | {"sha256": sums})}
    save_file(ARRAYS, tmp_path / "a.safetensors", metadata=notes)
    assert refusal(tmp_path / "a.safetensors") == f"the SHA-256 of the description {wrong}: the file is damaged"


@pytest.mark.parametrize(
    ("altered", "wrong"),
    [(None, "is missing"), ("last digit", "is not the one that the file gives")],
)
def test_a_checksum_of_an_array_that_is_damaged_is_said_to_be(tmp_path, altered, wrong):
    path = tmp_path / "a.safetensors"
    write_safetensors(path, ARRAYS, NOTES)
    with safe_open(path, framework="np") as file:
        notes = json.loads(file.metadata()["travjax"])
    digits = notes["sha256"].pop("b/c")
    if altered:
        notes["sha256"]["b/c"] = digits[:-1] + ("1" if digits[-1] == "0" else "0")
    save_file(ARRAYS, path, metadata={"travjax": json.dumps(notes)})
    assert refusal(path, "b/c") == f"the SHA-256 of b/c {wrong}: the file is damaged"


# torch


@pytest.fixture(scope="module")
def torch():
    return pytest.importorskip("torch")


def test_a_tensor_is_as_large_as_it_says_only_if_it_is_read(torch, tmp_path):
    """One number that is repeated without end."""
    torch.save({"a": torch.ones(1).expand(1 << 20, 1 << 20), "b": torch.ones(2)}, tmp_path / "a.pth")
    tracemalloc.start()
    with open_arrays(tmp_path / "a.pth") as file:
        assert file.arrays["a"].shape == (1 << 20, 1 << 20)
        np.testing.assert_array_equal(file.arrays["b"].read(), np.ones(2))
    assert tracemalloc.get_traced_memory()[1] < 50 * MEGABYTE
    tracemalloc.stop()


def test_a_compressed_file_of_torch_is_refused(torch, tmp_path):
    torch.save({"a": torch.zeros(MEGABYTE)}, tmp_path / "a.pth")
    with zipfile.ZipFile(tmp_path / "a.pth") as whole, zipfile.ZipFile(tmp_path / "b.pth", "w", 8) as packed:
        for name in whole.namelist():
            packed.writestr(name, whole.read(name))
    assert refusal(tmp_path / "b.pth").endswith(" is compressed: must be stored, as torch.save does it")


def test_an_altered_tensor_is_noticed(torch, tmp_path):
    torch.save({"a": torch.arange(1000.0)}, tmp_path / "a.pth")
    content = bytearray((tmp_path / "a.pth").read_bytes())
    content[content.index(struct.pack("<f", 500)) + 1] ^= 1
    (tmp_path / "a.pth").write_bytes(content)
    assert "is not what its checksum says: the file is damaged" in refusal(tmp_path / "a.pth")


def test_dicts_in_dicts_and_what_else_a_checkpoint_holds(torch, tmp_path):
    shared = {"w": torch.ones(2)}
    state: dict = {"a.b": torch.ones(3), "model": {"c": torch.ones(1, dtype=torch.float16), "again": shared}}
    state |= {"shared": shared, "epoch": 3, "optimizer": {"state": {0: {"m": torch.ones(9)}}}, "list": [shared] * 9}
    state["model"]["self"] = state
    torch.save(state, tmp_path / "a.pth")
    with open_arrays(tmp_path / "a.pth") as file:
        assert {name: stored.shape for name, stored in file.arrays.items()} == {
            "a.b": (3,),
            "model.c": (1,),
            "shared.w": (2,),
        }
        assert file.arrays["model.c"].dtype == "float16"
    torch.save({"a.b": torch.ones(3), "a": {"b": torch.ones(3)}}, tmp_path / "b.pth")
    assert refusal(tmp_path / "b.pth") == "holds a.b twice: must be one"


def test_a_sparse_tensor_is_one_line(torch, tmp_path):
    torch.save({"a": torch.eye(3).to_sparse()}, tmp_path / "a.pth")
    assert refusal(tmp_path / "a.pth", "a").startswith("cannot be read as .pth, damaged or something else: ")


def test_a_compiled_program_is_not_run(torch, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.pt", "w") as archive:
        for part in ("data.pkl", "constants.pkl", "code/__torch__.py", "version"):
            archive.writestr(f"a/{part}", b"3")
    assert "TorchScript" in refusal(tmp_path / "a.pt")


# Any file


def test_a_name_that_is_too_long_or_goes_in_circles_is_one_line(tmp_path):
    assert "too long" in refusal(tmp_path / f"{'a' * 300}.npz")
    (tmp_path / "a.npz").symlink_to("a.npz")
    assert refusal(tmp_path / "a.npz") == "no such file"
