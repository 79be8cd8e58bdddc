"""`travjax map`: where a robot can drive on a whole site, and in which direction."""

import argparse

from travjax import options
from travjax.files import user_path
from travjax.rasters.formats import OTHERS
from travjax.signals import going_on


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "map",
        help="map where a robot can drive on a whole site, and in which direction",
        description="Simulates the straight pass through every place of a site in every heading, and writes "
        "GeoTIFFs of its cost and of what blocks it, and maps for Nav2. A site is an elevation map: GeoTIFF or another "
        f"raster of local pixels that GDAL reads, {OTHERS}.",
    )
    options.add_site(parser)
    parser.add_argument(
        "--method",
        choices=("passes", "geometric"),
        default="passes",
        help="simulate passes, or compute the cost map of UNSTR-NAV, which has no headings, as a baseline (passes)",
    )
    parser.add_argument(
        "--grid-map", type=user_path, metavar="FILE", help="also write a GridMap of ROS 2 to this file, .mcap or .db3"
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="simulate on a Dask cluster: the address of its scheduler, or local"
    )
    options.add_out(parser, "runs/map")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Maps the site and writes the results."""
    from travjax.site.mapping import save_map, say_notes, setup_of

    passes = arguments.robot, arguments.headings, arguments.stride
    for name in ("grid_map", "scheduler"):
        options.require_left_out(arguments, name, arguments.method == "geometric", "with --method geometric")
    if arguments.spacing is not None or not arguments.allow_coarse:  # refuses what is wrong before the site is read
        setup_of(*passes, 0.0625 if arguments.spacing is None else arguments.spacing, arguments.contact)
    site = options.site(arguments)
    setup = setup_of(*passes, site.spacing, arguments.contact)
    say_notes(site, setup)
    if arguments.method == "geometric":
        from travjax.site.geometric import save_geometric

        save_geometric(site, setup, arguments.out)
        return
    with going_on("the same command goes on with the tiles that are missing"):
        save_map(site, setup, arguments.out, arguments.grid_map, arguments.scheduler)
