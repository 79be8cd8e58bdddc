"""What a file of heights is, by its content; the suffix decides only where the content cannot.

Text in other encodings and files that are packed by gzip are unfolded into a temporary folder first.
"""

import gzip
import re
import shutil
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from travjax.config import InputError
from travjax.memory import require_disk

BEGINNING = 2**16
"""Bytes of a file that are looked at."""

TEXT_SUFFIXES = (".xyz", ".txt", ".csv", ".pts", ".asc", ".dat", ".grd", ".tsv", "")
"""Suffixes of text that is taken as points where its beginning does not tell; .asc and .grd are grids as well."""

RASTER_TEXT = (".dem", ".gxf")
"""Suffixes of rasters that are text."""

MESH_SUFFIXES = (".obj", ".stl", ".gltf", ".glb")

GRID_WORDS = (
    "ncols",
    "nrows",
    "xllcorner",
    "xllcenter",
    "yllcorner",
    "yllcenter",
    "cellsize",
    "dsaa",
    "north:",
    "proj:",
)
"""First words of grids as text: Arc, GRASS, Surfer."""

MAGIC = {
    b"\x93NUMPY": "npy",
    b"PK\x03\x04": "npz",
    b"PK\x05\x06": "npz",
    b"LASF": "las",
    b"ply\n": "ply",
    b"ply\r": "ply",
    b"glTF": "mesh",
    b"\x1f\x8b": "gzip",
    b"#ROSBAG V2.0\n": "recording",
    b"SQLite format 3\0": "recording",
    b"\x89MCAP0\r\n": "recording",
}

ENCODINGS = {b"\xef\xbb\xbf": "utf-8-sig", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
"""Text that begins with a byte order mark."""

MOST_UNFOLDED = 2**35
"""Bytes to which a packed file may unfold: 32 GiB."""

OTHERS = (
    ".npy, .npz, .xyz, .txt, .csv, .pts, .ply, .las, .laz, .pcd, .obj, .stl, .glb, .gltf, ROS's .bag, .db3 and .mcap, "
    "and any of them as .gz"
)
"""What is read beside the rasters of GDAL, for help and messages."""


def form_of(path: Path) -> str:
    """Returns "npy", "npz", "las", "ply", "pcd", "mesh", "text" (of points), "recording" (of ROS) or "raster".

    Or how a file has to be unfolded: "gzip", "utf-16", "utf-8-sig", or "commas" for a grid with decimal commas.
    """
    with path.open("rb") as file:
        head = file.read(BEGINNING)
    suffix = path.suffix.lower()
    for magic, form in MAGIC.items():
        if head.removeprefix(b"\xef\xbb\xbf").startswith(magic):
            return form
    if suffix in (".npy", ".npz"):
        return suffix[1:]  # its reader says what is wrong with it
    if head.startswith(b"# .PCD") or head.startswith(b"VERSION") and b"\nFIELDS" in head:
        return "pcd"
    if suffix in MESH_SUFFIXES:
        return "mesh"
    for mark, encoding in ENCODINGS.items():
        if head.startswith(mark):
            return encoding if _is_grid(head.decode(encoding, "ignore")) else "text"
    if re.search(rb"[\x00-\x08\x0e-\x1f]", head):  # no text
        return "raster"
    text = head.decode("latin-1")
    if _is_grid(text):
        return "commas" if re.search(r"cellsize\s+\d*,", text, re.IGNORECASE) else "raster"
    if suffix in RASTER_TEXT:
        return "raster"
    if suffix in TEXT_SUFFIXES and suffix not in (".asc", ".grd") or _has_numbers(text):
        return "text"
    return "raster"


def _is_grid(text: str) -> bool:
    return text.lstrip().lower().startswith(GRID_WORDS)


def _has_numbers(text: str) -> bool:
    """Tells whether one of the first lines begins with three numbers."""
    number = r"[-+]?[\d.,]+(?:[eEdD][-+]?\d+)?"
    lines = text.splitlines()[:50]
    return any(re.match(rf"\s*{number}[\s;,]+{number}[\s;,]+{number}", line) for line in lines)


@contextmanager
def unfolded(path: Path) -> Iterator[tuple[Path, str]]:
    """Yields the file in a form that a reader takes, and that form; a copy in a temporary folder where it is packed.

    Raises InputError when it is damaged, packed more than once, or unfolds to more than fits.
    """
    form = form_of(path)
    if form not in ("gzip", "commas", *ENCODINGS.values()):
        yield path, form
        return
    with tempfile.TemporaryDirectory(prefix="travjax-") as folder:
        name = path.stem if form == "gzip" and path.suffix.lower() == ".gz" else path.name
        copy = Path(folder) / name
        if form == "gzip":
            _unpack(path, copy)
        else:
            encoding = "latin-1" if form == "commas" else form
            text = path.read_text(encoding, errors="replace")
            copy.write_text(text.replace(",", ".") if re.search(r"cellsize\s+\d*,", text, re.IGNORECASE) else text)
        inner = form_of(copy)
        if inner == "gzip":
            raise InputError("is packed by gzip more than once: must be packed once")
        if inner in ("commas", *ENCODINGS.values()):
            with unfolded(copy) as found:
                yield found
        else:
            yield copy, inner


def _unpack(path: Path, copy: Path) -> None:
    require_disk(path.stat().st_size, copy.parent, f"the contents of {path.name}")
    most = min(MOST_UNFOLDED, shutil.disk_usage(copy.parent).free // 2)
    written = 0
    try:
        with gzip.open(path) as packed, copy.open("wb") as out:
            while piece := packed.read(2**20):
                written += len(piece)
                if written > most:
                    raise InputError(f"unfolds to more than {most} bytes; unpack it first")
                out.write(piece)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise InputError(f"cannot be read as .gz: {error}") from None
