"""Checks the model of a robot against what its maker says, before anything is labelled with it."""

import math
from dataclasses import dataclass, replace

import numpy as np

from travjax.physics.config import PhysicsConfig
from travjax.physics.labelling import label_ground
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot

GRID = Grid()
KERBS = (0.9, 1.0, 1.15)
"""Metres ahead of the start at which kerbs are."""

MORE = 1.2
"""A step of so many times the rated one must not be climbed."""


@dataclass(frozen=True)
class Check:
    """One thing that the model must do: what, found and wanted as texts, and whether it does."""

    what: str
    found: str
    wanted: str
    passed: bool


def check(robot: Robot, physics: PhysicsConfig, actions: ActionSpace = ActionSpace()) -> list[Check]:
    """Drives flat arcs, which must be followed, kerbs and a grade: what is rated must be climbed, and more must not."""
    x, y = np.meshgrid(GRID.axis(), GRID.axis())
    leaning = replace(robot, max_tilt=math.radians(60))  # only what stops it counts
    tightest = min(range(len(actions.radii)), key=lambda i: abs(actions.radii[i]))
    arcs = [int(actions.index(turn, first, tightest)) for turn, first in ((0, 0), (actions.turns // 3, tightest))]
    flat = label_ground(0 * x, arcs, leaning, physics, actions, GRID)
    ends = [f"{station:.2f} m" for station in flat.station]
    checks = [
        Check("arcs on flat ground", ", ".join(ends), f"{sum(actions.arc_lengths):.2f} m each", not flat.failed.any())
    ]
    for factor, wanted in ((1.0, 0), (MORE, len(KERBS))):
        climbs = [
            label_ground(factor * robot.max_step * (y > at), [0], leaning, physics, actions, GRID) for at in KERBS
        ]
        failed = sum(int(one.failed[0]) for one in climbs)
        text = "all climbed" if wanted == 0 else "none climbed"
        what = f"step of {factor * robot.max_step:.3f} m, {'rated' if factor == 1 else f'{MORE:g} times the rated'}"
        checks.append(Check(what, f"{len(KERBS) - failed} of {len(KERBS)} climbed", text, failed == wanted))
    grade = label_ground(_grade(y, robot.max_tilt), [0], leaning, physics, actions, GRID)
    degrees = math.degrees(robot.max_tilt)
    reached = f"{grade.station[0]:.2f} m, {math.degrees(grade.tilt[0]):.1f} degrees"
    checks.append(Check(f"grade of {degrees:.1f} degrees, rated", reached, "climbed", not grade.failed.any()))
    return checks


def _grade(y: np.ndarray, angle: float) -> np.ndarray:
    """A slope that grows smoothly to its angle over 1.5 m."""
    beyond, slope = np.maximum(y - 0.3, 0), math.tan(angle)
    return np.where(beyond < 1.5, slope * beyond**2 / 3, slope * (beyond - 0.75))


def passed(checks: list[Check]) -> bool:
    """Tells whether all checks passed."""
    return all(one.passed for one in checks)
