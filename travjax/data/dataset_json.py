"""dataset.json, which says what the arrays in a data set's folder are, and the size and SHA-256 of their files."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from travjax.config import InputError, read_json, require, shown

FORMAT, FORMAT_VERSION = "travjax data set", 1


def read_table(path: Path) -> dict[str, Any]:
    """Reads dataset.json, without its checksum.

    Raises InputError that names it when it is missing, something else, of another version, or altered.
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
    """Returns size and checksum of the file of each array of these names, as dataset.json has them.

    Raises InputError that names the file and the entry when one is missing, of no use, or of something else.
    """
    told, expected = table.get("files"), [f"{name}.npy" for name in names]
    files = told if isinstance(told, dict) else {}
    require(files.keys() == set(expected), f"{path}: files", told, f"a table of {', '.join(expected)}")
    for name, file in files.items():
        both = isinstance(file, dict) and type(file.get("bytes")) is int and isinstance(file.get("sha256"), str)
        require(both, f"{path}: files.{name}", file, "a table with bytes and sha256")
    return {name: (file["bytes"], file["sha256"]) for name, file in files.items()}


def digest(table: dict[str, Any]) -> str:
    """Returns the checksum of all that dataset.json holds beside it."""
    return hashlib.sha256(json.dumps(table, sort_keys=True, allow_nan=False).encode()).hexdigest()
