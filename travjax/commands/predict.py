"""`travjax predict`: probabilities of failure for every trajectory of maps, by a trained estimator."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from travjax import progress
from travjax.commands import label, options
from travjax.config import require
from travjax.data.map_batches import Batch, bytes_each, labelled, samples, title
from travjax.data.npz_stream import NpzStream
from travjax.estimators.names import ESTIMATORS
from travjax.files import output_folder, save_text, user_path

if TYPE_CHECKING:
    from travjax.runs.predictor import Predictor

PROBABILITY = 0.5
"""From which a trajectory counts as failing in the printed table."""

SIMULATOR = "simulator\non the map as given"
"""What a figure calls the row below the predictions."""

AGAINST = "Against the simulator on the map as given, its noise included"
"""What stands above the table of `--check`."""


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "predict",
        help="predict failures on maps by a trained estimator",
        description="Predicts the probability of step, obstacle and tilt failures for every trajectory of maps: of the "
        "windows of elevation maps as `travjax label` takes them, or of synthetic maps. The estimator is the hazard "
        "field for the Seekur Jr that comes with the package, unless another is named.",
    )
    parser.add_argument(
        "dem", nargs="*", type=user_path, metavar="DEM", help="elevation map files; none: synthetic maps"
    )
    parser.add_argument(
        "--checkpoint",
        type=user_path,
        metavar="C",
        help="folder of a training run, or .safetensors file of an estimator",
    )
    parser.add_argument("--model", choices=ESTIMATORS, help="what the estimator must be")
    parser.add_argument("--robot", metavar="R", help="what the estimator must have been trained for")
    parser.add_argument(
        "--check",
        action="store_true",
        help="the simulator beside it, on the map as given: it takes the noise of a map for ground",
    )
    options.add_synthetic(parser, count=20, each="maps in all, the styles in turn")
    options.add_dem(parser, stride=8.0)
    parser.add_argument("--no-figures", action="store_true", help="write no figures")
    options.add_out(parser, "runs/predict")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Predicts, prints the shares that fail, and writes predictions and a figure."""
    from travjax.evaluation import tables
    from travjax.runs.predictor import Predictor
    from travjax.simulation.robot import Robot

    predictor = Predictor.load(arguments.checkpoint)
    model, trained = predictor.run.preset.model, predictor.run
    require(arguments.model in (None, model), "--model", arguments.model, f"{model}, which the estimator is")
    predictor.require_trained_for(Robot.load(arguments.robot) if arguments.robot else None)
    total, source, files = label.maps_of(arguments, trained.grid)
    out = output_folder(arguments.out)
    config = options.configuration_json(
        trained.robot, trained.actions, trained.grid, files=files, model=model, world=arguments.world
    )
    size = (
        bytes_each(trained.robot, trained.actions, trained.grid)
        + len(trained.actions) * len(trained.robot.events) * 2 * 4
    )
    with NpzStream(out / "predictions.npz", total, size, "predicted maps") as predictions:
        with progress.bar("predicting", total * len(trained.actions), "trajectory") as bar:
            for batch in source:
                predictions.append(_predicted(batch, predictor, bar.update))
        maps = predictions.arrays
        fails = maps["probability"] >= PROBABILITY
        table = tables.shares_table(maps["group"], fails, maps["known"], False, trained.robot.event_names)
        text = f"Predicted to fail, {trained.robot.name}, {len(trained.actions)} trajectories a map, {model}:\n{table}"
        if arguments.check:
            text += f"\n\n{_checked(maps, trained.robot.event_names)}"
        unsaved = ("heights",) if arguments.check else ("heights", "failed")
        saved = predictions.save(unsaved, config=config, cell_size=trained.grid.spacing)
        shares = save_text(out / "shares.txt", f"{text}\n")
        print(f"\n{text}\n")
        progress.wrote(saved, shares)
        if not arguments.no_figures:
            progress.wrote(_figure(maps, predictor, arguments.check, out))


def _predicted(batch: Batch, predictor: "Predictor", on_progress: Callable[[int], object]) -> Batch:
    """A batch with what is predicted, and of the simulator what fails and which trajectories touch unknown ground."""
    trained = predictor.run
    simulated = labelled(batch, trained.robot, trained.actions, trained.grid)
    predicted = predictor.predict(batch["heights"], on_progress)
    kept = ("heights", "group", "known", "failed", "origin", "height_offset", "crs", "seed")
    found = {name: simulated[name] for name in kept if name in simulated} | {"probability": predicted.probability}
    if predicted.margins is not None:
        found |= {
            f"margin_{name}": predicted.margins[..., event] for event, name in enumerate(trained.robot.event_names)
        }
    return found


def _checked(maps: Batch, events: Sequence[str]) -> str:
    """The predictions against the simulator on the maps as given; on noisy ones that is not what a robot meets."""
    from travjax.evaluation import metrics, tables

    known = maps["known"]
    scores = metrics.evaluate(maps["probability"][known], maps["failed"][known], events=events)
    return f"{AGAINST}:\n{tables.metrics_table(scores, None)}"


def _figure(maps: Batch, predictor: "Predictor", check: bool, out: Path) -> Path:
    """The action space of a few maps in safe, doubtful and failing; `check` adds the simulator's below it."""
    from travjax.evaluation import map_figures

    shown, trained = samples(maps), predictor.run
    titles = [title(maps, index) for index in shown]
    figure = map_figures.predicted_maps(
        maps["heights"][shown],
        {"predicted": maps["probability"][shown]},
        maps["failed"][shown] if check else None,
        maps["known"][shown],
        titles,
        trained.robot,
        trained.actions,
        trained.grid,
        SIMULATOR,
    )
    return map_figures.save(figure, out / "predictions.png")
