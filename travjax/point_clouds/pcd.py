"""Points of a PCD file, the format of the Point Cloud Library (SPEC section 11)."""

import itertools
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from travjax.config import InputError
from travjax.point_clouds.points import Points, listed, reason_of

LONGEST_HEADER = 2**16
"""Bytes."""

SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
"""Bytes that a number of each type may take."""

MOST_EXPANSION = 100
"""How many times its size data may unfold to: three bytes stand for 264 at most."""

AT_ORIGIN = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
"""VIEWPOINT of points that are not moved: translation, then quaternion w, x, y, z."""


class Layout(NamedTuple):
    """What a header says: (name, type, numbers) of the fields, number of points, how they are stored, viewpoint."""

    fields: list[tuple[str, str, int]]
    points: int
    data: str
    viewpoint: list[float]

    def dtype(self) -> np.dtype:
        """Returns the type of one point in binary: field number k is pk."""
        return np.dtype([(f"p{number}", kind, (count,)) for number, (_, kind, count) in enumerate(self.fields)])


def read_pcd(path: Path) -> Points:
    """Reads points from a PCD file: ascii, binary or binary_compressed.

    Raises InputError when it is no PCD file, and when it holds no x, y, z or fewer points than it says.
    """
    with path.open("rb") as file:
        layout = _header(file)
        names = [name.lower() if count == 1 else "" for name, _, count in layout.fields]
        if not {"x", "y", "z"} <= set(names):
            raise InputError(f"FIELDS: must hold numbers x, y, z; it holds: {listed(names)}")
        columns = [names.index(axis) for axis in "xyz"]
        left = path.stat().st_size - file.tell()
        if layout.data == "ascii":
            x, y, z = _text(file, layout, columns, left)
        elif layout.data == "binary":
            _require_room(layout, left)
            table = np.fromfile(file, layout.dtype(), layout.points)
            x, y, z = (np.ascontiguousarray(table[f"p{column}"][:, 0]) for column in columns)
        else:
            x, y, z = _unfolded(file, layout, columns, left)
    moved = layout.viewpoint != AT_ORIGIN
    shown = " ".join(f"{value:g}" for value in layout.viewpoint)
    notes = (f"VIEWPOINT {shown} is not applied: x, y, z are taken as they are stored",) if moved else ()
    return Points(x, y, z, notes=notes)


def _header(file: BinaryIO) -> Layout:
    said: dict[str, list[str]] = {}
    while "DATA" not in said:
        line = file.readline(LONGEST_HEADER)
        if not line or file.tell() > LONGEST_HEADER:
            raise InputError("cannot be read as PCD: its header has no line DATA; it is cut short")
        words = line.decode("utf-8", "replace").removeprefix("\ufeff").split()
        if words and not words[0].startswith("#"):
            said[words[0].upper()] = words[1:]
    names = said.get("FIELDS") or said.get("COLUMNS") or []
    try:
        sizes, counts = ([int(word) for word in said.get(key, ["1"] * len(names))] for key in ("SIZE", "COUNT"))
        kinds = [word.upper() for word in said.get("TYPE", [])]
        if not names or not len(names) == len(sizes) == len(kinds) == len(counts):
            raise ValueError("FIELDS, SIZE, TYPE and COUNT must be as many")
        if any(size not in SIZES.get(kind, ()) for kind, size in zip(kinds, sizes, strict=True)):
            raise ValueError("TYPE and SIZE must be F of 4 or 8 bytes, I or U of 1, 2, 4 or 8")
        if not all(0 < count < 2**16 for count in counts):
            raise ValueError("COUNT must be from 1 to 65535")
        across, along = (int(said.get(key, ["1"])[0]) for key in ("WIDTH", "HEIGHT"))
        points = int(said["POINTS"][0]) if "POINTS" in said else across * along
        viewpoint = [float(word) for word in said.get("VIEWPOINT", [])] or AT_ORIGIN
        data = said["DATA"][0].lower()
        if points < 0 or len(str(points)) > 25 or data not in ("ascii", "binary", "binary_compressed"):
            raise ValueError("POINTS must be a number, DATA ascii, binary or binary_compressed")
    except (ValueError, IndexError) as error:
        raise InputError(f"cannot be read as PCD: header: {reason_of(error)}") from None
    described = zip(names, kinds, sizes, counts, strict=True)
    fields = [(name, f"<{kind.lower()}{size}", count) for name, kind, size, count in described]
    return Layout(fields, points, data, viewpoint)


def _require_room(layout: Layout, size: int) -> None:
    if layout.points * layout.dtype().itemsize > size:
        raise InputError(f"POINTS = {layout.points}: must fit into its {size} bytes of them; it is cut short")


def _text(file: BinaryIO, layout: Layout, columns: list[int], left: int) -> np.ndarray:
    starts = [0, *itertools.accumulate(count for _, _, count in layout.fields)]
    if layout.points * 2 * starts[-1] > left + 1:
        raise InputError(f"POINTS = {layout.points}: must fit into its {left} bytes of them; it is cut short")
    lines = itertools.islice((line.decode("ascii", "replace") for line in file if not line.isspace()), layout.points)
    try:
        used = [starts[column] for column in columns]
        rows = np.loadtxt(lines, usecols=used, ndmin=2, comments=None) if layout.points else np.zeros((0, 3))
    except ValueError as error:
        raise InputError(f"cannot be read as PCD: {reason_of(error)}") from None
    if len(rows) < layout.points:
        raise InputError(f"POINTS = {layout.points}: holds {len(rows)}; it is cut short")
    return rows.T


def _unfolded(file: BinaryIO, layout: Layout, columns: list[int], left: int) -> list[np.ndarray]:
    """Unpacks the columns of compressed data, which hold one field of all points after the other."""
    sizes = np.fromfile(file, "<u4", 2)
    folded, size = (int(number) for number in sizes) if len(sizes) == 2 else (0, 0)
    wanted = layout.points * layout.dtype().itemsize
    if folded > left - 8 or size != wanted or size > MOST_EXPANSION * folded:
        raise InputError(
            f"POINTS = {layout.points}: must take the {size} bytes that {folded} compressed ones unfold to, of "
            f"{max(left - 8, 0)} in the file; it is cut short or damaged"
        )
    unfolded = lzf(file.read(folded), size)
    starts = np.cumsum([0, *(layout.points * np.dtype(kind).itemsize * count for _, kind, count in layout.fields)])
    return [np.frombuffer(unfolded, layout.fields[column][1], layout.points, int(starts[column])) for column in columns]


def lzf(folded: bytes, size: int) -> bytearray:
    """Unfolds data that LibLZF compressed to `size` bytes; raises InputError when it comes out otherwise.

    A byte below 32 is followed by one more literal bytes than it says; others give, in the upper three bits, how many
    bytes to copy (7: the next byte adds to it), and in the lower five and the next byte how far back these lie.
    """
    out, at, end = bytearray(), 0, len(folded)
    try:
        while at < end and len(out) <= size:
            control = folded[at]
            at += 1
            if control < 32:
                out += folded[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += folded[at]
                at += 1
            back = ((control & 31) << 8) + folded[at] + 1
            at += 1
            if back > len(out):
                break
            start, length = len(out) - back, length + 2
            piece = out[start : start + length]
            out += (piece * (length // len(piece) + 1))[:length]  # a copy may run into what it writes
    except IndexError:
        pass
    if at != end or len(out) != size:
        raise InputError("cannot be read as PCD: its compressed data is damaged")
    return out
