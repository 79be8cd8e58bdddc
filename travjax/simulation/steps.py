"""The steps of a map: the height that a tyre must climb or drop at each node (SPEC section 15).

heights -> gaps that a tyre bridges are closed -> rises that are steeper than the ground before and after them. A step
belongs to the map and the wheel's radius, not to a direction of driving, so it is computed once for a map.
"""

import math
from itertools import product

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from travjax.simulation.grid import HIGHEST

TIE = 1e-9
"""Slack of bounds, as a share of the spacing."""

DIRECTIONS = tuple(direction for direction in product((-1, 0, 1), repeat=2) if any(direction))
"""The (row, col) offsets to the eight neighbours of a node."""


def step_heights(heights: Float[Array, "n r c"], radius: float, spacing: float) -> Float[Array, "n r c"]:
    """Computes the step S of every node.

    heights: metres, NaN or beyond grid.HIGHEST where unknown
    radius:  metres, of the wheels; spacing: metres between nodes
    Returns metres, at least 0; 0 where unknown. Source: SPEC section 15.
    """
    heights = jnp.where(jnp.abs(heights) <= HIGHEST, heights, jnp.nan)
    closed = _closed(heights, nodes_within(radius, spacing))
    # One pad holds all the neighbours that are read, two rises in every direction.
    margin = 2 * nodes_within(radius, spacing)
    padded = jnp.pad(closed, ((0, 0), (margin, margin), (margin, margin)), constant_values=jnp.nan)
    rows, cols = heights.shape[1:]

    def at(row: int, col: int) -> jax.Array:
        return padded[:, margin + row : margin + row + rows, margin + col : margin + col + cols]

    highest = jnp.zeros_like(heights)
    for row, col in DIRECTIONS:
        for n in range(1, nodes_within(radius, spacing * math.hypot(row, col)) + 1):
            behind = at(-n * row, -n * col)
            before, after = behind - at(-2 * n * row, -2 * n * col), at(n * row, n * col) - closed
            slope = jnp.where(before > 0, before, 0)
            slope = jnp.where(after > slope, after, slope)
            excess = closed - behind - slope
            highest = jnp.where(excess > highest, excess, highest)
    return highest


def nodes_within(distance: float, spacing: float) -> int:
    """Returns how many nodes in a row lie within a distance, at least 1."""
    return max(1, math.floor(distance / spacing + TIE))


def _closed(heights: jax.Array, size: int) -> jax.Array:
    """Returns the smallest, over all squares of `size` nodes that contain a node, of their largest known heights."""
    known = jnp.isfinite(heights)
    window, strides, around = (1, size, size), (1, 1, 1), ((0, 0), (size - 1, size - 1), (size - 1, size - 1))
    largest = jax.lax.reduce_window(jnp.where(known, heights, -jnp.inf), -jnp.inf, jax.lax.max, window, strides, around)
    smallest = jax.lax.reduce_window(largest, jnp.inf, jax.lax.min, window, strides, "VALID")
    return jnp.where(known, smallest, jnp.nan)
