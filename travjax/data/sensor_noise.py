"""Simulated sensor errors in elevation maps (noise, missing nodes, a coarser grid), repairs of them, and filters.

Everything is NumPy on the host. Maps are [n, rows, cols] metres.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from travjax.config import require_number

Maps = Float[np.ndarray, "n rows cols"]


@dataclass(frozen=True)
class CorruptionConfig:
    """How training maps are corrupted, newly drawn each time; the labels remain those of the clean maps.

    probability: that a map is corrupted; the others stay unchanged
    noise:       metres; the standard deviation of the noise is uniform from 0 to this
    missing:     in half of the corrupted maps, the share of missing nodes is uniform from 0 to this
    coarse:      share of the corrupted maps that keep only every second node

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    probability: float = field(default=0.0, metadata={"formerly": "share"})
    noise: float = 0.06
    missing: float = 0.25
    coarse: float = 0.2

    def __post_init__(self):
        require_number("noise", self.noise, -1e-300, 1, "metres, from 0 to 1")
        for name, most in (("probability", 1), ("missing", 0.9), ("coarse", 1)):
            require_number(name, getattr(self, name), -1e-300, most, f"a share from 0 to {most}")


def corrupted(maps: Maps, config: CorruptionConfig, rng: np.random.Generator) -> Maps:
    """Corrupts maps at random as a sensor might, and fills missing nodes; float32."""
    result = np.array(maps, np.float32)
    for index in np.flatnonzero(rng.random(len(maps)) < config.probability):
        one = result[index : index + 1]
        if rng.random() < config.coarse:
            one = upsampled(one)
        one = noisy(one, rng.uniform(0, config.noise), rng)
        if rng.random() < 0.5:
            one = filled(thinned(one, rng.uniform(0, config.missing), rng))
        result[index] = one[0]
    return result


def noisy(maps: Maps, deviation: float, rng: np.random.Generator) -> Maps:
    """Adds independent Gaussian noise at each node; deviation: metres."""
    return maps + np.float32(deviation) * rng.standard_normal(maps.shape, dtype=np.float32)


def thinned(maps: Maps, share: float, rng: np.random.Generator) -> Maps:
    """Sets a share of the nodes, each independently, to NaN."""
    return np.where(rng.random(maps.shape) < share, np.float32(np.nan), maps)


def upsampled(maps: Maps) -> Maps:
    """Keeps every second node and interpolates the others bilinearly.

    maps: must have an even number of cells along each edge
    """
    result = np.array(maps)
    result[:, 1:-1:2, ::2] = (maps[:, :-2:2, ::2] + maps[:, 2::2, ::2]) / 2
    result[:, :, 1:-1:2] = (result[:, :, :-2:2] + result[:, :, 2::2]) / 2
    return result


def filled(maps: Maps) -> Maps:
    """Gives each NaN the height of the nearest known node; a map without any known node becomes flat."""
    holes = np.isnan(maps)
    if not holes.any():
        return maps
    result = np.array(maps)
    for one, unknown in zip(result, holes, strict=True):
        if unknown.all():
            one[:] = 0
        elif unknown.any():
            place = ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True)
            one[:] = one[tuple(place)]
    return result


def smoothed(maps: Maps, deviation: float) -> Maps:
    """Smooths maps with a Gaussian; deviation: nodes."""
    return ndimage.gaussian_filter(maps, (0, deviation, deviation), mode="nearest")


def median(maps: Maps) -> Maps:
    """Replaces each height by the median of the 3 x 3 nodes around it."""
    return ndimage.median_filter(maps, (1, 3, 3), mode="nearest")


NOISES = (0.01, 0.02, 0.05)
"""Standard deviations of the noise that is added, in metres."""

MISSING = (0.05, 0.2)
"""Shares of nodes that are missing."""

CLEAN, COARSE = "none", "0.125 m"

GAUSSIANS = (0.5, 0.75, 1.0, 1.25, 1.5, 2.0)
"""Standard deviations, in nodes, of the Gaussian filters for the simulator's map."""


Corruption = Callable[[Maps, np.random.Generator], Maps]


def _noise(deviation: float) -> Corruption:
    return lambda maps, rng: noisy(maps, deviation, rng)


def _missing(share: float) -> Corruption:
    return lambda maps, rng: filled(thinned(maps, share, rng))


CORRUPTIONS: dict[str, Corruption] = {
    CLEAN: lambda maps, rng: maps,
    **{f"noise {100 * noise:g} cm": _noise(noise) for noise in NOISES},
    **{f"{share:.0%} missing": _missing(share) for share in MISSING},
    COARSE: lambda maps, rng: upsampled(maps),
}
"""Corruptions of maps by name: each shows the maps as a sensor may see them, with all nodes known."""

FILTERS: dict[str, Callable[[Maps], Maps]] = {
    "no filter": lambda maps: maps,
    "median 3 x 3": median,
    **{f"Gaussian {nodes:g}": partial(smoothed, deviation=nodes) for nodes in GAUSSIANS},
}
"""Filters by name that may be applied to a corrupted map before it is simulated; deviations in nodes."""
