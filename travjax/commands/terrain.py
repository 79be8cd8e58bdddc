"""`travjax terrain`: synthetic maps and pictures of them."""

import argparse

from travjax import options
from travjax.evaluation.map_reports import write_terrain
from travjax.simulation.grid import Grid
from travjax.terrain.styles import STYLES


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser("terrain", help="make synthetic maps", description="Makes synthetic maps.")
    options.add_synthetic(parser, count=12, each="maps of each style")
    options.add_grid(parser)
    options.add_out(parser, "runs/terrain")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Makes maps of each style and writes them with pictures."""
    grid = Grid(arguments.size, arguments.spacing)
    count, seed = options.count(arguments), options.seed(arguments)
    write_terrain(arguments.style or list(STYLES), range(seed, seed + count), grid, arguments.out, arguments.world)
