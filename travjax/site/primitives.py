"""Motion primitives: short drives that are simulated from every place of a site (SPEC section 13)."""

import math
from dataclasses import dataclass
from numbers import Integral

import numpy as np
from jaxtyping import Float

from travjax.config import require, require_length, require_number
from travjax.simulation.actions import arc_poses, stations


@dataclass(frozen=True)
class Primitive:
    """A drive along one arc or several, past a place of the site.

    heading: radians, anticlockwise from +y, at its start
    arcs:    (radius, length) of each arc in metres; a positive radius turns left, inf is straight
    behind:  metres that it starts behind the place, in the direction of `heading`

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    heading: float
    arcs: tuple[tuple[float, float], ...]
    behind: float = 0.0

    def __post_init__(self):
        require_number("heading", self.heading, -100, 100, "radians from -100 to 100")
        require_number("behind", self.behind, -100, 100, "metres from -100 to 100")
        pairs = isinstance(self.arcs, tuple) and len(self.arcs) > 0 and all(len(arc) == 2 for arc in self.arcs)
        require(pairs, "arcs", self.arcs, "one or more pairs (radius, length) in metres")
        for radius, length in self.arcs:
            require_length("arcs, length", length, 0.001, 1000)
            require(radius == math.inf or abs(radius) >= 0.001, "arcs, radius", radius, "from 0.001 m, inf is straight")

    def poses(self, interval: float) -> Float[np.ndarray, "p 3"]:
        """Returns the simulated poses, counted from the place: x and y in metres, and the heading in radians.

        interval: metres between poses; each arc also has one at its end
        """
        start = np.array([math.sin(self.heading), -math.cos(self.heading), 0.0]) * self.behind
        at = start + [0.0, 0.0, self.heading]
        along: list[np.ndarray] = []
        for radius, length in self.arcs:
            arc = arc_poses(at, np.asarray(radius), np.append(stations(length, interval), length))
            along.append(arc[1:] if along else arc)
            at = arc[-1]
        return np.concatenate(along)

    def radii(self, interval: float) -> Float[np.ndarray, " p"]:
        """Returns the radius of the arc that each of the poses lies on, of the first arc where two meet."""
        counts = [len(stations(length, interval)) + (number == 0) for number, (_, length) in enumerate(self.arcs)]
        return np.repeat([radius for radius, _ in self.arcs], counts)


@dataclass(frozen=True)
class PointTurn:
    """A turn on the spot at a place of the site, of which some poses are simulated.

    heading: radians, anticlockwise from +y, at its start
    angle:   radians that it turns by, positive to the left
    parts:   equal parts between poses; 0 parts are one pose, the robot standing there

    Its step margin is that between poses, and says nothing: wheels that turn on the spot scrub, they do not climb.
    """

    heading: float
    angle: float = 0.0
    parts: int = 0

    def poses(self, interval: float) -> Float[np.ndarray, "p 3"]:
        """Returns the simulated poses, counted from the place: x and y in metres, and the heading in radians."""
        poses = np.zeros((self.parts + 1, 3))
        poses[:, 2] = self.heading + np.linspace(0, self.angle, self.parts + 1)
        return poses

    def radii(self, interval: float) -> Float[np.ndarray, " p"]:
        """Returns inf for each of the poses, as if the robot had come straight to it."""
        return np.full(self.parts + 1, math.inf)


def straight_passes(headings: int = 16, stride: float = 0.25) -> tuple[Primitive, ...]:
    """Returns the straight drive through a place in each of the headings, half a stride before and behind it.

    Together those of neighbouring places cover straight drives along rows and columns. Source: SPEC section 13.
    Raises InputError unless there are 1 to 360 headings.
    """
    whole = isinstance(headings, Integral) and not isinstance(headings, bool)
    require(whole and 1 <= headings <= 360, "headings", headings, "a whole number from 1 to 360")
    return tuple(Primitive(2 * math.pi * h / headings, ((math.inf, stride),), stride / 2) for h in range(headings))


def all_poses(primitives: tuple[Primitive | PointTurn, ...], interval: float) -> Float[np.ndarray, "f p 3"]:
    """Returns the poses of primitives; those of a shorter one end with repetitions of its last one."""
    paths = [primitive.poses(interval) for primitive in primitives]
    longest = max(map(len, paths))
    return np.stack([np.concatenate([path, path[-1:].repeat(longest - len(path), axis=0)]) for path in paths])
