"""Keras' files: layers by name in every layout, and no other file opened for an HDF5 file that points to it."""

import io
import json
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest

from travjax.config import InputError
from travjax.resnet.weight_files import open_arrays


def refusal(path: Path, *names: str) -> str:
    """The one line on a file, or on one of its arrays."""
    with pytest.raises(InputError) as error, open_arrays(path) as file:
        for name in names:
            file.arrays[name].read()
    assert "\n" not in str(error.value)
    return str(error.value)


def shapes(path: Path) -> dict[str, tuple[int, ...]]:
    with open_arrays(path) as file:
        return {name: stored.shape for name, stored in file.arrays.items()}


@pytest.fixture
def secret(tmp_path) -> Path:
    """A file that no other may read."""
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["kernel"] = np.ones(3, np.float32)
    return tmp_path / "secret.h5"


def virtual(file: h5py.File, secret: Path) -> None:
    layout = h5py.VirtualLayout((3,), "f4")
    layout[:] = h5py.VirtualSource(str(secret), "kernel", (3,))
    file.create_virtual_dataset("conv/kernel", layout)


ELSEWHERE = {
    "external link": (
        lambda f, s: f.update({"conv": h5py.ExternalLink(str(s), "/")}),
        "conv is a link: must be an array",
    ),
    "soft link": (lambda f, s: f.update({"conv": h5py.SoftLink("/other")}), "conv is a link: must be an array"),
    "external storage": (
        lambda f, s: f.create_dataset("conv/kernel", (3,), "f4", external=[(str(s), 0, 12)]),
        "conv/kernel lies in other files: must be in this one, others are not opened",
    ),
    "virtual data set": (virtual, "conv/kernel lies in other files: must be in this one"),
}


@pytest.mark.parametrize("how", ELSEWHERE)
@pytest.mark.parametrize("suffix", [".h5", ".keras"])
def test_no_other_file_is_opened(tmp_path, secret, monkeypatch, how, suffix):
    point, message = ELSEWHERE[how]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        point(file, secret)
    if suffix == ".keras":
        with zipfile.ZipFile(tmp_path / "a.keras", "w") as archive:
            archive.write(tmp_path / "a.h5", "model.weights.h5")
    assert refusal(tmp_path / f"a{suffix}").startswith(message)


def test_arrays_without_values_and_in_huge_chunks_are_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("conv/kernel", (1 << 20, 1 << 20), "f4")
    assert refusal(tmp_path / "a.h5", "conv/kernel") == (
        "conv/kernel = [1048576, 1048576]: must have values, of which the file holds none"
    )
    with h5py.File(tmp_path / "b.h5", "w") as file:
        data = file.create_dataset("conv/kernel", (4,), "f4", maxshape=(None,), chunks=(1 << 25,), compression="gzip")
        data[:] = 1
    assert refusal(tmp_path / "b.h5", "conv/kernel") == (
        "conv/kernel in chunks of 134,217,728 bytes: must be at most 67,108,864"
    )


def test_the_state_of_training_is_passed_over(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["model_weights/conv/conv/kernel:0"] = np.ones(3)
        file["optimizer_weights/training/Adam/conv/kernel/m:0"] = np.ones(3)
        file["optimizer_weights/training/Adam/other/kernel/m:0"] = np.ones(3)
        file["optimizer/vars/0"] = np.ones(3)
    assert shapes(tmp_path / "a.h5") == {"conv/kernel": (3,)}


# Keras 3


def keras(
    path: Path, arrays: dict[str, np.ndarray], layers: list | None = None, named: bool = False, **options
) -> Path:
    """A .keras file with arrays by group, and a configuration."""
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        for group, array in arrays.items():
            file[group] = array
            if named:
                file[group].parent.attrs["name"] = group.split("/")[-3] + "_by_name"
    with zipfile.ZipFile(path, "w", **options) as archive:
        archive.writestr("config.json", json.dumps({"class_name": "Functional", "config": {"layers": layers or []}}))
        archive.writestr("model.weights.h5", content.getvalue())
    return path


GROUPS = {
    "layers/conv2d/vars/0": np.ones((1, 2)),
    "layers/conv2d_1/vars/1": np.ones(3),
    "layers/functional/layers/batch_normalization/vars/3": np.ones(4),
    "optimizer/vars/0": np.ones(5),
}


def layer(kind: str, name: str, layers: list | None = None) -> dict:
    return {"class_name": kind, "config": {"name": name} | ({"layers": layers} if layers else {})}


LAYERS = [
    layer("InputLayer", "input"),
    layer("Conv2D", "one"),
    layer("Lambda", "dangerous"),
    layer("Functional", "net", [layer("BatchNormalization", "bn")]),
    layer("Conv2D", "two"),
]


def test_layers_without_names_are_those_of_the_configuration(tmp_path):
    path = keras(tmp_path / "a.keras", GROUPS, LAYERS)
    assert shapes(path) == {"one/kernel": (1, 2), "two/bias": (3,), "bn/moving_variance": (4,)}


def test_names_beside_the_arrays_go_first(tmp_path):
    path = keras(tmp_path / "a.keras", GROUPS, LAYERS, named=True)
    assert "conv2d_1_by_name/bias" in shapes(path)


@pytest.mark.parametrize(
    "layers", [[3, None, {}], [{"class_name": 3}], [{"class_name": "Conv2D", "config": 3}], {"a": 1}, "text"]
)
def test_a_configuration_of_something_else_names_no_layers(tmp_path, layers):
    path = keras(tmp_path / "a.keras", dict(list(GROUPS.items())[:1]), layers)
    assert shapes(path) == {"vars/0": (1, 2)}


def test_parts_that_are_missing_or_damaged_are_one_line(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.keras", "w") as archive:
        archive.writestr("config.json", "{}")
    assert refusal(tmp_path / "a.keras") == "holds no model.weights.h5; allowed: a .keras file of Keras 3"
    with zipfile.ZipFile(tmp_path / "b.keras", "w") as archive:
        archive.writestr("config.json", "[" * 100_000)
        archive.writestr("model.weights.h5", b"")
    assert refusal(tmp_path / "b.keras").startswith("cannot be read as .keras, damaged or something else: ")
    (tmp_path / "c.keras").write_text("no zip")
    assert refusal(tmp_path / "c.keras").startswith("cannot be read as .keras, damaged or something else: ")


def test_a_part_that_unfolds_to_a_hundred_times_its_size_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.keras", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("model.weights.h5", bytes(64 << 20))
    assert refusal(tmp_path / "a.keras").startswith("model.weights.h5 = 67,108,864 bytes unfolded, ")


def test_an_altered_array_is_noticed(tmp_path):
    path = keras(tmp_path / "a.keras", {"layers/conv2d/vars/0": np.arange(100.0)}, LAYERS)
    content = bytearray(path.read_bytes())
    content[content.index(np.float64(50).tobytes()) + 6] ^= 1
    path.write_bytes(content)
    assert "Bad CRC-32" in refusal(path)
