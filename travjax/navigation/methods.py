"""Methods to judge motions on a map that a sensor saw, by name."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float

from travjax.data.sensor_noise import FILTERS
from travjax.navigation.tasks import NavigationConfig
from travjax.planning.field_judge import FieldJudge
from travjax.planning.judges import Judged
from travjax.planning.motions import MotionLattice
from travjax.planning.planner import Planner
from travjax.runs.predictor import Predictor
from travjax.site.geometric import FORBIDDEN, geometric_bands
from travjax.site.ground import ArrayGround, Site
from travjax.site.kernel import SiteSetup, Tile

GEOMETRIC, SIMULATOR, FILTERED = "geometric cost map", "simulator", "simulator, best filter"
CAUTIOUS, THRESHOLD, RISK = "simulator, best filter, lower limits", "hazard field", "hazard field as risk"
METHODS = (GEOMETRIC, SIMULATOR, FILTERED, CAUTIOUS, THRESHOLD, RISK)


class GeometricJudge:
    """Judges by the geometric cost map of UNSTR-NAV: of the places that a motion leads over, the worst counts.

    Headings play no part. Motions over a forbidden place are impossible; the cost of the others grows by 1 + risk * c^2
    with the cost c of the worst place as a share of the largest.
    """

    unknown_allowed = False
    title = "geometric cost map"
    final = False

    def __init__(self, ground: Site, setup: SiteSetup, lattice: MotionLattice):
        self._lattice, cost = lattice, geometric_bands(ground, setup)[-1]
        impossible = np.isnan(cost) | (cost >= FORBIDDEN)
        self._factor = np.where(impossible, np.inf, 1 + lattice.motions.risk * (cost / FORBIDDEN) ** 2)
        self._offsets = [self._under(number, setup) for number in range(len(lattice.all))]

    def _under(self, number: int, setup: SiteSetup) -> np.ndarray:
        """Returns the places that a motion leads over: [k, 2] rows and columns from where it begins."""
        poses = self._lattice.all[number].primitive.poses(setup.interval)
        return np.unique(np.round(poses[:, 1::-1] / setup.stride).astype(int), axis=0)

    def motions(self, tile: Tile) -> Judged:
        """Judges the motions from the places of a tile."""
        reach = max(int(np.abs(offsets).max()) for offsets in self._offsets)
        rows, cols = self._factor.shape
        beyond = [max(0, first + tile.edge - count) for first, count in ((tile.row, rows), (tile.col, cols))]
        padded = np.pad(self._factor, [(reach, more + reach) for more in beyond], constant_values=np.inf)
        factor = np.stack([self._worst(padded, offsets + reach, tile) for offsets in self._offsets])
        return factor.astype(np.float32), np.where(np.isfinite(factor), 0, 2).astype(np.uint8)

    def _worst(self, padded: np.ndarray, first: np.ndarray, tile: Tile) -> np.ndarray:
        south, west = first[:, 0] + tile.row, first[:, 1] + tile.col
        return np.max([padded[r : r + tile.edge, c : c + tile.edge] for r, c in zip(south, west, strict=True)], axis=0)

    def standing(self) -> Judged:
        """Judges the robot standing at every place, the same in every heading."""
        factor = np.broadcast_to(self._factor, (self._lattice.headings, *self._factor.shape)).astype(np.float32)
        return factor, np.where(np.isfinite(factor), 0, 2).astype(np.uint8)


def planners(
    seen: Float[np.ndarray, "n n"], spacing: float, best_filter: str, config: NavigationConfig, predictor: Predictor
) -> Iterator[tuple[str, Planner]]:
    """Yields a planner for each method on a map that a sensor saw."""
    robot = config.true_robot
    lower = {event.limit: getattr(robot, event.limit) * config.margin for event in robot.events}
    filtered = FILTERS[best_filter](seen[None])[0]
    raw, smooth = (ArrayGround(heights.astype(np.float32), 0.0, spacing) for heights in (seen, filtered))
    make = partial(Planner, contact=config.contact)
    yield GEOMETRIC, make(raw, robot, judge=GeometricJudge)
    yield SIMULATOR, make(raw, robot)
    yield FILTERED, make(smooth, robot)
    yield CAUTIOUS, make(smooth, replace(robot, **lower))
    field = make(raw, robot, judge=partial(FieldJudge, predictor=predictor, threshold=config.threshold, keep=True))
    judge = field.costs.judge
    assert isinstance(judge, FieldJudge)
    yield RISK, field
    yield THRESHOLD, make(raw, robot, judge=lambda *_: judge.weighing(0.0))
