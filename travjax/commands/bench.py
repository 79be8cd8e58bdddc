"""`travjax bench`: how fast terrain, labelling and the network are on this machine."""

import argparse
from pathlib import Path

import jax

from travjax import progress, report
from travjax.actions import ActionSpace
from travjax.commands import options
from travjax.config import require
from travjax.files import output_folder, written_whole
from travjax.grid import Grid
from travjax.robot import Robot


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
    from travjax import bench_network

    out = output_folder(arguments.out)
    rows = bench_network.Bench(robot, actions, grid, arguments.repeats).rows()
    measured = bench_network.with_ratio(list(progress.bar("network", 4, "row", iterable=rows)))
    _write(measured, bench_network.COLUMNS, out / "network.tsv")


def _write(rows: list[dict], columns: dict[str, str], path: Path) -> None:
    """Prints the table and writes it."""
    from travjax import bench

    print(f"\n{bench.machine()}\n{report.rows_table(rows, columns)}\n")
    with written_whole(path) as temporary:
        bench.write_tsv(rows, temporary, columns)
    progress.wrote(path)


def _measure_labelling(arguments: argparse.Namespace, robot: Robot, actions: ActionSpace, grid: Grid) -> None:
    from travjax import bench, plots

    bench.check(robot, actions, grid)
    require(arguments.stream >= 0, "--stream", arguments.stream, "at least 0")
    out = output_folder(arguments.out)
    rows = [bench.start_row()]
    # First calls are to compile, not to read the cache.
    jax.config.update("jax_enable_compilation_cache", False)
    measured = bench.kernel_rows(robot, actions, grid, arguments.repeats)
    rows += list(progress.bar("kernels", 2 * len(bench.BATCHES), "row", iterable=measured))
    with progress.bar("sequential simulator", len(actions), "trajectory") as bar:
        rows.append(bench.reference_row(robot, actions, grid, lambda done: bar.update(done - bar.n)))
    if arguments.stream:
        with progress.bar("stream", arguments.stream, "map") as bar:
            rows.append(bench.stream_row(arguments.stream, robot, actions, grid, bar.update))
    rows = bench.with_speed_up(rows)
    _write(rows, bench.COLUMNS, out / "bench.tsv")
    kernels = [row for row in rows if row["what"] in ("terrain", "labelling")]
    progress.wrote(plots.save(plots.speed_figure(kernels), out / "bench.png"))
