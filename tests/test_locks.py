"""A lock ends with its file or its process, and is no other's as long as it lasts."""

import errno
import subprocess
import sys

import pytest

from travjax import locks
from travjax.locks import lock_file

TRIES = "import sys; from pathlib import Path; from travjax.locks import lock_file; print(lock_file(Path('it'))[1])"


def tried(folder) -> str:
    """What another process gets."""
    done = subprocess.run([sys.executable, "-c", TRIES], cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_a_file_is_locked_until_it_is_closed(tmp_path):
    file, locked = lock_file(tmp_path / "it")
    with file:
        assert locked is True
        assert tried(tmp_path) == "False"
        other, second = lock_file(tmp_path / "it")
        other.close()
        assert second is False
    assert tried(tmp_path) == "True"


def test_a_file_that_its_holder_removes_meanwhile_is_made_anew(tmp_path, monkeypatch):
    path, lock = tmp_path / "it", locks._lock
    found = []

    def removed(file):
        if not found:
            path.unlink()  # between opening and locking
        found.append(lock(file))
        return found[-1]

    monkeypatch.setattr(locks, "_lock", removed)
    file, locked = lock_file(path)
    with file:
        assert locked is True and found == [True, True]
        monkeypatch.undo()
        assert tried(tmp_path) == "False"


@pytest.mark.parametrize(
    ("error", "expected"),
    [(errno.ENOLCK, None), (errno.EOPNOTSUPP, None), (errno.EAGAIN, False), (errno.EACCES, False)],
)
def test_a_file_system_without_locks_is_told_from_one_whose_lock_is_taken(tmp_path, monkeypatch, error, expected):
    def refused(file, how):
        raise OSError(error, "no")

    monkeypatch.setattr("fcntl.flock", refused)
    file, locked = lock_file(tmp_path / "it")
    file.close()
    assert locked is expected
