"""Stencils of poses against a loop over poses and places, and against the nodes of the simulator's wheels."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.conftest import SETUPS
from travjax.config import InputError
from travjax.models.pose_stencil import ALONG, STENCIL_NODES, nodes_at, stencil


def places_by_hand(pose, radius, robot, actions) -> list[tuple[float, float]]:
    """(x, y) of every place of one stencil, from their definition."""
    x, y, heading = pose
    if math.isinf(radius):
        before = (x + math.sin(heading) * actions.interval, y - math.cos(heading) * actions.interval, heading)
    else:  # back along the circle around the point at `radius` to the left
        cx, cy = x - radius * math.cos(heading), y - radius * math.sin(heading)
        earlier = heading - actions.interval / radius
        before = (cx + radius * math.cos(earlier), cy + radius * math.sin(earlier), earlier)

    def at(place, right, forward):
        sin, cos = math.sin(place[2]), math.cos(place[2])
        return place[0] + cos * right - sin * forward, place[1] + sin * right + cos * forward

    chassis = [
        (side * robot.chassis_width / 4, (step - 2) * robot.chassis_length / 5) for side in (-1, 1) for step in range(5)
    ]
    wheels = robot.wheel_positions()
    return [*(at(pose, *w) for w in wheels), *(at(before, *w) for w in wheels), *(at(pose, *c) for c in chassis)]


def test_stencils_are_the_nodes_nearest_to_their_places(setup):
    robot, actions, grid = setup.robot, setup.actions, setup.grid
    table, rng = stencil(setup), np.random.default_rng(0)
    radii, split = np.asarray(actions.radii), table.first_poses
    for arc in rng.choice(len(table.nodes), min(len(table.nodes), 6), replace=False):
        turn, first = divmod(int(arc), len(radii))
        second = int(rng.integers(len(radii)))
        own, rest = actions.first_poses(turn, first), actions.second_poses(turn, first, second)
        following = table.nodes[arc, split:].reshape(len(radii), len(rest), STENCIL_NODES)[second]
        for poses, nodes, radius in ((own, table.nodes[arc, :split], radii[first]), (rest, following, radii[second])):
            for pose, found in zip(poses, nodes, strict=True):
                for place, node in zip(places_by_hand(pose, radius, robot, actions), found, strict=True):
                    row, col = divmod(int(node), grid.nodes)
                    off = np.array([col, row]) - np.clip(np.array(place) / grid.spacing + grid.cells / 2, 0, grid.cells)
                    assert np.abs(off).max() <= 0.5 + 1e-6


def test_the_first_places_are_the_nodes_under_the_wheels_in_the_simulator(setup):
    actions, table, simulated = setup.actions, stencil(setup), setup.node_table()
    turns, radii = actions.turns, len(actions.radii)
    assert table.nodes.shape[1:] == (simulated.layout.poses, STENCIL_NODES) and len(table.nodes) == turns * radii
    own = {tuple(wheels.ravel()) for wheels in table.nodes[..., :4]}
    assert {tuple(wheels.ravel()) for wheels in simulated.wheels[..., 0]} <= own


def test_stencils_are_integers_in_the_map_and_read_only():
    setup = SETUPS["coarse small map"]
    nodes = stencil(setup).nodes
    assert nodes.dtype == np.int32 and nodes.min() >= 0 and nodes.max() < setup.grid.nodes**2
    with pytest.raises(ValueError, match="read-only"):
        nodes[0] = 0


def test_places_off_the_map_are_on_its_edge():
    setup = SETUPS["coarse small map"]
    nodes = nodes_at(np.array([100.0, -100.0, 0.3]), np.array(math.inf), setup)
    assert set(nodes.tolist()) == {setup.grid.nodes - 1}  # the south-east corner


def test_places_under_the_chassis_are_within_it():
    setup = SETUPS["fine large map"]
    robot, grid = setup.robot, setup.grid
    nodes = nodes_at(np.zeros(3), np.array(math.inf), setup)[8:].reshape(2, ALONG)
    row, col = np.divmod(nodes, grid.nodes)
    assert np.abs((col - grid.cells // 2) * grid.spacing).max() <= robot.chassis_width / 2
    assert np.abs((row - grid.cells // 2) * grid.spacing).max() <= robot.chassis_length / 2
    assert len(np.unique(nodes)) == nodes.size


def test_what_does_not_fit_together_is_refused():
    setup = replace(SETUPS["paper"], grid=SETUPS["coarse small map"].grid)
    with pytest.raises(InputError, match="leave the 4 m map"):
        stencil(setup)
