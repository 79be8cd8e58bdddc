"""Biarcs: they end where they should, without a kink, by numerical integration as by their own arcs."""

import math

import numpy as np
import pytest
from scipy.integrate import quad

from travjax.planning.biarcs import Arc, biarc
from travjax.site.primitives import Primitive


def integrated(heading: float, arcs: tuple[Arc, Arc]) -> tuple[float, float, float]:
    """Returns x, y and heading at the end of arcs, by quadrature of the direction along them."""
    x = y = 0.0
    for arc in arcs:
        at = lambda s, start=heading, arc=arc: start + s / arc.radius
        x += quad(lambda s: -math.sin(at(s)), 0, arc.length, epsabs=1e-12, limit=200)[0]  # noqa: B023
        y += quad(lambda s: math.cos(at(s)), 0, arc.length, epsabs=1e-12, limit=200)[0]  # noqa: B023
        heading = at(arc.length)
    return x, y, heading


def drives(count: int):
    """Yields random poses to begin and end with: heading, end, heading of the end."""
    rng = np.random.default_rng(7)
    for _ in range(count):
        yield rng.uniform(-4, 4), rng.uniform(-3, 3, 2), rng.uniform(-4, 4)


def test_biarcs_end_on_the_given_pose():
    found = 0
    for heading, end, end_heading in drives(300):
        arcs = biarc(heading, end, end_heading)
        if arcs is None:
            continue
        found += 1
        x, y, last = integrated(heading, arcs)
        assert math.hypot(x - end[0], y - end[1]) < 1e-9
        assert abs(math.remainder(last - end_heading, 2 * math.pi)) < 1e-9
        for arc in arcs:
            assert arc.length > 0 and abs(arc.turn) < math.pi
            assert arc.turn == pytest.approx(arc.length / arc.radius, abs=1e-12)
    assert found > 290


def test_poses_along_a_biarc_have_no_kink():
    for heading, end, end_heading in drives(50):
        arcs = biarc(heading, end, end_heading)
        if arcs is None:
            continue
        poses = Primitive(heading, tuple((arc.radius, arc.length) for arc in arcs)).poses(0.03)
        chord, turned = np.diff(poses[:, :2], axis=0), np.diff(poses[:, 2])
        middle = poses[:-1, 2] + turned / 2  # the chord of an arc points half way between the tangents at its ends
        direction = np.stack([-np.sin(middle), np.cos(middle)], axis=1)
        length = np.hypot(*chord.T)
        np.testing.assert_allclose(chord, direction * length[:, None], atol=1e-9)
        assert (length <= 0.03 + 1e-9).all()
        np.testing.assert_allclose(poses[-1, :2], end, atol=1e-9)


@pytest.mark.parametrize(
    ("heading", "end", "end_heading", "length"),
    [
        (0.0, (0, 2), 0.0, 2.0),
        (-math.pi / 2, (2, 0), -math.pi / 2, 2.0),
        (0.0, (-1, 1), math.pi / 2, math.pi / 2),  # a quarter of a circle to the left
        (0.0, (1, 1), -math.pi / 2, math.pi / 2),
    ],
)
def test_a_single_arc_is_found_where_one_is_enough(heading, end, end_heading, length):
    arcs = biarc(heading, np.array(end, float), end_heading)
    assert arcs is not None
    assert sum(arc.length for arc in arcs) == pytest.approx(length)
    assert arcs[0].radius == pytest.approx(arcs[1].radius)


def test_a_change_of_lane_turns_there_and_back():
    arcs = biarc(0.0, np.array([-0.5, 2.0]), 0.0)
    assert arcs is not None
    assert arcs[0].turn > 0 and arcs[0].turn == pytest.approx(-arcs[1].turn)
    assert arcs[0].radius == pytest.approx(-arcs[1].radius)


def test_mirrored_and_turned_poses_have_mirrored_and_turned_biarcs():
    for heading, end, end_heading in drives(50):
        arcs = biarc(heading, end, end_heading)
        mirrored = biarc(-heading, end * [-1, 1], -end_heading)
        sin, cos = math.sin(1.1), math.cos(1.1)
        turned = biarc(heading + 1.1, np.array([[cos, -sin], [sin, cos]]) @ end, end_heading + 1.1)
        assert (arcs is None) == (mirrored is None) == (turned is None)
        for arc, left, other in zip(arcs or (), mirrored or (), turned or (), strict=True):
            assert (left.length, left.turn) == pytest.approx((arc.length, -arc.turn))
            assert (other.length, other.turn) == pytest.approx((arc.length, arc.turn))


@pytest.mark.parametrize("end", [(0, -1), (0.5, -0.0), (-1, -1)])
def test_places_beside_and_behind_have_none_in_the_same_heading(end):
    arcs = biarc(0.0, np.array(end, float), 0.0)
    assert arcs is None
