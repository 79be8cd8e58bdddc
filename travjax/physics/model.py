"""A robot on a map as a MuJoCo model.

The ground is a height field. Wheels are ellipsoids with soft contacts: stiff ones chatter, and a skid-steer robot then
hardly turns. The body is made of boxes whose ends are raised as the robot's file says. Robot and map share the frames
of SPEC section 1: x right, y forward.
"""

import importlib.util
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from travjax.config import InputError
from travjax.physics.config import PhysicsConfig
from travjax.simulation.robot import Robot

TIME_STEP = 0.004
"""Seconds."""

BOXES = (3, 7)
"""Boxes of the body across and along."""

SERVO_ERROR = 0.2
"""Radians a second: a wheel that is so much too slow gets the whole torque."""

BODY_HEIGHT = 0.2
"""Metres, of the boxes."""


def mujoco() -> ModuleType:
    """Returns the module mujoco; raises InputError that says how to install it where it is missing."""
    if importlib.util.find_spec("mujoco") is None:
        raise InputError('MuJoCo: not installed; needed: pip install "travjax[physics]"')
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
    boxes = [engine.mj_name2id(model, engine.mjtObj.mjOBJ_GEOM, f"box{i}") for i in range(BOXES[0] * BOXES[1])]
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
    boxes = "".join(_box(robot, across, along) for across in range(BOXES[0]) for along in range(BOXES[1]))
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


def _box(robot: Robot, across: int, along: int) -> str:
    """Returns one box of the body, above its part of the chassis."""
    count_x, count_y = BOXES
    half_x, half_y = robot.chassis_width / count_x / 2, robot.chassis_length / count_y / 2
    x, y = (2 * across + 1 - count_x) * half_x, (2 * along + 1 - count_y) * half_y
    beyond = max(robot.overall_length - robot.wheelbase, 1e-9) / 2
    raised = (robot.nose_rise or 0.0) * float(np.clip((abs(y) - robot.wheelbase / 2) / beyond, 0, 1))
    z = robot.ride_height - robot.wheel_diameter / 2 + raised + BODY_HEIGHT / 2
    return (
        f'<geom name="box{across * count_y + along}" type="box" size="{half_x} {half_y} {BODY_HEIGHT / 2}" '
        f'pos="{x} {y} {z}" mass="0" condim="3" friction="0.5 0.005 0.0001" contype="1" conaffinity="2"/>'
    )
