"""The results of a site while it is being simulated: arrays on disk, and which tiles are in them.

They are mapped from files, so memory does not grow with the site, and a run that was stopped goes on with the tiles
that are missing.
"""

import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from travjax.config import InputError, require
from travjax.files import save_text
from travjax.site.costs import UNKNOWN_COST
from travjax.site.tiling import Part

FOLDER = "unfinished-map"
"""Name of the folder in that of the results; it is removed at the end."""


@dataclass(frozen=True, eq=False)
class Store:
    """Arrays of a site, mapped from files; row 0 is the northernmost, as in GeoTIFF.

    bands: metres, shares and counts of costs.band_names; costs: of each heading; heights: metres, of the places
    done:  which tiles are in the arrays
    """

    folder: Path
    bands: Float[np.ndarray, "b r c"]
    costs: UInt8[np.ndarray, "h r c"]
    heights: Float[np.ndarray, "r c"]
    done: Bool[np.ndarray, " tiles"]

    @staticmethod
    def open(out: Path, settings: dict[str, Any], bands: int, headings: int, lattice: tuple[int, int], tiles: int):
        """Opens the arrays of an interrupted run of the same settings in the folder `out`, or makes new ones.

        Raises InputError when they cannot be written.
        """
        folder, text = out / FOLDER, json.dumps(settings, sort_keys=True)
        require(not folder.is_file(), "--out", str(out), f"a folder without a file called {FOLDER}")
        kept = folder / "settings.json"
        if not (kept.is_file() and kept.read_text(encoding="utf-8") == text):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(exist_ok=True)
        arrays = {
            "bands": ((bands, *lattice), np.float32, np.nan),
            "costs": ((headings, *lattice), np.uint8, UNKNOWN_COST),
            "heights": (lattice, np.float32, np.nan),
            "done": ((tiles,), bool, False),
        }
        try:
            mapped = [_mapped(folder / f"{name}.npy", *array) for name, array in arrays.items()]
        except OSError as error:
            shutil.rmtree(folder, ignore_errors=True)
            raise InputError(f"{folder}: cannot be written: {error.strerror or error}") from None
        save_text(kept, text)
        return Store(folder, *mapped)

    def add(self, number: int, part: Part) -> None:
        """Puts the part of a tile into the arrays."""
        rows, cols = part.tile.within(self.heights.shape)
        top = len(self.heights) - rows.stop
        place = ..., slice(top, top + rows.stop - rows.start), cols
        for array, values in ((self.bands, part.bands), (self.costs, part.costs), (self.heights, part.heights)):
            array[place] = values[..., ::-1, :]
        self.done[number] = True

    def remove(self) -> None:
        """Removes the files."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _mapped(path: Path, shape: tuple[int, ...], dtype, unknown) -> np.ndarray:
    if path.is_file():
        return np.lib.format.open_memmap(path, mode="r+")
    array = np.lib.format.open_memmap(path, mode="w+", dtype=dtype, shape=shape)
    with path.open("r+b") as file:
        os.posix_fallocate(file.fileno(), 0, path.stat().st_size)  # a full disk would end the process without a word
    array[...] = unknown
    return array
