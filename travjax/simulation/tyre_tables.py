"""Which grid nodes tyres and outline touch at given poses: the static tables behind the `tyre` contact model.

Poses -> the nodes of the four tyres, with the height of the tyre's surface above each, and the nodes of the outline,
with its underside above each, as NumPy arrays that depend only on robot, grid and poses (SPEC section 15). Everything
is computed in float64. footprint.py explains the letters in shapes; N is the number of poses.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from travjax.config import InputError, require
from travjax.simulation.footprint import TIE
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot

POSES_AT_ONCE = 2_000
"""Poses whose nodes are found at once: their candidates fit in the cache."""


@dataclass(frozen=True)
class Places:
    """Nodes near a place of the robot, as many for each, padded by repeating the last one.

    row, col: [N, K] int16, counted from the pose's `centre`
    height:   [N, K] float32 metres, of the robot's surface above the pose plane at the node
    """

    row: np.ndarray
    col: np.ndarray
    height: np.ndarray


@dataclass(frozen=True)
class TyreTable:
    """Nodes and constants of N poses; node = row * cols + col.

    centre:  [N] int32 node nearest to the robot's centre
    offset:  [N, 2] float32 vector from that node to the robot's centre, (x, y) in cells
    axes:    [N, 2] float32 cos and sin of the heading
    corner:  [N, 4] int32 node south-west of the centres of the wheels FL, FR, RL, RR
    within:  [N, 4, 2] float32 position of the wheel's centre in that cell, (x, y), 0 to 1
    tyres:   [4 N, K] nodes of the tyres, wheel by wheel of each pose
    outline: [N, K] nodes of the outline; `height` is that of the underside, less the ride height
    """

    centre: np.ndarray
    offset: np.ndarray
    axes: np.ndarray
    corner: np.ndarray
    within: np.ndarray
    tyres: Places
    outline: Places


def tyre_table(poses: np.ndarray, robot: Robot, grid: Grid) -> TyreTable:
    """Builds the table of poses [N, 3] (x, y in metres, heading in radians).

    Raises InputError when tyres or outline leave the map, or when no node lies under the outline.
    """
    require_inside(robot, poses, grid)
    x, y, heading = np.asarray(poses, float).T
    cos, sin = np.cos(heading), np.sin(heading)
    cells = np.stack([x, y], axis=-1) / grid.spacing + grid.cells / 2  # of the robot's centre: column, row
    centre = np.floor(cells + 0.5).astype(int)
    right, forward = np.array(robot.wheel_positions()).T
    wheels = cells[:, None] + _turned(right, forward, cos[:, None], sin[:, None]) / grid.spacing
    corner = np.clip(np.floor(wheels).astype(int), 0, grid.cells - 1)
    blocks = [slice(start, start + POSES_AT_ONCE) for start in range(0, len(x), POSES_AT_ONCE)]
    tyre, outline = _tyre_surface(robot, grid), _outline_surface(robot, grid)
    tyre_reach = math.hypot(robot.wheel_width + grid.spacing, robot.wheel_diameter + grid.spacing) / 2
    reach = math.hypot(robot.overall_width + grid.spacing, robot.overall_length + grid.spacing) / 2

    def of_tyres(block: slice) -> Places:
        count = len(cos[block])
        middle = np.repeat(centre[block], 4, axis=0)
        turned = np.repeat(cos[block], 4), np.repeat(sin[block], 4)
        return _places(wheels[block].reshape(4 * count, 2), middle, *turned, tyre, tyre_reach, grid)

    return TyreTable(
        centre=(centre[:, 1] * grid.nodes + centre[:, 0]).astype(np.int32),
        offset=(cells - centre).astype(np.float32),
        axes=np.stack([cos, sin], axis=-1).astype(np.float32),
        corner=(corner[..., 1] * grid.nodes + corner[..., 0]).astype(np.int32),
        within=(wheels - corner).astype(np.float32),
        tyres=_joined([of_tyres(block) for block in blocks]),
        outline=_joined([_places(cells[b], centre[b], cos[b], sin[b], outline, reach, grid) for b in blocks]),
    )


def require_inside(robot: Robot, poses: np.ndarray, grid: Grid) -> None:
    """Raises InputError when the overall outline, or a tyre, leaves the map at one of the poses [N, 3], or when the
    outline does not contain the chassis, or has ends that rise but is no longer than the wheelbase.
    """
    for name in ("length", "width"):
        overall, chassis = getattr(robot, f"overall_{name}"), getattr(robot, f"chassis_{name}")
        allowed = f'at least chassis_{name} = {chassis:g} m for the contact model "tyre"'
        require(overall >= chassis - TIE, f"overall_{name}", overall, allowed)
    longer = robot.nose_rise is None or robot.overall_length > robot.wheelbase
    require(longer, "nose_rise", robot.nose_rise, "left out where overall_length is at most the wheelbase")
    half_width = max(robot.overall_width, robot.track + robot.wheel_width) / 2
    half_length = max(robot.overall_length, robot.wheelbase + robot.wheel_diameter) / 2
    x, y, heading = np.asarray(poses, float).T
    cos, sin = np.abs(np.cos(heading)), np.abs(np.sin(heading))
    farthest = max(
        np.max(np.abs(x) + half_width * cos + half_length * sin),
        np.max(np.abs(y) + half_width * sin + half_length * cos),
    )
    if farthest > grid.size / 2 + TIE:
        raise InputError(
            f"size = {grid.size:g}: the robot's outline leaves the map by {farthest - grid.size / 2:g} m; allowed: "
            'arcs short enough to stay on it, a larger map (--size), or the contact model "nearest"'
        )


Surface = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""The height of a surface at places (right, forward) [m] of a wheel or robot; NaN where there is none."""


def _tyre_surface(robot: Robot, grid: Grid) -> Surface:
    radius, half_width, half_cell = robot.wheel_diameter / 2, robot.wheel_width / 2, grid.spacing / 2

    def drop(right: np.ndarray, forward: np.ndarray) -> np.ndarray:
        from_axle = np.clip(np.abs(forward) - half_cell, 0, radius)
        inside = (np.abs(right) <= half_width + half_cell + TIE) & (np.abs(forward) <= radius + half_cell + TIE)
        return np.where(inside, radius - np.sqrt(radius**2 - from_axle**2), np.nan)

    return drop


def _outline_surface(robot: Robot, grid: Grid) -> Surface:
    radius, half_width, half_cell = robot.wheel_diameter / 2, robot.wheel_width / 2, grid.spacing / 2
    overhang = 0.0 if robot.overhang_height is None else robot.overhang_height - robot.ride_height

    def underside(right: np.ndarray, forward: np.ndarray) -> np.ndarray:
        aside, along = np.abs(right), np.abs(forward)
        outline = aside <= robot.overall_width / 2 + half_cell + TIE
        outline &= along <= robot.overall_length / 2 + half_cell + TIE
        chassis = (aside <= robot.chassis_width / 2 + TIE) & (along <= robot.chassis_length / 2 + TIE)
        tyre = (np.abs(aside - robot.track / 2) <= half_width + TIE) & (
            np.abs(along - robot.wheelbase / 2) <= radius + TIE
        )
        rise = 0.0
        if robot.nose_rise is not None:
            end = (robot.overall_length - robot.wheelbase) / 2
            rise = robot.nose_rise * np.clip((along - robot.wheelbase / 2) / end, 0, 1)
        return np.where(outline & ~tyre, np.where(chassis, 0.0, overhang) + rise, np.nan)

    return underside


def _turned(right, forward, cos, sin) -> np.ndarray:
    """Turns (right, forward) of a robot into (east, north), stacked on the last axis."""
    return np.stack([right * cos - forward * sin, right * sin + forward * cos], axis=-1)


def _places(cells: np.ndarray, centre: np.ndarray, cos, sin, surface: Surface, reach: float, grid: Grid) -> Places:
    """Finds the nodes where a surface around `cells` (col, row) [N, 2] exists, counted from `centre` [N, 2]."""
    nearest = np.floor(cells + 0.5).astype(int)
    span = np.arange(-math.ceil(reach / grid.spacing) - 1, math.ceil(reach / grid.spacing) + 2)
    col, row = (axis.ravel() for axis in np.meshgrid(span, span))
    col, row = nearest[:, :1] + col, nearest[:, 1:] + row
    east, north = (col - cells[:, :1]) * grid.spacing, (row - cells[:, 1:]) * grid.spacing
    cos, sin = cos[:, None], sin[:, None]
    height = surface(east * cos + north * sin, north * cos - east * sin)
    on_map = (row >= 0) & (row <= grid.cells) & (col >= 0) & (col <= grid.cells)
    pose, place = np.nonzero(np.isfinite(height) & on_map)
    counts = np.bincount(pose, minlength=len(cells))
    if not counts.all():
        raise InputError(f"spacing = {grid.spacing:g}: too coarse for the robot, no node under its outline")
    col, row, height = col[pose, place], row[pose, place], height[pose, place]
    slot = np.minimum(np.arange(counts.max()), counts[:, None] - 1) + (np.cumsum(counts) - counts)[:, None]
    return Places(
        row=(row[slot] - centre[:, 1:]).astype(np.int16),
        col=(col[slot] - centre[:, :1]).astype(np.int16),
        height=height[slot].astype(np.float32),
    )


def _joined(parts: list[Places]) -> Places:
    """Joins the places of blocks of poses, which may have different numbers K."""
    most = max(part.row.shape[1] for part in parts)
    padded = [
        [np.pad(array, ((0, 0), (0, most - array.shape[1])), mode="edge") for array in vars(part).values()]
        for part in parts
    ]
    return Places(*(np.concatenate(arrays) for arrays in zip(*padded, strict=True)))
