"""`travjax evaluate`: tables, JSON and figures of a run, and the one line for each bad input."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.commandline import FEW, FEW_TOML, Run, files, printed_files, run, run_words, succeeds
from tests.small_training import GRID, GRID_WORDS, HUSKY, begun, copy, dataset, forward, loads, run_of
from travjax.data.dataset import save
from travjax.data.sampling import every_sample
from travjax.evaluation import metrics
from travjax.models.input_images import render_inputs
from travjax.models.variables import split_model
from travjax.runs.checkpoint import load_meta
from travjax.runs.run import load_estimator
from travjax.traversal.traverse import unpacked

pytestmark = pytest.mark.usefixtures("shared_code")

FIGURES = {"precision_recall.png", "reliability.png", "predictions.png"}
BASELINES = ["heads on the frozen trunk", "regression on slope and step"]


@pytest.fixture(scope="module")
def done(trained, tmp_path_factory) -> Run:
    """All samples of the test maps, with everything that is drawn."""
    words = ("evaluate", trained, "--data", trained.parent / "set", "--maps", 0, "--each", 0, "--checkpoint", "latest")
    return succeeds(tmp_path_factory.mktemp("evaluated"), *words, "--recall", 0.5)


@pytest.fixture(scope="module")
def truth(trained) -> metrics.Evaluation:
    """The figures of a direct forward pass on images of all samples."""
    samples = every_sample(dataset().labels, dataset().maps_of("test"))
    images = render_inputs(dataset().heights, *samples, HUSKY, FEW, grid=GRID, elevation_scale=0.5)
    logits = np.asarray(forward(*split_model(load_estimator(trained, "latest")[1]), images))
    failed = np.asarray(unpacked(dataset().labels[samples])[0])
    return metrics.evaluate(1 / (1 + np.exp(-logits)), failed, dataset().group[samples[0]], recalls=[0.5])


def evaluated(folder: Path, trained: Path, *words) -> Run:
    """Without what takes time."""
    quick = ("--figure-maps", 0, "--no-baselines")
    return succeeds(folder, "evaluate", trained, "--data", trained.parent / "set", *quick, *words)


@pytest.fixture(scope="module")
def usual(trained, tmp_path_factory) -> Run:
    """The sample and the checkpoint that are the preset's."""
    return evaluated(tmp_path_factory.mktemp("usual"), trained)


def results(done: Run) -> dict:
    return loads((done.folder / "evaluation.json").read_text())


def refusal(*words) -> str:
    code, _, err = run_words("evaluate", *words)
    line = err.replace("\r", "\n").strip().splitlines()[-1]
    assert code == 2 and line.startswith("travjax: ") and err.count("travjax: ") == 1
    return line.removeprefix("travjax: ")


# ---- What it says


def test_everything_that_is_written_is_printed(done):
    assert {path.name for path in files(done.folder)} == {"tables.txt", "evaluation.json", *FIGURES}
    assert printed_files(done) == files(done.folder)


def test_the_figures_of_the_network_are_those_of_a_forward_pass(done, truth):
    found = results(done)["network"]
    assert found["samples"] == truth.samples == 6 * len(FEW)
    for name, scores in truth.scores.items():
        confusion = found["scores"][name]["confusion"]
        assert [confusion[key] for key in ("tn", "fp", "fn", "tp")] == [
            getattr(scores.confusion, key) for key in ("tn", "fp", "fn", "tp")
        ]
        assert found["scores"][name]["average_precision"] == pytest.approx(scores.average_precision, rel=1e-3)
        assert 0.5 in [point["wanted"] for point in found["points"][name]]
    assert set(found["groups"]) == set(truth.groups)


def test_the_sample_is_described(done, trained):
    sample = results(done)["sample"]
    wanted = {"checkpoint": "latest", "samples": 108, "maps": 6, "test_maps": 6, "trajectories": 18}
    assert sample == sample | wanted
    assert (sample["phase"], sample["steps"]) == (2, 28)
    assert sample["robot"] == HUSKY.name
    assert "108 samples of 6 of 6 test maps, Husky A200; checkpoint latest: phase 2, step 28\n" in done.out


def test_the_tables_are_printed_and_written(done):
    text = (done.folder / "tables.txt").read_text()
    assert text in done.out
    for word in ("step", "obstacle", "tilt", "overall", *BASELINES, "0.5"):
        assert word in text
    for style in set(dataset().group[dataset().maps_of("test")]):
        assert style in text


def test_the_baselines_stand_beside_the_network(done, truth):
    found = results(done)
    assert list(found) == ["sample", "network", *BASELINES]
    for name in BASELINES:
        assert found[name]["samples"] == 108
        assert found[name]["average_precision"] != found["network"]["average_precision"]
        value = found[name]["average_precision"]["step"]
        assert re.search(rf"^{name} .*{value:.3f}", done.out, re.MULTILINE)


def test_the_heads_of_the_first_phase_are_the_checkpoint_of_that_name(done, trained, tmp_path):
    heads = evaluated(tmp_path, trained, "--maps", 0, "--each", 0, "--checkpoint", "heads")
    assert results(heads)["network"]["average_precision"] == results(done)[BASELINES[0]]["average_precision"]
    assert results(heads)["sample"]["phase"] == 1


def test_the_figures_open(done):
    for name in FIGURES:
        with Image.open(done.folder / name) as image:
            assert min(image.size) > 300
            image.load()


def test_nothing_that_is_no_number_is_in_the_json(trained, tmp_path):
    """Two samples have no failure of some event, so that its recall is no number."""
    found = results(evaluated(tmp_path, trained, "--maps", 1, "--each", 2))
    values = [found["network"]["scores"][name]["average_precision"] for name in ("step", "obstacle", "tilt")]
    assert None in values


# ---- What is evaluated


def test_the_sample_is_the_preset_s_unless_told_otherwise(usual, trained, tmp_path):
    found = results(usual)["sample"]
    assert (found["samples"], found["maps"], found["checkpoint"]) == (24, 4, "best")
    found = results(evaluated(tmp_path, trained, "--each", 3))["sample"]
    assert (found["samples"], found["maps"]) == (12, 4)
    found = results(evaluated(tmp_path, trained, "--maps", 2))["sample"]
    assert (found["samples"], found["maps"]) == (12, 2)


def test_the_same_again_is_the_same(usual, trained, tmp_path):
    assert results(evaluated(tmp_path, trained)) == results(usual)


def test_the_best_checkpoint_is_that_of_the_run(usual, trained):
    wanted = load_meta(trained / "checkpoints", "best")["position"]
    sample = results(usual)["sample"]
    assert (sample["phase"], sample["steps"]) == (wanted["phase"], wanted["total"])


def test_a_run_s_own_data_set_and_folder_need_not_be_named(trained, tmp_path):
    folder = copy(trained, tmp_path / "run")
    save(dataset(), folder / "data")
    code, out, err = run_words("evaluate", folder, "--figure-maps", 0, "--no-baselines")
    assert code == 0, err
    assert {path.name for path in files(folder / "evaluation")} == {"tables.txt", "evaluation.json"} | (
        FIGURES - {"predictions.png"}
    )
    assert str(folder / "evaluation/tables.txt") in out


def test_a_run_without_a_first_phase_has_one_baseline(tmp_path):
    begun(tmp_path / "run", head_epochs=0, epochs=1).train()
    run_of(head_epochs=0, epochs=1).save(tmp_path / "run")
    save(dataset(), tmp_path / "run/data")
    done = succeeds(tmp_path / "out", "evaluate", tmp_path / "run", "--figure-maps", 0)
    assert list(results(done)) == ["sample", "network", BASELINES[1]]


def test_more_maps_can_be_drawn_than_there_are(trained, tmp_path):
    split = dataset().split.copy()
    split[dataset().maps_of("test")[1:]] = split.min()
    save(replace(dataset(), split=split), tmp_path / "set")
    words = ("--data", tmp_path / "set", "--no-baselines", "--figure-maps", 2)
    done = succeeds(tmp_path / "out", "evaluate", trained, *words)
    assert (done.folder / "predictions.png").stat().st_size > 1000


# ---- Bad input


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--maps", -1), "--maps = -1: must be at least 0"),
        (("--each", -1), "--each = -1: must be at least 0"),
        (("--figure-maps", -1), "--figure-maps = -1: must be at least 0"),
        (("--recall", 0), "--recall = 0.0: must be above 0 and at most 1"),
        (("--recall", 0.5, 1.5), "--recall = 1.5: must be above 0 and at most 1"),
        (("--recall", "nan"), "--recall = nan: must be above 0 and at most 1"),
    ],
)
def test_wrong_options_are_one_line(trained, tmp_path, words, message):
    assert refusal(trained, "--out", tmp_path / "out", *words) == message
    assert files(tmp_path) == set()


def test_what_is_no_run_is_one_line(tmp_path):
    assert refusal(tmp_path).startswith(f"{tmp_path / 'run.json'}: cannot be read: No such file or directory")


def test_a_checkpoint_that_is_not_there_is_one_line(trained, tmp_path):
    said = refusal(trained, "--checkpoint", "tails", "--data", trained.parent / "set", "--out", tmp_path / "out")
    assert "holds no checkpoint 'tails'; it holds: " in said


def test_a_run_without_its_data_set_is_one_line(trained, tmp_path):
    said = refusal(trained, "--out", tmp_path / "out")
    assert said.startswith("data set = ") and str(trained / "data")[:20] in said
    assert files(tmp_path) == set()


def test_a_data_set_of_another_action_space_is_one_line(trained, tmp_path, few):
    other = tmp_path / "other.toml"
    other.write_text(FEW_TOML.replace("turns = 2", "turns = 3"))
    done = run(tmp_path / "set", "dataset", "--maps", 3, *GRID_WORDS, "--robot", "husky_a200", "--actions", other)
    assert done.code == 0, done.err
    said = refusal(trained, "--data", tmp_path / "set", "--out", tmp_path / "out")
    assert said == "actions of the data set: turns = 3; must be as here: turns = 2"


def test_a_data_set_without_test_maps_is_one_line(trained, tmp_path):
    split = np.minimum(dataset().split, 1)
    save(replace(dataset(), split=split), tmp_path / "set")
    assert "test" in refusal(trained, "--data", tmp_path / "set", "--out", tmp_path / "out")


def test_a_damaged_checkpoint_is_passed_over_with_a_notice(trained, tmp_path):
    folder = copy(trained, tmp_path / "run")
    last = max(path for path in (folder / "checkpoints").iterdir() if "-step-" in path.name)
    (last / "meta.json").unlink()
    words = ("--data", trained.parent / "set", "--checkpoint", "latest", "--figure-maps", 0, "--no-baselines")
    done = succeeds(tmp_path / "out", "evaluate", folder, *words)
    assert f"{last}: damaged checkpoint passed over: meta.json is missing" in done.out
    assert results(done)["sample"]["steps"] == 27
    assert "checkpoint latest: phase 2, step 27\n" in done.out
