"""Points in a text: columns that a header names, else x, y, z, in whatever spelling (SPEC section 11).

Semicolons, commas, tabs or blanks part the columns; decimals have points or commas. Before the numbers may stand a
header, the number of points, and lines that begin with # or //.
"""

import itertools
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np

from travjax.config import InputError
from travjax.point_clouds.points import Points, reason_of, whole_classes
from travjax.rasters.coordinates import METRE_NAMES, UNIT_METRES, require_height_unit_named
from travjax.rasters.reading_options import DemOptions

NAMES = {
    "x": ("x", "easting", "east", "e", "ostwert", "rechtswert"),
    "y": ("y", "northing", "north", "n", "nordwert", "hochwert"),
    "z": ("z", "elevation", "height", "altitude", "elev", "alt", "h", "up", "u", "höhe", "hoehe"),
    "classes": ("classification", "class"),
}
"""Words that name a column, the surest first."""

OTHERS = {"normal", "sigma", "std", "stdev", "error", "accuracy", "precision", "velocity", "scanner", "origin", "index"}
"""Words of a column that is no coordinate although it names an axis."""

DEGREES = {"lat", "latitude", "lon", "long", "longitude", "lng", "deg", "degree", "degrees", "°"}

MATRIX_COLUMNS = 16
"""More numbers in a line, without a header, are no point."""

LONGEST_LINE = 2**20
"""Characters: what is longer is no line of a point."""

MATRIX = "; a matrix of heights is given as .npy with --cell-size"

MARKS = {b"\xff\xfe\0\0": "utf-32", b"\0\0\xfe\xff": "utf-32", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
"""Bytes that a text in other than UTF-8 begins with."""

COMMENT = ("#", "//", "%", "!")
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([ed][+-]?\d+)?", re.IGNORECASE)


class Beginning(NamedTuple):
    """What a text says before its points: lines to skip, number of points or None, names of columns, first line."""

    skipped: int
    stated: int | None
    header: str
    first: str


def read_text(path: Path, options: DemOptions) -> Points:
    """Reads points from a text; raises InputError when it is none, is a matrix, or names no axes or other units."""
    encoding = _encoding(path)
    with path.open(encoding=encoding, errors="replace") as file:
        beginning = _beginning(file)
    separator = _separator(beginning.first)
    across = _width(beginning.first, separator)
    if not beginning.header and across > MATRIX_COLUMNS:
        raise InputError(
            f"columns = {across}: is a matrix of heights, or has many columns and no header that names x, y, z{MATRIX}"
        )
    columns, named = {"x": 0, "y": 1, "z": 2}, 0
    if beginning.header:
        names = _names(beginning.header, across)
        columns, named = _columns(names, across, options), len(names)
        if "classes" in columns and not _is_number(beginning.first.split(separator)[columns["classes"]]):
            del columns["classes"]
    try:
        with path.open(encoding=encoding, errors="replace") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of NumPy, where no line follows
            lines = _lines(itertools.islice(file, beginning.skipped, None), separator)
            used = list(columns.values())
            table = np.loadtxt(lines, delimiter=separator, usecols=used, ndmin=2, quotechar='"', comments=None)
    except ValueError as error:
        raise InputError(
            f"cannot be read as a table of x, y, z: {reason_of(error)} (rows count from 0){MATRIX}"
        ) from None
    if beginning.stated is not None and len(table) != beginning.stated:
        raise InputError(f"points = {len(table)}: must be {beginning.stated}, as its first line says; it is cut short")
    if across > max(3, named) and len(table) > 9 and (np.diff(table[:, 0]) == 1).all():
        raise InputError("columns: the first counts the points: must be named by a header, as in: id x y z")
    found = dict(zip(columns, table.T, strict=True))
    return Points(found["x"], found["y"], found["z"], classes=whole_classes(found.get("classes")))


def _encoding(path: Path) -> str:
    with path.open("rb") as file:
        start = file.read(512)
    for mark, encoding in MARKS.items():
        if start.startswith(mark):
            return encoding
    if start and b"\0" in start:  # UTF-16 without a mark: digits and blanks have a zero before or after them
        even, odd = (start[first::2].count(0) for first in (0, 1))
        if max(even, odd) > 0.4 * len(start) / 2 and not min(even, odd):
            return "utf-16-be" if even else "utf-16-le"
        raise InputError("cannot be read as text: it holds bytes that are no characters")
    return "utf-8-sig"


def _beginning(file: TextIO) -> Beginning:
    stated, header = None, ""
    for number in itertools.count():
        line = file.readline(LONGEST_LINE)
        if not line:
            raise InputError("cannot be read as text: no line of it holds three numbers")
        if len(line) == LONGEST_LINE:
            raise InputError(f"cannot be read as text: a line has more than {LONGEST_LINE} characters{MATRIX}")
        text = line.strip()
        comment = text.startswith(COMMENT)
        fields = _fields(text)
        if comment:
            header = text if _is_header(fields) else header
        elif len(fields) == 1 and fields[0].isdecimal():
            stated = int(fields[0][:30])
        elif sum(_is_number(field.strip(' "')) for field in text.split(_separator(text))) >= 3:
            return Beginning(number, stated, header, text)
        elif text:
            header = _with_units_below(header, fields) or text
    raise AssertionError


def _lines(file: Iterator[str], separator: str | None) -> Iterator[str]:
    """Yields lines of numbers as NumPy reads them: without comments, Fortran exponents and decimal commas."""
    for line in file:
        if line.startswith(COMMENT):
            continue
        for mark in COMMENT:
            if mark in line:
                line = line.partition(mark)[0]
        line = line.replace("D", "e").replace("d", "e")
        if separator != ",":
            line = line.replace(",", ".")
        elif '"' in line:
            line = re.sub('"[^"]*"', lambda quoted: quoted[0].replace(",", "."), line)
        if not line.isspace():
            yield line


def _separator(line: str) -> str | None:
    """Returns what separates the columns of a line: a semicolon, a comma that is not decimal, else blanks (None)."""
    if ";" in line:
        return ";"
    if "," not in line:
        return None
    fields = line.split()
    decimal = len(fields) > 2 and all("," not in field or DECIMAL_COMMA.fullmatch(field) for field in fields)
    return None if decimal else ","


def _width(line: str, separator: str | None) -> int:
    """Counts the columns of a line of numbers, without empty ones after the last separator."""
    return len(line.rstrip(f'{separator or ""} \t"').split(separator))


def _fields(line: str) -> list[str]:
    """Splits a line into lower-case columns without quotes; tabs separate names that hold blanks."""
    line = line.strip().lstrip("#/%!").strip().lower()
    separator = _separator(line) or ("\t" if "\t" in line else None)
    if separator is None and '"' in line:
        return [field.strip('" ') for field in re.findall(r'"[^"]*"|\S+', line)]
    fields = [field.strip(" \t\"'") for field in line.split(separator)]
    return (fields if separator else _with_units(fields)) or [""]


def _names(header: str, columns: int) -> list[str]:
    """Returns the names in a header, one a column; names with blanks have equally many words each."""
    fields = _fields(header)
    while len(fields) > columns and not fields[-1]:
        fields.pop()
    words, rest = divmod(len(fields), columns)
    if words > 1 and not rest:
        fields = [" ".join(fields[words * column : words * (column + 1)]) for column in range(columns)]
    return fields


def _with_units_below(header: str, fields: list[str]) -> str:
    """Joins the names of a header with the units in the line below it; returns "" if that line holds no units."""
    names = _fields(header)
    units = len(fields) == len(names) and all(_unit(f"z [{field}]") or field in DEGREES for field in fields)
    pairs = zip(names, fields, strict=False)
    return ";".join(f"{name} [{unit}]" for name, unit in pairs) if units and _is_header(names) else ""


def _with_units(fields: list[str]) -> list[str]:
    """Joins a unit in brackets, as in "x [m]", with the name before it."""
    joined: list[str] = []
    for field in fields:
        if joined and field[:1] in ("[", "("):
            joined[-1] += f" {field}"
        else:
            joined.append(field)
    return joined


def _is_number(field: str) -> bool:
    try:
        float(field.lower().replace(",", ".").replace("d", "e"))
    except ValueError:
        return False
    return True


def _words(field: str) -> list[str]:
    return [word for word in re.split(r"[\s_\-.:\[\](){}/]+", field) if word]


def _is_header(fields: list[str]) -> bool:
    """Tells whether words name the axes, or degrees: a comment with such words is a header."""
    words = [set(_words(field)) for field in fields]
    named = [any(set(NAMES[axis]) & one for one in words) for axis in "xyz"]
    return len(fields) >= 3 and (all(named) or (named[2] and any(one & DEGREES for one in words)))


def _columns(fields: list[str], columns: int, options: DemOptions) -> dict[str, int]:
    """Returns the columns of x, y, z and, if there is one, of the classes."""
    found = {axis: _column(fields, axis) for axis in NAMES}
    degrees = [field for field in fields if set(_words(field)) & DEGREES]
    if degrees and any(found[axis] is None or fields[found[axis]] in degrees for axis in "xy"):  # type: ignore[index]
        raise InputError(f"column {degrees[0]!r}: is in degrees; reproject it to metres (a UTM zone, say) first")
    if None in (found["x"], found["y"], found["z"]):
        shown = ",".join(fields)
        raise InputError(
            f"header = {shown[:60]!r}: must name x, y, z (or easting, northing, elevation), or be left out"
        )
    first = {found["x"], found["y"], found["z"]} == {0, 1, 2}
    if len(fields) != columns and (not first or columns == len(fields) + 1):  # one more may be the names of rows
        raise InputError(f"header: names {len(fields)} columns, the first row has {columns}: must name each")
    for axis in "xyz":
        field = fields[found[axis]]  # type: ignore[index]
        unit = _unit(field)
        if axis == "z":
            require_height_unit_named(f"column {field!r}", unit, options.height_scale is not None)
        elif unit and not METRE_NAMES.match(unit):
            raise InputError(f"column {field!r}: is in {unit}; must be in metres: convert it first")
    return {axis: column for axis, column in found.items() if column is not None}


def _column(fields: list[str], axis: str) -> int | None:
    """Returns the column named by exactly the best word, else the only column whose name contains such a word."""
    bare = [re.sub(r"[\[(].*", "", field).strip() for field in fields]
    for name in NAMES[axis]:
        if bare.count(name) == 1:
            return bare.index(name)
    words = [_words(field) for field in fields]
    for name in NAMES[axis]:
        named = [index for index, one in enumerate(words) if name in one and not OTHERS & set(one)]
        if len(named) > 1 and axis != "classes":
            columns = " and ".join(repr(fields[index]) for index in named[:3])
            raise InputError(f"columns {columns}: all name {axis}: must be one")
        if named:
            return named[0]
    return None


def _unit(field: str) -> str | None:
    """Returns the unit that a name carries in brackets or as its last word, or None."""
    bracketed = re.search(r"[\[(]([^\])]*)", field)
    candidates = [bracketed[1].strip()] if bracketed else []
    candidates += _words(field)[1:][-1:]
    for unit in candidates:
        if METRE_NAMES.match(unit) or any(re.fullmatch(pattern, unit, re.IGNORECASE) for pattern in UNIT_METRES):
            return unit
    return None
