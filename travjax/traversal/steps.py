"""The steps of a map: the height that a tyre must climb or drop at each node (SPEC section 15).

heights -> gaps that a tyre bridges are filled -> rises that are steeper than the ground before and after them. A step
belongs to the map and the wheel's radius, not to a direction of driving, so it is computed once for a map.
"""

import math
from collections.abc import Callable
from itertools import product

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from travjax.simulation.grid import HIGHEST

TIE = 1e-9
"""Metres, slack of the wheel's radius."""

DIRECTIONS = tuple(direction for direction in product((-1, 0, 1), repeat=2) if any(direction))
"""The (row, col) offsets to the eight neighbours of a node; one of each opposite pair comes after the middle."""

EVEN = 1e-5
"""Metres, by which parts of a rise may differ and still be equal: rounding must not decide whose an even bank is."""

LEAST = 2
"""Distances between nodes that a rise may take, also where the wheel is smaller: a sensor blurs a kerb so far."""

At = Callable[[int], jax.Array]
"""Returns, for all nodes at once, the heights so many nodes further in one direction, NaN off the map."""


def nodes_within(distance: float, spacing: float) -> int:
    """Returns how many nodes in a row lie within a distance, at least 1."""
    return max(1, math.floor((distance + TIE) / spacing))


def reach_of_steps(radius: float, spacing: float) -> int:
    """Returns how many nodes away ground may be that the step of a node depends on."""
    within = nodes_within(radius, spacing)
    return (within + 1) + 2 * max(LEAST, within)


def without_gaps(heights: Float[Array, "n r c"], radius: float, spacing: float) -> Float[Array, "n r c"]:
    """Fills the trenches and holes of maps that a tyre bridges.

    heights: metres, NaN or beyond grid.HIGHEST where unknown
    radius:  metres, of the wheels; spacing: metres between nodes
    Returns metres, NaN where unknown. Source: SPEC section 15.
    """
    heights = jnp.where(jnp.abs(heights) <= HIGHEST, heights, jnp.nan)
    filled = heights
    for at, count, _ in _lines(heights, radius, spacing, DIRECTIONS[4:], nodes_within(radius, spacing) + 1):
        before, after = [_rim(at, -i) for i in range(1, count)], [_rim(at, i) for i in range(1, count)]
        for i, j in product(range(1, count), repeat=2):
            if i + j <= count:
                level = jnp.minimum(before[i - 1], after[j - 1])  # NaN where a rim is unknown
                filled = jnp.where(level > filled, level, filled)
    return filled


def _rim(at: At, k: int) -> jax.Array:
    """Returns the height of the rim k nodes away, continued to here where it falls towards here."""
    rim = at(k)
    fall = rim - at(k + (1 if k > 0 else -1))
    return rim + abs(k) * jnp.where(fall < 0, fall, 0)


def step_heights(filled: Float[Array, "n r c"], radius: float, spacing: float) -> Float[Array, "n r c"]:
    """Computes the step S of every node.

    filled: metres, of `without_gaps`; radius, spacing: metres, as there
    Returns metres, at least 0; 0 where unknown. Source: SPEC section 15.
    """
    highest = jnp.zeros_like(filled)
    reach = 2 * max(LEAST, nodes_within(radius, spacing))
    for at, within, distance in _lines(filled, radius, spacing, DIRECTIONS, reach):
        count, arriving = max(LEAST, within), at(0) - at(-1)
        for i, j in product(range(1, count + 1), range(count)):
            n = i + j
            if n > count:
                continue
            rise, before, after = at(j) - at(-i), at(-i) - at(-i - n), at(j + n) - at(j)
            before, after = (jnp.where(jnp.isnan(a), b, a) for a, b in ((before, after), (after, before)))
            slope = jnp.nan_to_num(jnp.maximum(before, after))
            bank = jnp.maximum(jnp.nan_to_num(jnp.minimum(before, after)), n * distance)
            excess = rise - jnp.minimum(jnp.maximum(slope, 0), bank)
            counts = excess > highest
            if n > 1:
                counts &= rise > n * distance  # what is less steep than 45 degrees is a slope
            for k in range(1 - i, j + 1):
                counts &= arriving >= at(k) - at(k - 1) - EVEN
            highest = jnp.where(counts, excess, highest)
    return highest


def _lines(heights: jax.Array, radius: float, spacing: float, directions, reach: int):
    """Yields, for each direction, the heights along it, how many nodes lie within the radius, and their distance."""
    rows, cols = heights.shape[1:]
    padded = jnp.pad(heights, ((0, 0), (reach, reach), (reach, reach)), constant_values=jnp.nan)
    for row, col in directions:

        def at(k: int, row=row, col=col) -> jax.Array:
            top, left = reach + k * row, reach + k * col
            return padded[:, top : top + rows, left : left + cols]

        distance = spacing * math.hypot(row, col)
        yield at, nodes_within(radius, distance), distance
