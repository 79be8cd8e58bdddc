"""The data set as tensorflow-datasets keep it: read back equal, without TensorFlow, network, warnings or noise."""

import resource
import signal
import socket
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import SETUPS
from travjax.config import InputError
from travjax.data.dataset import SPLITS, Dataset, DatasetConfig
from travjax.data.provenance import Provenance, Site, SiteRecord, SitesConfig
from travjax.data.tfds_export import NAME, VERSION, export, read
from travjax.terrain.styles import STYLES

SETUP = SETUPS["coarse small map"]
ROBOT, ACTIONS, GRID = SETUP.robot, SETUP.actions, SETUP.grid


def some_data(maps: int = 40, config: DatasetConfig | None = None, shift: int = 0) -> Dataset:
    """Random heights with unknown ground, and random labels."""
    rng = np.random.default_rng(0)
    heights = rng.standard_normal((maps, *GRID.shape)).astype(np.float32)
    heights[:, 0, shift] = np.nan
    labels = rng.integers(0, 9, (maps, len(ACTIONS))).astype(np.uint8)
    config = config or DatasetConfig(maps, 5, 0.2, 0.1)
    return Dataset(heights, labels, config.styles(), config.seeds(), config.splits(), SETUP, config)


@pytest.fixture(scope="module")
def data() -> Dataset:
    return some_data()


@pytest.fixture
def exported(data, tmp_path) -> Path:
    export(data, tmp_path / "tfds")
    return tmp_path / "tfds"


def assert_equal(one: Dataset, other: Dataset):
    assert one.arrays.keys() == other.arrays.keys()
    for name, array in one.arrays.items():
        np.testing.assert_array_equal(array, other.arrays[name])
        assert array.dtype == other.arrays[name].dtype
    assert (one.provenance and one.provenance.to_json()) == (other.provenance and other.provenance.to_json())
    parts = ("robot", "actions", "grid", "config")
    assert [getattr(one, name) for name in parts] == [getattr(other, name) for name in parts]


def test_a_data_set_is_read_back_equal(data, exported):
    assert_equal(read(exported), data)
    assert {path.name for path in exported.parent.iterdir()} == {"tfds"}
    assert {path.name for path in exported.iterdir()} == {NAME}


def test_a_split_without_maps_is_left_out(tmp_path):
    small = some_data(2, DatasetConfig(2))
    export(small, tmp_path / "tfds")
    assert_equal(read(tmp_path / "tfds"), small)


@pytest.fixture(scope="module")
def real(data) -> Dataset:
    return Dataset(data.heights, data.labels, np.full(40, "Möckeln"), data.seed * 0, data.split, SETUP, None)


def test_real_maps_keep_their_site(real, tmp_path):
    export(real, tmp_path / "tfds")
    assert_equal(read(tmp_path / "tfds"), real)


def test_real_maps_keep_their_places(real, tmp_path):
    config = SitesConfig((Site("Möckeln.tif", validation_strip=("east", 24.0)),))
    of_file = ("ab" * 32, None, 0.0625, 20.5, 0.9, 0.001, 0.2)
    record = SiteRecord("Möckeln", "/there/Möckeln.tif", *of_file, 40, 30, 6, 0, 2, 1, 1)
    origin, turns = np.random.default_rng(1).uniform(4e6, 5e6, (40, 2)), np.arange(40, dtype=np.uint8) % 4
    placed = replace(real, provenance=Provenance(origin, turns, config, (record,)))
    export(placed, tmp_path / "tfds")
    assert_equal(read(tmp_path / "tfds"), placed)


def test_tensorflow_datasets_finds_it_by_name(data, exported):
    import tensorflow_datasets as tfds

    builder = tfds.builder(NAME, data_dir=exported)
    assert builder.info.file_format.value == "array_record"
    for name in SPLITS:
        source = builder.as_data_source(name)
        assert [source[place]["map"] for place in range(len(source))] == data.maps_of(name).tolist()
    example = source[0]
    number = example["map"]
    assert example["style"].decode() == data.group[number] == STYLES[number % 5]
    assert example["seed"] == data.seed[number]
    np.testing.assert_array_equal(example["elevation"], data.heights[number])
    np.testing.assert_array_equal(example["labels"], data.labels[number])
    assert builder.info.metadata["robot"]["name"] == ROBOT.name


def test_progress_counts_maps(data, tmp_path):
    added: list[int] = []
    export(data, tmp_path / "tfds", added.append)
    assert sum(added) == 40


def test_nothing_is_printed_fetched_or_left_behind(data, tmp_path, capfd, monkeypatch):
    def refuse(*arguments, **options):
        pytest.fail(f"the network was asked: {arguments}")

    for name in ("connect", "connect_ex", "sendto"):
        monkeypatch.setattr(socket.socket, name, refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    export(data, tmp_path / "tfds")
    assert_equal(read(tmp_path / "tfds"), data)
    assert capfd.readouterr() == ("", "")
    assert not list((tmp_path / "temporary").iterdir())


def test_no_tensorflow_and_no_warning_in_a_new_process(exported):
    code = (
        "import sys, travjax.data.tfds_export as b;"
        "assert 'tensorflow_datasets' not in sys.modules;"
        f"assert len(b.read({str(exported)!r}).heights) == 40;"
        "assert 'tensorflow' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_an_older_export_is_replaced(exported):
    other = some_data(shift=3)
    export(other, exported)
    assert_equal(read(exported), other)


def test_something_else_is_not_replaced(data, exported):
    (exported / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="tfds: holds something else: must be a new or empty folder"):
        export(data, exported)
    assert (exported / "notes.txt").read_text() == "mine"


def test_a_full_disk_is_one_line_and_leaves_nothing(data, tmp_path):
    # A limit on the size of a file fails a write as a full disk does.
    limits, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(InputError, match="tfds: cannot be written: .*File too large") as raised:
            export(data, tmp_path / "tfds")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert "\n" not in str(raised.value)
    assert not list(tmp_path.iterdir())


def test_a_missing_export_is_named(tmp_path):
    with pytest.raises(InputError, match="^folder = '.*none': must be one with an exported data set in travjax/1.0.0$"):
        read(tmp_path / "none")


def records_of(folder: Path) -> Path:
    return next((folder / NAME / VERSION).glob("*train.array_record*"))


def truncated(folder: Path):
    path = records_of(folder)
    path.write_bytes(path.read_bytes()[:50_000])


def altered(folder: Path):
    path = records_of(folder)
    data = bytearray(path.read_bytes())
    data[len(data) // 2 + 100] ^= 1
    path.write_bytes(data)


def a_split_dropped(folder: Path):
    path = folder / NAME / VERSION / "dataset_info.json"
    path.write_text(path.read_text().replace('"name": "test"', '"name": "other"'))


@pytest.mark.parametrize(
    "damage",
    [
        truncated,
        altered,
        a_split_dropped,
        lambda folder: records_of(folder).unlink(),
        lambda folder: (folder / NAME / VERSION / "features.json").unlink(),
        lambda folder: (folder / NAME / VERSION / "metadata.json").write_text('{"travjax": "0.1.0"}'),
    ],
)
def test_a_damaged_export_is_refused_in_one_line(exported, damage):
    damage(exported)
    with pytest.raises(InputError, match=f"{NAME}/{VERSION}: damaged: ") as raised:
        read(exported)
    assert "\n" not in str(raised.value)


def test_maps_that_come_twice_instead_of_others_are_noticed(real, tmp_path):
    export(real, tmp_path)
    test = next((tmp_path / NAME / VERSION).glob("*test.array_record*"))
    test.write_bytes(records_of(tmp_path).read_bytes())
    with pytest.raises(InputError, match=r"damaged: split = \[3\]: must be from 0 to 2"):
        read(tmp_path)


@pytest.mark.parametrize("call", [lambda data, folder: export(data, folder), lambda data, folder: read(folder)])
def test_without_tensorflow_datasets_the_extra_is_named(data, tmp_path, monkeypatch, call):
    monkeypatch.setitem(sys.modules, "tensorflow_datasets", None)
    with pytest.raises(InputError, match=r"^tensorflow-datasets cannot be imported .*pip install 'travjax\[tfds\]'$"):
        call(data, tmp_path / "tfds")
    assert not list(tmp_path.iterdir())
