"""Plans in a folder: what their tables and figures hold, and that only the files of the last plan are there."""

from dataclasses import replace

import numpy as np
import pytest

from tests.planning.sites import NODES, SPACING, walled
from travjax.plan_results.plan_figures import plan_figure
from travjax.plan_results.plan_report import save_no_path, save_plan
from travjax.planning.no_path import NoPathError
from travjax.planning.planner import Planner
from travjax.simulation.robot import Robot
from travjax.site.ground import ArrayGround

START, GOAL = (2.0, 1.5, 0.0), (2.0, 3.0, 0.0)


def planner(heights: np.ndarray, robot: Robot | None = None) -> Planner:
    ground = ArrayGround(heights.astype(np.float32), 0.0, SPACING)
    return Planner(ground, robot, headings=8, contact="nearest")


def test_table_and_profile_show_every_event_of_the_robot(tmp_path):
    across = np.broadcast_to(0.15 * SPACING * np.arange(NODES), (NODES, NODES))  # rises to the east
    rolling = planner(across, replace(Robot.load("seekur_jr"), max_roll=0.4))
    plan = rolling.plan(START, GOAL)
    text = (save_plan(plan, rolling, tmp_path) / "plan.txt").read_text()
    roll = np.degrees(plan.path.roll.max())
    assert roll == pytest.approx(np.degrees(np.arctan(0.15)), abs=1.5)  # wheels go by the nearest node
    line = next(line for line in text.splitlines() if line.startswith("roll"))
    assert line.split() == ["roll", f"{roll:.1f}", "deg", "22.9", "deg"]
    profile = plan_figure(plan, rolling, ("",)).axes[-1]
    shown = {line.get_label(): line.get_ydata() for line in profile.lines}
    np.testing.assert_allclose(shown["roll"], plan.path.roll / 0.4)
    assert {"step", "obstacle", "tilt"} < shown.keys()


def test_a_folder_holds_either_a_path_or_the_reason_why_there_is_none(tmp_path):
    closed, without_path = planner(walled(gap=0)), {"no_path.png", "no_path.txt"}
    save_plan(closed.plan(START, GOAL), closed, tmp_path)
    with_path = {file.name for file in tmp_path.iterdir() if not file.name.startswith(".")}
    assert with_path == {"path.csv", "plan.png", "plan.txt"}
    (tmp_path / "path.gpx").touch()
    with pytest.raises(NoPathError) as found:
        closed.plan(START, (2.0, 6.5))
    save_no_path(found.value, closed, tmp_path)
    assert {file.name for file in tmp_path.iterdir() if not file.name.startswith(".")} == without_path
    save_plan(closed.plan(START, GOAL), closed, tmp_path)
    assert {file.name for file in tmp_path.iterdir() if not file.name.startswith(".")} == with_path
