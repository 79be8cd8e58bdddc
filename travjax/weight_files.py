"""Arrays by name out of files of weights: .npz, Keras .h5, safetensors, and .pth, of which no pickled code is run."""

import json
import pickle
import re
import warnings
from pathlib import Path

import numpy as np

from travjax.config import InputError
from travjax.files import written_whole

Arrays = dict[str, np.ndarray]

KERAS_1 = {"W": "kernel", "b": "bias", "running_mean": "moving_mean", "running_std": "moving_variance"}
"""Names of Keras 1 and those of Keras 2; both of the last hold variances."""

KERAS_NORM = ("gamma", "beta", "moving_mean", "moving_variance")
"""Arrays of a batch normalisation, in the order in which Keras 3 numbers them."""


def read_arrays(path: Path) -> tuple[Arrays, dict]:
    """The arrays by their names in the file, and the notes that write_safetensors added.

    Raises InputError, without the path, when the file is missing, of no known kind or damaged, or needs code to be run.
    """
    readers = {".npz": _npz, ".h5": _keras, ".safetensors": _safetensors, ".pth": _torch}
    suffix = path.suffix.lower()
    if suffix not in readers:
        raise InputError(f"unknown kind of file; allowed: {', '.join(readers)}")
    if not path.is_file():
        raise InputError("is a folder; allowed: a file" if path.is_dir() else "no such file")
    try:
        return readers[suffix](path)
    except InputError:
        raise
    except Exception as error:  # libraries raise all sorts over a damaged file
        text = (getattr(error, "strerror", None) or str(error)).partition("\n")[0]
        reason = text if " " in text else f"{type(error).__name__} {text}".strip()
        raise InputError(f"cannot be read as {suffix}, damaged or something else: {reason}") from None


def write_safetensors(path: Path, arrays: Arrays, notes: dict) -> None:
    """Writes arrays and notes (numbers and texts), whole or not at all."""
    from safetensors.numpy import save

    with written_whole(path) as temporary:
        temporary.write_bytes(save(arrays, metadata={"travjax": json.dumps(notes)}))  # save_file hides it from others


def _npz(path: Path) -> tuple[Arrays, dict]:
    with path.open("rb") as file, np.lib.npyio.NpzFile(file, allow_pickle=False) as arrays:
        return dict(arrays), {}


def _safetensors(path: Path) -> tuple[Arrays, dict]:
    from safetensors import safe_open

    with safe_open(path, framework="np") as file:
        notes = dict(json.loads((file.metadata() or {}).get("travjax", "{}")))
        return {name: file.get_tensor(name) for name in file.keys() if not _is_counter(name)}, notes


def _torch(path: Path) -> tuple[Arrays, dict]:
    """A state dict; only tensors and plain containers are unpickled."""
    try:
        import torch
    except ImportError:
        raise InputError("reading it needs torch: pip install torch; .safetensors needs nothing") from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on unusual pickles, which are refused below
            state = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError:
        raise InputError("holds pickled code, which is not run, or is damaged; allowed: a saved state_dict()") from None
    if not isinstance(state, dict) or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise InputError("holds something else than tensors by name; allowed: a saved state_dict()")
    plain = lambda tensor: (tensor.float() if tensor.is_floating_point() else tensor).numpy()
    return {str(name): plain(tensor.detach()) for name, tensor in state.items() if not _is_counter(str(name))}, {}


def _is_counter(name: str) -> bool:
    """Of training steps, which torch's batch normalisation keeps."""
    return name.endswith(".num_batches_tracked")


def _keras(path: Path) -> tuple[Arrays, dict]:
    """Arrays as "layer/array", from .h5 of Keras 1 and 2 and .weights.h5 of Keras 3."""
    try:
        import h5py
    except ImportError:
        raise InputError("reading it needs h5py: pip install h5py") from None
    arrays: Arrays = {}

    def add(place: str, item) -> None:
        if isinstance(item, h5py.Dataset):
            name = _keras_name(place.split("/"), item.parent.attrs.get("name"))
            if name in arrays:
                raise InputError(f"holds {name} twice; allowed: one network")
            arrays[name] = np.asarray(item[()])

    with h5py.File(path) as file:
        file.visititems(add)
    return arrays, {}


def _keras_name(place: list[str], layer: str | None) -> str:
    """The layer is given by Keras 3, whose groups are only numbered: layers/batch_normalization_7/vars/0."""
    if layer is not None:
        order = KERAS_NORM if place[-3].startswith("batch_normalization") else ("kernel", "bias")
        return f"{layer}/{dict(enumerate(order)).get(int(place[-1]), place[-1])}"
    # Keras 2: conv1_conv/conv1_conv/kernel:0; Keras 1: conv1/conv1_W_1:0
    *_, layer, array = ["", *place]
    array = re.sub(rf"^{re.escape(layer)}_|_\d+$", "", array.split(":")[0])
    return f"{layer}/{KERAS_1.get(array, array)}"
