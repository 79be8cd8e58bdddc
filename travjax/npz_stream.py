"""Writes an .npz batch by batch, so that its arrays need not fit into memory."""

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
"""Largest size of an item, in bytes, of arrays that are kept in memory; others go to an unnamed file."""

LEVEL = 1
"""Compression level: at any level flags shrink to a tenth, and numbers hardly at all."""


class NpzStream:
    """Arrays with a common leading axis that grow batch by batch, for an .npz; a context that releases its files.

    count: number of items added
    """

    def __init__(self, path: Path, items: int, item_bytes: int, what: str):
        """Raises InputError unless `items` items fit on the disk twice, compressed and not."""
        require_disk(2 * items * item_bytes, path.parent, f"{items} {what}")
        self.path, self.count = path, 0
        self._files: dict[str, tuple[IO[bytes], np.dtype, tuple[int, ...]]] = {}
        self._held: dict[str, list[np.ndarray]] = {}

    def __enter__(self) -> "NpzStream":
        return self

    def __exit__(self, *reason: object) -> None:
        for file, _, _ in self._files.values():
            file.close()  # it has no name, so closing removes it

    def append(self, batch: Mapping[str, np.ndarray]) -> None:
        """Adds a batch of arrays [n, ...]; every batch has the same names. Raises InputError when the disk is full."""
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
        """The arrays added so far, by name; large ones are mapped from their files."""
        arrays = self._joined()
        for name, (file, dtype, shape) in self._files.items():
            file.flush()
            arrays[name] = np.memmap(file, dtype, "r", shape=(self.count, *shape))
        return arrays

    def save(self, without: Collection[str] = (), **more: np.ndarray | str | float) -> Path:
        """Writes the added arrays and further ones to the .npz, whole or not at all; names in `without` are left
        out.
        """
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
