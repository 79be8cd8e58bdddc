"""Scores of the comparison: names of the methods, their results on each kind of ground, tables and figures."""

import math
from collections.abc import Mapping, Sequence
from itertools import cycle

import numpy as np
from matplotlib.figure import Figure

from travjax import progress
from travjax.data.sampling import Samples
from travjax.data.sensor_noise import CLEAN, CORRUPTIONS, FILTERS
from travjax.evaluation import metrics
from travjax.evaluation.metrics import OVERALL, THRESHOLD, Confusion
from travjax.evaluation.tables import rows_table
from travjax.experiments.robustness import (
    BenchmarkMaps,
    Progress,
    average_precisions,
    by_margins,
    of_samples,
    scores,
)
from travjax.models.hazard_field import LARGE_MARGIN
from travjax.runs.predictor import Predicted, Predictor

SIMULATOR, FILTERED = "simulator", "simulator, best filter"
HAZARD, MARGINS, NETWORK = "hazard field", "hazard field, margins", "ResNet50"
METHODS = (SIMULATOR, FILTERED, HAZARD, MARGINS, NETWORK)

ON_SITES = (*FILTERS, HAZARD, MARGINS)
"""Methods on real ground: the simulator after each filter, and the hazard field."""

IN_FIGURE = {
    "no filter": SIMULATOR,
    "median 3 x 3": "simulator after a median of 3 x 3",
    "Gaussian 1.25": "simulator after a Gaussian of 1.25 nodes",
    HAZARD: HAZARD,
}
"""Methods of ON_SITES that the figure of real ground shows, with their names in the legend."""

RECALL = 0.97
"""The recall for which a threshold is chosen on validation maps."""

SiteScores = dict[str, dict[str, dict[str, Confusion]]]
"""Confusions of one site: by corruption, method and event."""


def best_filters(validation: BenchmarkMaps, seed: int) -> dict[str, str]:
    """Returns for every corruption the filter that is best for the simulator on the validation maps."""
    with progress.bar("filters", len(CORRUPTIONS) * len(FILTERS), "filter") as bar:
        return {name: validation.best_filter(validation.seen(name, seed + 1), bar.update) for name in CORRUPTIONS}


def compare(
    test: BenchmarkMaps,
    validation: BenchmarkMaps,
    field: Predictor,
    resnet: Predictor | None,
    samples: int,
    chosen: Mapping[str, str],
    seed: int,
) -> dict:
    """Returns for every corruption its filter and the confusions and average precisions of every method."""
    results: dict[str, dict] = {}
    drawn, events = _drawn(test, samples, seed), test.setup.robot.event_names
    methods = 3 + (resnet is not None)
    with progress.bar("corruptions", len(CORRUPTIONS) * methods, "method") as bar:
        for name in CORRUPTIONS:
            seen = test.seen(name, seed)
            predicted = field.predict(seen)
            found = {
                SIMULATOR: (test.simulated(seen), test.failed),
                FILTERED: (test.simulated(FILTERS[chosen[name]](seen)), test.failed),
                HAZARD: (predicted.probability, test.failed),
                MARGINS: (by_margins(_margins(predicted.margins), test.setup.robot), test.failed),
            }
            bar.update(3)
            if resnet:
                found[NETWORK] = (of_samples(resnet, seen, drawn), test.failed[drawn])
                bar.update()
            by_method = {method: _scored(*pair, events) for method, pair in found.items()}
            results[name] = {"filter": chosen[name], "methods": by_method}
            if name == CLEAN:
                results[name] |= _on_clean_maps(test, validation, field, predicted)
    return results


def _margins(margins: np.ndarray | None) -> np.ndarray:
    assert margins is not None  # the hazard field has margins
    return margins


def _drawn(test: BenchmarkMaps, samples: int, seed: int) -> Samples:
    """Draws random trajectories of all maps, for methods that are too slow for all of them."""
    rng = np.random.default_rng(seed)
    maps, trajectories = test.failed.shape[:2]
    places = np.sort(rng.choice(maps * trajectories, min(samples, maps * trajectories), replace=False))
    return places // trajectories, places % trajectories


def _scored(fails: np.ndarray, failed: np.ndarray, events: Sequence[str]) -> dict:
    precisions = average_precisions(fails, failed, events)
    return {"confusion": scores(fails, failed, events=events), "average_precision": precisions}


def _on_clean_maps(test: BenchmarkMaps, validation: BenchmarkMaps, field: Predictor, predicted: Predicted) -> dict:
    """Returns the threshold for RECALL, chosen on validation maps, and the errors of the margins."""
    events = test.setup.robot.event_names
    probability = field.predict(validation.heights).probability
    threshold = metrics.threshold_for_recall(probability.ravel(), validation.failed.ravel(), RECALL)
    largest = LARGE_MARGIN * np.asarray(test.setup.robot.limits)
    off = np.minimum(_margins(predicted.margins), largest) - np.minimum(test.margins, largest)
    return {
        "threshold": threshold,
        "at_threshold": scores(predicted.probability, test.failed, threshold, events),
        "margin_errors": dict(zip(events, np.abs(off).mean(axis=(0, 1)).tolist(), strict=True)),
    }


def on_sites(real: Mapping[str, BenchmarkMaps], field: Predictor, seed: int) -> dict[str, SiteScores]:
    """Returns by site and corruption the confusions of the simulator with each filter, and of the hazard field."""
    with progress.bar("sites", len(real) * len(CORRUPTIONS) * len(ON_SITES), "method") as bar:
        return {site: _of_site(ground, field, seed, bar.update) for site, ground in real.items()}


def _of_site(ground: BenchmarkMaps, field: Predictor, seed: int, on_progress: Progress) -> SiteScores:
    found: SiteScores = {}
    for name in CORRUPTIONS:
        seen, by_method = ground.seen(name, seed), {}
        for smooth, of in FILTERS.items():
            by_method[smooth] = ground.scores(ground.simulated(of(seen)))
            on_progress(1)
        predicted = field.predict(seen)
        by_method[HAZARD] = ground.scores(predicted.probability)
        by_method[MARGINS] = ground.scores(by_margins(_margins(predicted.margins), ground.setup.robot))
        on_progress(2)
        found[name] = by_method
    return found


def f1_of(results: Mapping[str, dict]) -> dict[str, dict[str, float]]:
    """Returns F1 of every method in METHODS on every corruption, from the results of `compare`."""
    return {
        method: {name: one["methods"][method]["confusion"][OVERALL].f1 for name, one in results.items()}
        for method in METHODS
        if method in results[CLEAN]["methods"]
    }


def f1_of_site(site: SiteScores, chosen: Mapping[str, str]) -> dict[str, dict[str, float]]:
    """Returns F1 of the methods in ON_SITES and of FILTERED on every corruption; chosen: filter by corruption."""
    f1 = {method: {name: of[method][OVERALL].f1 for name, of in site.items()} for method in ON_SITES}
    return f1 | {FILTERED: {name: f1[smooth][name] for name, smooth in chosen.items()}}


def shown(value: float) -> str:
    """Formats a share with three digits, or as a dash where it is undefined."""
    return "-" if math.isnan(value) else f"{value:.3f}"


QUALITY = {"method": "clean maps", "event": "", "recall": "recall", "precision": "precision", "f1": "F1", "ap": "AP"}


def quality_table(clean: dict) -> str:
    """Returns a table of recall, precision, F1 and average precision of each method and event on the clean maps."""
    rows = []
    for method, scored in clean["methods"].items():
        if method == FILTERED:
            continue
        for number, (event, confusion) in enumerate(scored["confusion"].items()):
            rows.append(_quality("" if number else method, event, confusion, scored["average_precision"][event]))
    for number, (event, confusion) in enumerate(clean["at_threshold"].items()):
        name = "" if number else f"{HAZARD} at {clean['threshold']:.3f}"
        rows.append(_quality(name, event, confusion, math.nan))
    return rows_table(rows, QUALITY)


def _quality(method: str, event: str, confusion: Confusion, precision: float) -> dict:
    figures = {"recall": confusion.recall, "precision": confusion.precision, "f1": confusion.f1, "ap": precision}
    return {"method": method, "event": event} | {key: shown(value) for key, value in figures.items()}


def sites_table(sites: Mapping[str, SiteScores], chosen: Mapping[str, str]) -> str:
    """Returns a table of F1 on real ground, one row for each corruption and site; filters and the best method follow.

    sites: scores by name; chosen: filter of FILTERED by corruption
    """
    plain, *filters = FILTERS
    heads = {plain: SIMULATOR} | {name: name for name in (*filters, HAZARD, MARGINS)} | {FILTERED: "best filter"}
    columns = {"corruption": "F1", "site": "", "fails": "fails"}
    columns |= {method: head.replace(" ", "\n", 1) for method, head in heads.items()}
    f1 = {site: f1_of_site(of, chosen) for site, of in sites.items()}
    rows = []
    for name in CORRUPTIONS:
        for number, (site, of_site) in enumerate(sites.items()):
            row = {"corruption": "" if number else name, "site": site}
            row["fails"] = f"{of_site[name][HAZARD][OVERALL].failures:.2%}"
            rows.append(row | {method: shown(of[name]) for method, of in f1[site].items()})
    filters_chosen = "; ".join(f"{name}: {smooth}" for name, smooth in chosen.items())
    return f"{rows_table(rows, columns)}\n\nBest filter: {filters_chosen}.\n{_where_better(f1)}"


def _where_better(f1: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Says on how many sites the field is better than the simulator with the best filter; f1: by site and method."""
    counts = []
    for name in CORRUPTIONS:
        measured = [of for of in f1.values() if not math.isnan(of[HAZARD][name])]
        better = sum(of[HAZARD][name] > of[FILTERED][name] for of in measured)
        counts.append(f"{name}: {better} of {len(measured)}")
    return f"Sites on which the hazard field is above the simulator after the best filter: {'; '.join(counts)}."


def robustness_figure(f1: Mapping[str, Mapping[str, float]]) -> Figure:
    """Draws F1 of methods against the noise of the map, and on maps with other corruptions.

    f1: F1 by method and by name of a corruption: "none", "noise 2 cm", or another
    """
    figure = Figure(figsize=(12.5, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1, 1.3))
    names = list(next(iter(f1.values())))
    noisy = [name for name in names if name.startswith("noise")]
    others = [name for name in names if name not in noisy]
    noises = [0.0, *(float(name.split()[1]) for name in noisy)]
    width = 0.8 / len(f1)
    for number, (method, of) in enumerate(f1.items()):
        colour = f"C{number}"
        left.plot(noises, [of[others[0]], *(of[name] for name in noisy)], "o-", color=colour, label=method)
        places = np.arange(len(others)) + (number - (len(f1) - 1) / 2) * width
        bars = right.bar(places, [of[name] for name in others], width, color=colour)
        right.bar_label(bars, fmt="%.2f", fontsize=7, padding=1)
    left.set(xlabel="noise at each node [cm]", ylabel=f"F1 at {THRESHOLD:g}, events pooled", ylim=(0, 1.05))
    right.set_xticks(range(len(others)), [name if name != others[0] else "clean" for name in others])
    for ax in (left, right):
        ax.grid(alpha=0.3)
    left.legend(fontsize=9)
    return figure


OKABE_ITO = ("#000000", "#0072B2", "#E69F00", "#D55E00", "#009E73", "#CC79A7")
"""Colours that the colour-blind can tell apart (Okabe and Ito 2008)."""


def sites_figure(f1: Mapping[str, Mapping[str, Mapping[str, float]]], methods: Mapping[str, str]) -> Figure:
    """Draws F1 of methods on each site: against the noise of the map above, with other corruptions below.

    f1:      F1 by site, method and corruption: "none", "noise 2 cm", or another
    methods: methods to draw, with their names; each has its own colour, marker and line
    """
    names = list(next(iter(next(iter(f1.values())).values())))
    clean, noisy = names[0], [name for name in names if name.startswith("noise")]
    others = [name for name in names if name not in noisy]
    noises = [0.0, *(float(name.split()[1]) for name in noisy)]
    figure = Figure(figsize=(2.9 * len(f1) + 0.6, 6.2), layout="constrained")
    axes = figure.subplots(2, len(f1), sharey=True, squeeze=False)
    styles = list(zip(methods, OKABE_ITO, "osv^DP", cycle(("-", "--", "-.", ":")), strict=False))
    for (upper, lower), (site, of) in zip(axes.T, f1.items(), strict=True):
        for number, (method, colour, marker, line) in enumerate(styles):
            style = dict(color=colour, marker=marker, markersize=5)
            values = [of[method][name] for name in (clean, *noisy)]
            upper.plot(noises, values, linestyle=line, label=methods[method], **style)
            aside = np.arange(len(others)) + 0.16 * (number - (len(styles) - 1) / 2)
            lower.plot(aside, [of[method][name] for name in others], linestyle="none", **style)
        upper.set(title=site, xlabel="noise at each node [cm]", xlim=(-0.25, max(noises) + 0.25), ylim=(0, 1.05))
        lower.set(xlim=(-0.5, len(others) - 0.5))
        words = [name.replace(" missing", "\nmissing") if name != clean else "clean" for name in others]
        lower.set_xticks(range(len(others)), words)
        for ax in (upper, lower):
            ax.grid(alpha=0.3)
    for ax in axes[:, 0]:
        ax.set_ylabel(f"F1 at {THRESHOLD:g}, events pooled")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(styles), fontsize=9)
    return figure


def quality_figure(points: Mapping[str, tuple[float, float, float]]) -> Figure:
    """Draws F1 against the time for all trajectories of a map.

    points: by method (seconds a map, F1 on clean maps, F1 at the largest noise)
    """
    figure = Figure(figsize=(9, 5.6), layout="constrained")
    ax = figure.subplots()
    for number, (name, (seconds, clean, noisy)) in enumerate(points.items()):
        ax.plot([seconds, seconds], [clean, noisy], "-", color=f"C{number}", alpha=0.4)
        ax.plot(seconds, clean, "o", color=f"C{number}", label=f"{name}: {seconds:.3g} s")
        ax.plot(seconds, noisy, "v", color=f"C{number}")
    for marker, label in (("o", "clean map"), ("v", "at the largest noise, simulators after the best filter")):
        ax.plot([], [], marker, color="0.4", label=label)
    ax.set_xscale("log")
    ax.set(
        xlabel="s for all trajectories of a map",
        ylabel=f"F1 at {THRESHOLD:g}, events pooled",
        ylim=(0, 1.05),
    )
    ax.grid(alpha=0.3)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return figure
