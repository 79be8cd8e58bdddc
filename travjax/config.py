"""Shared by all configurations: one-line errors, and TOML and JSON files that are checked when they are read.

A configuration is a frozen dataclass of numbers, strings and tuples in SI units and radians. In a TOML file an angle
may be given in degrees, by a key that ends in `_deg`; everything else is named as the field is. A field with the
metadata `items` is a tuple of configurations of that kind, in the file a list of tables, `[[field]]`. One with the
metadata `optional` is left out of JSON while it is None. One with the metadata `formerly` is read by that older name as
well, and a line says so.
"""

import dataclasses
import difflib
import importlib.util
import json
import math
import os
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

Config = TypeVar("Config")

Renamed = dict[str, str]
"""Old keys that were read, and what they are called now."""

LONGEST = 600
"""Most characters of a message, and of a printed name; the middle of a longer one is left out."""

QUOTED = 80
"""Most characters of a value in a message."""

LARGEST = 64 << 20
"""Largest text file that is read, in bytes."""

DEEPEST = 50
"""Deepest nesting of lists and tables in a text file that is read; valid ones have at most four levels."""


class InputError(ValueError):
    """Bad input in one line: which file or argument, which field, which value, and what is allowed."""

    def __init__(self, message: object):
        super().__init__(one_line(message))


def one_line(text: object, most: int = LONGEST) -> str:
    """Returns a text for printing: everything not printable is escaped, and a long text is shortened."""
    whole = str(text)
    plain = whole if whole.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in whole)
    end = most // 3
    return plain if len(plain) <= most else f"{plain[: most - end - 5]} ... {plain[-end:]}"


def shown(value: object) -> str:
    """Returns a value as messages quote it: its repr in one line, shortened if it is long."""
    plain = value.item() if isinstance(value, np.generic) else value
    try:
        text = repr(plain)
    except (ValueError, RecursionError):  # whole numbers of thousands of digits, deeply nested lists
        text = hex(plain) if isinstance(plain, int) else f"a {type(plain).__name__}"
    text = " ".join(text.split())
    return text if len(text) <= QUOTED else f"{text[: QUOTED - 4]} ..."


def require(condition: bool, field: str, value: object, allowed: str) -> None:
    """Raises InputError "field = value: must be allowed" unless the condition holds."""
    if not condition:
        raise InputError(f"{field} = {shown(value)}: must be {allowed}")


def require_number(field: str, value: object, low: float, high: float, allowed: str) -> None:
    """Raises InputError unless `value` is a finite number with low < value <= high."""
    real = isinstance(value, int | float | np.number) and not isinstance(value, bool | np.complexfloating)
    try:
        number = float(value) if real else math.nan  # type: ignore[arg-type]
    except OverflowError:
        number = math.nan
    require(math.isfinite(number) and low < number <= high, field, value, allowed)


def require_length(field: str, value: object, low: float, high: float) -> None:
    """Raises InputError unless `value` is a number of metres from `low` to `high`."""
    require_number(field, value, math.nextafter(low, 0), high, f"a length in metres from {low:g} to {high:g}")


@contextmanager
def naming(what: object) -> Iterator[None]:
    """Adds to an out-of-memory error a note on what was being read or made, which programs print in their one line."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:  # XLA raises the latter
        error.add_note(str(what))
        raise


def load_toml(path: str | Path, kind: type[Config], others: Mapping[str, type] | None = None) -> Config:
    """Reads one configuration dataclass from a TOML file.

    others: configurations of tables in it that are not its own, by name; only their keys are checked
    Raises InputError that names the file when it is missing or not TOML, when a key is unknown or a field without a
    default is absent, and when the dataclass refuses a value.
    """
    path = Path(os.path.expanduser(path))
    table = _parsed(path, read_text(path), tomllib.loads, "a TOML file", finite=False)
    older: Renamed = {}
    try:
        for name, other in (others or {}).items():
            if isinstance(table.get(name), dict):
                _require_keys(name, table.pop(name), other, kind)
        made = _made(table, kind, older)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    say_renamed(path, older)
    return made


def load_table(path: str | Path, name: str, kind: type[Config]) -> Config | None:
    """Reads a configuration dataclass from one table of a TOML file; None where the file has no such table.

    Raises InputError as `load_toml` does.
    """
    path = Path(os.path.expanduser(path))
    table = _parsed(path, read_text(path), tomllib.loads, "a TOML file", finite=False)
    if name not in table:
        return None
    try:
        return _inner(name, table[name], kind, f"[{name}]", f"[{name}]", {})  # type: ignore[return-value]
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def require_installed(module: str, name: str, extra: str) -> None:
    """Raises InputError that says how to install a library that is missing; extra: that of travjax which brings it."""
    if importlib.util.find_spec(module) is None:
        raise InputError(f'{name}: not installed; needed: pip install "travjax[{extra}]"')


def say_renamed(where: object, older: Mapping[str, str]) -> None:
    """Prints a line that begins with `where` if there are old keys; older: what each of them is called now."""
    if older:
        one = len(older) == 1
        old, new = (", ".join(map(repr, names)) for names in (older, older.values()))
        keys, names = (f"key {old} is", "name") if one else (f"keys {old} are", "names")
        print(one_line(f"{where}: {keys} now called {new}; the old {names} will not be read by the next version"))


def read_json(path: Path, allowed: str = "", finite: bool = True) -> Any:
    """Reads a JSON file that travjax wrote; raises InputError that names the file, like `read_text`."""
    return parse_json(read_text(path, allowed), path, finite)


def parse_json(text: str, where: object, finite: bool = True) -> Any:
    """Returns what a JSON text holds.

    Raises InputError that begins with `where` when it is not JSON, is nested too deep, or holds a whole number beyond
    64 bits or, with `finite`, a number that is not finite.
    """
    return _parsed(where, text, json.loads, "JSON", finite)


def read_text(path: Path, allowed: str = "") -> str:
    """Reads a text file.

    Raises InputError that names the file when it is too large, not UTF-8, or missing; then it says what is allowed.
    """
    data = bytearray()
    try:
        with path.open("rb") as file:
            while len(data) <= LARGEST and (piece := file.read(1 << 20)):
                data += piece
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL byte
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read: {reason}{allowed and f'; allowed: {allowed}'}") from None
    if len(data) > LARGEST:
        raise InputError(f"{path}: cannot be read: must be a text of at most {LARGEST >> 20} MiB")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: cannot be read: byte {error.start} is not UTF-8") from None


def _parsed(where: object, text: str, parse: Callable[[str], Any], kind: str, finite: bool) -> Any:
    """Parses a text and checks that it holds nothing that no valid file holds."""
    try:
        found = parse(text)
    except RecursionError:
        raise InputError(f"{where}: lists and tables: must be nested {DEEPEST} deep at most") from None
    except Exception as error:  # the parser's errors, and Python's for numbers of thousands of digits
        if number := re.search(r"\d[\d_]{999,}", text):
            line, digits = text.count("\n", 0, number.start()) + 1, f"{number[0][:20]} ..."
            raise InputError(f"{where}: line {line}: {digits}: must be a number of fewer digits") from None
        raise InputError(f"{where}: not {kind}: {error}") from None
    try:
        _require_plain(found, finite)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    return found


def _require_plain(found: object, finite: bool) -> None:
    """Raises InputError for whole numbers beyond 64 bits, deep nesting and, with `finite`, numbers that are not."""
    level: list[tuple[str, object]] = [("", found)]
    for _ in range(DEEPEST):
        inner: list[tuple[str, object]] = []
        for name, value in level:
            if isinstance(value, dict):
                inner += [(f"{name}.{key}" if name else key, item) for key, item in value.items()]
            elif isinstance(value, list):
                inner += [(f"{name}[{index}]", item) for index, item in enumerate(value)]
            elif type(value) is int:
                require(-(2**63) <= value < 2**64, name, value, "a whole number of 64 bits")
            elif finite and isinstance(value, float):
                require(math.isfinite(value), name, value, "a finite number")
        if not inner:
            return
        level = inner
    require(False, level[0][0].partition("[")[0], "...", f"nested {DEEPEST} deep at most")


def to_json(config: object) -> dict[str, Any]:
    """Converts a configuration dataclass to what JSON can hold: tuples become lists, with "inf" for infinity
    in them.
    """

    def plain(value):
        if dataclasses.is_dataclass(value):
            return to_json(value)
        if isinstance(value, tuple):
            items = [plain(item) for item in value]
            return [str(item) if item in (math.inf, -math.inf) else item for item in items]
        return value.item() if isinstance(value, np.generic) else value

    values = {field: getattr(config, field.name) for field in dataclasses.fields(config)}  # type: ignore[arg-type]
    left_out = [field for field, value in values.items() if value is None and "optional" in field.metadata]
    return {field.name: plain(value) for field, value in values.items() if field not in left_out}


def from_json(table: Any, kind: type[Config], where: object = "saved settings") -> Config:
    """Restores the configuration that `to_json` was given, and prints which keys are old; where: the file.

    Raises InputError for unknown or missing keys and bad values.
    """
    older: Renamed = {}
    made = _restored(table, kind, older)
    say_renamed(where, older)
    return made


def _restored(table: Any, kind: type[Config], older: Renamed) -> Config:
    require(isinstance(table, dict), kind.__name__, table, "a table")
    infinite = {"inf": math.inf, "-inf": -math.inf}
    number = lambda item: infinite.get(item, item) if isinstance(item, str) else item
    lists = {key: [number(item) for item in value] for key, value in table.items() if type(value) is list}
    return kind(**_fields_from(table | lists, kind, older))  # tables within a table hold no infinite numbers


def parts_from_json(table: Any, kinds: Mapping[str, type], where: object = "saved settings") -> dict[str, Any]:
    """Returns the configurations that a table has under names, and prints which keys are old; where: the file.

    Raises InputError that says what is missing or wrong.
    """
    missing = [name for name in kinds if not isinstance(table, dict) or name not in table]
    if missing:
        raise InputError(f"missing {', '.join(missing)}")
    older: Renamed = {}
    parts: dict[str, Any] = {name: _restored(table[name], kind, older) for name, kind in kinds.items()}
    say_renamed(where, older)
    return parts


def _made(table: dict, kind: type[Config], older: Renamed) -> Config:
    """Makes the configuration of a table; errors name and show an angle that was given in degrees as it was given."""
    try:
        return kind(**_fields_from(table, kind, older))
    except InputError as error:
        message = str(error)
        for key, value in table.items():
            field, _, allowed = message.partition(": must be ")
            if allowed and key.endswith("_deg") and field.startswith(f"{key.removesuffix('_deg')} = "):
                message = f"{key} = {shown(value)}: must be {allowed}"
        raise InputError(message) from None


def _fields_from(table: dict, kind: type, older: Renamed) -> dict:
    """Returns the values of a table by field; `older` takes in its old keys."""
    names = {field.name: field for field in dataclasses.fields(kind)}
    former = {field.metadata["formerly"]: name for name, field in names.items() if "formerly" in field.metadata}
    values = {}
    for key, value in table.items():
        name = key.removesuffix("_deg")
        degrees = key != name
        if name in former and name not in names:
            name = former[name]
            older[key] = f"{name}_deg" if degrees else name
            require(older[key] not in table, key, value, f"left out beside {older[key]}, its name now")
        if name not in names or degrees and not names[name].metadata.get("angle"):
            raise InputError(_unknown(key, kind))
        if name in values:
            raise InputError(f"{key} = {shown(value)}: is given twice, once in degrees; allowed: once")
        if degrees:
            require_number(key, value, -math.inf, math.inf, "a number of degrees")
            value = math.radians(value)
        if dataclasses.is_dataclass(names[name].default):
            value = _inner(key, value, type(names[name].default), f"[{key}]", f"[{key}]", older)
        elif "items" in names[name].metadata:
            inner, written = names[name].metadata["items"], f"[[{key}]]"
            require(isinstance(value, list), key, value, f"a list of tables {written}")
            numbered = enumerate(value, 1)
            value = [_inner(key, item, inner, written, f"{key} {number}:", older) for number, item in numbered]
        values[name] = tuple(value) if isinstance(value, list) else value
    missing = [n for n, f in names.items() if n not in values and f.default is dataclasses.MISSING]
    if missing:
        raise InputError(f"missing {', '.join(missing)}")
    return values


def _require_keys(name: str, keys: Iterable[str], kind: type, around: type) -> None:
    """Raises InputError for a key of the table `name` that `kind` lacks; around: of the keys above the table."""
    for key in keys:
        if key not in _written(kind):
            above = f"; {key} belongs above [{name}]" if key in _written(around) else ""
            raise InputError(f"[{name}] {_unknown(key, kind, above)}")


def _written(kind: type) -> list[str]:
    """Returns the keys of a configuration as they are written: those of angles also in degrees."""
    ends = lambda field: ("", "_deg") if field.metadata.get("angle") else ("",)
    return [field.name + end for field in dataclasses.fields(kind) for end in ends(field)]


def _unknown(key: str, kind: type, meant: str = "") -> str:
    """Says what is wrong with a key that is no field: all that are allowed, and, unless given, which may be meant."""
    allowed = _written(kind)
    if not meant and (near := difflib.get_close_matches(key, allowed, n=1)):
        meant = f"; perhaps {near[0]} is meant"
    return f"unknown key {shown(key)}; allowed: {', '.join(allowed)}{meant}"


def _inner(key: str, table: object, kind: type, written: str, place: str, older: Renamed) -> object:
    """Makes the configuration of a table within a table; `place` names it in errors."""
    require(isinstance(table, dict), key, table, f"a table {written}")
    try:
        return _made(table, kind, older)  # type: ignore[arg-type]
    except InputError as error:
        raise InputError(f"{place} {error}") from None
