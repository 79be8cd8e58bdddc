"""Devices that share the work: one, several of a host, or those of several processes, with the same code.

A batch is cut into equal parts along its first axis, one for each device; everything else is replicated. Under `jit`
nothing more is needed for data-parallel training: XLA adds the sums over devices, including batch statistics.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from travjax.config import InputError, require

PyTree = Any


@dataclass(frozen=True)
class Devices:
    """All devices of all processes.

    mesh: one axis, "batch"
    """

    mesh: Mesh

    @staticmethod
    def all() -> "Devices":
        """Returns the devices that JAX sees; after `join`, those of all processes."""
        return Devices(jax.make_mesh((jax.device_count(),), ("batch",), axis_types=(AxisType.Auto,)))

    @property
    def main(self) -> bool:
        """Whether this process is the one that writes files and prints."""
        return jax.process_index() == 0

    @cached_property
    def everywhere(self) -> NamedSharding:
        """The sharding that puts the whole array on each device."""
        return NamedSharding(self.mesh, PartitionSpec())

    @cached_property
    def _in_parts(self) -> NamedSharding:
        return NamedSharding(self.mesh, PartitionSpec("batch"))

    def replicate(self, tree: PyTree) -> PyTree:
        """Puts arrays, the same in each process, on all devices."""
        return jax.tree.map(lambda array: _placed(array, self.everywhere), tree)

    def shard(self, tree: PyTree) -> PyTree:
        """Splits arrays [b, ...], the same in each process, and puts a part on each device."""
        return jax.tree.map(lambda array: _placed(array, self._in_parts), tree)

    def fetch(self, array: jax.Array) -> np.ndarray:
        """Returns a whole array, in each process."""
        if array.is_fully_addressable:
            return np.asarray(array)
        return np.asarray(multihost_utils.process_allgather(array, tiled=True))

    def wait(self) -> None:
        """Waits until all processes have reached this call."""
        if jax.process_count() > 1:
            multihost_utils.sync_global_devices("travjax")

    def check_batch(self, size: int) -> None:
        """Raises InputError unless a batch can be cut into equal parts."""
        count = self.mesh.size
        require(size % count == 0, "batch_size", size, f"a multiple of the {count} devices that share a batch")


def _placed(array, sharding: NamedSharding) -> jax.Array:
    if jax.process_count() == 1:
        return jax.device_put(array, sharding)
    host = np.asarray(array)
    return jax.make_array_from_callback(host.shape, sharding, lambda part: host[part])


def join(coordinator: str, processes: int, process: int) -> None:
    """Joins the processes of a run; to be called before JAX is used in any other way.

    coordinator: address:port of process 0; processes: how many there are; process: which of them this is, from 0
    Raises InputError for invalid arguments. When the processes do not find each other, JAX ends them.
    """
    whole = lambda value: isinstance(value, int) and not isinstance(value, bool)
    require(whole(processes) and processes >= 1, "--processes", processes, "at least 1")
    require(whole(process) and 0 <= process < processes, "--process", process, f"from 0 to {processes - 1}")
    host, _, port = coordinator.rpartition(":")
    named = bool(host) and port.isdecimal() and 0 < int(port) < 65536
    require(named, "--coordinator", coordinator, "address:port of process 0")
    try:
        jax.distributed.initialize(coordinator, processes, process)
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"--coordinator {coordinator}: {reason}; allowed: address:port of process 0") from None
