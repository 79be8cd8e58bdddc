"""Weights that are fetched: from a server of the tests, checked, converted and kept, or one line and nothing kept."""

import hashlib
import io
import re
import sys
import urllib.error
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from tests.commandline import Terminal, files
from tests.resnet.test_imagenet_weights import canonical_arrays, keras_arrays, write
from travjax.config import InputError
from travjax.resnet import fetched_weights as module
from travjax.resnet.fetched_weights import KEPT, fetched_weights
from travjax.resnet.imagenet_weights import load_weights


@pytest.fixture(scope="module")
def arrays() -> dict[str, np.ndarray]:
    """Random weights of a trunk by canonical name."""
    return canonical_arrays(width=64, top=False)


@pytest.fixture(scope="module")
def served(tmp_path_factory, arrays) -> bytes:
    """The file that the server has."""
    return write(tmp_path_factory.mktemp("server") / "served.h5", keras_arrays(arrays)).read_bytes()


@pytest.fixture
def asked(served, tmp_path, monkeypatch) -> list[str]:
    """The addresses that were asked of the server; the cache is `tmp_path / "cache"`."""
    addresses: list[str] = []

    def urlopen(address, timeout):
        addresses.append(address)
        return io.BytesIO(served)

    monkeypatch.setattr("urllib.request.urlopen", urlopen)
    monkeypatch.setattr(module, "SIZE", len(served))
    monkeypatch.setattr(module, "MD5", hashlib.md5(served).hexdigest())
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return addresses


def kept(folder: Path) -> Path:
    return folder / "cache/travjax" / KEPT


def test_weights_are_fetched_once_converted_and_kept(asked, served, arrays, tmp_path, monkeypatch, capsys):
    path = fetched_weights()
    assert path == kept(tmp_path) and [each for each in files(tmp_path) if each.is_file()] == [path]
    (tmp_path / "served.h5").write_bytes(served)
    weights, wanted = load_weights(path), load_weights(tmp_path / "served.h5")
    assert weights.arrays.keys() == arrays.keys() == wanted.arrays.keys()
    for name, array in wanted.arrays.items():
        np.testing.assert_array_equal(weights.arrays[name], array)
    assert (weights.stride_in, weights.epsilon) == ("1x1", 1.001e-5)
    assert weights.origin == "resnet50_weights_tf_dim_ordering_tf_kernels_notop.h5, Keras names"
    out, err = capsys.readouterr()
    assert out.startswith("Fetching the ImageNet weights of Keras, ") and out.endswith(f"{path}\n") and err == ""
    monkeypatch.setitem(sys.modules, "h5py", None)  # what is kept does not need it
    assert fetched_weights() == path and asked == [module.URL]


def test_a_terminal_has_a_progress_bar(asked, monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    fetched_weights()
    assert "ImageNet weights: 100%" in sys.stderr.getvalue()


def refusal(folder: Path) -> str:
    """The one line of weights that cannot be fetched; nothing is kept."""
    with pytest.raises(InputError) as raised:
        fetched_weights()
    assert not [path for path in files(folder / "cache") if path.is_file() or "unfinished" in path.name]
    assert "\n" not in str(raised.value)
    return str(raised.value)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (urllib.error.URLError(OSError(-2, "Name or service not known")), "[Errno -2] Name or service not known"),
        (urllib.error.HTTPError(module.URL, 404, "Not Found", None, None), "Not Found"),
        (TimeoutError(), "TimeoutError"),
        (ConnectionResetError(104, "Connection reset by peer"), "[Errno 104] Connection reset by peer"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_server_that_is_out_of_reach_is_one_line(asked, tmp_path, monkeypatch, error, said):
    def urlopen(address, timeout):
        raise error

    monkeypatch.setattr("urllib.request.urlopen", urlopen)
    assert refusal(tmp_path) == f"{module.URL}: cannot be fetched: {said}"


@pytest.mark.parametrize("content", [b"", b"<html>sign in</html>", "cut", "changed"])
def test_another_file_than_the_expected_one_is_refused(asked, served, tmp_path, monkeypatch, content):
    content = {"cut": served[:-1], "changed": served[:-1] + b"\1"}.get(content, content)
    monkeypatch.setattr("urllib.request.urlopen", lambda address, timeout: io.BytesIO(content))
    said = refusal(tmp_path)
    assert f": {len(content):,} bytes came, or another MD5: must be {len(served):,} of {module.MD5}" in said


def test_what_is_fetched_is_checked_like_any_file_of_weights(asked, tmp_path, monkeypatch):
    content = write(tmp_path / "narrow.h5", keras_arrays(canonical_arrays(width=4))).read_bytes()
    monkeypatch.setattr("urllib.request.urlopen", lambda address, timeout: io.BytesIO(content))
    monkeypatch.setattr(module, "SIZE", len(content))
    monkeypatch.setattr(module, "MD5", hashlib.md5(content).hexdigest())
    assert "wrong for a trunk of blocks [3, 4, 6, 3], width 64" in refusal(tmp_path)


def test_without_h5py_nothing_is_fetched(asked, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    assert refusal(tmp_path) == "converting them needs h5py: pip install h5py"
    assert asked == []


def test_without_a_place_for_a_cache_nothing_is_fetched(asked, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "cache_folder", lambda: None)
    assert refusal(tmp_path).startswith("there is no folder for a cache: ")
    monkeypatch.setattr(module, "cache_folder", lambda: tmp_path / "taken/cache")
    (tmp_path / "taken").touch()
    assert refusal(tmp_path) == f"{tmp_path}/taken/cache/weights: cannot be written: Not a directory"
    assert asked == []


def test_the_address_and_the_checksum_are_those_of_keras():
    keras = find_spec("keras")  # not imported: it would choose a backend
    source = (Path(keras.origin).parent / "src/applications/resnet.py").read_text()
    folder, name = module.URL.rsplit("/", 1)
    assert f'"{folder}/"' in source and name == "resnet50_weights_tf_dim_ordering_tf_kernels_notop.h5"
    assert re.search(rf'"resnet50": \(\s*"[0-9a-f]{{32}}",\s*"{module.MD5}",\s*\)', source)
