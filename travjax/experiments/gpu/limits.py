"""The limits of a GPU, and how much of them a piece of work uses.

A piece of work moves bytes to and from the memory of the device, and takes operations of arithmetic. It lasts no less
than

    limit = max(bytes / bandwidth, sum of operations / peak)

and its share of the limit is limit / measured time. `bytes` counts what cannot be spared: each input read once, each
result written once. Reads that caches answer are not among them. A peak belongs to a type of numbers: XLA multiplies
float32 matrices in tf32 on these devices, and does all other float32 arithmetic outside the tensor cores.
"""

from collections.abc import Mapping
from dataclasses import dataclass

FORMULA = "share of the limit = max(bytes / bandwidth, operations / peak) / measured time"


@dataclass(frozen=True)
class Device:
    """What a data sheet promises.

    bandwidth: bytes/s of the memory; peaks: operations/s by the type of numbers, without sparsity
    """

    bandwidth: float
    peaks: dict[str, float]


_HOPPER = {"float32": 67e12, "tf32": 494.5e12, "bfloat16": 989e12}

DEVICES = {
    "NVIDIA H100 80GB HBM3": Device(3.35e12, _HOPPER),
    "NVIDIA H200": Device(4.8e12, _HOPPER),
}
"""Devices by the name that JAX gives them. Sources: NVIDIA's data sheets of the H100 (SXM) and the H200 Tensor Core
GPU; their figures for tensor cores, 989 TFLOP/s in tf32 and 1,979 in bfloat16, are those with sparsity, twice these."""


@dataclass(frozen=True)
class Work:
    """What a piece of work moves and computes at least.

    operations: by the type of numbers, a key of `Device.peaks`
    """

    bytes: float
    operations: Mapping[str, float]

    def divided(self, count: int) -> "Work":
        """Returns the work of one of `count`."""
        return Work(self.bytes / count, {numbers: each / count for numbers, each in self.operations.items()})

    def limit(self, device: Device) -> tuple[float, str]:
        """Returns the least seconds on a device, and what sets them: "memory" or "arithmetic"."""
        moving = self.bytes / device.bandwidth
        computing = sum(count / device.peaks[numbers] for numbers, count in self.operations.items())
        return (moving, "memory") if moving > computing else (computing, "arithmetic")
