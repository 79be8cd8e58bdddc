"""Failure events: what is measured along a trajectory, and which limit of the robot it is compared with.

An event is data. Labels, tables, figures and estimators take the names and the number of events from the robot
(`Robot.events`): the paper's three, which every robot has, and those of OPTIONAL that the robot gives a limit for.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial, reduce

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from travjax.config import require


@dataclass(frozen=True)
class Nodes:
    """Where the robot touches the ground at one pose, as nodes (row * cols + col) of the map.

    wheels: of each entry of Pose.change; body: of the clearance; centre: the node nearest to the robot's centre
    """

    wheels: tuple[jax.Array, ...]
    body: jax.Array
    centre: jax.Array


@dataclass(frozen=True)
class Pose:
    """The state of the robot at one pose; arrays of one shape with an element for each arc and map.

    contact:     metres, height of the ground under each of the wheels FL, FR, RL, RR, or at which they rest
    change:      metres, change of each contact height since the previous pose, 0 at the first pose of a trajectory; or
                 of the contact model `tyre` one entry, the largest step that a tyre reaches
    pitch, roll: slopes of the pose plane, forward and to the right
    steepness:   square of the pose plane's slope, pitch^2 + roll^2
    clearance:   metres, highest chassis node above the pose plane
    nodes:       where that is; None unless it is asked for
    """

    contact: tuple[jax.Array, ...]
    change: tuple[jax.Array, ...]
    pitch: jax.Array
    roll: jax.Array
    steepness: jax.Array
    clearance: jax.Array
    nodes: Nodes | None = None

    @property
    def places(self) -> Nodes:
        """The nodes, which somebody asked for."""
        assert self.nodes is not None
        return self.nodes


@dataclass(frozen=True)
class Event:
    """One way to fail: a trajectory fails where its margin exceeds the limit.

    name:   what labels, tables and figures call it
    unit:   of margin and limit, "m" or "rad"
    limit:  the field of Robot that holds the limit; a robot where it is None does not have the event
    value:  computes the value at a pose; if it adds two products, `travjax.batching.rounded` keeps the result the
            same to the bit in any batch
    margin: computes the margin of a trajectory from the largest value at its poses, and must increase with it; the
            margin is that value unless given
    node:   tells at which node the value is reached, of the pose's Nodes; the robot's centre unless given
    """

    name: str
    unit: str
    limit: str
    value: Callable[[Pose], jax.Array]
    margin: Callable[[jax.Array], jax.Array] = lambda largest: largest
    node: Callable[[Pose], jax.Array] = lambda pose: pose.places.centre

    def shown(self, margin: float) -> str:
        """Formats a margin, or an error of one, in metres or degrees."""
        return f"{math.degrees(margin):.2f} degrees" if self.unit == "rad" else f"{margin:.4f} {self.unit}"


def larger(a: jax.Array, b: jax.Array) -> jax.Array:
    """Returns the larger of two numbers with one instruction; jnp.maximum also checks for NaN."""
    a, b = jnp.broadcast_arrays(a, b)
    return jax.lax.select(a > b, a, b)  # jnp.where is a function of its own wherever it is called: slow to compile


def _stepping_node(pose: Pose) -> jax.Array:
    """Returns the node under the wheel that has the largest change."""
    change, node = jnp.abs(pose.change[0]), pose.places.wheels[0]
    for other, there in zip(pose.change[1:], pose.places.wheels[1:], strict=True):
        node = jnp.where(jnp.abs(other) > change, there, node)
        change = larger(jnp.abs(other), change)
    return node


PAPER = (
    Event("step", "m", "max_step", lambda pose: reduce(larger, map(jnp.abs, pose.change)), node=_stepping_node),
    Event("obstacle", "m", "ride_height", lambda pose: pose.clearance, node=lambda pose: pose.places.body),
    Event("tilt", "rad", "max_tilt", lambda pose: pose.steepness, lambda largest: jnp.arctan(jnp.sqrt(largest))),
)
"""The events of the paper (SPEC section 5), which every robot has."""

OPTIONAL = (Event("roll", "rad", "max_roll", lambda pose: jnp.abs(pose.roll), jnp.arctan),)
"""Events that a robot has if it gives a limit for them; at most four, since a label is one byte."""

EVENTS = tuple(event.name for event in PAPER)
"""Names of the paper's events: those of most robots."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["step", "obstacle", "tilt", "known", "optional"],
    meta_fields=["names"],
)
@dataclass(frozen=True)
class Margins:
    """The margin of every trajectory for each event; NaN where unknown.

    step:     [n, t] metres, largest change of a wheel's contact height between poses
    obstacle: [n, t] metres, largest height of ground under the chassis above the pose plane
    tilt:     [n, t] radians, largest slope of the pose plane
    known:    [n, t] False where wheels or chassis touch unknown ground
    optional: margins of the robot's further events, [n, t] each
    names:    names of all events of the robot; margins["roll"] is the margin of one
    """

    step: Float[Array, "*n t"]
    obstacle: Float[Array, "*n t"]
    tilt: Float[Array, "*n t"]
    known: Bool[Array, "*n t"]
    optional: tuple[Float[Array, "*n t"], ...] = ()
    names: tuple[str, ...] = EVENTS

    def __getitem__(self, name: str) -> Float[Array, "*n t"]:
        """Returns the margin of an event; raises InputError where the robot does not have it."""
        require(name in self.names, "event", name, f"one of the robot's: {', '.join(self.names)}")
        return (self.step, self.obstacle, self.tilt, *self.optional)[self.names.index(name)]

    def events(self) -> Float[Array, "*n t k"]:
        """Stacks all margins in the order of the robot's events: step, obstacle, tilt first."""
        return jnp.stack([self[name] for name in self.names], axis=-1)


@partial(jax.tree_util.register_dataclass, data_fields=["pose", "node"], meta_fields=[])
@dataclass(frozen=True)
class Where:
    """Where every trajectory reaches its margin of each event, in the order of the robot's events.

    pose: [n, t, k] int32 number of the pose, as in ActionSpace.poses; negative before a turn ends
    node: [n, t, k, 2] int32 row and column on the map: the wheel's, the highest under the body, or the robot's centre
    Both are -1 where the trajectory is unknown; read `pose` together with Margins.known, since turns are negative too.
    """

    pose: Int[Array, "*n t k"]
    node: Int[Array, "*n t k 2"]


UNKNOWN_LABEL = 0b0000_1000
"""The bit of a label that marks an unknown trajectory."""

FAILED = 0b1111_0111
"""The bits of a label that mark failures: bits 0 to 2 the paper's events, bits 4 to 7 the optional events."""


def label_bit(event: int) -> int:
    """Returns the number of the bit in a label that marks a failure by the robot's event of this number."""
    return event if event < len(PAPER) else event + 1


def label_codes(events: int) -> int:
    """Returns the number that all labels for so many events are below: 16 for the paper's three."""
    return 2 << events
