"""Runs cases in processes of worker.py, so that one that dies or hangs is caught as one that raises is."""

import json
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from .worker import ACCEPTED, FAILED, noise_of

REPOSITORY = Path(__file__).resolve().parents[2]

FORMATS = "tests.fuzz.formats"
"""The module with the table of formats."""

PATIENCE = 120
"""Seconds of waiting after which a process is taken to hang; the cores may be busy with other work."""

START = 600
"""The same while it is started and undamaged files are made and read."""

Case = tuple[str, int]
"""A format and a seed."""


@dataclass(frozen=True)
class Finding:
    """What became of a case.

    result:  worker.ACCEPTED, REFUSED or FAILED
    message: of the reader, or why it failed
    damage:  what was done to which file
    kept:    the folder with the files of a failing case, if they were to be kept
    """

    case: Case
    result: str
    message: str
    damage: str = ""
    kept: Path | None = None

    def __str__(self) -> str:
        place = f"; kept in {self.kept}" if self.kept else ""
        damage = f" ({self.damage})" if self.damage else ""
        return f"{self.case[0]}:{self.case[1]}: {self.message}{damage}{place}"


def run(
    cases: Iterable[Case],
    formats: Sequence[str],
    *,
    workers: int = 2,
    module: str = FORMATS,
    keep: Path | None = None,
    patience: float = PATIENCE,
    on_finding: Callable[[Finding], object] = lambda finding: None,
) -> list[Finding]:
    """Returns what became of each case, in their order by format and seed.

    formats:  those of the cases, whose seeds are made first
    keep:     where the files of failing cases go
    patience: seconds of waiting after which a process is taken to hang
    Raises RuntimeError when an undamaged seed is not accepted.
    """
    found: list[Finding] = []
    errors: list[Exception] = []
    source, lock = iter(cases), threading.Lock()

    def serve(worker: Worker) -> None:
        try:
            while True:
                with lock:
                    case = next(source, None)
                if case is None:
                    return
                finding = worker.tried(case, keep)
                with lock:
                    found.append(finding)
                    on_finding(finding)
        except Exception as error:  # to be raised where the caller is
            errors.append(error)

    with tempfile.TemporaryDirectory(prefix="travjax-fuzz-") as folder, ExitStack() as stack:
        place = Path(folder)
        (place / "work").mkdir()
        every = [stack.enter_context(Worker(place, module, formats, patience)) for _ in range(workers)]
        every[0].make_seeds()
        threads = [threading.Thread(target=serve, args=(worker,)) for worker in every]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    if errors:
        raise errors[0]
    return sorted(found, key=lambda finding: finding.case)


class Worker:
    """A process that reads cases; where one ends it, another takes its place.

    formats: what it reads undamaged before its memory is limited, so that everything is imported by then
    """

    def __init__(self, place: Path, module: str, formats: Sequence[str], patience: float):
        self.place, self.module, self.formats, self.patience = place, module, list(formats), patience
        self._process: subprocess.Popen | None = None

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, *_) -> None:
        self._end()

    def make_seeds(self) -> None:
        """Writes a valid file of each format; raises RuntimeError when its reader does not accept it."""
        for form in self.formats:
            result, message, *_ = self.ask({"make": form})
            if result != ACCEPTED:
                raise RuntimeError(f"{form}: an undamaged file is not accepted: {message}")
        self.ask({"read": []})

    def tried(self, case: Case, keep: Path | None) -> Finding:
        """What becomes of a case; its files are kept if it fails."""
        if self._process is None:
            self.ask({"read": self.formats})
        assert self._process
        files = self.place / "work" / str(self._process.pid)
        finding = Finding(case, *self.ask({"case": case}, self.patience))
        if finding.result != FAILED or keep is None:
            return finding
        kept = keep / f"{case[0]}-{case[1]}".replace(" ", "_").replace("/", "_")
        shutil.rmtree(kept, ignore_errors=True)
        shutil.copytree(files, kept)
        return Finding(finding.case, finding.result, finding.message, finding.damage, kept)

    def ask(self, task: dict, patience: float = START) -> list[str]:
        """The answer to a task: result, message, and of a case what was done; FAILED where the process ended."""
        process = self._process or self._start()
        assert process.stdin and process.stdout
        process.stdin.write(json.dumps(task).encode() + b"\n")
        process.stdin.flush()
        ready, _, _ = select.select([process.stdout], [], [], patience)
        answer = process.stdout.readline() if ready else b""
        if answer:
            return json.loads(answer)
        if not ready:
            self._end()
            return [FAILED, f"no answer within {patience:g} s"]
        code = process.wait()
        why = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        noise = noise_of(self.place / "work", process.pid)
        said = noise.read_text(errors="replace").strip().splitlines() if noise.exists() else []
        self._end()
        return [FAILED, f"the process ended by {why}: {' '.join(said[-1:])[:300]}"]

    def _start(self) -> subprocess.Popen:
        words = [self.module, str(self.place / "seeds"), str(self.place / "work")]
        code = f"from tests.fuzz.worker import main; main(*{words!r})"
        paths = [str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])]
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            # As the programs set it: XLA logs an error over compiled code that it reads back from a cache.
            env=os.environ | {"PYTHONPATH": os.pathsep.join(paths), "TF_CPP_MIN_LOG_LEVEL": "3"},
        )
        return self._process

    def _end(self) -> None:
        if self._process:
            self._process.kill()
            self._process.wait()
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe:
                    pipe.close()
            self._process = None
