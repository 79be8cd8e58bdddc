"""The navigation experiment: its intervals, its judges, and how trials end."""

import numpy as np
import pytest

from tests.planning.sites import plane, walled
from travjax.config import InputError
from travjax.navigation import methods, trials
from travjax.navigation.methods import GeometricJudge
from travjax.navigation.scores import figure, interval, table, winners
from travjax.navigation.tasks import Ground, NavigationConfig, RealGround, Task, tasks_on
from travjax.navigation.trials import ARRIVED, FAILED, REFUSED, Trial
from travjax.planning.planner import Planner
from travjax.site.geometric import FORBIDDEN, geometric_tile
from travjax.site.ground import ArrayGround
from travjax.site.kernel import Tile, tiles_of

SPACING = 0.125


def ground(heights: np.ndarray) -> Ground:
    return Ground("synthetic", 0, heights.astype(np.float32), SPACING)


@pytest.mark.parametrize(
    ("count", "total", "expected"), [(0, 10, (0.0, 0.2775)), (10, 10, (0.7225, 1.0)), (81, 263, (0.2553, 0.3662))]
)
def test_intervals_are_wilsons(count, total, expected):
    assert interval(count, total) == pytest.approx(expected, abs=1e-4)  # Newcombe 1998, method 3


def test_tasks_are_far_apart_and_solved_on_true_ground():
    config = NavigationConfig(tasks=3, least=0.5)
    found = tasks_on(ground(walled()), config)
    assert len(found) == 3
    for task in found:
        away = np.hypot(task.start[0] - task.goal[0], task.start[1] - task.goal[1])
        assert away >= 4 and task.length >= away - 1e-6
    assert tasks_on(ground(walled()), config) == found


def test_the_geometric_judge_takes_the_worst_place_under_a_motion():
    heights = np.random.default_rng(1).normal(scale=0.02, size=(65, 65))
    planner = Planner(ground(heights).site, contact="nearest", headings=8, judge=GeometricJudge)
    site, setup, lattice = planner.costs.ground, planner.setup, planner.lattice
    cost = np.full(setup.lattice(site.shape), np.nan)
    for tile in tiles_of(cost.shape, setup):
        found = np.asarray(geometric_tile(site.part(*tile.ground(setup)), setup))[-1]
        cost[tile.within(cost.shape)] = tile.cropped(found, cost.shape)
    factor, in_the_way = planner.costs.judge.motions(Tile(0, 0, 32))
    rng, seen = np.random.default_rng(2), 0
    for _ in range(300):
        number, row, col = rng.integers(len(lattice.all)), *rng.integers(32, size=2)
        worst = 0.0
        for x, y, _ in lattice.all[number].primitive.poses(setup.interval):
            place = row + round(y / 0.25), col + round(x / 0.25)
            inside = 0 <= place[0] < len(cost) and 0 <= place[1] < len(cost)
            here = cost[place] if inside else np.nan
            worst = max(worst, FORBIDDEN if np.isnan(here) else here)
        expected = np.inf if worst >= FORBIDDEN else 1 + lattice.motions.risk * (worst / FORBIDDEN) ** 2
        assert factor[number, row, col] == pytest.approx(expected, rel=1e-6)
        assert (in_the_way[number, row, col] > 0) == np.isinf(expected)
        seen += np.isfinite(expected)
    assert 20 < seen < 280


def test_a_trial_arrives_fails_or_finds_no_path():
    config, task = NavigationConfig(), Task((2.0, 1.5), (2.0, 6.5), 5.0)
    true = ground(plane())
    blind = Planner(ArrayGround(plane().astype(np.float32), 0.0, SPACING), contact="nearest")
    closed = Planner(ArrayGround(walled(gap=0).astype(np.float32), 0.0, SPACING), contact="nearest")
    assert trials._trial(blind, true, task, config) == (ARRIVED, pytest.approx(1.0))
    assert trials._trial(blind, ground(walled()), task, config)[0] == FAILED
    assert trials._trial(closed, true, task, config) == (REFUSED, 0.0)
    inside = Task((2.0, 4.0), (2.0, 6.5), 5.0)
    assert trials._trial(closed, true, inside, config) == (REFUSED, 0.0)


def test_every_trial_counts_once_in_table_figure_and_verdict():
    ended = {methods.SIMULATOR: [ARRIVED, FAILED, FAILED, REFUSED], methods.RISK: [ARRIVED] * 4}
    rows = [
        Trial("synthetic", 0, task, "none", method, end, 1.1 if end != REFUSED else 0.0)
        for method, ends in ended.items()
        for task, end in enumerate(ends)
    ]
    text = table(rows, "synthetic", ["none"])
    simulator = next(line for line in text.splitlines() if "simulator" in line)
    assert simulator.split()[-7:] == ["25.0%", "5%", "to", "70%", "50.0%", "25.0%", "1.100"]
    said = winners(rows, "synthetic", ["none"])
    assert said == (
        "- none: *hazard field as risk* arrived most often, 100.0%; its interval overlaps with those of *simulator*. "
        "Fewest tasks failed on the way, 0.0%, with *hazard field as risk*."
    )
    drawn = figure(rows, ["none"])
    assert [ax.get_title() for ax in drawn.axes] == ["synthetic, 4 tasks", ""]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (dict(corruptions=("fog",)), "corruptions = 'fog': must be one of none"),
        (dict(tasks=0), "tasks = 0: must be a whole number of at least 1"),
        (dict(threshold=1.5), "threshold = 1.5: must be above 0 and at most 1"),
        (dict(style="sea"), "style = 'sea': must be one of"),
        (dict(real=(RealGround("a/site.tif"), RealGround("b/site.npz"))), "real = 'site': must be files with names"),
    ],
)
def test_other_values_are_refused(values, message):
    with pytest.raises(InputError, match=message):
        NavigationConfig(**values)
    with pytest.raises(InputError, match="windows = 0"):
        RealGround("site.tif", windows=0)
