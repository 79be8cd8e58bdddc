"""Biarcs: two arcs without a kink that lead from one pose to another.

Poses lie on a lattice, so the place and the heading in which a drive ends are given; a single arc seldom ends there,
but two always can. Source: Bolton 1975, "Biarc curves", Computer-Aided Design 7(2), with tangents of equal length.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

STRAIGHT = 1e-9
"""Radians; an arc that turns by less is straight."""


@dataclass(frozen=True)
class Arc:
    """An arc: its radius in metres, positive to the left and inf if straight, its length, and how far it turns."""

    radius: float
    length: float
    turn: float


def biarc(heading: float, end: Float[np.ndarray, " 2"], end_heading: float) -> tuple[Arc, Arc] | None:
    """Returns the arcs from (0, 0) to another pose; None where one of them would turn by half a circle or more.

    heading, end_heading: radians, anticlockwise from +y; end: x and y in metres, not (0, 0)
    """
    start, finish = _direction(heading), _direction(end_heading)
    along, across = float(end @ (start + finish)), 2 * (1 - float(start @ finish))
    if across < STRAIGHT:
        if along <= 0:
            return None
        tangent = float(end @ end) / (2 * along)
    else:
        tangent = (-along + math.sqrt(along**2 + across * float(end @ end))) / across
    middle = (end + tangent * (start - finish)) / 2
    first = _arc(heading, middle)
    second = _arc(heading + first.turn, end - middle)
    missed = math.remainder(heading + first.turn + second.turn - end_heading, 2 * math.pi)
    return (first, second) if abs(missed) < 1e-6 else None


def _arc(heading: float, chord: Float[np.ndarray, " 2"]) -> Arc:
    """Returns the arc that begins in a heading and ends so far away."""
    forward, left = float(chord @ _direction(heading)), float(chord @ _direction(heading + math.pi / 2))
    turn, straight = 2 * math.atan2(left, forward), math.hypot(forward, left)
    if abs(turn) < STRAIGHT:
        return Arc(math.inf, straight, 0.0)
    length = straight * (turn / 2) / math.sin(turn / 2)
    return Arc(length / turn, length, turn)


def _direction(heading: float) -> Float[np.ndarray, " 2"]:
    return np.array([-math.sin(heading), math.cos(heading)])
