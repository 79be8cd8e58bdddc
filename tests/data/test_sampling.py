"""Samples against a slow loop over maps, and what a choice may depend on."""

import numpy as np
import pytest

from travjax.config import InputError
from travjax.data import sampling
from travjax.data.sampling import Sampler, balanced_subset, batches, every_sample, natural_sample, random_keys

TRAJECTORIES = 50


@pytest.fixture(scope="module")
def labels() -> np.ndarray:
    """[600, 50]: maps that fail nowhere, rarely, often and everywhere, a tenth unknown; the first five are special."""
    rng = np.random.default_rng(0)
    share = rng.choice([0, 0.02, 0.13, 0.5, 0.97, 1], size=(600, 1))
    labels = np.where(rng.random((600, TRAJECTORIES)) < share, rng.integers(1, 8, (600, TRAJECTORIES)), 0)
    labels[rng.random(labels.shape) < 0.1] = 8
    labels[0] = 8  # nothing known
    labels[1] = 0  # no failure
    labels[2] = 4  # only failures
    labels[3] = np.where(np.arange(TRAJECTORIES) < 3, 1, 0)  # fewer failures than wanted
    labels[4] = [8] * 40 + [2] * 8 + [0] * 2  # fewer safe ones than wanted
    return labels.astype(np.uint8)


def taken(samples, number: int) -> list[int]:
    """The trajectories that were taken of a map, in order of their index."""
    maps, trajectories = samples
    return sorted(trajectories[maps == number].tolist())


def everywhere(labels) -> np.ndarray:
    return np.arange(len(labels))


def slow_balanced(labels, maps, each, failing) -> list[tuple[int, int]]:
    """How many failing and safe trajectories each map gives."""
    counts = []
    for number in maps:
        fails = sum(1 for label in labels[number] if label in range(1, 8))
        safe = sum(1 for label in labels[number] if label == 0)
        first = min(fails, failing)
        counts.append((first, min(safe, each - first)))
    return counts


@pytest.mark.parametrize(("each", "failing"), [(11, 6), (11, 0), (5, 5), (1, 1), (1, 0), (50, 25), (80, 40)])
def test_a_balanced_subset_has_the_counts_of_a_loop_over_maps(labels, each, failing):
    maps, trajectories = balanced_subset(labels, everywhere(labels), 3, each, failing)
    assert maps.dtype == trajectories.dtype == np.int32
    assert len(set(zip(maps.tolist(), trajectories.tolist(), strict=True))) == len(maps)
    chosen = labels[maps, trajectories]
    fails = np.bincount(maps, (chosen > 0) & (chosen < 8), len(labels)).astype(int)
    safe = np.bincount(maps, chosen == 0, len(labels)).astype(int)
    counts = list(zip(fails.tolist(), safe.tolist(), strict=True))
    assert counts == slow_balanced(labels, everywhere(labels), each, failing)
    assert counts[1] == (0, min(each, TRAJECTORIES)) and counts[2] == (min(failing, TRAJECTORIES), 0)


def test_a_third_of_a_balanced_subset_fails_where_an_eighth_of_the_labels_does():
    # As in the paper's data set: a third of the maps without failures, 12.6 % of all labels.
    rng = np.random.default_rng(1)
    share = np.where(np.arange(900) % 3 == 0, 0, np.abs(rng.normal(0, 0.25, 900)))[:, None]
    labels = (rng.random((900, 1000)) < share).astype(np.uint8)
    assert labels.mean() == pytest.approx(0.126, abs=0.02)
    chosen = labels[balanced_subset(labels, np.arange(900), 0)]
    assert len(chosen) == 900 * 11
    assert 0.3 < chosen.mean() < 0.38


def test_unknown_trajectories_are_never_taken(labels):
    maps = everywhere(labels)
    for samples in (
        balanced_subset(labels, maps, 0, 50, 25),
        natural_sample(labels, maps, 0, 600, 50),
        every_sample(labels, maps),
    ):
        assert (labels[samples] < 8).all()
        assert 0 not in samples[0]


def test_an_unknown_trajectory_with_a_failure_bit_is_not_taken_either():
    labels = np.full((1, 20), 8 + 1, np.uint8)
    assert not len(balanced_subset(labels, np.arange(1), 0)[0])


@pytest.mark.parametrize("choose", [balanced_subset, lambda *arguments: natural_sample(*arguments, 600, 11)])
def test_the_choice_of_a_map_depends_on_no_other_map(labels, choose):
    together = choose(labels, everywhere(labels), 5)
    for number in (1, 17, 300, 599):
        alone = choose(labels, np.array([number]), 5)
        assert taken(alone, number) == taken(together, number) != []
    backwards = choose(labels, everywhere(labels)[::-1], 5)
    assert all(taken(backwards, number) == taken(together, number) for number in range(0, 600, 37))


def test_the_choice_does_not_depend_on_the_chunks(labels, monkeypatch):
    whole = balanced_subset(labels, everywhere(labels), 5)
    monkeypatch.setattr(sampling, "MAPS_AT_ONCE", 7)
    for one, other in zip(whole, balanced_subset(labels, everywhere(labels), 5), strict=True):
        np.testing.assert_array_equal(one, other)


def test_maps_come_in_the_order_in_which_they_are_asked_for(labels):
    asked = np.array([9, 3, 400, 7])
    maps, _ = balanced_subset(labels, asked, 0)
    assert list(dict.fromkeys(maps.tolist())) == asked.tolist()
    assert set(balanced_subset(labels, [], 0)[0].tolist()) == set()


def test_the_same_seed_gives_the_same_subset_and_others_another(labels):
    subsets = {
        seed: balanced_subset(labels, everywhere(labels), seed)[1].tolist()
        for seed in (0, 1, (0,), (0, 0), (0, 1), (1, 0), 2**40)
    }
    assert subsets[0] == balanced_subset(labels, everywhere(labels), 0)[1].tolist()
    assert subsets[0] == subsets[(0,)]
    assert len({tuple(subset) for subset in subsets.values()}) == 6


def test_a_subset_is_the_same_on_every_machine_and_version():
    # Recorded from the first version: what changes this changes every experiment with a data set.
    labels = np.zeros((3, 100), np.uint8)
    labels[:, ::7] = 1
    maps, trajectories = balanced_subset(labels, np.arange(3), 2026, 5, 2)
    assert maps.tolist() == [0] * 5 + [1] * 5 + [2] * 5
    assert trajectories.tolist() == [77, 98, 18, 39, 9, 35, 84, 45, 8, 76, 63, 42, 50, 44, 46]


def test_every_trajectory_is_equally_likely():
    labels = np.zeros((20_000, 12), np.uint8)
    labels[:, :4] = 1
    _, trajectories = balanced_subset(labels, np.arange(20_000), 0, each=5, failing=2)
    counts = np.bincount(trajectories, minlength=12)
    # 2 of 4 failing, 3 of 8 safe; standard deviations are 71 and 68
    np.testing.assert_allclose(counts[:4], 10_000, rtol=0, atol=350)
    np.testing.assert_allclose(counts[4:], 7_500, rtol=0, atol=350)


def test_choices_of_neighbouring_maps_and_seeds_are_unrelated():
    labels = np.zeros((4_000, 20), np.uint8)
    first = balanced_subset(labels, np.arange(4_000), 0, each=1, failing=0)[1]
    second = balanced_subset(labels, np.arange(4_000), 1, each=1, failing=0)[1]
    for one, other in ((first[1:], first[:-1]), (first, second)):
        assert abs((one == other).mean() - 1 / 20) < 0.015
        assert abs(np.corrcoef(one, other)[0, 1]) < 0.08


def test_a_natural_sample_fails_as_often_as_the_maps_do(labels):
    maps = everywhere(labels)
    chosen = labels[natural_sample(labels, maps, 0, len(maps), 30)]
    known = labels[labels < 8]
    assert (chosen > 0).mean() == pytest.approx((known > 0).mean(), abs=0.02)


def test_a_natural_sample_takes_so_many_of_so_many_maps(labels):
    maps = np.arange(10, 200)
    chosen, trajectories = natural_sample(labels, maps, 4, 25, 20)
    names, counts = np.unique(chosen, return_counts=True)
    assert len(names) == 25 and set(names.tolist()) <= set(maps.tolist())
    assert (counts == 20).all()
    assert len(set(zip(chosen.tolist(), trajectories.tolist(), strict=True))) == 500
    assert set(natural_sample(labels, maps, 5, 25, 20)[0].tolist()) != set(names.tolist())


def test_a_natural_sample_of_few_maps_or_trajectories_takes_all(labels):
    maps = np.array([4, 5])
    every = every_sample(labels, maps)
    natural = natural_sample(labels, maps, 0, 100, 1000)
    assert [taken(natural, number) for number in maps] == [taken(every, number) for number in maps]


def test_every_sample_is_every_known_one(labels):
    maps, trajectories = every_sample(labels, np.array([590, 4, 0, 17]))
    expected = [(m, t) for m in (590, 4, 0, 17) for t in range(TRAJECTORIES) if labels[m, t] != 8]
    assert list(zip(maps.tolist(), trajectories.tolist(), strict=True)) == expected
    assert maps.dtype == trajectories.dtype == np.int32


@pytest.mark.parametrize("count", [1, 9, 10, 11, 95, 100])
def test_each_sample_counts_once_an_epoch(count):
    samples = np.arange(count, dtype=np.int32), np.arange(count, dtype=np.int32) * 2
    maps, trajectories, weight = batches(samples, 10, 0, 0)
    steps = -(-count // 10)
    assert maps.shape == trajectories.shape == weight.shape == (steps, 10)
    assert weight.dtype == np.float32 and set(np.unique(weight)) <= {0, 1}
    assert sorted(maps[weight == 1].tolist()) == list(range(count))
    np.testing.assert_array_equal(trajectories, maps * 2)
    np.testing.assert_array_equal(weight.ravel(), np.arange(steps * 10) < count)
    # What fills up are the first samples of the same order.
    filled = maps.ravel()[count:]
    np.testing.assert_array_equal(filled, np.resize(maps.ravel()[:count], len(filled)))


def test_epochs_and_seeds_have_orders_of_their_own():
    samples = np.arange(200), np.zeros(200, int)
    order = lambda seed, epoch: tuple(batches(samples, 20, seed, epoch)[0].ravel().tolist())
    assert order(3, 1) == order(3, 1)
    assert len({order(3, 1), order(3, 2), order(1, 3), order(4, 1), tuple(range(200))}) == 5


def test_the_papers_sampler_gives_the_same_subset_each_epoch(labels):
    sampler = Sampler(labels, everywhere(labels), seed=7)
    fixed = balanced_subset(labels, everywhere(labels), 7)
    for epoch in (0, 1, 5):
        np.testing.assert_array_equal(sampler.epoch(epoch), fixed)


def test_a_fresh_sampler_gives_a_new_subset_each_epoch(labels):
    sampler = Sampler(labels, np.arange(200), seed=7, each=5, failing=2, fresh=True)
    again = Sampler(labels, np.arange(200), seed=7, each=5, failing=2, fresh=True)
    np.testing.assert_array_equal(sampler.epoch(3), again.epoch(3))
    np.testing.assert_array_equal(sampler.epoch(3), balanced_subset(labels, np.arange(200), (7, 3), 5, 2))
    first, second = sampler.epoch(0), sampler.epoch(1)
    np.testing.assert_array_equal(first[0], second[0])  # as many of each map
    assert (first[1] != second[1]).mean() > 0.5


def slow_key(state: int, *numbers: int) -> int:
    """The key of one item with Python's integers."""
    for number in numbers:
        state = (state + number * 0x9E3779B97F4A7C15) % 2**64
        state = (state ^ state >> 30) * 0xBF58476D1CE4E5B9 % 2**64
        state = (state ^ state >> 27) * 0x94D049BB133111EB % 2**64
        state ^= state >> 31
    return state


def test_keys_are_those_of_splitmix_with_pythons_integers():
    state = int(random_keys(("test", (1, 2)))[0])
    keys = random_keys(("test", (1, 2)), np.array([[0], [56_839], [2**32]]), np.array([0, 3041]))
    assert keys.tolist() == [[slow_key(state, m, t) for t in (0, 3041)] for m in (0, 56_839, 2**32)]
    assert slow_key(0, 1) == 0xE220A8397B1DCDAF  # the first output of SplitMix64 with seed 0


def test_keys_are_unlike_each_other_and_their_bits_fair():
    keys = random_keys(("test", 0), np.arange(100)[:, None], np.arange(100))
    assert keys.shape == (100, 100) and keys.dtype == np.uint64
    assert len(np.unique(keys)) == keys.size
    bits = np.unpackbits(keys.view(np.uint8).reshape(-1, 8), axis=1).mean(axis=0)
    np.testing.assert_allclose(bits, 0.5, rtol=0, atol=0.03)
    assert not np.intersect1d(keys, random_keys(("other", 0), np.arange(100)[:, None], np.arange(100))).size


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda labels: balanced_subset(labels, [600], 0), r"maps = \[600\]: must be from 0 to 599"),
        (lambda labels: every_sample(labels, [3, -1]), r"maps = \[-1\]: must be from 0 to 599"),
        (lambda labels: balanced_subset(labels, [1], 0, 0), "each = 0: must be at least 1 trajectory a map"),
        (lambda labels: balanced_subset(labels, [1], 0, 3, 4), "failing = 4: must be from 0 to each = 3"),
        (lambda labels: balanced_subset(labels, [1], -1), "seed = -1: must be a whole number from 0, or several"),
        (lambda labels: balanced_subset(labels, [1], (0, 0.5)), r"seed = \(0, 0.5\): must be a whole number from 0"),
        (lambda labels: natural_sample(labels, [1], 0, 0, 5), "number_of_maps = 0: must be at least 1"),
        (lambda labels: natural_sample(labels, [1], 0, 5, 0), "each = 0: must be at least 1"),
        (lambda labels: batches(every_sample(labels, [1]), 0, 0, 0), "batch size = 0: must be at least 1"),
        (lambda labels: batches(every_sample(labels, [0]), 8, 0, 0), "samples: none: must be at least one"),
    ],
)
def test_bad_arguments_are_named(labels, call, message):
    with pytest.raises(InputError, match=f"^{message}"):
        call(labels)
