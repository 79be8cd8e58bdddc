"""One step of training: a jitted function of the state and a batch.

The state is a dict of pytrees: parameters of "trunk" and "heads", the running "statistics", and the "optimizer" state
of the parts that the phase trains.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Float, Int

from travjax.estimators.kind import Batch, Phase
from travjax.jax_flags import key_of, usual_flags
from travjax.models.variables import merge_model

State = dict[str, Any]


@dataclass(frozen=True)
class StepSettings:
    """The static settings that a step is compiled for.

    graph:   the static part of the network
    phase:   the phase, which defines the loss and the parts that are trained
    penalty: factor of the sum of squares of the heads' kernels, which is added to the loss
    """

    graph: nnx.GraphDef
    phase: Phase
    optimizer: optax.GradientTransformation
    penalty: float = 0.0


@usual_flags()
@partial(jax.jit, static_argnames="settings", donate_argnames="state")
def update(
    state: State, batch: Batch, seed: int | Int[Array, ""], step: int | Int[Array, ""], *, settings: StepSettings
) -> tuple[State, Float[Array, ""]]:
    """Takes one step; returns the new state and the mean loss over the batch.

    batch:      its inputs are placed on the devices as the phase does it
    seed, step: together they seed the random numbers of the step
    """
    phase, key = settings.phase, jax.random.fold_in(key_of(seed), step)

    def loss(parameters: State) -> tuple[Float[Array, ""], tuple[Float[Array, ""], nnx.State]]:
        network = merge_model(settings.graph, state | parameters)
        each = phase.loss(network, batch.inputs, batch.targets, key)
        mean = (each * batch.weight).sum() / batch.weight.sum()
        added = settings.penalty * _squares((state | parameters)["heads"]) if settings.penalty else 0.0
        return mean + added, (mean, nnx.state(network, nnx.BatchStat))

    parameters = {name: state[name] for name in phase.trained}
    gradients, (mean, statistics) = jax.grad(loss, has_aux=True)(parameters)
    updates, moved = settings.optimizer.update(gradients, state["optimizer"], parameters)
    return state | optax.apply_updates(parameters, updates) | {"statistics": statistics, "optimizer": moved}, mean


def _squares(heads: nnx.State) -> Float[Array, ""]:
    """Returns the sum of the squares of the kernels of dense layers."""
    kernels = [kernel for path, kernel in nnx.to_flat_state(heads) if path[-1] == "kernel"]
    return jnp.stack([jnp.sum(jnp.square(kernel[...])) for kernel in kernels]).sum()


@jax.jit
def is_finite(state: State) -> jax.Array:
    """Tells whether every number of the state is finite."""
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(state)]).all()
