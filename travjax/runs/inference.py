"""The network on many samples, a batch after the other."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from travjax.config import InputError
from travjax.data.sampling import Samples
from travjax.devices import Devices
from travjax.jax_flags import usual_flags
from travjax.models.input_images import ImageSource
from travjax.models.trajectory_resnet import merge_model
from travjax.runs.map_samples import MapSource

Variables = dict[str, nnx.State]

MAPS = 4
"""Maps whose hazard fields a device reads at once; a map takes some 100 MB."""


class NoNumbers(InputError):
    """An estimator that puts out NaN or infinity: its weights are damaged, or training has diverged."""

    def __init__(self):
        super().__init__("the estimator puts out NaN or infinity; allowed: one whose weights are not damaged")


@partial(jax.jit, static_argnames="graph")
def sample_logits(graph, variables: Variables, source: ImageSource, map_index, trajectory_index):
    """Logits of samples [b]: [b, events]."""
    return merge_model(graph, variables)(source.images(map_index, trajectory_index))


@partial(jax.jit, static_argnames="graph")
def sample_features(graph, variables: Variables, source: ImageSource, map_index, trajectory_index):
    """The trunk's features of samples [b]: [b, features]."""
    return merge_model(graph, variables).trunk(source.images(map_index, trajectory_index))[0]


@partial(jax.jit, static_argnames="graph")
def feature_logits(graph, variables: Variables, features: Float[Array, "b f"]):
    """Logits of features of the trunk: [b, events]."""
    return merge_model(graph, variables).heads(features)


@usual_flags()
def over_samples(
    function: Callable[..., Float[Array, "b f"]],
    graph: nnx.GraphDef,
    variables: Variables,
    source: ImageSource | MapSource,
    samples: tuple[np.ndarray, ...],
    devices: Devices,
    batch_size: int = 64,
    on_progress: Callable[[int], object] = lambda count: None,
) -> Float[np.ndarray, "k f"]:
    """`sample_logits` or `sample_features` of k samples, or `map_hazards` of k maps, on the host.

    on_progress: is told how many samples were added
    Raises NoNumbers when one of the results is NaN or infinite.
    """
    count = len(samples[0])
    results: list[np.ndarray] = []  # one array, filled batch by batch
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
        running.append((min(batch_size, count - start), function(graph, variables, source, *devices.shard(batch))))
        collect(2)  # the device works while the host fetches
    collect(0)
    return results[0]


@partial(jax.jit, static_argnames="graph")
def map_hazards(graph, variables: Variables, source: MapSource, map_index):
    """Logits, then margins in units of the limits, of all trajectories of maps [b]: [b, t, 2 events]."""
    return jnp.concatenate(merge_model(graph, variables)(source.elevation(map_index), source.stencil), axis=-1)


def logits_of(
    graph: nnx.GraphDef,
    variables: Variables,
    source: ImageSource | MapSource,
    samples: Samples,
    devices: Devices,
    batch_size: int = 64,
    on_progress: Callable[[int], object] = lambda count: None,
) -> Float[np.ndarray, "k events"]:
    """Logits of k samples: one by one, or from the hazard field of each of their maps.

    batch_size: samples at once; on_progress: is told how many samples were added
    """
    if isinstance(source, ImageSource):
        return over_samples(sample_logits, graph, variables, source, samples, devices, batch_size, on_progress)
    maps, place = np.unique(samples[0], return_inverse=True)
    each = len(place) // len(maps)
    added = hazards(graph, variables, source, maps, devices, lambda count: on_progress(count * each))
    return added[place, samples[1], : added.shape[-1] // 2]


def features_of(
    graph: nnx.GraphDef,
    variables: Variables,
    source: ImageSource,
    samples: Samples,
    devices: Devices,
    batch_size: int = 64,
    on_progress: Callable[[int], object] = lambda count: None,
) -> Float[np.ndarray, "k f"]:
    """The trunk's features of k samples; arguments of `logits_of`."""
    return over_samples(sample_features, graph, variables, source, samples, devices, batch_size, on_progress)


def hazards(
    graph: nnx.GraphDef,
    variables: Variables,
    source: MapSource,
    maps: np.ndarray,
    devices: Devices,
    on_progress: Callable[[int], object] = lambda count: None,
) -> Float[np.ndarray, "m t hazards"]:
    """`map_hazards` of maps [m], on the host."""
    count = devices.mesh.size
    size = min(MAPS, -(-len(maps) // count)) * count  # a single map is not read four times
    return over_samples(map_hazards, graph, variables, source, (maps,), devices, size, on_progress)


@usual_flags()
def probabilities(logits: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """The sigmoid of logits."""
    return np.asarray(jax.nn.sigmoid(logits))
