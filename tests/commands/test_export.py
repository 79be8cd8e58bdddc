"""`travjax export`: the file, its model card, and the one line for each bad input."""

import json
import re
from pathlib import Path

import jax
import numpy as np
import pytest

from tests.commandline import FEW, files, run_words
from tests.field_runs import CONFIG
from tests.small_training import GRID_WORDS, copy, dataset, host, require_equal
from travjax.models.variables import split_model
from travjax.runs.checkpoint import load_meta
from travjax.runs.model_card import card
from travjax.runs.model_file import read_model
from travjax.runs.predictor import DEFAULT, WEIGHTS, Predictor
from travjax.runs.run import load_estimator

EXPERIMENTS = Path(__file__).parents[2] / "experiments"

pytestmark = pytest.mark.usefixtures("shared_code")


def exported(folder: Path, to: Path, *words) -> str:
    code, out, err = run_words("export", folder, "--to", to, *words)
    assert code == 0, err
    return out


def refusal(*words) -> str:
    code, _, err = run_words("export", *words)
    line = err.strip().splitlines()[-1]
    assert code == 2 and line.startswith("travjax: ") and err.count("travjax: ") == 1
    return line.removeprefix("travjax: ")


def row(card: str, name: str) -> str:
    return re.search(rf"^\| {name} \| (.*) \|$", card, re.MULTILINE)[1]


def test_the_file_and_its_card_are_written_and_printed(field, tmp_path):
    to = tmp_path / "my_field.safetensors"
    assert exported(field, to) == f"{to}\n{to.with_suffix('.md')}\n"
    assert files(tmp_path) == {to, to.with_suffix(".md")}


@pytest.mark.parametrize("which", ["best", "latest"])
def test_the_file_holds_the_checkpoint_that_is_named(field, tmp_path, which):
    to = tmp_path / "it.safetensors"
    exported(field, to, "--checkpoint", which)
    (run, network, notes), (wanted, trained, meta) = read_model(to), load_estimator(field, which)
    assert run == wanted
    require_equal(host(split_model(network)[1]), host(split_model(trained)[1]))
    position = meta["position"]
    assert notes == {"dataset": dataset().fingerprint, "epoch": position["epoch"], "step": position["total"]}
    if which == "latest":
        assert notes["step"] == 10


def test_the_best_checkpoint_is_exported_unless_told_otherwise(field, tmp_path):
    exported(field, tmp_path / "it.safetensors")
    best = load_meta(field / "checkpoints", "best")["position"]["total"]
    assert read_model(tmp_path / "it.safetensors")[2]["step"] == best


def test_the_file_predicts_as_the_run_does(field, tmp_path):
    exported(field, tmp_path / "it.safetensors")
    one, other = (
        Predictor.load(source).predict(dataset().heights[:2]) for source in (field, tmp_path / "it.safetensors")
    )
    np.testing.assert_array_equal(one.probability, other.probability)
    np.testing.assert_array_equal(one.margins, other.margins)


def test_the_card_says_what_it_was_trained_on(field, tmp_path):
    exported(field, tmp_path / "it.safetensors", "--checkpoint", "latest")
    said = (tmp_path / "it.md").read_text()
    assert said.startswith("# it.safetensors\n")
    count = sum(leaf.size for leaf in jax.tree.leaves(split_model(load_estimator(field)[1])[1]))
    assert row(said, "estimator") == f"field, {count:,} parameters" and CONFIG.hidden == 8
    assert row(said, "robot").startswith("Husky A200; ")
    assert row(said, "maps") == f"4 x 4 m at 0.125 m, {len(FEW)} trajectories"
    wanted = f"30 synthetic maps of seed 5 (fingerprint {dataset().fingerprint}), seed 0, 10 steps"
    assert row(said, "trained on") == wanted
    assert row(said, "corrupted").startswith("50% of the maps: noise up to 0.02 m")
    assert "not evaluated: `travjax evaluate` writes the tables" in said


def test_the_card_holds_the_tables_of_the_evaluation_of_the_same_step(field, tmp_path):
    folder = copy(field, tmp_path / "run")
    best, last = (load_meta(field / "checkpoints", which)["position"]["total"] for which in ("best", "latest"))
    for name, step, f1 in (("evaluation", best - 1, 0.4), ("evaluation_latest", last, 0.5)):
        (folder / name).mkdir()
        (folder / name / "tables.txt").write_text(f"F1 of everything\n{f1}\n")
        (folder / name / "evaluation.json").write_text(json.dumps({"sample": {"steps": step}}))
    exported(folder, tmp_path / "it.safetensors", "--checkpoint", "latest")
    said = (tmp_path / "it.md").read_text()
    assert "```\nF1 of everything\n0.5\n```" in said and "not evaluated" not in said
    (folder / "evaluation_latest/evaluation.json").write_text('{"sample": {"steps": 3}}')
    exported(folder, tmp_path / "it.safetensors")
    assert "not evaluated: " in (tmp_path / "it.md").read_text()


def test_the_card_of_a_hazard_field_holds_what_was_measured_on_real_ground(field, tmp_path):
    folder = copy(field, tmp_path / "run")
    exported(folder, tmp_path / "it.safetensors")
    said = (tmp_path / "it.md").read_text()
    assert "## Beside the simulator, on real ground" in said and "Not measured: `python -m " in said
    (folder / "comparison").mkdir()
    (folder / "comparison/sites.txt").write_text("F1 on a hill\n0.4\n")
    exported(folder, tmp_path / "again.safetensors")
    said = (tmp_path / "again.md").read_text()
    assert "```\nF1 on a hill\n0.4\n```\n\nLimits: " in said and "Not measured" not in said


def test_the_card_of_the_estimator_that_comes_with_the_package_holds_what_is_recorded():
    trained, _, notes = read_model(WEIGHTS / f"{DEFAULT}.safetensors")
    tables, real = (
        (EXPERIMENTS / name).read_text().strip()
        for name in ("field/laptop/evaluation/tables.txt", "comparison/real/sites.txt")
    )
    assert (WEIGHTS / f"{DEFAULT}.md").read_text() == card(trained, notes, f"{DEFAULT}.safetensors", tables, real)


def test_a_resnet_is_exported_too(trained, tmp_path):
    exported(trained, tmp_path / "it.safetensors", "--checkpoint", "heads")
    run, network, notes = read_model(tmp_path / "it.safetensors")
    assert run.preset.model == "resnet50" and notes["step"] == 14
    require_equal(host(split_model(network)[1]), host(split_model(load_estimator(trained, "heads")[1])[1]))
    said = (tmp_path / "it.md").read_text()
    assert row(said, "estimator").startswith("resnet50, ") and "Beside the simulator" not in said


def test_a_card_and_a_file_of_ours_are_replaced(field, tmp_path):
    to = tmp_path / "it.safetensors"
    for which in ("latest", "best"):
        exported(field, to, "--checkpoint", which)
    best = load_meta(field / "checkpoints", "best")["position"]["total"]
    assert f", {best:,} steps" in row((tmp_path / "it.md").read_text(), "trained on")


# ---- Bad input


@pytest.mark.parametrize(
    ("name", "what"), [("notes.md", "model card"), ("notes.safetensors", "estimator"), ("notes.md/mine", "model card")]
)
def test_no_file_of_the_user_s_is_replaced(field, tmp_path, name, what):
    mine = tmp_path / name
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("# notes.safetensors\n\nmine\n")
    before, to = files(tmp_path), tmp_path / "notes.safetensors"
    way = f"{tmp_path / name.split('/')[0]} is in the way, and no {what} of travjax"
    assert refusal(field, "--to", to) == f"--to {to}: {way}; allowed: another name, or none there"
    assert files(tmp_path) == before and mine.read_text() == "# notes.safetensors\n\nmine\n"


def test_another_kind_of_file_is_one_line(field, tmp_path):
    said = refusal(field, "--to", tmp_path / "it.npz")
    assert said == f"--to {tmp_path / 'it.npz'}: must be a .safetensors file"
    assert files(tmp_path) == set()


def test_what_is_no_run_is_one_line(tmp_path):
    said = refusal(tmp_path / "none", "--to", tmp_path / "it.safetensors")
    assert said.startswith(f"{tmp_path / 'none/run.json'}: cannot be read: No such file or directory")
    assert files(tmp_path) == set()


def test_a_checkpoint_that_is_not_there_is_one_line(field, tmp_path):
    said = refusal(field, "--to", tmp_path / "it.safetensors", "--checkpoint", "heads")
    assert "holds no checkpoint 'heads'; it holds: " in said
    assert files(tmp_path) == set()


def test_a_folder_that_is_not_there_is_one_line(field, tmp_path):
    to = tmp_path / "none/it.safetensors"
    assert refusal(field, "--to", to).startswith(f"{to}: cannot be written: No such file or directory")
    assert files(tmp_path) == set()


# ---- Files that run without travjax


def test_the_field_and_the_simulator_are_exported_with_their_descriptions(field, tmp_path, few):
    simulator = ("--robot", "husky_a200", "--actions", few, *GRID_WORDS, "--contact", "nearest")
    exports = {
        "field": (field, "--stablehlo", "--checkpoint", "latest"),
        "it": ("--simulator", *simulator),
    }
    for name, words in exports.items():
        to = tmp_path / f"{name}.stablehlo"
        code, out, err = run_words("export", *words, "--to", to)
        assert (code, out) == (0, f"{to}\n{to}.json\n"), err
    assert len(files(tmp_path)) == 4
    function = [json.loads((tmp_path / f"{name}.stablehlo.json").read_text())["function"] for name in exports]
    assert function == ["field, run", "simulator, contact model nearest"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--to", "it.safetensors"), "MODEL: left out; needed: the folder of a training run, or --stablehlo or --onnx"),
        (("--stablehlo", "--to", "it.onnx"), "--to it.onnx: must be a .stablehlo file"),
        (("--onnx", "--to", "it.stablehlo"), "--to it.stablehlo: must be a .onnx file"),
        (("--simulator", "--to", "it.json"), "--to it.json: must be a .stablehlo file"),
        (("run", "--simulator", "--to", "it.stablehlo"), "MODEL = 'run': must be left out with --simulator"),
        (
            ("--onnx", "--robot", "leo_rover", "--to", "it.onnx"),
            "--robot = 'leo_rover': must be left out where --simulator is not given",
        ),
        (
            ("--onnx", "--checkpoint", "best", "--to", "it.onnx"),
            "--checkpoint = 'best': must be left out where MODEL is",
        ),
        (("--onnx", "--no-turn", "--to", "it.onnx"), "--no-turn = 'given': must be left out where --simulator is not"),
        (("--stablehlo", "--to", "no/such/it.stablehlo"), "no/such/it.stablehlo: cannot be written: No such file or"),
    ],
)
def test_what_does_not_fit_together_ends_with_one_line(words, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert refusal(*words).startswith(said) and not files(tmp_path)


def test_one_format_is_written_at_a_time(tmp_path):
    assert "not allowed with argument --onnx" in refusal("--onnx", "--simulator", "--to", tmp_path / "it.onnx")
