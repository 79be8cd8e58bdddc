"""The interface of estimators to training, evaluation and prediction; each estimator has a class that implements it.

The class defines the phases of training, makes the network, its source (the arrays that are put on the devices once)
and its training data, and computes logits. Networks are split into `trunk` and `heads` (models/variables.py).
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from flax import nnx
from jaxtyping import Array, Float, Key

from travjax.data.dataset import Dataset
from travjax.data.sampling import Samples
from travjax.devices import Devices, PyTree
from travjax.estimators.inference import Placed, Progress
from travjax.estimators.preset import Preset
from travjax.models.variables import Network, Variables
from travjax.resnet.imagenet_weights import Weights
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup

AT_ONCE = 64
"""Samples in a batch on each device when all trajectories of maps are asked for."""


class Batch(NamedTuple):
    """The data of one training step.

    inputs, targets: arguments of the phase's loss; weight: [b], 0 for a sample that only pads the batch
    """

    inputs: PyTree
    targets: PyTree
    weight: Float[np.ndarray, " b"] | Float[Array, " b"]


class TrainingData(Protocol):
    """The samples that a run is trained and validated on, on the host."""

    dataset: Dataset

    @property
    def validation(self) -> Samples:
        """The samples that each epoch is scored on."""

    def samples(self, phase: int, epoch: int) -> Samples:
        """Returns the training samples of an epoch."""

    def failed(self, samples: Samples) -> Float[np.ndarray, "k e"]:
        """Returns the failures of samples."""

    def count(self, phase: int, epoch: int) -> int:
        """Counts the samples of an epoch: the sum of its batches' weights."""

    def steps(self, phase: int, epoch: int = 0) -> int:
        """Counts the batches of an epoch."""

    def batches(self, phase: int, epoch: int, first: int = 0) -> Iterator[Batch]:
        """Yields the batches of an epoch from the first-th on."""

    def summary(self) -> str:
        """Describes the training data in a few words."""


@dataclass(frozen=True)
class FrozenTrunk:
    """How a phase uses a frozen trunk: the features of all samples are computed once.

    features: function that returns the features of k samples, [k, f]; its arguments are those of `EstimatorKind.logits`
    logits:   function from features to logits, (graph, variables, features [b, f]) -> [b, 3]
    """

    features: Callable[[Placed, Samples, int, Progress], Float[np.ndarray, "k f"]]
    logits: Callable[[nnx.GraphDef, Variables, Float[Array, "b f"]], Float[Array, "b e"]]


def beside_source(source: PyTree, inputs: tuple, devices: Devices) -> tuple:
    """Puts the inputs of a step [b, ...] on the devices, a part on each, and returns them after the estimator's
    source.
    """
    return (source, *devices.shard(inputs))


@dataclass(frozen=True)
class Phase:
    """Defines the steps of a phase; hashable, because compiled code depends on it.

    trained:      parts of the network that are trained, out of "trunk" and "heads"
    loss:         loss of each sample of a batch, (network, inputs, targets, key) -> [b]; the key is for dropout
    place:        puts inputs on the devices, (source, inputs, devices) -> inputs as `loss` takes them
    frozen_trunk: if there is one, the inputs of a batch are places [b] in the phase's samples, and `loss` takes the
                  features of these samples [b, f]
    """

    trained: tuple[str, ...]
    loss: Callable[[Any, PyTree, PyTree, Key[Array, ""]], Float[Array, " b"]]
    place: Callable[[PyTree, Any, Devices], PyTree] = beside_source
    frozen_trunk: FrozenTrunk | None = None


class EstimatorKind(Protocol):
    """An estimator; a subclass needs an entry in names.py.

    phases:           phases by number: 1 lasts the preset's head_epochs and may be missing; 2 lasts its epochs
    title:            its name in messages
    largest_margin:   in units of the robot's limits; margins above it are not told apart; None without margins
    reads_whole_maps: whether all trajectories of a map take no longer than one
    sees_images:      whether it is trained on images of map and trajectory, of which a run draws a few (inputs.png)
    """

    phases: Mapping[int, Phase]
    title: str = "the estimator"
    largest_margin: float | None = None
    reads_whole_maps: bool = False
    sees_images: bool = False

    def create(self, preset: Preset, robot: Robot, seed: int = 0, weights: Weights | None = None) -> Network:
        """Makes the network with random parameters, or with a trunk of `weights`.

        Raises InputError for weights that are not for it.
        """

    def source(
        self,
        preset: Preset,
        heights: Float[np.ndarray, "n rows cols"],
        setup: Setup,
        on_progress: Progress = lambda count: None,
    ) -> PyTree:
        """Returns the arrays to put on the devices for maps, NaN unknown; on_progress: is told of trajectories."""

    def data(self, preset: Preset, dataset: Dataset) -> TrainingData:
        """Returns the samples of a data set that are trained and validated on.

        Raises InputError when there are no training or no validation samples.
        """

    def logits(
        self, placed: Placed, samples: Samples, batch_size: int, on_progress: Progress = lambda count: None
    ) -> Float[np.ndarray, "k e"]:
        """Returns the logits of k samples, `batch_size` at a time; on_progress: is told of samples.

        Raises NoNumbers when one of them is NaN or infinite.
        """

    def of_maps(
        self, placed: Placed, maps: np.ndarray, trajectories: int, on_progress: Progress = lambda count: None
    ) -> tuple[Float[np.ndarray, "m t e"], Float[np.ndarray, "m t e"] | None]:
        """Returns the logits of all trajectories of maps and, if it has them, margins in units of the robot's limits.

        on_progress: is told of samples. Raises as `logits` does.
        """
        samples = (np.repeat(maps, trajectories), np.tile(np.arange(trajectories), len(maps)))
        size = AT_ONCE * placed.devices.mesh.size
        return self.logits(placed, samples, size, on_progress).reshape(len(maps), trajectories, -1), None
