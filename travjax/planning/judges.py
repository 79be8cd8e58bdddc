"""Who says what motions cost from every place, and what stands in their way.

A planner asks a judge. The one here knows the exact margins of the site kernel (SPEC section 13); field_judge.py has
one that knows probabilities, and one of your own is a class with what `Judge` has.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np
from jaxtyping import Float32, UInt8

from travjax.data.sensor_noise import filled
from travjax.planning.motions import MotionLattice
from travjax.simulation.events import Margins
from travjax.site.ground import ArrayGround, Ground, Site
from travjax.site.kernel import SiteSetup, Tile, site_margins, tile_margins
from travjax.site.primitives import PointTurn

UNKNOWN = 255
"""Stands for unknown ground among what stands in the way; 0 is nothing, 1 the robot's first event."""

UNKNOWN_NAME = "unknown ground or the site's edge"
"""What messages and figures call it: ground beyond the site is unknown, too."""

Judged = tuple[Float32[np.ndarray, "m rows cols"], UInt8[np.ndarray, "m rows cols"]]
"""Factors of the cost of motions from places, inf where they are impossible, and what is in their way there."""


class Judge(Protocol):
    """Says what motions cost, and why some are impossible."""

    title: str
    """What figures call it."""

    final: bool
    """Whether a path must pass the sequential simulators in the end, because the judge wants the same as they do."""

    @property
    def unknown_allowed(self) -> bool:
        """Whether motions may lead over unknown ground."""

    def motions(self, tile: Tile) -> Judged:
        """Judges all motions of the lattice from the places of a tile: [motions, edge, edge]."""

    def standing(self) -> Judged:
        """Judges the robot standing at every place in every heading: [headings, rows, cols].

        Its factors must not exceed those of motions that begin or end there.
        """


class MarginJudge:
    """Judges by exact margins: a cost grows with the largest share of a limit, and is inf beyond it.

    Where unknown ground may be driven on, it is taken to be as high as the nearest known ground: a wall between two
    unknown patches still is one. What leaves the site stays impossible.
    """

    title = "exact margins"
    final = True

    def __init__(self, ground: Site, setup: SiteSetup, lattice: MotionLattice, unknown_cost: float | None = None):
        """
        setup:        robot, spacing, stride and contact model; its primitives are replaced by the motions
        unknown_cost: how many times as much as the worst safe ground unknown ground costs, at least 1; None where it
                      is not driven on
        """
        self._ground, self._robot, self._risk = ground, setup.robot, lattice.motions.risk
        self._unknown_cost, self._assumed = unknown_cost, None
        if unknown_cost is not None:
            rows, cols = ground.shape
            self._assumed = ArrayGround(filled(ground.part(slice(0, rows), slice(0, cols))[None])[0])
        groups = (lattice.straights, lattice.curves, lattice.point_turns)  # a kernel runs over as many poses for each
        self._setups = [replace(setup, primitives=tuple(one.primitive for one in group)) for group in groups if group]
        self._standing = replace(setup, primitives=tuple(PointTurn(angle) for angle in lattice.angles.tolist()))

    @property
    def unknown_allowed(self) -> bool:
        """Whether motions may lead over unknown ground."""
        return self._unknown_cost is not None

    def motions(self, tile: Tile) -> Judged:
        """Judges the motions from the places of a tile."""
        parts = []
        for setup in self._setups:
            simulate = lambda ground, setup=setup: tile_margins(ground.part(*tile.ground(setup)), setup)
            parts.append(self.judged(simulate, isinstance(setup.primitives[0], PointTurn)))
        factors, in_the_way = (np.concatenate(field) for field in zip(*parts, strict=True))
        return factors, in_the_way

    def standing(self) -> Judged:
        """Judges the robot standing at every place in every heading."""
        return self.judged(lambda ground: site_margins(ground, self._standing), turning=True)

    def judged(self, simulate: Callable[[Ground], Margins], turning: bool) -> Judged:
        """Judges some motions.

        simulate: returns their margins on a ground; turning: whether they are point turns, whose wheels do not climb
        """
        factor, in_the_way = self._on_known_ground(simulate(self._ground), turning)
        if self._unknown_cost is None or self._assumed is None:
            return factor, in_the_way
        unknown = in_the_way == UNKNOWN
        assumed, in_the_way_then = self._on_known_ground(simulate(self._assumed), turning)
        possible = np.isfinite(assumed)
        cost = np.where(possible, np.float32(self._unknown_cost * (1 + self._risk)), np.float32(np.inf))
        return np.where(unknown, cost, factor), np.where(unknown & ~possible, in_the_way_then, in_the_way)

    def _on_known_ground(self, margins: Margins, turning: bool) -> Judged:
        known = np.asarray(margins.known)
        share, in_the_way = np.zeros(known.shape, np.float32), np.zeros(known.shape, np.uint8)
        for number, (event, limit) in enumerate(zip(self._robot.events, self._robot.limits, strict=True), 1):
            if turning and event.name == "step":
                continue
            ours = np.asarray(margins[event.name]) / np.float32(limit)
            over = np.asarray(margins[event.name]) > np.float32(limit)  # a quotient may be rounded to 1
            in_the_way[over & (ours >= np.maximum(share, 1))] = number
            share = np.fmax(share, ours)
        in_the_way = np.where(known, in_the_way, UNKNOWN).astype(np.uint8)
        factor = np.where(in_the_way > 0, np.inf, 1 + self._risk * np.minimum(share, 1) ** 2)
        return factor.astype(np.float32), in_the_way
