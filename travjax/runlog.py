"""What a training run reports: metrics.jsonl, a line for each report, and TensorBoard."""

import json
from pathlib import Path
from typing import Any

from travjax.config import InputError
from travjax.files import written_whole


class RunLog:
    """Rows of numbers, each with its `step`, in folder/metrics.jsonl and folder/tensorboard.

    A run that goes on from a step starts with the rows up to there; later ones are cut off.
    Raises InputError when a file cannot be written.
    """

    def __init__(self, folder: Path, step: int = 0):
        from tensorboardX import SummaryWriter

        self.path = folder / "metrics.jsonl"
        kept = [row for row in read_rows(self.path) if row["step"] <= step] if step else []
        with written_whole(self.path) as temporary:
            temporary.write_text("".join(f"{json.dumps(row)}\n" for row in kept))
        try:
            self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1 if step else None)
        except OSError as error:
            raise InputError(f"{folder / 'tensorboard'}: cannot be written: {error.strerror}") from None

    def write(self, row: dict[str, Any]) -> None:
        """Appends a row; a dict in it is a group of numbers."""
        try:
            with self.path.open("a") as file:
                file.write(json.dumps(row, allow_nan=False) + "\n")
            for key, value in row.items():
                inner = value if isinstance(value, dict) else {"": value}
                for name, number in inner.items():
                    if isinstance(number, int | float):
                        self._board.add_scalar(f"{key}/{name}".rstrip("/"), number, row["step"])
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {error.strerror}") from None

    def close(self) -> None:
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
