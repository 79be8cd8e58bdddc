"""What every configuration shares: one-line errors and checked TOML files.

A configuration is a frozen dataclass of numbers, strings and tuples in SI units and radians. In a TOML file a key that
ends in `_deg` holds degrees; everything else is named as the field is.
"""

import dataclasses
import math
import textwrap
import tomllib
from numbers import Real
from pathlib import Path
from typing import TypeVar, cast

Config = TypeVar("Config")


class InputError(ValueError):
    """Bad input in one line: which file or argument, which field, which value, and what is allowed."""


def require(condition: bool, field: str, value: object, allowed: str) -> None:
    """Raises InputError "field = value: must be allowed" unless the condition holds."""
    if not condition:
        shown = textwrap.shorten(repr(value), 80, placeholder=" ...")
        raise InputError(f"{field} = {shown}: must be {allowed}")


def require_number(field: str, value: object, low: float, high: float, allowed: str) -> None:
    """Raises InputError unless `value` is a finite number with low < value <= high."""
    number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    require(number and low < float(cast(float, value)) <= high, field, value, allowed)


def load_toml(path: str | Path, kind: type[Config]) -> Config:
    """Reads one configuration dataclass from a TOML file.

    Raises InputError that names the file when it is missing or not TOML, when a key is unknown or a field without a
    default is absent, and when the dataclass refuses a value.
    """
    path = Path(path)
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


def _fields_from(table: dict, kind: type) -> dict:
    names = {field.name: field for field in dataclasses.fields(kind)}
    values = {}
    for key, value in table.items():
        name = key.removesuffix("_deg")
        if name not in names:
            raise InputError(f"unknown key {key!r}; allowed: {', '.join(names)}")
        if key != name:
            require_number(key, value, -math.inf, math.inf, "a number of degrees")
            value = math.radians(value)
        values[name] = tuple(value) if isinstance(value, list) else value
    missing = [n for n, f in names.items() if n not in values and f.default is dataclasses.MISSING]
    if missing:
        raise InputError(f"missing {', '.join(missing)}")
    return values
