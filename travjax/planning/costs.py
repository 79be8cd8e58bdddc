"""The costs of motions on a site, asked from a judge tile by tile, when a search first comes to a tile."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cached_property

import numpy as np
from jaxtyping import Float32

from travjax import progress
from travjax.memory import require_memory
from travjax.planning.judges import Judge, Judged
from travjax.planning.motions import MotionLattice
from travjax.planning.path import Leg
from travjax.simulation.robot import Robot
from travjax.site.ground import Site
from travjax.site.kernel import SiteSetup, Tile, workers

TILE = 32
"""Places along an edge of the tiles that are judged at once."""


class MotionCosts:
    """The costs of motions on a site.

    cost:       [places, motions] as of Motions, inf where the robot fails or the ground is unknown
    in_the_way: [places, motions] 0 for nothing, 1, 2, 3 ... for the robot's event of this number, or judges.UNKNOWN
    evaluated:  [tile rows, tile cols] of tiles of `tile` places a side, whether these are known
    refused:    how many motions were forbidden by `block`
    on_progress: is called after each tile that was judged
    """

    def __init__(self, ground: Site, setup: SiteSetup, lattice: MotionLattice, judge: Judge):
        self.ground, self.lattice, self.judge = ground, lattice, judge
        self.robot: Robot = setup.robot
        self.shape, self.tile = setup.lattice(ground.shape), TILE
        places, headings = self.shape[0] * self.shape[1], lattice.headings
        needed = places * (5 * len(lattice.all) + 40 * headings)  # also of a search, and of the margins of standing
        require_memory(needed, f"a plan on {self.shape[0]} x {self.shape[1]} places", "; a longer stride takes less")
        self.cost = np.empty((places, len(lattice.all)), np.float32)
        self.in_the_way = np.empty((places, len(lattice.all)), np.uint8)
        self.evaluated = np.zeros(tuple(-(-count // TILE) for count in self.shape), bool)
        self.refused = 0
        self.on_progress: Callable[[], object] = lambda: None
        self._pool = ThreadPoolExecutor(workers())

    @cached_property
    def standing(self) -> Judged:
        """The factor of cost of the robot standing at every place in every heading, and what is in its way there."""
        return self.judge.standing()

    @cached_property
    def easiest(self) -> Float32[np.ndarray, "rows cols"]:
        """The smallest factor of cost at every place, in its best heading."""
        return self.standing[0].min(axis=0)

    def at(self, row: int, col: int) -> tuple[float, float]:
        """Returns x and y of a place, in coordinates of the site."""
        x, y = self.ground.origin
        return x + col * self.lattice.stride, y + row * self.lattice.stride

    def evaluate(self, places: Iterable[int]) -> None:
        """Judges the motions in the tiles of the first places where they are missing, as many as there are cores."""
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
            self.on_progress()

    @contextmanager
    def watched(self, what: str, whole: bool) -> Iterator[None]:
        """Shows how many tiles are judged; whole: whether these will be all tiles."""
        left = self.evaluated.size - int(self.evaluated.sum())
        with progress.bar(what, left if whole else None, "tile") as bar:
            self.on_progress = bar.update
            try:
                yield
            finally:
                self.on_progress = lambda: None

    def block(self, leg: Leg) -> None:
        """Forbids a motion that the sequential simulators refuse."""
        self.refused += 1
        self.cost[leg.row * self.shape[1] + leg.col, self.lattice.all.index(leg.motion)] = np.inf

    def _evaluate(self, at: tuple[int, int]) -> tuple[int, int]:
        tile = Tile(at[0] * TILE, at[1] * TILE, TILE)
        rows, cols = tile.within(self.shape)
        places = (np.arange(rows.start, rows.stop)[:, None] * self.shape[1] + np.arange(cols.start, cols.stop)).ravel()
        factor, in_the_way = (
            tile.cropped(field, self.shape).reshape(len(field), -1).T for field in self.judge.motions(tile)
        )
        possible = np.isfinite(factor)  # a turn may cost nothing, and 0 * inf is no number
        self.cost[places] = np.multiply(factor, self.lattice.costs, out=factor.copy(), where=possible)
        self.in_the_way[places] = in_the_way
        return at
