"""Point clouds and meshes of every format as rasters (SPEC section 11).

x is east, y is north, z is up, whatever the order of the points; where y points up, z points south.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from travjax.config import InputError
from travjax.point_clouds.gridding import gridded, require_fits
from travjax.point_clouds.las import read_las
from travjax.point_clouds.meshes import read_mesh, surface
from travjax.point_clouds.pcd import read_pcd
from travjax.point_clouds.ply import read_ply
from travjax.point_clouds.points import Points, ground_of, listed, require_fine_steps, whole_classes
from travjax.point_clouds.text_points import read_text
from travjax.rasters.coordinates import name_of, require_metric, system_named
from travjax.rasters.raster import Raster, require_heights, require_size
from travjax.rasters.reading_options import DemOptions
from travjax.simulation.grid import Grid

SUFFIXES = (".xyz", ".txt", ".csv", ".pts", ".ply", ".las", ".laz", ".pcd", ".obj", ".stl", ".gltf", ".glb")
"""Usual suffixes of these files."""

Y_UP = "its points lie flat along x and z: if y points up, say so (--up=y)"


def read_cloud(path: Path, form: str, options: DemOptions, grid: Grid) -> Raster:
    """Returns the points or the mesh of a file as a raster.

    form: "text", "ply" (its vertices), "pcd", "las" (LAS and LAZ), or "mesh" (OBJ, STL, glTF and GLB), whose surface
          as seen from above is taken
    Points whose height is NaN or nodata are left out. Raises InputError when the file cannot be read or is cut short,
    its coordinates are not finite, in degrees or feet, or in too large steps, and when the points are too few, or too
    far apart for a raster.
    """
    match form:
        case "text":
            return _of_points(read_text(path, options), options, grid)
        case "las":
            return _of_points(read_las(path, options), options, grid)
        case "ply":
            return _of_points(read_ply(path), options, grid)
        case "pcd":
            return _of_points(read_pcd(path), options, grid)
    return _of_mesh(path, options, grid)


def cloud_of_arrays(arrays: dict[str, np.ndarray], options: DemOptions, grid: Grid) -> Raster:
    """Returns the points in the arrays of an .npz file as a raster.

    arrays: `x`, `y` and `z` [n], or `points` [n, 3], and if they are there, `classification` [n] and `crs`
    Raises InputError when they are none of these, and as `read_cloud` does.
    """
    if "points" in arrays:
        points = arrays["points"]
        if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "iuf":
            raise InputError(f"points: {points.dtype} {list(points.shape)}: must be numbers [n, 3]")
        x, y, z = points.T
    elif {"x", "y", "z"} <= set(arrays):
        x, y, z = (arrays[axis] for axis in "xyz")
    else:
        raise InputError(f"no array `points`, nor x, y, z; it holds: {listed(arrays)}")
    classes = arrays.get("classification")
    given = {"x": x, "y": y, "z": z} | ({} if classes is None else {"classification": classes})
    for name, values in given.items():
        if values.ndim != 1 or len(values) != len(x) or values.dtype.kind not in "iuf":
            raise InputError(f"{name}: {values.dtype} {list(values.shape)}: must be numbers [n], as many as x")
    whole = whole_classes(classes)
    if whole is None and classes is not None:
        raise InputError("classification: must be whole numbers from 0 to 255")
    named = str(np.ravel(arrays["crs"])[0]) if np.size(arrays.get("crs", ())) else ""
    crs = system_named(named)
    return _of_points(Points(x, y, z, crs, whole), options, grid)


def _of_points(points: Points, options: DemOptions, grid: Grid) -> Raster:
    points = ground_of(points, options.classes)
    x, y, z, known = _in_metres(points, options.up, options)
    x, y, z = x[known], y[known], z[known]
    _require_site(x, y, z, grid)
    require_metric(points.crs, float(np.median(x)), float(np.median(y)), options.height_scale is not None)
    notes = points.notes
    if options.up is None and _lies_along_z(x, y, z):
        notes += (Y_UP,)
    try:
        raster = gridded(x, y, z, options.cell_size, grid)
    except InputError as error:
        raise InputError("; ".join([str(error), *notes])) from None
    return Raster(raster.heights, raster.cell_size, raster.origin, name_of(points.crs), notes + raster.notes)


def _of_mesh(path: Path, options: DemOptions, grid: Grid) -> Raster:
    """Samples the highest surface of a mesh at the grid's spacing, or at the given cell size, from the mesh's own
    corner.
    """
    if options.classes is not None:
        raise InputError(f"classes = {options.classes}: must be left out: a mesh has none")
    mesh = read_mesh(path)
    up = options.up or mesh.up
    if not len(mesh.faces):
        points = Points(*mesh.vertices.T)._replace(notes=("it has no triangles: its points are taken",))
        return _of_points(points, replace(options, up=up), grid)
    x, y, z, known = _in_metres(Points(*mesh.vertices[mesh.faces].reshape(-1, 3).T), up, options)
    corners = np.stack([x, y, z], axis=1).reshape(-1, 3, 3)[known.reshape(-1, 3).all(axis=1)]
    x, y, z = corners.reshape(-1, 3).T
    _require_site(x, y, z, grid)
    flat = up is None and _lies_along_z(x, y, z)
    east, north, cell_size = float(np.ptp(x)), float(np.ptp(y)), options.cell_size or grid.spacing
    try:
        require_size(east, north, grid)
        require_fits(east, north, cell_size, grid.spacing)
    except InputError as error:
        raise InputError(f"{error}; {Y_UP}" if flat else str(error)) from None
    shape = int(north / cell_size + 1e-6) + 1, int(east / cell_size + 1e-6) + 1
    raster = surface(corners, cell_size, shape)
    notes = (f"{len(corners)} triangles are taken as they are seen from above", *((Y_UP,) if flat else ()))
    return Raster(raster.heights, raster.cell_size, raster.origin, notes=notes)


def _in_metres(points: Points, up: str | None, options: DemOptions) -> tuple[np.ndarray, ...]:
    """Returns x to the east, y to the north and z up, [n] float64, and which points have a height; refuses coarse
    steps.
    """
    east, north, height = (points.x, points.z, points.y) if up == "y" else (points.x, points.y, points.z)
    scale = options.height_scale or 1.0
    with np.errstate(invalid="ignore"):  # of a NaN that signals, in damaged files
        z = height.astype(np.float64)
        metres = z * scale
    known = ~np.isnan(z)
    if options.nodata is not None:
        known &= ~np.isclose(z, options.nodata, rtol=1e-6, atol=1e-6)
    for name, values in zip("xyz", points[:3], strict=True):
        require_fine_steps(name, values[known], scale if values is height else 1.0)
    y = north.astype(np.float64)
    return east.astype(np.float64), -y if up == "y" else y, metres, known


def _require_site(x: np.ndarray, y: np.ndarray, z: np.ndarray, grid: Grid) -> None:
    """Refuses heights that are none, and coordinates that are not finite or look like degrees."""
    require_heights(z)
    for name, values in (("x", x), ("y", y)):
        near = np.abs(values) < 1e9
        if not near.all():
            raise InputError(f"{name} = {values[~near][0]:g}: must be finite, below 1e9 m")
    east, north = (float(np.subtract(*np.quantile(values, (0.95, 0.05)))) for values in (x, y))
    middle = float(np.median(x)), float(np.median(y))
    if max(east, north) < grid.size / 10 and abs(middle[0]) <= 180 and abs(middle[1]) <= 90:
        raise InputError(
            f"x, y = {middle[0]:.6g}, {middle[1]:.6g} within {east:.3g} x {north:.3g}: look like degrees; must be "
            "metres (reproject to a UTM zone, say)"
        )


def _lies_along_z(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> bool:
    """Tells whether points lie on a surface over x and z rather than over x and y, as where y points up."""
    some = slice(None, None, max(1, len(x) // 20_000))
    x, y, z = x[some], y[some], z[some]
    across, along, high = (float(np.subtract(*np.quantile(values, (0.99, 0.01)))) for values in (x, y, z))
    if along > 0.7 * min(across, high):
        return False
    edge = max(across, high) / 32
    if not edge:
        return False
    return _spread(x, y, z, edge) > 3 * _spread(x, z, y, edge)


def _spread(one: np.ndarray, other: np.ndarray, height: np.ndarray, edge: float) -> float:
    """Returns the standard deviation of the heights within square cells."""
    cells = np.floor(np.stack([one, other], axis=1) / edge).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    held = np.bincount(cell.ravel())
    mean = np.bincount(cell.ravel(), height) / held
    return float(np.sqrt(np.mean((height - mean[cell.ravel()]) ** 2)))
