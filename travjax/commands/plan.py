"""`travjax plan`: a path that a robot survives, or what stands in its way."""

import argparse
import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from travjax import options, progress
from travjax.config import require
from travjax.files import user_path
from travjax.rasters.formats import OTHERS

if TYPE_CHECKING:
    from travjax.planning.planner import Planner
    from travjax.site.ground import SiteGround

ACTION_SPACE = "action-space"

NO_PATH = 1
"""Exit code where there is no path."""


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "plan",
        help="plan a path that a robot survives, or tell what stands in its way",
        description="Plans the cheapest path between points of a site: drives and point turns whose margins are exact, "
        "each pose simulated once more in the end. Writes the path and a figure; without a path, the reason, a figure "
        f"and exit code 1. A site is an elevation map: GeoTIFF or another raster that GDAL reads, {OTHERS}.",
    )
    numbers: Any = dict(nargs="+", type=float, metavar=("X Y", "DEG"))
    where = "x and y of the site, and the heading in degrees anticlockwise from +y (north) if it matters"
    parser.add_argument("--from", dest="start", help=f"where the path begins: {where}", **numbers)
    parser.add_argument("--to", dest="goal", required=True, help="where it ends, likewise", **numbers)
    parser.add_argument("--via", action="append", help="a point to pass, likewise; may be given again", **numbers)
    parser.add_argument(
        "--coordinates",
        choices=("site", "latlon", "rowcol"),
        default="site",
        help="what points are: x and y (site), latitude and longitude in degrees (latlon), or row and column of nodes, "
        "counted from the south-west (rowcol)",
    )
    options.add_site(parser)
    _add_search(parser)
    _add_files(parser)
    parser.set_defaults(run=run)


def _add_search(parser: argparse.ArgumentParser) -> None:
    """Adds the options for motions, what they cost, and how a path is searched."""
    parser.add_argument(
        "--primitives", type=user_path, metavar="FILE", help=".toml file of what the robot may do and what that costs"
    )
    parser.add_argument(
        "--estimator",
        type=user_path,
        metavar="FILE",
        help="judge motions by this hazard field instead of margins: a .safetensors file, the folder of a run, or "
        "field_seekur_jr, which comes with travjax; its probability is the risk, and above --threshold it forbids a "
        "motion; for noisy maps",
    )
    parser.add_argument(
        "--threshold",
        type=float,
        metavar="P",
        help="with --estimator: probability of failure above which a motion is not used (0.5)",
    )
    parser.add_argument(
        "--interval", type=float, default=0.06, metavar="M", help="metres between simulated poses (0.06)"
    )
    parser.add_argument(
        "--planner",
        choices=("lattice", ACTION_SPACE),
        default="lattice",
        help="search on the lattice, or, as a baseline, by the paper's 3042 trajectories from each state (lattice)",
    )
    parser.add_argument(
        "--unknown-cost",
        type=float,
        metavar="K",
        help="drive over unknown ground, at K times the cost of the worst safe ground (never); it is then "
        "taken to be as high as the nearest known ground",
    )


def _add_files(parser: argparse.ArgumentParser) -> None:
    """Adds the options for what is written."""
    parser.add_argument(
        "--to-go",
        action="store_true",
        help="also write the cost to go to the goal from everywhere",
    )
    parser.add_argument(
        "--route-graph",
        type=user_path,
        metavar="FILE",
        help="also write a route graph for Nav2, .geojson: places 2 m apart where the robot can turn on the spot, and "
        "straight drives between them",
    )
    parser.add_argument(
        "--ros-path", type=user_path, metavar="FILE", help="also write the path as nav_msgs/Path, .mcap or .db3"
    )
    options.add_out(parser, "runs/plan")


def run(arguments: argparse.Namespace) -> int:
    """Plans the path and writes the results; returns the exit code."""
    from travjax.plan_results.plan_report import save_no_path, save_plan, save_to_go
    from travjax.plan_results.route_graph import route_graph, save_route_graph
    from travjax.planning.action_space import ActionSpacePlanner
    from travjax.planning.no_path import NoPathError
    from travjax.planning.to_go import CostToGo
    from travjax.site.mapping import say_notes

    goal, via = _point("--to", arguments.goal), [_point("--via", point) for point in arguments.via or ()]
    start = _point("--from", arguments.start) if arguments.start else None
    _require_together(arguments)
    site = options.site(arguments)
    planner = _planner(arguments, site)
    say_notes(site, planner.setup)
    if arguments.route_graph:
        graph = route_graph(planner)
        for note in graph.notes:
            progress.say(note)
        progress.wrote(save_route_graph(arguments.route_graph, graph))
    try:
        if arguments.to_go:
            save_to_go(CostToGo(planner, goal, arguments.coordinates), arguments.out)
        if start is not None:
            if arguments.planner == ACTION_SPACE:
                plan = ActionSpacePlanner(planner).plan(start, goal, arguments.coordinates)
            else:
                plan = planner.plan(start, goal, via, arguments.coordinates)
            save_plan(plan, planner, arguments.out, arguments.ros_path)
    except NoPathError as error:
        save_no_path(error, planner, arguments.out)
        return NO_PATH
    return 0


def _require_together(arguments: argparse.Namespace) -> None:
    """Raises InputError where options do not go together, or results could not be written in the end."""
    from travjax.rasters.recordings import require_recording

    require(bool(arguments.start or arguments.to_go), "--from", None, "given, unless --to-go is")
    for name in ("via", "ros_path"):
        options.require_left_out(arguments, name, arguments.start is None, "where --from is")
    for name in ("via", "to_go", "estimator", "unknown_cost", "primitives"):
        by_trajectories = arguments.planner == ACTION_SPACE
        options.require_left_out(arguments, name, by_trajectories, f"with --planner {ACTION_SPACE}")
    options.require_left_out(arguments, "unknown_cost", arguments.estimator is not None, "with --estimator")
    options.require_left_out(arguments, "threshold", arguments.estimator is None, "without --estimator")
    out, graph = arguments.out, arguments.route_graph
    require(out.is_dir() or not out.exists(), "--out", str(out), "a folder")
    if graph:
        require(
            graph.parent.is_dir() and not graph.is_dir(), "--route-graph", str(graph), "a file in a folder that exists"
        )
    if arguments.ros_path:
        require_recording("--ros-path", arguments.ros_path)


def _planner(arguments: argparse.Namespace, site: "SiteGround") -> "Planner":
    """Returns the planner of a site; raises InputError where settings and estimator do not fit."""
    from travjax.planning.field_judge import FieldJudge
    from travjax.planning.motions import Motions
    from travjax.planning.planner import Planner
    from travjax.runs.predictor import Predictor

    judge, contact = None, arguments.contact
    if arguments.estimator:
        predictor = Predictor.load(arguments.estimator)
        judge = partial(FieldJudge, predictor=predictor)
        if arguments.threshold is not None:
            judge = partial(judge, threshold=arguments.threshold)
        contact = contact or predictor.run.setup.contact.model
    return Planner(
        site,
        arguments.robot,
        Motions.load(arguments.primitives) if arguments.primitives else None,
        headings=arguments.headings,
        stride=arguments.stride,
        contact=contact,
        interval=arguments.interval,
        unknown_cost=arguments.unknown_cost,
        judge=judge,
    )


def _point(option: str, numbers: Sequence[float]) -> tuple[float, ...]:
    """Returns a point with its heading in radians."""
    require(len(numbers) in (2, 3), option, list(numbers), "X Y, or X Y DEG with the heading")
    x, y, *heading = numbers
    return x, y, *(math.radians(angle) for angle in heading)
