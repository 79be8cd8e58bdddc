"""`python -m travjax.experiments.comparison`: its results against direct computation, and what it writes."""

import contextlib
import io
import json

import numpy as np
import pytest
from commandline import FEW
from field_runs import RUN, estimator
from PIL import Image
from training import GRID, HUSKY

from travjax.experiments import comparison
from travjax.model_file import write_model
from travjax.predictor import Predictor
from travjax.robustness import CORRUPTIONS, Ground

pytestmark = pytest.mark.usefixtures("compilation_cache", "shared_code")


def run(*words) -> tuple[int, str, str]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        return comparison.main([*map(str, words)]), out.getvalue(), err.getvalue()


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "tiny.safetensors"
    write_model(path, RUN, estimator(), {})
    return path


@pytest.fixture(scope="module")
def done(model, trained, tmp_path_factory):
    folder = tmp_path_factory.mktemp("comparison") / "out"
    words = (
        "--field",
        model,
        "--resnet",
        trained,
        "--maps",
        6,
        "--validation-maps",
        5,
        "--samples",
        20,
        "--repeats",
        1,
    )
    code, out, err = run(*words, "--out", folder)
    assert code == 0, err
    return folder, out


def test_everything_that_is_written_is_printed(done):
    folder, out = done
    names = {"report.md", "results.json", "f1.tsv", "robustness.png", "quality.png"}
    assert {path.name for path in folder.iterdir()} == names
    assert {line for line in out.splitlines() if line.startswith(str(folder))} == {str(folder / name) for name in names}
    for name in ("robustness.png", "quality.png"):
        with Image.open(folder / name) as image:
            assert image.size[0] > 800


def test_the_figures_are_those_of_the_methods(done):
    maps = json.loads((done[0] / "results.json").read_text())["maps"]
    assert list(maps) == list(CORRUPTIONS)
    test = Ground.synthetic(6, comparison.SEED, HUSKY, FEW, GRID)
    for name in ("none", "noise 2 cm", "20% missing"):
        probability = Predictor(RUN, estimator()).predict(test.seen(name, comparison.SEED)).probability
        counts = maps[name]["methods"]["hazard field"]["confusion"]["overall"]
        assert counts["tp"] == int(((probability >= 0.5) & test.failed).sum())
        assert counts["fp"] == int(((probability >= 0.5) & ~test.failed).sum())
        simulated = maps[name]["methods"]["simulator"]["confusion"]["overall"]
        assert (simulated["fp"] + simulated["fn"] == 0) == (name == "none")
        network = maps[name]["methods"]["ResNet50"]["confusion"]["overall"]
        assert sum(network[key] for key in ("tn", "fp", "fn", "tp")) == 20 * 3
    errors = np.abs(
        np.minimum(Predictor(RUN, estimator()).predict(test.heights).margins, 4 * np.array(HUSKY.limits))
        - np.minimum(test.margins, 4 * np.array(HUSKY.limits))
    ).mean(axis=(0, 1))
    np.testing.assert_allclose(list(maps["none"]["margin_errors"].values()), errors, rtol=1e-4)


def test_the_times_are_of_every_way(done):
    times = json.loads((done[0] / "results.json").read_text())["times"]
    starts = ["sequential", "batched", "batched", "network", "hazard field, 1 map", "hazard field, 8 maps"]
    assert all(row["what"].startswith(start) for row, start in zip(times, starts, strict=True))
    assert all(row["seconds"] > 0 for row in times)
    assert times[-1]["speed_up"] == pytest.approx(times[0]["seconds"] / times[-1]["seconds"])


def test_an_estimator_of_another_model_is_refused(trained, model, tmp_path):
    for words, message in (
        (("--field", trained), "--field = "),
        (("--field", model, "--resnet", model), "--resnet = "),
        (("--field", model, "--maps", 0), "--maps = 0: must be at least 1"),
    ):
        code, _, err = run(*words, "--out", tmp_path / "out")
        assert code == 2 and err.startswith(f"travjax: {message}") and err.count("\n") == 1
    assert not (tmp_path / "out").exists()
