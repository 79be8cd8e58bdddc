"""`travjax terrain`: synthetic maps and pictures of them."""

import argparse

import numpy as np

from travjax import progress
from travjax.commands import options
from travjax.data.map_batches import joined, synthetic_batches
from travjax.files import output_folder, save_npz
from travjax.simulation.grid import Grid
from travjax.terrain.styles import are_rock_fields


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser("terrain", help="make synthetic maps", description="Makes synthetic maps.")
    options.add_synthetic(parser, count=12, each="maps of each style")
    options.add_grid(parser)
    options.add_out(parser, "runs/terrain")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Makes maps of each style and writes them, and a contact sheet of each style."""
    from travjax.evaluation import map_figures  # matplotlib takes 0.3 s to import

    grid = Grid(arguments.size, arguments.spacing)
    count, seed = options.count(arguments), options.seed(arguments)
    out = output_folder(arguments.out)
    styles = options.styles(arguments, grid)
    names = [style for style in styles for _ in range(count)]
    seeds = list(range(seed, seed + count)) * len(styles)
    batches = synthetic_batches(names, seeds, grid, arguments.world)
    maps = joined(list(options.progress(batches, len(names), "terrain")))
    if not are_rock_fields(styles, arguments.world):
        maps = {"world": np.asarray(grid.size if arguments.world is None else arguments.world), **maps}
    progress.wrote(save_npz(out / "terrain.npz", cell_size=grid.spacing, **maps))
    for style in styles:
        chosen = np.flatnonzero(maps["group"] == style)[:24]
        titles = [f"seed {seed}" for seed in maps["seed"][chosen]]
        progress.wrote(
            map_figures.save(
                map_figures.contact_sheet(
                    maps["heights"][chosen], titles, f"{style}: {len(chosen)} of {count} maps", grid
                ),
                out / f"terrain_{style}.png",
            )
        )
