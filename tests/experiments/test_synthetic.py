"""`python -m travjax.experiments.synthetic`: a whole experiment at a tiny preset, going on, and bad input."""

import contextlib
import io
import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from tests.commandline import files, run_words
from tests.conftest import SEEKUR_JR
from tests.small_training import GRID_WORDS, HUSKY, PRESET, SETUP, TOML, copy, loads, rows_of, validations
from travjax.evaluation.metrics import Confusion
from travjax.evaluation.simulator_benchmark import machine
from travjax.experiments import synthetic
from travjax.runs.run import Run
from travjax.simulation.actions import ActionSpace
from travjax.simulation.setup import Setup
from travjax.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("shared_code")

EVALUATION = [f"evaluation/{name}.png" for name in ("predictions", "precision_recall", "reliability")]
TRAINING = ["training.png", "inputs.png"]


def run(*words) -> tuple[int, str, str]:
    """The experiment in this process: exit code, standard output and errors."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        return synthetic.main([*map(str, words)]), out.getvalue(), err.getvalue()


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A working folder with the preset of the tests of training, tiny.toml."""
    folder = tmp_path_factory.mktemp("place")
    (folder / "tiny.toml").write_text(TOML)
    return folder


@pytest.fixture(scope="module")
def words(few) -> tuple:
    return ("--actions", few, *GRID_WORDS)


@pytest.fixture(scope="module")
def done(place, words, shared_code) -> tuple[Path, str]:
    """The folder of an experiment that was interrupted in its second phase and went on, and what it printed then."""
    step = Trainer._step

    def interrupted(trainer, *batch):
        if trainer.position.total == 26:
            raise KeyboardInterrupt
        return step(trainer, *batch)

    with contextlib.chdir(place):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Trainer, "_step", interrupted)
            code, _, err = run("tiny.toml", *words)
        assert code == 130 and err.endswith("travjax: interrupted; the same command goes on from there\n")
        assert not (place / "runs/synthetic/tiny/report.md").exists()
        code, out, err = run("tiny.toml", *words)
    assert code == 0, err
    return place / "runs/synthetic/tiny", out


# ---- What it makes


def test_it_trains_and_evaluates_like_the_commands(done, trained, tmp_path):
    folder, _ = done
    assert rows_of(folder) == rows_of(trained)
    assert Run.load(folder) == Run(PRESET, SETUP)
    code, _, err = run_words("evaluate", trained, "--data", trained.parent / "set", "--out", tmp_path / "out")
    assert code == 0, err
    for name in ("tables.txt", "evaluation.json"):
        assert (folder / "evaluation" / name).read_text() == (tmp_path / "out" / name).read_text()


def test_it_goes_on_where_it_was_interrupted(done):
    assert "goes on from step 24: phase 2" in done[1]


def test_everything_is_in_one_folder(done):
    folder, out = done
    texts = {"run.json", "metrics.jsonl", "report.md"}
    folders = {"checkpoints", "tensorboard", "data", "evaluation"}
    assert {path.name for path in folder.iterdir()} == texts | {*TRAINING} | folders
    evaluated = {"tables.txt", "evaluation.json", *(Path(name).name for name in EVALUATION)}
    assert {path.name for path in (folder / "evaluation").iterdir()} == evaluated
    assert out.splitlines()[-1] == "runs/synthetic/tiny/report.md"


def test_the_report_holds_tables_figures_and_configuration(done):
    folder, out = done
    report = (folder / "report.md").read_text()
    last = validations(folder)[-1]
    assert report.startswith("# Synthetic maps, preset tiny\n\nHusky A200, 18 trajectories a map; 30 maps; 28 steps, ")
    assert f" samples/s in the last epoch on {machine()}.\n" in report and last["step"] == 28
    tables = (folder / "evaluation" / "tables.txt").read_text()
    assert f"```\n{tables}```\n" in report and tables in out
    assert f"```json\n{(folder / 'run.json').read_text()}```\n" in report
    shown = re.findall(r"^!\[.+\]\((.+)\)$", report, re.MULTILINE)
    assert shown == EVALUATION + TRAINING
    for name in shown:
        Image.open(folder / name).verify()
    assert "the paper's in brackets" not in report  # another robot


def test_a_finished_experiment_is_evaluated_again_and_not_trained(done, words, place, tmp_path, monkeypatch):
    folder = copy(done[0], tmp_path / "again")
    (folder / "report.md").unlink()
    monkeypatch.setattr(Trainer, "_step", lambda *arguments: pytest.fail("trained"))
    code, _, err = run(place / "tiny.toml", *words, "--out", folder)
    assert code == 0, err
    assert (folder / "report.md").read_text() == (done[0] / "report.md").read_text()
    assert loads((folder / "evaluation" / "evaluation.json").read_text()) == loads(
        (done[0] / "evaluation" / "evaluation.json").read_text()
    )


# ---- The paper beside it


def line_of(run: Run, confusion: Confusion) -> list[str]:
    return synthetic._beside_the_paper(run, confusion)


def test_the_paper_s_figures_stand_beside_ours():
    as_in_paper = Run(PRESET, Setup(SEEKUR_JR))
    (line,) = line_of(as_in_paper, Confusion(tn=75, fp=10, fn=5, tp=15))
    assert "recall 0.750 (0.944), precision 0.600 (0.684), F1 0.667 (0.793)" in line
    (line,) = line_of(as_in_paper, Confusion(tn=100, fp=0, fn=0, tp=0))
    assert "recall - (0.944), precision - (0.684), F1 - (0.793)" in line


@pytest.mark.parametrize(
    "run",
    [
        Run(PRESET, Setup(HUSKY)),
        Run(PRESET, Setup(replace(SEEKUR_JR, max_step=0.1))),
        Run(PRESET, Setup(SEEKUR_JR, ActionSpace(radii=(math.inf, 1.5, -1.5)))),
    ],
)
def test_the_paper_s_figures_are_left_out_where_they_do_not_compare(run):
    assert line_of(run, Confusion(80, 5, 5, 15)) == []


# ---- Bad input


def refusal(*words) -> str:
    """The one line of an experiment that fails."""
    code, _, err = run(*words)
    assert code == 2 and err.count("\n") == 1 and err.startswith("travjax: ")
    return err.removeprefix("travjax: ").strip()


def test_a_preset_that_is_not_there_is_one_line(place, tmp_path, monkeypatch):
    monkeypatch.chdir(place)
    said = refusal("small", "--out", tmp_path / "out")
    assert said == "preset small: no such resnet50 preset; allowed: laptop, paper, smoke, workstation, or a .toml file"
    assert files(tmp_path) == set()


def test_an_experiment_does_not_go_on_with_another_preset(done, words, tmp_path):
    (tmp_path / "other.toml").write_text(TOML.replace("learning_rate = 1e-3", "learning_rate = 2e-3"))
    before = files(done[0])
    said = refusal(tmp_path / "other.toml", *words, "--out", done[0])
    changed = "preset.training.learning_rate = 0.002: must be 0.001, as in the run so far"
    assert said == f"--out {done[0]}: {changed}"
    assert refusal(tmp_path / "other.toml", *words, "--robot", "leo_rover", "--out", done[0]).startswith("--out ")
    assert files(done[0]) == before


def test_missing_weights_are_one_line_and_leave_nothing(place, words, tmp_path, monkeypatch):
    monkeypatch.chdir(place)
    monkeypatch.delenv("TRAVJAX_DATA", raising=False)
    said = refusal("tiny.toml", *words, "--weights", "none.npz", "--out", tmp_path / "out")
    assert said.startswith("weights none.npz: no such file here")
    assert files(tmp_path) == set()
