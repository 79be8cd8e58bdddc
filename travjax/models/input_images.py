"""The network's input for a map and a trajectory: three channels (SPEC section 6, the paper's Fig. 1).

1. elevation:  height above the robot's, in units of `elevation_scale` metres, clipped to [-LIMIT, LIMIT]
2. trajectory: 1 on the path of the robot's centre, falling to 0 half a track away
3. wheels:     the same for the four wheel paths, half a wheel's width wide; 1 where a front and a rear wheel both pass

Channels 2 and 3 do not depend on the map. They are drawn once for all trajectories of an action space and kept as the
bank, in bytes (255 stands for 1); images are assembled on the device. Rows and columns are those of grid.py.
"""

import hashlib
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from travjax.config import InputError, require, require_number
from travjax.files import cache_folder, save_npz
from travjax.jax_flags import usual_flags
from travjax.simulation.actions import ActionSpace
from travjax.simulation.arrays import integers
from travjax.simulation.grid import HIGHEST, Grid
from travjax.simulation.heights import Heights, as_maps
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup

CHANNELS = ("elevation", "trajectory", "wheels")

LIMIT = 4.0
"""Largest value of the elevation channel, and of its negative."""

FORMAT = 1
"""Version of the bank's file; raise it when the drawing of channels changes."""

STRAIGHT = 1e6
"""Metres: radius that stands for a straight line; over 10 m it is off by 13 micrometres."""

TRAJECTORIES_AT_ONCE = 16
"""Arcs drawn at once, so that their distances fit in the second-level cache."""


@usual_flags()
def render_inputs(
    heights: Heights,
    map_index,
    trajectory_index,
    robot: Robot | str | None = None,
    actions: ActionSpace | None = None,
    *,
    grid: Grid = Grid(),
    elevation_scale: float = 1.0,
) -> Float[Array, "*b rows cols 3"]:
    """Returns the network's inputs for samples of maps and trajectories.

    heights:          [n, rows, cols] or [rows, cols] metres, NaN unknown, as for `simulate`
    map_index:        [b] integers or one integer, the map of each sample
    trajectory_index: [b] integers or one integer, the trajectory of each sample
    robot, actions:   the Seekur Jr and the paper's action space unless given
    elevation_scale:  metres that count as 1 in the elevation channel
    Returns [b, rows, cols, 3] in the order of CHANNELS, without b where both indices are single numbers. Source: SPEC
    section 6.
    Raises InputError as `simulate` does, for indices that are not integers or are out of range, and for a scale that is
    not above 0.
    """
    maps, _ = as_maps(heights, grid)
    setup = Setup.chosen(robot, actions, grid)
    require_number("elevation_scale", elevation_scale, 0, np.inf, "a length in metres above 0")
    setup.node_table()  # raises where robot, actions and grid do not fit together
    of_map = _checked_index("map_index", map_index, len(maps))
    of_trajectory = _checked_index("trajectory_index", trajectory_index, len(setup.actions))
    if of_map.ndim and of_trajectory.ndim and of_map.shape != of_trajectory.shape:
        raise InputError(
            f"map_index, trajectory_index: {of_map.size} and {of_trajectory.size} samples: must be as many of both"
        )
    drawn, place = np.unique(of_trajectory, return_inverse=True)
    channels = trajectory_channels(setup, drawn)
    of_map, place = np.broadcast_arrays(of_map, place.reshape(of_trajectory.shape))
    images = assemble(maps, channels, np.atleast_1d(of_map), np.atleast_1d(place), elevation_scale)
    return images if of_map.ndim else images[0]


def _checked_index(name: str, index, count: int) -> np.ndarray:
    allowed = f"an integer, or a list of integers, from 0 to {count - 1}"
    numbered = integers(name, index, allowed, 0, count - 1)
    require(numbered.ndim < 2, name, index, allowed)
    return numbered


@partial(jax.tree_util.register_dataclass, data_fields=["heights", "bank", "elevation_scale"], meta_fields=[])
@dataclass(frozen=True)
class ImageSource:
    """The arrays on the device that images are assembled from.

    heights: [n, rows, cols] metres; bank: [t, rows, cols, 2] bytes; elevation_scale: metres that count as 1
    """

    heights: Float[Array, "n rows cols"] | Float[np.ndarray, "n rows cols"]
    bank: UInt8[Array, "t rows cols 2"] | UInt8[np.ndarray, "t rows cols 2"]
    elevation_scale: float | np.float32

    @staticmethod
    def from_maps(
        heights: Float[np.ndarray, "n rows cols"],
        setup: Setup,
        elevation_scale: float,
        on_progress: Callable[[int], object] = lambda count: None,
    ) -> "ImageSource":
        """Makes the source of all trajectories on maps; the arguments are those of `trajectory_bank`, which it
        calls.
        """
        bank = trajectory_bank(setup, on_progress=on_progress)
        return ImageSource(heights, bank, np.float32(elevation_scale))

    def images(self, map_index: Int[Array, " b"], trajectory_index: Int[Array, " b"]) -> Float[Array, "b rows cols 3"]:
        """Returns images of samples, as `assemble` does."""
        return assemble(self.heights, self.bank, map_index, trajectory_index, self.elevation_scale)


@jax.jit
def assemble(
    heights: Float[Array, "n rows cols"] | Float[np.ndarray, "n rows cols"],
    bank: UInt8[Array, "t rows cols 2"] | UInt8[np.ndarray, "t rows cols 2"],
    map_index: Int[Array, " b"],
    trajectory_index: Int[Array, " b"],
    elevation_scale: float | np.float32 = 1.0,
) -> Float[Array, "b rows cols 3"]:
    """Assembles images of samples on the device: the map's elevation channel and the trajectory's two of the bank."""
    elevation = elevation_channel(heights[map_index], elevation_scale)
    channels = bank[trajectory_index].astype(jnp.float32) / 255
    return jnp.concatenate([elevation[..., None], channels], axis=-1)


def elevation_channel(
    heights: Float[Array, "b rows cols"], scale: float | np.float32 | Float[Array, ""] = 1.0
) -> Float[Array, "b rows cols"]:
    """Returns heights above the robot's in units of `scale` metres, clipped; unknown ground is 0.

    Where the centre is unknown, the nearest known node's height stands for it.
    """
    rows, cols = heights.shape[1:]
    flat = heights.reshape(len(heights), -1)
    y = jnp.arange(rows, dtype=jnp.int32)[:, None] - rows // 2
    x = jnp.arange(cols, dtype=jnp.int32) - cols // 2
    distance = (x * x + y * y).reshape(-1)
    known = jnp.abs(flat) <= HIGHEST
    nearest = jnp.argmin(jnp.where(known, distance, jnp.iinfo(distance.dtype).max), axis=1)
    level = jnp.take_along_axis(flat, nearest[:, None], axis=1)
    return jnp.where(known, jnp.clip((flat - level) / scale, -LIMIT, LIMIT), 0.0).reshape(heights.shape)


def trajectory_bank(
    setup: Setup,
    *,
    cache: Path | None = None,
    on_progress: Callable[[int], object] = lambda count: None,
) -> UInt8[np.ndarray, "t rows cols 2"]:
    """Returns channels 2 and 3 of every trajectory: 101 MB for the paper's action space.

    cache: folder that keeps it, with one file for each configuration (the user's cache unless given); a damaged file
           is made again, and nothing is kept where the folder cannot be written to or there is no cache
    on_progress: is told how many trajectories were added
    """
    robot, actions, grid = setup.robot, setup.actions, setup.grid
    configuration = repr((FORMAT, robot.track, robot.wheelbase, robot.wheel_width, actions, grid))
    name = f"bank-{hashlib.sha256(configuration.encode()).hexdigest()[:16]}.npz"
    folder = cache_folder() if cache is None else cache
    bank = _read_bank(folder / name, configuration) if folder else None
    if bank is not None:
        on_progress(len(actions))
        return bank
    bank = np.empty((len(actions), *grid.shape, 2), np.uint8)
    block = len(actions.radii) ** 2
    for start in range(0, len(actions), block):
        numbers = np.arange(start, start + block)
        bank[numbers] = trajectory_channels(setup, numbers)
        on_progress(block)
    if folder:
        with suppress(InputError, OSError):  # it is made again next time
            folder.mkdir(parents=True, exist_ok=True)
            save_npz(folder / name, bank=bank, configuration=configuration)
    return bank


def _read_bank(path: Path, configuration: str) -> np.ndarray | None:
    """Reads the bank of a file; returns None unless its checksums match and it has this configuration."""
    try:
        with path.open("rb") as file:
            archive = np.load(file)
            return archive["bank"] if str(archive["configuration"]) == configuration else None
    except (OSError, ValueError, EOFError, LookupError, zipfile.BadZipFile, zlib.error):
        return None


@usual_flags()
def trajectory_channels(setup: Setup, trajectories: Int[np.ndarray, " k"]) -> UInt8[np.ndarray, "k rows cols 2"]:
    """Draws channels 2 and 3 of some trajectories, with 255 for 1; a first arc is drawn once for all that share it."""
    robot, actions, grid = setup.robot, setup.actions, setup.grid
    turn, first, second = actions.split(np.asarray(trajectories))
    starts = actions.first_poses(turn, first)[:, [0, -1]]  # where the first and the second arc start
    widths = (robot.track / 2, robot.wheel_width / 2)
    shared, place = np.unique(turn * len(actions.radii) + first, return_index=True, return_inverse=True)[1:]
    arcs = partial(_arc_marks, robot=robot, widths=widths, grid=grid)
    radii = np.asarray(actions.radii)
    along_first = arcs(starts[shared, 0], radii[first[shared]], actions.arc_lengths[0])
    channels = np.empty((len(turn), *grid.shape, 2), np.uint8)
    for start in range(0, len(turn), TRAJECTORIES_AT_ONCE):
        part = slice(start, start + TRAJECTORIES_AT_ONCE)
        along_second = arcs(starts[part, 1], radii[second[part]], actions.arc_lengths[1])
        marks = np.maximum(along_first[place[part]], along_second)
        channels[part, ..., 0] = (marks[:, 0].astype(np.uint32) + 128) // 257
        front, rear = marks[:, 1:3].max(axis=1), marks[:, 3:5].max(axis=1)
        channels[part, ..., 1] = (front.astype(np.uint32) + rear + 257) // 514
    return channels


def _arc_marks(start, radius, length: float, *, robot: Robot, widths, grid: Grid) -> np.ndarray:
    """Draws the paths of the centre and the four wheels along arcs from `start` [k, 3] of signed `radius` [k].

    Returns [k, 5, rows, cols] uint16, where 65535 stands for 1.
    """
    marks = np.empty((len(start), 5, *grid.shape), np.uint16)
    offsets = ((0.0, 0.0), *robot.wheel_positions())
    reach = np.array([widths[0]] + [widths[1]] * 4, np.float32)
    paths = np.stack([_point_path(start, radius, length, *offset) for offset in offsets], axis=1).astype(np.float32)
    axis = grid.axis().astype(np.float32)
    for begin in range(0, len(start), TRAJECTORIES_AT_ONCE):
        chunk = paths[begin : begin + TRAJECTORIES_AT_ONCE]
        missing = TRAJECTORIES_AT_ONCE - len(chunk)
        padded = np.concatenate([chunk, np.repeat(chunk[:1], missing, axis=0)]) if missing else chunk
        marks[begin : begin + TRAJECTORIES_AT_ONCE] = _marks(padded, reach, axis)[: len(chunk)]
    return marks


def _point_path(start, radius, length: float, right: float, forward: float) -> np.ndarray:
    """Returns the arc that a point of the robot describes: [k, 6].

    The six numbers are x and y of its middle, its radius, the unit vector from the centre of its circle to its middle,
    and half its angle.
    """
    radius = np.copysign(np.minimum(np.abs(radius), STRAIGHT), radius)
    x, y, heading = start.T
    half = length / radius / 2
    # Seen from the centre of the circle, which is to the left of the robot, with the robot halfway along the arc.
    cos, sin = np.cos(heading + half), np.sin(heading + half)
    out_x, out_y = (radius + right) * cos - forward * sin, (radius + right) * sin + forward * cos
    distance = np.hypot(out_x, out_y)
    scale = 1 / np.maximum(distance, 1e-12)
    middle_x = x - radius * np.cos(heading) + out_x
    middle_y = y - radius * np.sin(heading) + out_y
    return np.stack([middle_x, middle_y, distance, out_x * scale, out_y * scale, np.abs(half)], axis=-1)


@jax.jit
def _marks(paths, reach, axis):
    """Computes g(d; h) times 65535 from each node's distance d to paths [k, 5, 6], h = reach [5]: [k, 5, rows,
    cols].
    """

    def mark(path, half_width):
        distance = _distance_to_arc(path, axis[None, :], axis[:, None])
        value = (jnp.exp(-3 * distance / half_width) - jnp.exp(-3.0)) / (1 - jnp.exp(-3.0))
        return jnp.round(65535 * jnp.maximum(value, 0)).astype(jnp.uint16)

    return jax.vmap(jax.vmap(mark), in_axes=(0, None))(paths, reach)


def _distance_to_arc(path, x, y):
    """Returns the distance to the circle within the arc's angle, elsewhere to the nearer of its ends.

    Nothing is measured from the circle's centre, which may lie far away.
    """
    dx, dy, radius, half = x - path[0], y - path[1], path[2], path[5]
    outward = dx * path[3] + dy * path[4]
    aside = jnp.abs(dy * path[3] - dx * path[4])
    from_centre = jnp.hypot(radius + outward, aside)
    to_circle = jnp.abs(dx * dx + dy * dy + 2 * radius * outward) / (from_centre + radius)
    to_end = jnp.hypot(outward + 2 * radius * jnp.sin(half / 2) ** 2, aside - radius * jnp.sin(half))
    return jnp.where(jnp.arctan2(aside, radius + outward) <= half, to_circle, to_end)
