"""The examples run, with small settings, and print what they say."""

import importlib.util
import re
import runpy
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests.exporting.test_stablehlo import SHORT
from tests.small_training import SETUP, dataset
from travjax.exporting.stablehlo import export_simulator
from travjax.simulation.setup import Setup

EXAMPLES = Path(__file__).parents[1] / "examples"

PRESET = """
model = "field"
weights = "none"
elevation_scale = 0.1
[dataset]
maps = 6
validation = 0.2
test = 0.2
[field]
stem = 1
widths = [1]
channels = 2
hidden = 4
[training]
batch_size = 4
head_epochs = 0
epochs = 1
weight_decay = 0.0
validation_samples = 100
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Examples write to runs/examples of the working directory."""
    monkeypatch.chdir(tmp_path)


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def lines_said(module: ModuleType) -> list[str]:
    """Returns the last indented block of the module's docstring: what it prints."""
    assert module.__doc__
    return re.findall(r"(?:^    .*\n)+", module.__doc__, re.MULTILINE)[-1].replace("    ", "", 1).splitlines()


def words(text: str) -> list[str]:
    """Returns the words of a text without its numbers, which differ a little between machines."""
    return re.sub(r"[\d.]+", "", text).split()


def test_every_example_is_tested():
    tested = {"label_dem", "own_robot", "paper_figure", "run_exported", "train_field"}
    assert {path.stem for path in EXAMPLES.glob("*.py")} == tested


def test_a_dem_is_labelled(capsys):
    module = example("label_dem")
    module.main(stride=16.0)
    out = capsys.readouterr().out
    assert out.startswith("4 windows") and words(out) == words("\n".join(lines_said(module)))
    module.main("runs/examples/site.npz", stride=16.0)
    assert capsys.readouterr().out == out


def test_a_robot_of_ones_own_fails_less_with_more_clearance(capsys):
    module = example("own_robot")
    module.main(maps=4)
    out = capsys.readouterr().out
    assert words(out) == words("\n".join(lines_said(module)))
    shares = [float(share) for share in re.findall(r"([\d.]+) %", out)]
    assert shares == sorted(shares, reverse=True) and shares[0] > shares[-1]


def test_a_figure_of_the_paper_is_drawn(capsys):
    module = example("paper_figure")
    assert module.main(every=100).stat().st_size > 10_000
    assert words(capsys.readouterr().out) == words("\n".join(lines_said(module)[:-1]))


def test_a_field_is_trained_and_compared(capsys, tmp_path):
    module = example("train_field")
    (tmp_path / "tiny.toml").write_text(PRESET)
    module.main(preset="tiny.toml", maps=2)
    said = lines_said(module)
    out = "\n".join(capsys.readouterr().out.splitlines()[-len(said) :])
    assert words(out) == words("\n".join(said))
    simulator, _, field = (float(score) for score in re.findall(r"(\d\.\d+)$", out, re.MULTILINE))
    assert simulator < 0.5 < field


def test_an_exported_file_runs_without_travjax(capsys, monkeypatch):
    export_simulator("it.stablehlo", Setup(SETUP.robot, SHORT, SETUP.grid))
    np.save("heights.npy", dataset().heights[:3])
    source = EXAMPLES / "run_exported.py"
    monkeypatch.setattr(sys, "argv", [source.name, "it.stablehlo", "heights.npy"])
    runpy.run_path(str(source))
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "simulator, contact model nearest for Husky A200"
    assert said[5] == f"limits: {list(SETUP.robot.limits)}" and said[8].startswith("failed: [b, 2, 3] bool")
    lines = source.read_text().splitlines()
    imports = [line for line in lines if re.match("(import|from) ", line)]
    assert len(lines) <= 20 and imports and not any("travjax" in line for line in imports)
