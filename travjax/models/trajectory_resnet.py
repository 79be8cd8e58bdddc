"""The estimator: a ResNet trunk and a head for each event (SPEC section 8)."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Key

from travjax.config import require, require_number
from travjax.jax_flags import key_of, usual_flags
from travjax.resnet.imagenet_weights import Weights, apply_weights
from travjax.resnet.network import ResNet, ResNetConfig
from travjax.simulation.events import EVENTS


@dataclass(frozen=True)
class HeadsConfig:
    """Size of the heads.

    hidden:  units of each head's hidden layer
    dropout: share of these units left out in a training step

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    hidden: int = 512
    dropout: float = 0.2

    def __post_init__(self):
        require(
            type(self.hidden) is int and 1 <= self.hidden <= 65536, "hidden", self.hidden, "a number from 1 to 65536"
        )
        require_number("dropout", self.dropout, -1, 1, "a share from 0, below 1")
        require(0 <= self.dropout < 1, "dropout", self.dropout, "a share from 0, below 1")


class Head(nnx.Module):
    """The head of one event: a dense layer with ReLU and dropout, then one of a single unit, the logit."""

    def __init__(self, features: int, config: HeadsConfig, *, rngs: nnx.Rngs):
        self.hidden = nnx.Linear(features, config.hidden, rngs=rngs)
        self.logit = nnx.Linear(config.hidden, 1, rngs=rngs)
        self.dropout = nnx.Dropout(config.dropout)

    def __call__(self, features: Float[Array, "b f"], key: Key[Array, ""] | None) -> Float[Array, " b"]:
        hidden = jax.nn.relu(self.hidden(features))
        hidden = self.dropout(hidden, deterministic=key is None, rngs=key)
        return self.logit(hidden)[:, 0]


class Heads(nnx.Module):
    """The heads of all events, on the trunk's features; each is an attribute by its event's name."""

    def __init__(self, features: int, config: HeadsConfig, events: tuple[str, ...] = EVENTS, *, rngs: nnx.Rngs):
        self.events = events
        for event in events:
            setattr(self, event, Head(features, config, rngs=rngs))

    def __call__(self, features: Float[Array, "b f"], key: Key[Array, ""] | None = None) -> Float[Array, "b k"]:
        """Returns logits in the order of the events; with a key, dropout leaves out units."""
        heads = [getattr(self, event) for event in self.events]
        keys = [None] * len(heads) if key is None else list(jax.random.split(key, len(heads)))
        return jnp.stack([head(features, key) for head, key in zip(heads, keys, strict=True)], axis=-1)


class Estimator(nnx.Module):
    """Network from images of map and trajectory to a logit for each event."""

    def __init__(self, trunk: ResNet, heads: Heads):
        self.trunk = trunk
        self.heads = heads

    def __call__(
        self, images: Float[Array, "b rows cols 3"], *, train: bool = False, key: Key[Array, ""] | None = None
    ) -> Float[Array, "b k"]:
        """Returns logits in the order of the events.

        train: whether the trunk normalises by the batch's statistics and updates the running ones
        key:   key for dropout; no dropout without it
        """
        features, _ = self.trunk(images, train=train)
        return self.heads(features, key)


@usual_flags()
def create(
    trunk: ResNetConfig = ResNetConfig(),
    heads: HeadsConfig = HeadsConfig(),
    seed: int = 0,
    weights: Weights | None = None,
    events: tuple[str, ...] = EVENTS,
) -> Estimator:
    """Makes an estimator of the named events with random parameters, or with a trunk of `weights`.

    Raises InputError when the weights are those of another trunk.
    """
    make = lambda: ResNet(trunk, rngs=nnx.Rngs(key_of(seed)))
    if weights is None:
        body = make()
    else:
        body = nnx.eval_shape(make)  # random numbers for a whole trunk take ten seconds to compile
        apply_weights(body, weights)
    return Estimator(body, Heads(trunk.features, heads, events, rngs=nnx.Rngs(key_of(seed + 1))))
