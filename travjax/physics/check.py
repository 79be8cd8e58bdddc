"""Checks the model of a robot against what its maker says, before anything is labelled with it."""

import math
from dataclasses import dataclass, replace

import numpy as np

from travjax.physics.drive import Driver
from travjax.physics.labelling import label_ground
from travjax.physics.model import build
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.physics_table import PhysicsConfig
from travjax.simulation.robot import Robot

GRID = Grid()
KERBS = (0.9, 1.0, 1.15)
"""Metres ahead of the start at which kerbs are."""

MORE = 1.2
"""A step of so many times the rated one must not be climbed."""


TRACKED = 0.1
"""Metres from the path, at most, on flat ground."""

YAW_RATIOS = (0.4, 1.0)
"""Ratio of the yaw rate to that which the wheels' speeds would give without slip; chattering contacts give 0.25."""


@dataclass(frozen=True)
class Check:
    """One thing that the model must do: what, found and wanted as texts, and whether it does."""

    what: str
    found: str
    wanted: str
    passed: bool


def check(robot: Robot, physics: PhysicsConfig, actions: ActionSpace = ActionSpace()) -> list[Check]:
    """Drives flat arcs, which must be followed, kerbs and a grade: what is rated must be climbed, and more must not."""
    return [
        *_on_flat_ground(robot, physics, actions),
        *_steps(robot, physics, actions),
        _grade(robot, physics, actions),
    ]


def _on_flat_ground(robot: Robot, physics: PhysicsConfig, actions: ActionSpace) -> list[Check]:
    """Checks that arcs are followed, and that the robot turns as well as it should for its wheels' speeds."""
    tightest = min(range(len(actions.radii)), key=lambda i: abs(actions.radii[i]))
    arcs = [int(actions.index(turn, first, tightest)) for turn, first in ((0, 0), (actions.turns // 3, tightest))]
    driven = label_ground(np.zeros(GRID.shape), arcs, _leaning(robot), physics, actions, GRID)
    ends = ", ".join(f"{station:.2f} m" for station in driven.station)
    strayed, ratio = float(driven.deviation.max()), yaw_ratio(robot, physics, abs(actions.radii[tightest]))
    low, high = YAW_RATIOS
    return [
        Check("arcs on flat ground", ends, f"{sum(actions.arc_lengths):.2f} m each", not driven.failed.any()),
        Check("distance from them", f"{strayed:.3f} m", f"at most {TRACKED:g} m", strayed <= TRACKED),
        Check("yaw rate to that of the wheels", f"{ratio:.2f}", f"{low:g} to {high:g}", low <= ratio <= high),
    ]


def yaw_ratio(robot: Robot, physics: PhysicsConfig, radius: float) -> float:
    """Returns the yaw rate on flat ground over that which wheels that turn for an arc would give without slip.

    radius: of the arc, metres
    """
    driver = Driver(build(np.zeros(GRID.shape), GRID.spacing, robot, physics), robot, physics, ActionSpace())
    driver.put_down(np.zeros(3), lambda x, y: np.zeros(np.shape(x)))
    wanted = physics.speed / radius
    driver.turn_wheels(wanted, 1.0)  # until the turn is steady
    return driver.turn_wheels(wanted, 2.0) / (2.0 * wanted)


def _steps(robot: Robot, physics: PhysicsConfig, actions: ActionSpace) -> list[Check]:
    """Checks that a kerb of the rated height is climbed and a higher one is not."""
    y = np.meshgrid(GRID.axis(), GRID.axis())[1]
    checks = []
    for factor, wanted in ((1.0, len(KERBS)), (MORE, 0)):
        kerbs = [factor * robot.max_step * (y > at) for at in KERBS]
        climbed = [not label_ground(kerb, [0], _leaning(robot), physics, actions, GRID).failed[0] for kerb in kerbs]
        what = f"step of {factor * robot.max_step:.3f} m, {f'{factor:g} times the rated' if wanted == 0 else 'rated'}"
        found, text = f"{sum(climbed)} of {len(KERBS)} climbed", "none climbed" if wanted == 0 else "all climbed"
        checks.append(Check(what, found, text, sum(climbed) == wanted))
    return checks


def _grade(robot: Robot, physics: PhysicsConfig, actions: ActionSpace) -> Check:
    """Checks that a slope of the rated grade, which grows smoothly over 1.5 m, is climbed."""
    y = np.meshgrid(GRID.axis(), GRID.axis())[1]
    beyond, slope = np.maximum(y - 0.3, 0), math.tan(robot.max_tilt)
    heights = np.where(beyond < 1.5, slope * beyond**2 / 3, slope * (beyond - 0.75))
    driven = label_ground(heights, [0], _leaning(robot), physics, actions, GRID)
    found = f"{driven.station[0]:.2f} m, {math.degrees(driven.tilt[0]):.1f} degrees"
    return Check(f"grade of {math.degrees(robot.max_tilt):.1f} degrees, rated", found, "climbed", not driven.failed[0])


def _leaning(robot: Robot) -> Robot:
    """Returns the robot with a tilt limit that only a fall exceeds, so that only what stops it counts."""
    return replace(robot, max_tilt=math.radians(60))


def passed(checks: list[Check]) -> bool:
    """Tells whether all checks passed."""
    return all(one.passed for one in checks)
