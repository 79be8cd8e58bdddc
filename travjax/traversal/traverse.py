"""The traverse simulator: every trajectory of a batch of maps in one pass (SPEC sections 5 and 15).

heights -> margins of all trajectories, by one of the contact models (nearest.py, tyre.py) -> failures.
"""

from functools import reduce

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from travjax.batching import in_batches
from travjax.jax_flags import usual_flags
from travjax.simulation.actions import ActionSpace
from travjax.simulation.events import UNKNOWN_LABEL, Margins, Where, label_bit
from travjax.simulation.grid import Grid
from travjax.simulation.heights import Heights, as_maps
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup, chosen_robot
from travjax.traversal.nearest import nearest_margins
from travjax.traversal.tyre_trajectories import tyre_margins


@usual_flags()
def simulate(
    heights: Heights,
    robot: Robot | str | None = None,
    actions: ActionSpace | None = None,
    *,
    grid: Grid = Grid(),
    contact: str | None = None,
    turn: bool = True,
    where: bool = False,
) -> Margins | tuple[Margins, Where]:
    """Simulates every trajectory on every map, and returns the margins.

    heights: [n, rows, cols] or [rows, cols] metres, NaN or masked where unknown; laid out as in grid.py. Any array of
             numbers, or nested lists; float64 heights are taken relative to the map's centre before they become
             float32, so a site at 2000 m loses nothing
    robot:   a Robot, or the name or file of one; the Seekur Jr unless given
    actions: the paper's action space unless given
    contact: "nearest", the paper's contact model (SPEC section 5), or "tyre" (15); that of the robot's file unless
             given, and "nearest" where it has none
    turn:    whether `tyre` simulates the point turn at the start of a trajectory; `nearest` never does
    where:   whether to return (Margins, Where): also the pose and the node at which each margin is reached
    Returns [n, t] arrays, or [t] for one map.
    Raises InputError when heights do not have the grid's shape or are not numbers, when they are infinite, beyond 30 km
    or a common marker of unknown ground such as -9999 (in a jax array, whose values are not checked, such heights count
    as unknown), and when a trajectory leaves the map or turns inside the robot.
    """
    setup = Setup.chosen(robot, actions, grid, contact, turn)
    return places_of(heights, setup) if where else margins_of(heights, setup)


@usual_flags()
def margins_of(heights: Heights, setup: Setup) -> Margins:
    """Simulates every trajectory of a setup on every map; takes the heights and raises the errors of `simulate`."""
    return _in_batches(heights, setup, where=False)[0]


@usual_flags()
def places_of(heights: Heights, setup: Setup) -> tuple[Margins, Where]:
    """Simulates every trajectory, and also returns where it reaches its margins; otherwise as `margins_of`."""
    margins, where = _in_batches(heights, setup, where=True)
    assert where is not None
    return margins, where


@usual_flags()
def margins_at_once(maps: Float[Array, "n rows cols"], setup: Setup) -> Margins:
    """Simulates every trajectory of a setup on maps as `margins_of` does, but on all of them in one batch.

    maps: metres, not checked
    """
    return _batch(maps, setup, where=False)[0]


def _batch(maps: Float[Array, "n rows cols"], setup: Setup, where: bool) -> tuple[Margins, Where | None]:
    simulate_batch = tyre_margins if setup.contact.model == "tyre" else nearest_margins
    return simulate_batch(maps, setup, where)


def _in_batches(heights: Heights, setup: Setup, where: bool) -> tuple[Margins, Where | None]:
    maps, alone = as_maps(heights, setup.grid)
    results = in_batches(lambda batch: _batch(batch, setup, where), maps)
    return jax.tree.map(lambda result: result[0], results) if alone else results


@usual_flags()
def failures(margins: Margins, robot: Robot | str | None = None) -> Bool[Array, "*n t k"]:
    """Tells which margins exceed the robot's limits, in the order of its events; False where unknown.

    Raises InputError when the margins lack one of the robot's events.
    """
    robot = chosen_robot(robot)
    chosen = jnp.stack([margins[name] for name in robot.event_names], axis=-1)
    return chosen > jnp.asarray(robot.limits, jnp.float32)


@usual_flags()
def label(
    heights: Heights,
    robot: Robot | str | None = None,
    actions: ActionSpace | None = None,
    *,
    grid: Grid = Grid(),
    contact: str | None = None,
    turn: bool = True,
) -> Bool[Array, "*n t k"]:
    """Tells which trajectories fail on every map; takes the arguments of `simulate` and raises its errors.

    Returns [n, t, 3] for step, obstacle and tilt, and more columns where the robot has limits for further events. Also
    False where a trajectory is unknown, so read it together with `simulate(...).known`.
    """
    return failures(margins_of(heights, Setup.chosen(robot, actions, grid, contact, turn)), robot)


@usual_flags()
@jax.jit
def packed(failed: Bool[Array, "*n t k"], known: Bool[Array, "*n t"]) -> UInt8[Array, "*n t"]:
    """Packs labels into a byte per trajectory: bits 0 to 2 step, obstacle and tilt, 3 unknown, 4 on further events."""
    bits = [failed[..., event].astype(jnp.uint8) << label_bit(event) for event in range(failed.shape[-1])]
    return reduce(jnp.bitwise_or, bits, jnp.where(known, jnp.uint8(0), jnp.uint8(UNKNOWN_LABEL)))


@usual_flags()
def packed_labels(heights: Heights, setup: Setup) -> UInt8[Array, "*n t"]:
    """Labels every trajectory of a setup on every map in a byte each; takes heights and raises as `simulate` does."""
    margins = margins_of(heights, setup)
    return packed(failures(margins, setup.robot), margins.known)


@usual_flags()
def unpacked(labels, robot: Robot | str | None = None) -> tuple[Bool[Array, "*n t k"], Bool[Array, "*n t"]]:
    """Unpacks labels that `packed` made for a robot, [n, t] uint8, into (failed, known)."""
    labels, count = jnp.asarray(labels), len(chosen_robot(robot).events)
    bits = jnp.array([1 << label_bit(event) for event in range(count)], jnp.uint8)
    return (labels[..., None] & bits) > 0, (labels & UNKNOWN_LABEL) == 0
