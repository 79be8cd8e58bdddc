"""Convolution, pooling and batch normalisation whose gradients are as fast on a CPU as elsewhere.

XLA's own gradients take most of a training step on a CPU: it inverts a maximum one element at a time, fuses the sums of
batch normalisation into loops that run on one core, and transposes the operands of a kernel's gradient element by
element. Written as below, the same step takes a third of the time (BUILD_NOTES.md). Other backends use the
plain definitions. Images are NHWC, kernels HWIO.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from travjax.resnet import winograd
from travjax.resnet.winograd import flattened

WIDE = 128
"""Channels from which on a 3 x 3 convolution and its gradients are faster by Winograd's method than by XLA's."""


def convolve(images: jax.Array, kernel: jax.Array, stride: int = 1, padding: int = 0) -> jax.Array:
    """Cross-correlates without bias: [b, rows, cols, in] with [h, w, in, out] -> [b, rows, cols, out].

    padding: rows and columns of zeros added on each side
    """
    if jax.default_backend() != "cpu":
        return _correlate(images, kernel, stride, padding)
    size = kernel.shape[0]
    if kernel.shape[:2] == (1, 1) and padding == 0:
        return _pointwise(images[:, ::stride, ::stride], kernel)
    if stride == 1 and kernel.shape[:2] == (3, 3) and padding == 1 and _is_wide(images, kernel):
        return _three_by_three(images, kernel)
    if stride == 1 and kernel.shape[1] == size and padding < size:
        return _same_resolution(images, kernel, padding)
    return _strided(images, kernel, stride, padding)


def max_pool(images: jax.Array) -> jax.Array:
    """Takes the largest value of each 3 x 3 window, two pixels apart; the one pixel of padding never counts."""
    return _max_pool(images) if jax.default_backend() == "cpu" else _window_maxima(images)


def batch_norm(
    images: jax.Array, scale: jax.Array, bias: jax.Array, epsilon: float
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Normalises each channel by its mean and variance over the batch, in float32.

    scale, bias: [channels]
    Returns the normalised images in the same shape and dtype, and the mean and (population) variance [channels], which
    differentiation treats as constants.
    """
    flat = images.reshape(-1, images.shape[-1]).astype(jnp.float32)
    normalised, mean, var = (_batch_norm if jax.default_backend() == "cpu" else _normalised)(flat, scale, bias, epsilon)
    return normalised.reshape(images.shape).astype(images.dtype), lax.stop_gradient(mean), lax.stop_gradient(var)


def _correlate(images, kernel, stride: int, padding: int):
    edge = (padding, padding)
    return lax.conv_general_dilated(
        images, kernel, (stride, stride), (edge, edge), dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


@jax.custom_vjp
def _pointwise(images, kernel):
    """Computes a 1 x 1 convolution as one matrix product, so that its gradients are matrix products as well."""
    return _pointwise_forward(images, kernel)[0]


def _pointwise_forward(images, kernel):
    pixels = flattened(images)
    return (pixels @ kernel[0, 0]).reshape(*images.shape[:-1], -1), (pixels, kernel)


def _pointwise_backward(saved, gradient):
    pixels, kernel = saved
    flat = flattened(gradient)
    of_images = lax.dot_general(flat, kernel[0, 0], (((1,), (1,)), ((), ())))
    of_kernel = lax.dot_general(pixels, flat, (((0,), (0,)), ((), ())))
    return of_images.reshape(*gradient.shape[:-1], -1), of_kernel[None, None]


_pointwise.defvjp(_pointwise_forward, _pointwise_backward)


def _is_wide(images, kernel) -> bool:
    """Tells whether Winograd's transforms cost less than the products that they save, and lose no digits."""
    return min(kernel.shape[2:]) >= WIDE and images.dtype != jnp.bfloat16


@jax.custom_vjp
def _three_by_three(images, kernel):
    """Computes a 3 x 3 convolution, as Winograd does where gradients are wanted as well."""
    return _correlate(images, kernel, 1, 1)


_three_by_three.defvjp(winograd.convolve, winograd.gradients)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def _same_resolution(images, kernel, padding: int):
    """Computes a convolution of stride 1; the images' gradient is also one, with the kernel rotated."""
    return _correlate(images, kernel, 1, padding)


def _same_resolution_forward(images, kernel, padding: int):
    return _correlate(images, kernel, 1, padding), (images, kernel)


def _same_resolution_backward(padding: int, saved, gradient):
    images, kernel = saved
    turned = lax.optimization_barrier(kernel[::-1, ::-1].swapaxes(2, 3))
    of_images = _correlate(gradient, turned, 1, len(kernel) - 1 - padding)
    of_kernel = jax.linear_transpose(lambda k: _correlate(images, k, 1, padding), kernel)(gradient)[0]
    return of_images, of_kernel


_same_resolution.defvjp(_same_resolution_forward, _same_resolution_backward)


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _strided(images, kernel, stride: int, padding: int):
    """Computes any other convolution; the kernel's gradient is one matrix product over the patches under it."""
    return _correlate(images, kernel, stride, padding)


def _strided_forward(images, kernel, stride: int, padding: int):
    return _correlate(images, kernel, stride, padding), (images, kernel)


def _strided_backward(stride: int, padding: int, saved, gradient):
    images, kernel = saved
    of_images = jax.linear_transpose(lambda i: _correlate(i, kernel, stride, padding), images)(gradient)[0]
    patches = jnp.concatenate(list(_window_places(images, gradient.shape, kernel.shape, stride, padding, 0)), axis=-1)
    of_kernel = lax.dot_general(flattened(patches), flattened(gradient), (((0,), (0,)), ((), ())))
    return of_images, of_kernel.reshape(kernel.shape)


_strided.defvjp(_strided_forward, _strided_backward)


def _window_places(images, result, window, stride: int, padding: int, fill):
    """Yields what lies under each place of a window, row by row: [b, rows, cols, channels] of `result` each."""
    edges = ((0, 0), (padding, padding), (padding, padding), (0, 0))
    padded = jnp.pad(images, edges, constant_values=fill)
    rows, cols = (stride * (count - 1) + 1 for count in result[1:3])
    for i in range(window[0]):
        for j in range(window[1]):
            yield padded[:, i : i + rows : stride, j : j + cols : stride]


def _window_maxima(images):
    edges = ((0, 0), (1, 1), (1, 1), (0, 0))
    return lax.reduce_window(images, -jnp.inf, lax.max, (1, 3, 3, 1), (1, 2, 2, 1), edges)


@jax.custom_vjp
def _max_pool(images):
    """Pools with a gradient that goes to the first place of each window that holds the maximum."""
    return _window_maxima(images)


def _max_pool_forward(images):
    highest = _window_maxima(images)
    place = jnp.full(highest.shape, 8, jnp.uint8)
    places = list(_window_places(images, highest.shape, (3, 3), 2, 1, -jnp.inf))
    for number in reversed(range(8)):
        place = jnp.where(places[number] == highest, jnp.uint8(number), place)
    return highest, (place, images.shape[1:3])


def _max_pool_backward(saved, gradient):
    """Gathers the gradient of each pixel from the up to four windows that it lies in."""
    place, (rows, cols) = saved
    row = jnp.arange(rows, dtype=jnp.int32)[:, None, None]
    col = jnp.arange(cols, dtype=jnp.int32)[:, None]
    total = jnp.zeros((len(gradient), rows, cols, gradient.shape[-1]), gradient.dtype)
    for below in (0, 1):
        for right in (0, 1):
            # Pixel i lies in windows (i + 1) // 2 and i // 2; its row within a window is i + 1 - 2 * window.
            window_row, window_col = (row + below) // 2, (col + right) // 2
            own = (row + 1 - 2 * window_row) * 3 + col + 1 - 2 * window_col
            twice = (below == 1) & (row % 2 == 0) | (right == 1) & (col % 2 == 0)
            take = (_spread(place, below, right, rows, cols) == own) & ~twice
            total += jnp.where(take, _spread(gradient, below, right, rows, cols), 0)
    return (total,)


def _spread(windows, below: int, right: int, rows: int, cols: int):
    """Spreads the value of window ((row + below) // 2, (col + right) // 2) to each pixel."""
    padded = jnp.pad(windows, ((0, 0), (0, 1), (0, 1), (0, 0)))
    return padded.repeat(2, axis=1).repeat(2, axis=2)[:, below : below + rows, right : right + cols]


_max_pool.defvjp(_max_pool_forward, _max_pool_backward)


def _normalised(pixels, scale, bias, epsilon: float):
    mean = pixels.mean(axis=0)
    var = jnp.square(pixels - mean).mean(axis=0)
    return (pixels - mean) * (scale * lax.rsqrt(var + epsilon)) + bias, mean, var


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _batch_norm(pixels, scale, bias, epsilon: float):
    return _batch_norm_forward(pixels, scale, bias, epsilon)[0]


def _batch_norm_forward(pixels, scale, bias, epsilon: float):
    pixels = lax.optimization_barrier(pixels)
    mean = pixels.sum(axis=0) / len(pixels)
    var = _total(jnp.square(pixels - mean)) / len(pixels)
    inverse = lax.rsqrt(var + epsilon)
    return ((pixels - mean) * (scale * inverse) + bias, mean, var), (pixels, mean, inverse, scale)


def _batch_norm_backward(epsilon: float, saved, gradients):
    pixels, mean, inverse, scale = saved
    gradient = lax.optimization_barrier(gradients[0])
    of_bias = gradient.sum(axis=0)
    of_scale = _total(gradient * (pixels - mean)) * inverse
    along = inverse * of_scale / len(pixels)
    of_pixels = scale * inverse * (gradient - along * (pixels - mean) - of_bias / len(pixels))
    return lax.optimization_barrier(of_pixels), of_scale, of_bias


def _total(pixels):
    """Sums over the pixels [n, channels]; the operand is computed first, because a fused sum runs on one core."""
    return lax.optimization_barrier(pixels).sum(axis=0)


_batch_norm.defvjp(_batch_norm_forward, _batch_norm_backward)
