"""Synthetic terrain: five styles of the paper's Algorithm 1 (SPEC section 2), and rock fields beside them.

A style and a seed give the parameters and the noise seed; these give the map. Plains and mountains are two noise
fields, mixed by a third one: Z = plains * w + mountains * (1 - w). All three share one noise seed.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from travjax.batching import BATCH, in_batches
from travjax.config import InputError, require, require_number
from travjax.jax_flags import key_of, usual_flags
from travjax.simulation.arrays import integers, numbers
from travjax.simulation.grid import Grid, require_grid
from travjax.terrain.noise import SEEDS, noise_on_axes, permutation_table
from travjax.terrain.rock_field import STYLE as ROCK_FIELD
from travjax.terrain.rock_field import rock_fields


@partial(
    jax.tree_util.register_dataclass,
    data_fields=[
        "perc_obstacles",
        "smooth_transition",
        "distribution_x",
        "distribution_y",
        "height_obstacles",
        "smooth_mountains",
        "smooth_plains",
        "slopes_variation",
        "max_slope_variation",
    ],
    meta_fields=[],
)
@dataclass(frozen=True)
class TerrainParams:
    """Parameters of Algorithm 1: numbers for one map, [n] arrays for n maps.

    perc_obstacles, smooth_transition: where the mixing noise (0 to 1) turns from mountains to plains, and how softly
    distribution_x, distribution_y:    0 to 1, how often plains and mountains alternate along x and y
    height_obstacles:                  metres, height of the mountains (negative for craters)
    smooth_mountains, smooth_plains:   0 to 1, feature size from 1/M to M metres, M the map size or the `world`; the
                                       style mountain_crater draws smooth_mountains up to 6
    slopes_variation:                  exponent of the plains
    max_slope_variation:               scale of the plains
    """

    perc_obstacles: Float[Array, "*n"]
    smooth_transition: Float[Array, "*n"]
    distribution_x: Float[Array, "*n"]
    distribution_y: Float[Array, "*n"]
    height_obstacles: Float[Array, "*n"]
    smooth_mountains: Float[Array, "*n"]
    smooth_plains: Float[Array, "*n"]
    slopes_variation: Float[Array, "*n"]
    max_slope_variation: Float[Array, "*n"]


FIELDS = tuple(field.name for field in dataclasses.fields(TerrainParams))

_CRATER = dict(
    perc_obstacles=(0.15, 0.2),
    smooth_transition=(0.2, 1),
    distribution_x=(0.05, 0.1),
    distribution_y=(0.05, 0.1),
    smooth_mountains=(1, 6),
    smooth_plains=(0.3, 1),
    slopes_variation=(0.05, 0.5),
    max_slope_variation=0.3,
)
_SMOOTH = dict(
    perc_obstacles=(0.05, 0.1),
    smooth_transition=0.3,
    distribution_x=0.85,
    distribution_y=0.85,
    height_obstacles=0.5,
    smooth_mountains=0.2,
    smooth_plains=(0.4, 0.9),
    slopes_variation=(0.08, 0.8),
    max_slope_variation=(0.08, 0.4),
)
_ROUGH = dict(
    perc_obstacles=(0.1, 0.15),
    smooth_transition=0.1,
    distribution_x=(0.7, 0.85),
    distribution_y=(0.7, 0.85),
    height_obstacles=(0.5, 1.5),
    smooth_mountains=0.1,
    smooth_plains=(0.03, 0.05),
    slopes_variation=(0.03, 0.06),
    max_slope_variation=(0.05, 0.5),
)
_WAVY = dict(
    perc_obstacles=0.1,
    smooth_transition=0.1,
    distribution_x=0.7,
    distribution_y=0.7,
    height_obstacles=1,
    smooth_mountains=0.1,
    max_slope_variation=0.5,
)
_SHARP = dict(
    perc_obstacles=(0.1, 0.17),
    smooth_transition=0.3,
    distribution_x=(0.85, 0.9),
    distribution_y=(0.85, 0.9),
    height_obstacles=(0.3, 2.5),
    smooth_mountains=(0.1, 0.2),
    smooth_plains=0.4,
    slopes_variation=0.5,
    max_slope_variation=0.4,
)
RANGES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "mountain_crater": (_CRATER | dict(height_obstacles=(2, 6)), _CRATER | dict(height_obstacles=(-6, -2))),
    "smooth": (_SMOOTH, _SMOOTH),
    "rough": (_ROUGH, _ROUGH),
    "wavy": (
        _WAVY | dict(smooth_plains=(0.3, 0.35), slopes_variation=(0.45, 0.55)),
        _WAVY | dict(smooth_plains=(0.4, 0.7), slopes_variation=(0.8, 1)),
    ),
    "scattered_sharp": (_SHARP, _SHARP),
}
"""For the two halves of each style's maps, parameters as numbers or ends of uniform distributions (SPEC section 2)."""

STYLES = tuple(RANGES)

_LIMITS = np.array(
    [[[np.broadcast_to(half[field], 2) for field in FIELDS] for half in halves] for halves in RANGES.values()],
    np.float32,
)
"""RANGES as an array: [style, half, field, (low, high)]."""


@usual_flags()
def generate_terrain(
    style: str | Sequence[str], seeds, *, grid: Grid = Grid(), world: float | None = None
) -> Float[Array, "n rows cols"]:
    """Makes maps of a style, one for each seed; the same (style, seed) gives the same map in any batch.

    style: one of STYLES, or a sequence with one for each seed; or rock_field.STYLE for all of them
    seeds: integers in [0, 2^32): a sequence, a range or one number
    world: as `elevation` takes it; none for rock fields
    Returns heights [n, rows, cols] in metres. Source: the paper's Algorithm 1, or the sources of landforms.py.
    Raises InputError for an unknown style, no or bad seeds, different numbers of styles and seeds, or a bad world.
    """
    if are_rock_fields([style] if isinstance(style, str) else list(style), world):
        _, numbered = _styles_and_seeds(style, seeds, (ROCK_FIELD,))
        require_grid(grid)
        return jnp.asarray(rock_fields(numbered.tolist(), grid))
    return elevation(*sample_params(style, seeds), grid=grid, world=world)


@usual_flags()
def sample_params(style: str | Sequence[str], seeds) -> tuple[TerrainParams, Int[Array, " n"]]:
    """Draws the parameters [n] and noise seeds [n] of the maps that `generate_terrain` makes; same arguments and
    errors.
    """
    styles, numbered = _styles_and_seeds(style, seeds, STYLES)
    index = np.array([STYLES.index(name) for name in styles], np.uint32)
    fill = (0, -len(index) % BATCH)  # drawing takes no time, but each other size would take seconds to compile
    pairs = np.pad(index, fill), np.pad(numbered.astype(np.uint32), fill)
    values, noise_seeds = (drawn[: len(index)] for drawn in in_batches(lambda pair: _sample(*pair), pairs))
    return TerrainParams(*values.T), noise_seeds


def are_rock_fields(styles: Sequence[str], world: float | None) -> bool:
    """Tells whether maps of these styles are rock fields.

    Raises InputError when some are and others are not, and when a world is given for them.
    """
    if ROCK_FIELD not in styles:
        return False
    others = [style for style in dict.fromkeys(styles) if style != ROCK_FIELD]
    require(not others, f"style beside {ROCK_FIELD}", others, "left out: its maps are made by parameters of their own")
    require(world is None, "world", world, f"left out for {ROCK_FIELD}, whose features have sizes of their own")
    return True


def _styles_and_seeds(style: str | Sequence[str], seeds: Any, known: Sequence[str]) -> tuple[list[str], np.ndarray]:
    """Returns the style and the seed of each map, [n] each; raises InputError for bad ones."""
    allowed = f"one or more integers from 0 to {2**32 - 1}"
    numbered = np.atleast_1d(integers("seeds", seeds, allowed, 0, 2**32 - 1))
    require(numbered.ndim == 1, "seeds", seeds, allowed)
    styles = [style] * len(numbered) if isinstance(style, str) else list(style)
    for name in set(styles):
        require(name in known, "style", name, f"one of {', '.join(known)}")
    require(
        len(styles) == len(numbered), "style", f"{len(styles)} styles for {len(numbered)} seeds", "one, or one a seed"
    )
    return styles, numbered


@jax.jit
def _sample(style, seed):
    def sample_one(style, seed):
        key = jax.random.fold_in(key_of(seed), style)
        for_half, for_values, for_noise = jax.random.split(key, 3)
        half = jax.random.bernoulli(for_half, jnp.float32(0.5)).astype(jnp.int32)
        low, high = jnp.asarray(_LIMITS)[style, half].T
        values = low + (high - low) * jax.random.uniform(for_values, (len(FIELDS),), jnp.float32)
        return values, jax.random.randint(for_noise, (), 0, SEEDS, jnp.int32)

    return jax.vmap(sample_one)(style, seed)


def require_world(world: float | None) -> None:
    """Raises InputError unless `world` is None or a map size that features may be derived from."""
    if world is not None:
        require_number("world", world, math.nextafter(1, 0), 1000, "a map size in metres from 1 to 1000")


def world_note(world: float | None, grid: Grid) -> str | None:
    """Returns a line on the map size that sets the size of features, where it is not obvious, or None.

    Raises InputError for a bad world.
    """
    require_world(world)
    if world is not None and world != grid.size:
        return f"synthetic maps of {grid.size:g} m with the features of {world:g} m maps"
    if grid.size == Grid().size:
        return None
    paper = f"a world of {Grid().size:g} m makes the ground of the paper's {Grid().size:g} m maps"
    return f"synthetic maps of {grid.size:g} m: their features grow with the map; {paper}"


@usual_flags()
def elevation(
    params: TerrainParams, noise_seed, *, grid: Grid = Grid(), world: float | None = None
) -> Float[Array, "*n rows cols"]:
    """Evaluates Algorithm 1 for given parameters: [rows, cols] for numbers, [n, rows, cols] for [n] arrays; metres.

    noise_seed: an integer in [0, 10000), or [n] of them; their values and those of the parameters are
                checked, so this cannot run under `jit`
    world:      metres, the map size M from which features are derived; the grid's own unless given. Maps of one world
                and different sizes agree where they overlap
    Raises InputError when the noise seed, a parameter that shapes the noise, or the world lies outside what is allowed.
    """
    require_grid(grid)
    require_world(world)
    seeds = integers("noise_seed", noise_seed, f"an integer from 0 to {SEEDS - 1}", 0, SEEDS - 1)
    values = [numbers(field, getattr(params, field)).astype(np.float32) for field in FIELDS]
    for field, value in zip(FIELDS, values, strict=True):
        if not np.isfinite(value).all():
            raise InputError(f"{field} = {getattr(params, field)}: must be finite")
        if field.startswith("distribution"):
            require(bool((value >= 0).all() and (value <= 1).all()), field, getattr(params, field), "from 0 to 1")
        elif field != "height_obstacles":
            require(bool((value >= 0).all()), field, getattr(params, field), "at least 0")
    shape = np.broadcast_shapes(seeds.shape, *(value.shape for value in values))
    require(len(shape) < 2, "params", f"arrays of shape {shape}", "numbers or [n] arrays")
    columns = [jnp.asarray(np.broadcast_to(value, shape).reshape(-1)) for value in (*values, seeds.astype(np.int32))]
    batched = (TerrainParams(*columns[:-1]), columns[-1])
    size = grid.size if world is None else float(world)
    maps = in_batches(lambda batch: _elevation(*batch, permutation_table(), grid, size), batched)
    return maps if shape else maps[0]


@partial(jax.jit, static_argnames=("grid", "world"))
def _elevation(params: TerrainParams, noise_seeds, permutations, grid: Grid, world: float):
    return jax.vmap(lambda one, seed: _elevation_of_one(one, permutations[seed], grid, world))(params, noise_seeds)


def _elevation_of_one(params: TerrainParams, permutation, grid: Grid, world: float) -> Float[Array, "rows cols"]:
    axis = jnp.asarray(grid.axis(), jnp.float32)
    smallest, largest = 1 / world, world

    def noise(feature_x, feature_y):
        reach = grid.size / 2 / smallest
        return noise_on_axes(permutation, axis / feature_x, axis / feature_y, reach)

    mix = (noise(*(largest - (largest - smallest) * d for d in (params.distribution_x, params.distribution_y))) + 1) / 2
    start = params.perc_obstacles - 0.2 * params.smooth_transition
    end = params.perc_obstacles + 0.2 * params.smooth_transition
    between = (mix - start) / jnp.where(end > start, end - start, 1.0)
    weight = jnp.where(mix < start, 0.0, jnp.where(mix > end, 1.0, between))

    feature = (largest - smallest) * params.smooth_plains + smallest
    base = jnp.maximum(noise(feature, feature) + 1, 0) * params.max_slope_variation * 0.15 * world
    plains = base**params.slopes_variation - 0.8

    feature = (largest - smallest) * params.smooth_mountains + smallest
    mountains = (noise(feature, feature) + 1) / 2 * params.height_obstacles
    return plains * weight + mountains * (1 - weight)
