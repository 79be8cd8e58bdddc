"""What every configuration shares: one-line errors and checked TOML files.

A configuration is a frozen dataclass of numbers, strings and tuples in SI units and radians. In a TOML file an angle
may be given in degrees, by a key that ends in `_deg`; everything else is named as the field is. A field with the
metadata `items` is a tuple of configurations of that kind, in the file a list of tables, `[[field]]`.
"""

import dataclasses
import math
import os
import textwrap
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

Config = TypeVar("Config")


class InputError(ValueError):
    """Bad input in one line: which file or argument, which field, which value, and what is allowed."""


def require(condition: bool, field: str, value: object, allowed: str) -> None:
    """Raises InputError "field = value: must be allowed" unless the condition holds."""
    if not condition:
        plain = value.item() if isinstance(value, np.generic) else value
        shown = textwrap.shorten(repr(plain), 80, placeholder=" ...")
        raise InputError(f"{field} = {shown}: must be {allowed}")


def require_number(field: str, value: object, low: float, high: float, allowed: str) -> None:
    """Raises InputError unless `value` is a finite number with low < value <= high."""
    real = isinstance(value, int | float | np.number) and not isinstance(value, bool | np.complexfloating)
    try:
        number = float(value) if real else math.nan  # type: ignore[arg-type]
    except OverflowError:
        number = math.nan
    require(math.isfinite(number) and low < number <= high, field, value, allowed)


@contextmanager
def naming(what: object) -> Iterator[None]:
    """Notes on an error for lack of memory what was being read or made; programs say it in their one line."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:  # the latter XLA's
        error.add_note(str(what))
        raise


def load_toml(path: str | Path, kind: type[Config]) -> Config:
    """Reads one configuration dataclass from a TOML file.

    Raises InputError that names the file when it is missing or not TOML, when a key is unknown or a field without a
    default is absent, and when the dataclass refuses a value.
    """
    path = Path(os.path.expanduser(path))
    try:
        with path.open("rb") as file:
            table = tomllib.load(file)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not a TOML file: {error}") from None
    try:
        return kind(**_fields_from(table, kind))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def to_json(config: object) -> dict[str, Any]:
    """A configuration dataclass as JSON can hold it: tuples are lists, and an infinite number in one is "inf"."""

    def plain(value):
        if dataclasses.is_dataclass(value):
            return to_json(value)
        if isinstance(value, tuple):
            items = [plain(item) for item in value]
            return [str(item) if item in (math.inf, -math.inf) else item for item in items]
        return value.item() if isinstance(value, np.generic) else value

    return {field.name: plain(getattr(config, field.name)) for field in dataclasses.fields(config)}  # type: ignore[arg-type]


def from_json(table: dict[str, Any], kind: type[Config]) -> Config:
    """The configuration that `to_json` was given; raises InputError for unknown or missing keys and refused values."""
    infinite = {"inf": math.inf, "-inf": -math.inf}
    number = lambda item: infinite.get(item, item) if isinstance(item, str) else item
    lists = {key: [number(item) for item in value] for key, value in table.items() if type(value) is list}
    return kind(**_fields_from(table | lists, kind))  # tables within a table hold no infinite numbers


def _fields_from(table: dict, kind: type) -> dict:
    names = {field.name: field for field in dataclasses.fields(kind)}
    values = {}
    for key, value in table.items():
        name = key.removesuffix("_deg")
        degrees = key != name
        if name not in names or degrees and not names[name].metadata.get("angle"):
            raise InputError(f"unknown key {key!r}; allowed: {', '.join(names)}")
        if name in values:
            raise InputError(f"{key} = {value!r}: is given twice, once in degrees; allowed: once")
        if degrees:
            require_number(key, value, -math.inf, math.inf, "a number of degrees")
            value = math.radians(value)
        if dataclasses.is_dataclass(names[name].default):
            value = _inner(key, value, type(names[name].default), f"[{key}]", f"[{key}]")
        elif "items" in names[name].metadata:
            inner, written = names[name].metadata["items"], f"[[{key}]]"
            require(isinstance(value, list), key, value, f"a list of tables {written}")
            value = [_inner(key, item, inner, written, f"{key} {number}:") for number, item in enumerate(value, 1)]
        values[name] = tuple(value) if isinstance(value, list) else value
    missing = [n for n, f in names.items() if n not in values and f.default is dataclasses.MISSING]
    if missing:
        raise InputError(f"missing {', '.join(missing)}")
    return values


def _inner(key: str, table: object, kind: type, written: str, place: str) -> object:
    """The configuration of a table within a table; `place` names it in errors."""
    require(isinstance(table, dict), key, table, f"a table {written}")
    try:
        return kind(**_fields_from(table, kind))  # type: ignore[arg-type]
    except InputError as error:
        raise InputError(f"{place} {error}") from None
