"""`travjax label`: every trajectory of synthetic or real maps with its failures."""

import argparse

from travjax import options
from travjax.evaluation.map_reports import label_maps
from travjax.rasters.formats import OTHERS


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "label",
        help="label every trajectory of synthetic or real maps",
        description="Labels every trajectory of maps with step, obstacle and tilt failures: of synthetic maps, or of "
        f"the windows of elevation maps: GeoTIFF and other rasters of local pixels that GDAL reads, {OTHERS}.",
    )
    options.add_maps(parser)
    options.add_synthetic(parser, count=200, each="maps in all, the styles in turn")
    options.add_dem(parser, stride=8.0)
    options.add_robot(parser)
    options.add_grid(parser)
    parser.add_argument("--no-figures", action="store_true", help="write no figures")
    options.add_out(parser, "runs/label")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Labels every trajectory of the maps and writes the results."""
    setup = options.setup(arguments)
    maps = options.maps(arguments, setup.grid)
    label_maps(maps, setup, arguments.out, figures=not arguments.no_figures)
