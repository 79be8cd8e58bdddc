"""Robot, action space and map that are read together."""

import json
import math
from dataclasses import replace

import pytest

from tests.commandline import FEW
from travjax.config import InputError
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup

SMALL = Setup(Robot.load("husky_a200"), FEW, Grid(4, 0.125))


def test_names_and_files_are_read(few):
    assert Setup.load("seekur_jr") == Setup(Robot.load("seekur_jr"), ActionSpace(), Grid())
    assert Setup.load("husky_a200", few, 4.0, 0.125) == Setup(Robot.load("husky_a200"), FEW, Grid(4, 0.125))
    assert Setup.load("husky_a200", str(few), 4.0, 0.125).actions == FEW


def test_what_does_not_fit_together_is_named(few):
    with pytest.raises(InputError, match="^seekur_jr: .*trajectories leave the 4 m map"):
        Setup.load("seekur_jr", size=4.0)
    with pytest.raises(InputError, match=f"^seekur_jr with {few}: .*trajectories leave the 2 m map"):
        Setup.load("seekur_jr", few, 2.0)


def test_the_json_holds_all_that_labels_depend_on():
    robot, grid = Robot.load("husky_a200"), Grid(4, 0.125)
    table = json.loads(Setup(robot, FEW, grid).to_json_text(world=8.0))
    assert table["robot"]["name"] == robot.name and table["grid"] == {"size": 4, "spacing": 0.125}
    assert table["actions"]["radii"][0] == "inf" and math.isinf(FEW.radii[0])
    assert table["world"] == 8.0 and table["travjax"]


def test_an_equal_setup_is_the_same():
    SMALL.require_same(Setup(Robot.load("husky_a200"), replace(FEW), Grid(4, 0.125)), "data set")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"robot": replace(SMALL.robot, max_step=0.5)},
            "robot of the data set: max_step = 0.0826; must be as here: max_step = 0.5",
        ),
        (
            {"actions": replace(FEW, turns=7, interval=0.2), "grid": Grid()},
            "actions of the data set: turns = 2, interval = 0.1; must be as here: turns = 7, interval = 0.2",
        ),
        ({"grid": Grid(4, 0.25)}, "grid of the data set: spacing = 0.125; must be as here: spacing = 0.25"),
    ],
)
def test_the_first_part_that_differs_is_named_with_both_values(change, message):
    with pytest.raises(InputError) as raised:
        SMALL.require_same(replace(SMALL, **change), "data set")
    assert str(raised.value) == message


def test_a_robot_that_differs_in_much_is_named_in_one_line():
    other = replace(SMALL, robot=Robot.load("seekur_jr"))
    with pytest.raises(
        InputError, match="^robot of the data set: name = 'Husky A200'.*here: name = 'Seekur Jr'"
    ) as raised:
        SMALL.require_same(other, "data set")
    assert len(str(raised.value)) < 400 and "\n" not in str(raised.value)


def test_only_robot_and_actions_decide_whether_a_setup_is_the_paper_s():
    paper = Setup(Robot.load("seekur_jr"))
    assert paper.as_in_paper and replace(paper, grid=Grid(10, 0.125)).as_in_paper
    assert not replace(paper, robot=replace(paper.robot, max_step=0.1)).as_in_paper
    assert not replace(paper, actions=FEW).as_in_paper
