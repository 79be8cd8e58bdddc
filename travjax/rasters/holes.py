"""Small holes in rasters: which are filled, and with what (SPEC section 11)."""

import numpy as np

from travjax.rasters.raster import HeightSource, parts

FILL_DISTANCE = 0.125
"""Metres: a hole is filled when each of its cells is this near to known ground, or one cell where that is more."""

REACH = 2.0
"""Metres around a piece of ground in which holes are known when its own are filled: what lies beyond has no effect.

Holes that are filled are at most two FILL_DISTANCE and a cell wide, and in a channel of that width a difference at its
end falls by a factor of e on a third of the width.
"""


class SmallHoles:
    """Which cells of a raster lie in small holes.

    count: of these cells
    """

    def __init__(self, heights: HeightSource, cell_size: float):
        """Reads the heights through, twice if any is unknown."""
        self._cols, self._distance = heights.shape[1], max(FILL_DISTANCE, cell_size) + 1e-9
        self._packed: dict[int, np.ndarray] = {}  # of the rows that have any, a bit a cell
        holes = _Holes(heights, cell_size, self._distance)
        self.count = 0
        for rows, small in holes.small():
            for row in np.flatnonzero(small.any(axis=1)):
                self._packed[rows.start + int(row)] = np.packbits(small[row])
                self.count += int(np.count_nonzero(small[row]))

    def within(self, rows: slice, cols: slice) -> np.ndarray | None:
        """Returns which cells of a part lie in small holes, [rows, cols] bool, or None where none does."""
        there = [row for row in range(rows.start, rows.stop) if row in self._packed] if self._packed else []
        if not there:
            return None
        small = np.zeros((rows.stop - rows.start, cols.stop - cols.start), bool)
        for row in there:
            small[row - rows.start] = np.unpackbits(self._packed[row], count=self._cols)[cols].view(bool)
        return small if small.any() else None


class _Holes:
    """Groups of unknown cells that touch, be it at a corner, over all parts in which a raster is read."""

    def __init__(self, heights: HeightSource, cell_size: float, distance: float):
        self.heights, self.cell_size, self.distance = heights, cell_size, distance

    def small(self):
        """Yields the rows and the cells in small holes [rows, cols] bool of each part that has unknown ones."""
        deep = self._deep()
        if deep.all():
            return
        number = 0
        for rows, _, part in parts(self.heights):
            unknown = np.isnan(part)
            if unknown.any():
                hole, count = _numbered(unknown)
                small = np.concatenate([[False], ~deep[number : number + count]])[hole]
                number += count
                if small.any():
                    yield rows, small

    def _deep(self) -> np.ndarray:
        """Tells whether the hole that each group of a part belongs to reaches too far from known ground: [groups]
        bool.
        """
        from scipy import ndimage  # takes 0.3 s to import
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        deep, links, above, total = [np.zeros(0, bool)], [np.zeros((2, 0), int)], None, 0
        reach = int(self.distance / self.cell_size)
        along = self.cell_size * np.arange(-reach, reach + 1)
        near = np.hypot(along[:, None], along) <= self.distance
        for _, own, part in parts(self.heights, reach):
            missing = np.isnan(part)
            unknown = missing[own]
            if not unknown.any():
                above = None
                continue
            far = ndimage.binary_erosion(missing, near, border_value=1)[own]  # nothing known within reach
            hole, count = _numbered(unknown)
            part_deep = np.zeros(count + 1, bool)
            part_deep[hole[far]] = True
            deep.append(part_deep[1:])
            hole = np.where(unknown, hole + total, 0)  # groups count from 1
            if above is not None:
                links.append(_touching(above, hole[0]))
            above, total = hole[-1], total + count
        every, pairs = np.concatenate(deep), np.concatenate(links, axis=1) - 1
        joined = coo_matrix((np.ones(pairs.shape[1], bool), tuple(pairs)), shape=(total, total))
        _, whole = connected_components(joined, directed=False) if total else (0, np.zeros(0, int))
        reaches = np.zeros(whole.max(initial=-1) + 1, bool)
        reaches[whole[every]] = True
        return reaches[whole]


def _numbered(unknown: np.ndarray) -> tuple[np.ndarray, int]:
    from scipy import ndimage

    return ndimage.label(unknown, np.ones((3, 3)))


def _touching(south: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Pairs of groups in two rows, one above the other, that touch: [2, n]."""
    width = len(south)
    pairs = []
    for shift in (-1, 0, 1):
        below = south[max(-shift, 0) : width - max(shift, 0)]
        over = north[max(shift, 0) : width - max(-shift, 0)]
        both = (below > 0) & (over > 0)
        pairs.append(np.stack([below[both], over[both]]))
    return np.concatenate(pairs, axis=1)


def interpolated(heights: np.ndarray, holes: np.ndarray) -> np.ndarray:
    """Fills each cell of a hole with the mean of its four neighbours: a plane stays a plane, and no new extremes arise.

    What lies outside the part does not count. Cells beside a hole are known or of the same hole.
    """
    from scipy.sparse import csc_matrix, diags
    from scipy.sparse.linalg import spsolve

    row, col = np.nonzero(holes)
    number = np.full(holes.shape, -1)
    number[holes] = np.arange(len(row))
    level = heights[~np.isnan(heights)].mean()
    neighbours, known = np.zeros(len(row)), np.zeros(len(row))
    links = []
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        r, c = row + down, col + right
        inside = (r >= 0) & (r < holes.shape[0]) & (c >= 0) & (c < holes.shape[1])
        beside = np.flatnonzero(inside)
        neighbours += inside
        other = number[r[beside], c[beside]]
        ground = other < 0
        known[beside[ground]] += heights[r[beside[ground]], c[beside[ground]]] - level
        links.append(np.stack([beside[~ground], other[~ground]]))
    here, there = np.concatenate(links, axis=1)
    coupling = csc_matrix((np.ones(len(here)), (here, there)), (len(row), len(row)))
    filled = heights.copy()
    filled[holes] = spsolve(diags(neighbours, format="csc") - coupling, known) + level
    return filled
