"""Points of a PLY file: its vertices, whatever else it holds (SPEC section 11)."""

import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from travjax.config import InputError
from travjax.point_clouds.points import Points, listed, printable, reason_of, whole_classes

TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
BYTE_ORDER_MARK = b"\xef\xbb\xbf"

LONGEST_HEADER = 2**20
"""Bytes."""

COLUMNS = {"x": ("x",), "y": ("y",), "z": ("z",), "classes": ("classification", "scalar_classification")}
"""Names of the properties that are read, in lower case."""


@dataclass
class Element:
    """One kind of things in a PLY file: how many, and (name, type, type of a list's length or "") of its properties."""

    name: str
    count: int
    properties: list[tuple[str, str, str]] = field(default_factory=list)

    def lists(self) -> list[int]:
        """Returns the numbers of the properties that are lists."""
        return [number for number, (_, _, length) in enumerate(self.properties) if length]

    def dtype(self, order: str, lengths: dict[int, int]) -> np.dtype:
        """Returns the type of one in binary: property number k is field pk, the length of a list nk."""
        fields: list = []
        for number, (_, kind, length) in enumerate(self.properties):
            if length:
                fields.append((f"n{number}", order + length))
            fields.append((f"p{number}", order + kind, (lengths[number],) if length else ()))
        return np.dtype(fields)

    def least(self, order: str) -> int:
        """Returns the bytes that one takes at least; in text a digit and a blank for each value."""
        return self.dtype(order, dict.fromkeys(self.lists(), 0)).itemsize if order else 2 * len(self.properties)


def read_ply(path: Path) -> Points:
    """Reads the vertices of a PLY file, in text or binary; faces are passed over.

    Raises InputError when it is no PLY file, and when it holds no vertices or fewer than it says.
    """
    with path.open("rb") as file:
        order, elements = _header(file)
        names = [element.name for element in elements]
        if "vertex" not in names:
            raise InputError(f"no element `vertex`; it holds: {listed(names)}")
        vertex = elements[names.index("vertex")]
        columns = _wanted(vertex)
        _pass_mark(file, order, elements, path.stat().st_size)
        _require_room(elements, order, path.stat().st_size - file.tell())
        for element in elements[: names.index("vertex")]:
            _pass_over(file, order, element)
        values = _values(file, order, vertex, columns)
    faces = sum(element.count for element in elements if element.name == "face")
    notes = (
        (f"{faces} faces are passed over: its vertices are taken as points (of .obj, .stl and .glb the surface)",)
        if faces
        else ()
    )
    return Points(values["x"], values["y"], values["z"], classes=whole_classes(values.get("classes")), notes=notes)


def _header(file: BinaryIO) -> tuple[str, list[Element]]:
    """Reads (byte order, "" for text; elements) from the header, and leaves the file at its end."""
    order: str | None = None
    elements: list[Element] = []
    for number in itertools.count():
        line = file.readline(LONGEST_HEADER)
        if number == 0:
            line = line.removeprefix(BYTE_ORDER_MARK)
        words = line.decode("utf-8", "replace").split()  # comments may hold whatever they like
        match words:
            case _ if number == 0:
                if words != ["ply"]:
                    raise InputError("cannot be read as PLY: its first line must be `ply`")
            case ["end_header"]:
                break
            case [("comment" | "obj_info"), *_]:
                pass
            case ["format", name, *_] if name in ORDERS:
                order = ORDERS[name]
            case ["element", *name, count] if name and count.isdecimal() and len(count) < 30:
                elements.append(Element(" ".join(name), int(count)))
            case ["property", "list", length, kind, *name] if elements and {length, kind} <= set(TYPES):
                elements[-1].properties.append((" ".join(name).lower(), TYPES[kind], TYPES[length]))
            case ["property", kind, *name] if elements and kind in TYPES:
                elements[-1].properties.append((" ".join(name).lower(), TYPES[kind], ""))
            case _ if words or not line or file.tell() > LONGEST_HEADER:
                shown = " ".join(words)[:60]
                raise InputError(
                    f"cannot be read as PLY: line {number + 1} of its header: {shown!r}: must be one of PLY"
                )
    if order is None:
        raise InputError(f"cannot be read as PLY: format: must be one of {', '.join(ORDERS)}")
    return order, elements


def _wanted(vertex: Element) -> dict[str, int]:
    """Returns the numbers of the properties that are coordinates and, if there are any, classes."""
    names = [name if not length else "" for name, _, length in vertex.properties]
    found = {axis: names.index(name) for axis, known in COLUMNS.items() for name in known if name in names}
    if not {"x", "y", "z"} <= set(found):
        raise InputError(f"vertex: must have numbers x, y, z; it has: {listed(names)}")
    return found


def _pass_mark(file: BinaryIO, order: str, elements: list[Element], size: int) -> None:
    """Passes over a byte-order mark behind the header, which some programs that write text leave there."""
    start = file.tell()
    if file.read(3) != BYTE_ORDER_MARK:
        file.seek(start)
    elif order:
        expected = sum(element.count * element.least(order) for element in elements)
        lists = any(element.lists() for element in elements)
        if lists or size - start != expected + 3:
            file.seek(start)


def _require_room(elements: list[Element], order: str, size: int) -> None:
    """Raises InputError when the elements cannot lie in so many bytes."""
    needed = sum(element.count * element.least(order) for element in elements)
    if needed > size + 1:  # the last line of a text may lack its end
        counts = ", ".join(f"{element.name} {element.count}" for element in elements)
        raise InputError(f"elements = {printable(counts[:80])}: must fit into {size} bytes; it is cut short")


def _pass_over(file: BinaryIO, order: str, element: Element) -> None:
    if not order:
        for _ in range(element.count):
            if not file.readline():
                raise InputError(f"cannot be read as PLY: {printable(element.name[:40])}: it is cut short")
        return
    start = file.tell()
    if not element.properties or _table(file, order, element) is not None:
        return
    file.seek(start)
    for _ in range(element.count):  # lists of different lengths: slower
        for _, kind, length in element.properties:
            number = int(_read(file, np.dtype(order + length), 1, element.name)[0]) if length else 1
            file.seek(max(0, number) * np.dtype(kind).itemsize, 1)


def _table(file: BinaryIO, order: str, element: Element) -> np.ndarray | None:
    """Reads a whole binary element; None where its lists differ in length, and the file position is then undefined."""
    lengths: dict[int, int] = {}
    if element.lists() and element.count:
        start = file.tell()
        for number in range(len(element.properties)):
            _, kind, length = element.properties[number]
            if length:
                lengths[number] = max(0, int(_read(file, np.dtype(order + length), 1, element.name)[0]))
            file.seek(lengths.get(number, 1) * np.dtype(kind).itemsize, 1)
        size = file.tell() - start
        file.seek(start)
        if size * element.count > _left(file):
            return None
    dtype = element.dtype(order, lengths or dict.fromkeys(element.lists(), 0))
    table = _read(file, dtype, element.count, element.name)
    return table if all((table[f"n{number}"] == length).all() for number, length in lengths.items()) else None


def _read(file: BinaryIO, dtype: np.dtype, count: int, name: str) -> np.ndarray:
    table = np.fromfile(file, dtype, count)
    if len(table) < count:
        raise InputError(f"cannot be read as PLY: {printable(name[:40])}: it is cut short")
    return table


def _left(file: BinaryIO) -> int:
    here = file.tell()
    size = file.seek(0, 2)
    file.seek(here)
    return size - here


def _values(file: BinaryIO, order: str, vertex: Element, columns: dict[str, int]) -> dict[str, np.ndarray]:
    """Reads the columns of the vertices; those of a text in double precision, whatever type it states."""
    if order:
        table = _table(file, order, vertex)
        if table is None:
            raise InputError("vertex: has lists of different lengths: must have numbers x, y, z alone")
        return {axis: np.ascontiguousarray(table[f"p{number}"]) for axis, number in columns.items()}
    if any(number < max(columns.values()) for number in vertex.lists()):
        raise InputError("vertex: has a list before x, y, z: must have it behind them")
    lines = itertools.islice((line.decode("ascii", "replace") for line in file if not line.isspace()), vertex.count)
    try:
        rows = np.zeros((0, len(columns)))
        if vertex.count:
            rows = np.loadtxt(lines, usecols=list(columns.values()), ndmin=2, comments=None)
    except ValueError as error:
        raise InputError(f"cannot be read as PLY: vertex: {reason_of(error)}") from None
    if len(rows) < vertex.count:
        raise InputError(f"cannot be read as PLY: vertex = {len(rows)}: must be {vertex.count}; it is cut short")
    return dict(zip(columns, rows.T, strict=True))
