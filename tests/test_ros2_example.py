"""The ROS 2 example: its logic on recorded messages, and the lines of its node, against stand-ins for rclpy and tf2."""

import dataclasses
import math
import re
import sys
from array import array
from functools import cache
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import travjax
from travjax.rasters.grid_maps import TYPE, grid_map_message, grid_map_types, read_grid_map
from travjax.rasters.reading_options import DemOptions
from travjax.rasters.recordings import header, kind_of, pose, write_message
from travjax.site.ground import SiteGround
from travjax.site.nav2 import over_headings

pytest.importorskip("rosbags", reason="the extra ros is not installed")

EXAMPLE = Path(__file__).parents[1] / "examples" / "ros2"
CELL, ORIGIN = 0.1, (3.0, -2.0)
SETTINGS = dict(robot="leo_rover", contact="nearest", headings=4, stride=0.5, spacing=CELL)
WAYS = {name: SETTINGS[name] for name in ("robot", "contact", "headings", "stride")}
START, GOAL = (4.0, -1.0, 0.0), (6.5, -1.0, math.pi)
"""x, y and heading from +y; between them is the wall of `heights`, open in the north."""


@pytest.fixture
def example(monkeypatch) -> ModuleType:
    """The module of the logic, found as the node finds it."""
    monkeypatch.syspath_prepend(EXAMPLE)
    monkeypatch.delitem(sys.modules, "mapping_messages", raising=False)
    import mapping_messages

    return mapping_messages


def heights() -> np.ndarray:
    """4 x 5 m, asymmetric: a slope, a wall from the south, and unknown ground in the north-west; row 0 is south."""
    y, x = np.mgrid[:41, :51] * CELL
    ground = 0.1 * x + 0.05 * y + np.where((x > 2.0) & (x < 2.4) & (y < 2.4), 0.6, 0.0)
    ground[36:, :6] = np.nan
    return ground.astype(np.float32)


def elevation(kind, stamped: Any, ground: np.ndarray, name: str = "elevation") -> Any:
    return grid_map_message(kind, stamped, {"variance": 0 * ground, name: ground}, CELL, ORIGIN)


def recorded(path: Path, message: Any, name: str = TYPE) -> Any:
    """Writes a message into a recording, and returns what rosbags reads from it."""
    from rosbags.highlevel import AnyReader

    write_message(path, "/recorded", name, message, grid_map_types())
    with AnyReader([path], default_typestore=grid_map_types()) as reader:
        ((connection, _, raw),) = reader.messages()
        return reader.deserialize(raw, connection.msgtype)


def rolled(message: Any, shift: tuple[int, int], by_row: bool) -> Any:
    """Lays the layers of a GridMap out as a circular buffer that begins elsewhere, or row by row."""
    for layer in message.data:
        cols, rows = (dim.size for dim in layer.layout.dim)
        values = np.roll(layer.data.reshape(cols, rows).T, shift, axis=(0, 1))
        layer.data = (values if by_row else values.T).ravel()
        layer.layout.dim = layer.layout.dim[:: -1 if by_row else 1]
    message.outer_start_index, message.inner_start_index = shift
    return message


@pytest.fixture(scope="module")
def kind():
    return kind_of(grid_map_types())


@pytest.fixture
def received(tmp_path, kind):
    """A GridMap as rosbags reads it."""
    return recorded(tmp_path / "map.mcap", elevation(kind, header(kind, "odom"), heights()))


def as_pose(kind, place: tuple[float, float, float]) -> Any:
    x, y, heading = place
    return pose(kind, x, y, 0.3, heading + math.pi / 2)


def costs_of(message: Any) -> np.ndarray:
    """The costs of an OccupancyGrid, [rows, cols]."""
    return np.asarray(message.data).reshape(message.info.height, message.info.width)


def expected_costs(which: str = "worst") -> np.ndarray:
    """The same, from the heights alone; the levels of float32 heights do not matter to a byte."""
    costs = over_headings(travjax.map_site(heights(), spacing=CELL, **WAYS).costs)[which].astype(int)
    return np.where(costs == 255, -1, costs)


@pytest.mark.parametrize("by_row", [False, True])
@pytest.mark.parametrize("shift", [(0, 0), (7, 11)])
def test_a_cost_map_is_that_of_the_heights_however_they_are_stored(example, tmp_path, kind, received, by_row, shift):
    message = recorded(tmp_path / "rolled.mcap", rolled(received, shift, by_row))
    grid, bands = example.Mapper(example.Settings(**SETTINGS), kind).take(message)
    grid = recorded(tmp_path / "costs.mcap", grid, "nav_msgs/msg/OccupancyGrid")
    np.testing.assert_array_equal(costs_of(grid), expected_costs())
    assert {-1, 100} < {*grid.data.tolist()}
    corner = grid.info.origin.position
    assert (corner.x, corner.y, grid.info.resolution) == pytest.approx((ORIGIN[0] - 0.25, ORIGIN[1] - 0.25, 0.5))
    assert grid.header.frame_id == bands.header.frame_id == "odom"
    recorded(tmp_path / "bands.mcap", bands)
    band = read_grid_map(tmp_path / "bands.mcap", DemOptions(layer="cost_worst"))
    assert band.origin == pytest.approx(ORIGIN)
    values = band.heights[: grid.info.height, : grid.info.width]
    np.testing.assert_array_equal(np.nan_to_num(values, nan=-1), costs_of(grid))


def test_the_ground_of_a_message_is_that_of_the_recording(example, tmp_path, kind, received):
    site = SiteGround.open(tmp_path / "map.mcap", CELL, reading=DemOptions(layer="elevation"))
    _, bands = example.Mapper(example.Settings(**SETTINGS), kind).take(received)
    recorded(tmp_path / "bands.mcap", bands)
    expected = travjax.map_site(site, **WAYS)
    for name, band in {**expected.bands, "elevation": expected.heights.astype(np.float32)}.items():
        found = read_grid_map(tmp_path / "bands.mcap", DemOptions(layer=name)).heights
        np.testing.assert_array_equal(found[: found.shape[0], : found.shape[1]], band)


@pytest.mark.parametrize("which", ["best", "mean"])
def test_other_costs_can_be_chosen(example, kind, received, which):
    grid, _ = example.Mapper(example.Settings(**SETTINGS, costs=which), kind).take(received)
    np.testing.assert_array_equal(costs_of(grid), expected_costs(which))


def test_a_path_is_that_of_the_planner(example, tmp_path, kind, received):
    mapper = example.Mapper(example.Settings(**SETTINGS), kind)
    mapper.take(received)
    path, reason = mapper.path(as_pose(kind, START), as_pose(kind, GOAL))
    path = recorded(tmp_path / "path.mcap", path, "nav_msgs/msg/Path")
    there = [(x - ORIGIN[0], y - ORIGIN[1], heading) for x, y, heading in (START, GOAL)]
    expected = travjax.plan(heights(), *there, spacing=CELL, **WAYS).path.pose + [*ORIGIN, 0]
    found = np.array([example.place_of(one.pose) for one in path.poses])
    assert reason == "" and {one.header.frame_id for one in [path, *path.poses]} == {"odom"}
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * found[:, 2]), np.exp(1j * expected[:, 2]), atol=1e-9)
    assert np.ptp(found[:, 1]) > 1  # it leads around the wall


@pytest.mark.parametrize(
    ("start", "goal", "reason"),
    [
        (START, (20.0, 0.0, 0.0), r"goal = \(20.*must be on the site, from \(3, -2\) to \(8, 2\)"),
        (START, (5.2, -1.0, 0.0), r"goal = .*the robot cannot stand there in heading 0 \(\w+\); the nearest place"),
        ((3.0, 1.9, 0.0), GOAL, "start = .*the robot cannot stand there in heading 0 .unknown ground"),
    ],
)
def test_where_there_is_no_path_a_reason_is_given(example, kind, received, start, goal, reason):
    mapper = example.Mapper(example.Settings(**SETTINGS), kind)
    mapper.take(received)
    path, why = mapper.path(as_pose(kind, start), as_pose(kind, goal))
    assert not path.poses and path.header.frame_id == "odom" and re.match(reason, why)


def test_a_wall_without_an_end_is_the_reason(example, kind):
    mapper = example.Mapper(example.Settings(**SETTINGS), kind)
    ground = heights()
    ground[:, 20:24] += 0.6
    mapper.take(elevation(kind, header(kind, "odom"), ground))
    path, why = mapper.path(as_pose(kind, START), as_pose(kind, GOAL))
    assert not path.poses and why.startswith("no path from start (4, -1) to goal (6.5, -1): ") and "step" in why


def test_a_map_that_cannot_be_read_leaves_the_one_before(example, kind, received):
    mapper = example.Mapper(example.Settings(**SETTINGS), kind)
    mapper.take(received)
    other = header(kind, "other")
    with pytest.raises(travjax.InputError, match="^layer = 'elevation': must be variance or height$"):
        mapper.take(elevation(kind, other, heights(), "height"))
    with pytest.raises(travjax.InputError, match="all unknown"):
        mapper.take(elevation(kind, other, np.nan * heights()))
    path, _ = mapper.path(as_pose(kind, START), as_pose(kind, GOAL))
    assert path.poses and mapper.header.frame_id == "odom"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"costs": "all"}, "costs = 'all': must be one of worst, best, mean"),
        ({"robot": "tank"}, "robot 'tank': no such preset"),
        ({"unknown_cost": 0.5}, "unknown_cost = 0.5: must be a factor of at least 1"),
        ({"estimator": "field_seekur_jr", "unknown_cost": 2.0}, "unknown_cost = 2.0: must be 0 with an estimator"),
        ({"estimator": "field_seekur_jr", "robot": "leo_rover"}, "robot = 'Leo Rover': must be Seekur Jr"),
    ],
)
def test_settings_that_cannot_be_used_are_refused_before_the_first_map(example, kind, settings, message):
    with pytest.raises(travjax.InputError, match=message):
        example.Mapper(example.Settings(**settings), kind)


def test_the_estimator_brings_its_contact_model(example, kind):
    assert example.Mapper(example.Settings(estimator="field_seekur_jr"), kind).planner.setup.contact == "nearest"
    assert example.Mapper(example.Settings(), kind).planner.setup.contact == "tyre"


def test_the_page_lists_all_parameters(example):
    page = (EXAMPLE / "README.md").read_text()
    listed = dict(re.findall(r"^\| `(\w+)` \| `([^`]*)` \|", page, re.MULTILINE))
    defaults = {field.name: field.default for field in dataclasses.fields(example.Settings)}
    assert listed == {name: str(value) if value != "" else '""' for name, value in defaults.items()}


# ---- The node, with messages that are as strict as those of rclpy, and without ROS

TYPE_CODES = {"float32": "f", "int8": "b"}


@cache
def strict(name: str) -> type:
    """Returns a class of messages that has default values and refuses what classes of rosidl refuse."""
    from rosbags.interfaces import Nodetype

    fields = grid_map_types().get_msgdef(name).fields

    def default(node: Nodetype, of: Any) -> Any:
        if node is Nodetype.NAME:
            return strict(of)()
        if node is Nodetype.BASE:
            return {"f": 0.0, "s": ""}.get(of[0][0], 0)
        code = TYPE_CODES.get(of[0][1][0]) if of[0][0] is Nodetype.BASE else None
        return array(code) if code else []

    def require(value: Any, node: Nodetype, of: Any) -> None:
        if node is Nodetype.SEQUENCE and isinstance(value, list):
            for one in value:
                require(one, *of[0])
        elif isinstance(value, array):
            assert value.typecode == TYPE_CODES[of[0][1][0]]
        else:
            assert isinstance(value, strict(of) if node is Nodetype.NAME else type(default(node, of))), (name, value)

    def __init__(self, **given):
        assert {*given} <= {field for field, _ in fields}
        for field, (node, of) in fields:
            value = given[field] if field in given else default(node, of)
            require(value, node, of)
            setattr(self, field, value)
        if name == "geometry_msgs/msg/Quaternion" and not given:
            self.w = 1.0

    return type(name.rpartition("/")[2], (), {"__init__": __init__})


class Node:
    """Stands for rclpy.node.Node: keeps what it is given, and what is published and logged."""

    parameters: dict[str, Any] = {}

    def __init__(self, name: str):
        self.published, self.callbacks, self.log = dict[str, list](), dict[str, Any](), list[tuple[str, str]]()

    def declare_parameter(self, name: str, default: Any):
        value = self.parameters.get(name, default)
        assert type(value) is type(default)
        return SimpleNamespace(value=value)

    def create_publisher(self, kind: type, topic: str, qos: Any):
        def publish(message):
            assert isinstance(message, kind)
            self.published.setdefault(topic, []).append(message)

        return SimpleNamespace(publish=publish)

    def create_subscription(self, kind: type, topic: str, callback: Any, qos: Any):
        self.callbacks[topic] = callback

    def create_timer(self, period: float, callback: Any, callback_group: Any):
        self.callbacks["timer"] = callback

    def get_logger(self):
        return SimpleNamespace(**{level: lambda line, level=level: self.log.append((level, line)) for level in LEVELS})


LEVELS = ("error", "warning")


class TransformError(Exception):
    """Stands for tf2_ros.TransformException."""


class Buffer:
    """Stands for tf2_ros.Buffer: knows where the robot is."""

    robot: Any = None

    def transform(self, stamped: Any, frame: str):
        assert stamped.header.stamp.sec == 0, "the latest transform"
        if stamped.header.frame_id != "base_link" or self.robot is None:
            raise TransformError(f"{stamped.header.frame_id!r} does not exist")
        found = type(stamped)(pose=self.robot)
        found.header.frame_id = frame
        return found


def module(name: str, **names: Any) -> ModuleType:
    made = ModuleType(name)
    made.__dict__.update(names)
    return made


@pytest.fixture
def node_module(example, monkeypatch) -> ModuleType:
    """The module of the node, on top of stand-ins."""

    class Stopped(Exception):
        """Stands for ExternalShutdownException."""

    class Executor:
        nodes: list = []

        def __init__(self, num_threads: int):
            assert num_threads > 1

        def add_node(self, node):
            self.nodes.append(node)

        def spin(self):
            raise Stopped

    messages: dict[str, dict[str, type]] = {
        "geometry_msgs": {"PoseStamped": strict("geometry_msgs/msg/PoseStamped")},
        "grid_map_msgs": {"GridMap": strict(TYPE)},
        "nav_msgs": {name: strict(f"nav_msgs/msg/{name}") for name in ("OccupancyGrid", "Path")},
    }
    stand_ins = [
        module("rclpy", init=lambda: None, try_shutdown=lambda: None),
        module("rclpy.callback_groups", MutuallyExclusiveCallbackGroup=object),
        module("rclpy.executors", ExternalShutdownException=Stopped, MultiThreadedExecutor=Executor),
        module("rclpy.node", Node=Node),
        module("rclpy.qos", DurabilityPolicy=SimpleNamespace(TRANSIENT_LOCAL=1), QoSProfile=dict),
        module("rosidl_runtime_py"),
        module("rosidl_runtime_py.utilities", get_message=strict),
        module("tf2_geometry_msgs"),
        module(
            "tf2_ros", Buffer=Buffer, TransformException=TransformError, TransformListener=lambda buffer, node: None
        ),
        *(module(package) for package in messages),
        *(module(f"{package}.msg", **kinds) for package, kinds in messages.items()),
    ]
    for one in stand_ins:
        monkeypatch.setitem(sys.modules, one.__name__, one)
    monkeypatch.setattr(Node, "parameters", SETTINGS)
    monkeypatch.delitem(sys.modules, "traversability_node", raising=False)
    import traversability_node

    return traversability_node


def goal_of(kind, place: tuple[float, float, float], frame: str = "odom") -> Any:
    return kind("geometry_msgs/msg/PoseStamped")(header=header(kind, frame), pose=as_pose(kind, place))


def test_the_node_maps_and_plans(node_module):
    kind, node = node_module.ros_kind, node_module.TraversabilityNode()
    node.callbacks["timer"]()
    node.callbacks["goal_pose"](goal_of(kind, GOAL))
    node.callbacks["timer"]()
    assert not node.published
    for rise in (5.0, 0.0):  # only the newer one is mapped
        node.callbacks["~/elevation"](elevation(kind, header(kind, "odom"), heights() + rise * heights()))
    node.callbacks["timer"]()
    (costs,), (bands,), (path,) = (node.published[f"~/{name}"] for name in ("cost_map", "bands", "path"))
    np.testing.assert_array_equal(costs_of(costs), expected_costs())
    assert "cost_worst" in bands.layers and len(bands.data) == len(bands.layers)
    assert not path.poses and node.log == [("warning", "'base_link' does not exist")]

    node.transforms.robot = as_pose(kind, START)
    node.callbacks["timer"]()
    assert len(node.published["~/path"]) == 1  # nothing is new
    node.callbacks["goal_pose"](goal_of(kind, GOAL))
    node.callbacks["timer"]()
    ends = [node.published["~/path"][-1].poses[end].pose.position for end in (0, -1)]
    np.testing.assert_allclose([(end.x, end.y) for end in ends], [START[:2], GOAL[:2]], atol=1e-9)
    assert len(node.published["~/cost_map"]) == 1 and len(node.log) == 1


def test_the_node_says_what_it_cannot_do(node_module):
    kind, node = node_module.ros_kind, node_module.TraversabilityNode()
    node.transforms.robot = as_pose(kind, START)
    node.callbacks["~/elevation"](elevation(kind, header(kind, "odom"), heights(), "height"))
    node.callbacks["timer"]()
    assert node.log.pop() == ("error", "elevation map: layer = 'elevation': must be variance or height")
    node.callbacks["~/elevation"](elevation(kind, header(kind, "odom"), heights()))
    for goal, reason in ((goal_of(kind, (20.0, 0.0, 0.0)), "on the site"), (goal_of(kind, GOAL, "moon"), "moon")):
        node.callbacks["goal_pose"](goal)
        node.callbacks["timer"]()
        ((level, line),) = node.log
        assert level == "warning" and reason in line and not node.published["~/path"][-1].poses
        node.log.clear()


def test_the_program_runs_until_it_is_stopped_and_refuses_bad_parameters(node_module, monkeypatch, capsys):
    assert node_module.main() == 0
    monkeypatch.setattr(Node, "parameters", {"robot": "tank"})
    assert node_module.main() == 2
    out, err = capsys.readouterr()
    assert not out and err.count("\n") == 1 and err.startswith("traversability_node: robot 'tank': no such preset")
