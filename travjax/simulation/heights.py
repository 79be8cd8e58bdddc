"""Checks the heights of maps that callers pass, and converts them to float32 maps for the kernel (SPEC section 1)."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from travjax.config import InputError
from travjax.simulation.arrays import are_numbers, numbers
from travjax.simulation.grid import HIGHEST, MARKERS, Grid, require_grid

COARSEST = 0.05
"""Metres: coarser heights of a two-byte type are refused; bfloat16 is coarser from 8 m on, float16 from 64 m."""

Heights = Float[Array, "*n rows cols"] | Float[np.ndarray, "*n rows cols"]


def as_maps(heights: Any, grid: Grid) -> tuple[Float[Array, "n rows cols"], bool]:
    """Returns checked float32 maps with a leading axis, and whether the input was one map without that axis.

    float64 heights are taken relative to each map's centre before they become float32. Masked and missing nodes are
    unknown. The values of a jax array are not checked, since that would wait for the device: its infinite or absurd
    heights, and those equal to a common marker of unknown ground, count as unknown.
    Raises InputError when heights are not numbers in the grid's shape, and when heights of any other kind of array are
    infinite, beyond 30 km, a common marker of unknown ground (grid.MARKERS), or in steps larger than COARSEST.
    """
    require_grid(grid)
    if not isinstance(heights, jax.Array):
        heights = numbers("heights", heights, "numbers (metres)")
    elif not are_numbers(heights.dtype):
        raise InputError(f"heights: dtype {heights.dtype}: must be numbers (metres)")
    if heights.ndim not in (2, 3) or heights.shape[-2:] != grid.shape:
        allowed = f"[{grid.nodes}, {grid.nodes}] or [n, {grid.nodes}, {grid.nodes}]"
        raise InputError(
            f"heights: shape {list(heights.shape)}: must be {allowed}, a {grid.size:g} m map at {grid.spacing:g} m"
        )
    if heights.size == 0:
        raise InputError("heights: zero maps: must be at least one")
    maps = heights.reshape(-1, *grid.shape)
    if isinstance(maps, np.ndarray):
        _require_ground(maps)
        require_close(maps)
        if maps.dtype != np.float32:
            maps = _relative(maps.astype(np.float64), grid)
    elif maps.dtype == np.float64:
        with jax.enable_x64(True):
            maps = _relative(_unmarked(maps), grid).astype(jnp.float32)
    else:
        maps = _unmarked(maps)
    return jnp.asarray(maps, jnp.float32), heights.ndim == 2


def as_site(heights: Any) -> tuple[Float[np.ndarray, "rows cols"], float]:
    """Returns a checked float32 raster of any size, NaN where unknown, above its median in whole metres, and that.

    Raises InputError when heights are not numbers in two dimensions, and for impossible ones, as `as_maps` does.
    """
    array = np.asarray(numbers("heights", heights, "numbers (metres)"))
    if array.ndim != 2 or array.size == 0:
        raise InputError(f"heights: shape {list(array.shape)}: must be [rows, cols], one raster")
    _require_ground(array)
    require_close(array)
    known = array[np.isfinite(array)]
    level = np.round(np.median(known)) if known.size else 0.0
    return (array - level).astype(np.float32), float(level)


@jax.jit
def _unmarked(maps: jax.Array) -> jax.Array:
    """Replaces common markers of unknown ground by NaN; runs on the device, without waiting for the result."""
    heights = maps if maps.dtype == np.float64 else maps.astype(jnp.float32)
    marked = heights == MARKERS[0]
    for mark in MARKERS[1:]:
        marked |= heights == mark
    return jnp.where(marked, jnp.nan, heights)


def require_close(maps: np.ndarray) -> None:
    """Raises InputError for heights whose number type has coarse steps at that height, so that ground would be flat."""
    if maps.dtype.kind in "iu" or maps.dtype.itemsize > 2:
        return
    values = np.abs(maps.astype(np.float32))
    largest = np.max(values[values <= HIGHEST], initial=0)
    step = float(np.exp2(np.floor(np.log2(max(largest, 1e-6)))) * jnp.finfo(maps.dtype).eps)
    if step > COARSEST:
        raise InputError(
            f"heights = {largest:g}: is stored in steps of {step:g} m ({maps.dtype}): must be float32 or float64, or "
            "relative to a height nearby"
        )


def _require_ground(maps: np.ndarray) -> None:
    """Raises InputError for impossible heights, and for undeclared markers of unknown ground."""
    exact = maps.dtype.itemsize > 2 or maps.dtype.kind in "iu"
    with np.errstate(over="ignore"):
        marks = np.asarray(MARKERS, np.float64) if exact else np.asarray(MARKERS).astype(maps.dtype).astype(np.float64)
    values = maps if maps.dtype == np.float32 else maps.astype(np.float64)
    least = np.abs(marks).min()
    if not (np.fmax.reduce(values, axis=None) >= least or np.fmin.reduce(values, axis=None) <= -least):
        return
    values = values[np.abs(values) >= least]
    for bad in values[np.abs(values) > HIGHEST][:1]:
        allowed = f"metres between {-HIGHEST:g} and {HIGHEST:g}, or NaN where unknown"
        raise InputError(f"heights = {bad:g}: must be {allowed}")
    for bad in values[np.isin(np.round(values, 6), marks)][:1]:
        raise InputError(f"heights = {bad:g}: is a usual mark of unknown ground; must be metres, or NaN where unknown")


def _relative(maps, grid: Grid):
    """Returns heights [n, rows, cols] relative to the centre of each map, where the centre is known."""
    centre = maps[:, grid.cells // 2, grid.cells // 2, None, None]
    use = jnp if isinstance(maps, jax.Array) else np
    return maps - use.where(abs(centre) <= HIGHEST, centre, 0.0)
