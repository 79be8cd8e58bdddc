"""A robot on a map as a MuJoCo model.

The ground is a height field. Wheels are ellipsoids with soft contacts: stiff ones chatter, and a skid-steer robot then
hardly turns. The body is made of boxes, the chassis and what the overall outline has beyond it; its ends are raised as
the robot's file says. Robot and map share the frames of SPEC section 1: x right, y forward.
"""

from dataclasses import dataclass
from itertools import pairwise, product
from types import ModuleType
from typing import Any

import numpy as np

from travjax.config import require_installed
from travjax.simulation.physics_table import PhysicsConfig
from travjax.simulation.robot import Robot

TIME_STEP = 0.004
"""Seconds."""

BOXES = (3, 7)
"""Boxes of the chassis across and along."""

BOX = "box"
"""What the names of the body's boxes begin with."""

SERVO_ERROR = 0.2
"""Radians a second: a wheel that is so much too slow gets the whole torque."""

BODY_HEIGHT = 0.2
"""Metres, of the boxes."""


def mujoco() -> ModuleType:
    """Returns the module mujoco; raises InputError that says how to install it where it is missing."""
    require_installed("mujoco", "MuJoCo", "physics")
    import mujoco

    return mujoco


@dataclass(frozen=True)
class World:
    """A compiled model, a mujoco.MjModel, and the numbers of the body's boxes among its geoms."""

    model: Any
    body: frozenset[int]


def build(heights: np.ndarray, spacing: float, robot: Robot, physics: PhysicsConfig) -> World:
    """Compiles the model of a robot on a map.

    heights: [rows, cols] metres without unknown nodes; spacing: metres
    """
    engine = mujoco()
    rows, cols = heights.shape
    low, rise = float(heights.min()), max(float(np.ptp(heights)), 1e-3)
    half = (cols - 1) * spacing / 2, (rows - 1) * spacing / 2
    model = engine.MjModel.from_xml_string(_xml(robot, physics, rows, cols, half, low, rise))
    model.hfield_data[:] = ((heights - low) / rise).astype(np.float32).ravel()
    boxes = [geom for geom in range(model.ngeom) if model.geom(geom).name.startswith(BOX)]
    return World(model, frozenset(boxes))


def _xml(robot: Robot, physics: PhysicsConfig, rows: int, cols: int, half, low: float, rise: float) -> str:
    radius, total = robot.wheel_diameter / 2, physics.mass + physics.payload
    wheel_mass = 0.05 * physics.mass
    soft = (
        f'solref="{physics.stiffness_time} {physics.stiffness_damping}" '
        f'solimp="{" ".join(map(str, physics.impedance))}"'
    )
    body = total - 4 * wheel_mass
    # The inertia of a box of the overall size and half a metre or the wheels' height.
    width, length, height = robot.overall_width, robot.overall_length, max(0.5, robot.wheel_diameter)
    inertia = [body / 12 * (a * a + b * b) for a, b in ((length, height), (width, height), (width, length))]
    # Heights in the body's frame, whose origin lies at the height of the axles.
    centre = (physics.centre_height - radius) * total / body
    boxes = "".join(_body(robot))
    wheels = "".join(
        f'<body pos="{right} {forward} 0">'
        f'<joint name="wheel{i}" type="hinge" axis="-1 0 0" armature="{physics.drive_inertia}" damping="0.1"/>'
        f'<geom type="ellipsoid" size="{robot.wheel_width / 2} {radius} {radius}" mass="{wheel_mass}" condim="3" '
        f'friction="{physics.friction} 0.005 0.0001" {soft} contype="1" conaffinity="2"/></body>'
        for i, (right, forward) in enumerate(robot.wheel_positions())
    )
    torque = physics.drive_torque / 2
    # A servo of each wheel; those of a side are tied together where a chain does it.
    servos = "".join(
        f'<velocity joint="wheel{i}" kv="{torque / SERVO_ERROR}" forcelimited="true" forcerange="{-torque} {torque}"/>'
        for i in range(4)
    )
    ties = '<equality><joint joint1="wheel0" joint2="wheel2"/><joint joint1="wheel1" joint2="wheel3"/></equality>'
    return f"""<mujoco>
  <compiler angle="radian"/>
  <option timestep="{TIME_STEP}" integrator="implicitfast" cone="elliptic" impratio="100"/>
  <size memory="64M"/>
  <asset><hfield name="ground" nrow="{rows}" ncol="{cols}" size="{half[0]} {half[1]} {rise} 1"/></asset>
  <worldbody>
    <geom name="ground" type="hfield" hfield="ground" pos="0 0 {low}" condim="3" contype="2" conaffinity="1"
      friction="{physics.friction} 0.005 0.0001" {soft}/>
    <body name="robot"><freejoint/>
      <inertial pos="0 0 {centre}" mass="{body}" diaginertia="{" ".join(map(str, inertia))}"/>
      {boxes}{wheels}
    </body>
  </worldbody>
  <actuator>{servos}</actuator>
  {ties if physics.coupled else ""}
</mujoco>"""


def _body(robot: Robot) -> list[str]:
    """Returns the boxes of the body: of the chassis, and of what the overall outline has beyond it but the tyres."""
    half_x, half_y = robot.chassis_width / 2, robot.chassis_length / 2
    outer_x, outer_y = robot.overall_width / 2, robot.overall_length / 2
    tyre_x, tyre_y = (robot.track + robot.wheel_width) / 2, (robot.wheelbase + robot.wheel_diameter) / 2
    across, along = (np.linspace(-half, half, count + 1) for half, count in zip((half_x, half_y), BOXES, strict=True))
    overhang = robot.ride_height if robot.overhang_height is None else robot.overhang_height
    parts = [(x, y, robot.ride_height) for x, y in product(pairwise(across), pairwise(along))]
    for sign in (-1, 1):
        end, corner = (half_y, outer_y), (tyre_y, half_y)
        parts += [
            (x, (sign * y[0], sign * y[1]), overhang)
            for x, y in (((-outer_x, outer_x), end), ((half_x, outer_x), corner), ((-outer_x, -half_x), corner))
            if y[0] < y[1] and x[0] < x[1]
        ]
        if tyre_x < outer_x:
            parts.append(((sign * tyre_x, sign * outer_x), (-half_y, half_y), overhang))
    return [_box(robot, f"{BOX}{number}", *part) for number, part in enumerate(parts)]


def _box(robot: Robot, name: str, x_edges, y_edges, underside: float) -> str:
    """Returns one box of the body; underside: its height above flat ground, in metres, where the ends do not rise."""
    x, y = sum(x_edges) / 2, sum(y_edges) / 2
    half_x, half_y = abs(x_edges[1] - x_edges[0]) / 2, abs(y_edges[1] - y_edges[0]) / 2
    beyond = max(robot.overall_length - robot.wheelbase, 1e-9) / 2
    raised = (robot.nose_rise or 0.0) * float(np.clip((abs(y) - robot.wheelbase / 2) / beyond, 0, 1))
    z = underside - robot.wheel_diameter / 2 + raised + BODY_HEIGHT / 2
    return (
        f'<geom name="{name}" type="box" size="{half_x} {half_y} {BODY_HEIGHT / 2}" '
        f'pos="{x} {y} {z}" mass="0" condim="3" friction="0.5 0.005 0.0001" contype="1" conaffinity="2"/>'
    )
