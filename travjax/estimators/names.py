"""The estimators, one entry each. To add one, write a class as in trajectory_estimator.py, and an entry here."""

from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any

RESNET, FIELD = "resnet50", "field"


@dataclass(frozen=True)
class Entry:
    """Where an estimator is found.

    kind:   "module:class" of its EstimatorKind (kind.py); it is imported at first use, so that a command can list
            the names without Flax
    folder: name of the folder of its runs under runs/
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
"""Entries by the `model` of a preset: one trajectory at a time, and all trajectories of a map at once."""
