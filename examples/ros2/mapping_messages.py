"""Maps and plans on messages of ROS 2, without ROS: a GridMap in, cost maps and paths out.

Messages are read by the names of their fields, so those of rclpy and those of rosbags will do. Classes of messages that
are made are looked up by a function; see travjax.rasters.recordings.Kind. Coordinates are those of the GridMap's frame.
"""

import math
from array import array
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import travjax
from travjax.config import require
from travjax.plan_results.path_files import KIND, path_message
from travjax.planning.field_judge import FieldJudge
from travjax.rasters.grid_maps import grid_map_message, raster_of
from travjax.rasters.reading_options import DemOptions
from travjax.rasters.recordings import Kind, pose
from travjax.site.costs import UNKNOWN_COST
from travjax.site.ground import ArrayGround, ground_of
from travjax.site.mapping import setup_of
from travjax.site.nav2 import over_headings

COSTS = ("worst", "best", "mean")
"""How the costs of a place become one cost, over its known headings."""


@dataclass(frozen=True)
class Settings:
    """Parameters of the node; an empty text and 0 stand for "not given".

    layer:        of the GridMap, that holds the elevation
    robot:        name or file of a robot
    contact:      contact model, "tyre" or "nearest"; that of the robot or the estimator unless given
    estimator:    hazard field that judges motions of paths instead of margins, as `travjax plan --estimator` takes it
    headings:     number of headings, evenly around the circle
    stride:       metres between places; spacing: metres between nodes
    costs:        one of COSTS
    unknown_cost: of unknown ground, as a multiple of the worst safe ground; no path leads over it unless given
    robot_frame:  frame of the robot, x ahead
    """

    layer: str = "elevation"
    robot: str = "seekur_jr"
    contact: str = ""
    estimator: str = ""
    headings: int = 16
    stride: float = 0.25
    spacing: float = 0.0625
    costs: str = "worst"
    unknown_cost: float = 0.0
    robot_frame: str = "base_link"


class Mapper:
    """Maps one GridMap after the other, and plans on the latest one.

    header:  of the latest GridMap, or None before the first
    planner: on its ground
    """

    def __init__(self, settings: Settings, kind: Kind):
        """Raises InputError for settings that cannot be used, whatever the map."""
        require(settings.costs in COSTS, "costs", settings.costs, f"one of {', '.join(COSTS)}")
        both = bool(settings.estimator and settings.unknown_cost)
        require(not both, "unknown_cost", settings.unknown_cost, "0 with an estimator")
        self.settings, self.kind, self.header = settings, kind, None
        self._reading = DemOptions(layer=settings.layer or None)
        contact, judge = settings.contact or None, None
        if settings.estimator:
            predictor = travjax.Predictor.load(settings.estimator)
            judge = partial(FieldJudge, predictor=predictor)
            contact = contact or predictor.run.setup.contact.model
        setup = setup_of(settings.robot, settings.headings, settings.stride, settings.spacing, contact)
        self._ways = dict(robot=setup.robot, headings=settings.headings, stride=settings.stride, contact=setup.contact)
        self._choices = self._ways | dict(unknown_cost=settings.unknown_cost or None, judge=judge)
        flat = ArrayGround(np.zeros((2, 2), np.float32), spacing=settings.spacing)
        self.planner = travjax.Planner(flat, **self._choices)  # refuses what does not fit

    def take(self, grid_map: Any) -> tuple[Any, Any]:
        """Maps a GridMap, on which `path` plans from now on.

        Returns the costs as nav_msgs/OccupancyGrid, and what the map says of each place as GridMap, both with the
        header of the GridMap. Raises InputError where it holds no such layer, or no ground that can be mapped; the map
        before stays then.
        """
        raster = raster_of(grid_map, self._reading)
        ground = ground_of(raster, self.settings.spacing)
        planner = travjax.Planner(ground, **self._choices)
        site = travjax.map_site(ground, **self._ways)
        self.planner, self.header = planner, grid_map.header
        costs = over_headings(site.costs)[self.settings.costs]
        layers = {**site.bands, "elevation": site.heights}
        bands = grid_map_message(self.kind, self.header, layers, self.settings.stride, ground.origin)
        return occupancy_grid(self.kind, self.header, costs, self.settings.stride, ground.origin), bands

    def path(self, start: Any, goal: Any) -> tuple[Any, str]:
        """Plans on the latest map, from a geometry_msgs/Pose to another, both in the map's frame.

        Returns a nav_msgs/Path, and why it is empty; that is an empty text where there is a path.
        """
        try:
            plan = self.planner.plan(place_of(start), place_of(goal))
        except (travjax.InputError, travjax.NoPathError) as error:
            return self.no_path(), str(error)
        return path_message(self.kind, self.header, plan.path), ""

    def no_path(self) -> Any:
        """Returns an empty nav_msgs/Path."""
        return self.kind(KIND)(header=self.header, poses=[])


def occupancy_grid(kind: Kind, header: Any, costs: np.ndarray, cell_size: float, origin: tuple[float, float]) -> Any:
    """Returns costs [rows, cols] of 0 to 100, UNKNOWN_COST where unknown, as nav_msgs/OccupancyGrid.

    origin: x, y of the south-west cell's middle, metres; the message has that of the cell's outer corner
    """
    rows, cols = costs.shape
    x, y = (axis - cell_size / 2 for axis in origin)
    info = kind("nav_msgs/msg/MapMetaData")(
        map_load_time=header.stamp, resolution=cell_size, width=cols, height=rows, origin=pose(kind, x, y)
    )
    values = np.where(costs == UNKNOWN_COST, -1, costs).astype(np.int8)
    return kind("nav_msgs/msg/OccupancyGrid")(header=header, info=info, data=values.ravel())


def place_of(at: Any) -> tuple[float, float, float]:
    """Returns x, y and heading of a geometry_msgs/Pose; the heading counts from +y, in radians."""
    q = at.orientation
    yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
    return at.position.x, at.position.y, yaw - math.pi / 2


def with_buffers(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Returns fields of a message, NumPy arrays as those of the standard library, which messages of rclpy hold."""
    return {
        name: array(value.dtype.char, value.tobytes()) if isinstance(value, np.ndarray) else value
        for name, value in fields.items()
    }
