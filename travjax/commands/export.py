"""`travjax export`: a training run's estimator as one file, with its model card."""

import argparse

from travjax import options, progress
from travjax.files import user_path


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "export",
        help="write a trained estimator to one file",
        description="Writes the estimator of a training run to one .safetensors file, which `travjax predict "
        "--checkpoint` takes, and beside it a model card: what it was trained on, and the tables of its evaluation. "
        "Replaces no other file.",
    )
    parser.add_argument("folder", type=user_path, metavar="RUN", help="folder of a training run")
    parser.add_argument("--checkpoint", default="best", metavar="C", help="best or latest (best)")
    parser.add_argument("--to", type=user_path, required=True, metavar="FILE", help=".safetensors file to write")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Writes the file and the card."""
    from travjax.runs.model_card import export_run

    progress.wrote(*export_run(arguments.folder, arguments.to, arguments.checkpoint))
