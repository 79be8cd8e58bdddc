"""A hazard field as an ONNX file, by jax2onnx, which is checked by onnxruntime before it is written.

jax2onnx pins Orbax below the version that travjax needs, so no extra can bring it. It does not use Orbax here and is
installed without its dependencies; the extra `onnx` brings those that it does use.
"""

import importlib.util
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from travjax.config import InputError, require, require_installed
from travjax.exporting import exported_file
from travjax.exporting.functions import field_function
from travjax.files import user_path
from travjax.jax_flags import usual_flags
from travjax.runs.predictor import Predictor

SUFFIX = ".onnx"

EXPORTER = "jax2onnx==0.17.1"

OPSET = 18
"""Version of the operators: an old one, for programs that are old."""

NAMES = ("margin", "probability")
"""Results in the order of the file, which is that of their names."""

TOLERANCE = 1e-5
"""Largest error of a result that a file may have, relative where the result is above 1."""


@usual_flags()
def export_onnx(to: str | Path, predictor: Predictor) -> tuple[Path, Path]:
    """Writes the function of a hazard field, and its description; returns where both are.

    to: .onnx file; a file that travjax did not write is never replaced
    Input and results are those of `Predictor.predict`, any number of maps; `known` is not among them.
    Raises InputError for an estimator of another kind, when a library is missing, when something else is in the way,
    and when the graph does not compute what the predictor does.
    """
    path, setup = user_path(to), predictor.run.setup
    exported_file.require_place(path, SUFFIX)
    predicted = field_function(predictor, barriers=False)
    dtype = predictor.run.preset.field.dtype
    require(dtype == "float32", "dtype", dtype, "float32: onnxruntime has no convolution of bfloat16 on a CPU")
    _require_libraries()
    heights = jax.ShapeDtypeStruct(("b", *setup.grid.shape), jnp.float32)
    with _quiet():
        from jax2onnx import to_onnx

        named = {"model_name": "travjax", "input_names": ["heights"], "output_names": NAMES}
        graph = to_onnx(predicted, [heights], opset=OPSET, **named)
    data = graph.SerializeToString()
    error = largest_error(data, predictor)
    if not error <= TOLERANCE:
        said = f"the graph of {EXPORTER} is off by {error:.1g}; allowed: up to {TOLERANCE:g}"
        rounded = "" if jax.default_backend() == "cpu" else "; with JAX_PLATFORMS=cpu nothing is rounded as here"
        raise InputError(said + rounded)
    shape = f"[b, {len(setup.actions)}, {len(setup.robot.events)}] float32"
    outputs = {"margin": f"{shape}, metres or radians", "probability": f"{shape}, of each event"}
    return exported_file.write(path, data, setup, predictor.title, outputs)


def largest_error(graph: bytes, predictor: Predictor) -> float:
    """Returns the largest error of what onnxruntime computes, on four maps with unknown ground, as of TOLERANCE.

    NaN where a result is none.
    """
    import onnxruntime

    steps = np.random.default_rng(0).normal(0, 0.02, (4, *predictor.run.grid.shape))
    heights = steps.cumsum(axis=2).astype(np.float32)
    heights[:, : heights.shape[1] // 4] = np.nan
    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    wanted = predictor.predict(heights)
    assert wanted.margins is not None
    pairs = zip(session.run(list(NAMES), {"heights": heights}), (wanted.margins, wanted.probability), strict=True)
    return float(np.max([(np.abs(found - value) / np.maximum(np.abs(value), 1)).max() for found, value in pairs]))


def _require_libraries() -> None:
    """Raises InputError that says how to install a library that is missing."""
    for module in ("onnx", "onnx_ir", "onnxruntime"):
        require_installed(module, "--onnx", "onnx")
    if importlib.util.find_spec("jax2onnx") is None:
        raise InputError(f"--onnx: jax2onnx is not installed; needed: pip install --no-deps {EXPORTER}")


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps from the terminal what the exporter logs and warns of on its way; the graph is checked afterwards."""
    loggers = [logging.getLogger(name) for name in ("jax2onnx", "onnx_ir")]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.ERROR)
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
