"""Drives many trajectories of many maps, on all cores, and goes on after an interruption.

A map is one piece of work, and its outcomes are one small file in the output folder until all are there.
"""

import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import map_coordinates

from travjax.config import InputError, require, to_json
from travjax.files import save_text
from travjax.physics.drive import OUTCOMES, VERSION, Driver
from travjax.physics.model import build, mujoco
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.physics_table import PhysicsConfig
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup

ARRIVED = ""


@dataclass(frozen=True)
class Outcomes:
    """What became of trajectories, [k] each.

    map, trajectory: which they are
    outcome: index in ("", *OUTCOMES), 0 for those that arrived
    station: metres, how far each came; tilt: radians, how far it leaned
    deviation: metres, how far its centre was from the path
    """

    map: Int[np.ndarray, " k"]
    trajectory: Int[np.ndarray, " k"]
    outcome: Int[np.ndarray, " k"]
    station: Float[np.ndarray, " k"]
    tilt: Float[np.ndarray, " k"]
    deviation: Float[np.ndarray, " k"]

    @property
    def started(self) -> np.ndarray:
        """Whether the robot stood at the start."""
        return self.outcome != 1 + OUTCOMES.index("bad_start")

    @property
    def failed(self) -> np.ndarray:
        """Whether the trajectory failed, of those that started."""
        return (self.outcome > 0) & self.started


@dataclass(frozen=True)
class Variation:
    """A small change, to see how repeatable outcomes are: of friction, as a factor, and of the start, metres."""

    friction: float = 1.0
    aside: float = 0.0


def label_physics(
    heights: Float[np.ndarray, "n r c"],
    wanted: Sequence[Int[np.ndarray, " t"]],
    setup: Setup,
    physics: PhysicsConfig,
    folder: Path,
    processes: int | None = None,
    variations: Sequence[Variation] | None = None,
    on_progress: Callable[[int], object] = lambda count: None,
) -> Outcomes:
    """Drives the wanted trajectories of each map, and returns their outcomes in the order of maps.

    heights: metres without unknown nodes; wanted: of each map
    folder:  takes one file a map; those that are there are not driven again
    variations: of each map; none unless given
    on_progress: is told how many trajectories were added
    Raises InputError when MuJoCo is missing, or a file in the folder is of other settings.
    """
    mujoco()
    variations = variations or [Variation()] * len(heights)
    key = {"version": VERSION, "setup": setup.to_json(), "physics": to_json(physics)}
    pieces = [
        _Piece(heights[i], np.sort(np.asarray(wanted[i])).tolist(), setup, physics, variations[i])
        for i in range(len(heights))
    ]
    paths = [folder / f"map_{index:05d}.json" for index in range(len(pieces))]
    folder.mkdir(parents=True, exist_ok=True)
    driven: dict[int, list] = {}
    missing = []
    for index, (piece, path) in enumerate(zip(pieces, paths, strict=True)):
        if path.exists():
            driven[index] = _read(path, key | piece.named())
            on_progress(len(piece.trajectories))
        elif piece.trajectories:
            missing.append(index)
    workers = min(processes or os.cpu_count() or 1, max(1, len(missing)))
    if missing:
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
            running = {pool.submit(_drive, pieces[index]): index for index in missing}
            for future in as_completed(running):
                index = running[future]
                driven[index] = future.result()
                save_text(paths[index], json.dumps(key | pieces[index].named() | {"outcomes": driven[index]}))
                on_progress(len(pieces[index].trajectories))
    return _outcomes([(index, *row) for index in sorted(driven) for row in driven[index]])


def label_ground(
    heights: Float[np.ndarray, "r c"],
    trajectories: Sequence[int],
    robot: Robot,
    physics: PhysicsConfig,
    actions: ActionSpace,
    grid: Grid,
) -> Outcomes:
    """Drives a few trajectories of one map in this process."""
    piece = _Piece(heights, sorted(trajectories), Setup(robot, actions, grid), physics, Variation())
    return _outcomes([(0, *row) for row in _drive(piece)])


def _outcomes(rows: list[tuple]) -> Outcomes:
    columns = list(zip(*rows, strict=True)) or [()] * 6
    kinds = (int, int, int, float, float, float)
    return Outcomes(*(np.array(column, kind) for column, kind in zip(columns, kinds, strict=True)))


@dataclass(frozen=True)
class _Piece:
    """One map's work."""

    heights: np.ndarray
    trajectories: list[int]
    setup: Setup
    physics: PhysicsConfig
    variation: Variation

    def named(self) -> dict[str, Any]:
        """Returns what tells this piece from another, for JSON."""
        checksum = float(np.asarray(self.heights, np.float64).sum())
        return {"trajectories": self.trajectories, "variation": asdict(self.variation), "heights": round(checksum, 6)}


def _read(path: Path, wanted: dict[str, Any]) -> list:
    """Returns the outcomes in a file; raises InputError where it is damaged or of other settings."""
    try:
        saved = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {error}") from None
    for name, value in wanted.items():
        same = json.loads(json.dumps(value)) == saved.get(name)
        require(same, f"{path}: {name}", "other", "as in this run; allowed: another folder")
    return saved["outcomes"]


def _drive(piece: _Piece) -> list[tuple[int, int, float, float, float]]:
    """Drives the trajectories of one map: (trajectory, outcome, station, tilt, deviation) each."""
    setup, grid, actions = piece.setup, piece.setup.grid, piece.setup.actions
    heights = np.asarray(piece.heights, np.float64)
    physics = PhysicsConfig(**(vars(piece.physics) | {"friction": piece.physics.friction * piece.variation.friction}))
    world = build(heights, grid.spacing, setup.robot, physics)
    turn, first, second = actions.split(np.array(piece.trajectories))
    groups: dict[tuple[int, int], list[int]] = {}
    for t, f, s in zip(turn.tolist(), first.tolist(), second.tolist(), strict=True):
        groups.setdefault((t, f), []).append(s)

    def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        places = [np.asarray(v) / grid.spacing + grid.cells / 2 for v in (y, x)]
        return map_coordinates(heights, places, order=1, mode="nearest")

    results = Driver(world, setup.robot, physics, actions, piece.variation.aside).drive(groups, ground)
    names = (ARRIVED, *OUTCOMES)
    return [(index, names.index(one.outcome), *one[1:]) for index, one in sorted(results.items())]
