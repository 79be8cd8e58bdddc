"""Which products XLA may join with the sum that follows, rounding once, and which it may not."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def rounded(product: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Returns a product that is rounded before it is added to something.

    XLA repeats cheap expressions in several loops and joins multiply and add in some of them only, and where two
    products are added it joins either; the last bits would then hang on the form of the loop.
    The bound is never reached, which no optimiser knows.
    """
    return jnp.maximum(product, -1e30)
