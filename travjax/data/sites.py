"""Real maps as a data set: windows of sites, split so that training and test share no ground (SPEC section 11).

Windows are assigned in this order:
1. Windows with too many unknown nodes or without any known trajectory are left out.
2. Windows of test sites, and those that lie wholly in a test strip, are for testing.
3. Other windows that are nearer than the gap to a test window on the same ground are left out.
4. Windows of validation sites, and those that lie wholly in a validation strip, are for validation.
5. Other windows that share ground with a validation window, even just the nodes of an edge, are left out.
6. The rest is for training; copies rotated by 90, 180 and 270 degrees are added and labelled separately.

Positions of windows are compared in file coordinates where files name the same coordinate system, and on the planet,
with a tolerance of some metres, where they name different ones. A file with a local system or none is not compared with
others, and counts as separate ground.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np

from travjax.config import InputError
from travjax.data.dataset import MAPS_AT_ONCE, Dataset, Progress
from travjax.data.dem import Windows, load_dem
from travjax.data.provenance import SPLITS, Provenance, Site, SiteRecord, SitesConfig, Strip
from travjax.data.sampling import are_known
from travjax.files import find_data
from travjax.rasters.coordinates import is_local, places
from travjax.simulation.events import UNKNOWN_LABEL
from travjax.simulation.grid import Grid
from travjax.simulation.setup import Setup
from travjax.traversal.traverse import packed_labels


class Assignment(IntEnum):
    """The split of a window, numbered as in SPLITS, or the reason why it is left out; named as in SiteRecord."""

    TRAIN = 0
    VALIDATION = 1
    TEST = 2
    TOO_UNKNOWN = 3
    NEAR_TEST = 4
    SHARED = 5


TOLERANCE = 1e-6
"""Metres by which positions of windows may be wrong."""

DOUBT = 10.0
"""Metres by which positions in two coordinate systems may disagree: other frame realisations, missing grids."""


def read(config: SitesConfig, setup: Setup, on_progress: Progress | None = None) -> Dataset:
    """Cuts, labels and splits the windows of the sites, site by site; rotated copies come last.

    on_progress is called with the number of maps that were labelled. Raises InputError when robot, actions and grid do
    not fit together, when a file is missing, cannot be read or is given twice, and when a site has no window left for a
    split that was asked for.
    """
    setup.require_fit()
    grid = setup.grid
    found = [_windows(site, config, grid) for site in config.site]
    _require_different(found)
    label = lambda heights: _labels(heights, setup, on_progress)
    windows = _Candidates(found)
    labels = np.full((len(windows.site), len(setup.actions)), UNKNOWN_LABEL, np.uint8)
    for some, heights in windows.batches():
        enough = np.isnan(heights).mean(axis=(1, 2)) <= config.max_unknown
        labels[some[enough]] = label(heights[enough])
    known = np.asarray(are_known(labels).any(axis=1))
    assignment = _assignments(config, windows, known, grid.size)
    records = _records(config, found, windows.site, assignment)
    _require_all(config, records, found, grid.size)

    kept = np.flatnonzero(assignment <= Assignment.TEST)
    copied = np.flatnonzero(assignment == Assignment.TRAIN) if config.rotations else kept[:0]
    source = np.concatenate([kept, *[copied] * 3])
    turns = np.repeat(np.arange(4, dtype=np.uint8), [len(kept), *[len(copied)] * 3])
    heights = np.empty((len(source), *grid.shape), np.float32)
    heights[: len(kept)] = windows.read(kept)
    for quarter in (1, 2, 3):
        heights[turns == quarter] = turned(heights[np.searchsorted(kept, copied)], quarter)
    return Dataset(
        heights=heights,
        labels=np.concatenate([labels[kept], label(heights[len(kept) :])]),
        group=np.array([site.group for site in config.site])[windows.site[source]],
        seed=np.zeros(len(source), np.uint32),
        split=assignment[source],
        setup=setup,
        config=None,
        provenance=Provenance(windows.origin[source], turns, config, records),
    )


def turned(heights: np.ndarray, quarter_turns: int) -> np.ndarray:
    """Rotates maps [..., rows, cols] anticlockwise about their centre, with x to the east and y to the north."""
    return np.rot90(heights, -quarter_turns, axes=(-2, -1))  # rows go north, so np.rot90 turns the other way


@dataclass(frozen=True, eq=False)
class _Candidates:
    """The windows of all sites.

    found: the windows of each site
    """

    found: list[Windows]

    @cached_property
    def origin(self) -> np.ndarray:
        return np.concatenate([windows.origins for windows in self.found])

    @cached_property
    def site(self) -> np.ndarray:
        """The index of the site of each window: [n]."""
        return np.repeat(np.arange(len(self.found)), [len(windows) for windows in self.found])

    @cached_property
    def system(self) -> np.ndarray:
        """The name of the coordinate system of each window, or a name for the site where the system is local: [n]."""
        names = np.concatenate([windows.systems() for windows in self.found]).astype(object)
        own = [index for index, name in enumerate(names) if is_local(name or None)]
        names[own] = [f"site {site}" for site in self.site[own]]
        return names

    def batches(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yields the indices [k] and heights [k, rows, cols] of a few windows at a time."""
        first = 0
        for windows in self.found:
            for start in range(0, len(windows), MAPS_AT_ONCE):
                heights = windows.read(slice(start, start + MAPS_AT_ONCE))
                yield first + start + np.arange(len(heights)), heights
            first += len(windows)

    def read(self, which: np.ndarray) -> np.ndarray:
        """Returns the heights of some windows, [k, rows, cols]; which: [k] in rising order."""
        sites = self.site[which]
        first = np.cumsum([0, *(len(windows) for windows in self.found)])
        return np.concatenate([self.found[one].read(which[sites == one] - first[one]) for one in np.unique(sites)])

    def places(self, size: float) -> dict[float, tuple[np.ndarray, np.ndarray]]:
        """Returns the centres of windows on each planet, by its radius: indices [k] and positions [k, 3] in metres."""
        found: dict[float, list[tuple[np.ndarray, np.ndarray]]] = {}
        for name in dict.fromkeys(self.system):
            if not name.startswith("site "):
                here = np.flatnonzero(self.system == name)
                planet, xyz = places(name, *(self.origin[here] + size / 2).T)
                found.setdefault(planet, []).append((here, xyz))
        return {
            planet: (np.concatenate([here for here, _ in parts]), np.concatenate([xyz for _, xyz in parts]))
            for planet, parts in found.items()
        }


def _windows(site: Site, config: SitesConfig, grid: Grid) -> Windows:
    path = find_data(site.file, f"site {site.group}: file")
    return load_dem(
        path,
        config.stride,
        grid=grid,
        cell_size=site.cell_size,
        height_scale=site.height_scale,
        nodata=site.nodata,
        band=site.band,
        classes=site.classes,
        up=site.up,
        gdal_drivers=site.gdal_drivers,
        topic=site.topic,
        layer=site.layer,
        time=site.time,
        fill_holes=config.fill_holes,
        allow_coarse=config.allow_coarse,
    )


def _require_different(found: list[Windows]) -> None:
    first: dict[str, str] = {}
    for windows in found:
        if windows.sha256 in first:
            raise InputError(f"{windows.path}: holds the same as {first[windows.sha256]}: must be given once")
        first[windows.sha256] = windows.path


def _labels(heights: np.ndarray, setup: Setup, on_progress: Progress | None) -> np.ndarray:
    """Simulates all trajectories of maps and returns their labels: [n, t] uint8."""
    labels = np.empty((len(heights), len(setup.actions)), np.uint8)
    for start in range(0, len(heights), MAPS_AT_ONCE):
        chunk = slice(start, min(start + MAPS_AT_ONCE, len(heights)))
        labels[chunk] = packed_labels(heights[chunk], setup)
        if on_progress:
            on_progress(chunk.stop - start)
    return labels


def _assignments(config: SitesConfig, windows: _Candidates, known: np.ndarray, size: float) -> np.ndarray:
    """Returns the Assignment of each window: [n] uint8; known: [n] bool, whether any trajectory is known."""
    asked = {split: _asked_for(split, config, windows, size) for split in ("validation", "test")}
    assignment = np.full(len(known), Assignment.TRAIN, np.uint8)
    assignment[~known] = Assignment.TOO_UNKNOWN
    assignment[known & asked["test"]] = Assignment.TEST
    near_test = _near(windows, assignment == Assignment.TEST, size, size + config.gap - TOLERANCE)
    assignment[(assignment == Assignment.TRAIN) & near_test] = Assignment.NEAR_TEST
    assignment[(assignment == Assignment.TRAIN) & asked["validation"]] = Assignment.VALIDATION
    touching = _near(windows, assignment == Assignment.VALIDATION, size, size + TOLERANCE)
    assignment[(assignment == Assignment.TRAIN) & touching] = Assignment.SHARED
    return assignment


def _asked_for(split: str, config: SitesConfig, windows: _Candidates, size: float) -> np.ndarray:
    """Tells which windows belong to sites of a split or lie in its strips: [n] bool."""
    asked = np.zeros(len(windows.site), bool)
    for index, site in enumerate(config.site):
        members = windows.site == index
        inside = _in_strip(windows.origin[members], site.strips[split], size)
        asked[members] = inside | (site.split == split)
    return asked


def _in_strip(origin: np.ndarray, strip: Strip, size: float) -> np.ndarray:
    """Tells which windows of a site, at [n, 2], lie wholly in a strip along its outermost windows: [n] bool."""
    if not strip:
        return np.zeros(len(origin), bool)
    side, metres = strip
    along = origin[:, 0 if side in ("east", "west") else 1]
    beyond = along - along.min() if side in ("south", "west") else along.max() - along
    return beyond + size <= metres + TOLERANCE


def _near(windows: _Candidates, others: np.ndarray, size: float, reach: float) -> np.ndarray:
    """Tells which windows have one of the `others` [n] bool on the same ground within reach: [n] bool.

    size:  metres, edge of a window
    reach: metres between south-west nodes, along the axis in which they lie farther apart; windows touch at `size`
    """
    from scipy.spatial import KDTree  # takes 0.2 s to import

    near = np.zeros(len(others), bool)
    for system in dict.fromkeys(windows.system[others]):
        here = windows.system == system
        distance, _ = KDTree(windows.origin[here & others]).query(windows.origin[here], p=np.inf)
        near[here] = distance < reach
    if len(dict.fromkeys(windows.system)) == 1:
        return near
    apart = reach + (np.sqrt(2) - 1) * size + DOUBT  # between centres, whatever the rotation of the windows
    for index, xyz in windows.places(size).values():
        held = others[index]
        for system in dict.fromkeys(windows.system[index[held]]):
            own = windows.system[index] == system
            distance, _ = KDTree(xyz[held & own]).query(xyz[~own])
            near[index[~own]] |= distance < apart
    return near


def _records(
    config: SitesConfig, found: list[Windows], site: np.ndarray, assignment: np.ndarray
) -> tuple[SiteRecord, ...]:
    read = ("sha256", "cell_size", "covered", "filled", "unknown")

    def records() -> Iterator[SiteRecord]:
        for index, windows in enumerate(found):
            counts = np.bincount(assignment[site == index], minlength=len(Assignment)).tolist()
            assignments = {one.name.lower(): count for one, count in zip(Assignment, counts, strict=True)}
            as_read: dict[str, Any] = {name: getattr(windows, name) for name in read}
            as_read["crs"] = ", ".join(dict.fromkeys(windows.systems())) or None
            as_read["height_offset"] = windows.height_offset if isinstance(windows.height_offset, float) else None
            site_of = config.site[index]
            yield SiteRecord(site_of.group, site_of.file, **as_read, windows=sum(counts), **assignments)

    return tuple(records())


def _require_all(config: SitesConfig, records: tuple[SiteRecord, ...], found: list[Windows], size: float) -> None:
    """Raises InputError if a requested split has no window, with the use that the site's windows were put to."""
    for site, record, windows in zip(config.site, records, found, strict=True):
        strips = {split: strip for split, strip in site.strips.items() if strip}
        for split in dict.fromkeys([*strips, site.split]):
            if getattr(record, split):
                continue
            east, north = np.ptp(windows.origins, axis=0) + size
            strip = strips.get(split)
            what = f"{split}_strip = {strip[0]} {strip[1]:g} m" if strip else f"split = {split}"
            kept = ", ".join(f"{getattr(record, other)} {other}" for other in SPLITS if other != split)
            raise InputError(
                f"site {site.group}: {what}: must leave at least one of {record.windows} windows, which are {size:g} m "
                f"and span {east:g} x {north:g} m; now {kept}, {record.too_unknown} left out as unknown, "
                f"{record.near_test} near the test, {record.shared} sharing ground with validation"
            )
