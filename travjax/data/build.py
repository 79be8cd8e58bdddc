"""Builds a data set in a folder: from synthetic maps, or from the windows of real sites."""

from collections.abc import Callable
from pathlib import Path

from travjax import progress
from travjax.config import InputError, require
from travjax.data import sites
from travjax.data.dataset import Dataset, DatasetConfig, Progress, generate, is_dataset, save
from travjax.data.provenance import SitesConfig
from travjax.files import output_folder, put_back, resolved, user_path
from travjax.simulation.setup import Setup
from travjax.terrain.styles import world_note


def build_synthetic(config: DatasetConfig, setup: Setup, folder: str | Path) -> Dataset:
    """Makes and labels synthetic maps, and saves the data set in a folder, with progress bars.

    An existing data set is replaced. Raises InputError when robot, actions and grid do not fit together, when the maps
    do not fit in memory, and when the folder holds something else or the data set cannot be written.
    """
    if note := world_note(config.world, setup.grid):
        progress.say(note)
    make = lambda on_progress: generate(config, setup, on_progress)
    return _saved(make, config.maps, user_path(folder), f"--maps = {config.maps}")


def build_from_sites(config: SitesConfig, setup: Setup, folder: str | Path) -> Dataset:
    """Cuts the windows of real sites, labels them, and saves the data set in a folder, with progress bars.

    Raises InputError as `build_synthetic` does, and when a file is missing, cannot be read or leaves no window.
    """
    make = lambda on_progress: sites.read(config, setup, on_progress)
    return _saved(make, None, user_path(folder), "the sites' windows")


def _saved(make: Callable[[Progress], Dataset], total: int | None, folder: Path, what: str) -> Dataset:
    """Saves the data set that `make` makes, and returns it; total: number of maps, if it is known in advance."""
    _require_free(folder)
    try:
        with progress.bar("making", total, "map", delay=0.1) as bar:  # no bar where a file is refused at once
            dataset = make(bar.update)
    except MemoryError as error:
        raise InputError(f"{what}: do not fit in memory: {error}") from None
    size = sum(array.nbytes for array in dataset.arrays.values())
    with progress.bar("saving", size, "B", unit_scale=True) as bar:
        # The total does not include the files' headers.
        save(dataset, folder, lambda added: bar.update(min(added, size - bar.n)))
    return dataset


def _require_free(folder: Path) -> None:
    """Raises InputError early for a folder that `save` would refuse after minutes of work, and for the current one."""
    require(resolved(folder) != Path.cwd(), "--out", str(folder), "another folder than the one you are in")
    put_back(folder)
    try:
        empty = not folder.exists() or folder.is_dir() and not any(folder.iterdir())
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be read: {error.strerror or error}") from None
    if not empty and not is_dataset(folder):
        raise InputError(f"--out {folder}: holds something else: must be a new or empty folder, or that of a data set")
    if not empty:
        progress.say(f"{folder}: the data set there will be replaced")
    output_folder(folder.parent)
