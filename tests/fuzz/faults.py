"""Readers that go wrong over a damaged file, each in its own way: what the campaign has to catch."""

import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path

from travjax.config import InputError

from .worker import Format, Invalid

WHOLE = b"a valid file " * 20


def _format(over_damage: Callable[[Path], object]) -> Format:
    def read(folder: Path) -> None:
        if (folder / "it").read_bytes() != WHOLE:
            over_damage(folder / "it")

    return Format(lambda folder: (folder / "it").write_bytes(WHOLE), read)


class _TwoLines(InputError):
    """What InputError itself does not let happen."""

    def __str__(self) -> str:
        return f"{self.args[0]}: one\ntwo"


def _raise(error: Exception) -> None:
    raise error


FAULTS = {
    "raises": lambda path: {}["a key"],
    "returns nonsense": lambda path: _raise(Invalid("heights = [inf]")),
    "aborts": lambda path: os.abort(),
    "exits": lambda path: os._exit(3),
    "takes memory": lambda path: bytearray(4 << 30),
    "warns": lambda path: warnings.warn("divide by zero", RuntimeWarning, stacklevel=1),
    "prints": lambda path: os.write(2, b"libtiff: bad"),
    "says two lines": lambda path: _raise(_TwoLines(path)),
    "names no file": lambda path: _raise(InputError("cannot be read")),
}

FORMATS = {name: _format(fault) for name, fault in FAULTS.items()} | {
    "accepts": _format(lambda path: None),
    "refuses": _format(lambda path: _raise(InputError(f"{path}: cannot be read: it is cut short"))),
    "hangs": _format(lambda path: time.sleep(1000)),
    "refuses all": Format(
        lambda folder: (folder / "it").write_bytes(WHOLE),
        lambda folder: _raise(InputError(f"{folder}: no file of ours")),
    ),
}
