"""Recognises whose names a file of ResNet weights uses, and which of its arrays belong to the network.

The canonical names are those of imagenet_weights.py. Names of any other program may have a prefix, as in
`state_dict.module.conv1.weight`.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from travjax.config import InputError
from travjax.resnet.stored_arrays import Stored, shown

CLASSES = 1000

TRAINING = ("optimizer", "optimizer_weights", "opt_state")
"""Keys under which a checkpoint keeps the training state."""

_TORCHVISION = {"gamma": "weight", "beta": "bias", "mean": "running_mean", "var": "running_var"}
_KERAS = {"gamma": "gamma", "beta": "beta", "mean": "moving_mean", "var": "moving_variance"}


@dataclass(frozen=True)
class Naming:
    """How a kind of file names and stores arrays, and the usual settings of its networks.

    name:      function from (layer, array), both canonical, to the name in the file
    by_output: whether kernels are stored [out, in, rows, cols] and [out, in], as in torch
    biased:    whether convolutions have a bias
    input:     one of preprocessing.INPUTS
    """

    title: str
    name: Callable[[str, str], str]
    stride_in: str = "1x1"
    epsilon: float = 1e-5
    by_output: bool = False
    biased: bool = False
    input: str = "torch"

    def stored(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Returns the shape in the file of an array of canonical shape."""
        return (*shape[:-3:-1], *shape[:-2]) if self.by_output else shape


def _position(layer: str) -> tuple[int, int, int]:
    """Returns (stage from 2, block from 0, 0 for the projection or 1 to 3 along the block): "res3b_branch2c" is (3, 1,
    3).
    """
    stage, block, branch = re.fullmatch(r"res(\d)([a-z])_branch(1|2[abc])", layer).groups()  # type: ignore[union-attr]
    return int(stage), ord(block) - ord("a"), {"1": 0, "2a": 1, "2b": 2, "2c": 3}[branch]


def _torchvision_name(layer: str, array: str) -> str:
    if layer == "fc1000":
        return "fc.weight" if array == "kernel" else "fc.bias"
    block, number = "", 1
    if layer != "conv1":
        stage, index, number = _position(layer)
        block = f"layer{stage - 1}.{index}."
    convolution, norm = (f"conv{number}", f"bn{number}") if number else ("downsample.0", "downsample.1")
    return f"{block}{convolution}.weight" if array == "kernel" else f"{block}{norm}.{_TORCHVISION[array]}"


def _hugging_face_name(layer: str, array: str) -> str:
    """Returns an array's name in ResNetForImageClassification (modeling_resnet.py of huggingface/transformers)."""
    if layer == "fc1000":
        return "classifier.1.weight" if array == "kernel" else "classifier.1.bias"
    place = "embedder.embedder"
    if layer != "conv1":
        stage, index, number = _position(layer)
        place = f"encoder.stages.{stage - 2}.layers.{index}.{f'layer.{number - 1}' if number else 'shortcut'}"
    return f"resnet.{place}." + ("convolution.weight" if array == "kernel" else f"normalization.{_TORCHVISION[array]}")


def _detectron_name(layer: str, array: str) -> str:
    """Returns an array's name in the ResNet of facebookresearch/detectron2, whose classifier is called `linear`."""
    if layer == "fc1000":
        return "linear.weight" if array == "kernel" else "linear.bias"
    place = "stem.conv1"
    if layer != "conv1":
        stage, index, number = _position(layer)
        place = f"res{stage}.{index}.{f'conv{number}' if number else 'shortcut'}"
    return f"{place}.weight" if array == "kernel" else f"{place}.norm.{_TORCHVISION[array]}"


def _keras_name(layer: str, array: str) -> str:
    if layer == "fc1000":
        return f"predictions/{array}"
    if layer != "conv1":
        stage, block, number = _position(layer)
        layer = f"conv{stage}_block{block + 1}_{number}"
    return f"{layer}_bn/{_KERAS[array]}" if array in _KERAS else f"{layer}_conv/{array}"


def _caffe_name(layer: str, array: str) -> str:
    if array not in _KERAS:
        return f"{layer}/{array}"
    return f"bn_conv1/{_KERAS[array]}" if layer == "conv1" else f"bn{layer.removeprefix('res')}/{_KERAS[array]}"


def _bare_hugging_face_name(layer: str, array: str) -> str:
    """Returns an array's name in ResNetModel and ResNetBackbone."""
    return _hugging_face_name(layer, array).removeprefix("resnet.")


NAMINGS = (
    Naming("canonical", lambda layer, array: f"{layer}/{array}"),
    Naming("torchvision", _torchvision_name, stride_in="3x3", by_output=True),
    Naming("Hugging Face", _hugging_face_name, stride_in="3x3", by_output=True),
    Naming("Hugging Face", _bare_hugging_face_name, stride_in="3x3", by_output=True),
    Naming("Detectron2", _detectron_name, by_output=True, input="caffe"),
    Naming("Keras", _keras_name, epsilon=1.001e-5, biased=True, input="caffe"),
    # From 2016 to 2018 Keras left epsilon at its default; with it these weights are the most accurate if the pool is
    # padded: github.com/keras-team/keras-applications/issues/8.
    Naming("Keras before 2.2", _caffe_name, epsilon=1e-3, biased=True, input="caffe"),
)


@dataclass(frozen=True)
class Recognised:
    """The network in a file.

    prefix:     text before each of its names
    expected:   names in the file, with canonical names and stored shapes
    unexpected: names of arrays that would belong to another network
    left_out:   names of arrays that do not belong to the network: other heads, other parts of a checkpoint
    """

    naming: Naming
    prefix: str
    expected: dict[str, tuple[str, tuple[int, ...]]]
    unexpected: list[str]
    left_out: list[str]

    def name(self, canonical: str) -> str:
        """Returns the name in the file."""
        return self.prefix + self.naming.name(*canonical.split("/"))


def recognised(
    found: Mapping[str, Stored], namings: Sequence[Naming], shapes: dict[str, tuple[int, ...]], prefix: str | None
) -> Recognised:
    """Returns the network in a file, by the naming and the prefix that most arrays follow.

    shapes: shapes of the network's arrays and of a top layer of CLASSES, by canonical name
    prefix: start of the prefix, where a file holds several networks
    Raises InputError when there is no network, or when there are several that no prefix tells apart.
    """
    best, ties = (0, namings[0], ""), [""]
    for naming in namings:
        names = [naming.name(*name.split("/")) for name in shapes]
        for start in _prefixes(found, naming.name("conv1", "kernel")):
            count = sum(start + name in found for name in names)
            if prefix is not None and not start.startswith(prefix):
                continue
            if count > best[0]:
                best, ties = (count, naming, start), [start]
            elif count == best[0] and naming is best[1]:
                ties.append(start)
    count, naming, start = best
    if not count:
        known = ", ".join(dict.fromkeys(naming.name("conv1", "kernel") for naming in namings))
        under = "" if prefix is None else f" that begin with {prefix!r}"
        raise InputError(
            f"no array of a ResNet among its {len(found)}{under}; allowed names are, for the first: {known}"
        )
    if len(ties) > 1 and 2 * count > len(
        shapes
    ):  # else the file fits none of them, and the error lists what is missing
        several = ", ".join(shown(repr(tie)) for tie in ties[:4])
        raise InputError(f"holds {len(ties)} networks, whose names begin with {several}: --prefix must say which")
    return _sorted_out(found, naming, start, shapes)


def _prefixes(found: Mapping[str, Stored], first: str) -> list[str]:
    """Returns every prefix with which the first array's name occurs."""
    starts = [name.removesuffix(first) for name in found if name.endswith(first)]
    return [start for start in starts if not start or start[-1] in "./"]


def _sorted_out(
    found: Mapping[str, Stored], naming: Naming, prefix: str, shapes: dict[str, tuple[int, ...]]
) -> Recognised:
    if naming.biased:
        shapes = shapes | {name.replace("/beta", "/bias"): shape for name, shape in shapes.items() if "/beta" in name}
    top = {name: shape for name, shape in shapes.items() if name.startswith("fc1000/")}
    in_file = lambda name: prefix + naming.name(*name.split("/"))
    if not any(in_file(name) in found for name in top) or _is_other_head(found, in_file, naming, top):
        shapes = {name: shape for name, shape in shapes.items() if name not in top}
    expected = {in_file(name): (name, naming.stored(shape)) for name, shape in shapes.items()}
    inside: list[str] = []
    left_out: list[str] = []
    for name in found.keys() - expected.keys():
        own = name.startswith(prefix) and re.split("[./]", name.removeprefix(prefix))[0] not in TRAINING
        (inside if own else left_out).append(name)
    if _are_heads([found[name].shape for name in inside], top["fc1000/kernel"][0]):
        inside, left_out = [], left_out + inside
    return Recognised(naming, prefix, expected, sorted(inside), sorted(left_out))


def _is_other_head(found: Mapping[str, Stored], in_file: Callable[[str], str], naming: Naming, top: dict) -> bool:
    """Tells whether the top layer has another number of classes, or no bias for each of them."""
    kernel, bias = (found.get(in_file(name)) for name in top)
    if kernel is None or len(kernel.shape) != 2:
        return False
    features, classes = kernel.shape[::-1] if naming.by_output else kernel.shape
    whole = classes == CLASSES and bias is not None and bias.shape == (CLASSES,)
    return features == top["fc1000/kernel"][0] and not whole


def _are_heads(shapes: list[tuple[int, ...]], features: int) -> bool:
    """Tells whether arrays may be dense layers, possibly with norms, on a network's features."""
    return all(len(shape) <= 2 for shape in shapes) and any(len(s) == 2 and features in s for s in shapes)
