"""`python -m travjax.experiments.navigation`: it goes on where it was stopped, and reads only its own results."""

import json
from itertools import islice

import pytest

from travjax.experiments import navigation
from travjax.experiments.robustness import BenchmarkMaps
from travjax.navigation import trials
from travjax.navigation.methods import METHODS

TINY = """
maps = 1
size = 8.0
tasks = 1
least = 0.3
validation = 1
corruptions = ["none", "noise 5 cm"]
"""


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs the experiment in a folder with a filter that is already chosen; returns exit code, output and errors."""
    (tmp_path / "tiny.toml").write_text(TINY)
    filters = {"none": "no filter", "noise 5 cm": "Gaussian 1.25"}
    monkeypatch.setattr(BenchmarkMaps, "synthetic", staticmethod(lambda *_: None))
    monkeypatch.setattr(navigation, "best_filters", lambda *_: filters)

    def start():
        code = navigation.main([str(tmp_path / "tiny.toml"), "--out", str(tmp_path / "out")])
        return code, *capsys.readouterr()

    return start


def test_methods_have_their_trials_and_a_stopped_run_goes_on(run, tmp_path, monkeypatch):
    whole, stopped, every = navigation.trials_on, [], trials.planners
    monkeypatch.setattr(trials, "planners", lambda *given: islice(every(*given), 2))  # the others take long to compile

    def stopping(ground, tasks, corruption, *rest):
        if corruption == "noise 5 cm" and not stopped:
            stopped.append(corruption)
            raise KeyboardInterrupt
        return whole(ground, tasks, corruption, *rest)

    monkeypatch.setattr(navigation, "trials_on", stopping)
    code, _, err = run()
    assert code == 130 and "goes on" in err
    assert {row["corruption"] for row in json.loads((tmp_path / "out/trials.json").read_text())["trials"]} == {"none"}
    code, text, err = run()
    assert (code, err) == (0, "")
    rows = json.loads((tmp_path / "out/trials.json").read_text())["trials"]
    assert sorted((row["corruption"], row["method"]) for row in rows) == sorted(
        (corruption, method) for corruption in ("none", "noise 5 cm") for method in METHODS[:2]
    )
    for name in ("navigation.png", "trials.json", "report.md"):
        assert str(tmp_path / "out" / name) in text
    report = (tmp_path / "out/report.md").read_text()
    assert "geometric cost map" in report and "- noise 5 cm: Gaussian 1.25" in report


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda saved: saved["config"].update(tasks=2), "a folder without results of other settings"),
        (lambda saved: saved.update(trials=[{"kind": 1}]), "trials.json: trials:"),
        (lambda saved: saved["filters"].clear(), "trials.json: filters"),
        (lambda saved: saved.pop("trials"), "must be results of navigation"),
    ],
)
def test_other_results_are_refused(run, tmp_path, change, line):
    (tmp_path / "out").mkdir()
    config = navigation.NavigationConfig.load(tmp_path / "tiny.toml")
    settings = {"config": navigation.to_json(config), "field": navigation.Predictor.load().run.setup.to_json()}
    saved = settings | {"filters": dict.fromkeys(config.corruptions, "no filter"), "trials": []}
    change(saved)
    (tmp_path / "out/trials.json").write_text(json.dumps(saved))
    code, _, err = run()
    assert code == 2 and line in err and err.count("\n") == 1
