"""Figures of a whole site: where it is passable, in which directions, and what blocks elsewhere."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LightSource, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from travjax.evaluation.map_figures import DOUBTFUL, FAILED, SAFE, UNKNOWN_COLOUR
from travjax.site.costs import IMPASSABLE, KINDS, UNKNOWN_COST, kinds_of
from travjax.site.geotiff import Frame

MOST = 1200
"""Pixels along an edge of a figure's map, at most; of larger sites every second, third ... place is drawn."""

EVENT_COLOURS = ("#cfe8f7", "#e69f00", "#0072b2", "#5b1a3d", "#117733")
"""Colours of no event and of each event; they differ in lightness."""


def passable_figure(
    heights: np.ndarray, bands: Mapping[str, np.ndarray], costs: np.ndarray, frame: Frame, what: Sequence[str]
) -> Figure:
    """Draws in how many directions places are passable, and the costs of one place by heading.

    heights, bands, costs: of a site, row 0 in the north; what: lines for the title
    """
    every = shown_every(heights.shape)
    ways, known = (np.asarray(bands[f"{name}_headings"][::every, ::every]) for name in ("passable", "known"))
    colours = SAFE, DOUBTFUL, FAILED, UNKNOWN_COLOUR
    figure, ax, side = map_figure(heights, frame, what)
    draw_kinds(ax, heights, kinds_of(ways, known), colours, frame, every)
    draw_legend(side, dict(zip(KINDS, colours, strict=True)), "passable in")
    place = _telling_place(bands, every)
    if place is not None:
        x = frame.origin[0] + place[1] * frame.cell_size
        y = frame.origin[1] + (len(heights) - 1 - place[0]) * frame.cell_size
        ax.plot(x, y, "o", markerfacecolor="none", markeredgecolor="black", markersize=9, markeredgewidth=1.5)
        _rose(figure, np.asarray(costs[:, place[0], place[1]]))
    return figure


def blocking_figure(
    heights: np.ndarray, bands: Mapping[str, np.ndarray], frame: Frame, events: Sequence[str], what: Sequence[str]
) -> Figure:
    """Draws which event exceeds its limit most, over the known headings of each place."""
    every = shown_every(heights.shape)
    code = np.asarray(bands["blocking_event"][::every, ::every])
    colours = (*EVENT_COLOURS[: len(events) + 1], UNKNOWN_COLOUR)
    figure, ax, side = map_figure(heights, frame, what)
    draw_kinds(ax, heights, np.where(np.isnan(code), len(events) + 1, code), colours, frame, every)
    draw_legend(side, dict(zip(("none", *events, "unknown"), colours, strict=True)), "blocked by, in some direction")
    return figure


def shown_every(shape: tuple[int, ...]) -> int:
    """Returns how many places along an edge share a pixel."""
    return -(-max(shape) // MOST)


def map_figure(heights: np.ndarray, frame: Frame, what: Sequence[str]):
    """Returns a figure with axes for the map, and beside it axes for what explains it."""
    rows, cols = heights.shape
    tall = float(np.clip(6.4 * rows / cols, 3.2, 9.0))
    figure = Figure(figsize=(9.2, tall + 1.3))
    ax, side = figure.subplots(1, 2, width_ratios=(3.2, 1))
    figure.subplots_adjust(left=0.1, right=0.98, bottom=0.65 / (tall + 1.3), top=1 - 0.65 / (tall + 1.3), wspace=0.05)
    side.set_axis_off()
    figure.suptitle("\n".join(what), fontsize=10)
    return figure, ax, side


def draw_kinds(ax, heights: np.ndarray, kind: np.ndarray, colours: Sequence[str], frame: Frame, every: int) -> None:
    """Draws kinds in their colours over a hillshade, with a scale bar and north."""
    extent = draw_hillshade(ax, heights, frame, every)
    kinds: Any = dict(cmap=ListedColormap(colours), vmin=-0.5, vmax=len(colours) - 0.5, interpolation="nearest")
    ax.imshow(kind, extent=extent, alpha=0.62, **kinds)


def draw_hillshade(ax, heights: np.ndarray, frame: Frame, every: int) -> tuple[float, float, float, float]:
    """Draws the ground [rows, cols], row 0 in the north, with a scale bar and north; returns the image's extent."""
    rows, cols = heights.shape
    half, (x, y) = frame.cell_size / 2, frame.origin
    east, north = x + (cols - 1) * frame.cell_size, y + (rows - 1) * frame.cell_size
    extent = (x - half, east + half, y - half, north + half)
    shown = np.asarray(heights[::every, ::every], float)
    level = np.nanmean(shown) if np.isfinite(shown).any() else 0.0
    cell = frame.cell_size * every
    shade = np.ones_like(shown)
    if min(shown.shape) > 1:
        shade = LightSource(315, 45).hillshade(np.nan_to_num(shown, nan=level), dx=cell, dy=cell)
    ax.imshow(shade, extent=extent, cmap="gray", vmin=0, vmax=1)
    ax.set(xlabel="x, east [m]", ylabel="y, north [m]", aspect="equal")
    ax.ticklabel_format(useOffset=False, style="plain")
    ax.tick_params(labelsize=8)
    _scale_bar(ax, extent)
    return extent


def _scale_bar(ax, extent: tuple[float, float, float, float]) -> None:
    west, east, south, north = extent
    wide = east - west
    sizes = (k * 10.0**power for power in range(-2, 6) for k in (1, 2, 5))
    length = max((size for size in sizes if size <= wide / 4), default=wide / 4)
    left, low = west + 0.04 * wide, south + 0.05 * (north - south)
    ax.plot([left, left + length], [low, low], color="white", linewidth=5, solid_capstyle="butt")
    ax.plot([left, left + length], [low, low], color="black", linewidth=2.5, solid_capstyle="butt")
    text: Any = dict(ha="center", va="bottom", fontsize=8, bbox=dict(facecolor="white", alpha=0.7, edgecolor="none"))
    ax.text(left + length / 2, low + 0.015 * (north - south), f"{length:g} m", **text)
    ax.text(0.95, 0.955, "N", transform=ax.transAxes, **text)
    arrow = dict(arrowstyle="->", linewidth=1.5)
    ax.annotate("", (0.95, 0.95), (0.95, 0.88), xycoords="axes fraction", arrowprops=arrow)


def draw_legend(side, entries: Mapping[str, str], title: str) -> None:
    """Draws names and colours of kinds."""
    edge: Any = dict(edgecolor="black", linewidth=0.5)
    patches = [Patch(facecolor=colour, label=name, **edge) for name, colour in entries.items()]
    side.legend(handles=patches, title=title, loc="upper left", fontsize=8, title_fontsize=8, frameon=False)


def _telling_place(bands: Mapping[str, np.ndarray], every: int) -> tuple[int, int] | None:
    """Returns a place that is passable in about half of its directions, all of them known, or None."""
    ways, known = (np.asarray(bands[f"{name}_headings"][::every, ::every]) for name in ("passable", "known"))
    among = known == known.max(initial=0)
    mixed = np.where(among & (ways > 0) & (ways < known), np.abs(ways / np.maximum(known, 1) - 0.5), np.inf)
    if not np.isfinite(mixed).any():
        return None
    row, col = np.unravel_index(int(mixed.argmin()), mixed.shape)
    return int(row) * every, int(col) * every


def _rose(figure: Figure, costs: np.ndarray) -> None:
    """Draws the costs of one place by heading, north up."""
    ax: Any = figure.add_axes((0.775, 0.12, 0.19, 0.34), projection="polar")
    angles = 2 * np.pi * np.arange(len(costs)) / len(costs)
    colours = [UNKNOWN_COLOUR if c == UNKNOWN_COST else FAILED if c == IMPASSABLE else SAFE for c in costs]
    lengths = np.where(costs == UNKNOWN_COST, IMPASSABLE, np.maximum(costs, 2))
    ax.bar(angles, lengths, width=2 * np.pi / len(costs), color=colours, edgecolor="white", linewidth=0.5)
    ax.set_theta_zero_location("N")  # headings run anticlockwise, as matplotlib's angles do
    ax.set(ylim=(0, 100), yticks=[50, 100], xticks=np.pi / 2 * np.arange(4), xticklabels=["N", "W", "S", "E"])
    ax.tick_params(labelsize=7)
    ax.set_title("cost by heading\nat the circle", fontsize=8)
