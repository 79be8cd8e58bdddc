"""Simulators and estimators on the same maps, clean and as sensors see them; labels always come from the clean map.

A method turns maps [n, rows, cols] into failure scores [n, t, k]; a score of 0.5 or more means "fails".
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from travjax.data import sites
from travjax.data.dataset import DatasetConfig
from travjax.data.map_batches import Batch, joined, labelled, synthetic_batches
from travjax.data.provenance import SitesConfig
from travjax.data.sampling import Samples
from travjax.data.sensor_noise import CORRUPTIONS, FILTERS, Maps, filled
from travjax.devices import Devices
from travjax.estimators.inference import Placed, probabilities
from travjax.evaluation.metrics import OVERALL, Confusion, average_precision, confusions
from travjax.runs.predictor import Predictor
from travjax.simulation.events import EVENTS
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup
from travjax.traversal.traverse import margins_of

Fails = Float[np.ndarray, "*m k"]
Progress = Callable[[int], object]


@dataclass(frozen=True)
class BenchmarkMaps:
    """Clean maps and their labels by the simulator.

    heights: [n, rows, cols] metres, none unknown: what was unknown has the height of the nearest known node
    known:   [n, t] whether a trajectory touches only known ground; the others count in no score
    failed:  [n, t, k] for the robot's k events
    margins: [n, t, k] metres or radians, NaN where unknown
    """

    heights: Maps
    known: Bool[np.ndarray, "n t"]
    failed: Bool[np.ndarray, "n t k"]
    margins: Float[np.ndarray, "n t k"]
    setup: Setup

    @staticmethod
    def synthetic(
        count: int,
        seed: int,
        setup: Setup,
        on_progress: Progress = lambda count: None,
    ) -> "BenchmarkMaps":
        """Makes maps of all styles as a data set of that size and seed draws them; on_progress: is told of maps."""
        config, batches = DatasetConfig(count, seed), []
        for batch in synthetic_batches(config.styles().tolist(), config.seeds().tolist(), setup.grid):
            batches.append(labelled(batch, setup))
            on_progress(len(batch["heights"]))
        return BenchmarkMaps._from_batch(joined(batches), setup)

    @staticmethod
    def real(heights: Maps, setup: Setup) -> "BenchmarkMaps":
        """Labels windows of real maps; heights: [n, rows, cols] metres, NaN unknown."""
        return BenchmarkMaps._from_batch(labelled({"heights": heights}, setup), setup)

    @staticmethod
    def _from_batch(maps: Batch, setup: Setup) -> "BenchmarkMaps":
        margins = np.stack([maps[event] for event in setup.robot.event_names], axis=-1)
        heights = filled(maps["heights"])
        return BenchmarkMaps(heights, maps["known"], maps["failed"], margins, setup)

    def seen(self, name: str, seed: int) -> Maps:
        """Returns the maps with one of CORRUPTIONS, the same each time for a seed."""
        rng = np.random.default_rng((seed, list(CORRUPTIONS).index(name)))
        return np.asarray(CORRUPTIONS[name](self.heights, rng), np.float32)

    def simulated(self, maps: Maps) -> Fails:
        """Returns the simulator's verdict on maps: 1 where a trajectory fails, else 0."""
        margins = margins_of(maps, self.setup).events()
        return (np.asarray(margins) > np.asarray(self.setup.robot.limits, np.float32)).astype(np.float32)

    def best_filter(self, maps: Maps, on_progress: Progress = lambda count: None) -> str:
        """Returns the name in FILTERS of the filter that gives the simulator the largest F1 on these corrupted maps."""
        scores = {}
        for name, smooth in FILTERS.items():
            scores[name] = self.scores(self.simulated(smooth(maps)))[OVERALL].f1
            on_progress(1)
        return max(scores, key=lambda name: scores[name])

    def scores(self, fails: Fails, threshold: float = 0.5) -> dict[str, Confusion]:
        """Returns the confusion of each event, and of all pooled, over the known trajectories; fails: [n, t, k]."""
        return scores(fails[self.known], self.failed[self.known], threshold, self.setup.robot.event_names)


def of_sites(
    config: SitesConfig,
    most: int,
    seed: int,
    setup: Setup,
    on_progress: Progress = lambda count: None,
) -> dict[str, BenchmarkMaps]:
    """Returns the windows of each site by name: all that are sufficiently known, or `most` drawn at random.

    config: its splits and turns are ignored; on_progress: is told of windows that were read
    Raises InputError when a file is missing, cannot be read or leaves no window.
    """
    whole = (replace(site, split="test", test_strip=(), validation_strip=()) for site in config.site)
    data = sites.read(replace(config, site=tuple(whole), rotations=False), setup, on_progress)
    grounds = {}
    for number, site in enumerate(config.site):
        own, rng = np.flatnonzero(data.group == site.group), np.random.default_rng((seed, number))
        chosen = np.sort(rng.choice(own, min(most, len(own)), replace=False))
        grounds[site.group] = BenchmarkMaps.real(data.heights[chosen], setup)
    return grounds


def by_margins(margins: Float[np.ndarray, "n t k"], robot: Robot) -> Fails:
    """Converts regressed margins to scores, which are 0.5 at the robot's limits."""
    return np.clip(margins / np.asarray(robot.limits, np.float32) / 2, 0, 1)


def of_samples(predictor: Predictor, maps: Maps, samples: Samples, on_progress: Progress = lambda count: None) -> Fails:
    """Returns an estimator's probabilities for samples [m] of maps: [m, k]; on_progress: is told of samples."""
    devices = Devices.all()
    placed = Placed.from_network(predictor.network, devices.replicate(predictor.run.source(maps)), devices)
    return probabilities(predictor.run.kind.logits(placed, samples, 64 * devices.mesh.size, on_progress))


def scores(
    fails: Fails, failed: Bool[np.ndarray, "*m k"], threshold: float = 0.5, events: Sequence[str] = EVENTS
) -> dict[str, Confusion]:
    """Returns the confusion of each event, given by name, and of all pooled."""
    return confusions(fails.reshape(-1, len(events)), failed.reshape(-1, len(events)), threshold, events)


def average_precisions(
    fails: Fails, failed: Bool[np.ndarray, "*m k"], events: Sequence[str] = EVENTS
) -> dict[str, float]:
    """Returns the average precision of each event, given by name, and of all pooled."""
    columns = {name: (fails[..., event], failed[..., event]) for event, name in enumerate(events)}
    pairs = columns | {OVERALL: (fails, failed)}
    return {name: average_precision(one.ravel(), true.ravel()) for name, (one, true) in pairs.items()}
