"""What a map of a site says of each place: costs by heading, and bands over all headings (SPEC section 13)."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from travjax.simulation.events import PAPER, Margins
from travjax.simulation.robot import Robot

IMPASSABLE, UNKNOWN_COST = 100, 255
"""Costs of a pass that fails, and of one that is unknown; the others are 99 times the largest share of a limit."""


OVER = float(np.nextafter(np.float32(1), np.float32(2)))
"""The smallest share of a limit that exceeds it."""


KINDS = ("every known direction", "some directions", "no direction", "unknown")
"""How a place can be passable, by the number of `kinds_of`."""


def kinds_of(passable: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Returns the number in KINDS of places, from the bands passable_headings and known_headings."""
    return np.select([~(known > 0), passable == 0, passable < known], [3, 2, 1], 0)


def band_names(robot: Robot) -> tuple[str, ...]:
    """Returns the names of the bands in order: counts, costs, the paper's events, what blocks, further events."""
    paper = robot.event_names[: len(PAPER)]
    counts = ("passable_headings", "known_headings", "cost_best", "cost_worst")
    return (*counts, *paper, "blocking_event", *robot.event_names[len(PAPER) :])


@partial(jax.jit, static_argnames="robot")
def products(margins: Margins, robot: Robot) -> tuple[Float[Array, "b r c"], UInt8[Array, "h r c"]]:
    """Computes bands and costs of the margins of a pass in each heading, [h, r, c] each.

    Returns the bands of `band_names`, NaN where no heading is known except in known_headings, and the costs.
    Source: SPEC section 13.
    """
    known = margins.known
    # Without the barrier XLA multiplies by reciprocals, which are rounded.
    limits = jax.lax.optimization_barrier(jnp.array(robot.limits, jnp.float32))[:, None, None, None]
    of_events = jnp.moveaxis(margins.events(), -1, 0)
    over = of_events > limits  # a quotient may be rounded to 1
    shares, fails = jnp.where(over, jnp.maximum(of_events / limits, OVER), of_events / limits), over.any(axis=0)
    percent = jnp.clip(jnp.floor(99 * shares.max(axis=0)), 0, 99)
    cost = jnp.where(fails, IMPASSABLE, percent)
    count = known.sum(axis=0)
    somewhere = count > 0
    over_headings = jnp.where(known, shares, -jnp.inf).max(axis=1)
    worst_event = over_headings.argmax(axis=0)
    counts = [
        (known & ~fails).sum(axis=0),
        jnp.where(known, cost, jnp.inf).min(axis=0),
        jnp.where(known, cost, -jnp.inf).max(axis=0),
    ]
    passable, best, worst, *events = (jnp.where(somewhere, band, jnp.nan) for band in (*counts, *over_headings))
    blocking = jnp.where(over_headings.max(axis=0) > 1, 1 + worst_event, 0)
    blocking = jnp.where(somewhere, blocking, jnp.nan)
    paper, further = events[: len(PAPER)], events[len(PAPER) :]
    bands = jnp.stack([passable, count, best, worst, *paper, blocking, *further]).astype(jnp.float32)
    return bands, jnp.where(known, cost, UNKNOWN_COST).astype(jnp.uint8)
