"""The hazard-field estimator: one pass over a map for all trajectories.

A U-Net turns the elevation into a few channels at every node, once for each map. The hazard of a pose, a logit and a
margin for each event, is computed by a small network from these channels at the pose's stencil (pose_stencil.py). That
network is the same at every place and heading, so the field is defined at any pose, without bins. A trajectory's logit
is the log-sum-exp of its poses' logits, its margin the largest of their margins; a first arc is read once for all
second arcs that follow it.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import nnx
from jax import lax
from jaxtyping import Array, Float

from travjax.config import require, require_number
from travjax.jax_flags import key_of, usual_flags
from travjax.models.pose_stencil import STENCIL_NODES, Stencil
from travjax.resnet.convolution import convolve
from travjax.resnet.network import ConvNorm
from travjax.simulation.events import EVENTS

RELIEF = 9
"""Nodes along the edge of the window whose mean is subtracted from the elevation for the first input channel."""

COARSE = 5.0
"""Elevation scales that count as 1 in the second input channel, which shows the map's large forms."""

FIRST_LOGIT = -6.0
"""Logit of each pose before training: failures are rare, and a trajectory has many poses."""

LARGE_MARGIN = 4.0
"""Multiple of a limit above which margins are no longer told apart."""

_he_normal = nnx.initializers.he_normal()


@dataclass(frozen=True)
class FieldConfig:
    """Size and conventions of the hazard-field estimator.

    stem:          channels at full resolution
    widths:        channels of each level of the U-Net, the first at half resolution
    channels:      channels at each node that poses read, including the elevation itself
    hidden:        units of each of the two layers that compute a pose's hazard from them
    margin_weight: weight of the margins in the loss, beside the cross-entropy of the failures
    epsilon, momentum: of batch normalisation, as in the ResNet
    dtype:         type of the U-Net's activations, "float32" or "bfloat16"

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    stem: int = 16
    widths: tuple[int, ...] = (32, 64)
    channels: int = 8
    hidden: int = 64
    margin_weight: float = 1.0
    epsilon: float = 1e-5
    momentum: float = 0.95
    dtype: str = "float32"

    def __post_init__(self):
        whole = lambda value, least: type(value) is int and least <= value <= 1024
        several = isinstance(self.widths, tuple) and all(whole(width, 1) for width in self.widths)
        require(several and 1 <= len(self.widths) <= 6, "widths", self.widths, "1 to 6 whole numbers from 1 to 1024")
        for name, least in (("stem", 1), ("channels", 2), ("hidden", 1)):
            value = getattr(self, name)
            require(whole(value, least), name, value, f"a whole number from {least} to 1024")
        require_number("margin_weight", self.margin_weight, -1e-300, 1000, "from 0 to 1000")
        require_number("epsilon", self.epsilon, 0, 0.1, "above 0 and at most 0.1")
        require_number("momentum", self.momentum, 0, 1, "above 0 and at most 1")
        require(self.dtype in ("float32", "bfloat16"), "dtype", self.dtype, '"float32" or "bfloat16"')


class Block(nnx.Module):
    """Two 3 x 3 convolutions with a shortcut."""

    def __init__(self, width: int, config: FieldConfig, *, rngs: nnx.Rngs):
        self.first = ConvNorm(width, width, 3, 1, config, rngs=rngs)
        self.second = ConvNorm(width, width, 3, 1, config, rngs=rngs)

    def __call__(self, images: Float[Array, "b rows cols c"], train: bool) -> Float[Array, "b rows cols c"]:
        return jax.nn.relu(images + self.second(jax.nn.relu(self.first(images, train)), train))


class UNet(nnx.Module):
    """Network from elevation to channels at each node (after Ronneberger et al. 2015, arXiv 1505.04597)."""

    def __init__(self, config: FieldConfig, *, rngs: nnx.Rngs):
        widths, steps = config.widths, list(zip(config.widths, config.widths[1:], strict=False))
        learned = config.channels - 1
        self.config = config
        self.stem = ConvNorm(2, config.stem, 3, 1, config, rngs=rngs)
        self.half = ConvNorm(config.stem, widths[0], 3, 2, config, rngs=rngs)
        self.encoder = nnx.List([Block(width, config, rngs=rngs) for width in widths])
        self.down = nnx.List([ConvNorm(upper, lower, 3, 2, config, rngs=rngs) for upper, lower in steps])
        self.up = nnx.List([ConvNorm(lower, upper, 1, 1, config, rngs=rngs) for upper, lower in steps])
        self.decoder = nnx.List([Block(upper, config, rngs=rngs) for upper, _ in steps])
        fine = _he_normal(rngs.params(), (9 * config.stem, learned), jnp.float32)  # a matrix compiles quickly
        self.fine = nnx.Param(fine.reshape(3, 3, config.stem, learned))
        coarse = _he_normal(rngs.params(), (widths[0], 4 * learned), jnp.float32)
        self.coarse = nnx.Param(coarse.reshape(1, 1, widths[0], 4 * learned))

    def __call__(self, elevation: Float[Array, "b rows cols"], train: bool) -> Float[Array, "b rows cols c"]:
        """Returns the channels at all nodes.

        elevation: in units of the elevation scale
        train:     whether to normalise by the batch's statistics, as ConvNorm does
        """
        relief = elevation - _window_means(elevation)
        inputs = jnp.stack([relief, elevation / COARSE], axis=-1).astype(self.config.dtype)
        stem = jax.nn.relu(self.stem(inputs, train))
        images = jax.nn.relu(self.half(stem, train))
        levels = []
        for level, block in enumerate(self.encoder):
            images = block(images, train)
            if level < len(self.down):
                levels.append(images)
                images = jax.nn.relu(self.down[level](images, train))
        for level in reversed(range(len(self.down))):
            upper = levels[level]
            images = upper + _doubled(jax.nn.relu(self.up[level](images, train)), upper.shape[1:3])
            images = self.decoder[level](images, train)
        dtype = images.dtype
        fine = convolve(stem, self.fine[...].astype(dtype), 1, 1)
        coarse = _four_nodes(convolve(images, self.coarse[...].astype(dtype)), elevation.shape[1:])
        learned = (fine + coarse).astype(jnp.float32)
        return jnp.concatenate([learned, elevation[..., None]], axis=-1)


class PoseHead(nnx.Module):
    """Network from the channels at a pose's stencil to the pose's logits and margins."""

    def __init__(self, config: FieldConfig, events: int, *, rngs: nnx.Rngs):
        inputs, hidden, outputs = (STENCIL_NODES + 1) * config.channels, config.hidden, 2 * events
        self.first = nnx.Linear(inputs, hidden, use_bias=False, kernel_init=_he_normal, rngs=rngs)
        self.bias = nnx.Param(jnp.zeros(hidden, jnp.float32))
        self.second = nnx.Linear(hidden, hidden, kernel_init=_he_normal, rngs=rngs)
        self.hazard = nnx.Linear(hidden, outputs, rngs=rngs)
        self.hazard.bias = nnx.Param(jnp.repeat(jnp.array([FIRST_LOGIT, 0.0], jnp.float32), events))

    def __call__(self, ground: Float[Array, "p s b c"]) -> Float[Array, "p b h"]:
        """Returns a logit of each event, then a margin of each in units of the robot's limits.

        The inputs are the ground relative to its mean over the stencil, and that mean.
        """
        mean = ground.mean(axis=1, keepdims=True)
        places = jnp.concatenate([ground - mean, mean], axis=1)
        kernel = self.first.kernel[...].reshape(places.shape[1], places.shape[3], -1)
        hidden = jax.nn.relu(jnp.einsum("psbc,sch->pbh", places, kernel) + self.bias[...])
        return self.hazard(jax.nn.relu(self.second(hidden)))


class HazardField(nnx.Module):
    """Network from elevation maps to the logits and margins of all trajectories."""

    def __init__(self, trunk: UNet, heads: PoseHead):
        self.trunk = trunk
        self.heads = heads

    def __call__(
        self, elevation: Float[Array, "b rows cols"], stencil: Stencil, *, train: bool = False
    ) -> tuple[Float[Array, "b t k"], Float[Array, "b t k"]]:
        """Returns the logits of a stencil's trajectories, and their margins in units of the robot's limits."""
        arcs, poses, _ = stencil.nodes.shape
        hazard = self.at(self.trunk(elevation, train), stencil.nodes.reshape(arcs * poses, -1))
        return read_out(hazard.reshape(arcs, poses, *hazard.shape[1:]), stencil)

    def at(self, channels: Float[Array, "b rows cols c"], nodes) -> Float[Array, "p b h"]:
        """Returns the field at poses of stencils [p, s], from the channels at all nodes."""
        maps, rows, cols, count = channels.shape
        # Maps and channels lie side by side, so that each node is one wide row to read, and to add to in the gradient.
        by_node = channels.reshape(maps, rows * cols, count).transpose(1, 0, 2).reshape(rows * cols, -1)
        ground = by_node.at[nodes].get(mode="promise_in_bounds")
        return self.heads(ground.reshape(*nodes.shape, maps, count))


def read_out(hazard: Float[Array, "f p b h"], stencil: Stencil) -> tuple[Float[Array, "b t k"], Float[Array, "b t k"]]:
    """Reduces the logits and margins of poses, in a stencil's order, to those of their trajectories."""
    first, rest = hazard[:, : stencil.first_poses], hazard[:, stencil.first_poses :]
    second = rest.reshape(len(hazard), stencil.second_arcs, -1, *hazard.shape[2:])
    events = hazard.shape[-1] // 2
    smooth = lambda part, axis: jax.nn.logsumexp(part[..., :events], axis=axis)
    logits = jnp.logaddexp(smooth(first, 1)[:, None], smooth(second, 2))
    margins = jnp.maximum(first[..., events:].max(axis=1)[:, None], second[..., events:].max(axis=2))
    by_map = lambda part: part.reshape(-1, *part.shape[2:]).swapaxes(0, 1)
    return by_map(logits), by_map(margins)


@usual_flags()
def create(config: FieldConfig = FieldConfig(), seed: int = 0, events: int = len(EVENTS)) -> HazardField:
    """Makes a hazard field with random parameters for a number of events."""
    trunk, heads = (nnx.Rngs(key_of(number)) for number in (seed, seed + 1))
    return HazardField(UNet(config, rngs=trunk), PoseHead(config, events, rngs=heads))


def _window_means(elevation: Float[Array, "b rows cols"]) -> Float[Array, "b rows cols"]:
    """Averages the RELIEF x RELIEF nodes around each node, with the map's edge repeated."""
    edge, padded = RELIEF // 2, elevation
    for axis in (1, 2):  # jnp.pad would do the same, but is not exported to ONNX as it should be
        first = lax.slice_in_dim(padded, 0, 1, axis=axis)
        last = lax.slice_in_dim(padded, -1, None, axis=axis)
        padded = jnp.concatenate([first] * edge + [padded] + [last] * edge, axis)
    return lax.reduce_window(padded, 0.0, lax.add, (1, RELIEF, RELIEF), (1, 1, 1), "VALID") / RELIEF**2


def _doubled(images: Float[Array, "b rows cols c"], shape: tuple[int, ...]) -> Float[Array, "b _rows _cols c"]:
    """Doubles the resolution by repeating pixels, and crops to a shape."""
    return images.repeat(2, axis=1).repeat(2, axis=2)[:, : shape[0], : shape[1]]


def _four_nodes(images: Float[Array, "b rows cols c"], shape: tuple[int, ...]) -> Float[Array, "b _rows _cols _c"]:
    """Spreads four groups of channels at half resolution over the four nodes of each 2 x 2 block, row by row."""
    maps, rows, cols, channels = images.shape
    spread = images.reshape(maps, rows, cols, 2, 2, channels // 4).transpose(0, 1, 3, 2, 4, 5)
    return spread.reshape(maps, 2 * rows, 2 * cols, channels // 4)[:, : shape[0], : shape[1]]
