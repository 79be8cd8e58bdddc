"""The data set: maps, the labels of all their trajectories, and which split each map belongs to (SPEC section 7).

`generate` makes it from one seed, all in memory, and sites.py makes one from real maps. `save` and `load` store it as a
folder of .npy files with a `dataset.json` that holds the configurations and each file's size and SHA-256.
"""

import hashlib
import json
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np

from travjax.config import (
    InputError,
    naming,
    parts_from_json,
    read_json,
    require,
    require_number,
    to_json,
)
from travjax.data.dataset_json import FORMAT, FORMAT_VERSION, digest, files_of, read_table
from travjax.data.provenance import PROVENANCE_ARRAYS, SPLITS, Provenance
from travjax.data.sampling import Samples, random_keys
from travjax.files import atomic_write_folder, put_back, sha256, user_path
from travjax.simulation.events import label_codes
from travjax.simulation.setup import PARTS, Setup, WithSetup
from travjax.terrain.styles import STYLES, generate_terrain, require_world
from travjax.traversal.traverse import packed_labels, unpacked

ARRAYS = ("heights", "labels", "group", "seed", "split")
"""Each array has its own file, `heights.npy` and so on; data sets of real maps also have PROVENANCE_ARRAYS."""

MAPS_AT_ONCE = 256
"""Number of maps that are made and labelled before they are copied into the arrays."""

Progress = Callable[[int], object]


@dataclass(frozen=True)
class DatasetConfig:
    """The configuration of a synthetic data set.

    maps:             number of maps; the five styles alternate
    seed:             determines the terrain seeds and the splits
    validation, test: shares of the maps; the rest is for training
    world:            metres, the map size that terrain features scale with; the size of the maps unless given
    """

    maps: int = 56_840
    seed: int = 0
    validation: float = 0.08
    test: float = 0.02
    world: float | None = None

    def __post_init__(self):
        whole = lambda value: isinstance(value, Integral) and not isinstance(value, bool)
        require(whole(self.maps) and 1 <= self.maps <= 10**7, "maps", self.maps, "a whole number from 1 to 10000000")
        require(whole(self.seed) and 0 <= self.seed < 2**63, "seed", self.seed, "a whole number from 0 to 2^63 - 1")
        for name in ("validation", "test"):
            require_number(name, getattr(self, name), -math.inf, 1, "a share from 0 to 1")
            require(getattr(self, name) >= 0, name, getattr(self, name), "a share from 0 to 1")
        require_world(self.world)
        require(self.validation + self.test <= 1, "validation + test", self.validation + self.test, "at most 1")

    def styles(self) -> np.ndarray:
        """Returns the style of each map: [n] texts."""
        return np.resize(np.array(STYLES), self.maps)

    def seeds(self) -> np.ndarray:
        """Draws the terrain seed of each map: [n] uint32, all different.

        Data sets with different seeds or sizes have practically no map in common.
        """
        spare = 64 + self.maps // 16  # replaces the few seeds that are drawn twice
        keys = random_keys(("terrain", (self.seed, self.maps)), np.arange(self.maps + spare)) >> np.uint64(32)
        first = np.sort(np.unique(keys, return_index=True)[1])
        return keys[first[: self.maps]].astype(np.uint32)

    def split_sizes(self) -> tuple[int, int, int]:
        """Returns the number of maps in each of SPLITS: the shares rounded down, the rest for training.

        The paper's 56,840 maps give 51157, 4547 and 1136, which is its number of test maps. With three maps or more
        each split whose share is not 0 has at least one.
        """
        test, validation = (math.floor(share * self.maps + 1e-9) for share in (self.test, self.validation))
        sizes = [self.maps - validation - test, validation, test]
        shares = (1 - self.validation - self.test, self.validation, self.test)
        for index, share in enumerate(shares):
            if self.maps >= len(SPLITS) and share > 1e-9 and not sizes[index]:
                sizes[sizes.index(max(sizes))] -= 1
                sizes[index] = 1
        return tuple(sizes)  # type: ignore[return-value]

    def splits(self) -> np.ndarray:
        """Assigns each map to a split: [n] uint8 index into SPLITS; in a split, styles differ by at most one map.

        The maps of each style are shuffled among the places of that style, and each split takes consecutive places.
        """
        keys = random_keys(("split", (self.seed, self.maps)), np.arange(self.maps))
        order = np.arange(self.maps)
        for style in range(len(STYLES)):
            members = order[style :: len(STYLES)]
            order[style :: len(STYLES)] = members[np.argsort(keys[members], kind="stable")]
        split = np.empty(self.maps, np.uint8)
        split[order] = np.repeat(np.arange(len(SPLITS), dtype=np.uint8), self.split_sizes())
        return split


@dataclass(frozen=True, eq=False)
class Dataset(WithSetup):
    """Maps, labels and splits; the arrays are on the host and must not be changed.

    heights: [n, rows, cols] float32 metres, NaN unknown
    labels:  [n, t] uint8, one byte per trajectory as traverse.py packs them
    group:   [n] name of the style (if there is a `config`) or of the site
    seed:    [n] uint32 terrain seed; 0 for real maps
    split:   [n] uint8 index into SPLITS
    setup:   robot, action space and grid that the labels are valid for
    config:  configuration of synthetic maps; None for real maps
    provenance: where real maps come from; None if unknown

    Raises InputError when the arrays do not match each other.
    """

    heights: np.ndarray
    labels: np.ndarray
    group: np.ndarray
    seed: np.ndarray
    split: np.ndarray
    setup: Setup
    config: DatasetConfig | None
    provenance: Provenance | None = None

    def __post_init__(self):
        require(not (self.config and self.provenance), "provenance", "given", "left out where there is a config")
        maps = self.config.maps if self.config else np.size(self.split)
        require(maps > 0, "split", [], "of one map at least")
        expected = {
            "heights": ((maps, *self.grid.shape), "f4"),
            "labels": ((maps, len(self.actions)), "u1"),
            "group": ((maps,), "U"),
            "seed": ((maps,), "u4"),
            "split": ((maps,), "u1"),
            "origin": ((maps, 2), "f8"),
            "quarter_turns": ((maps,), "u1"),
        }
        for name, array in self.arrays.items():
            shape, kind = expected[name]
            fits = array.shape == shape and kind in (array.dtype.kind, array.dtype.str[1:]) and array.dtype.isnative
            allowed = f"{list(shape)} of {'text' if kind == 'U' else np.dtype(kind)}"
            require(fits, name, f"{list(array.shape)} of {array.dtype}", allowed)
        wrong = self.split[self.split >= len(SPLITS)]
        require(not wrong.size, "split", wrong[:1].tolist(), f"from 0 to {len(SPLITS) - 1}: {', '.join(SPLITS)}")
        largest = int(self.labels.max(initial=0))
        codes = label_codes(len(self.robot.events))
        require(largest < codes, "labels", largest, f"from 0 to {codes - 1}")
        groups = STYLES if self.config else self.provenance and [site.name for site in self.provenance.sites]
        unknown = self.group[~np.isin(self.group, groups)] if groups else self.group[:0]
        require(not unknown.size, "group", unknown[:1].tolist(), f"of {', '.join(groups or ())}")

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays by name; those of the provenance come last."""
        return {name: getattr(self, name) for name in ARRAYS} | (self.provenance.arrays if self.provenance else {})

    @cached_property
    def fingerprint(self) -> str:
        """A hash that identifies the data set: labels, seeds, groups, splits, and heights and origins of real maps."""
        digest = hashlib.sha256("\n".join(self.group).encode(errors="surrogatepass"))
        places = [] if self.config else [self.heights, *(self.provenance.arrays.values() if self.provenance else ())]
        for array in (self.labels, self.seed, self.split, *places):
            digest.update(np.ascontiguousarray(array).data)
        return digest.hexdigest()[:16]

    def maps_of(self, split: str) -> np.ndarray:
        """Returns the indices of the maps of "train", "validation" or "test": [k]."""
        require(split in SPLITS, "split", split, f"one of {', '.join(SPLITS)}")
        return np.flatnonzero(self.split == SPLITS.index(split))

    def failed(self, samples: Samples) -> np.ndarray:
        """Returns the failures of samples: [k, events] bool."""
        return np.asarray(unpacked(self.labels[samples], self.robot)[0])


def generate(config: DatasetConfig, setup: Setup, on_progress: Progress | None = None) -> Dataset:
    """Makes and labels the maps; the same arguments give the same data set.

    on_progress is called with the number of maps that were added. Needs memory for the arrays, 4.0 GB for the paper's
    56,840 maps, and a few hundred MB more. Raises InputError when robot, actions and grid do not fit together.
    """
    setup.require_fit()
    styles, seeds = config.styles(), config.seeds()
    heights = np.empty((config.maps, *setup.grid.shape), np.float32)
    labels = np.empty((config.maps, len(setup.actions)), np.uint8)
    for start in range(0, config.maps, MAPS_AT_ONCE):
        chunk = slice(start, min(start + MAPS_AT_ONCE, config.maps))
        made = generate_terrain(styles[chunk].tolist(), seeds[chunk], grid=setup.grid, world=config.world)
        labels[chunk] = packed_labels(made, setup)
        heights[chunk] = made
        if on_progress:
            on_progress(chunk.stop - start)
    return Dataset(heights, labels, styles, seeds, config.splits(), setup, config)


def configs_to_json(dataset: Dataset) -> dict[str, Any]:
    """Converts all of a data set except its arrays to what JSON can hold, with the version of travjax."""
    config = dataset.config and to_json(dataset.config)
    table = dataset.setup.to_json() | {"config": config, "travjax": version("travjax")}
    return table | ({"provenance": dataset.provenance.to_json()} if dataset.provenance else {})


def dataset_from_arrays(table: dict[str, Any], arrays: dict[str, np.ndarray]) -> Dataset:
    """Restores a data set from its arrays and the output of `configs_to_json`; raises InputError for anything else."""
    synthetic = table.get("config") is not None
    parts = parts_from_json(Setup.parts_of(table), PARTS | ({"config": DatasetConfig} if synthetic else {}))
    config = parts.pop("config", None)
    places = {name: array for name, array in arrays.items() if name in PROVENANCE_ARRAYS}
    provenance = Provenance.from_json(table["provenance"], **places) if "provenance" in table else None
    own = {name: arrays[name] for name in ARRAYS}
    return Dataset(**own, setup=Setup(**parts), config=config, provenance=provenance)


def save(dataset: Dataset, folder: str | Path, on_progress: Progress | None = None) -> None:
    """Writes the data set to a folder, completely or not at all; an existing data set there is replaced.

    on_progress is called with the number of bytes that were added. Raises InputError when the folder holds something
    else or cannot be written (disk full, no permission).
    """
    with atomic_write_folder(user_path(folder), is_dataset) as temporary:
        arrays = {f"{name}.npy": array for name, array in dataset.arrays.items()}
        files = {name: _write(temporary / name, array, on_progress) for name, array in arrays.items()}
        table = {"format": FORMAT, "version": FORMAT_VERSION} | configs_to_json(dataset) | {"files": files}
        (temporary / "dataset.json").write_text(json.dumps(table | {"sha256": digest(table)}, indent=1) + "\n")


def load(folder: str | Path) -> Dataset:
    """Reads a data set that `save` wrote.

    Raises InputError, which names folder, file and fault, when something is missing, truncated, altered, inconsistent
    or of another format version.
    """
    folder = user_path(folder)
    put_back(folder)
    require(folder.is_dir(), "data set", str(folder), "a folder that travjax wrote; there is none")
    path = folder / "dataset.json"
    table = read_table(path)
    names = ARRAYS + (PROVENANCE_ARRAYS if "provenance" in table else ())
    for name, (size, checksum) in files_of(table, names, path).items():
        _verify(folder / name, size, checksum)
    arrays = {name: _read_array(folder / f"{name}.npy") for name in names}
    try:
        with naming(folder):
            return dataset_from_arrays(table, arrays)
    except InputError as error:
        raise InputError(f"{folder}: {error}") from None


load_dataset = load
"""The public name of `load`, `travjax.load_dataset`."""


def _read_array(path: Path) -> np.ndarray:
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy warns of headers that it did not write
            array = np.load(file, allow_pickle=False)
    except Exception as error:  # NumPy raises many kinds of error for files that hold no array
        reason = str(error).partition(". ")[0] or type(error).__name__
        raise InputError(f"{path}: cannot be read as an array: {reason}") from None
    require(isinstance(array, np.ndarray), str(path), type(array).__name__, "a .npy file of one array")
    return array


def _verify(path: Path, size: int, expected: str) -> None:
    try:
        found = path.stat().st_size
        if found != size:
            raise InputError(f"{path}: {found} bytes: must be {size}; it was truncated or overwritten")
        digest = sha256(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    if digest != expected:
        raise InputError(f"{path}: has been altered: its SHA-256 is {digest[:12]}..., and was {expected[:12]}...")


class _Hashing:
    """A writable file that hashes and counts the bytes written to it."""

    def __init__(self, file, on_progress: Progress | None):
        self.file, self.on_progress = file, on_progress
        self.sha256, self.bytes = hashlib.sha256(), 0

    def write(self, data: bytes) -> None:
        self.file.write(data)
        self.sha256.update(data)
        self.bytes += len(data)
        if self.on_progress:
            self.on_progress(len(data))


def _write(path: Path, array: np.ndarray, on_progress: Progress | None) -> dict[str, Any]:
    """Writes a .npy file piece by piece, and returns its size and checksum."""
    with path.open("wb") as file:
        hashing = _Hashing(file, on_progress)
        np.lib.format.write_array(hashing, array, allow_pickle=False)
    return {"bytes": hashing.bytes, "sha256": hashing.sha256.hexdigest()}


def is_dataset(folder: Path) -> bool:
    """Tells whether the folder holds a data set of any version and nothing else."""
    try:
        table = read_json(folder / "dataset.json")
        ours = {"dataset.json", *(f"{name}.npy" for name in ARRAYS + PROVENANCE_ARRAYS)}
        described = isinstance(table, dict) and table.get("format") == FORMAT
        return described and {path.name for path in folder.iterdir()} <= ours
    except (OSError, InputError):
        return False
