"""A training run's folder: what was trained on what (run.json), and its checkpoints."""

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx

import travjax.estimator
import travjax.field
from travjax.actions import ActionSpace
from travjax.checkpoint import Checkpoints
from travjax.config import InputError, from_json, require, to_json
from travjax.estimator import Estimator, put_together, take_apart
from travjax.field import HazardField
from travjax.files import written_whole
from travjax.flags import usual_flags
from travjax.grid import Grid
from travjax.imagenet import Weights
from travjax.inputs import ImageSource
from travjax.map_data import MapSource
from travjax.models import FIELD
from travjax.preset import Preset
from travjax.robot import Robot

TRAINED = {1: ("heads",), 2: ("trunk", "heads"), FIELD: ("trunk", "heads")}
"""What each phase trains, and training of the hazard field."""

DATA = "data"
"""Folder of a run's own data set."""

_PARTS = {"preset": Preset, "robot": Robot, "actions": ActionSpace, "grid": Grid}


Network = Estimator | HazardField
"""An estimator of either model."""


@dataclass(frozen=True)
class Run:
    """What a training run is made from.

    robot, actions, grid: what the labels, and so the network, hold for
    """

    preset: Preset
    robot: Robot
    actions: ActionSpace
    grid: Grid

    def save(self, folder: Path) -> Path:
        """Writes run.json."""
        path = folder / "run.json"
        with written_whole(path) as temporary:
            temporary.write_text(json.dumps(self.to_json(), indent=1) + "\n")
        return path

    def to_json(self) -> dict[str, Any]:
        """What JSON can hold."""
        return {name: to_json(getattr(self, name)) for name in _PARTS}

    @staticmethod
    def from_json(table: dict[str, Any]) -> "Run":
        """The inverse of `to_json`; raises all sorts over another table."""
        return Run(**{name: from_json(table[name], kind) for name, kind in _PARTS.items()})

    @staticmethod
    def load(folder: str | Path) -> "Run":
        """Reads run.json; raises InputError when it is missing or wrong."""
        path = Path(folder) / "run.json"
        try:
            return Run.from_json(json.loads(path.read_text()))
        except OSError as error:
            raise InputError(
                f"{path}: cannot be read: {error.strerror}; allowed: the folder of a training run"
            ) from None
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        except (ValueError, LookupError, TypeError, AttributeError):
            raise InputError(f"{path}: not the run.json of a training run") from None

    def require_same(self, other: "Run", what: str) -> None:
        """Raises InputError that names the first setting in which the other run differs."""
        free = {f"preset.{name}" for name in ("robot", "weights", "evaluation.maps", "evaluation.each")}
        for name, mine, others in _settings(self, other):
            if mine != others and name not in free:
                raise InputError(f"{what}: {name} = {others!r}: must be {mine!r}, as in the run so far")

    @usual_flags()
    def create(self, seed: int = 0, weights: Weights | None = None) -> Network:
        """An estimator with random parameters, or a ResNet with a trunk of `weights`.

        Raises InputError for weights of another trunk, or where the hazard field is to begin with any.
        """
        if self.preset.model == FIELD:
            require(weights is None, "weights", self.preset.weights, '"none": the hazard field begins with random ones')
            return travjax.field.create(self.preset.field, seed)
        return travjax.estimator.create(self.preset.trunk, self.preset.heads, seed, weights)

    def source(
        self, heights: np.ndarray, on_progress: Callable[[int], object] = lambda count: None
    ) -> ImageSource | MapSource:
        """Maps [n, rows, cols] as the estimator takes them; on_progress is told of trajectories drawn."""
        scale = self.preset.elevation_scale
        if self.preset.model == FIELD:
            return MapSource.of(heights, self.robot, self.actions, self.grid, scale)
        return ImageSource.of(heights, self.robot, self.actions, self.grid, scale, on_progress)

    @usual_flags()
    def graph(self) -> nnx.GraphDef:
        """What is fixed of the estimator."""
        return take_apart(nnx.eval_shape(self.create))[0]

    @usual_flags()
    def template(self, phase: int, sharding: jax.sharding.Sharding | None = None) -> dict[str, Any]:
        """Shapes of the state of a phase, for a checkpoint; phase 0 is without an optimizer."""

        def state():
            variables = take_apart(self.create())[1]
            if phase:
                trained = {name: variables[name] for name in TRAINED[phase]}
                variables |= {"optimizer": self.preset.training.optimizer(phase, 1).init(trained)}
            return variables

        shaped = lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding)
        return jax.tree.map(shaped, jax.eval_shape(state))


def _settings(mine: Any, other: Any, prefix: str = ""):
    for field in dataclasses.fields(mine):
        name, ours, theirs = prefix + field.name, getattr(mine, field.name), getattr(other, field.name)
        if dataclasses.is_dataclass(ours):
            yield from _settings(ours, theirs, f"{name}.")
        else:
            yield name, ours, theirs


def has_checkpoints(folder: Path) -> bool:
    """Whether training has begun in the folder: it holds a checkpoint, whole or not."""
    checkpoints = folder / "checkpoints"
    return checkpoints.is_dir() and any(not path.name.startswith(".") for path in checkpoints.iterdir())


@usual_flags()
def load_estimator(folder: str | Path, which: str = "best") -> tuple[Run, Network, dict]:
    """The run of a folder, the estimator of one of its checkpoints, and what the checkpoint says of itself.

    which: "best", "latest" or the name of a checkpoint ("heads" is the end of phase 1)
    Raises InputError when there is none, or it is damaged or not made of finite numbers.
    """
    run = Run.load(folder)
    checkpoints = Checkpoints(Path(folder) / "checkpoints")
    state, meta = checkpoints.restore(lambda meta: run.template(meta["optimizer"]), which)
    for notice in checkpoints.notices:
        print(notice)
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state)):
        raise InputError(f"{folder}: checkpoint {which!r} holds NaN or infinite weights; allowed: another checkpoint")
    return run, put_together(run.graph(), state), meta
