"""What exported functions do before the network sees a map: unknown nodes filled as on the host, ties included."""

import jax
import numpy as np
import pytest

from tests.small_training import GRID
from travjax.data.sensor_noise import filled, thinned
from travjax.exporting.functions import nearest_filled

fill = jax.jit(nearest_filled)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.99, 1.0])
def test_unknown_nodes_get_the_same_heights_as_on_the_host(share):
    rng = np.random.default_rng(3)
    heights = thinned(rng.random((20, *GRID.shape), dtype=np.float32), share, rng)
    np.testing.assert_array_equal(jax.vmap(fill)(heights), filled(heights))


@pytest.mark.parametrize("every", [(2, 1), (1, 2), (2, 2), (4, 4), (6, 3)])
def test_so_do_nodes_that_are_as_near_to_several_known_ones(every):
    heights = np.full(GRID.shape, np.nan, np.float32)
    known = heights[:: every[0], :: every[1]]
    known[...] = np.arange(known.size).reshape(known.shape)
    np.testing.assert_array_equal(fill(heights), filled(heights[None])[0])
