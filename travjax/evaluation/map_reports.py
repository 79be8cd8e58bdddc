"""Writes synthetic maps and labelled maps as files of arrays, tables and figures."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from travjax import progress
from travjax.data.map_batches import Batch, MapStream, bytes_each, joined, labelled, samples, title
from travjax.evaluation import tables
from travjax.files import output_folder, save_npz, save_text
from travjax.npz_stream import NpzStream
from travjax.simulation.contact import spacing_note
from travjax.simulation.grid import Grid
from travjax.simulation.setup import Setup

ON_SHEET = 24
"""The largest number of maps on a contact sheet."""


def write_terrain(
    styles: Sequence[str], seeds: Sequence[int], grid: Grid, out: str | Path, world: float | None = None
) -> Path:
    """Makes maps of each style with each of these seeds, and writes them with a contact sheet of each style.

    Returns the path of their .npz. Raises InputError as `generate_terrain` does, and when `out` cannot be written to.
    """
    from travjax.evaluation import map_figures  # matplotlib takes 0.3 s to import

    folder, count = output_folder(out), len(seeds)
    maps = MapStream.synthetic(
        [style for style in styles for _ in seeds], [*seeds] * len(styles), grid, world, progress.say
    )
    arrays = joined(list(_counted(maps.batches, maps.total, "terrain")))
    if maps.paper:
        arrays = {"world": np.asarray(grid.size if world is None else world), **arrays}
    saved = save_npz(folder / "terrain.npz", cell_size=grid.spacing, **arrays)
    progress.wrote(saved)
    for style in styles:
        chosen = np.flatnonzero(arrays["group"] == style)[:ON_SHEET]
        titles = [f"seed {seed}" for seed in arrays["seed"][chosen]]
        headline = f"{style}: {len(chosen)} of {count} maps"
        sheet = map_figures.contact_sheet(arrays["heights"][chosen], titles, headline, grid)
        progress.wrote(map_figures.save(sheet, folder / f"terrain_{style}.png"))
    return saved


def label_maps(maps: MapStream, setup: Setup, out: str | Path, figures: bool = True) -> Path:
    """Simulates every trajectory of maps, prints the shares that fail, and writes labels, shares and figures.

    Returns the path of the .npz of the labels. Raises InputError when they do not fit on the disk or cannot be written.
    """
    folder, robot = output_folder(out), setup.robot
    if note := spacing_note(setup.contact.model, setup.grid.spacing):
        progress.say(note)
    config = setup.to_json_text(files=maps.files, world=maps.world)
    with NpzStream(folder / "labels.npz", maps.total, bytes_each(setup, where=True), "labelled maps") as labels:
        for batch in _counted((labelled(one, setup, where=True) for one in maps.batches), maps.total, "labelling"):
            labels.append(batch)
        arrays = labels.arrays
        in_paper = maps.paper and setup.as_in_paper
        table = tables.shares_table(arrays["group"], arrays["failed"], arrays["known"], in_paper, robot.event_names)
        places = tables.where_table(arrays["where_pose"], arrays["failed"], setup)
        labels.save(config=config, cell_size=setup.grid.spacing)
        shares = save_text(folder / "shares.txt", f"{table}\n\n{places}\n")
        progress.say(
            f"\nShare of trajectories that fail, {robot.name}, {len(setup.actions)} trajectories a map, contact model "
            f"{setup.contact.model}:\n{table}\n\nWhere they reach the margin that fails:\n{places}\n"
        )
        unknown = int((~arrays["known"].any(axis=-1)).sum())
        if unknown:
            progress.say(f"{unknown} of {maps.total} maps have no known trajectory; they count in no share.\n")
        progress.wrote(labels.path, shares)
        if figures:
            _write_figures(arrays, setup, folder)
    return labels.path


def _counted(batches: Iterator[Batch], total: int, what: str) -> Iterator[Batch]:
    """Yields the batches, with a progress bar that counts their maps."""
    with progress.bar(what, total, "map") as shown:
        for batch in batches:
            yield batch
            shown.update(len(batch["heights"]))


def _write_figures(maps: Batch, setup: Setup, out: Path) -> None:
    """Draws and writes the labels of a few maps, the robot and the action space."""
    from travjax.evaluation import map_figures  # matplotlib takes 0.3 s to import

    chosen = samples(maps)
    titles = [title(maps, index) for index in chosen]
    heights, failed, known, poses = (maps[key][chosen] for key in ("heights", "failed", "known", "where_pose"))
    labels = map_figures.labelled_maps(heights, failed, known, titles, setup, poses)
    progress.wrote(map_figures.save(labels, out / "labels.png"))
    progress.wrote(map_figures.save(map_figures.robot_figure(setup.robot), out / "robot.png"))
    progress.wrote(map_figures.save(map_figures.action_figure(setup), out / "actions.png"))
