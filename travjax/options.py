"""Options that commands and experiments share, in groups, and the typed values that they stand for."""

import argparse
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from travjax.config import require
from travjax.data.map_batches import MapStream, WindowOptions
from travjax.files import user_path
from travjax.rasters.reading_options import AXES_UP, DemOptions
from travjax.simulation.contact import CONTACTS
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup
from travjax.terrain.rock_field import STYLE as ROCK_FIELD
from travjax.terrain.styles import STYLES

if TYPE_CHECKING:  # these take seconds to import
    from travjax.estimators.preset import Preset
    from travjax.runs.run import Run
    from travjax.site import ground


class Commands(Protocol):
    """The object to which `add(commands)` of a command adds its parser."""

    def add_parser(self, name: str, *, help: str, description: str) -> argparse.ArgumentParser:
        """Returns a new parser for a command."""


class Options(Protocol):
    """A parser, or a group of its options."""

    def add_argument(self, *names: str, **settings: Any) -> argparse.Action:
        """Adds an option."""


def add_maps(parser: argparse.ArgumentParser) -> None:
    """Adds the elevation map files of a command that takes synthetic maps without them; see `maps`."""
    parser.add_argument(
        "dem", nargs="*", type=user_path, metavar="DEM", help="elevation map files; none: synthetic maps"
    )


def add_synthetic(parser: argparse.ArgumentParser, count: int, each: str) -> None:
    """Adds the options for styles, number and seed of synthetic maps; see `maps`, `count` and `seed`."""
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
    """Adds the option for the world of synthetic maps; see `MapStream`."""
    parser.add_argument(
        "--world",
        type=float,
        metavar="M",
        help="map size in metres that features of synthetic maps are derived from: 8 makes the ground of the paper's "
        "maps on maps of any size (the maps' own size)",
    )


def add_robot_alone(parser: Options) -> None:
    """Adds the option for the robot."""
    presets = ", ".join(Robot.presets())
    parser.add_argument("--robot", default="seekur_jr", metavar="R", help=f"{presets}, or a .toml file (seekur_jr)")


def add_robot(parser: Options) -> None:
    """Adds the options for robot and action space; see `setup`."""
    add_robot_alone(parser)
    parser.add_argument("--actions", type=user_path, metavar="FILE", help=".toml file of an action space (the paper's)")
    add_contact(parser)


def add_contact_model(parser: Options, default: str) -> None:
    """Adds the option for the contact model; default: the model where neither it nor the robot's file decides."""
    parser.add_argument(
        "--contact",
        choices=CONTACTS,
        help="how wheels and body touch the ground: as in the paper (nearest), or with the wheels' size, the whole "
        f"outline and the point turn (tyre); the robot's file decides unless given, else {default}",
    )


def add_contact(parser: Options) -> None:
    """Adds the options for the contact model; see `setup`."""
    add_contact_model(parser, "nearest")
    parser.add_argument(
        "--no-turn",
        dest="turn",
        action="store_false",
        help="leave point turns out of --contact tyre, as the paper does",
    )


GROWS = "features of synthetic maps grow with it, unless a world is given"
"""Help text on the effect of a map's size."""


def add_grid(parser: Options, of_synthetic: bool = True) -> None:
    """Adds the options for size and spacing of maps; see `setup`; of_synthetic: whether some may be synthetic."""
    effect = f"; {GROWS}" if of_synthetic else ""
    parser.add_argument("--size", type=float, default=8.0, metavar="M", help=f"edge of a map in metres (8){effect}")
    parser.add_argument(
        "--spacing", type=float, default=0.0625, metavar="M", help="metres between nodes of a map (0.0625)"
    )


RUN_OPTIONS = ("robot", "actions", "size", "spacing", "contact", "turn", "weights", "seed")
"""Names of the options that `add_run` adds."""


def add_run(parser: Options) -> None:
    """Adds the options that replace settings of a run's preset; see `run_of`."""
    parser.add_argument("--robot", metavar="R", help="another robot than the preset's: its name or a .toml file")
    parser.add_argument("--actions", type=user_path, metavar="FILE", help=".toml file of an action space (the paper's)")
    add_grid(parser)
    add_contact(parser)
    parser.add_argument(
        "--weights",
        metavar="FILE",
        help="the trunk's first weights, or none for random ones (ImageNet's: TRAVJAX_DATA, the cache, else fetched)",
    )
    parser.add_argument("--seed", type=int, metavar="S", help="seed of data set and training, instead of the preset's")


DEM_OPTIONS = (
    *("stride", "cell_size", "height_scale", "nodata", "keep_holes", "allow_coarse"),
    *("band", "classes", "up", "gdal_driver", "topic", "layer", "time"),
)
"""Names of the options that `add_dem` adds; each is None or False unless given."""


def add_dem(parser: argparse.ArgumentParser, stride: float) -> None:
    """Adds the options for reading elevation maps and cutting them into windows; see `windows`."""
    parser.add_argument("--stride", type=float, metavar="M", help=f"metres between windows of a DEM ({stride:g})")
    add_reading(parser)
    parser.set_defaults(default_stride=stride)


def add_reading(parser: argparse.ArgumentParser) -> None:
    """Adds the options for reading elevation maps; see `reading`."""
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
        help="classes of LAS points that are ground, as in 2,9 (2, 8 and 11 where the file has 2, else all but noise)",
    )
    parser.add_argument("--up", choices=AXES_UP, help="axis of a point cloud or mesh that points up (z)")
    parser.add_argument(
        "--gdal-driver",
        action="append",
        metavar="NAME",
        help="a driver of GDAL that may read files beside those of local pixels; may be given again",
    )
    parser.add_argument("--topic", metavar="NAME", help="topic of a recorded GridMap (the only one)")
    parser.add_argument("--layer", metavar="NAME", help="layer of a recorded GridMap (the only one)")
    parser.add_argument(
        "--time", type=float, metavar="S", help="read the latest GridMap until so many seconds from a recording's start"
    )


def add_site(parser: argparse.ArgumentParser) -> None:
    """Adds the file of a whole site, how it is read, the robot, and the lattice of places; see `site`."""
    parser.add_argument("site", type=user_path, metavar="SITE", help="elevation map file")
    add_robot_alone(parser)
    add_contact_model(parser, "tyre")
    parser.add_argument("--headings", type=int, default=16, metavar="H", help="headings around the circle (16)")
    parser.add_argument(
        "--stride",
        type=float,
        metavar="M",
        help="metres between places (0.25, or as many coarse cells as make up that)",
    )
    parser.add_argument(
        "--spacing", type=float, metavar="M", help="metres between nodes (0.0625; with --allow-coarse the site's own)"
    )
    add_reading(parser)


def _codes(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(code) for code in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: must be codes from 0 to 255, as in 2,9") from None


def add_out(parser: argparse.ArgumentParser, folder: str) -> None:
    """Adds the option for the output folder."""
    parser.add_argument(
        "--out", type=user_path, default=Path(folder), metavar="DIR", help=f"folder to write to ({folder})"
    )


def count(arguments: argparse.Namespace) -> int:
    """Returns the number of synthetic maps."""
    count = arguments.default_count if arguments.count is None else arguments.count
    require(count > 0, "--count", count, "at least 1")
    return count


def seed(arguments: argparse.Namespace) -> int:
    """Returns the seed of the first synthetic map."""
    seed = arguments.seed or 0
    require(0 <= seed < 2**31, "--seed", seed, f"from 0 to {2**31 - 1}")
    return seed


def setup(arguments: argparse.Namespace) -> Setup:
    """Returns robot, action space, grid and contact model; raises InputError early where they do not fit together."""
    where = arguments.size, arguments.spacing
    return Setup.load(arguments.robot, arguments.actions, *where, arguments.contact, arguments.turn)


def windows(arguments: argparse.Namespace) -> WindowOptions:
    """Returns the options for reading elevation maps and cutting them into windows."""
    stride = arguments.default_stride if arguments.stride is None else arguments.stride
    return WindowOptions(reading(arguments), stride, not arguments.keep_holes, arguments.allow_coarse)


def reading(arguments: argparse.Namespace) -> DemOptions:
    """Returns what is said about the files of elevation maps."""
    return DemOptions(
        arguments.cell_size,
        arguments.height_scale,
        arguments.nodata,
        arguments.band,
        arguments.classes,
        arguments.up,
        tuple(arguments.gdal_driver or ()),
        arguments.topic,
        arguments.layer,
        arguments.time,
    )


def site(arguments: argparse.Namespace) -> "ground.SiteGround":
    """Opens the elevation map of a whole site."""
    from travjax.site.ground import SiteGround

    return SiteGround.open(
        arguments.site,
        arguments.spacing,
        reading=reading(arguments),
        fill_holes=not arguments.keep_holes,
        allow_coarse=arguments.allow_coarse,
    )


def require_left_out(arguments: argparse.Namespace, name: str, here: bool, where: str) -> None:
    """Raises InputError if an option is given where it has no effect; where: in words, as in "with --estimator"."""
    given = getattr(arguments, name)
    none = given is None or given is False
    require(none or not here, f"--{name.replace('_', '-')}", str(given), f"left out {where}")


def require_default(
    arguments: argparse.Namespace, defaults: Mapping[str, object], names: Iterable[str], where: str
) -> None:
    """Raises InputError if an option has another value than its default where it has no effect.

    defaults: of options by name; where: in words, as in "--check is given"
    """
    for name in names:
        given = getattr(arguments, name)
        require(given == defaults[name], f"--{name.replace('_', '-')}", given, f"left out where {where}")


def maps(arguments: argparse.Namespace, grid: Grid) -> MapStream:
    """Returns the windows of elevation maps, or synthetic maps if no file is given; prints a description of them."""
    unused = ("style", "count", "seed", "world") if arguments.dem else DEM_OPTIONS
    for name in unused:
        given = getattr(arguments, name)
        allowed = "left out where DEM files are given" if arguments.dem else "left out where no DEM file is given"
        require(given is None or given is False, f"--{name.replace('_', '-')}", given, allowed)
    if arguments.dem:
        return MapStream.from_files(arguments.dem, grid, windows(arguments), print)
    total, first = count(arguments), seed(arguments)
    return MapStream.synthetic(
        arguments.style or list(STYLES), range(first, first + total), grid, arguments.world, print
    )


def run_of(preset: "Preset", arguments: argparse.Namespace) -> "Run":
    """Returns the run of a preset with the settings that RUN_OPTIONS replace."""
    from travjax.training.fit import run_from_preset

    if arguments.seed is not None:
        seed(arguments)
    return run_from_preset(preset, **{name: getattr(arguments, name) for name in RUN_OPTIONS})
