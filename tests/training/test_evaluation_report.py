"""Evaluation by a call; what the tables hold is in tests/commands/test_evaluate.py."""

import pytest

from tests.small_training import copy, loads
from travjax.config import InputError
from travjax.evaluation.metrics import OVERALL
from travjax.training.evaluation_report import evaluate_run

pytestmark = pytest.mark.usefixtures("shared_code")


def test_the_figures_that_are_returned_are_those_that_are_written(trained, tmp_path, capsys):
    folder = copy(trained, tmp_path / "run")
    scores = evaluate_run(str(folder), trained.parent / "set", "heads", maps=2, each=3, figure_maps=0, baselines=False)
    written = loads((folder / "evaluation_heads/evaluation.json").read_text())
    assert list(written) == ["sample", "network"]
    assert written["sample"]["samples"] == scores.samples == 6
    assert written["network"]["scores"][OVERALL]["confusion"]["tp"] == scores.scores[OVERALL].confusion.tp
    out = capsys.readouterr().out
    assert (folder / "evaluation_heads/tables.txt").read_text() in out
    assert out.endswith(f"{folder}/evaluation_heads/reliability.png\n")


def test_a_data_set_that_is_not_there_is_an_error_before_anything_is_written(trained, tmp_path):
    with pytest.raises(InputError, match="^data set = "):
        evaluate_run(trained, tmp_path / "none", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
