"""Reads the arrays of Keras files by layer: .h5 of Keras 1 and 2, .weights.h5 and .keras of Keras 3.

Only arrays and names are read; no layer is built, and no part of a model's configuration is run. An HDF5 file may point
to other files, by links, external storage or virtual data sets; these are never opened.
"""

import io
import json
import math
import re
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from travjax.config import InputError
from travjax.resnet.stored_arrays import Stored, WeightFile, as_named, open_zip, reading, shown, type_name, unfolded

KERAS_1 = {"W": "kernel", "b": "bias", "running_mean": "moving_mean", "running_std": "moving_variance"}
"""Names of Keras 1 and the names of Keras 2 for them; both of the last two hold variances."""

NORM = ("gamma", "beta", "moving_mean", "moving_variance")
"""Arrays of a batch normalisation, in the order in which Keras 3 numbers them."""

NOT_LAYERS = ("optimizer", "optimizer_weights")
"""Groups that hold the training state, not layers."""

ARRAYS, CONFIG = "model.weights.h5", "config.json"
"""Parts of a .keras file."""

LARGEST_CHUNK = 1 << 26
"""Largest chunk in bytes, since HDF5 decompresses a chunk at once; Keras writes no chunks."""


def open_keras(path: Path, held: ExitStack) -> WeightFile:
    """Opens a .keras file for as long as `held` is open."""
    archive = held.enter_context(open_zip(path, ".keras"))
    parts = archive.namelist()
    if ARRAYS not in parts:
        raise InputError(f"holds no {ARRAYS}; allowed: a .keras file of Keras 3")
    names = _layer_names(unfolded(archive, CONFIG, ".keras")) if CONFIG in parts else {}
    return _opened(io.BytesIO(unfolded(archive, ARRAYS, ".keras")), ".keras", names, held)


def open_hdf5(path: Path, held: ExitStack) -> WeightFile:
    """Opens an .h5 file for as long as `held` is open."""
    return _opened(path, path.suffix.lower(), {}, held)


def _opened(source: Path | io.BytesIO, kind: str, layer_names: dict[str, str], held: ExitStack) -> WeightFile:
    """Opens an HDF5 file; layer_names: layers of groups whose names are only numbered"""
    try:
        import h5py
    except ImportError:
        raise InputError("reading it needs h5py: pip install h5py") from None
    with reading(kind):
        file = held.enter_context(h5py.File(source, "r"))
        links: list[tuple[str, object]] = []
        file.visititems_links(lambda place, link: links.append((place, link)))
    arrays: dict[str, Stored] = {}
    for place, link in links:
        if place.split("/")[0] in NOT_LAYERS:
            continue
        if not isinstance(link, h5py.HardLink):
            raise InputError(f"{shown(place)} is a link: must be an array in this file, others are not opened")
        with reading(kind):
            item = file[place]
            layer = item.parent.attrs.get("name") if isinstance(item, h5py.Dataset) else None
        if isinstance(item, h5py.Dataset):
            layer = layer if isinstance(layer, str) else layer_names.get(item.parent.name)
            name = _name(place.split("/"), layer)
            if name in arrays:
                raise InputError(f"holds {shown(name)} twice; allowed: one network, of layers with names")
            arrays[name] = _stored(item, name, kind)
    return WeightFile(arrays, {})


def _stored(item, name: str, kind: str) -> Stored:
    """Returns a data set, after checking that its data lie in this file."""
    with reading(kind):
        elsewhere = (
            item.is_virtual or item.external is not None
        )  # checked first, since HDF5 opens other files for the shape
    if elsewhere:
        raise InputError(f"{shown(name)} lies in other files: must be in this one, others are not opened")
    with reading(kind):
        shape, dtype = item.shape or (), item.dtype

    def read() -> np.ndarray:
        with reading(kind):
            chunk, taken = math.prod(item.chunks or ()) * dtype.itemsize, item.id.get_storage_size()
        if not taken:
            raise InputError(f"{shown(name)} = {list(shape)}: must have values, of which the file holds none")
        if chunk > LARGEST_CHUNK:
            raise InputError(f"{shown(name)} in chunks of {chunk:,} bytes: must be at most {LARGEST_CHUNK:,}")
        with reading(kind):
            return as_named(np.asarray(item[()]))

    return Stored(shape, type_name(dtype), read)


def _name(place: list[str], layer: str | None) -> str:
    """Names an array; `layer` comes from Keras 3, whose groups are only numbered:
    layers/batch_normalization_7/vars/0.
    """
    if layer is not None:
        order = NORM if len(place) > 2 and place[-3].startswith("batch_normalization") else ("kernel", "bias")
        return f"{layer}/{dict(zip('0123', order, strict=False)).get(place[-1], place[-1])}"
    # Keras 2: conv1_conv/conv1_conv/kernel:0; Keras 1: conv1/conv1_W_1:0
    *_, layer, array = ["", *place]
    array = re.sub(rf"^{re.escape(layer)}_|_\d+$", "", array.split(":")[0])
    return f"{layer}/{KERAS_1.get(array, array)}"


def _layer_names(config: bytes) -> dict[str, str]:
    """Returns layer names by group, as Keras 3 numbers them; its first versions stored no names with the arrays."""
    with reading(".keras"):
        model = json.loads(config)
    names: dict[str, str] = {}
    waiting = [("/layers", model)]
    while waiting:
        place, container = waiting.pop()
        inner = container.get("config") if isinstance(container, dict) else None
        layers = inner.get("layers") if isinstance(inner, dict) else None
        counts: dict[str, int] = {}
        for layer in layers if isinstance(layers, list) else []:
            kind, settings = (layer.get(key) for key in ("class_name", "config")) if isinstance(layer, dict) else (0, 0)
            if not isinstance(kind, str) or not isinstance(settings, dict):
                continue
            group = _snake_case(kind)
            number = counts[group] = counts.get(group, -1) + 1
            group = f"{place}/{group}_{number}" if number else f"{place}/{group}"
            if isinstance(settings.get("name"), str):
                names[f"{group}/vars"] = settings["name"]
            waiting.append((f"{group}/layers", layer))
    return names


def _snake_case(name: str) -> str:
    """Converts BatchNormalization to batch_normalization, Conv2D to conv2d."""
    name = re.sub("(.)([A-Z][a-z]+)", r"\1_\2", re.sub(r"\W+", "", name))
    return re.sub("([a-z])([A-Z])", r"\1_\2", name).lower()
