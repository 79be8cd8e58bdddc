"""Batches of maps with their origin and labels, and the choice of maps to show.

A `MapStream` makes them from styles and seeds, or reads them from elevation maps.

A batch is a dict of arrays with a common leading axis: `heights` [n, rows, cols], `group` [n] (style or file), further
arrays that identify its maps, and, once labelled, the margins, `known` and `failed`.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from travjax.batching import BATCH
from travjax.config import one_line, require, to_json
from travjax.data.dem import Windows, load_dem
from travjax.rasters.reading_options import DemOptions
from travjax.simulation.grid import Grid
from travjax.simulation.setup import Setup
from travjax.terrain.rock_field import rock_fields, sample_rock_field
from travjax.terrain.styles import FIELDS, are_rock_fields, elevation, sample_params, world_note
from travjax.traversal.traverse import failures, margins_of, places_of

Batch = dict[str, np.ndarray]

Say = Callable[[str], object]
"""A function that is called with lines about the maps."""


@dataclass(frozen=True)
class WindowOptions:
    """The settings of `load_dem` for reading elevation maps and cutting them into windows.

    stride: metres between the windows
    """

    reading: DemOptions = DemOptions()
    stride: float = 8.0
    fill_holes: bool = True
    allow_coarse: bool = False

    @property
    def settings(self) -> dict[str, Any]:
        """All settings by the argument names of `load_dem`."""
        own = {name: getattr(self, name) for name in ("stride", "fill_holes", "allow_coarse")}
        return dataclasses.asdict(self.reading) | own


@dataclass(frozen=True)
class MapStream:
    """Maps that are made or read batch by batch, so that they need not fit into memory.

    total:   number of maps
    batches: the maps, once
    files:   how each elevation map was read; empty for synthetic maps
    world:   metres, the map size that features of synthetic maps scale with, if it was given
    paper:   whether the maps have the paper's styles, so that failure shares can be compared with the paper's
    """

    total: int
    batches: Iterator[Batch]
    files: tuple[dict[str, Any], ...] = ()
    world: float | None = None
    paper: bool = False

    @staticmethod
    def synthetic(
        styles: Sequence[str],
        seeds: Sequence[int],
        grid: Grid,
        world: float | None = None,
        say: Say = lambda line: None,
    ) -> "MapStream":
        """Makes maps with these seeds [n] and alternating styles.

        Raises InputError as `generate_terrain` does.
        """
        names = [styles[number % len(styles)] for number in range(len(seeds))]
        rocky = are_rock_fields(names, world)
        note = None if rocky else world_note(world, grid)
        if note:
            say(note)
        batches = synthetic_batches(names, list(seeds), grid, world)
        return MapStream(len(seeds), batches, world=world, paper=not rocky)

    @staticmethod
    def from_files(
        paths: Sequence[Path], grid: Grid, options: WindowOptions = WindowOptions(), say: Say = lambda line: None
    ) -> "MapStream":
        """Reads the windows of elevation maps; `say` is called with lines about each file and its windows.

        Raises InputError as `load_dem` does.
        """
        names = [path.name for path in paths]
        sites, files = [], []
        for path in paths:
            windows = load_dem(path, grid=grid, **options.settings)
            for line in _described(path, windows):
                say(one_line(line))
            sites.append((path.name if names.count(path.name) == 1 else str(path), windows))
            read = {
                name: getattr(windows, name) for name in ("path", "sha256", "covered", "filled", "unknown", "notes")
            }
            read |= {"crs": windows.crs, "height_offset": np.ravel(windows.height_offset).tolist()}
            files.append(read | options.settings | {"cell_size": windows.cell_size})
        return MapStream(sum(len(windows) for _, windows in sites), dem_batches(sites), tuple(files))


def _described(path: Path, windows: Windows) -> list[str]:
    """Describes a file and the windows that were cut out of it, in lines."""
    systems = dict.fromkeys(windows.systems().tolist())
    said = (
        f"{path}: {len(windows)} windows cover {windows.covered:.1%}, cells of {windows.cell_size:g} m, "
        f"crs {', '.join(map(_shown, systems))}, {windows.filled:.3%} filled in small holes, "
        f"{windows.unknown:.1%} unknown"
    )
    return [said, *(f"{path}: {note}" for note in windows.notes)]


def _shown(crs: str) -> str:
    """Returns the code of a coordinate system, or its name if it has no code."""
    return crs.split('"')[1] if '"' in crs else crs or "none"


def synthetic_batches(styles: list[str], seeds: list[int], grid: Grid, world: float | None = None) -> Iterator[Batch]:
    """Makes maps of the styles and seeds [n] in a world, with the parameters and noise seeds that reproduce them.

    Raises InputError as `generate_terrain` does.
    """
    rocky = are_rock_fields(styles, world)
    for start in range(0, len(seeds), BATCH):
        names, numbers = styles[start : start + BATCH], seeds[start : start + BATCH]
        made = _rock_fields(numbers, grid) if rocky else _noise_maps(names, numbers, grid, world)
        yield {"heights": made.pop("heights"), "group": np.array(names), "seed": np.array(numbers), **made}


def _noise_maps(styles: list[str], seeds: list[int], grid: Grid, world: float | None) -> Batch:
    """Makes maps of the paper's styles; returns heights, noise seeds and parameters."""
    params, noise_seeds = sample_params(styles, seeds)
    return {
        "heights": np.asarray(elevation(params, noise_seeds, grid=grid, world=world)),
        "noise_seed": np.asarray(noise_seeds),
        **{field: np.asarray(getattr(params, field)) for field in FIELDS},
    }


def _rock_fields(seeds: list[int], grid: Grid) -> Batch:
    """Makes rock fields; returns heights and parameters."""
    params = [to_json(sample_rock_field(seed)) for seed in seeds]
    fields = {field: np.array([one[field] for one in params]) for field in params[0]}
    return {"heights": rock_fields(seeds, grid), **fields}


def dem_batches(sites: Iterable[tuple[str, Windows]]) -> Iterator[Batch]:
    """Reads the windows of named sites, with the position of each on its site."""
    for name, windows in sites:
        for start in range(0, len(windows), BATCH):
            some = slice(start, start + BATCH)
            heights = windows.read(some)
            yield {
                "heights": heights,
                "group": np.full(len(heights), name),
                "origin": windows.origins[some],
                "height_offset": windows.offsets(some),
                "crs": windows.systems(some),
            }


def labelled(batch: Batch, setup: Setup, where: bool = False) -> Batch:
    """Adds to a batch `known` and the margin of each of the robot's k events by name, [n, t], and `failed` [n, t, k].

    where: whether also to add `where_pose` [n, t, k] and `where_node` [n, t, k, 2], as in events.Where, int16
    Raises InputError when a margin is NaN or infinite where the ground is known: it would not count as a failure.
    """
    if where:
        margins, places = places_of(batch["heights"], setup)
        found = {"where_pose": places.pose, "where_node": places.node}
    else:
        margins, found = margins_of(batch["heights"], setup), {}
    numbers = np.isfinite(np.asarray(margins.events())).all(axis=-1)
    allowed = "finite where the ground is known"
    require(
        bool((numbers | ~np.asarray(margins.known)).all()), f"margins of {setup.robot.name}", "NaN or infinity", allowed
    )
    arrays = {name: margins[name] for name in margins.names}
    arrays |= {"known": margins.known, "failed": failures(margins, setup.robot)}
    where_arrays = {name: np.asarray(array).astype(np.int16) for name, array in found.items()}
    return batch | {name: np.asarray(array) for name, array in arrays.items()} | where_arrays


def bytes_each(setup: Setup, where: bool = False) -> int:
    """Returns the bytes of a labelled map: heights, and per trajectory `known`, and of each event margin and flag, and
    with `where` a pose and a node.
    """
    return 4 * setup.grid.nodes**2 + len(setup.actions) * ((11 if where else 5) * len(setup.robot.events) + 1)


def joined(batches: list[Batch]) -> Batch:
    """Joins batches into one."""
    return {key: np.concatenate([batch[key] for batch in batches]) for key in batches[0]}


def samples(maps: Batch, most: int = 5) -> np.ndarray:
    """Returns the indices of labelled maps to show: taken from the groups in turn, and spread over each group.

    Maps where 5% to 60% of the trajectories fail come first.
    """
    fails = (maps["failed"].any(axis=-1) & maps["known"]).mean(axis=-1)
    dull = (fails < 0.05) | (fails > 0.6)
    spread = np.arange(len(fails)) * 0.618034 % 1  # the smallest few of these belong to maps that are far apart
    groups: dict[str, list[int]] = {}
    for index in np.lexsort((spread, dull)):
        groups.setdefault(maps["group"][index], []).append(int(index))
    in_turn = sorted((rank, index) for members in groups.values() for rank, index in enumerate(members))
    return np.array([index for _, index in in_turn[:most]])


def title(maps: Batch, index: int) -> str:
    """Returns a line that identifies a map: its group, and its seed or south-west corner."""
    seed = "seed" in maps
    where = f"seed {maps['seed'][index]}" if seed else "SW ({:.1f}, {:.1f})".format(*maps["origin"][index])
    return f"{one_line(maps['group'][index], 30)}, {where}"
