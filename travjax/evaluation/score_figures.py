"""Figures of evaluation and training: precision and recall, calibration, training curves, network inputs.

Functions return a matplotlib Figure; `map_figures.save` writes it.
"""

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from itertools import cycle, pairwise

import numpy as np
from matplotlib.figure import Figure

from travjax.evaluation.metrics import OVERALL, PAPER_SYNTHETIC, THRESHOLD, Confusion, Curve, Evaluation
from travjax.simulation.events import EVENTS
from travjax.simulation.grid import Grid

COLOURS = ("tab:blue", "tab:orange", "tab:purple", "tab:green", "tab:red", "navy", "teal")
"""Colours of a robot's events, in their order."""

BASELINES = ("tab:brown", "tab:olive", "tab:cyan", "tab:pink", "tab:gray")


def precision_recall_figure(
    evaluation: Evaluation,
    paper: Mapping[str, Confusion] | None = PAPER_SYNTHETIC,
    baselines: Mapping[str, Evaluation] | None = None,
) -> Figure:
    """Plots precision against recall for each event and overall, over lines of equal F1.

    Marks the threshold of the evaluation and the result of the paper. baselines: other predictors by name.
    """
    rows, colours = math.ceil(len(evaluation.scores) / 2), _colours_of(evaluation.scores)
    figure = Figure(figsize=(13.5, 4.5 * rows), layout="constrained")
    axes = figure.subplots(rows, 2, sharex=True, sharey=True)
    for ax in axes.flat[len(colours) :]:
        ax.set_visible(False)
    for ax, (name, own) in zip(axes.flat, colours.items(), strict=False):
        _draw_equal_f1(ax)
        for colour, (other, one) in zip(cycle(BASELINES), (baselines or {}).items(), strict=False):
            _draw_curve(ax, one.curves[name], one.scores[name].average_precision, other, color=colour, linewidth=1.2)
        scores = evaluation.scores[name]
        _draw_curve(ax, evaluation.curves[name], scores.average_precision, "network", color=own, linewidth=2)
        _draw_point(ax, scores.confusion, "o", own, f"network at {evaluation.threshold:g}")
        if paper and name in paper:
            _draw_point(ax, paper[name], "*", "red", "paper")
        ax.set_title(f"{name}: {scores.confusion.failures:.2%} of {scores.confusion.samples:,} fail", fontsize=10)
        ax.set(xlim=(0, 1.01), ylim=(0, 1.01))
        ax.legend(loc="upper left", bbox_to_anchor=(1.12, 1), fontsize=8, frameon=False)
    for ax in axes[-1]:
        ax.set_xlabel("recall")
    for ax in axes[:, 0]:
        ax.set_ylabel("precision")
    return figure


def _colours_of(names: Iterable[str]) -> dict[str, str]:
    """Assigns a colour to each event, and black to "overall"."""
    colours = iter(COLOURS)
    return {name: "black" if name == OVERALL else next(colours) for name in names}


def _draw_equal_f1(ax) -> None:
    for f1 in (0.2, 0.4, 0.6, 0.8):
        recall = np.linspace(f1 / (2 - f1), 1, 100)
        ax.plot(recall, f1 * recall / (2 * recall - f1), color="0.8", linewidth=0.8, zorder=0)
        beside = dict(textcoords="offset points", va="center", annotation_clip=False)
        ax.annotate(f"F1 {f1:g}", (1, f1 / (2 - f1)), (8, 0), fontsize=7, color="0.5", **beside)


def _draw_curve(ax, curve: Curve, average_precision: float, label: str, **style) -> None:
    """Draws the steps that average precision sums: a precision applies to the recall gained up to its point."""
    if len(curve.recall):
        recall, precision = np.append(0, curve.recall), np.append(curve.precision[0], curve.precision)
        name = textwrap.fill(f"{label}, AP {average_precision:.3f}", 28)
        ax.step(recall, precision, where="pre", label=name, **style)
    else:
        ax.plot([], [], label=f"{label}: no sample fails", **style)


def _draw_point(ax, counts: Confusion, marker: str, colour: str, label: str) -> None:
    """Marks precision and recall of a confusion, unless one of them is undefined."""
    if np.isfinite(counts.recall + counts.precision):
        size = 12 if marker == "*" else 7
        style = dict(color=colour, markersize=size, markeredgecolor="white", linestyle="none", clip_on=False, zorder=5)
        ax.plot([counts.recall], [counts.precision], marker, label=label, **style)


def reliability_figure(evaluation: Evaluation) -> Figure:
    """Plots observed failures against predicted probability for each event and overall, with samples per bin below."""
    colours = _colours_of(evaluation.scores)
    figure = Figure(figsize=(3.5 * len(colours), 5.2), layout="constrained")
    axes = figure.subplots(2, len(colours), sharex=True, sharey="row", height_ratios=(3, 1))
    for (upper, lower), (name, colour) in zip(axes.T, colours.items(), strict=True):
        bins = evaluation.calibration[name]
        upper.plot([0, 1], [0, 1], color="0.6", linewidth=1, linestyle="--")
        filled = bins.count > 0
        upper.plot(bins.probability[filled], bins.observed[filled], "o-", color=colour, markersize=4, clip_on=False)
        upper.set_title(f"{name}, calibration error {bins.error:.4f}", fontsize=10)
        upper.set(xlim=(0, 1), ylim=(0, 1))
        lower.bar(bins.edges[:-1], bins.count, np.diff(bins.edges), align="edge", color=colour, alpha=0.7)
        lower.set_yscale("log")
        lower.set_xlabel("predicted probability")
        for ax in (upper, lower):
            ax.grid(alpha=0.3)
    axes[1, 0].set_ylim(bottom=0.5)
    axes[0, 0].set_ylabel("observed share of failures")
    axes[1, 0].set_ylabel("samples")
    return figure


def training_figure(rows: Sequence[Mapping], events: Sequence[str] = EVENTS) -> Figure:
    """Plots losses, average precision, F1 and learning rate against the training step.

    rows: as read from metrics.jsonl, in order. Keys `step`, `phase`, `loss`, `validation_loss`, `learning_rate`, and
    `average_precision` and `f1` by event; a row may lack any key but `step`, and only numbers are drawn.
    events: names of the events
    """
    figure = Figure(figsize=(12, 8), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True)
    (loss, precision), (rate, f1) = axes
    _draw_series(loss, *_series(rows, "loss"), label="training", color="tab:blue", linewidth=1)
    _draw_series(loss, *_series(rows, "validation_loss"), label="validation", color="tab:red", marker="o")
    _draw_series(rate, *_series(rows, "learning_rate"), color="tab:green", drawstyle="steps-post")
    for name, colour in _colours_of([*events, OVERALL]).items():
        for ax, key in ((precision, "average_precision"), (f1, "f1")):
            _draw_series(ax, *_series(rows, key, name), label=name, color=colour, marker="o")
    titles = ("loss", "average precision, validation", "learning rate", f"F1 at {THRESHOLD:g}, validation")
    for ax, title in zip(axes.flat, titles, strict=True):
        ax.set_title(title, fontsize=10)
        ax.grid(alpha=0.3)
        _mark_phases(ax, rows)
        if ax.get_legend_handles_labels()[0]:
            ax.legend(fontsize=8)
    for ax in (precision, f1):
        ax.set_ylim(0, 1)
    for ax in axes[-1]:
        ax.set_xlabel("training step")
    return figure


def _series(rows: Sequence[Mapping], key: str, name: str | None = None) -> tuple[list, list]:
    """Returns steps and values of the rows with a number under `key` (and `name` within it, if given)."""
    values = [(row["step"], row.get(key)) for row in rows]
    if name is not None:
        values = [(step, value.get(name)) for step, value in values if isinstance(value, Mapping)]
    kept = [(step, value) for step, value in values if type(value) in (int, float)]
    return [step for step, _ in kept], [value for _, value in kept]


def _draw_series(ax, steps: list, values: list, **style) -> None:
    if steps:
        ax.plot(steps, values, markersize=4, **style)


def _mark_phases(ax, rows: Sequence[Mapping]) -> None:
    """Draws a line where a phase of training begins, with its number."""
    for before, after in pairwise(row for row in rows if type(row.get("phase")) is int):
        if before["phase"] != after["phase"]:
            ax.axvline(before["step"], color="0.4", linewidth=1, linestyle=":")
            ax.annotate(f"phase {after['phase']}", (before["step"], 1), (3, -10), **_PHASE)


_PHASE = dict(xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=8, color="0.4")


def input_channels_figure(images: np.ndarray, titles: Sequence[str], grid: Grid = Grid()) -> Figure:
    """Draws network inputs, one sample per row: the three channels, then all three as RGB (the paper's Fig. 1).

    images: [k, rows, cols, 3] as `inputs.render_inputs` makes them
    """
    figure = Figure(figsize=(12.5, 2.8 * len(images) + 0.6), layout="compressed")
    axes = figure.subplots(len(images), 4, sharex=True, sharey=True, squeeze=False)
    edge = grid.size / 2 + grid.spacing / 2
    place = dict(origin="lower", extent=(-edge, edge, -edge, edge))
    for row, image, title in zip(axes, images, titles, strict=True):
        elevation = image[..., 0]
        low, high = elevation.min(), max(elevation.max(), elevation.min() + 1e-3)
        drawn = row[0].imshow(elevation, cmap="gray", vmin=low, vmax=high, **place)
        figure.colorbar(drawn, ax=row[0], shrink=0.85)
        for ax, channel in zip(row[1:3], (1, 2), strict=True):
            drawn = ax.imshow(image[..., channel], cmap="gray", vmin=0, vmax=1, **place)
        figure.colorbar(drawn, ax=row[2], shrink=0.85)
        composite = np.concatenate([(elevation[..., None] - low) / (high - low), image[..., 1:]], axis=-1)
        row[3].imshow(np.clip(composite, 0, 1), **place)
        row[0].set_ylabel(f"{title}\ny, forward [m]", fontsize=9)
    for ax, name in zip(
        axes[0], ("elevation, from the robot's", "trajectory", "wheels", "as red, green, blue"), strict=True
    ):
        ax.set_title(name, fontsize=10)
    for ax in axes[-1]:
        ax.set_xlabel("x, right [m]")
    return figure
