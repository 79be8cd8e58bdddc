"""How experiments start and write their reports."""

import pytest

from travjax.config import InputError
from travjax.experiments import launch

# ---- Starting


def started(*words) -> tuple[int, list]:
    """Exit code of an experiment with an option, and the options of its runs."""
    options, ran = launch.parser("trial", "Tries."), []
    options.add_argument("--count", type=int, default=3)
    return launch.launch(options, lambda arguments: ran.append(arguments.count), words), ran


def test_an_experiment_runs_with_its_options():
    assert started() == (0, [3])
    assert started("--count", "5") == (0, [5])


def test_compiled_code_is_kept_from_before_the_run(monkeypatch):
    options, order = launch.parser("trial", "Tries."), []
    monkeypatch.setattr(launch, "use_compilation_cache", lambda: order.append("cache"))
    assert launch.launch(options, lambda arguments: order.append("run"), []) == 0
    assert order == ["cache", "run"]


def test_bad_words_are_one_line_and_nothing_runs(capsys):
    assert started("--count", "many") == (2, [])
    said = capsys.readouterr().err
    assert said.startswith("travjax: argument --count: ") and said.count("\n") == 1
    assert "(see python -m travjax.experiments.trial --help)" in said


def test_bad_input_of_a_run_is_one_line(capsys):
    def run(arguments):
        raise InputError("count = 3: must be 4")

    assert launch.launch(launch.parser("trial", "Tries."), run, []) == 2
    assert capsys.readouterr().err == "travjax: count = 3: must be 4\n"


def test_help_names_the_module(capsys):
    with pytest.raises(SystemExit) as ended:
        started("--help")
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith("usage: python -m travjax.experiments.trial ")


# ---- Reports


def test_a_report_holds_its_pieces_in_order_with_figures_beside_it(tmp_path):
    figures = [tmp_path / "precision_recall.png", tmp_path / "maps/f1.png"]
    pieces = ["Some words.", figures[0], launch.verbatim("a  b\n1  2"), figures[1], launch.verbatim("{}", "json")]
    path = launch.write_report(tmp_path, "A title", pieces)
    assert path == tmp_path / "report.md"
    assert path.read_text() == (
        "# A title\n\nSome words.\n\n![Precision recall](precision_recall.png)\n\n```\na  b\n1  2\n```\n\n"
        "![F1](maps/f1.png)\n\n```json\n{}\n```\n"
    )
    assert {path.name for path in tmp_path.iterdir()} == {"report.md"}
