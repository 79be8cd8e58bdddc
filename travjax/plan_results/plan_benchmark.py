"""Benchmark of plans on synthetic sites: seconds from a raster in memory to a path, and how much was simulated."""

import resource
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from travjax import progress
from travjax.evaluation.simulator_benchmark import write_rows
from travjax.files import output_folder
from travjax.planning.planner import Planner
from travjax.planning.to_go import CostToGo
from travjax.simulation.contact import CONTACTS
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.site.ground import ArrayGround
from travjax.terrain.styles import generate_terrain

SIZES, STYLE, WORLD = (60.0, 250.0), "scattered_sharp", 8.0
"""Edges of the sites in metres, and their ground: that of the paper's maps, with rocks."""

TASKS = 5
"""Paths whose median is taken, each from near one edge of a site to the opposite one."""

COLUMNS = {
    "what": "what",
    "size_m": "site m",
    "length_m": "path m",
    "path_s": "raster to path s",
    "check_s": "check s",
    "searched": "share of tiles simulated",
    "to_go_s": "cost to go s",
    "peak_mib": "peak memory MiB",
}


def measure(robot: Robot | str, out: str | Path) -> None:
    """Plans paths on sites of two sizes by each contact model; prints a table and writes it as plan.tsv."""
    folder, rows = output_folder(out), []
    with progress.bar("planning", len(SIZES) * len(CONTACTS), "row") as bar:
        for size in SIZES:
            heights = np.asarray(generate_terrain(STYLE, [0], grid=Grid(size), world=WORLD))[0]
            for contact in CONTACTS:
                rows.append(_row(ArrayGround(heights), robot, contact, size))
                bar.update()
    write_rows(rows, COLUMNS, folder / "plan.tsv")


def _row(ground: ArrayGround, robot: Robot | str, contact: str, size: float) -> dict[str, Any]:
    _planned(ground, robot, contact, size, 0)  # compiles
    times = [_planned(ground, robot, contact, size, task) for task in range(1, TASKS + 1)]
    middle = {name: median(one[name] for one in times) for name in times[0]}
    row: dict[str, Any] = {"what": contact, "size_m": size, "to_go_s": None}
    row |= {name: round(value, 3) for name, value in middle.items()}
    if size == min(SIZES):
        planner = Planner(ground, robot, contact=contact)
        start = time.perf_counter()
        CostToGo(planner, _ends(planner, size, 0)[1])
        row["to_go_s"] = round(time.perf_counter() - start, 3)
    return row | {"peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024}


def _planned(ground: ArrayGround, robot: Robot | str, contact: str, size: float, task: int) -> dict[str, float]:
    """Plans one path, with nothing known of the site but its heights; returns what it took."""
    start = time.perf_counter()
    planner = Planner(ground, robot, contact=contact)
    start_point, goal = _ends(planner, size, task)
    points = planner.points(start_point, goal)
    found = planner.cheapest(points)
    middle = time.perf_counter()
    answers = iter([found])
    plan = planner.checked(points, lambda: next(answers, None) or planner.cheapest(points))  # if it is refused
    return {
        "length_m": plan.path.length,
        "path_s": middle - start,
        "check_s": time.perf_counter() - middle,
        "searched": float(planner.costs.evaluated.mean()),
    }


def _ends(planner: Planner, size: float, task: int) -> list[tuple[float, float]]:
    """Returns the places nearest to a point in the west and one in the east where the robot can turn on the spot."""
    stands = np.argwhere(np.isfinite(planner.costs.standing[0]).all(axis=0)) * planner.lattice.stride
    south = np.random.default_rng(task).uniform(0.1, 0.9, 2) * size
    wanted = [(south[0], 0.05 * size), (south[1], 0.95 * size)]
    places = [stands[np.hypot(*(stands - place).T).argmin()] for place in wanted]
    return [(float(x), float(y)) for y, x in places]
