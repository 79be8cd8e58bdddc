"""The estimators, one entry each. One of your own is a class as in trajectory_estimator.py, and an entry here."""

from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any

RESNET, FIELD = "resnet50", "field"


@dataclass(frozen=True)
class Entry:
    """Where an estimator is found.

    kind:   "module:class" of its EstimatorKind (kind.py); it is imported when it is first asked for, so that a command
            lists the names without Flax
    folder: of its runs under runs/; its presets lie in presets/, in a folder of its name
    """

    kind: str
    folder: str

    def load(self) -> Any:
        """Returns the estimator's kind."""
        return resolve_name(self.kind)()


ESTIMATORS = {
    RESNET: Entry("travjax.estimators.trajectory_estimator:TrajectoryEstimator", folder="train"),
    FIELD: Entry("travjax.estimators.map_estimator:MapEstimator", folder="field"),
}
"""By the `model` of a preset: of one trajectory at a time, and of all trajectories of a map at once."""
