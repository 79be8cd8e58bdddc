"""Robots: presets, files and refused values."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from travjax.config import InputError, from_json, to_json
from travjax.simulation.robot import Robot

SEEKUR_JR = Robot.load("seekur_jr")
NEEDED = [field.name for field in fields(Robot) if "optional" not in field.metadata]
LENGTHS = [field.name for field in fields(Robot) if field.name in NEEDED[1:] and "angle" not in field.metadata]
MAY_BE_LEFT_OUT = {field.name: None for field in fields(Robot) if "optional" in field.metadata}


def as_toml(**changes) -> str:
    """The Seekur Jr as a TOML text with other values; None leaves a key out."""
    values = {field.name: getattr(SEEKUR_JR, field.name) for field in fields(Robot)} | changes
    return "\n".join(f"{key} = {value!r}" for key, value in values.items() if value is not None)


def test_seekur_jr_has_the_numbers_of_the_specification():
    expected = Robot(
        name="Seekur Jr",
        wheelbase=0.425,
        track=0.663,
        wheel_diameter=0.400,
        wheel_width=0.172,
        chassis_length=1.051,
        chassis_width=0.440,
        overall_length=1.198,
        overall_width=0.835,
        ride_height=0.108,
        max_step=0.12,
        nose_rise=0.10,
        max_tilt=math.radians(36.87),
    )
    assert expected == SEEKUR_JR
    assert math.tan(SEEKUR_JR.max_tilt) == pytest.approx(0.75, abs=1e-5)


def test_there_are_three_presets():
    assert Robot.presets() == ["husky_a200", "leo_rover", "seekur_jr"]


@pytest.mark.parametrize("preset", Robot.presets())
def test_every_preset_loads_as_a_robot_of_plausible_build(preset):
    robot = Robot.load(preset)
    assert robot.name
    assert max(robot.wheelbase, robot.chassis_length) < robot.overall_length < 2
    assert max(robot.track, robot.chassis_width) < robot.overall_width < 1
    assert robot.max_step < robot.wheel_diameter
    assert robot.ride_height < robot.wheel_diameter
    assert math.radians(20) < robot.max_tilt < math.radians(60)


def test_presets_are_different_robots():
    assert len({Robot.load(preset) for preset in Robot.presets()}) == 3


def test_a_robot_is_loaded_as_it_is():
    assert Robot.load(SEEKUR_JR) is SEEKUR_JR


@pytest.mark.parametrize("as_path", [str, lambda path: path])
def test_a_file_of_ones_own_makes_a_robot(tmp_path, as_path):
    path = tmp_path / "mine.toml"
    path.write_text(as_toml(name="Mine", track=0.7, max_tilt=None) + "\nmax_tilt_deg = 45")
    assert Robot.load(as_path(path)) == replace(SEEKUR_JR, name="Mine", track=0.7, max_tilt=math.pi / 4)


def test_a_tilt_may_be_given_in_radians(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(as_toml(max_tilt=0.5))
    assert Robot.load(path).max_tilt == 0.5


def test_an_unknown_preset_is_refused_with_the_known_ones():
    with pytest.raises(InputError, match="^robot 'seekur': no such preset; allowed: husky_a200, leo_rover, seekur_jr"):
        Robot.load("seekur")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="none.toml: cannot be read: No such file"):
        Robot.load(tmp_path / "none.toml")


@pytest.mark.parametrize("field", NEEDED)
def test_a_file_without_a_field_is_refused_by_name(tmp_path, field):
    path = tmp_path / "mine.toml"
    path.write_text(as_toml(**{field: None}))
    with pytest.raises(InputError, match=f"mine.toml: missing {field}$"):
        Robot.load(path)


def test_a_wrong_value_in_a_file_is_named_with_the_file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(as_toml(track=-1))
    with pytest.raises(InputError, match="mine.toml: track = -1: must be a length in metres from 0.001 to 100$"):
        Robot.load(path)


@pytest.mark.parametrize("field", LENGTHS)
@pytest.mark.parametrize(
    "value",
    [0, 1e-40, 0.00099, -0.1, 100.1, pytest.param(10**5000, id="digits"), math.nan, math.inf, "0.4", None, True],
)
def test_a_bad_length_is_refused(field, value):
    with pytest.raises(InputError, match=f"^{field} = .*: must be a length in metres from 0.001 to 100$"):
        replace(SEEKUR_JR, **{field: value})


@pytest.mark.parametrize("value", [0, 1e-40, -0.1, 36.87, math.nan, math.inf, "0.4", None, True])
def test_a_bad_tilt_is_refused(value):
    with pytest.raises(InputError, match="^max_tilt = .*: must be an angle from 0.01 to 90 degrees"):
        replace(SEEKUR_JR, max_tilt=value)


def test_a_right_angle_is_the_largest_tilt():
    assert replace(SEEKUR_JR, max_tilt=math.pi / 2).max_tilt == math.pi / 2


def test_a_millimetre_is_a_length():
    small = dict.fromkeys(LENGTHS, 0.001) | {"track": 0.002}
    assert replace(SEEKUR_JR, **small).wheelbase == 0.001
    assert replace(SEEKUR_JR, max_tilt=math.radians(0.01)).max_tilt == math.radians(0.01)


@pytest.mark.parametrize("name", ["", None, 3, ["Seekur"], "Seekur\nJr", "\x1b[31mSeekur", "n" * 101, "\udcff"])
def test_a_bad_name_is_refused(name):
    with pytest.raises(InputError, match="^name = .*: must be a non-empty text of one line, at most 100 characters$"):
        replace(SEEKUR_JR, name=name)


def test_wheels_inside_the_chassis_are_refused_with_all_numbers():
    allowed = "at least chassis_width \\+ wheel_width = 0.44 \\+ 0.172 = 0.612 m, or the wheels are inside the chassis"
    with pytest.raises(InputError, match=f"^track = 0.611: must be {allowed}$"):
        replace(SEEKUR_JR, track=0.611)
    assert replace(SEEKUR_JR, track=0.612).track == 0.612


@pytest.mark.parametrize(
    "outside", [{"ride_height": 0.4}, {"chassis_length": 0.2, "wheelbase": 0.61}], ids=["below", "before and behind"]
)
def test_wheels_below_or_beyond_the_chassis_may_stand_close(outside):
    assert replace(SEEKUR_JR, track=0.3, **outside).track == 0.3


def test_an_angle_given_in_degrees_is_shown_in_degrees(tmp_path):
    path = tmp_path / "mine.toml"
    for degrees in (91, -5, 0.001):
        path.write_text(as_toml(name="Mine", max_tilt=None) + f"\nmax_tilt_deg = {degrees}")
        with pytest.raises(InputError, match=f"max_tilt_deg = {degrees}: must be an angle from 0.01 to 90 deg"):
            Robot.load(path)


def test_a_misspelt_limit_is_told_the_one_that_is_meant(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(as_toml(max_tilt=None) + "\nmax_tild_deg = 30")
    with pytest.raises(InputError, match="unknown key 'max_tild_deg'; allowed: .*; perhaps max_tilt_deg is meant$"):
        Robot.load(path)


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("max_roll_deg", "; max_roll_deg belongs above [physics]"),
        ("ride_height", "; ride_height belongs above [physics]"),
        ("centre_heigt", "; perhaps centre_height is meant"),
        ("wheels", ""),
    ],
)
def test_a_key_below_physics_that_is_none_of_its_own_is_refused(tmp_path, key, message):
    path = tmp_path / "mine.toml"
    path.write_text(Robot.path_of("seekur_jr").read_text() + f"\n{key} = 0.1\n")
    allowed = "mass, centre_height, drive_torque, drive_inertia, payload, coupled, friction, speed, stiffness_time, "
    line = f"{path}: [physics] unknown key '{key}'; allowed: {allowed}stiffness_damping, impedance{message}"
    for load in (Robot.load, Robot.load_physics):
        with pytest.raises(InputError) as raised:
            load(path)
        assert str(raised.value) == line


def test_a_table_of_physics_that_is_not_complete_is_no_matter_of_labels(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(Robot.path_of("seekur_jr").read_text().replace("mass = 77.0", ""))
    assert Robot.load(path) == SEEKUR_JR
    with pytest.raises(InputError, match=r"mine.toml: \[physics\] missing mass$"):
        Robot.load_physics(path)


def test_limits_are_step_obstacle_tilt():
    robot = replace(SEEKUR_JR, max_step=0.1, ride_height=0.2, max_tilt=0.3)
    assert robot.limits == (0.1, 0.2, 0.3)
    assert robot.event_names == ("step", "obstacle", "tilt")


def test_a_limit_of_roll_adds_an_event(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(as_toml() + "\nmax_roll_deg = 15")
    robot = Robot.load(path)
    assert robot == replace(SEEKUR_JR, max_roll=math.radians(15))
    assert robot.event_names == ("step", "obstacle", "tilt", "roll")
    assert robot.limits == (*SEEKUR_JR.limits, math.radians(15))


@pytest.mark.parametrize("value", [0, -0.1, 36.87, math.nan, "0.4", True])
def test_a_bad_limit_of_roll_is_refused(value):
    with pytest.raises(InputError, match="^max_roll = .*: must be an angle from 0.01 to 90 degrees"):
        replace(SEEKUR_JR, max_roll=value)


def test_a_robot_without_a_limit_of_roll_is_saved_as_before_there_was_one():
    plain = replace(SEEKUR_JR, **MAY_BE_LEFT_OUT)
    assert list(to_json(plain)) == NEEDED
    robot = replace(plain, max_roll=0.3)
    assert to_json(robot) == to_json(plain) | {"max_roll": 0.3}
    assert from_json(to_json(robot), Robot) == robot and from_json(to_json(SEEKUR_JR), Robot) == SEEKUR_JR


@pytest.mark.parametrize("field", ["overhang_height", "nose_rise"])
def test_what_only_the_contact_model_tyre_uses_may_be_left_out_but_not_be_wrong(field):
    assert getattr(replace(SEEKUR_JR, **{field: None}), field) is None
    with pytest.raises(InputError, match=f"^{field} = -0.1: must be a length in metres from 0.001 to 100$"):
        replace(SEEKUR_JR, **{field: -0.1})


def test_a_robot_names_a_contact_model_or_none():
    assert replace(SEEKUR_JR, contact="tyre") == SEEKUR_JR, "which model is used is part of a Setup"
    with pytest.raises(InputError, match='^contact = \'wheel\': must be "nearest" or "tyre"$'):
        replace(SEEKUR_JR, contact="wheel")


def test_wheels_stand_front_left_front_right_rear_left_rear_right():
    robot = replace(SEEKUR_JR, track=0.64, wheelbase=0.4)
    expected = [(-0.32, 0.2), (0.32, 0.2), (-0.32, -0.2), (0.32, -0.2)]
    np.testing.assert_allclose(robot.wheel_positions(), expected, rtol=0, atol=1e-15)


def test_equal_robots_are_one_key():
    assert {SEEKUR_JR: 1}[replace(SEEKUR_JR)] == 1
