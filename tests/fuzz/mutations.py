"""Damage to files: bytes, blocks, numbers in headers and words in texts, drawn by a seeded generator."""

import gzip
import io
import re
import struct
import zipfile
from collections.abc import Callable

import numpy as np

Rng = np.random.Generator

NUMBERS = (0, 1, -1, 127, 255, 2**15 - 1, 2**16 - 1, 2**31 - 1, -(2**31), 2**32 - 1, 2**63 - 1, -(2**63))
REALS = (0.0, -1.0, 1e-40, 1e38, 1e300, float("nan"), float("inf"), -float("inf"))
"""What numbers in binary headers are replaced by."""

TOKENS = (
    *(b"0", b"-1", b"1", b"2147483647", b"2147483648", b"4294967295", b"9223372036854775807", b"-9223372036854775808"),
    *(b"1e22", b"1e999", b"-1e999", b"1e-320", b"nan", b"NaN", b"-inf", b"Infinity", b"0.0", b"9" * 5000),
    *(b"", b" ", b"\n", b"\r", b"\0", b"\xff\xfe", b"\xc3\xa9", b"\x1b[31m", b"$x$", b"%s", b"../..", b"true", b"null"),
    *(b"{}", b"[]", b'""', b"'", b'"', b"[" * 3000, b"{" * 3000, b"-", b"1,5", b"0x10", b"1_0"),
)
"""What words and numbers in texts are replaced by."""

ENDS = 512
"""Bytes at the beginning and the end of a file that are damaged more often: that is where headers and tables lie."""


def mutated(data: bytes, rng: Rng) -> tuple[bytes, str]:
    """The data with one to four kinds of damage, and what was done.

    Half of the archives are damaged within a member and packed again, since otherwise their checksums catch everything.
    """
    if rng.random() < 0.5:
        for unpacked in (_within_zip, _within_gzip):
            if (found := unpacked(data, rng)) is not None:
                return found
    return _damaged(data, rng)


def _damaged(data: bytes, rng: Rng) -> tuple[bytes, str]:
    done = []
    for _ in range(1 if rng.random() < 0.6 else rng.integers(2, 5)):
        kind = KINDS[rng.integers(len(KINDS))]
        data, said = kind(data, rng)
        done.append(said)
    return data, ", ".join(done)


def _within_zip(data: bytes, rng: Rng) -> tuple[bytes, str] | None:
    if not zipfile.is_zipfile(io.BytesIO(data)):
        return None
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(packed, "w") as new:
        infos = old.infolist()
        chosen = infos[rng.integers(len(infos))]
        for info in infos:
            content = old.read(info)
            if info is chosen:
                content, said = _damaged(content, rng)
            new.writestr(info, content)
    return packed.getvalue(), f"in {chosen.filename}: {said}"


def _within_gzip(data: bytes, rng: Rng) -> tuple[bytes, str] | None:
    if not data.startswith(b"\x1f\x8b"):
        return None
    content, said = _damaged(gzip.decompress(data), rng)
    return gzip.compress(content, mtime=0), f"unpacked: {said}"


def _place(size: int, rng: Rng) -> int:
    """Somewhere among `size` bytes, half of the times within ENDS of the beginning or the end."""
    if size == 0:
        return 0
    where = rng.random()
    if where < 0.35:
        return int(rng.integers(min(size, ENDS)))
    return int(rng.integers(max(size - ENDS, 0), size)) if where < 0.5 else int(rng.integers(size))


def _block(size: int, rng: Rng) -> tuple[int, int]:
    """Beginning and end of a block, mostly a short one."""
    start = _place(size, rng)
    length = int(2 ** rng.uniform(0, 12))
    return start, min(start + length, size)


def _flipped(data: bytes, rng: Rng) -> tuple[bytes, str]:
    changed, places = bytearray(data), []
    for _ in range(int(rng.integers(1, 9)) if data else 0):
        places.append(_place(len(data), rng))
        changed[places[-1]] ^= int(rng.integers(1, 256))
    return bytes(changed), f"bytes {places} flipped"


def _cut(data: bytes, rng: Rng) -> tuple[bytes, str]:
    left = _place(len(data), rng)
    return data[:left], f"cut to {left} bytes"


def _removed(data: bytes, rng: Rng) -> tuple[bytes, str]:
    start, stop = _block(len(data), rng)
    return data[:start] + data[stop:], f"bytes {start} to {stop} removed"


def _inserted(data: bytes, rng: Rng) -> tuple[bytes, str]:
    place, length = _place(len(data), rng), int(2 ** rng.uniform(0, 10))
    block = bytes(length) if rng.random() < 0.3 else rng.bytes(length)
    return data[:place] + block + data[place:], f"{length} bytes inserted at {place}"


def _doubled(data: bytes, rng: Rng) -> tuple[bytes, str]:
    start, stop = _block(len(data), rng)
    return data[:stop] + data[start:stop] + data[stop:], f"bytes {start} to {stop} doubled"


def _overwritten(data: bytes, rng: Rng) -> tuple[bytes, str]:
    start, stop = _block(len(data), rng)
    place = _place(len(data), rng)
    return data[:place] + data[start:stop] + data[place + stop - start :], f"bytes {start} to {stop} copied to {place}"


def _number(data: bytes, rng: Rng) -> tuple[bytes, str]:
    """A number of two, four or eight bytes, in either byte order, at a place that is a multiple of its size or not."""
    form = "hiqfd"[rng.integers(5)]
    size = struct.calcsize(f"<{form}")
    if form in "fd":
        value = REALS[rng.integers(len(REALS))]
        with np.errstate(over="ignore"):
            coded = np.array(value, np.float32 if form == "f" else np.float64).tobytes()
    else:
        value = NUMBERS[rng.integers(len(NUMBERS))]
        coded = (value % 2 ** (8 * size)).to_bytes(size, "little")
    place = _place(len(data), rng)
    place -= place % size if rng.random() < 0.7 else 0
    coded = coded if rng.random() < 0.8 else coded[::-1]
    return data[:place] + coded + data[place + size :], f"{size} bytes at {place} replaced by {value}"


def _token(data: bytes, rng: Rng) -> tuple[bytes, str]:
    """A number or a word of a text, or of a text in a binary file; by another one of the file for one time in four."""
    pattern = rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?" if rng.random() < 0.6 else rb"[A-Za-z_][A-Za-z_0-9.-]+"
    found = list(re.finditer(pattern, data[: 1 << 16]))
    if not found:
        return _number(data, rng)
    place = _place(min(len(data), 1 << 16), rng)
    old = min(found, key=lambda match: abs(match.start() - place))
    other = found[rng.integers(len(found))].group()
    new = other if rng.random() < 0.25 else TOKENS[rng.integers(len(TOKENS))]
    return data[: old.start()] + new + data[old.end() :], f"{old.group()[:20]!r} at {old.start()} became {new[:20]!r}"


KINDS: tuple[Callable[[bytes, Rng], tuple[bytes, str]], ...] = (
    *(_flipped, _cut, _removed, _inserted, _doubled, _overwritten),
    *(_number, _number, _token, _token, _token),
)
