"""`python -m travjax.experiments.comparison`: simulators and estimators by quality, time and robustness.

On its own map the simulator is exact; on a noisy one it is not, and an estimator trained on such maps can be better.
Whether it is depends on the ground: synthetic maps and each real site have rows of their own. The recorded runs are
under experiments/comparison.
"""

import argparse
import json
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from travjax import progress
from travjax.config import InputError, require, to_json
from travjax.data.provenance import SitesConfig
from travjax.data.sensor_noise import CLEAN, CORRUPTIONS
from travjax.estimators.names import FIELD, RESNET
from travjax.evaluation import map_figures, metrics, simulator_benchmark
from travjax.evaluation.metrics import OVERALL
from travjax.evaluation.tables import rows_table
from travjax.experiments import launch, timing
from travjax.experiments.robustness import BenchmarkMaps, of_sites
from travjax.experiments.robustness_scores import (
    FILTERED,
    HAZARD,
    IN_FIGURE,
    NETWORK,
    SiteScores,
    best_filters,
    compare,
    f1_of,
    f1_of_site,
    on_sites,
    quality_figure,
    quality_table,
    robustness_figure,
    shown,
    sites_figure,
    sites_table,
)
from travjax.files import find_data, find_preset, output_folder, save_text, user_path
from travjax.models.hazard_field import LARGE_MARGIN
from travjax.resnet.network import ResNetConfig
from travjax.runs.predictor import Predictor

SYNTHETIC, REAL, BOTH = GROUNDS = ("synthetic", "real", "both")

SITES = "real"
"""Name of the preset of real ground that is used unless another is given."""

SEED = 20_251_125
"""The seed of the test maps; the validation maps have the next one.

A data set draws its terrain seeds from its own seed and size together, so another seed or size gives different maps.
Presets have seed 0, so training maps, validation maps and test maps are all different.
"""

DESCRIPTION = (
    "Compares the simulators, the hazard field and a ResNet50: quality, time for all trajectories of a map, and F1 on "
    "maps with noise, missing nodes and at half the resolution, of synthetic ground and of real sites."
)

MEANING = (
    "Labels are always those of the clean map, at natural frequency. Noise is Gaussian and independent at each node; "
    "missing nodes are drawn independently and get the height of the nearest known one, for every method; 0.125 m "
    "maps are every second node with the others interpolated. *Best filter* is the one of none, a 3 x 3 median and "
    "Gaussians of 0.5 to 2 nodes with the largest F1 on other maps with the same corruption. F1 at 0.5, the events "
    "pooled."
)

MEANING_REAL = (
    "In the table of real ground a row is a site, and its clean map is the site's own as it was read, whatever noise "
    "is in that already. Nodes that are unknown there have the height of the nearest known one, for every method, and "
    "trajectories that touch them do not count. Gaussians are given in nodes."
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
    parser.add_argument(
        "--ground", choices=GROUNDS, default=BOTH, help=f"what is compared on; times with {SYNTHETIC} ground ({BOTH})"
    )
    parser.add_argument("--maps", type=int, default=200, metavar="N", help="synthetic test maps (200)")
    parser.add_argument(
        "--validation-maps", type=int, default=50, metavar="N", help="synthetic maps that filters are chosen on (50)"
    )
    parser.add_argument(
        "--sites",
        metavar="SITES",
        help=f"the real sites, whose splits play no part: a name or a .toml file ({SITES}, where its files are found)",
    )
    parser.add_argument("--windows", type=int, default=100, metavar="N", help="windows of a site, at most (100)")
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
    for name in ("maps", "validation_maps", "windows", "samples", "repeats"):
        require(getattr(arguments, name) > 0, f"--{name.replace('_', '-')}", getattr(arguments, name), "at least 1")
    require(0 <= arguments.seed < 2**62, "--seed", arguments.seed, "a whole number from 0 to 2^62 - 1")
    wanted = arguments.ground
    require(wanted != REAL or not arguments.resnet, "--resnet", str(arguments.resnet), f"left out on {REAL} ground")
    require(wanted != SYNTHETIC or not arguments.sites, "--sites", str(arguments.sites), "left out on synthetic ground")
    field = _load("--field", arguments.field, FIELD)
    resnet = _load("--resnet", arguments.resnet, RESNET) if arguments.resnet else None
    trained = field.run
    if resnet:
        resnet.require_trained_for(trained.robot, trained.actions, trained.grid)
    sites = _sites(arguments.sites, wanted)
    out = output_folder(arguments.out)
    seed = arguments.seed
    real, parts = {}, []
    if sites:
        with progress.bar("windows of sites", None, "window") as bar:
            real = of_sites(sites, arguments.windows, seed, trained.setup, bar.update)
    validation = _synthetic("validation", arguments.validation_maps, seed + 1, field)
    chosen = best_filters(validation, seed)
    if wanted != REAL:
        test = _synthetic("test", arguments.maps, seed, field)
        results = compare(test, validation, field, resnet, arguments.samples, chosen, seed)
        rows = times(field, resnet, arguments.repeats)
        parts.append(_on_synthetic_ground(results, rows, field, arguments, out))
    if sites:
        parts.append(_on_real_ground(on_sites(real, field, seed), real, chosen, sites, field, arguments, out))
    _write(parts, out)


def _load(option: str, source: Path | None, model: str) -> Predictor:
    predictor = Predictor.load(source)
    require(predictor.run.preset.model == model, option, str(source), f"an estimator that is a {model}")
    return predictor


def _sites(given: str | None, ground: str) -> SitesConfig | None:
    """Returns the sites to compare on, or prints in a line why they are not available and returns None."""
    if ground == SYNTHETIC:
        return None
    try:
        sites = SitesConfig.load(find_preset(given or SITES, "sites"))
        for site in sites.site:
            find_data(site.file, f"site {site.group}: file")
    except InputError as error:
        if given or ground == REAL:
            raise
        print(f"Synthetic ground alone: {error}")
        return None
    return sites


def _synthetic(what: str, count: int, seed: int, field: Predictor) -> BenchmarkMaps:
    with progress.bar(f"{what} maps", count, "map") as bar:
        return BenchmarkMaps.synthetic(count, seed, field.run.setup, bar.update)


def times(field: Predictor, resnet: Predictor | None, repeats: int) -> list[dict]:
    """Returns rows of experiments/timing.py for the simulators and the ResNet50, and two for the hazard field."""
    trained = field.run
    trunk = resnet.run.preset.trunk if resnet else ResNetConfig()
    rows = timing.measured(trained.setup, trunk, 64, repeats)
    maps = BenchmarkMaps.synthetic(8, SEED, trained.setup).heights
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


@dataclass(frozen=True)
class Part:
    """The part of the results on one kind of ground.

    text:    paragraphs of the report
    tables:  tables by title
    numbers: values for results.json
    files:   files that were written, including figures
    """

    text: list[str]
    tables: dict[str, str]
    numbers: dict[str, Any]
    files: list[Path]


def _on_synthetic_ground(
    results: dict, rows: list[dict], field: Predictor, arguments: argparse.Namespace, out: Path
) -> Part:
    f1, clean = f1_of(results), results[CLEAN]
    columns = {"method": "F1", **{name: name for name in results}}
    noisy = [{"method": method} | {name: shown(value) for name, value in of.items()} for method, of in f1.items()]
    noisy.append({"method": "the best filter"} | {name: one["filter"] for name, one in results.items()})
    errors = clean["margin_errors"]
    each = ", ".join(f"{event.name} {event.shown(errors[event.name])}" for event in field.run.robot.events)
    margins = f"Mean absolute error of the margins, those above {LARGE_MARGIN:g} limits counted as that: {each}."
    headline = (
        f"{field.run.robot.name}, {arguments.maps} test maps and {arguments.validation_maps} "
        f"validation maps that no preset trains on, {len(field.run.actions)} trajectories each, seed {arguments.seed}; "
        f"{simulator_benchmark.machine()}."
    )
    network = clean["methods"].get(NETWORK)
    if network:
        drawn = network["confusion"][OVERALL].samples // len(field.run.robot.events)
        headline += f" The {NETWORK}'s scores are of {drawn:,} random trajectories, the others' of all."
    lines = ["\t".join(columns.values()), *("\t".join(str(row[key]) for key in columns) for row in noisy)]
    save_text(out / "f1.tsv", "\n".join(lines) + "\n")
    seconds = {row["what"]: row["seconds"] for row in rows}
    figures = {
        "robustness": robustness_figure(f1),
        "quality": quality_figure(_points(f1, seconds)),
    }
    tables = {
        "Quality": f"{quality_table(clean)}\n\n{margins}",
        "Maps as sensors see them": rows_table(noisy, columns),
        "Time": rows_table(rows, timing.COLUMNS),
    }
    numbers = {"maps": metrics.json_ready(results), "times": metrics.json_ready(rows)}
    files = [map_figures.save(figure, out / f"{name}.png") for name, figure in figures.items()]
    return Part([headline, MEANING], tables, numbers, [out / "f1.tsv", *files])


def _on_real_ground(
    scores: Mapping[str, SiteScores],
    real: Mapping[str, BenchmarkMaps],
    chosen: Mapping[str, str],
    config: SitesConfig,
    field: Predictor,
    arguments: argparse.Namespace,
    out: Path,
) -> Part:
    windows = ", ".join(f"{len(ground.heights)} of {site}" for site, ground in real.items())
    size = field.run.grid.size
    headline = (
        f"{field.run.robot.name}, windows of {size:g} x {size:g} m, at most {config.max_unknown:.0%} of each unknown: "
        f"{windows}; {len(field.run.actions)} trajectories each. Filters are chosen on {arguments.validation_maps} "
        f"synthetic maps. Seed {arguments.seed}."
    )
    table = sites_table(scores, chosen)
    save_text(out / "sites.txt", f"{headline}\n\n{table}\n")
    f1 = {site: f1_of_site(of, chosen) for site, of in scores.items()}
    figure = map_figures.save(sites_figure(f1, IN_FIGURE), out / "sites.png")
    numbers = {
        "sites": to_json(config),
        "windows": {site: len(ground.heights) for site, ground in real.items()},
        "filters": dict(chosen),
        "real": metrics.json_ready(scores),
    }
    return Part([headline, MEANING, MEANING_REAL], {"Real ground": table}, numbers, [out / "sites.txt", figure])


def _write(parts: Sequence[Part], out: Path) -> None:
    """Prints the tables, and writes the report and all numbers as JSON."""
    pieces: list[launch.Piece] = []
    for part in parts:
        for title, table in part.tables.items():
            print(f"\n{title}\n{table}")
        pieces += [text for text in part.text if text not in pieces]
        pieces += [f"## {title}\n\n{launch.verbatim(table)}" for title, table in part.tables.items()]
        pieces += [path for path in part.files if path.suffix == ".png"]
    print()
    numbers = {name: value for part in parts for name, value in part.numbers.items()}
    save_text(out / "results.json", json.dumps(numbers, indent=1, allow_nan=False) + "\n")
    report = launch.write_report(out, "Simulators and estimators", pieces)
    progress.wrote(report, out / "results.json", *(path for part in parts for path in part.files))


def _points(
    f1: Mapping[str, Mapping[str, float]], seconds: Mapping[str, float]
) -> dict[str, tuple[float, float, float]]:
    """Returns (seconds a map, F1 on clean maps, F1 at the largest noise) of each method.

    The simulators are drawn with the best filter, whose time is not counted: without a filter they would look worse on
    the noisy map than they need to be.
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
