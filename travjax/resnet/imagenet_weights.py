"""ImageNet weights for the trunk: read from several kinds of files, checked name by name and shape by shape, and set.

Whatever file they come from (weight_files.py), arrays become float32 with one set of canonical names: for each
convolution `res2a_branch2a/kernel`, `/gamma`, `/beta`, `/mean`, `/var`; for the top layer, if there is one of 1000
classes, `fc1000/kernel` and `fc1000/bias`. Kernels are [rows, cols, in, out] and take channels in the order R, G, B
with values (x / 255 - mean) / std, about -2 to 2, a range that the input channels share (SPEC section 8).

The weights of Keras expect B, G, R with values x - mean (its `preprocess_input` in mode "caffe"), hundreds of
units wide. Their first kernel is reversed and multiplied by PIXEL_SCALE, so that it does to (x / 255 - mean) / std
what it did to their own values. Files with other names may also expect such values: see preprocessing.py.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from flax import nnx
from tabulate import tabulate

from travjax.config import InputError, require
from travjax.files import user_path
from travjax.jax_flags import key_of
from travjax.resnet.namings import CLASSES, Recognised, recognised
from travjax.resnet.namings import NAMINGS as _NAMINGS
from travjax.resnet.network import ResNet, ResNetConfig
from travjax.resnet.preprocessing import (
    INPUTS,
    converted,
    has_statistics,
    is_untrained,
    require_fit,
    require_kernel,
    require_statistics,
)
from travjax.resnet.stored_arrays import Stored, WeightFile, shown
from travjax.resnet.weight_files import open_arrays, write_safetensors

HUB = ("timm/resnet50.tv_in1k", "model.safetensors")
"""Repository and file of torchvision's weights on the Hugging Face hub."""

SHOWN = 6
"""Number of mismatches that an error names; the others are counted."""

_CANONICAL = {"kernel": "kernel", "scale": "gamma", "bias": "beta", "mean": "mean", "var": "var"}


@dataclass(frozen=True)
class Weights:
    """Weights of a ResNet, as load_weights returns them.

    arrays:    float32 arrays by canonical name
    path:      the file
    naming:    the program whose names the file uses
    origin:    file and naming that a file of save_safetensors was made from, else those of this file
    stride_in: convolution with the strides in the network they were made for: "1x1" (v1) or "3x3" (v1.5)
    epsilon:   that network's batch-norm epsilon
    input:     pixel values that network expects, one of preprocessing.INPUTS; the arrays here expect those of "torch"
    left_out:  arrays of the file that do not belong to the network, such as a top layer of other classes, with shapes
    """

    arrays: dict[str, np.ndarray]
    path: str
    naming: str
    origin: str
    stride_in: str
    epsilon: float
    input: str = "torch"
    left_out: tuple[str, ...] = ()

    @property
    def classifier(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Kernel [features, 1000] and bias [1000] of the top layer, if the file has one."""
        if "fc1000/kernel" not in self.arrays:
            return None
        return self.arrays["fc1000/kernel"], self.arrays["fc1000/bias"]


def load_weights(
    path: str | Path,
    config: ResNetConfig = ResNetConfig(),
    *,
    input: str | None = None,
    stride_in: str | None = None,
    prefix: str | None = None,
) -> Weights:
    """Reads and checks the weights of a network of this size, with or without its top layer.

    input, stride_in: what names do not tell: one of preprocessing.INPUTS, and "1x1" or "3x3". By default the usual ones
        for the file's names. The input is checked as far as the numbers allow
    prefix: start of the names, where a file holds several networks
    Raises InputError when the file is missing, damaged or of no known kind, when it needs pickled code to be run, when
    its weights were evidently made for another input, and when arrays do not fit: missing, unexpected, of a wrong
    shape, not floating-point, not finite, or with a negative variance. One error lists all that do not fit.
    """
    path = user_path(path)
    try:
        require(input is None or input in list(INPUTS), "input", input, f"one of {', '.join(INPUTS)}")
        with open_arrays(path) as file:
            network = recognised(file.arrays, _NAMINGS, _shapes(config), prefix)
            arrays = _read(file.arrays, network, config)
            left_out = tuple(f"{shown(name)} {list(file.arrays[name].shape)}" for name in network.left_out)
        settings = _settings(file, network, input, stride_in, path)
        replace(config, stride_in=settings["stride_in"], epsilon=settings["epsilon"])  # raises unless both are allowed
        arrays = _canonical(arrays, network, settings["input"], told=input is not None, ours=bool(file.notes))
        return Weights(arrays, str(path), network.naming.title, left_out=left_out, **settings)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _settings(file: WeightFile, network: Recognised, input: str | None, stride_in: str | None, path: Path) -> dict:
    """Returns origin, strides, epsilon and input: from the file, else as given, else the usual ones for its names."""
    naming, notes = network.naming, file.notes
    if notes:
        require(input in (None, "torch"), "input", input, "left out: the file is one of travjax weights, for torch")
        require(stride_in in (None, notes.get("stride_in")), "stride_in", stride_in, f"{notes.get('stride_in')!r} here")
    elif input != naming.input and (input or "").startswith("caffe") and naming.by_output:
        allowed = "1x1, as in most of Caffe's, or 3x3: --stride-in, which names do not say"
        require(stride_in is not None, "stride_in", stride_in, allowed)
    given = "" if input in (None, naming.input) else f", input {input}"
    return {
        "origin": notes.get("origin", f"{path.name}, {naming.title} names{given}"),
        "stride_in": notes.get("stride_in", stride_in or naming.stride_in),
        "epsilon": notes.get("epsilon", naming.epsilon),
        "input": input or naming.input,
    }


def _variables(resnet: ResNet) -> dict[str, nnx.Variable]:
    """Returns parameters and statistics by canonical name."""
    named = {}
    for path, node in nnx.iter_graph(resnet):
        if isinstance(node, nnx.Variable):
            *layer, array = map(str, path)
            named[f"{'_'.join(layer)}/{_CANONICAL[array]}"] = node
    return named


@lru_cache
def _shapes(config: ResNetConfig) -> dict[str, tuple[int, ...]]:
    """Returns canonical names and shapes of a network's arrays, with those of the top layer."""
    resnet = nnx.eval_shape(lambda: ResNet(config, rngs=nnx.Rngs(key_of(0))))
    shapes = {name: variable.shape for name, variable in _variables(resnet).items()}
    return shapes | {"fc1000/kernel": (config.features, CLASSES), "fc1000/bias": (CLASSES,)}


def _read(found: dict[str, Stored], network: Recognised, config: ResNetConfig) -> dict[str, np.ndarray]:
    """Reads the network's arrays, float32, by canonical name; raises InputError that names whatever does not fit.

    Only arrays of the right shape are read, so reading takes no more memory than the network.
    """
    wrong = [f"{shown(name)} is missing" for name in network.expected if name not in found]
    wrong += [f"{shown(name)} is unexpected" for name in network.unexpected]
    arrays = {}
    for name, (canonical, shape) in network.expected.items():
        if name not in found:
            continue
        stored = found[name]
        if not stored.floating:
            wrong.append(f"{shown(name)} is {shown(stored.dtype)}, not floating-point")
        elif stored.shape != shape:
            wrong.append(f"{shown(name)} is {list(stored.shape)}, not {list(shape)}")
        else:
            array = arrays[canonical] = _float32(stored.read())
            if not np.isfinite(array).all():
                wrong.append(f"{shown(name)} is not finite throughout")
            elif canonical.endswith("/var") and (array < 0).any():
                wrong.append(f"{shown(name)} is negative somewhere")
    if wrong:
        more = f"; and {len(wrong) - SHOWN} more" if len(wrong) > SHOWN else ""
        count = f"{len(wrong)} array{'s' if len(wrong) > 1 else ''}"
        size = f"a trunk of blocks {list(config.blocks)}, width {config.width}"
        raise InputError(f"{count} of {network.naming.title} naming wrong for {size}: {'; '.join(wrong[:SHOWN])}{more}")
    return arrays


def _float32(array: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        return array.astype(np.float32)


def _canonical(
    arrays: dict[str, np.ndarray], network: Recognised, input: str, told: bool, ours: bool
) -> dict[str, np.ndarray]:
    """Converts arrays to the canonical layout and input; a convolution's bias is subtracted from the running mean.

    told: whether the user gave the input; the weights may then lack statistics
    ours: whether `travjax weights` wrote the file, in which case the input was checked then
    """
    names = {canonical: shown(name) for name, (canonical, _) in network.expected.items()}
    require_kernel(arrays, names)
    if not (told or ours):
        require_statistics(arrays, names)
    measured = has_statistics(arrays)
    if network.naming.by_output:
        kernels = {name: array for name, array in arrays.items() if array.ndim > 1}
        arrays |= {name: np.ascontiguousarray(np.moveaxis(array, (0, 1), (-1, -2))) for name, array in kernels.items()}
    if network.naming.biased:
        for layer in [name.removesuffix("/mean") for name in arrays if name.endswith("/mean")]:
            arrays[f"{layer}/mean"] -= arrays.pop(f"{layer}/bias")
    arrays = converted(arrays, INPUTS[input])
    if measured and not ours:
        require_fit(arrays, input, names)
    return arrays


def apply_weights(resnet: ResNet, weights: Weights) -> None:
    """Sets the trunk's parameters and statistics, even in a network of `nnx.eval_shape`, which has no arrays yet.

    Where the epsilons differ, gamma is scaled to compensate, so that the function stays the same.
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
    """Writes canonical arrays to a file that load_weights reads; the file is written whole or not at all."""
    notes = {key: getattr(weights, key) for key in ("origin", "stride_in", "epsilon")}
    write_safetensors(user_path(path), weights.arrays, notes)


def fetch(repository: str = HUB[0], filename: str = HUB[1]) -> Path:
    """Fetches a file from the Hugging Face hub, or from the cache if it was fetched before.

    Raises InputError when it cannot be fetched.
    """
    try:
        import huggingface_hub
    except ImportError:
        raise InputError("fetching weights needs huggingface_hub: pip install huggingface_hub") from None
    huggingface_hub.utils.logging.set_verbosity_error()  # it would print a line for every retry
    try:
        return Path(huggingface_hub.hf_hub_download(repository, filename))
    except Exception as error:  # which one depends on its HTTP client
        reason = (str(error) or type(error).__name__).splitlines()[0].rstrip(".")
        raise InputError(f"{repository}/{filename}: cannot be fetched; allowed offline: a file: {reason}") from None


def describe(weights: Weights) -> str:
    """Returns a table that describes the weights."""
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
        "left out": _left_out(weights),
        "strides": f"in the {weights.stride_in} convolutions ({'v1' if weights.stride_in == '1x1' else 'v1.5'})",
        "batch-norm epsilon": f"{weights.epsilon:g}",
        "statistics": _statistics(weights.arrays),
        "made for": INPUTS[weights.input].text,
        "input": INPUTS["torch"].text,
    }
    return tabulate(rows.items(), tablefmt="plain", disable_numparse=True)


def _statistics(arrays: dict[str, np.ndarray]) -> str:
    """Says whether running means and variances were measured, and why not."""
    if has_statistics(arrays):
        return "measured"
    return "0 and 1: " + ("a network before training" if is_untrained(arrays) else "none, gamma and beta hold them")


def _left_out(weights: Weights) -> str:
    """Names the first arrays that do not belong to the network."""
    names = weights.left_out
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return f"{', '.join(names[:SHOWN])}{more}; only the trunk is needed" if names else "nothing"
