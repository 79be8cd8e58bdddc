"""Failure events: what is measured along a trajectory, and which of the robot's limits it is held against.

An event is data. Labels, tables, figures and estimators take names and number of the events from the robot
(`Robot.events`): the three of the paper, which every robot has, and those of OPTIONAL for which it gives a limit.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial, reduce

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from travjax.config import require


@dataclass(frozen=True)
class Pose:
    """What the simulator knows of the robot at one pose; arrays of one shape, an element for each arc and map.

    contact:     metres, height of the ground under each of the wheels FL, FR, RL, RR
    change:      metres, of each of them since the pose before; 0 at the first pose of a trajectory
    pitch, roll: slopes of the pose plane, forward and to the right
    steepness:   square of the pose plane's slope, pitch^2 + roll^2
    clearance:   metres, highest chassis node above the pose plane
    """

    contact: tuple[jax.Array, ...]
    change: tuple[jax.Array, ...]
    pitch: jax.Array
    roll: jax.Array
    steepness: jax.Array
    clearance: jax.Array


@dataclass(frozen=True)
class Event:
    """One way to fail: a trajectory fails where its margin exceeds the limit.

    name:   what labels, tables and figures call it
    unit:   of margin and limit, "m" or "rad"
    limit:  the field of Robot that is the limit; a robot that leaves it None does not have the event
    value:  of a pose; where two products are added in it, `travjax.batching.rounded` keeps its bits the same in any
            batch
    margin: of a trajectory, from the largest value of its poses, with which it grows; the value itself unless given
    """

    name: str
    unit: str
    limit: str
    value: Callable[[Pose], jax.Array]
    margin: Callable[[jax.Array], jax.Array] = lambda largest: largest

    def shown(self, margin: float) -> str:
        """A margin, or an error of one, as it is printed: in metres or degrees."""
        return f"{math.degrees(margin):.2f} degrees" if self.unit == "rad" else f"{margin:.4f} {self.unit}"


def larger(a: jax.Array, b: jax.Array) -> jax.Array:
    """Maximum of numbers: one instruction, where jnp.maximum also looks for NaN."""
    return jnp.where(a > b, a, b)


PAPER = (
    Event("step", "m", "max_step", lambda pose: reduce(larger, map(jnp.abs, pose.change))),
    Event("obstacle", "m", "ride_height", lambda pose: pose.clearance),
    Event("tilt", "rad", "max_tilt", lambda pose: pose.steepness, lambda largest: jnp.arctan(jnp.sqrt(largest))),
)
"""The events of the paper (SPEC section 5), which every robot has."""

OPTIONAL = (Event("roll", "rad", "max_roll", lambda pose: jnp.abs(pose.roll), jnp.arctan),)
"""Events that a robot has if it gives their limit; at most four, since a label is one byte."""

EVENTS = tuple(event.name for event in PAPER)
"""Names of the paper's events: those of most robots."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["step", "obstacle", "tilt", "known", "optional"],
    meta_fields=["names"],
)
@dataclass(frozen=True)
class Margins:
    """How far every trajectory goes towards each failure; NaN where unknown.

    step:     [n, t] metres, largest change of a wheel's contact height between poses
    obstacle: [n, t] metres, largest height of ground under the chassis above the pose plane
    tilt:     [n, t] radians, largest slope of the pose plane
    known:    [n, t] False where wheels or chassis touch unknown ground
    optional: [n, t] each, of the robot's further events
    names:    of all its events; margins["roll"] is the margin of one
    """

    step: Float[Array, "*n t"]
    obstacle: Float[Array, "*n t"]
    tilt: Float[Array, "*n t"]
    known: Bool[Array, "*n t"]
    optional: tuple[Float[Array, "*n t"], ...] = ()
    names: tuple[str, ...] = EVENTS

    def __getitem__(self, name: str) -> Float[Array, "*n t"]:
        """The margin of an event; raises InputError where the robot does not have it."""
        require(name in self.names, "event", name, f"one of the robot's: {', '.join(self.names)}")
        return (self.step, self.obstacle, self.tilt, *self.optional)[self.names.index(name)]

    def events(self) -> Float[Array, "*n t k"]:
        """All margins in the order of the robot's events: step, obstacle, tilt first."""
        return jnp.stack([self[name] for name in self.names], axis=-1)


UNKNOWN_LABEL = 0b0000_1000
"""The bit of a label that says unknown."""

FAILED = 0b1111_0111
"""The bits of a label that say that an event happens: bits 0 to 2 those of the paper, bits 4 to 7 optional ones."""


def label_bit(event: int) -> int:
    """The bit of a label that says that a robot's event of this number happens."""
    return event if event < len(PAPER) else event + 1


def label_codes(events: int) -> int:
    """A label of so many events is a number below this: 16 for the paper's three."""
    return 2 << events
