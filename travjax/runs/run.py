"""A training run's folder: what was trained on what (run.json), and its checkpoints."""

import dataclasses
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx

from travjax.config import InputError, one_line, parts_from_json, read_json, require, shown, to_json
from travjax.estimators.inference import Progress
from travjax.estimators.kind import EstimatorKind
from travjax.estimators.names import ESTIMATORS
from travjax.estimators.preset import Preset
from travjax.files import save_text, user_path
from travjax.jax_flags import usual_flags
from travjax.models.variables import VARIABLES, Network, merge_model, split_model
from travjax.resnet.imagenet_weights import Weights
from travjax.resnet.weight_files import require_finite
from travjax.runs.checkpoint import Checkpoints
from travjax.simulation.setup import PARTS, Setup, WithSetup

COUNTS, SUMS = ("phase", "epoch", "step", "total"), ("loss", "samples", "best")
"""Fields of the training position that a checkpoint records: whole numbers, and other numbers."""

DATA = "data"
"""Name of the folder that holds a run's own data set."""


@dataclass(frozen=True)
class Run(WithSetup):
    """What a training run is made from.

    setup: robot, action space and grid that the labels, and so the network, are made for
    """

    preset: Preset
    setup: Setup

    def save(self, folder: Path) -> Path:
        """Writes run.json."""
        return save_text(folder / "run.json", json.dumps(self.to_json(), indent=1) + "\n")

    def to_json(self) -> dict[str, Any]:
        """Converts the run to what JSON can hold."""
        return {"preset": to_json(self.preset)} | self.setup.to_json()

    @staticmethod
    def from_json(table: Any, where: object = "saved settings") -> "Run":
        """Restores the run that `to_json` converted; prints which keys of `where` are old.

        Raises InputError for any other table.
        """
        parts = parts_from_json(Setup.parts_of(table), {"preset": Preset} | PARTS, where)
        return Run(parts.pop("preset"), Setup(**parts))

    @staticmethod
    def load(folder: str | Path) -> "Run":
        """Reads run.json; raises InputError when it is missing or wrong."""
        path = user_path(folder) / "run.json"
        table = read_json(path, "the folder of a training run")
        try:
            return Run.from_json(table, path)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    def require_same_settings(self, other: "Run", what: str) -> None:
        """Raises InputError that names the first setting in which the other run differs."""
        free = {f"preset.{name}" for name in ("robot", "weights", "evaluation.maps", "evaluation.trajectories_per_map")}
        parts = [(f"{part}.{name}", *values) for part, name, *values in self.setup.differences(other.setup)]
        for name, mine, others in [*_differences(self.preset, other.preset, "preset."), *parts]:
            if name not in free:
                raise InputError(f"{what}: {name} = {shown(others)}: must be {shown(mine)}, as in the run so far")

    @property
    def kind(self) -> EstimatorKind:
        """The estimator's kind, which defines how it is made, trained and read."""
        return ESTIMATORS[self.preset.model].load()

    @usual_flags()
    def create(self, seed: int = 0, weights: Weights | None = None) -> Network:
        """Makes a network with random parameters, or with a trunk of `weights`.

        Raises InputError for weights that are not for it.
        """
        return self.kind.create(self.preset, self.robot, seed, weights)

    def source(self, heights: np.ndarray, on_progress: Progress = lambda count: None) -> Any:
        """Returns maps [n, rows, cols] in the form the estimator takes; on_progress counts the trajectories drawn."""
        return self.kind.source(self.preset, heights, self.setup, on_progress)

    @usual_flags()
    def graph(self) -> nnx.GraphDef:
        """Returns the static part of the estimator, without its arrays."""
        return split_model(nnx.eval_shape(self.create))[0]

    @usual_flags()
    def template(self, phase: int, sharding: jax.sharding.Sharding | None = None) -> dict[str, Any]:
        """Returns the shapes of the state of a phase, for a checkpoint; phase 0 is without an optimizer.

        Raises InputError for a phase that the estimator does not have.
        """
        phases = self.kind.phases
        require(phase in (0, *phases), f"phase of {self.kind.title}", phase, f"one of {[0, *phases]}")

        def state():
            variables = split_model(self.create())[1]
            if phase:
                trained = {name: variables[name] for name in phases[phase].trained}
                variables |= {"optimizer": self.preset.training.make_optimizer(phase, 1).init(trained)}
            return variables

        shaped = lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding)
        return jax.tree.map(shaped, jax.eval_shape(state))


def _differences(mine: Any, other: Any, prefix: str) -> Iterator[tuple[str, Any, Any]]:
    """Yields name, value here and value there for each setting in which another configuration differs."""
    for field in dataclasses.fields(mine):
        name, ours, theirs = prefix + field.name, getattr(mine, field.name), getattr(other, field.name)
        if dataclasses.is_dataclass(ours) and type(theirs) is type(ours):
            yield from _differences(ours, theirs, f"{name}.")
        elif ours != theirs:
            yield name, ours, theirs


def has_checkpoints(folder: Path) -> bool:
    """Tells whether training has begun in the folder: it holds a checkpoint, intact or not."""
    checkpoints = folder / "checkpoints"
    return checkpoints.is_dir() and any(not path.name.startswith(".") for path in checkpoints.iterdir())


def checked_meta(meta: dict, folder: str | Path, run: Run | None = None) -> dict:
    """Returns the meta that training wrote with a checkpoint of a run, once it is checked.

    Raises InputError that names the run's folder where the meta is incomplete, and run.json where the checkpoint was
    trained with other settings than those of `run`, if given; older checkpoints do not record their settings.
    """
    where, told = f"{folder}: meta of a checkpoint", meta.get("position")
    position = told if isinstance(told, dict) else {}
    require(meta.get("optimizer") in (0, 1, 2), f"{where}: optimizer", meta.get("optimizer"), "0, 1 or 2")
    require(isinstance(meta.get("dataset"), str), f"{where}: dataset", meta.get("dataset"), "a fingerprint")
    counted = all(type(position.get(name)) is int and position[name] >= 0 for name in COUNTS)
    summed = all(type(position.get(name)) in (int, float) and abs(position[name]) < math.inf for name in SUMS)
    whole = counted and summed and position["phase"] in (1, 2) and len(position) == len(COUNTS + SUMS)
    require(whole, f"{where}: position", told, f"numbers named {', '.join(COUNTS + SUMS)}")
    if run and "run" in meta:
        try:
            trained = Run.from_json(meta["run"], where)
        except InputError as error:
            raise InputError(f"{where}: run: {error}") from None
        trained.require_same_settings(run, f"{user_path(folder) / 'run.json'}")
    return meta


@usual_flags()
def load_estimator(folder: str | Path, which: str = "best") -> tuple[Run, Network, dict]:
    """Loads the run of a folder, the estimator of one of its checkpoints, and the meta of that checkpoint.

    which: "best", "latest" or the name of a checkpoint ("heads" is the end of phase 1)
    Raises InputError when there is none, it is damaged, it was trained with other settings than those of run.json, or
    it holds a number that is not finite.
    """
    run = Run.load(folder)
    checkpoints = Checkpoints(user_path(folder) / "checkpoints")
    state, meta = checkpoints.restore(lambda meta: run.template(checked_meta(meta, folder, run)["optimizer"]), which)
    for notice in checkpoints.notices:
        print(one_line(notice))
    variables = {name: state[name] for name in VARIABLES}
    for name, leaf in named_leaves(variables).items():
        require_finite(f"{folder}, checkpoint {which}: {name}", np.asarray(leaf))
    return run, merge_model(run.graph(), state), meta


def named_leaves(variables: Any) -> dict[str, Any]:
    """Returns the leaves of an estimator's variables in order, by path such as "trunk/trunk/stem/kernel"."""
    name = lambda path: jax.tree_util.keystr(path, simple=True, separator="/").removesuffix("/value")
    return {name(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(variables)}
