"""`travjax export`: an estimator as one file, for travjax or to run without it; the simulator as well."""

import argparse

from travjax import options, progress
from travjax.config import InputError, require
from travjax.files import user_path

SETUP = ("robot", "actions", "contact", "size", "spacing")
"""Names of the options of the simulator, which an estimator has settled in training."""


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "export",
        help="write an estimator or the simulator to one file",
        description="Writes the estimator of a training run to one .safetensors file, which `travjax predict "
        "--checkpoint` takes, and beside it a model card: what it was trained on, and the tables of its evaluation. "
        "--stablehlo, --onnx and --simulator write a function from heights to results that runs without travjax, and "
        "beside it what it is as .json. Replaces no other file.",
    )
    parser.add_argument(
        "model",
        nargs="?",
        type=user_path,
        metavar="MODEL",
        help="folder of a training run, or for --stablehlo and --onnx a .safetensors file (the field of the package)",
    )
    parser.add_argument("--checkpoint", metavar="C", help="of a folder: best or latest (best)")
    parser.add_argument("--to", type=user_path, required=True, metavar="FILE", help="file to write")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--stablehlo", action="store_true", help="the hazard field as .stablehlo, for jax on CPU and GPU")
    kind.add_argument("--onnx", action="store_true", help="the hazard field as .onnx")
    kind.add_argument("--simulator", action="store_true", help="the simulator for a robot as .stablehlo")
    simulator = parser.add_argument_group("with --simulator")
    options.add_robot(simulator)
    options.add_grid(simulator, of_synthetic=False)
    parser.set_defaults(run=run, setup={name: parser.get_default(name) for name in SETUP})


def run(arguments: argparse.Namespace) -> None:
    """Writes the file, and the card or the description beside it."""
    if arguments.simulator:
        from travjax.exporting.stablehlo import export_simulator

        require(arguments.model is None, "MODEL", str(arguments.model), "left out with --simulator")
        options.require_left_out(arguments, "checkpoint", True, "with --simulator")
        progress.wrote(*export_simulator(arguments.to, options.setup(arguments)))
        return
    options.require_default(arguments, arguments.setup, SETUP, "--simulator is not given")
    require(arguments.turn, "--no-turn", "given", "left out where --simulator is not given")
    checkpoint = arguments.checkpoint or "best"
    if not (arguments.stablehlo or arguments.onnx):
        from travjax.runs.model_card import export_run

        if arguments.model is None:
            raise InputError("MODEL: left out; needed: the folder of a training run, or --stablehlo or --onnx")
        progress.wrote(*export_run(arguments.model, arguments.to, checkpoint))
        return
    of_folder = arguments.model is not None and arguments.model.is_dir()
    options.require_left_out(arguments, "checkpoint", not of_folder, "where MODEL is no folder")
    from travjax.exporting.onnx_graph import export_onnx
    from travjax.exporting.stablehlo import export_field
    from travjax.runs.predictor import Predictor

    write = export_onnx if arguments.onnx else export_field
    progress.wrote(*write(arguments.to, Predictor.load(arguments.model, checkpoint)))
