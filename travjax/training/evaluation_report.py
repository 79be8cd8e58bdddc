"""Evaluates a training run on its test maps: tables, figures and JSON in a folder."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from travjax import progress
from travjax.config import InputError, one_line
from travjax.data import dataset
from travjax.data.dataset import Dataset
from travjax.data.sampling import Samples
from travjax.devices import Devices
from travjax.evaluation import map_figures, score_figures, tables
from travjax.evaluation.metrics import RECALLS, Evaluation, json_ready
from travjax.files import output_folder, save_text, user_path
from travjax.jax_flags import usual_flags
from travjax.models.variables import Network
from travjax.runs.evaluator import Evaluator
from travjax.runs.run import DATA, Run, load_estimator
from travjax.traversal.traverse import unpacked

MARGINS = "regressed margins above their limits"


@usual_flags()
def evaluate_run(
    folder: str | Path,
    data: str | Path | Dataset | None = None,
    checkpoint: str = "best",
    out: str | Path | None = None,
    *,
    maps: int | None = None,
    each: int | None = None,
    recalls: Sequence[float] = RECALLS,
    figure_maps: int = 2,
    baselines: bool = True,
) -> Evaluation:
    """Evaluates a training run, prints the tables and writes them with the figures; returns the network's scores.

    data:       a data set, or the folder of one, instead of the run's own
    checkpoint: "best", "latest" or "heads"
    out:        folder to write to, instead of one in the run's folder
    maps, each: number of random test maps and of random trajectories of each, 0 for all, instead of the preset's
    recalls:    recalls to find thresholds for; figure_maps: number of maps in predictions.png
    baselines:  whether to evaluate the baselines as well
    Raises InputError when the run, its checkpoint or its data set is missing, damaged, or does not fit.
    """
    place = user_path(folder)
    trained, estimator, meta = load_estimator(place, checkpoint)
    given = data if isinstance(data, Dataset) else dataset.load(data or place / DATA)
    evaluator = Evaluator.from_run(trained, given, Devices.all())
    name = "evaluation" if checkpoint == "best" else f"evaluation_{checkpoint}"
    written = output_folder(out or place / name)
    sampled = trained.preset.evaluation
    count = sampled.trajectories_per_map if each is None else each
    samples = evaluator.samples(sampled.maps if maps is None else maps, count)
    scores = evaluator.scores(_probabilities(evaluator, estimator, samples, "test samples"), samples, recalls)
    others = _baselines(place, evaluator, samples, recalls) if baselines else {}
    description = _description(evaluator, samples, checkpoint, meta["position"])
    errors = None
    if trained.kind.largest_margin is not None:
        with progress.bar("margins", len(np.unique(samples[0])), "map") as bar:
            predicted, true = evaluator.margins(estimator, samples, bar.update)
        errors = np.abs(predicted - true).mean(axis=0) * np.asarray(trained.robot.limits)
        others[MARGINS] = evaluator.scores(np.clip(predicted / 2, 0, 1), samples, recalls)  # 0.5 is the limit
    _write_tables(written, scores, others, description, evaluator, errors)
    _draw(written, evaluator, estimator, scores, others, figure_maps, len(samples[0]))
    return scores


def _probabilities(evaluator: Evaluator, estimator: Network, samples: Samples, what: str) -> np.ndarray:
    with progress.bar(what, len(samples[0]), "sample") as bar:
        return evaluator.probabilities(estimator, samples, bar.update)


def _baselines(folder: Path, evaluator: Evaluator, samples: Samples, recalls: Sequence[float]) -> dict[str, Evaluation]:
    """Evaluates the baselines: heads on the trunk before it was trained, and a regression on the ground alone."""
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


def _description(evaluator: Evaluator, samples: Samples, checkpoint: str, position: dict) -> dict:
    """Describes which checkpoint was evaluated, and on which data."""
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
    scores: Evaluation,
    others: Mapping[str, Evaluation],
    description: dict,
    evaluator: Evaluator,
    errors: np.ndarray | None,
) -> None:
    """Prints the tables, and writes them and all figures as JSON."""
    paper = evaluator.paper
    average_precisions = {"network": scores.average_precision}
    average_precisions |= {name: other.average_precision for name, other in others.items()}
    headline = "{samples} samples of {maps} of {test_maps} test maps, {robot}; checkpoint {checkpoint}: phase {phase}, "
    parts = [
        (headline + "step {steps}").format(**description),
        tables.metrics_table(scores, paper),
        tables.threshold_table(scores, paper),
        *([tables.paper_table(scores, paper)] if paper and scores.recall_at_paper_precision else []),
        tables.calibration_line(scores),
        tables.groups_table(scores),
        tables.baselines_table(average_precisions),
    ]
    if errors is not None:
        of_margins = tables.metrics_table(others[MARGINS], paper)
        parts += [f"{MARGINS.capitalize()}:\n{of_margins}", _margin_errors(errors, evaluator.run)]
    text = "\n\n".join(parts)
    progress.say(f"\n{text}\n")
    results = {"sample": description, "network": json_ready(scores)}
    results |= {name: json_ready(other) for name, other in others.items()}
    if errors is not None:
        results["margin_errors"] = dict(zip(evaluator.run.robot.event_names, errors.tolist(), strict=True))
    for name, content in (("tables.txt", text), ("evaluation.json", json.dumps(results, indent=1, allow_nan=False))):
        progress.wrote(save_text(out / name, content + "\n"))


def _margin_errors(errors: np.ndarray, run: Run) -> str:
    """Returns one line with the mean absolute errors [k] of the margins of the robot's events."""
    pairs, largest = zip(run.robot.events, errors, strict=True), run.kind.largest_margin
    each = ", ".join(f"{event.name} {event.shown(error)}" for event, error in pairs)
    return f"Mean absolute error of the margins, those above {largest:g} limits counted as that: {each}"


def _draw(
    out: Path,
    evaluator: Evaluator,
    estimator: Network,
    scores: Evaluation,
    others: Mapping[str, Evaluation],
    maps: int,
    samples: int,
) -> None:
    """Draws curves, calibration and, unless `maps` is 0, predictions on `maps` maps."""
    figure = score_figures.precision_recall_figure(scores, evaluator.paper, others)
    progress.wrote(map_figures.save(figure, out / "precision_recall.png"))
    progress.wrote(map_figures.save(score_figures.reliability_figure(scores), out / "reliability.png"))
    if maps:
        progress.wrote(map_figures.save(_predictions(evaluator, estimator, maps, samples), out / "predictions.png"))


def _predictions(evaluator: Evaluator, estimator: Network, maps: int, samples: int) -> Figure:
    """Draws predictions over labels for the action space of test maps where only some trajectories fail.

    samples: the evaluated samples; where they are few, not all trajectories are shown
    """
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
        trained.setup,
        every=every,
    )
