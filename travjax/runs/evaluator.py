"""Evaluation of a trained estimator on the test maps of a data set (SPEC section 10)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from travjax.config import require
from travjax.data import map_batches
from travjax.data.dataset import Dataset
from travjax.data.sampling import Samples, balanced_subset, every_sample, natural_sample
from travjax.devices import Devices
from travjax.estimators.inference import Placed, Progress, probabilities
from travjax.evaluation import metrics
from travjax.evaluation.baselines import LogisticRegression, slope_and_step
from travjax.models.variables import Network
from travjax.runs.run import Run
from travjax.traversal.traverse import margins_of, unpacked

SPARSEST = 6
"""A figure shows at least every sixth trajectory."""

REGRESSION_SAMPLES = 50_000
"""Most training samples that the logistic regression is fitted to."""


@dataclass(frozen=True)
class Evaluator:
    """A run's data set on the devices, ready for its estimators.

    Raises InputError when the data set is not for the run's robot, action space and grid, or when the devices cannot
    share a batch.
    """

    run: Run
    dataset: Dataset
    source: Any
    devices: Devices

    @staticmethod
    def from_run(run: Run, dataset: Dataset, devices: Devices) -> "Evaluator":
        """Puts the network's source, made from the maps, on the devices."""
        dataset.setup.require_same(run.setup, "data set")
        devices.check_batch(run.preset.training.batch_size)
        source = run.source(dataset.heights)
        return Evaluator(run, dataset, devices.replicate(source), devices)

    def samples(self, maps: int, each: int) -> Samples:
        """Draws random test samples at natural frequency on `maps` maps, with `each` trajectories each; 0 means all.

        Raises InputError when there are none.
        """
        labels, test = self.dataset.labels, self.dataset.maps_of("test")
        if maps or each:
            seed = self.run.preset.training.seed
            samples = natural_sample(labels, test, seed, maps or max(len(test), 1), each or labels.shape[1])
        else:
            samples = every_sample(labels, test)
        require(len(samples[0]) > 0, "data set, test split", 0, "at least one known trajectory")
        return samples

    def failed(self, samples: Samples) -> np.ndarray:
        """Returns the failures of samples: [k, events] bool."""
        return self.dataset.failed(samples)

    def probabilities(
        self, estimator: Network, samples: Samples, on_progress: Progress = lambda count: None
    ) -> np.ndarray:
        """Returns the probabilities of samples: [k, events]."""
        placed = Placed.from_network(estimator, self.source, self.devices)
        size = self.run.preset.training.batch_size
        return probabilities(self.run.kind.logits(placed, samples, size, on_progress))

    def margins(
        self, network: Network, samples: Samples, on_progress: Progress = lambda count: None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns predicted and true margins of samples, [k, events] each, in units of the robot's limits.

        Only for estimators that have margins. Both are clipped at the kind's largest margin.
        on_progress: is called with numbers of maps
        Raises InputError when the data set marks a trajectory as known whose margins on its map are unknown.
        """
        maps, place = np.unique(samples[0], return_inverse=True)
        run, count = self.run, len(self.run.actions)
        placed = Placed.from_network(network, self.source, self.devices)
        margins = run.kind.of_maps(placed, maps, count, lambda done: on_progress(done // count))[1]
        largest = run.kind.largest_margin
        assert margins is not None and largest is not None
        simulated = margins_of(self.dataset.heights[maps], run.setup).events()
        true = np.asarray(simulated)[place, samples[1]] / np.asarray(run.robot.limits, np.float32)
        allowed = "known trajectories alone, as its labels say"
        require(bool(np.isfinite(true).all()), "data set, margins", "NaN", allowed)
        return np.minimum(margins[place, samples[1]], largest), np.minimum(true, largest)

    def to_show(self, count: int, group: str | None = None) -> np.ndarray:
        """Picks test maps of one group, or of all, for a figure; maps where only some trajectories fail come first."""
        data = self.dataset
        test = data.maps_of("test")
        test = test if group is None else test[data.group[test] == group]
        failed, known = map(np.asarray, unpacked(data.labels[test], self.run.robot))
        return test[map_batches.samples({"failed": failed, "known": known, "group": data.group[test]}, count)]

    def whole_maps(
        self, estimator: Network, maps: np.ndarray, on_progress: Progress = lambda count: None, every: int = 1
    ) -> np.ndarray:
        """Returns the probabilities of every `every`-th trajectory of maps [k]: [k, t, events]."""
        trajectories = np.arange(0, len(self.run.actions), every)
        samples = (np.repeat(maps, len(trajectories)), np.tile(trajectories, len(maps)))
        return self.probabilities(estimator, samples, on_progress).reshape(len(maps), len(trajectories), -1)

    def every(self, maps: int, samples: int) -> int:
        """Returns the step between the trajectories to show, so that a figure takes no longer than `samples` do.

        It is at most SPARSEST, and coprime to the number of radii, so that all turns and arcs appear. It is 1 for
        estimators that read whole maps at once.
        """
        if self.run.kind.reads_whole_maps:
            return 1
        most = min(SPARSEST, -(-maps * len(self.run.actions) // samples))
        return next(number for number in range(most, 0, -1) if math.gcd(number, len(self.run.actions.radii)) == 1)

    def regression(self, samples: Samples) -> np.ndarray:
        """Returns the probabilities of samples by the baseline's regression, fitted to training maps: [k, events]."""
        config, run, heights = self.run.preset.training, self.run, self.dataset.heights
        maps = self.dataset.maps_of("train")[: max(1, REGRESSION_SAMPLES // config.trajectories_per_map)]
        each, failing = config.trajectories_per_map, config.failing_per_map
        known = balanced_subset(self.dataset.labels, maps, config.seed, each, failing)
        features = [slope_and_step(heights, part, run.actions, run.grid) for part in (known, samples)]
        return LogisticRegression.fit(features[0], self.failed(known)).probabilities(features[1])

    @property
    def paper(self) -> Mapping[str, metrics.Confusion] | None:
        """The paper's confusion matrices; None unless maps are synthetic and robot and action space are the paper's."""
        compares = self.dataset.config and self.run.setup.as_in_paper
        return metrics.PAPER_SYNTHETIC if compares else None

    def scores(self, probability: np.ndarray, samples: Samples, recalls: Sequence[float]) -> metrics.Evaluation:
        """Scores predicted probabilities [k, events], overall and by style or site."""
        groups = self.dataset.group[samples[0]]
        return metrics.evaluate(
            probability,
            self.failed(samples),
            groups,
            events=self.run.robot.event_names,
            recalls=recalls,
            paper=self.paper,
        )
