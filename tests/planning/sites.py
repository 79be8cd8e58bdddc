"""Small sites that planners are tested on: 8 x 8 m, a node every 0.125 m, row 0 in the south."""

import numpy as np

SPACING, NODES = 0.125, 65
"""Metres between nodes; nodes along an edge."""

SETTINGS = dict(headings=8, spacing=SPACING, contact="nearest")
"""Arguments of `travjax.plan` that make the tests quick."""


def plane() -> np.ndarray:
    """Level ground."""
    return np.zeros((NODES, NODES))


def walled(gap: float = 1.75, height: float = 1.0) -> np.ndarray:
    """Ground with a wall from west to east in the middle, open for `gap` metres beside the eastern edge."""
    ground = plane()
    ground[31:34, : NODES - round(gap / SPACING)] = height
    return ground


def parted() -> np.ndarray:
    """Ground with a strip that is not known, from west to east."""
    ground = plane()
    ground[31:34] = np.nan
    return ground
