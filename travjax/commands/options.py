"""What commands share: groups of options, the configurations they make, and progress."""

import argparse
import json
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

from travjax.actions import ActionSpace
from travjax.config import InputError, require, to_json
from travjax.files import user_path
from travjax.footprint import node_table
from travjax.grid import Grid
from travjax.labelling import Batch
from travjax.progress import bar
from travjax.robot import Robot
from travjax.terrain import STYLES

Commands = argparse._SubParsersAction
"""What `add(commands)` of a command adds its parser to."""


def add_synthetic(parser: argparse.ArgumentParser, count: int, each: str) -> None:
    """Styles, number and seed of synthetic maps; see `count` and `seed`."""
    parser.add_argument(
        "--style", nargs="+", choices=STYLES, metavar="STYLE", help=f"styles: {', '.join(STYLES)} (all)"
    )
    parser.add_argument("--count", type=int, metavar="N", help=f"number of {each} ({count})")
    parser.add_argument("--seed", type=int, metavar="S", help="seed of the first map, counting on from there (0)")
    parser.set_defaults(default_count=count)


def add_robot(parser: argparse.ArgumentParser) -> None:
    """Robot and action space; see `configuration`."""
    presets = ", ".join(Robot.presets())
    parser.add_argument("--robot", default="seekur_jr", metavar="R", help=f"{presets}, or a .toml file (seekur_jr)")
    parser.add_argument("--actions", type=user_path, metavar="FILE", help=".toml file of an action space (the paper's)")


def add_grid(parser: argparse._ActionsContainer) -> None:
    """Size and spacing of maps; see `configuration`."""
    parser.add_argument("--size", type=float, default=8.0, metavar="M", help="edge of a map in metres (8)")
    parser.add_argument(
        "--spacing", type=float, default=0.0625, metavar="M", help="metres between nodes of a map (0.0625)"
    )


DEM_OPTIONS = ("stride", "cell_size", "height_scale", "nodata", "keep_holes", "allow_coarse")
"""What `add_dem` adds; each is None or False where it is not given."""


def add_dem(parser: argparse.ArgumentParser, stride: float) -> None:
    """How elevation maps are read; see `dem_settings`."""
    parser.add_argument("--stride", type=float, metavar="M", help=f"metres between windows of a DEM ({stride:g})")
    parser.add_argument(
        "--cell-size", type=float, metavar="M", help="metres between a DEM's values, or into which points are put"
    )
    parser.add_argument("--height-scale", type=float, metavar="M", help="metres per unit of a DEM's values (1)")
    parser.add_argument(
        "--nodata",
        type=float,
        metavar="Z",
        help="value that marks unknown ground, if the file does not say; as in --nodata=-9999",
    )
    parser.add_argument(
        "--keep-holes", action="store_true", help="do not interpolate holes within 0.125 m of known ground"
    )
    parser.add_argument("--allow-coarse", action="store_true", help="take DEM cells larger than 0.125 m")
    parser.set_defaults(default_stride=stride)


def add_out(parser: argparse.ArgumentParser, folder: str) -> None:
    """The folder to write to."""
    parser.add_argument(
        "--out", type=user_path, default=Path(folder), metavar="DIR", help=f"folder to write to ({folder})"
    )


def count(arguments: argparse.Namespace) -> int:
    """The number of synthetic maps."""
    count = arguments.default_count if arguments.count is None else arguments.count
    require(count > 0, "--count", count, "at least 1")
    return count


def seed(arguments: argparse.Namespace) -> int:
    """The seed of the first synthetic map."""
    seed = arguments.seed or 0
    require(0 <= seed < 2**31, "--seed", seed, f"from 0 to {2**31 - 1}")
    return seed


def dem_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """How elevation maps are read, as `load_dem` takes it: by keyword, `stride` included."""
    return {
        "stride": arguments.default_stride if arguments.stride is None else arguments.stride,
        "cell_size": arguments.cell_size,
        "height_scale": arguments.height_scale,
        "nodata": arguments.nodata,
        "fill_holes": not arguments.keep_holes,
        "allow_coarse": arguments.allow_coarse,
    }


def configuration(arguments: argparse.Namespace) -> tuple[Grid, Robot, ActionSpace]:
    """Grid, robot and action space; refuses what does not fit together before anything is made."""
    grid, robot = Grid(arguments.size, arguments.spacing), Robot.load(arguments.robot)
    actions = ActionSpace.load(arguments.actions) if arguments.actions else ActionSpace()
    try:
        node_table(robot, actions, grid)
    except InputError as error:
        given = [str(source) for source in (arguments.robot, arguments.actions) if source]
        raise InputError(f"{' with '.join(given)}: {error}") from None
    return grid, robot, actions


def configuration_json(robot: Robot, actions: ActionSpace, grid: Grid, **more: Any) -> str:
    """All that labels depend on, as JSON, with the version of travjax; a straight arc's radius is "inf"."""
    parts = {name: to_json(part) for name, part in (("robot", robot), ("actions", actions), ("grid", grid))}
    return json.dumps(parts | more | {"travjax": version("travjax")}, allow_nan=False)


def progress(batches: Iterator[Batch], total: int, what: str) -> Iterator[Batch]:
    """The batches, with a bar that counts their maps."""
    with bar(what, total, "map") as shown:
        for batch in batches:
            yield batch
            shown.update(len(batch["heights"]))
