"""What a training run reports: metrics.jsonl, a line for each report, and TensorBoard."""

import json
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from travjax.config import InputError
from travjax.files import save_text


class RunLog:
    """Rows of numbers, each with its `step`, in folder/metrics.jsonl and folder/tensorboard.

    A run that goes on from a step starts with the rows up to there; later ones are cut off.
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
            # SummaryWriter writes from a thread, which dies over a full disk and lets its caller wait for ever.
            self._board = EventsWriter(str(board / "events"))
            if step:
                later = SessionLog(status=SessionLog.START)
                self._board.write_event(Event(wall_time=time.time(), step=step + 1, session_log=later))
        except OSError as error:
            raise InputError(f"{board}: cannot be written: {error.strerror}") from None

    def write(self, row: dict[str, Any]) -> None:
        """Appends a row; a dict in it is a group of numbers."""
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
    """The rows of a metrics.jsonl, none if there is no file; a last line that was cut short does not count."""
    try:
        lines = path.read_text().splitlines()
    except FileNotFoundError:
        return []
    rows = []
    for number, line in enumerate(lines, start=1):
        try:
            row = json.loads(line)
            row["step"] + 0
            rows.append(row)
        except (ValueError, LookupError, TypeError):
            if number < len(lines):
                raise InputError(f"{path}: line {number}: not a row with its step") from None
    return rows
