"""The setup that labels are valid for: robot, action space and map grid together."""

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

from travjax.config import InputError, to_json
from travjax.simulation.actions import ActionSpace
from travjax.simulation.footprint import node_table
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot


def load_setup(
    robot: str | Path, actions: str | Path | None = None, size: float = 8.0, spacing: float = 0.0625
) -> tuple[Grid, Robot, ActionSpace]:
    """Reads a robot and an action space, and checks that they fit the map before any work is done.

    robot:   name of a robot that comes with the package, or a TOML file
    actions: TOML file of an action space, the paper's unless given
    size:    edge of a map in metres; spacing: metres between its nodes
    Raises InputError when a file is missing or wrong, or when they do not fit together.
    """
    grid, loaded = Grid(size, spacing), Robot.load(robot)
    space = ActionSpace.load(actions) if actions else ActionSpace()
    try:
        node_table(loaded, space, grid)
    except InputError as error:
        given = [str(source) for source in (robot, actions) if source]
        raise InputError(f"{' with '.join(given)}: {error}") from None
    return grid, loaded, space


def setup_json(robot: Robot, actions: ActionSpace, grid: Grid, **more: Any) -> str:
    """Returns everything labels depend on as JSON, with the version of travjax; a straight arc's radius is "inf"."""
    parts = {name: to_json(part) for name, part in (("robot", robot), ("actions", actions), ("grid", grid))}
    return json.dumps(parts | more | {"travjax": version("travjax")}, allow_nan=False)
