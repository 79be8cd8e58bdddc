"""Landforms of natural ground: fractal relief, rocks, craters, ledges and wheel ruts, each by rules of the literature.

Every function draws from its own generator and works on the `Nodes` of a raster. Most return what they add to the
ground, [rows, cols] float64 metres; rocks are laid on the existing ground. Everything except the fractal relief is
drawn in metres, so that the same landforms come out at any spacing of the nodes.
"""

import math
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from scipy.fft import next_fast_len

LONGEST_WAVE = 16.0
"""Metres: smallest period of the fractal relief that a small raster is cut out of."""

ROCK_SIDES = (0.6, 1.0)
"""Width over length of a rock's outline, drawn uniformly."""

ROCK_SHAPES = (2.0, 3.5)
"""Exponent of a rock's superellipse, drawn uniformly: 2 is an ellipse, larger ones are blocks with rounded edges."""

ROCK_BURIAL = (0.0, 0.6)
"""Height above a rock's widest section at which the ground cuts it, over its upper half-height; drawn uniformly."""

ROCK_HEIGHTS = (0.7, 1.3)
"""Height of a rock over its diameter, as a multiple of the mean; drawn uniformly."""

CRATER_DEPTH, CRATER_RIM = 0.2, 0.04
"""Depth from rim to floor and height of the rim of a fresh crater, over its diameter (Pike 1977; Melosh 1989)."""

CRATER_REACH = 3.0
"""Distance, in crater radii, at which the ejecta end."""

BACKSLOPE = 4.0
"""Metres over which the ground behind a ledge falls off to 1/e of the ledge's height."""

RUT_GAUGE, RUT_HALF_WIDTH = 1.5, 0.16
"""Metres between the middles of two ruts, and half the width of one: those of an off-road vehicle."""

KNOTS = 0.05
"""Metres between the points at which waves along a line are computed; between them they are interpolated."""

BERM = 0.35
"""Height of the berms beside a rut over its depth."""


@dataclass(frozen=True)
class Nodes:
    """The nodes of a raster, the middle one at (0, 0).

    rows, cols: numbers of nodes to the north and to the east
    spacing:    metres between neighbouring nodes
    """

    rows: int
    cols: int
    spacing: float

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.rows, self.cols

    @cached_property
    def x(self) -> np.ndarray:
        """Metres to the east of the middle: [cols]."""
        return (np.arange(self.cols) - self.cols // 2) * self.spacing

    @cached_property
    def y(self) -> np.ndarray:
        """Metres to the north of the middle: [rows]."""
        return (np.arange(self.rows) - self.rows // 2) * self.spacing

    def area(self, beyond: float) -> float:
        """Returns the area in square metres of the raster with a margin of `beyond` metres around it."""
        return (np.ptp(self.x) + 2 * beyond) * (np.ptp(self.y) + 2 * beyond)

    def places(self, rng: np.random.Generator, count: int, beyond: float) -> np.ndarray:
        """Returns uniform random points (x, y) on the raster and a margin of `beyond` metres: [count, 2]."""
        low = np.array([self.x[0], self.y[0]]) - beyond
        high = np.array([self.x[-1], self.y[-1]]) + beyond
        return rng.uniform(low, high, (count, 2))

    def around(self, x: float, y: float, reach: float) -> tuple[slice, slice]:
        """Returns rows and columns of the nodes within a square around a point, empty where there are none."""
        return _within(self.y, y, reach, self.spacing), _within(self.x, x, reach, self.spacing)

    def nearest(self, x: float, y: float) -> tuple[int, int]:
        """Returns row and column of the node nearest to a point, on the edge for a point outside."""
        row = math.floor((y - self.y[0]) / self.spacing + 0.5)
        col = math.floor((x - self.x[0]) / self.spacing + 0.5)
        return min(max(row, 0), self.rows - 1), min(max(col, 0), self.cols - 1)


def _within(axis: np.ndarray, middle: float, reach: float, spacing: float) -> slice:
    first = math.ceil((middle - reach - axis[0]) / spacing)
    last = math.floor((middle + reach - axis[0]) / spacing)
    return slice(min(max(first, 0), len(axis)), min(max(last + 1, 0), len(axis)))


def fractal_relief(rng: np.random.Generator, nodes: Nodes, hurst: float, roughness: float) -> np.ndarray:
    """Returns a fractional Brownian surface by spectral synthesis, cut out of one of twice the size to hide its period.

    hurst:     Hurst exponent H: the root-mean-square difference of heights at a distance r is proportional to r^H
    roughness: metres, the expected value of that difference at 1 m
    Source: Shepard et al. (2001), The roughness of natural terrain, J. Geophys. Res. 106(E12), 32777-32795.
    """
    rows, cols = (
        next_fast_len(max(2 * count, math.ceil(LONGEST_WAVE / nodes.spacing)), real=True) for count in nodes.shape
    )
    along_y = np.fft.fftfreq(rows, nodes.spacing)[:, None]
    along_x = np.fft.rfftfreq(cols, nodes.spacing)[None, :]
    frequency = np.hypot(along_y, along_x)
    frequency[0, 0] = np.inf
    amplitude = frequency ** -(hurst + 1)
    twice = np.full(len(along_x[0]), 2.0)  # these frequencies also stand for their negatives
    twice[0] = 1
    if cols % 2 == 0:
        twice[-1] = 1
    power = (amplitude**2 * twice).sum(axis=1)
    difference = 2 * (power * (1 - np.cos(2 * np.pi * along_y[:, 0]))).sum() / (rows * cols)
    spectrum = np.fft.rfft2(rng.standard_normal((rows, cols))) * amplitude
    relief = np.fft.irfft2(spectrum, (rows, cols))[: nodes.rows, : nodes.cols]
    return relief * (roughness / math.sqrt(difference))


# ---- Rocks


@dataclass(frozen=True)
class Rocks:
    """Rocks on the ground: [n] arrays.

    diameter:      metres; the outline has the area of a circle of that diameter
    x, y:          metres, position of the middle
    height:        metres above the ground at the middle
    heading:       radians, direction of the longer axis, anticlockwise from +y
    sides:         width over length
    exponent:      exponent of the superellipse
    burial:        as in ROCK_BURIAL
    """

    diameter: np.ndarray
    x: np.ndarray
    y: np.ndarray
    height: np.ndarray
    heading: np.ndarray
    sides: np.ndarray
    exponent: np.ndarray
    burial: np.ndarray

    def only(self, chosen: np.ndarray) -> "Rocks":
        """Returns the chosen rocks."""
        return Rocks(*(getattr(self, field.name)[chosen] for field in fields(self)))


def rock_area(diameter, abundance: float):
    """Returns the share of the ground that rocks of at least a diameter [m] cover, F(D) = k exp(-q(k) D).

    abundance: k, the share that all rocks together cover; q(k) = 1.79 + 0.152 / k
    Source: Golombek and Rapp (1997), Size-frequency distributions of rocks on Mars and Earth analog sites,
    J. Geophys. Res. 102(E2), 4117-4129.
    """
    return abundance * np.exp(-(1.79 + 0.152 / abundance) * np.asarray(diameter))


def draw_rocks(
    rng: np.random.Generator, nodes: Nodes, abundance: float, smallest: float, largest: float, height: float
) -> Rocks:
    """Draws rocks between two diameters [m] by `rock_area`, anywhere on the raster and around it.

    height: mean height over diameter. Golombek et al. (2003, J. Geophys. Res. 108(E12), 8086) take 0.5 for safety,
    Golombek and Rapp (1997) measured 3/8 to 1/2
    """
    edges = np.geomspace(smallest, largest, 257)
    area = -np.diff(rock_area(edges, abundance)) if abundance else np.zeros(256)
    count = area / (np.pi / 4 * edges[:-1] * edges[1:])  # rocks per square metre in each class of diameters
    beyond = largest
    total = rng.poisson(count.sum() * nodes.area(beyond))
    rising = np.concatenate([[0], np.cumsum(count)])
    diameter = np.exp(np.interp(rng.uniform(0, rising[-1], total), rising, np.log(edges)))
    x, y = nodes.places(rng, total, beyond).T
    return Rocks(
        diameter,
        x,
        y,
        diameter * height * rng.uniform(*ROCK_HEIGHTS, total),
        rng.uniform(0, np.pi, total),
        rng.uniform(*ROCK_SIDES, total),
        rng.uniform(*ROCK_SHAPES, total),
        rng.uniform(*ROCK_BURIAL, total),
    )


def lay_rocks(ground: np.ndarray, nodes: Nodes, rocks: Rocks) -> np.ndarray:
    """Returns the ground with rocks on it; the height of a rock counts from the ground at its middle."""
    covered = ground.copy()
    length, width = _half_axes(rocks)
    for index in range(len(rocks.diameter)):
        x, y, exponent = rocks.x[index], rocks.y[index], rocks.exponent[index]
        rows, cols = nodes.around(x, y, math.hypot(length[index], width[index]))
        if rows.start == rows.stop or cols.start == cols.stop:
            continue
        sine, cosine = math.sin(rocks.heading[index]), math.cos(rocks.heading[index])
        east, north = nodes.x[None, cols] - x, nodes.y[rows, None] - y
        across = np.abs(east * cosine + north * sine) / width[index]
        along = np.abs(north * cosine - east * sine) / length[index]
        radius = across**exponent + along**exponent  # raised to the power of the exponent
        burial = rocks.burial[index]
        upper = np.maximum(1 - (1 - burial**exponent) * radius, 0) ** (1 / exponent)
        top = ground[nodes.nearest(x, y)] + rocks.height[index] * (upper - burial) / (1 - burial)
        part = covered[rows, cols]
        np.copyto(part, np.maximum(part, top), where=radius < 1)
    return covered


def _half_axes(rocks: Rocks) -> tuple[np.ndarray, np.ndarray]:
    """Returns half the length and half the width of outlines that have the area of their diameter."""
    power = 1 / rocks.exponent
    gamma = np.array([math.gamma(1 + one) ** 2 / math.gamma(1 + 2 * one) for one in power])
    length = rocks.diameter / 4 * np.sqrt(np.pi / (gamma * rocks.sides))
    return length, length * rocks.sides


# ---- Craters


def crater_profile(radii: np.ndarray, diameter: float, freshness: float) -> np.ndarray:
    """Returns the height of a crater [m] at distances from its middle, in units of its radius.

    freshness: 1 for a new crater, less for a levelled one, which is shallower, with a lower and rounded rim
    A new crater is a parabolic bowl with a rim, and ejecta that fall off with the third power (McGetchin et al. 1973,
    Earth Planet. Sci. Lett. 20, 226-236). Sources: Pike (1977), Impact and Explosion Cratering, 489-509; Melosh (1989),
    Impact Cratering.
    """
    depth, rim = CRATER_DEPTH * diameter * freshness, CRATER_RIM * diameter * freshness
    end = CRATER_REACH**-3
    ejecta = (np.maximum(radii, 1) ** -3 - end) / (1 - end)
    bowl = np.maximum(1 - radii**2, 0) ** (2 - freshness)
    return np.where(radii < 1, rim - depth * bowl, rim * np.maximum(ejecta, 0))


def craters(
    rng: np.random.Generator,
    nodes: Nodes,
    density: float,
    smallest: float,
    largest: float,
    freshness: tuple[float, float],
) -> np.ndarray:
    """Returns what craters add to the ground, [rows, cols] metres; a crater levels the older ones that it hits.

    density:           craters of at least 1 m per square metre; density D^-2 have at least D metres, the slope of a
                       surface in equilibrium (Gault 1970, Radio Sci. 5, 273-291)
    smallest, largest: metres, diameters
    freshness:         lowest and highest freshness, as `crater_profile` takes it; drawn uniformly
    """
    beyond = CRATER_REACH * largest / 2
    total = rng.poisson(density * (smallest**-2 - largest**-2) * nodes.area(beyond))
    diameters = rng.uniform(largest**-2, smallest**-2, total) ** -0.5
    places, fresh = nodes.places(rng, total, beyond), rng.uniform(*freshness, total)
    added = np.zeros(nodes.shape)
    for (x, y), diameter, one in zip(places.tolist(), diameters.tolist(), fresh.tolist(), strict=True):
        rows, cols = nodes.around(x, y, CRATER_REACH * diameter / 2)
        radii = np.hypot(nodes.x[None, cols] - x, nodes.y[rows, None] - y) / (diameter / 2)
        older, inside = added[rows, cols], radii < 1
        level = older[inside].mean() if inside.any() else 0.0
        kept = np.minimum(radii, 1) ** 4
        added[rows, cols] = level + (older - level) * kept + crater_profile(radii, diameter, one)
    return added


# ---- Lines across the raster


def ledges(rng: np.random.Generator, nodes: Nodes, density: float, heights: tuple[float, float]) -> np.ndarray:
    """Returns what ledges of layered bedrock add to the ground: [rows, cols] metres.

    density: ledges per metre across them; their lines meander and have gaps where the ledge runs out
    heights: metres, least and largest, drawn uniformly
    A face is one cell wide, and the ground behind it falls off gently, as on a dipping layer, so that all faces point
    the same way. The shape is our choice.
    """
    across, along = _directions(rng, nodes)
    for _ in range(9):
        across = across + _waves(rng, _directions(rng, nodes)[0], 1, 0.8, 32.0, 0.18)[0]
    added, facing = np.zeros(nodes.shape), rng.choice([-1.0, 1.0])
    for middle in _crossings(rng, nodes, density):
        height = rng.uniform(*heights)
        present = np.clip(0.8 + _waves(rng, along, 6, 8.0, 40.0, 0.12)[0], 0, 1)
        beyond = facing * (across - middle)
        face = np.clip(beyond / nodes.spacing + 0.5, 0, 1)
        added += height * present * face * np.exp(-np.maximum(beyond, 0) / BACKSLOPE)
    return added


def ruts(
    rng: np.random.Generator, nodes: Nodes, density: float, depths: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns what the tracks of a vehicle add to the ground, [rows, cols] metres, and where they leave no rock.

    density: passes per metre across them, each a pair of ruts along a smooth curve
    depths:  metres, least and largest, drawn uniformly
    Berms lie beside each rut. The shape is our choice.
    """
    added, driven = np.zeros(nodes.shape), np.zeros(nodes.shape, bool)
    for middle in _crossings(rng, nodes, density):
        across, along = _directions(rng, nodes)
        bend, slope = _waves(rng, along, 6, 20.0, 60.0, 0.3)
        distance = np.abs(across - middle - bend) / np.sqrt(1 + slope**2)
        aside = np.abs(distance - RUT_GAUGE / 2) / RUT_HALF_WIDTH
        shape = BERM * np.exp(-(((aside - 1.6) / 0.4) ** 2)) - np.exp(-(aside**4))
        added += rng.uniform(*depths) * shape
        driven |= distance < RUT_GAUGE / 2 + 2 * RUT_HALF_WIDTH
    return added, driven


def _directions(rng: np.random.Generator, nodes: Nodes) -> tuple[np.ndarray, np.ndarray]:
    """Returns each node's position across and along lines of a random direction, in metres: two [rows, cols]."""
    angle = rng.uniform(0, np.pi)
    x, y = nodes.x[None, :], nodes.y[:, None]
    return x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)


def _crossings(rng: np.random.Generator, nodes: Nodes, density: float) -> np.ndarray:
    """Draws where lines cross the raster, in metres from its middle; their number has a Poisson distribution."""
    half = math.hypot(np.ptp(nodes.x), np.ptp(nodes.y)) / 2
    return rng.uniform(-half, half, rng.poisson(density * 2 * half))


def _waves(
    rng: np.random.Generator, where: np.ndarray, count: int, shortest: float, longest: float, steepness: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the sum of random waves [m] and its slope at places along a line [m], in the shape of `where`.

    shortest, longest: metres, range of the wavelengths
    steepness:         root-mean-square slope
    """
    knots = np.arange(where.min(), where.max() + KNOTS, KNOTS)
    height, slope = np.zeros(len(knots)), np.zeros(len(knots))
    for wavelength in np.exp(rng.uniform(math.log(shortest), math.log(longest), count)):
        phase = 2 * np.pi / wavelength * knots + rng.uniform(0, 2 * np.pi)
        amplitude = steepness * math.sqrt(2 / count)  # amplitude of the slope
        height += amplitude * wavelength / (2 * np.pi) * np.sin(phase)
        slope += amplitude * np.cos(phase)
    return np.interp(where, knots, height), np.interp(where, knots, slope)
