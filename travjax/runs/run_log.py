"""The log of a training run: metrics.jsonl, with one line for each report, and TensorBoard files."""

import json
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from travjax.config import InputError, one_line, parse_json, say_renamed
from travjax.files import save_text

FORMERLY = {"watched": "eval_sets"}
"""Old keys of rows, and what they are called now."""


class RunLog:
    """Rows of numbers, each with its `step`, in folder/metrics.jsonl and folder/tensorboard.

    A run that resumes from a step keeps the rows up to that step; later ones are removed.
    Raises InputError when a file cannot be written.
    """

    def __init__(self, folder: Path, step: int = 0):
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog

        self.path = folder / "metrics.jsonl"
        kept = [row for row in read_rows(self.path) if row["step"] <= step] if step else []
        save_text(self.path, "".join(f"{json.dumps(row)}\n" for row in kept))
        board = folder / "tensorboard"
        try:
            board.mkdir(exist_ok=True)
            # SummaryWriter writes from a thread, which dies when the disk is full and leaves its caller waiting.
            self._board = EventsWriter(str(board / "events"))
            if step:
                later = SessionLog(status=SessionLog.START)
                self._board.write_event(Event(wall_time=time.time(), step=step + 1, session_log=later))
        except OSError as error:
            raise InputError(f"{board}: cannot be written: {error.strerror}") from None

    def write(self, row: dict[str, Any]) -> None:
        """Appends a row; a dict within it is a group of numbers."""
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.summary import scalar

        try:
            with self.path.open("a") as file:
                file.write(json.dumps(row, allow_nan=False) + "\n")
            for key, value in row.items():
                inner = value if isinstance(value, dict) else {"": value}
                for name, number in inner.items():
                    if isinstance(number, int | float):
                        summary = scalar(f"{key}/{name}".rstrip("/"), number)
                        self._board.write_event(Event(wall_time=time.time(), step=row["step"], summary=summary))
            self._board.flush()
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {error.strerror}") from None

    def close(self) -> None:
        """Closes the files; a full disk was reported when the last row was written."""
        with suppress(OSError):
            self._board.close()


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Reads the rows of a metrics.jsonl, none if there is no file; prints which lines are not rows with a step.

    Those lines are left out: a damaged log does not stop a run. A last line that was cut short is skipped silently.
    Old keys are taken for what they are called now, and named in a line; a row must not have both.
    Raises InputError when the file cannot be read.
    """
    try:
        *lines, last = path.read_bytes().split(b"\n")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    found = [_row(line) for line in lines]
    damaged = [str(number) for number, row in enumerate(found, start=1) if row is None]
    if damaged:
        numbers = f"line {damaged[0]}" if len(damaged) == 1 else f"{len(damaged)} lines from {damaged[0]} on"
        print(one_line(f"{path}: {numbers} left out: must be a row of JSON with its step"))
    rows = [row for row in (*found, _row(last)) if row is not None]
    say_renamed(path, {old: new for old, new in FORMERLY.items() if any(old in row for row in rows)})
    return [{FORMERLY.get(key, key): value for key, value in row.items()} for row in rows]


def _row(line: bytes) -> dict[str, Any] | None:
    """Parses a line; returns None where it is not a row."""
    try:
        row = parse_json(line.decode(), "row")
    except (UnicodeDecodeError, InputError):
        return None
    if not isinstance(row, dict) or any(old in row and new in row for old, new in FORMERLY.items()):
        return None
    return row if type(row.get("step")) is int and row["step"] >= 0 else None
