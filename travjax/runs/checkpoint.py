"""Training checkpoints, which Orbax writes whole or not at all; they are checked when they are read.

A folder holds one sub-folder for each checkpoint, numbered in the order in which they were saved:

    000007-step-1200-best/   state/       the arrays, in Orbax's format
                             meta.json    what the caller says of the checkpoint, and dtype and shape of its arrays
                             SHA256SUMS   of every other file, written last; `sha256sum -c SHA256SUMS` reads it too
    000008-heads/            a checkpoint that was saved under a name

A checkpoint is written to a temporary folder and renamed: if the process is killed, the earlier ones stay as they were.
"""

import errno
import json
import os
import re
import shutil
import textwrap
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax.traverse_util import unflatten_dict
from jax.experimental import multihost_utils

from travjax.config import InputError, require
from travjax.files import sha256, user_path
from travjax.runs.quiet_orbax import quiet_orbax

FORMAT = 1
UNFINISHED = ".unfinished-checkpoint"
ENTRIES = 64
"""Number of files and folders there must be room for, a few more than a checkpoint has."""

SPARE = 2**20
"""Bytes there must be room for in addition to the arrays."""

NAME = "[a-z][a-z0-9_]*"
FOLDER = re.compile(rf"(\d{{6,}})-(?:step-\d+(-best)?|({NAME}))")
PyTree = Any


class Checkpoints:
    """The checkpoints in a folder: the latest few, the best, and those with a name.

    In a run of several processes, which share the folder, all of them call each method with the same global arrays.
    notices: after `restore`, a line on each damaged checkpoint that was passed over, to be printed
    """

    def __init__(self, folder: str | Path, keep_latest: int = 2):
        require(isinstance(keep_latest, int) and keep_latest >= 1, "keep_latest", keep_latest, "an integer from 1")
        self.folder = user_path(folder).absolute()
        self.keep_latest = keep_latest
        self.notices: list[str] = []
        self._damaged: dict[Path, str] = {}

    def save(self, step: int, state: PyTree, meta: dict, best: bool = False) -> None:
        """Saves a pytree of arrays, and what JSON can hold, as the latest checkpoint and, if so marked, the best.

        Raises InputError when it cannot be written, a full disk for one; the earlier ones are kept.
        """
        self._save(f"step-{step}{'-best' if best else ''}", state, meta)

    def save_named(self, name: str, state: PyTree, meta: dict) -> None:
        """Saves a checkpoint that counts neither as latest nor as best, and replaces the one of the same name."""
        allowed = re.fullmatch(NAME, name) is not None and name not in ("latest", "best")
        require(allowed, "name", name, "lower-case letters, digits and _, neither latest nor best")
        self._save(name, state, meta)

    def restore(self, template: PyTree = None, which: str = "latest") -> tuple[PyTree, dict]:
        """Returns the state and the meta of the latest, the best or a named checkpoint.

        template: pytree of arrays or `jax.ShapeDtypeStruct` of the same structure, dtypes and shapes, whose shardings
            are used (a NumPy array where there is none); or a function that makes it from the checkpoint's meta.
            Without a template it returns nested dicts of NumPy arrays
        A damaged checkpoint is skipped in favour of the one before it, with a notice; one that training removes
        meanwhile, in favour of the newer one.
        Raises InputError when none is intact, or when its arrays differ from the template's.
        """
        while True:
            path, saved = self._newest_good(which)
            chosen = template(saved["meta"]) if callable(template) else template
            try:
                return _load(path, saved["arrays"], chosen), saved["meta"]
            except _Unreadable as error:
                with suppress(_Damaged):  # removed or altered since it was checked
                    _checked(path, arrays=True)
                    raise InputError(f"{path}: {error}; allowed: another checkpoint") from None

    def _newest_good(self, which: str) -> tuple[Path, dict]:
        damaged: dict[Path, str] = {}
        try:
            path, saved = _newest_good(self.folder, which, damaged, arrays=True)
        finally:
            self._damaged |= damaged
            self.notices = [f"{path}: damaged checkpoint passed over: {why}" for path, why in damaged.items()]
        if damaged:
            self.notices.append(f"{path}: is used instead")
        return path, saved

    def _save(self, label: str, state: PyTree, meta: dict) -> None:
        arrays = _named_leaves(state)
        text = json.dumps({"format": FORMAT, "meta": meta, "arrays": _described(arrays)})
        unfinished = self.folder / UNFINISHED

        def begin() -> None:
            shutil.rmtree(unfinished, ignore_errors=True)  # of a run that was killed
            unfinished.mkdir(parents=True)
            _require_room(unfinished, sum(leaf.nbytes for leaf in arrays.values()) + len(text))

        def write_arrays() -> None:
            with quiet_orbax() as ocp:
                context = ocp.Context()
                context.array.saving.use_compression = False  # saves 8 % of the space in seven times the time
                with context:
                    ocp.save(unfinished / "state", arrays)

        def finish() -> None:
            (unfinished / "meta.json").write_text(text)
            sums = [f"{sha256(file)}  {name}\n" for name, file in _files(unfinished).items()]
            (unfinished / "SHA256SUMS").write_text("".join(sums))
            number = max((number for number, _, _ in _checkpoints(self.folder)), default=0) + 1
            unfinished.rename(self.folder / f"{number:06d}-{label}")
            self._remove_superseded()

        first = jax.process_index() == 0
        try:
            self._together(begin, first)
            self._together(write_arrays, True)
            self._together(finish, first)
        finally:
            if first:
                shutil.rmtree(unfinished, ignore_errors=True)

    def _together(self, work: Callable[[], None], mine: bool) -> None:
        """Does the work if it is mine and waits for the other processes; raises in all of them if one failed."""
        reason = ""
        try:
            if mine:
                work()
        except (OSError, ValueError) as error:
            reason = _reason(error)
        failed = bool(reason)
        if jax.process_count() > 1:
            failed = bool(np.any(multihost_utils.process_allgather(np.array(failed))))
        if failed:
            why = reason or "another process failed"
            raise InputError(f"{self.folder}: checkpoint cannot be written: {why}; the earlier ones are kept")

    def _remove_superseded(self) -> None:
        good = [(kind, path) for _, kind, path in _checkpoints(self.folder) if path not in self._damaged]
        newest = {path for kind, path in dict(reversed(good)).items() if kind != "latest"}
        latest = [path for kind, path in good if kind in ("latest", "best")][: self.keep_latest]
        for _, _, path in _checkpoints(self.folder):
            if path not in newest and path not in latest:
                unfinished = path.rename(self.folder / UNFINISHED)  # so that no half-deleted checkpoint remains
                shutil.rmtree(unfinished, ignore_errors=True)


def load_meta(folder: str | Path, which: str = "latest") -> dict:
    """Reads only the meta of a checkpoint: its arrays are neither read nor checked, and Orbax is not imported.

    Raises InputError like `Checkpoints.restore`.
    """
    return _newest_good(user_path(folder).absolute(), which, {}, arrays=False)[1]["meta"]


def _checkpoints(folder: Path) -> list[tuple[int, str, Path]]:
    """Returns number, kind (latest, best or a name) and path of the checkpoints, newest first."""
    matches = [(FOLDER.fullmatch(path.name), path) for path in folder.iterdir()]
    return sorted(((int(m[1]), "best" if m[2] else m[3] or "latest", path) for m, path in matches if m), reverse=True)


def _newest_good(folder: Path, which: str, damaged: dict[Path, str], arrays: bool) -> tuple[Path, dict]:
    """Returns the checkpoint to use and its meta.json; adds those it skips to `damaged`, with the reason.

    A latest checkpoint stands in for a damaged best one.
    """
    try:
        found = _checkpoints(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {error.strerror}; allowed: a folder with checkpoints") from None
    steps = [path for _, kind, path in found if kind in ("latest", "best")]
    paths = steps if which == "latest" else [path for _, kind, path in found if kind == which]
    if not paths:
        there = sorted({kind for _, kind, _ in found} | {"latest" for _ in steps})
        raise InputError(f"{folder}: holds no checkpoint {which!r}; it holds: {', '.join(there) or 'none at all'}")
    for path in dict.fromkeys(paths + steps if which == "best" else paths):
        try:
            return path, _checked(path, arrays)
        except _Damaged as error:
            if (
                _checkpoints(folder) != found
            ):  # training is still running there, and may have replaced it by a newer one
                damaged.clear()
                return _newest_good(folder, which, damaged, arrays)
            damaged[path] = str(error)
    reasons = "; ".join(f"{path.name}: {why}" for path, why in damaged.items())
    raise InputError(f"{folder}: holds no checkpoint {which!r} that is whole: {reasons}")


class _Damaged(Exception):
    """What is wrong with a checkpoint's files."""


class _Unreadable(Exception):
    """Why Orbax cannot read arrays."""


def _checked(path: Path, arrays: bool) -> dict:
    """Reads meta.json once the files match SHA256SUMS (only meta.json without `arrays`); raises _Damaged otherwise.

    Raises InputError for another format version.
    """
    try:
        sums = dict(line.split("  ", 1)[::-1] for line in (path / "SHA256SUMS").read_text().splitlines())
        files = _files(path)
        for name in sorted(sums.keys() ^ files.keys()):
            raise _Damaged(f"{name} is {'missing' if name in sums else 'not in SHA256SUMS'}")
        for name in sums if arrays else ["meta.json"]:
            if sha256(files[name]) != sums[name]:
                raise _Damaged(f"{name} is altered or truncated")
        saved = json.loads((path / "meta.json").read_text())
    except OSError as error:
        raise _Damaged(f"{Path(error.filename or path).name} cannot be read: {error.strerror}") from None
    except (ValueError, KeyError):
        raise _Damaged("SHA256SUMS is altered or truncated") from None
    if saved["format"] != FORMAT:
        raise InputError(f"{path}: format = {saved['format']}: must be {FORMAT}, that of this version of travjax")
    return saved


def _files(path: Path) -> dict[str, Path]:
    """Lists the files by path, except hidden ones, which Finder, NFS and others leave there and Orbax ignores."""
    files = sorted(file for file in path.rglob("*") if not file.is_dir() and file.name != "SHA256SUMS")
    named = {file.relative_to(path).as_posix(): file for file in files}
    return {name: file for name, file in named.items() if not f"/{name}".count("/.")}


def _named_leaves(tree: PyTree) -> dict[str, Any]:
    """Returns the leaves by path, such as trunk/conv1/kernel."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    named = {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}
    if len(named) != len(leaves) or not named:
        raise InputError("the state has no arrays, or two of one path")
    return named


def _described(leaves: dict[str, Any]) -> dict[str, list]:
    """Returns dtype and shape of arrays; raises InputError for arrays Orbax cannot hold (it hangs on an empty one)."""
    for name, leaf in leaves.items():
        numbers = hasattr(leaf, "dtype") and not jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.extended)
        require(numbers and 0 not in leaf.shape, name, leaf, "an array of numbers that is not empty")
    return {name: [np.dtype(leaf.dtype).name, list(leaf.shape)] for name, leaf in leaves.items()}


def _load(path: Path, saved: dict[str, list], template: PyTree) -> PyTree:
    leaves = {} if template is None else _named_leaves(template)
    if template is not None:
        _require_same_arrays(path, saved, _described(leaves))
    abstract = {}
    for name, (dtype, shape) in saved.items():
        sharding = getattr(leaves.get(name), "sharding", None)
        blank = np.broadcast_to(np.zeros((), jax.numpy.dtype(dtype)), shape)
        abstract[name] = blank if sharding is None else jax.ShapeDtypeStruct(shape, blank.dtype, sharding=sharding)
    try:
        with quiet_orbax() as ocp:
            arrays = ocp.load(path / "state", abstract)
    except MemoryError:
        raise
    except Exception as error:  # Orbax and TensorStore raise whatever their parsers do, although the checksums match
        reason = textwrap.shorten(_reason(error), 80, placeholder=" ...")
        raise _Unreadable(f"state: cannot be read: {reason}") from None
    if template is None:
        return unflatten_dict(arrays, sep="/")
    return jax.tree.unflatten(jax.tree.structure(template), [arrays[name] for name in leaves])


def _require_same_arrays(path: Path, saved: dict[str, list], wanted: dict[str, list]) -> None:
    """Raises InputError that names the first arrays of a checkpoint that differ from those wanted."""
    shown = lambda array: "{}{}".format(*array) if array else "missing"
    names = [name for name in {**wanted, **saved} if saved.get(name) != wanted.get(name)]
    if names:
        each = [f"{n} is {shown(saved.get(n))} here and {shown(wanted.get(n))} there" for n in names[:3]]
        more = f"; and {len(names) - 3} more" if len(names) > 3 else ""
        raise InputError(f"{path}: other arrays than the network and optimiser have: {'; '.join(each)}{more}")


def _require_room(folder: Path, size: int) -> None:
    """Raises OSError where a checkpoint of `size` bytes has no room: Orbax notices late, and may then hang."""
    places = [folder / f"room-{number}" for number in range(ENTRIES)]
    for place in places:
        place.touch()
    try:
        with places[0].open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, size + SPARE)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise  # otherwise a single file of that size is not allowed
    for place in places:
        place.unlink()


def _reason(error: Exception) -> str:
    """Puts an error into one line; TensorStore reports a full disk as a ValueError with the system's error number."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    if code := re.search(r"os_error_code='(\d+)'", str(error)):
        return os.strerror(int(code[1]))
    return textwrap.shorten(str(error), 200, placeholder=" ...")
