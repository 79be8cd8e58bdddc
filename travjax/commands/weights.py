"""`travjax weights`: ImageNet weights for the trunk, checked and converted to one kind of file."""

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

from travjax.commands import options
from travjax.config import InputError, require
from travjax.files import output_folder, user_path

if TYPE_CHECKING:
    from travjax.imagenet import Weights


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "weights",
        help="convert ImageNet weights of a ResNet50",
        description="Checks ImageNet weights of a ResNet50 name by name and shape by shape, says what they are, and "
        "writes them as DIR/resnet50.safetensors.",
    )
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "--from",
        dest="path",
        type=user_path,
        metavar="FILE",
        help=".npz, Keras .h5, .safetensors or .pth file to convert",
    )
    source.add_argument(
        "--hub",
        nargs="?",
        const="",
        metavar="REPOSITORY",
        help="fetch them from the Hugging Face hub (timm/resnet50.tv_in1k)",
    )
    parser.add_argument("--file", metavar="NAME", help="file of the hub's repository (model.safetensors)")
    options.add_out(parser, "runs/weights")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Reads or fetches weights, prints what was found and writes them."""
    from travjax.imagenet import describe, load_weights, save_safetensors  # flax takes 0.5 s to import

    if arguments.path:
        require(arguments.file is None, "--file", arguments.file, "left out where --from is given")
        weights = load_weights(arguments.path)
    else:
        weights = _fetched(arguments.hub, arguments.file)
    path = output_folder(arguments.out) / "resnet50.safetensors"
    save_safetensors(weights, path)
    print(describe(weights), f"\n{path}", sep="\n")


def _fetched(repository: str, filename: str | None) -> "Weights":
    """Weights of the hub, the repository in their origin."""
    from travjax.imagenet import HUB, fetch, load_weights

    repository, filename = repository or HUB[0], filename or HUB[1]
    try:
        path = fetch(repository, filename)
    except InputError as error:
        raise InputError(f"{error}; convert a file instead: travjax weights --from FILE") from None
    weights = load_weights(path)
    return replace(weights, origin=f"{repository}: {weights.origin}")
