"""Measures the network: its inputs, a training step beside PyTorch's, and all trajectories of a map, in one run.

Times are medians of repeated calls of compiled code. The PyTorch network is the same one in its fastest form on a CPU,
channels-last; it is measured where PyTorch is installed.
"""

import resource
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np

from travjax import progress
from travjax.data.dataset import DatasetConfig, generate
from travjax.data.sampling import Sampler, batches
from travjax.devices import Devices
from travjax.estimators.inference import Placed, over_samples
from travjax.estimators.kind import Batch
from travjax.estimators.preset import TrainingConfig
from travjax.estimators.trajectory_estimator import TrajectoryEstimator, sample_logits
from travjax.evaluation import simulator_benchmark
from travjax.files import output_folder
from travjax.models.input_images import ImageSource
from travjax.models.trajectory_resnet import create
from travjax.models.variables import VARIABLES, split_model
from travjax.resnet.network import ResNetConfig
from travjax.simulation.events import EVENTS
from travjax.simulation.grid import Grid
from travjax.simulation.setup import Setup
from travjax.training.step import StepSettings, update
from travjax.traversal.traverse import unpacked

COLUMNS = {
    "what": "what",
    "batch": "batch",
    "ms": "ms",
    "ms_per_sample": "ms a sample",
    "samples_per_s": "samples/s",
    "ratio": "x PyTorch",
    "first_call_s": "first call s (compiles)",
    "repeats": "repeats",
    "peak_mib": "peak memory so far MiB",
}

BATCH = 64
STEP_BATCH = 32
MAPS = 64
FLAX, TORCH = "training step, Flax", "training step, PyTorch"


class Bench:
    """A small data set on the devices and an estimator with random weights, a ResNet50 unless another trunk is
    given.
    """

    def __init__(self, setup: Setup, repeats: int, trunk: ResNetConfig = ResNetConfig()):
        self.repeats, self.devices = repeats, Devices.all()
        self.dataset = generate(DatasetConfig(MAPS), setup)
        self.source = self.devices.replicate(ImageSource.from_maps(self.dataset.heights, setup, 1.0))
        self.graph, self.variables = split_model(create(trunk, events=setup.robot.event_names))
        self.sampler = Sampler(self.dataset.labels, np.arange(MAPS), fresh=True)

    def rows(self) -> Iterator[dict]:
        """Yields one row for each measurement."""
        yield self.inputs()
        yield self.training_step()
        try:
            import torch  # noqa: F401
        except ImportError:
            pass
        else:
            yield self.torch_step()
        yield self.all_trajectories()

    def inputs(self) -> dict:
        """Measures making a batch, from drawing its samples to the images and labels on the device."""
        epochs = iter(range(10**9))

        def batch():
            chosen = batches(self.sampler.epoch(next(epochs)), BATCH, 0, 0)
            samples = self.devices.shard((chosen[0][0], chosen[1][0]))
            return self.source.images(*samples), unpacked(
                self.dataset.labels[chosen[0][0], chosen[1][0]], self.dataset.robot
            )[0]

        return self._timed("inputs of a batch, a fresh subset of 64 maps included", BATCH, batch)

    def training_step(self, size: int = STEP_BATCH) -> dict:
        """Measures a training step of the whole network on `size` samples, from sample indices to new parameters."""
        phase, optimizer = TrajectoryEstimator.phases[2], TrainingConfig().make_optimizer(2, 1)
        settings = StepSettings(self.graph, phase, optimizer, penalty=0.001)
        trained = {name: self.variables[name] for name in phase.trained}
        state = jax.tree.map(jax.numpy.copy, self.variables) | {"optimizer": optimizer.init(trained)}
        state = self.devices.replicate(state)
        maps, trajectories = (np.resize(index, size) for index in self.sampler.epoch(0))
        failed = self.dataset.failed((maps, trajectories)).astype(np.float32)
        inputs = phase.place(self.source, (maps, trajectories), self.devices)
        batch = Batch(inputs, *self.devices.shard((failed, np.ones(size, np.float32))))

        def step():
            nonlocal state
            state, loss = update(state, batch, 0, 0, settings=settings)
            return loss

        return self._timed(FLAX, size, step)

    def torch_step(self) -> dict:
        """Measures the same step in PyTorch on ready images: network, loss, gradients, RMSprop."""
        return self._timed(TORCH, STEP_BATCH, _torch_training(self.dataset.grid))

    def all_trajectories(self, batch: int = BATCH, repeats: int = 1) -> dict:
        """Measures the network on all trajectories of one map, `batch` at a time."""
        count = len(self.dataset.actions)
        samples = (np.zeros(count, np.int32), np.arange(count, dtype=np.int32))
        variables = self.devices.replicate({name: self.variables[name] for name in VARIABLES})
        placed = Placed(self.graph, variables, self.source, self.devices)
        run = lambda: over_samples(sample_logits, placed, samples, batch)
        return self._timed(f"all {count} trajectories of a map through the network", count, run, repeats)

    def _timed(self, what: str, batch: int, run: Callable[[], object], repeats: int | None = None) -> dict:
        median, first = simulator_benchmark.median_time(run, repeats or self.repeats)
        return {
            "what": what,
            "batch": batch,
            "ms": median * 1e3,
            "ms_per_sample": median / batch * 1e3,
            "samples_per_s": batch / median,
            "ratio": None,
            "first_call_s": first,
            "repeats": repeats or self.repeats,
            "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }


def measure(setup: Setup, out: str | Path, repeats: int = 15) -> None:
    """Measures inputs, a training step and all trajectories of a map; prints the table and writes it as TSV.

    repeats: number of timed calls; the median is reported
    Raises InputError when nothing can be written to `out`.
    """
    folder = output_folder(out)
    rows = list(progress.bar("network", 4, "row", iterable=Bench(setup, repeats).rows()))
    simulator_benchmark.write_rows(with_ratio(rows), COLUMNS, folder / "network.tsv")


def with_ratio(rows: list[dict]) -> list[dict]:
    """Returns the rows with the Flax step's time as a multiple of PyTorch's, if that was measured."""
    ms = {row["what"]: row["ms"] for row in rows}
    ratio = ms[FLAX] / ms[TORCH] if TORCH in ms else None
    return [row | {"ratio": ratio if row["what"] == FLAX else None} for row in rows]


def torch_estimator():
    """Makes the estimator in PyTorch: (trunk, heads), for images in channels-last form."""
    import torch
    from torch import nn

    def unit(inputs: int, outputs: int, size: int, stride: int = 1) -> nn.Sequential:
        convolution = nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False)
        return nn.Sequential(convolution, nn.BatchNorm2d(outputs, momentum=0.01))

    class Bottleneck(nn.Module):
        def __init__(self, inputs: int, inner: int, stride: int, first: bool):
            super().__init__()
            relu = nn.ReLU(inplace=True)
            self.main = nn.Sequential(
                unit(inputs, inner, 1, stride), relu, unit(inner, inner, 3), relu, unit(inner, 4 * inner, 1)
            )
            self.shortcut = unit(inputs, 4 * inner, 1, stride) if first else nn.Identity()

        def forward(self, x):
            return torch.relu_(self.main(x) + self.shortcut(x))

    def trunk() -> nn.Sequential:
        layers: list[nn.Module] = [unit(3, 64, 7, 2), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2, 1)]
        channels = 64
        for stage, blocks in enumerate((3, 4, 6, 3)):
            for block in range(blocks):
                first, inner = block == 0, 64 * 2**stage
                layers.append(Bottleneck(channels, inner, 2 if first and stage else 1, first))
                channels = 4 * inner
        return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten())

    head = lambda: nn.Sequential(nn.Linear(2048, 512), nn.ReLU(inplace=True), nn.Dropout(0.2), nn.Linear(512, 1))
    return trunk().to(memory_format=torch.channels_last), nn.ModuleList(head() for _ in EVENTS)


def _torch_training(grid: Grid) -> Callable[[], object]:
    """Returns a function that takes a training step of the PyTorch estimator on a fixed batch of random images."""
    import torch
    from torch import nn

    body, heads = torch_estimator()
    parameters = [*body.parameters(), *heads.parameters()]
    optimizer = torch.optim.RMSprop(parameters, lr=1e-4, alpha=0.9, eps=1e-7)
    images = torch.rand(STEP_BATCH, 3, *grid.shape).to(memory_format=torch.channels_last)
    failed = (torch.rand(STEP_BATCH, len(EVENTS)) > 0.7).float()
    kernels = [layer.weight for one in heads for layer in one if isinstance(layer, nn.Linear)]

    def step() -> float:
        optimizer.zero_grad()
        features = body(images)
        logits = torch.cat([one(features) for one in heads], dim=1)
        entropy = nn.functional.binary_cross_entropy_with_logits(logits, failed, reduction="sum") / STEP_BATCH
        (entropy + 0.001 * sum((kernel**2).sum() for kernel in kernels)).backward()
        optimizer.step()
        return float(entropy.detach())

    return step
