"""A trained estimator as one file: a .safetensors of its variables, with what it was made from and how good it is.

The estimators that come with the package are such files (weights/). Checksums of all of it are in the header
(resnet/weight_files.py) and are compared when it is read, so a damaged estimator is refused.
"""

from pathlib import Path

import jax
import numpy as np

from travjax.config import InputError
from travjax.models.variables import Network, merge_model, split_model
from travjax.resnet.stored_arrays import WeightFile, shown
from travjax.resnet.weight_files import open_arrays, require_finite, write_safetensors
from travjax.runs.run import Run, named_leaves

SUFFIX = ".safetensors"


def write_model(path: Path, run: Run, network: Network, notes: dict) -> None:
    """Writes an estimator; notes: JSON values that describe its training and its scores.

    Raises InputError that names an array with a number that is not finite.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in named_leaves(split_model(network)[1]).items()}
    write_safetensors(path, arrays, {"run": run.to_json(), "notes": notes})


def read_model(path: Path) -> tuple[Run, Network, dict]:
    """Reads the run, the estimator and the notes of a file.

    A file of an older version has no checksums; a printed line says so.
    Raises InputError when it is missing, damaged or something else, or holds a number that is not finite.
    """
    try:
        with open_arrays(path) as file:
            run, notes = _described(file.notes, path)
            template = run.template(0)
            arrays = _read(file, named_leaves(template))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if not file.checked:
        print(f"{path}: has no checksums, as it is of an older travjax: damage would go unnoticed; export it again")
    variables = jax.tree.unflatten(jax.tree.structure(template), [jax.numpy.asarray(array) for array in arrays])
    return run, merge_model(run.graph(), variables), notes


def _described(notes: dict, path: Path) -> tuple[Run, dict]:
    """Returns the run and the notes that write_model was given."""
    try:
        if notes.keys() == {"run", "notes"} and isinstance(notes["notes"], dict):
            return Run.from_json(notes["run"], path), notes["notes"]
    except InputError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError):
        pass
    raise InputError("holds no estimator of travjax; allowed: a file of `travjax export`")


def _read(file: WeightFile, leaves: dict[str, jax.ShapeDtypeStruct]) -> list[np.ndarray]:
    """Reads the arrays of an estimator's leaves, in their order."""
    expected = {name: (leaf.shape, leaf.dtype.name) for name, leaf in leaves.items()}
    given = {name: (stored.shape, stored.dtype) for name, stored in file.arrays.items()}
    if expected != given:
        names = sorted(name for name in expected.keys() | given.keys() if expected.get(name) != given.get(name))
        listed = ", ".join(map(shown, names[:3]))
        raise InputError(f"{listed}: not the arrays of its estimator; allowed: an undamaged file")
    arrays = {name: file.arrays[name].read() for name in leaves}
    for name, array in arrays.items():
        require_finite(name, array)
    return list(arrays.values())
