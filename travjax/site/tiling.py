"""Runs over the tiles of a site: reads the ground of each, simulates it, and hands on what the map says of its places.

One thread reads and takes the results; as many tiles as there are cores are simulated meanwhile.
"""

from collections import deque
from collections.abc import Collection, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, UInt8

from travjax.jax_flags import usual_flags
from travjax.site.costs import products
from travjax.site.ground import Ground
from travjax.site.kernel import SiteSetup, Tile, tile_margins, tiles_of, workers

AHEAD = 2
"""Tiles that are read ahead, for each that is being simulated."""


@dataclass(frozen=True)
class Part:
    """What the map says of the places of one tile, [rows, cols] within the lattice.

    bands, costs: of costs.products; heights: metres, of the ground at the places, NaN where unknown
    """

    tile: Tile
    bands: Float[np.ndarray, "b r c"]
    costs: UInt8[np.ndarray, "h r c"]
    heights: Float[np.ndarray, "r c"]


def parts_of(ground: Ground, setup: SiteSetup, done: Collection[int] = ()) -> Iterator[tuple[int, Part]]:
    """Yields the number of each tile and its part, in order, except those that are done."""
    lattice = setup.lattice(ground.shape)
    tiles = [(number, tile) for number, tile in enumerate(tiles_of(lattice)) if number not in done]
    running: deque[tuple[int, Future]] = deque()
    with ThreadPoolExecutor(workers()) as pool:
        try:
            for number, tile in tiles:
                running.append((number, pool.submit(_part, ground.part(*tile.ground(setup)), tile, setup, lattice)))
                if len(running) > AHEAD * workers():
                    first, part = running.popleft()
                    yield first, part.result()
            for number, part in running:
                yield number, part.result()
        finally:
            pool.shutdown(cancel_futures=True)


@usual_flags()
def _part(ground: np.ndarray, tile: Tile, setup: SiteSetup, lattice: tuple[int, int]) -> Part:
    rows, cols = (part.stop - part.start for part in tile.within(lattice))
    bands, costs = jax.device_get(products(tile_margins(ground, setup), setup.robot))
    first = setup.halo * setup.step
    heights = ground[first :: setup.step, first :: setup.step]
    return Part(tile, bands[:, :rows, :cols], costs[:, :rows, :cols], heights[:rows, :cols])
