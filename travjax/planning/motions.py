"""What the robot may do between states of a plan: drives and point turns that begin and end on a lattice.

A state is a place of the site and one of H headings, h * 2 pi / H anticlockwise from +y. A motion leads from a state to
another, the same way from every place. Drives are biarcs, so that they end on a place and in a heading to rounding.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from numbers import Integral
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from travjax.config import load_toml, require, require_length, require_number
from travjax.planning.biarcs import Arc, biarc
from travjax.site.primitives import PointTurn, Primitive

FARTHEST = 16
"""Places, in rows and columns, that a drive may lead away at most."""

MOST_TURN = math.pi / 2
"""Radians that the arcs of a drive may turn by, both together."""

TURN_PART = math.radians(5)
"""Radians between simulated poses of a point turn at most, as of the contact model `tyre`."""

LEAST_PARTS = 4
"""Parts of a point turn from heading to heading at least: SPEC section 14."""

MOST_STEPS = 0xFFFF
"""Steps from all headings, which a search counts in two bytes."""


@dataclass(frozen=True)
class Motions:
    """What a robot may do between states, and what that costs, in metres of straight and level driving.

    turns:       headings that a drive turns by, each a whole number, positive to the left; 0 goes on straight
    radius:      metres, smallest turning radius of drives; they are the shortest that keep it
    point_turns: whether the robot may turn on the spot
    reverse:     whether it may drive backwards
    turning:     cost of turning by a radian
    risk:        weight of the largest margin as a share r of its limit: every cost is multiplied by 1 + risk * r^2
    reversing:   factor of the cost of driving backwards

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    turns: tuple[int, ...] = (0, 1, -1)
    radius: float = 1.0
    point_turns: bool = True
    reverse: bool = False
    turning: float = 0.3
    risk: float = 4.0
    reversing: float = 2.0

    def __post_init__(self):
        if isinstance(self.turns, list):
            object.__setattr__(self, "turns", tuple(self.turns))
        require(isinstance(self.turns, tuple) and len(self.turns) > 0, "turns", self.turns, "a list of whole numbers")
        for turn in self.turns:
            whole = isinstance(turn, Integral) and not isinstance(turn, bool)
            require(whole and abs(turn) <= 90, "turns", turn, "a whole number of headings from -90 to 90")
        require(len(set(self.turns)) == len(self.turns), "turns", self.turns, "different from each other")
        require_length("radius", self.radius, 0.001, 1000)
        for name in ("point_turns", "reverse"):
            require(isinstance(getattr(self, name), bool), name, getattr(self, name), "true or false")
        for name in ("turning", "risk"):
            require_number(name, getattr(self, name), -1e-300, 1000, "a number from 0 to 1000")
        require_number("reversing", self.reversing, math.nextafter(1, 0), 1000, "a number from 1 to 1000")

    @staticmethod
    def load(path: str | Path) -> "Motions":
        """Reads motions from a TOML file; raises InputError when it is missing or wrong."""
        return load_toml(path, Motions)


@dataclass(frozen=True)
class Motion:
    """One way from a state to another.

    name:         what it is called: straight, left, right or turn_left
    primitive:    its poses, counted from the place where it begins
    heading, end: numbers of the headings in which it begins and ends
    rows, cols:   places, north and east, that it leads to
    length:       metres; turned: radians, all turning to the left and right added up
    """

    name: str
    primitive: Primitive | PointTurn
    heading: int
    end: int
    rows: int
    cols: int
    length: float
    turned: float


class Step(NamedTuple):
    """A step of a search from a state to another.

    motion:      number of the motion, -1 for none
    rows, cols:  places that the step leads to; end: the heading in which it ends
    from_rows, from_cols: from here to the place where the motion begins, whose cost it is
    factor:      of that cost
    backwards:   whether the motion is gone through from its end to its beginning
    """

    motion: int
    rows: int
    cols: int
    end: int
    from_rows: int
    from_cols: int
    factor: float
    backwards: bool


@dataclass(frozen=True)
class Moves:
    """All steps of a search, [H, M] of each field of Step: M for each heading in which one may be; some are none."""

    motion: Int[np.ndarray, "h m"]
    rows: Int[np.ndarray, "h m"]
    cols: Int[np.ndarray, "h m"]
    end: Int[np.ndarray, "h m"]
    from_rows: Int[np.ndarray, "h m"]
    from_cols: Int[np.ndarray, "h m"]
    factor: Float[np.ndarray, "h m"]
    backwards: Bool[np.ndarray, "h m"]

    @staticmethod
    def from_steps(steps: Sequence[Sequence[Step]]) -> "Moves":
        """Returns the steps from each heading as arrays."""
        most = max(map(len, steps))
        require(most * len(steps) < MOST_STEPS, "turns", most * len(steps), f"fewer than {MOST_STEPS} steps in all")
        nothing = Step(-1, 0, 0, 0, 0, 0, 1.0, False)
        padded = [[*some, *[nothing] * (most - len(some))] for some in steps]
        field = lambda name: np.array([[getattr(one, name) for one in some] for some in padded])
        return Moves(**{name: field(name) for name in Step._fields})

    def step(self, heading: int, number: int) -> Step:
        """Returns one of the steps from a heading."""
        return Step(*(getattr(self, name)[heading, number].item() for name in Step._fields))


@dataclass(frozen=True)
class MotionLattice:
    """The motions of a plan between states; headings: their number; stride: metres between places.

    Raises InputError where no drive fits, and where some states cannot be reached on open ground.
    """

    motions: Motions = Motions()
    headings: int = 16
    stride: float = 0.25

    def __post_init__(self):
        whole = isinstance(self.headings, Integral) and not isinstance(self.headings, bool)
        require(whole and 1 <= self.headings <= 360, "headings", self.headings, "a whole number from 1 to 360")
        require_length("stride", self.stride, 0.001, 1000)
        for turn in self.motions.turns:
            allowed = f"at most {self.headings // 4} of {self.headings} headings, 90 degrees"
            require(4 * abs(turn) <= self.headings, "turns", turn, allowed)
        _require_all_reached(self)

    @property
    def angles(self) -> Float[np.ndarray, " h"]:
        """The headings in radians, anticlockwise from +y."""
        return 2 * np.pi * np.arange(self.headings) / self.headings

    @cached_property
    def straights(self) -> tuple[Motion, ...]:
        """The drives that end in the heading in which they begin, if `Motions.turns` has 0."""
        return tuple(_drive(self, heading, 0) for heading in range(self.headings) if 0 in self.motions.turns)

    @cached_property
    def curves(self) -> tuple[Motion, ...]:
        """The other drives."""
        turns = [turn for turn in self.motions.turns if turn != 0]
        return tuple(_drive(self, heading, turn) for turn in turns for heading in range(self.headings))

    @property
    def drives(self) -> tuple[Motion, ...]:
        """All drives."""
        return self.straights + self.curves

    @cached_property
    def point_turns(self) -> tuple[Motion, ...]:
        """The point turns to the left, from each heading to the next; turns to the right go through them backwards."""
        if not self.motions.point_turns or self.headings == 1:
            return ()
        angle = 2 * math.pi / self.headings
        parts = max(LEAST_PARTS, math.ceil(angle / TURN_PART - 1e-9))
        return tuple(
            Motion("turn_left", PointTurn(start, angle, parts), h, (h + 1) % self.headings, 0, 0, 0.0, angle)
            for h, start in enumerate(self.angles.tolist())
        )

    @cached_property
    def all(self) -> tuple[Motion, ...]:
        """All motions: straight drives, curves, point turns."""
        return self.straights + self.curves + self.point_turns

    @cached_property
    def costs(self) -> Float[np.ndarray, " motions"]:
        """What each motion costs where there is no risk."""
        return np.array([motion.length + self.motions.turning * motion.turned for motion in self.all])

    @cached_property
    def moves(self) -> Moves:
        """The steps from each heading."""
        steps: list[list[Step]] = [[] for _ in range(self.headings)]
        for number, motion in enumerate(self.all):
            turn = isinstance(motion.primitive, PointTurn)
            steps[motion.heading].append(Step(number, motion.rows, motion.cols, motion.end, 0, 0, 1.0, False))
            if turn or self.motions.reverse:
                back = (-motion.rows, -motion.cols)
                factor = 1.0 if turn else self.motions.reversing
                steps[motion.end].append(Step(number, *back, motion.heading, *back, factor, True))
        return Moves.from_steps(steps)

    @cached_property
    def moves_back(self) -> Moves:
        """The steps of a search from the goal: from the end of each of `moves` to where it begins."""
        steps: list[list[Step]] = [[] for _ in range(self.headings)]
        for heading, number in zip(*np.nonzero(self.moves.motion >= 0), strict=True):
            one = self.moves.step(heading, number)
            begins = one.from_rows - one.rows, one.from_cols - one.cols
            back = Step(one.motion, -one.rows, -one.cols, int(heading), *begins, one.factor, one.backwards)
            steps[one.end].append(back)
        return Moves.from_steps(steps)


@lru_cache(maxsize=1)
def _by_distance() -> list[tuple[int, int]]:
    """Returns the places that a drive may lead to, rows and columns away, the nearest first."""
    line = range(-FARTHEST, FARTHEST + 1)
    return sorted(product(line, line), key=lambda offset: math.hypot(*offset))[1:]


def _drive(lattice: MotionLattice, heading: int, turn: int) -> Motion:
    """Returns the shortest drive from a heading that turns so far and keeps to the smallest radius."""
    radius, count = lattice.motions.radius, lattice.headings
    start, angle = lattice.angles[heading], 2 * math.pi * turn / count
    best: tuple[float, float, int, int, tuple[Arc, Arc]] | None = None
    for rows, cols in _by_distance():
        if best is not None and math.hypot(rows, cols) * lattice.stride > best[0]:
            break  # no drive is shorter than the straight line
        arcs = biarc(start, np.array([cols, rows]) * lattice.stride, start + angle)
        if arcs is None:
            continue
        length, turned = sum(arc.length for arc in arcs), sum(abs(arc.turn) for arc in arcs)
        turning = abs(arcs[0].turn + arcs[1].turn - angle) < 1e-6  # and not the other way round
        fits = turning and turned <= MOST_TURN + 1e-9 and min(abs(arc.radius) for arc in arcs) >= radius - 1e-9
        if fits and (best is None or (round(length, 9), round(turned, 9)) < best[:2]):
            best = round(length, 9), round(turned, 9), rows, cols, arcs
    reach = FARTHEST * lattice.stride
    allowed = f"a radius that a drive from {math.degrees(start):g} degrees by {turn} of {count} headings can keep"
    require(best is not None, "radius", radius, f"{allowed} within {reach:g} m")
    assert best is not None
    _, turned, rows, cols, arcs = best
    length = sum(arc.length for arc in arcs)  # not rounded: the drive ends on the place
    name = "straight" if turn == 0 else "left" if turn > 0 else "right"
    pieces = ((math.inf, length),) if turned < 1e-6 else tuple((arc.radius, arc.length) for arc in arcs)
    end = (heading + turn) % count
    return Motion(name, Primitive(float(start), pieces), heading, end, rows, cols, length, turned)


@lru_cache(maxsize=16)
def _require_all_reached(lattice: MotionLattice) -> None:
    """Raises InputError unless every state of an open plane can be reached from every other.

    Motions are the same from every place and turn by the same numbers of headings from every heading. So it is enough
    to know which headings a walk from heading 0 reaches, and where walks lead that end in their first heading: to all
    places if the cells that these ways span have, taken together, an area of one place.
    """
    moves = lattice.moves
    heading, step = np.nonzero(moves.motion >= 0)
    end, way = moves.end[heading, step], np.stack([moves.rows, moves.cols], axis=-1)[heading, step]
    walked, queue = {0: np.zeros(2, int)}, [0]
    for here in queue:
        for one in np.flatnonzero(heading == here):
            if (there := int(end[one])) not in walked:
                walked[there] = walked[here] + way[one]
                queue.append(there)
    steps = zip(heading.tolist(), end.tolist(), way, strict=True)
    row, col = np.array([walked[h] + w - walked[e] for h, e, w in steps if h in walked]).T
    area = int(np.gcd.reduce(np.outer(row, col) - np.outer(col, row), axis=None))
    share = len(walked) / lattice.headings / area if area else 0
    allowed = f"such that every heading and place can be reached; with {lattice.headings} headings {share:.0%} can"
    require(share == 1, "turns", lattice.motions.turns, allowed)
