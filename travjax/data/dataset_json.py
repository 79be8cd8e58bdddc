"""Reads dataset.json, which describes the arrays in a data set's folder, with the size and SHA-256 of their files."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from travjax.config import InputError, read_json, require, shown

FORMAT, FORMAT_VERSION = "travjax data set", 1


def read_table(path: Path) -> dict[str, Any]:
    """Reads dataset.json, and returns it without its checksum.

    Raises InputError, which names the file, when it is missing, something else, of another version, or altered.
    """
    table = read_json(path)
    if not isinstance(table, dict) or table.get("format") != FORMAT:
        raise InputError(f"{path}: not the description of a {FORMAT}")
    if table.get("version") != FORMAT_VERSION:
        raise InputError(
            f"{path}: format version {shown(table.get('version'))}: must be {FORMAT_VERSION}; make it again"
        )
    if table.pop("sha256", None) != digest(table):
        raise InputError(f"{path}: has been altered: its checksum differs")
    return table


def files_of(table: dict[str, Any], names: Sequence[str], path: Path) -> dict[str, tuple[int, str]]:
    """Returns the size and checksum that dataset.json gives for the file of each of these arrays.

    Raises InputError, which names file and entry, when an entry is missing, unusable, or not of one of these arrays.
    """
    told, expected = table.get("files"), [f"{name}.npy" for name in names]
    files = told if isinstance(told, dict) else {}
    require(files.keys() == set(expected), f"{path}: files", told, f"a table of {', '.join(expected)}")
    for name, file in files.items():
        both = isinstance(file, dict) and type(file.get("bytes")) is int and isinstance(file.get("sha256"), str)
        require(both, f"{path}: files.{name}", file, "a table with bytes and sha256")
    return {name: (file["bytes"], file["sha256"]) for name, file in files.items()}


def digest(table: dict[str, Any]) -> str:
    """Returns the checksum of all other entries of dataset.json."""
    return hashlib.sha256(json.dumps(table, sort_keys=True, allow_nan=False).encode()).hexdigest()
