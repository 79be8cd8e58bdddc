"""`travjax evaluate`: how good a trained estimator is on the test maps, as tables, figures and JSON."""

import argparse
import json
from pathlib import Path

import numpy as np
from tqdm import tqdm

from travjax.commands import options
from travjax.config import InputError, require
from travjax.files import output_folder, written_whole

CALIBRATION = (
    "Training samples fail more often than these do, so probabilities tend to be too high (reliability.png shows by "
    "how much); choose a threshold from the table above."
)


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "evaluate",
        help="evaluate a trained estimator",
        description="Evaluates a training run's estimator on the test maps of its data set: the paper's table beside "
        "ours, thresholds for a wanted recall, calibration, failures by style, and figures.",
    )
    parser.add_argument("folder", type=Path, metavar="RUN", help="folder of a training run")
    parser.add_argument("--data", type=Path, metavar="DIR", help="data set (the run's own)")
    parser.add_argument(
        "--checkpoint", default="best", metavar="C", help="best, latest, or heads for the end of phase 1 (best)"
    )
    parser.add_argument("--maps", type=int, metavar="N", help="random test maps, 0 for all (as the preset says)")
    parser.add_argument("--each", type=int, metavar="N", help="random trajectories of each, 0 for all (likewise)")
    parser.add_argument(
        "--recall", type=float, nargs="+", default=[0.9, 0.99], metavar="R", help="recalls to find thresholds for"
    )
    parser.add_argument("--figure-maps", type=int, default=2, metavar="N", help="maps in predictions.png (2)")
    parser.add_argument("--no-baselines", action="store_true", help="without the two predictors to beat")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder to write to (RUN/evaluation, and RUN/evaluation_C for another checkpoint than best)",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Evaluates, prints the tables and writes them with the figures."""
    from travjax import dataset
    from travjax.evaluate import Evaluator
    from travjax.parallel import Devices
    from travjax.trained import DATA, load_estimator

    _check(arguments)
    trained, estimator, meta = load_estimator(arguments.folder, arguments.checkpoint)
    evaluator = Evaluator.of(trained, dataset.load(arguments.data or arguments.folder / DATA), Devices.all())
    name = "evaluation" if arguments.checkpoint == "best" else f"evaluation_{arguments.checkpoint}"
    out = output_folder(arguments.out or arguments.folder / name)
    sampled = trained.preset.evaluation
    maps = sampled.maps if arguments.maps is None else arguments.maps
    samples = evaluator.samples(maps, sampled.each if arguments.each is None else arguments.each)
    of_network = _probabilities(evaluator, estimator, samples, "test samples")
    scores = evaluator.scores(of_network, samples, arguments.recall)
    others = {}
    if not arguments.no_baselines:
        others = _baselines(arguments.folder, evaluator, samples, arguments.recall)
    _write_tables(out, scores, others, _description(evaluator, samples, arguments, meta), evaluator.paper)
    _draw(out, evaluator, estimator, scores, others, arguments.figure_maps)


def _check(arguments: argparse.Namespace) -> None:
    for name in ("maps", "each", "figure_maps"):
        value = getattr(arguments, name)
        require(value is None or value >= 0, f"--{name.replace('_', '-')}", value, "at least 0")
    for recall in arguments.recall:
        require(0 < recall <= 1, "--recall", recall, "above 0 and at most 1")


def _probabilities(evaluator, estimator, samples, what: str):
    with tqdm(desc=what, total=len(samples[0]), unit="sample") as bar:
        return evaluator.probabilities(estimator, samples, bar.update)


def _baselines(folder: Path, evaluator, samples, recalls) -> dict:
    """Evaluations of the predictors to beat: heads on the trunk as it was, and a regression on the ground alone."""
    from travjax.trained import load_estimator

    others = {}
    if evaluator.run.preset.training.head_epochs:
        try:
            heads = load_estimator(folder, "heads")[1]
        except InputError as error:
            tqdm.write(f"{error}; left out")
        else:
            others["heads on the frozen trunk"] = _probabilities(evaluator, heads, samples, "frozen trunk")
    others["regression on slope and step"] = evaluator.regression(samples)
    return {name: evaluator.scores(values, samples, recalls) for name, values in others.items()}


def _description(evaluator, samples, arguments: argparse.Namespace, meta: dict) -> dict:
    """What was evaluated on what."""
    trained, data = evaluator.run, evaluator.dataset
    return {
        "checkpoint": arguments.checkpoint,
        "phase": meta["position"]["phase"],
        "steps": meta["position"]["total"],
        "samples": len(samples[0]),
        "maps": len(np.unique(samples[0])),
        "test_maps": len(data.maps_of("test")),
        "robot": trained.robot.name,
        "trajectories": len(trained.actions),
    }


def _write_tables(out: Path, scores, others: dict, description: dict, paper) -> None:
    from travjax import report
    from travjax.metrics import to_json

    average_precisions = {"network": scores.average_precision}
    average_precisions |= {name: other.average_precision for name, other in others.items()}
    headline = "{samples} samples of {maps} of {test_maps} test maps, {robot}; checkpoint {checkpoint}: phase {phase}, "
    tables = [
        (headline + "step {steps}").format(**description),
        report.metrics_table(scores, paper),
        report.threshold_table(scores, paper),
        CALIBRATION,
        report.groups_table(scores),
        report.baselines_table(average_precisions),
    ]
    text = "\n\n".join(tables)
    print(f"\n{text}\n")
    results = {"sample": description, "network": to_json(scores)}
    results |= {name: to_json(other) for name, other in others.items()}
    for name, content in (("tables.txt", text), ("evaluation.json", json.dumps(results, indent=1, allow_nan=False))):
        with written_whole(out / name) as temporary:
            temporary.write_text(content + "\n")
        print(out / name)


def _draw(out: Path, evaluator, estimator, scores, others: dict, maps: int) -> None:
    from travjax import curves, plots

    figure = curves.precision_recall_figure(scores, evaluator.paper, others)
    print(plots.save(figure, out / "precision_recall.png"))
    print(plots.save(curves.reliability_figure(scores), out / "reliability.png"))
    if maps:
        print(plots.save(_predictions(evaluator, estimator, maps), out / "predictions.png"))


def _predictions(evaluator, estimator, maps: int):
    """Prediction over truth on the whole action space of test maps that fail neither nowhere nor everywhere."""
    from travjax import plots
    from travjax.labelling import samples as to_show
    from travjax.traverse import unpacked

    data, trained = evaluator.dataset, evaluator.run
    test = data.maps_of("test")
    failed, known = map(np.asarray, unpacked(data.labels[test]))
    chosen = to_show({"failed": failed, "known": known, "group": data.group[test]}, maps)
    trajectories = len(trained.actions)
    samples = (np.repeat(test[chosen], trajectories), np.tile(np.arange(trajectories), len(chosen)))
    probability = _probabilities(evaluator, estimator, samples, "maps for the figure").reshape(-1, trajectories, 3)
    titles = [f"{data.group[index]}, map {index}" for index in test[chosen]]
    return plots.predicted_maps(
        data.heights[test[chosen]],
        probability,
        failed[chosen],
        known[chosen],
        titles,
        trained.robot,
        trained.actions,
        trained.grid,
    )
