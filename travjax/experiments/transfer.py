"""`python -m travjax.experiments.transfer`: what pre-training on synthetic maps is worth on real ones.

Trains every arm of transfer_runs.py and writes tables, figures, a report and all numbers as JSON. The recorded run is
under experiments/transfer.
"""

import argparse
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from travjax import options, progress
from travjax.config import InputError, from_json, load_toml, read_json, read_text, require, to_json
from travjax.data import dataset
from travjax.data.build import build_from_sites
from travjax.data.dataset import Dataset
from travjax.data.provenance import SitesConfig
from travjax.devices import Devices
from travjax.estimators.names import ESTIMATORS, FIELD, RESNET
from travjax.estimators.preset import Preset
from travjax.estimators.trajectory_samples import TrajectorySamples
from travjax.evaluation import map_figures
from travjax.evaluation.dataset_tables import statistics_table
from travjax.evaluation.simulator_benchmark import machine
from travjax.experiments import launch
from travjax.experiments.stand_ins import StandIns, chosen_stand_ins
from travjax.experiments.transfer_runs import IMAGENET, Transfer, TransferConfig, run_all
from travjax.experiments.transfer_scores import Results, arms_table, events_table, results_json, transfer_figure
from travjax.files import find_preset, held, put_back, save_text, user_path
from travjax.runs.evaluator import Evaluator
from travjax.runs.run import DATA, Run
from travjax.signals import going_on
from travjax.training.evaluation_report import evaluate_run
from travjax.training.fit import fit
from travjax.traversal.traverse import unpacked

DESCRIPTION = (
    "Trains on real maps from random weights, from ImageNet, and from ImageNet and synthetic maps, and scores every "
    "epoch on held-out sites: the second half of the paper. A run that was interrupted goes on."
)

COLOURS = {"random": "tab:gray", "ImageNet": "tab:blue", "ImageNet + synthetic": "tab:red", "synthetic": "tab:red"}


def add(parser: argparse.ArgumentParser) -> None:
    """Adds the options."""
    parser.add_argument(
        "preset",
        nargs="?",
        default="laptop",
        metavar="PRESET",
        help="smoke, laptop or paper, or a .toml file (laptop)",
    )
    parser.add_argument(
        "--model",
        choices=ESTIMATORS,
        default=RESNET,
        help=f"{FIELD} takes the preset PRESET_field ({RESNET})",
    )
    parser.add_argument(
        "--data", type=user_path, metavar="DIR", help="data set of real maps, instead of that of the sites"
    )
    parser.add_argument(
        "--stand-ins",
        action="store_true",
        help="built-in sites instead of real maps; the default where no file of the sites is found",
    )
    parser.add_argument(
        "--out", type=user_path, metavar="DIR", help="folder to write to (runs/transfer/ and the preset's name)"
    )
    parser.add_argument(
        "--synthetic",
        type=user_path,
        metavar="RUN",
        help="folder of a training run on synthetic maps, instead of a new one",
    )
    synthetic = parser.add_argument_group("the synthetic model, unless a folder of it is given")
    options.add_run(synthetic)
    parser.set_defaults(of_synthetic={name: parser.get_default(name) for name in options.RUN_OPTIONS})


def run(arguments: argparse.Namespace) -> None:
    """Trains the runs that are not trained yet, and writes the results."""
    named = Path(arguments.preset).suffix != ".toml"
    suffix = f"_{arguments.model}" if named and arguments.model != RESNET else ""
    path = find_preset(arguments.preset + suffix, "transfer")
    out = arguments.out or Path("runs/transfer") / path.stem
    with held(out), going_on(launch.GOES_ON):
        experiment(
            path,
            out,
            lambda preset: _base(preset, arguments),
            arguments.synthetic,
            data=arguments.data,
            stand_ins=arguments.stand_ins,
        )


def experiment(
    path: Path,
    out: Path,
    base_of: Callable[[Path], Run],
    synthetic: Path | None = None,
    *,
    data: Path | None = None,
    stand_ins: bool = False,
    until: float = math.inf,
) -> bool:
    """Runs the experiment of a preset in a folder that no other process uses.

    base_of:   makes the run of the synthetic model from the preset that trains it
    synthetic: folder of the synthetic model, which is trained unless given
    data:      data set of real maps, instead of that of the sites; stand_ins: whether built-in sites take their place
    until:     `time.monotonic()` after which no step of the arms begins; the seeds that have ended by then are reported
    Returns whether all seeds have ended.
    """
    config = load_toml(path, TransferConfig)
    sites = path.parent / user_path(config.sites)
    places = chosen_stand_ins(sites, out, stand_ins, data)
    if places:
        print(places.sentence, flush=True)
        config = places.in_place_of_real(config)
    devices = Devices.all()
    _require_same(out, config)
    base = base_of(path.parent / user_path(config.synthetic))
    windows = _data(sites, data, base, out, places)
    # Before hours of work, as it raises where something does not fit.
    transfer = Transfer(config, base, synthetic or out / "synthetic", windows, out, devices)
    if not synthetic:
        _train_synthetic(base, transfer.synthetic, devices)
    say = lambda arm, seed: progress.say(f"\n{arm}, seed {seed}: {transfer.place_of(arm, seed)}")
    rows = run_all(transfer, say, until)
    ended = len(rows[transfer.arms[0]])
    if ended:
        _write(transfer, Results.from_rows(rows), out, places)
    return ended == len(config.seeds)


def _require_same(out: Path, config: TransferConfig) -> None:
    """Saves the configuration in the folder; raises InputError if it holds another, except for moved FILES."""
    path = out / "config.json"
    if path.exists() and not _is_of(path, config):
        raise InputError(
            f"--out {out}: holds an experiment of another preset; allowed: another folder, or the same preset"
        )
    save_text(path, json.dumps(to_json(config), indent=1) + "\n")


def _is_of(path: Path, config: TransferConfig) -> bool:
    """Tells whether a file holds a configuration, but for the files it names: these are compared where runs go on."""
    table = read_json(path)
    try:
        kept = from_json(table, TransferConfig, path)
    except InputError:
        return False
    return replace(kept, sites=config.sites, synthetic=config.synthetic) == config


def _base(preset: Path, arguments: argparse.Namespace) -> Run:
    """Returns the run of the synthetic model: that of the given folder, else that of the experiment."""
    if not arguments.synthetic:
        return options.run_of(Preset.load(preset), arguments)
    for name, default in arguments.of_synthetic.items():
        given = getattr(arguments, name)
        require(given == default, f"--{name}", given, "left out where --synthetic is given")
    return Run.load(arguments.synthetic)


def _train_synthetic(base: Run, folder: Path, devices: Devices) -> None:
    """Trains and evaluates the synthetic model unless that is done."""
    fit(base, folder, devices, resume=True)
    if not (folder / TABLES).exists():
        evaluate_run(folder)


TABLES = "evaluation/tables.txt"
"""File of the tables of `travjax evaluate` in the folder of a training run."""


def _data(sites: Path, given: Path | None, base: Run, out: Path, stand_ins: StandIns | None) -> Dataset:
    """Returns the data set of real maps: the one given, else the experiment's, made if it does not exist yet."""
    if given:
        return dataset.load(given)
    put_back(out / DATA)
    if (out / DATA / "dataset.json").exists():
        return dataset.load(out / DATA)
    if stand_ins:
        stand_ins.write()
    config = stand_ins.sites if stand_ins else SitesConfig.load(sites)
    return build_from_sites(config, base.setup, out / DATA)


def _write(transfer: Transfer, results: Results, out: Path, stand_ins: StandIns | None) -> None:
    """Prints tables, and writes figures, JSON and the report."""
    config, base = transfer.config, transfer.base
    kind = "stand-in" if stand_ins else "real"
    trained = "the heads, on frozen trunks," if config.frozen else "everything"
    tables = {
        "First weights": arms_table(results),
        f"Events, {transfer.arms[-1]}": events_table(results, transfer.arms[-1]),
        f"{kind.capitalize()} maps": statistics_table(transfer.dataset, as_in_paper=False),
    }
    for title, table in tables.items():
        print(f"\n{title}\n{table}")
    print()
    figures = [map_figures.save(transfer_figure(results, COLOURS, f"{kind} maps"), out / "f1.png")]
    if stand_ins:
        figures.append(map_figures.save(stand_ins.figure(), out / "stand_in_sites.png"))
    if config.shown_maps:
        figures.append(map_figures.save(_maps_figure(transfer), out / "maps.png"))
    described: dict[str, Any] = {
        "config": to_json(config),
        "synthetic": to_json(base.preset),
        "robot": to_json(base.robot),
    }
    provenance = transfer.dataset.provenance
    described |= {"machine": machine(), "real": provenance and provenance.to_json()}
    save_text(out / "results.json", json.dumps(described | results_json(results), indent=1, allow_nan=False) + "\n")
    intro = (
        f"{base.robot.name}, {len(base.actions)} trajectories a map; {trained} trained on {_samples(transfer)} "
        f"of {kind} maps for {config.epochs} epochs, {results.seeds} seeds; {machine()}.\n\n{MEANING}"
    )
    if base.preset.weights == "none" and IMAGENET in transfer.arms:
        intro += f" Without ImageNet weights the arm {IMAGENET} begins with random ones as well."
    synthetic = transfer.synthetic / TABLES
    sections = {"Synthetic test maps": read_text(synthetic).strip()} if synthetic.exists() else {}
    sections |= tables
    pieces: list[launch.Piece] = [
        *([f"**{stand_ins.sentence}**"] if stand_ins else []),
        intro,
        *(f"## {title}\n\n{launch.verbatim(table)}" for title, table in sections.items()),
        *figures,
    ]
    report = launch.write_report(out, f"Transfer to {kind} maps", pieces)
    progress.wrote(report, out / "results.json", *figures)


MEANING = (
    "Scores are those of held-out windows at natural frequency, at a threshold of 0.5; figures of several seeds are "
    "means ± standard deviations. *Always fails* is the predictor that says so of every trajectory; *of the way to 1* "
    "is the share of the distance from its F1 to 1 that an arm covers. The best epoch is the best one on the held-out "
    "site itself, as in the paper; validation's epoch is chosen on other windows. The paper's figures are those of its "
    "own site and robot."
)


def _samples(transfer: Transfer) -> str:
    """Describes the training samples of an epoch."""
    if transfer.base.kind.reads_whole_maps:
        return f"all trajectories of {len(transfer.dataset.maps_of('train')):,} windows"
    return f"{TrajectorySamples(transfer.dataset, transfer.config.training).count(2, 0):,} samples"


def _maps_figure(transfer: Transfer) -> Figure:
    """Draws predictions before and after training on real maps, above the labels, on windows of one site."""
    config, data, base = transfer.config, transfer.dataset, transfer.base
    evaluator = Evaluator.from_run(base, data, transfer.devices)
    shown = evaluator.to_show(config.shown_maps, config.shown)
    models = {"before": transfer.pretrained, "after": transfer.estimator(transfer.arms[-1], config.seeds[0])}
    predictions = {}
    for name, estimator in models.items():
        with progress.bar(f"maps for the figure, {name}", len(shown) * len(base.actions), "sample") as bar:
            predictions[name] = evaluator.whole_maps(estimator, shown, bar.update)
    failed, known = map(np.asarray, unpacked(data.labels[shown], base.robot))
    places = data.provenance.origin[shown] if data.provenance else shown
    titles = [f"{config.shown}, SW {np.round(place, 1).tolist()}" for place in places]
    return map_figures.predicted_maps(data.heights[shown], predictions, failed, known, titles, base.setup)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the experiment; returns the exit code, 2 for bad input."""
    parser = launch.parser("transfer", DESCRIPTION)
    add(parser)
    return launch.launch(parser, run, argv)


if __name__ == "__main__":
    raise SystemExit(main())
