"""`python -m travjax.experiments.timing`: how long all trajectories of a map take, by simulator and by network.

The sequential simulator, the batched one and the network on the device at hand, in one run, beside what the paper took.
The recorded runs are under experiments/timing.
"""

import argparse
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax

from travjax import options, progress
from travjax.config import require
from travjax.devices import Devices
from travjax.estimators.names import RESNET
from travjax.estimators.preset import Preset
from travjax.evaluation import map_figures, simulator_benchmark
from travjax.evaluation.tables import rows_table
from travjax.experiments import launch
from travjax.files import atomic_write, find_preset, output_folder
from travjax.resnet.network import ResNetConfig
from travjax.simulation.actions import ActionSpace
from travjax.simulation.setup import Setup
from travjax.training.network_benchmark import BATCH, Bench

COLUMNS = {
    "what": "what",
    "device": "device",
    "seconds": "s a map",
    "trajectories_per_s": "trajectories/s",
    "speed_up": "x sequential",
    "repeats": "repeats",
}

TOGETHER = 32
"""Maps at once, where several are simulated together."""

SEQUENTIAL, NETWORK = "sequential simulator", "network"
PAPER = {f"paper: {SEQUENTIAL}": ("Intel i5-6500", 58.0), f"paper: {NETWORK}": ("NVIDIA GTX 1050", 17.0)}
"""Devices and seconds for the 3042 trajectories of one map (SPEC section 10)."""

DESCRIPTION = (
    "Measures how long all trajectories of a map take by the sequential simulator, by the batched one and by the "
    "network, beside the paper's figures."
)

MEANING = (
    "Medians of repeated calls after one that compiles; a call ends when its result is there. The network's time holds "
    "the making of its inputs; its weights are random, which makes no difference. The sequential simulator takes one "
    "trajectory after the other in NumPy, as the paper's does; *x sequential* is against it, for the paper's figures "
    "against the paper's own."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the experiment; returns the exit code, 2 for bad input."""
    parser = launch.parser("timing", DESCRIPTION)
    options.add_robot(parser)
    options.add_grid(parser)
    parser.add_argument(
        "--network",
        metavar="PRESET",
        help="preset of `travjax train`, or a .toml file, whose network is measured (a ResNet50 in float32)",
    )
    parser.add_argument(
        "--batch", type=int, default=BATCH, metavar="N", help=f"samples in the network at once ({BATCH})"
    )
    parser.add_argument(
        "--repeats", type=int, default=5, metavar="N", help="timed calls of which the median is taken (5)"
    )
    options.add_out(parser, "runs/timing")
    return launch.launch(parser, run, argv)


def run(arguments: argparse.Namespace) -> None:
    """Measures, and writes the table, a figure and the report."""
    setup = options.setup(arguments)
    require(arguments.repeats > 0, "--repeats", arguments.repeats, "at least 1")
    require(arguments.batch > 0, "--batch", arguments.batch, "at least 1")
    Devices.all().check_batch(arguments.batch)
    simulator_benchmark.check(setup)
    trunk = ResNetConfig()
    if arguments.network:
        trunk = Preset.load(find_preset(arguments.network, RESNET)).trunk
    out = output_folder(arguments.out)
    rows = _of_paper() if setup.actions == ActionSpace() else []
    rows += measured(setup, trunk, arguments.batch, arguments.repeats)
    _write(
        rows, f"{setup.robot.name}, {len(setup.actions)} trajectories of a map; {simulator_benchmark.machine()}", out
    )


def measured(setup: Setup, trunk: ResNetConfig, batch: int, repeats: int) -> list[dict]:
    """Measures each method on all trajectories of a map on this device, with progress bars; returns the rows."""
    trajectories = len(setup.actions)
    with progress.bar(SEQUENTIAL, repeats * trajectories, "trajectory") as bar:
        row = simulator_benchmark.reference_row(setup, lambda done: bar.update(), repeats)
    sequential = row["ms_per_map"] / 1e3
    rows = [
        _row(SEQUENTIAL, f"{simulator_benchmark.processor()}, one core", sequential, trajectories, sequential, repeats)
    ]

    def others() -> Iterator[dict]:
        device = _device()
        for maps in (1, TOGETHER):
            row = simulator_benchmark.labelling_row(maps, setup, repeats)
            what = f"batched simulator, {maps} map{'s at once' if maps > 1 else ''}"
            yield _row(what, device, row["ms_per_map"] / 1e3, trajectories, sequential, repeats)
        row = Bench(setup, repeats, trunk).all_trajectories(batch, repeats)
        what = f"{NETWORK}, {trunk.dtype}, batches of {batch}"
        yield _row(what, device, row["ms"] / 1e3, trajectories, sequential, repeats)

    return rows + list(progress.bar("batched simulator, network", 3, "row", iterable=others()))


def _of_paper() -> list[dict]:
    """Returns the rows of the paper's times."""
    sequential = next(seconds for _, seconds in PAPER.values())
    trajectories = len(ActionSpace())
    return [
        _row(what, device, seconds, trajectories, sequential, None) | {"machine": f"the paper's, {device}"}
        for what, (device, seconds) in PAPER.items()
    ]


def _row(what: str, device: str, seconds: float, trajectories: int, sequential: float, repeats: int | None) -> dict:
    return {
        "what": what,
        "device": device,
        "seconds": seconds,
        "trajectories_per_s": trajectories / seconds,
        "speed_up": sequential / seconds,
        "repeats": repeats,
    }


def _device() -> str:
    """Returns the name of the device that JAX runs on."""
    devices = jax.devices()
    if devices[0].platform == "cpu":
        return f"{simulator_benchmark.processor()}, {os.cpu_count()} cores"
    return devices[0].device_kind if len(devices) == 1 else f"{len(devices)} x {devices[0].device_kind}"


def _write(rows: list[dict], headline: str, out: Path) -> None:
    """Prints the table, and writes it as TSV, a figure and the report."""
    table = rows_table(rows, COLUMNS)
    print(f"\n{headline}\n{table}\n")
    with atomic_write(out / "timing.tsv") as temporary:
        simulator_benchmark.write_tsv(rows, temporary, COLUMNS)
    figure = map_figures.save(map_figures.timing_figure(rows), out / "timing.png")
    pieces: list[launch.Piece] = [f"{headline}.", launch.verbatim(table), MEANING, figure]
    progress.wrote(out / "timing.tsv", figure, launch.write_report(out, "All trajectories of a map", pieces))


if __name__ == "__main__":
    raise SystemExit(main())
