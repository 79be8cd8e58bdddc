"""ResNet trunk in Flax NNX (He et al. 2016, arXiv 1512.03385; SPEC section 8).

Images are NHWC; all padding is explicit and symmetric. Layers have their historical names: `conv1`, then
`res2a.branch2a`, ... with stages counted from 2, blocks a, b, c, ..., and `branch1` the projection of a stage's
first block. Parameters and statistics are float32 whatever the type of the activations.
"""

from dataclasses import dataclass
from string import ascii_lowercase
from typing import Protocol

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Key

from travjax.config import require, require_number
from travjax.resnet.convolution import batch_norm, convolve, max_pool

EXPANSION = 4
"""Output channels of a bottleneck as a multiple of its inner channels."""


def _he_normal(key: Key[Array, ""], size: int, inputs: int, outputs: int) -> Float[Array, "size size in out"]:
    """Draws a kernel from a normal distribution of variance 2 / (size^2 outputs), He et al. 2015, arXiv 1502.01852.

    It is drawn as a matrix: XLA takes ten times as long to compile random numbers with several short axes.
    """
    deviation = jnp.sqrt(jnp.float32(2 / (size * size * outputs)))
    kernel = jax.random.normal(key, (size * size * inputs, outputs), jnp.float32) * deviation
    return kernel.reshape(size, size, inputs, outputs)


@dataclass(frozen=True)
class ResNetConfig:
    """Size and conventions of a ResNet; the defaults are ResNet50 v1.

    blocks:    bottlenecks in each stage
    width:     inner channels of the first stage and output channels of the stem, doubled from stage to stage
    stride_in: the convolution of a stage's first block that has the stride: "1x1" (v1) or "3x3" (v1.5)
    epsilon:   added to variances by batch normalisation
    momentum:  share of the old running statistics that a training step keeps
    dtype:     type of the activations, "float32" or "bfloat16"

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    blocks: tuple[int, ...] = (3, 4, 6, 3)
    width: int = 64
    stride_in: str = "1x1"
    epsilon: float = 1e-5
    momentum: float = 0.99
    dtype: str = "float32"

    def __post_init__(self):
        counted = isinstance(self.blocks, tuple) and all(
            type(count) is int and 1 <= count <= len(ascii_lowercase) for count in self.blocks
        )
        require(counted and 1 <= len(self.blocks) <= 8, "blocks", self.blocks, "1 to 8 whole numbers from 1 to 26")
        require(type(self.width) is int and 1 <= self.width <= 1024, "width", self.width, "a whole number, 1 to 1024")
        require(self.stride_in in ("1x1", "3x3"), "stride_in", self.stride_in, '"1x1" (v1) or "3x3" (v1.5)')
        require_number("epsilon", self.epsilon, 0, 0.1, "above 0 and at most 0.1")
        require_number("momentum", self.momentum, 0, 1, "above 0 and at most 1")
        require(self.dtype in ("float32", "bfloat16"), "dtype", self.dtype, '"float32" or "bfloat16"')

    @property
    def features(self) -> int:
        """Channels of the last stage."""
        return EXPANSION * self.width * 2 ** (len(self.blocks) - 1)


class NormConfig(Protocol):
    """The fields of a configuration that a batch normalisation needs."""

    @property
    def epsilon(self) -> float: ...

    @property
    def momentum(self) -> float: ...


class ConvNorm(nnx.Module):
    """A convolution without bias and its batch normalisation.

    kernel: [size, size, in, out], from a normal distribution of variance 2 / (size^2 out)
    scale, bias, mean, var: [out]
    """

    def __init__(self, inputs: int, outputs: int, size: int, stride: int, config: NormConfig, *, rngs: nnx.Rngs):
        self.kernel = nnx.Param(_he_normal(rngs.params(), size, inputs, outputs))
        self.scale = nnx.Param(jnp.ones(outputs, jnp.float32))
        self.bias = nnx.Param(jnp.zeros(outputs, jnp.float32))
        self.mean = nnx.BatchStat(jnp.zeros(outputs, jnp.float32))
        self.var = nnx.BatchStat(jnp.ones(outputs, jnp.float32))
        self.stride, self.padding, self.config = stride, size // 2, config

    def __call__(self, images: Float[Array, "b rows cols in"], train: bool) -> Float[Array, "b _rows _cols out"]:
        """Convolves and normalises; with `train` by the batch's statistics, which also update the running ones."""
        raw = convolve(images, self.kernel[...].astype(images.dtype), self.stride, self.padding)
        scale, bias, epsilon = self.scale[...], self.bias[...], self.config.epsilon
        if not train:
            factor = scale * jax.lax.rsqrt(self.var[...] + epsilon)
            return ((raw - self.mean[...]) * factor + bias).astype(raw.dtype)
        normalised, mean, var = batch_norm(raw, scale, bias, epsilon)
        kept = self.config.momentum
        self.mean[...] = kept * self.mean[...] + (1 - kept) * mean
        self.var[...] = kept * self.var[...] + (1 - kept) * var
        return normalised


class Bottleneck(nnx.Module):
    """Convolutions of 1x1, 3x3 and 1x1 beside a shortcut, which is a projection in the first block of a stage."""

    def __init__(self, inputs: int, inner: int, stride: int, first: bool, config: ResNetConfig, *, rngs: nnx.Rngs):
        outputs = EXPANSION * inner
        narrow, middle = (stride, 1) if config.stride_in == "1x1" else (1, stride)
        self.branch2a = ConvNorm(inputs, inner, 1, narrow, config, rngs=rngs)
        self.branch2b = ConvNorm(inner, inner, 3, middle, config, rngs=rngs)
        self.branch2c = ConvNorm(inner, outputs, 1, 1, config, rngs=rngs)
        self.branch1 = ConvNorm(inputs, outputs, 1, stride, config, rngs=rngs) if first else None

    def __call__(self, images: Float[Array, "b rows cols in"], train: bool) -> Float[Array, "b _rows _cols out"]:
        shortcut = images if self.branch1 is None else self.branch1(images, train)
        inner = jax.nn.relu(self.branch2a(images, train))
        inner = jax.nn.relu(self.branch2b(inner, train))
        return jax.nn.relu(shortcut + self.branch2c(inner, train))


class ResNet(nnx.Module):
    """A ResNet without its classifier: a stem, stages of bottlenecks and the mean over the last stage's pixels."""

    def __init__(self, config: ResNetConfig = ResNetConfig(), *, rngs: nnx.Rngs):
        self.config = config
        self.conv1 = ConvNorm(3, config.width, 7, 2, config, rngs=rngs)
        channels = config.width
        for stage, names in self._blocks().items():
            for name in names:
                first = name == names[0]
                stride = 2 if first and stage > 2 else 1
                inner = config.width * 2 ** (stage - 2)
                setattr(self, name, Bottleneck(channels, inner, stride, first, config, rngs=rngs))
                channels = EXPANSION * inner

    def _blocks(self) -> dict[int, list[str]]:
        """Returns the names of each stage's blocks."""
        counts = enumerate(self.config.blocks, start=2)
        return {stage: [f"res{stage}{letter}" for letter in ascii_lowercase[:count]] for stage, count in counts}

    def __call__(
        self, images: Float[Array, "b rows cols 3"], *, train: bool = False
    ) -> tuple[Float[Array, "b features"], dict[str, Array]]:
        """Returns features, float32, and the activations after the stem's pooling and after each stage, by name.

        train: whether to normalise by the batch's statistics and update the running ones
        """
        x = max_pool(jax.nn.relu(self.conv1(images.astype(self.config.dtype), train)))
        stages = {"stem": x}
        for stage, names in self._blocks().items():
            for name in names:
                x = getattr(self, name)(x, train)
            stages[f"stage{stage}"] = x
        return x.astype(jnp.float32).mean((1, 2)), stages
