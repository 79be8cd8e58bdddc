"""The command `travjax`: configurations in, library calls, files and figures out."""

import argparse
import dataclasses
import json
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

import jax
import numpy as np
from tqdm import tqdm

import travjax
from travjax import report
from travjax.actions import ActionSpace
from travjax.config import InputError, require
from travjax.dem import load_dem
from travjax.files import cache_folder, output_folder, save_npz, written_whole
from travjax.footprint import node_table
from travjax.grid import Grid
from travjax.labelling import Batch, dem_batches, joined, labelled, samples, synthetic_batches, title
from travjax.robot import Robot
from travjax.terrain import STYLES
from travjax.traverse import default_robot


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code, 2 for bad input."""
    try:
        arguments = _parser().parse_args(argv)
        _use_compilation_cache()
        arguments.run(arguments)
    except InputError as error:
        print(f"travjax: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of our output has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt:
        print("travjax: interrupted", file=sys.stderr)
        return 130
    return 0


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="travjax", description="Which trajectories of a wheeled robot will fail, and why.")
    parser.add_argument("--version", action="version", version=f"travjax {travjax.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)

    terrain = commands.add_parser("terrain", help="make synthetic maps", description="Makes synthetic maps.")
    _add_synthetic(terrain, count=12, each="maps of each style")
    _add_grid(terrain)
    _add_out(terrain, "runs/terrain")
    terrain.set_defaults(run=_terrain)

    label = commands.add_parser(
        "label",
        help="label every trajectory of synthetic or real maps",
        description="Labels every trajectory of maps with step, obstacle and tilt failures: of synthetic maps, or of "
        "the windows of elevation maps (GeoTIFF and other rasters, .npy, .npz).",
    )
    label.add_argument("dem", nargs="*", type=Path, metavar="DEM", help="elevation map files; none: synthetic maps")
    _add_synthetic(label, count=200, each="maps in all, the styles in turn")
    label.add_argument("--stride", type=float, metavar="M", help="metres between windows of a DEM (8)")
    label.add_argument(
        "--cell-size", type=float, metavar="M", help="metres between a DEM's values, if the file does not say"
    )
    label.add_argument("--height-scale", type=float, metavar="M", help="metres per unit of a DEM's values (1)")
    label.add_argument(
        "--nodata",
        type=float,
        metavar="Z",
        help="value that marks unknown ground, if the file does not say; as in --nodata=-9999",
    )
    label.add_argument(
        "--keep-holes", action="store_true", help="do not interpolate holes within 0.125 m of known ground"
    )
    label.add_argument("--allow-coarse", action="store_true", help="take DEM cells larger than 0.125 m")
    _add_robot(label)
    _add_grid(label)
    label.add_argument("--no-figures", action="store_true", help="write no figures")
    _add_out(label, "runs/label")
    label.set_defaults(run=_label)

    speed = commands.add_parser(
        "bench", help="measure speed", description="Measures terrain and labelling on this machine."
    )
    _add_robot(speed)
    _add_grid(speed)
    speed.add_argument(
        "--repeats", type=int, default=15, metavar="N", help="timed calls of which the median is taken (15)"
    )
    speed.add_argument(
        "--stream", type=int, default=0, metavar="N", help="also make and label N maps (the paper has 56840)"
    )
    _add_out(speed, "runs/bench")
    speed.set_defaults(run=_bench)
    return parser


def _add_synthetic(parser: argparse.ArgumentParser, count: int, each: str) -> None:
    parser.add_argument(
        "--style", nargs="+", choices=STYLES, metavar="STYLE", help=f"styles: {', '.join(STYLES)} (all)"
    )
    parser.add_argument("--count", type=int, metavar="N", help=f"number of {each} ({count})")
    parser.add_argument("--seed", type=int, metavar="S", help="seed of the first map, counting on from there (0)")
    parser.set_defaults(default_count=count)


def _add_robot(parser: argparse.ArgumentParser) -> None:
    presets = ", ".join(Robot.presets())
    parser.add_argument("--robot", default="seekur_jr", metavar="R", help=f"{presets}, or a .toml file (seekur_jr)")
    parser.add_argument("--actions", type=Path, metavar="FILE", help=".toml file of an action space (the paper's)")


def _add_grid(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", type=float, default=8.0, metavar="M", help="edge of a map in metres (8)")
    parser.add_argument(
        "--spacing", type=float, default=0.0625, metavar="M", help="metres between nodes of a map (0.0625)"
    )


def _add_out(parser: argparse.ArgumentParser, folder: str) -> None:
    parser.add_argument("--out", type=Path, default=Path(folder), metavar="DIR", help=f"folder to write to ({folder})")


def _use_compilation_cache() -> None:
    """Compiled code is kept between runs, so that a second start is quick; JAX_COMPILATION_CACHE_DIR moves it."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        cache = cache_folder() / "jax"
        try:
            output_folder(cache)
        except InputError:
            return
        jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _terrain(arguments: argparse.Namespace) -> None:
    from travjax import plots  # matplotlib takes 0.3 s to import

    grid = Grid(arguments.size, arguments.spacing)
    styles = arguments.style or list(STYLES)
    count, seed = _count(arguments), _seed(arguments)
    out = output_folder(arguments.out)
    names = [style for style in styles for _ in range(count)]
    seeds = list(range(seed, seed + count)) * len(styles)
    maps = joined(list(_progress(synthetic_batches(names, seeds, grid), len(names), "terrain")))
    print(save_npz(out / "terrain.npz", cell_size=grid.spacing, **maps))
    for style in styles:
        chosen = np.flatnonzero(maps["group"] == style)[:24]
        titles = [f"seed {seed}" for seed in maps["seed"][chosen]]
        print(
            plots.save(
                plots.contact_sheet(maps["heights"][chosen], titles, f"{style}: {len(chosen)} of {count} maps", grid),
                out / f"terrain_{style}.png",
            )
        )


def _label(arguments: argparse.Namespace) -> None:
    grid, robot, actions = _configuration(arguments)
    dem_options = ("stride", "cell_size", "height_scale", "nodata", "keep_holes", "allow_coarse")
    unused = ("style", "count", "seed") if arguments.dem else dem_options
    for name in unused:
        given = getattr(arguments, name)
        allowed = "left out where DEM files are given" if arguments.dem else "left out where no DEM file is given"
        require(given is None or given is False, f"--{name.replace('_', '-')}", given, allowed)
    if arguments.dem:
        total, source, files = _dem_windows(arguments, grid)
    else:
        styles, total, seed = arguments.style or list(STYLES), _count(arguments), _seed(arguments)
        names = [styles[number % len(styles)] for number in range(total)]
        source, files = synthetic_batches(names, list(range(seed, seed + total)), grid), []
    out = output_folder(arguments.out)

    maps = joined(list(_progress((labelled(batch, robot, actions, grid) for batch in source), total, "labelling")))

    as_in_paper = not arguments.dem and robot == default_robot() and actions == ActionSpace()
    table = report.shares_table(maps["group"], maps["failed"], maps["known"], as_in_paper)
    labels = save_npz(out / "labels.npz", config=_config(robot, actions, grid, files), cell_size=grid.spacing, **maps)
    with written_whole(out / "shares.txt") as temporary:
        temporary.write_text(table + "\n")
    print(f"\nShare of trajectories that fail, {robot.name}, {len(actions)} trajectories a map:\n{table}\n")
    unknown = int((~maps["known"].any(axis=-1)).sum())
    if unknown:
        print(f"{unknown} of {total} maps have no known trajectory; they count in no share.\n")
    print(labels, out / "shares.txt", sep="\n")
    if arguments.no_figures:
        return
    from travjax import plots  # matplotlib takes 0.3 s to import

    chosen = samples(maps)
    titles = [title(maps, index) for index in chosen]
    heights, failed, known = (maps[key][chosen] for key in ("heights", "failed", "known"))
    print(plots.save(plots.labelled_maps(heights, failed, known, titles, robot, actions, grid), out / "labels.png"))
    print(plots.save(plots.robot_figure(robot), out / "robot.png"))
    print(plots.save(plots.action_figure(actions, robot, grid), out / "actions.png"))


def _bench(arguments: argparse.Namespace) -> None:
    from travjax import bench, plots

    grid, robot, actions = _configuration(arguments)
    bench.check(robot, actions, grid)
    require(arguments.repeats > 0, "--repeats", arguments.repeats, "at least 1")
    require(arguments.stream >= 0, "--stream", arguments.stream, "at least 0")
    out = output_folder(arguments.out)
    rows = [bench.start_row()]
    # First calls are to compile, not to read the cache.
    jax.config.update("jax_enable_compilation_cache", False)
    measured = bench.kernel_rows(robot, actions, grid, arguments.repeats)
    rows += list(tqdm(measured, "kernels", total=2 * len(bench.BATCHES)))
    with tqdm(desc="sequential simulator", total=len(actions), unit="trajectory") as bar:
        rows.append(bench.reference_row(robot, actions, grid, lambda done: bar.update(done - bar.n)))
    if arguments.stream:
        with tqdm(desc="stream", total=arguments.stream, unit="map") as bar:
            rows.append(bench.stream_row(arguments.stream, robot, actions, grid, bar.update))
    rows = bench.with_speed_up(rows)
    print(f"\n{bench.machine()}\n{report.rows_table(rows, bench.COLUMNS)}\n")
    with written_whole(out / "bench.tsv") as temporary:
        bench.write_tsv(rows, temporary)
    print(out / "bench.tsv")
    kernels = [row for row in rows if row["what"] in ("terrain", "labelling")]
    print(plots.save(plots.speed_figure(kernels), out / "bench.png"))


def _configuration(arguments: argparse.Namespace) -> tuple[Grid, Robot, ActionSpace]:
    """Grid, robot and action space; refuses what does not fit together before anything is made."""
    grid, robot, actions = Grid(arguments.size, arguments.spacing), Robot.load(arguments.robot), _actions(arguments)
    try:
        node_table(robot, actions, grid)
    except InputError as error:
        given = [str(source) for source in (arguments.robot, arguments.actions) if source]
        raise InputError(f"{' with '.join(given)}: {error}") from None
    return grid, robot, actions


def _actions(arguments: argparse.Namespace) -> ActionSpace:
    return ActionSpace.load(arguments.actions) if arguments.actions else ActionSpace()


def _count(arguments: argparse.Namespace) -> int:
    count = arguments.default_count if arguments.count is None else arguments.count
    require(count > 0, "--count", count, "at least 1")
    return count


def _seed(arguments: argparse.Namespace) -> int:
    seed = arguments.seed or 0
    require(0 <= seed < 2**31, "--seed", seed, f"from 0 to {2**31 - 1}")
    return seed


def _dem_windows(arguments: argparse.Namespace, grid: Grid) -> tuple[int, Iterator[Batch], list[dict[str, Any]]]:
    """The number of windows of all files, batches of them with where they come from, and how each file was read."""
    options: dict[str, Any] = {
        "stride": 8.0 if arguments.stride is None else arguments.stride,
        "cell_size": arguments.cell_size,
        "height_scale": arguments.height_scale,
        "nodata": arguments.nodata,
        "fill_holes": not arguments.keep_holes,
        "allow_coarse": arguments.allow_coarse,
    }
    names = [path.name for path in arguments.dem]
    files, notes = [], []
    for path in arguments.dem:
        windows = load_dem(path, grid=grid, **options)
        crs = windows.crs or "none"
        crs = crs.split('"')[1] if '"' in crs else crs  # of a system without a code, the name
        print(
            f"{path}: {len(windows.heights)} windows cover {windows.covered:.1%}, cells of {windows.cell_size:g} m, "
            f"crs {crs}, {windows.filled:.3%} filled in small holes, {windows.unknown:.1%} unknown"
        )
        files.append((path.name if names.count(path.name) == 1 else str(path), windows))
        read = {
            name: getattr(windows, name)
            for name in ("path", "sha256", "crs", "height_offset", "covered", "filled", "unknown")
        }
        notes.append(read | options | {"cell_size": windows.cell_size})

    return sum(len(windows.heights) for _, windows in files), dem_batches(files), notes


def _progress(batches: Iterator[Batch], total: int, what: str) -> Iterator[Batch]:
    with tqdm(desc=what, total=total, unit="map") as bar:
        for batch in batches:
            yield batch
            bar.update(len(batch["heights"]))


def _config(robot: Robot, actions: ActionSpace, grid: Grid, files: list[dict[str, Any]]) -> str:
    """All that the labels depend on, as JSON; a straight arc's radius is "inf"."""
    parts = {name: dataclasses.asdict(part) for name, part in (("robot", robot), ("actions", actions), ("grid", grid))}
    parts["actions"]["radii"] = ["inf" if np.isinf(radius) else radius for radius in actions.radii]
    return json.dumps(parts | {"files": files, "travjax": travjax.__version__}, allow_nan=False)
