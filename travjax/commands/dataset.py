"""`travjax dataset`: maps with all their labels and splits, synthetic or real, kept in one folder."""

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from travjax import options, progress
from travjax.config import InputError, one_line, require
from travjax.data import tfds_export
from travjax.data.build import build_from_sites, build_synthetic
from travjax.data.dataset import Dataset, DatasetConfig, load
from travjax.data.provenance import SIDES, Site, SitesConfig, Strip
from travjax.evaluation.dataset_tables import are_statistics, dataset_tables
from travjax.files import find_preset, require_replaceable, resolved, save_text, user_path

SYNTHETIC = ("maps", "seed", "validation", "test", "world")
"""Names of the options of a synthetic data set."""

REAL = ("test_strip", "validation_strip", "gap", "max_unknown", "no_rotations", *options.DEM_OPTIONS)
"""Names of the options of a data set from DEM files."""

MAKING = (*SYNTHETIC, "sites", "dem", "held_out", *REAL, "robot", "actions", "size", "spacing", "out")
"""Names of the options for making a data set, which checking one does not take."""


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
    """Makes and saves a data set or checks one, prints its contents, and exports it if asked to."""
    folder = arguments.check or arguments.out
    statistics = folder.parent / f"{folder.name}_statistics.txt"  # the folder holds only the data set
    if arguments.check:
        options.require_default(arguments, arguments.making, MAKING, "--check is given")
    else:
        require_replaceable(statistics, are_statistics, f"--out {folder}", "table")
    if arguments.tfds:
        outside = not resolved(arguments.tfds).is_relative_to(resolved(folder))
        require(outside, "--tfds", str(arguments.tfds), f"a folder outside the data set, {folder}")
    dataset = load(folder) if arguments.check else _made(arguments, folder)
    tables = dataset_tables(dataset)
    shown = "\n\n".join(f"{headline}\n{table}" for headline, table in tables.items())
    print(f"\n{shown}\n")
    if arguments.check:
        print(one_line(f"{folder}: all files are as they were written"))
    else:
        progress.wrote(folder, save_text(statistics, "\n\n".join(tables.values()) + "\n"))
    if arguments.tfds:
        with progress.bar("exporting", len(dataset.split), "map") as bar:
            tfds_export.export(dataset, arguments.tfds, bar.update)
        progress.wrote(arguments.tfds)


def _made(arguments: argparse.Namespace, folder: Path) -> Dataset:
    """Makes and saves the data set that the options describe."""
    files = bool(arguments.dem or arguments.held_out)
    if arguments.sites:
        options.require_default(arguments, arguments.making, (*SYNTHETIC, "dem", "held_out", *REAL), "--sites is given")
    elif files:
        options.require_default(arguments, arguments.making, SYNTHETIC, "DEM files are given")
    else:
        options.require_default(arguments, arguments.making, REAL, "no DEM file is given")
    named = SitesConfig.load(find_preset(arguments.sites, "sites")) if arguments.sites else None
    real = _sites(arguments) if files else named
    synthetic = None if real else DatasetConfig(*(getattr(arguments, name) for name in SYNTHETIC))
    setup = options.setup(arguments)
    if real:
        return build_from_sites(real, setup, folder)
    assert synthetic
    return build_synthetic(synthetic, setup, folder)


def _sites(arguments: argparse.Namespace) -> SitesConfig:
    """Returns the sites of DEM files."""
    windows = options.windows(arguments)
    read = asdict(windows.reading)
    strips: dict[str, Any] = {
        name: _strip(name, getattr(arguments, name)) for name in ("test_strip", "validation_strip")
    }
    if not arguments.dem:
        options.require_default(arguments, arguments.making, tuple(strips), "no --dem file is given")
    given = {name: getattr(arguments, name) for name in ("gap", "max_unknown")}
    return SitesConfig(
        (
            *(Site(file, **strips, **read) for file in arguments.dem),
            *(Site(file, split="test", **read) for file in arguments.held_out),
        ),
        rotations=not arguments.no_rotations,
        **{name: value for name, value in given.items() if value is not None},
        stride=windows.stride,
        fill_holes=windows.fill_holes,
        allow_coarse=windows.allow_coarse,
    )


def _strip(name: str, given: list[str] | None) -> Strip:
    if not given:
        return ()
    try:
        return given[0], float(given[1])
    except ValueError:
        raise InputError(f"--{name.replace('_', '-')} = {' '.join(given)}: must be a side, then metres") from None
