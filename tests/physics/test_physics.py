"""Trajectories driven in the physics engine: checks of the model, grounds that decide outcomes, and the programs."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.commandline import run_words
from travjax.config import InputError
from travjax.experiments import physics as experiment
from travjax.physics.check import check, passed, yaw_ratio
from travjax.physics.drive import VERSION
from travjax.physics.labelling import OUTCOMES, Variation, label_ground, label_physics
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup

pytest.importorskip("mujoco", reason="the extra physics is not installed")

ROBOT, PHYSICS = Robot.load("seekur_jr"), Robot.load_physics("seekur_jr")
ACTIONS = ActionSpace(turns=4, arc_lengths=(0.6, 0.8))
X, Y = np.meshgrid(Grid().axis(), Grid().axis())


def outcome(heights: np.ndarray, trajectory: int = 0) -> str:
    """What becomes of one trajectory."""
    found = label_ground(heights, [trajectory], ROBOT, PHYSICS, ACTIONS, Grid())
    return ("arrived", *OUTCOMES)[int(found.outcome[0])]


def test_the_seekur_jr_does_what_its_data_sheet_says():
    checks = check(ROBOT, PHYSICS)
    assert passed(checks), [one for one in checks if not one.passed]


def test_a_weak_drive_does_not():
    checks = check(ROBOT, replace(PHYSICS, drive_torque=20.0))
    assert not passed(checks)


def test_wheels_that_only_slip_sideways_turn_the_robot_as_far_as_coulomb_friction_says():
    theory = 1 / (1 + (ROBOT.wheelbase / ROBOT.track) ** 2)  # point contacts, equal loads
    assert yaw_ratio(ROBOT, PHYSICS, 2.5) == pytest.approx(theory, abs=0.15)
    assert yaw_ratio(ROBOT, replace(PHYSICS, drive_torque=20.0), 2.5) < 0.2


def test_grounds_that_decide_what_happens():
    assert outcome(0 * X) == "arrived"
    assert outcome(1.0 * (Y > 0.9)) in ("contact", "stuck")
    assert outcome(0.4 * (np.hypot(X, Y - 0.9) < 0.2)) in ("contact", "stuck")
    assert outcome(np.where(np.abs(Y) < 0.7, 0.0, 0.9 * (np.abs(Y) - 0.7))) in ("tilt", "contact")
    assert outcome(1.2 * X) == "bad_start"


def test_second_arcs_go_on_where_their_first_arc_ended():
    several = label_ground(0 * X, [0, 1, 2, 13], ROBOT, PHYSICS, ACTIONS, Grid())
    np.testing.assert_array_equal(several.trajectory, [0, 1, 2, 13])
    assert not several.failed.any() and several.started.all()
    alone = label_ground(0 * X, [2], ROBOT, PHYSICS, ACTIONS, Grid())
    assert alone.station[0] == pytest.approx(several.station[2], abs=0.02)


def test_a_run_goes_on_and_refuses_another_ones_folder(tmp_path):
    setup, heights = Setup(ROBOT, ACTIONS), np.stack([0 * X, 0.3 * (Y > 0.8)])
    wanted = [np.array([0]), np.array([0, 3])]
    told: list[int] = []
    found = label_physics(heights, wanted, setup, PHYSICS, tmp_path, 1, on_progress=told.append)
    assert found.failed.tolist() == [False, True, True] and sum(told) == 3
    (tmp_path / "map_00001.json").unlink()
    again = label_physics(heights, wanted, setup, PHYSICS, tmp_path, 1)
    np.testing.assert_array_equal(again.station, found.station)
    with pytest.raises(InputError, match="map_00000.json: physics = 'other': must be as in this run; allowed: another"):
        label_physics(heights, wanted, setup, replace(PHYSICS, friction=0.7), tmp_path, 1)
    with pytest.raises(InputError, match="map_00000.json: variation"):
        label_physics(heights, wanted, setup, PHYSICS, tmp_path, 1, [Variation(0.95), Variation()])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": 0}, "mass = 0: must be a number from 0.1 to 100000"),
        ({"friction": "high"}, "friction = 'high': must be"),
        ({"coupled": 1}, "coupled = 1: must be true or false"),
        ({"impedance": (0.3, 0.3)}, "impedance = .*: must be five numbers"),
    ],
)
def test_bad_numbers_are_named(change, message):
    with pytest.raises(InputError, match=message):
        replace(PHYSICS, **change)


def test_a_robot_without_the_table_is_refused_by_name():
    with pytest.raises(InputError, match=r"husky_a200.toml: no table \[physics\]; needed: one with at least mass"):
        Robot.load_physics("husky_a200")
    code, _, err = run_words("physics", "--robot", "husky_a200", "--check")
    assert code == 2 and "no table [physics]" in err


def test_labels_do_not_depend_on_the_table(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(Robot.path_of("seekur_jr").read_text().replace("mass = 77.0", "mass = 50.0"))
    assert Robot.load(path) == ROBOT and Robot.load_physics(path).mass == 50.0
    path.write_text(path.read_text() + "wheels = 4\n")
    with pytest.raises(InputError, match=r"mine.toml: \[physics\] unknown key 'wheels'"):
        Robot.load_physics(path)


def test_the_command_writes_outcomes_table_and_picture(tmp_path):
    words = ("--count", "1", "--style", "scattered_sharp", "--trajectories", "4", "--processes", "1", "--out", tmp_path)
    code, out, err = run_words("physics", *words)
    assert code == 0, err
    assert "rated" in out and "arrived" in out and (tmp_path / "driven.png").stat().st_size > 10_000
    with np.load(tmp_path / "labels_physics.npz") as labels:
        assert labels["outcome"].shape == labels["failed"].shape == (4,)
        assert json.loads(str(labels["config"]))["version"] == VERSION


def test_the_experiment_runs_and_goes_on(tmp_path):
    preset = tmp_path / "tiny.toml"
    preset.write_text('robot = "seekur_jr"\nmaps = 2\nseed = 731003\ntrajectories = 8\nrepeats = 0.3\n')
    for _ in range(2):
        assert experiment.main([str(preset), "--processes", "1", "--out", str(tmp_path / "out")]) == 0
    results = json.loads((tmp_path / "out/results.json").read_text())
    assert [row["contact"] for row in results["scores"][-2:]] == ["nearest", "tyre"]
    assert results["repeats"]["driven twice"] >= 1
    assert "bands.png" in (tmp_path / "out/report.md").read_text()
