"""A process that damages files, has them read and judges what came out; campaign.py starts it and sets its tasks.

Tasks come as lines of JSON on standard input, answers go the same way on standard output.
"""

import importlib
import json
import logging
import os
import resource
import shutil
import sys
import time
import traceback
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MEMORY = 2 << 30
"""Bytes that reading may take beyond what the process has once everything is imported."""

SECONDS = 20
"""Seconds of processor time that a file may take."""

ACCEPTED, REFUSED, FAILED = "accepted", "refused", "failed"


class Invalid(Exception):
    """What a reader returned is not what it may return."""


@dataclass(frozen=True)
class Format:
    """A kind of file.

    make:   writes a valid file, or several, to an empty folder, the same bytes each time if it can
    read:   has them read by the reader under test and raises Invalid unless what comes out is valid
    reseal: makes the checksums within the files right again, so that damage gets past them
    """

    make: Callable[[Path], object]
    read: Callable[[Path], object]
    reseal: Callable[[Path], object] | None = None


def damage(formats: dict[str, Format], name: str, seed: int, seeds: Path, place: Path) -> str:
    """Writes the case of a seed to the folder `place`; returns what was done to which file."""
    from .mutations import mutated

    form, rng = formats[name], np.random.default_rng([zlib.crc32(name.encode()), seed])
    shutil.copytree(seeds / name, place)
    targets = sorted(path for path in place.rglob("*") if path.is_file())
    target = targets[rng.integers(len(targets))]
    data, done = mutated(target.read_bytes(), rng)
    target.write_bytes(data)
    if form.reseal and rng.random() < 0.6:
        form.reseal(place)
        done += ", checksums made anew"
    return f"{target.relative_to(place)}: {done}"


def judge(form: Format, folder: Path, noise: Path) -> tuple[str, str]:
    """What became of reading the folder: ACCEPTED, REFUSED or FAILED, and the message.

    noise: a file for what is written to standard error meanwhile
    """
    from travjax.config import InputError

    logging.root.handlers.clear()  # what tests import logs more than travjax does
    began = time.process_time()
    with noise.open("wb") as file, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        kept = os.dup(2)
        os.dup2(file.fileno(), 2)
        try:
            form.read(folder)
            result, message = ACCEPTED, ""
        except InputError as error:
            result, message = REFUSED, str(error)
        except BaseException as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{Path(where.filename).name}:{where.lineno}"
            result, message = FAILED, f"{type(error).__name__} at {place}: {str(error)[:200]}"
        finally:
            os.dup2(kept, 2)
            os.close(kept)
    said = " ".join(noise.read_bytes()[:400].decode(errors="replace").split())
    taken = time.process_time() - began
    if result == REFUSED and not message.isprintable():
        return FAILED, f"a message that is not one line: {message[:200]!r}"
    if result == REFUSED and str(folder) not in message:
        return FAILED, f"a message that names no file: {message[:200]}"
    if result != FAILED and caught:
        first = caught[0]
        place = f"{Path(first.filename).name}:{first.lineno}"
        return FAILED, f"{first.category.__name__} at {place}: {str(first.message)[:200]}"
    if result != FAILED and said:
        return FAILED, f"words on standard error: {said}"
    if result != FAILED and taken > SECONDS:
        return FAILED, f"{taken:.0f} s of processor time"
    return result, message


def limit_memory() -> None:
    """Lets the process grow by MEMORY from now on, and leave no core file."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * os.sysconf("SC_PAGE_SIZE") + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main(module: str, seeds: str, work: str) -> None:
    """Serves tasks: {"make": format} writes its seed, {"read": formats} reads seeds, {"case": [format, seed]}."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    formats = importlib.import_module(module).FORMATS
    logging.getLogger("asyncio").disabled = True  # tells of Orbax's tasks that failed, during cases long after
    folder, noise = Path(work) / f"{os.getpid()}", noise_of(Path(work), os.getpid())
    for line in sys.stdin:
        task = json.loads(line)
        if "make" in task:
            form, place = formats[task["make"]], Path(seeds) / task["make"]
            place.mkdir(parents=True)
            form.make(place)
            answer: tuple = judge(form, place, noise)
        elif "read" in task:
            for name in task["read"]:  # so that everything that their readers need is imported
                judge(formats[name], Path(seeds) / name, noise)
            limit_memory()
            answer = (ACCEPTED, "")
        else:
            shutil.rmtree(folder, ignore_errors=True)
            done = damage(formats, *task["case"], Path(seeds), folder)
            answer = (*judge(formats[task["case"][0]], folder, noise), done)
        answers.write(json.dumps(answer) + "\n")


def noise_of(work: Path, pid: int) -> Path:
    """Where a process leaves what was last written to standard error."""
    return work / f"{pid}.err"
