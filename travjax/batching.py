"""Processes many maps in batches of a few fixed sizes, so that few shapes are compiled and results do not depend on the
batch.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

BATCH = 32
"""Maps in a batch: more gains nothing on a CPU and costs memory."""


def in_batches(function: Callable[[Any], Any], items: Any) -> Any:
    """Applies `function` to batches of `items` and puts the results together.

    items: a pytree of arrays with a common leading axis [n, ...]; so are the results. A batch has BATCH items; the
    last one has the power of two that holds the rest, padded by repeating its first item.
    """
    count = len(jax.tree.leaves(items)[0])
    results = []
    for start in range(0, count, BATCH):
        size = min(BATCH, count - start)
        missing = (1 << (size - 1).bit_length()) - size
        batch = jax.tree.map(lambda item: _filled(item[start : start + size], missing), items)  # noqa: B023
        results.append(jax.tree.map(lambda result: result[:size], function(batch)))  # noqa: B023
    return results[0] if len(results) == 1 else jax.tree.map(lambda *parts: jnp.concatenate(parts), *results)


def _filled(item: jax.Array, missing: int) -> jax.Array:
    return jnp.concatenate([item, jnp.repeat(item[:1], missing, axis=0)]) if missing else item


def rounded(product: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Returns a product that is rounded before it is added to something.

    XLA repeats cheap expressions in several loops and fuses multiply and add in only some of them, and where two
    products are added it may fuse either; the last bits would then depend on the form of the loop.
    The bound is never reached, but the optimiser cannot know that.
    """
    return jnp.maximum(product, -1e30)
