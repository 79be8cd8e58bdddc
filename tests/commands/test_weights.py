"""`travjax weights`: what it converts, writes and says, and the one line for each bad input."""

import json
import re
import subprocess
import sys
from pathlib import Path

import huggingface_hub
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from tests.commandline import Run, files, printed_files, run, run_words, succeeds
from tests.resnet.test_imagenet_weights import canonical_arrays, torchvision_arrays, write
from travjax import cli
from travjax.resnet.imagenet_weights import HUB, describe, load_weights


@pytest.fixture(scope="module")
def arrays() -> dict[str, np.ndarray]:
    """Random weights of a ResNet50 by canonical name."""
    return canonical_arrays(width=64)


@pytest.fixture(scope="module")
def source(tmp_path_factory, arrays) -> Path:
    """The weights in a file as torchvision names them."""
    return write(tmp_path_factory.mktemp("weights") / "theirs.safetensors", torchvision_arrays(arrays))


@pytest.fixture(scope="module")
def converted(tmp_path_factory, source) -> Run:
    return succeeds(tmp_path_factory.mktemp("runs") / "new" / "folder", "weights", "--from", source)


def test_the_written_file_holds_the_weights(converted, arrays):
    weights = load_weights(converted.folder / "resnet50.safetensors")
    assert weights.arrays.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(weights.arrays[name], array)
    assert weights.naming == "canonical"
    assert weights.stride_in == "3x3"
    assert weights.origin == "theirs.safetensors, torchvision names"


def test_what_was_found_and_where_it_was_written_is_printed(converted, source):
    assert describe(load_weights(source)) in converted.out
    assert re.search(r"^arrays +267$", converted.out, re.MULTILINE)
    assert printed_files(converted) == files(converted.folder) == {converted.folder / "resnet50.safetensors"}


def test_converted_weights_can_be_converted_again_in_place(converted, tmp_path):
    path = tmp_path / "resnet50.safetensors"
    path.write_bytes((converted.folder / path.name).read_bytes())
    before = path.read_bytes()
    succeeds(tmp_path, "weights", "--from", path)
    assert path.read_bytes() == before
    assert files(tmp_path) == {path}


def test_weights_made_from_caffe_are_converted_once_that_is_said(tmp_path, source):
    arrays = load_file(source)
    arrays["conv1.weight"] = np.ascontiguousarray(arrays["conv1.weight"][:, ::-1] / np.float32(58))
    theirs = write(tmp_path / "caffe.safetensors", arrays)
    out = tmp_path / "out"
    refused = run(out, "weights", "--from", theirs)
    assert (refused.code, refused.out, len(refused.err.splitlines())) == (2, "", 1)
    told = re.search("travjax weights --from FILE (--input caffe --stride-in 1x1) ", refused.err)
    done = succeeds(out, "weights", "--from", theirs, *told[1].split())
    assert re.search("^made for +B, G, R, x - mean, from 0 to 255$", done.out, re.MULTILINE)
    assert re.search(r"^strides +in the 1x1 convolutions \(v1\)$", done.out, re.MULTILINE)
    found, wanted = (load_weights(path).arrays["conv1/kernel"] for path in (out / "resnet50.safetensors", source))
    ratios = np.median(found / wanted, axis=(0, 1, 3))
    np.testing.assert_allclose(ratios, np.array([58.395, 57.12, 57.375]) / 58, rtol=1e-5)


def test_one_of_several_networks_is_chosen(tmp_path, source):
    arrays = load_file(source)
    both = {f"{name}{key}": array for name in ("model.", "model_ema.") for key, array in arrays.items()}
    theirs = write(tmp_path / "both.safetensors", both)
    assert "--prefix must say which" in run(tmp_path / "out", "weights", "--from", theirs).err
    done = succeeds(tmp_path / "out", "weights", "--from", theirs, "--prefix", "model_ema.")
    assert re.search(r"^left out +model\.bn1\.bias \[64\], .* and 261 more; only the trunk", done.out, re.MULTILINE)


# ---- The hub


def notes_of(path: Path) -> dict:
    with safe_open(path, framework="np") as file:
        return json.loads(file.metadata()["travjax"])


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], ("timm/resnet50.tv_in1k", "model.safetensors")),
        (["someone/resnet"], ("someone/resnet", "model.safetensors")),
        (["someone/resnet", "--file", "r50.pth"], ("someone/resnet", "r50.pth")),
        (["--file", "r50.pth"], ("timm/resnet50.tv_in1k", "r50.pth")),
    ],
    ids=str,
)
def test_weights_of_the_hub_are_fetched_and_their_repository_noted(tmp_path, source, monkeypatch, words, expected):
    asked = []
    monkeypatch.setattr(huggingface_hub, "hf_hub_download", lambda *names: asked.append(names) or str(source))
    done = succeeds(tmp_path, "weights", "--hub", *words)
    assert asked == [expected]
    origin = f"{expected[0]}: theirs.safetensors, torchvision names"
    assert notes_of(tmp_path / "resnet50.safetensors")["origin"] == origin
    assert re.search(rf"^origin +{re.escape(origin)}$", done.out, re.MULTILINE)


def test_offline_there_is_one_line_that_names_the_twin(tmp_path, monkeypatch):
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    done = run(tmp_path / "out", "weights", "--hub")
    assert done.code == 2
    assert len(done.err.splitlines()) == 1, done.err
    assert done.err.startswith(f"travjax: {'/'.join(HUB)}: cannot be fetched")
    assert done.err.endswith("travjax weights --from FILE\n")
    assert not (tmp_path / "out").exists()


def test_without_huggingface_hub_there_is_one_line_that_names_the_twin(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    done = run(tmp_path / "out", "weights", "--hub")
    assert done.code == 2
    assert re.fullmatch("travjax: .*pip install huggingface_hub.*travjax weights --from FILE\n", done.err)


# ---- Bad input


@pytest.fixture(scope="module")
def bad(tmp_path_factory) -> Path:
    """A folder of files each of which is wrong in one way."""
    folder = tmp_path_factory.mktemp("bad")
    (folder / "text.npz").write_text("no weights\n")
    (folder / "notes.txt").write_text("no weights\n")
    save_file({"layer": np.zeros(3, np.float32)}, folder / "other.safetensors")
    save_file(canonical_arrays(width=4), folder / "narrow.safetensors")
    return folder


BAD_WORDS = {
    "nothing": ([], "one of the arguments --from --hub is required"),
    "two sources": (["--from", "BAD/text.npz", "--hub"], "--hub: not allowed with argument --from"),
    "a file of no repository": (["--from", "BAD/text.npz", "--file", "a.pth"], "--file = 'a.pth': must be left out"),
    "missing file": (["--from", "BAD/none.npz"], "BAD/none.npz: no such file"),
    "folder": (["--from", "BAD"], "BAD: "),
    "unknown kind": (["--from", "BAD/notes.txt"], "BAD/notes.txt: unknown kind of file; allowed: .npz, .h5"),
    "damaged": (["--from", "BAD/text.npz"], "BAD/text.npz: cannot be read as .npz"),
    "no ResNet": (["--from", "BAD/other.safetensors"], "BAD/other.safetensors: no array of a ResNet"),
    "an unknown input": (["--from", "BAD/narrow.safetensors", "--input", "bgr"], "--input: invalid choice: 'bgr'"),
    "narrow ResNet": (["--from", "BAD/narrow.safetensors"], "BAD/narrow.safetensors: .*; and [0-9]+ more"),
}


@pytest.mark.parametrize("name", BAD_WORDS)
def test_bad_input_is_one_line_with_exit_code_2_and_nothing_written(bad, tmp_path, name):
    words, expected = BAD_WORDS[name]
    done = run(tmp_path / "out", "weights", *(word.replace("BAD", str(bad)) for word in words))
    assert done.code == 2
    assert len(done.err.splitlines()) == 1, done.err
    assert done.err.startswith("travjax: ")
    assert re.search(expected.replace("BAD", re.escape(str(bad))), done.err)
    assert not files(tmp_path)


def test_a_file_in_the_way_of_the_output_is_one_line(tmp_path, source):
    taken = tmp_path / "taken"
    taken.write_text("mine")
    done = run(taken / "sub", "weights", "--from", source)
    assert done.code == 2
    assert done.err.startswith(f"travjax: --out {taken / 'sub'}: cannot be written: ")
    assert files(tmp_path) == {taken}


def test_a_folder_in_the_way_of_the_file_is_said_so_and_leaves_nothing_half_written(tmp_path, source):
    taken = tmp_path / "resnet50.safetensors"
    taken.mkdir()
    done = run(tmp_path, "weights", "--from", source)
    assert done.code == 2
    assert done.err.startswith(f"travjax: {taken}: cannot be written: ")
    assert (done.out, files(tmp_path)) == ("", {taken})


def test_help_names_the_options_and_where_the_hub_looks(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["weights", "--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert all(
        option in shown
        for option in (
            *("--from FILE", "--hub [REPOSITORY]", "--file NAME", "--out DIR", *HUB),
            *("--input I", "--stride-in {1x1,3x3}", "--prefix P"),
        )
    )


def test_parsers_of_all_commands_import_nothing_slow():
    slow = ["flax", "h5py", "huggingface_hub", "matplotlib", "optax", "orbax", "tensorflow_datasets", "torch"]
    program = f"import sys, travjax.cli as cli; cli._parser(); print([name for name in {slow} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.stdout == "[]\n", done.stderr


def test_words_of_two_commands_do_not_mix():
    assert run_words("weights", "--maps", "3")[0] == 2
