"""Draws the pictures of the README and of these pages into images/: `python docs/pictures.py`."""

import io
import math
from pathlib import Path

import numpy as np
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle
from matplotlib.transforms import Affine2D
from PIL import Image

import travjax

IMAGES = Path(__file__).parent / "images"

COLOURS = {"safe": "#c9e8f7", "obstacle": "#f0a500", "step": "#c8431b", "tilt": "#35105e"}
"""From light to dark, so that they can be told apart without colour too."""

INK, PALE, SHADE = "#222222", "#8a8a8a", "#d9d9d9"

PACKAGES = [
    {"commands": "parse, call the library, print", "experiments": "the paper's, and a comparison"},
    {"training": "the trainer and its step; evaluation on test maps", "physics": "trajectories driven in MuJoCo"},
    {"navigation": "plan on what a sensor saw, drive on the truth", "plan_results": "files and figures of paths"},
    {"planning": "paths on whole sites, or why there is none", "exporting": "StableHLO and ONNX files"},
    {"runs": "a run on disk: checkpoints, model file, predictors"},
    {"estimators": "presets, samples, losses", "site": "maps of whole sites"},
    {"evaluation": "scores, tables, figures"},
    {"data": "windows of real sites, samples, splits, data sets"},
    {"point_clouds": "LAS, LAZ, PLY, PCD, text, meshes"},
    {"terrain": "synthetic ground", "rasters": "GeoTIFF and others", "models": "ResNet50, hazard field"},
    {"traversal": "what happens to a robot on a map: the kernels of the contact models"},
    {"simulation": "grid, robot, actions, events", "resnet": "network, ImageNet weights"},
]
"""Packages and what each holds, in rows: each imports only from rows below its own."""

FOUNDATION = "config, files, devices, batching, jax_flags, signals, progress"
"""Modules of travjax itself, on which all packages stand."""


def overview(path: Path) -> None:
    """Draws a map, what its trajectories fail at, and what the hazard field says of them."""
    robot, actions, grid = travjax.Robot.load("seekur_jr"), travjax.ActionSpace(), travjax.Grid()
    heights = np.asarray(travjax.generate_terrain("rough", [9]))[0]
    step, obstacle, tilt = np.asarray(travjax.label(heights)).T
    kind = np.select([tilt, step, obstacle], [3, 2, 1])
    probability = np.asarray(travjax.predict(heights)).max(1)
    shown = np.flatnonzero(actions.split(np.arange(len(actions)))[0] % 3 == 0)
    paths = actions.poses(shown)[..., :2]

    figure = Figure(figsize=(11, 3.7), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    for ax in axes:
        shade(ax, heights, grid)
    left, middle, right = axes
    edge = grid.size / 2 + grid.spacing / 2
    image = left.imshow(heights, origin="lower", extent=(-edge, edge, -edge, edge), cmap="cividis", alpha=0.5)
    figure.colorbar(image, ax=left, label="elevation [m]", shrink=0.8)
    draw_robot(left, robot)
    left.set_ylabel("y, forward [m]")
    left.set_title("Elevation map, robot to scale", fontsize=11)

    for place, (event, colour) in enumerate(COLOURS.items()):
        middle.add_collection(
            LineCollection(paths[kind[shown] == place], colors=colour, linewidths=0.55, zorder=2 + place)
        )
        middle.plot([], [], color=colour, linewidth=3, label=event)
    middle.legend(loc="lower center", ncols=4, fontsize=7.5, columnspacing=1, handlelength=1.4)
    middle.set_title("Simulator: failure events", fontsize=11)

    order = np.argsort(probability[shown])
    lines = LineCollection(paths[order], linewidths=0.55, cmap="magma_r", array=probability[shown][order])
    lines.set_clim(0, 1)
    right.add_collection(lines)
    figure.colorbar(lines, ax=right, label="probability of a failure", shrink=0.8)
    right.set_title("Hazard field: one network pass", fontsize=11)
    save_small(figure, path)


def save_small(figure: Figure, path: Path) -> None:
    """Writes a PNG in which each colour has 43 levels, which packs to about half the size."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=120)
    Image.open(buffer).convert("RGB").point(lambda value: (value + 3) // 6 * 6).save(path, optimize=True)


def shade(ax: Axes, heights: np.ndarray, grid: travjax.Grid) -> None:
    """Draws a map in grey, lit from the north-west."""
    edge = grid.size / 2 + grid.spacing / 2
    light = LightSource(315, 40).hillshade(heights[::-1], dx=grid.spacing, dy=grid.spacing, vert_exag=1.5)
    extent = (-edge, edge, -edge, edge)
    ax.imshow(light[::-1], origin="lower", extent=extent, cmap="gray", vmin=-0.35, vmax=1.15)
    ax.set(aspect="equal", xlim=(-4, 4), ylim=(-4, 4), xticks=range(-4, 5, 2), yticks=range(-4, 5, 2))
    ax.set_xlabel("x, right [m]")


def draw_robot(ax: Axes, robot: travjax.Robot, pose: tuple[float, float, float] = (0, 0, 0)) -> None:
    """Draws chassis and wheels in plan, to scale, at a pose (x, y, heading)."""
    x, y, heading = pose
    turn = Affine2D().rotate(heading).translate(x, y) + ax.transData
    boxes = [(0.0, 0.0, robot.chassis_width, robot.chassis_length, "white")]
    boxes += [(right, ahead, robot.wheel_width, robot.wheel_diameter, INK) for right, ahead in robot.wheel_positions()]
    for right, ahead, width, length, colour in boxes:
        corner = (right - width / 2, ahead - length / 2)
        ax.add_patch(Rectangle(corner, width, length, facecolor=colour, edgecolor=INK, zorder=5, transform=turn))
    ahead = np.array([-math.sin(heading), math.cos(heading)])
    tail, tip = np.array([x, y]) - 0.3 * ahead, np.array([x, y]) + 0.45 * ahead
    ax.annotate("", tip, tail, arrowprops={"arrowstyle": "-|>", "color": INK}, zorder=6)


def frames(path: Path) -> None:
    """Draws the frame of a map, the order of its rows and columns, and a trajectory: a point turn and two arcs."""
    robot, actions = travjax.Robot.load("seekur_jr"), travjax.ActionSpace()
    trajectory = actions.index(turn=2, first=3, second=4)
    poses = actions.poses(trajectory)
    figure = Figure(figsize=(8.2, 5.4), layout="constrained")
    ax = figure.subplots()
    ax.set(aspect="equal", xlim=(-4.9, 6.6), ylim=(-4.9, 4.9))
    ax.set_xticks(range(-4, 5, 2))
    ax.set_yticks(range(-4, 5, 2))
    ax.set_xlabel("x, right, east [m]", loc="left")
    ax.set_ylabel("y, forward, north [m]")
    ax.spines[["top", "right", "bottom", "left"]].set_visible(False)
    ax.add_patch(Rectangle((-4, -4), 8, 8, facecolor="#f4f4f4", edgecolor=INK))
    nodes = np.arange(-4, 4.01, 0.5)
    ax.plot(*map(np.ravel, np.meshgrid(nodes, nodes)), ".", color=SHADE, markersize=3)
    arrow = {"arrowstyle": "-|>", "color": PALE}
    ax.annotate("", (-0.4, -4.35), (-4, -4.35), arrowprops=arrow)
    ax.text(-0.3, -4.35, "columns: col 0 is the westernmost", color=INK, va="center")
    ax.annotate("", (-4.35, -0.4), (-4.35, -4), arrowprops=arrow)
    ax.text(-4.35, -0.2, "rows: row 0 is the southernmost", color=INK, rotation=90, ha="center", va="bottom")
    ax.plot(-4, -4, "o", color=INK, markersize=5)
    ax.text(-3.85, -3.75, "heights[0, 0]")

    draw_robot(ax, robot)
    ax.annotate("", (0, 1.9), (0, 0.6), arrowprops={"arrowstyle": "-", "color": PALE, "linestyle": ":"})
    turn = np.linspace(0, actions.heading(2), 40)
    swept = 1.7 * np.stack([-np.sin(turn), np.cos(turn)], axis=-1)
    ax.plot(*swept.T, color=INK, linewidth=1)
    ax.annotate("", swept[-1], swept[-3], arrowprops={"arrowstyle": "-|>", "color": INK})
    ax.text(0.15, 1.75, "heading, anticlockwise\nfrom +y")
    junction = len(actions.first_stations()) - 1
    for part, colour in ((poses[: junction + 1], "#c8431b"), (poses[junction:], "#35105e")):
        ax.plot(part[:, 0], part[:, 1], ".-", color=colour, markersize=4, linewidth=1, zorder=8)
    draw_robot(ax, robot, poses[-1])
    ax.text(4.3, 3.3, f"trajectory {trajectory} =\n(turn 2 * 13 + first 3) * 13 + second 4", va="center")
    for place, (text, colour) in enumerate(
        [
            (f"point turn: {math.degrees(actions.heading(2)):.0f} degrees", INK),
            (f"first arc: radius {actions.radii[3]:+.2f} m, left", "#c8431b"),
            (f"second arc: radius {actions.radii[4]:+.2f} m, right", "#35105e"),
            (f"{len(poses)} poses, at most 0.06 m apart", INK),
            ("8 x 8 m, 129 x 129 nodes, 0.0625 m apart", PALE),
        ]
    ):
        ax.text(4.3, 2.3 - 0.55 * place, text, color=colour, va="center")
    figure.savefig(path, metadata={"Date": None})


def packages(path: Path) -> None:
    """Draws the packages in rows, over the modules on which all stand."""
    rows = [*PACKAGES, {FOUNDATION: "what everything stands on"}]
    figure = Figure(figsize=(7.4, 0.62 * len(rows)), layout="constrained")
    ax = figure.subplots()
    ax.set(xlim=(0, 10), ylim=(-len(rows), 0))
    ax.axis("off")
    for row, texts in enumerate(rows, start=1):
        width = 10 / len(texts)
        for place, (name, text) in enumerate(texts.items()):
            middle = width * (place + 0.5)
            style = {"boxstyle": "round,pad=0,rounding_size=0.12", "facecolor": "#eef4f8", "edgecolor": INK}
            ax.add_patch(FancyBboxPatch((width * place + 0.1, 0.1 - row), width - 0.2, 0.8, **style))
            ax.text(middle, 0.65 - row, name, ha="center", va="center", weight="bold", color=INK)
            ax.text(middle, 0.32 - row, text, ha="center", va="center", fontsize=9, color="#444444")
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    rcParams["svg.fonttype"] = "none"
    rcParams["svg.hashsalt"] = "travjax"
    overview(IMAGES / "overview.png")
    frames(IMAGES / "frames.svg")
    packages(IMAGES / "packages.svg")
