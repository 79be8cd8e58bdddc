"""`travjax weights`: ImageNet weights for the trunk, checked and converted to one kind of file."""

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from travjax import options, progress
from travjax.config import InputError, require
from travjax.files import output_folder, user_path
from travjax.resnet.preprocessing import INPUTS

if TYPE_CHECKING:
    from travjax.resnet.imagenet_weights import Weights


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "weights",
        help="convert ImageNet weights of a ResNet50",
        description="Checks ImageNet weights of a ResNet50 name by name and shape by shape, says what they are, and "
        "writes them as DIR/resnet50.safetensors. Names may be those of torchvision, Hugging Face, Detectron2 or "
        "Keras, after any prefix (state_dict.module.); only the trunk is needed, other heads are left out. Not read "
        "are pickles of arrays (.pkl), weights in several files, .onnx, .msgpack, and files of TensorFlow.",
    )
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "--from",
        dest="path",
        type=user_path,
        metavar="FILE",
        help="file to convert: .npz, .h5 or .keras of Keras, .safetensors, .pth (.pt, .bin, .ckpt, .pth.tar) of torch",
    )
    source.add_argument(
        "--hub",
        nargs="?",
        const="",
        metavar="REPOSITORY",
        help="fetch them from the Hugging Face hub (timm/resnet50.tv_in1k)",
    )
    parser.add_argument("--file", metavar="NAME", help="file of the hub's repository (model.safetensors)")
    parser.add_argument(
        "--input",
        choices=INPUTS,
        metavar="I",
        help="pixels that the weights are made for, which names do not say: torch, R, G, B, (x / 255 - mean) / std; "
        "caffe, B, G, R, x - mean from 0 to 255; torch-bgr, caffe-rgb; tf, R, G, B from -1 to 1; unit, from 0 to 1 "
        "(caffe under the names of Keras and Detectron2, else torch)",
    )
    parser.add_argument(
        "--stride-in",
        choices=["1x1", "3x3"],
        help="the convolution that has the strides: 1x1 (v1), as in most that were made from Caffe's, or 3x3 (v1.5) "
        "(3x3 under the names of torchvision and Hugging Face, else 1x1)",
    )
    parser.add_argument(
        "--prefix", metavar="P", help="what names begin with, where a file holds several networks (state_dict_ema.)"
    )
    options.add_out(parser, "runs/weights")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Reads or fetches weights, prints what was found and writes them."""
    from travjax.resnet.imagenet_weights import describe, load_weights, save_safetensors  # flax takes 0.5 s to import

    if arguments.path:
        require(arguments.file is None, "--file", arguments.file, "left out where --from is given")
        weights = load_weights(arguments.path, **_told(arguments))
    else:
        weights = _fetched(arguments)
    path = output_folder(arguments.out) / "resnet50.safetensors"
    save_safetensors(weights, path)
    print(f"{describe(weights)}\n")
    progress.wrote(path)


def _told(arguments: argparse.Namespace) -> dict[str, Any]:
    """Returns what the options say about the weights."""
    return {"input": arguments.input, "stride_in": arguments.stride_in, "prefix": arguments.prefix}


def _fetched(arguments: argparse.Namespace) -> "Weights":
    """Fetches weights from the Hugging Face hub, and names the repository in their origin."""
    from travjax.resnet.imagenet_weights import HUB, fetch, load_weights

    repository, filename = arguments.hub or HUB[0], arguments.file or HUB[1]
    try:
        path = fetch(repository, filename)
    except InputError as error:
        raise InputError(f"{error}; convert a file instead: travjax weights --from FILE") from None
    weights = load_weights(path, **_told(arguments))
    return replace(weights, origin=f"{repository}: {weights.origin}")
