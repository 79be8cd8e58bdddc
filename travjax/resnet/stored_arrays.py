"""Arrays in files of weights, whose names, shapes and types are known before they are read.

The claims of a file are first compared with its size, so that no header can make reading take more memory than the
length of the file, or than the array that is asked for.
"""

import math
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from travjax.config import InputError

LARGEST = 4 << 30
"""Most bytes of a decompressed part of a file, unless it is one of the wanted arrays."""

EXPANSION = 100
"""Largest ratio of decompressed to compressed size of such a part; weights hardly compress at all."""

PIECE = 1 << 20


@dataclass(frozen=True)
class Stored:
    """An array of a file.

    dtype: name of its type without byte order, such as "float32"
    read:  function that returns the array; raises InputError, without the path, when that part of the file is damaged
    """

    shape: tuple[int, ...]
    dtype: str
    read: Callable[[], np.ndarray]

    @property
    def floating(self) -> bool:
        """Whether it holds real numbers."""
        return self.dtype.startswith(("float", "bfloat"))


@dataclass(frozen=True)
class WeightFile:
    """An open file of weights.

    arrays:  arrays by their names in the file
    notes:   notes that weight_files.write_safetensors was given, {} in other files
    checked: whether it has checksums, which are compared as arrays are read
    """

    arrays: dict[str, Stored]
    notes: dict
    checked: bool = False


@contextmanager
def reading(kind: str) -> Iterator[None]:
    """Turns whatever a library raises for a damaged file into InputError; to be used around library calls only."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about what is refused in the end
            yield
    except InputError:
        raise
    except MemoryError as error:
        raise InputError(f"does not fit into memory: {error}") from None
    except Exception as error:
        text = (getattr(error, "strerror", None) or str(error)).strip().partition("\n")[0]
        reason = text if " " in text else f"{type(error).__name__} {text}".strip()
        raise InputError(f"cannot be read as {kind}, damaged or something else: {shown(reason)}") from None


def shown(text: str) -> str:
    """Shortens a text of a file to one line."""
    plain = text if text.isprintable() else ascii(text)[1:-1]
    return plain if len(plain) <= 200 else f"{plain[:200]} ..."


def type_name(dtype: np.dtype) -> str:
    """Returns the name of a type; NumPy has no bfloat16, and writes such arrays as two untyped bytes."""
    return "bfloat16" if dtype.kind == "V" and dtype.itemsize == 2 and not dtype.names else dtype.name


def as_named(array: np.ndarray) -> np.ndarray:
    """Views the array as the type that `type_name` names."""
    return array.view(jnp.bfloat16) if type_name(array.dtype) == "bfloat16" else array


def open_zip(path: Path, kind: str) -> zipfile.ZipFile:
    """Opens a zip file; raises InputError unless its parts have different names and are stored or deflated."""
    with reading(kind):
        archive = zipfile.ZipFile(path)
    infos = archive.infolist()
    for info in infos:
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or info.flag_bits & 1:
            raise InputError(f"{shown(info.filename)}: must be stored or deflated, without a password")
    if len({info.filename for info in infos}) < len(infos):
        raise InputError("holds two parts of one name: must be one of each")
    return archive


def unfolded(archive: zipfile.ZipFile, name: str, kind: str) -> bytes:
    """Unpacks a part of a zip file; raises InputError when its claimed size is implausible or too small."""
    info = archive.getinfo(name)
    if info.file_size > min(LARGEST, EXPANSION * info.compress_size):
        raise InputError(
            f"{shown(name)} = {info.file_size:,} bytes unfolded, {info.compress_size:,} stored: "
            f"must be at most {EXPANSION} times as many, and at most {LARGEST:,}"
        )
    content = bytearray()
    with reading(kind), archive.open(info) as file:
        while piece := file.read(PIECE):  # a single read would decompress before checking the size
            content += piece
    return bytes(content)


def stored_npy(archive: zipfile.ZipFile, info: zipfile.ZipInfo, kind: str) -> Stored:
    """Reads an array of a zip file in NumPy's format."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    with reading(kind), archive.open(info) as file:
        shape, _, dtype = readers[np.lib.format.read_magic(file)](file)
        claimed = file.tell() + math.prod(shape) * dtype.itemsize
    if not dtype.hasobject and (claimed != info.file_size or min(shape, default=0) < 0):
        raise InputError(
            f"{shown(info.filename)} = {list(shape)}, {claimed:,} bytes: must be as long as it is stored, "
            f"{info.file_size:,} bytes"
        )

    def read() -> np.ndarray:
        with reading(kind), archive.open(info) as file:
            array = np.lib.format.read_array(file, allow_pickle=False)
            file.read(1)  # at the end zipfile compares the checksum
        return as_named(array)

    return Stored(shape, type_name(dtype), read)
