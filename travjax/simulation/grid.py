"""The node grid of an elevation map (SPEC section 1).

`heights[row, col]` lies at y = -size/2 + spacing * row (forward, north), x = -size/2 + spacing * col (right, east).
The robot starts at (0, 0) and faces +y.
"""

import math
from dataclasses import dataclass

import numpy as np

from travjax.config import require, require_length, require_number

HIGHEST = 30_000.0
"""Metres: values above this, or below its negative, are not heights."""

MARKERS = (-9999, -99999, -32768, 9999)
"""Common markers of unknown ground, which some files and arrays use without declaring them."""


@dataclass(frozen=True)
class Grid:
    """A square, node-registered grid.

    size:    metres, edge of the map; 8 m in the paper
    spacing: metres between neighbouring nodes
    """

    size: float = 8.0
    spacing: float = 0.0625

    def __post_init__(self):
        require_length("size", self.size, 0.001, 1000)
        allowed = "a distance in metres, from 0.001 and at most the map's size"
        require_number("spacing", self.spacing, math.nextafter(0.001, 0), self.size, allowed)
        cells = self.size / self.spacing
        require(
            abs(cells - round(cells)) < 1e-6, "spacing", self.spacing, f"a whole fraction of the size {self.size:g} m"
        )
        require(round(cells) <= 4096, "spacing", self.spacing, "such that an edge has at most 4096 cells")

    @property
    def cells(self) -> int:
        """Cells along one edge."""
        return round(self.size / self.spacing)

    @property
    def nodes(self) -> int:
        """Nodes along one edge, one more than cells: 129."""
        return self.cells + 1

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of a map."""
        return self.nodes, self.nodes

    def axis(self) -> np.ndarray:
        """Coordinates of the rows (y) or columns (x): [nodes] float64 metres."""
        return (np.arange(self.nodes) - 0.5 * self.cells) * self.spacing


def require_grid(grid: object) -> None:
    """Raises InputError unless it is a Grid."""
    require(isinstance(grid, Grid), "grid", grid, "a travjax.Grid, such as Grid(size=8, spacing=0.0625)")
