"""`travjax predict`: probabilities of failure for every trajectory of maps, by a trained estimator."""

import argparse

from travjax import options
from travjax.config import require
from travjax.estimators.names import ESTIMATORS
from travjax.files import user_path
from travjax.simulation.contact import CONTACTS
from travjax.simulation.robot import Robot


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "predict",
        help="predict failures on maps by a trained estimator",
        description="Predicts the probability of step, obstacle and tilt failures for every trajectory of maps: of the "
        "windows of elevation maps as `travjax label` takes them, or of synthetic maps. The estimator is the hazard "
        "field for the Seekur Jr that comes with the package, unless another is named.",
    )
    options.add_maps(parser)
    parser.add_argument(
        "--checkpoint",
        type=user_path,
        metavar="C",
        help="folder of a training run, or .safetensors file of an estimator",
    )
    parser.add_argument("--model", choices=ESTIMATORS, help="what the estimator must be")
    parser.add_argument("--robot", metavar="R", help="what the estimator must have been trained for")
    parser.add_argument("--contact", choices=CONTACTS, help="contact model that it must have been trained for")
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
    """Predicts failures on the maps and writes the results."""
    from travjax.runs.prediction_report import predict_maps
    from travjax.runs.predictor import Predictor

    predictor = Predictor.load(arguments.checkpoint)
    model = predictor.run.preset.model
    require(arguments.model in (None, model), "--model", arguments.model, f"{model}, which the estimator is")
    robot = Robot.load(arguments.robot) if arguments.robot else None
    own = robot.contact if robot else None
    predictor.require_trained_for(robot, contact=arguments.contact or own)
    maps = options.maps(arguments, predictor.run.grid)
    predict_maps(maps, predictor, arguments.out, arguments.check, figures=not arguments.no_figures)
