"""Convolution, pooling and batch normalisation against their plain definitions, which JAX differentiates in float64."""

import os
import subprocess
import sys
import textwrap
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax
from jax.test_util import check_grads

from travjax.resnet.convolution import batch_norm, convolve, max_pool
from travjax.resnet.network import ResNet, ResNetConfig

EPSILON = 1e-5
KERNELS = [(1, 1), (1, 2), (3, 1), (3, 2), (7, 2)]
"""Size and stride of the kernels of a ResNet; their padding is half their size."""

SIZES = [(129, 5), (66, 65), (33, 9), (17, 8), (1, 1)]
"""Rows and columns of images."""

QUICK = {"xla_backend_optimization_level": 0}
"""Compiler options where the same mathematics is enough."""


def plain_convolution(images, kernel, stride: int = 1, padding: int = 0):
    edges = [(padding, padding)] * 2
    return lax.conv_general_dilated(images, kernel, (stride, stride), edges, dimension_numbers=("NHWC", "HWIO", "NHWC"))


def plain_max_pool(images):
    edges = ((0, 0), (1, 1), (1, 1), (0, 0))
    return lax.reduce_window(images, -jnp.inf, lax.max, (1, 3, 3, 1), (1, 2, 2, 1), edges)


def plain_batch_norm(images, scale, bias, epsilon: float):
    mean, var = images.mean((0, 1, 2)), images.var((0, 1, 2))
    return (images - mean) / jnp.sqrt(var + epsilon) * scale + bias, mean, var


def random(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape)


def weights_of(shape: tuple[int, ...]) -> np.ndarray:
    """The gradient of a value of that shape: random whole numbers, whose sums are exact."""
    return np.round(8 * random(*shape, seed=9))


def derived(function, *arrays, jit: bool = True, options=None) -> list[np.ndarray]:
    """The value of a function and the gradients of its arrays for the value's gradient `weights_of`."""

    def value_and_gradients(*arrays):
        value, backward = jax.vjp(function, *arrays)
        return value, *backward(jnp.asarray(weights_of(value.shape), value.dtype))

    run = jax.jit(value_and_gradients, compiler_options=options) if jit else value_and_gradients
    return [np.asarray(array) for array in run(*map(jnp.asarray, arrays))]


def exactly(function, *arrays) -> list[np.ndarray]:
    """`derived` in float64."""
    with jax.enable_x64(True):
        return derived(function, *(np.asarray(array, np.float64) for array in arrays), options=QUICK)


def assert_close(found, wanted, rtol: float):
    """To a share of the largest value, each array of two lists."""
    for one, other in zip(found, wanted, strict=True):
        assert one.shape == other.shape
        one, other = np.asarray(one, np.float64), np.asarray(other, np.float64)
        np.testing.assert_allclose(one, other, rtol=0, atol=rtol * max(np.abs(other).max(), 1e-30))


@pytest.fixture(params=["cpu", "gpu"], ids=["on_a_cpu", "elsewhere"])
def backend(request, monkeypatch) -> str:
    """Both ways through the module: that of a CPU, and the plain definitions of everything else."""
    monkeypatch.setattr("travjax.resnet.convolution.jax.default_backend", lambda: request.param)
    return request.param


# Convolution


@pytest.mark.parametrize("rows_cols", SIZES, ids=str)
@pytest.mark.parametrize(("size", "stride"), KERNELS)
def test_kernels_of_a_resnet_and_their_gradients_agree_with_the_definition(size, stride, rows_cols):
    arrays = random(2, *rows_cols, 3), random(size, size, 3, 4, seed=1)
    wanted = exactly(lambda x, k: plain_convolution(x, k, stride, size // 2), *arrays)
    found = exactly(lambda x, k: convolve(x, k, stride, size // 2), *arrays)
    assert_close(found, wanted, 1e-13)
    assert found[0].shape[1:3] == tuple((count - 1) // stride + 1 for count in rows_cols)


@st.composite
def convolutions(draw):
    """Images, kernel, stride and padding of any convolution that has a result."""
    whole = st.integers
    height, width, padding = draw(whole(1, 4)), draw(whole(1, 4)), draw(whole(0, 5))
    rows, cols = (draw(whole(max(1, length - 2 * padding), 9)) for length in (height, width))
    count, inputs, outputs = draw(whole(1, 3)), draw(whole(1, 3)), draw(whole(1, 3))
    arrays = random(count, rows, cols, inputs), random(height, width, inputs, outputs, seed=1)
    return *arrays, draw(whole(1, 5)), padding


@settings(max_examples=12)
@given(convolutions())
def test_any_convolution_and_its_gradients_agree_with_the_definition(drawn):
    images, kernel, stride, padding = drawn
    wanted = exactly(lambda x, k: plain_convolution(x, k, stride, padding), images, kernel)
    found = exactly(lambda x, k: convolve(x, k, stride, padding), images, kernel)
    assert_close(found, wanted, 1e-13)


@pytest.mark.parametrize(("size", "padding"), [(1, 1), (2, 0), (3, 0), (3, 2), (3, 4)])
def test_square_kernels_of_other_paddings_agree_with_the_definition(size, padding):
    arrays = random(2, 6, 5, 2), random(size, size, 2, 3, seed=1)
    wanted = exactly(lambda x, k: plain_convolution(x, k, 1, padding), *arrays)
    assert_close(exactly(lambda x, k: convolve(x, k, 1, padding), *arrays), wanted, 1e-13)


@pytest.mark.parametrize(("size", "stride"), [(1, 2), (3, 1), (3, 2)])
def test_gradients_of_convolutions_are_differences_of_their_values(size, stride):
    arrays = random(2, 6, 5, 2), random(size, size, 2, 3, seed=1)
    with jax.enable_x64(True):
        function = jax.jit(lambda x, k: convolve(x, k, stride, size // 2))
        check_grads(function, arrays, order=1, modes=["rev"])


@pytest.mark.parametrize(("size", "stride"), KERNELS)
def test_convolutions_in_float32(size, stride):
    arrays = random(2, 17, 16, 8).astype(np.float32), random(size, size, 8, 4, seed=1).astype(np.float32)
    function = lambda x, k: convolve(x, k, stride, size // 2)
    found = derived(function, *arrays)
    assert {array.dtype for array in found} == {np.dtype(np.float32)}
    assert_close(found, exactly(function, *arrays), 1e-5)


@pytest.mark.parametrize(("size", "stride"), [(1, 2), (3, 1), (3, 2)])
def test_convolutions_and_their_gradients_keep_bfloat16(size, stride, backend):
    images, kernel = (jnp.asarray(x, jnp.bfloat16) for x in (random(2, 9, 8, 8), random(size, size, 8, 4, seed=1)))
    function = lambda x, k: convolve(x, k, stride, size // 2)
    found = derived(function, images, kernel, options=QUICK)
    assert {array.dtype for array in found} == {jnp.dtype(jnp.bfloat16)}
    assert_close(found, exactly(function, images, kernel), 0.02)


@pytest.mark.parametrize(("size", "stride"), [(1, 2), (3, 1), (3, 2)])
def test_without_jit_and_by_the_plain_definitions_convolutions_are_the_same(size, stride, backend):
    arrays = random(2, 9, 8, 3).astype(np.float32), random(size, size, 3, 4, seed=1).astype(np.float32)
    function = lambda x, k: convolve(x, k, stride, size // 2)
    assert_close(derived(function, *arrays, jit=False), exactly(function, *arrays), 1e-5)


def test_the_parts_of_a_batch_are_convolved_apart():
    images, kernel = random(4, 9, 9, 3).astype(np.float32), random(3, 3, 3, 4).astype(np.float32)
    together = convolve(images, kernel, 2, 1)
    np.testing.assert_allclose(convolve(images[1:2], kernel, 2, 1)[0], together[1], rtol=1e-5, atol=1e-5)


# Maximum


def first_maxima(images: np.ndarray, gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maxima of the windows, and what each pixel gets that is the first of its window to hold the maximum."""
    maxima, total = np.empty_like(gradient), np.zeros_like(images)
    for item, row, col, channel in np.ndindex(gradient.shape):
        top, left = max(2 * row - 1, 0), max(2 * col - 1, 0)
        window = images[item, top : 2 * row + 2, left : 2 * col + 2, channel]
        i, j = np.unravel_index(window.argmax(), window.shape)
        maxima[item, row, col, channel] = window[i, j]
        total[item, top + i, left + j, channel] += gradient[item, row, col, channel]
    return maxima, total


@st.composite
def images_with_ties(draw) -> np.ndarray:
    """Small images of few values, mostly negative and some of them -inf."""
    shape = [draw(st.integers(1, most)) for most in (2, 8, 8, 2)]
    values = np.array([-np.inf, -3, -2, -1, 0, 1])[draw(st.integers(0, 4)) :]
    return np.random.default_rng(draw(st.integers(0, 999))).choice(values, shape).astype(np.float32)


@settings(max_examples=15)
@given(images_with_ties())
def test_of_equal_pixels_of_a_window_the_first_gets_the_gradient(images):
    maxima, gradient = derived(max_pool, images, options=QUICK)
    assert maxima.shape[1:3] == tuple((count + 1) // 2 for count in images.shape[1:3])
    wanted, total = first_maxima(images, weights_of(maxima.shape))
    np.testing.assert_array_equal(maxima, wanted)
    np.testing.assert_array_equal(gradient, total)


@pytest.mark.parametrize("rows_cols", SIZES, ids=str)
def test_maxima_and_their_gradient_are_those_of_xla(rows_cols):
    """Pixels of a channel have one, three and a thousand values."""
    images = -np.floor([1, 3, 1000] * np.random.default_rng(0).random((2, *rows_cols, 3)))
    for found, wanted in zip(exactly(max_pool, images), exactly(plain_max_pool, images), strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_the_gradient_of_maxima_is_the_difference_of_their_values():
    images = np.random.default_rng(0).permutation(2 * 6 * 7 * 2).reshape(2, 6, 7, 2) / 10 - 5
    with jax.enable_x64(True):
        check_grads(jax.jit(max_pool), (images,), order=1, modes=["rev"])


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_maxima_and_their_gradient_keep_their_dtype(dtype, backend):
    images = jnp.asarray(random(1, 5, 6, 2), dtype)
    found = derived(max_pool, images, options=QUICK)
    assert {array.dtype for array in found} == {jnp.dtype(dtype)}
    assert_close(found, exactly(max_pool, images), 0.01 if dtype == jnp.bfloat16 else 1e-6)


def test_without_jit_maxima_and_their_gradient_are_the_same():
    images = random(1, 5, 6, 2).astype(np.float32)
    assert_close(derived(max_pool, images, jit=False), derived(max_pool, images), 1e-6)


# Batch normalisation


def normalised(images, scale, bias):
    return batch_norm(images, scale, bias, EPSILON)[0]


def jitted(images, scale, bias):
    """Normalised images, mean and variance."""
    return jax.jit(lambda *arrays: batch_norm(*arrays, EPSILON))(images, scale, bias)


def plainly_normalised(images, scale, bias):
    return plain_batch_norm(images, scale, bias, EPSILON)[0]


def channels(count: int) -> tuple[np.ndarray, np.ndarray]:
    """A scale and a bias."""
    return 1 + random(count, seed=2).astype(np.float32) / 4, random(count, seed=3).astype(np.float32)


@pytest.mark.parametrize("shape", [(8, 17, 17, 5), (1, 2, 3, 1), (1, 1, 1, 3)], ids=str)
def test_batch_norm_and_its_gradients_agree_with_the_definition(shape, backend):
    arrays = (3 + 2 * random(*shape)).astype(np.float32), *channels(shape[-1])
    found, wanted = derived(normalised, *arrays), exactly(plainly_normalised, *arrays)
    assert {array.dtype for array in found} == {np.dtype(np.float32)}
    for one, other in zip(found, wanted, strict=True):
        # One pixel has no gradient, and two next to none: the terms that cancel are of the size of the weights.
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-5 * max(np.abs(other).max(), 8))
    exact = arrays[0].astype(np.float64)
    _, mean, var = jitted(*arrays)
    assert_close([mean, var], [exact.mean((0, 1, 2)), exact.var((0, 1, 2))], 1e-5)


def test_each_channel_is_normalised_by_itself(backend):
    """Fifty channels of very different mean and spread, each compared to its own largest value."""
    generator = np.random.default_rng(0)
    spread = 10 ** generator.uniform(-2, 2, 50)
    images = (spread * (generator.uniform(-4, 4, 50) + random(4, 9, 8, 50))).astype(np.float32)
    arrays = images, *channels(50)
    for one, other in zip(derived(normalised, *arrays), exactly(plainly_normalised, *arrays), strict=True):
        one, other = one.reshape(-1, 50), other.reshape(-1, 50)
        assert (np.abs(one - other) <= 1e-5 * np.maximum(np.abs(other).max(0), 1)).all()


def test_without_jit_batch_norm_is_the_same(backend):
    arrays = random(2, 4, 5, 3).astype(np.float32), *channels(3)
    assert_close(derived(normalised, *arrays, jit=False), derived(normalised, *arrays), 1e-5)


@pytest.mark.parametrize("value", [0.0, -1000.0])
def test_a_constant_channel_becomes_its_bias(value, backend):
    """Its variance is 0, so that its pixels' gradient is that of a shift and a scale of 1 / sqrt(epsilon)."""
    images = np.stack([np.full((2, 4, 4), value), random(2, 4, 4)], axis=-1).astype(np.float32)
    arrays = images, *channels(2)
    rounding = abs(value) / np.sqrt(EPSILON) * np.finfo(np.float32).eps
    assert_close(derived(normalised, *arrays), exactly(plainly_normalised, *arrays), 1e-5 + rounding)
    result, mean, var = jitted(*arrays)
    np.testing.assert_allclose(result[..., 0], arrays[2][0], rtol=0, atol=1e-6 + rounding)
    assert (mean[0], var[0]) == (value, 0)


@pytest.mark.parametrize("spread", [1.0, 0.1])
def test_a_small_variance_beside_a_large_mean_is_found(spread, backend):
    """The error of a result is a few roundings of the mean, measured in standard deviations."""
    images = (1e3 + spread * random(4, 17, 16, 3)).astype(np.float32)
    scale, bias = channels(3)
    value, of_images, of_scale, of_bias = derived(normalised, images, scale, bias)
    wanted = exactly(plainly_normalised, images, scale, bias)
    rounding = 1e3 / spread * np.finfo(np.float32).eps
    assert_close([value], wanted[:1], 4 * rounding)
    assert_close([of_images, of_scale, of_bias], wanted[1:], 4 * rounding)
    var = jitted(images, scale, bias)[2]
    assert_close([var], [images.astype(np.float64).var((0, 1, 2))], 1e-5)


def test_a_large_batch_is_summed_to_float32_accuracy():
    images = (10 + random(32, 65, 65, 2)).astype(np.float32)
    _, mean, var = jitted(images, *channels(2))
    exact = images.astype(np.float64)
    assert_close([mean, var], [exact.mean((0, 1, 2)), exact.var((0, 1, 2))], 2e-6)


def test_mean_and_variance_are_constants_in_differentiation(backend):
    images, scale, bias = random(2, 5, 5, 3).astype(np.float32), *channels(3)

    def loss(images, scale, bias, weight):
        result, mean, var = batch_norm(images, scale, bias, EPSILON)
        return jnp.square(result).sum() + weight * (mean + var).sum()

    gradient = jax.jit(jax.grad(loss, (0, 1, 2)))
    with_both, without = (gradient(images, scale, bias, weight) for weight in (100.0, 0.0))
    for one, other in zip(with_both, without, strict=True):
        np.testing.assert_array_equal(one, other)


def test_statistics_of_bfloat16_images_are_float32(backend):
    images = (100 + random(3, 64, 64, 3)).astype(jnp.bfloat16)
    result, mean, var = jitted(images, *channels(3))
    exact = images.astype(np.float64)
    assert result.dtype == jnp.bfloat16
    assert mean.dtype == var.dtype == jnp.float32
    assert_close([mean], [exact.mean((0, 1, 2))], 1e-6)
    assert_close([var], [exact.var((0, 1, 2))], 1e-4)


def test_gradients_of_bfloat16_images_are_bfloat16_and_those_of_scale_and_bias_float32(backend):
    arrays = jnp.asarray(random(3, 9, 8, 4), jnp.bfloat16), *channels(4)
    found = derived(normalised, *arrays)
    assert [array.dtype.name for array in found] == ["bfloat16", "bfloat16", "float32", "float32"]
    assert_close(found, exactly(plainly_normalised, *arrays), 0.02)


def test_batch_norm_of_a_batch_by_its_own_statistics_is_normal(backend):
    images = (5 + 3 * random(3, 64, 64, 3)).astype(np.float32)
    result = jitted(images, np.full(3, 2.0), np.full(3, 7.0))[0]
    _, mean, var = jitted(result, np.ones(3), np.zeros(3))
    assert_close([mean], [np.full(3, 7.0)], 1e-5)
    assert_close([var], [np.full(3, 4.0)], 1e-4)


# Together


def gradient_of_a_small_resnet() -> dict[str, np.ndarray]:
    """By path; the network has kernels of all sizes and strides, and a block without a projection."""
    config = ResNetConfig(blocks=(2, 1), width=4, stride_in="3x3")
    graph, *states = nnx.split(nnx.eval_shape(lambda: ResNet(config, rngs=nnx.Rngs(0))), nnx.Param, ...)
    parameters, rest = jax.tree.map(lambda leaf: (1 + random(*leaf.shape)).astype(leaf.dtype), states)
    images = random(4, 33, 34, 3).astype(np.float32)

    @partial(jax.jit, compiler_options=QUICK)
    def gradient(parameters, rest):
        def loss(parameters):
            features, stages = nnx.merge(graph, parameters, rest, copy=True)(images, train=True)
            return (features @ random(32, seed=4).astype(np.float32)).sum() + jnp.square(stages["stem"]).mean()

        return jax.grad(loss)(parameters)

    paths = jax.tree.leaves_with_path(gradient(parameters, rest))
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in paths}


def test_the_gradient_of_a_resnet_is_that_of_the_plain_definitions(monkeypatch):
    found = gradient_of_a_small_resnet()

    def constant_statistics(*arguments):
        result, *statistics = plain_batch_norm(*arguments)
        return result, *lax.stop_gradient(statistics)

    monkeypatch.setattr("travjax.resnet.network.convolve", plain_convolution)
    monkeypatch.setattr("travjax.resnet.network.max_pool", plain_max_pool)
    monkeypatch.setattr("travjax.resnet.network.batch_norm", constant_statistics)
    wanted = gradient_of_a_small_resnet()
    assert len(found) == 3 * 12
    for path, gradient in wanted.items():
        assert np.abs(gradient).max() > 0, path
        assert_close([found[path]], [gradient], 1e-3)  # sums over many pixels cancel


ON_DEVICES = """
import jax, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from travjax.resnet.convolution import batch_norm, convolve, max_pool

def step(images, parameters):
    def loss(images, parameters):
        first, pointwise, last, scale, bias = parameters
        x = max_pool(convolve(images, first, 2, 3))
        x, mean, var = batch_norm(x, scale, bias, 1e-5)
        x = convolve(x, pointwise, 2)
        return (convolve(convolve(x, last, 1, 1), last, 2, 1) ** 2).sum(), (mean, var)
    return jax.value_and_grad(loss, (0, 1), has_aux=True)(images, parameters)

random = np.random.default_rng(0)
shapes = (8, 33, 34, 3), (7, 7, 3, 4), (1, 1, 4, 4), (3, 3, 4, 4), (4,), (4,)
images, *parameters = (random.standard_normal(shape).astype(np.float32) for shape in shapes)
one = jax.jit(step)(images, parameters)
mesh = Mesh(np.array(jax.devices()), ("batch",))
part, whole = NamedSharding(mesh, PartitionSpec("batch")), NamedSharding(mesh, PartitionSpec())
four = jax.jit(step)(jax.device_put(images, part), jax.device_put(parameters, whole))
assert len(four[1][0].addressable_shards) == 4 and four[1][0].addressable_shards[0].data.shape[0] == 2
for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(four), strict=True):
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * np.abs(a).max())
print(len(jax.tree.leaves(four)))
"""


def test_four_devices_find_what_one_finds():
    variables = {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": "--xla_force_host_platform_device_count=4"}
    command = [sys.executable, "-W", "error", "-c", textwrap.dedent(ON_DEVICES)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=os.environ | variables)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [str(1 + 2 + 6)]
