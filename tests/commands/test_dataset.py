"""`travjax dataset`: what it makes, writes and says, and the one line for each bad input."""

import os
import re
import shutil
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from tests.commandline import FEW, Run, files, printed_files, run, run_words, succeeds
from travjax import cli
from travjax.commands import dataset as command
from travjax.data import build, dataset, sites, tfds_export
from travjax.data.dataset import ARRAYS, DatasetConfig, generate, load
from travjax.data.provenance import Site, SitesConfig
from travjax.data.sampling import balanced_subset
from travjax.evaluation.dataset_tables import statistics_table, windows_table
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup

GRID = Grid(4, 0.125)
SMALL = ("--size", 4, "--spacing", 0.125)
CONFIG = DatasetConfig(maps=40, seed=3, validation=0.2, test=0.1)
WORDS = ("dataset", "--maps", 40, "--seed", 3, "--validation", 0.2, "--test", 0.1, *SMALL)


@pytest.fixture(scope="module")
def made(tmp_path_factory, few) -> Run:
    """A data set in a folder that was not there, and its export."""
    folder = tmp_path_factory.mktemp("runs") / "new" / "set"
    return succeeds(folder, *WORDS, "--actions", few, "--robot", "husky_a200", "--tfds", folder.with_name("set_tfds"))


def assert_equal(one: dataset.Dataset, other: dataset.Dataset):
    assert one.arrays.keys() == other.arrays.keys()
    for name, array in one.arrays.items():
        np.testing.assert_array_equal(array, other.arrays[name])
    assert (one.provenance and one.provenance.to_json()) == (other.provenance and other.provenance.to_json())
    parts = ("robot", "actions", "grid", "config")
    assert [getattr(one, name) for name in parts] == [getattr(other, name) for name in parts]


def test_the_data_set_is_the_one_that_generate_makes(made):
    assert_equal(load(made.folder), generate(CONFIG, Setup(Robot.load("husky_a200"), FEW, GRID)))


def test_the_export_is_read_back_equal(made):
    assert_equal(tfds_export.read(made.folder.with_name("set_tfds")), load(made.folder))


def test_everything_that_is_written_is_printed(made):
    statistics = made.folder.with_name("set_statistics.txt")
    names = {made.folder, statistics, made.folder.with_name("set_tfds")}
    assert printed_files(made) == set(made.folder.parent.iterdir()) == names
    assert {path.name for path in made.folder.iterdir()} == {"dataset.json", *(f"{name}.npy" for name in ARRAYS)}


def test_the_statistics_are_printed_and_written(made):
    table = statistics_table(load(made.folder), as_in_paper=False)
    assert f"\n{table}\n" in made.out
    assert made.folder.with_name("set_statistics.txt").read_text() == table + "\n"
    for split, maps in (("train", 28), ("validation", 8)):
        size = len(balanced_subset(load(made.folder).labels, load(made.folder).maps_of(split), seed=3)[0])
        assert re.search(rf"^{split}, balanced +{maps} +{size} ", made.out, re.MULTILINE)
    assert "40 maps (28 train, 8 validation, 4 test), Husky A200, 18 trajectories a map" in made.out


def test_progress_is_shown_with_a_rate_and_the_time_left(made):
    bars = dict(line.split(": ", 1) for line in made.err.replace("\r", "\n").splitlines() if line)  # the last of each
    assert list(bars) == ["making", "saving", "exporting"]
    for what, rate in (("making", "map/s"), ("saving", "B/s"), ("exporting", "map/s")):
        assert re.search(rf"^100%.* \[\d+:\d+<\d+:\d+, +[\d.]+k?M?G?({rate}|s/map)\]$", bars[what])


def test_a_data_set_that_lies_there_is_replaced(tmp_path, few):
    for seed in (0, 5):
        succeeds(tmp_path / "set", "dataset", "--maps", 3, "--seed", seed, *SMALL, "--actions", few)
        assert load(tmp_path / "set").config == DatasetConfig(3, seed)
    assert {path.name for path in tmp_path.iterdir()} == {"set", "set_statistics.txt"}


def test_the_paper_stands_beside_its_own_robot_and_actions_only(tmp_path, few):
    assert "paper's test set" not in succeeds(tmp_path / "few", "dataset", "--maps", 2, *SMALL, "--actions", few).out
    done = succeeds(tmp_path / "paper", "dataset", "--maps", 2)
    assert re.search(r"paper's test set +6\.23% +5\.50% +0\.42% +9\.60%", done.out)
    assert load(tmp_path / "paper").actions == ActionSpace()


def test_the_heights_are_in_memory_once(tmp_path, few, monkeypatch):
    monkeypatch.setattr(dataset, "MAPS_AT_ONCE", 64)
    tracemalloc.start()
    try:
        succeeds(tmp_path / "set", "dataset", "--maps", 640, "--actions", few)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    heights = 640 * 129 * 129 * 4
    assert heights < peak < heights + 25e6  # a piece of 16 MB that is written


# ---- Real maps


@pytest.fixture(scope="module")
def dems(tmp_path_factory) -> dict[str, Path]:
    """Two maps of 30 x 20 m, bumpy ground with a hole; a third of coarse is unknown, and its cells are large."""
    folder = tmp_path_factory.mktemp("dem")
    rng = np.random.default_rng(0)
    for name in ("yard", "field"):
        heights = np.cumsum(rng.normal(0, 0.02, (161, 241)), axis=1)
        heights[40:70, 30:60] = np.nan
        np.savez(folder / f"{name}.npz", heights=heights, cell_size=0.125, origin=(10.0, 20.0))
    heights = np.zeros((65, 65), np.int16)
    heights[:20] = -7
    np.save(folder / "coarse.npy", heights)
    return {path.stem: path for path in folder.iterdir()}


SETTINGS = {"stride": 2.0, "max_unknown": 0.2, "gap": 9.0}
REAL_WORDS = ("dataset", *SMALL, "--robot", "husky_a200", "--stride", 2, "--max-unknown", 0.2, "--gap", 9)


@pytest.fixture(scope="module")
def real(dems, tmp_path_factory, few) -> Run:
    """A data set of two DEM files, one of them held out, and its export."""
    folder = tmp_path_factory.mktemp("real") / "set"
    strips = ("--test-strip", "east", 6, "--validation-strip", "west", 5)
    files = ("--dem", dems["yard"], "--held-out", dems["field"])
    return succeeds(folder, *REAL_WORDS, *files, *strips, "--actions", few, "--tfds", folder.with_name("tfds"))


def config_of(dems) -> SitesConfig:
    yard = Site(str(dems["yard"]), test_strip=("east", 6.0), validation_strip=("west", 5.0))
    return SitesConfig((yard, Site(str(dems["field"]), split="test")), **SETTINGS)


def test_dem_files_become_the_data_set_of_their_sites(real, dems):
    loaded = load(real.folder)
    assert_equal(loaded, sites.read(config_of(dems), Setup(Robot.load("husky_a200"), FEW, GRID)))
    assert loaded.provenance.config == config_of(dems)
    assert set(loaded.group.tolist()) == {"yard", "field"} and all(len(loaded.maps_of(s)) for s in dataset.SPLITS)


def test_a_file_of_sites_gives_the_same(real, dems, tmp_path, few):
    (tmp_path / "sites.toml").write_text(f"""
        stride = 2.0
        max_unknown = 0.2
        gap = 9.0
        [[site]]
        file = "{dems["yard"]}"
        test_strip = ["east", 6.0]
        validation_strip = ["west", 5.0]
        [[site]]
        file = "{dems["field"]}"
        split = "test"
    """)
    words = ("--sites", tmp_path / "sites.toml", *SMALL, "--robot", "husky_a200", "--actions", few)
    assert_equal(load(succeeds(tmp_path / "set", "dataset", *words).folder), load(real.folder))


def test_what_became_of_the_windows_is_printed_and_written(real):
    loaded = load(real.folder)
    tables = [statistics_table(loaded, as_in_paper=False), windows_table(loaded.provenance)]
    assert all(f"\n{table}\n" in real.out for table in tables)
    assert real.folder.with_name("set_statistics.txt").read_text() == "\n\n".join(tables) + "\n"
    copies = 3 * loaded.provenance.sites[0].train
    assert f"Windows of the sites, beside which {copies} maps are turned copies:" in real.out
    checked = run_words("dataset", "--check", real.folder)[1]
    assert all(table in checked for table in tables)


def test_an_export_of_real_maps_is_read_back_equal(real):
    assert_equal(tfds_export.read(real.folder.with_name("tfds")), load(real.folder))


def test_progress_of_real_maps_is_shown(real):
    bars = dict(line.split(": ", 1) for line in real.err.replace("\r", "\n").splitlines() if line)
    assert list(bars) == ["making", "saving", "exporting"]
    windows = sum(site.windows - site.too_unknown for site in load(real.folder).provenance.sites)
    labelled = int(re.match(r"(\d+)map \[", bars["making"])[1])
    assert labelled >= windows and (load(real.folder).provenance.quarter_turns > 0).sum() < labelled


def test_reading_options_reach_the_files(dems, tmp_path, few):
    reading = ("--cell-size", 0.25, "--height-scale", 0.001, "--nodata=-7", "--allow-coarse", "--keep-holes")
    more = ("--no-rotations", "--max-unknown", 1, "--actions", few, "--robot", "husky_a200")
    done = succeeds(tmp_path / "set", "dataset", *SMALL, "--dem", dems["coarse"], *reading, *more)
    wanted = Site(str(dems["coarse"]), cell_size=0.25, height_scale=0.001, nodata=-7.0)
    expected = SitesConfig((wanted,), max_unknown=1.0, rotations=False, fill_holes=False, allow_coarse=True)
    assert load(done.folder).provenance.config == expected


def test_a_data_set_may_be_for_the_test_alone(dems, tmp_path, few):
    done = succeeds(tmp_path / "set", *REAL_WORDS, "--held-out", dems["field"], "--actions", few)
    assert set(load(done.folder).split.tolist()) == {2}
    assert re.search(r"^train +0 +0 +- +- +- +- +- +-$", done.out, re.MULTILINE)


BAD_REAL = {
    "sites that are missing": (["--sites", "none.toml"], "none.toml: cannot be read: No such file"),
    "a file that is missing": (["--dem", "none.tif"], "site none: file none.tif: no such file here, "),
    "both": (["--sites", "s.toml", "--dem", "a.tif"], r"--dem = \['a.tif'\]: must be left out where --sites is given"),
    "sites and a stride": (["--sites", "s.toml", "--stride", "2"], "--stride = 2.0: must be left out where --sites is"),
    "sites and a seed": (["--sites", "s.toml", "--seed", "2"], "--seed = 2: must be left out where --sites is given"),
    "maps of files": (["--dem", "a.tif", "--maps", "9"], "--maps = 9: must be left out where DEM files are given"),
    "share of files": (["--held-out", "a.tif", "--test", "0.5"], "--test = 0.5: must be left out where DEM files"),
    "gap of nothing": (["--gap", "9"], "--gap = 9.0: must be left out where no DEM file is given"),
    "rotations of nothing": (["--no-rotations"], "--no-rotations = True: must be left out where no DEM file is given"),
    "reading of nothing": (["--allow-coarse"], "--allow-coarse = True: must be left out where no DEM file is given"),
    "strip of nothing": (
        ["--test-strip", "east", "9"],
        r"--test-strip = \['east', '9'\]: must be left out where no DEM",
    ),
    "strip of held-out files": (
        ["--held-out", "a.tif", "--test-strip", "east", "9"],
        r"--test-strip = \['east', '9'\]: must be left out where no --dem file is given",
    ),
    "strip without a number": (
        ["--dem", "a.tif", "--test-strip", "east", "wide"],
        "--test-strip = east wide: must be a side, then metres",
    ),
    "unknown side": (
        ["--dem", "a.tif", "--validation-strip", "up", "9"],
        r"validation_strip = \('up', 9.0\): must be of one of north, east, south, west, then metres",
    ),
    "small gap": (["--dem", "a.tif", "--gap", "1"], "gap = 1.0: must be a distance in metres, at least 8"),
    "no share": (["--dem", "a.tif", "--max-unknown", "2"], "max_unknown = 2.0: must be a share from 0 to 1"),
    "names alike": (["--dem", "a.tif", "--held-out", "b/a.tif"], r"names of sites = \['a'\]: must be different"),
}


@pytest.mark.parametrize("name", BAD_REAL)
def test_bad_real_maps_are_one_line_and_nothing_is_written(tmp_path, monkeypatch, name):
    words, expected = BAD_REAL[name]
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    done = run(tmp_path / "out", "dataset", *words)
    assert (done.code, done.out) == (2, "")
    assert re.match(f"travjax: {expected}", done.err.splitlines()[-1]), done.err
    assert files(tmp_path) == {tmp_path / "here"}


def test_a_strip_without_windows_names_file_and_strip(dems, tmp_path, few):
    words = ("--dem", dems["yard"], "--test-strip", "north", 3, "--actions", few)
    done = run(tmp_path / "set", *REAL_WORDS, *words)
    message = "travjax: site yard: test_strip = north 3 m: must leave at least one of "
    assert done.code == 2 and done.err.splitlines()[-1].startswith(message)
    assert not files(tmp_path)


# ---- An existing data set


@pytest.fixture
def copied(made, tmp_path) -> Path:
    return shutil.copytree(made.folder, tmp_path / "copy")


def test_a_check_shows_what_a_data_set_holds_and_writes_nothing(copied):
    before = files(copied.parent)
    code, out, _ = run_words("dataset", "--check", copied)
    assert code == 0
    assert statistics_table(load(copied), as_in_paper=False) in out
    assert out.splitlines()[-1] == f"{copied}: all files are as they were written"
    assert files(copied.parent) == before


def test_a_data_set_that_exists_can_be_exported(copied, tmp_path):
    code, out, err = run_words("dataset", "--check", copied, "--tfds", tmp_path / "tfds")
    assert code == 0, err
    assert out.splitlines()[-1] == str(tmp_path / "tfds")
    assert_equal(tfds_export.read(tmp_path / "tfds"), load(copied))


def test_real_maps_are_not_beside_the_paper(tmp_path):
    actions, grid = ActionSpace(), Grid()
    heights, labels = np.zeros((3, *grid.shape), np.float32), np.zeros((3, len(actions)), np.uint8)
    group, seed, split = np.array(["quarry"] * 3), np.zeros(3, np.uint32), np.arange(3, dtype=np.uint8)
    real = dataset.Dataset(heights, labels, group, seed, split, Setup(Robot.load("seekur_jr"), actions, grid), None)
    dataset.save(real, tmp_path / "real")
    out = run_words("dataset", "--check", tmp_path / "real")[1]
    assert "quarry" in out
    assert "paper" not in out


def alter(folder: Path):
    content = bytearray((folder / "labels.npy").read_bytes())
    content[-1] ^= 1
    (folder / "labels.npy").write_bytes(content)


DAMAGE = {
    "altered labels": (alter, "SET/labels.npy: has been altered"),
    "truncated heights": (lambda folder: os.truncate(folder / "heights.npy", 99), "SET/heights.npy: 99 byte"),
    "missing splits": (lambda folder: (folder / "split.npy").unlink(), "SET/split.npy: cannot be read: No such file"),
    "no description": (lambda folder: (folder / "dataset.json").unlink(), "SET/dataset.json: cannot be read"),
    "no folder": (shutil.rmtree, "data set = 'SET': must be a folder that travjax wrote"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_data_set_is_one_line(copied, name):
    damage, expected = DAMAGE[name]
    damage(copied)
    code, out, err = run_words("dataset", "--check", copied)
    assert (code, out, len(err.splitlines())) == (2, "", 1), err
    assert err.startswith("travjax: ")
    assert expected.replace("SET", str(copied)) in err


@pytest.mark.parametrize(
    "words",
    [
        ("--maps", 3),
        ("--seed", 4),
        ("--test", 0.5),
        ("--robot", "leo_rover"),
        ("--size", 4),
        ("--actions", "few.toml"),
        ("--sites", "sites.toml"),
        ("--dem", "a.tif"),
        ("--gap", 9),
        ("--stride", 2),
    ],
    ids=lambda words: words[0],
)
def test_a_check_takes_no_options_of_what_is_made(copied, words):
    code, _, err = run_words("dataset", "--check", copied, *words)
    assert code == 2
    assert re.fullmatch(rf"travjax: {words[0]} = .*{words[1]}.*: must be left out where --check is given\n", err)


def test_a_check_takes_no_folder_to_write_to(copied, tmp_path):
    assert "--out = " in run(tmp_path / "out", "dataset", "--check", copied).err


# ---- Bad input


BAD_WORDS = {
    "no maps": (["--maps", "0"], "maps = 0: must be a whole number from 1"),
    "maps that are no number": (["--maps", "many"], "--maps.*'many'"),
    "negative seed": (["--seed", "-1"], "seed = -1: must be a whole number from 0"),
    "negative share": (["--validation", "-0.1"], r"validation = -0\.1: must be a share from 0 to 1"),
    "share that is none": (["--test", "nan"], "test = nan: must be a share"),
    "shares above 1": (["--validation", "0.6", "--test", "0.6"], r"validation \+ test = 1\.2: must be at most 1"),
    "unknown robot": (["--robot", "tank"], "'tank': no such preset"),
    "missing actions": (["--actions", "none.toml"], "none.toml: cannot be read"),
    "trajectories that leave the map": (["--size", "4"], "seekur_jr: .*trajectories leave the 4 m map"),
    "export into the data set": (["--tfds", "OUT/tfds"], "--tfds = .*: must be a folder outside the data set"),
    "export in place of the data set": (["--tfds", "OUT"], "--tfds = .*: must be a folder outside the data set"),
    "unknown option": (["--fast"], "--fast"),
}


@pytest.mark.parametrize("name", BAD_WORDS)
def test_bad_input_is_one_line_with_exit_code_2_and_nothing_written(tmp_path, name):
    words, expected = BAD_WORDS[name]
    done = run(tmp_path / "out", "dataset", *(word.replace("OUT", str(tmp_path / "out")) for word in words))
    assert done.code == 2
    assert len(done.err.splitlines()) == 1, done.err
    assert done.err.startswith("travjax: ")
    assert re.search(expected, done.err)
    assert not files(tmp_path)


@pytest.mark.parametrize("below", ["", "sub", "sub/sub"])
def test_a_file_in_the_way_of_the_output_is_one_line_before_anything_is_made(tmp_path, below, monkeypatch):
    monkeypatch.setattr(build, "generate", lambda *_: pytest.fail("made for nothing"))
    (tmp_path / "taken").write_text("mine")
    done = run(tmp_path / "taken" / below, "dataset", "--maps", 2)
    assert done.code == 2
    assert len(done.err.splitlines()) == 1, done.err
    assert f"{tmp_path / 'taken'}" in done.err
    assert files(tmp_path) == {tmp_path / "taken"}
    assert (tmp_path / "taken").read_text() == "mine"


def test_the_working_folder_is_not_replaced(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in (".", tmp_path, "../" + tmp_path.name):
        done = run(folder, "dataset", "--maps", 2)
        assert done.code == 2
        assert re.fullmatch("travjax: --out = '.*': must be another folder than the one you are in\n", done.err)
    assert not files(tmp_path)


def test_a_folder_of_something_else_is_left_alone_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(build, "generate", lambda *_: pytest.fail("made for nothing"))
    (tmp_path / "thesis.txt").write_text("mine")
    done = run(tmp_path, "dataset", "--maps", 2)
    assert done.code == 2
    assert done.err.startswith(f"travjax: --out {tmp_path}: holds something else: must be ")
    assert files(tmp_path) == {tmp_path / "thesis.txt"}


@pytest.mark.parametrize("text", ["mine\n", ""])
def test_a_file_of_the_user_s_is_not_replaced_by_the_statistics(tmp_path, monkeypatch, text):
    monkeypatch.setattr(build, "generate", None)  # not reached
    notes = tmp_path / "set_statistics.txt"
    notes.write_text(text)
    done = run(tmp_path / "set", *WORDS)
    way = f"{notes} is in the way, and no table of travjax; allowed: another name, or none there"
    assert (done.code, done.err.splitlines()[-1]) == (2, f"travjax: --out {tmp_path / 'set'}: {way}")
    assert files(tmp_path) == {notes} and notes.read_text() == text


@pytest.mark.parametrize("option", ["--out", "--tfds"])
def test_a_link_to_itself_is_one_line(tmp_path, few, option):
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    code, _, err = run_words(*WORDS, "--actions", few, "--robot", "husky_a200", "--out", tmp_path / "set", option, loop)
    assert code == 2
    assert err == f"travjax: {loop}: a symbolic link that leads to itself; allowed: a folder, or a new one\n"
    assert files(tmp_path) == {loop}


def test_a_foreign_file_beside_the_arrays_is_kept(copied, few):
    (copied / "notes.txt").write_text("mine")
    before = load(copied)
    done = run(copied, "dataset", "--maps", 2, *SMALL, "--actions", few)
    assert done.code == 2
    assert "holds something else" in done.err.splitlines()[-1]
    assert_equal(load(copied), before)
    assert (copied / "notes.txt").read_text() == "mine"
    assert {path.name for path in copied.parent.iterdir()} == {"copy"}


def test_too_many_maps_for_the_memory_are_said_so(tmp_path, few, monkeypatch):
    def exhausted(*_):
        raise MemoryError("Unable to allocate 620. GiB")

    monkeypatch.setattr(build, "generate", exhausted)
    done = run(tmp_path / "set", "dataset", "--maps", 9_999_999, *SMALL, "--actions", few)
    assert done.code == 2
    assert done.err.splitlines()[-1].endswith("--maps = 9999999: do not fit in memory: Unable to allocate 620. GiB")
    assert not files(tmp_path)


def test_an_interruption_leaves_the_data_set_that_was_there(copied, few, monkeypatch):
    def interrupt(dataset, folder, on_progress):
        raise KeyboardInterrupt

    monkeypatch.setattr(build, "save", interrupt)
    before = files(copied.parent)
    done = run(copied, "dataset", "--maps", 2, *SMALL, "--actions", few)
    assert done.code == 130
    assert done.err.splitlines()[-1] == "travjax: interrupted"
    assert files(copied.parent) == before


def test_without_tensorflow_datasets_the_data_set_is_kept(tmp_path, few, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorflow_datasets", None)
    done = run(tmp_path / "set", "dataset", "--maps", 2, *SMALL, "--actions", few, "--tfds", tmp_path / "tfds")
    assert done.code == 2
    assert "pip install 'travjax[tfds]'" in done.err.splitlines()[-1]
    assert load(tmp_path / "set").config == DatasetConfig(2)
    assert {path.name for path in tmp_path.iterdir()} == {"set", "set_statistics.txt"}


def test_help_names_the_options(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["dataset", "--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert all(f"--{name.replace('_', '-')} " in shown for name in (*command.MAKING, "check", "tfds"))
