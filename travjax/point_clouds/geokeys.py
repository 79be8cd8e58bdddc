"""Coordinate systems that a LAS file states: as WKT, or as the keys of GeoTIFF (SPEC section 11).

The numbers of keys and methods are those of the GeoTIFF standard, OGC 19-008.
"""

import struct
from functools import lru_cache

from pyproj import CRS
from pyproj.database import get_units_map

from travjax.config import InputError
from travjax.rasters.coordinates import parsed, require_height_unit

WKT, DIRECTORY, DOUBLES = 2112, 34735, 34736
"""Numbers of the records that state a system."""

MODEL, GEODETIC, PROJECTED, METHOD, UNIT, UNIT_SIZE = 1024, 2048, 3072, 3075, 3076, 3077
VERTICAL, VERTICAL_UNIT = 4096, 4099
USER_DEFINED = 32767

METHODS = {1: "tmerc", 7: "merc", 8: "lcc", 9: "lcc", 11: "aea"}
"""Projections without a code whose scale can be told, by their numbers, as PROJ calls them."""

PARAMETERS = {
    3078: "lat_1",
    3079: "lat_2",
    3080: "lon_0",
    3081: "lat_0",
    3082: "x_0",
    3083: "y_0",
    3084: "lon_0",
    3085: "lat_0",
    3086: "x_0",
    3087: "y_0",
    3088: "lon_0",
    3089: "lat_0",
    3092: "k_0",
    3093: "k_0",
}
"""Keys of a projection's numbers, as PROJ calls them."""

Keys = dict[int, float]


def system_of(records: dict[int, bytes], heights_scaled: bool) -> CRS | None:
    """Returns the system that the records of a LAS file state, by their number, or None.

    Raises InputError when it cannot be understood, is geocentric, or states heights in another unit than metres while
    no height scale was given.
    """
    text = records.get(WKT, b"").partition(b"\0")[0].decode("utf-8", "replace").strip()
    keys = _keys(records.get(DIRECTORY, b""), records.get(DOUBLES, b""))
    crs = parsed(text) if text else _horizontal(keys)
    if crs is None or not (crs.is_compound or crs.is_vertical or len(crs.axis_info) > 2):
        _require_heights_in_metres(keys, heights_scaled)
    return crs


def _keys(directory: bytes, doubles: bytes) -> Keys:
    """Reads the keys whose values are numbers, by key number."""
    numbers = struct.unpack(f"<{len(directory) // 2}H", directory[: len(directory) // 2 * 2])
    values = struct.unpack(f"<{len(doubles) // 8}d", doubles[: len(doubles) // 8 * 8])
    if len(numbers) < 4:
        return {}
    if numbers[3] > len(numbers) // 4 - 1:
        raise InputError(f"crs: GeoKeys = {numbers[3]}: must be the {len(numbers) // 4 - 1} there; it is cut short")
    keys: Keys = {}
    for at in range(4, 4 + 4 * numbers[3], 4):
        key, place, _, value = numbers[at : at + 4]
        if place == 0:
            keys[key] = value
        elif place == DOUBLES and value < len(values):
            keys[key] = values[value]
    return keys


def _horizontal(keys: Keys) -> CRS | None:
    alone = GEODETIC in keys and not keys.keys() & {PROJECTED, METHOD}
    model = keys.get(MODEL, 2 if alone else 1)
    if model == 3:
        raise InputError("crs: is geocentric: its z is no height; convert it to metres (a UTM zone, say) first")
    code = int(keys.get(PROJECTED if model != 2 else GEODETIC, 0))
    metres = None if model == 2 else _unit_metres(keys, UNIT, UNIT_SIZE)
    if metres is not None and abs(metres - 1) > 1e-9:  # whatever the code says: it is the unit of these coordinates
        raise InputError(f"crs: is in units of {metres:g} m (GeoKey {UNIT}); reproject it to metres first")
    if 1024 <= code < USER_DEFINED:
        return parsed(code)
    if model == 2:
        raise InputError("crs: is in degrees; reproject it to metres (a UTM zone, say) first")
    return _described(keys)


def _described(keys: Keys) -> CRS | None:
    """Builds the system of a projection from its parameters; None without parameters, or for another method."""
    method = METHODS.get(int(keys.get(METHOD, 0)))
    if method is None:
        return None
    words = {name: keys[key] for key, name in PARAMETERS.items() if key in keys}
    if method == "merc" and "lat_1" in words:
        words["lat_ts"] = words.pop("lat_1")
    geodetic = int(keys.get(GEODETIC, 0))
    body = parsed(geodetic).ellipsoid if 1024 <= geodetic < USER_DEFINED else None
    shape = f"+a={body.semi_major_metre} +b={body.semi_minor_metre}" if body else "+ellps=WGS84"
    return parsed(f"+proj={method} {' '.join(f'+{name}={value!r}' for name, value in words.items())} {shape} +units=m")


def _require_heights_in_metres(keys: Keys, heights_scaled: bool) -> None:
    """Refuses heights whose unit, or that of their own system, is another than metres, and depths."""
    code = int(keys.get(VERTICAL, 0))
    metres = None if heights_scaled else _unit_metres(keys, VERTICAL_UNIT, None)
    if metres is not None:
        unit = _units()[int(keys[VERTICAL_UNIT])][1]
        require_height_unit(f"crs: GeoKey {VERTICAL_UNIT}", unit, metres, heights_scaled)
    if not 1024 <= code < USER_DEFINED:
        return
    try:
        system = parsed(code)
    except InputError:
        return  # one of the numbers that came before EPSG's: they say nothing about the unit
    for axis in system.axis_info if system.is_vertical else ():
        if axis.direction == "down":
            raise InputError(f"crs = EPSG:{code}: has depths, which run down; turn them into heights first")
        if metres is None:
            require_height_unit(f"crs = EPSG:{code}", axis.unit_name, axis.unit_conversion_factor, heights_scaled)


def _unit_metres(keys: Keys, key: int, size: int | None) -> float | None:
    """Returns the metres of the unit that a key names, or None; a unit without a code has the length in the key
    `size`.
    """
    code = int(keys.get(key, 0))
    if code == 0:
        return None
    if code == USER_DEFINED and size in keys:
        return float(keys[size])
    if code not in _units():
        hint = "; give metres a unit (--height-scale=METRES)" if key == VERTICAL_UNIT else ""
        raise InputError(f"crs: GeoKey {key} = {code}: must be a known unit of length{hint}")
    return _units()[code][0]


@lru_cache(maxsize=1)
def _units() -> dict[int, tuple[float, str]]:
    """Returns (metres, name) of EPSG's units of length, by code."""
    units = get_units_map(auth_name="EPSG", category="linear", allow_deprecated=True)
    return {int(unit.code): (unit.conv_factor, unit.name) for unit in units.values()}
