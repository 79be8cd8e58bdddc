"""Grounds to drive on, and tasks: from a place to another that is far away, with the length of the best path."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from travjax.config import load_toml, require, require_length, require_number
from travjax.data.sensor_noise import CORRUPTIONS, filled
from travjax.files import find_data
from travjax.planning.no_path import NoPathError
from travjax.planning.planner import Planner
from travjax.simulation.contact import require_contact
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.site.ground import ArrayGround, SiteGround
from travjax.terrain.styles import STYLES, generate_terrain

TRIES = 50
"""Pairs of places that are drawn for a task before its ground is given up."""

KNOWN = 0.98
"""Least share of a real window that has to be known; the rest gets the height of the nearest known node."""


@dataclass(frozen=True)
class RealGround:
    """Windows of a real site. file: looked for here or under TRAVJAX_DATA; size: metres, edge of a window."""

    file: str
    size: float = 40.0
    windows: int = 1

    def __post_init__(self):
        require_length("size", self.size, 4, 1000)
        require(self.windows > 0, "windows", self.windows, "at least 1")


@dataclass(frozen=True)
class NavigationConfig:
    """What is driven where.

    robot:       name or file; contact: contact model of planner and truth, that of the estimator
    maps, size, style, world: synthetic grounds, their edge in metres, and their making, as of `travjax terrain`
    tasks:       on each ground; least: least distance of a task as a share of the ground's edge
    corruptions: names of sensor_noise.CORRUPTIONS; real: windows of real sites
    validation:  8 m maps that the best filter of each corruption is chosen on
    margin:      factor of the robot's limits for the cautious simulator
    threshold:   probability above which a motion is impossible for the estimator

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    robot: str = "seekur_jr"
    contact: str = "nearest"
    maps: int = 10
    size: float = 40.0
    style: str = "scattered_sharp"
    world: float = 8.0
    seed: int = 910_000
    tasks: int = 20
    least: float = 0.5
    corruptions: tuple[str, ...] = ("none", "noise 1 cm", "noise 2 cm", "noise 5 cm", "5% missing", "20% missing")
    real: tuple[RealGround, ...] = field(default=(), metadata={"items": RealGround})
    validation: int = 20
    margin: float = 0.8
    threshold: float = 0.5

    def __post_init__(self):
        if isinstance(self.corruptions, list):
            object.__setattr__(self, "corruptions", tuple(self.corruptions))
        require_contact(self.contact)
        require(self.style in STYLES, "style", self.style, f"one of {', '.join(STYLES)}")
        for name in ("maps", "tasks", "validation"):
            value = getattr(self, name)
            require(type(value) is int and value > 0, name, value, "a whole number of at least 1")
        require_length("size", self.size, 4, 256)
        for name in ("least", "margin", "threshold"):
            require_number(name, getattr(self, name), 0, 1, "above 0 and at most 1")
        names = [Path(one.file).stem for one in self.real]  # what tables call their ground
        twice = next((name for name in names if names.count(name) > 1), None)
        require(twice is None, "real", twice, "files with names of their own, each named once")
        for name in self.corruptions:
            require(name in CORRUPTIONS, "corruptions", name, f"one of {', '.join(CORRUPTIONS)}")

    @property
    def true_robot(self) -> Robot:
        """The robot that drives."""
        return Robot.load(self.robot)

    @staticmethod
    def load(path: Path) -> "NavigationConfig":
        """Reads a configuration from a TOML file; raises InputError when it is missing or wrong."""
        return load_toml(path, NavigationConfig)


@dataclass(frozen=True, eq=False)
class Ground:
    """True ground, all of it known. kind: what tables call it; number: among those of its kind."""

    kind: str
    number: int
    heights: Float[np.ndarray, "n n"]
    spacing: float

    @property
    def site(self) -> ArrayGround:
        """The ground as a site whose south-west node lies at (0, 0)."""
        return ArrayGround(self.heights, 0.0, self.spacing)


@dataclass(frozen=True)
class Task:
    """From a place to another; length: metres of the cheapest path on true ground."""

    start: tuple[float, float]
    goal: tuple[float, float]
    length: float


def grounds(config: NavigationConfig) -> Iterator[Ground]:
    """Yields synthetic grounds, then windows of real sites.

    Raises InputError where a site's file is missing or has no window that is known well enough.
    """
    for number in range(config.maps):
        grid = Grid(config.size)
        heights = generate_terrain(config.style, [config.seed + number], grid=grid, world=config.world)
        yield Ground("synthetic", number, np.asarray(heights[0]), grid.spacing)
    for real in config.real:
        path = find_data(real.file, "real: file")
        yield from _windows(SiteGround.open(path), real, path.stem, config.seed)


def _windows(site: SiteGround, real: RealGround, name: str, seed: int) -> Iterator[Ground]:
    """Yields windows of a site that do not overlap, at random."""
    nodes = round(real.size / site.spacing) + 1
    rows, cols = ((count - nodes) // (nodes - 1) + 1 for count in site.shape)
    require(rows > 0 and cols > 0, f"{real.file}: size", real.size, "at most that of the site")
    found = 0
    for place in np.random.default_rng(seed).permutation(rows * cols).tolist():
        row, col = (number * (nodes - 1) for number in divmod(place, cols))
        heights = site.part(slice(row, row + nodes), slice(col, col + nodes))
        if np.isfinite(heights).mean() >= KNOWN:
            yield Ground(name, found, filled(heights[None])[0], site.spacing)
            found += 1
            if found == real.windows:
                return
    require(found > 0, f"{real.file}: size", real.size, f"such that {KNOWN:.0%} of some window are known")


def tasks_on(ground: Ground, config: NavigationConfig) -> list[Task]:
    """Draws tasks that a planner solves on true ground; fewer than wanted where the ground has none."""
    planner = Planner(ground.site, config.true_robot, contact=config.contact)
    turns = np.argwhere(np.isfinite(planner.costs.standing[0]).all(axis=0)) * planner.lattice.stride
    rng = np.random.default_rng([config.seed, ground.number])
    least, found = config.least * (len(ground.heights) - 1) * ground.spacing, list[Task]()
    for _ in range(TRIES * config.tasks):
        if len(turns) < 2 or len(found) == config.tasks:
            break
        start, goal = ((float(x), float(y)) for y, x in turns[rng.choice(len(turns), 2, replace=False)])
        if np.hypot(start[0] - goal[0], start[1] - goal[1]) < least:
            continue
        try:
            legs = planner.cheapest(planner.points(start, goal))[0]
        except NoPathError:
            continue
        found.append(Task(start, goal, sum(leg.motion.length for leg in legs)))
    return found
