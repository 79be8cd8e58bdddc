"""Figures of plans: the path with its profile, how far the search got where there is no path, and the cost to go."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.transforms import Affine2D

from travjax.evaluation.map_figures import UNKNOWN_COLOUR
from travjax.planning.endpoints import Endpoint
from travjax.planning.judges import UNKNOWN, UNKNOWN_NAME
from travjax.planning.no_path import NoPathError
from travjax.planning.path import Path
from travjax.planning.planner import Plan, Planner
from travjax.planning.to_go import CostToGo
from travjax.simulation.robot import Robot
from travjax.site.geotiff import Frame
from travjax.site.site_figures import (
    EVENT_COLOURS,
    draw_hillshade,
    draw_kinds,
    draw_legend,
    map_figure,
    shown_every,
)

PATH, GROUND, REACHED, ELSEWHERE = "#d81b60", "#555555", "#cfe8f7", "#ffffff"
"""Colours of the path, of ground in profiles, of places that can be reached, and of all others."""

FOOTPRINTS = 24
"""Outlines of the robot along a path, about."""

ROUND = 4.0
"""Metres of ground that are shown around a path."""

ARROWS = 28
"""Arrows along an edge of the map of the cost to go."""

STYLES = ("-", "--", ":", "-.")
"""Lines of the events in profiles."""


def plan_figure(plan: Plan, planner: Planner, what: Sequence[str]) -> Figure:
    """Draws a path on the ground around it, with the robot's outline to scale, and its profile; what: title lines."""
    path, robot = plan.path, planner.setup.robot
    figure = Figure(figsize=(12.5, 7.0), layout="constrained")
    figure.suptitle("\n".join(what), fontsize=10)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1))
    ax = figure.add_subplot(grid[:, 0])
    low, high = (edge(path.pose[:, :2], axis=0) for edge in (np.min, np.max))
    spare = np.maximum(ROUND, (np.max(high - low) - (high - low)) / 4)
    heights, frame = _ground(planner, low - spare, high + spare)
    draw_hillshade(ax, heights, frame, shown_every(heights.shape))
    ax.plot(path.pose[:, 0], path.pose[:, 1], color="white", linewidth=4)
    ax.plot(path.pose[:, 0], path.pose[:, 1], color=PATH, linewidth=2, label="path")
    _draw_outlines(ax, path, robot)
    _draw_points(ax, plan.points)
    ax.legend(loc="upper left", fontsize=8)
    _draw_elevation(figure.add_subplot(grid[0, 1]), path)
    _draw_margins(figure.add_subplot(grid[1, 1]), path, robot)
    return figure


def no_path_figure(error: NoPathError, planner: Planner, what: Sequence[str]) -> Figure:
    """Draws the places that the search reached, and what stands in the way around them."""
    reached, events = error.reached, planner.setup.robot.event_names
    heights, frame = _ground(planner)
    every = shown_every(heights.shape)
    figure, ax, side = map_figure(heights, frame, what)
    colours = (ELSEWHERE, REACHED, *EVENT_COLOURS[1 : len(events) + 1], UNKNOWN_COLOUR)
    names = ("", "can be reached", *events, UNKNOWN_NAME.replace(" or ", "\nor "))
    kinds = np.where(reached.frontier > 0, reached.frontier.astype(int) + 1, reached.places)
    kinds[reached.frontier == UNKNOWN] = len(names) - 1
    draw_kinds(ax, heights, _thinned(kinds[::-1], every), colours, frame, every)
    _draw_points(ax, (error.start, error.goal))
    row, col = reached.nearest
    x, y = frame.origin[0] + col * frame.cell_size, frame.origin[1] + row * frame.cell_size
    ax.plot(x, y, "x", color="black", markersize=9, markeredgewidth=2)
    ax.annotate("nearest", (x, y), textcoords="offset points", xytext=(6, 6), fontsize=8)
    draw_legend(side, dict(zip(names[1:], colours[1:], strict=True)), "reached, or in the way")
    return figure


def to_go_figure(to_go: CostToGo, what: Sequence[str]) -> Figure:
    """Draws the cost to reach the goal from every place, and where the cheapest paths lead."""
    best, direction = to_go.best[::-1], to_go.direction[::-1]
    heights, frame = _ground(to_go.planner)
    every = shown_every(heights.shape)
    figure, ax, side = map_figure(heights, frame, what)
    extent = draw_hillshade(ax, heights, frame, every)
    shown = np.where(np.isfinite(best), best, np.nan)[::every, ::every]
    image = ax.imshow(shown, extent=extent, cmap="viridis_r", alpha=0.7, interpolation="nearest")
    apart = max(1, max(best.shape) // ARROWS)
    rows, cols = (np.arange(apart // 2, count, apart) for count in best.shape)
    angle = direction[np.ix_(rows, cols)]
    x, y = frame.origin[0] + cols * frame.cell_size, frame.origin[1] + (len(best) - 1 - rows) * frame.cell_size
    arrows: Any = dict(pivot="mid", scale=ARROWS * 1.25, width=0.003, headwidth=4.5, headlength=5, color="black")
    ax.quiver(x, y, -np.sin(angle), np.cos(angle), **arrows)
    _draw_points(ax, (to_go.goal,))
    bar = figure.colorbar(image, ax=side, fraction=0.5, pad=0.1, location="left")
    bar.set_label("cost to go [m of straight, level, safe driving]", fontsize=8)
    return figure


def _ground(
    planner: Planner, low: np.ndarray | None = None, high: np.ndarray | None = None
) -> tuple[np.ndarray, Frame]:
    """Returns heights of the places, row 0 in the north, or of those between two corners, and their frame."""
    costs, stride = planner.costs, planner.setup.stride
    ground, step, shape = costs.ground, planner.setup.step, np.array(costs.shape)
    origin = np.array(ground.origin)
    first, last = np.zeros(2, int), shape - 1
    if low is not None and high is not None:
        first = np.clip(np.floor((low - origin) / stride).astype(int)[::-1], 0, shape - 1)
        last = np.clip(np.ceil((high - origin) / stride).astype(int)[::-1], first, shape - 1)
    rows = [
        ground.part(slice(row * step, row * step + 1), slice(first[1] * step, last[1] * step + 1))[:, ::step]
        for row in range(first[0], last[0] + 1)
    ]
    x, y = origin + first[::-1] * stride
    return np.concatenate(rows[::-1]).astype(float), Frame((float(x), float(y)), stride, ground.crs)


def _thinned(kinds: np.ndarray, every: int) -> np.ndarray:
    """Returns the largest of the kinds that share a pixel: a frontier is a line of single places."""
    rows, cols = (-(-count // every) * every for count in kinds.shape)
    padded = np.pad(kinds, ((0, rows - kinds.shape[0]), (0, cols - kinds.shape[1])))
    return padded.reshape(rows // every, every, cols // every, every).max(axis=(1, 3))


def _draw_outlines(ax, path: Path, robot: Robot) -> None:
    """Draws the robot's outline to scale, at even distances along the path."""
    wide, long = robot.overall_width / 2, robot.overall_length / 2
    corners = np.array([(-wide, -long), (wide, -long), (wide, long * 0.7), (0, long), (-wide, long * 0.7)])
    count = min(FOOTPRINTS, max(2, int(path.length / robot.overall_length)))
    for distance in np.linspace(0, path.length, count):
        x, y, heading = path.pose[np.searchsorted(path.distance, distance).clip(0, len(path.z) - 1)]
        turned = Affine2D().rotate(heading).translate(x, y).transform(corners)
        ax.add_patch(Polygon(turned, closed=True, fill=False, edgecolor="black", linewidth=0.9, zorder=3))


def _draw_points(ax, points: Sequence[Endpoint]) -> None:
    for number, point in enumerate(points):
        marker = "*" if point.name == "goal" else "o" if point.name == "start" else "D"
        size = 15 if marker == "*" else 9
        ax.plot(point.x, point.y, marker, color="white", markeredgecolor="black", markersize=size, zorder=5)
        below = -14 if number % 2 else 8
        text: Any = dict(fontsize=9, zorder=6, bbox=dict(facecolor="white", alpha=0.7, edgecolor="none", pad=1))
        ax.annotate(point.name, (point.x, point.y), textcoords="offset points", xytext=(8, below), **text)


def _draw_elevation(ax, path: Path) -> None:
    ax.plot(path.distance, path.z, color=GROUND, linewidth=1.5)
    ax.set(xlabel="distance along the path [m]", ylabel="z of the robot [m]", title="elevation")
    ax.ticklabel_format(useOffset=False, axis="y")
    ax.grid(alpha=0.3)


def _draw_margins(ax, path: Path, robot: Robot) -> None:
    """Draws the margins as shares of their limits; the limit is one line for all."""
    shares = [getattr(path, name) / limit for name, limit in zip(robot.event_names, robot.limits, strict=True)]
    for name, share, style, colour in zip(robot.event_names, shares, STYLES, EVENT_COLOURS[1:], strict=False):
        ax.plot(path.distance, share, style, color=colour, linewidth=1.6, label=name)
    ax.axhline(1, color="black", linewidth=1.5)
    ax.text(0.99, 1.01, "limit", transform=ax.get_yaxis_transform(), ha="right", va="bottom", fontsize=8)
    top = max(1.0, *(float(np.nanmax(share, initial=0)) for share in shares))
    ax.set(xlabel="distance along the path [m]", ylabel="margin / limit", ylim=(-0.02, top * 1.12))
    ax.set_title("margins, by the sequential simulator")
    ax.legend(fontsize=8, ncols=len(shares), loc="upper left")
    ax.grid(alpha=0.3)
