"""Winograd's convolution against the plain definition, which JAX differentiates in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.resnet.test_convolution import assert_close, derived, exactly, plain_convolution, random
from travjax.resnet import winograd
from travjax.resnet.convolution import WIDE, convolve


@jax.custom_vjp
def by_winograd(images, kernel):
    return winograd.convolve(images, kernel)[0]


by_winograd.defvjp(winograd.convolve, winograd.gradients)


@pytest.mark.parametrize("rows_cols", [(1, 1), (1, 4), (2, 3), (5, 5), (6, 9), (17, 8)], ids=str)
def test_the_result_and_its_gradients_agree_with_the_definition(rows_cols):
    arrays = random(2, *rows_cols, 3), random(3, 3, 3, 4, seed=1)
    wanted = exactly(lambda x, k: plain_convolution(x, k, 1, 1), *arrays)
    assert_close(exactly(by_winograd, *arrays), wanted, 1e-13)


def test_whole_numbers_are_convolved_exactly():
    images, kernel = np.round(4 * random(1, 5, 4, 2)), 4 * np.round(2 * random(3, 3, 2, 3, seed=1))
    arrays = images.astype(np.float32), kernel.astype(np.float32)
    found = derived(by_winograd, *arrays)
    for one, other in zip(found, exactly(lambda x, k: plain_convolution(x, k, 1, 1), *arrays), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("size", [33, 5])
def test_rounding_in_float32_is_that_of_a_plain_convolution(size):
    arrays = random(2, size, size, WIDE).astype(np.float32), random(3, 3, WIDE, WIDE, seed=1).astype(np.float32)
    plain = lambda x, k: plain_convolution(x, k, 1, 1)
    wanted = exactly(plain, *arrays)
    found = derived(lambda x, k: convolve(x, k, 1, 1), *arrays)
    errors = [np.abs(one - other).max() / np.abs(other).max() for one, other in zip(found, wanted, strict=True)]
    assert max(errors) < 2e-6


@pytest.mark.parametrize(
    ("channels", "dtype", "used"), [(WIDE, "float32", True), (WIDE - 1, "float32", False), (WIDE, "bfloat16", False)]
)
def test_wide_kernels_of_full_precision_take_it_where_gradients_are_wanted(channels, dtype, used):
    convolved = lambda x, k: convolve(x, k, 1, 1)
    images, kernel = jnp.ones((1, 3, 3, channels), dtype), jnp.ones((3, 3, channels, channels), dtype)
    products = lambda function: str(jax.make_jaxpr(function)(images, kernel)).count("dot_general")
    assert products(convolved) == 0
    gradients = lambda x, k: jax.grad(lambda *arrays: convolved(*arrays).sum(), argnums=(0, 1))(x, k)
    assert products(gradients) == (48 if used else 0)
