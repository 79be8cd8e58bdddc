"""Predictions for maps by a call; what is said of them is in tests/commands/test_predict.py."""

import json

import numpy as np

from tests.commandline import files
from tests.field_runs import RUN, estimator
from travjax.data.map_batches import MapStream
from travjax.runs.prediction_report import predict_maps
from travjax.runs.predictor import Predictor


def test_predictions_are_written_and_their_shares_printed(tmp_path, capsys):
    predictor = Predictor(RUN, estimator())
    maps = lambda: MapStream.synthetic(["rough", "smooth"], [3, 4], RUN.grid, 8.0)
    path = predict_maps(maps(), predictor, str(tmp_path), figures=False)
    assert files(tmp_path) == {path, tmp_path / "shares.txt"}
    with np.load(path) as written:
        heights = np.concatenate([batch["heights"] for batch in maps().batches])
        np.testing.assert_array_equal(written["probability"], predictor.predict(heights).probability)
        config = json.loads(str(written["config"]))
        assert "heights" not in written and written["group"].tolist() == ["rough", "smooth"]
    assert (config["world"], config["model"], config["robot"]["name"]) == (8.0, "field", RUN.robot.name)
    assert (tmp_path / "shares.txt").read_text() in capsys.readouterr().out
