"""The pixel values that a ResNet's weights expect, and their conversion to (x / 255 - mean) / std in R, G, B.

The names in a file do not tell which values its weights expect, but its numbers tell something. Statistics of 0 and 1
throughout were never measured. The variance of a convolution's output is bounded by its kernel and its input, so that a
first kernel for pixels up to 255 is not mistaken for one for values about 1. The first running means also show the mean
of the input. The order of the colours and the place of the strides leave no trace.
"""

from dataclasses import dataclass

import numpy as np

from travjax.config import InputError

MEAN = np.array([0.485, 0.456, 0.406])
STD = np.array([0.229, 0.224, 0.225])

PIXEL_SCALE = 255 * STD.astype(np.float32)
"""Change in pixel value, on the scale 0 to 255, for one unit of (x / 255 - mean) / std, in the order R, G, B."""

MOST = 49 * float(np.sum((0.5 / STD) ** 2))
"""Upper bound, 720, on the output variance over the sum of squares of a 7 x 7 kernel: a pixel from 0 to 1 has a
variance of at most 1/4, and a weighted sum has at most the sum of the squared weights times the sum of the variances. A
quarter of the filters of resnet50_imagenet.npz have a ratio of 4 or more."""

LEAST = 0.02
"""Ratio that a quarter of the filters exceed in any network. It is not a strict bound, but only filters for the finest
texture come near it. If values about 1 were mistaken for pixels up to 255, the 4 above would be 0.001."""

EXPLAINED = 0.9
"""Share of the first running means that the mean of three colours must explain to be trusted (0.99 in
resnet50_imagenet.npz, 0.05 for random numbers)."""

FEWEST = 16
"""Fewest filters for which this is tried."""

NEAR = 0.06
"""Largest difference between equal means of colours, in units of (x / 255 - mean) / std; 0.04 in
resnet50_imagenet.npz.
"""


@dataclass(frozen=True)
class PixelInput:
    """Values of pixels, scale * y + offset where y is (x / 255 - mean) / std; both in the order R, G, B.

    reverse: whether the first kernel takes B, G, R
    """

    text: str
    scale: np.ndarray
    offset: np.ndarray
    reverse: bool = False


_ONES, _NONE = np.ones(3, np.float32), np.zeros(3)

INPUTS = {
    "torch": PixelInput("R, G, B, (x / 255 - mean) / std", _ONES, _NONE),
    "torch-bgr": PixelInput("B, G, R, (x / 255 - mean) / std", _ONES, _NONE, reverse=True),
    # The means of Keras, 103.939, 116.779, 123.68, and those of others agree to within one unit.
    "caffe": PixelInput("B, G, R, x - mean, from 0 to 255", PIXEL_SCALE, _NONE, reverse=True),
    "caffe-rgb": PixelInput("R, G, B, x - mean, from 0 to 255", PIXEL_SCALE, _NONE),
    "tf": PixelInput("R, G, B, x / 127.5 - 1", 2 * STD.astype(np.float32), 2 * MEAN - 1),
    "unit": PixelInput("R, G, B, x / 255", STD.astype(np.float32), MEAN),
}
"""Inputs by name, as in Keras' preprocess_input where it has one; mean and std are those of ImageNet."""

MEANS = ("torch", "tf", "unit")
"""Inputs with values about 1, which only their means tell apart."""

CONVERT = "travjax weights --from FILE --input {} takes them as what they are"

FROM_CAFFE = "caffe --stride-in 1x1"
"""Options for most weights converted from Caffe: those of MSRA and Detectron, and *_caffe of mmdet."""


def converted(arrays: dict[str, np.ndarray], given: PixelInput) -> dict[str, np.ndarray]:
    """Returns canonical arrays whose first kernel takes R, G, B, (x / 255 - mean) / std.

    The network stays the same except at the border, where the padding is zero whatever value zero stands for.
    """
    kernel = arrays["conv1/kernel"][:, :, ::-1] if given.reverse else arrays["conv1/kernel"]
    changed = {"conv1/kernel": kernel * given.scale[:, None]}
    if given.offset.any():
        added = kernel.sum(axis=(0, 1), dtype=np.float64).T @ given.offset
        changed["conv1/mean"] = (arrays["conv1/mean"] - added).astype(np.float32)
    return arrays | changed


def has_statistics(arrays: dict[str, np.ndarray]) -> bool:
    """Tells whether any running mean differs from 0 or any running variance from 1, or from 1 less an epsilon
    (Detectron2).
    """
    nearly = {"mean": (0, 0), "var": (1, 2e-5)}
    off = [np.abs(array - nearly[kind][0]).max() > nearly[kind][1] for kind, array in _of_kinds(arrays, *nearly)]
    return any(off)


def is_untrained(arrays: dict[str, np.ndarray]) -> bool:
    """Tells whether gamma is 1 or, at the end of a block, 0 throughout and beta is 0: a network before training."""
    allowed = {"gamma": (0, 1), "beta": (0,), "bias": (0,)}
    return all(np.isin(array, allowed[kind]).all() for kind, array in _of_kinds(arrays, *allowed))


def _of_kinds(arrays: dict[str, np.ndarray], *kinds: str):
    split = ((name.split("/"), array) for name, array in arrays.items())
    return [(kind, array) for (layer, kind), array in split if kind in kinds and layer != "fc1000"]


def require_statistics(arrays: dict[str, np.ndarray], names: dict[str, str]) -> None:
    """Raises InputError for trained weights, canonical but for their input, without statistics.

    names: names in the file, by canonical name
    """
    if not has_statistics(arrays) and not is_untrained(arrays):
        count = sum(name.endswith("/var") for name in arrays)
        raise InputError(
            f"{names['conv1/mean']} = 0 and {names['conv1/var']} = 1, as in all {count} norms: must be statistics that "
            f"were measured; weights made from Caffe's have none, take B, G, R from 0 to 255 and have strides in the "
            f"1x1: {CONVERT.format(FROM_CAFFE)}, or --input torch if they are for (x / 255 - mean) / std"
        )


def require_kernel(arrays: dict[str, np.ndarray], names: dict[str, str]) -> None:
    """Raises InputError for a first kernel of zeros, which no network has, not even one before training."""
    if not arrays["conv1/kernel"].any():
        raise InputError(f"{names['conv1/kernel']} = 0 throughout: must be the kernel of a network")


def require_fit(arrays: dict[str, np.ndarray], assumed: str, names: dict[str, str]) -> None:
    """Raises InputError when the first layer of canonical arrays shows that they are made for another input.

    assumed: the input they were converted from, one of INPUTS; names: names in the file, by canonical name
    """
    given = INPUTS[assumed]
    kernel, mean, var = (arrays[f"conv1/{kind}"].astype(np.float64) for kind in ("kernel", "mean", "var"))
    squares = (kernel**2).sum(axis=(0, 1, 2))
    live = (squares > 0) & (arrays["conv1/gamma"] != 0)
    if not live.any():
        return
    ratio = float(np.quantile(var[live] / squares[live], 0.75))
    if not LEAST <= ratio <= MOST:
        size = "larger" if ratio > MOST else "smaller"
        raise InputError(
            f"{names['conv1/var']} = {ratio:.2g} times the squares of {names['conv1/kernel']}, upper quartile: must be "
            f"{LEAST} to {MOST:.0f}, as from {given.text}: made for {size} values; {_fitting(ratio, assumed)}"
        )
    colours = _mean_of_colours(kernel[..., live], mean[live])
    meant = None if colours is None else _meant(colours, assumed)
    if meant:
        raise InputError(
            f"{names['conv1/mean']} = what pixels of {INPUTS[meant].text} give: must be of {given.text}; "
            f"{CONVERT.format(meant)}"
        )


def _meant(colours: np.ndarray, assumed: str) -> str | None:
    """Returns the other input that the mean of R, G and B points to, in units of (x / 255 - mean) / std of `assumed`.

    Images may have an unusual mean: from "torch", only a mean NEAR that of another input points to it; from "tf" and
    "unit", any mean that is nearer to another input's than to their own.
    """
    given = INPUTS[assumed]
    own = "torch" if assumed == "torch-bgr" else assumed
    if own not in MEANS:
        return None
    values = given.scale * colours + given.offset
    orders = [values, values[::-1]] if given.reverse else [values]
    away = {name: min(np.abs(order - INPUTS[name].offset).max() for order in orders) for name in MEANS}
    nearest = min(away, key=lambda name: away[name])
    told = nearest != own and (own != "torch" or away[nearest] < NEAR)
    return nearest if told else None


def _fitting(ratio: float, assumed: str) -> str:
    """Returns the inputs for which the first kernel, canonical from `assumed`, has a plausible ratio of variance to
    squares.
    """
    scale = {name: float(np.mean(given.scale)) for name, given in INPUTS.items()}
    fitting = [name for name in INPUTS if LEAST <= ratio * (scale[assumed] / scale[name]) ** 2 <= MOST]
    if not fitting:
        return "there is no --input that it would fit"
    first, others = (FROM_CAFFE if fitting[0] == "caffe" else fitting[0]), " or ".join(fitting[1:])
    return CONVERT.format(first) + (f" (or {others})" if others else "")


def _mean_of_colours(kernel: np.ndarray, mean: np.ndarray) -> np.ndarray | None:
    """Fits the mean of R, G and B [3] that explains the first running means; None where none does, or where they are
    0.
    """
    sums = kernel.sum(axis=(0, 1)).T
    if len(mean) < FEWEST or not mean.any():
        return None
    colours = np.linalg.lstsq(sums, mean, rcond=None)[0]
    explained = 1 - np.sum((mean - sums @ colours) ** 2) / np.sum(mean**2)
    return colours if explained >= EXPLAINED else None
