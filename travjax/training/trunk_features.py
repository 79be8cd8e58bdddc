"""The features of a frozen trunk in a file, for a resumed run and other runs of the same trunk."""

from collections.abc import Callable, Mapping
from hashlib import sha256
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from travjax.data.sampling import Samples
from travjax.files import save_npz
from travjax.models.variables import Variables

Features = Mapping[str, Float[np.ndarray, "k f"]]
"""The features of samples, by the names of the samples."""

ORIGIN = "origin"
"""Name in the file of what its features were computed from."""


def origin_of(fingerprint: str, variables: Variables, samples: Mapping[str, Samples]) -> str:
    """Returns a digest of what features depend on: the data set, the trunk and the samples."""
    trunk = jax.device_get((variables["trunk"], variables["statistics"]))
    digest = sha256(fingerprint.encode())
    for name, part in samples.items():
        digest.update(name.encode())
        for index in part:
            digest.update(np.asarray(index, np.int64).tobytes())
    for leaf in jax.tree.leaves(trunk):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()


def kept(path: Path, origin: str, compute: Callable[[], Features]) -> Features:
    """Returns the features in a file, computed and written anew where it is missing, damaged or of another origin."""
    found = _read(path)
    if str(found.pop(ORIGIN, None)) == origin:
        return found
    features = compute()
    save_npz(path, **{ORIGIN: origin}, **features)
    return features


def _read(path: Path) -> dict[str, np.ndarray]:
    """Reads the arrays of a file; none where it is missing or damaged."""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            return dict(file)
    except Exception:  # NumPy and zipfile raise many kinds of errors for a damaged file
        return {}
