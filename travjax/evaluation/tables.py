"""Tables of failure shares and metrics, as text to print."""

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from tabulate import tabulate

from travjax.config import QUOTED, one_line
from travjax.evaluation.metrics import OVERALL, PAPER_SYNTHETIC, Confusion, Evaluation, OperatingPoint
from travjax.simulation.events import EVENTS
from travjax.simulation.setup import Setup

ANY = "any failure"

PAPER_SHARES = {"step": 0.0623, "obstacle": 0.0550, "tilt": 0.0042, ANY: 0.096}
"""Shares of the paper's synthetic test trajectories that fail (SPEC section 10); its robot is not published in full."""

AT_ONCE = 1024
"""Number of maps whose flags are read together: they may be on the disk."""

TOLERANCE = 0.1
"""Share by which the mean probability may differ from the frequency of failures and still be called right."""


def shares_table(
    groups: Sequence[str] | np.ndarray,
    failed: np.ndarray,
    known: np.ndarray,
    as_in_paper: bool = True,
    events: Sequence[str] = EVENTS,
) -> str:
    """Tabulates the shares of known trajectories that fail, for each group of maps and overall.

    groups: [n] name of each map's group; failed: [n, t, k]; known: [n, t]; events: names of the k events; as_in_paper:
    whether the paper's shares can be compared with these, and get a row
    """
    members: np.ndarray = np.asarray(groups)
    names = list(dict.fromkeys(groups))
    parts = [slice(start, start + AT_ONCE) for start in range(0, len(known), AT_ONCE)]
    counts = np.concatenate([_failures(failed[part], known[part]) for part in parts])
    rows = [_shares(name, counts[members == name], known.shape[1]) for name in names]
    if len(names) > 1:
        rows.append(_shares("overall", counts, known.shape[1]))
    if as_in_paper:
        shares = [f"{PAPER_SHARES[name]:.2%}" if name in PAPER_SHARES else None for name in (*events, ANY)]
        rows.append(["paper's test set", None, *shares, None, None])
    headers = ["", "maps", *events, ANY, "maps with none", "known"]
    return _table(rows, headers)


def _failures(failed: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Counts the known trajectories of each map, and those that fail by each event and by any: [n, k + 2]."""
    fails = np.asarray(failed) & np.asarray(known)[..., None]
    return np.column_stack([known.sum(axis=1), fails.sum(axis=1), fails.any(axis=-1).sum(axis=1)])


def _shares(name: str, counts: np.ndarray, trajectories: int) -> list:
    """Makes the table row of some maps from the counts of `_failures` [n, k + 2]."""
    known, *fails = counts.sum(axis=0)
    if not known:
        return [name, len(counts), *["-"] * counts.shape[1], "0.0%"]
    none = counts[counts[:, 0] > 0, -1] == 0
    return [
        name,
        str(len(counts)),
        *(f"{share / known:.2%}" for share in fails),
        f"{none.mean():.1%}",
        f"{known / (len(counts) * trajectories):.1%}",
    ]


def where_table(poses: np.ndarray, failed: np.ndarray, setup: Setup) -> str:
    """Tabulates, for each event, on which part of a trajectory its margin is reached where it fails.

    poses: [n, t, k] of events.Where; failed: [n, t, k], False where unknown
    """
    junction = len(setup.actions.first_stations())
    ends = {"point turn": -1, "first arc": junction - 1, "second arc": np.iinfo(np.int16).max}
    counts = np.zeros((len(ends), failed.shape[-1]), int)
    for start in range(0, len(failed), AT_ONCE):
        some = slice(start, start + AT_ONCE)
        part = np.searchsorted(list(ends.values()), np.asarray(poses[some]))
        counts += np.stack(
            [((part == which) & np.asarray(failed[some])).sum(axis=(0, 1)) for which in range(len(ends))]
        )
    totals = counts.sum(axis=0)
    rows = [
        [name, *(f"{count / total:.1%}" if total else "-" for count in of_event)]
        for name, of_event, total in zip(setup.robot.event_names, counts.T, totals, strict=True)
    ]
    return _table(rows, ["", *ends])


def rows_table(rows: Iterable[dict], columns: dict[str, str] | None = None) -> str:
    """Tabulates dicts; `columns` maps keys to headings, and keys head themselves without it.

    None is left blank, numbers have four significant digits.
    """
    rows = list(rows)
    columns = {key: key for key in rows[0]} if columns is None else columns
    cells = [[_cell(row[key]) for key in columns] for row in rows]
    return _table(cells, list(columns.values()))


def _cell(value) -> str:
    if value is None:
        return ""
    if isinstance(value, float) and value < 1e4:
        return f"{value:,.4g}"
    return f"{value:,.0f}" if isinstance(value, int | float) else str(value)


def metrics_table(evaluation: Evaluation, paper: Mapping[str, Confusion] | None = PAPER_SYNTHETIC) -> str:
    """Tabulates metrics and counts of each event and overall, the paper's below each; notes explain dashes."""
    rows, notes = [], []
    for name, scores in evaluation.scores.items():
        precision, error = scores.average_precision, evaluation.calibration[name].error
        rows.append([name, *_figures(scores.confusion), _share(precision), _share(error), *_counts(scores.confusion)])
        notes.append(_why_undefined(name, scores.confusion))
        if paper and name in paper:
            rows.append(["  paper", *_figures(paper[name]), "", "", *_counts(paper[name])])
            notes.append(_why_undefined(f"{name} in the paper", paper[name]))
    headers = ["", "accuracy", "recall", "precision", "F1", "failures", "AP", "ECE", "TN", "FP", "FN", "TP"]
    return with_notes(_table(rows, headers), notes)


def threshold_table(evaluation: Evaluation, paper: Mapping[str, Confusion] | None = PAPER_SYNTHETIC) -> str:
    """Tabulates the highest threshold for each recall, the metrics there, and the paper's precision at its recall."""
    rows, notes = [], []
    for name, points in evaluation.points.items():
        for point in points:
            found = point.confusion
            threshold, flagged = f"{point.threshold:.4g}", f"{(found.fp + found.tp) / found.samples:.2%}"
            figures = [threshold, _share(found.recall), _share(found.precision), _share(found.f1), flagged]
            beside = _share(paper[name].precision) if paper and name in paper and _is_of(paper[name], point) else ""
            rows.append([name, f"{point.wanted:.3f}", *(["-"] * 5 if math.isnan(point.threshold) else figures), beside])
        notes.append(_why_undefined(name, points[0].confusion))
    headers = ["", "wanted recall", "threshold", "recall", "precision", "F1", "predicted to fail", "paper's precision"]
    return with_notes(_table(rows, headers), notes)


def paper_table(evaluation: Evaluation, paper: Mapping[str, Confusion]) -> str:
    """Tabulates the precision at the paper's recall and the recall at the paper's precision, beside the paper's."""
    rows, notes = [], []
    for name, recall in evaluation.recall_at_paper_precision.items():
        counts = paper[name]
        at_its_recall = next(point.confusion for point in evaluation.points[name] if _is_of(counts, point))
        rows.append([name, *map(_share, (counts.recall, counts.precision, at_its_recall.precision, recall))])
        notes.append(_why_undefined(name, at_its_recall))
    headers = ["", "paper's recall", "paper's precision", "precision at its recall", "recall at its precision"]
    return with_notes(_table(rows, headers), notes)


def calibration_line(evaluation: Evaluation) -> str:
    """Compares mean probability with measured failure frequency in one line, and says which way they are off."""
    over = lambda bins, values: float(np.nansum(bins.count * values) / bins.count.sum())
    pairs = {
        name: (over(bins, bins.probability), over(bins, bins.observed)) for name, bins in evaluation.calibration.items()
    }
    means = [f"{name} {mean:.4f} ({frequency:.4f})" for name, (mean, frequency) in pairs.items()]
    mean, frequency = pairs[OVERALL]
    ratio = mean / frequency if frequency else math.inf
    verdict = "too high" if ratio > 1 + TOLERANCE else "too low" if ratio < 1 - TOLERANCE else "right"
    times = f"{ratio:.2f} times the frequency" if frequency else "no sample fails"
    return (
        f"Calibration, mean probability and in brackets the measured frequency of failures: {', '.join(means)}. "
        f"Overall the probabilities are {verdict} on average, {times}; reliability.png shows them by bin."
    )


def groups_table(evaluation: Evaluation) -> str:
    """Tabulates the samples of each group and, for each event, the share that fails, F1 and average precision."""
    rows = []
    undefined: dict[str, list[str]] = {name: [] for name in evaluation.scores if name != OVERALL}
    for group, scores in [*evaluation.groups.items(), ("all", evaluation.scores)]:
        group = one_line(group, QUOTED)
        failing = {event: scores[event].confusion.failures for event in undefined}
        f1 = [_share(one.confusion.f1) for one in scores.values()]
        precisions = [_share(one.average_precision) for one in scores.values()]
        for event, share in failing.items():
            undefined[event] += [] if share else [group]
        samples = next(iter(scores.values())).confusion.samples
        rows.append([group, f"{samples:,}", *(f"{share:.2%}" for share in failing.values()), *f1, *precisions])
    per_event = [
        *(f"{event} fails" for event in undefined),
        *(f"{what} {name}" for what in ("F1", "AP") for name in evaluation.scores),
    ]
    headers = [title.replace(" ", "\n") for title in ("", "samples", *per_event)]
    notes = [f"{event}: no sample fails in {', '.join(names)}" for event, names in undefined.items() if names]
    return with_notes(_table(rows, headers), notes)


def baselines_table(rows: Mapping[str, Mapping[str, float]]) -> str:
    """Tabulates average precision of named predictors, as in `Evaluation.average_precision`."""
    columns = list(next(iter(rows.values())))
    undefined = [name for name in columns if any(math.isnan(values[name]) for values in rows.values())]
    cells = [[predictor, *(_share(values[name]) for name in columns)] for predictor, values in rows.items()]
    notes = [f"{name}: no sample fails, so average precision is undefined" for name in undefined]
    return with_notes(_table(cells, ["average precision", *columns]), notes)


def _figures(counts: Confusion) -> list[str]:
    figures = (counts.accuracy, counts.recall, counts.precision, counts.f1)
    return [*(_share(figure) for figure in figures), f"{counts.failures:.2%}"]


def _counts(counts: Confusion) -> list[str]:
    return [f"{count:,}" for count in (counts.tn, counts.fp, counts.fn, counts.tp)]


def _share(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"


def _is_of(paper: Confusion, point: OperatingPoint) -> bool:
    return abs(paper.recall - point.wanted) < 0.0005


def _why_undefined(what: str, counts: Confusion) -> str:
    """Explains why some figures of a confusion are a dash; returns an empty text if none is."""
    if not counts.fn + counts.tp:
        return f"{what}: no sample fails, so the figures with a dash are undefined"
    if not counts.fp + counts.tp:
        return f"{what}: no sample is predicted to fail, so precision is undefined"
    return ""


def _table(rows: list[list[str]], headers: Sequence[str]) -> str:
    shown = [[one_line(cell, QUOTED) if isinstance(cell, str) else cell for cell in row] for row in rows]
    return tabulate(shown, headers, disable_numparse=True, stralign="right", colalign=("left",))


def with_notes(table: str, notes: Iterable[str]) -> str:
    """Adds notes, which explain dashes, below a table; empty notes are dropped."""
    return "\n".join([table, *(f"- {note}" for note in notes if note)])
