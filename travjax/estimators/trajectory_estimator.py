"""The estimator of one trajectory at a time ("resnet50"): a ResNet on images of map and trajectory (SPEC section 9).

It is trained in two phases: the heads on the features of the frozen trunk, then everything.
"""

from functools import partial

import jax
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Float, Int, Key

from travjax.data.dataset import Dataset
from travjax.data.sampling import Samples
from travjax.estimators.inference import Placed, Progress, over_samples
from travjax.estimators.kind import EstimatorKind, FrozenTrunk, Phase
from travjax.estimators.preset import Preset
from travjax.estimators.trajectory_samples import TrajectorySamples
from travjax.models.input_images import ImageSource
from travjax.models.trajectory_resnet import Estimator, create
from travjax.models.variables import Variables, merge_model
from travjax.resnet.imagenet_weights import Weights
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup


def _loss(network: Estimator, inputs, failed: Float[Array, "b e"], key: Key[Array, ""]) -> Float[Array, " b"]:
    """Returns the cross-entropy summed over the events; inputs: the source, and maps and trajectories [b]."""
    source, map_index, trajectory_index = inputs
    return _entropy(network(source.images(map_index, trajectory_index), train=True, key=key), failed)


def _loss_of_heads(
    network: Estimator, features: Float[Array, "b f"], failed: Float[Array, "b e"], key: Key[Array, ""]
) -> Float[Array, " b"]:
    """Returns the same loss for the heads alone, on the trunk's features."""
    return _entropy(network.heads(features, key), failed)


def _entropy(logits: Float[Array, "b e"], failed: Float[Array, "b e"]) -> Float[Array, " b"]:
    return optax.sigmoid_binary_cross_entropy(logits, failed).sum(axis=-1)


@partial(jax.jit, static_argnames="graph")
def sample_logits(
    graph: nnx.GraphDef,
    variables: Variables,
    source: ImageSource,
    map_index: Int[Array, " b"],
    trajectory_index: Int[Array, " b"],
) -> Float[Array, "b e"]:
    """Returns the logits of samples."""
    return merge_model(graph, variables)(source.images(map_index, trajectory_index))


@partial(jax.jit, static_argnames="graph")
def sample_features(
    graph: nnx.GraphDef,
    variables: Variables,
    source: ImageSource,
    map_index: Int[Array, " b"],
    trajectory_index: Int[Array, " b"],
) -> Float[Array, "b f"]:
    """Returns the trunk's features of samples."""
    return merge_model(graph, variables).trunk(source.images(map_index, trajectory_index))[0]


@partial(jax.jit, static_argnames="graph")
def feature_logits(graph: nnx.GraphDef, variables: Variables, features: Float[Array, "b f"]) -> Float[Array, "b e"]:
    """Returns the logits for the trunk's features."""
    return merge_model(graph, variables).heads(features)


def features_of(
    placed: Placed, samples: Samples, batch_size: int, on_progress: Progress = lambda count: None
) -> Float[np.ndarray, "k f"]:
    """Returns the trunk's features of k samples; the arguments are those of `EstimatorKind.logits`."""
    return over_samples(sample_features, placed, samples, batch_size, on_progress)


class TrajectoryEstimator(EstimatorKind):
    """The trajectory ResNet."""

    phases = {
        1: Phase(("heads",), _loss_of_heads, frozen_trunk=FrozenTrunk(features_of, feature_logits)),
        2: Phase(("trunk", "heads"), _loss),
    }
    sees_images = True

    def create(self, preset: Preset, robot: Robot, seed: int = 0, weights: Weights | None = None) -> Estimator:
        """Makes the network; raises InputError for weights of another trunk."""
        return create(preset.trunk, preset.heads, seed, weights, robot.event_names)

    def source(
        self,
        preset: Preset,
        heights: Float[np.ndarray, "n rows cols"],
        setup: Setup,
        on_progress: Progress = lambda count: None,
    ) -> ImageSource:
        """Returns the maps and the drawn channels of all trajectories."""
        return ImageSource.from_maps(heights, setup, preset.elevation_scale, on_progress)

    def data(self, preset: Preset, dataset: Dataset) -> TrajectorySamples:
        """Returns balanced subsets of trajectories."""
        return TrajectorySamples(dataset, preset.training)

    def logits(
        self, placed: Placed, samples: Samples, batch_size: int, on_progress: Progress = lambda count: None
    ) -> Float[np.ndarray, "k e"]:
        """Returns the logits of samples, one image each."""
        return over_samples(sample_logits, placed, samples, batch_size, on_progress)
