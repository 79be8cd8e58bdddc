"""The traverse simulator: every trajectory of a batch of maps in one pass (SPEC sections 5 and 15).

heights -> margins of all trajectories, by one of the contact models (nearest.py, tyre.py) -> failures.
"""

from functools import lru_cache, reduce

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, UInt8

from travjax.batching import in_batches
from travjax.config import require
from travjax.jax_flags import usual_flags
from travjax.simulation.actions import ActionSpace
from travjax.simulation.events import UNKNOWN_LABEL, Margins, Where, label_bit
from travjax.simulation.grid import Grid
from travjax.simulation.heights import Heights, as_maps
from travjax.simulation.nearest import nearest_margins
from travjax.simulation.robot import Robot
from travjax.simulation.tyre import tyre_margins


@lru_cache(maxsize=1)
def default_robot() -> Robot:
    """Returns the Seekur Jr, the paper's robot."""
    return Robot.load("seekur_jr")


def as_in_paper(robot: Robot, actions: ActionSpace) -> bool:
    """Tells whether both are the paper's, so that figures on synthetic maps can be compared with the paper's."""
    return robot == default_robot() and actions == ActionSpace()


def chosen_robot(robot: Robot | str | None) -> Robot:
    """Returns the default robot for None, else the robot that `Robot.load` makes of the argument."""
    return default_robot() if robot is None else Robot.load(robot)


def chosen_actions(actions: ActionSpace | None) -> ActionSpace:
    """Returns the paper's action space for None, else the given one; raises InputError if it is no ActionSpace."""
    require(isinstance(actions, ActionSpace | None), "actions", actions, "a travjax.ActionSpace")
    return ActionSpace() if actions is None else actions


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
    Returns [n, t] arrays, or [t] for one map. Source: SPEC section 5.
    Raises InputError when heights do not have the grid's shape or are not numbers, when they are infinite, beyond 30 km
    or a common marker of unknown ground such as -9999 (in a jax array, whose values are not checked, such heights count
    as unknown), and when a trajectory leaves the map or turns inside the robot.
    """
    maps, alone = as_maps(heights, grid)
    robot, actions = chosen_robot(robot), chosen_actions(actions)

    def simulate_batch(batch: jax.Array) -> tuple[Margins, Where | None]:
        if contact == "tyre":
            return tyre_margins(batch, robot, actions, grid, turn, where)
        return nearest_margins(batch, robot, actions, grid, where)

    results = in_batches(simulate_batch, maps)
    margins, places = jax.tree.map(lambda result: result[0], results) if alone else results
    return (margins, places) if where else margins


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
) -> Bool[Array, "*n t k"]:
    """Tells which trajectories fail on every map; takes the arguments and raises the errors of `simulate`.

    Returns [n, t, 3] for step, obstacle and tilt, and more columns where the robot has limits for further events. Also
    False where a trajectory is unknown, so read it together with `simulate(...).known`.
    """
    return failures(simulate(heights, robot, actions, grid=grid), robot)


@usual_flags()
@jax.jit
def packed(failed: Bool[Array, "*n t k"], known: Bool[Array, "*n t"]) -> UInt8[Array, "*n t"]:
    """Packs labels into a byte per trajectory: bits 0 to 2 step, obstacle and tilt, 3 unknown, 4 on further events."""
    bits = [failed[..., event].astype(jnp.uint8) << label_bit(event) for event in range(failed.shape[-1])]
    return reduce(jnp.bitwise_or, bits, jnp.where(known, jnp.uint8(0), jnp.uint8(UNKNOWN_LABEL)))


@usual_flags()
def unpacked(labels, robot: Robot | str | None = None) -> tuple[Bool[Array, "*n t k"], Bool[Array, "*n t"]]:
    """Unpacks labels that `packed` made for a robot, [n, t] uint8, into (failed, known)."""
    labels, count = jnp.asarray(labels), len(chosen_robot(robot).events)
    bits = jnp.array([1 << label_bit(event) for event in range(count)], jnp.uint8)
    return (labels[..., None] & bits) > 0, (labels & UNKNOWN_LABEL) == 0
