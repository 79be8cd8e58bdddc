"""Node tables against an enumeration of all nodes of the map, pose by pose, in float64.

A trajectory is found in a table through `source`: its first arc, second arc and view. The table's nodes in that view
are mapped back to the map as it is, and compared with the nodes that lie under the robot there.
"""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from travjax.config import InputError
from travjax.simulation.actions import ActionSpace
from travjax.simulation.footprint import RUN, TIE, View, chassis_places, node_table
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.traversal import reference

SEEKUR_JR = Robot.load("seekur_jr")
STRAIGHT = ActionSpace(turns=1, radii=(math.inf,))
VIEWS = [View(turned, mirrored) for turned, mirrored in product((False, True), repeat=2)]


def place_of(table, trajectory) -> tuple[int, np.ndarray, int]:
    """Where a table holds a trajectory: first arc, positions of its poses along P, view."""
    layout = table.layout
    arcs, view = divmod(int(table.source[trajectory]), len(layout.views))
    arc, second = divmod(arcs, layout.second_arcs)
    following = (layout.poses - layout.first_poses) // layout.second_arcs
    poses = np.arange(following) + layout.first_poses + second * following
    return arc, np.append(np.arange(layout.first_poses), poses), view


def some_trajectories(table, each=3) -> list[int]:
    """A few trajectories of every view."""
    rng = np.random.default_rng(0)
    of_view = table.source % len(table.layout.views)
    return [t for view in np.unique(of_view) for t in rng.permutation(np.flatnonzero(of_view == view))[:each].tolist()]


def nodes_in_view(table, arc, pose) -> np.ndarray:
    """The chassis nodes of one pose, in the view: [n, 2] row, col."""
    centre = divmod(int(table.centre[arc, pose]), table.layout.grid.nodes)
    row, start, count = table.chassis[arc, pose].astype(int)
    nodes = [(r, first + k) for r, first, n in zip(row, start, count, strict=True) for k in range(n)]
    return np.array(nodes).reshape(-1, 2) + centre


def covered_by(places, run=1) -> set[tuple[int, int]]:
    """The nodes of the places [2, K] of one pose, each `run` nodes long."""
    return {(row, col + k) for row, col in places.T.tolist() for k in range(run)}


def in_map(nodes, view: View, grid: Grid) -> set[tuple[int, int]]:
    """Nodes of a view (row, col) as nodes of the map as it is."""
    nodes = nodes.copy()
    for axis in view.flipped:
        nodes[:, axis] = grid.cells - nodes[:, axis]
    return set(map(tuple, nodes.tolist()))


def in_robot_frame(grid: Grid, pose) -> tuple[np.ndarray, np.ndarray]:
    """(right, forward) of every node, [rows, cols] metres from the robot's centre."""
    x, y, heading = pose
    east, north = grid.axis()[None, :] - x, grid.axis()[:, None] - y
    sin, cos = math.sin(heading), math.cos(heading)
    return east * cos + north * sin, north * cos - east * sin


def nodes_under_chassis(robot, grid, pose) -> set[tuple[int, int]]:
    right, forward = in_robot_frame(grid, pose)
    within = np.abs(right) <= robot.chassis_width / 2 + TIE
    within &= np.abs(forward) <= robot.chassis_length / 2 + TIE
    return set(map(tuple, np.argwhere(within).tolist()))


def nearest_index(coordinate, grid: Grid) -> int:
    """The nearest of the coordinates of an axis, the larger one of two that are equally near."""
    distance = np.abs(grid.axis() - coordinate) / grid.spacing
    return int(np.flatnonzero(distance <= distance.min() + 2 * TIE)[-1])


def nodes_under_wheels(robot, grid, pose) -> list[tuple[int, int]]:
    """(row, col) under the wheels FL, FR, RL, RR."""
    x, y, heading = pose
    sin, cos = math.sin(heading), math.cos(heading)
    t, b = robot.track / 2, robot.wheelbase / 2
    centres = [(x + u * cos - v * sin, y + u * sin + v * cos) for u, v in [(-t, b), (t, b), (-t, -b), (t, -b)]]
    return [(nearest_index(north, grid), nearest_index(east, grid)) for east, north in centres]


def seen_from(view: View, poses) -> np.ndarray:
    """Poses of the map as it is, as they look in a view."""
    x, y, heading = poses.T
    if view.turned:
        x, y, heading = -x, -y, heading + math.pi
    if view.mirrored:
        x, heading = -x, -heading
    return np.stack([x, y, heading], axis=1)


def assert_same_pose(pose, expected):
    np.testing.assert_allclose(pose[..., :2], expected[..., :2], rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.sin((pose - expected)[..., 2] / 2), 0, rtol=0, atol=1e-6)


# Nodes


def test_wheels_stand_on_their_nearest_nodes(setup):
    robot, actions, grid = setup.robot, setup.actions, setup.grid
    table = setup.node_table()
    for trajectory in some_trajectories(table):
        arc, positions, view = place_of(table, trajectory)
        order = [1, 0, 3, 2] if table.layout.views[view].mirrored else [0, 1, 2, 3]
        wheels = table.wheels[arc, positions][:, order, view]
        expected = [nodes_under_wheels(robot, grid, pose) for pose in reference.poses(actions, trajectory)]
        np.testing.assert_array_equal(np.stack(np.divmod(wheels, grid.nodes), axis=-1), expected)


def test_the_chassis_covers_the_nodes_under_it(setup):
    robot, actions, grid = setup.robot, setup.actions, setup.grid
    table = setup.node_table()
    for trajectory in some_trajectories(table):
        arc, positions, view = place_of(table, trajectory)
        for position, pose in zip(positions, reference.poses(actions, trajectory), strict=True):
            covered = in_map(nodes_in_view(table, arc, position), table.layout.views[view], grid)
            assert covered == nodes_under_chassis(robot, grid, pose)


@pytest.mark.parametrize("run", [1, 2, RUN, 7])
def test_runs_and_singles_cover_the_nodes_of_the_chassis(setup, run):
    table = setup.node_table()
    none, every = chassis_places(table.chassis, 1)
    runs, singles = chassis_places(table.chassis, run)
    assert none.size == 0
    arcs, poses = table.centre.shape
    for arc, pose in product(range(0, arcs, 1 + arcs // 3), range(0, poses, 1 + poses // 100)):
        row, start, count = table.chassis[arc, pose].tolist()
        nodes = {(r, first + k) for r, first, n in zip(row, start, count, strict=True) for k in range(n)}
        assert covered_by(every[arc, pose]) == nodes
        assert covered_by(runs[arc, pose], run) | covered_by(singles[arc, pose]) == nodes


def one_pose(*rows) -> np.ndarray:
    """A chassis of one pose from (row, first column, number of columns)."""
    return np.array(rows, np.int16).T[None, None]


def test_rows_are_covered_by_runs_that_overlap_at_their_end():
    runs, singles = chassis_places(one_pose((0, -3, 6), (1, 2, 4)), 4)
    np.testing.assert_array_equal(runs[0, 0], [[0, 0, 1], [-3, -1, 2]])
    assert covered_by(singles[0, 0]) <= covered_by(runs[0, 0], 4)


def test_rows_shorter_than_a_run_are_covered_node_by_node():
    runs, singles = chassis_places(one_pose((-1, 5, 3), (0, -3, 4), (7, 9, 0)), 4)
    np.testing.assert_array_equal(runs[0, 0], [[0], [-3]])
    np.testing.assert_array_equal(singles[0, 0], [[-1, -1, -1], [5, 6, 7]])


def test_places_that_a_pose_does_not_need_repeat_nodes_of_its_own():
    """The first pose needs three single nodes and one run, the second no single one and two runs."""
    runs, singles = chassis_places(np.concatenate([one_pose((-2, 5, 3), (1, 2, 4)), one_pose((3, 1, 4), (4, 1, 4))]), 4)
    assert runs.shape == (2, 1, 2, 2) and singles.shape == (2, 1, 2, 3)
    np.testing.assert_array_equal(runs[0, 0], [[1, 1], [2, 2]])
    assert covered_by(singles[1, 0]) <= covered_by(runs[1, 0], 4)


def test_all_nodes_are_single_where_a_pose_has_no_row_as_long_as_a_run():
    chassis = np.concatenate([one_pose((0, 0, 4)), one_pose((0, 0, 3))])
    runs, singles = chassis_places(chassis, 4)
    assert runs.shape == (2, 1, 2, 0)
    assert covered_by(singles[0, 0]) == {(0, 0), (0, 1), (0, 2), (0, 3)}
    assert covered_by(singles[1, 0]) == {(0, 0), (0, 1), (0, 2)}


def test_centre_offset_and_axes_are_those_of_the_poses_in_the_view(setup):
    actions, grid = setup.actions, setup.grid
    table = setup.node_table()
    for trajectory in some_trajectories(table):
        arc, positions, view = place_of(table, trajectory)
        row, col = np.divmod(table.centre[arc, positions], grid.nodes)
        x, y = grid.axis()[col], grid.axis()[row]
        east, north = (table.offset[arc, positions] * grid.spacing).T
        cos, sin = table.axes[arc, positions].T
        pose = np.stack([x + east, y + north, np.arctan2(sin, cos)], axis=1)
        assert_same_pose(pose, seen_from(table.layout.views[view], reference.poses(actions, trajectory)))
        assert np.abs(table.offset).max() <= 0.5 + 1e-6


def test_every_trajectory_has_its_own_place(setup):
    table = setup.node_table()
    places = len(table.centre) * table.layout.second_arcs * len(table.layout.views)
    assert table.source.shape == (len(setup.actions),)
    assert len(np.unique(table.source)) == len(table.source)
    assert 0 <= table.source.min() and table.source.max() < places


def test_shapes_are_those_of_the_layout(setup):
    actions, grid = setup.actions, setup.grid
    table = setup.node_table()
    layout, arcs = table.layout, len(table.centre)
    assert layout.grid == grid
    assert layout.second_arcs == len(actions.radii)
    assert layout.first_poses == len(actions.first_stations())
    assert layout.poses == layout.first_poses + len(actions.radii) * len(actions.second_stations())
    assert table.wheels.shape == (arcs, layout.poses, 4, len(layout.views))
    assert table.axes.shape == table.offset.shape == (*table.centre.shape, 2) == (arcs, layout.poses, 2)
    assert table.chassis.shape[:3] == (arcs, layout.poses, 3)


@pytest.mark.parametrize("cells", [127, 100])
def test_a_centre_between_nodes_or_on_one_is_no_different(cells):
    robot, actions, grid = SEEKUR_JR, ActionSpace(turns=2, radii=(math.inf, 1.5, -1.5)), Grid(8, 8 / cells)
    table = node_table(robot, actions, grid)
    for trajectory in some_trajectories(table, each=1):
        arc, positions, view = place_of(table, trajectory)
        view = table.layout.views[view]
        for position, pose in zip(positions, reference.poses(actions, trajectory), strict=True):
            covered = in_map(nodes_in_view(table, arc, position), view, grid)
            assert covered == nodes_under_chassis(robot, grid, pose)
            wheels = table.wheels[arc, position, [1, 0, 3, 2] if view.mirrored else [0, 1, 2, 3]]
            expected = nodes_under_wheels(robot, grid, pose)
            assert list(zip(*np.divmod(wheels[:, table.layout.views.index(view)], cells + 1), strict=True)) == expected


# Views


def views_of(**changes) -> set[View]:
    return set(node_table(SEEKUR_JR, ActionSpace(**changes), Grid()).layout.views)


def test_the_paper_needs_a_quarter_of_its_first_arcs():
    """There are (18 x 13 + 2) / 4 of 18 x 13 first arcs: turns 0 and 9 straight on are their own mirror images."""
    table = node_table(SEEKUR_JR, ActionSpace(), Grid())
    assert set(table.layout.views) == set(VIEWS)
    assert table.centre.shape == (59, 29 + 13 * 28)


def test_views_are_those_that_map_the_actions_onto_themselves():
    paired, unpaired = (math.inf, 1.5, -1.5), (math.inf, 1.5)
    assert views_of(turns=4, radii=paired) == set(VIEWS)
    assert views_of(turns=5, radii=paired) == {View(), View(mirrored=True)}
    assert views_of(turns=4, radii=unpaired) == {View(), View(turned=True)}
    assert views_of(turns=5, radii=unpaired) == {View()}


@pytest.mark.parametrize("view", VIEWS, ids=str)
def test_a_view_shows_other_arcs_of_the_map_as_given_ones(view):
    actions = ActionSpace()
    turn, first, second = actions.split(np.arange(len(actions)))
    true = actions.index(*view.arc(turn, first, actions), view.second(second, actions))
    assert sorted(true) == list(range(len(actions)))
    for trajectory in range(0, len(actions), 97):
        assert_same_pose(seen_from(view, actions.poses(true[trajectory])), actions.poses(trajectory))


@pytest.mark.parametrize("view", VIEWS, ids=str)
def test_a_flipped_map_shows_the_ground_where_the_view_has_it(view):
    grid = Grid(4, 0.5)
    x, y = np.meshgrid(grid.axis(), grid.axis())
    seen = seen_from(view, np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1))
    ground = lambda x, y: x + 10 * y
    flipped = np.flip(ground(x, y), view.flipped)
    row, col = np.rint((seen[:, 1::-1] + 2) / 0.5).astype(int).T
    np.testing.assert_allclose(flipped[row, col], ground(x, y).ravel(), rtol=0, atol=1e-12)


# Errors


def test_a_radius_below_half_the_track_is_refused():
    with pytest.raises(InputError, match="^radii = -0.331: must be at least half the track of Seekur Jr, 0.3315 m: a"):
        node_table(SEEKUR_JR, ActionSpace(radii=(1.0, -0.331)), Grid())


def test_a_radius_of_half_the_track_is_allowed():
    robot = replace(SEEKUR_JR, track=0.7)
    assert len(node_table(robot, ActionSpace(turns=1, radii=(0.35,)), Grid()).source) == 1


def test_a_chassis_that_ends_on_the_last_row_stays_on_the_map():
    """3.3 m of path and 1 m of half a chassis."""
    robot = replace(SEEKUR_JR, chassis_length=2.0)
    table = node_table(robot, STRAIGHT, Grid(8.6, 0.05))
    nodes = nodes_in_view(table, 0, table.layout.poses - 1)
    assert nodes[:, 0].max() == 172


def test_a_chassis_that_leaves_the_map_is_refused():
    robot = replace(SEEKUR_JR, chassis_length=2.0)
    with pytest.raises(
        InputError, match=r"^arc_lengths = \(1.65, 1.65\): trajectories leave the 8.4 m map by 0.1 m; allowed"
    ):
        node_table(robot, STRAIGHT, Grid(8.4, 0.05))


def test_a_wheel_that_leaves_the_map_is_refused():
    robot = replace(SEEKUR_JR, wheelbase=2.0)
    assert len(node_table(robot, STRAIGHT, Grid(8.6, 0.05)).source) == 1
    with pytest.raises(
        InputError, match=r"^arc_lengths = \(1.65, 1.65\): trajectories leave the 8.4 m map by 0.1 m; allowed"
    ):
        node_table(robot, STRAIGHT, Grid(8.4, 0.05))


@pytest.mark.parametrize("turns", [2, 4])
def test_a_map_that_is_left_to_any_side_is_refused(turns):
    with pytest.raises(InputError, match="^arc_lengths = .*: trajectories leave the 4 m map"):
        node_table(SEEKUR_JR, ActionSpace(turns=turns, radii=(math.inf,)), Grid(4, 0.0625))


def test_a_robot_wider_than_the_map_is_refused():
    actions = ActionSpace(turns=1, radii=(math.inf,), arc_lengths=(0.1, 0.1))
    with pytest.raises(InputError, match="^arc_lengths = .*: trajectories leave the 1 m map by 0.125 m"):
        node_table(replace(SEEKUR_JR, track=1.5, chassis_width=1.3, chassis_length=0.2), actions, Grid(1, 0.125))


def test_a_chassis_that_falls_between_the_nodes_is_refused_with_a_spacing_that_works():
    robot = replace(SEEKUR_JR, chassis_width=0.06, chassis_length=0.3)
    with pytest.raises(InputError, match="^spacing = 0.0625: too coarse for Seekur Jr.*; allowed: up to 0.0424 m$"):
        node_table(robot, ActionSpace(), Grid())
    assert len(node_table(robot, ActionSpace(), Grid(8, 0.04)).source) == 3042


def test_a_table_cannot_be_written_to():
    table = node_table(SEEKUR_JR, STRAIGHT, Grid())
    with pytest.raises(ValueError, match="read-only"):
        table.wheels[0] = 0


def test_the_same_table_is_built_once():
    assert node_table(SEEKUR_JR, STRAIGHT, Grid()) is node_table(replace(SEEKUR_JR), STRAIGHT, Grid())
