"""Probabilities of failure for the whole action space, from maps alone, by a trained estimator."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from travjax.config import InputError, require
from travjax.devices import Devices
from travjax.estimators.inference import NoNumbers, Placed, Progress, probabilities
from travjax.files import user_path
from travjax.jax_flags import usual_flags
from travjax.models.variables import Network
from travjax.runs.model_file import SUFFIX, read_model
from travjax.runs.run import Run, load_estimator
from travjax.simulation.actions import ActionSpace
from travjax.simulation.contact import Contact
from travjax.simulation.grid import HIGHEST, Grid
from travjax.simulation.heights import Heights, as_maps
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup

WEIGHTS = Path(__file__).parent / "weights"
"""The estimators that come with the package."""

DEFAULT = "field_seekur_jr"


@dataclass(frozen=True)
class Predicted:
    """What an estimator says of the trajectories of maps.

    probability: [n, t, k] of each of the robot's failure events: step, obstacle and tilt, and any further ones
    margins:     [n, t, k] metres or radians; None if the estimator has none
    """

    probability: Float[np.ndarray, "*n t k"]
    margins: Float[np.ndarray, "*n t k"] | None


@dataclass(frozen=True, repr=False)
class Predictor:
    """A trained estimator, the run that it comes from, and the file or folder that it was read from."""

    run: Run
    network: Network
    source: Path | None = None

    def __repr__(self) -> str:
        run = self.run
        return (
            f"Predictor({run.preset.model} for {run.robot.name},\n"
            f"          {len(run.actions)} trajectories of maps of {run.grid.size:g} x {run.grid.size:g} m at "
            f"{run.grid.spacing:g} m)"
        )

    @property
    def title(self) -> str:
        """What it is and the name of its file or folder, as in "field, laptop"."""
        model = self.run.preset.model
        return f"{model}, {self.source.name}" if self.source else model

    @staticmethod
    @usual_flags()
    def load(source: str | Path | None = None, which: str = "best") -> "Predictor":
        """Loads the estimator of a file, of a training run's folder, or one that comes with the package.

        source: file or folder, or the name of one in the package, field_seekur_jr, which is also meant by None
        which:  checkpoint of a folder
        Raises InputError when there is none, or it is damaged.
        """
        path = user_path(DEFAULT if source is None else source)
        packaged = WEIGHTS / f"{path.name}{SUFFIX}"
        if source is None or (len(path.parts) == 1 and packaged.is_file() and not path.exists()):
            path = packaged
        if path.is_dir():
            return Predictor(*load_estimator(path, which)[:2], path)
        if path.suffix != SUFFIX:
            raise InputError(f"{path}: no estimator; allowed: the folder of a training run, or a {SUFFIX} file")
        return Predictor(*read_model(path)[:2], path)

    def require_trained_for(
        self,
        robot: Robot | None = None,
        actions: ActionSpace | None = None,
        grid: Grid | None = None,
        contact: str | None = None,
    ):
        """Raises InputError when robot, actions, grid or contact model differ from what the estimator was trained for;
        it names both.
        """
        own = self.run.setup
        model = Contact.from_model(contact, own.contact.turn) if contact else own.contact
        given = Setup(robot or own.robot, actions or own.actions, grid or own.grid, model)
        parts = [part for part, *_ in own.differences(given)]
        for part in sorted(parts, key=lambda part: part != "contact"):  # which decides what of a robot matters
            wanted, other = getattr(own, part), getattr(given, part)
            if part == "robot":
                same = " of other dimensions or limits" if other.name == wanted.name else ""
                wanted, other = f"{wanted.name}{same}", other.name
            if part == "contact":
                wanted, other = wanted.model, other.model
            require(False, part, other, f"{wanted}, which the estimator was trained for")

    @usual_flags()
    def predict(self, heights: Heights, on_progress: Progress = lambda count: None) -> Predicted:
        """Predicts the failures of every trajectory of maps on the run's grid.

        heights: [n, rows, cols] or [rows, cols] metres, NaN unknown, as `simulate` takes them
        The hazard field gives an unknown node the height of the nearest known one; the ResNet follows SPEC section 6.
        on_progress: is told how many trajectories were added
        Raises InputError where `simulate` would refuse the heights, and when the estimator returns NaN or infinity.
        """
        checked, alone = as_maps(heights, self.run.grid)
        maps = np.asarray(checked)
        maps = np.where(np.abs(maps) <= HIGHEST, maps, np.nan)  # a jax array may hold any values
        try:
            logits, margins = self._outputs(maps, on_progress)
        except NoNumbers as error:
            raise InputError(f"{self.source}: {error}" if self.source else str(error)) from None
        one = (lambda array: array[0]) if alone else (lambda array: array)
        return Predicted(one(probabilities(logits)), None if margins is None else one(margins))

    def _outputs(self, maps: np.ndarray, on_progress: Progress) -> tuple[np.ndarray, np.ndarray | None]:
        """Returns logits and margins of the trajectories of maps: [n, t, k] each, None for margins if it has none."""
        run, devices = self.run, Devices.all()
        placed = Placed.from_network(self.network, devices.replicate(run.source(maps)), devices)
        logits, margins = run.kind.of_maps(placed, np.arange(len(maps)), len(run.actions), on_progress)
        return logits, None if margins is None else margins * np.asarray(run.robot.limits, np.float32)


def predict(heights: Heights, model: str | Path | None = None) -> Float[np.ndarray, "*n t k"]:
    """Returns the probabilities of step, obstacle and tilt failures for every trajectory of every map.

    heights: [n, rows, cols] or [rows, cols] metres, NaN unknown, 8 x 8 m at 0.0625 m unless the model expects others
    model:   folder of a training run, or .safetensors file; the hazard field for the Seekur Jr that comes with the
             package unless given
    Returns [n, t, 3], or [t, 3] for one map; more where the model's robot has further events. Raises InputError for
    invalid heights or an invalid model.
    """
    return Predictor.load(model).predict(heights).probability
