"""Where a path begins, passes and ends: places of the lattice, from coordinates of the site or of the earth."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pyproj import Transformer
from pyproj.exceptions import ProjError

from travjax.config import InputError, require, require_number, shown
from travjax.planning.costs import MotionCosts
from travjax.planning.judges import UNKNOWN, UNKNOWN_NAME
from travjax.rasters.coordinates import is_local, parsed
from travjax.site.ground import Site

COORDINATES = ("site", "latlon", "rowcol")
"""How points are given: x and y of the site, degrees of latitude and longitude (WGS 84), or row and column of nodes."""


@dataclass(frozen=True)
class Endpoint:
    """A place of the lattice that a path begins at, passes or ends at.

    name:     of the argument, for messages; given: the point as it was given
    row, col: of the place; x, y: metres, in coordinates of the site
    heading:  number of the heading, None for any
    """

    name: str
    given: tuple[float, ...]
    row: int
    col: int
    x: float
    y: float
    heading: int | None


def endpoint(name: str, given: Any, costs: MotionCosts, coordinates: str = "site") -> Endpoint:
    """Returns the place of the lattice that is nearest to a point.

    given: (x, y) or (x, y, heading), the heading in radians anticlockwise from +y, or instead of x and y latitude and
           longitude, or row and column of nodes, counted from the south-west
    Raises InputError where that is not a point of the site.
    """
    require(coordinates in COORDINATES, "coordinates", coordinates, f"one of {', '.join(COORDINATES)}")
    numbers = isinstance(given, Sequence | np.ndarray) and not isinstance(given, str) and len(given) in (2, 3)
    require(numbers, name, given, "two numbers, or three with a heading")
    for number in given:
        require_number(name, number, -1e12, 1e12, "finite numbers")
    point = tuple(float(number) for number in given)
    ground, stride = costs.ground, costs.lattice.stride
    x, y = on_site(name, point, ground, coordinates)
    row, col = (
        math.floor((value - start) / stride + 0.5) for value, start in ((y, ground.origin[1]), (x, ground.origin[0]))
    )
    rows, cols = costs.shape
    ends = place_text(*costs.at(0, 0)), place_text(*costs.at(rows - 1, cols - 1))
    allowed = f"on the site, from {ends[0]} to {ends[1]}; it is at {place_text(x, y)}"
    require(0 <= row < rows and 0 <= col < cols, name, point, allowed)
    heading = None
    if len(point) == 3:
        headings = costs.lattice.headings
        heading = round(point[2] / (2 * math.pi) * headings) % headings
    return Endpoint(name, point, row, col, *costs.at(row, col), heading)


def on_site(name: str, point: tuple[float, ...], ground: Site, coordinates: str) -> tuple[float, float]:
    """Returns a point in coordinates of the site; raises InputError where it cannot be one."""
    if coordinates == "rowcol":
        return ground.origin[0] + point[1] * ground.spacing, ground.origin[1] + point[0] * ground.spacing
    if coordinates == "site":
        return point[0], point[1]
    require(not is_local(ground.crs), name, point, "x and y, since the site has no coordinate system")
    allowed = "degrees of latitude, from -90 to 90, and longitude, from -180 to 180"
    require(abs(point[0]) <= 90 and abs(point[1]) <= 180, name, point, allowed)
    try:
        x, y = from_earth(ground.crs).transform(point[1], point[0], errcheck=True)
    except ProjError as error:
        raise InputError(f"{name} = {shown(point)}: {error}") from None
    return float(x), float(y)


def from_earth(crs: str | None) -> Transformer:
    """Returns what makes coordinates of a system out of longitude and latitude."""
    assert crs is not None
    return Transformer.from_crs("EPSG:4326", parsed(crs), always_xy=True)


def standing(point: Endpoint, costs: MotionCosts) -> list[int]:
    """Returns the states at a point in which the robot can stand: those of its heading, or of all headings."""
    factors = costs.standing[0][:, point.row, point.col]
    headings = range(costs.lattice.headings) if point.heading is None else [point.heading]
    place = point.row * costs.shape[1] + point.col
    return [place * costs.lattice.headings + heading for heading in headings if np.isfinite(factors[heading])]


def why_not_standing(point: Endpoint, costs: MotionCosts) -> str:
    """Says which point it is, why the robot cannot stand there, and the nearest place where it can."""
    headings = slice(None) if point.heading is None else slice(point.heading, point.heading + 1)
    codes, counts = np.unique(costs.standing[1][headings, point.row, point.col], return_counts=True)
    reason = in_the_way_named(int(codes[counts.argmax()]), costs)
    where = (
        "in any heading" if point.heading is None else f"in heading {360 * point.heading / costs.lattice.headings:g}"
    )
    given = f"{point.name} = {shown(point.given)}"
    return f"{given}: the robot cannot stand there {where} ({reason}); {_nearest(point, costs, headings)}"


def _nearest(point: Endpoint, costs: MotionCosts, headings: slice) -> str:
    rows, cols = np.nonzero(np.isfinite(costs.standing[0][headings]).any(axis=0))
    if not len(rows):
        return "it can stand nowhere on the site"
    best = np.hypot(rows - point.row, cols - point.col).argmin()
    return f"the nearest place where it can is {place_text(*costs.at(rows[best], cols[best]))}"


def place_text(x: float, y: float) -> str:
    """Returns a point as messages give it, to a centimetre."""
    return f"({round(x, 2):.12g}, {round(y, 2):.12g})"


def in_the_way_named(code: int, costs: MotionCosts) -> str:
    """Returns what a code of MotionCosts.in_the_way stands for."""
    return UNKNOWN_NAME if code == UNKNOWN else costs.robot.event_names[code - 1]
