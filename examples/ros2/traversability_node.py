"""Serves cost maps and paths on a robot's elevation map, as a node of ROS 2.

    python3 traversability_node.py --ros-args -p robot:=husky_a200 -r ~/elevation:=/elevation_map

See README.md in this folder for topics and parameters. Maps come faster than they are mapped: callbacks only keep the
latest one, and a timer with a thread of its own maps it and plans.
"""

import sys
from dataclasses import fields
from typing import Any

import rclpy
import tf2_geometry_msgs  # noqa: F401  (lets tf2 transform poses)
from geometry_msgs.msg import PoseStamped
from grid_map_msgs.msg import GridMap
from mapping_messages import Mapper, Settings, with_buffers
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosidl_runtime_py.utilities import get_message
from tf2_ros import Buffer, TransformException, TransformListener

from travjax import InputError
from travjax.entry import use_compilation_cache

PERIOD = 0.1
"""Seconds after which the node looks whether a map or a goal is new."""


def ros_kind(name: str) -> Any:
    """Returns what makes messages of a class of ROS from fields that may be NumPy arrays."""
    return lambda **given: get_message(name)(**with_buffers(given))


class TraversabilityNode(Node):
    """Maps each elevation map that it has time for, and plans on it to the latest goal."""

    def __init__(self) -> None:
        """Raises InputError for parameters that cannot be used."""
        super().__init__("traversability")
        given = {field.name: self.declare_parameter(field.name, field.default).value for field in fields(Settings)}
        self.mapper = Mapper(Settings(**given), ros_kind)
        self.transforms = Buffer()
        self.listener = TransformListener(self.transforms, self)
        self.new_map: GridMap | None = None
        self.goal: PoseStamped | None = None
        self.goal_is_new = False
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.cost_maps = self.create_publisher(OccupancyGrid, "~/cost_map", kept)
        self.bands = self.create_publisher(GridMap, "~/bands", kept)
        self.paths = self.create_publisher(Path, "~/path", 1)
        self.create_subscription(GridMap, "~/elevation", self.keep_map, 1)
        self.create_subscription(PoseStamped, "goal_pose", self.keep_goal, 1)
        self.create_timer(PERIOD, self.work, callback_group=MutuallyExclusiveCallbackGroup())

    def keep_map(self, message: GridMap) -> None:
        """Keeps an elevation map in place of the one before."""
        self.new_map = message

    def keep_goal(self, message: PoseStamped) -> None:
        """Keeps a goal in place of the one before."""
        self.goal, self.goal_is_new = message, True

    def work(self) -> None:
        """Maps the latest elevation map if it is new, and plans if it or the goal is."""
        new_map, self.new_map = self.new_map, None
        due = self.map_is_taken(new_map) if new_map is not None else self.goal_is_new
        if due and self.goal is not None and self.mapper.header is not None:
            self.goal_is_new = False
            self.plan(self.goal)

    def map_is_taken(self, message: GridMap) -> bool:
        """Publishes what an elevation map says of each place; returns whether it could be mapped."""
        try:
            costs, bands = self.mapper.take(message)
        except InputError as error:
            self.get_logger().error(f"elevation map: {error}")
            return False
        self.cost_maps.publish(costs)
        self.bands.publish(bands)
        return True

    def plan(self, goal: PoseStamped) -> None:
        """Publishes the path from where the robot is, or an empty one, and logs why."""
        robot = PoseStamped()
        robot.header.frame_id = self.mapper.settings.robot_frame
        try:
            path, reason = self.mapper.path(self.in_map(robot).pose, self.in_map(goal).pose)
        except TransformException as error:
            path, reason = self.mapper.no_path(), str(error)
        if reason:
            self.get_logger().warning(reason)
        self.paths.publish(path)

    def in_map(self, stamped: PoseStamped) -> PoseStamped:
        """Returns a pose in the map's frame, by the latest transforms."""
        frame = self.mapper.header.frame_id
        if stamped.header.frame_id == frame:
            return stamped
        latest = PoseStamped(pose=stamped.pose)
        latest.header.frame_id = stamped.header.frame_id
        return self.transforms.transform(latest, frame)


def main() -> int:
    """Runs the node until it is stopped; returns 2 for parameters that cannot be used."""
    use_compilation_cache()
    rclpy.init()
    try:
        executor = MultiThreadedExecutor(num_threads=2)
        executor.add_node(TraversabilityNode())
        executor.spin()
    except InputError as error:
        print(f"traversability_node: {error}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
