"""What tests of commands share: running one in this process, and what it did."""

import contextlib
import io
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from travjax import cli
from travjax.simulation.actions import ActionSpace

FEW = ActionSpace(turns=2, arc_lengths=(0.5, 0.6), radii=(math.inf, 1.5, -1.5), interval=0.1)
FEW_TOML = "turns = 2\narc_lengths = [0.5, 0.6]\nradii = [inf, 1.5, -1.5]\ninterval = 0.1\n"


class Run(NamedTuple):
    """What one command did."""

    code: int
    out: str
    err: str
    folder: Path

    def arrays(self, name: str = "labels.npz") -> dict[str, np.ndarray]:
        with np.load(self.folder / name) as file:
            return dict(file)


class Terminal(io.StringIO):
    """Standard errors that somebody watches, so that bars are drawn."""

    def isatty(self) -> bool:
        return True


def run_words(*words) -> tuple[int, str, str]:
    """`travjax words...` in this process: exit code, standard output and errors."""
    out, err = io.StringIO(), Terminal()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        return cli.main([*map(str, words)]), out.getvalue(), err.getvalue()


def run(folder: Path, *words) -> Run:
    """`travjax words... --out folder` in this process."""
    return Run(*run_words(*words, "--out", folder), folder)


def succeeds(folder: Path, *words) -> Run:
    done = run(folder, *words)
    assert done.code == 0, done.err
    return done


def printed_files(done: Run) -> set[Path]:
    """The lines that are paths."""
    return {Path(line) for line in done.out.splitlines() if line.startswith(str(done.folder))}


def files(folder: Path) -> set[Path]:
    return set(folder.rglob("*")) if folder.exists() else set()
