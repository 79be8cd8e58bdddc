"""The field that comes with the package as ONNX: what onnxruntime computes, and what is refused."""

import importlib.util
import json

import numpy as np
import pytest

from tests.field_runs import RUN, estimator
from travjax.config import InputError
from travjax.exporting import onnx_graph
from travjax.exporting.onnx_graph import EXPORTER, TOLERANCE, export_onnx
from travjax.runs.predictor import Predictor

onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("jax2onnx", reason=f"install it: pip install --no-deps {EXPORTER}")

pytestmark = pytest.mark.usefixtures("shared_code")


@pytest.fixture(scope="module")
def heights(maps) -> np.ndarray:
    """Four terrains, the last with unknown nodes."""
    return np.stack([maps[name] for name in ("rough", "scattered_sharp", "steep", "holes")])


@pytest.fixture(scope="module")
def predictor() -> Predictor:
    return Predictor.load()


def test_the_packaged_field_predicts_the_same_as_onnx(predictor, heights, tmp_path):
    wanted = predictor.predict(heights)
    path, _ = export_onnx(tmp_path / "field.onnx", predictor)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    found = dict(zip(names, session.run(None, {"heights": heights}), strict=True))
    np.testing.assert_allclose(found["probability"], wanted.probability, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(found["margin"], wanted.margins, rtol=0, atol=TOLERANCE)
    alone = session.run(["probability"], {"heights": heights[3:]})[0]
    np.testing.assert_allclose(alone, wanted.probability[3:], rtol=0, atol=TOLERANCE)
    assert path.stat().st_size < 20e6
    said = json.loads((tmp_path / "field.onnx.json").read_text())
    assert said["function"] == "field, field_seekur_jr.safetensors" and set(said["outputs"]) == set(names)


def test_a_graph_that_computes_something_else_is_not_written(monkeypatch, tmp_path):
    monkeypatch.setattr(onnx_graph, "largest_error", lambda graph, predictor: np.nan)
    with pytest.raises(InputError, match="is off by nan; allowed: up to 1e-05"):
        export_onnx(tmp_path / "it.onnx", Predictor(RUN, estimator()))
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(("wrong", "error"), [(0.01, 0.01), (np.nan, np.nan)])
@pytest.mark.parametrize("result", onnx_graph.NAMES)
def test_the_error_of_a_graph_is_the_largest_of_all_its_results(monkeypatch, result, wrong, error):
    predictor = Predictor(RUN, estimator())

    class Session:
        def __init__(self, graph, providers):
            pass

        def run(self, names, inputs):
            found = predictor.predict(inputs["heights"])
            results = {"margin": np.array(found.margins), "probability": np.array(found.probability)}
            results[result][2, 5, 1] += wrong
            return [results[name] for name in names]

    monkeypatch.setattr(onnxruntime, "InferenceSession", Session)
    np.testing.assert_allclose(onnx_graph.largest_error(b"", predictor), error, rtol=1e-3)


@pytest.mark.parametrize(
    ("missing", "needed"),
    [("onnx_ir", 'pip install "travjax[onnx]"'), ("jax2onnx", f"pip install --no-deps {EXPORTER}")],
)
def test_a_library_that_is_missing_is_named(monkeypatch, tmp_path, missing, needed):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == missing else find(name))
    with pytest.raises(InputError) as raised:
        export_onnx(tmp_path / "it.onnx", Predictor(RUN, estimator()))
    assert str(raised.value).endswith(f"not installed; needed: {needed}")
