"""`python -m travjax.experiments.comparison`: its results against direct computation, and what it writes."""

import contextlib
import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.field_runs import RUN, estimator
from tests.small_training import GRID, HUSKY, SETUP
from travjax.data.dataset import DatasetConfig
from travjax.data.provenance import SitesConfig
from travjax.data.sensor_noise import CORRUPTIONS, FILTERS
from travjax.estimators.names import ESTIMATORS
from travjax.estimators.preset import Preset
from travjax.evaluation.metrics import OVERALL, Confusion
from travjax.experiments import comparison
from travjax.experiments.robustness import BenchmarkMaps, of_sites
from travjax.experiments.robustness_scores import (
    FILTERED,
    HAZARD,
    MARGINS,
    SIMULATOR,
    best_filters,
    compare,
    quality_figure,
    robustness_figure,
    sites_figure,
    sites_table,
)
from travjax.files import PRESETS
from travjax.runs.model_file import write_model
from travjax.runs.predictor import Predictor

pytestmark = pytest.mark.usefixtures("shared_code")


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
def sites(tmp_path_factory) -> Path:
    """Two sites, ridge of two windows and plain of one, as a TOML file."""
    folder = tmp_path_factory.mktemp("sites")
    heights = BenchmarkMaps.synthetic(10, 5, SETUP).heights
    ridge = np.concatenate([heights[8], heights[9][:, 1:]], axis=1)
    ridge[3:5, 40:50] = np.nan
    tables = ["stride = 4.0", "fill_holes = false"]
    for name, one in (("ridge", ridge), ("plain", heights[4])):
        np.savez(folder / f"{name}.npz", heights=one, cell_size=GRID.spacing)
        tables += ["[[site]]", f"file = '{folder / name}.npz'"]
    (folder / "sites.toml").write_text("\n".join(tables))
    return folder / "sites.toml"


@pytest.fixture(scope="module")
def done(model, trained, sites, tmp_path_factory):
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
        "--sites",
        sites,
    )
    code, out, err = run(*words, "--out", folder)
    assert code == 0, err
    return folder, out


def test_everything_that_is_written_is_printed(done):
    folder, out = done
    names = {"report.md", "results.json", "f1.tsv", "robustness.png", "quality.png", "sites.txt", "sites.png"}
    assert {path.name for path in folder.iterdir()} == names
    assert {line for line in out.splitlines() if line.startswith(str(folder))} == {str(folder / name) for name in names}
    for name in ("robustness.png", "quality.png", "sites.png"):
        with Image.open(folder / name) as image:
            assert image.size[0] > 800


def test_the_figures_are_those_of_the_methods(done):
    maps = json.loads((done[0] / "results.json").read_text())["maps"]
    assert list(maps) == list(CORRUPTIONS)
    test = BenchmarkMaps.synthetic(6, comparison.SEED, SETUP)
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


def test_the_filter_is_the_best_on_validation_maps(done):
    maps = json.loads((done[0] / "results.json").read_text())["maps"]
    validation = BenchmarkMaps.synthetic(5, comparison.SEED + 1, SETUP)
    for name in CORRUPTIONS:
        seen = validation.seen(name, comparison.SEED + 1)
        f1 = {key: validation.scores(validation.simulated(of(seen)))[OVERALL].f1 for key, of in FILTERS.items()}
        assert f1[maps[name]["filter"]] == max(f1.values())


def test_the_report_says_what_the_scores_are_of(done):
    report = (done[0] / "report.md").read_text()
    maps = "6 test maps and 5 validation maps that no preset trains on"
    assert f"{maps}, 18 trajectories each, seed {comparison.SEED};" in report
    assert "The ResNet50's scores are of 20 random trajectories, the others' of all." in report


def test_maps_are_those_of_no_preset():
    presets = [Preset.load(path) for model in ESTIMATORS for path in (PRESETS / model).glob("*.toml")]
    sets = [DatasetConfig(200, comparison.SEED), DatasetConfig(50, comparison.SEED + 1)]
    ours, others = (
        [set(zip(config.styles().tolist(), config.seeds().tolist(), strict=True)) for config in configs]
        for configs in (sets, [preset.dataset for preset in presets])
    )
    assert len(presets) >= 6 and not ours[0] & ours[1]
    assert not any(one & other for one in ours for other in others)


def test_another_seed_gives_other_maps_and_the_same_one_the_same_results():
    network = Predictor(RUN, estimator())
    found = []
    for seed in (1, 1, 2):
        test, validation = (BenchmarkMaps.synthetic(5, seed + number, SETUP) for number in (0, 1))
        found.append(compare(test, validation, network, None, 5, best_filters(validation, seed), seed))
    assert found[0] == found[1] != found[2]


def test_the_quality_figure_draws_the_simulator_after_its_filter():
    noise = "noise 5 cm"
    f1 = {SIMULATOR: {"none": 1.0, noise: 0.2}, FILTERED: {"none": 1.0, noise: 0.8}}
    f1[HAZARD] = {"none": 0.9, noise: 0.85}
    seconds = {"sequential simulator": 3.0, "network, float32, batches of 64": 30.0, "hazard field, 1 map": 0.05}
    points = comparison._points(f1, seconds)
    assert points == {"sequential simulator": (3.0, 1.0, 0.8), "hazard field, 1 map": (0.05, 0.9, 0.85)}
    (ax,) = quality_figure(points).axes
    assert ax.get_xscale() == "log"
    drawn = {(*line.get_xdata(), *line.get_ydata()) for line in ax.lines if line.get_marker() in "ov"}
    assert {(3.0, 1.0), (3.0, 0.8), (0.05, 0.9), (0.05, 0.85)} <= drawn


def test_the_robustness_figure_draws_every_f1():
    f1 = {method: {name: (1 + n) / 10 + m / 100 for n, name in enumerate(CORRUPTIONS)} for m, method in enumerate("ab")}
    left, right = robustness_figure(f1).axes
    assert list(left.lines[1].get_xdata()) == [0, 1, 2, 5]
    assert list(left.lines[1].get_ydata()) == [f1["b"][name] for name in list(CORRUPTIONS)[:4]]
    heights = [bar.get_height() for bar in right.patches]
    assert heights == [of[name] for of in f1.values() for name in ("none", "5% missing", "20% missing", "0.125 m")]


def test_the_times_are_of_every_way(done):
    times = json.loads((done[0] / "results.json").read_text())["times"]
    starts = ["sequential", "batched", "batched", "network", "hazard field, 1 map", "hazard field, 8 maps"]
    assert all(row["what"].startswith(start) for row, start in zip(times, starts, strict=True))
    assert all(row["seconds"] > 0 for row in times)
    assert times[-1]["speed_up"] == pytest.approx(times[0]["seconds"] / times[-1]["seconds"])


# ---- Real ground


def test_the_figures_of_a_site_are_those_of_its_windows(done, sites):
    results = json.loads((done[0] / "results.json").read_text())
    assert results["windows"] == {"ridge": 2, "plain": 1}
    real = of_sites(SitesConfig.load(sites), 100, comparison.SEED, SETUP)
    for site, ground in real.items():
        known = ground.known
        assert known.all() == (site == "plain")
        for name in ("none", "noise 2 cm", "0.125 m"):
            seen = ground.seen(name, comparison.SEED)
            fails = {key: ground.simulated(of(seen))[known] for key, of in FILTERS.items()}
            predicted = Predictor(RUN, estimator()).predict(seen)
            fails["hazard field"] = predicted.probability[known]
            fails["hazard field, margins"] = predicted.margins[known] / np.array(HUSKY.limits) / 2
            assert list(results["real"][site][name]) == list(fails)
            for method, of in fails.items():
                counts = results["real"][site][name][method]["overall"]
                assert counts["tp"] == int(((of >= 0.5) & ground.failed[known]).sum())
                assert counts["fp"] == int(((of >= 0.5) & ~ground.failed[known]).sum())
                assert counts["tn"] + counts["fp"] + counts["fn"] + counts["tp"] == 3 * known.sum()


def test_the_table_has_a_row_a_site_and_the_filter_that_was_chosen(done):
    results = json.loads((done[0] / "results.json").read_text())
    headline, *lines = (done[0] / "sites.txt").read_text().splitlines()
    assert headline.startswith("Husky A200, windows of 4 x 4 m, ")
    rows = [line.split() for line in lines if "ridge" in line or "plain" in line]
    assert len(rows) == 2 * len(CORRUPTIONS)
    for number, name in enumerate(CORRUPTIONS):
        for site, row in zip(("ridge", "plain"), rows[2 * number : 2 * number + 2], strict=True):
            scores = results["real"][site][name]
            f1 = [scores[method]["overall"]["f1"] for method in scores]
            f1.append(scores[results["filters"][name]]["overall"]["f1"])
            assert row[-len(f1) :] == [f"{value:.3f}" for value in f1]
    chosen = results["filters"]
    assert lines[-2] == "Best filter: " + "; ".join(f"{name}: {chosen[name]}" for name in CORRUPTIONS) + "."
    assert chosen == {name: one["filter"] for name, one in results["maps"].items()}


def test_the_table_says_on_how_many_sites_the_field_is_ahead():
    counts = {"ahead": (5, 2), "behind": (5, 8), "as good": (5, 5), "nothing fails": (0, 2)}
    other = {OVERALL: Confusion(1, 5, 0, 5)}
    sites = {}
    for site, (tp, fp) in counts.items():
        methods = dict.fromkeys((*FILTERS, MARGINS), other) | {HAZARD: {OVERALL: Confusion(1, fp, 0, tp)}}
        sites[site] = dict.fromkeys(CORRUPTIONS, methods)
    last = sites_table(sites, dict.fromkeys(CORRUPTIONS, "no filter")).splitlines()[-1]
    assert last.endswith(": " + "; ".join(f"{name}: 1 of 3" for name in CORRUPTIONS) + ".")


def test_the_report_says_what_the_real_ground_is(done):
    report = (done[0] / "report.md").read_text()
    assert "windows of 4 x 4 m, at most 10% of each unknown: 2 of ridge, 1 of plain; 18 trajectories each." in report
    assert report.count(comparison.MEANING) == report.count(comparison.MEANING_REAL) == 1
    assert report.index("(robustness.png)") < report.index("## Real ground") < report.index("(sites.png)")


def test_real_ground_alone_takes_no_times(model, sites, done, tmp_path):
    words = ("--ground", "real", "--field", model, "--sites", sites, "--validation-maps", 5, "--windows", 1)
    code, out, err = run(*words, "--out", tmp_path)
    assert code == 0, err
    assert {path.name for path in tmp_path.iterdir()} == {"report.md", "results.json", "sites.txt", "sites.png"}
    found, whole = (json.loads((folder / "results.json").read_text()) for folder in (tmp_path, done[0]))
    assert found["windows"] == {"ridge": 1, "plain": 1} and "times" not in found
    assert found["filters"] == whole["filters"] and found["real"]["plain"] == whole["real"]["plain"]


def test_without_the_sites_at_hand_synthetic_ground_is_left_and_a_line_says_why(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("TRAVJAX_DATA", raising=False)
    monkeypatch.chdir(tmp_path)
    assert comparison._sites(None, "both") is None
    said = capsys.readouterr().out
    assert said.startswith("Synthetic ground alone: site quarry: file terrain/quarry.tif: no such file here")
    assert said.count("\n") == 1
    assert comparison._sites(None, "synthetic") is None and not capsys.readouterr().out


def test_the_figure_of_sites_draws_every_f1():
    f1 = {
        site: {
            method: {name: (1 + n) / 10 + m / 100 + s / 1000 for n, name in enumerate(CORRUPTIONS)}
            for m, method in enumerate("abc")
        }
        for s, site in enumerate(("hill", "dale"))
    }
    axes = np.reshape(sites_figure(f1, {"b": "the second", "c": "the third"}).axes, (2, 2))
    for site, (upper, lower) in zip(f1, axes.T, strict=True):
        assert upper.get_title() == site
        assert [line.get_label() for line in upper.lines] == ["the second", "the third"]
        for method, line, marks in zip("bc", upper.lines, lower.lines, strict=True):
            assert list(line.get_xdata()) == [0, 1, 2, 5]
            assert list(line.get_ydata()) == [f1[site][method][name] for name in list(CORRUPTIONS)[:4]]
            others = ("none", "5% missing", "20% missing", "0.125 m")
            assert list(marks.get_ydata()) == [f1[site][method][name] for name in others]
        styles = {(line.get_color(), line.get_marker(), line.get_linestyle()) for line in upper.lines}
        assert len({colour for colour, _, _ in styles}) == len({mark for _, mark, _ in styles}) == 2


# ---- Bad input


def test_an_estimator_of_another_model_is_refused(trained, model, tmp_path):
    for words, message in (
        (("--field", trained), "--field = "),
        (("--field", model, "--resnet", model), "--resnet = "),
        (("--field", model, "--maps", 0), "--maps = 0: must be at least 1"),
        (("--field", model, "--seed", -1), "--seed = -1: must be a whole number from 0"),
        (("--field", tmp_path / "none.safetensors"), f"{tmp_path}/none.safetensors: "),
        (("--field", model, "--windows", 0), "--windows = 0: must be at least 1"),
        (("--ground", "real", "--resnet", trained), f"--resnet = '{trained}': must be left out on real ground"),
        (("--ground", "synthetic", "--sites", trained), f"--sites = '{trained}': must be left out on synthetic"),
        (("--ground", "real", "--sites", tmp_path / "none.toml"), f"{tmp_path}/none.toml: cannot be read: "),
    ):
        code, _, err = run(*words, "--out", tmp_path / "out")
        assert code == 2 and err.startswith(f"travjax: {message}") and err.count("\n") == 1
    assert not (tmp_path / "out").exists()
