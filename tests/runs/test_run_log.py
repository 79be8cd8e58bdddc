"""What a run reports is read back as it was written, goes on where the run goes on, and is cut off there."""

import json
import struct

import pytest

from travjax.config import InputError
from travjax.runs.run_log import RunLog, read_rows

ROWS = [
    {"step": 1, "phase": 1, "loss": 0.1 + 0.2, "learning_rate": 1e-4},
    {"step": 2, "phase": 1, "loss": 0.5, "average_precision": {"step": 0.25, "tilt": None}, "f1": {"overall": 1}},
    {"step": 3, "phase": 2, "loss": 1e-12},
]


def written(folder, rows=ROWS, step=0) -> None:
    log = RunLog(folder, step)
    for row in rows:
        log.write(row)
    log.close()


def scalars(folder) -> list[tuple[str, int, float]]:
    """Tag, step and value of what TensorBoard would show, read from the records of its files."""
    from tensorboardX.proto.event_pb2 import Event

    found = []
    for path in sorted((folder / "tensorboard").iterdir()):
        data, place = path.read_bytes(), 0
        while place < len(data):
            (length,) = struct.unpack_from("<Q", data, place)
            event = Event.FromString(data[place + 12 : place + 12 + length])
            found += [(value.tag, event.step, value.simple_value) for value in event.summary.value]
            place += length + 16
    return found


def test_rows_come_back_as_they_were_written(tmp_path):
    written(tmp_path)
    assert read_rows(tmp_path / "metrics.jsonl") == ROWS
    assert [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()] == ROWS


def test_a_row_is_on_disk_as_soon_as_it_is_written(tmp_path):
    log = RunLog(tmp_path)
    log.write(ROWS[0])
    assert read_rows(tmp_path / "metrics.jsonl") == ROWS[:1]
    log.close()


def test_tensorboard_shows_every_number(tmp_path):
    written(tmp_path)
    shown = {(tag, step): value for tag, step, value in scalars(tmp_path)}
    wanted = {("loss", 1): 0.3, ("loss", 2): 0.5, ("loss", 3): 1e-12, ("learning_rate", 1): 1e-4}
    wanted |= {("average_precision/step", 2): 0.25, ("f1/overall", 2): 1}
    for place, value in wanted.items():
        assert shown[place] == pytest.approx(value, rel=1e-6)
    assert not any("tilt" in tag for tag, _ in shown)


def test_a_run_that_goes_on_keeps_the_rows_up_to_there(tmp_path):
    written(tmp_path)
    written(tmp_path, [ROWS[2] | {"loss": 7.0}], step=2)
    assert read_rows(tmp_path / "metrics.jsonl") == [*ROWS[:2], ROWS[2] | {"loss": 7.0}]
    assert scalars(tmp_path)[-1] == ("loss", 3, 7.0)


def test_a_new_run_starts_with_none(tmp_path):
    written(tmp_path)
    written(tmp_path, ROWS[:1])
    assert read_rows(tmp_path / "metrics.jsonl") == ROWS[:1]


def test_a_last_line_that_was_cut_short_does_not_count(tmp_path):
    written(tmp_path)
    path = tmp_path / "metrics.jsonl"
    path.write_text(path.read_text()[:-5])
    assert read_rows(path) == ROWS[:2]
    written(tmp_path, [ROWS[2]], step=2)
    assert read_rows(path) == ROWS


def test_no_file_has_no_rows(tmp_path):
    assert read_rows(tmp_path / "metrics.jsonl") == []
    written(tmp_path, [ROWS[2]], step=2)
    assert read_rows(tmp_path / "metrics.jsonl") == [ROWS[2]]


DAMAGES = {
    "a flipped bit": lambda line: line[:5] + bytes([line[5] | 0x80]) + line[6:],
    "no JSON": lambda line: line.replace(b'"step": 2', b'"step: 2'),
    "a text as step": lambda line: line.replace(b'"step": 2', b'"step": "2"'),
    "a negative step": lambda line: line.replace(b'"step": 2', b'"step": -2'),
    "no step": lambda line: line.replace(b'"step"', b'"stop"'),
    "no row": lambda line: b"3",
    "nothing": lambda line: b"",
    "not finite": lambda line: line.replace(b"0.5", b"NaN"),
    "beyond a number": lambda line: line.replace(b"0.5", b"1e999"),
    "too deep": lambda line: b"[" * 5000,
    "too many digits": lambda line: b'{"step": ' + b"9" * 5000 + b"}",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_line_is_named_and_left_out(tmp_path, capsys, damage):
    written(tmp_path)
    path = tmp_path / "metrics.jsonl"
    lines = path.read_bytes().splitlines()
    lines[1] = DAMAGES[damage](lines[1])
    path.write_bytes(b"".join(line + b"\n" for line in lines))
    said = f"{path}: line 2 left out: must be a row of JSON with its step\n"
    assert read_rows(path) == [ROWS[0], ROWS[2]]
    assert capsys.readouterr().out == said
    written(tmp_path, [ROWS[2] | {"loss": 7.0}], step=2)
    assert capsys.readouterr().out == said
    assert read_rows(path) == [ROWS[0], ROWS[2] | {"loss": 7.0}]
    assert capsys.readouterr().out == ""


def test_several_damaged_lines_are_one_line(tmp_path, capsys):
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(b'{"step": 1}\n\xff\n{"step": 2}\n\xff\n\n{"step": 3}\n')
    assert [row["step"] for row in read_rows(path)] == [1, 2, 3]
    assert capsys.readouterr().out == f"{path}: 3 lines from 2 on left out: must be a row of JSON with its step\n"


def test_a_log_that_cannot_be_read_is_one_line(tmp_path):
    (tmp_path / "metrics.jsonl").mkdir()
    with pytest.raises(InputError, match="metrics.jsonl: cannot be read: Is a directory$"):
        read_rows(tmp_path / "metrics.jsonl")


def test_what_cannot_be_written_is_one_line(tmp_path):
    log = RunLog(tmp_path)
    (tmp_path / "metrics.jsonl").unlink()
    (tmp_path / "metrics.jsonl").mkdir()
    with pytest.raises(InputError) as raised:
        log.write(ROWS[0])
    assert str(raised.value) == f"{tmp_path / 'metrics.jsonl'}: cannot be written: Is a directory"
    log.close()


@pytest.mark.parametrize("name", ["metrics.jsonl", "tensorboard"])
def test_what_lies_in_the_way_is_one_line(tmp_path, name):
    if name == "tensorboard":
        (tmp_path / name).touch()
    else:
        (tmp_path / name).mkdir()
    with pytest.raises(InputError, match=f"{name}: cannot be written: ") as raised:
        RunLog(tmp_path)
    assert "\n" not in str(raised.value)


def test_an_old_key_of_a_row_is_taken_for_the_new_one_and_said_once(tmp_path, capsys):
    path, new = tmp_path / "metrics.jsonl", [row | {"eval_sets": {"hill": {}}} for row in ROWS]
    path.write_text("".join(json.dumps(row).replace("eval_sets", "watched") + "\n" for row in new))
    assert read_rows(path) == new
    assert capsys.readouterr().out == (
        f"{path}: key 'watched' is now called 'eval_sets'; the old name will not be read by the next version\n"
    )
    RunLog(tmp_path, step=3).close()
    capsys.readouterr()
    assert read_rows(path) == new and capsys.readouterr().out == ""  # a run that goes on writes the new key


def test_a_row_with_an_old_key_and_its_new_one_is_left_out(tmp_path, capsys):
    path = tmp_path / "metrics.jsonl"
    path.write_text(f"{json.dumps(ROWS[0])}\n{json.dumps(ROWS[1] | {'watched': {}, 'eval_sets': {}})}\n")
    assert read_rows(path) == ROWS[:1]
    assert "line 2 left out" in capsys.readouterr().out
