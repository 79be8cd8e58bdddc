"""Batches of a few fixed sizes."""

import jax.numpy as jnp
import numpy as np
import pytest

from travjax.batching import BATCH, in_batches

COUNTS = [1, 2, 3, 5, BATCH - 1, BATCH, BATCH + 1, 2 * BATCH + 6]


@pytest.mark.parametrize("count", COUNTS)
def test_results_are_those_of_the_whole_in_order(count):
    items = {"a": np.arange(count), "b": np.arange(3.0 * count).reshape(count, 3)}
    results = in_batches(lambda batch: (2 * batch["a"], batch["b"].sum(axis=1)), items)
    np.testing.assert_array_equal(results[0], 2 * items["a"])
    np.testing.assert_array_equal(results[1], items["b"].sum(axis=1))


@pytest.mark.parametrize("count", COUNTS)
def test_batches_are_full_or_a_power_of_two(count):
    sizes = []

    def double(batch):
        sizes.append(len(batch))
        return 2 * batch

    in_batches(double, jnp.arange(count))
    assert sizes[:-1] == [BATCH] * ((count - 1) // BATCH)
    assert sizes[-1] & (sizes[-1] - 1) == 0
    assert count <= sum(sizes) < 2 * count


def test_a_batch_is_filled_up_with_its_first_item():
    seen = []

    def keep(batch):
        seen.extend(batch.tolist())
        return batch

    in_batches(keep, jnp.array([7, 8, 9, 10, 11]))
    assert seen == [7, 8, 9, 10, 11, 7, 7, 7]
