"""The features of a frozen trunk in a file, for a resumed run and other runs of the same trunk."""

from collections.abc import Callable, Mapping
from hashlib import sha256
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from travjax import progress
from travjax.config import InputError
from travjax.data.sampling import Samples
from travjax.files import save_npz
from travjax.models.variables import Variables
from travjax.runs.run import Run

Features = Mapping[str, Float[np.ndarray, "k f"]]
"""The features of samples, by the names of the samples."""

ORIGIN = "origin"
"""Name in the file of what its features were computed from."""

OF = "of "
"""What the names of samples begin with in the file, so that none is the origin's."""


def origin_of(run: Run, fingerprint: str, variables: Variables, samples: Mapping[str, Samples]) -> str:
    """Returns a digest of what features depend on: robot and grid, images, the data set, the trunk and the samples."""
    trunk = jax.device_get((variables["trunk"], variables["statistics"]))
    settings = run.setup.to_json_text(), run.preset.trunk, run.preset.elevation_scale, fingerprint
    digest = sha256(repr(settings).encode())
    for name, part in samples.items():
        digest.update(name.encode())
        for index in part:
            digest.update(np.asarray(index, np.int64).tobytes())
    for leaf in jax.tree.leaves(trunk):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()


def kept(path: Path, origin: str, compute: Callable[[], Features]) -> Features:
    """Returns the features in a file, computed and written anew where it is missing, damaged or of another origin.

    Those that cannot be written are returned all the same, and a line says so.
    """
    if (found := _read(path, origin)) is not None:
        return found
    features = compute()
    try:
        save_npz(path, **{ORIGIN: origin}, **{OF + name: array for name, array in features.items()})
    except InputError as error:
        progress.say(f"{error}; features of the frozen trunk are kept in memory alone")
    return features


def _read(path: Path, origin: str) -> Features | None:
    """Reads the features in a file; None where it is missing, damaged or of another origin."""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            if str(file[ORIGIN]) == origin:
                return {name.removeprefix(OF): file[name] for name in file.files if name.startswith(OF)}
    except Exception:  # NumPy and zipfile raise many kinds of errors for a damaged file
        pass
    return None
