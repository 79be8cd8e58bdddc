"""Points as a raster: the lattice that they stand on, or averages in square cells (SPEC section 11).

Points that stand on a lattice (a raster that was written as points) are that raster, decided by the bulk of them.
Others are averaged in square cells around multiples of the cell size, which keeps detail that is finer than a cell from
showing as steps; a cell without points is unknown. What is left out or averaged is said in the raster's notes.
"""

import numpy as np

from travjax.config import InputError
from travjax.point_clouds.points import COARSEST_STEP, without_repeats
from travjax.rasters.raster import COARSEST, Raster, agreed_cell_size, require_size
from travjax.simulation.grid import Grid

POINTS_A_CELL = 2
"""On average; at this density an eighth of the cells has none, and those are small holes."""

MOST_CELLS = 2**27
"""Cells of a raster of points: a gibibyte of heights."""

MOST_NODES = 2**28
"""Nodes at the grid's spacing: a square kilometre at 0.0625 m."""

ON_NODES = 0.75
"""Share of the points that stand on a lattice's nodes, at least."""

OFF_NODE = 0.3
"""Share of a lattice's step that rounding may move a column or row by."""

SAME_LEVEL = 1.5e-4
"""Metres: coordinates that are nearer than that are the same with another rounding; text often has four decimals."""

LEAST_KNOWN = 1e-3
"""Share of the cells that there must be points for."""

WIDEST_LINES = 1.0
"""Metres between lines of points, of which one coordinate is regular and the other is not."""

LEAST_BESIDE = 0.25
"""Share of a lattice's nodes with a point that have one a step east, at least: half of the nodes may lack one."""

Scale = tuple[float, float, float]
"""A level that coordinates stand on, the step between levels, 0 where there is none, and how far off they are."""

FEW = 0.05
"""Share of the points that may lie apart from the others and be left out; where there are more, they are the site."""


def gridded(x: np.ndarray, y: np.ndarray, z: np.ndarray, cell_size: float | None, grid: Grid) -> Raster:
    """Returns points, [n] float64 metres each, as a raster: their lattice, else their averages.

    cell_size: of averages in metres; where it is None, the grid's spacing or what holds POINTS_A_CELL if that is more
    Raises InputError when they are too few or too far apart for a raster, or a lattice has another cell size.
    """
    notes: list[str] = []
    for chosen in (_repeated, _at_the_origin, _apart):
        x, y, z = chosen(x, y, z, grid, notes)
    require_size(float(np.ptp(x)), float(np.ptp(y)), grid)
    axes = [_regular(values) for values in (x, y)]
    raster = _lattice(x, y, z, axes, notes)
    if raster is None:
        cell_size = cell_size or _cell_size(x, y, grid.spacing)
        _require_own_places(x, y, axes, cell_size)
        east, north = float(np.ptp(x)), float(np.ptp(y))
        require_fits(east, north, cell_size, grid.spacing)
        _require_dense(len(z), (east / cell_size + 1) * (north / cell_size + 1), cell_size)
        raster = _averaged(x, y, z, cell_size)
    else:
        agreed_cell_size(raster.cell_size, cell_size)
        north, east = ((edge - 1) * raster.cell_size for edge in raster.heights.shape)
        require_fits(east, north, raster.cell_size, grid.spacing)
    fewest = _fewest(raster.cell_size, grid)
    if len(z) < fewest:
        raise InputError(f"points = {len(z)}: must be at least {fewest}, as many as a window has cells")
    return Raster(raster.heights, raster.cell_size, raster.origin, notes=tuple(notes))


def require_fits(east: float, north: float, cell_size: float, spacing: float) -> None:
    """Raises InputError when a site of these metres has more than MOST_CELLS, or MOST_NODES at the spacing."""
    for edge, most, name in ((cell_size, MOST_CELLS, "cells"), (spacing, MOST_NODES, "nodes")):
        if (east / edge + 2) * (north / edge + 2) > most:
            raise InputError(
                f"size = {east:g} x {north:g} m: must be at most {most} {name} of {edge:g} m; is a point astray? "
                "cut the site out"
            )


def _require_dense(points: int, cells: float, cell_size: float) -> None:
    """Refuses so few points that hardly any cell has one."""
    if points < LEAST_KNOWN * cells:
        raise InputError(
            f"points = {points}: must be at least {LEAST_KNOWN:.1%} of the {cells:.0f} cells of {cell_size:g} m; are "
            "points astray?"
        )


def _fewest(cell_size: float, grid: Grid) -> int:
    """Returns how many points a window needs."""
    return int(grid.size / max(cell_size, COARSEST)) ** 2


# ---- What is left out


def _repeated(x, y, z, grid: Grid, notes: list[str]):
    kept = without_repeats(x, y, z)
    if kept.all():
        return x, y, z
    notes.append(f"{_points(~kept)} repeated exactly: taken once")
    return x[kept], y[kept], z[kept]


def _at_the_origin(x, y, z, grid: Grid, notes: list[str]):
    """Drops points at exactly (0, 0, 0), the mark of an invalid return, unless ground nearby is as high."""
    zero = (x == 0) & (y == 0) & (z == 0)
    if not zero.any():
        return x, y, z
    beside = (np.hypot(x, y) < 4 * max(_point_spacing(x, y), grid.spacing)) & ~zero
    if (np.abs(z[beside]) < 0.1).any():
        return x, y, z
    notes.append("points at exactly (0, 0, 0) are invalid returns: left out")
    return x[~zero], y[~zero], z[~zero]


def _apart(x, y, z, grid: Grid, notes: list[str]):
    """Drops the few points that an empty strip wider than a window separates from all others.

    They are too few for a window of their own, and would stretch the site over what nobody has measured.
    """
    width = max(grid.size, 10 * _point_spacing(x, y))
    few = min(_fewest(0, grid), FEW * len(x))
    kept = np.ones(len(x), bool)
    while True:
        before = np.count_nonzero(kept)
        for values in (x, y):
            if _is_filled(values[kept], width):
                continue
            ordered = np.sort(values[kept])
            wide = np.flatnonzero(np.diff(ordered) > width)
            group = np.searchsorted((ordered[wide] + ordered[wide + 1]) / 2, values)
            held = np.bincount(group, kept)
            apart = (held < min(few, held.max()))[group] & kept
            if np.count_nonzero(~kept | apart) <= FEW * len(x):
                kept &= ~apart
        if np.count_nonzero(kept) == before:
            break
    if kept.all():
        return x, y, z
    beside = [np.maximum(np.maximum(v[kept].min() - v[~kept], v[~kept] - v[kept].max()), 0) for v in (x, y)]
    away = np.hypot(*beside)
    farthest = int(np.argmax(away))
    notes.append(
        f"{_points(~kept)} apart from all others left out, as at x, y = {x[~kept][farthest]:.10g}, "
        f"{y[~kept][farthest]:.10g}, {away[farthest]:.4g} m beside the site"
    )
    return x[kept], y[kept], z[kept]


def _is_filled(values: np.ndarray, width: float) -> bool:
    """Tells whether each half of a width holds a value, so that no gap is as wide: faster than sorting."""
    first, extent = values.min(), np.ptp(values)
    return extent < 1e5 * width and bool(np.bincount(((values - first) / (width / 2)).astype(np.int64)).all())


def _points(chosen: np.ndarray) -> str:
    number = np.count_nonzero(chosen)
    return f"{number} point{'' if number == 1 else 's'}"


def _point_spacing(x: np.ndarray, y: np.ndarray) -> float:
    """Returns the metres between points if they were spread evenly over the middle nine tenths of the site on each
    axis.
    """
    across, along = (np.subtract(*np.quantile(values, (0.95, 0.05))) for values in (x, y))
    return float(np.sqrt(across * along / len(x)))


# ---- Lattices


def _lattice(x: np.ndarray, y: np.ndarray, z: np.ndarray, axes: list[Scale], notes: list[str]) -> Raster | None:
    """Returns the raster that the bulk of the points forms if enough nodes have a neighbour one step east, else None.

    Points off the nodes are left out, several heights of a node averaged.
    """
    (west, across, _), (south, along, _) = axes
    if not across * along or abs(across - along) > 1e-3 * across:
        return None
    nodes = (np.ptp(x) / across + 1) * (np.ptp(y) / along + 1)
    if nodes > MOST_CELLS or len(z) < LEAST_KNOWN * nodes:
        return None
    col, row = ((values - first) / step for values, (first, step, _) in zip((x, y), axes, strict=True))
    on = np.abs(col - np.rint(col)) * across <= axes[0][2]
    on &= np.abs(row - np.rint(row)) * along <= axes[1][2]
    if np.count_nonzero(on) < ON_NODES * len(z):
        return None
    number = [np.rint(values[on]).astype(np.int64) for values in (col, row)]
    first_col, first_row = (int(values.min()) for values in number)
    cols, rows = (int(np.ptp(values)) + 1 for values in number)
    heights, several = _at_nodes((number[1] - first_row) * cols + number[0] - first_col, z[on], rows * cols)
    known = ~np.isnan(heights).reshape(rows, cols)
    nodes, beside = np.count_nonzero(known), np.count_nonzero(known[:, 1:] & known[:, :-1])
    if beside < LEAST_BESIDE * nodes or several / nodes > _several_by_chance(beside / nodes) / 2:
        return None
    if not on.all():
        notes.append(f"{_points(~on)} off the lattice of {across:g} m left out")
    if several:
        notes.append(f"{several} of {nodes} nodes of the lattice hold several heights: their mean is taken")
    origin = (float(west + across * first_col), float(south + along * first_row))
    return Raster(heights.reshape(rows, cols), float(across), origin)


def _at_nodes(place: np.ndarray, z: np.ndarray, nodes: int) -> tuple[np.ndarray, int]:
    """Returns (mean height at each node, NaN where there is none [nodes]; number of nodes with several heights)."""
    heights = np.full(nodes, np.nan)
    heights[place] = z
    several = np.unique(place[heights[place] != z])
    if several.size:
        shared = np.flatnonzero(np.isin(place, several))
        where = np.searchsorted(several, place[shared])
        heights[several] = np.bincount(where, z[shared]) / np.bincount(where)
    return heights, len(several)


def _several_by_chance(filled: float) -> float:
    """Returns the share of occupied cells with several points if points fell at random until so many cells had some."""
    filled = min(filled, 0.999)
    a_cell = -np.log1p(-filled)
    return float(1 - a_cell * (1 - filled) / filled)


def _regular(values: np.ndarray) -> Scale:
    """Finds the regular scale that all but a few values stand on, apart from rounding; the step is 0 if there is none.

    Of the steps that the rounding leaves room for, the one with the fewest digits.
    """
    levels, held = _levels(values)
    if len(levels) < 2:
        return float(values[0]), 0.0, 0.0
    usual = np.median(np.diff(levels))
    gaps = np.diff(levels)
    beside = np.zeros(len(levels), bool)  # heavy as it may be, such a level is no column
    beside[1:] |= (gaps < 0.8 * usual) & (held[1:] < held[:-1])
    beside[:-1] |= (gaps < 0.8 * usual) & (held[:-1] < held[1:])
    levels = levels[~beside]
    number = np.concatenate([[0], np.cumsum(np.rint(np.diff(levels) / usual))])
    while True:
        if not number[-1] > number[0]:
            return float(values[0]), 0.0, 0.0
        step = (levels[-1] - levels[0]) / (number[-1] - number[0])
        away = levels - levels[0] - step * (number - number[0])
        off = np.abs(away - np.median(away))
        regular = off < OFF_NODE * step
        if regular.all():
            break
        levels, number = levels[regular], number[regular]
        if len(levels) < 2:
            return float(values[0]), 0.0, 0.0
    doubt = 2 * np.abs(away).max() / (number[-1] - number[0]) + 1e-12
    step = next(shorter for digits in range(16) if abs((shorter := round(float(step), digits)) - step) <= doubt)
    away = levels - levels[0] - step * (number - number[0])
    middle = (away.max() + away.min()) / 2
    return float(levels[0] + middle), step, float(np.ptp(away) / 2 + 0.02 * step)


def _levels(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns (distinct values, number of points at each), without values that far fewer points share than is usual.

    Of values that are nearer than SAME_LEVEL, the most frequent.
    """
    found, counts = np.unique(values, return_counts=True)
    level = np.concatenate([[0], np.cumsum(np.diff(found) > SAME_LEVEL)])
    by_count = np.lexsort((counts, level))
    ends = np.flatnonzero(np.diff(level, append=level[-1] + 1))
    levels, held = found[by_count[ends]], np.bincount(level, counts).astype(np.int64)
    ordered = np.sort(held)
    usual = ordered[np.searchsorted(np.cumsum(ordered), len(values) / 2)]
    heavy = held >= 0.2 * usual
    return levels[heavy], held[heavy]


# ---- Averages


def _require_own_places(x: np.ndarray, y: np.ndarray, axes: list[Scale], cell_size: float) -> None:
    """Refuses coordinates rounded so far that many points share a place with others, or are nearer than the steps."""
    steps = [step for _, step, _ in axes]
    coarsest = max(steps)
    if coarsest < COARSEST_STEP + 1e-9 or cell_size > coarsest - 1e-9:
        return
    shared = 1 - np.mean(without_repeats(x, y, np.zeros(len(x))))
    rounded = min(steps) > COARSEST_STEP and (shared > 0.1 or coarsest > 2 * _point_spacing(x, y))
    if rounded or coarsest > WIDEST_LINES:
        name, values = ("x", x) if steps[0] == coarsest else ("y", y)
        raise InputError(
            f"{name} = {values[0]:.10g}: is given in steps of {coarsest:g} m, {shared:.0%} of the points share their "
            f"place: must be given to {COARSEST_STEP:g} m, or put into cells (--cell-size={coarsest:g})"
        )


def _cell_size(x: np.ndarray, y: np.ndarray, finest: float) -> float:
    """Returns the metres, in whole millimetres above `finest`, of cells that hold POINTS_A_CELL at the usual density.

    That is the median of blocks that would hold 16 points each if these were spread evenly. A twentieth of the points
    on each side does not count, so that a few astray have no say.
    """
    ends = [np.quantile(values, (0.05, 0.95)) for values in (x, y)]
    area = np.prod([high - low for low, high in ends])
    if not area:
        return finest
    inner = np.all([(low <= values) & (values <= high) for values, (low, high) in zip((x, y), ends, strict=True)], 0)
    edge = 4 * np.sqrt(area / np.count_nonzero(inner))
    (col, _), (row, _) = (_cells(values[inner], edge) for values in (x, y))
    held = np.bincount(row * (col.max() + 1) + col)
    cell = edge * np.sqrt(POINTS_A_CELL / np.median(held[held > 0]))
    return max(finest, float(np.ceil(1000 * cell) / 1000))


def _cells(values: np.ndarray, edge: float) -> tuple[np.ndarray, int]:
    """Returns (number of the cell that each value lies in [n], number of the first), with cells centred on multiples of
    the edge.
    """
    number = np.floor(values / edge + 0.5).astype(np.int64)
    first = int(number.min())
    return number - first, first


def _averaged(x: np.ndarray, y: np.ndarray, z: np.ndarray, cell_size: float) -> Raster:
    """Averages the heights of the points in each cell; NaN where there are none."""
    (col, first_col), (row, first_row) = (_cells(values, cell_size) for values in (x, y))
    rows, cols = int(row.max()) + 1, int(col.max()) + 1
    place = row * cols + col
    count = np.bincount(place, minlength=rows * cols)
    heights = np.bincount(place, weights=z, minlength=rows * cols)
    heights[count == 0] = np.nan
    np.divide(heights, count, out=heights, where=count > 0)
    origin = (first_col * cell_size, first_row * cell_size)
    return Raster(heights.reshape(rows, cols), float(cell_size), origin)
