"""Configurations from TOML files, and the one line that says what is wrong with one."""

import json
import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from travjax.config import (
    InputError,
    from_json,
    load_toml,
    one_line,
    parse_json,
    parts_from_json,
    read_json,
    require,
    require_number,
    shown,
    to_json,
)


@dataclass(frozen=True)
class Ramp:
    length: float
    slope: float = field(metadata={"angle": True})
    marks: tuple[float, ...] = (0.0,)

    def __post_init__(self):
        require_number("length", self.length, 0, 100, "a length in metres, above 0 and at most 100")
        require(self.slope < 1, "slope", self.slope, "below 1 rad")


@pytest.fixture
def ramp_file(tmp_path):
    """Writes a text to ramp.toml and returns its path."""

    def write(text):
        path = tmp_path / "ramp.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


SLOP = "unknown key 'slop'; allowed: length, slope, slope_deg, marks; perhaps slope is meant"


def refusal(path) -> str:
    """What load_toml says about a wrong file: one line that starts with the file's name."""
    with pytest.raises(InputError) as raised:
        load_toml(path, Ramp)
    message = str(raised.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


def test_a_file_gives_fields_by_name_and_defaults_for_the_rest(ramp_file):
    assert load_toml(ramp_file("length = 2.5\nslope = 0.5"), Ramp) == Ramp(2.5, 0.5, (0.0,))


def test_a_path_may_be_text(ramp_file):
    assert load_toml(str(ramp_file("length = 2.5\nslope = 0.5")), Ramp).length == 2.5


def test_degrees_become_radians(ramp_file):
    assert load_toml(ramp_file("length = 1\nslope_deg = 30"), Ramp).slope == pytest.approx(math.pi / 6, abs=1e-15)


def test_a_list_becomes_a_tuple(ramp_file):
    ramp = load_toml(ramp_file("length = 1\nslope = 0\nmarks = [1, inf]"), Ramp)
    assert ramp.marks == (1, math.inf)
    assert hash(ramp) == hash(Ramp(1, 0, (1, math.inf)))


def test_a_missing_file_is_named(tmp_path):
    assert refusal(tmp_path / "none.toml") == "cannot be read: No such file or directory"


def test_a_folder_is_no_file(tmp_path):
    assert refusal(tmp_path) == "cannot be read: Is a directory"


@pytest.mark.parametrize("text", ["length = ", "length 1", "= 3", "length = 1\nlength = 2", "[ramp"])
def test_text_that_is_not_toml_is_said_to_be_none(ramp_file, text):
    assert refusal(ramp_file(text)).startswith("not a TOML file: ")


def test_bytes_that_are_not_text_cannot_be_read(ramp_file):
    assert refusal(ramp_file(b"length = \xff\xfe")).startswith("cannot be read: ")


HOSTILE = {
    "deep": ("marks = " + "[" * 3000, "lists and tables: must be nested 50 deep at most"),
    "deep and closed": (f"marks = {'[' * 60}{']' * 60}", "marks = '...': must be nested 50 deep at most"),
    "deep tables": ("[" + ".".join("a" * 60) + "]", "a.a.a."),
    "digits": (
        f"slope = 0\nlength = {'9' * 5000}",
        "line 2: 99999999999999999999 ...: must be a number of fewer digits",
    ),
    "hexadecimal": (f"length = 0x{'f' * 5000}", "length = 0xffff"),
    "beyond 64 bits": (f"marks = [1, {2**64}]", "marks[1] = 18446744073709551616: must be a whole number of 64 bits"),
    "in degrees": (f"slope_deg = 0x{'f' * 5000}", "slope_deg = 0xffff"),
    "twice": (f"slope = 1\nslope_deg = 0x{'f' * 5000}", "slope_deg = 0xffff"),
    "NUL": ("length = 1\x00", "not a TOML file: "),
    "UTF-16": ("length = 1".encode("utf-16"), "cannot be read: byte 0 is not UTF-8"),
    "a long key": (f"{'k' * 5000} = 1", "unknown key 'kkkk"),
    "a key of two lines": ('"a\\nb" = 1', "unknown key 'a\\nb'; allowed: "),
    "a value of two lines": ('slope = 0\nlength = "a\\nb\\u001b"', "length = 'a\\nb\\x1b': must be "),
    "a date": ("slope = 0\nlength = 1979-05-27", "length = datetime.date(1979, 5, 27): must be "),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_what_no_file_of_ours_holds_is_refused_in_one_line(ramp_file, what):
    text, message = HOSTILE[what]
    said = refusal(ramp_file(text))
    assert said.startswith(message) and len(said) < 600 and said.isprintable()


def test_a_byte_order_mark_is_passed_over(ramp_file):
    assert load_toml(ramp_file(b"\xef\xbb\xbflength = 1\r\nslope = 0\r\n"), Ramp) == Ramp(1, 0)


def test_a_name_with_a_nul_byte_is_one_line():
    with pytest.raises(InputError, match=r"^no\\x00ne.toml: cannot be read: embedded null byte$"):
        load_toml("no\x00ne.toml", Ramp)


def test_a_file_that_does_not_end_is_refused(monkeypatch):
    monkeypatch.setattr("travjax.config.LARGEST", 1 << 20)
    with pytest.raises(InputError, match="^/dev/zero: cannot be read: must be a text of at most 1 MiB$"):
        load_toml("/dev/zero", Ramp)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON: "),
        ('{"a": [1, NaN]}', "a[1] = nan: must be a finite number"),
        ('{"a": {"b": -Infinity}}', "a.b = -inf: must be a finite number"),
        ('{"a": 1e999}', "a = inf: must be a finite number"),
        (f'{{"a": {2**64}}}', f"a = {2**64}: must be a whole number of 64 bits"),
        (f'{{"a": {"9" * 5000}}}', "line 1: 99999999999999999999 ...: must be a number of fewer digits"),
        ("[" * 100_000, "lists and tables: must be nested 50 deep at most"),
        ('{"a": ' * 60 + "1" + "}" * 60, "a.a.a."),
    ],
)
def test_json_that_is_none_of_ours_is_refused_in_one_line(tmp_path, text, message):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(InputError) as raised:
        read_json(path)
    assert str(raised.value).startswith(f"{path}: {message}") and len(str(raised.value)) < 600


def test_json_is_read_as_it_is(tmp_path):
    held = {"a": [1, 2.5, None, True, "x"], "b": {"c": -(2**63), "d": 2**64 - 1}}
    (tmp_path / "a.json").write_text(json.dumps(held))
    assert read_json(tmp_path / "a.json") == held
    assert parse_json("[Infinity, NaN]", "text", finite=False)[0] == math.inf
    with pytest.raises(InputError, match="none.json: cannot be read: No such file or directory; allowed: a run$"):
        read_json(tmp_path / "none.json", "a run")


def test_an_unknown_key_is_named_with_the_allowed_ones(ramp_file):
    assert refusal(ramp_file("length = 1\nslop = 0")) == SLOP


def test_an_unknown_key_in_degrees_is_named_as_written(ramp_file):
    assert refusal(ramp_file("length = 1\nslop_deg = 0")).startswith("unknown key 'slop_deg'; allowed: ")


def test_a_table_is_no_field(ramp_file):
    assert refusal(ramp_file("[ramp]\nlength = 1")).startswith("unknown key 'ramp'; allowed: ")


def test_missing_keys_are_all_named_and_defaults_are_not(ramp_file):
    assert refusal(ramp_file("marks = [1]")) == "missing length, slope"


def test_an_empty_file_misses_what_has_no_default(ramp_file):
    assert refusal(ramp_file("")) == "missing length, slope"


def test_a_refused_value_is_named_with_file_field_and_what_is_allowed(ramp_file):
    message = refusal(ramp_file("length = -2\nslope = 0"))
    assert message == "length = -2: must be a length in metres, above 0 and at most 100"


def test_only_angles_may_be_in_degrees(ramp_file):
    message = refusal(ramp_file("length_deg = 1\nslope = 0"))
    assert message.startswith("unknown key 'length_deg'; allowed: length, slope, slope_deg, marks")


@pytest.mark.parametrize("text", ["slope = 0.1\nslope_deg = 5", "slope_deg = 5\nslope = 0.1"])
def test_an_angle_may_be_given_once(ramp_file, text):
    assert "is given twice, once in degrees; allowed: once" in refusal(ramp_file(f"length = 1\n{text}"))


@pytest.mark.parametrize("value", ["'30'", "true", "nan", "inf", "[30]"])
def test_degrees_must_be_a_number(ramp_file, value):
    message = refusal(ramp_file(f"length = 1\nslope_deg = {value}"))
    assert message.startswith("slope_deg = ")
    assert message.endswith(": must be a number of degrees")


def test_bad_input_is_a_value_error():
    with pytest.raises(ValueError, match="^field = 'x': must be y$"):
        require(False, "field", "x", "y")


def test_a_long_value_is_shortened_to_one_line():
    with pytest.raises(InputError) as raised:
        require(False, "field", np.zeros((20, 20)), "small")
    message = str(raised.value)
    assert message.startswith("field = array([[0., 0., ")
    assert message.endswith(" ...: must be small")
    assert "\n" not in message and len(message) < 120


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("a name\nof two\r\nlines", "a name\\nof two\\r\\nlines"),
        ("\x1b[31mred\x07 \u202e \x00", "\\x1b[31mred\\x07 \\u202e \\x00"),
        ("\udcff.tif \u2028", "\\udcff.tif \\u2028"),
        ("Gelände 山 a\\nb", "Gelände 山 a\\nb"),
    ],
)
def test_a_message_is_one_line_whatever_names_hold(text, line):
    assert str(InputError(text)) == one_line(text) == line
    assert str(InputError(InputError(text))) == line


def test_a_long_message_keeps_its_ends():
    message = str(InputError(f"FILE: {'x y ' * 5000}: must be short"))
    assert len(message) <= 600 and message.startswith("FILE: x y x y") and message.endswith(" x y : must be short")
    assert " ... " in message and one_line("y" * 600) == "y" * 600
    assert one_line("0123456789" * 5, 20) == "012345678 ... 456789"


def test_a_value_without_spaces_is_cut_off_as_well():
    assert shown("x" * 5000) == f"'{'x' * 75} ..."


@pytest.mark.parametrize("value", [10**5000, [10**5000], (1, [10**5000])], ids=["alone", "list", "inside"])
def test_a_number_that_python_does_not_write_can_be_quoted(value):
    assert len(shown(value)) <= 80
    with pytest.raises(InputError, match="^field = .*: must be small$"):
        require(False, "field", value, "small")


def test_what_holds_is_not_refused():
    require(True, "field", "x", "y")


@pytest.mark.parametrize("value", [0.1, 1, 2, 2.0, np.float32(0.5), np.int64(1)])
def test_a_number_within_the_bounds_is_allowed(value):
    require_number("field", value, 0, 2, "above 0, at most 2")


@pytest.mark.parametrize("value", [0, 2.0001, -1, 10**400, math.nan, math.inf, -math.inf, "1", None, True, [1], 1j])
def test_what_is_no_finite_number_within_the_bounds_is_refused(value):
    with pytest.raises(InputError, match="^field = .*: must be above 0, at most 2$"):
        require_number("field", value, 0, 2, "above 0, at most 2")


@dataclass(frozen=True)
class Track(Ramp):
    name: str = "inf"
    laps: int = 1


@pytest.mark.parametrize(
    "config", [Track(2.5, 0.1, (math.inf, 1 / 3, -math.inf)), Track(1e-17, 0.5, ()), Track(1, 0, (1, 2), "a", 3)]
)
def test_a_configuration_comes_back_from_json_as_it_was(config):
    text = json.dumps(to_json(config), allow_nan=False)
    again = from_json(json.loads(text), Track)
    assert again == config and repr(again) == repr(config) and hash(again) == hash(config)


def test_an_infinite_number_is_text_in_json():
    assert to_json(Ramp(1, 0, (math.inf, -math.inf, 2.0)))["marks"] == ["inf", "-inf", 2.0]


def test_numpy_numbers_become_plain_ones_in_json():
    table = to_json(Track(np.float64(0.1), 0.5, (np.float32(0.5), 1 / 3), laps=np.int64(3)))
    assert json.loads(json.dumps(table)) == {
        "length": 0.1,
        "slope": 0.5,
        "marks": [0.5, 1 / 3],
        "name": "inf",
        "laps": 3,
    }


@dataclass(frozen=True)
class Park:
    ramp: tuple[Ramp, ...] = field(metadata={"items": Ramp})
    name: str = "park"


PARK = Park((Ramp(1, 0.5), Ramp(2, 0.25, (1.0, 2.0))), "north")


def test_a_list_of_tables_becomes_a_tuple_of_configurations(ramp_file):
    text = 'name = "north"\n[[ramp]]\nlength = 1\nslope = 0.5\n[[ramp]]\nlength = 2\nslope = 0.25\nmarks = [1.0, 2.0]'
    park = load_toml(ramp_file(text), Park)
    assert park == PARK and hash(park) == hash(PARK)


@pytest.mark.parametrize("park", [PARK, replace(PARK, ramp=())])
def test_a_list_of_tables_comes_back_from_json(park):
    text = json.dumps(to_json(park), allow_nan=False)
    assert from_json(json.loads(text), Park) == park
    assert to_json(PARK)["ramp"][1] == {"length": 2, "slope": 0.25, "marks": [1.0, 2.0]}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[ramp]]\nlength = 1\nslope = 0\n[[ramp]]\nslope = 0", "ramp 2: missing length"),
        (
            "[[ramp]]\nlength = -2\nslope = 0",
            "ramp 1: length = -2: must be a length in metres, above 0 and at most 100",
        ),
        ("[[ramp]]\nlength = 1\nslop = 0", f"ramp 1: {SLOP}"),
        ("[[ramp]]\nlength = 1\nslope_deg = 'a'", "ramp 1: slope_deg = 'a': must be a number of degrees"),
        ("[ramp]\nlength = 1", "ramp = {'length': 1}: must be a list of tables [[ramp]]"),
        ("ramp = 3", "ramp = 3: must be a list of tables [[ramp]]"),
        ("ramp = [3]", "ramp = 3: must be a table [[ramp]]"),
        ("name = 'a'", "missing ramp"),
    ],
)
def test_the_table_of_a_list_that_is_wrong_is_numbered(ramp_file, text, message):
    path = ramp_file(text)
    with pytest.raises(InputError) as raised:
        load_toml(path, Park)
    assert str(raised.value) == f"{path}: {message}"


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"length": 1}, "missing slope"),
        ({"length": 1, "slope": 0, "width": 2}, "unknown key 'width'; allowed: length, slope, slope_deg, marks"),
        ({"length": -1, "slope": 0}, "length = -1: must be a length in metres, above 0 and at most 100"),
    ],
)
def test_json_that_does_not_fit_is_refused(table, message):
    with pytest.raises(InputError, match=f"^{message}$"):
        from_json(table, Ramp)


# ---- Keys that were renamed


@dataclass(frozen=True)
class Slide:
    drop: float = field(default=1.0, metadata={"formerly": "fall"})
    slope: float = field(default=0.5, metadata={"angle": True, "formerly": "incline"})


@dataclass(frozen=True)
class Playground:
    slide: Slide = Slide()
    slides: tuple[Slide, ...] = field(default=(), metadata={"items": Slide})


def notice(where, old: str, new: str) -> str:
    return f"{where}: key {old!r} is now called {new!r}; the old name will not be read by the next version\n"


@pytest.mark.parametrize(
    ("text", "old", "new"),
    [
        ("[slide]\nfall = 2", "fall", "drop"),
        ("[slide]\nincline = 0.25", "incline", "slope"),
        ("[slide]\nincline_deg = 30", "incline_deg", "slope_deg"),
        ("[[slides]]\nfall = 2\n[[slides]]\nfall = 3", "fall", "drop"),
    ],
)
def test_an_old_key_is_read_and_said_once(ramp_file, capsys, text, old, new):
    now = load_toml(ramp_file(text.replace(old, new)), Playground)
    assert capsys.readouterr().out == "" and now != Playground()
    path = ramp_file(text)
    assert load_toml(path, Playground) == now
    assert capsys.readouterr().out == notice(path, old, new)


def test_several_old_keys_are_one_notice(ramp_file, capsys):
    path = ramp_file("[slide]\nfall = 2\nincline_deg = 30")
    assert load_toml(path, Playground) == Playground(Slide(2, math.radians(30)))
    assert capsys.readouterr().out == (
        f"{path}: keys 'fall', 'incline_deg' are now called 'drop', 'slope_deg'; "
        "the old names will not be read by the next version\n"
    )


@pytest.mark.parametrize(
    ("text", "old", "new"),
    [
        ("fall = 2\ndrop = 2", "fall = 2", "drop"),
        ("drop = 2\nfall = 2", "fall = 2", "drop"),
        ("incline_deg = 3\nslope_deg = 3", "incline_deg = 3", "slope_deg"),
    ],
)
def test_an_old_key_beside_the_new_one_is_refused(ramp_file, capsys, text, old, new):
    path = ramp_file(text)
    with pytest.raises(InputError) as raised:
        load_toml(path, Slide)
    assert str(raised.value) == f"{path}: {old}: must be left out beside {new}, its name now"
    assert capsys.readouterr().out == ""


def test_an_old_key_in_one_unit_beside_the_new_one_in_another_is_refused(ramp_file):
    for text in ("incline_deg = 3\nslope = 0.1", "slope_deg = 3\nincline = 0.1"):
        with pytest.raises(InputError, match="is given twice"):
            load_toml(ramp_file(text), Slide)


def test_old_keys_are_read_from_json_and_not_written(capsys):
    assert to_json(Slide(2, 0.25)) == {"drop": 2, "slope": 0.25}
    assert from_json({"fall": 2, "incline": 0.25}, Slide, "run.json") == Slide(2, 0.25)
    assert capsys.readouterr().out.startswith("run.json: keys 'fall', 'incline' are now called 'drop', 'slope'; ")
    parts = parts_from_json({"one": {"fall": 2}, "two": {"fall": 3}}, {"one": Slide, "two": Slide}, "run.json")
    assert parts == {"one": Slide(2), "two": Slide(3)}
    assert capsys.readouterr().out == notice("run.json", "fall", "drop")


def test_an_old_key_is_not_among_those_allowed(ramp_file):
    with pytest.raises(InputError, match="unknown key 'fell'; allowed: drop, slope, slope_deg"):
        load_toml(ramp_file("fell = 2"), Slide)
