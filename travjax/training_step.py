"""One step of training: a jitted function of the state and a batch.

The state is a dict of pytrees: parameters of "trunk" and "heads", the trunk's running "statistics", and the "optimizer"
state of what the phase trains.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx

from travjax.estimator import Estimator, put_together
from travjax.trained import TRAINED

State = dict[str, Any]


def _heads_alone(estimator: Estimator, features, key):
    return estimator.heads(features, key)


def _everything(estimator: Estimator, inputs, key):
    source, map_index, trajectory_index = inputs
    return estimator(source.images(map_index, trajectory_index), train=True, key=key)


FORWARD = {1: _heads_alone, 2: _everything}
"""The logits of a training step of each phase."""


@partial(jax.jit, static_argnames=("graph", "phase", "optimizer", "weight_decay"), donate_argnames="state")
def update(state: State, inputs, failed, weight, seed, step, *, graph, phase: int, optimizer, weight_decay: float):
    """One step of a phase: the new state, and the mean over the batch of the cross-entropy summed over the events.

    inputs: what FORWARD takes; failed: [b, 3]; weight: [b], 0 for a sample that only fills the batch up
    """
    key = jax.random.fold_in(jax.random.key(seed), step)

    def loss(parameters):
        estimator = put_together(graph, state | parameters)
        logits = FORWARD[phase](estimator, inputs, key)
        entropy = optax.sigmoid_binary_cross_entropy(logits, failed).sum(axis=-1)
        entropy = (entropy * weight).sum() / weight.sum()
        penalty = weight_decay * estimator.heads.squares()
        return entropy + penalty, (entropy, nnx.state(estimator, nnx.BatchStat))

    parameters = {name: state[name] for name in TRAINED[phase]}
    gradients, (entropy, statistics) = jax.grad(loss, has_aux=True)(parameters)
    updates, moved = optimizer.update(gradients, state["optimizer"], parameters)
    return state | optax.apply_updates(parameters, updates) | {"statistics": statistics, "optimizer": moved}, entropy


@jax.jit
def is_finite(state: State) -> jax.Array:
    """Whether all of it is numbers."""
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(state)]).all()
