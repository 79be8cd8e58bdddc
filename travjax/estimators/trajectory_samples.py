"""The samples of each epoch of a training run, and their batches; all NumPy on the host."""

import itertools
from collections.abc import Iterator
from functools import cached_property

import numpy as np

from travjax.config import require
from travjax.data.dataset import Dataset
from travjax.data.sampling import Sampler, Samples, balanced_subset, batches, random_keys
from travjax.estimators.kind import Batch
from travjax.estimators.preset import TrainingConfig


class TrajectorySamples:
    """Samples of a data set's training and validation maps.

    Raises InputError when there are none of either.
    """

    def __init__(self, dataset: Dataset, config: TrainingConfig):
        self.dataset, self.config = dataset, config
        maps = dataset.maps_of("train")
        each, failing, fresh = config.trajectories_per_map, config.failing_per_map, config.resample_each_epoch
        self._sampler = Sampler(dataset.labels, maps, config.sampling_seed, each, failing, fresh)
        self._kept: dict[int, Samples] = {}
        for split, samples in (("train", self.samples(1, 0)), ("validation", self.validation)):
            require(len(samples[0]) > 0, f"data set, {split} split", 0, "at least one known trajectory")

    def samples(self, phase: int, epoch: int) -> Samples:
        """Returns the training samples of an epoch; phase 1 has the same ones in all epochs."""
        number = 0 if phase == 1 else epoch + 1
        if number not in self._kept:
            # Those from which steps are counted are kept, others dropped: drawing from a large data set takes a second.
            counted = {kept: samples for kept, samples in self._kept.items() if kept < 2}
            self._kept = counted | {number: self._sampler.epoch(number)}
        return self._kept[number]

    @cached_property
    def validation(self) -> Samples:
        """The balanced subset of the validation maps, or as many of it as the configuration allows."""
        config, maps = self.config, self.dataset.maps_of("validation")
        each, failing = config.trajectories_per_map, config.failing_per_map
        samples = balanced_subset(self.dataset.labels, maps, config.sampling_seed, each, failing)
        keys = random_keys(("validation", config.sampling_seed), np.arange(len(samples[0])))
        chosen = np.sort(np.argsort(keys)[: config.validation_samples])
        return samples[0][chosen], samples[1][chosen]

    def failed(self, samples: Samples) -> np.ndarray:
        """Returns the failures of samples: [k, events] float32."""
        return self.dataset.failed(samples).astype(np.float32)

    def count(self, phase: int, epoch: int) -> int:
        """Returns the number of samples of an epoch."""
        return len(self.samples(phase, epoch)[0])

    def steps(self, phase: int, epoch: int = 0) -> int:
        """Returns the number of batches of an epoch."""
        return -(-self.count(phase, epoch) // self.config.batch_size)

    def batches(self, phase: int, epoch: int, first: int = 0) -> Iterator[Batch]:
        """Yields the batches of an epoch from the first-th on, each epoch in its own order.

        inputs:  maps [b] and trajectories [b]; in phase 1 places in `samples` [b]
        targets: failures [b, events]
        The samples that pad the last batch have weight 0, but count in its batch statistics.
        """
        samples = self.samples(phase, epoch)
        failed, places = self.failed(samples), np.arange(len(samples[0]))
        stream = 2 * epoch + phase - 1
        chosen, _, weights = batches((places, places), self.config.batch_size, self.config.seed, stream)
        for index, weight in itertools.islice(zip(chosen, weights, strict=True), first, None):
            inputs = index if phase == 1 else (samples[0][index], samples[1][index])
            yield Batch(inputs, failed[index], weight)

    def summary(self) -> str:
        """Says in one line what is trained on."""
        samples = self.samples(2, 0)
        share = self.failed(samples).any(axis=1).mean()
        return (
            f"{len(self.dataset.maps_of('train'))} training maps; {len(samples[0])} samples an epoch, {share:.0%} of "
            f"which fail; {len(self.validation[0])} validation samples"
        )
