"""Which (map, trajectory) pairs to train on: balanced subsets, natural samples and shuffled batches (SPEC section 7).

Everything here is NumPy on the host and cheap: a balanced subset of the paper's 51,157 training maps takes a second, so
a fresh one can be drawn for each epoch. Samples are a pair of int32 arrays (map_index, trajectory_index). Labels are
[n, t], one byte per trajectory as traverse.py packs them.

A random choice takes the smallest of random keys that depend only on the seed, the map and the trajectory
(`random_keys`), so the choice for a map does not depend on the other maps or on the version of NumPy.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from travjax.config import InputError, require
from travjax.simulation.events import FAILED, UNKNOWN_LABEL

MAPS_AT_ONCE = 256
"""Number of maps whose labels are processed together: 256 x 3042 keys of 8 bytes are 6 MB."""

Samples = tuple[np.ndarray, np.ndarray]
Seed = int | Sequence[int]

_PLACE_BITS = 20
"""Lowest bits of a key that hold the trajectory index; an action space has at most a million trajectories."""


def balanced_subset(labels: np.ndarray, maps: np.ndarray, seed: Seed, each: int = 11, failing: int = 6) -> Samples:
    """Draws `each` random trajectories per map, `failing` of them with some failure (or all such, if fewer).

    labels: [n, t] uint8; maps: [k] indices. Unknown trajectories are never drawn; a map with too few safe ones gives
    fewer than `each`. Source: SPEC section 7.
    """
    require(1 <= each, "each", each, "at least 1 trajectory a map")
    require(0 <= failing <= each, "failing", failing, f"from 0 to each = {each}")

    def chosen(chunk: np.ndarray, keys: np.ndarray) -> np.ndarray:
        fails, known = (chunk & FAILED) > 0, are_known(chunk)
        failed = _smallest(keys, fails & known, failing)
        safe = _smallest(keys, ~fails & known, each)
        room = each - (failed >= 0).sum(axis=1, keepdims=True)
        return np.concatenate([failed, np.where(np.arange(safe.shape[1]) < room, safe, -1)], axis=1)

    return _chosen(labels, maps, ("balanced", seed), chosen)


def natural_sample(labels: np.ndarray, maps: np.ndarray, seed: Seed, number_of_maps: int, each: int) -> Samples:
    """Draws `number_of_maps` random maps, and `each` random known trajectories (or all, if fewer) on each of them.

    Failures are then as frequent as on the maps. The chosen maps keep the order of `maps`.
    labels: [n, t] uint8; maps: [k] indices
    """
    require(1 <= number_of_maps, "number_of_maps", number_of_maps, "at least 1")
    require(1 <= each, "each", each, "at least 1 trajectory a map")
    maps = _map_indices(labels, maps)
    drawn = np.argsort(random_keys(("natural maps", seed), maps), kind="stable")[:number_of_maps]
    choose = lambda chunk, keys: _smallest(keys, are_known(chunk), each)
    return _chosen(labels, maps[np.sort(drawn)], ("natural", seed), choose)


def every_sample(labels: np.ndarray, maps: np.ndarray) -> Samples:
    """Returns every known trajectory of the maps: labels [n, t] uint8, maps [k] indices."""
    return _joined(_pairs(part, are_known(labels[part])) for part in _chunks(_map_indices(labels, maps)))


def are_known(labels: np.ndarray) -> np.ndarray:
    """Tells which labels belong to known trajectories."""
    return (labels & UNKNOWN_LABEL) == 0


@dataclass(frozen=True, eq=False)
class Sampler:
    """Draws the balanced subset of each epoch.

    labels: [n, t] uint8; maps: [k] indices; each, failing: as in `balanced_subset`
    fresh:  False for the same subset in every epoch, as in the paper; True for a new one in each, which costs little
            since every trajectory has a label
    """

    labels: np.ndarray
    maps: np.ndarray
    seed: int = 0
    each: int = 11
    failing: int = 6
    fresh: bool = False

    def epoch(self, number: int) -> Samples:
        """Returns the samples of an epoch."""
        return self._subset((self.seed, number)) if self.fresh else self._fixed

    @cached_property
    def _fixed(self) -> Samples:
        return self._subset(self.seed)

    def _subset(self, seed: Seed) -> Samples:
        return balanced_subset(self.labels, self.maps, seed, self.each, self.failing)


def batches(samples: Samples, size: int, seed: int, epoch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shuffles the samples of an epoch into batches: (map_index, trajectory_index, weight), each [steps, size].

    The weight (float32) is 1. The last batch is filled up with samples from the start of the order with weight 0, so
    that all batches have one shape and each sample counts once. Raises InputError when there are no samples.
    """
    require(1 <= size, "batch size", size, "at least 1")
    maps, trajectories = samples
    if not len(maps):
        raise InputError("samples: none: must be at least one known trajectory")
    order = np.argsort(random_keys(("batches", (seed, epoch)), np.arange(len(maps))), kind="stable")
    steps = -(-len(maps) // size)
    weight = (np.arange(steps * size) < len(maps)).astype(np.float32)
    filled = np.resize(order, steps * size)
    return tuple(array.reshape(steps, size) for array in (maps[filled], trajectories[filled], weight))  # type: ignore[return-value]


def random_keys(stream: tuple[str, Seed], *numbers: np.ndarray) -> np.ndarray:
    """Returns a random uint64 for each item of a stream; it does not depend on the other items in the call.

    stream:  what the keys are for, and a seed
    numbers: integer arrays that broadcast; together they identify an item
    Source: the output function of SplitMix64 (Steele, Lea, Flood 2014), applied once for each number.
    """
    purpose, seed = stream
    entropy = list(seed) if isinstance(seed, Sequence) else [seed]
    whole = all(isinstance(part, int | np.integer) and part >= 0 for part in entropy)
    require(whole, "seed", seed, "a whole number from 0, or several")
    words = [int.from_bytes(purpose.encode()), len(entropy), *map(int, entropy)]
    keys = np.random.SeedSequence(words).generate_state(1, np.uint64)
    for number in numbers:
        keys = _mixed(keys + np.asarray(number).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15))
    return keys


def _mixed(bits: np.ndarray) -> np.ndarray:
    bits ^= bits >> np.uint64(30)
    bits *= np.uint64(0xBF58476D1CE4E5B9)
    bits ^= bits >> np.uint64(27)
    bits *= np.uint64(0x94D049BB133111EB)
    bits ^= bits >> np.uint64(31)
    return bits


def _chosen(labels, maps, stream, choose: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Samples:
    """Collects, as samples, the trajectories that `choose(labels, keys)` picks for each map: [c, k], -1 for none."""
    maps = _map_indices(labels, maps)
    trajectories = np.arange(labels.shape[1])

    def of_part(part: np.ndarray) -> Samples:
        chosen = choose(labels[part], random_keys(stream, part[:, None], trajectories))
        row, column = np.nonzero(chosen >= 0)
        return part[row], chosen[row, column].astype(np.int32)

    return _joined(of_part(part) for part in _chunks(maps))


def _smallest(keys: np.ndarray, allowed: np.ndarray, count: int) -> np.ndarray:
    """Returns the columns of the `count` smallest allowed keys in each row, smallest first; -1 if there are fewer."""
    count = min(count, keys.shape[1])
    if not count:
        return np.empty((len(keys), 0), np.int64)
    place = np.uint64((1 << _PLACE_BITS) - 1)
    none = np.uint64(2**64 - 1)
    placed = np.where(allowed, (keys & ~place) | np.arange(keys.shape[1], dtype=np.uint64), none)
    smallest = np.sort(np.partition(placed, count - 1, axis=1)[:, :count], axis=1)
    return np.where(smallest == none, -1, (smallest & place).astype(np.int64))


def _map_indices(labels: np.ndarray, maps: np.ndarray) -> np.ndarray:
    maps = np.asarray(maps, np.int32)
    outside = maps[(maps < 0) | (maps >= len(labels))]
    require(not outside.size, "maps", outside[:1].tolist(), f"from 0 to {len(labels) - 1}")
    return maps


def _chunks(maps: np.ndarray) -> Iterator[np.ndarray]:
    return (maps[start : start + MAPS_AT_ONCE] for start in range(0, len(maps), MAPS_AT_ONCE))


def _pairs(maps: np.ndarray, wanted: np.ndarray) -> Samples:
    row, column = np.nonzero(wanted)
    return maps[row], column.astype(np.int32)


def _joined(parts: Iterator[Samples]) -> Samples:
    empty = np.empty(0, np.int32)
    maps, trajectories = zip((empty, empty), *parts, strict=True)
    return np.concatenate(maps), np.concatenate(trajectories)
