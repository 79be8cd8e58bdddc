"""Points of LAS and LAZ files (SPEC section 11).

The counts and lengths in the header are compared with the size of the file before anything is read by them. What the
decompressor takes memory by is checked in laz.py.
"""

import struct
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from travjax.config import InputError
from travjax.point_clouds.geokeys import system_of
from travjax.point_clouds.laz import require_decompressible, without_panics
from travjax.point_clouds.points import COARSEST_STEP, Points, installed, reason_of
from travjax.rasters.reading_options import DemOptions

POINTS_AT_ONCE = 2_000_000
"""Points in memory with all that they hold."""

POINT_BYTES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
"""Bytes of a point of each format, without extra ones."""

COMPRESSED = 128
"""Bit of the point format that LASzip sets; the next, 64, is an older form of it."""


class Header(NamedTuple):
    """What a LAS header says: minor version, place, format, size and number of points, scales, records by number."""

    minor: int
    start: int
    form: int
    size: int
    points: int
    scales: tuple[float, float, float]
    records: dict[int, bytes]
    compressed: bool


def read_las(path: Path, options: DemOptions) -> Points:
    """Reads all points of a LAS or LAZ file but those withheld, a chunk at a time.

    Raises InputError when it cannot be read, holds fewer points than it says, steps coarser than COARSEST_STEP, or a
    coordinate system that is not in metres.
    """
    laspy = installed("laspy", "'laspy[lazrs]'")
    with path.open("rb") as file:
        header = _header(file, path.stat().st_size)
        if header.compressed:
            require_decompressible(file, path.stat().st_size, header.start, header.size, header.points, header.records)
    _require_fine_scales(header, options.height_scale or 1.0)
    crs = system_of(header.records, options.height_scale is not None)
    parts, read = [(np.zeros((3, 0)), np.zeros(0, np.uint8))], 0
    form = "LAZ" if header.compressed else "LAS"
    try:
        with without_panics(), laspy.open(path, read_evlrs=False) as points:
            for chunk in points.chunk_iterator(POINTS_AT_ONCE) if header.points else ():
                read += len(chunk)
                parts.append(_kept(chunk))
    except (MemoryError, KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # of laspy and lazrs; a panic of Rust is no Exception
        if isinstance(error, laspy.LaspyException):
            raise InputError(f"cannot be read as {form}: {reason_of(error)}") from None
        raise InputError(f"cannot be read as {form}: it is cut short or damaged") from None
    if read != header.points:
        raise InputError(f"points = {read}: must be {header.points}, as its header says; it is cut short")
    places, classes = zip(*parts, strict=True)
    x, y, z = np.concatenate(places, axis=1)
    return Points(x, y, z, crs, np.concatenate(classes))


def _kept(chunk: Any) -> tuple[np.ndarray, np.ndarray]:
    """Returns (coordinates [3, n], classes [n]) of the points that are not withheld."""
    kept = np.asarray(chunk.withheld) == 0
    return np.stack([np.asarray(chunk[axis])[kept] for axis in "xyz"]), np.asarray(chunk.classification)[kept]


def _header(file: BinaryIO, size: int) -> Header:
    start = file.read(375)
    if start[:4] != b"LASF" or len(start) < 227:
        raise InputError("cannot be read as LAS: it does not begin as one, or is cut short")
    major, minor = start[24:26]
    if major != 1 or minor > 4:
        raise InputError(f"version = {major}.{minor}: must be 1.0 to 1.4")
    length, first, records, form, each, points = struct.unpack("<HIIBHI", start[94:111])
    scales, offsets = struct.unpack("<3d", start[131:155]), struct.unpack("<3d", start[155:179])
    least = (227, 227, 227, 235, 375)[minor]
    extended, extensions = 0, 0
    if minor == 4 and len(start) == 375:
        extended, extensions, points = struct.unpack("<QIQ", start[235:255])
    compressed, form = bool(form & COMPRESSED), form & 63
    if form >= len(POINT_BYTES) or each < POINT_BYTES[form]:
        raise InputError(f"point format = {form} of {each} bytes: must be 0 to 10, of as many bytes as that has")
    if not least <= length <= first <= size:
        raise InputError(
            f"offset to points = {first}: must lie behind the header, in its {size} bytes; it is cut short"
        )
    if not compressed and points > (size - first) // each:
        held = (size - first) // each
        raise InputError(f"points = {held}: must be {points}, as its header says; it is cut short")
    for name, numbers in (("scales", scales), ("offsets", offsets)):
        if not np.isfinite(numbers).all() or np.abs(numbers).max() > 1e12 or (name == "scales" and min(numbers) <= 0):
            raise InputError(f"{name} = {numbers}: must be finite{', above 0' * (name == 'scales')}")
    found = _records(file, length, first, records, 54)
    for number, content in _records(file, extended, size, extensions, 60).items():
        found.setdefault(number, content)
    return Header(minor, first, form, each, points, scales, found, compressed)


def _records(file: BinaryIO, start: int, end: int, count: int, header: int) -> dict[int, bytes]:
    """Reads the first record of each number between two offsets, of those about coordinate systems and LASzip."""
    found: dict[int, bytes] = {}
    for number in range(count):
        described = b""
        if start + header <= end:
            file.seek(start)
            described = file.read(header)
        if len(described) < header:
            raise InputError(f"records = {count}: must lie between header and points; number {number + 1} is cut short")
        user, code = described[2:18].rstrip(b"\0"), int.from_bytes(described[18:20], "little")
        length = int.from_bytes(described[20 : 22 if header == 54 else 28], "little")
        if start + header + length > end:
            raise InputError(f"record {number + 1} = {length} bytes: must lie in the file; it is cut short")
        if user in (b"LASF_Projection", b"liblas", b"laszip encoded"):
            content = file.read(length)
            if content.strip(b"\0 "):
                found.setdefault(code, content)
        start += header + length
    return found


def _require_fine_scales(header: Header, height_scale: float) -> None:
    for axis, scale in zip("xyz", header.scales, strict=True):
        step = scale * (height_scale if axis == "z" else 1.0)
        if step > COARSEST_STEP * (1 + 1e-9):
            raise InputError(
                f"scale of {axis} = {scale:g}: is stored in steps of {step:g} m: must be at most {COARSEST_STEP:g} m"
            )
