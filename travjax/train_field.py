"""Training of the hazard field: the loop of train.py over whole maps instead of samples."""

from typing import Any

import jax
import numpy as np

from travjax.dataset import Dataset
from travjax.map_data import MapData
from travjax.preset import FIELD
from travjax.train import Trainer
from travjax.trained import Run
from travjax.training_step import update


class FieldTrainer(Trainer):
    """One training run of the hazard field; see Trainer. Its only phase is the second."""

    data: MapData  # type: ignore[assignment]

    def _data(self, dataset: Dataset) -> MapData:  # type: ignore[override]
        return MapData(dataset, self.run.preset)

    def _inputs(self):
        return lambda maps: self.data.prepared(maps, self.position.total)

    def _step(self, inputs: Any, failed: None, weight: np.ndarray) -> jax.Array:
        (elevation, stencil), targets = inputs
        elevation, targets, weight = self.devices.shard((elevation, targets, weight))
        self.state, loss = update(
            self.state,
            (elevation, self.devices.replicate(stencil)),
            targets,
            weight,
            self.config.seed,
            self.position.total,
            graph=self.graph,
            phase=FIELD,
            optimizer=self._optimizer(2),
            penalty=self.config.penalty,
        )
        return loss


def trainer_of(run: Run) -> type[Trainer]:
    """The trainer for a run's model."""
    return FieldTrainer if run.preset.model == FIELD else Trainer
