"""An .npz that is written batch by batch, so that its arrays need not fit into memory."""

import shutil
import tempfile
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import IO

import numpy as np

from travjax.config import InputError
from travjax.files import atomic_write
from travjax.memory import require_disk

SMALL = 1024
"""Bytes an item up to which an array is held in memory; larger ones wait in a file without a name."""

LEVEL = 1
"""Of compression: flags shrink to a tenth at any, and numbers little at any."""


class NpzStream:
    """Arrays with a common leading axis that grow batch by batch, for an .npz; a context that gives up what it holds.

    count: items that were added
    """

    def __init__(self, path: Path, items: int, item_bytes: int, what: str):
        """Raises InputError when so many items, whatever they are, do not fit on the disk twice: packed, and before."""
        require_disk(2 * items * item_bytes, path.parent, f"{items} {what}")
        self.path, self.count = path, 0
        self._files: dict[str, tuple[IO[bytes], np.dtype, tuple[int, ...]]] = {}
        self._held: dict[str, list[np.ndarray]] = {}

    def __enter__(self) -> "NpzStream":
        return self

    def __exit__(self, *reason: object) -> None:
        for file, _, _ in self._files.values():
            file.close()  # which has no name, and goes with that

    def append(self, batch: Mapping[str, np.ndarray]) -> None:
        """Adds a batch of arrays [n, ...]; every batch holds the same ones. Raises InputError when the disk is full."""
        try:
            for name, array in batch.items():
                if array[:1].nbytes <= SMALL:
                    self._held.setdefault(name, []).append(array)
                else:
                    np.ascontiguousarray(array).tofile(self._file(name, array))
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {error.strerror or error}") from None
        self.count += len(next(iter(batch.values())))

    def _file(self, name: str, array: np.ndarray) -> IO[bytes]:
        if name not in self._files:
            self._files[name] = tempfile.TemporaryFile(dir=self.path.parent), array.dtype, array.shape[1:]
        return self._files[name][0]

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """What was added, by name; large arrays are mapped from their files."""
        arrays = self._joined()
        for name, (file, dtype, shape) in self._files.items():
            file.flush()
            arrays[name] = np.memmap(file, dtype, "r", shape=(self.count, *shape))
        return arrays

    def save(self, without: Collection[str] = (), **more: np.ndarray | str | float) -> Path:
        """Writes what was added, and arrays beside it, to the .npz, whole or not at all; `without` is left out."""
        with (
            atomic_write(self.path) as temporary,
            zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=LEVEL) as archive,
        ):
            for name, (file, dtype, shape) in self._files.items():
                if name in without:
                    continue
                file.seek(0)
                header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False}
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array_header_1_0(member, header | {"shape": (self.count, *shape)})
                    shutil.copyfileobj(file, member, 2**20)
            held = {name: array for name, array in self._joined().items() if name not in without}
            for name, array in (held | more).items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
        return self.path

    def _joined(self) -> dict[str, np.ndarray]:
        return {name: np.concatenate(parts) for name, parts in self._held.items()}
