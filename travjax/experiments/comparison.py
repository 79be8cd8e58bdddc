"""`python -m travjax.experiments.comparison`: simulators and estimators by quality, time and robustness.

On its own map the simulator is exact; on a noisy one it is not, and an estimator trained on such maps can be better.
The recorded run is under experiments/comparison.
"""

import argparse
import json
import math
import statistics
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from travjax import bench, curves, metrics, plots, progress
from travjax.config import require
from travjax.experiments import launch, timing
from travjax.files import output_folder, save_text, user_path
from travjax.metrics import NAMES, OVERALL
from travjax.models import FIELD, RESNET
from travjax.predictor import Predictor
from travjax.report import rows_table
from travjax.resnet import ResNetConfig
from travjax.robustness import CLEAN, CORRUPTIONS, FILTERS, Ground, average_precisions, by_margins, of_samples, scores
from travjax.sampling import Samples
from travjax.training_step import LARGE_MARGIN
from travjax.traverse import EVENTS

SIMULATOR, FILTERED = "simulator", "simulator, best filter"
HAZARD, MARGINS, NETWORK = "hazard field", "hazard field, margins", "ResNet50"
METHODS = (SIMULATOR, FILTERED, HAZARD, MARGINS, NETWORK)

SEED = 20_251_125
"""Of the test maps, the validation maps having the next one.

A data set draws its terrain seeds from its own seed and size together, so that maps of another seed or size are other
maps. Presets have seed 0: none of their maps is among these, nor is a test map among the validation maps.
"""

RECALL = 0.97
"""For which a threshold is chosen on validation maps."""

DESCRIPTION = (
    "Compares the simulators, the hazard field and a ResNet50: quality, time for all trajectories of a map, and F1 on "
    "maps with noise, missing nodes and at half the resolution."
)

MEANING = (
    "Labels are always those of the clean map, at natural frequency. Noise is Gaussian and independent at each node; "
    "missing nodes are drawn independently and get the height of the nearest known one, for every method; 0.125 m "
    "maps are every second node with the others interpolated. *Best filter* is the one of none, a 3 x 3 median and "
    "Gaussians of 0.5 to 2 nodes with the largest F1 on other maps with the same corruption. F1 at 0.5, the events "
    "pooled."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the experiment; returns the exit code, 2 for bad input."""
    parser = launch.parser("comparison", DESCRIPTION)
    parser.add_argument(
        "--field",
        type=user_path,
        metavar="C",
        help="folder of a run, or .safetensors file, of a hazard field (the package's)",
    )
    parser.add_argument("--resnet", type=user_path, metavar="RUN", help="folder of a ResNet50's run (left out)")
    parser.add_argument("--maps", type=int, default=200, metavar="N", help="test maps (200)")
    parser.add_argument(
        "--validation-maps", type=int, default=50, metavar="N", help="maps that filters are chosen on (50)"
    )
    parser.add_argument(
        "--samples",
        type=int,
        default=2000,
        metavar="N",
        help="random trajectories for the ResNet50 (2000)",
    )
    parser.add_argument(
        "--repeats", type=int, default=5, metavar="N", help="timed calls of which the median is taken (5)"
    )
    parser.add_argument(
        "--seed", type=int, default=SEED, metavar="N", help=f"of maps, corruptions and random trajectories ({SEED})"
    )
    parser.add_argument(
        "--out",
        type=user_path,
        default=Path("runs/comparison"),
        metavar="DIR",
        help="folder to write to (runs/comparison)",
    )
    return launch.launch(parser, run, argv)


def run(arguments: argparse.Namespace) -> None:
    """Measures, and writes tables, figures, JSON and the report."""
    for name in ("maps", "validation_maps", "samples", "repeats"):
        require(getattr(arguments, name) > 0, f"--{name.replace('_', '-')}", getattr(arguments, name), "at least 1")
    require(0 <= arguments.seed < 2**62, "--seed", arguments.seed, "a whole number from 0 to 2^62 - 1")
    field = _load("--field", arguments.field, FIELD)
    resnet = _load("--resnet", arguments.resnet, RESNET) if arguments.resnet else None
    trained = field.run
    if resnet:
        resnet.require_same(trained.robot, trained.actions, trained.grid)
    out = output_folder(arguments.out)
    counts = {"test": arguments.maps, "validation": arguments.validation_maps}
    grounds = {}
    for number, (what, count) in enumerate(counts.items()):
        with progress.bar(f"{what} maps", count, "map") as bar:
            named = (trained.robot, trained.actions, trained.grid)
            grounds[what] = Ground.synthetic(count, arguments.seed + number, *named, bar.update)
    results = compare(grounds["test"], grounds["validation"], field, resnet, arguments.samples, arguments.seed)
    rows = times(field, resnet, arguments.repeats)
    _write(results, rows, grounds, field, arguments, out)


def _load(option: str, source: Path | None, model: str) -> Predictor:
    predictor = Predictor.load(source)
    require(predictor.run.preset.model == model, option, str(source), f"an estimator that is a {model}")
    return predictor


def compare(
    test: Ground, validation: Ground, field: Predictor, resnet: Predictor | None, samples: int, seed: int = SEED
) -> dict:
    """For every corruption: the filter, and for every method its confusions and average precisions."""
    results: dict[str, dict] = {}
    chosen = _drawn(test, samples, seed)
    methods = 3 + len(FILTERS) + (resnet is not None)
    with progress.bar("corruptions", len(CORRUPTIONS) * methods, "method") as bar:
        for name in CORRUPTIONS:
            seen = test.seen(name, seed)
            best = validation.best_filter(validation.seen(name, seed + 1), bar.update)
            predicted = field.predict(seen)
            found = {
                SIMULATOR: (test.simulated(seen), test.failed),
                FILTERED: (test.simulated(FILTERS[best](seen)), test.failed),
                HAZARD: (predicted.probability, test.failed),
                MARGINS: (by_margins(_margins(predicted.margins), test.robot), test.failed),
            }
            bar.update(3)
            if resnet:
                found[NETWORK] = (of_samples(resnet, seen, chosen), test.failed[chosen])
                bar.update()
            results[name] = {"filter": best, "methods": {method: _scored(*pair) for method, pair in found.items()}}
            if name == CLEAN:
                results[name] |= _on_clean_maps(test, validation, field, predicted)
    return results


def _margins(margins: np.ndarray | None) -> np.ndarray:
    assert margins is not None  # the hazard field has them
    return margins


def _drawn(test: Ground, samples: int, seed: int) -> Samples:
    """Random trajectories of all maps, for what is too slow for all of them."""
    rng = np.random.default_rng(seed)
    maps, trajectories = test.failed.shape[:2]
    places = np.sort(rng.choice(maps * trajectories, min(samples, maps * trajectories), replace=False))
    return places // trajectories, places % trajectories


def _scored(fails: np.ndarray, failed: np.ndarray) -> dict:
    return {"confusion": scores(fails, failed), "average_precision": average_precisions(fails, failed)}


def _on_clean_maps(test: Ground, validation: Ground, field: Predictor, predicted) -> dict:
    """The threshold for RECALL, chosen on validation maps, and the errors of the margins [m, m, rad]."""
    probability = field.predict(validation.heights).probability
    threshold = metrics.threshold_for_recall(probability.ravel(), validation.failed.ravel(), RECALL)
    largest = LARGE_MARGIN * np.asarray(test.robot.limits)
    off = np.minimum(predicted.margins, largest) - np.minimum(test.margins, largest)
    return {
        "threshold": threshold,
        "at_threshold": scores(predicted.probability, test.failed, threshold),
        "margin_errors": dict(zip(EVENTS, np.abs(off).mean(axis=(0, 1)).tolist(), strict=True)),
    }


def times(field: Predictor, resnet: Predictor | None, repeats: int) -> list[dict]:
    """Rows of experiments/timing.py for the simulators and the ResNet50, and two for the hazard field."""
    trained = field.run
    trunk = resnet.run.preset.trunk if resnet else ResNetConfig()
    rows = timing.measured(trained.robot, trained.actions, trained.grid, trunk, 64, repeats)
    maps = Ground.synthetic(8, SEED, trained.robot, trained.actions, trained.grid).heights
    for count in (1, len(maps)):
        field.predict(maps[:count])
        taken = []
        for _ in range(4 * repeats):
            began = time.perf_counter()
            field.predict(maps[:count])
            taken.append((time.perf_counter() - began) / count)
        what = f"{HAZARD}, {count} map{'s at once' if count > 1 else ''}"
        seconds = statistics.median(taken)
        row = rows[1] | {"what": what, "seconds": seconds, "repeats": len(taken)}
        rows.append(
            row | {"trajectories_per_s": len(trained.actions) / seconds, "speed_up": rows[0]["seconds"] / seconds}
        )
    return rows


QUALITY = {"method": "clean maps", "event": "", "recall": "recall", "precision": "precision", "f1": "F1", "ap": "AP"}


def _quality_rows(clean: dict) -> list[dict]:
    rows = []
    for method, scored in clean["methods"].items():
        if method == FILTERED:
            continue
        for event in NAMES:
            confusion, precision = scored["confusion"][event], scored["average_precision"][event]
            rows.append(_quality(method if event == NAMES[0] else "", event, confusion, precision))
    for event in NAMES:
        name = f"{HAZARD} at {clean['threshold']:.3f}" if event == NAMES[0] else ""
        rows.append(_quality(name, event, clean["at_threshold"][event], math.nan))
    return rows


def _quality(method: str, event: str, confusion: metrics.Confusion, precision: float) -> dict:
    figures = {"recall": confusion.recall, "precision": confusion.precision, "f1": confusion.f1, "ap": precision}
    return {"method": method, "event": event} | {key: _shown(value) for key, value in figures.items()}


def _shown(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"


def _f1(results: Mapping[str, dict]) -> dict[str, dict[str, float]]:
    """Of every method on every corruption."""
    return {
        method: {name: one["methods"][method]["confusion"][OVERALL].f1 for name, one in results.items()}
        for method in METHODS
        if method in results[CLEAN]["methods"]
    }


def _write(
    results: dict,
    rows: list[dict],
    grounds: Mapping[str, Ground],
    field: Predictor,
    arguments: argparse.Namespace,
    out: Path,
) -> None:
    """Prints the tables, and writes them with figures and JSON."""
    f1, clean = _f1(results), results[CLEAN]
    columns = {"method": "F1", **{name: name for name in results}}
    noisy = [{"method": method} | {name: _shown(value) for name, value in of.items()} for method, of in f1.items()]
    noisy.append({"method": "the best filter"} | {name: one["filter"] for name, one in results.items()})
    errors = clean["margin_errors"]
    margins = (
        f"Mean absolute error of the margins, those above {LARGE_MARGIN:g} limits counted as that: step "
        f"{errors['step']:.4f} m, obstacle {errors['obstacle']:.4f} m, tilt {math.degrees(errors['tilt']):.2f} degrees."
    )
    tables = {
        "Quality": rows_table(_quality_rows(clean), QUALITY) + f"\n\n{margins}",
        "Maps as sensors see them": rows_table(noisy, columns),
        "Time": rows_table(rows, timing.COLUMNS),
    }
    headline = (
        f"{field.run.robot.name}, {len(grounds['test'].heights)} test maps and {len(grounds['validation'].heights)} "
        f"validation maps that no preset trains on, {len(field.run.actions)} trajectories each, seed {arguments.seed}; "
        f"{bench.machine()}."
    )
    network = clean["methods"].get(NETWORK)
    if network:
        drawn = network["confusion"][OVERALL].samples // len(EVENTS)
        headline += f" The {NETWORK}'s scores are of {drawn:,} random trajectories, the others' of all."
    for title, table in tables.items():
        print(f"\n{title}\n{table}")
    print()
    text = json.dumps({"maps": metrics.to_json(results), "times": metrics.to_json(rows)}, indent=1, allow_nan=False)
    save_text(out / "results.json", text + "\n")
    lines = ["\t".join(columns.values()), *("\t".join(str(row[key]) for key in columns) for row in noisy)]
    save_text(out / "f1.tsv", "\n".join(lines) + "\n")
    figures = [plots.save(curves.robustness_figure(f1), out / "robustness.png")]
    seconds = {row["what"]: row["seconds"] for row in rows}
    figures.append(plots.save(curves.quality_figure(_points(f1, seconds)), out / "quality.png"))
    pieces: list[launch.Piece] = [headline, MEANING]
    pieces += [f"## {title}\n\n{launch.verbatim(table)}" for title, table in tables.items()]
    report = launch.write_report(out, "Simulators and estimators", [*pieces, *figures])
    print(report, out / "results.json", out / "f1.tsv", *figures, sep="\n")


def _points(
    f1: Mapping[str, Mapping[str, float]], seconds: Mapping[str, float]
) -> dict[str, tuple[float, float, float]]:
    """(seconds a map, F1 on clean maps, F1 at the largest noise) of each way.

    The simulators are drawn with the best filter, the time of which is left out: without one they would look worse on
    the noisy map than they have to be.
    """
    noisiest = [name for name in CORRUPTIONS if name.startswith("noise")][-1]
    points = {}
    for what, taken in seconds.items():
        starts = {timing.NETWORK: NETWORK, HAZARD: HAZARD}
        method = next((method for start, method in starts.items() if what.startswith(start)), FILTERED)
        if method in f1:
            points[what] = (taken, f1[method][CLEAN], f1[method][noisiest])
    return points


if __name__ == "__main__":
    raise SystemExit(main())
