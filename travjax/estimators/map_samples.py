"""The samples of the hazard field: whole maps, with all their trajectories.

Each step takes a few maps, rotated by quarter turns and flipped to one of the views that leave the action space as it
is (footprint.py), some of them corrupted, and the trajectories of a few first arcs of each. Labels are the simulator's
margins on the clean map, so they are exact in every view. All random numbers follow from the training seed and step.
"""

import itertools
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from travjax.config import require
from travjax.data.dataset import Dataset
from travjax.data.sampling import Samples, batches, every_sample
from travjax.data.sensor_noise import corrupted, filled
from travjax.estimators.kind import Batch
from travjax.estimators.preset import Preset
from travjax.jax_flags import usual_flags
from travjax.models.pose_stencil import Stencil, stencil
from travjax.simulation.setup import Setup
from travjax.traversal.traverse import margins_of


@partial(jax.tree_util.register_dataclass, data_fields=["heights", "stencil", "elevation_scale"], meta_fields=[])
@dataclass(frozen=True)
class MapSource:
    """Maps for the hazard field, on the device.

    heights: [n, rows, cols] metres, none unknown; stencil: of all trajectories; elevation_scale: metres that count as 1
    """

    heights: Float[Array, "n rows cols"] | Float[np.ndarray, "n rows cols"]
    stencil: Stencil
    elevation_scale: float | np.float32

    @staticmethod
    def from_maps(heights: np.ndarray, setup: Setup, elevation_scale: float) -> "MapSource":
        """Takes heights [n, rows, cols] in metres; an unknown node gets the height of the nearest known one."""
        return MapSource(filled(heights), stencil(setup), np.float32(elevation_scale))

    def elevation(self, map_index: Int[Array, " b"]) -> Float[Array, "b rows cols"]:
        """Returns the network's input for maps."""
        return relative(self.heights[map_index], self.elevation_scale)


def relative(heights, scale):
    """Returns heights [b, rows, cols] above the height at the centre, in units of `scale`."""
    middle = heights.shape[-1] // 2
    return (heights - heights[:, middle, middle, None, None]) / scale


class MapSamples:
    """The training and validation maps of a data set.

    Raises InputError when there are none of either.
    """

    def __init__(self, dataset: Dataset, preset: Preset):
        self.dataset, self.preset, self.config = dataset, preset, preset.training
        self.maps = dataset.maps_of("train")
        for split, count in (("train", len(self.maps)), ("validation", len(self.validation[0]))):
            require(count > 0, f"data set, {split} split", count, "at least one map with a known trajectory")

    @cached_property
    def validation(self) -> Samples:
        """All known trajectories of as many validation maps as make up `validation_samples`, at least of one map."""
        maps = self.dataset.maps_of("validation")
        count = max(self.config.validation_samples // len(self.dataset.actions), 1)
        return every_sample(self.dataset.labels, maps[:: max(len(maps) // count, 1)][:count])

    def samples(self, phase: int, epoch: int) -> Samples:
        """Returns all known trajectories of the training maps; a step uses some of them."""
        return every_sample(self.dataset.labels, self.maps)

    def failed(self, samples: Samples) -> np.ndarray:
        """Returns the failures of samples: [k, events] float32."""
        return self.dataset.failed(samples).astype(np.float32)

    def count(self, phase: int, epoch: int) -> int:
        """Returns the number of maps of an epoch."""
        return len(self.maps)

    def steps(self, phase: int, epoch: int = 0) -> int:
        """Returns the number of batches of an epoch."""
        return -(-len(self.maps) // self.config.batch_size)

    def batches(self, phase: int, epoch: int, first: int = 0) -> Iterator[Batch]:
        """Yields the batches of an epoch from the first-th on; the next one is prepared while a step runs."""
        ahead = deque[tuple[Future, np.ndarray]]()
        numbered = zip(itertools.count(epoch * self.steps(phase)), *self.chosen(epoch), strict=False)
        with ThreadPoolExecutor(1) as pool:
            for step, maps, weight in itertools.islice(numbered, first, None):
                ahead.append((pool.submit(self.prepared, maps, step), weight))
                if len(ahead) == 2:
                    yield _batch(*ahead.popleft())
            for prepared, weight in ahead:
                yield _batch(prepared, weight)

    def chosen(self, epoch: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the maps and the weights of each step of an epoch: [s, b] each."""
        maps, _, weights = batches((self.maps, self.maps), self.config.batch_size, self.config.seed, epoch)
        return maps, weights

    @usual_flags()  # it runs in a thread of its own
    def prepared(self, maps: np.ndarray, step: int):
        """Prepares inputs and targets of a step, counted over the whole training, on maps [b]."""
        data, preset, rng = self.dataset, self.preset, np.random.default_rng((self.config.seed, step))
        views = data.setup.views
        view = views[rng.integers(len(views))]
        heights = np.ascontiguousarray(np.rot90(data.heights[maps], int(rng.integers(4)), axes=(1, 2)))
        margins = margins_of(heights, data.setup)
        table = stencil(data.setup)
        arcs = self._arcs(table, rng)
        trajectories = (arcs[:, None] * table.second_arcs + np.arange(table.second_arcs)).ravel()
        targets = _targets(margins.events(), view.trajectories(data.actions)[trajectories], data.robot.limits)
        seen = np.flip(heights, tuple(axis + 1 for axis in view.flipped))
        seen = corrupted(filled(seen), preset.corruption, rng)
        part = Stencil(table.nodes[arcs], table.first_poses, table.second_arcs)
        return (relative(seen, np.float32(preset.elevation_scale)), part), targets

    def _arcs(self, table: Stencil, rng: np.random.Generator) -> np.ndarray:
        """Draws the first arcs whose trajectories a step sees."""
        count = min(max(self.config.trajectories_per_map // table.second_arcs, 1), len(table.nodes))
        return np.sort(rng.choice(len(table.nodes), count, replace=False))

    def summary(self) -> str:
        """Says in one line what is trained on."""
        return f"{len(self.maps)} training maps; {len(self.validation[0])} validation samples"


def _batch(prepared: Future, weight: np.ndarray) -> Batch:
    """Waits for the data of a step."""
    inputs, targets = prepared.result()
    return Batch(inputs, targets, weight)


@partial(jax.jit, static_argnames="limits")
def _targets(margins, trajectories, limits):
    """Returns margins of trajectories in units of the limits, and whether they are known."""
    chosen = margins[:, trajectories] / jnp.asarray(limits, jnp.float32)
    known = ~jnp.isnan(chosen[..., 0])
    return jnp.where(known[..., None], chosen, 0), known
