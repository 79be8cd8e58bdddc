"""Drives trajectories in the physics engine, and says how they fail.

A robot is put down at the start of a first arc, settles, follows the arc, and from its end each of the second arcs,
so first arcs are driven once. The controller is a pure pursuit with a servo of the yaw rate, since a skid-steer robot
turns less than its wheels say.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from travjax.physics.model import TIME_STEP, World, mujoco
from travjax.simulation.actions import ActionSpace, arc_poses
from travjax.simulation.physics_table import PhysicsConfig
from travjax.simulation.robot import Robot

VERSION = 3
"""Version of controller and thresholds; it is written beside all labels."""

OUTCOMES = ("stuck", "contact", "off_path", "tip", "tilt", "bad_start")
"""Ways to fail; a bad start is one at which the robot does not stand, and is no failure of the trajectory."""

PROGRESS, PROGRESS_TIME = 0.05, 2.0
"""Stuck: less than so many metres along the path in so many seconds."""

FORCE, FORCE_TIME = 80.0, 0.1
"""Contact: the body bears more than so many newtons for so many seconds."""

OFF_PATH = 0.3
"""Metres between the robot's centre and the path."""

TIP = math.radians(60)
TILT_TIME = 0.1
"""Tilt: the robot leans more than its limit for so many seconds."""

LOOK_AHEAD = 0.3
"""Metres along the path."""

TURN_GAIN, TURN_INTEGRAL = 2.0, 8.0
"""The wheels' difference in speed follows the yaw rate that is wanted, and what it lacks."""

ACCELERATION = 0.5
"""Metres a second squared: a robot that starts at once on a steep slope rears up."""

CONTROL_STEPS = 5
"""Time steps between two decisions of the controller and looks at forces."""

SETTLE_TIME = 1.0


class Drive(NamedTuple):
    """What became of a trajectory.

    outcome: one of OUTCOMES, "" when it arrived; station: metres driven; tilt: largest, radians
    deviation: largest distance of the robot's centre from the path, metres
    """

    outcome: str
    station: float = 0.0
    tilt: float = 0.0
    deviation: float = 0.0


@dataclass
class Watch:
    """What the controller and the outcomes remember; copied where second arcs branch off."""

    speed: float = 0.0
    integral: float = 0.0
    force_time: float = 0.0
    tilt_time: float = 0.0
    station: float = 0.0
    progress_station: float = 0.0
    progress_time: float = 0.0
    highest_tilt: float = 0.0
    deviation: float = 0.0

    def drive(self, outcome: str, before: float = 0.0) -> Drive:
        """Returns the outcome of an arc that begins `before` metres from the trajectory's start."""
        return Drive(outcome, before + self.station, self.highest_tilt, self.deviation)


class Driver:
    """Drives trajectories of an action space on one map."""

    def __init__(self, world: World, robot: Robot, physics: PhysicsConfig, actions: ActionSpace, aside: float = 0.0):
        """Takes a compiled model of the robot on the map; aside: metres to the right that it is put down."""
        self.engine = mujoco()
        self.world, self.robot, self.physics, self.actions = world, robot, physics, actions
        self.data, self.aside = self.engine.MjData(world.model), aside
        self.spec = self.engine.mjtState.mjSTATE_INTEGRATION
        self.size = self.engine.mj_stateSize(world.model, self.spec)

    def drive(self, trajectories: Mapping[tuple[int, int], Sequence[int]], ground) -> dict[int, Drive]:
        """Drives second arcs after first arcs; returns outcomes by trajectory.

        trajectories: the second arcs to drive after each (turn, first arc)
        ground:       function of x and y arrays [m] that returns the ground's height, to put the robot down
        """
        results: dict[int, Drive] = {}
        for (turn, first), seconds in trajectories.items():
            start = self.actions.first_poses(turn, first)[0]
            junction = self.actions.first_poses(turn, first)[-1]
            indices = [int(self.actions.index(turn, first, second)) for second in seconds]
            if not self.put_down(start, ground):
                results |= {index: Drive("bad_start") for index in indices}
                continue
            watch = Watch()
            failed = self.follow(start, self.actions.radii[first], self.actions.arc_lengths[0], watch)
            if failed:
                results |= {index: watch.drive(failed) for index in indices}
                continue
            state = np.empty(self.size)
            self.engine.mj_getState(self.world.model, self.data, state, self.spec)
            for index, second in zip(indices, seconds, strict=True):
                self.engine.mj_setState(self.world.model, self.data, state, self.spec)
                self.engine.mj_forward(self.world.model, self.data)
                own = Watch(**(vars(watch) | {"station": 0.0, "progress_station": 0.0, "progress_time": 0.0}))
                failed = self.follow(junction, self.actions.radii[second], self.actions.arc_lengths[1], own)
                results[index] = own.drive(failed, self.actions.arc_lengths[0])
        return results

    def put_down(self, pose: np.ndarray, ground) -> bool:
        """Puts the robot down at (x, y, heading) and lets it settle; returns whether it stands there."""
        x, y, heading = pose[0] + self.aside * math.cos(pose[2]), pose[1] + self.aside * math.sin(pose[2]), pose[2]
        model, data, robot = self.world.model, self.data, self.robot
        self.engine.mj_resetData(model, data)
        right, forward = np.array(robot.wheel_positions()).T
        cos, sin = math.cos(heading), math.sin(heading)
        under = ground(x + right * cos - forward * sin, y + right * sin + forward * cos)
        pitch = ((under[0] + under[1]) - (under[2] + under[3])) / (2 * robot.wheelbase)
        roll = ((under[1] + under[3]) - (under[0] + under[2])) / (2 * robot.track)
        data.qpos[:3] = x, y, under.mean() + robot.wheel_diameter / 2 * math.sqrt(1 + pitch**2 + roll**2) + 0.03
        data.qpos[3:7] = _quaternion(heading, math.atan(pitch), -math.atan(roll))
        self.engine.mj_forward(model, data)
        forces = 0.0
        for step in range(round(SETTLE_TIME / TIME_STEP)):
            data.ctrl[:] = 0
            self.engine.mj_step(model, data)
            if step * TIME_STEP > SETTLE_TIME / 2 and step % CONTROL_STEPS == 0:
                forces = forces + CONTROL_STEPS * TIME_STEP if self.body_force() > FORCE else 0.0
        moved = math.hypot(data.qpos[0] - x, data.qpos[1] - y)
        return bool(moved < OFF_PATH / 2 and self.tilt() < self.robot.max_tilt and forces < FORCE_TIME)

    def follow(self, start: np.ndarray, radius: float, length: float, watch: Watch) -> str:
        """Follows an arc from `start` to its end; returns the outcome that ends it, "" when it arrives."""
        model, data = self.world.model, self.data
        stations = np.arange(0.0, length + LOOK_AHEAD + 0.01, 0.01)
        path = arc_poses(np.asarray(start, float), np.asarray(radius), stations)
        limit = 6 * (length / self.physics.speed) + 2 * PROGRESS_TIME
        for step in range(round(limit / TIME_STEP)):
            if step % CONTROL_STEPS == 0:
                outcome = self.watch_out(path, stations, length, watch)
                if outcome is not None:
                    return outcome
                self.steer(path, stations, watch)
            self.engine.mj_step(model, data)
        return "stuck"

    def watch_out(self, path: np.ndarray, stations: np.ndarray, length: float, watch: Watch) -> str | None:
        """Returns the outcome that ends an arc now, "" for its end, or None to go on."""
        span = CONTROL_STEPS * TIME_STEP
        position = self.data.qpos[:2]
        near = (stations > watch.station - 0.1) & (stations < watch.station + 0.3)
        distance = np.where(near, np.hypot(*(path[:, :2] - position).T), np.inf)
        nearest = int(distance.argmin())
        watch.station = max(watch.station, float(stations[nearest]))
        tilt, away = self.tilt(), float(distance[nearest])
        watch.deviation = max(watch.deviation, away)
        watch.highest_tilt = max(watch.highest_tilt, tilt)
        watch.tilt_time = watch.tilt_time + span if tilt > self.robot.max_tilt else 0.0
        watch.force_time = watch.force_time + span if self.body_force() > FORCE else 0.0
        watch.progress_time += span
        if watch.station >= watch.progress_station + PROGRESS:
            watch.progress_station, watch.progress_time = watch.station, 0.0
        if tilt > TIP:
            return "tip"
        if watch.tilt_time >= TILT_TIME:
            return "tilt"
        if watch.force_time >= FORCE_TIME:
            return "contact"
        if away > OFF_PATH:
            return "off_path"
        if watch.progress_time >= PROGRESS_TIME:
            return "stuck"
        return "" if watch.station >= length - 0.005 else None

    def steer(self, path: np.ndarray, stations: np.ndarray, watch: Watch) -> None:
        """Sets the speeds of the wheels towards a point ahead on the path."""
        ahead = path[min(int(np.searchsorted(stations, watch.station + LOOK_AHEAD)), len(path) - 1), :2]
        forward = self.axis(1)[:2]
        forward = forward / max(math.hypot(*forward), 1e-9)
        to = ahead - self.data.qpos[:2]
        along, left = float(to @ forward), float(forward[0] * to[1] - forward[1] * to[0])
        span = CONTROL_STEPS * TIME_STEP
        watch.speed = speed = min(self.physics.speed, watch.speed + ACCELERATION * span)
        wanted = speed * 2 * left / max(along**2 + left**2, 0.01)
        lacks = wanted - float(self.data.qvel[5])  # the yaw rate in the body's frame
        watch.integral = float(np.clip(watch.integral + TURN_INTEGRAL * lacks * span, -4, 4))
        turn = TURN_GAIN * wanted + watch.integral
        self.set_wheels(speed, float(np.clip(turn * self.robot.track / 2, -2 * speed, 2 * speed)))

    def set_wheels(self, speed: float, difference: float) -> None:
        """Sets the speeds of the wheels in m/s, `difference` more on the right and less on the left."""
        radius = self.robot.wheel_diameter / 2
        left, right = (speed - difference) / radius, (speed + difference) / radius
        self.data.ctrl[:] = left, right, left, right

    def turn_wheels(self, yaw_rate: float, seconds: float) -> float:
        """Lets the wheels turn at the speed as for a yaw rate without slip; returns the angle turned in radians."""
        self.set_wheels(self.physics.speed, yaw_rate * self.robot.track / 2)
        turned = 0.0
        for _ in range(round(seconds / TIME_STEP)):
            self.engine.mj_step(self.world.model, self.data)
            turned += float(self.data.qvel[5]) * TIME_STEP
        return turned

    def axis(self, which: int) -> np.ndarray:
        """Returns an axis of the robot in the world: 0 right, 1 forward, 2 up."""
        return self.data.xmat[1].reshape(3, 3)[:, which]

    def tilt(self) -> float:
        """Returns the angle between the robot's up and the vertical in radians."""
        return math.acos(max(-1.0, min(1.0, float(self.axis(2)[2]))))

    def body_force(self) -> float:
        """Returns the force in newtons that the ground exerts on the body's boxes."""
        data, total = self.data, 0.0
        force = np.zeros(6)
        for number in range(data.ncon):
            pair = data.contact[number].geom
            if pair[0] in self.world.body or pair[1] in self.world.body:
                self.engine.mj_contactForce(self.world.model, data, number, force)
                total += abs(float(force[0]))
        return total


def _quaternion(heading: float, pitch: float, roll: float) -> np.ndarray:
    """Returns the rotation by `roll` about forward, then `pitch` about right, then `heading` about up: w, x, y, z."""

    def about(axis: int, angle: float) -> np.ndarray:
        quaternion = np.zeros(4)
        quaternion[0], quaternion[1 + axis] = math.cos(angle / 2), math.sin(angle / 2)
        return quaternion

    def times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        vector = a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
        return np.concatenate([[a[0] * b[0] - a[1:] @ b[1:]], vector])

    return times(about(2, heading), times(about(0, pitch), about(1, roll)))
