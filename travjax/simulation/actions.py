"""The action space: a point turn, then two arcs (SPEC section 4).

Trajectory index = (turn * len(radii) + first) * len(radii) + second. Poses are (x, y, heading) in metres and radians,
heading anticlockwise from +y. The point turn itself is not simulated. Everything here is float64 NumPy.
"""

import math
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path

import numpy as np

from travjax.config import load_toml, require, require_length, require_number

ARC_LENGTH = 1.65


def _paper_radii() -> tuple[float, ...]:
    turning = (2 * ARC_LENGTH / math.pi + offset for offset in (0.0, 0.1, 0.2, 0.5, 1.0, 1.8))
    return (math.inf, *(signed for radius in turning for signed in (radius, -radius)))


@dataclass(frozen=True)
class ActionSpace:
    """The set of trajectories that are simulated.

    turns:       number of point turns, evenly spread over the circle: 2 pi k / turns, anticlockwise
    arc_lengths: metres, first and second arc
    radii:       metres, signed (+ turns left, inf is straight); both arcs use all of them
    interval:    metres between simulated poses along the path

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    turns: int = 18
    arc_lengths: tuple[float, float] = (ARC_LENGTH, ARC_LENGTH)
    radii: tuple[float, ...] = _paper_radii()
    interval: float = 0.06

    def __post_init__(self):
        for name in ("arc_lengths", "radii"):
            if isinstance(getattr(self, name), list | np.ndarray):
                object.__setattr__(self, name, tuple(np.asarray(getattr(self, name), object).tolist()))
        whole = isinstance(self.turns, Integral) and not isinstance(self.turns, bool)
        require(whole and 1 <= self.turns <= 3600, "turns", self.turns, "a whole number from 1 to 3600")
        pair = isinstance(self.arc_lengths, tuple) and len(self.arc_lengths) == 2
        require(pair, "arc_lengths", self.arc_lengths, "two lengths in metres")
        for length in self.arc_lengths:
            require_length("arc_lengths", length, 0.001, 1000)
        radii = isinstance(self.radii, tuple) and len(self.radii) > 0
        require(radii, "radii", self.radii, "a list of one or more radii in metres")
        for radius in self.radii:
            number = isinstance(radius, Real) and not isinstance(radius, bool)
            fits = number and (radius == math.inf or 0.001 <= abs(radius) <= 1e12)
            require(fits, "radii", radius, "a radius in metres from 0.001 to 1e12, + or -; inf is straight")
        require(len(set(self.radii)) == len(self.radii), "radii", self.radii, "different from each other")
        require(len(self) <= 1_000_000, "turns x radii x radii", len(self), "at most 1000000 trajectories")
        allowed = "a length in metres, from 0.001 and at most an arc's length"
        require_number("interval", self.interval, math.nextafter(0.001, 0), min(self.arc_lengths), allowed)
        shortest = max(self.arc_lengths) / 1000
        require(
            self.interval >= shortest, "interval", self.interval, f"at least a thousandth of an arc, {shortest:g} m"
        )

    @staticmethod
    def load(path: str | Path) -> "ActionSpace":
        """Reads an action space from a TOML file; raises InputError when it is missing or wrong."""
        return load_toml(path, ActionSpace)

    def __len__(self) -> int:
        """Returns the number of trajectories: 3042 for the paper's action space."""
        return self.turns * len(self.radii) ** 2

    def index(self, turn, first, second):
        """Returns the trajectory index of a point turn and of two radii, given by their positions in `radii`."""
        return (turn * len(self.radii) + first) * len(self.radii) + second

    def split(self, trajectory):
        """Splits a trajectory index into (turn, first, second); raises InputError when there is no such trajectory."""
        outside = np.ravel(trajectory)[(np.ravel(trajectory) < 0) | (np.ravel(trajectory) >= len(self))]
        require(not outside.size, "trajectory", outside[:1].tolist(), f"from 0 to {len(self) - 1}")
        arcs, second = np.divmod(trajectory, len(self.radii))
        turn, first = np.divmod(arcs, len(self.radii))
        return turn, first, second

    def heading(self, turn):
        """Returns the heading after the point turn in radians."""
        return 2 * math.pi * np.asarray(turn) / self.turns

    def first_stations(self) -> np.ndarray:
        """Returns the path lengths of the poses along the first arc, junction included: [29] metres."""
        return np.append(stations(self.arc_lengths[0], self.interval), self.arc_lengths[0])

    def second_stations(self) -> np.ndarray:
        """Returns the path lengths of the poses along the second arc, junction excluded: [28] metres."""
        return np.append(stations(self.arc_lengths[1], self.interval)[1:], self.arc_lengths[1])

    def first_poses(self, turn, first) -> np.ndarray:
        """Computes the poses of first arcs: [..., 29, 3] for integer arrays `turn`, `first` [...]."""
        start = np.stack(np.broadcast_arrays(0.0, 0.0, self.heading(turn)), axis=-1)
        return arc_poses(start, np.asarray(self.radii)[first], self.first_stations())

    def second_poses(self, turn, first, second) -> np.ndarray:
        """Computes poses of second arcs after the junction: [..., 28, 3] for integers `turn`, `first`, `second`."""
        junction = self.first_poses(turn, first)[..., -1, :]
        return arc_poses(junction, np.asarray(self.radii)[second], self.second_stations())

    def poses(self, trajectory) -> np.ndarray:
        """Computes all simulated poses of trajectories: [..., 57, 3] for an integer array `trajectory` [...]."""
        turn, first, second = self.split(np.asarray(trajectory))
        return np.concatenate([self.first_poses(turn, first), self.second_poses(turn, first, second)], axis=-2)


def stations(length: float, interval: float) -> np.ndarray:
    """Returns the path lengths of poses from the start of an arc to before its end, in metres."""
    return np.arange(math.ceil((length - 1e-9) / interval)) * interval


def arc_poses(start: np.ndarray, radius: np.ndarray, stations: np.ndarray) -> np.ndarray:
    """Computes poses along arcs of signed radius (+ left, inf straight).

    start: [..., 3] x, y, heading; radius: [...] metres; stations: [s] metres along the path. Returns [..., s, 3].
    Source: SPEC section 4.
    """
    curvature = (1 / np.asarray(radius, float))[..., None]
    angle = stations * curvature
    forward = stations * np.sinc(angle / np.pi)
    left = stations * np.sin(angle / 2) * np.sinc(angle / (2 * np.pi))
    x, y, heading = (start[..., None, axis] for axis in range(3))
    sin, cos = np.sin(heading), np.cos(heading)
    return np.stack(
        np.broadcast_arrays(x - sin * forward - cos * left, y + cos * forward - sin * left, heading + angle), axis=-1
    )
