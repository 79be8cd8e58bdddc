"""Compressed LAS files: what the decompressor would take memory by, checked before it sees the file (SPEC section 11).

It believes every count and aborts the process where it cannot have the memory; nothing in Python catches that. Names
and layout are those of the LASzip specification.
"""

import os
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

from travjax.config import InputError
from travjax.point_clouds.points import installed, reason_of

RECORD = 22204
"""Number of the record that describes the compression."""

ITEMS = {6: (20,), 7: (8,), 8: (6,), 9: (29,), 10: (30,), 11: (6,), 12: (8,), 13: (29,)}
"""Bytes of each kind of item but those of extra bytes, 0 and 14."""

EXTRA_BYTES = (0, 14)
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Number of lengths that a chunk of layered items begins with, for each kind; of extra bytes one a byte."""

MOST_POINTS = 2**22
"""Points of a chunk, which are in memory at once; LASzip writes 50,000."""

POINTWISE_CHUNKED, LAYERED = 2, 3
VARIABLE = 2**32 - 1
"""Points of a chunk that says itself how many it has."""


@contextmanager
def without_panics() -> Iterator[None]:
    """Drops what is written to standard error meanwhile: Rust tells there of a panic, which is an exception as well."""
    if sys.stderr is not None:
        sys.stderr.flush()
    kept = os.dup(2)
    with open(os.devnull, "wb") as nothing:
        os.dup2(nothing.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def require_decompressible(
    file: BinaryIO, size: int, start: int, point_size: int, points: int, records: dict[int, bytes]
) -> None:
    """Raises InputError unless record, chunk table and chunks of a LAZ file of so many bytes agree with its size.

    start:   where the compressed points begin
    records: of the header, by number
    """
    lazrs = installed("lazrs")
    compressor, chunk_points, items = _described(records.get(RECORD, b""), point_size)
    if not points:
        return
    table = _table_start(file, size, start)
    file.seek(table)
    version, chunks = struct.unpack("<II", _read(file, 8))
    most = (table - start - 8) // point_size + 1
    if version != 0 or chunks > most:
        raise InputError(f"chunks = {chunks}: must be at most {most}, which the file has room for")
    file.seek(start)
    try:
        entries = lazrs.read_chunk_table(file, lazrs.LazVlr(records[RECORD]))
    except (MemoryError, KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # a panic of Rust is no Exception
        raise InputError(
            f"cannot be read as LAZ: chunk table: {reason_of(error)}; it is cut short or damaged"
        ) from None
    each = [number if chunk_points == VARIABLE else chunk_points for number, _ in entries]
    held = sum(each)
    if max(each, default=0) > MOST_POINTS:
        raise InputError(f"points of a chunk = {max(each)}: must be at most {MOST_POINTS}")
    if held < points or sum(length for _, length in entries) > table - start - 8:
        raise InputError(f"points = {points}: must be in its {len(entries)} chunks; it is cut short or damaged")
    if compressor == LAYERED:
        _require_layers(file, start + 8, [length for _, length in entries], point_size, items)


def _described(record: bytes, point_size: int) -> tuple[int, int, list[tuple[int, int]]]:
    """Reads (compressor, points in a chunk, kind and bytes of the items) from the record of LASzip."""
    if len(record) < 34:
        raise InputError("cannot be read as LAZ: no record of LASzip describes its compression")
    compressor, count = struct.unpack("<H", record[:2])[0], struct.unpack("<H", record[32:34])[0]
    chunk_points = struct.unpack("<I", record[12:16])[0]
    described = record[34 : 34 + 6 * count]
    items = [(kind, size) for kind, size, _ in struct.iter_unpack("<HHH", described[: len(described) // 6 * 6])]
    known = all(size in ITEMS[kind] if kind in ITEMS else kind in EXTRA_BYTES for kind, size in items)
    if compressor not in (POINTWISE_CHUNKED, LAYERED) or len(items) != count or not count or not known:
        raise InputError(f"cannot be read as LAZ: compressor = {compressor}, items = {items}: must be those of LASzip")
    layered = {kind in LAYERS or kind == 14 for kind, _ in items}
    if layered != {compressor == LAYERED} or sum(size for _, size in items) != point_size or not chunk_points:
        raise InputError(f"cannot be read as LAZ: items = {items}: must make up a point of {point_size} bytes")
    return compressor, chunk_points, items


def _table_start(file: BinaryIO, size: int, start: int) -> int:
    file.seek(start)
    table = struct.unpack("<q", _read(file, 8))[0]
    if table == -1:  # written as a stream: it stands in the last eight bytes
        file.seek(size - 8)
        table = struct.unpack("<q", _read(file, 8))[0]
    if not start + 8 <= table <= size - 8:
        raise InputError(f"chunk table at {table}: must lie behind the points, in {size} bytes; it is cut short")
    return table


def _read(file: BinaryIO, length: int) -> bytes:
    content = file.read(length)
    if len(content) < length:
        raise InputError("cannot be read as LAZ: it is cut short")
    return content


def _require_layers(
    file: BinaryIO, start: int, lengths: list[int], point_size: int, items: list[tuple[int, int]]
) -> None:
    """Refuses chunks whose layers are longer than the chunks."""
    layers = sum(LAYERS.get(kind, size) for kind, size in items)
    for number, length in enumerate(lengths):
        file.seek(start + point_size)
        content = _read(file, 4 + 4 * layers) if length else b""
        sizes = struct.unpack(f"<{layers}I", content[4:]) if content else ()
        if point_size + len(content) + sum(sizes) > length and length:
            raise InputError(f"chunk {number + 1} = {length} bytes: must hold its layers; it is damaged")
        start += length
