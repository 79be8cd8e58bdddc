"""Landforms against the rules that they are made by, measured on what comes out."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import KDTree

from travjax.terrain.landforms import (
    BERM,
    CRATER_DEPTH,
    CRATER_RIM,
    RUT_GAUGE,
    Nodes,
    Rocks,
    crater_profile,
    craters,
    draw_rocks,
    fractal_relief,
    lay_rocks,
    ledges,
    rock_area,
    ruts,
)

SITE = Nodes(801, 801, 0.05)
"""40 x 40 m."""


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(seed))


def deviation(relief: np.ndarray, lag: int) -> float:
    """Root-mean-square difference of heights so many nodes apart, along both axes."""
    along_y, along_x = relief[lag:] - relief[:-lag], relief[:, lag:] - relief[:, :-lag]
    return float(np.sqrt((np.mean(along_y**2) + np.mean(along_x**2)) / 2))


def test_the_middle_node_is_at_the_origin_and_squares_hold_the_nodes_within():
    nodes = Nodes(9, 6, 0.5)
    assert (nodes.y[4], nodes.x[3]) == (0, 0) and (nodes.y[-1], nodes.x[-1]) == (2, 1)
    rows, cols = nodes.around(0.6, -0.1, 0.7)
    np.testing.assert_array_equal(nodes.y[rows], [-0.5, 0, 0.5])
    np.testing.assert_array_equal(nodes.x[cols], [0, 0.5, 1])
    assert all(part.start == part.stop for part in (nodes.around(9, 0, 1)[1], nodes.around(0, -9, 1)[0]))
    assert nodes.nearest(0.6, -0.3) == (3, 4) and nodes.nearest(-9, 9) == (8, 0)


@pytest.mark.parametrize("hurst", [0.5, 0.65, 0.8])
def test_relief_has_its_hurst_exponent_and_its_roughness_at_a_metre(hurst):
    reliefs = [fractal_relief(rng(seed), Nodes(641, 513, 0.0625), hurst, 0.06) for seed in range(8)]
    lags = np.array([2, 4, 8, 16, 32])
    squares = np.mean([[deviation(relief, lag) ** 2 for lag in lags] for relief in reliefs], axis=0)
    slope = np.polyfit(np.log(lags), np.log(squares) / 2, 1)[0]
    assert slope == pytest.approx(hurst, abs=0.06)
    assert np.sqrt(squares[3]) == pytest.approx(0.06, rel=0.06)


def test_relief_is_not_periodic():
    relief = fractal_relief(rng(), SITE, 0.7, 0.05)
    steps = np.abs(np.diff(relief, axis=0)).mean()
    assert np.abs(relief[0] - relief[-1]).mean() > 3 * steps
    assert np.abs(relief[:, 0] - relief[:, -1]).mean() > 3 * steps


def test_rocks_cover_what_golombek_and_rapp_say():
    abundance, smallest, largest = 0.1, 0.1, 2.0
    rocks = draw_rocks(rng(), SITE, abundance, smallest, largest, 0.45)
    area = SITE.area(largest)
    for diameter in (0.1, 0.15, 0.2, 0.3, 0.5, 0.8, 1.2):
        areas = np.pi / 4 * rocks.diameter[rocks.diameter >= diameter] ** 2
        expected = rock_area(diameter, abundance) - rock_area(largest, abundance)
        assert areas.sum() / area == pytest.approx(expected, abs=4 * np.sqrt((areas**2).sum()) / area)
    assert rock_area(0.2, 0.1) == pytest.approx(0.1 * np.exp(-0.2 * (1.79 + 1.52)))
    assert rocks.diameter.min() >= smallest and rocks.diameter.max() <= largest
    ratio = rocks.height / rocks.diameter
    assert ratio.mean() == pytest.approx(0.45, rel=0.02) and 0.3 < ratio.min() < ratio.max() < 0.6


def test_laid_rocks_cover_their_share_but_for_overlaps():
    nodes = Nodes(801, 801, 0.025)
    rocks = draw_rocks(rng(1), nodes, 0.1, 0.1, 2.0, 0.45)
    covered = lay_rocks(np.zeros(nodes.shape), nodes, rocks) > 0
    areas = np.pi / 4 * rocks.diameter**2 / nodes.area(2.0)
    assert covered.mean() == pytest.approx(1 - np.exp(-areas.sum()), rel=0.08)


def one_rock(**others) -> Rocks:
    values = dict(diameter=0.8, x=0.0, y=0.0, height=0.35, heading=0.0, sides=0.7, exponent=2.5, burial=0.3) | others
    return Rocks(**{name: np.array([value]) for name, value in values.items()})


@pytest.mark.parametrize("burial", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("exponent", [2.0, 3.5])
def test_a_rock_has_the_height_and_the_area_that_it_is_given(burial, exponent):
    nodes = Nodes(401, 401, 0.005)
    ground = np.full(nodes.shape, 7.0)
    heights = lay_rocks(ground, nodes, one_rock(burial=burial, exponent=exponent)) - ground
    assert heights.max() == heights[200, 200] == pytest.approx(0.35)
    assert heights.min() == 0
    assert (heights > 0).sum() * 0.005**2 == pytest.approx(np.pi / 4 * 0.8**2, rel=0.01)
    rows, cols = np.nonzero(heights)
    assert np.ptp(cols) / np.ptp(rows) == pytest.approx(0.7, abs=0.02)  # heading 0: the longer axis is that of y


def test_a_rock_turns_anticlockwise_and_is_cut_at_the_edge():
    nodes = Nodes(201, 201, 0.01)
    turned = lay_rocks(np.zeros(nodes.shape), nodes, one_rock(heading=np.pi / 4))
    rows, cols = np.nonzero(turned)
    assert np.corrcoef(rows, cols)[0, 1] < -0.2  # from +y to the north-west
    cut = lay_rocks(np.zeros(nodes.shape), nodes, one_rock(x=1.0, y=1.0))
    assert cut[-1, -1] == pytest.approx(0.35) and not cut[:100].any()
    assert not lay_rocks(np.zeros(nodes.shape), nodes, one_rock(x=9.0)).any()


def test_a_rock_lies_on_the_ground_at_its_middle():
    nodes = Nodes(101, 101, 0.02)
    ground = 0.2 * nodes.x + np.zeros(nodes.shape)
    heights = lay_rocks(ground, nodes, one_rock(x=0.5))
    assert heights[50, 75] == pytest.approx(0.2 * 0.5 + 0.35)
    assert (heights >= ground).all()


def test_a_fresh_crater_has_the_depth_and_the_rim_of_pike_and_melosh():
    radii = np.linspace(0, 4, 4001)
    profile = crater_profile(radii, 5.0, 1.0)
    assert profile.max() == pytest.approx(CRATER_RIM * 5) and radii[profile.argmax()] == pytest.approx(1, abs=0.002)
    assert profile.max() - profile.min() == pytest.approx(CRATER_DEPTH * 5) and profile.argmin() == 0
    assert (profile[radii >= 3] == 0).all()
    assert np.abs(np.diff(profile)).max() < 0.005  # no cliff
    half = crater_profile(radii, 5.0, 0.5)
    assert np.ptp(half) == pytest.approx(np.ptp(profile) / 2)


def test_craters_follow_their_size_frequency(monkeypatch):
    drawn: list[tuple[float, float]] = []

    def profile(radii, *rest):
        drawn.append(rest)
        return np.zeros_like(radii)

    monkeypatch.setattr("travjax.terrain.landforms.crater_profile", profile)
    nodes = Nodes(41, 41, 1.0)
    for seed in range(40):
        craters(rng(seed), nodes, 0.02, 2.0, 8.0, (0.2, 1.0))
    diameters, freshness = np.array(drawn).T
    assert 0.2 <= freshness.min() < 0.25 and 0.95 < freshness.max() <= 1
    for diameter in (2.0, 3.0, 5.0):
        expected = 0.02 * (diameter**-2 - 8.0**-2) * nodes.area(12.0) * 40
        assert (diameters >= diameter).sum() == pytest.approx(expected, abs=4 * np.sqrt(expected))


def test_craters_are_as_deep_and_their_rims_as_high_as_their_profiles():
    added = craters(rng(), Nodes(401, 401, 0.25), 0.2, 4.0, 4.1, (1.0, 1.0))
    assert added.min() == pytest.approx(-(CRATER_DEPTH - CRATER_RIM) * 4, rel=0.05)
    assert np.quantile(added[added > 0], 0.99) == pytest.approx(CRATER_RIM * 4, rel=0.15)


def test_a_ledge_is_as_high_as_asked_and_its_face_one_or_two_cells_wide():
    added = ledges(rng(6), SITE, 0.02, (0.3, 0.3))
    steps = [np.abs(np.diff(added, axis=axis)).max() for axis in (0, 1)]
    faces = np.abs(added[2:] - added[:-2]).max(), np.abs(added[:, 2:] - added[:, :-2]).max()
    assert max(faces) == pytest.approx(0.3, rel=0.05) and max(steps) <= 0.3 + 1e-9
    assert 0 <= added.min() and added.max() <= 0.3
    assert not ledges(rng(), SITE, 0.0, (0.3, 0.3)).any()


def test_ruts_are_as_deep_as_asked_with_berms_and_a_gauge():
    added, driven = ruts(rng(6), SITE, 0.02, (0.1, 0.1))
    assert added.min() == pytest.approx(-0.1, rel=0.01) and added.max() == pytest.approx(BERM * 0.1, rel=0.05)
    assert driven[added < -0.001].all()
    parts, count = ndimage.label(added < -0.099)  # half as wide as 0.1 m
    assert count == 2
    first, second = (np.argwhere(parts == number) * SITE.spacing for number in (1, 2))
    assert KDTree(first).query(second)[0].mean() == pytest.approx(RUT_GAUGE, abs=0.1)
    assert not ruts(rng(), SITE, 0.0, (0.1, 0.1))[0].any()
