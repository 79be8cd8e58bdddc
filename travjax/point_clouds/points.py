"""Points of a cloud as a file holds them, and what is left out of them before they are gridded (SPEC section 11)."""

import logging
from collections.abc import Iterable
from importlib import import_module
from types import ModuleType
from typing import NamedTuple

import numpy as np
from pyproj import CRS

from travjax.config import InputError

NOISE = (7, 18)
"""Classes of points that are no ground whatever else a file holds: low and high noise."""

GROUND = (2, 8, 11)
"""Classes that are ground where a file has class 2: ground, its key points, road surface."""

COARSEST_STEP = 0.01
"""Metres: coordinates stored in larger steps move a point by as much as a limit of a robot."""


class Points(NamedTuple):
    """Points of a file.

    x, y, z: [n] as the file stores them
    crs:     coordinate system, or None
    classes: [n] integers, 2 of ground, or None
    notes:   lines about how the file was read that its user should know
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    crs: CRS | None = None
    classes: np.ndarray | None = None
    notes: tuple[str, ...] = ()


def installed(module: str, package: str = "") -> ModuleType:
    """Imports a library that only some formats need; raises InputError that says what to install."""
    logger = logging.getLogger(module)
    if not logger.handlers:
        logger.addHandler(logging.NullHandler())  # what it says about a file is in our own line
    try:
        return import_module(module)
    except ImportError:
        raise InputError(f"reading it needs {module}: pip install {package or module}") from None


def reason_of(error: BaseException) -> str:
    """Returns why a library could not read a file, as one short line."""
    lines = str(error).strip().splitlines()
    return printable(lines[0][:160]) if lines else type(error).__name__


def printable(text: str) -> str:
    """Returns what a file holds with its unprintable characters as question marks."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def listed(names: Iterable[str]) -> str:
    """Returns the names of what a file holds, at most 80 characters of them."""
    return printable(", ".join(filter(None, names))[:80]) or "nothing"


def whole_classes(values: np.ndarray | None) -> np.ndarray | None:
    """Returns classes [n] as whole numbers, None where there are none or other numbers."""
    if values is None or not ((values >= 0) & (values < 256) & (values == np.rint(values))).all():
        return None
    return values.astype(np.uint8)


def ground_of(points: Points, wanted: tuple[int, ...] | None) -> Points:
    """Leaves out what is not of the classes wanted; ground alone where there are points of class 2, unless given.

    Raises InputError when classes are wanted that no point has.
    """
    if points.classes is None:
        if wanted is not None:
            raise InputError(f"classes = {_listed(wanted)}: must be left out: its points have no classes")
        return points
    found = {int(code): int(number) for code, number in enumerate(np.bincount(points.classes)) if number}
    if wanted is not None:
        if found and not set(wanted) & set(found):
            raise InputError(f"classes = {_listed(wanted)}: must be among those of its points: {_listed(found)}")
        return _kept(points, np.isin(points.classes, wanted))
    others = sorted(set(found) - {*NOISE, *GROUND})
    if 2 in found and others:
        left = sum(found[code] for code in others)
        note = (
            f"ground alone is taken: {left} of {len(points.x)} points, of classes {_listed(others)}, are left out "
            f"(--classes={_listed(sorted({*found} & {*GROUND} | {*others}))} takes them)"
        )
        return _kept(points, np.isin(points.classes, GROUND), note)
    kept = _kept(points, ~np.isin(points.classes, NOISE))
    if 2 in found or not set(others) - {0, 1}:
        return kept
    note = f"no point is called ground: classes {_listed(others)} all count as ground (--classes takes some)"
    return kept._replace(notes=(*kept.notes, note))


def _listed(codes) -> str:
    return ",".join(map(str, codes))


def _kept(points: Points, kept: np.ndarray, *notes: str) -> Points:
    x, y, z = (points.x, points.y, points.z) if kept.all() else (points.x[kept], points.y[kept], points.z[kept])
    return points._replace(x=x, y=y, z=z, classes=None, notes=(*points.notes, *notes))


def require_fine_steps(name: str, values: np.ndarray, scale: float = 1.0) -> None:
    """Raises InputError when values, [n] metres times the scale, are too large for the number type that holds them."""
    if values.dtype.kind != "f" or values.dtype.itemsize > 4:
        return
    largest = np.nanmax(np.abs(values), initial=0).astype(values.dtype.newbyteorder("="))
    step = float(np.spacing(largest)) * scale
    if np.isfinite(largest) and step > COARSEST_STEP:
        raise InputError(
            f"{name} = {largest:g}: is stored in steps of {step:g} m (float{8 * values.dtype.itemsize}): must be "
            "double, or relative to a place nearby"
        )


def without_repeats(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Returns which of the points, [n] float64 each, to keep so that each is there once."""
    mixed = np.zeros(len(x), np.uint64)
    for values in (x, y, z):
        mixed = (mixed ^ (values + 0.0).view(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(32)
    kept = np.ones(len(x), bool)
    ordered = np.sort(mixed)
    shared = np.unique(ordered[1:][ordered[1:] == ordered[:-1]])
    if shared.size:
        here = np.flatnonzero(shared[np.minimum(np.searchsorted(shared, mixed), len(shared) - 1)] == mixed)
        order = here[np.lexsort((z[here], y[here], x[here]))]
        again = np.all([values[order[1:]] == values[order[:-1]] for values in (x, y, z)], axis=0)
        kept[order[1:][again]] = False
    return kept
