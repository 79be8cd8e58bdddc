"""Every kind of file that travjax reads: how a valid one is made, its reader, and what that may return.

A new kind of file is one entry of FORMATS, a worker.Format; `dem` and `cloud` make those of elevation maps.
"""

import gzip
import hashlib
import json
import math
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path

import jax
import numpy as np

from tests.field_runs import RUN
from tests.points import CLOUDS, MESHES, points_of, write_las, write_ply, write_text
from tests.resnet.test_imagenet_weights import NARROW, canonical_arrays, keras_arrays, torchvision_arrays, write
from travjax.data.dataset import Dataset, DatasetConfig, load, save
from travjax.data.dem import load_dem
from travjax.data.provenance import Provenance, Site, SiteRecord, SitesConfig
from travjax.estimators.preset import Preset
from travjax.files import find_preset
from travjax.models.variables import merge_model, split_model
from travjax.resnet.imagenet_weights import load_weights
from travjax.runs.checkpoint import Checkpoints, load_meta
from travjax.runs.model_file import read_model, write_model
from travjax.runs.run import Run, load_estimator
from travjax.runs.run_log import read_rows
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import PRESETS as ROBOTS
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup
from travjax.training.trainer import Position

from .worker import Format, Invalid

GRID = Grid(4, 0.125)
CELL = GRID.spacing


def heights(holes: bool = True) -> np.ndarray:
    """A small gentle site [34, 35] at CELL, float32 metres."""
    y, x = np.mgrid[:34, :35] * CELL
    ground = 100 + 0.2 * np.sin(1.3 * x + 0.2) * np.cos(0.7 * y) + 0.02 * x
    if holes:
        ground[5, 7:9] = np.nan
    return ground.astype(np.float32)


# ---- Elevation maps


def dem(name: str, make: Callable[[Path], object], reseal: Callable[[Path], None] | None = None, **settings) -> Format:
    """A file of that name that `load_dem` takes with the settings; make and reseal get the file's path."""

    def read(folder: Path) -> None:
        windows = load_dem(folder / name, 2.0, grid=GRID, **settings)
        maps, origins = windows.heights, windows.origins
        _require(maps.dtype == np.float32 and maps.shape[1:] == GRID.shape and len(maps) > 0, "heights", maps.shape)
        _require(not any(np.isinf(one).any() for one in maps), "heights", "infinite")
        _require(origins.shape == (len(maps), 2) and np.isfinite(origins).all(), "origins", origins.shape)
        _require(0 < windows.cell_size < math.inf, "cell_size", windows.cell_size)
        _require(math.isfinite(windows.height_offset), "height_offset", windows.height_offset)
        for share in (windows.covered, windows.filled, windows.unknown):
            _require(0 <= share <= 1, "share", share)

    return Format(lambda folder: make(folder / name), read, reseal and (lambda folder: reseal(folder / name)))


def _require(right: bool, what: str, value: object) -> None:
    if not right:
        raise Invalid(f"{what} = {value!r:.100}")


TILES = {"blockxsize": 16, "blockysize": 16}


def _geotiff(path: Path, **options) -> None:
    import rasterio

    profile = dict(width=35, height=34, count=1, dtype="float32", crs="EPSG:32632", nodata=-9999) | options
    place = rasterio.Affine(CELL, 0, 500000, 0, -CELL, 5000000)
    with rasterio.open(path, "w", driver="GTiff", transform=place, **profile) as file:
        file.write(np.nan_to_num(heights()[::-1], nan=-9999), 1)


def _netcdf(path: Path) -> None:
    from scipy.io import netcdf_file

    with netcdf_file(path, "w") as file:
        for name, count, start in (("y", 34, 900.0), ("x", 35, 500.0)):
            file.createDimension(name, count)
            axis = file.createVariable(name, "d", (name,))
            axis[:] = start + CELL * np.arange(count)
            axis.units, axis.standard_name = b"m", f"projection_{name}_coordinate".encode()
        z = file.createVariable("z", "f", ("y", "x"))
        z[:] = np.nan_to_num(heights(), nan=-9999)
        z.units, z._FillValue = b"m", np.float32(-9999)


def _ascii_grid(path: Path) -> None:
    head = f"ncols 35\nnrows 34\nxllcorner 500\nyllcorner 900\ncellsize {CELL}\nNODATA_value -9999\n"
    rows = np.nan_to_num(heights()[::-1], nan=-9999)
    path.write_text(head + "\n".join(" ".join(f"{value:.4g}" for value in row) for row in rows) + "\n")


def _png(path: Path) -> None:
    from PIL import Image

    Image.fromarray(((heights(holes=False)[::-1] - 99) * 1000).astype(np.uint16)).save(path)


def _pgm(path: Path) -> None:
    values = (heights(holes=False)[::-1] - 99) * 1000
    path.write_bytes(b"P5\n35 34\n65535\n" + values.astype(">u2").tobytes())


def _lattice(path: Path) -> None:
    write_text(path, points_of(heights(), CELL, 500.0, 900.0))


def _packed(path: Path, make: Callable[[Path], object]) -> None:
    """The file of `make` in gzip."""
    inner = path.with_suffix("")
    make(inner)
    path.write_bytes(gzip.compress(inner.read_bytes(), mtime=0))
    inner.unlink()


def _png_checksums(path: Path) -> None:
    data, place, pieces = path.read_bytes(), 8, []
    while place + 12 <= len(data):
        length = int.from_bytes(data[place : place + 4], "big")
        chunk = data[place + 4 : place + 8 + length]
        pieces.append(data[place : place + 4] + chunk + zlib.crc32(chunk).to_bytes(4, "big"))
        place += 12 + length
    path.write_bytes(data[:8] + b"".join(pieces))


def _npz(path: Path) -> None:
    np.savez(path, heights=heights(), cell_size=CELL, origin=[500.0, 900.0], crs="EPSG:32632", height_offset=3.0)


def _labels(path: Path) -> None:
    maps = heights()[None, :33, :33] + np.arange(3, dtype=np.float32)[:, None, None]
    origins = np.arange(6.0).reshape(3, 2)
    np.savez_compressed(path, heights=maps, cell_size=CELL, origin=origins, height_offset=np.zeros(3), crs=["", "", ""])


def cloud(name: str, make: Callable[[Path, np.ndarray], object], off: float = 0.0) -> Format:
    """A cloud of points; off: metres at random by which they stand off a lattice."""

    def written(path: Path) -> None:
        points = points_of(heights(), CELL, 500.0, 900.0)
        points[:, :2] += off * np.random.default_rng(1).random((len(points), 2))
        make(path, points)
        if path.suffix in (".las", ".laz"):
            _of_one_day(path)

    return dem(name, written, cell_size=CELL if off else None)


def _of_one_day(path: Path) -> None:
    """Sets the date in the header of a LAS file, so that it is the same each day."""
    data = bytearray(path.read_bytes())
    data[90:94] = (1).to_bytes(2, "little") + (2025).to_bytes(2, "little")
    path.write_bytes(data)


ELEVATION = {
    "npy": dem("site.npy", lambda path: np.save(path, heights()), cell_size=CELL),
    "npz": dem("site.npz", _npz),
    "npz of several maps": dem("labels.npz", _labels),
    "GeoTIFF": dem("site.tif", _geotiff),
    "GeoTIFF, deflated": dem("site.tif", lambda path: _geotiff(path, compress="deflate", tiled=True, **TILES)),
    "netCDF": dem("site.nc", _netcdf),
    "ASCII grid": dem("site.asc", _ascii_grid),
    "PNG": dem("site.png", _png, _png_checksums, cell_size=CELL, height_scale=0.001),
    "PGM": dem("site.pgm", _pgm, cell_size=CELL, height_scale=0.001),
    "GeoTIFF in gzip": dem("site.tif.gz", lambda path: _packed(path, _geotiff)),
    "XYZ in gzip": dem("site.xyz.gz", lambda path: _packed(path, _lattice)),
    **{name: cloud(*entry) for name, entry in (CLOUDS | MESHES).items()},
    "CSV, scattered": cloud("site.csv", lambda path, points: write_text(path, points, ",", "x,y,z"), off=0.1),
    "PLY, scattered": cloud("site.ply", write_ply, off=0.1),
    "LAS, scattered": cloud("site.las", write_las, off=0.1),
}
"""Those of clouds come from points.py, which the tests of clouds share."""


# ---- Configurations


def toml(name: str, text: Callable[[], str], load: Callable[[Path], object]) -> Format:
    """A TOML file that `load` reads; it checks all values itself."""

    def read(folder: Path) -> None:
        _require(load(folder / name) is not None, name, None)

    return Format(lambda folder: (folder / name).write_text(text()), read)


CONFIGURATIONS = {
    "robot": toml("robot.toml", (ROBOTS / "seekur_jr.toml").read_text, Robot.load),
    "actions": toml(
        "actions.toml",
        lambda: "turns = 2\narc_lengths = [0.5, 0.6]\nradii = [inf, 1.5, -1.5]\ninterval = 0.1\n",
        ActionSpace.load,
    ),
    "preset": toml("preset.toml", find_preset("laptop", "field").read_text, Preset.load),
    "sites": toml("sites.toml", find_preset("real", "sites").read_text, SitesConfig.load),
}


# ---- Data sets and runs


def _set(folder: Path, provenance: Provenance | None) -> None:
    """A data set of ten maps, synthetic ones unless their provenance is given; its labels are drawn, not simulated."""
    config, rng = DatasetConfig(10, seed=5, validation=0.2, test=0.2), np.random.default_rng(0)
    maps = rng.normal(0, 0.1, (10, *GRID.shape)).astype(np.float32)
    labels = rng.integers(8, size=(10, len(RUN.actions)), dtype=np.uint8)
    group = np.full(10, "hill") if provenance else config.styles()
    arrays = (maps, labels, group, config.seeds(), config.splits())
    given = None if provenance else config
    save(Dataset(*arrays, Setup(RUN.robot, RUN.actions, GRID), given, provenance=provenance), folder / "set")


def _provenance() -> Provenance:
    config = SitesConfig((Site("hill.tif", test_strip=("north", 12.0)),))
    read = dict(sha256="0" * 64, crs="EPSG:32632", cell_size=0.1, height_offset=100.0, covered=0.9)
    counts = dict(windows=12, train=6, validation=2, test=2, too_unknown=1, near_test=1, shared=0)
    record = SiteRecord("hill", "hill.tif", **read, filled=0.01, unknown=0.02, **counts)
    return Provenance(np.arange(20.0).reshape(10, 2), np.arange(10, dtype=np.uint8) % 4, config, (record,))


def _read_set(folder: Path) -> None:
    found = load(folder / "set")
    _require(len(found.heights) == len(found.labels) > 0, "maps", len(found.heights))
    _require(found.heights.dtype == np.float32 and not np.isinf(found.heights).any(), "heights", found.heights.dtype)


def _reseal_set(folder: Path) -> None:
    """Sizes and checksums of the arrays, and that of the description, as `save` writes them."""
    path = folder / "set/dataset.json"
    with suppress(ValueError, LookupError, TypeError, AttributeError, OSError, RecursionError):
        table = json.loads(path.read_text())
        for name, file in table["files"].items():
            data = (folder / "set" / name).read_bytes()
            file |= {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        table.pop("sha256", None)
        digest = hashlib.sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()
        path.write_text(json.dumps(table | {"sha256": digest}, indent=1) + "\n")


ROWS = (
    *({"step": step, "phase": 2, "loss": 1.0 / (1 + step), "f1": {"step": 0.5, "overall": None}} for step in range(5)),
    {"step": 5, "validation_loss": 0.25, "learning_rate": 1e-3},
)


def _read_log(folder: Path) -> None:
    for row in read_rows(folder / "metrics.jsonl"):
        _require(isinstance(row, dict) and math.isfinite(row["step"]), "row", row)


def _variables():
    """The arrays of a tiny hazard field; drawn by NumPy, since JAX would compile for seconds."""
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda leaf: rng.uniform(0.1, 1, leaf.shape).astype(leaf.dtype), RUN.template(0))


def _model(folder: Path) -> None:
    network = merge_model(RUN.graph(), _variables())
    write_model(folder / "it.safetensors", RUN, network, {"dataset": "0123", "step": 8})


def _checkpoint(folder: Path) -> None:
    RUN.save(folder)
    position = Position(phase=2, epoch=1, step=3, total=8, loss=0.5, samples=4)
    meta = {"dataset": "0123", "optimizer": 0, "position": asdict(position)}
    Checkpoints(folder / "checkpoints").save(8, _variables(), meta, best=True)


def _read_checkpoint(folder: Path) -> None:
    _, network, meta = load_estimator(folder)
    _require_finite(network)
    _require(isinstance(meta, dict), "meta", meta)


def _require_finite(network) -> None:
    for leaf in jax.tree.leaves(split_model(network)[1]):
        _require(bool(np.isfinite(np.asarray(leaf, np.float32)).all()), "weights", "not finite")


def _read_meta(folder: Path) -> None:
    meta = load_meta(folder / "checkpoints", "best")
    _require(isinstance(meta, dict), "meta", meta)


def _reseal_checkpoint(folder: Path) -> None:
    for sums in folder.glob("checkpoints/*/SHA256SUMS"):
        files = sorted(path for path in sums.parent.rglob("*") if path.is_file() and path != sums)
        lines = (f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.relative_to(sums.parent)}\n" for p in files)
        sums.write_text("".join(lines))


def _read_model(folder: Path) -> None:
    _require_finite(read_model(folder / "it.safetensors")[1])


RUNS = {
    "data set": Format(lambda folder: _set(folder, None), _read_set, _reseal_set),
    "data set of sites": Format(lambda folder: _set(folder, _provenance()), _read_set, _reseal_set),
    "run.json": Format(RUN.save, Run.load),
    "metrics.jsonl": Format(
        lambda folder: (folder / "metrics.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in ROWS)),
        _read_log,
    ),
    "checkpoint": Format(_checkpoint, _read_checkpoint, _reseal_checkpoint),
    "checkpoint's meta": Format(_checkpoint, _read_meta, _reseal_checkpoint),
    "model file": Format(_model, _read_model),
}


# ---- ImageNet weights


def weights(suffix: str, named: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]) -> Format:
    """A file of weights for a narrow ResNet50, by the names that `named` gives them."""
    name = f"resnet50{suffix}"

    def read(folder: Path) -> None:
        for array in load_weights(folder / name, NARROW).arrays.values():
            _require(array.dtype == np.float32 and bool(np.isfinite(array).all()), "weights", array.dtype)

    return Format(lambda folder: write(folder / name, named(canonical_arrays(top=False))), read)


WEIGHTS = {
    "weights, .npz": weights(".npz", lambda arrays: arrays),
    "weights, .safetensors": weights(".safetensors", torchvision_arrays),
    "weights, .h5": weights(".h5", keras_arrays),
}
if find_spec("torch"):  # it is not installed everywhere
    WEIGHTS["weights, .pth"] = weights(".pth", torchvision_arrays)

FORMATS: dict[str, Format] = ELEVATION | CONFIGURATIONS | RUNS | WEIGHTS
