"""The estimator of all trajectories of a map at once ("field"): the hazard field, trained on whole maps.

It has one phase, in which everything is trained, and returns margins as well as logits.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Float, Int, Key

from travjax.config import require
from travjax.data.dataset import Dataset
from travjax.data.sampling import Samples
from travjax.devices import Devices
from travjax.estimators.inference import Placed, Progress, over_samples
from travjax.estimators.kind import EstimatorKind, Phase
from travjax.estimators.map_samples import MapSamples, MapSource
from travjax.estimators.preset import Preset
from travjax.models.hazard_field import LARGE_MARGIN, HazardField, create
from travjax.models.variables import Variables, merge_model
from travjax.resnet.imagenet_weights import Weights
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup

SMALL_ERROR = 0.3
"""Error of a margin, in limits, up to which it counts by its square."""

MAPS = 4
"""Maps whose hazard fields a device reads at once; a map takes some 100 MB."""


def _loss(network: HazardField, inputs, targets, key: Key[Array, ""]) -> Float[Array, " b"]:
    """Returns the mean loss over the known trajectories of each map.

    inputs:  elevation [b, rows, cols] and the stencil of t trajectories
    targets: margins [b, t, e] in units of the limits, known [b, t]
    """
    (elevation, stencil), (margins, known) = inputs, targets
    logits, predicted = network(elevation, stencil, train=True)
    off = optax.huber_loss(predicted, jnp.minimum(margins, LARGE_MARGIN), delta=SMALL_ERROR).sum(axis=-1)
    entropy = optax.sigmoid_binary_cross_entropy(logits, margins > 1).sum(axis=-1)
    loss = entropy + network.trunk.config.margin_weight * off
    return (loss * known).sum(axis=-1) / jnp.maximum(known.sum(axis=-1), 1)


def _place(source: MapSource, inputs, devices: Devices):
    """Puts a part of the maps on each device and the stencil on all; a step has its own maps, not the source's."""
    elevation, stencil = inputs
    return devices.shard(elevation), devices.replicate(stencil)


@partial(jax.jit, static_argnames="graph")
def map_hazards(
    graph: nnx.GraphDef, variables: Variables, source: MapSource, map_index: Int[Array, " b"]
) -> Float[Array, "b t h"]:
    """Returns logits, then margins in units of the limits, of all trajectories of maps."""
    return jnp.concatenate(merge_model(graph, variables)(source.elevation(map_index), source.stencil), axis=-1)


def hazards(placed: Placed, maps: np.ndarray, on_progress: Progress = lambda count: None) -> Float[np.ndarray, "m t h"]:
    """Returns `map_hazards` of maps [m], on the host; on_progress: is told of maps."""
    count = placed.devices.mesh.size
    size = min(MAPS, -(-len(maps) // count)) * count  # so that a single map is not computed four times
    return over_samples(map_hazards, placed, (maps,), size, on_progress)


class MapEstimator(EstimatorKind):
    """The hazard field."""

    phases = {2: Phase(("trunk", "heads"), _loss, _place)}
    title = "the hazard field"
    largest_margin = LARGE_MARGIN
    reads_whole_maps = True

    def create(self, preset: Preset, robot: Robot, seed: int = 0, weights: Weights | None = None) -> HazardField:
        """Makes the network with random parameters; raises InputError if weights are given."""
        require(weights is None, "weights", preset.weights, '"none": the hazard field begins with random ones')
        return create(preset.field, seed, len(robot.events))

    def source(
        self,
        preset: Preset,
        heights: Float[np.ndarray, "n rows cols"],
        setup: Setup,
        on_progress: Progress = lambda count: None,
    ) -> MapSource:
        """Returns the maps and the stencil of all trajectories."""
        return MapSource.from_maps(heights, setup, preset.elevation_scale)

    def data(self, preset: Preset, dataset: Dataset) -> MapSamples:
        """Returns the samples of whole maps."""
        return MapSamples(dataset, preset)

    def logits(
        self, placed: Placed, samples: Samples, batch_size: int, on_progress: Progress = lambda count: None
    ) -> Float[np.ndarray, "k e"]:
        """Returns the logits of samples, from the hazard field of each of their maps, whatever the batch size."""
        maps, place = np.unique(samples[0], return_inverse=True)
        each = len(place) // len(maps)
        added = hazards(placed, maps, lambda count: on_progress(count * each))
        return added[place, samples[1], : added.shape[-1] // 2]

    def of_maps(
        self, placed: Placed, maps: np.ndarray, trajectories: int, on_progress: Progress = lambda count: None
    ) -> tuple[Float[np.ndarray, "m t e"], Float[np.ndarray, "m t e"]]:
        """Returns logits and margins in units of the robot's limits of all trajectories of maps."""
        logits, margins = np.split(hazards(placed, maps, lambda count: on_progress(count * trajectories)), 2, axis=-1)
        return logits, margins
