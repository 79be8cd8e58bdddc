"""`travjax label`: every trajectory of synthetic or real maps with its failures."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from travjax import progress
from travjax.commands import options
from travjax.config import one_line, require
from travjax.data.dem import load_dem
from travjax.data.map_batches import Batch, bytes_each, dem_batches, labelled, samples, synthetic_batches, title
from travjax.data.npz_stream import NpzStream
from travjax.evaluation import tables
from travjax.files import output_folder, save_text, user_path
from travjax.rasters.formats import OTHERS
from travjax.simulation import traverse
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.terrain.styles import are_rock_fields


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "label",
        help="label every trajectory of synthetic or real maps",
        description="Labels every trajectory of maps with step, obstacle and tilt failures: of synthetic maps, or of "
        f"the windows of elevation maps: GeoTIFF and other rasters of local pixels that GDAL reads, {OTHERS}.",
    )
    parser.add_argument(
        "dem", nargs="*", type=user_path, metavar="DEM", help="elevation map files; none: synthetic maps"
    )
    options.add_synthetic(parser, count=200, each="maps in all, the styles in turn")
    options.add_dem(parser, stride=8.0)
    options.add_robot(parser)
    options.add_grid(parser)
    parser.add_argument("--no-figures", action="store_true", help="write no figures")
    options.add_out(parser, "runs/label")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Labels the maps, prints the shares that fail, and writes labels, shares and figures."""
    grid, robot, actions = options.configuration(arguments)
    total, source, files = maps_of(arguments, grid)
    out = output_folder(arguments.out)

    noise = not arguments.dem and not are_rock_fields(arguments.style or (), arguments.world)
    as_in_paper = noise and traverse.as_in_paper(robot, actions)
    config = options.configuration_json(robot, actions, grid, files=files, world=arguments.world)
    with NpzStream(out / "labels.npz", total, bytes_each(robot, actions, grid), "labelled maps") as labels:
        for batch in options.progress((labelled(batch, robot, actions, grid) for batch in source), total, "labelling"):
            labels.append(batch)
        maps = labels.arrays
        table = tables.shares_table(maps["group"], maps["failed"], maps["known"], as_in_paper, robot.event_names)
        labels.save(config=config, cell_size=grid.spacing)
        shares = save_text(out / "shares.txt", table + "\n")
        print(f"\nShare of trajectories that fail, {robot.name}, {len(actions)} trajectories a map:\n{table}\n")
        unknown = int((~maps["known"].any(axis=-1)).sum())
        if unknown:
            print(f"{unknown} of {total} maps have no known trajectory; they count in no share.\n")
        progress.wrote(labels.path, shares)
        if not arguments.no_figures:
            _write_figures(maps, robot, actions, grid, out)


def maps_of(arguments: argparse.Namespace, grid: Grid) -> tuple[int, Iterator[Batch], list[dict[str, Any]]]:
    """The number of maps, batches of them, and how each DEM file was read."""
    unused = ("style", "count", "seed", "world") if arguments.dem else options.DEM_OPTIONS
    for name in unused:
        given = getattr(arguments, name)
        allowed = "left out where DEM files are given" if arguments.dem else "left out where no DEM file is given"
        require(given is None or given is False, f"--{name.replace('_', '-')}", given, allowed)
    if arguments.dem:
        return _dem_windows(arguments, grid)
    total, seed, styles = options.count(arguments), options.seed(arguments), options.styles(arguments, grid)
    names = [styles[number % len(styles)] for number in range(total)]
    return total, synthetic_batches(names, list(range(seed, seed + total)), grid, arguments.world), []


def _dem_windows(arguments: argparse.Namespace, grid: Grid) -> tuple[int, Iterator[Batch], list[dict[str, Any]]]:
    """The number of windows of all files, batches of them with where they come from, and how each file was read."""
    settings = options.dem_settings(arguments)
    names = [path.name for path in arguments.dem]
    files, notes = [], []
    for path in arguments.dem:
        windows = load_dem(path, grid=grid, **settings)
        systems = dict.fromkeys(windows.systems().tolist())
        said = (
            f"{path}: {len(windows)} windows cover {windows.covered:.1%}, cells of {windows.cell_size:g} m, "
            f"crs {', '.join(map(_shown, systems))}, {windows.filled:.3%} filled in small holes, "
            f"{windows.unknown:.1%} unknown"
        )
        for line in (said, *(f"{path}: {note}" for note in windows.notes)):
            print(one_line(line))
        files.append((path.name if names.count(path.name) == 1 else str(path), windows))
        read = {name: getattr(windows, name) for name in ("path", "sha256", "covered", "filled", "unknown", "notes")}
        read |= {"crs": windows.crs, "height_offset": np.ravel(windows.height_offset).tolist()}
        notes.append(read | settings | {"cell_size": windows.cell_size})

    return sum(len(windows) for _, windows in files), dem_batches(files), notes


def _shown(crs: str) -> str:
    """The code of a system, the name of one without a code."""
    return crs.split('"')[1] if '"' in crs else crs or "none"


def _write_figures(maps: Batch, robot: Robot, actions: ActionSpace, grid: Grid, out: Path) -> None:
    from travjax.evaluation import map_figures  # matplotlib takes 0.3 s to import

    chosen = samples(maps)
    titles = [title(maps, index) for index in chosen]
    heights, failed, known = (maps[key][chosen] for key in ("heights", "failed", "known"))
    progress.wrote(
        map_figures.save(
            map_figures.labelled_maps(heights, failed, known, titles, robot, actions, grid), out / "labels.png"
        )
    )
    progress.wrote(map_figures.save(map_figures.robot_figure(robot), out / "robot.png"))
    progress.wrote(map_figures.save(map_figures.action_figure(actions, robot, grid), out / "actions.png"))
