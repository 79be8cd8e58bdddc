"""A trained estimator as one file: a .safetensors of its variables, with what it was made from and how good it is.

The estimators that come with the package are such files (weights/).
"""

from pathlib import Path

import jax
import numpy as np

from travjax.config import InputError
from travjax.estimator import put_together, take_apart
from travjax.trained import Network, Run
from travjax.weight_files import read_arrays, write_safetensors

SUFFIX = ".safetensors"


def write_model(path: Path, run: Run, network: Network, notes: dict) -> None:
    """Writes an estimator; notes: what JSON can hold, on its training and its figures."""
    arrays = {name: np.asarray(leaf) for name, leaf in _named(take_apart(network)[1]).items()}
    write_safetensors(path, arrays, {"run": run.to_json(), "notes": notes})


def read_model(path: Path) -> tuple[Run, Network, dict]:
    """The run, the estimator and the notes of a file.

    Raises InputError when it is missing, damaged or something else.
    """
    try:
        arrays, described = read_arrays(path)
        run, notes = Run.from_json(described["run"]), described["notes"]
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (LookupError, TypeError, ValueError, AttributeError):
        raise InputError(f"{path}: holds no estimator of travjax; allowed: a file of `travjax export`") from None
    template = run.template(0)
    expected = {name: (leaf.shape, leaf.dtype) for name, leaf in _named(template).items()}
    given = {name: (array.shape, array.dtype) for name, array in arrays.items()}
    if expected != given:
        names = sorted(name for name in expected.keys() | given.keys() if expected.get(name) != given.get(name))
        raise InputError(f"{path}: {', '.join(names[:3])}: not the arrays of its estimator; allowed: an undamaged file")
    leaves = [jax.numpy.asarray(arrays[name]) for name in _named(template)]
    variables = jax.tree.unflatten(jax.tree.structure(template), leaves)
    return run, put_together(run.graph(), variables), notes


def _named(variables) -> dict[str, jax.Array]:
    """The leaves by path, in their order."""
    name = lambda path: jax.tree_util.keystr(path, simple=True, separator="/").removesuffix("/value")
    return {name(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(variables)}
