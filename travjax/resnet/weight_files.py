"""Reads arrays by name from files of weights: .npz, safetensors, .pth, without running pickled code, and Keras files.

Files that travjax writes are .safetensors with the SHA-256 of each array and of the notes in their header.
"""

import hashlib
import json
import pickle
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from travjax.config import InputError
from travjax.files import atomic_write
from travjax.resnet.keras_files import open_hdf5, open_keras
from travjax.resnet.stored_arrays import Stored, WeightFile, open_zip, reading, shown, stored_npy

SUMS = "sha256"
"""Key of the checksums beside the notes."""

NOTES = "__metadata__"
"""Key of the checksum of the notes; safetensors allows no array of that name."""

_LETTERS = {"F": "float", "I": "int", "U": "uint"}

TYPES = {f"{letter}{bits}": f"{kind}{bits}" for letter, kind in _LETTERS.items() for bits in (8, 16, 32, 64)}
TYPES |= {"BF16": "bfloat16", "BOOL": "bool"}
"""Names of types in safetensors, and their NumPy names."""


@contextmanager
def open_arrays(path: Path) -> Iterator[WeightFile]:
    """Opens a file of weights, whose arrays can be read as long as it is open.

    Raises InputError, without the path, when the file is missing, of no known kind or damaged, needs code to be run,
    points to other files, or claims more than its size allows.
    """
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise InputError(f"unknown kind of file; allowed: {', '.join(READERS)}")
    with reading(suffix):
        exists, folder = path.is_file(), path.is_dir()
    if not exists:
        raise InputError("is a folder; allowed: a file" if folder else "no such file")
    _require_content(path, suffix)
    with ExitStack() as held:
        file = READERS[suffix](path, held)
        counters = [name for name in file.arrays if name.endswith("num_batches_tracked")]
        for name in counters:
            del file.arrays[name]
        yield file


def _require_content(path: Path, suffix: str) -> None:
    """Raises InputError for files that often replace weights by mistake: empty ones, Git LFS pointers, web pages."""
    with reading(suffix), path.open("rb") as file:
        start = file.read(512)
    if not start:
        raise InputError("is empty: must be a file of weights")
    if start.startswith(b"version https://git-lfs"):
        raise InputError("is a Git LFS pointer: must be the file that it stands for, which git lfs pull fetches")
    if start.removeprefix(b"\xef\xbb\xbf").lstrip().lower().startswith((b"<!doctype html", b"<html")):
        raise InputError("is an HTML page: must be a file of weights; a download may have given an error or a login")


def write_safetensors(path: Path, arrays: dict[str, np.ndarray], notes: dict) -> None:
    """Writes arrays, notes (numbers and texts) and the checksums of both, whole or not at all.

    Raises InputError that names an array with a number that is not finite.
    """
    from safetensors.numpy import save

    for name, array in arrays.items():
        require_finite(f"{path}: {name}", array)
    sums = {NOTES: _sum_of_notes(notes)} | {name: _sum_of(array) for name, array in arrays.items()}
    header = {
        "travjax": json.dumps(notes | {SUMS: sums})
    }  # a single entry, since safetensors writes several in any order
    with atomic_write(path) as temporary:
        temporary.write_bytes(save(arrays, metadata=header))  # save_file would make it unreadable for others


def require_finite(what: str, array: np.ndarray) -> None:
    """Raises InputError that names the first number of an array that is not finite."""
    finite = np.isfinite(array)
    if not finite.all():
        value = float(array.flat[int(np.argmin(finite))])
        raise InputError(f"{what} = {value}: must be finite throughout, as the weights of a network are")


def _npz(path: Path, held: ExitStack) -> WeightFile:
    archive = held.enter_context(open_zip(path, ".npz"))
    infos = [info for info in archive.infolist() if info.filename.endswith(".npy")]
    return WeightFile({info.filename.removesuffix(".npy"): stored_npy(archive, info, ".npz") for info in infos}, {})


def _safetensors(path: Path, held: ExitStack) -> WeightFile:
    from safetensors import safe_open

    with reading(".safetensors"):
        file = held.enter_context(safe_open(path, framework="np"))
        notes = dict(json.loads((file.metadata() or {}).get("travjax", "{}")))
        places = {name: file.get_slice(name) for name in file.keys()}
    sums = notes.pop(SUMS, None)
    if sums is not None:
        given = sums.get(NOTES) if isinstance(sums, dict) else None
        _require_sum("the description", _sum_of_notes(notes), given)

    def stored(name: str) -> Stored:
        def read() -> np.ndarray:
            with reading(".safetensors"):
                array = file.get_tensor(name)
            if sums is not None:
                _require_sum(shown(name), _sum_of(array), sums.get(name))
            return array

        kind = places[name].get_dtype()
        return Stored(tuple(places[name].get_shape()), TYPES.get(kind, kind), read)

    return WeightFile({name: stored(name) for name in places}, notes, checked=sums is not None)


def _require_sum(what: str, found: str, given: object) -> None:
    if found != given:
        wrong = "is missing" if given is None else "is not the one that the file gives"
        raise InputError(f"the SHA-256 of {what} {wrong}: the file is damaged")


def _sum_of(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def _sum_of_notes(notes: dict) -> str:
    return hashlib.sha256(json.dumps(notes, sort_keys=True).encode()).hexdigest()


def _torch(path: Path, held: ExitStack) -> WeightFile:
    """Reads a saved state dict, or a checkpoint that holds one; only tensors and plain containers are unpickled."""
    try:
        import torch
    except ImportError:
        raise InputError("reading it needs torch: pip install torch; .safetensors needs nothing") from None
    with path.open("rb") as file:
        zipped = file.read(4) == b"PK\3\4"
    if zipped:
        _check_torch_zip(path)
    with reading(path.suffix):
        try:
            state = torch.load(path, map_location="cpu", weights_only=True, mmap=zipped)
        except pickle.UnpicklingError:
            raise InputError(
                "holds pickled code, which is not run, or is damaged; allowed: a saved state_dict()"
            ) from None
    tensors = _tensors(state, torch.Tensor)
    if not tensors:
        raise InputError("holds no tensors by name; allowed: a saved state_dict()")
    return WeightFile({name: _stored_tensor(tensor, path.suffix) for name, tensor in tensors.items()}, {})


def _check_torch_zip(path: Path) -> None:
    """Checks the checksums of a zip file of torch, which torch itself ignores."""
    with open_zip(path, ".pth") as archive:
        for info in archive.infolist():
            if info.compress_type or info.file_size != info.compress_size:
                raise InputError(f"{shown(info.filename)} is compressed: must be stored, as torch.save does it")
        with reading(path.suffix):
            damaged = archive.testzip()
    if damaged:
        raise InputError(f"{shown(damaged)} is not what its checksum says: the file is damaged")


def _tensors(state: Any, kind: type) -> dict[str, Any]:
    """Returns the tensors of nested dicts, with keys joined by dots; a dict that occurs twice counts once."""
    found: dict[str, Any] = {}
    waiting, seen = deque([("", state)]), {id(state)}
    while waiting:
        place, holder = waiting.popleft()
        for key, value in holder.items() if isinstance(holder, dict) else ():
            if not isinstance(key, str):
                continue  # parameters of an optimizer, which numbers them
            if isinstance(value, kind):
                if place + key in found:
                    raise InputError(f"holds {shown(place + key)} twice: must be one")
                found[place + key] = value
            elif isinstance(value, dict) and id(value) not in seen:
                seen.add(id(value))
                waiting.append((f"{place}{key}.", value))
    return found


def _stored_tensor(tensor: Any, kind: str) -> Stored:
    def read() -> np.ndarray:
        with reading(kind):
            return (tensor.float() if tensor.is_floating_point() else tensor).detach().numpy()

    return Stored(tuple(tensor.shape), str(tensor.dtype).removeprefix("torch."), read)


READERS = {".npz": _npz, ".h5": open_hdf5, ".hdf5": open_hdf5, ".keras": open_keras, ".safetensors": _safetensors}
READERS |= dict.fromkeys((".pth", ".pt", ".bin", ".ckpt", ".tar"), _torch)
"""Functions that open a file, by its suffix; .tar is torch's .pth.tar."""
