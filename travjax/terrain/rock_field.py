"""Rock fields: natural ground made by a process other than the paper's noise, and two sites made with it.

A rock field has fractal relief, ledges, craters, wheel ruts, and rocks on top (landforms.py, with the sources). A seed
gives parameters within RANGES; parameters and seed give the ground. Each landform has its own random numbers, so that
changing one leaves the others as they are. SITES are two sites of different character that stand in for real maps.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from travjax.config import require, require_length, require_number
from travjax.simulation.arrays import integers
from travjax.simulation.grid import Grid
from travjax.terrain.landforms import Nodes, craters, draw_rocks, fractal_relief, lay_rocks, ledges, ruts

STYLE = "rock_field"
"""Name of these maps as a style, beside the five styles of the paper."""

FINEST, MOST_NODES = 0.03, 4097**2
"""Smallest spacing of nodes in metres, and largest number of nodes in a raster."""

_SEED = f"an integer from 0 to {2**32 - 1}"


@dataclass(frozen=True)
class RockFieldParams:
    """Parameters of a rock field; lengths in metres.

    hurst:              Hurst exponent of the relief, 0 to 1
    roughness:          root-mean-square difference of heights 1 m apart
    rock_abundance:     share of the ground that rocks cover, k of Golombek and Rapp (1997)
    smallest_rock, largest_rock: diameters
    rock_height:        mean height over diameter
    crater_density:     craters of at least 1 m per square metre
    smallest_crater, largest_crater: diameters
    crater_freshness:   freshness of the most levelled crater; that of the freshest is 1
    ledge_density:      ledges per metre across them
    lowest_ledge, highest_ledge: heights of their faces
    rut_density:        passes of a vehicle per metre across them
    shallowest_rut, deepest_rut: depths

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    hurst: float = 0.7
    roughness: float = 0.05
    rock_abundance: float = 0.03
    smallest_rock: float = 0.1
    largest_rock: float = 2.0
    rock_height: float = 0.43
    crater_density: float = 0.0
    smallest_crater: float = 1.0
    largest_crater: float = 16.0
    crater_freshness: float = 0.2
    ledge_density: float = 0.0
    lowest_ledge: float = 0.05
    highest_ledge: float = 0.4
    rut_density: float = 0.0
    shallowest_rut: float = 0.05
    deepest_rut: float = 0.15

    def __post_init__(self):
        above_zero = math.nextafter(0, -1)
        require_number("hurst", self.hurst, 0, 1, "a number above 0 and at most 1")
        require_number("roughness", self.roughness, above_zero, 10, "a length in metres from 0 to 10")
        require_number("rock_abundance", self.rock_abundance, above_zero, 0.5, "a share from 0 to 0.5")
        require_number("rock_height", self.rock_height, 0, 1, "a number above 0 and at most 1")
        for name in ("crater_density", "ledge_density", "rut_density"):
            require_number(name, getattr(self, name), above_zero, 1, "a number from 0 to 1")
        require_number("crater_freshness", self.crater_freshness, above_zero, 1, "a number from 0 to 1")
        for low, high, least, most in (
            ("smallest_rock", "largest_rock", 0.02, 10),
            ("smallest_crater", "largest_crater", 0.2, 100),
            ("lowest_ledge", "highest_ledge", 0.001, 10),
            ("shallowest_rut", "deepest_rut", 0.001, 1),
        ):
            require_length(low, getattr(self, low), least, most)
            require_length(high, getattr(self, high), getattr(self, low), most)


RANGES: dict[str, tuple[float, float]] = {
    "hurst": (0.5, 0.8),
    "roughness": (0.02, 0.07),
    "rock_abundance": (0.005, 0.03),
    "rock_height": (0.375, 0.5),
    "crater_density": (0.0, 0.015),
    "crater_freshness": (0.1, 0.6),
    "ledge_density": (0.0, 0.06),
    "rut_density": (0.0, 0.04),
}
"""Ends of the uniform distributions that `sample_rock_field` draws from; other parameters are the defaults.

Hurst exponents are those of most natural surfaces in Shepard et al. (2001); rock abundances lie between those of the
sites of Opportunity and of Pathfinder's surroundings (Golombek et al. 2003).
"""


@dataclass(frozen=True)
class RockSite:
    """A reproducible site: parameters, seed, and metres to the east and to the north."""

    params: RockFieldParams
    seed: int
    size: tuple[float, float]


SITES = {
    "bedrock_flats": RockSite(
        RockFieldParams(
            hurst=0.6,
            roughness=0.03,
            rock_abundance=0.012,
            rock_height=0.4,
            ledge_density=0.08,
            lowest_ledge=0.1,
            rut_density=0.045,
        ),
        seed=2,
        size=(96.0, 64.0),
    ),
    "crater_plain": RockSite(
        RockFieldParams(
            hurst=0.75,
            roughness=0.05,
            rock_abundance=0.02,
            rock_height=0.45,
            crater_density=0.03,
            crater_freshness=0.3,
        ),
        seed=6,
        size=(64.0, 64.0),
    ),
}
"""Layered bedrock with ledges, scattered rocks and wheel tracks; and a rolling plain with craters and more rocks."""


def sample_rock_field(seed: int) -> RockFieldParams:
    """Draws parameters within RANGES; raises InputError for a bad seed."""
    drawn = _generators(seed)[0].uniform(*np.array(list(RANGES.values())).T)
    return RockFieldParams(**dict(zip(RANGES, drawn.tolist(), strict=True)))


def rock_field(params: RockFieldParams, seed: int, shape: tuple[int, int], spacing: float) -> np.ndarray:
    """Returns the ground of a rock field: [rows, cols] float64 metres above the node in the middle.

    seed:    an integer in [0, 2^32)
    shape:   (rows, cols) of the nodes, rows to the north
    spacing: metres between them, at least FINEST
    Raises InputError for bad parameters, seeds, shapes and spacings.
    """
    require(isinstance(params, RockFieldParams), "params", params, "a RockFieldParams")
    nodes = _nodes(shape, spacing)
    _, for_relief, for_ledges, for_craters, for_ruts, for_rocks = _generators(seed)
    ground = fractal_relief(for_relief, nodes, params.hurst, params.roughness)
    ground += ledges(for_ledges, nodes, params.ledge_density, (params.lowest_ledge, params.highest_ledge))
    of_craters = params.smallest_crater, params.largest_crater, (params.crater_freshness, 1.0)
    ground += craters(for_craters, nodes, params.crater_density, *of_craters)
    tracks, driven = ruts(for_ruts, nodes, params.rut_density, (params.shallowest_rut, params.deepest_rut))
    ground += tracks
    of_rocks = params.smallest_rock, params.largest_rock, params.rock_height
    rocks = draw_rocks(for_rocks, nodes, params.rock_abundance, *of_rocks)
    free = [not driven[nodes.nearest(x, y)] for x, y in zip(rocks.x, rocks.y, strict=True)]
    ground = lay_rocks(ground, nodes, rocks.only(np.array(free, bool)))
    return ground - ground[nodes.rows // 2, nodes.cols // 2]


def rock_fields(seeds: Sequence[int], grid: Grid) -> np.ndarray:
    """Returns a rock field for each seed, with parameters drawn from that seed: [n, rows, cols] float32 metres."""
    maps = [rock_field(sample_rock_field(seed), seed, grid.shape, grid.spacing) for seed in seeds]
    return np.array(maps, np.float32)


def site_heights(name: str, spacing: float = 0.0625) -> np.ndarray:
    """Returns the ground of one of SITES: [rows, cols] float64 metres; raises InputError for another name."""
    require(name in SITES, "site", name, f"one of {', '.join(SITES)}")
    site = SITES[name]
    east, north = (round(metres / spacing) + 1 for metres in site.size)
    return rock_field(site.params, site.seed, (north, east), spacing)


def _nodes(shape: Any, spacing: Any) -> Nodes:
    require_number("spacing", spacing, math.nextafter(FINEST, 0), 1, f"metres, from {FINEST:g} to 1")
    allowed = f"(rows, cols), whole numbers from 2, at most {MOST_NODES} nodes"
    pair = isinstance(shape, tuple) and len(shape) == 2 and all(type(one) is int and one > 1 for one in shape)
    require(pair and math.prod(shape) <= MOST_NODES, "shape", shape, allowed)
    rows, cols = shape
    return Nodes(rows, cols, float(spacing))


def _generators(seed: int) -> list[np.random.Generator]:
    """Returns generators for the parameters and for each landform; each is independent of how the others are used."""
    number = integers("seed", seed, _SEED, 0, 2**32 - 1)
    require(number.ndim == 0, "seed", seed, _SEED)
    return [np.random.Generator(np.random.PCG64(one)) for one in np.random.SeedSequence(int(number)).spawn(6)]
