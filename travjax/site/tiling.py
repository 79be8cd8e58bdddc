"""Runs over the tiles of a site: reads the ground of each, simulates it, and hands on what the map says of its places.

One thread reads and takes the results. Meanwhile as many tiles as there are cores are simulated by threads of this
process, or as many as there are threads in a cluster by the workers of Dask.
"""

from collections import deque
from collections.abc import Collection, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, UInt8

from travjax.config import InputError, require_installed
from travjax.jax_flags import usual_flags
from travjax.site.costs import products
from travjax.site.ground import Ground
from travjax.site.kernel import SiteSetup, Tile, tile_margins, tiles_of, workers

CONNECT = 30
"""Seconds within which a scheduler has to answer."""

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


LOCAL = "local"
"""Stands for a cluster of processes on this machine."""


@contextmanager
def executor(scheduler: str | None = None) -> Iterator[tuple[Executor, int]]:
    """Yields what simulates tiles, and how many of them at once.

    scheduler: address of a scheduler of Dask, or LOCAL; threads of this process unless given
    Raises InputError when Dask is missing, or the scheduler cannot be reached.
    """
    if scheduler is None:
        with ThreadPoolExecutor(workers()) as pool:
            try:
                yield pool, workers()
            finally:
                pool.shutdown(cancel_futures=True)
        return
    require_installed("distributed", "Dask", "dask")
    from distributed import Client, LocalCluster

    with ExitStack() as stack:
        try:
            where = scheduler
            if scheduler == LOCAL:
                where = stack.enter_context(LocalCluster(threads_per_worker=1, dashboard_address=None))
            client = stack.enter_context(Client(where, timeout=CONNECT))
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(f"--scheduler {scheduler}: cannot be reached: {str(error)[:160]}") from None
        threads = sum(client.nthreads().values())
        yield client.get_executor(), max(threads, 1)


def parts_of(
    ground: Ground, setup: SiteSetup, pool: tuple[Executor, int], done: Collection[int] = ()
) -> Iterator[tuple[int, Part]]:
    """Yields the number of each tile and its part, in order, except those that are done; pool: of `executor`."""
    lattice, (simulating, count) = setup.lattice(ground.shape), pool
    tiles = [(number, tile) for number, tile in enumerate(tiles_of(lattice, setup)) if number not in done]
    running: deque[tuple[int, Future]] = deque()
    for number, tile in tiles:
        running.append((number, simulating.submit(_part, ground.part(*tile.ground(setup)), tile, setup, lattice)))
        if len(running) > AHEAD * count:
            first, part = running.popleft()
            yield first, part.result()
    for number, part in running:
        yield number, part.result()


@usual_flags()
def _part(ground: np.ndarray, tile: Tile, setup: SiteSetup, lattice: tuple[int, int]) -> Part:
    bands, costs = jax.device_get(products(tile_margins(ground, setup), setup.robot))
    first = setup.halo * setup.step
    heights = ground[first :: setup.step, first :: setup.step]
    return Part(tile, *(tile.cropped(values, lattice) for values in (bands, costs, heights)))
