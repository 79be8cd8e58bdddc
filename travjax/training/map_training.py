"""Training of the hazard field: the loop of trainer.py over whole maps instead of samples."""

import itertools
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from travjax.data.dataset import Dataset
from travjax.models.names import FIELD
from travjax.runs.map_samples import MapData
from travjax.runs.run import Run
from travjax.training.step import update
from travjax.training.trainer import Trainer


class FieldTrainer(Trainer):
    """One training run of the hazard field; see Trainer. Its only phase is the second."""

    data: MapData  # type: ignore[assignment]

    def _data(self, dataset: Dataset) -> MapData:  # type: ignore[override]
        return MapData(dataset, self.run.preset)

    def _batches(self) -> Iterator[tuple[Any, None, np.ndarray]]:
        """As Trainer's; the next batch is prepared while a step runs."""
        here, ahead = self.position, deque[tuple[Future, np.ndarray]]()
        numbered = enumerate(self.data.batches(here.phase, here.epoch), here.total - here.step)
        with ThreadPoolExecutor(1) as pool:
            for step, (maps, _, weight) in itertools.islice(numbered, here.step, None):
                ahead.append((pool.submit(self.data.prepared, maps, step), weight))
                if len(ahead) == 2:
                    prepared, weight = ahead.popleft()
                    yield prepared.result(), None, weight
            for prepared, weight in ahead:
                yield prepared.result(), None, weight

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
