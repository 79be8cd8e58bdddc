"""Data sets: made from one seed, split by map, and kept on disk so that nothing wrong is read back."""

import errno
import hashlib
import json
import os
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import SETUPS
from travjax.config import InputError
from travjax.data import dataset as module
from travjax.data import dataset_json
from travjax.data.dataset import ARRAYS, SPLITS, Dataset, DatasetConfig, generate, load
from travjax.data.dataset import save as save_dataset
from travjax.data.provenance import PROVENANCE_ARRAYS, Provenance, Site, SiteRecord, SitesConfig
from travjax.files import atomic_write_folder
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup
from travjax.terrain.styles import STYLES, generate_terrain
from travjax.traversal.traverse import label, simulate, unpacked

SETUP = SETUPS["coarse small map"]
ROBOT, ACTIONS, GRID = SETUP.robot, SETUP.actions, SETUP.grid
CONFIG = DatasetConfig(maps=64, seed=3, validation=0.2, test=0.1)


@pytest.fixture(scope="module")
def made() -> Dataset:
    return generate(CONFIG, SETUP)


def real_maps(count: int = 6) -> Dataset:
    """A data set that was not generated: named sites, unknown ground."""
    heights = np.zeros((count, *GRID.shape), np.float32)
    heights[0, :5] = np.nan
    labels = np.zeros((count, len(ACTIONS)), np.uint8)
    labels[0, ::2] = 8
    group = np.array([f"site {number % 2}" for number in range(count)])
    split = np.arange(count, dtype=np.uint8) % 3
    return Dataset(heights, labels, group, np.zeros(count, np.uint32), split, SETUP, None)


def placed_maps() -> Dataset:
    """The same six with their places."""
    config = SitesConfig((Site("data/site 0.tif", test_strip=("north", 9.5)), Site("b.npy", "site 1", nodata=-1.5)))
    crs = 'LOCAL_CS["unnamed"]'
    records = (
        SiteRecord(
            "site 0", "/there/data/site 0.tif", "ab" * 32, crs, 0.1, 2000.5, 0.9, 0.01, 0.2, 9, 3, 1, 1, 2, 1, 1
        ),
        SiteRecord("site 1", "b.npy", "cd" * 32, None, 0.0625, 0.0, 1.0, 0.0, 0.0, 4, 1, 2, 1, 0, 0, 0),
    )
    origin = np.arange(12).reshape(6, 2) + 0.1 + 5e6
    return replace(real_maps(), provenance=Provenance(origin, np.array([0, 1, 2, 3, 0, 0], np.uint8), config, records))


def assert_equal(one: Dataset, other: Dataset):
    assert one.arrays.keys() == other.arrays.keys()
    for name, array in one.arrays.items():
        np.testing.assert_array_equal(array, other.arrays[name])
        assert array.dtype == other.arrays[name].dtype
    assert (one.provenance and one.provenance.to_json()) == (other.provenance and other.provenance.to_json())
    parts = ("robot", "actions", "grid", "config")
    assert [getattr(one, name) for name in parts] == [getattr(other, name) for name in parts]


def listing(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


# What the maps are


def test_each_map_is_the_one_of_its_style_and_seed_with_its_labels(made):
    assert made.heights.shape == (64, *GRID.shape) and made.heights.dtype == np.float32
    assert made.labels.shape == (64, len(ACTIONS)) and made.labels.dtype == np.uint8
    for number in (0, 13, 63):
        style, seed = str(made.group[number]), int(made.seed[number])
        assert style == STYLES[number % 5]
        np.testing.assert_allclose(made.heights[number], generate_terrain(style, seed, grid=GRID)[0], rtol=0, atol=1e-6)
        failed, known = (np.asarray(part) for part in unpacked(made.labels[number]))
        np.testing.assert_array_equal(failed, label(made.heights[number], ROBOT, ACTIONS, grid=GRID))
        np.testing.assert_array_equal(known, simulate(made.heights[number], ROBOT, ACTIONS, grid=GRID).known)
    assert 0.02 < (made.labels > 0).mean() < 0.9


def test_the_same_arguments_give_the_same_data_set_whatever_the_chunks(made, monkeypatch):
    monkeypatch.setattr(module, "MAPS_AT_ONCE", 32)
    added: list[int] = []
    again = generate(CONFIG, SETUP, added.append)
    assert_equal(again, made)
    assert added == [32, 32]


def test_another_seed_gives_other_maps_and_splits():
    other = replace(CONFIG, seed=4)
    assert not np.intersect1d(CONFIG.seeds(), other.seeds()).size
    assert (CONFIG.splits() != other.splits()).any()
    np.testing.assert_array_equal(CONFIG.styles(), other.styles())


def test_data_sets_of_different_size_share_no_maps():
    small, large = DatasetConfig(maps=500), DatasetConfig(maps=5000)
    assert np.intersect1d(small.seeds(), large.seeds()).size <= 1


@pytest.mark.parametrize("maps", [1, 2, 64, 56_840, 200_000])
def test_terrain_seeds_do_not_repeat(maps):
    seeds = DatasetConfig(maps=maps, seed=1).seeds()
    assert seeds.dtype == np.uint32 and len(np.unique(seeds)) == len(seeds) == maps


def test_terrain_seeds_spread_over_all_32_bits():
    seeds = DatasetConfig().seeds() / 2**32
    assert abs(np.quantile(seeds, [0.1, 0.5, 0.9]) - [0.1, 0.5, 0.9]).max() < 0.01


def test_maps_and_splits_are_the_same_on_every_machine_and_version():
    # Recorded from the first version: what changes this changes every experiment with a data set.
    config = DatasetConfig(maps=10, seed=2026, validation=0.2, test=0.2)
    assert config.seeds().tolist() == [
        4082726255,
        840690886,
        1198788319,
        2056018242,
        4109481400,
        811286603,
        570190186,
        4170166399,
        4012720392,
        3491176644,
    ]
    assert config.splits().tolist() == [0, 0, 0, 2, 0, 0, 1, 1, 0, 2]


def test_a_configuration_that_does_not_fit_is_refused_before_anything_is_made():
    with pytest.raises(InputError):
        generate(CONFIG, Setup(ROBOT, ActionSpace(), GRID), lambda count: pytest.fail("a map was made"))


# Splits


def test_the_papers_splits():
    config = DatasetConfig()
    assert config.split_sizes() == (51157, 4547, 1136)
    assert np.bincount(config.splits()).tolist() == [51157, 4547, 1136]


@pytest.mark.parametrize(
    "config",
    [DatasetConfig(), CONFIG, DatasetConfig(maps=101, validation=0.3, test=0.3), DatasetConfig(maps=23, test=0.5)],
)
def test_each_style_is_split_in_the_same_proportion(config):
    splits, styles = config.splits(), config.styles()
    for index, size in enumerate(config.split_sizes()):
        counts = [np.count_nonzero(styles[splits == index] == style) for style in STYLES]
        assert sum(counts) == size and max(counts) - min(counts) <= 1


@pytest.mark.parametrize(
    ("maps", "validation", "test", "sizes"),
    [
        (3, 0.08, 0.02, (1, 1, 1)),
        (2, 0.08, 0.02, (2, 0, 0)),
        (4, 0.08, 0.0, (3, 1, 0)),
        (4, 0.0, 0.02, (3, 0, 1)),
        (3, 0.9, 0.05, (1, 1, 1)),
        (10, 0.0, 1.0, (0, 0, 10)),
        (100, 0.29, 0.29, (42, 29, 29)),
        (50, 0.08, 0.02, (45, 4, 1)),
    ],
)
def test_a_small_data_set_has_a_map_in_each_split_that_is_asked_for(maps, validation, test, sizes):
    assert DatasetConfig(maps, 0, validation, test).split_sizes() == sizes


def test_the_maps_of_the_splits_are_all_maps_once(made):
    parts = [made.maps_of(split) for split in SPLITS]
    assert sorted(np.concatenate(parts).tolist()) == list(range(64))
    assert [len(part) for part in parts] == list(CONFIG.split_sizes()) == [46, 12, 6]
    with pytest.raises(InputError, match="^split = 'dev': must be one of train, validation, test$"):
        made.maps_of("dev")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"maps": 0}, "maps = 0: must be a whole number from 1"),
        ({"maps": 2.5}, "maps = 2.5: must be a whole number"),
        ({"maps": True}, "maps = True: must be a whole number"),
        ({"seed": -1}, "seed = -1: must be a whole number from 0"),
        ({"seed": "0"}, "seed = '0': must be a whole number from 0"),
        ({"validation": -0.1}, "validation = -0.1: must be a share from 0 to 1"),
        ({"test": 1.1}, "test = 1.1: must be a share from 0 to 1"),
        ({"test": float("nan")}, "test = nan: must be a share from 0 to 1"),
        ({"validation": 0.6, "test": 0.6}, r"validation \+ test = 1.2: must be at most 1"),
    ],
)
def test_bad_configurations_are_named(values, message):
    with pytest.raises(InputError, match=f"^{message}"):
        DatasetConfig(**values)


# What belongs together


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"heights": np.zeros((64, 5, 5), np.float32)}, r"heights = '\[64, 5, 5\] of float32': must be \[64, 33, 33\]"),
        ({"heights": np.zeros((64, 33, 33))}, r"heights = .*float64': must be \[64, 33, 33\] of float32"),
        ({"labels": np.zeros((64, 9), np.uint8)}, r"labels = .*: must be \[64, 36\] of uint8"),
        ({"labels": np.zeros((63, 36), np.uint8)}, r"labels = .*: must be \[64, 36\] of uint8"),
        ({"labels": np.zeros((64, 36), bool)}, "labels = .*of bool': must be"),
        ({"seed": np.zeros(64, np.int64)}, r"seed = .*: must be \[64\] of uint32"),
        ({"split": np.zeros(65, np.uint8)}, r"split = .*: must be \[64\] of uint8"),
        ({"split": np.full(64, 3, np.uint8)}, r"split = \[3\]: must be from 0 to 2: train, validation, test"),
        ({"group": np.full(64, "lunar")}, r"group = \['lunar'\]: must be of mountain_crater, "),
        ({"group": np.zeros(64)}, r"group = .*: must be \[64\] of text"),
    ],
)
def test_arrays_that_do_not_fit_together_are_named(made, arrays, message):
    with pytest.raises(InputError, match=f"^{message}"):
        replace(made, **arrays)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"origin": np.zeros((6, 3))}, r"origin = '\[6, 3\] of float64': must be \[6, 2\] of float64"),
        ({"origin": np.zeros((6, 2), np.float32)}, r"origin = '\[6, 2\] of float32': must be \[6, 2\] of float64"),
        ({"quarter_turns": np.zeros(5, np.uint8)}, r"quarter_turns = '\[5\] of uint8': must be \[6\] of uint8"),
        ({"quarter_turns": np.zeros(6, np.int64)}, r"quarter_turns = '\[6\] of int64': must be \[6\] of uint8"),
    ],
)
def test_places_that_do_not_fit_are_named(arrays, message):
    maps = placed_maps()
    with pytest.raises(InputError, match=f"^{message}"):
        replace(maps, provenance=replace(maps.provenance, **arrays))


def test_maps_of_a_site_without_a_record_are_named():
    group = np.array([*["site 0"] * 5, "moon"])
    with pytest.raises(InputError, match=r"^group = \['moon'\]: must be of site 0, site 1$"):
        replace(placed_maps(), group=group)


def test_synthetic_maps_have_no_places(made):
    with pytest.raises(InputError, match="^provenance = 'given': must be left out where there is a config"):
        replace(made, provenance=placed_maps().provenance)
    assert list(made.arrays) == list(ARRAYS)
    assert list(placed_maps().arrays) == [*ARRAYS, *PROVENANCE_ARRAYS]


# Fingerprints


def test_the_fingerprint_of_synthetic_maps_is_that_of_labels_seeds_groups_and_splits(made):
    # Runs have written it down: what changes this makes them refuse their own data set.
    data = ["\n".join(made.group).encode(), *(getattr(made, name).tobytes() for name in ("labels", "seed", "split"))]
    assert made.fingerprint == hashlib.sha256(b"".join(data)).hexdigest()[:16]
    assert replace(made, heights=made.heights + 1).fingerprint == made.fingerprint


def moved(array: np.ndarray) -> np.ndarray:
    changed = array.copy()
    changed.flat[-1] = 2 if array.dtype == np.uint8 else 0.5
    return changed


@pytest.mark.parametrize("name", ["labels", "split", "heights", "origin", "quarter_turns", "group"])
def test_real_maps_that_differ_in_anything_have_another_fingerprint(name):
    maps = placed_maps()
    if name in PROVENANCE_ARRAYS:
        other = replace(maps, provenance=replace(maps.provenance, **{name: moved(maps.arrays[name])}))
    elif name == "group":
        other = replace(maps, group=maps.group[::-1].copy())
    else:
        other = replace(maps, **{name: np.roll(maps.split, 1) if name == "split" else moved(maps.arrays[name])})
    assert other.fingerprint != maps.fingerprint == placed_maps().fingerprint


# On disk


def test_a_data_set_is_read_back_as_it_was_saved(made, tmp_path):
    added: list[int] = []
    save_dataset(made, tmp_path / "sub" / "set", added.append)
    assert_equal(load(tmp_path / "sub" / "set"), made)
    assert listing(tmp_path / "sub") == {"set"}
    files = [path for path in (tmp_path / "sub" / "set").iterdir() if path.suffix == ".npy"]
    assert sum(added) == sum(path.stat().st_size for path in files) > made.heights.nbytes


def test_real_maps_have_sites_and_unknown_ground(tmp_path):
    save_dataset(real_maps(), tmp_path / "set")
    loaded = load(str(tmp_path / "set"))
    assert_equal(loaded, real_maps())
    assert loaded.config is None and np.isnan(loaded.heights).any()


def test_places_are_kept_beside_the_maps(tmp_path):
    save_dataset(placed_maps(), tmp_path / "set")
    assert_equal(load(tmp_path / "set"), placed_maps())
    names = {"dataset.json", *(f"{name}.npy" for name in ARRAYS + PROVENANCE_ARRAYS)}
    assert listing(tmp_path / "set") == names
    table = json.loads((tmp_path / "set/dataset.json").read_text())["provenance"]
    assert table["config"]["site"][0]["test_strip"] == ["north", 9.5]
    assert table["sites"][0]["file"] == "/there/data/site 0.tif" and table["sites"][1]["crs"] is None
    save_dataset(real_maps(), tmp_path / "set")
    assert_equal(load(tmp_path / "set"), real_maps())
    assert listing(tmp_path / "set") == {"dataset.json", *(f"{name}.npy" for name in ARRAYS)}


def test_straight_arcs_are_written_as_text(made, tmp_path):
    save_dataset(made, tmp_path / "set")
    table = json.loads((tmp_path / "set" / "dataset.json").read_text(), parse_constant=pytest.fail)
    assert table["actions"]["radii"] == ["inf", 0.7, -0.7]
    assert table["version"] == 1 and table["config"]["maps"] == 64
    assert set(table["files"]) == {f"{name}.npy" for name in ARRAYS}


def test_an_older_data_set_is_replaced(made, tmp_path):
    save_dataset(real_maps(), tmp_path / "set")
    save_dataset(made, tmp_path / "set")
    assert_equal(load(tmp_path / "set"), made)
    assert listing(tmp_path) == {"set"}


def test_an_empty_folder_is_written_to(tmp_path):
    (tmp_path / "set").mkdir()
    save_dataset(real_maps(), tmp_path / "set")
    assert listing(tmp_path) == {"set"}
    assert_equal(load(tmp_path / "set"), real_maps())


def a_file(folder):
    folder.write_text("mine")


def a_folder(folder):
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")


def a_folder_with_another_dataset_json(folder):
    a_folder(folder)
    (folder / "dataset.json").write_text('{"format": "other"}')


def a_data_set_and_notes(folder):
    save_dataset(real_maps(), folder)
    (folder / "notes.txt").write_text("mine")


@pytest.mark.parametrize("make", [a_file, a_folder, a_folder_with_another_dataset_json, a_data_set_and_notes])
def test_what_is_no_data_set_is_not_replaced(tmp_path, make):
    folder = tmp_path / "set"
    make(folder)
    before = listing(folder) if folder.is_dir() else folder.read_text()
    with pytest.raises(InputError, match="set: holds something else: must be a new or empty folder, or an older one"):
        save_dataset(real_maps(), folder)
    assert (listing(folder) if folder.is_dir() else folder.read_text()) == before
    assert listing(tmp_path) == {"set"}


@pytest.mark.parametrize("older", [False, True])
@pytest.mark.parametrize("after", [0, 1, 4])
def test_a_full_disk_leaves_nothing_half_written(made, tmp_path, monkeypatch, older, after):
    if older:
        save_dataset(real_maps(), tmp_path / "set")
    write, written = module._Hashing.write, []

    def write_until_full(self, data):
        if len(written) > after:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written.append(len(data))
        write(self, data)

    monkeypatch.setattr(module._Hashing, "write", write_until_full)
    with pytest.raises(InputError, match="set: cannot be written: No space left on device$"):
        save_dataset(made, tmp_path / "set")
    assert listing(tmp_path) == ({"set"} if older else set())
    if older:
        assert_equal(load(tmp_path / "set"), real_maps())


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_interrupted_write_leaves_the_older_folder(tmp_path, error):
    a_folder(tmp_path / "set")
    with pytest.raises(error), atomic_write_folder(tmp_path / "set", lambda folder: True) as temporary:
        (temporary / "half").touch()
        raise error
    assert listing(tmp_path) == {"set"}
    assert listing(tmp_path / "set") == {"notes.txt"}


def test_an_older_folder_comes_back_when_the_new_one_cannot_take_its_place(tmp_path):
    a_folder(tmp_path / "set")
    with (
        pytest.raises(InputError, match="set: cannot be written: "),
        atomic_write_folder(tmp_path / "set", lambda folder: True) as temporary,
    ):
        temporary.rmdir()
    assert listing(tmp_path) == {"set"}
    assert listing(tmp_path / "set") == {"notes.txt"}


def test_a_folder_that_takes_no_files_is_named():
    # The process file system lets nobody create a folder, not even root.
    with pytest.raises(InputError, match="^/proc/self/set: cannot be written: "):
        save_dataset(real_maps(), "/proc/self/set")


# What is wrong on disk is found


def changed_table(folder: Path, **changes) -> None:
    """Changes dataset.json as another version of travjax might have written it, its checksum included."""
    path = folder / "dataset.json"
    table = {key: value for key, value in json.loads(path.read_text()).items() if key != "sha256"} | changes
    path.write_text(json.dumps(table | {"sha256": dataset_json.digest(table)}))


def changed_array(folder: Path, name: str, array: np.ndarray) -> None:
    """Replaces an array with its checksum: what a faulty writer would leave."""
    np.save(folder / f"{name}.npy", array)
    files = json.loads((folder / "dataset.json").read_text())["files"]
    data = (folder / f"{name}.npy").read_bytes()
    files[f"{name}.npy"] = {"bytes": len(data), "sha256": module.hashlib.sha256(data).hexdigest()}
    changed_table(folder, files=files)


def altered(path: Path, place: int) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)


DAMAGES = {
    "folder missing": (lambda folder: folder.rename(f"{folder}2"), "data set = '{0}': must be a folder that travjax"),
    "no data set": (
        lambda folder: (folder / "dataset.json").unlink(),
        "{0}/dataset.json: cannot be read: No such file or directory",
    ),
    "array missing": (
        lambda folder: (folder / "labels.npy").unlink(),
        "{0}/labels.npy: cannot be read: No such file or directory",
    ),
    "array a folder": (
        lambda folder: ((folder / "seed.npy").unlink(), (folder / "seed.npy").mkdir()),
        "{0}/seed.npy: ",
    ),
    "half of dataset.json": (
        lambda folder: os.truncate(folder / "dataset.json", 300),
        "{0}/dataset.json: not JSON: ",
    ),
    "no text": (
        lambda folder: (folder / "dataset.json").write_bytes(b"\xff\xfe{}"),
        "{0}/dataset.json: cannot be read: byte 0 is not",
    ),
    "a list": (
        lambda folder: (folder / "dataset.json").write_text("[]"),
        "{0}/dataset.json: not the description of a travjax data set",
    ),
    "another format": (
        lambda folder: changed_table(folder, format="croissant"),
        "{0}/dataset.json: not the description of a travjax data set",
    ),
    "another version": (
        lambda folder: changed_table(folder, version=2),
        "{0}/dataset.json: format version 2: must be 1; make it again",
    ),
    "robot edited by hand": (
        lambda folder: (folder / "dataset.json").write_text(
            (folder / "dataset.json").read_text().replace('"max_step": 0.0826', '"max_step": 0.2')
        ),
        "{0}/dataset.json: has been altered: its checksum differs",
    ),
    "truncated": (
        lambda folder: os.truncate(folder / "heights.npy", 5000),
        "{0}/heights.npy: 5000 bytes: must be 26264; it was truncated or overwritten",
    ),
    "one bit": (
        lambda folder: altered(folder / "heights.npy", -100),
        "{0}/heights.npy: has been altered: its SHA-256 is ",
    ),
    "one bit of the header": (lambda folder: altered(folder / "split.npy", 3), "{0}/split.npy: has been altered: "),
    "robot refused": (
        lambda folder: changed_table(folder, robot={"name": "R"}),
        "{0}: missing wheelbase, ",
    ),
    "shape": (
        lambda folder: changed_array(folder, "labels", np.zeros((6, 5), np.uint8)),
        "{0}: labels = '[6, 5] of uint8': must be [6, 36] of uint8",
    ),
    "no shape": (
        lambda folder: changed_array(folder, "heights", np.float32(1)),
        "{0}: heights = '[] of float32': must be [6, 33, 33] of float32",
    ),
    "type": (
        lambda folder: changed_array(folder, "heights", np.zeros((6, 33, 33))),
        "{0}: heights = '[6, 33, 33] of float64': must be [6, 33, 33] of float32",
    ),
    "split out of range": (
        lambda folder: changed_array(folder, "split", np.array([0, 0, 0, 0, 7, 0], np.uint8)),
        "{0}: split = [7]: must be from 0 to 2: train, validation, test",
    ),
    "unknown style": (
        lambda folder: changed_table(folder, config={"maps": 6}),
        "{0}: group = ['site 0']: must be of mountain_crater, ",
    ),
    "no places": (
        lambda folder: (folder / "origin.npy").unlink(),
        "{0}/origin.npy: cannot be read: No such file or directory",
    ),
    "turns out of range": (
        lambda folder: changed_array(folder, "quarter_turns", np.full(6, 4, np.uint8)),
        "{0}: quarter_turns = [4]: must be from 0 to 3",
    ),
    "places without a site": (
        lambda folder: changed_table(folder, provenance=placed_maps().provenance.to_json() | {"sites": []}),
        "{0}: records of sites = []: must be of site 0, site 1",
    ),
    "objects": (
        lambda folder: changed_array(folder, "group", np.array([{}] * 6, object)),
        "{0}/group.npy: cannot be read as an array: Object arrays cannot be loaded",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_wrong_is_said_in_one_line(tmp_path, damage):
    do, message = DAMAGES[damage]
    placed = "places" in damage or "turns" in damage
    save_dataset(placed_maps() if placed else real_maps(), tmp_path / "set")
    do(tmp_path / "set")
    with pytest.raises(InputError) as raised:
        load(tmp_path / "set")
    assert str(raised.value).startswith(message.format(tmp_path / "set"))
    assert "\n" not in str(raised.value)


# Memory


@pytest.fixture
def large() -> Dataset:
    """30 MB of heights, which is more than what reading and writing may take beside them."""
    grid = Grid(8, 0.0625)
    count, actions = 450, replace(ACTIONS, turns=3)
    arrays = {
        "heights": np.zeros((count, *grid.shape), np.float32),
        "labels": np.zeros((count, len(actions)), np.uint8),
        "group": np.full(count, "site"),
        "seed": np.zeros(count, np.uint32),
        "split": np.zeros(count, np.uint8),
    }
    return Dataset(**arrays, setup=Setup(ROBOT, actions, grid), config=None)


def peak_of(function) -> int:
    """The most memory in bytes that NumPy and Python took beyond what they had before."""
    tracemalloc.start()
    try:
        function()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_saving_copies_no_large_array_and_loading_copies_it_once(large, tmp_path):
    size = large.heights.nbytes
    assert peak_of(lambda: save_dataset(large, tmp_path / "set")) < 20e6  # a piece of 16 MB, whatever the size
    assert peak_of(lambda: load(tmp_path / "set")) < size + 1e6


def test_generating_allocates_the_arrays_once(monkeypatch):
    monkeypatch.setattr(module, "MAPS_AT_ONCE", 64)
    config = DatasetConfig(maps=640)
    size = config.maps * (GRID.nodes**2 * 4 + len(ACTIONS))
    assert peak_of(lambda: generate(config, SETUP)) < 1.3 * size


def test_a_data_set_holds_the_very_arrays_that_it_was_given(large):
    again = replace(large, setup=replace(large.setup, robot=Robot.load("seekur_jr")))
    assert np.shares_memory(again.heights, large.heights)
    assert np.shares_memory(again.labels, large.labels)
