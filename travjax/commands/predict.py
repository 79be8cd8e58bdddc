"""`travjax predict`: probabilities of failure for every trajectory of maps, by a trained estimator."""

import argparse
from pathlib import Path

import numpy as np

from travjax import progress
from travjax.commands import label, options
from travjax.config import require
from travjax.files import output_folder, save_npz, save_text, user_path
from travjax.labelling import Batch, joined, labelled, samples, title
from travjax.models import MODELS

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
    parser.add_argument("--model", choices=MODELS, help="what the estimator must be")
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
    from travjax import report
    from travjax.predictor import Predictor
    from travjax.robot import Robot

    predictor = Predictor.load(arguments.checkpoint)
    model, trained = predictor.run.preset.model, predictor.run
    require(arguments.model in (None, model), "--model", arguments.model, f"{model}, which the estimator is")
    predictor.require_same(Robot.load(arguments.robot) if arguments.robot else None)
    total, source, files = label.maps_of(arguments, trained.grid)
    out = output_folder(arguments.out)
    maps = joined(list(options.progress((_simulated(batch, predictor) for batch in source), total, "simulator")))
    with progress.bar("predicting", total * len(trained.actions), "trajectory") as bar:
        predicted = predictor.predict(maps["heights"], bar.update)
    fails = predicted.probability >= PROBABILITY
    table = report.shares_table(maps["group"], fails, maps["known"], as_in_paper=False)
    headline = f"Predicted to fail, {trained.robot.name}, {len(trained.actions)} trajectories a map, {model}:"
    text = f"{headline}\n{table}"
    if arguments.check:
        text += f"\n\n{_checked(maps, predicted.probability)}"
    arrays = {"probability": predicted.probability, "group": maps["group"], "known": maps["known"]}
    arrays |= {name: maps[name] for name in ("origin", "height_offset", "crs", "seed") if name in maps}
    if predicted.margins is not None:
        arrays |= {f"margin_{name}": predicted.margins[..., k] for k, name in enumerate(("step", "obstacle", "tilt"))}
    if arguments.check:
        arrays |= {"failed": maps["failed"]}
    config = options.configuration_json(
        trained.robot, trained.actions, trained.grid, files=files, model=model, world=arguments.world
    )
    saved = save_npz(out / "predictions.npz", config=config, cell_size=trained.grid.spacing, **arrays)
    shares = save_text(out / "shares.txt", f"{text}\n")
    print(f"\n{text}\n\n{saved}\n{shares}")
    if not arguments.no_figures:
        print(_figure(maps, predicted.probability, predictor, arguments.check, out))


def _simulated(batch: Batch, predictor) -> Batch:
    """The batch with what the simulator says of it; which trajectories touch unknown ground is needed in any case."""
    trained = predictor.run
    return labelled(batch, trained.robot, trained.actions, trained.grid)


def _checked(maps: Batch, probability: np.ndarray) -> str:
    """The predictions against the simulator on the maps as given; on noisy ones that is not what a robot meets."""
    from travjax import metrics, report

    known = maps["known"]
    scores = metrics.evaluate(probability[known], maps["failed"][known])
    return f"{AGAINST}:\n{report.metrics_table(scores, None)}"


def _figure(maps: Batch, probability: np.ndarray, predictor, check: bool, out: Path) -> Path:
    """The action space of a few maps in safe, doubtful and failing; `check` adds the simulator's below it."""
    from travjax import plots

    shown, trained = samples(maps), predictor.run
    titles = [title(maps, index) for index in shown]
    figure = plots.predicted_maps(
        maps["heights"][shown],
        {"predicted": probability[shown]},
        maps["failed"][shown] if check else None,
        maps["known"][shown],
        titles,
        trained.robot,
        trained.actions,
        trained.grid,
        SIMULATOR,
    )
    return plots.save(figure, out / "predictions.png")
