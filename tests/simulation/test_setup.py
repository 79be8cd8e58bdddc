"""Robot, action space and map that are read together."""

import json
import math

import pytest

from tests.commandline import FEW
from travjax.config import InputError
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import load_setup, setup_json


def test_names_and_files_are_read(few):
    assert load_setup("seekur_jr") == (Grid(), Robot.load("seekur_jr"), ActionSpace())
    assert load_setup("husky_a200", few, 4.0, 0.125) == (Grid(4, 0.125), Robot.load("husky_a200"), FEW)
    assert load_setup("husky_a200", str(few), 4.0, 0.125)[2] == FEW


def test_what_does_not_fit_together_is_named(few):
    with pytest.raises(InputError, match="^seekur_jr: .*trajectories leave the 4 m map"):
        load_setup("seekur_jr", size=4.0)
    with pytest.raises(InputError, match=f"^seekur_jr with {few}: .*trajectories leave the 2 m map"):
        load_setup("seekur_jr", few, 2.0)


def test_the_json_holds_all_that_labels_depend_on():
    robot, grid = Robot.load("husky_a200"), Grid(4, 0.125)
    table = json.loads(setup_json(robot, FEW, grid, world=8.0))
    assert table["robot"]["name"] == robot.name and table["grid"] == {"size": 4, "spacing": 0.125}
    assert table["actions"]["radii"][0] == "inf" and math.isinf(FEW.radii[0])
    assert table["world"] == 8.0 and table["travjax"]
