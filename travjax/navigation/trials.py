"""Tasks planned on what a sensor saw and driven on true ground: how each ended."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace

import numpy as np

from travjax.config import InputError, require, require_number
from travjax.data.sensor_noise import CORRUPTIONS
from travjax.navigation.methods import planners
from travjax.navigation.tasks import Ground, NavigationConfig, Task
from travjax.planning.no_path import NoPathError
from travjax.planning.path import drive
from travjax.planning.planner import Planner
from travjax.runs.predictor import Predictor

ENDS = ARRIVED, FAILED, REFUSED = "arrived", "failed", "refused"
"""How a task ends: at the goal, beyond a limit of the robot on the way, or without a path."""


@dataclass(frozen=True)
class Trial:
    """How a task ended. detour: length of the path over that of the best one, 0 without a path."""

    kind: str
    ground: int
    task: int
    corruption: str
    method: str
    ended: str
    detour: float = 0.0

    def __post_init__(self):
        for name in ("kind", "corruption", "method"):
            require(isinstance(getattr(self, name), str), name, getattr(self, name), "a name")
        for name in ("ground", "task"):
            value = getattr(self, name)
            require(type(value) is int and value >= 0, name, value, "a whole number from 0 on")
        require(self.ended in ENDS, "ended", self.ended, f"one of {', '.join(ENDS)}")
        require_number("detour", self.detour, -1e-300, 1e9, "a ratio of lengths")

    def to_json(self) -> dict:
        """Returns it for a JSON file."""
        return asdict(self)


def trials_on(
    ground: Ground,
    tasks: list[Task],
    corruption: str,
    best_filter: str,
    config: NavigationConfig,
    predictor: Predictor,
    on_progress: Callable[[], object] = lambda: None,
) -> Iterator[Trial]:
    """Yields the trials of all methods on one ground, seen with one corruption."""
    rng = np.random.default_rng([config.seed, ground.number, list(CORRUPTIONS).index(corruption)])
    seen = CORRUPTIONS[corruption](ground.heights[None], rng)[0]
    for method, planner in planners(seen, ground.spacing, best_filter, config, predictor):
        for number, task in enumerate(tasks):
            ended, detour = _trial(planner, ground, task, config)
            yield Trial(ground.kind, ground.number, number, corruption, method, ended, detour)
            on_progress()


def _trial(planner: Planner, ground: Ground, task: Task, config: NavigationConfig) -> tuple[str, float]:
    try:
        points = planner.points(task.start, task.goal)
        planner.require_standing(points[0])
        legs, _, first = planner.cheapest(points)
    except (NoPathError, InputError):
        return REFUSED, 0.0
    setup = replace(planner.setup, robot=config.true_robot)
    path, _ = drive(legs, planner.pose_of(first), ground.site, setup)
    return (FAILED if path.exceeds.any() else ARRIVED), path.length / task.length
