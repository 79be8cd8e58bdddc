"""Applies a network to many samples, batch by batch."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from flax import nnx
from jaxtyping import Float

from travjax.config import InputError
from travjax.devices import Devices
from travjax.jax_flags import usual_flags
from travjax.models.variables import Network, Variables, split_model

Progress = Callable[[int], object]


class NoNumbers(InputError):
    """Raised when an estimator returns NaN or infinity: its weights are damaged, or training has diverged."""

    def __init__(self):
        super().__init__("the estimator puts out NaN or infinity; allowed: one whose weights are not damaged")


@dataclass(frozen=True)
class Placed:
    """A network and its source on the devices.

    graph, variables: the network as `split_model` returns it; source: what the estimator's kind makes from maps
    """

    graph: nnx.GraphDef
    variables: Variables
    source: Any
    devices: Devices

    @staticmethod
    def from_network(network: Network, source: Any, devices: Devices) -> "Placed":
        """Puts a network on the devices, where its source already is."""
        graph, variables = split_model(network)
        return Placed(graph, devices.replicate(variables), source, devices)


@usual_flags()
def over_samples(
    function: Callable[..., Float[jax.Array, "b ..."]],
    placed: Placed,
    samples: tuple[np.ndarray, ...],
    batch_size: int = 64,
    on_progress: Progress = lambda count: None,
) -> Float[np.ndarray, "k ..."]:
    """Applies a function of a network to k samples, and returns the results on the host.

    function:    (graph, variables, source, *indices [b]) -> [b, ...], compiled
    samples:     indices [k], one array for each index argument of the function
    on_progress: is told how many samples were added
    Raises NoNumbers when one of the results is NaN or infinite.
    """
    count, devices = len(samples[0]), placed.devices
    results: list[np.ndarray] = []  # a single array, filled batch by batch
    filled = 0
    running: list[tuple[int, jax.Array]] = []

    def collect(most: int) -> None:
        nonlocal filled
        while len(running) > most:
            size, result = running.pop(0)
            batch = devices.fetch(result)
            if not np.isfinite(batch).all():
                raise NoNumbers
            if not results:
                results.append(np.empty((count, *batch.shape[1:]), batch.dtype))
            results[0][filled : filled + size] = batch[:size]
            filled += size
            on_progress(size)

    for start in range(0, count, batch_size):
        batch = tuple(np.resize(index[start : start + batch_size], batch_size) for index in samples)
        result = function(placed.graph, placed.variables, placed.source, *devices.shard(batch))
        running.append((min(batch_size, count - start), result))
        collect(2)  # the device computes while the host fetches
    collect(0)
    return results[0]


@usual_flags()
def probabilities(logits: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Returns the sigmoid of logits."""
    return np.asarray(jax.nn.sigmoid(logits))
