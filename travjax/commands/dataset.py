"""`travjax dataset`: maps with all their labels and splits, synthetic or real, kept in one folder."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from travjax import progress
from travjax.commands import options
from travjax.config import InputError, one_line, require
from travjax.data import sites, tfds_export
from travjax.data.dataset import SPLITS, Dataset, DatasetConfig, Progress, generate, is_dataset, load, save
from travjax.data.provenance import SIDES, Site, SitesConfig, Strip
from travjax.evaluation.dataset_tables import are_headings, statistics_table, windows_table
from travjax.files import (
    find_preset,
    first_lines,
    output_folder,
    put_back,
    require_replaceable,
    resolved,
    save_text,
    user_path,
)
from travjax.rasters.reading_options import DemOptions
from travjax.simulation import traverse
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot

SYNTHETIC = ("maps", "seed", "validation", "test", "world")
"""The options of a synthetic data set."""

REAL = ("test_strip", "validation_strip", "gap", "max_unknown", "no_rotations", *options.DEM_OPTIONS)
"""The options of DEM files."""

MAKING = (*SYNTHETIC, "sites", "dem", "held_out", *REAL, "robot", "actions", "size", "spacing", "out")
"""The options of a data set that is made, not of one that is checked."""


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "dataset",
        help="make a data set for training",
        description="Makes synthetic maps, the styles in turn, or cuts real ones out of elevation maps; labels every "
        "trajectory, splits the maps, and keeps all of it in one folder. The whole data set is in memory: 4 GB for the "
        "paper's 56840 maps.",
    )
    config = DatasetConfig()
    parser.add_argument("--maps", type=int, default=config.maps, metavar="N", help=f"number of maps ({config.maps})")
    parser.add_argument(
        "--seed", type=int, default=config.seed, metavar="S", help="what maps and splits are drawn from (0)"
    )
    for name in ("validation", "test"):
        share = getattr(config, name)
        parser.add_argument(
            f"--{name}", type=float, default=share, metavar="SHARE", help=f"share of the maps for {name} ({share:g})"
        )
    options.add_world(parser)
    _add_real(parser)
    options.add_robot(parser)
    options.add_grid(parser)
    options.add_out(parser, "runs/dataset")
    parser.add_argument(
        "--check", type=user_path, metavar="DIR", help="make nothing: verify the data set in DIR and show what it holds"
    )
    parser.add_argument(
        "--tfds", type=user_path, metavar="DIR", help="also write the data set for tensorflow-datasets, as array_record"
    )
    parser.set_defaults(run=run, making={name: parser.get_default(name) for name in MAKING})


def _add_real(parser: argparse.ArgumentParser) -> None:
    config = SitesConfig((Site("none"),))
    parser.add_argument(
        "--sites", metavar="SITES", help="real maps: .toml file with a [[site]] for each elevation map, or real"
    )
    parser.add_argument("--dem", nargs="+", default=[], metavar="FILE", help="real maps: elevation maps to train on")
    parser.add_argument(
        "--held-out", nargs="+", default=[], metavar="FILE", help="real maps: elevation maps for the test alone"
    )
    for split in ("test", "validation"):
        parser.add_argument(
            f"--{split}-strip",
            nargs=2,
            metavar=("SIDE", "M"),
            help=f"for {split}: the windows within M metres of a side ({', '.join(SIDES)}) of each --dem file",
        )
    parser.add_argument(
        "--gap", type=float, metavar="M", help=f"metres around test windows to train on nothing ({config.gap:g})"
    )
    parser.add_argument(
        "--max-unknown",
        type=float,
        metavar="SHARE",
        help=f"share of unknown nodes above which a window is left out ({config.max_unknown:g})",
    )
    parser.add_argument(
        "--no-rotations", action="store_true", help="no training windows turned by 90, 180 and 270 degrees"
    )
    options.add_dem(parser, config.stride)


def run(arguments: argparse.Namespace) -> None:
    """Makes and saves a data set or checks one, prints what it holds, and exports it if that is asked for."""
    folder = arguments.check or arguments.out
    statistics = folder.parent / f"{folder.name}_statistics.txt"  # the folder holds the data set alone
    if arguments.check:
        _require_left_out(arguments, MAKING, "--check is given")
    else:
        require_replaceable(statistics, _are_statistics, f"--out {folder}", "table")
    if arguments.tfds:
        outside = not resolved(arguments.tfds).is_relative_to(resolved(folder))
        require(outside, "--tfds", str(arguments.tfds), f"a folder outside the data set, {folder}")
    dataset = load(folder) if arguments.check else _made(arguments, folder)
    tables = _print_tables(dataset)
    if arguments.check:
        print(one_line(f"{folder}: all files are as they were written"))
    else:
        progress.wrote(folder, save_text(statistics, "\n\n".join(tables) + "\n"))
    if arguments.tfds:
        with progress.bar("exporting", len(dataset.split), "map") as bar:
            tfds_export.export(dataset, arguments.tfds, bar.update)
        progress.wrote(arguments.tfds)


def _are_statistics(path: Path) -> bool:
    """Whether a file holds the tables of a data set: their first line is that of the headings."""
    return [are_headings(line) for line in first_lines(path, 1)] == [True]


def _print_tables(dataset: Dataset) -> list[str]:
    """Prints and returns the shares that fail and, of real maps, what became of the windows."""
    as_in_paper = dataset.config is not None and traverse.as_in_paper(dataset.robot, dataset.actions)
    tables = [statistics_table(dataset, as_in_paper=as_in_paper)]
    sizes = ", ".join(f"{len(dataset.maps_of(split))} {split}" for split in SPLITS)
    trajectories = f"{dataset.robot.name}, {len(dataset.actions)} trajectories a map"
    print(f"\n{len(dataset.split)} maps ({sizes}), {trajectories}; shares that fail:\n{tables[0]}\n")
    if dataset.provenance:
        tables.append(windows_table(dataset.provenance))
        copies = int((dataset.provenance.quarter_turns > 0).sum())
        print(f"Windows of the sites, beside which {copies} maps are turned copies:\n{tables[1]}\n")
    return tables


def _made(arguments: argparse.Namespace, folder: Path) -> Dataset:
    """The data set that is asked for, saved."""
    files = bool(arguments.dem or arguments.held_out)
    if arguments.sites:
        _require_left_out(arguments, (*SYNTHETIC, "dem", "held_out", *REAL), "--sites is given")
    elif files:
        _require_left_out(arguments, SYNTHETIC, "DEM files are given")
    else:
        _require_left_out(arguments, REAL, "no DEM file is given")
    named = SitesConfig.load(find_preset(arguments.sites, "sites")) if arguments.sites else None
    real = _sites(arguments) if files else named
    synthetic = None if real else DatasetConfig(*(getattr(arguments, name) for name in SYNTHETIC))
    grid, robot, actions = options.configuration(arguments)
    if real:
        return made_of_sites(real, robot, actions, grid, folder)
    assert synthetic
    return made(synthetic, robot, actions, grid, folder)


def _require_left_out(arguments: argparse.Namespace, names: Sequence[str], where: str) -> None:
    for name in names:
        given = getattr(arguments, name)
        require(given == arguments.making[name], f"--{name.replace('_', '-')}", given, f"left out where {where}")


def _sites(arguments: argparse.Namespace) -> SitesConfig:
    """The sites of DEM files."""
    settings = options.dem_settings(arguments)
    read = {field.name: settings.pop(field.name) for field in fields(DemOptions)}
    strips: dict[str, Any] = {
        name: _strip(name, getattr(arguments, name)) for name in ("test_strip", "validation_strip")
    }
    if not arguments.dem:
        _require_left_out(arguments, tuple(strips), "no --dem file is given")
    given = {name: getattr(arguments, name) for name in ("gap", "max_unknown")}
    return SitesConfig(
        (
            *(Site(file, **strips, **read) for file in arguments.dem),
            *(Site(file, split="test", **read) for file in arguments.held_out),
        ),
        rotations=not arguments.no_rotations,
        **{name: value for name, value in given.items() if value is not None},
        **settings,
    )


def _strip(name: str, given: list[str] | None) -> Strip:
    if not given:
        return ()
    try:
        return given[0], float(given[1])
    except ValueError:
        raise InputError(f"--{name.replace('_', '-')} = {' '.join(given)}: must be a side, then metres") from None


def made(config: DatasetConfig, robot: Robot, actions: ActionSpace, grid: Grid, folder: Path) -> Dataset:
    """A new synthetic data set, saved in a folder, with progress bars."""
    options.say_world(config.world, grid)
    make = lambda on_progress: generate(config, robot, actions, grid, on_progress)
    return _saved(make, config.maps, folder, f"--maps = {config.maps}")


def made_of_sites(config: SitesConfig, robot: Robot, actions: ActionSpace, grid: Grid, folder: Path) -> Dataset:
    """A new data set of real maps, saved in a folder, with progress bars."""
    make = lambda on_progress: sites.read(config, robot, actions, grid, on_progress)
    return _saved(make, None, folder, "the sites' windows")


def _saved(make: Callable[[Progress], Dataset], total: int | None, folder: Path, what: str) -> Dataset:
    """What `make` makes; `total` maps, if that is known before."""
    _require_free(folder)
    try:
        with progress.bar("making", total, "map", delay=0.1) as bar:  # none where a file is refused at once
            dataset = make(bar.update)
    except MemoryError as error:
        raise InputError(f"{what}: do not fit in memory: {error}") from None
    size = sum(array.nbytes for array in dataset.arrays.values())
    with progress.bar("saving", size, "B", unit_scale=True) as bar:
        # The files' headers are not in the total.
        save(dataset, folder, lambda added: bar.update(min(added, size - bar.n)))
    return dataset


def _require_free(folder: Path) -> None:
    """Refuses, before minutes of work, what `save` would refuse after them, and to replace the working folder."""
    require(resolved(folder) != Path.cwd(), "--out", str(folder), "another folder than the one you are in")
    put_back(folder)
    try:
        empty = not folder.exists() or folder.is_dir() and not any(folder.iterdir())
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be read: {error.strerror or error}") from None
    if not empty and not is_dataset(folder):
        raise InputError(f"--out {folder}: holds something else: must be a new or empty folder, or that of a data set")
    if not empty:
        progress.say(f"{folder}: the data set there will be replaced")
    output_folder(folder.parent)
