"""`travjax evaluate`: how good a trained estimator is on the test maps, as tables, figures and JSON."""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from travjax import progress
from travjax.commands import options
from travjax.config import InputError, one_line, require
from travjax.files import output_folder, save_text, user_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from travjax.data.sampling import Samples
    from travjax.evaluation.metrics import Evaluation
    from travjax.models.variables import Network
    from travjax.runs.evaluator import Evaluator
    from travjax.simulation.robot import Robot

RECALLS = (0.9, 0.99)
"""Recalls that thresholds are found for, unless others are asked for."""

FIGURE_MAPS = 2
"""Maps in predictions.png, likewise."""

MARGINS = "regressed margins above their limits"


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "evaluate",
        help="evaluate a trained estimator",
        description="Evaluates a training run's estimator on the test maps of its data set: the paper's table beside "
        "ours, thresholds for a wanted recall, calibration, failures by style, and figures.",
    )
    parser.add_argument("folder", type=user_path, metavar="RUN", help="folder of a training run")
    parser.add_argument("--data", type=user_path, metavar="DIR", help="data set (the run's own)")
    parser.add_argument(
        "--checkpoint", default="best", metavar="C", help="best, latest, or heads for the end of phase 1 (best)"
    )
    parser.add_argument("--maps", type=int, metavar="N", help="random test maps, 0 for all (as the preset says)")
    parser.add_argument("--each", type=int, metavar="N", help="random trajectories of each, 0 for all (likewise)")
    parser.add_argument(
        "--recall", type=float, nargs="+", default=RECALLS, metavar="R", help="recalls to find thresholds for"
    )
    parser.add_argument("--figure-maps", type=int, default=FIGURE_MAPS, metavar="N", help="maps in predictions.png (2)")
    parser.add_argument("--no-baselines", action="store_true", help="without the two predictors to beat")
    parser.add_argument(
        "--out",
        type=user_path,
        metavar="DIR",
        help="folder to write to (RUN/evaluation, and RUN/evaluation_C for another checkpoint than best)",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Evaluates."""
    for name in ("maps", "each", "figure_maps"):
        value = getattr(arguments, name)
        require(value is None or value >= 0, f"--{name.replace('_', '-')}", value, "at least 0")
    for recall in arguments.recall:
        require(0 < recall <= 1, "--recall", recall, "above 0 and at most 1")
    evaluate(
        arguments.folder,
        arguments.data,
        arguments.checkpoint,
        arguments.out,
        maps=arguments.maps,
        each=arguments.each,
        recalls=arguments.recall,
        figure_maps=arguments.figure_maps,
        baselines=not arguments.no_baselines,
    )


def evaluate(
    folder: Path,
    data: Path | None = None,
    checkpoint: str = "best",
    out: Path | None = None,
    *,
    maps: int | None = None,
    each: int | None = None,
    recalls: Sequence[float] = RECALLS,
    figure_maps: int = FIGURE_MAPS,
    baselines: bool = True,
) -> "Evaluation":
    """Evaluates a training run, prints the tables and writes them with the figures; returns the network's figures.

    data:       folder of a data set, instead of the run's own
    checkpoint: "best", "latest" or "heads"
    out:        folder to write to, instead of one in that of the run
    maps, each: random test maps and random trajectories of each, 0 for all, instead of the preset's
    recalls:    those to find thresholds for; figure_maps: maps in predictions.png
    baselines:  whether the predictors to beat are evaluated as well
    Raises InputError when the run, its checkpoint or its data set is missing, damaged, or does not fit.
    """
    from travjax.data import dataset
    from travjax.devices import Devices
    from travjax.models.hazard_field import HazardField
    from travjax.runs.evaluator import Evaluator
    from travjax.runs.run import DATA, load_estimator

    trained, estimator, meta = load_estimator(folder, checkpoint)
    evaluator = Evaluator.from_run(trained, dataset.load(data or folder / DATA), Devices.all())
    name = "evaluation" if checkpoint == "best" else f"evaluation_{checkpoint}"
    out = output_folder(out or folder / name)
    sampled = trained.preset.evaluation
    samples = evaluator.samples(sampled.maps if maps is None else maps, sampled.each if each is None else each)
    scores = evaluator.scores(_probabilities(evaluator, estimator, samples, "test samples"), samples, recalls)
    others = _baselines(folder, evaluator, samples, recalls) if baselines else {}
    description = _description(evaluator, samples, checkpoint, meta["position"])
    errors = None
    if isinstance(estimator, HazardField):
        with progress.bar("margins", len(np.unique(samples[0])), "map") as bar:
            predicted, true = evaluator.margins(estimator, samples, bar.update)
        errors = np.abs(predicted - true).mean(axis=0) * np.asarray(trained.robot.limits)
        others[MARGINS] = evaluator.scores(np.clip(predicted / 2, 0, 1), samples, recalls)  # 0.5 is the limit
    _write_tables(out, scores, others, description, evaluator, errors)
    _draw(out, evaluator, estimator, scores, others, figure_maps, len(samples[0]))
    return scores


def _probabilities(evaluator: "Evaluator", estimator: "Network", samples: "Samples", what: str) -> np.ndarray:
    with progress.bar(what, len(samples[0]), "sample") as bar:
        return evaluator.probabilities(estimator, samples, bar.update)


def _baselines(
    folder: Path, evaluator: "Evaluator", samples: "Samples", recalls: Sequence[float]
) -> dict[str, "Evaluation"]:
    """Evaluations of the predictors to beat: heads on the trunk as it was, and a regression on the ground alone."""
    from travjax.runs.run import load_estimator

    others = {}
    if evaluator.run.preset.training.head_epochs:
        try:
            heads = load_estimator(folder, "heads")[1]
        except InputError as error:
            progress.say(f"{error}; left out")
        else:
            others["heads on the frozen trunk"] = _probabilities(evaluator, heads, samples, "frozen trunk")
    others["regression on slope and step"] = evaluator.regression(samples)
    return {name: evaluator.scores(values, samples, recalls) for name, values in others.items()}


def _description(evaluator: "Evaluator", samples: "Samples", checkpoint: str, position: dict) -> dict:
    """What was evaluated on what."""
    trained, data = evaluator.run, evaluator.dataset
    return {
        "checkpoint": checkpoint,
        "phase": position["phase"],
        "steps": position["total"],
        "samples": len(samples[0]),
        "maps": len(np.unique(samples[0])),
        "test_maps": len(data.maps_of("test")),
        "robot": trained.robot.name,
        "trajectories": len(trained.actions),
    }


def _write_tables(
    out: Path,
    scores: "Evaluation",
    others: Mapping[str, "Evaluation"],
    description: dict,
    evaluator: "Evaluator",
    errors: np.ndarray | None,
) -> None:
    from travjax.evaluation import tables
    from travjax.evaluation.metrics import json_ready

    paper = evaluator.paper
    average_precisions = {"network": scores.average_precision}
    average_precisions |= {name: other.average_precision for name, other in others.items()}
    headline = "{samples} samples of {maps} of {test_maps} test maps, {robot}; checkpoint {checkpoint}: phase {phase}, "
    parts = [
        (headline + "step {steps}").format(**description),
        tables.metrics_table(scores, paper),
        tables.threshold_table(scores, paper),
        tables.calibration_line(scores),
        tables.groups_table(scores),
        tables.baselines_table(average_precisions),
    ]
    if errors is not None:
        parts += [
            f"{MARGINS.capitalize()}:\n{tables.metrics_table(others[MARGINS], paper)}",
            _margin_errors(errors, evaluator.run.robot),
        ]
    text = "\n\n".join(parts)
    print(f"\n{text}\n")
    results = {"sample": description, "network": json_ready(scores)}
    results |= {name: json_ready(other) for name, other in others.items()}
    if errors is not None:
        results["margin_errors"] = dict(zip(evaluator.run.robot.event_names, errors.tolist(), strict=True))
    for name, content in (("tables.txt", text), ("evaluation.json", json.dumps(results, indent=1, allow_nan=False))):
        progress.wrote(save_text(out / name, content + "\n"))


def _margin_errors(errors: np.ndarray, robot: "Robot") -> str:
    """One line on mean absolute errors [k] of the margins of a robot's events."""
    from travjax.models.hazard_field import LARGE_MARGIN

    each = ", ".join(f"{event.name} {event.shown(error)}" for event, error in zip(robot.events, errors, strict=True))
    return f"Mean absolute error of the margins, those above {LARGE_MARGIN:g} limits counted as that: {each}"


def _draw(
    out: Path,
    evaluator: "Evaluator",
    estimator: "Network",
    scores: "Evaluation",
    others: Mapping[str, "Evaluation"],
    maps: int,
    samples: int,
) -> None:
    from travjax.evaluation import map_figures, score_figures

    figure = score_figures.precision_recall_figure(scores, evaluator.paper, others)
    progress.wrote(map_figures.save(figure, out / "precision_recall.png"))
    progress.wrote(map_figures.save(score_figures.reliability_figure(scores), out / "reliability.png"))
    if maps:
        progress.wrote(map_figures.save(_predictions(evaluator, estimator, maps, samples), out / "predictions.png"))


def _predictions(evaluator: "Evaluator", estimator: "Network", maps: int, samples: int) -> "Figure":
    """Prediction over truth on the action space of test maps that fail neither nowhere nor everywhere.

    samples: those that were evaluated; where they are few, not all trajectories are shown
    """
    from travjax.evaluation import map_figures
    from travjax.simulation.traverse import unpacked

    data, trained = evaluator.dataset, evaluator.run
    shown = evaluator.to_show(maps)
    every = evaluator.every(len(shown), samples)
    labels = data.labels[shown, ::every]
    with progress.bar("maps for the figure", labels.size, "sample") as bar:
        probability = evaluator.whole_maps(estimator, shown, bar.update, every)
    failed, known = map(np.asarray, unpacked(labels, trained.robot))
    titles = [f"{one_line(data.group[index], 30)}, map {index}" for index in shown]
    return map_figures.predicted_maps(
        data.heights[shown],
        {"predicted": probability},
        failed,
        known,
        titles,
        trained.robot,
        trained.actions,
        trained.grid,
        every=every,
    )
