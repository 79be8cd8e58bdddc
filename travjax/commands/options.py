"""What commands share: groups of options, the configurations they make, and progress."""

import argparse
import dataclasses
import json
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

from travjax.config import InputError, require, to_json
from travjax.data.map_batches import Batch
from travjax.files import user_path
from travjax.progress import bar
from travjax.rasters.reading_options import AXES_UP, DemOptions
from travjax.simulation.actions import ActionSpace
from travjax.simulation.footprint import node_table
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.terrain.rock_field import STYLE as ROCK_FIELD
from travjax.terrain.styles import STYLES, are_rock_fields, require_world

Commands = argparse._SubParsersAction
"""What `add(commands)` of a command adds its parser to."""


def add_synthetic(parser: argparse.ArgumentParser, count: int, each: str) -> None:
    """Styles, number and seed of synthetic maps; see `styles`, `count` and `seed`."""
    parser.add_argument(
        "--style",
        nargs="+",
        choices=(*STYLES, ROCK_FIELD),
        metavar="STYLE",
        help=f"styles: {', '.join(STYLES)} (all); or {ROCK_FIELD}, other ground than the paper's",
    )
    parser.add_argument("--count", type=int, metavar="N", help=f"number of {each} ({count})")
    parser.add_argument("--seed", type=int, metavar="S", help="seed of the first map, counting on from there (0)")
    add_world(parser)
    parser.set_defaults(default_count=count)


def add_world(parser: argparse.ArgumentParser) -> None:
    """The world of synthetic maps; see `say_world`."""
    parser.add_argument(
        "--world",
        type=float,
        metavar="M",
        help="map size in metres that features of synthetic maps are derived from: 8 makes the ground of the paper's "
        "maps on maps of any size (the maps' own size)",
    )


def add_robot(parser: argparse.ArgumentParser) -> None:
    """Robot and action space; see `configuration`."""
    presets = ", ".join(Robot.presets())
    parser.add_argument("--robot", default="seekur_jr", metavar="R", help=f"{presets}, or a .toml file (seekur_jr)")
    parser.add_argument("--actions", type=user_path, metavar="FILE", help=".toml file of an action space (the paper's)")


GROWS = "features of synthetic maps grow with it, unless a world is given"
"""What a map's edge does."""


def add_grid(parser: argparse._ActionsContainer) -> None:
    """Size and spacing of maps; see `configuration`."""
    parser.add_argument("--size", type=float, default=8.0, metavar="M", help=f"edge of a map in metres (8); {GROWS}")
    parser.add_argument(
        "--spacing", type=float, default=0.0625, metavar="M", help="metres between nodes of a map (0.0625)"
    )


DEM_OPTIONS = (
    *("stride", "cell_size", "height_scale", "nodata", "keep_holes", "allow_coarse"),
    *("band", "classes", "up", "gdal_driver"),
)
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
        "--keep-holes", action="store_true", help="do not interpolate holes within 0.125 m, or a cell, of known ground"
    )
    parser.add_argument("--allow-coarse", action="store_true", help="take DEM cells larger than 0.125 m")
    parser.add_argument(
        "--band",
        type=lambda text: int(text) if text.isdigit() else text,
        metavar="B",
        help="band of a raster that holds the heights: its number from 1, or its description; of a netCDF file the "
        "variable, as in z or z:2",
    )
    parser.add_argument(
        "--classes",
        type=_codes,
        metavar="C,C",
        help="classes of LAS points that are ground, as in 2,9 (2 where the file has it beside others, else all)",
    )
    parser.add_argument("--up", choices=AXES_UP, help="axis of a point cloud or mesh that points up (z)")
    parser.add_argument(
        "--gdal-driver",
        action="append",
        metavar="NAME",
        help="a driver of GDAL that may read files beside those of local pixels; may be given again",
    )
    parser.set_defaults(default_stride=stride)


def _codes(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(code) for code in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: must be codes from 0 to 255, as in 2,9") from None


def add_out(parser: argparse.ArgumentParser, folder: str) -> None:
    """The folder to write to."""
    parser.add_argument(
        "--out", type=user_path, default=Path(folder), metavar="DIR", help=f"folder to write to ({folder})"
    )


def styles(arguments: argparse.Namespace, grid: Grid) -> list[str]:
    """Returns the styles of synthetic maps; says what maps their features are those of, and refuses a bad world."""
    styles = arguments.style or list(STYLES)
    if not are_rock_fields(styles, arguments.world):
        say_world(arguments.world, grid)
    return styles


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


def say_world(world: float | None, grid: Grid) -> None:
    """Prints what maps the features of synthetic maps are those of, where that is not plain; refuses a bad world."""
    require_world(world)
    if world is not None and world != grid.size:
        print(f"synthetic maps of {grid.size:g} m with the features of {world:g} m maps")
    elif grid.size != Grid().size:
        paper = f"a world of {Grid().size:g} m makes the ground of the paper's {Grid().size:g} m maps"
        print(f"synthetic maps of {grid.size:g} m: their features grow with the map; {paper}")


def dem_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """How elevation maps are read, as `load_dem` takes it: by keyword, `stride` included."""
    options = DemOptions(
        arguments.cell_size,
        arguments.height_scale,
        arguments.nodata,
        arguments.band,
        arguments.classes,
        arguments.up,
        tuple(arguments.gdal_driver or ()),
    )
    return dataclasses.asdict(options) | {
        "stride": arguments.default_stride if arguments.stride is None else arguments.stride,
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
