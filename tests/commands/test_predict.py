"""`travjax predict`: what is written and printed for synthetic and real maps, and the one line for each bad input."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.commandline import FEW, Run, files, printed_files, run_words, succeeds
from tests.field_runs import RUN, estimator
from tests.small_training import GRID, HUSKY, run_of
from tests.small_training import estimator as resnet
from travjax.config import from_json
from travjax.evaluation import metrics, tables
from travjax.runs.model_file import write_model
from travjax.runs.predictor import Predictor
from travjax.simulation.robot import Robot
from travjax.terrain.styles import STYLES, generate_terrain
from travjax.traversal.traverse import failures, simulate

SEED = 40
COUNT = 10


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    """A tiny hazard field with random parameters."""
    path = tmp_path_factory.mktemp("model") / "tiny.safetensors"
    write_model(path, RUN, estimator(), {})
    return path


@pytest.fixture(scope="module")
def done(file, tmp_path_factory) -> Run:
    """Synthetic maps, checked and drawn."""
    words = ("predict", "--checkpoint", file, "--count", COUNT, "--seed", SEED, "--check")
    return succeeds(tmp_path_factory.mktemp("predicted") / "out", *words)


@pytest.fixture(scope="module")
def heights() -> np.ndarray:
    """The maps that `done` is about."""
    styles = [STYLES[index % len(STYLES)] for index in range(COUNT)]
    return np.asarray(generate_terrain(styles, range(SEED, SEED + COUNT), grid=GRID))


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A bumpy DEM of 8 x 4 m, high up and with a hole."""
    z = 2000 + np.random.default_rng(0).normal(0, 0.06, (33, 65)).cumsum(axis=1)
    z[24:26, 18:20] = np.nan
    path = tmp_path_factory.mktemp("site") / "site.npy"
    np.save(path, z)
    return path


def predicted(folder: Path, file: Path, *words) -> Run:
    return succeeds(folder, "predict", *words, "--checkpoint", file, "--no-figures")


def refusal(folder: Path, *words) -> str:
    """The one line, after which nothing is written."""
    code, _, err = run_words("predict", *words, "--out", folder / "out")
    line = err.replace("\r", "\n").strip().splitlines()[-1]
    assert code == 2 and line.startswith("travjax: ") and err.count("travjax: ") == 1
    assert not (folder / "out").exists()
    return line.removeprefix("travjax: ")


# ---- What is written and printed


def test_everything_that_is_written_is_printed(done):
    assert {path.name for path in files(done.folder)} == {"predictions.npz", "shares.txt", "predictions.png"}
    assert printed_files(done) == files(done.folder)


def test_probabilities_and_margins_are_those_of_the_estimator(done, heights):
    arrays, wanted = done.arrays("predictions.npz"), Predictor(RUN, estimator()).predict(heights)
    assert arrays["probability"].shape == (COUNT, len(FEW), 3)
    np.testing.assert_allclose(arrays["probability"], wanted.probability, atol=1e-5)
    for number, event in enumerate(("step", "obstacle", "tilt")):
        np.testing.assert_allclose(arrays[f"margin_{event}"], wanted.margins[..., number], atol=1e-5)


def test_the_maps_are_told_apart_and_the_configuration_is_kept(done):
    arrays = done.arrays("predictions.npz")
    assert arrays["group"].tolist() == [STYLES[index % len(STYLES)] for index in range(COUNT)]
    assert arrays["seed"].tolist() == list(range(SEED, SEED + COUNT))
    assert arrays["known"].all() and arrays["known"].shape == (COUNT, len(FEW))
    assert arrays["cell_size"] == GRID.spacing
    config = json.loads(str(arrays["config"]))
    assert from_json(config["robot"], Robot) == HUSKY and config["model"] == "field" and config["files"] == []


def test_shares_are_those_above_one_half(done):
    arrays, text = done.arrays("predictions.npz"), (done.folder / "shares.txt").read_text()
    assert text in done.out
    table = tables.shares_table(arrays["group"], arrays["probability"] >= 0.5, arrays["known"], as_in_paper=False)
    assert text.startswith(f"Predicted to fail, Husky A200, 18 trajectories a map, field:\n{table}\n")
    assert "paper" not in text


def test_the_simulator_stands_beside_the_predictions(done, heights):
    margins = simulate(heights, HUSKY, FEW, grid=GRID)
    failed, arrays = np.asarray(failures(margins, HUSKY)), done.arrays("predictions.npz")
    np.testing.assert_array_equal(arrays["failed"], failed)
    assert 0 < failed.mean() < 0.5
    scores = metrics.evaluate(arrays["probability"].reshape(-1, 3), failed.reshape(-1, 3))
    text = (done.folder / "shares.txt").read_text()
    assert text.endswith(
        f"\n\nAgainst the simulator on the map as given, its noise included:\n{tables.metrics_table(scores, None)}\n"
    )
    counts = [getattr(scores.scores["step"].confusion, name) for name in ("tn", "fp", "fn", "tp")]
    row = next(line for line in text.splitlines()[-8:] if line.startswith("step "))
    assert [int(word) for word in row.split()[-4:]] == counts


def test_the_figure_opens(done):
    with Image.open(done.folder / "predictions.png") as image:
        assert min(image.size) > 300
        image.load()


def test_without_the_check_and_figures_there_are_neither(file, tmp_path):
    plain = predicted(tmp_path / "out", file, "--count", 4)
    assert {path.name for path in files(plain.folder)} == {"predictions.npz", "shares.txt"}
    assert "failed" not in plain.arrays("predictions.npz") and "simulator:\n" not in plain.out


def test_styles_can_be_chosen(file, tmp_path):
    some = predicted(tmp_path / "out", file, "--count", 5, "--style", "wavy", "rough").arrays("predictions.npz")
    assert some["group"].tolist() == ["wavy", "rough", "wavy", "rough", "wavy"]


def test_the_same_again_is_the_same(file, tmp_path):
    words = ("--count", 4, "--seed", 7)
    one, other = (predicted(tmp_path / name, file, *words).arrays("predictions.npz") for name in ("one", "other"))
    assert one.keys() == other.keys()
    for name, array in one.items():
        np.testing.assert_array_equal(array, other[name])


# ---- Real maps


def test_a_dem_is_read_as_label_reads_it(file, site, tmp_path):
    words = (site, "--cell-size", GRID.spacing, "--stride", 4, "--keep-holes")
    found = predicted(tmp_path / "out", file, *words, "--check")
    arrays = found.arrays("predictions.npz")
    assert arrays["probability"].shape == (2, len(FEW), 3) and arrays["group"].tolist() == ["site.npy"] * 2
    assert np.isfinite(arrays["probability"]).all() and np.ptp(arrays["origin"][:, 0]) == 4
    z = np.load(site)
    windows = np.stack([z[:, :33], z[:, 32:]])
    order = np.argsort(arrays["origin"][:, 0])
    wanted = Predictor(RUN, estimator()).predict(windows)
    np.testing.assert_allclose(arrays["probability"][order], wanted.probability, atol=1e-3)
    known = np.asarray(simulate(windows, HUSKY, FEW, grid=GRID).known)
    np.testing.assert_array_equal(arrays["known"][order], known)
    assert 0 < known[0].mean() < 1 and known[1].all()
    samples = int(known.sum())
    row = next(line for line in found.out.splitlines() if line.startswith("tilt "))
    assert sum(int(word.replace(",", "")) for word in row.split()[-4:]) == samples


# ---- Which estimator


def test_a_resnet_has_no_margins(tmp_path):
    path = tmp_path / "resnet.safetensors"
    write_model(path, run_of(), resnet(), {})
    found = predicted(tmp_path / "out", path, "--count", 2, "--model", "resnet50", "--robot", "husky_a200")
    arrays = found.arrays("predictions.npz")
    assert arrays["probability"].shape == (2, len(FEW), 3)
    assert not any(name.startswith("margin") for name in arrays)
    assert "18 trajectories a map, resnet50:\n" in found.out


def test_a_training_run_is_taken_too(trained, tmp_path):
    found = predicted(tmp_path / "out", trained, "--count", 1)
    assert found.arrays("predictions.npz")["probability"].shape == (1, len(FEW), 3)


def test_the_packaged_estimator_is_the_default(tmp_path):
    found = succeeds(tmp_path / "out", "predict", "--count", 1, "--style", "rough", "--no-figures", "--check")
    arrays = found.arrays("predictions.npz")
    assert arrays["probability"].shape == (1, 3042, 3)
    assert ((arrays["probability"] > 0.5) == arrays["failed"]).mean() > 0.95
    assert "Predicted to fail, Seekur Jr, 3042 trajectories a map, field:\n" in found.out


# ---- Bad input


def test_another_robot_is_one_line_that_names_both(file, tmp_path):
    said = refusal(tmp_path, "--checkpoint", file, "--robot", "seekur_jr")
    assert said == "robot = 'Seekur Jr': must be Husky A200, which the estimator was trained for"


def test_another_model_is_one_line(file, tmp_path):
    said = refusal(tmp_path, "--checkpoint", file, "--model", "resnet50")
    assert said == "--model = 'resnet50': must be field, which the estimator is"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--count", 0), "--count = 0: must be at least 1"),
        (("--seed", -1), "--seed = -1: must be from 0 to 2147483647"),
        (("--stride", 4), "--stride = 4.0: must be left out where no DEM file is given"),
        (("--robot", "nobody"), "robot"),
    ],
)
def test_wrong_options_are_one_line(file, tmp_path, words, said):
    assert refusal(tmp_path, "--checkpoint", file, *words).startswith(said)


def test_a_missing_or_damaged_estimator_is_one_line(file, tmp_path):
    missing, damaged = tmp_path / "none.safetensors", tmp_path / "damaged.safetensors"
    damaged.write_bytes(file.read_bytes()[:-9])
    assert refusal(tmp_path, "--checkpoint", missing) == f"{missing}: no such file"
    assert refusal(tmp_path, "--checkpoint", damaged).startswith(f"{damaged}: cannot be read as .safetensors, damaged")
    assert refusal(tmp_path, "--checkpoint", tmp_path / "folder").startswith(f"{tmp_path / 'folder'}: no estimator;")


def test_a_dem_that_is_not_there_is_one_line(file, tmp_path):
    missing = tmp_path / "none.npy"
    assert str(missing) in refusal(tmp_path, missing, "--checkpoint", file, "--cell-size", 0.125)
    assert "--count" in refusal(tmp_path, missing, "--checkpoint", file, "--count", 3)
