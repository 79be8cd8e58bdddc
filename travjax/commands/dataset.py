"""`travjax dataset`: maps with all their labels and splits, made from one seed and kept in one folder."""

import argparse
from pathlib import Path

from tqdm import tqdm

from travjax import tfds_builder, traverse
from travjax.actions import ActionSpace
from travjax.commands import options
from travjax.config import InputError, require
from travjax.dataset import ARRAYS, SPLITS, Dataset, DatasetConfig, generate, is_dataset, load, save
from travjax.files import output_folder, written_whole
from travjax.grid import Grid
from travjax.robot import Robot
from travjax.statistics import statistics_table

MAKING = ("maps", "seed", "validation", "test", "robot", "actions", "size", "spacing", "out")
"""The options of a data set that is made, not of one that is checked."""


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "dataset",
        help="make a data set for training",
        description="Makes synthetic maps, the styles in turn, labels every trajectory, splits the maps, and keeps "
        "all of it in one folder. The whole data set is in memory: 4 GB for the paper's 56840 maps.",
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
    options.add_robot(parser)
    options.add_grid(parser)
    options.add_out(parser, "runs/dataset")
    parser.add_argument(
        "--check", type=Path, metavar="DIR", help="make nothing: verify the data set in DIR and show what it holds"
    )
    parser.add_argument(
        "--tfds", type=Path, metavar="DIR", help="also write the data set for tensorflow-datasets, as array_record"
    )
    parser.set_defaults(run=run, making={name: parser.get_default(name) for name in MAKING})


def run(arguments: argparse.Namespace) -> None:
    """Makes and saves a data set or checks one, prints what it holds, and exports it if that is asked for."""
    folder = arguments.check or arguments.out
    if arguments.check:
        for name, default in arguments.making.items():
            given = getattr(arguments, name)
            require(given == default, f"--{name}", given, "left out where --check is given")
    if arguments.tfds:
        outside = not arguments.tfds.resolve().is_relative_to(folder.resolve())
        require(outside, "--tfds", str(arguments.tfds), f"a folder outside the data set, {folder}")
    if arguments.check:
        dataset = load(folder)
    else:
        grid, robot, actions = options.configuration(arguments)
        config = DatasetConfig(arguments.maps, arguments.seed, arguments.validation, arguments.test)
        dataset = made(config, robot, actions, grid, folder)
    as_in_paper = dataset.config is not None and traverse.as_in_paper(dataset.robot, dataset.actions)
    table = statistics_table(dataset, as_in_paper=as_in_paper)
    sizes = ", ".join(f"{len(dataset.maps_of(split))} {split}" for split in SPLITS)
    trajectories = f"{dataset.robot.name}, {len(dataset.actions)} trajectories a map"
    print(f"\n{len(dataset.split)} maps ({sizes}), {trajectories}; shares that fail:\n{table}\n")
    if arguments.check:
        print(f"{folder}: all files are as they were written")
    else:
        statistics = folder.with_name(f"{folder.name}_statistics.txt")  # the folder holds the data set alone
        with written_whole(statistics) as temporary:
            temporary.write_text(table + "\n")
        print(folder, statistics, sep="\n")
    if arguments.tfds:
        with tqdm(desc="exporting", total=len(dataset.split), unit="map") as bar:
            tfds_builder.export(dataset, arguments.tfds, bar.update)
        print(arguments.tfds)


def made(config: DatasetConfig, robot: Robot, actions: ActionSpace, grid: Grid, folder: Path) -> Dataset:
    """A new data set, saved in a folder, with progress bars."""
    _require_free(folder)
    try:
        with tqdm(desc="making", total=config.maps, unit="map") as bar:
            dataset = generate(config, robot, actions, grid, bar.update)
    except MemoryError as error:
        raise InputError(f"--maps = {config.maps}: do not fit in memory: {error}") from None
    size = sum(getattr(dataset, name).nbytes for name in ARRAYS)
    with tqdm(desc="saving", total=size, unit="B", unit_scale=True) as bar:
        # The files' headers are not in the total.
        save(dataset, folder, lambda added: bar.update(min(added, size - bar.n)))
    return dataset


def _require_free(folder: Path) -> None:
    """Refuses, before minutes of work, what `save` would refuse after them, and to replace the working folder."""
    require(folder.resolve() != Path.cwd(), "--out", str(folder), "another folder than the one you are in")
    try:
        empty = not folder.exists() or folder.is_dir() and not any(folder.iterdir())
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be read: {error.strerror or error}") from None
    if not empty and not is_dataset(folder):
        raise InputError(f"--out {folder}: holds something else: must be a new or empty folder, or that of a data set")
    if not empty:
        tqdm.write(f"{folder}: the data set there will be replaced")
    output_folder(folder.parent)
