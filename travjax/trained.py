"""A training run's folder: what was trained on what (run.json), and its checkpoints."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
from flax import nnx

from travjax.actions import ActionSpace
from travjax.checkpoint import Checkpoints
from travjax.config import InputError, from_json, to_json
from travjax.estimator import Estimator, create, put_together, take_apart
from travjax.files import written_whole
from travjax.grid import Grid
from travjax.preset import Preset
from travjax.robot import Robot

TRAINED = {1: ("heads",), 2: ("trunk", "heads")}
"""What each phase trains."""

DATA = "data"
"""Folder of a run's own data set."""

_PARTS = {"preset": Preset, "robot": Robot, "actions": ActionSpace, "grid": Grid}


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
        table = {name: to_json(getattr(self, name)) for name in _PARTS}
        path = folder / "run.json"
        with written_whole(path) as temporary:
            temporary.write_text(json.dumps(table, indent=1) + "\n")
        return path

    @staticmethod
    def load(folder: str | Path) -> "Run":
        """Reads run.json; raises InputError when it is missing or wrong."""
        path = Path(folder) / "run.json"
        try:
            table = json.loads(path.read_text())
            return Run(**{name: from_json(table[name], kind) for name, kind in _PARTS.items()})
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

    def graph(self) -> nnx.GraphDef:
        """What is fixed of the estimator."""
        return take_apart(nnx.eval_shape(lambda: create(self.preset.trunk, self.preset.heads)))[0]

    def template(self, phase: int, sharding: jax.sharding.Sharding | None = None) -> dict[str, Any]:
        """Shapes of the state of a phase, for a checkpoint; phase 0 is without an optimizer."""

        def state():
            variables = take_apart(create(self.preset.trunk, self.preset.heads))[1]
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


def load_estimator(folder: str | Path, which: str = "best") -> tuple[Run, Estimator, dict]:
    """The run of a folder, the estimator of one of its checkpoints, and what the checkpoint says of itself.

    which: "best", "latest" or the name of a checkpoint ("heads" is the end of phase 1)
    Raises InputError when there is none or it is damaged.
    """
    run = Run.load(folder)
    checkpoints = Checkpoints(Path(folder) / "checkpoints")
    state, meta = checkpoints.restore(lambda meta: run.template(meta["optimizer"]), which)
    for notice in checkpoints.notices:
        print(notice)
    return run, put_together(run.graph(), state), meta
