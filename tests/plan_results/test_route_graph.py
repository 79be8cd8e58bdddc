"""Route graphs of Nav2: what is an edge, against the sequential simulators, and what the files say."""

import json
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from travjax.config import InputError
from travjax.plan_results.route_graph import RouteGraph, route_graph, save_route_graph
from travjax.planning.motions import Motions
from travjax.planning.planner import Planner
from travjax.simulation.setup import chosen_robot
from travjax.site.ground import ArrayGround
from travjax.site.kernel import site_margins
from travjax.site.primitives import Primitive
from travjax.traversal.pose_by_pose import at_poses

SPACING, INTERVAL, ORIGIN, NODE, RISK = 1.5, 0.12, (100.0, -40.0), 0.0625, 2.0
ROBOT = replace(chosen_robot(None), max_roll=math.radians(8))


@cache
def heights() -> np.ndarray:
    """A wall along y = 5.25 with a gap at x = 3, a bank along x = 5.25 to ground 0.2 m higher, an unknown corner."""
    x, y = np.meshgrid(np.arange(0, 7.51, NODE), np.arange(0, 7.51, NODE))
    ground = 0.2 * np.clip((x - 5.05) / 0.4, 0, 1)
    ground[(np.abs(y - 5.25) < 0.01) & ~((x > 2.3) & (x < 3.7))] = 0.5
    ground[(x > 6.2) & (y < 1.1)] = np.nan
    return ground


@cache
def planner() -> Planner:
    ground = ArrayGround(heights().astype(np.float32), 0.0, NODE, ORIGIN, frame="odom")
    return Planner(ground, ROBOT, Motions(risk=RISK), contact="tyre", interval=INTERVAL)


@cache
def graph() -> RouteGraph:
    return route_graph(planner(), SPACING)


def edges_of(found: RouteGraph) -> dict[tuple[tuple[float, ...], tuple[float, ...]], float]:
    """Costs by where an edge begins and ends, from the site's south-west node."""
    at = np.round(found.nodes - ORIGIN, 6).tolist()
    return {
        (tuple(at[i]), tuple(at[j])): cost
        for (i, j), cost in zip(found.edges.tolist(), found.cost.tolist(), strict=True)
    }


def shares(poses: list[np.ndarray], step: bool) -> list[float]:
    """The largest share of a limit over each drive, by the sequential simulators; inf on unknown ground."""
    size = heights().shape[0] // 2 * NODE
    seen = at_poses(heights(), np.concatenate(poses) - [size, size, 0], ROBOT, NODE, "tyre")
    of_events = [seen.obstacle / ROBOT.ride_height, seen.tilt / ROBOT.max_tilt, abs(seen.roll) / ROBOT.max_roll]
    worst = np.max([*of_events, seen.step / ROBOT.max_step * step], axis=0, initial=0)
    worst[~seen.known] = np.inf
    return [part.max() for part in np.split(worst, np.cumsum([len(one) for one in poses])[:-1])]


def straight(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Poses of the drive from a place to another, INTERVAL apart, and the last one."""
    length = math.hypot(*(end - start))
    along = np.append(np.arange(0, length - 1e-9, INTERVAL), length)[:, None] / length
    heading = math.atan2(start[0] - end[0], end[1] - start[1])
    return np.hstack([start + along * (end - start), np.full((len(along), 1), heading)])


def test_nodes_and_edges_are_those_of_the_sequential_simulators():
    inner = np.arange(1, 5) * SPACING  # at the edges of the site the robot would stand on unknown ground
    places = [np.array([x, y]) for y in inner for x in inner]
    circle = np.linspace(0, 2 * np.pi, 81)[:, None]
    turning = shares([np.hstack([np.tile(place, (81, 1)), circle]) for place in places], step=False)
    nodes = [place for place, share in zip(places, turning, strict=True) if share <= 1]
    assert np.round(graph().nodes - ORIGIN, 6).tolist() == [node.tolist() for node in nodes]
    assert len(nodes) < len(places)
    pairs = [(a, b) for a in nodes for b in nodes if 0 < np.abs(a - b).max() < 1.1 * SPACING]
    worst = shares([straight(*pair) for pair in pairs], step=True)
    expected = {
        (tuple(a.tolist()), tuple(b.tolist())): math.hypot(*(b - a)) * (1 + RISK * share**2)
        for (a, b), share in zip(pairs, worst, strict=True)
        if share <= 1
    }
    assert edges_of(graph()) == pytest.approx(expected, abs=1e-4)


def test_the_wall_is_passed_by_its_gap_and_the_bank_straight():
    edges = edges_of(graph())
    through = [edge for edge in edges if (edge[0][1] < 5.25) != (edge[1][1] < 5.25)]
    assert sorted(through) == [((3.0, 4.5), (3.0, 6.0)), ((3.0, 6.0), (3.0, 4.5))]
    over = [edge for edge in edges if (edge[0][0] < 5.25) != (edge[1][0] < 5.25)]
    assert sorted(over) == [((4.5, 3.0), (6.0, 3.0)), ((6.0, 3.0), (4.5, 3.0))]  # (6, 1.5) is beside unknown ground
    assert ((4.5, 1.5), (4.5, 3.0)) in edges and all((6.0, 1.5) not in edge for edge in edges)
    assert edges[(4.5, 3.0), (6.0, 3.0)] > SPACING == edges[(1.5, 1.5), (3.0, 1.5)]


def test_nodes_are_every_so_many_places_of_the_planner():
    """Drives from the nodes have the margins of the same drives from all places."""
    ahead = (Primitive(0.0, ((math.inf, SPACING),)),)
    setup, ground = replace(planner().setup, primitives=ahead, contact="nearest"), planner().costs.ground
    every, few = (site_margins(ground, replace(setup, stride=stride)) for stride in (0.25, SPACING))
    for name in ROBOT.event_names:
        np.testing.assert_array_equal(few[name], every[name][:, ::6, ::6])
    assert np.isfinite(few.tilt).any()


def test_nav2_reads_the_file(tmp_path):
    """As its loader does: ids from points, then edges between them, all of them different."""
    file = save_route_graph(tmp_path / "graph.geojson", graph())
    assert file == tmp_path / "graph.geojson"
    collection = json.loads(file.read_text())
    assert collection["type"] == "FeatureCollection" and set(collection) == {"type", "features"}
    points = [one for one in collection["features"] if one["geometry"]["type"] == "Point"]
    lines = [one for one in collection["features"] if one["geometry"]["type"] == "LineString"]
    assert len(points) == len(graph().nodes) and len(lines) == len(graph().edges)
    ids = [one["properties"]["id"] for one in points + lines]
    assert len(set(ids)) == len(ids) and all(type(one) is int and one >= 0 for one in ids)
    places = {one["properties"]["id"]: tuple(one["geometry"]["coordinates"]) for one in points}
    assert {one["properties"]["frame"] for one in points} == {"odom"}
    assert list(places.values()) == [tuple(node) for node in graph().nodes.tolist()]
    read = {}
    for line in lines:
        properties = line["properties"]
        ends = places[properties["startid"]], places[properties["endid"]]
        assert [tuple(position) for position in line["geometry"]["coordinates"]] == list(ends)
        assert properties["overridable"] is False and properties["cost"] > 0
        read[tuple(tuple(np.subtract(end, ORIGIN).tolist()) for end in ends)] = properties["cost"]
    assert read == pytest.approx(edges_of(graph()), abs=1e-4)


def test_the_cheapest_way_over_the_graph_goes_through_the_gap():
    at = np.round(graph().nodes - ORIGIN, 6).tolist()
    weights = csr_array((graph().cost, tuple(graph().edges.T)), shape=(len(at), len(at)))
    cost, before = dijkstra(weights, indices=at.index([6.0, 3.0]), return_predecessors=True)
    way, node = [], at.index([3.0, 6.0])
    while node >= 0:
        way.append(at[node])
        node = before[node]
    assert way == [[3.0, 6.0], [3.0, 4.5], [4.5, 3.0], [6.0, 3.0]]
    assert cost[at.index([3.0, 6.0])] == pytest.approx(SPACING * (2 + math.sqrt(2)), rel=0.3)


@pytest.mark.parametrize(
    ("motions", "spacing", "message"),
    [
        (Motions(point_turns=False), 1.5, "point_turns = False: must be true for a route graph"),
        (Motions(turns=(1, -1)), 1.5, r"turns = \(1, -1\): must be such that 0, straight on, is among them"),
        (Motions(), 1.6, "spacing = 1.6: must be a whole number of strides, 0.25 m each, of at most 10.5 m"),
        (Motions(), 0.0, "spacing = 0.0: must be a whole number of strides"),
        (Motions(), 10.75, r"spacing = 10.75: must be a whole number of strides, .* of at most 10.5 m"),
    ],
)
def test_what_is_no_graph_is_refused(motions, spacing, message):
    with pytest.raises(InputError, match=message) as raised:
        route_graph(Planner(planner().costs.ground, ROBOT, motions), spacing)
    assert len(str(raised.value).splitlines()) == 1


def test_a_site_where_no_drive_leads_anywhere_is_refused():
    site = ArrayGround(np.zeros((49, 49), np.float32))  # nodes at 0, 2 and 4 m: only the middle one is on it
    with pytest.raises(InputError, match=r"spacing = 2.0: must be such that .* it can turn at 1 of 4 places"):
        route_graph(Planner(site, contact="nearest"))


def test_a_graph_far_from_its_origin_says_what_nav2_makes_of_it():
    assert graph().notes == ()
    (note,) = replace(graph(), nodes=graph().nodes + [500_000.0, 5_200_000.0]).notes
    assert note.startswith("route graph: Nav2 keeps coordinates in four bytes, here to 0.25 m")
