"""The ground of a site at the nodes of maps: small holes filled, resampled, tile by tile as it is asked for.

A tile is made with so much ground around it that its nodes are those of the whole raster made at once.
"""

from collections import OrderedDict

import numpy as np

from travjax.rasters.holes import REACH, SmallHoles, interpolated
from travjax.rasters.raster import Raster

TILE = 1024
"""Nodes along an edge of a tile, at most."""

TILE_CELLS = 2048
"""Cells of the raster along an edge of a tile, about, where they are finer than the nodes."""


class Surface:
    """Heights of a raster at another spacing, from the same south-west node.

    shape:  (rows, cols) of nodes
    filled: number of the raster's cells that were interpolated in small holes
    """

    def __init__(self, raster: Raster, spacing: float, offset: float, fill_holes: bool):
        """Takes the metres above which heights are counted as `offset`."""
        self._raster, self._offset = raster, offset
        self._ratio = 1.0 if abs(spacing / raster.cell_size - 1) < 1e-6 else spacing / raster.cell_size
        rows, cols = (int((edge - 1) / self._ratio + 1e-6) + 1 for edge in raster.heights.shape)
        self.shape = rows, cols
        self._holes = SmallHoles(raster.heights, raster.cell_size) if fill_holes else None
        self.filled = self._holes.count if self._holes else 0
        self._edge = max(min(TILE, int(TILE_CELLS / self._ratio)), 1)
        self._tiles: OrderedDict[tuple[int, int], np.ndarray] = OrderedDict()
        self._kept = 2 * -(-cols // self._edge) + 2  # two rows of tiles: windows go from west to east

    def nodes(self, rows: slice, cols: slice) -> np.ndarray:
        """Returns the nodes of some rows and columns, [rows, cols] float32 metres, NaN unknown and off the raster."""
        cut = np.full((rows.stop - rows.start, cols.stop - cols.start), np.nan, np.float32)
        for i in self._tiles_along(rows, 0):
            for j in self._tiles_along(cols, 1):
                south, west = i * self._edge, j * self._edge
                tile = self._tile(i, j)
                row = slice(max(rows.start, south), min(rows.stop, south + len(tile)))
                col = slice(max(cols.start, west), min(cols.stop, west + tile.shape[1]))
                cut[row.start - rows.start : row.stop - rows.start, col.start - cols.start : col.stop - cols.start] = (
                    tile[row.start - south : row.stop - south, col.start - west : col.stop - west]
                )
        return cut

    def _tiles_along(self, nodes: slice, axis: int) -> range:
        """Returns the numbers of the tiles that hold some of these rows or columns."""
        first, last = max(nodes.start, 0), min(nodes.stop, self.shape[axis]) - 1
        return range(first // self._edge, last // self._edge + 1) if first <= last else range(0)

    def _tile(self, i: int, j: int) -> np.ndarray:
        if (i, j) not in self._tiles:
            starts = (i * self._edge, j * self._edge)
            ends = (min(start + self._edge, edge) for start, edge in zip(starts, self.shape, strict=True))
            self._tiles[i, j] = self._made(*(slice(*pair) for pair in zip(starts, ends, strict=True)))
            if len(self._tiles) > self._kept:
                self._tiles.popitem(last=False)
        self._tiles.move_to_end((i, j))
        return self._tiles[i, j]

    def _made(self, rows: slice, cols: slice) -> np.ndarray:
        """Makes the nodes of a tile: [rows, cols] float32."""
        around = int(REACH / self._raster.cell_size) + int(4 * _sigma(self._ratio)) + 2
        parts = []
        for nodes, edge in zip((rows, cols), self._raster.heights.shape, strict=True):
            first, last = int(nodes.start * self._ratio), int(np.ceil((nodes.stop - 1) * self._ratio))
            parts.append(slice(max(first - around, 0), min(last + around + 1, edge)))
        heights = self._raster.heights[parts[0], parts[1]]
        small = self._holes.within(*parts) if self._holes else None
        if small is not None:
            heights = interpolated(heights, small)
        if self._ratio == 1:
            own = (slice(n.start - p.start, n.stop - p.start) for n, p in zip((rows, cols), parts, strict=True))
            sampled = heights[tuple(own)]
        else:
            at = [
                np.arange(nodes.start, nodes.stop) * self._ratio - part.start
                for nodes, part in zip((rows, cols), parts, strict=True)
            ]
            sampled = _sampled(heights, at, self._ratio)
        return (sampled - self._offset).astype(np.float32)


def _sigma(ratio: float) -> float:
    """Returns the standard deviation, in cells, of the Gaussian that smooths a finer raster before it is sampled."""
    return max(ratio - 1, 0) / 2


def _sampled(heights: np.ndarray, at: list[np.ndarray], ratio: float) -> np.ndarray:
    """Samples heights bilinearly at rows and columns, and smooths them first where they are finer than the nodes.

    A node is unknown where a value that it is made from is.
    """
    from scipy import ndimage  # takes 0.3 s to import

    unknown = np.isnan(heights)
    if unknown.all():
        return np.full((len(at[0]), len(at[1])), np.nan)
    level = np.nanmedian(heights)
    heights, share = np.where(unknown, 0.0, heights - level), (~unknown).astype(float)
    if ratio > 1:
        sigma = _sigma(ratio)
        heights, share = (ndimage.gaussian_filter(field, sigma, mode="nearest") for field in (heights, share))
        heights = np.divide(heights, share, out=heights, where=share > 0)
    places = np.meshgrid(*at, indexing="ij")
    values = ndimage.map_coordinates(heights, places, order=1, mode="nearest")
    missing = ndimage.map_coordinates(unknown.astype(float), places, order=1, mode="nearest") > 1e-6
    return np.where(missing, np.nan, values + level)
