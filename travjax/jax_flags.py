"""Keeps JAX's global flags from changing results: margins and files are the same whatever an application has set.

An application may choose 64-bit numbers, another random number generator or strict promotion for its own code, by
`jax.config` or JAX_... in the environment. Such flags change random numbers as well as types and rounding. The code
here therefore states its types and keys, and runs within `usual_flags` for everything that only a flag controls.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

GENERATOR = "threefry2x32"

_USUAL = (
    partial(jax.enable_x64, False),
    partial(jax.threefry_partitionable, True),
    partial(jax.default_prng_impl, GENERATOR),
    partial(jax.numpy_dtype_promotion, "standard"),
    partial(jax.numpy_rank_promotion, "allow"),
    partial(jax.default_matmul_precision, None),
    partial(jax.disable_jit, False),
    partial(jax.debug_nans, False),  # unknown ground is NaN
    partial(jax.debug_infs, False),
    partial(jax.transfer_guard, "allow"),  # NumPy arrays come in and go out
)
"""The defaults of the JAX flags that change results, or that raise errors for code that is correct here."""


@contextmanager
def usual_flags() -> Iterator[None]:
    """Runs a block, or the function that it decorates, as if no JAX flag had been set; applies to this thread only."""
    with ExitStack() as stack:
        for setting in _USUAL:
            stack.enter_context(setting())
        yield


def key_of(seed) -> Key[Array, ""]:
    """Returns the random key of a seed from 0 to 2^32 - 1, whatever generator and offset of seeds are set."""
    words = jnp.stack([jnp.zeros((), jnp.uint32), jnp.asarray(seed, jnp.uint32)])
    return jax.random.wrap_key_data(words, impl=GENERATOR)
