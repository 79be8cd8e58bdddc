"""One step of training: a jitted function of the state and a batch.

The state is a dict of pytrees: parameters of "trunk" and "heads", the trunk's running "statistics", and the "optimizer"
state of what the phase trains.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx

from travjax.jax_flags import key_of, usual_flags
from travjax.models.hazard_field import HazardField
from travjax.models.names import FIELD
from travjax.models.trajectory_resnet import Estimator, merge_model
from travjax.runs.run import TRAINED

State = dict[str, Any]


def _of_heads(estimator: Estimator, features, failed, key):
    return _entropy(estimator.heads(features, key), failed)


def _of_samples(estimator: Estimator, inputs, failed, key):
    source, map_index, trajectory_index = inputs
    return _entropy(estimator(source.images(map_index, trajectory_index), train=True, key=key), failed)


def _of_maps(estimator: HazardField, inputs, targets, key):
    """Mean over the known trajectories of a map; targets: margins [b, t, k] in units of the limits, known [b, t]."""
    (elevation, stencil), (margins, known) = inputs, targets
    logits, predicted = estimator(elevation, stencil, train=True)
    off = optax.huber_loss(predicted, jnp.minimum(margins, LARGE_MARGIN), delta=SMALL_ERROR).sum(axis=-1)
    loss = _entropy(logits, margins > 1) + estimator.trunk.config.margin_weight * off
    return (loss * known).sum(axis=-1) / jnp.maximum(known.sum(axis=-1), 1)


def _entropy(logits, failed):
    return optax.sigmoid_binary_cross_entropy(logits, failed).sum(axis=-1)


LOSS: dict[int | str, Callable] = {1: _of_heads, 2: _of_samples, FIELD: _of_maps}
"""Of each sample of a batch, of each phase and of the hazard field: the cross-entropy summed over the events."""

LARGE_MARGIN = 4.0
"""Limits; margins are not told apart from there on."""

SMALL_ERROR = 0.3
"""Limits; up to there an error of a margin counts by its square."""


@usual_flags()
@partial(jax.jit, static_argnames=("graph", "phase", "optimizer", "penalty"), donate_argnames="state")
def update(state: State, inputs, targets, weight, seed, step, *, graph, phase: int | str, optimizer, penalty: float):
    """One step of a phase: the new state, and the mean of the loss over the batch.

    inputs, targets: what LOSS[phase] takes; weight: [b], 0 for a sample that only fills the batch up
    penalty: times the sum of squares of the heads' kernels
    """
    key = jax.random.fold_in(key_of(seed), step)

    def loss(parameters):
        estimator = merge_model(graph, state | parameters)
        each = LOSS[phase](estimator, inputs, targets, key)
        mean = (each * weight).sum() / weight.sum()
        added = penalty * estimator.heads.squares() if penalty else 0.0
        return mean + added, (mean, nnx.state(estimator, nnx.BatchStat))

    parameters = {name: state[name] for name in TRAINED[phase]}
    gradients, (mean, statistics) = jax.grad(loss, has_aux=True)(parameters)
    updates, moved = optimizer.update(gradients, state["optimizer"], parameters)
    return state | optax.apply_updates(parameters, updates) | {"statistics": statistics, "optimizer": moved}, mean


@jax.jit
def is_finite(state: State) -> jax.Array:
    """Whether all of it is numbers."""
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(state)]).all()
