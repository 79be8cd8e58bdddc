"""JAX's global flags do not reach results: seeds, files and margins are the same whatever an application has set.

An application may want 64-bit numbers, another random number generator or strict promotion for code of its own, by
`jax.config` or JAX_... in the environment. Random numbers hang on such flags as well as types and rounding do. What
computes here says its types and keys itself and runs within `usual_flags`, for what only a flag can say.
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
"""What reaches results, or would raise an error over what is meant here, as JAX has it when nothing is set."""


@contextmanager
def usual_flags() -> Iterator[None]:
    """Runs what is within, or the function that it decorates, as if no flag of JAX had been set; in this thread."""
    with ExitStack() as stack:
        for setting in _USUAL:
            stack.enter_context(setting())
        yield


def key_of(seed) -> Key[Array, ""]:
    """Returns the random key of a seed from 0 to 2^32 - 1, whatever generator and offset of seeds are set."""
    words = jnp.stack([jnp.zeros((), jnp.uint32), jnp.asarray(seed, jnp.uint32)])
    return jax.random.wrap_key_data(words, impl=GENERATOR)
