"""ImageNet weights for the trunk: read from several kinds of files, checked name by name and shape by shape, and set.

Whatever file they come from (weight_files.py), arrays are float32 afterwards and have one set of names: for each
convolution `res2a_branch2a/kernel`, `/gamma`, `/beta`, `/mean`, `/var`; for the top layer, if there is one,
`fc1000/kernel` and `fc1000/bias`. Kernels are [rows, cols, in, out] and take channels in the order R, G, B with values
(x / 255 - mean) / std, about -2 to 2, a range that the channels of SPEC section 6 share.

The weights of Keras are made for B, G, R with values x - mean (its `preprocess_input` in mode "caffe"), hundreds of
units wide. Their first kernel is reversed and multiplied by PIXEL_SCALE, so that it does to (x / 255 - mean) / std
what it did to their own values; the means of Keras, 103.939, 116.779, 123.68, are the same to half a unit.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from flax import nnx
from tabulate import tabulate

from travjax.config import InputError, require
from travjax.flags import key_of
from travjax.resnet import ResNet, ResNetConfig
from travjax.weight_files import read_arrays, write_safetensors

CLASSES = 1000

PIXEL_SCALE = 255 * np.array([0.229, 0.224, 0.225], np.float32)
"""Pixel values from 0 to 255 for one unit of (x / 255 - mean) / std, in the order R, G, B."""

HUB = ("timm/resnet50.tv_in1k", "model.safetensors")
"""Repository and file on the Hugging Face hub: the weights of torchvision."""

SHOWN = 6
"""Mismatches that an error names; the others are counted."""

_CANONICAL = {"kernel": "kernel", "scale": "gamma", "bias": "beta", "mean": "mean", "var": "var"}
_TORCHVISION = {"gamma": "weight", "beta": "bias", "mean": "running_mean", "var": "running_var"}
_KERAS = {"gamma": "gamma", "beta": "beta", "mean": "moving_mean", "var": "moving_variance"}


@dataclass(frozen=True)
class Weights:
    """Weights of a ResNet as load_weights read them.

    arrays:    float32, by canonical name
    path:      the file
    naming:    whose names the file uses
    origin:    file and naming of which a file of save_safetensors was made, else of this file
    stride_in: where the network that they were made for has its strides: "1x1" (v1) or "3x3" (v1.5)
    epsilon:   that network's batch-norm epsilon
    """

    arrays: dict[str, np.ndarray]
    path: str
    naming: str
    origin: str
    stride_in: str
    epsilon: float

    @property
    def classifier(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Kernel [features, 1000] and bias [1000] of the top layer, if the file has one."""
        if "fc1000/kernel" not in self.arrays:
            return None
        return self.arrays["fc1000/kernel"], self.arrays["fc1000/bias"]


@dataclass(frozen=True)
class _Naming:
    """How a kind of file names and stores the arrays.

    name:      (layer, array), both canonical, to the name in the file
    by_output: kernels are stored [out, in, rows, cols] and [out, in]
    by_pixel:  the first kernel takes B, G, R from 0 to 255, and convolutions have a bias
    """

    title: str
    name: Callable[[str, str], str]
    stride_in: str = "1x1"
    epsilon: float = 1e-5
    by_output: bool = False
    by_pixel: bool = False


def _position(layer: str) -> tuple[int, int, int]:
    """Stage from 2, block from 0, and 0 for the projection or 1 to 3 along the block: "res3b_branch2c" is (3, 1, 3)."""
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


_NAMINGS = (
    _Naming("canonical", lambda layer, array: f"{layer}/{array}"),
    _Naming("torchvision", _torchvision_name, stride_in="3x3", by_output=True),
    _Naming("Keras", _keras_name, epsilon=1.001e-5, by_pixel=True),
    # Of 2016 to 2018, when Keras left epsilon at its default, with which these weights are the most accurate if the
    # pool is padded: github.com/keras-team/keras-applications/issues/8.
    _Naming("Keras before 2.2", _caffe_name, epsilon=1e-3, by_pixel=True),
)


def load_weights(path: str | Path, config: ResNetConfig = ResNetConfig()) -> Weights:
    """Reads and checks the weights of a network of this size, with or without its top layer.

    Raises InputError when the file is missing, damaged or of no known kind, needs pickled code to be run, or its arrays
    do not fit: missing, unexpected, of a wrong shape, no floating-point numbers, not finite, a negative variance. All
    of those are in one error.
    """
    path = Path(path)
    try:
        found, notes = read_arrays(path)
        naming, expected = _recognised(found, config)
        _check(found, naming, expected, config)
        stride_in, epsilon = notes.get("stride_in", naming.stride_in), notes.get("epsilon", naming.epsilon)
        replace(config, stride_in=stride_in, epsilon=epsilon)  # raises InputError unless they are allowed
        return Weights(
            arrays=_converted(found, naming, expected),
            path=str(path),
            naming=naming.title,
            origin=notes.get("origin", f"{path.name}, {naming.title} names"),
            stride_in=stride_in,
            epsilon=epsilon,
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _variables(resnet: ResNet) -> dict[str, nnx.Variable]:
    """Parameters and statistics by canonical name."""
    named = {}
    for path, node in nnx.iter_graph(resnet):
        if isinstance(node, nnx.Variable):
            *layer, array = map(str, path)
            named[f"{'_'.join(layer)}/{_CANONICAL[array]}"] = node
    return named


@lru_cache
def _shapes(config: ResNetConfig) -> dict[str, tuple[int, ...]]:
    """Canonical names and shapes of a network's arrays, with those of the top layer."""
    resnet = nnx.eval_shape(lambda: ResNet(config, rngs=nnx.Rngs(key_of(0))))
    shapes = {name: variable.shape for name, variable in _variables(resnet).items()}
    return shapes | {"fc1000/kernel": (config.features, CLASSES), "fc1000/bias": (CLASSES,)}


def _recognised(found: dict, config: ResNetConfig) -> tuple[_Naming, dict[str, tuple[str, tuple[int, ...]]]]:
    """The naming that most arrays follow; and the canonical name and the shape of each array that should be there."""

    def expected(naming: _Naming) -> dict[str, tuple[str, tuple[int, ...]]]:
        shapes = dict(_shapes(config))
        if naming.by_pixel:
            shapes |= {name.replace("/beta", "/bias"): shape for name, shape in shapes.items() if "/beta" in name}
        by_name = {naming.name(*name.split("/")): (name, shape) for name, shape in shapes.items()}
        top = {name for name, (canonical, _) in by_name.items() if canonical.startswith("fc1000/")}
        return by_name if top & set(found) else {name: by_name[name] for name in by_name if name not in top}

    candidates = [(naming, expected(naming)) for naming in _NAMINGS]
    naming, wanted = max(candidates, key=lambda candidate: len(candidate[1].keys() & found.keys()))
    if not wanted.keys() & found.keys():
        known = ", ".join(dict.fromkeys(naming.name("conv1", "kernel") for naming in _NAMINGS))
        raise InputError(f"no array of a ResNet among its {len(found)}; allowed names are, for the first: {known}")
    return naming, wanted


def _check(found: dict[str, np.ndarray], naming: _Naming, expected: dict, config: ResNetConfig) -> None:
    """Raises InputError that names whatever does not fit."""
    wrong = [f"{name} is missing" for name in expected if name not in found]
    wrong += [f"{name} is unexpected" for name in found if name not in expected]
    for name in [name for name in expected if name in found]:
        canonical, shape = expected[name]
        array, shape = found[name], _stored(shape) if naming.by_output else shape
        if not jnp.issubdtype(array.dtype, jnp.floating):
            wrong.append(f"{name} is {array.dtype}, not floating-point")
        elif array.shape != shape:
            wrong.append(f"{name} is {list(array.shape)}, not {list(shape)}")
        elif not np.isfinite(_float32(array)).all():
            wrong.append(f"{name} is not finite throughout")
        elif canonical.endswith("/var") and (array < 0).any():
            wrong.append(f"{name} is negative somewhere")
    if wrong:
        more = f"; and {len(wrong) - SHOWN} more" if len(wrong) > SHOWN else ""
        count = f"{len(wrong)} array{'s' if len(wrong) > 1 else ''}"
        size = f"a trunk of blocks {list(config.blocks)}, width {config.width}"
        raise InputError(f"{count} of {naming.title} naming wrong for {size}: {'; '.join(wrong[:SHOWN])}{more}")


def _stored(shape: tuple[int, ...]) -> tuple[int, ...]:
    """[rows, cols, in, out] -> [out, in, rows, cols], [in, out] -> [out, in]."""
    return (*shape[:-3:-1], *shape[:-2])


def _float32(array: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        return array.astype(np.float32)


def _converted(found: dict[str, np.ndarray], naming: _Naming, expected: dict) -> dict[str, np.ndarray]:
    """Canonical arrays; a convolution's bias is taken off the mean that is subtracted from its output."""
    arrays = {canonical: _float32(found[name]) for name, (canonical, _) in expected.items()}
    if naming.by_output:
        for name, array in arrays.items():
            if array.ndim > 1:
                arrays[name] = np.ascontiguousarray(np.moveaxis(array, (0, 1), (-1, -2)))
    if naming.by_pixel:
        for layer in [name.removesuffix("/mean") for name in arrays if name.endswith("/mean")]:
            arrays[f"{layer}/mean"] -= arrays.pop(f"{layer}/bias")
        arrays["conv1/kernel"] = arrays["conv1/kernel"][:, :, ::-1] * PIXEL_SCALE[:, None]
    return arrays


def apply_weights(resnet: ResNet, weights: Weights) -> None:
    """Sets the trunk's parameters and statistics, also those of a network of `nnx.eval_shape`, which has none yet.

    Where the epsilons differ gamma makes up for it, so that the function stays the same.
    Raises InputError when the sizes differ, or the strides are in other convolutions.
    """
    allowed = f'"{weights.stride_in}", as in the network of these weights ({weights.origin})'
    require(resnet.config.stride_in == weights.stride_in, "stride_in", resnet.config.stride_in, allowed)
    variables = _variables(resnet)
    trunk = {name: array for name, array in weights.arrays.items() if not name.startswith("fc1000/")}
    fits = {name: array.shape for name, array in trunk.items()} == {n: v.shape for n, v in variables.items()}
    size = f"blocks {resnet.config.blocks}, width {resnet.config.width}"
    require(fits, "config", size, f"of the size of these weights ({weights.origin})")
    for name, variable in variables.items():
        array = trunk[name]
        if name.endswith("/gamma"):
            var = trunk[name.replace("/gamma", "/var")].astype(np.float64)
            array = array * np.sqrt((var + resnet.config.epsilon) / (var + weights.epsilon))
        variable.set_value(jnp.asarray(array, jnp.float32))


def save_safetensors(weights: Weights, path: str | Path) -> None:
    """Writes canonical names and arrays to a file that load_weights reads back, whole or not at all."""
    notes = {key: getattr(weights, key) for key in ("origin", "stride_in", "epsilon")}
    write_safetensors(Path(path), weights.arrays, notes)


def fetch(repository: str = HUB[0], filename: str = HUB[1]) -> Path:
    """A file of the Hugging Face hub, from its cache if it was fetched before.

    Raises InputError when it cannot be fetched.
    """
    try:
        import huggingface_hub
    except ImportError:
        raise InputError("fetching weights needs huggingface_hub: pip install huggingface_hub") from None
    huggingface_hub.utils.logging.set_verbosity_error()  # it says each time that it tries again
    try:
        return Path(huggingface_hub.hf_hub_download(repository, filename))
    except Exception as error:  # of whichever HTTP client it uses
        reason = (str(error) or type(error).__name__).splitlines()[0].rstrip(".")
        raise InputError(f"{repository}/{filename}: cannot be fetched; allowed offline: a file: {reason}") from None


def describe(weights: Weights) -> str:
    """A table of what was found."""
    kernels = [array for name, array in weights.arrays.items() if name.endswith("/kernel")]
    zero = sum(int((kernel == 0).sum()) for kernel in kernels) / sum(kernel.size for kernel in kernels)
    rows = {
        "file": weights.path,
        "names": weights.naming,
        "origin": weights.origin,
        "arrays": len(weights.arrays),
        "numbers": f"{sum(array.size for array in weights.arrays.values()):,}",
        "zeros in kernels": f"{zero:.1%}",
        "top layer": f"{CLASSES} classes" if weights.classifier else "none",
        "strides": f"in the {weights.stride_in} convolutions ({'v1' if weights.stride_in == '1x1' else 'v1.5'})",
        "batch-norm epsilon": f"{weights.epsilon:g}",
        "input": "R, G, B, (x / 255 - mean) / std",
    }
    return tabulate(rows.items(), tablefmt="plain", disable_numparse=True)
