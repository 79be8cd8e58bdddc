"""Coordinate systems: a metre of theirs must be one on the ground."""

import re

import numpy as np
import pytest

from travjax.config import InputError
from travjax.rasters.coordinates import (
    name_of,
    parsed,
    places,
    require_height_unit_named,
    require_metric,
    require_metric_named,
    short_name,
    why_not_on_earth,
)


def line(check, *arguments) -> str:
    with pytest.raises(InputError) as raised:
        check(*arguments)
    assert len(str(raised.value).splitlines()) == 1
    return str(raised.value)


LOCAL = 'LOCAL_CS["yard",UNIT["metre",1]]'
UNNAMED = 'LOCAL_CS["unnamed",UNIT["unknown",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
MARS = "+proj=eqc +R=3396190 +units=m +lat_ts={}"


@pytest.mark.parametrize(
    ("system", "name"),
    [("EPSG:32632", "EPSG:32632"), ("EPSG:25832+7837", "EPSG:25832"), ("EPSG:5555", "EPSG:25832")],
)
def test_a_system_joined_with_one_of_heights_goes_by_its_own_name(system, name):
    crs = parsed(system)
    require_metric(crs, 500_000, 5_000_000, False)
    assert name_of(crs) == short_name(crs) == name


def test_a_system_without_a_code_goes_by_its_text():
    assert str(name_of(parsed(LOCAL))).startswith('LOCAL_CS["yard"')
    assert short_name(parsed(LOCAL)) == '"yard"'
    assert name_of(None) is None


@pytest.mark.parametrize("text", ["nonsense", "EPSG:99999", "PROJCS[nonsense", 12])
def test_a_system_that_is_none_is_refused(text):
    assert line(parsed, text).startswith("crs: cannot be understood: ")


@pytest.mark.parametrize(
    ("system", "x", "y"),
    [
        (LOCAL, 0, 0),
        (UNNAMED, 480_456, 2_208_239),
        ("EPSG:32632", 500_000, 5_000_000),
        ("EPSG:2154", 652_000, 6_862_000),
        ("EPSG:28992", 155_000, 463_000),
        ("EPSG:27700", 400_000, 300_000),
        ("EPSG:2056", 2_600_000, 1_200_000),
        (MARS.format(18), 0, 1_065_000),
        ("EPSG:32234", -23.5, 21.5),  # a yard that counts from its own middle
    ],
)
def test_systems_that_are_true_to_scale_at_the_site_are_taken(system, x, y):
    require_metric(parsed(system), x, y, False)


@pytest.mark.parametrize(
    ("system", "x", "y", "start"),
    [
        ("EPSG:4326", 7, 46, "crs = EPSG:4326: is in degrees; reproject"),
        ("EPSG:4978", 0, 0, "crs = EPSG:4978: is geocentric: its z is no height"),
        ("EPSG:5703", 0, 0, "crs = EPSG:5703: is a Vertical CRS: must say where x and y lie"),
        ("EPSG:2263", 3e5, 6e4, "crs = EPSG:2263: is in units of 0.3048"),
        ("EPSG:2263+6360", 3e5, 6e4, "crs = EPSG:2263: is in units of 0.3048"),
        ('LOCAL_CS["yard",UNIT["foot",0.3048]]', 0, 0, 'crs = "yard": is in units of 0.3048 m (foot)'),
        ("EPSG:5513", 7e5, 1e6, "crs = EPSG:5513: its axes run south and west"),
        ("EPSG:25832+5831", 5e5, 5e6, "crs = EPSG:25832: has depths"),
        ("EPSG:3857", 1e6, 8_399_738, "crs = EPSG:3857: a metre on the ground is 2 of its metres here, at 60 degrees"),
        ("ESRI:102100", 1e6, 8_399_738, "crs = ESRI:102100: a metre on the ground is 2 of its metres here"),
        ("EPSG:3395", 1e6, 8_362_699, "crs = EPSG:3395: a metre on the ground is 1.995 of its metres here"),
        (MARS.format(0), 0, 1_065_000, 'crs = "unknown": a metre on the ground is 1.051 of its metres here'),
        ("EPSG:32632", 1_300_000, 5_000_000, "crs = EPSG:32632: a metre on the ground is 1.007 of its metres here"),
        ("EPSG:32632", 1e12, 1e12, "crs = EPSG:32632: x, y = 1e+12, 1e+12: "),
    ],
)
@pytest.mark.parametrize("scaled", [True, False])
def test_systems_whose_metre_is_none_on_the_ground_are_refused(system, x, y, start, scaled):
    assert line(require_metric, parsed(system), x, y, scaled).startswith(start)


def test_heights_in_feet_are_refused_unless_they_are_scaled():
    crs = parsed("EPSG:25832+6360")
    refused = line(require_metric, crs, 5e5, 5e6, False)
    assert refused.startswith("crs = EPSG:25832: has heights in units of 0.3048")
    assert float(refused.partition("--height-scale=")[2].rstrip(")")) == pytest.approx(1200 / 3937, abs=1e-12)
    require_metric(crs, 5e5, 5e6, True)
    require_metric(None, 0, 0, False)


@pytest.mark.parametrize("unit", [None, "", "unspecified", "m", "metre", "Meters", "m above the geoid"])
def test_units_that_are_metres_are_taken(unit):
    require_height_unit_named("band 1", unit, False)


@pytest.mark.parametrize(
    ("unit", "metres"),
    [("ft", 0.3048), ("US survey foot", 1200 / 3937), ("cm", 0.01), ("mm", 0.001), ("dm", 0.1), ("km", 1000)],
)
def test_units_of_a_known_size_are_refused_with_it(unit, metres):
    refused = line(require_height_unit_named, "band 1", unit, False)
    assert refused.startswith(f"band 1: has heights in units of {metres:g} m ({unit})")
    assert float(refused.partition("--height-scale=")[2].rstrip(")")) == metres
    require_height_unit_named("band 1", unit, True)


@pytest.mark.parametrize("unit", ["degree", "DN", "m/s", "m2", "%", "meterstick"])
def test_units_that_are_no_height_are_refused(unit):
    assert line(require_height_unit_named, "band 1", unit, False).startswith(f"band 1: has heights in '{unit}'")


def test_the_text_of_a_local_system_may_be_of_any_kind():
    for name in (None, "LOCAL_CS[]", LOCAL):
        require_metric_named(name, 0, 0, False)
    assert line(require_metric_named, "my yard", 0, 0, False).startswith("crs: cannot be understood")
    assert line(require_metric_named, "EPSG:3857", 0, 8e6, False).startswith("crs = EPSG:3857")


def test_a_place_is_the_same_by_two_systems():
    zone, x, y = "EPSG:32632", np.array([500_000.0, 700_000.0]), np.array([5_000_000.0, 5_300_000.0])
    radius, first = places(zone, x, y)
    assert radius == 6_378_137
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 6_367_000, atol=3000)
    assert np.linalg.norm(np.diff(first, axis=0)) == pytest.approx(np.hypot(2e5, 3e5), rel=1e-3)
    _, other = places("EPSG:25832", x, y)
    assert np.abs(first - other).max() < 2


def test_places_on_another_planet_are_not_those_on_earth():
    radius, xyz = places(MARS.format(0), np.zeros(1), np.zeros(1))
    assert radius == 3_396_190
    np.testing.assert_allclose(xyz, [[3_396_190, 0, 0]], atol=1)


@pytest.mark.parametrize(
    ("system", "x", "y", "reason"),
    [
        ("EPSG:32632", 500_000, 5_200_000, None),
        ("EPSG:25832+7837", 500_000, 5_200_000, None),
        ("+proj=tmerc +lat_0=47 +lon_0=9 +datum=WGS84 +units=m", 3, 5, None),
        ("EPSG:32632", 3, 5, "crs = EPSG:32632: x, y = 3, 5: count from an origin of the site's own"),
        (None, 3, 5, "no coordinate system says where on earth the site lies"),
        (LOCAL, 3, 5, "no coordinate system says where on earth the site lies"),
        (UNNAMED, 3, 5, "no coordinate system says where on earth the site lies"),
        ("IAU_2015:49910", 3, 5, "crs = IAU_2015:49910: lies on another body than the earth"),
        ("EPSG:32632", 1e12, 5, r"crs = EPSG:32632: x, y = 1e\+12, 5: .+"),
    ],
)
def test_a_point_lies_on_earth_or_a_line_says_why_not(system, x, y, reason):
    found = why_not_on_earth(system, x, y)
    assert found is None if reason is None else re.fullmatch(reason, found or "")
