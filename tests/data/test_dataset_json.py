"""dataset.json: what it must hold, and that no other files are read than a data set's own."""

import json

import pytest

from travjax.config import InputError
from travjax.data.dataset_json import FORMAT, FORMAT_VERSION, digest, files_of, read_table

FILE = {"bytes": 10, "sha256": "ab"}
TABLE = {"format": FORMAT, "version": FORMAT_VERSION, "files": {"heights.npy": FILE, "labels.npy": FILE}}
NAMES = ("heights", "labels")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "dataset.json"


def test_what_was_written_with_its_checksum_is_read_without_it(path):
    path.write_text(json.dumps(TABLE | {"sha256": digest(TABLE)}))
    assert read_table(path) == TABLE
    assert files_of(TABLE, NAMES, path) == {"heights.npy": (10, "ab"), "labels.npy": (10, "ab")}


def test_the_checksum_is_of_everything_and_of_no_order():
    assert digest(dict(reversed(TABLE.items()))) == digest(TABLE)
    assert digest(TABLE | {"more": 1}) != digest(TABLE)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (json.dumps(TABLE), "has been altered: its checksum differs"),
        (json.dumps(TABLE | {"sha256": 3}), "has been altered: its checksum differs"),
        (json.dumps(TABLE | {"format": ["a"]}), f"not the description of a {FORMAT}"),
        (json.dumps(TABLE | {"version": "a\nb"}), "format version 'a\\nb': must be 1; make it again"),
        (json.dumps(TABLE).replace("10", "1e999"), "files.heights.npy.bytes = inf: must be a finite number"),
        ("[" * 10**5, "lists and tables: must be nested 50 deep at most"),
    ],
)
def test_what_is_none_is_one_line(path, text, message):
    path.write_text(text)
    with pytest.raises(InputError) as raised:
        read_table(path)
    assert str(raised.value) == f"{path}: {message}"


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (None, "files = None: must be a table of heights.npy, labels.npy"),
        ({"heights.npy": FILE}, "files = "),
        ({"heights.npy": FILE, "labels.npy": FILE, "../secret": FILE}, "files = "),
        ({"heights.npy": FILE, "labels.npy": {"bytes": 10}}, "files.labels.npy = {'bytes': 10}: must be a table with "),
        ({"heights.npy": FILE, "labels.npy": FILE | {"bytes": True}}, "files.labels.npy = {'bytes': True, "),
        ({"heights.npy": [], "labels.npy": FILE}, "files.heights.npy = []: must be a table with bytes and sha256"),
    ],
)
def test_files_that_are_not_those_of_the_arrays_are_refused(path, files, message):
    with pytest.raises(InputError) as raised:
        files_of(TABLE | {"files": files}, NAMES, path)
    assert str(raised.value).startswith(f"{path}: {message}")
