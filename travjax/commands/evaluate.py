"""`travjax evaluate`: how good a trained estimator is on the test maps, as tables, figures and JSON."""

import argparse

from travjax import options
from travjax.config import require
from travjax.evaluation.metrics import RECALLS
from travjax.files import user_path


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
    parser.add_argument("--figure-maps", type=int, default=2, metavar="N", help="maps in predictions.png (2)")
    parser.add_argument("--no-baselines", action="store_true", help="without the two predictors to beat")
    parser.add_argument(
        "--out",
        type=user_path,
        metavar="DIR",
        help="folder to write to (RUN/evaluation, and RUN/evaluation_C for another checkpoint than best)",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Evaluates a training run."""
    from travjax.training.evaluation_report import evaluate_run

    for name in ("maps", "each", "figure_maps"):
        value = getattr(arguments, name)
        require(value is None or value >= 0, f"--{name.replace('_', '-')}", value, "at least 0")
    for recall in arguments.recall:
        require(0 < recall <= 1, "--recall", recall, "above 0 and at most 1")
    evaluate_run(
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
