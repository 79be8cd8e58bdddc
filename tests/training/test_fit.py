"""Fitting by a call; what training does and says is in test_trainer.py and tests/commands/test_train.py."""

from dataclasses import replace

import pytest

from tests.commandline import files
from tests.small_training import PRESET, SETUP, TOML, copy, rows_of
from travjax.config import InputError
from travjax.estimators.preset import Preset
from travjax.files import find_preset
from travjax.runs.run import Run
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.training.fit import fit, run_from_preset

pytestmark = pytest.mark.usefixtures("shared_code")


def test_the_run_of_a_preset_is_for_its_robot_and_the_paper_s_actions():
    run = run_from_preset(replace(PRESET, robot="seekur_jr"))
    assert (run.robot, run.actions, run.grid) == (Robot.load("seekur_jr"), ActionSpace(), Grid())


def test_what_differs_from_the_preset_is_taken(tmp_path, few):
    (tmp_path / "tiny.toml").write_text(TOML)
    assert run_from_preset(tmp_path / "tiny.toml", actions=few, size=4.0, spacing=0.125) == Run(PRESET, SETUP)
    run = run_from_preset(PRESET, robot="leo_rover", actions=few, weights="w.npz", seed=7)
    assert (run.robot.name, run.preset.robot, run.preset.weights) == ("Leo Rover", "leo_rover", "w.npz")
    assert run.preset.dataset.seed == run.preset.training.seed == 7
    assert run.preset.heads == PRESET.heads


def test_a_preset_that_comes_with_travjax_is_named(tmp_path):
    assert run_from_preset("smoke").preset == Preset.load(find_preset("smoke", "resnet50"))
    assert run_from_preset("smoke", model="field").preset == Preset.load(find_preset("smoke", "field"))
    with pytest.raises(InputError, match="^preset none: no such field preset; allowed: laptop, "):
        run_from_preset("none", model="field")
    with pytest.raises(InputError, match="^model = 'resnet': must be one of resnet50, field$"):
        run_from_preset("smoke", model="resnet")
    (tmp_path / "tiny.toml").write_text(TOML)
    with pytest.raises(InputError, match="^model = 'field': must be resnet50, as .*tiny.toml says$"):
        run_from_preset(tmp_path / "tiny.toml", model="field")
    assert run_from_preset(PRESET, model="resnet50", actions=None).preset == PRESET
    with pytest.raises(InputError, match="^model = 'field': must be resnet50, as the preset says$"):
        run_from_preset(PRESET, model="field")


def test_a_run_goes_on_only_where_it_is_told_to(trained, tmp_path, capsys):
    folder, run = copy(trained, tmp_path / "run"), Run.load(trained)
    before = files(folder / "checkpoints")
    with pytest.raises(InputError, match=f"^--out {folder}: holds a training run; allowed: --resume"):
        fit(run, folder, data=trained.parent / "set")
    with pytest.raises(InputError, match=f"^the run {folder}: preset.heads.hidden = 8: must be 16"):
        other = replace(run, preset=replace(PRESET, heads=replace(PRESET.heads, hidden=8)))
        fit(other, folder, data=trained.parent / "set", resume=True, option="the run")
    other = replace(run, preset=replace(PRESET, weights="other.npz"))
    fit(other, str(folder), data=str(trained.parent / "set"), resume=True)
    assert Run.load(folder) == run  # it began with those weights
    assert rows_of(folder) == rows_of(trained) and files(folder / "checkpoints") == before
    assert capsys.readouterr().out.endswith(f"\n{folder}/training.png\n")
