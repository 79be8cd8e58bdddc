"""SIGINT and SIGTERM end a program in one line, with a code of their own, and leave nothing behind."""

import os
import signal
import subprocess
import sys

import pytest

from travjax import entry, signals

ENDS = {signal.SIGINT: (130, "travjax: interrupted"), signal.SIGTERM: (143, "travjax: terminated")}

WORK = """
import os, signal
from pathlib import Path
from travjax import entry, files, signals
signals.end_at_once()
def work():
    with signals.going_on("it goes on"), files.atomic_write(Path("a.txt")) as temporary:
        temporary.write_text("half")
        os.kill(os.getpid(), NUMBER)
        print("still here")
raise SystemExit(entry.guarded(work))
"""

DROPPED = """
import os, signal, time
from travjax import entry, signals
class Closed:
    def __del__(self):
        os.kill(os.getpid(), NUMBER)
        print("not here")
def work():
    Closed()  # Python drops what a destructor raises
    time.sleep(100)
raise SystemExit(entry.guarded(work))
"""

POSTPONED = """
import os, signal
from travjax import entry, signals
def work():
    with signals.postponed():
        os.kill(os.getpid(), NUMBER)
        print("done")
        SECOND
    print("not here")
raise SystemExit(entry.guarded(work))
"""

IMPORTS = """
import os, signal
from travjax import signals
signals.end_at_once()
try:
    os.kill(os.getpid(), NUMBER)
except BaseException:  # as libraries do on import
    pass
print("still here")
"""


def script(text: str, number: int, folder, *before: str) -> subprocess.CompletedProcess:
    words = [*before, sys.executable, "-c", text.replace("NUMBER", str(int(number)))]
    return subprocess.run(words, cwd=folder, capture_output=True, text=True)


@pytest.mark.parametrize("number", ENDS)
def test_work_is_cleaned_up_and_says_how_it_goes_on(tmp_path, number):
    done = script(WORK, number, tmp_path)
    code, line = ENDS[number]
    assert (done.returncode, done.stdout, done.stderr) == (code, "", f"{line}; it goes on\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", ENDS)
def test_a_signal_that_comes_in_a_destructor_is_not_lost(tmp_path, number):
    done = script(DROPPED, number, tmp_path)
    code, line = ENDS[number]
    assert (done.returncode, done.stdout, done.stderr) == (code, "", f"{line}\n")


@pytest.mark.parametrize("number", ENDS)
@pytest.mark.parametrize("second", ["pass", "os.kill(os.getpid(), NUMBER); print('not here')"])
def test_a_signal_waits_for_a_block_that_cannot_be_left_halfway_and_a_second_one_does_not(tmp_path, number, second):
    done = script(POSTPONED.replace("SECOND", second), number, tmp_path)
    code, line = ENDS[number]
    assert (done.returncode, done.stdout, done.stderr) == (code, "done\n", f"{line}\n")


@pytest.mark.parametrize("number", ENDS)
def test_imports_are_ended_at_once_whatever_they_catch(tmp_path, number):
    done = script(IMPORTS, number, tmp_path)
    code, line = ENDS[number]
    assert (done.returncode, done.stdout, done.stderr) == (code, "", f"{line}\n")


@pytest.mark.parametrize("text", [WORK, IMPORTS])
def test_what_the_program_was_told_to_ignore_is_ignored(tmp_path, text):
    shell = ("sh", "-c", 'trap "" INT; exec "$@"', "sh")  # as a shell starts what runs in the background
    done = script(text, signal.SIGINT, tmp_path, *shell)
    assert (done.returncode, done.stdout, done.stderr) == (0, "still here\n", "")


def test_the_caller_s_handlers_come_back():
    mine = lambda number, frame: None
    before = signal.signal(signal.SIGTERM, mine)
    try:
        with pytest.raises(signals.Terminated), signals.raised():
            os.kill(os.getpid(), signal.SIGTERM)
        assert signal.getsignal(signal.SIGTERM) is mine
        assert entry.guarded(lambda: os.kill(os.getpid(), signal.SIGTERM)) == 143
        assert signal.getsignal(signal.SIGTERM) is mine
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("module", ["travjax", "travjax.experiments.transfer"])
def test_a_program_that_is_stopped_while_jax_is_imported_ends_in_one_line(tmp_path, module):
    (tmp_path / "jax.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    words = [sys.executable, "-m", module, "--help"]
    done = subprocess.run(words, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "travjax: interrupted\n")
