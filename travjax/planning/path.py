"""A path: poses that follow each other, and what the sequential simulators say about each of them."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float

from travjax.planning.motions import Motion
from travjax.site.ground import Site
from travjax.site.kernel import SiteSetup
from travjax.site.primitives import PointTurn
from travjax.traversal.pose_by_pose import Traverse, at_poses

WINDOW = 5.0
"""Metres, about, of path whose ground is cut out at once for the sequential simulators."""

TOLERANCE = 1e-6
"""Share of a limit by which rounding may lift a margin above it."""


class Stretch(Protocol):
    """A part of a path, whatever planner it is of: poses that follow each other, the first being the last before it."""

    @property
    def name(self) -> str:
        """What it is called."""

    @property
    def turning(self) -> bool:
        """Whether the robot turns on the spot."""

    def poses(self, interval: float, stride: float) -> Float[np.ndarray, "p 3"]:
        """Returns its poses, x and y in metres from the site's south-west node."""


@dataclass(frozen=True)
class Leg:
    """One motion of a path: from which place (row, col), which motion, and whether from its end to its beginning."""

    row: int
    col: int
    motion: Motion
    backwards: bool

    @property
    def name(self) -> str:
        """What the motion is called."""
        if not self.backwards:
            return self.motion.name
        return "turn_right" if self.turning else f"reverse_{self.motion.name}"

    @property
    def turning(self) -> bool:
        """Whether the robot turns on the spot."""
        return isinstance(self.motion.primitive, PointTurn)

    def poses(self, interval: float, stride: float) -> Float[np.ndarray, "p 3"]:
        """Returns its poses, x and y in metres from the site's south-west node."""
        poses = self.motion.primitive.poses(interval) + [self.col * stride, self.row * stride, 0]
        return poses[::-1] if self.backwards else poses


@dataclass(frozen=True, eq=False)
class PosedLeg:
    """A part of a path that keeps to no lattice.

    name:    what it is called; turning: whether the robot turns on the spot
    at:      [p, 3] its poses, x and y in metres from the site's south-west node
    length:  metres; turned: radians, all turning to the left and right added up
    """

    name: str
    turning: bool
    at: Float[np.ndarray, "p 3"]
    length: float
    turned: float

    def poses(self, interval: float, stride: float) -> Float[np.ndarray, "p 3"]:
        """Returns its poses, which no interval and no stride change."""
        return self.at


@dataclass(frozen=True)
class Path:
    """A path, as the sequential simulators see it; p poses.

    pose:     [p, 3] x, y in metres, in coordinates of the site, and heading in radians from 0 to 2 pi
    z:        [p] metres, height of the pose plane's centre; NaN on unknown ground, as the margins
    distance: [p] metres from its beginning, along the path
    motion:   [p] names of the motion that leads to each pose
    step, obstacle, tilt, roll: [p] metres and radians; step is that from the pose before, 0 at the first one and in
              turns; roll counts to both sides
    known:    [p] whether all ground that is touched is known
    share:    [p] the largest margin as a share of its limit, of all events of the robot; NaN on unknown ground. It
              includes, of `tyre`, the step that tyres reach where a drive begins
    exceeds:  [p] whether a limit of the robot is exceeded
    """

    pose: Float[np.ndarray, "p 3"]
    z: Float[np.ndarray, " p"]
    distance: Float[np.ndarray, " p"]
    motion: tuple[str, ...]
    step: Float[np.ndarray, " p"]
    obstacle: Float[np.ndarray, " p"]
    tilt: Float[np.ndarray, " p"]
    roll: Float[np.ndarray, " p"]
    known: Bool[np.ndarray, " p"]
    share: Float[np.ndarray, " p"]
    exceeds: Bool[np.ndarray, " p"]

    @property
    def length(self) -> float:
        """The metres from its beginning to its end."""
        return float(self.distance[-1])


def drive(
    legs: Sequence[Stretch], start: Float[np.ndarray, " 3"], ground: Site, setup: SiteSetup
) -> tuple[Path, list[int]]:
    """Simulates the poses of legs by the sequential simulators.

    start: pose where the path begins, and the first leg if there is one, from the site's south-west node
    Returns the path, and the number of the leg that each pose belongs to.
    """
    parts, owner = [np.asarray(start, float)[None]], [0]
    for number, leg in enumerate(legs):
        poses = leg.poses(setup.interval, setup.stride)[1:]
        parts.append(poses)
        owner += [number] * len(poses)
    poses = np.concatenate(parts)
    names = tuple(legs[number].name for number in owner) if legs else ("none",)
    turning = np.array([legs[number].turning for number in owner] if legs else [True])
    seen = list(_simulated(poses, ground, setup))
    step, obstacle, tilt, roll, known, z = (np.concatenate(field) for field in zip(*seen, strict=True))
    roll = np.abs(roll)
    counted = np.where(_counts(turning, setup.contact), step, 0)
    values = {"step": counted, "obstacle": obstacle, "tilt": tilt, "roll": roll}
    step = np.where(turning & known, 0, step)
    step[0] = np.where(known[0], 0, np.nan)
    robot = setup.robot
    shares = [values[event.name] / limit for event, limit in zip(robot.events, robot.limits, strict=True)]
    share = np.fmax.reduce(shares)  # a step from unknown ground is not known, the other margins are
    along = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    shift = np.array([*ground.origin, 0.0])
    pose = poses + shift
    pose[:, 2] %= 2 * math.pi
    distance = _arc_lengths(poses, along)
    exceeds = share > 1 + TOLERANCE
    z = z + ground.height_offset
    return Path(pose, z, distance, names, step, obstacle, tilt, roll, known, share, exceeds), owner


def _counts(turning: Bool[np.ndarray, " p"], contact: str) -> Bool[np.ndarray, " p"]:
    """Returns at which poses the step counts: those that drives lead to; of `tyre` also where drives begin."""
    drives = ~turning
    if contact == "tyre":
        drives = drives | np.append(drives[1:], False)
    return drives


def _arc_lengths(poses: np.ndarray, chords: np.ndarray) -> np.ndarray:
    """Returns the distance along the path to each pose: between two poses it is an arc."""
    half = np.abs(np.diff(poses[:, 2])) / 2
    half = np.minimum(half, math.pi - half)
    return np.concatenate([[0.0], np.cumsum(np.where(chords > 0, chords / np.sinc(half / math.pi), 0))])


def _simulated(poses: np.ndarray, ground: Site, setup: SiteSetup) -> Iterator[tuple[np.ndarray, ...]]:
    """Yields what the sequential simulators say, for parts of the poses."""
    cuts = [0]
    for number, pose in enumerate(poses):
        if np.abs(pose[:2] - poses[cuts[-1], :2]).max() > WINDOW / 2:
            cuts.append(number)
    for first, last in pairwise([*cuts, len(poses)]):
        before = max(first - 1, 0)  # a step is a change from the pose before
        seen, level = _on_window(poses[before:last], ground, setup)
        keep = slice(first - before, None)
        centre = seen.contact.mean(axis=1) + level
        yield tuple(field[keep] for field in (seen.step, seen.obstacle, seen.tilt, seen.roll, seen.known, centre))


def _on_window(poses: np.ndarray, ground: Site, setup: SiteSetup) -> tuple[Traverse, float]:
    """Returns what happens at poses that are near each other, and the height that contacts count from."""
    spacing, half = setup.spacing, setup.grid.cells // 2 + setup.halo * setup.step
    middle = [round(float(value) / spacing) for value in (poses[:, :2].min(axis=0) + poses[:, :2].max(axis=0)) / 2]
    half += math.ceil(np.abs(poses[:, :2] / spacing - middle).max())
    col, row = middle
    cut = ground.part(slice(row - half, row + half + 1), slice(col - half, col + half + 1)).astype(np.float64)
    level = float(np.nanmedian(cut)) if np.isfinite(cut).any() else 0.0
    shifted = poses - np.array([col * spacing, row * spacing, 0.0])
    return at_poses(cut - level, shifted, setup.robot, spacing, setup.contact), level
