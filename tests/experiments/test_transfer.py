"""`python -m travjax.experiments.transfer`: what it makes of sites and presets, going on, and bad input."""

import contextlib
import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.small_training import GRID, GRID_WORDS, TOML, copy, loads
from travjax.config import InputError, to_json
from travjax.data import sites
from travjax.data.dataset import save
from travjax.data.provenance import SitesConfig
from travjax.estimators.preset import TrainingConfig
from travjax.experiments import transfer
from travjax.experiments.transfer_runs import ARMS, TransferConfig
from travjax.files import find_preset
from travjax.runs.run import Run
from travjax.simulation.robot import Robot

pytestmark = pytest.mark.usefixtures("shared_code")

SITES = """
max_unknown = 0.2
[[site]]
file = "{folder}/hills.npz"
validation_strip = ["east", 4]
[[site]]
file = "{folder}/crater.npz"
split = "test"
[[site]]
file = "{folder}/plain.npz"
split = "test"
"""

PRESET = """
sites = "sites.toml"
synthetic = "tiny.toml"
seeds = [0, 1]
trajectories_per_map = 5
shown = "crater"
shown_maps = 1
[training]
batch_size = 8
head_epochs = 2
epochs = 0
learning_rate = 1e-3
trajectories_per_map = 3
failing_per_map = 2
"""


def write_files(folder: Path) -> Path:
    """Three sites of 12 x 20 m, the plain without any failure, and a preset with its files; returns the preset."""
    random, cell = np.random.default_rng(0), GRID.spacing
    y, x = np.meshgrid(*(cell * np.arange(round(edge / cell) + 1) for edge in (12, 20)), indexing="ij")
    for name in ("hills", "crater", "plain"):
        bumps = 0.0 if name == "plain" else 0.05
        heights = bumps * (4 * np.sin(x) * np.cos(1.3 * y) + random.standard_normal(x.shape))
        np.savez(folder / f"{name}.npz", heights=heights, cell_size=cell, origin=(100.0, 200.0))
    for name, text in (("sites", SITES.format(folder=folder)), ("tiny", TOML), ("small", PRESET)):
        (folder / f"{name}.toml").write_text(text)
    return folder / "small.toml"


def run(*words) -> tuple[int, str, str]:
    """The experiment in this process: exit code, standard output and errors."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        return transfer.main([*map(str, words)]), out.getvalue(), err.getvalue()


@pytest.fixture(scope="module")
def preset(tmp_path_factory) -> Path:
    return write_files(tmp_path_factory.mktemp("files"))


@pytest.fixture(scope="module")
def whole(preset, few) -> tuple[tuple, Path, str]:
    """The words of an experiment that made everything, its folder and what it printed."""
    out = preset.parent / "out"
    words = (preset, "--actions", few, *GRID_WORDS, "--out", out)
    code, printed, err = run(*words)
    assert code == 0, err
    return words, out, printed


def test_it_says_where_everything_is(whole):
    _, out, printed = whole
    named = {Path(line) for line in printed.splitlines() if line.startswith(str(out))}
    assert {out / name for name in ("report.md", "results.json", "f1.png", "maps.png")} <= named
    assert all(path.exists() for path in named)


def test_the_report_holds_the_tables_and_the_figures(whole):
    _, out, printed = whole
    report = (out / "report.md").read_text()
    for part in ("always fails", "paper: its own", "paper, transferred", "crater", "(f1.png)", "(maps.png)"):
        assert part in report
    assert "step on plain: no trajectory fails" in report
    for line in printed.splitlines():
        if "always fails" in line or "untrained" in line:
            assert line in report
    assert "samples of 4 of 6 test maps" in report  # of the synthetic model


def test_the_json_holds_every_seed_and_epoch_and_where_the_maps_come_from(whole):
    results = loads((whole[1] / "results.json").read_text())
    assert set(results["arms"]) == set(ARMS)
    for arm in results["arms"].values():
        assert set(arm) == {"0", "1"}
        assert [[epoch["number"] for epoch in seed["epochs"]] for seed in arm.values()] == [[0, 1, 2]] * 2
    assert results["config"]["training"]["head_epochs"] == 2
    assert [site["name"] for site in results["real"]["sites"]] == ["hills", "crater", "plain"]


def test_a_second_call_trains_nothing_and_gives_the_same_results(whole, monkeypatch):
    words, out, _ = whole
    before = (out / "results.json").read_text()
    monkeypatch.setattr("travjax.experiments.transfer_runs.Trainer", None)
    code, _, err = run(*words)
    assert code == 0, err
    assert (out / "results.json").read_text() == before


def test_a_model_and_a_data_set_may_be_given(whole, preset, trained, tmp_path):
    given = Run.load(trained)
    data = sites.read(SitesConfig.load(preset.parent / "sites.toml"), given.setup)
    save(data, tmp_path / "data")
    code, printed, err = run(preset, "--synthetic", trained, "--data", tmp_path / "data", "--out", tmp_path / "out")
    assert code == 0, err
    assert not (tmp_path / "out" / "synthetic").exists() and not (tmp_path / "out" / "data").exists()
    # `trained` is the run that the whole experiment makes for itself
    made, again = (loads((out / "results.json").read_text()) for out in (whole[1], tmp_path / "out"))
    assert made["arms"] == again["arms"]


def test_without_real_maps_it_runs_on_stand_ins_and_says_so_everywhere(trained, tmp_path, monkeypatch):
    monkeypatch.delenv("TRAVJAX_DATA", raising=False)
    shutil.copy(find_preset("stand_in", "sites"), tmp_path)
    (tmp_path / "sites.toml").write_text('stride = 8.0\n[[site]]\nfile = "quarry.npz"\n')
    (tmp_path / "tiny.toml").write_text(TOML)
    (tmp_path / "small.toml").write_text(PRESET.replace("[0, 1]", "[0]"))
    out = tmp_path / "out"
    words = (tmp_path / "small.toml", "--synthetic", trained, "--out", out)
    code, printed, err = run(*words)
    assert code == 0, err
    first = printed.splitlines()[0]
    assert first.startswith("Built-in stand-in sites take the place of real maps: bedrock_flats and crater_plain")
    report = (out / "report.md").read_text()
    assert report.startswith(f"# Transfer to stand-in maps\n\n**{first}**\n\n")
    for part in ("samples of stand-in maps", "## Stand-in maps", "crater_plain (stand-in)", "(stand_in_sites.png)"):
        assert part in report
    assert "real maps for" not in report and "## Real maps" not in report
    results = loads((out / "results.json").read_text())
    assert results["config"]["shown"] == "crater_plain (stand-in)"
    assert [site["name"] for site in results["real"]["sites"]] == [
        "bedrock_flats (stand-in)",
        "crater_plain (stand-in)",
    ]
    np.savez(tmp_path / "quarry.npz", heights=np.zeros((97, 97)), cell_size=GRID.spacing)
    monkeypatch.chdir(tmp_path)
    assert "holds an experiment on stand-in sites" in refused(*words)


# ---- Bad input


def refused(*words) -> str:
    code, out, err = run(*words)
    last = err.strip().splitlines()[-1]
    assert code == 2 and last.startswith("travjax: ") and "Traceback" not in err, (out, err)
    return last.removeprefix("travjax: ")


def test_a_folder_of_another_preset_is_refused(whole, preset, tmp_path):
    other = write_files(tmp_path)
    other.write_text(PRESET.replace("trajectories_per_map = 5", "trajectories_per_map = 6"))
    before = (whole[1] / "results.json").read_text()
    assert "another preset" in refused(other, "--out", whole[1])
    assert (whole[1] / "results.json").read_text() == before


def test_an_experiment_goes_on_when_the_files_that_its_preset_names_have_moved(tmp_path):
    begun = TransferConfig("sites.toml", "../train/laptop.toml", training=TrainingConfig(head_epochs=0))
    moved = replace(begun, sites="../sites/real.toml", synthetic="../resnet50/laptop.toml")
    transfer._require_same(tmp_path, begun)
    transfer._require_same(tmp_path, moved)
    assert loads((tmp_path / "config.json").read_text()) == loads(json.dumps(to_json(moved)))
    with pytest.raises(InputError, match="another preset"):
        transfer._require_same(tmp_path, replace(moved, trajectories_per_map=7))


def test_an_experiment_of_old_keys_goes_on_with_a_notice(tmp_path, capsys):
    begun, path = TransferConfig(training=TrainingConfig(head_epochs=0)), tmp_path / "config.json"
    text = json.dumps(to_json(begun))
    path.write_text(text.replace('"trajectories_per_map"', '"each"'))
    transfer._require_same(tmp_path, begun)
    assert capsys.readouterr().out == (
        f"{path}: key 'each' is now called 'trajectories_per_map'; the old name will not be read by the next version\n"
    )
    assert loads(path.read_text()) == loads(text)


def test_a_data_set_for_another_robot_is_refused_with_both_named(preset, trained, tmp_path):
    given, leo = Run.load(trained), Robot.load("leo_rover")
    save(sites.read(SitesConfig.load(preset.parent / "sites.toml"), replace(given.setup, robot=leo)), tmp_path / "data")
    message = refused(preset, "--synthetic", trained, "--data", tmp_path / "data", "--out", tmp_path / "out")
    assert "Leo Rover" in message and given.robot.name in message


def test_the_robot_of_a_given_model_is_not_chosen_again(preset, trained, tmp_path):
    message = refused(preset, "--synthetic", trained, "--robot", "leo_rover", "--out", tmp_path / "out")
    assert message == "--robot = 'leo_rover': must be left out where --synthetic is given"


def test_a_model_that_is_damaged_is_refused(preset, trained, tmp_path):
    broken = copy(trained, tmp_path / "broken")
    (broken / "run.json").unlink()
    assert "run.json" in refused(preset, "--synthetic", broken, "--out", tmp_path / "out")


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("sites", "crater.npz", "moon.npz", "moon.npz: no such file here"),
        ("sites", '"east", 4', '"up", 4', "site 1: validation_strip"),
        ("small", 'shown = "crater"', 'shown = "hills"', "shown = 'hills': must be a held-out site, crater, plain"),
        ("small", "\nepochs = 0", "\nepochs = 1", "[training] head_epochs = 2"),
        ("small", "seeds = [0, 1]", "seeds = []", "seeds = ()"),
        ("small", 'synthetic = "tiny.toml"', 'synthetic = "none.toml"', "none.toml: cannot be read"),
    ],
)
def test_bad_files_are_named(few, tmp_path, name, old, new, said):
    preset, path = write_files(tmp_path), tmp_path / f"{name}.toml"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    (tmp_path / "tiny.toml").write_text(
        TOML.replace("head_epochs = 2", "head_epochs = 1").replace("epochs = 2", "epochs = 0")
    )
    assert said in refused(preset, "--actions", few, *GRID_WORDS, "--out", tmp_path / "out")


def test_a_preset_that_is_not_there_is_named(tmp_path):
    assert "huge" in refused("huge", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()
