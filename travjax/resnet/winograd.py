"""3 x 3 convolutions by Winograd's minimal filtering F(2 x 2, 3 x 3), which needs 4 products a pixel instead of 9.

Images are cut into tiles of 2 x 2 pixels, each with its surroundings of 4 x 4. A linear transform along rows and
columns turns the surroundings and the kernel into 4 x 4 matrices, the products of which, summed over channels, are
turned back into 2 x 2 pixels (Lavin and Gray 2016, arXiv 1509.09308). The gradients are the transposed transforms with
the products in between, so they need 4 products a pixel as well.

A grid is a list of rows of arrays, here [tiles, channels] of one place of a tile, with the tiles of all images in
order.
"""

from collections.abc import Iterable
from functools import partial, reduce
from operator import add

import jax
import jax.numpy as jnp
from jax import lax

Grid = list[list[jax.Array]]
Matrix = tuple[tuple[float, ...], ...]

SURROUNDINGS: Matrix = ((1, 0, -1, 0), (0, 1, 1, 0), (0, -1, 1, 0), (0, 1, 0, -1))
KERNEL: Matrix = ((1, 0, 0), (0.5, 0.5, 0.5), (0.5, -0.5, 0.5), (0, 0, 1))
PIXELS: Matrix = ((1, 1, 1, 0), (0, 1, -1, -1))
"""The three transforms, of 4, 3 and 4 places; their entries are exact in binary."""

Saved = tuple[Grid, Grid]
"""The transformed surroundings and kernel."""


def convolve(images: jax.Array, kernel: jax.Array) -> tuple[jax.Array, Saved]:
    """Cross-correlates [b, rows, cols, in] with [3, 3, in, out], with one pixel of zeros on each side.

    Returns [b, rows, cols, out] and what `gradients` needs.
    """
    surroundings = _transform(SURROUNDINGS, _surroundings(images))
    factors = _transform(KERNEL, [list(row) for row in kernel])
    pixels = _transform(PIXELS, _product(surroundings, factors, (1, 0)))
    return _joined(pixels, images.shape), (surroundings, factors)


def gradients(saved: Saved, gradient: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the gradients of the images and of the kernel, from that of the result."""
    surroundings, factors = saved
    products = _transform(_transposed(PIXELS), _pixels(gradient))
    of_kernel = _transform(_transposed(KERNEL), _product(surroundings, products, (0, 0)))
    of_surroundings = _transform(_transposed(SURROUNDINGS), _product(products, factors, (1, 1)))
    return _overlapped(of_surroundings, gradient.shape), jnp.stack([jnp.stack(row) for row in of_kernel])


def _transform(matrix: Matrix, grid: Grid) -> Grid:
    """Returns matrix @ grid @ matrix^T, its arrays in memory as [n, channels]."""
    columns = [[_combined(weights, column) for weights in matrix] for column in zip(*grid, strict=True)]
    return [[flattened(_combined(weights, row)) for weights in matrix] for row in zip(*columns, strict=True)]


def _combined(weights: Iterable[float], arrays: Iterable[jax.Array]) -> jax.Array:
    return reduce(add, (weight * array for weight, array in zip(weights, arrays, strict=True) if weight))


def _product(left: Grid, right: Grid, axes: tuple[int, int]) -> Grid:
    """Multiplies matrices place by place, summing over an axis of the left ones and an axis of the right ones."""
    dot = partial(lax.dot_general, dimension_numbers=(((axes[0],), (axes[1],)), ((), ())))
    return [
        [lax.optimization_barrier(dot(*pair)) for pair in zip(*rows, strict=True)]
        for rows in zip(left, right, strict=True)
    ]


def _transposed(matrix: Matrix) -> Matrix:
    return tuple(zip(*matrix, strict=True))


def _tiles(shape: tuple[int, ...]) -> tuple[int, int]:
    """Returns how many tiles cover images [b, rows, cols, channels], along rows and columns."""
    return (shape[1] + 1) // 2, (shape[2] + 1) // 2


def _surroundings(images: jax.Array) -> Grid:
    """Cuts images into the overlapping 4 x 4 surroundings of their tiles: [b, tile rows, tile cols, in] each."""
    _, rows, cols, _ = images.shape
    down, across = _tiles(images.shape)
    padded = jnp.pad(images, ((0, 0), (1, 2 * down - rows + 1), (1, 2 * across - cols + 1), (0, 0)))
    return [[padded[:, i : i + 2 * down - 1 : 2, j : j + 2 * across - 1 : 2] for j in range(4)] for i in range(4)]


def _overlapped(surroundings: Grid, shape: tuple[int, ...]) -> jax.Array:
    """Adds up surroundings where they overlap, which is the transpose of `_surroundings`.

    shape: [b, rows, cols, channels] of the images; the channels may be others
    """
    (down, across), count = _tiles(shape), shape[0]
    ends = ((0, 1), (0, 1), (1, 0), (1, 0))  # Places 2 and 3 of a tile are places 0 and 1 of the next one.
    moved = [
        [
            jnp.pad(part.reshape(count, down, across, -1), ((0, 0), ends[i], ends[j], (0, 0)))
            for j, part in enumerate(row)
        ]
        for i, row in enumerate(surroundings)
    ]
    total = lambda i, j: moved[i][j] + moved[i + 2][j] + moved[i][j + 2] + moved[i + 2][j + 2]
    whole = _interleaved([[total(i, j) for j in range(2)] for i in range(2)])
    return whole[:, 1 : shape[1] + 1, 1 : shape[2] + 1]


def _pixels(images: jax.Array) -> Grid:
    """Cuts images into tiles of 2 x 2 pixels, the last ones filled up with zeros."""
    filled = jnp.pad(images, ((0, 0), (0, images.shape[1] % 2), (0, images.shape[2] % 2), (0, 0)))
    return [[filled[:, i::2, j::2] for j in range(2)] for i in range(2)]


def _joined(pixels: Grid, shape: tuple[int, ...]) -> jax.Array:
    """Puts tiles of 2 x 2 pixels together to images; the transpose of `_pixels`.

    shape: [b, rows, cols, channels] of the images; the channels may be others
    """
    down, across = _tiles(shape)
    tiles = [[part.reshape(shape[0], down, across, -1) for part in row] for row in pixels]
    return _interleaved(tiles)[:, : shape[1], : shape[2]]


def _interleaved(grid: Grid) -> jax.Array:
    """Joins 2 x 2 arrays [b, rows, cols, channels] of every other pixel to [b, 2 rows, 2 cols, channels]."""
    whole = jnp.stack([jnp.stack(row, axis=3) for row in grid], axis=2)
    count, down, _, across, _, channels = whole.shape
    return whole.reshape(count, 2 * down, 2 * across, channels)


def flattened(array: jax.Array) -> jax.Array:
    """Reshapes to [n, channels] in memory, so that XLA does not fuse what comes before into what follows."""
    return lax.optimization_barrier(array.reshape(-1, array.shape[-1]))
