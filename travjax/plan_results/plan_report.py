"""Plans on disk: tables, files for other tools and figures, in one folder."""

from collections.abc import Sequence
from pathlib import Path as FilePath

import numpy as np

from travjax import progress
from travjax.config import one_line
from travjax.evaluation import map_figures
from travjax.evaluation.tables import rows_table
from travjax.files import held, output_folder, save_text
from travjax.plan_results import path_files
from travjax.plan_results.plan_figures import no_path_figure, plan_figure, to_go_figure
from travjax.planning.no_path import NoPathError
from travjax.planning.planner import Plan, Planner
from travjax.planning.to_go import CostToGo
from travjax.simulation.events import Event
from travjax.site.geotiff import Frame, save_geotiff

PLAN_FILES = ("path.csv", "path.geojson", "path.gpx", "plan.png", "plan.txt")
"""Files that only a folder with a path holds."""

NO_PATH_FILES = ("no_path.png", "no_path.txt")
"""Files that only a folder without a path holds."""


def save_plan(plan: Plan, planner: Planner, out: str | FilePath, ros_path: FilePath | None = None) -> FilePath:
    """Writes a plan's files and figure into a folder, prints what the plan is, and returns the folder.

    The files of an earlier `save_no_path` are removed.
    ros_path: file, .mcap or .db3, that gets the path as nav_msgs/Path as well
    Raises InputError when something cannot be written.
    """
    path, robot = plan.path, planner.setup.robot
    rows = []
    for event, limit in zip(robot.events, robot.limits, strict=True):
        largest = float(np.nanmax(getattr(path, event.name), initial=0))
        rows.append({"event": event.name, "largest margin": _shown(event, largest), "limit": _shown(event, limit)})
    lines = [_heading(planner, plan.found_by), f"path of {path.length:.2f} m, cost {plan.cost:.2f}", rows_table(rows)]
    lines += [f"{what}: {count}" for what, count in plan.checks.items()]
    progress.say("\n".join(lines))
    with held(folder := output_folder(out)):
        figure = plan_figure(plan, planner, (lines[0], lines[1]))
        _remove(folder, NO_PATH_FILES)
        written, notes = path_files.save_path(folder, plan, planner)
        written.append(map_figures.save(figure, folder / "plan.png"))
        written.append(save_text(folder / "plan.txt", "\n".join(lines) + "\n"))
        if ros_path is not None:
            written.append(path_files.save_ros_path(ros_path, plan, planner))
    for note in notes:
        progress.say(note)
    progress.wrote(*written)
    return folder


def save_no_path(error: NoPathError, planner: Planner, out: str | FilePath) -> FilePath:
    """Writes no_path.png and no_path.txt, prints the reason, and returns the folder.

    The files of an earlier `save_plan` are removed.
    Raises InputError when something cannot be written.
    """
    progress.say(one_line(error))
    with held(folder := output_folder(out)):
        figure = no_path_figure(
            error, planner, (_heading(planner, planner.method), f"no path from {error.start.name} to {error.goal.name}")
        )
        _remove(folder, PLAN_FILES)
        image, text = NO_PATH_FILES
        written = [map_figures.save(figure, folder / image), save_text(folder / text, f"{error}\n")]
    progress.wrote(*written)
    return folder


def save_to_go(to_go: CostToGo, out: str | FilePath) -> FilePath:
    """Writes to_go.tif and to_go.png, and returns the folder."""
    planner, best = to_go.planner, to_go.best
    goal, reached = to_go.goal, np.isfinite(best)
    where = f"cost to go to ({goal.x:.2f}, {goal.y:.2f}): from {reached.mean():.1%} of places"
    heading = f"{_heading(planner, planner.method)}\n{where}"
    progress.say(heading)
    ground, setup = planner.costs.ground, planner.setup
    bands = np.stack([np.where(reached, best, np.nan), np.degrees(to_go.direction)]).astype(np.float32)[:, ::-1]
    tags = {"robot": setup.robot.name, "contact": setup.contact, "goal": f"{goal.x} {goal.y}"}
    names = ("cost_to_go", "direction_deg")
    with held(folder := output_folder(out)):
        written = [
            save_geotiff(
                folder / "to_go.tif", bands, names, Frame(ground.origin, setup.stride, ground.crs), float("nan"), tags
            ),
            map_figures.save(to_go_figure(to_go, heading.split("\n")), folder / "to_go.png"),
        ]
    progress.wrote(*written)
    return folder


def _remove(folder: FilePath, names: Sequence[str]) -> None:
    """Removes what an earlier plan left behind, which nobody should take for the result of this one."""
    for name in names:
        (folder / name).unlink(missing_ok=True)


def _heading(planner: Planner, method: str) -> str:
    return f"{planner.setup.robot.name}, {planner.setup.contact}, {method}"


def _shown(event: Event, margin: float) -> str:
    return f"{np.degrees(margin):.1f} deg" if event.unit == "rad" else f"{margin:.3f} m"
