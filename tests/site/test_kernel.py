"""The site kernel: equal to the sequential simulators, the same whatever the tiles, unknown beyond the edge."""

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from travjax.config import InputError
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.site import kernel
from travjax.site.ground import SiteGround
from travjax.site.kernel import SiteSetup, simulate_site, tiles_of
from travjax.site.primitives import Primitive, straight_passes
from travjax.terrain.styles import generate_terrain
from travjax.traversal import reference, tyre_reference
from travjax.traversal.traverse import simulate

SEEKUR_JR, LEO_ROVER = map(Robot.load, ("seekur_jr", "leo_rover"))
CURVES = (
    Primitive(0.3, ((0.9, 0.5),)),
    Primitive(2.0, ((-1.2, 0.4), (math.inf, 0.3)), behind=0.1),
    Primitive(-1.1, ((math.inf, 0.7),)),
)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    """A rough raster of 60 x 75 nodes with a hole, in metres."""
    heights = np.array(generate_terrain("scattered_sharp", [5])[0], np.float64)[20:80, 30:105]
    heights[22:24, 40:43] = np.nan
    return heights


def sequential(heights, robot: Robot, primitive: Primitive, row: int, col: int, contact: str, spacing: float = 0.0625):
    """Margins of one primitive from a node by the sequential simulators, on the ground around that node."""
    half = 60
    padded = np.pad(np.asarray(heights, float), half, constant_values=np.nan)
    around = padded[row : row + 2 * half + 1, col : col + 2 * half + 1]  # its centre is the node
    poses = primitive.poses(0.06).tolist()
    if contact == "nearest":
        states = [reference.pose_state(around, robot, *pose, spacing) for pose in poses]
        heights_of = np.array([state.contacts for state in states])
        step = np.abs(np.diff(heights_of, axis=0)).max(initial=0)
    else:
        whole = tyre_reference.ground_of(around, robot, spacing)
        states = [tyre_reference.pose_state(whole, robot, *pose, spacing) for pose in poses]
        step = max(state.step for state in states)
    if not all(state.known for state in states):
        return [math.nan] * 3
    return [step, max(state.clearance for state in states), max(state.tilt for state in states)]


def compare(heights, robot: Robot, primitives, contact: str, stride: float, spacing: float, count: int) -> float:
    """Compares random places; returns the share of them that are known."""
    passes = dict(contact=contact, stride=stride, spacing=spacing)
    margins = simulate_site(heights, robot, primitives, **passes)
    step, rng = round(stride / spacing), np.random.default_rng(3)
    found, wanted = [], []
    for _ in range(count):
        which, row, col = (int(rng.integers(edge)) for edge in margins.step.shape)
        found.append([margins[name][which, row, col] for name in ("step", "obstacle", "tilt")])
        wanted.append(sequential(heights, robot, primitives[which], row * step, col * step, contact, spacing))
        assert margins.known[which, row, col] == (not math.isnan(found[-1][0]))
    np.testing.assert_allclose(found, wanted, atol=1e-4)
    return float(np.isfinite(found).mean())


@pytest.mark.parametrize(
    ("contact", "robot", "primitives", "stride", "spacing"),
    [
        ("nearest", SEEKUR_JR, straight_passes(16), 0.25, 0.0625),
        ("nearest", LEO_ROVER, CURVES, 0.1875, 0.0625),
        ("tyre", SEEKUR_JR, straight_passes(16), 0.25, 0.0625),
        ("tyre", replace(LEO_ROVER, max_roll=0.3), CURVES, 0.3, 0.1),
    ],
)
def test_margins_are_those_of_the_sequential_simulators(ground, contact, robot, primitives, stride, spacing):
    assert 0.2 < compare(ground, robot, primitives, contact, stride, spacing, count=60) < 1


@pytest.mark.parametrize("contact", ["nearest", "tyre"])
@pytest.mark.parametrize("name", ["quarry", "mars_live_site"])
def test_margins_on_real_sites_are_those_of_the_sequential_simulators(name, contact):
    path = Path(os.environ.get("TRAVJAX_DATA", "")) / f"terrain/{name}.tif"
    if not path.is_file():
        pytest.skip(f"needs {name}.tif under TRAVJAX_DATA")
    part = SiteGround.open(path).part(slice(100, 400), slice(60, 360))
    assert compare(part, SEEKUR_JR, straight_passes(16), contact, 0.25, 0.0625, count=30) > 0.2


@pytest.mark.parametrize("contact", ["nearest", "tyre"])
def test_bits_do_not_depend_on_the_tiles(ground, contact, monkeypatch):
    whole = simulate_site(ground, contact=contact, stride=0.125)
    assert whole.known.any() and not whole.known.all()
    monkeypatch.setattr(kernel, "TILE", 8)
    tiled = simulate_site(ground, contact=contact, stride=0.125)
    for name in ("step", "obstacle", "tilt", "known"):
        np.testing.assert_array_equal(getattr(tiled, name), getattr(whole, name))


def test_tiles_cover_a_lattice_once():
    setup = SiteSetup(SEEKUR_JR, straight_passes(4))
    for lattice in ((1, 1), (8, 9), (300, 130), (129, 128)):
        covered = np.zeros(lattice, int)
        for tile in tiles_of(lattice, setup):
            covered[tile.within(lattice)] += 1
        assert (covered == 1).all()


def test_a_tile_of_fine_nodes_has_fewer_places():
    setup = SiteSetup(SEEKUR_JR, straight_passes(4, 1.0), 0.01, 1.0)
    tile = tiles_of((1000, 1000), setup)[0]
    assert tile.edge == 32 and tile.ground(setup)[0].stop - tile.ground(setup)[0].start <= kernel.TILE_NODES


@pytest.mark.parametrize("contact", ["nearest", "tyre"])
def test_at_the_middle_of_a_map_a_primitive_is_a_trajectory(contact):
    heights, actions = np.asarray(generate_terrain("rough", [3])[0]), ActionSpace(turns=5, radii=(math.inf, 2.0, -1.5))
    chosen = [(0, 0, 0), (3, 1, 2), (4, 2, 1)]
    arcs = [
        [(actions.radii[i], length) for i, length in zip(pair, actions.arc_lengths, strict=True)] for _, *pair in chosen
    ]
    primitives = [
        Primitive(float(actions.heading(turn)), tuple(pair)) for (turn, *_), pair in zip(chosen, arcs, strict=True)
    ]
    margins = simulate_site(heights, primitives=primitives, stride=0.5, contact=contact)
    trajectories = [int(actions.index(*one)) for one in chosen]
    expected = simulate(heights, actions=actions, contact=contact, turn=False)
    middle = Grid().cells // 2 // 8
    for name in ("step", "obstacle", "tilt"):
        np.testing.assert_allclose(margins[name][:, middle, middle], expected[name][np.array(trajectories)], atol=2e-6)


def test_ground_that_a_pass_needs_beyond_the_edge_is_unknown():
    margins = simulate_site(np.zeros((65, 97)), stride=0.5, contact="nearest")
    known = margins.known
    assert known.shape == (16, 9, 13)
    ahead, across = known[0], known[4]  # north, and west
    reach = (SEEKUR_JR.chassis_length + 0.5) / 2
    inside = [np.arange(edge) * 0.5 for edge in known.shape[1:]]
    near = [np.minimum(places, places[-1] - places) for places in inside]
    np.testing.assert_array_equal(ahead.any(axis=1), near[0] >= reach - 1e-9)
    np.testing.assert_array_equal(across.any(axis=0), near[1] >= reach - 1e-9)
    assert np.nanmax(np.abs(margins.step)) == np.nanmax(np.abs(margins.tilt)) == 0


def test_high_ground_loses_nothing(ground):
    low, high = (simulate_site(ground + level, contact="nearest") for level in (0.0, 3000.0))
    np.testing.assert_allclose(high.step, low.step, atol=1e-6)
    assert (high.known == low.known).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stride": 0.1}, "stride = 0.1: must be a whole number of nodes, 0.0625 m each"),
        ({"contact": "soft"}, "contact = 'soft': must be"),
        ({"interval": 0}, "interval = 0: must be"),
        (
            {"spacing": 0.002},
            "spacing = 0.002: must be at least 0.0034 m, at which Seekur Jr with its passes spans 512 nodes",
        ),
        (
            {"spacing": 0.003, "stride": 0.252},
            "spacing = 0.003: must be at least 0.0034 m, at which Seekur Jr with its passes spans 512 nodes$",
        ),
        (
            {"stride": 100.0, "primitives": straight_passes(4, 100.0)},
            "stride = 100.0: must be at most 30.25 m, at which Seekur Jr with its passes spans 512 nodes of 0.0625 m",
        ),
        (
            {"primitives": (Primitive(0.0, ((math.inf, 20.0),)),)},
            "primitives, reach = 20.0: must be at most 15.1 m from a place, at which Seekur Jr with its passes spans",
        ),
        ({"primitives": ()}, r"primitives = \(\): must be at least one"),
    ],
)
def test_bad_arguments_are_named(change, message):
    with pytest.raises(InputError, match=message):
        replace(SiteSetup(SEEKUR_JR, straight_passes(4)), **change)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Primitive(0.0, ()), "arcs = .*: must be one or more pairs"),
        (lambda: Primitive(math.nan, ((1.0, 1.0),)), "heading = nan: must be radians"),
        (lambda: Primitive(0.0, ((0.0, 1.0),)), "arcs, radius = 0.0: must be"),
        (lambda: straight_passes(0), "headings = 0: must be a whole number from 1 to 360"),
        (lambda: simulate_site(np.zeros((3, 4, 5))), r"heights: shape \[3, 4, 5\]: must be \[rows, cols\]"),
        (lambda: simulate_site(np.full((9, 9), -9999.0)), "heights = -9999: is a usual mark of unknown ground"),
    ],
)
def test_bad_primitives_and_heights_are_named(make, message):
    with pytest.raises(InputError, match=message):
        make()
