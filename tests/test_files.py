"""Files are written whole or not at all, and output folders are checked."""

import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from travjax import files
from travjax.config import InputError
from travjax.files import atomic_write, atomic_write_folder, find_data, find_preset, held, output_folder, save_npz


def listing(folder) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_file_appears_when_the_block_ends(tmp_path):
    path = tmp_path / "a.txt"
    with atomic_write(path) as temporary:
        temporary.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert listing(tmp_path) == {"a.txt"}


def test_the_temporary_file_lies_in_a_hidden_folder_beside_the_final_one(tmp_path):
    # Only within one file system is it a rename, which happens at once.
    with atomic_write(tmp_path / "a.txt") as temporary:
        assert temporary.name == "a.txt"
        assert temporary.parent.parent == tmp_path and temporary.parent.name.startswith(".travjax-unfinished-")
        temporary.touch()
    with atomic_write(tmp_path / ("n" * 255)) as temporary:
        temporary.touch()


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_a_failed_write_leaves_nothing(tmp_path, error):
    with pytest.raises(error), atomic_write(tmp_path / "a.txt") as temporary:
        temporary.write_text("half")
        raise error
    assert listing(tmp_path) == set()


def test_a_failure_before_the_first_byte_is_passed_on(tmp_path):
    with pytest.raises(RuntimeError), atomic_write(tmp_path / "a.txt"):
        raise RuntimeError
    assert listing(tmp_path) == set()


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic_write(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert listing(tmp_path) == {"a.txt"}


def test_an_old_file_is_there_until_the_new_one_replaces_it(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with path.open() as reader, atomic_write(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
        # A reader that has opened the old file goes on with it: the new one is another file under the same name.
        inode = path.stat().st_ino
    assert path.read_text() == "new"
    assert path.stat().st_ino != inode
    assert reader.closed


def test_arrays_are_read_back_as_they_were_saved(tmp_path):
    arrays = dict(heights=np.arange(6, dtype=np.float32).reshape(2, 3), group=np.array(["a", "bc"]), cell_size=0.0625)
    path = save_npz(tmp_path / "a.npz", **arrays)
    assert path == tmp_path / "a.npz"
    with np.load(path) as loaded:
        assert set(loaded) == set(arrays)
        for name, expected in arrays.items():
            np.testing.assert_array_equal(loaded[name], expected)
            assert loaded[name].dtype == np.asarray(expected).dtype
    assert listing(tmp_path) == {"a.npz"}


def test_the_name_is_kept_whatever_its_suffix(tmp_path):
    save_npz(tmp_path / "labels", x=1)
    assert listing(tmp_path) == {"labels"}


def test_arrays_that_cannot_be_saved_leave_nothing(tmp_path):
    class Unsaveable:
        def __reduce__(self):
            raise RuntimeError("no")

    with pytest.raises(RuntimeError):
        save_npz(tmp_path / "a.npz", heights=np.zeros(3), bad=np.array(Unsaveable(), object))
    assert listing(tmp_path) == set()


def test_an_output_folder_is_created_with_its_parents(tmp_path):
    folder = output_folder(tmp_path / "a" / "b")
    assert folder == tmp_path / "a" / "b"
    assert folder.is_dir()
    assert listing(folder) == set()


def test_an_output_folder_may_exist_and_keeps_its_files(tmp_path):
    (tmp_path / "old.txt").write_text("old")
    assert output_folder(str(tmp_path)) == tmp_path
    assert listing(tmp_path) == {"old.txt"}


def test_a_link_to_a_folder_is_an_output_folder(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert output_folder(tmp_path / "link") == tmp_path / "link"


@pytest.mark.parametrize("below", ["", "sub", "sub/sub"])
def test_a_file_in_the_way_is_named_and_kept(tmp_path, below):
    (tmp_path / "taken").write_text("mine")
    folder = tmp_path / "taken" / below
    with pytest.raises(InputError) as raised:
        output_folder(folder)
    message = str(raised.value)
    assert message.startswith(f"--out {folder}: cannot be written: ")
    assert "allowed: a folder you may write to" in message
    assert len(message.splitlines()) == 1
    assert (tmp_path / "taken").read_text() == "mine"


def test_a_link_that_leads_nowhere_is_no_output_folder(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "none")
    with pytest.raises(InputError, match="link: cannot be written: "):
        output_folder(tmp_path / "link")


def test_a_folder_that_takes_no_files_is_no_output_folder():
    # The process file system lets nobody create a file, not even root.
    with pytest.raises(
        InputError, match=r"^--out /proc/self: cannot be written: .*allowed: a folder you may write to$"
    ):
        output_folder("/proc/self")


def test_data_are_found_here_or_under_travjax_data(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    (tmp_path / "data/terrain").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("TRAVJAX_DATA", str(tmp_path / "data"))
    far = tmp_path / "data/terrain/a.tif"
    far.touch()
    assert find_data("terrain/a.tif", "map") == far
    assert find_data(str(far), "map") == far
    (tmp_path / "here/terrain").mkdir()
    with pytest.raises(InputError, match=f"^map terrain: no such file here, nor under TRAVJAX_DATA={tmp_path}/data; "):
        find_data("terrain", "map")
    (tmp_path / "here/terrain/a.tif").touch()
    assert find_data("terrain/a.tif", "map") == Path("terrain/a.tif")


@pytest.mark.parametrize("data", [None, ""])
def test_missing_data_are_one_line_that_says_what_is_allowed(tmp_path, monkeypatch, data):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TRAVJAX_DATA", data) if data is not None else monkeypatch.delenv("TRAVJAX_DATA", raising=False)
    with pytest.raises(InputError) as raised:
        find_data("a.tif", "map of the moon", "--map FILE")
    message = "map of the moon a.tif: no such file here, and TRAVJAX_DATA is not set; allowed: --map FILE"
    assert str(raised.value) == message


# ---- Presets


@pytest.mark.parametrize("kind", ["resnet50", "field", "transfer"])
def test_a_preset_is_found_by_its_name_from_anywhere(tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "laptop").touch()
    assert find_preset("laptop", kind) == files.PRESETS / kind / "laptop.toml"
    assert find_preset("laptop", kind).is_file()


def test_a_preset_is_found_by_its_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "laptop.toml").touch()
    for given in ("laptop.toml", "./laptop.toml", str(tmp_path / "laptop.toml"), tmp_path / "laptop.toml"):
        assert find_preset(given, "field") == Path(given)
    assert find_preset("~/laptop.toml", "field") == tmp_path / "laptop.toml"


@pytest.mark.parametrize(
    ("given", "kind", "message"),
    [
        (
            "big",
            "resnet50",
            "preset big: no such resnet50 preset; allowed: laptop, paper, smoke, workstation, or a .toml file",
        ),
        ("real", "field", "preset real: no such field preset; allowed: laptop, paper, smoke, or a .toml file"),
        ("../field/laptop", "field", "preset ../field/laptop: no such field preset; allowed: laptop, paper, smoke, or"),
        ("laptop", "sites", "preset laptop: no such sites preset; allowed: real, real_upright, stand_in, or a"),
    ],
)
def test_a_preset_that_is_not_there_is_one_line_that_lists_the_names(tmp_path, monkeypatch, given, kind, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=f"^{re.escape(message)}") as raised:
        find_preset(given, kind)
    assert "\n" not in str(raised.value)


# ---- What dead processes leave


def killed(folder: Path, script: str) -> None:
    """Runs a script in the folder, in a process that ends by SIGKILL."""
    start = "import os, signal\nfrom pathlib import Path\nfrom travjax import files\n"
    end = "\nos.kill(os.getpid(), signal.SIGKILL)\n"
    done = subprocess.run([sys.executable, "-c", start + script.replace("KILL", end.strip())], cwd=folder)
    assert done.returncode == -signal.SIGKILL


FILE = "with files.atomic_write(Path('a.txt')) as temporary:\n    temporary.write_text('half')\n    KILL"
FOLDER = """
with files.atomic_write_folder(Path('set'), lambda folder: True) as temporary:
    (temporary / 'half').touch()
    KILL
"""


@pytest.mark.parametrize("script", [FILE, FOLDER])
def test_the_next_process_removes_what_a_dead_one_was_writing(tmp_path, script):
    killed(tmp_path, script)
    assert len(listing(tmp_path)) == 1 and "a.txt" not in listing(tmp_path)
    with atomic_write(tmp_path / "b.txt") as temporary:
        temporary.touch()
    assert listing(tmp_path) == {"b.txt"}


def test_an_output_folder_is_cleared_of_it_at_once(tmp_path):
    killed(tmp_path, FILE)
    output_folder(tmp_path)
    assert listing(tmp_path) == set()


def test_what_a_live_process_is_writing_is_left_alone(tmp_path):
    # Also by a process of the same number, as all containers have.
    with atomic_write(tmp_path / "a.txt") as mine:
        mine.write_text("mine")
        with atomic_write(tmp_path / "a.txt") as other:
            other.write_text("other")
        output_folder(tmp_path)
        other_process = "from travjax.files import output_folder; output_folder('.')"
        subprocess.run([sys.executable, "-c", other_process], cwd=tmp_path, check=True)
    assert (tmp_path / "a.txt").read_text() == "mine"
    assert listing(tmp_path) == {"a.txt"}


def test_a_folder_of_the_user_is_no_remains(tmp_path):
    for name in (".travjax-unfinished", ".travjax-unfinished-of-mine", ".12-labels.npz"):
        (tmp_path / name).mkdir()
    before = listing(tmp_path)
    output_folder(tmp_path)
    assert listing(tmp_path) == before


# ---- Folders that are written whole


def folder_of(path: Path, text: str) -> Path:
    with atomic_write_folder(path, lambda folder: (folder / "it.txt").exists()) as temporary:
        (temporary / "it.txt").write_text(text)
    return path


@pytest.mark.parametrize("exchanges", [True, False])
def test_a_folder_replaces_an_older_one(tmp_path, monkeypatch, exchanges):
    if not exchanges:
        monkeypatch.setattr(files, "_exchanged", lambda one, other: False)
    for text in ("old", "new"):
        folder = folder_of(tmp_path / "set", text)
        assert (folder / "it.txt").read_text() == text
        assert listing(tmp_path) == {"set"}


def test_the_system_exchanges_two_folders_at_once(tmp_path):
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).touch()
    assert files._exchanged(tmp_path / "one", tmp_path / "other")
    assert listing(tmp_path / "one") == {"other"} and listing(tmp_path / "other") == {"one"}
    assert not files._exchanged(tmp_path / "one", tmp_path / "none")


BETWEEN = """
files._exchanged = lambda one, other: False
rename = Path.rename
def killed(self, place):
    if self.name == 'set' and place == Path('set').resolve():
        KILL
    return rename(self, place)
Path.rename = killed
with files.atomic_write_folder(Path('set'), lambda folder: True) as temporary:
    (temporary / 'it.txt').write_text('new')
"""


@pytest.mark.parametrize("looks", [files.put_back, lambda folder: output_folder(folder.parent)])
def test_a_folder_comes_back_that_a_dead_process_had_moved_aside(tmp_path, looks):
    folder_of(tmp_path / "set", "old")
    killed(tmp_path, BETWEEN)
    assert "set" not in listing(tmp_path)
    looks(tmp_path / "set")
    assert (tmp_path / "set/it.txt").read_text() == "old"
    assert listing(tmp_path) == {"set"}


def test_a_folder_stays_where_its_place_was_when_the_other_cannot_take_it(tmp_path, monkeypatch):
    folder_of(tmp_path / "set", "old")
    monkeypatch.setattr(files, "_exchanged", lambda one, other: False)
    rename = Path.rename

    def refused(self, place):
        if self.name == "set" and place == tmp_path / "set" and "replaced" not in str(self):
            raise PermissionError(13, "Permission denied")
        return rename(self, place)

    monkeypatch.setattr(Path, "rename", refused)
    with pytest.raises(InputError, match="set: cannot be written: Permission denied"):
        folder_of(tmp_path / "set", "new")
    assert (tmp_path / "set/it.txt").read_text() == "old"
    assert listing(tmp_path) == {"set"}


def test_a_folder_that_holds_something_else_is_kept(tmp_path):
    (tmp_path / "set").mkdir()
    (tmp_path / "set/mine").touch()
    with pytest.raises(InputError, match="set: holds something else"):
        folder_of(tmp_path / "set", "new")
    assert listing(tmp_path) == {"set"} and listing(tmp_path / "set") == {"mine"}


def test_a_link_to_itself_is_one_line(tmp_path):
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    with pytest.raises(InputError, match="loop: "):
        folder_of(loop, "new")
    with pytest.raises(InputError, match="loop: "), held(loop):
        pass
    assert listing(tmp_path) == {"loop"}


# ---- Folders that one process uses


HOLDS = """
with files.held(Path('run')):
    Path('holds').touch()
    input()
"""


def test_a_folder_in_use_is_refused_until_its_process_is_dead(tmp_path):
    start = "import os, signal\nfrom pathlib import Path\nfrom travjax import files\n"
    other = subprocess.Popen([sys.executable, "-c", start + HOLDS], cwd=tmp_path, stdin=subprocess.PIPE)
    try:
        while not (tmp_path / "holds").exists():
            assert other.poll() is None
            time.sleep(0.01)
        with pytest.raises(InputError) as raised, held(tmp_path / "run"):
            pass
        used = f"in use by process {other.pid} on {socket.gethostname()}"
        assert str(raised.value) == f"--out {tmp_path}/run: {used}; allowed: a folder that no other run uses"
    finally:
        other.kill()
        other.communicate()
    assert listing(tmp_path / "run") == {files.LOCK}
    with held(tmp_path / "run"):
        (tmp_path / "run/made").touch()
    assert listing(tmp_path / "run") == {"made"}


def test_a_process_may_hold_a_folder_twice_and_an_empty_new_one_goes(tmp_path):
    with held(tmp_path / "run"), held(tmp_path / "run"):
        assert listing(tmp_path / "run") == {files.LOCK}
    assert listing(tmp_path) == set()
    (tmp_path / "run").mkdir()
    with held(tmp_path / "run"):
        pass
    assert listing(tmp_path) == {"run"}


# ---- What a user names


def test_a_user_s_home_stands_for_its_sign(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("TRAVJAX_DATA", raising=False)
    (tmp_path / "a.tif").touch()
    assert files.user_path("~/a/b") == tmp_path / "a/b"
    assert find_data("~/a.tif", "map") == tmp_path / "a.tif"
    assert output_folder("~/out") == tmp_path / "out" and (tmp_path / "out").is_dir()
    monkeypatch.setenv("TRAVJAX_DATA", "~")
    assert find_data("a.tif", "map") == tmp_path / "a.tif"
    assert files.user_path("~nobody-of-this-name/a") == Path("~nobody-of-this-name/a")


@pytest.mark.parametrize(
    ("home", "given", "expected"),
    [
        ("/home/me", None, "/home/me/.cache/travjax"),
        ("/home/me", "", "/home/me/.cache/travjax"),
        ("/home/me", "/cache", "/cache/travjax"),
        ("/home/me", "relative", "/home/me/.cache/travjax"),
        ("", None, None),
        ("", "/cache", "/cache/travjax"),
        ("relative", None, None),
    ],
)
def test_the_cache_is_where_the_standard_says_or_nowhere(monkeypatch, home, given, expected):
    monkeypatch.setenv("HOME", home)
    monkeypatch.setenv("XDG_CACHE_HOME", given) if given is not None else monkeypatch.delenv("XDG_CACHE_HOME", False)
    assert files.cache_folder() == (Path(expected) if expected else None)


def test_a_user_who_is_unknown_has_no_cache(monkeypatch):
    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)

    def unknown(number):
        raise KeyError(number)

    monkeypatch.setattr("pwd.getpwuid", unknown)
    assert files.cache_folder() is None


def test_letters_that_utf_8_lacks_are_escaped_in_a_text(tmp_path):
    path = files.save_text(tmp_path / "a.txt", "\udcff é\n")
    assert path.read_bytes() == "\\udcff é\n".encode()


def test_only_a_file_of_ours_is_replaced(tmp_path):
    ours = lambda path: files.first_lines(path, 1) == ["ours"]
    path = tmp_path / "notes.md"
    files.require_replaceable(path, ours, "--to x", "card")
    for there in ("mine\nours\n", ""):
        path.write_text(there)
        with pytest.raises(InputError) as raised:
            files.require_replaceable(path, ours, "--to x", "card")
        line = f"--to x: {path} is in the way, and no card of travjax; allowed: another name, or none there"
        assert str(raised.value) == line
    path.write_text("ours\nmore")
    files.require_replaceable(path, ours, "--to x", "card")
