"""The functions that are exported: heights as they come in, arrays by name out.

All that `Predictor.predict` and `simulate` do on the host is part of them. Tables and variables are constants; they lie
behind barriers, because XLA would compute with them beforehand, with other last bits than `predict`.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from travjax.config import require
from travjax.estimators.map_samples import relative
from travjax.models.hazard_field import HazardField
from travjax.models.pose_stencil import Stencil, stencil
from travjax.models.variables import merge_model, split_model
from travjax.runs.predictor import Predictor
from travjax.simulation.grid import HIGHEST, MARKERS
from travjax.simulation.setup import Setup
from travjax.traversal.traverse import failures, margins_of

Function = Callable[[Float[Array, "b rows cols"]], dict[str, jax.Array]]
"""A function from heights in metres, NaN unknown, to arrays [b, ...] by name."""


def field_function(predictor: Predictor, barriers: bool = True) -> Function:
    """Returns the function that predicts as a hazard field does: probability and margin, [b, t, k] each.

    barriers: whether constants lie behind barriers, which ONNX has none of
    Margins are in metres and radians. Raises InputError for an estimator of another kind.
    """
    run = predictor.run
    of_field = isinstance(predictor.network, HazardField)
    require(of_field, "model", run.preset.model, "field: other estimators compute an image for every trajectory")
    graph, variables = split_model(predictor.network)
    table = stencil(run.setup)
    small = table.nodes.astype(np.min_scalar_type(table.nodes.max()))  # half the size of the file
    limits = np.asarray(run.robot.limits, np.float32)

    def predicted(heights: Float[Array, "b rows cols"]) -> dict[str, jax.Array]:
        constants = small, variables, np.float32(run.preset.elevation_scale)
        nodes, own, scale = jax.lax.optimization_barrier(constants) if barriers else constants
        ground = jax.vmap(nearest_filled)(_known(heights))
        elevation = relative(ground, scale)
        read_at = Stencil(jnp.asarray(nodes, jnp.int32), table.first_poses, table.second_arcs)
        logits, margins = merge_model(graph, own)(elevation, read_at)
        return {"probability": jax.nn.sigmoid(logits), "margin": margins * limits}

    return predicted


def simulator_function(setup: Setup) -> Function:
    """Returns the function that simulates: the margins by name, `known`, [b, t] each, and `failed`, [b, t, k]."""

    def simulated(heights: Float[Array, "b rows cols"]) -> dict[str, jax.Array]:
        margins = margins_of(heights, setup)
        by_name = {name: margins[name] for name in margins.names}
        return by_name | {"known": margins.known, "failed": failures(margins, setup.robot)}

    return simulated


def known_function(setup: Setup) -> Function:
    """Returns the function that tells which trajectories `simulate` knows: known, [b, t]."""
    return lambda heights: {"known": margins_of(heights, setup).known}


def map_by_map(*functions: Function) -> Function:
    """Returns the function of the results of all functions, which are applied to one map after another.

    Any number of maps then needs the memory of one, and each gets the bits that it gets alone.
    """

    def of_map(heights: Float[Array, "rows cols"]) -> dict[str, jax.Array]:
        results = [function(heights[None]) for function in functions]
        return {name: array[0] for part in results for name, array in part.items()}

    return lambda heights: jax.lax.map(of_map, heights)


def _known(heights: Float[Array, "b rows cols"]) -> Float[Array, "b rows cols"]:
    """Replaces by NaN what is no height: infinite or absurd values, and common markers of unknown ground."""
    known = jnp.abs(heights) <= HIGHEST
    for mark in MARKERS:
        known &= heights != mark
    return jnp.where(known, heights, jnp.nan)


def nearest_filled(heights: Float[Array, "rows cols"]) -> Float[Array, "rows cols"]:
    """Gives each NaN the height of the nearest known node, of several that which `sensor_noise.filled` takes.

    A map without any known node becomes flat. Distances are exact; they are float32 because ONNX lacks the running
    maximum of integers.
    """
    rows, cols = heights.shape
    row, col = jnp.arange(rows, dtype=jnp.float32)[:, None], jnp.arange(cols, dtype=jnp.float32)
    known, far = ~jnp.isnan(heights), float(rows + cols)
    before = jax.lax.cummax(jnp.where(known, row, -far), axis=0)
    after = jax.lax.cummin(jnp.where(known, row, 2 * far), axis=0, reverse=True)
    in_column = jnp.where(row - before <= after - row, before, after)  # row of the nearest one of the same column
    distance = (in_column - row)[:, None, :] ** 2 + (col[:, None] - col) ** 2
    column = distance.argmin(axis=-1)
    nearest = jnp.take_along_axis(in_column, column, axis=1).clip(0, rows - 1).astype(jnp.int32)
    return jnp.where(known.any(), heights[nearest, column], 0)
