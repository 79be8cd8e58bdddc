"""Reads programs before they run: the operations and bytes of networks, from what JAX hands to XLA (StableHLO)."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from travjax.estimators.kind import Batch
from travjax.estimators.map_estimator import map_hazards
from travjax.estimators.map_samples import MapSource
from travjax.estimators.trajectory_estimator import sample_logits
from travjax.experiments.gpu.limits import Work
from travjax.jax_flags import usual_flags
from travjax.models.input_images import ImageSource
from travjax.models.pose_stencil import Stencil, stencil
from travjax.models.variables import VARIABLES
from travjax.runs.run import Run
from travjax.training.step import StepSettings, update

NUMBERS = {"f32": 4, "bf16": 2, "f16": 2, "i32": 4, "ui32": 4, "i16": 2, "i8": 1, "ui8": 1, "i1": 1, "ui64": 8}
"""Bytes of the types of numbers in StableHLO."""

_TENSOR = re.compile(r"tensor<([^>]*)>")
_OPERATION = re.compile(r"stablehlo\.(\w+)\b([^\n]*) : (\(tensor[^\n]*\) -> tensor<[^>]*>)")
_SCATTER = re.compile(r'"stablehlo\.scatter".*?\}\) : (\(tensor[^\n]*\) -> tensor<[^>]*>)', re.DOTALL)
_CONTRACTED = re.compile(r"contracting_dims = \[([\d, ]*)\]")


@dataclass(frozen=True)
class Program:
    """What a program holds, loops counted once.

    operations: by the type of numbers; unfused: bytes, if every operation reads its operands and writes its result
    products:   number of convolutions and matrix products; products_bytes: bytes of their operands and results
    gathers:    number of gathers and scatters; gathers_bytes: bytes of what they read or add
    """

    operations: Mapping[str, float]
    unfused: float
    products: int
    products_bytes: float
    gathers: int
    gathers_bytes: float

    @property
    def work(self) -> Work:
        """The least that it moves and computes: all else is fused into products and gathers."""
        return Work(self.products_bytes + self.gathers_bytes, self.operations)


def read_program(lowered: jax.stages.Lowered) -> Program:
    """Counts what a lowered program does; cheap, since nothing is compiled."""
    text, cost = lowered.as_text(), lowered.cost_analysis() or {}
    products, gathers, in_tf32, halves = [], [], 0, False
    for name, how, types in _OPERATION.findall(text):
        tensors = _TENSOR.findall(types)
        if name in ("convolution", "dot_general"):
            products.append(sum(map(_bytes, tensors)))
            halves |= tensors[0].endswith("bf16")
        if name == "dot_general" and tensors[0].endswith("xf32"):
            in_tf32 += _product_operations(how, tensors[0], tensors[-1])
        if name == "gather":
            gathers.append(_bytes(tensors[-1]))
    gathers += [_bytes(_TENSOR.findall(types)[-2]) for types in _SCATTER.findall(text)]
    operations = float(cost.get("flops", 0))
    return Program(
        operations={"tf32": in_tf32, "bfloat16": operations - in_tf32} if halves else {"tf32": operations},
        unfused=float(cost.get("bytes accessed", 0)),
        products=len(products),
        products_bytes=float(sum(products)),
        gathers=len(gathers),
        gathers_bytes=float(sum(gathers)),
    )


def _product_operations(how: str, left: str, result: str) -> int:
    """Counts the operations of a matrix product: two for each element of the result and place of what is summed."""
    found = _CONTRACTED.search(how)
    axes = [int(axis) for axis in found[1].split(",")] if found and found[1] else []
    return 2 * _bytes(result) // NUMBERS["f32"] * prod(int(left.split("x")[axis]) for axis in axes)


def _bytes(tensor: str) -> int:
    """Returns the bytes of a tensor such as 64x129x129x3xf32."""
    *shape, numbers = tensor.split(",")[0].split("x")
    return prod(map(int, shape)) * NUMBERS[numbers]


@contextmanager
def as_on_a_gpu() -> Iterator[None]:
    """Lets networks be traced in the form that they have on a GPU, on a machine without one."""
    with mock.patch.object(jax, "default_backend", lambda: "gpu"):
        yield


@usual_flags()
def training_step(run: Run, size: int) -> jax.stages.Lowered:
    """Lowers a step of phase 2 of a training run on `size` samples; no array is made."""
    phase, training = run.kind.phases[2], run.preset.training
    settings = StepSettings(run.graph(), phase, training.make_optimizer(2, 1), training.penalty)
    inputs, targets = _inputs_of_maps(run, size) if run.kind.reads_whole_maps else _inputs_of_samples(run, size)
    batch = Batch(inputs, targets, _array(size))  # type: ignore[arg-type]
    return jax.jit(update, static_argnames="settings").lower(run.template(2), batch, 0, 0, settings=settings)


@usual_flags()
def prediction(run: Run, size: int) -> jax.stages.Lowered:
    """Lowers the prediction of `size` samples by a run's estimator: maps for the field, else maps and trajectories."""
    variables = {name: part for name, part in run.template(0).items() if name in VARIABLES}
    index = _array(size, dtype=np.int32)
    if run.kind.reads_whole_maps:
        maps = MapSource(_array(size, *run.grid.shape), _table(run), np.float32(1))  # type: ignore[arg-type]
        return map_hazards.lower(run.graph(), variables, maps, index)
    return sample_logits.lower(run.graph(), variables, _image_source(run, size), index, index)


def _array(*shape: int, dtype: type = np.float32) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, dtype)


def _image_source(run: Run, maps: int) -> ImageSource:
    bank = _array(len(run.actions), *run.grid.shape, 2, dtype=np.uint8)
    return ImageSource(_array(maps, *run.grid.shape), bank, np.float32(1))  # type: ignore[arg-type]


def _inputs_of_samples(run: Run, size: int) -> tuple:
    index = _array(size, dtype=np.int32)
    return (_image_source(run, size), index, index), _array(size, len(run.robot.events))


def _table(run: Run, arcs: int = 0) -> Stencil:
    """Returns the shapes of a stencil of so many first arcs, 0 for all."""
    table = stencil(run.setup)
    nodes = _array(arcs or len(table.nodes), *table.nodes.shape[1:], dtype=np.int32)
    return Stencil(nodes, table.first_poses, table.second_arcs)  # type: ignore[arg-type]


def _inputs_of_maps(run: Run, size: int) -> tuple:
    table = stencil(run.setup)
    arcs = min(max(run.preset.training.trajectories_per_map // table.second_arcs, 1), len(table.nodes))
    count, events = arcs * table.second_arcs, len(run.robot.events)
    targets = _array(size, count, events), jax.ShapeDtypeStruct((size, count), jnp.bool_)
    return (_array(size, *run.grid.shape), _table(run, arcs)), targets
