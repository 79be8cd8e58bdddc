"""What motions cost from every place, and what stands in their way: exact margins of the site kernel (SPEC section 13).

The kernel runs over tiles of places when a search first comes to them; the robot standing at every place in every
heading, which is quick, is simulated at the beginning and gives the search its bound.
"""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property

import numpy as np
from jaxtyping import Float32, UInt8

from travjax.planning.motions import MotionLattice
from travjax.planning.path import Leg
from travjax.simulation.events import Margins
from travjax.site.ground import Site
from travjax.site.kernel import SiteSetup, Tile, site_margins, tile_margins, workers
from travjax.site.primitives import PointTurn

TILE = 32
"""Places along an edge of the tiles that are simulated when a search needs them."""

UNKNOWN = 255
"""Stands for unknown ground among what stands in the way; 0 is nothing, 1 the robot's first event."""


class MotionCosts:
    """The costs of motions on a site.

    cost:         [places, motions] as of Motions, inf where the robot fails or the ground is unknown
    in_the_way:   [places, motions] 0 for nothing, 1, 2, 3 ... for the robot's event of this number, or UNKNOWN
    refused:      how many motions were forbidden by `block`
    evaluated:    [tile rows, tile cols] of tiles of `tile` places a side, whether these are known
    unknown_cost: how many times as much as the worst safe ground unknown ground costs, at least 1; None where it is
                  not driven on
    """

    def __init__(self, ground: Site, setup: SiteSetup, lattice: MotionLattice, unknown_cost: float | None = None):
        """setup: robot, spacing, stride and contact model; its primitives are replaced by the motions."""
        self.ground, self.lattice, self.unknown_cost = ground, lattice, unknown_cost
        self.robot, self.shape, self.tile = setup.robot, setup.lattice(ground.shape), TILE
        places = self.shape[0] * self.shape[1]
        self.cost = np.empty((places, len(lattice.all)), np.float32)
        self.in_the_way = np.empty((places, len(lattice.all)), np.uint8)
        self.evaluated = np.zeros(tuple(-(-count // TILE) for count in self.shape), bool)
        self._setups = _setups(setup, lattice)
        self.refused = 0
        self._pool = ThreadPoolExecutor(workers())
        self._standing = replace(setup, primitives=tuple(PointTurn(angle) for angle in lattice.angles.tolist()))

    @cached_property
    def standing(self) -> tuple[Float32[np.ndarray, "h rows cols"], UInt8[np.ndarray, "h rows cols"]]:
        """The factor of cost of the robot standing at every place in every heading, and what is in its way there."""
        return self._judged(site_margins(self.ground, self._standing), turning=True)

    @property
    def easiest(self) -> Float32[np.ndarray, "rows cols"]:
        """The smallest factor of cost at every place, in its best heading."""
        return self.standing[0].min(axis=0)

    def evaluate(self, places: Iterable[int]) -> None:
        """Simulates the motions in the tiles of the first places where they are missing, as many as there are cores."""
        missing: list[tuple[int, int]] = []
        for place in places:
            row, col = divmod(place, self.shape[1])
            tile = row // TILE, col // TILE
            if not self.evaluated[tile] and tile not in missing:
                missing.append(tile)
            if len(missing) == workers():
                break
        for tile in self._pool.map(self._evaluate, missing):
            self.evaluated[tile] = True

    def block(self, leg: Leg) -> None:
        """Forbids a motion that the sequential simulators refuse."""
        self.refused += 1
        self.cost[leg.row * self.shape[1] + leg.col, self.lattice.all.index(leg.motion)] = np.inf

    def _evaluate(self, at: tuple[int, int]) -> tuple[int, int]:
        tile, first = Tile(at[0] * TILE, at[1] * TILE, TILE), 0
        rows, cols = tile.within(self.shape)
        places = (np.arange(rows.start, rows.stop)[:, None] * self.shape[1] + np.arange(cols.start, cols.stop)).ravel()
        for setup in self._setups:
            margins = tile_margins(self.ground.part(*tile.ground(setup)), setup)
            factor, in_the_way = self._judged(margins, isinstance(setup.primitives[0], PointTurn))
            motions = slice(first, first + len(factor))
            factor, in_the_way = (
                tile.cropped(field, self.shape).reshape(len(factor), -1).T for field in (factor, in_the_way)
            )
            possible = np.isfinite(factor)  # a turn may cost nothing, and 0 * inf is no number
            self.cost[places, motions] = np.multiply(factor, self.lattice.costs[motions], out=factor, where=possible)
            self.in_the_way[places, motions] = in_the_way
            first = motions.stop
        return at

    def _judged(self, margins: Margins, turning: bool) -> tuple[np.ndarray, np.ndarray]:
        """Returns the factors of cost of motions, and what is in their way: of the same shape as the margins."""
        known = np.asarray(margins.known)
        share, in_the_way = np.zeros(known.shape, np.float32), np.zeros(known.shape, np.uint8)
        for number, (event, limit) in enumerate(zip(self.robot.events, self.robot.limits, strict=True), 1):
            if turning and event.name == "step":
                continue  # wheels that turn on the spot do not climb
            ours = np.asarray(margins[event.name]) / np.float32(limit)
            over = np.asarray(margins[event.name]) > np.float32(limit)  # a quotient may be rounded to 1
            in_the_way[over & (ours >= np.maximum(share, 1))] = number
            share = np.fmax(share, ours)
        factor = np.where(in_the_way > 0, np.inf, 1 + self.lattice.motions.risk * np.minimum(share, 1) ** 2)
        unknown = np.inf if self.unknown_cost is None else self.unknown_cost * (1 + self.lattice.motions.risk)
        return np.where(known, factor, unknown).astype(np.float32), np.where(known, in_the_way, UNKNOWN).astype(
            np.uint8
        )


def _setups(setup: SiteSetup, lattice: MotionLattice) -> list[SiteSetup]:
    """Returns setups whose primitives are all motions in their order: a kernel runs over as many poses for each."""
    groups = (lattice.straights, lattice.curves, lattice.turns)
    return [replace(setup, primitives=tuple(motion.primitive for motion in group)) for group in groups if group]
