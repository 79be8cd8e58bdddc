"""OpenSimplex 2D noise in JAX, the same function as the `opensimplex` package (the 2014 algorithm).

The plane is skewed so that a triangular lattice becomes a square one. Every lattice vertex within sqrt(2) of a point
adds (2 - d^2)^4 (g . d), with d the vector from the vertex and g one of eight gradients that a permutation of 256
picks. A point lies in one lattice cell, and at most five vertices can reach it: the cell's corners and one outside. The
gradients of all eight vertices around a cell are packed into one integer, so that each point reads memory once.
"""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from travjax.batching import rounded
from travjax.config import require
from travjax.jax_flags import usual_flags
from travjax.simulation.arrays import integers, numbers

SKEW = (1 / 3**0.5 - 1) / 2
UNSKEW = (3**0.5 - 1) / 2
NORM = 47
"""Divisor that scales the sum to [-1, 1]."""

SEEDS = 10_000
"""Noise seeds of terrain lie in [0, SEEDS)."""

AROUND = ((0, 0), (1, 0), (0, 1), (1, 1), (1, -1), (2, 0), (-1, 1), (0, 2))
"""Vertices that can reach a point of cell (0, 0), three bits each in a cell's code. Only one of the last four
counts: below the cell's diagonal x + y = 1 the vertex at 4 (if x > y) or 6, above it the one at 5 (if x > y) or 7."""


def permutations(seeds) -> np.ndarray:
    """Shuffles the permutation of each seed as the `opensimplex` package does: [n, 256] uint8 for n integers."""
    state = np.asarray(seeds, np.int64)
    multiplier, increment = np.int64(6364136223846793005), np.int64(1442695040888963407)
    each = np.arange(len(state))
    source = np.tile(np.arange(256, dtype=np.uint8), (len(state), 1))
    shuffled = np.zeros_like(source)
    for _ in range(3):
        state = state * multiplier + increment
    for last in range(255, -1, -1):
        state = state * multiplier + increment
        pick = (state + 31) % (last + 1)
        shuffled[:, last] = source[each, pick]
        source[each, pick] = source[:, last]
    return shuffled


@lru_cache(maxsize=1)
def permutation_table() -> jax.Array:
    """Returns the permutations of all terrain seeds, on the device: [SEEDS, 256] uint8."""
    with jax.ensure_compile_time_eval():  # an array, not a tracer, even while the caller is traced
        return jnp.asarray(permutations(np.arange(SEEDS)))


@usual_flags()
def noise2(seed, x: Float[Array, "*s"], y: Float[Array, "*s"]) -> Float[Array, "..."]:
    """Returns noise in [-1, 1] at points (x, y): [...] for one integer seed, [n, ...] for n seeds.

    Agrees with `OpenSimplex(seed).noise2` to 1e-5 where |x|, |y| < 32. Raises InputError unless the seeds are integers.
    """
    whole = "an integer, or a list of integers"
    seeds = integers("seed", seed, whole, -(2**63), 2**63 - 1)
    require(seeds.ndim < 2, "seed", seed, whole)
    x, y = (values if isinstance(values, jax.Array) else numbers("x, y", values) for values in (x, y))
    tables = permutations(np.atleast_1d(seeds))
    value = _noise_of_permutations(tables, jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32))
    return value[0] if seeds.ndim == 0 else value


@jax.jit
def _noise_of_permutations(tables, x, y):
    return jax.vmap(lambda table: noise_at(x, y, lambda i, j: cell_codes(table, i, j)))(tables)


def noise_on_axes(permutation: Int[Array, "256"], x: Float[Array, " cols"], y: Float[Array, " rows"], reach: float):
    """Returns noise on the grid of the axes x and y, all within [-reach, reach]: [rows, cols].

    Codes of the lattice cells are computed first where there are fewer cells than points.
    """
    half = int(np.ceil(reach)) + 1
    edge = 2 * half + 1
    if edge**2 > x.size * y.size:
        return noise_at(x[None, :], y[:, None], lambda i, j: cell_codes(permutation, i, j))
    cells = jnp.arange(-half, half + 1, dtype=jnp.int32)
    codes = cell_codes(permutation, cells[:, None], cells[None, :]).reshape(-1)
    lookup = lambda i, j: codes.at[(i + half) * edge + j + half].get(mode="promise_in_bounds")
    return noise_at(x[None, :], y[:, None], lookup)


def cell_codes(permutation: Int[Array, "256"], i: Int[Array, "*s"], j: Int[Array, "*s"]) -> Int[Array, "*s"]:
    """Packs the gradients of the vertices AROUND lattice cells (i, j) into one integer for each cell."""
    hashed = permutation.astype(jnp.int32)
    code = jnp.zeros(jnp.broadcast_shapes(i.shape, j.shape), jnp.int32)
    for bits, (right, up) in enumerate(AROUND):
        column = hashed.at[(i + right) & 255].get(mode="promise_in_bounds")
        gradient = hashed.at[(column + j + up) & 255].get(mode="promise_in_bounds")
        code |= ((gradient >> 1) & 7) << (3 * bits)
    return code


def noise_at(x, y, code_of_cell) -> Float[Array, "*s"]:
    """Returns noise at points, given a function from cell indices (i, j) to the cells' codes."""
    skew = rounded((x + y) * SKEW)  # else a point at a cell's edge might fall into different cells in different loops
    i, j = jnp.floor(x + skew), jnp.floor(y + skew)
    inside_x, inside_y = x + skew - i, y + skew - j
    code = code_of_cell(i.astype(jnp.int32), j.astype(jnp.int32))
    dx, dy = x - (i + (i + j) * UNSKEW), y - (j + (i + j) * UNSKEW)
    wide, below = inside_x > inside_y, inside_x + inside_y <= 1
    outside = jnp.where(wide, jnp.where(below, 12, 15), jnp.where(below, 18, 21))
    right = jnp.where(wide, jnp.where(below, 1.0, 2.0), jnp.where(below, -1.0, 0.0))
    up = jnp.where(wide, jnp.where(below, -1.0, 0.0), jnp.where(below, 1.0, 2.0))
    corners = [(a, b, 3 * bits) for bits, (a, b) in enumerate(AROUND[:4])]
    return sum(_contribution(code >> shift, dx, dy, a, b) for a, b, shift in (*corners, (right, up, outside))) / NORM


def _contribution(gradient, dx, dy, right, up):
    """Returns what one vertex adds; gradients are (5, 2) with bit 0 swapping, bit 1 and bit 2 negating x and y."""
    dx, dy = dx - right - (right + up) * UNSKEW, dy - up - (right + up) * UNSKEW
    reach = jnp.maximum(2 - dx * dx - dy * dy, 0) ** 2
    swapped = (gradient & 1) != 0
    along_x = jnp.where(swapped, 2.0, 5.0) * jnp.where((gradient & 2) != 0, -dx, dx)
    along_y = jnp.where(swapped, 5.0, 2.0) * jnp.where((gradient & 4) != 0, -dy, dy)
    return reach * reach * (along_x + along_y)
