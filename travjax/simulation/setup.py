"""The setup that labels are valid for: robot, action space, map grid and contact model together."""

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import Any

from travjax.config import InputError, one_line, require, to_json
from travjax.simulation.actions import ActionSpace
from travjax.simulation.contact import Contact
from travjax.simulation.footprint import NodeTable, View, node_table, views_of
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.tyre_tables import require_inside

PARTS: dict[str, type] = {"robot": Robot, "actions": ActionSpace, "grid": Grid, "contact": Contact}
"""The parts of a setup by name, in the order of its fields and of saved files."""


ONLY_TYRE = frozenset({"overhang_height", "nose_rise"})
"""Fields of a robot that only the contact model `tyre` uses."""


@lru_cache(maxsize=1)
def default_robot() -> Robot:
    """Returns the Seekur Jr, the paper's robot."""
    return Robot.load("seekur_jr")


def chosen_robot(robot: Robot | str | None) -> Robot:
    """Returns the default robot for None, else the robot that `Robot.load` makes of the argument."""
    return default_robot() if robot is None else Robot.load(robot)


@dataclass(frozen=True)
class Setup:
    """Everything that labels depend on, apart from the heights: robot, action space, grid and contact model."""

    robot: Robot
    actions: ActionSpace = ActionSpace()
    grid: Grid = Grid()
    contact: Contact = Contact()

    @staticmethod
    def chosen(
        robot: Robot | str | None,
        actions: ActionSpace | None,
        grid: Grid,
        contact: str | None = None,
        turn: bool = True,
    ) -> "Setup":
        """Returns the setup that the arguments of a public function stand for.

        robot:   a Robot, or the name or file of one; the Seekur Jr for None
        actions: the paper's action space for None
        contact: a contact model; that of the robot's file for None, and where it has none the paper's
        turn:    whether point turns are simulated, by the contact models that can
        Raises InputError as `Robot.load` does, and if actions are no ActionSpace.
        """
        chosen = chosen_robot(robot)
        require(isinstance(actions, ActionSpace | None), "actions", actions, "a travjax.ActionSpace")
        model = Contact.from_model((chosen.contact or "nearest") if contact is None else contact, turn)
        return Setup(chosen, ActionSpace() if actions is None else actions, grid, model)

    @staticmethod
    def load(
        robot: str | Path,
        actions: str | Path | None = None,
        size: float = 8.0,
        spacing: float = 0.0625,
        contact: str | None = None,
        turn: bool = True,
    ) -> "Setup":
        """Reads a robot and an action space, and checks that they fit the map before any work is done.

        robot:   name of a robot that comes with the package, or a TOML file
        actions: TOML file of an action space, the paper's unless given
        size:    edge of a map in metres; spacing: metres between its nodes
        contact, turn: as of `chosen`
        Raises InputError when a file is missing or wrong, or when they do not fit together.
        """
        space = ActionSpace.load(actions) if actions else None
        setup = Setup.chosen(Robot.load(robot), space, Grid(size, spacing), contact, turn)
        try:
            setup.require_fit()
        except InputError as error:
            given = [str(source) for source in (robot, actions) if source]
            raise InputError(f"{' with '.join(given)}: {error}") from None
        return setup

    def node_table(self) -> NodeTable:
        """Returns the table of the nodes that the robot touches, which is built once.

        Raises InputError when robot, actions and grid do not fit together: a radius turns inside the robot, or a
        trajectory leaves the map.
        """
        return node_table(self.robot, self.actions, self.grid)

    @property
    def views(self) -> tuple[View, ...]:
        """The views of a map in which its trajectories have the same margins as those that correspond to them.

        A point turn begins facing forward, so a map that is turned by 180 degrees is another one for it.
        """
        return tuple(view for view in views_of(self.actions) if not (self.contact.turn and view.turned))

    def require_fit(self) -> None:
        """Raises InputError when robot, actions and grid do not fit together."""
        table = self.node_table()
        if self.contact.model == "tyre":
            require_inside(self.robot, table.poses.reshape(-1, 3), self.grid)

    @property
    def as_in_paper(self) -> bool:
        """Whether all but the grid is the paper's, so that figures on synthetic maps can be compared with its own."""
        return not any(self.differences(Setup(default_robot(), grid=self.grid)))

    def differences(self, other: "Setup") -> Iterator[tuple[str, str, Any, Any]]:
        """Yields part, field, value here and value there for each field in which another setup differs.

        What the robot's file says only for another contact model does not count.
        """
        unused = {"contact"} | (set() if "tyre" in (self.contact.model, other.contact.model) else ONLY_TYRE)
        for part in PARTS:
            mine, others = getattr(self, part), getattr(other, part)
            for name in (field.name for field in dataclasses.fields(mine)):
                if not (part == "robot" and name in unused) and getattr(mine, name) != getattr(others, name):
                    yield part, name, getattr(mine, name), getattr(others, name)

    def require_same(self, wanted: "Setup", what: str) -> None:
        """Raises InputError, with both values, unless this is the wanted setup; what: whose setup this is."""
        for part, fields in groupby(self.differences(wanted), key=lambda difference: difference[0]):
            pairs = [(f"{name} = {mine!r}", f"{name} = {given!r}") for _, name, mine, given in fields]
            ours, theirs = (one_line(", ".join(side), 160) for side in zip(*pairs, strict=True))
            raise InputError(f"{part} of the {what}: {ours}; must be as here: {theirs}")

    @staticmethod
    def parts_of(table: Any) -> Any:
        """Returns saved settings with the paper's contact model where they are older than contact models."""
        return {"contact": to_json(Contact())} | table if isinstance(table, dict) else table

    def to_json(self) -> dict[str, Any]:
        """Converts the setup to what JSON can hold, part by part; a straight arc's radius becomes "inf"."""
        return {part: to_json(getattr(self, part)) for part in PARTS}

    def to_json_text(self, **more: Any) -> str:
        """Returns the setup and further values as JSON, with the version of travjax."""
        return json.dumps(self.to_json() | more | {"travjax": version("travjax")}, allow_nan=False)


class WithSetup:
    """What holds for one setup, and offers its parts by name."""

    setup: Setup

    @property
    def robot(self) -> Robot:
        """The robot of the setup."""
        return self.setup.robot

    @property
    def actions(self) -> ActionSpace:
        """The action space of the setup."""
        return self.setup.actions

    @property
    def grid(self) -> Grid:
        """The grid of the setup."""
        return self.setup.grid
