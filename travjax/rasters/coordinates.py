"""Coordinate systems of real maps: which are refused, since a metre of them is none on the ground, and their names.

These are the systems of the files of SPEC section 11.
pyproj brings its own database, so what a system says does not depend on the PROJ of the environment.
"""

import re
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from pyproj import CRS, Proj, Transformer
from pyproj.exceptions import CRSError, ProjError

from travjax.config import InputError

EARTH = 6_378_137.0
"""Metres: the radius of the earth at the equator."""

MOST_STRETCH = 1e-3
"""Share by which a metre of a coordinate system may differ from one on the ground: UTM stays below it in its zone."""

NEAR_ORIGIN = 100_000.0
"""Metres: coordinates as small as that, outside their system's area of use, count from an origin of the site's own."""

METRE_NAMES = re.compile(r"(m|met(er|re)s?)(?![\w/*^-])", re.IGNORECASE)
"""What a unit of metres begins with, as in "m above the geoid"."""

NO_UNIT = ("unspecified", "unknown", "none", "undefined")
"""What formats call a unit that was not said."""

UNIT_METRES = {
    r"(ft|foot|feet|international foot)": 0.3048,
    r"(ftus|us[-_ ]?(survey[-_ ]?)?(ft|foot|feet)|foot_us|us-ft)": 1200 / 3937,
    r"(dm|decimet(er|re)s?)": 0.1,
    r"(cm|centimet(er|re)s?)": 0.01,
    r"(mm|millimet(er|re)s?)": 0.001,
    r"(km|kilomet(er|re)s?)": 1000.0,
    r"(in|inch|inches)": 0.0254,
    r"(yd|yards?)": 0.9144,
}
"""Names of units of height, as patterns of the whole name, and how many metres each is."""


def parsed(described: str | int) -> CRS:
    """Returns the system of a code, WKT or PROJ text; raises InputError when it cannot be understood."""
    try:
        return _parsed(described)
    except (CRSError, ValueError, TypeError, OverflowError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"crs: cannot be understood: {reason[:120]}") from None


@lru_cache(maxsize=64)
def _parsed(described: str | int) -> CRS:
    return CRS.from_user_input(described)


def name_of(crs: CRS | None) -> str | None:
    """Returns the code of a system, else its WKT; of one joined with a height system that of its own part."""
    if crs is None:
        return None
    crs = horizontal(crs)
    authority = crs.to_authority(min_confidence=70)
    if authority:
        return ":".join(authority)
    try:
        return crs.to_wkt("WKT1_GDAL")
    except CRSError:
        return crs.to_wkt()


def horizontal(crs: CRS) -> CRS:
    """Returns the part of a system that says where on the ground a point lies."""
    if crs.is_bound and crs.source_crs is not None:
        crs = crs.source_crs
    return horizontal(crs.sub_crs_list[0]) if crs.is_compound else crs


def require_metric(crs: CRS | None, x: float, y: float, heights_scaled: bool) -> None:
    """Raises InputError unless a metre of the system at (x, y) is one on the ground, x to the east and y to the north.

    No system, or a local one that names no unit, is taken as metres.
    heights_scaled: whether a height scale was given, so that the system's unit of height does not count
    """
    if crs is None:
        return
    name, ground = short_name(crs), horizontal(crs)
    if ground.is_geographic:
        raise InputError(f"crs = {name}: is in degrees; reproject it to metres (a UTM zone, say) first")
    if ground.is_geocentric:
        raise InputError(
            f"crs = {name}: is geocentric: its z is no height; convert it to metres (a UTM zone, say) first"
        )
    local = "Engineering" in ground.type_name
    if not (ground.is_projected or local):
        raise InputError(f"crs = {name}: is a {ground.type_name}: must say where x and y lie, in metres")
    for axis in ground.axis_info[:2]:
        if abs(axis.unit_conversion_factor - 1) > 1e-9 and axis.unit_name.lower() != "unknown":
            unit = f"{axis.unit_conversion_factor:g} m ({axis.unit_name})"
            raise InputError(f"crs = {name}: is in units of {unit}; reproject it to metres first")
    if {axis.direction for axis in ground.axis_info[:2]} == {"south", "west"}:
        raise InputError(f"crs = {name}: its axes run south and west; reproject it to east and north first")
    for axis in _height_axes(crs):
        if axis.direction == "down":
            raise InputError(f"crs = {name}: has depths, which run down; turn them into heights first")
        require_height_unit(f"crs = {name}", axis.unit_name, axis.unit_conversion_factor, heights_scaled)
    if ground.is_projected:
        _require_true_to_scale(name, ground, x, y)


def require_metric_named(name: str | None, x: float, y: float, heights_scaled: bool) -> None:
    """Raises InputError unless the system of that code or text is as `require_metric` wants it."""
    require_metric(system_named(name), x, y, heights_scaled)


def system_named(name: str | None) -> CRS | None:
    """Returns the system of a code or text; None for none, and for a local one whose text says no more than that.

    Raises InputError for other texts that cannot be understood.
    """
    try:
        return parsed(name) if name else None
    except InputError:
        if is_local(name):
            return None
        raise


def is_local(name: str | None) -> bool:
    """Tells whether a system, as it is named, says nothing about where on earth it lies."""
    return name is None or name.startswith(("LOCAL_CS", "ENGCRS"))


def places(name: str, x: np.ndarray, y: np.ndarray) -> tuple[float, np.ndarray]:
    """Returns where points of a system lie: the radius of their planet [m], and [n, 3] metres from its centre.

    On earth in WGS 84; systems that differ in their realisation of the same frame are some metres apart at most.
    name: of a system that is not local
    """
    crs = horizontal(parsed(name))
    radius = _radius(crs)
    if _like_earth(radius):
        to_centre = Transformer.from_crs(crs, "EPSG:4978", always_xy=True)
        return EARTH, np.stack(to_centre.transform(x, y, np.zeros_like(x)), axis=-1)
    longitude, latitude = np.radians(Proj(crs)(x, y, inverse=True))
    level = np.cos(latitude)
    unit = np.stack([level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)], axis=-1)
    return float(round(radius)), radius * unit


def why_not_on_earth(name: str | None, x: float, y: float) -> str | None:
    """Says why a point of a system has no known longitude and latitude on the earth; None where it has them.

    name: of a system that `system_named` understands, or None; x, y: metres
    """
    crs = system_named(name)
    if crs is None or "Engineering" in horizontal(crs).type_name:
        return "no coordinate system says where on earth the site lies"
    ground, named = horizontal(crs), f"crs = {short_name(crs)}"
    if not _like_earth(_radius(ground)):
        return f"{named}: lies on another body than the earth"
    try:
        longitude, latitude = Proj(ground)(x, y, inverse=True, errcheck=True)
    except ProjError as error:
        return f"{named}: x, y = {x:g}, {y:g}: {error}"
    if _area_of_use(ground) and _from_own_origin(ground, x, y, longitude, latitude):
        return f"{named}: x, y = {x:g}, {y:g}: count from an origin of the site's own"
    return None


def require_height_unit(where: str, unit: str, metres: float, heights_scaled: bool) -> None:
    """Raises InputError for heights in another unit than metres, unless a height scale was given."""
    if abs(metres - 1) > 1e-9 and unit.lower() != "unknown" and not heights_scaled:
        raise InputError(
            f"{where}: has heights in units of {metres:g} m ({unit}); give that (--height-scale={metres!r})"
        )


def require_height_unit_named(where: str, unit: str | None, heights_scaled: bool) -> None:
    """Raises InputError unless a unit of height, as a file names it, is metres or none, or a height scale was given."""
    named = (unit or "").strip()
    named = "" if named.lower() in NO_UNIT else named
    if heights_scaled or not named or METRE_NAMES.match(named):
        return
    for pattern, metres in UNIT_METRES.items():
        if re.fullmatch(pattern, named, re.IGNORECASE):
            require_height_unit(where, named, metres, heights_scaled)
    raise InputError(
        f"{where}: has heights in {named[:40]!r}: must be metres; give metres a unit (--height-scale=METRES)"
    )


def short_name(crs: CRS) -> str:
    """Returns the code of a system, else its own name."""
    authority = horizontal(crs).to_authority(min_confidence=70)
    return ":".join(authority) if authority else f'"{horizontal(crs).name}"'


def _radius(crs: CRS) -> float:
    """Returns the metres from the centre of a system's planet to its equator."""
    return crs.ellipsoid.semi_major_metre if crs.ellipsoid else EARTH


def _like_earth(radius: float) -> bool:
    return abs(radius / EARTH - 1) < 0.01


def _height_axes(crs: CRS) -> Sequence:
    if crs.is_bound and crs.source_crs is not None:
        crs = crs.source_crs
    return crs.axis_info[2:]


def _require_true_to_scale(name: str, crs: CRS, x: float, y: float) -> None:
    try:
        projection = Proj(crs)
        longitude, latitude = projection(x, y, inverse=True, errcheck=True)
        if _from_own_origin(crs, x, y, longitude, latitude):
            return
        factors = projection.get_factors(longitude, latitude, errcheck=True)
        scales = np.array([factors.tissot_semimajor, factors.tissot_semiminor])
    except (CRSError, ProjError) as error:
        raise InputError(f"crs = {name}: x, y = {x:g}, {y:g}: no scale of it is known there ({error})") from None
    if not np.isfinite(scales).all() or (scales <= 0).any():
        raise InputError(f"crs = {name}: x, y = {x:g}, {y:g}: must lie where the system holds")
    off = scales[np.argmax(np.abs(scales - 1))]
    if abs(off - 1) > MOST_STRETCH:
        raise InputError(
            f"crs = {name}: a metre on the ground is {off:.4g} of its metres here, at {latitude:.4g} degrees north, "
            f"{longitude:.4g} east: must be within {MOST_STRETCH:.1%} of 1; reproject it to a UTM zone first"
        )


def _from_own_origin(crs: CRS, x: float, y: float, longitude: float, latitude: float) -> bool:
    """Tells whether coordinates count from an origin of the site's own, as after an offset was subtracted: see
    NEAR_ORIGIN.
    """
    if max(abs(x), abs(y)) > NEAR_ORIGIN:
        return False
    area = _area_of_use(crs)
    if area is None:
        return True
    within = area.west <= longitude <= area.east if area.west <= area.east else not area.east < longitude < area.west
    return not (within and area.south <= latitude <= area.north)


def _area_of_use(crs: CRS) -> Any:
    """Returns where a system is meant to be used, as pyproj says it; None where that is not known."""
    code = crs.to_authority(min_confidence=70)
    return crs.area_of_use or (_parsed(":".join(code)).area_of_use if code else None)
