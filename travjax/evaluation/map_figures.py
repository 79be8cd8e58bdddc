"""Figures of maps, labelled action spaces, the robot and its action space, and speed.

Functions return a matplotlib Figure; `save` writes it. No display is needed.
"""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.collections import LineCollection
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.text import Text

from travjax.config import one_line
from travjax.files import atomic_write
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup

SAFE, DOUBTFUL, FAILED, UNKNOWN_COLOUR = "#9fd8fb", "#e08a00", "#7a1200", "#8a8a8a"
DOUBT, FAILURE = 0.25, 0.5
"""Probabilities from which a trajectory is drawn as doubtful and as failing, as in the paper."""
TERRAIN = "gist_earth"


def save(figure: Figure, path: Path) -> Path:
    """Writes a figure as PNG, completely or not at all; names in it are drawn literally."""
    _draw_texts_as_they_are(figure)
    with atomic_write(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from")  # the font draws a box instead
        figure.savefig(temporary, format="png", dpi=150)
    return path


def _draw_texts_as_they_are(figure: Figure) -> None:
    """Turns mathematics off in texts, such as a name with two $, except in the numbers of axes, which need it."""
    axes = [axis for ax in figure.axes for axis in (ax.xaxis, ax.yaxis)]
    numbers = {label for axis in axes for label in (*axis.get_ticklabels(which="both"), axis.get_offset_text())}
    for text in figure.findobj(Text):
        if text not in numbers:
            text.set_parse_math(False)
            text.set_text("\n".join(one_line(line) for line in text.get_text().split("\n")))


def contact_sheet(heights: np.ndarray, titles: Sequence[str], heading: str, grid: Grid) -> Figure:
    """Draws maps [n, rows, cols] side by side in one colour scale, shaded from the north-west."""
    columns = min(6, len(heights))
    rows = -(-len(heights) // columns)
    figure = Figure(figsize=(2.1 * columns + 1.2, 2.25 * rows + 0.6), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, columns, sharex=True, sharey=True)).reshape(-1)
    low, high = _colour_range(heights)
    for ax in axes[len(heights) :]:
        ax.set_visible(False)
    images = []
    for ax, one, title in zip(axes, heights, titles, strict=False):
        images.append(_draw_elevation(ax, one, grid, low, high))
        ax.set_title(title, fontsize=8)
        ax.tick_params(labelsize=7)
    figure.colorbar(images[0], ax=axes.tolist(), label="elevation [m]", shrink=0.8)
    figure.suptitle(heading)
    return figure


def labelled_maps(
    heights: np.ndarray,
    failed: np.ndarray,
    known: np.ndarray,
    titles: Sequence[str],
    setup: Setup,
    poses: np.ndarray | None = None,
) -> Figure:
    """Draws each map's elevation and, for each event, the action space coloured as safe, failed or unknown.

    heights: [n, rows, cols]; failed: [n, t, k] for the robot's k events; known: [n, t]; poses: [n, t, k] where each
    margin is reached (events.Where), from where on failing trajectories are coloured; all of them unless given
    Source: the paper's qualitative figure.
    """
    robot, actions, grid = setup.robot, setup.actions, setup.grid
    paths = actions.poses(np.arange(len(actions)))[..., :2]
    columns = 1 + len(robot.events)
    figure = Figure(figsize=(3.25 * columns, 3.2 * len(heights) + 0.7), layout="constrained")
    axes = figure.subplots(len(heights), columns, sharex=True, sharey=True, squeeze=False)
    for row, one in enumerate(heights):
        low, high = _colour_range(one)
        image = _draw_elevation(axes[row, 0], one, grid, low, high)
        _draw_robot(axes[row, 0], robot)
        figure.colorbar(image, ax=axes[row, 0], shrink=0.85, label="elevation [m]")
        axes[row, 0].set_title(titles[row], fontsize=9)
        for event, name in enumerate(robot.event_names):
            ax = axes[row, 1 + event]
            _draw_elevation(ax, one, grid, low, high, colour="gray", alpha=0.35)
            if poses is None:
                _draw_paths(ax, paths, _by_label(failed[row, :, event], known[row]))
            else:
                _draw_paths_from(ax, paths, failed[row, :, event], known[row], poses[row, :, event])
            ax.set_title(_share_title(name, failed[row, :, event], known[row]), fontsize=9)
        axes[row, 0].set_ylabel("y, forward [m]")
    for ax in axes[-1]:
        ax.set_xlabel("x, right [m]")
    kinds = _KINDS if poses is None else (_KINDS[0], (FAILED, "failed, from its largest margin on"), _KINDS[2])
    legend = [Line2D([], [], color=colour, label=text) for colour, text in kinds]
    figure.legend(handles=legend, loc="outside upper right", ncols=3, frameon=False)
    contact = f", contact model {setup.contact.model}"
    figure.suptitle(f"{len(actions)} trajectories of {robot.name}{contact}", x=0.02, ha="left")
    return figure


def predicted_maps(
    heights: np.ndarray,
    predictions: Mapping[str, np.ndarray],
    failed: np.ndarray | None,
    known: np.ndarray,
    titles: Sequence[str],
    setup: Setup,
    labelled: str = "true",
    every: int = 1,
) -> Figure:
    """Draws each map's elevation and, for each event, the action space as predicted and, in the last row, as labelled.

    heights: [n, rows, cols]; predictions: named probabilities [n, t, k] of the robot's k events, one row each; failed:
    [n, t, k], or None to leave out the last row; known: [n, t]; labelled: name of the last row; every: step
    of the trajectories in the action space that predictions are for. Source: the paper's qualitative figure.
    """
    robot, actions, grid = setup.robot, setup.actions, setup.grid
    paths = actions.poses(np.arange(0, len(actions), every))[..., :2]
    rows, columns = len(predictions) + (failed is not None), 1 + len(robot.events)
    figure = Figure(figsize=(3.25 * columns, 3.15 * rows * len(heights) + 0.5), layout="constrained")
    axes = figure.subplots(rows * len(heights), columns, sharex=True, sharey=True, squeeze=False)
    for one in range(len(heights)):
        of_map = axes[rows * one : rows * (one + 1)]
        left = of_map[0, 0]
        image = _draw_elevation(left, heights[one], grid, *_colour_range(heights[one]))
        _draw_robot(left, robot)
        figure.colorbar(image, ax=left, shrink=0.85, label="elevation [m]")
        left.set_title(titles[one], fontsize=9)
        left.set_ylabel("y, forward [m]")
        left.tick_params(labelbottom=True)
        for ax in of_map[1:, 0]:
            ax.axis("off")
        for event, name in enumerate(robot.event_names):
            predicted = [(what, values[one, :, event]) for what, values in predictions.items()]
            drawn = [(what, p >= FAILURE, _by_probability(p, known[one])) for what, p in predicted]
            if failed is not None:
                fails = failed[one, :, event]
                drawn.append((labelled, fails, _by_label(fails, known[one])))
            for ax, (what, mask, by_colour) in zip(of_map[:, 1 + event], drawn, strict=True):
                _draw_elevation(ax, heights[one], grid, *_colour_range(heights[one]), colour="gray", alpha=0.35)
                _draw_paths(ax, paths, by_colour)
                ax.set_title(_share_title(f"{name}, {what}", mask, known[one]), fontsize=9)
    for ax in axes[-1, 1:]:
        ax.set_xlabel("x, right [m]")
    bands = [Line2D([], [], color=colour, label=text) for colour, text in _BANDS]
    if rows > 1:
        axes[1, 0].legend(handles=bands, loc="center")
    else:
        figure.legend(handles=bands, loc="outside lower center", ncols=len(bands))
    shown = f"{len(paths)} of the {len(actions)}" if every > 1 else f"{len(actions)}"
    figure.suptitle(f"{shown} trajectories of {robot.name}", x=0.02, ha="left")
    return figure


_BANDS = (
    (SAFE, f"predicted below {DOUBT:g}, or safe"),
    (DOUBTFUL, f"predicted {DOUBT:g} to {FAILURE:g}"),
    (FAILED, f"predicted {FAILURE:g} or more, or failed"),
    (UNKNOWN_COLOUR, "unknown ground"),
)


def _share_title(name: str, fails: np.ndarray, known: np.ndarray) -> str:
    return f"{name}: {fails[known].mean():.1%} of known fail" if known.any() else f"{name}: all unknown"


_KINDS = ((SAFE, "safe"), (FAILED, "failed"), (UNKNOWN_COLOUR, "unknown"))


def _colour_range(heights: np.ndarray) -> tuple[float, float]:
    """Returns the lowest and highest height of the colour scale; outliers get the colours at its ends."""
    low, high = np.nanpercentile(heights, [0.5, 99.5]) if np.isfinite(heights).any() else (0.0, 1.0)
    return low, max(high, low + 1e-3)


def _draw_elevation(ax, heights, grid: Grid, low: float, high: float, colour: str = TERRAIN, alpha: float = 1.0):
    edge = grid.size / 2 + grid.spacing / 2
    extent = (-edge, edge, -edge, edge)
    image = ax.imshow(heights, origin="lower", extent=extent, cmap=colour, vmin=low, vmax=high, alpha=alpha)
    level = np.nanmean(heights) if np.isfinite(heights).any() else 0.0
    shade = LightSource(315, 45).hillshade(np.nan_to_num(heights, nan=level)[::-1], dx=grid.spacing, dy=grid.spacing)
    shade = np.where(np.isnan(heights), np.nan, shade[::-1])
    ax.imshow(shade, origin="lower", extent=extent, cmap="gray", vmin=0, vmax=1, alpha=0.45 * alpha)
    ax.set_facecolor("white")
    return image


def _by_label(failed: np.ndarray, known: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the trajectories to draw in each colour; later colours are drawn on top."""
    return {UNKNOWN_COLOUR: ~known, SAFE: known & ~failed, FAILED: known & failed}


def _by_probability(probability: np.ndarray, known: np.ndarray) -> dict[str, np.ndarray]:
    failing, safe = probability >= FAILURE, probability < DOUBT
    return {UNKNOWN_COLOUR: ~known, SAFE: known & safe, DOUBTFUL: known & ~safe & ~failing, FAILED: known & failing}


def _draw_paths(ax, paths: np.ndarray, by_colour: dict[str, np.ndarray]) -> None:
    for colour, mask in by_colour.items():
        ax.add_collection(LineCollection(paths[mask], colors=colour, linewidths=0.25, alpha=0.7))


def _draw_paths_from(ax, paths: np.ndarray, failed: np.ndarray, known: np.ndarray, poses: np.ndarray) -> None:
    """Draws paths, the failing ones as failed only from the pose on where their margin is reached."""
    _draw_paths(ax, paths, {UNKNOWN_COLOUR: ~known, SAFE: known})
    last = paths.shape[1] - 2  # a line has two ends
    ends = [
        path[min(max(pose, 0), last) :] for path, pose in zip(paths[failed & known], poses[failed & known], strict=True)
    ]
    ax.add_collection(LineCollection(ends, colors=FAILED, linewidths=0.25, alpha=0.7))


def draw_failures(ax, heights: np.ndarray, setup: Setup, trajectories: np.ndarray, failed: np.ndarray) -> None:
    """Draws some trajectories on one map [rows, cols] in gray, coloured as safe or failed."""
    _draw_elevation(ax, heights, setup.grid, *_colour_range(heights), colour="gray", alpha=0.35)
    paths = setup.actions.poses(trajectories)[..., :2]
    for colour, mask in ((SAFE, ~failed), (FAILED, failed)):
        ax.add_collection(LineCollection(paths[mask], colors=colour, linewidths=0.8, alpha=0.9))


def _draw_robot(ax, robot: Robot) -> None:
    """Draws chassis and wheels from above, to scale, facing +y."""
    for x, y in robot.wheel_positions():
        ax.add_patch(_box(x, y, robot.wheel_width, robot.wheel_diameter, facecolor="black"))
    ax.add_patch(
        _box(0, 0, robot.chassis_width, robot.chassis_length, facecolor="orange", edgecolor="black", alpha=0.9)
    )
    ax.annotate("", (0, robot.chassis_length / 2), (0, 0), arrowprops=dict(arrowstyle="->", linewidth=1.2))


def _box(x: float, y: float, width: float, height: float, **style) -> Rectangle:
    return Rectangle((x - width / 2, y - height / 2), width, height, **style)


def robot_figure(robot: Robot) -> Figure:
    """Draws the robot from above and from the side, to scale, with the dimensions that the simulator uses."""
    figure = Figure(figsize=(12, 5.5), layout="constrained")
    plan, side = figure.subplots(1, 2)
    _draw_robot(plan, robot)
    plan.add_patch(_box(0, 0, robot.overall_width, robot.overall_length, fill=False, linestyle=":", edgecolor="gray"))
    plan.plot(*np.transpose(robot.wheel_positions()), "+", color="white")
    right, ahead = 0.62 * robot.overall_width, 0.58 * robot.overall_length
    _dimension(plan, (-robot.track / 2, -ahead), (robot.track / 2, -ahead), "track", (0, -5))
    _dimension(plan, (-robot.chassis_width / 2, ahead), (robot.chassis_width / 2, ahead), "chassis width", (0, 5))
    _dimension(plan, (right, -robot.wheelbase / 2), (right, robot.wheelbase / 2), "wheelbase", (6, 0))
    _dimension(plan, (-right, -robot.chassis_length / 2), (-right, robot.chassis_length / 2), "chassis length", (-6, 0))
    plan.set(title="plan; + wheel contact, dotted: overall", xlabel="right [m]", ylabel="forward [m]")

    radius, axle = robot.wheel_diameter / 2, robot.wheelbase / 2
    middle = robot.ride_height + 0.6 * radius
    side.add_patch(_box(0, middle, robot.chassis_length, 1.2 * radius, facecolor="orange", edgecolor="black"))
    turn = np.linspace(0, 2 * np.pi, 100)
    for y in (-axle, axle):
        side.fill(y + radius * np.cos(turn), radius + radius * np.sin(turn), color="black", alpha=0.75)
    edge = 0.6 * robot.overall_length
    side.plot(
        [-2 * edge, edge, edge, 2 * edge], [0, 0, robot.max_step, robot.max_step], color="saddlebrown", linewidth=2
    )
    _dimension(side, (-1.4 * edge, 0), (-1.4 * edge, robot.ride_height), "ride height", (0, 5))
    _dimension(side, (1.5 * edge, 0), (1.5 * edge, robot.max_step), "largest step", (0, 5))
    _dimension(side, (-radius - axle, -0.5 * radius), (radius - axle, -0.5 * radius), "wheel diameter", (0, -5))
    angles = [(event.name, getattr(robot, event.limit)) for event in robot.events if event.unit == "rad"]
    largest = "".join(f"; largest {name} {np.degrees(limit):.1f} deg" for name, limit in angles)
    side.set(title=f"side{largest}", xlabel="forward [m]", ylabel="up [m]")
    reach = 1.05 * max(robot.overall_length, robot.overall_width)
    plan.set(xlim=(-reach, reach), ylim=(-reach, reach))
    side.set(xlim=(-2.2 * edge, 2.2 * edge), ylim=(-1.6 * radius, 1.2 * edge))
    for ax in (plan, side):
        ax.set_aspect("equal")
        ax.grid(alpha=0.3)
    figure.suptitle(robot.name)
    return figure


def _dimension(ax, start: tuple[float, float], end: tuple[float, float], name: str, offset: tuple[int, int]) -> None:
    """Draws a dimension arrow with its length, `offset` points from its middle or, for a vertical offset, its top."""
    length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    ax.annotate("", end, start, arrowprops=dict(arrowstyle="<->", shrinkA=0, shrinkB=0, color="tab:blue"))
    across = {1: "left", 0: "center", -1: "right"}[int(np.sign(offset[0]))]
    along = {1: "bottom", 0: "center", -1: "top"}[int(np.sign(offset[1]))]
    text = f"{name} {length:.3f} m" if offset[1] else f"{name}\n{length:.3f} m"
    place = dict(textcoords="offset points", ha=across, va=along, fontsize=9, color="tab:blue")
    middle = ((start[0] + end[0]) / 2, max(start[1], end[1]) if offset[1] else (start[1] + end[1]) / 2)
    ax.annotate(text, middle, offset, **place)


def action_figure(setup: Setup) -> Figure:
    """Draws the action space: the point turns, and all pairs of arcs after one of them (the paper's Fig. 3)."""
    robot, actions, grid = setup.robot, setup.actions, setup.grid
    figure = Figure(figsize=(11, 5.6), layout="constrained")
    whole, fan = figure.subplots(1, 2)
    paths = actions.poses(np.arange(len(actions)))[..., :2]
    colours = colormaps["twilight"](np.linspace(0.1, 0.9, actions.turns))
    turn = actions.split(np.arange(len(actions)))[0]
    whole.add_collection(LineCollection(list(paths), colors=colours[turn], linewidths=0.25))
    for k in range(actions.turns):
        x, y = 0.94 * grid.size / 2 * np.array([-np.sin(actions.heading(k)), np.cos(actions.heading(k))])
        degrees = np.degrees(actions.heading(k))
        whole.text(x, y, f"{degrees:.0f}", ha="center", va="center", fontsize=8, color=colours[k])
    whole.set_title(f"{len(actions)} trajectories after {actions.turns} point turns [deg]", fontsize=10)
    ahead = np.flatnonzero(turn == 0)
    first = actions.first_poses(np.zeros(len(actions.radii), int), np.arange(len(actions.radii)))[..., :2]
    fan.add_collection(LineCollection(list(paths[ahead]), colors="tab:blue", linewidths=0.5))
    fan.add_collection(LineCollection(list(first), colors="black", linewidths=1.6))
    fan.plot(*first[:, -1].T, "o", color="black", markersize=3)
    lengths = " + ".join(f"{length:g}" for length in actions.arc_lengths)
    radii = len(actions.radii)
    fan.set_title(f"after one turn: {radii} first arcs (black) x {radii} second arcs, {lengths} m", fontsize=10)
    for ax in (whole, fan):
        _draw_robot(ax, robot)
        ax.set(
            xlim=(-grid.size / 2, grid.size / 2),
            ylim=(-grid.size / 2, grid.size / 2),
            aspect="equal",
            xlabel="x, right [m]",
        )
        ax.grid(alpha=0.3)
    whole.set_ylabel("y, forward [m]")
    return figure


def speed_figure(rows: list[dict]) -> Figure:
    """Plots milliseconds per map against the number of maps at once, from the rows of `bench`."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    ax = figure.subplots()
    for what in dict.fromkeys(row["what"] for row in rows):
        chosen = [row for row in rows if row["what"] == what and row["maps"] and row["ms_per_map"]]
        if chosen:
            ax.loglog([row["maps"] for row in chosen], [row["ms_per_map"] for row in chosen], "o-", label=what)
    ax.set(xlabel="maps at once", ylabel="ms a map (median)")
    ax.set_xticks(sorted({row["maps"] for row in rows}))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_formatter("")
    ax.yaxis.set_minor_formatter("{x:g}")
    ax.grid(alpha=0.3, which="both")
    ax.legend()
    return figure


def timing_figure(rows: list[dict]) -> Figure:
    """Draws bars of seconds per map from the rows of the experiment `timing`; the paper's are grey."""
    figure = Figure(figsize=(9, 0.6 * len(rows) + 1.2), layout="constrained")
    ax = figure.subplots()
    names = [f"{row['what']}\n{row['device']}" for row in rows]
    colours = ["tab:gray" if row["what"].startswith("paper") else "tab:blue" for row in rows]
    bars = ax.barh(names, [row["seconds"] for row in rows], color=colours, height=0.65)
    ax.bar_label(bars, [f"{row['seconds']:.3g} s" for row in rows], padding=3)
    ax.invert_yaxis()
    ax.set_xscale("log")
    ax.margins(x=0.12)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.set_xlabel("s a map (median)")
    ax.tick_params(axis="y", labelsize=8)
    ax.grid(alpha=0.3, axis="x")
    return figure
