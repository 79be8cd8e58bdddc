"""`travjax bench`: how fast terrain, labelling and the network are on this machine."""

import argparse
from pathlib import Path

import jax

from travjax import progress
from travjax.commands import options
from travjax.config import require
from travjax.evaluation import tables
from travjax.files import atomic_write, output_folder
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "bench", help="measure speed", description="Measures terrain and labelling on this machine, or the network."
    )
    options.add_robot(parser)
    options.add_grid(parser)
    parser.add_argument(
        "--repeats", type=int, default=15, metavar="N", help="timed calls of which the median is taken (15)"
    )
    parser.add_argument(
        "--stream", type=int, default=0, metavar="N", help="also make and label N maps (the paper has 56840)"
    )
    parser.add_argument(
        "--network", action="store_true", help="measure the network instead: inputs, a training step, a whole map"
    )
    options.add_out(parser, "runs/bench")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Measures, and writes the table as TSV and a figure."""
    grid, robot, actions = options.configuration(arguments)
    require(arguments.repeats > 0, "--repeats", arguments.repeats, "at least 1")
    if arguments.network:
        _measure_network(arguments, robot, actions, grid)
    else:
        _measure_labelling(arguments, robot, actions, grid)


def _measure_network(arguments: argparse.Namespace, robot: Robot, actions: ActionSpace, grid: Grid) -> None:
    from travjax.training import network_benchmark

    out = output_folder(arguments.out)
    rows = network_benchmark.Bench(robot, actions, grid, arguments.repeats).rows()
    measured = network_benchmark.with_ratio(list(progress.bar("network", 4, "row", iterable=rows)))
    _write(measured, network_benchmark.COLUMNS, out / "network.tsv")


def _write(rows: list[dict], columns: dict[str, str], path: Path) -> None:
    """Prints the table and writes it."""
    from travjax.evaluation import simulator_benchmark

    print(f"\n{simulator_benchmark.machine()}\n{tables.rows_table(rows, columns)}\n")
    with atomic_write(path) as temporary:
        simulator_benchmark.write_tsv(rows, temporary, columns)
    progress.wrote(path)


def _measure_labelling(arguments: argparse.Namespace, robot: Robot, actions: ActionSpace, grid: Grid) -> None:
    from travjax.evaluation import map_figures, simulator_benchmark

    simulator_benchmark.check(robot, actions, grid)
    require(arguments.stream >= 0, "--stream", arguments.stream, "at least 0")
    out = output_folder(arguments.out)
    rows = [simulator_benchmark.start_row()]
    # First calls are to compile, not to read the cache.
    jax.config.update("jax_enable_compilation_cache", False)
    measured = simulator_benchmark.kernel_rows(robot, actions, grid, arguments.repeats)
    rows += list(progress.bar("kernels", 2 * len(simulator_benchmark.BATCHES), "row", iterable=measured))
    with progress.bar("sequential simulator", len(actions), "trajectory") as bar:
        rows.append(simulator_benchmark.reference_row(robot, actions, grid, lambda done: bar.update(done - bar.n)))
    if arguments.stream:
        with progress.bar("stream", arguments.stream, "map") as bar:
            rows.append(simulator_benchmark.stream_row(arguments.stream, robot, actions, grid, bar.update))
    rows = simulator_benchmark.with_speed_up(rows)
    _write(rows, simulator_benchmark.COLUMNS, out / "bench.tsv")
    kernels = [row for row in rows if row["what"] in ("terrain", "labelling")]
    progress.wrote(map_figures.save(map_figures.speed_figure(kernels), out / "bench.png"))
