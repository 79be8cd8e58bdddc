"""How often each method arrived, with intervals, as tables and as a figure."""

import math
from collections.abc import Sequence
from statistics import NormalDist

import numpy as np
from matplotlib.figure import Figure

from travjax.evaluation.tables import rows_table
from travjax.navigation.methods import METHODS
from travjax.navigation.trials import ARRIVED, ENDS, FAILED, REFUSED, Trial

CONFIDENCE = 0.95

COLOURS = ("#999999", "#0072b2", "#56b4e9", "#003a5c", "#e69f00", "#d55e00")
"""Colours of METHODS; markers tell them apart without colour."""

MARKERS = "sovD^P"


def interval(count: int, total: int) -> tuple[float, float]:
    """Returns the interval of confidence of a share; source: Wilson 1927."""
    if total == 0:
        return 0.0, 1.0
    z = NormalDist().inv_cdf((1 + CONFIDENCE) / 2)
    share, centre = count / total, count / total + z**2 / (2 * total)
    half = z * math.sqrt(share * (1 - share) / total + z**2 / (4 * total**2))
    return max(0.0, (centre - half) / (1 + z**2 / total)), min(1.0, (centre + half) / (1 + z**2 / total))


def _alike(trials: Sequence[Trial], kind: str, corruption: str, method: str) -> list[Trial]:
    """Returns the trials of one method on one kind of ground, seen with one corruption."""
    return [one for one in trials if (one.kind, one.corruption, one.method) == (kind, corruption, method)]


def table(trials: Sequence[Trial], kind: str, corruptions: Sequence[str]) -> str:
    """Returns a table of one kind of ground: a row for each corruption and method."""
    rows = []
    for corruption in corruptions:
        for method in METHODS:
            mine = _alike(trials, kind, corruption, method)
            if not mine:
                continue
            counts = {end: sum(one.ended == end for one in mine) for end in ENDS}
            low, high = interval(counts[ARRIVED], len(mine))
            detours = [one.detour for one in mine if one.ended == ARRIVED]
            rows.append(
                {
                    "map": corruption,
                    "method": method,
                    "tasks": len(mine),
                    "arrived": f"{counts[ARRIVED] / len(mine):.1%}",
                    "95 %": f"{low:.0%} to {high:.0%}",
                    "failed on the way": f"{counts[FAILED] / len(mine):.1%}",
                    "no path": f"{counts[REFUSED] / len(mine):.1%}",
                    "length": f"{np.mean(detours):.3f}" if detours else "-",
                }
            )
    return rows_table(rows)


def winners(trials: Sequence[Trial], kind: str, corruptions: Sequence[str]) -> str:
    """Says for each corruption which methods arrived most often, and which are not told apart from them; and which
    failed least often.
    """
    lines = []
    for corruption in corruptions:
        of_method = {method: _alike(trials, kind, corruption, method) for method in METHODS}
        tried = {method: [one.ended for one in mine] for method, mine in of_method.items() if mine}
        arrived, failed = (
            {name: ends.count(end) / len(ends) for name, ends in tried.items()} for end in (ARRIVED, FAILED)
        )
        within = {method: interval(ends.count(ARRIVED), len(ends)) for method, ends in tried.items()}
        best, fewest = max(arrived, key=arrived.__getitem__), min(failed.values())
        close = [method for method in tried if method != best and within[method][1] >= within[best][0]]
        beside = f"; its interval overlaps with those of {_listed(close)}" if close else ""
        safest = _listed([method for method in tried if failed[method] == fewest])
        lines.append(
            f"- {corruption}: *{best}* arrived most often, {arrived[best]:.1%}{beside}. "
            f"Fewest tasks failed on the way, {fewest:.1%}, with {safest}."
        )
    return "\n".join(lines)


def _listed(methods: Sequence[str]) -> str:
    """Lists names of methods, which may hold commas, in italics."""
    return ", ".join(f"*{method}*" for method in methods)


def figure(trials: Sequence[Trial], corruptions: Sequence[str]) -> Figure:
    """Draws the share of tasks that arrived and that failed on the way, by corruption, a column a kind of ground."""
    kinds = list(dict.fromkeys(one.kind for one in trials))
    drawn = Figure(figsize=(3.2 + 4.3 * len(kinds), 7.2), layout="constrained")
    axes = np.atleast_2d(drawn.subplots(2, len(kinds), sharey="row", squeeze=False))
    for column, kind in enumerate(kinds):
        for row, (end, title) in enumerate(((ARRIVED, "arrived"), (FAILED, "failed on the way"))):
            ax = axes[row, column]
            _draw(ax, trials, kind, corruptions, end)
            tasks = len({(one.ground, one.task) for one in trials if one.kind == kind})
            ax.set_title(f"{kind}, {tasks} tasks" if row == 0 else "")
            ax.set_ylabel(f"share that {title}" if column == 0 else "")
            ax.set_xticks(range(len(corruptions)), corruptions, rotation=30, ha="right", fontsize=8)
            ax.grid(alpha=0.3)
    axes[0, 0].set_ylim(-0.03, 1.03)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside right upper", fontsize=8, title="95 % intervals")
    return drawn


def _draw(ax, trials: Sequence[Trial], kind: str, corruptions: Sequence[str], end: str) -> None:
    """Draws the shares of one end of a task on one kind of ground, a little apart from each other."""
    for number, (method, colour, marker) in enumerate(zip(METHODS, COLOURS, MARKERS, strict=True)):
        x, y, low, high = [], [], [], []
        for place, corruption in enumerate(corruptions):
            mine = [one.ended == end for one in _alike(trials, kind, corruption, method)]
            if mine:
                share, (least, most) = np.mean(mine), interval(sum(mine), len(mine))
                x.append(place + 0.1 * (number - len(METHODS) / 2))
                y.append(share)
                low.append(share - least)
                high.append(most - share)
        bars = np.maximum([low, high], 0)
        ax.errorbar(x, y, bars, color=colour, fmt=marker, markersize=5, linewidth=1, capsize=2, label=method)
