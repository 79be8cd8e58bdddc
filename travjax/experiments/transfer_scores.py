"""Scores of the transfer experiment for every arm, seed, epoch and held-out site, in tables, JSON and a figure.

Everything is computed from the confusions that training wrote to metrics.jsonl, at a threshold of 0.5. Numbers of
several seeds are given as mean ± standard deviation.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from matplotlib.figure import Figure

from travjax.config import one_line, require
from travjax.evaluation.metrics import NAMES, OVERALL, PAPER_REAL, THRESHOLD, Confusion, json_ready
from travjax.evaluation.tables import rows_table, with_notes

ALL = "all held-out"
"""Name of the held-out sites together, whose confusions are added."""

PAPER_BEST = {
    "random": None,
    "ImageNet": {"recall": 0.54, "precision": 0.14, "f1": 0.21},
    "ImageNet + synthetic": {"recall": 0.76, "precision": 0.31, "f1": 0.46},
}
"""The paper's best epoch of each arm on its own site, where 0.2 % of the trajectories fail (SPEC section 10)."""

COUNTS = ("tn", "fp", "fn", "tp")

Confusions = dict[str, dict[str, Confusion]]
"""Confusions by site, including ALL, and by event, including "overall"."""


@dataclass(frozen=True)
class Epoch:
    """One row of a run: number 0 is the first state, before any training.

    validation: average precision of the events pooled on the validation windows; None for the first state
    held_out:   confusions on each held-out site and on ALL
    """

    number: int
    validation: float | None
    held_out: Confusions

    @staticmethod
    def from_row(row: Mapping) -> "Epoch":
        """Reads a row of metrics.jsonl with the scores of `eval_sets`; raises InputError for another row."""
        allowed = "counts of every event on each held-out site; remove the run's folder to train it anew"
        require(_is_scored(row), "row of metrics.jsonl", row, allowed)
        sites = {
            site: {name: Confusion(*(one["confusion"][count] for count in COUNTS)) for name, one in scores.items()}
            for site, scores in row["eval_sets"].items()
        }
        if len(sites) > 1:
            first = next(iter(sites.values()))
            sites[ALL] = {name: sum((one[name] for one in sites.values()), Confusion(0, 0, 0, 0)) for name in first}
        precision = row.get("average_precision")
        return Epoch(row["epoch"], precision and precision[OVERALL], sites)


def _is_scored(row: Mapping) -> bool:
    """Tells whether a row holds counts of every event on each site, and a valid validation score if it has one."""
    at = lambda table, key: table.get(key) if isinstance(table, Mapping) else None
    sites, precision = row.get("eval_sets"), row.get("average_precision")
    if not isinstance(sites, Mapping) or type(row.get("epoch")) is not int:
        return False
    names = dict.fromkeys((*NAMES, *(name for site in sites.values() if isinstance(site, Mapping) for name in site)))
    counts = [
        at(at(at(site, name), "confusion"), count) for site in sites.values() for name in names for count in COUNTS
    ]
    overall = at(precision, OVERALL) if isinstance(precision, Mapping) and OVERALL in precision else "none"
    validated = precision is None or type(overall) in (int, float, type(None))
    return validated and all(type(count) is int and count >= 0 for count in counts)


@dataclass(frozen=True)
class ArmRun:
    """The epochs of one arm and seed, the first state first."""

    epochs: tuple[Epoch, ...]

    def best(self, site: str) -> Epoch:
        """Returns the epoch with the largest pooled F1 on a held-out site: the paper's choice, which uses test data."""
        return max(self.epochs[1:], key=lambda epoch: _or_zero(epoch.held_out[site][OVERALL].f1))

    @property
    def chosen(self) -> Epoch:
        """The epoch with the best average precision on validation windows, whose checkpoint is the run's best."""
        return max(self.epochs[1:], key=lambda epoch: _or_zero(epoch.validation))


def always_fails(counts: Confusion) -> Confusion:
    """Returns the counts, on the same samples, of the predictor that says "fails" for every trajectory."""
    return Confusion(0, counts.tn + counts.fp, 0, counts.fn + counts.tp)


def _or_zero(value: float | None) -> float:
    return 0.0 if value is None or math.isnan(value) else value


@dataclass(frozen=True)
class Results:
    """All runs by arm and seed."""

    arms: dict[str, dict[int, ArmRun]]

    @staticmethod
    def from_rows(rows: Mapping[str, Mapping[int, Sequence[Mapping]]]) -> "Results":
        """Reads the rows of every arm and seed."""
        run = lambda part: ArmRun(tuple(Epoch.from_row(row) for row in part))
        return Results({arm: {seed: run(part) for seed, part in seeds.items()} for arm, seeds in rows.items()})

    @cached_property
    def _some(self) -> Confusions:
        """The confusions of any one run: how many samples fail is the same in all."""
        return next(iter(next(iter(self.arms.values())).values())).epochs[0].held_out

    @property
    def seeds(self) -> int:
        """The number of seeds of each arm."""
        return len(next(iter(self.arms.values())))

    @property
    def sites(self) -> list[str]:
        """The held-out sites, and ALL if there are several."""
        return list(self._some)

    @property
    def events(self) -> list[str]:
        """The robot's events, and "overall"."""
        return list(next(iter(self._some.values())))

    def always(self, site: str, event: str = OVERALL) -> Confusion:
        """Returns the counts of the predictor that says "fails" for every trajectory."""
        return always_fails(self._some[site][event])

    def f1(self, arm: str, site: str) -> np.ndarray:
        """Returns pooled F1 of each seed and epoch: [seeds, epochs + 1]."""
        runs = self.arms[arm].values()
        return np.array([[epoch.held_out[site][OVERALL].f1 for epoch in run.epochs] for run in runs])

    def best(self, arm: str, site: str) -> list[Epoch]:
        """Returns the best epoch of each seed on a held-out site."""
        return [run.best(site) for run in self.arms[arm].values()]

    def chosen(self, arm: str) -> list[Epoch]:
        """Returns the epoch of each seed that is best on the validation windows."""
        return [run.chosen for run in self.arms[arm].values()]

    def first(self, arm: str) -> list[Epoch]:
        """Returns the first state of each seed."""
        return [run.epochs[0] for run in self.arms[arm].values()]


ARM_COLUMNS = {
    "site": "held-out site",
    "arm": "first weights",
    "epoch": "best\nepoch",
    "f1": "F1",
    "recall": "recall",
    "precision": "precision",
    "way": "of the way\nto 1",
    "chosen": "validation's\nepoch",
    "chosen_f1": "its F1",
    "chosen_recall": "its recall",
    "chosen_precision": "its precision",
}


def arms_table(results: Results) -> str:
    """Returns a table with, for each site, the predictor "always fails", each arm at its two epochs, and the paper."""
    rows: list[dict] = []
    for site in results.sites:
        always = results.always(site)
        rows.append(dict.fromkeys(ARM_COLUMNS) | {"site": site, "arm": "always fails", **_figures([always])})
        for arm in results.arms:
            best, chosen = results.best(arm, site), results.chosen(arm)
            at_best, at_chosen = ([epoch.held_out[site][OVERALL] for epoch in epochs] for epochs in (best, chosen))
            way = [(one.f1 - always.f1) / (1 - always.f1) for one in at_best]
            rows.append(
                {"site": "", "arm": arm, "epoch": _numbers(best), **_figures(at_best), "way": mean_and_spread(way)}
                | {"chosen": _numbers(chosen)}
                | {f"chosen_{name}": value for name, value in _figures(at_chosen).items()}
            )
    for arm, figures in PAPER_BEST.items():
        shown = {name: f"{value:.2f}" for name, value in figures.items()} if figures else {"f1": "near 0"}
        site = "paper: its own" if arm == next(iter(PAPER_BEST)) else ""
        rows.append(dict.fromkeys(ARM_COLUMNS) | {"site": site, "arm": arm} | shown)
    return with_notes(rows_table(rows, ARM_COLUMNS), _undefined(results, rows))


EVENT_COLUMNS = {
    "site": "held-out site",
    "event": "event",
    "failures": "fails",
    "state": "model",
    "accuracy": "accuracy",
    "recall": "recall",
    "precision": "precision",
    "f1": "F1",
    "always": "F1 of\nalways fails",
}


def events_table(results: Results, arm: str) -> str:
    """Returns a table with, for each site and event, an arm untrained, at its two epochs, and in the paper."""
    rows = []
    for site in results.sites:
        states = {"untrained": results.first(arm), "best epoch": results.best(arm, site)}
        states["validation's epoch"] = results.chosen(arm)
        for event in results.events:
            always = results.always(site, event)
            for state, epochs in states.items():
                counts = [epoch.held_out[site][event] for epoch in epochs]
                first = state == "untrained"
                place = {
                    "site": site if first and event == results.events[0] else "",
                    "event": event if first else "",
                    "failures": f"{always.failures:.2%}" if first else "",
                    "always": mean_and_spread([always.f1]) if first else "",
                }
                rows.append(place | {"state": state} | _figures(counts, ("accuracy", "recall", "precision", "f1")))
    notes = _undefined(results, rows)
    for event, paper in PAPER_REAL.items():
        place = {"site": "paper: its own" if event == NAMES[0] else "", "event": event, "state": "paper, transferred"}
        place |= {"failures": f"{paper.failures:.2%}", "always": mean_and_spread([always_fails(paper).f1])}
        rows.append(place | _figures([paper], ("accuracy", "recall", "precision", "f1")))
    notes = [*notes, "tilt in the paper: no sample fails, so its figures are undefined"]
    return with_notes(rows_table(rows, EVENT_COLUMNS), notes)


def _figures(counts: Iterable[Confusion], names: Sequence[str] = ("f1", "recall", "precision")) -> dict[str, str]:
    counts = list(counts)
    return {name: mean_and_spread([getattr(one, name) for one in counts]) for name in names}


def _numbers(epochs: Iterable[Epoch]) -> str:
    return ", ".join(str(epoch.number) for epoch in epochs)


def mean_and_spread(values: Sequence[float]) -> str:
    """Formats mean and standard deviation over the seeds, or a dash where a value is undefined."""
    if any(math.isnan(value) for value in values):
        return "-"
    spread = f" ± {np.std(values, ddof=1):.3f}" if len(values) > 1 and np.ptp(values) > 0 else ""
    return f"{np.mean(values):.3f}{spread}"


def _undefined(results: Results, rows: Iterable[Mapping]) -> list[str]:
    """Explains why some events and sites have a dash in the rows of a table."""
    none = [
        f"{event} on {site}: no trajectory fails, so recall, precision and F1 are undefined"
        for site in results.sites
        for event in results.events
        if not results.always(site, event).tp
    ]
    dashes = any(row.get(name) == "-" for row in rows for name in ("precision", "chosen_precision"))
    return none + ["a dash under precision: in some seed nothing is predicted to fail"] * dashes


def results_json(results: Results) -> dict:
    """Returns everything, for results.json."""

    def run(one: ArmRun) -> dict:
        best = {site: one.best(site).number for site in results.sites}
        return {"best_epoch": best, "validation_epoch": one.chosen.number, "epochs": json_ready(one.epochs)}

    arms = {arm: {str(seed): run(one) for seed, one in seeds.items()} for arm, seeds in results.arms.items()}
    always = {site: {event: results.always(site, event) for event in results.events} for site in results.sites}
    return {"arms": arms, "always_fails": json_ready(always)}


def transfer_figure(results: Results, arms: Mapping[str, str], maps: str = "real maps") -> Figure:
    """Draws F1 of every arm after each epoch on each held-out site: the mean of the seeds and their range.

    arms: colours by arm; maps: name of the maps that they are trained on
    Epoch 0 is the first state; the dashed line is the predictor that always says "fails".
    """
    figure = Figure(figsize=(4.6 * len(results.sites) + 0.6, 4.6), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(results.sites), sharey=True))
    for ax, site in zip(axes, results.sites, strict=True):
        for arm in results.arms:
            colour = arms[arm]
            f1 = np.nan_to_num(results.f1(arm, site))
            epochs = np.arange(f1.shape[1])
            ax.fill_between(epochs, f1.min(axis=0), f1.max(axis=0), color=colour, alpha=0.2, linewidth=0)
            ax.plot(epochs, f1.mean(axis=0), "o-", color=colour, markersize=4, label=arm)
        always = results.always(site)
        ax.axhline(always.f1, color="0.4", linestyle="--", linewidth=1, label="always fails")
        ax.set_title(f"{one_line(site, 40)}: {always.failures:.2%} of {always.samples:,} fail", fontsize=10)
        ax.set(xlabel=f"epoch on {maps}", xticks=epochs, xlim=(-0.2, None), ylim=(0, 1))
        ax.grid(alpha=0.3)
    axes[0].set_ylabel(f"F1 at {THRESHOLD:g}, events pooled")
    axes[0].legend(fontsize=9)
    return figure
