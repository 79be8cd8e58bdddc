"""Files are written whole or not at all, and output folders are checked."""

from pathlib import Path

import numpy as np
import pytest

from travjax.config import InputError
from travjax.files import find_data, output_folder, save_npz, written_whole


def listing(folder) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_file_appears_when_the_block_ends(tmp_path):
    path = tmp_path / "a.txt"
    with written_whole(path) as temporary:
        temporary.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert listing(tmp_path) == {"a.txt"}


def test_the_temporary_file_lies_beside_the_final_one(tmp_path):
    # Only within one file system is it a rename, which happens at once.
    with written_whole(tmp_path / "a.txt") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.name != "a.txt"
        temporary.touch()


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_a_failed_write_leaves_nothing(tmp_path, error):
    with pytest.raises(error), written_whole(tmp_path / "a.txt") as temporary:
        temporary.write_text("half")
        raise error
    assert listing(tmp_path) == set()


def test_a_failure_before_the_first_byte_is_passed_on(tmp_path):
    with pytest.raises(RuntimeError), written_whole(tmp_path / "a.txt"):
        raise RuntimeError
    assert listing(tmp_path) == set()


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), written_whole(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert listing(tmp_path) == {"a.txt"}


def test_an_old_file_is_there_until_the_new_one_replaces_it(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with path.open() as reader, written_whole(path) as temporary:
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
