"""Where real maps come from: the configured sites, and the position and rotation of each window."""

import math
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from travjax.config import from_json, load_toml, parts_from_json, require, require_number, to_json
from travjax.rasters.reading_options import DemOptions

SPLITS = ("train", "validation", "test")

SIDES = ("north", "east", "south", "west")

LEAST_GAP = 8.0
"""Metres: ground nearer to held-out ground than the size of the paper's maps resembles it too much."""

Strip = tuple[str, float] | tuple[()]
"""A side and metres, or empty for no strip."""


@dataclass(frozen=True)
class Site:
    """One elevation map and the splits that its windows belong to.

    file:  path from the current folder, or under TRAVJAX_DATA
    name:  group of its windows; the file's stem unless given
    split: split of its windows that lie in no strip
    test_strip, validation_strip: side of the site and metres; windows that lie wholly in this strip along that side
        belong to the split. The strip starts at the edge of the outermost windows
    cell_size, height_scale, nodata, band, classes, up, gdal_drivers, topic, layer, time: as `load_dem` takes them

    Raises InputError that names field, value and what is allowed.
    """

    file: str
    name: str = ""
    split: str = "train"
    test_strip: Strip = ()
    validation_strip: Strip = ()
    cell_size: float | None = None
    height_scale: float | None = None
    nodata: float | None = None
    band: int | str | None = None
    classes: tuple[int, ...] | None = None
    up: str | None = None
    gdal_drivers: tuple[str, ...] = ()
    topic: str | None = None
    layer: str | None = None
    time: float | None = None

    def __post_init__(self):
        require(isinstance(self.file, str) and bool(self.file), "file", self.file, "a non-empty text")
        require(isinstance(self.name, str) and self.name.isprintable(), "name", self.name, "a text of one line")
        require(self.split in SPLITS, "split", self.split, f"one of {', '.join(SPLITS)}")
        for split, strip in self.strips.items():
            _require_strip(f"{split}_strip", strip)
            needless = SPLITS.index(self.split) >= SPLITS.index(split)
            require(not (strip and needless), f"{split}_strip", strip, f"left out where split is {self.split}")
        options = DemOptions(**{field.name: getattr(self, field.name) for field in fields(DemOptions)})
        object.__setattr__(self, "nodata", options.nodata)  # NaN means no value

    @property
    def group(self) -> str:
        """The name of the group of its windows."""
        return self.name or Path(self.file).stem

    @property
    def strips(self) -> dict[str, Strip]:
        """The strips for test and validation, in this order."""
        return {"test": self.test_strip, "validation": self.validation_strip}


def _require_strip(name: str, strip: Any) -> None:
    if strip != ():
        pair = isinstance(strip, tuple) and len(strip) == 2
        require(pair, name, strip, "a side and metres, or left out")
        require(strip[0] in SIDES, name, strip, f"of one of {', '.join(SIDES)}, then metres")
        require_number(f"{name} {strip[0]}", strip[1], 0, 1e6, "metres, above 0")


@dataclass(frozen=True)
class SitesConfig:
    """The configuration of a data set of real maps; a TOML file has a table [[site]] for each site.

    stride:       metres between neighbouring windows
    gap:          smallest distance in metres between a test window and one for training or validation
    max_unknown:  share of unknown nodes above which a window is left out
    rotations:    whether training windows are also added rotated by 90, 180 and 270 degrees
    fill_holes, allow_coarse: as `load_dem` takes them

    Raises InputError that names field, value and what is allowed.
    """

    site: tuple[Site, ...] = field(metadata={"items": Site})
    stride: float = 4.0
    gap: float = LEAST_GAP
    max_unknown: float = 0.1
    rotations: bool = True
    fill_holes: bool = True
    allow_coarse: bool = False

    def __post_init__(self):
        sites = isinstance(self.site, tuple) and all(isinstance(site, Site) for site in self.site)
        require(sites and bool(self.site), "site", self.site, "at least one [[site]]")
        groups = [site.group for site in self.site]
        twice = [group for group in dict.fromkeys(groups) if groups.count(group) > 1]
        require(not twice, "names of sites", twice, "different; give a name to those whose files are called alike")
        require_number("stride", self.stride, 0, 1e6, "a distance in metres, above 0")
        least = math.nextafter(LEAST_GAP, 0)
        require_number("gap", self.gap, least, 1e6, f"a distance in metres, at least {LEAST_GAP:g}")
        share = "a share from 0 to 1"
        require_number("max_unknown", self.max_unknown, math.nextafter(0, -1), 1, share)
        for name in ("rotations", "fill_holes", "allow_coarse"):
            require(type(getattr(self, name)) is bool, name, getattr(self, name), "true or false")

    @staticmethod
    def load(path: str | Path) -> "SitesConfig":
        """Reads the sites from a TOML file; raises InputError when it is missing or wrong."""
        return load_toml(path, SitesConfig)


@dataclass(frozen=True)
class SiteRecord:
    """How a site was read, and how many of its windows went to each split or were left out.

    name:       the group of its maps
    file:       as in `Site`
    sha256, cell_size, covered, filled, unknown: as in `dem.Windows`
    crs:        coordinate system as the file names it, or several
    height_offset: metres, subtracted from the file's heights; None where each map has its own
    windows:    number of windows that were cut
    train, validation, test: how many of these are in each split; rotated copies do not count
    too_unknown: how many were left out for too many unknown nodes or no known trajectory
    near_test:  how many were left out because they lie within the gap around a test window
    shared:     how many were left out because they share ground with a validation window
    """

    name: str
    file: str
    sha256: str
    crs: str | None
    cell_size: float
    height_offset: float | None
    covered: float
    filled: float
    unknown: float
    windows: int
    train: int
    validation: int
    test: int
    too_unknown: int
    near_test: int
    shared: int

    def __post_init__(self):
        for name in ("name", "file", "sha256"):
            require(isinstance(getattr(self, name), str), name, getattr(self, name), "a text")
        require(self.crs is None or isinstance(self.crs, str), "crs", self.crs, "a text, or none")
        for name in ("cell_size", "height_offset", "covered", "filled", "unknown"):
            if name != "height_offset" or self.height_offset is not None:
                require_number(name, getattr(self, name), -math.inf, math.inf, "a number")
        for name in ("windows", *SPLITS, "too_unknown", "near_test", "shared"):
            value = getattr(self, name)
            require(type(value) is int and 0 <= value < 2**63, name, value, "a whole number, at least 0")


@dataclass(frozen=True, eq=False)
class Provenance:
    """Where each of n real maps comes from; the arrays are on the host and must not be changed.

    origin:        [n, 2] float64 x, y of the south-west node of its window, in the site's coordinates, metres
    quarter_turns: [n] uint8, 0 to 3: by how many quarter turns the window was rotated to make the map, about its centre
                   and anticlockwise as seen from above
    config:        the configuration that it was read with
    sites:         a record for each site of `config`, in its order
    """

    origin: np.ndarray
    quarter_turns: np.ndarray
    config: SitesConfig
    sites: tuple[SiteRecord, ...]

    def __post_init__(self):
        names, expected = [site.name for site in self.sites], [site.group for site in self.config.site]
        require(names == expected, "records of sites", names, f"of {', '.join(expected)}")
        wrong = self.quarter_turns[~np.isin(self.quarter_turns, range(4))]
        require(not wrong.size, "quarter_turns", wrong[:1].tolist(), "from 0 to 3")

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by name; each has its own file in a data set."""
        return {name: getattr(self, name) for name in PROVENANCE_ARRAYS}

    def to_json(self) -> dict[str, Any]:
        """Converts everything except the arrays to what JSON can hold."""
        return {"config": to_json(self.config), "sites": [to_json(site) for site in self.sites]}

    @staticmethod
    def from_json(table: Any, origin: np.ndarray, quarter_turns: np.ndarray) -> "Provenance":
        """Restores it from the arrays and the output of `to_json`; raises InputError for anything else."""
        config = parts_from_json(table, {"config": SitesConfig})["config"]
        sites = table.get("sites")
        require(isinstance(sites, list), "sites", sites, "a list of tables")
        return Provenance(origin, quarter_turns, config, tuple(from_json(site, SiteRecord) for site in sites))


PROVENANCE_ARRAYS = ("origin", "quarter_turns")
