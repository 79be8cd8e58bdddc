"""What every program shares: one line and an exit code for each way to end, the compilation cache, a quiet XLA."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import jax
import pytest

from travjax import entry
from travjax.config import InputError, naming
from travjax.signals import Terminated

# ---- How a program ends


def ends(error: BaseException, capsys) -> tuple[int, str]:
    """Exit code and standard error of a program whose work raises that."""

    def work():
        raise error

    code = entry.guarded(work)
    said = capsys.readouterr()
    assert said.out == ""
    return code, said.err


def noted(error: BaseException, note: str) -> BaseException:
    error.add_note(note)
    return error


def test_work_that_ends_well_says_nothing_and_gives_0(capsys):
    done = []
    assert entry.guarded(lambda: done.append(1)) == 0
    assert done == [1]
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (InputError("track = -1: must be above 0"), 2, "track = -1: must be above 0"),
        (OSError(36, "File name too long", "labels.npz"), 2, "labels.npz: File name too long"),
        (PermissionError(13, "Permission denied"), 2, "a file: Permission denied"),
        (OSError("cannot seek"), 2, "a file: cannot seek"),
        (
            MemoryError("Unable to allocate 9 GiB\nmore"),
            2,
            "out of memory: Unable to allocate 9 GiB; try fewer maps or",
        ),
        (
            jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes.\nlong table"),
            2,
            "out of memory: RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes.; try fewer maps or",
        ),
        (
            noted(MemoryError("Unable to allocate 9 GiB"), "site.tif"),
            2,
            "site.tif: out of memory: Unable to allocate 9",
        ),
        (MemoryError(), 2, "out of memory; try fewer maps or"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (Terminated(), 143, "terminated"),
        (noted(KeyboardInterrupt(), "it goes on"), 130, "interrupted; it goes on"),
    ],
)
def test_what_goes_wrong_is_one_line(error, code, line, capsys):
    found, said = ends(error, capsys)
    assert found == code
    assert said.startswith(f"travjax: {line}") and said.count("\n") == 1 and said.endswith("\n")


@pytest.mark.parametrize(
    "error", [ValueError("a bug"), jax.errors.JaxRuntimeError("INTERNAL: a bug"), SystemExit(0), AssertionError()]
)
def test_what_is_nobody_s_input_is_not_hidden(error, capsys):
    with pytest.raises(type(error)) as raised:
        ends(error, capsys)
    assert raised.value is error


def test_a_reader_that_has_gone_ends_the_program_quietly():
    script = "from travjax.entry import guarded; raise SystemExit(guarded(lambda: print('line', flush=True)))"
    process = subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
    )
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait(60) == 1
    process.stderr.close()


def test_out_of_memory_names_what_was_read_first(capsys):
    def work():
        with naming("label"), naming("site.tif"):
            raise MemoryError("Unable to allocate 9 GiB")

    assert entry.guarded(work) == 2
    assert capsys.readouterr().err.startswith("travjax: site.tif: out of memory: Unable to allocate 9 GiB; ")


# ---- Streams

SPEAKS = r"""
import sys
from travjax import entry
def work():
    print("\udcff é")
    print("\udcff é", file=sys.stderr)
    raise entry.InputError("bad \udcff")
raise SystemExit(entry.guarded(work))
"""


def speaks(redirections: str = "", **environment: str) -> tuple[int, bytes, bytes]:
    words = ["sh", "-c", f'exec "$@" {redirections}', "sh", sys.executable, "-c", SPEAKS]
    done = subprocess.run(words, capture_output=True, env=os.environ | environment)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("encoding", ["ascii", "utf-8", "latin-1"])
def test_no_letter_of_a_file_s_name_is_too_much_for_a_stream(encoding):
    line = b"\\udcff " + "é".encode(encoding, "backslashreplace") + b"\n"
    assert speaks(PYTHONIOENCODING=encoding) == (2, line, line + b"travjax: bad \\udcff\n")


@pytest.mark.parametrize("closed", ["2>&-", ">&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_closed_streams_are_done_without(closed):
    code, out, err = speaks(closed, PYTHONIOENCODING="utf-8")
    assert code == 2
    assert (bool(out), bool(err)) == (closed == "2>&-", closed == ">&-")


def test_a_full_disk_behind_standard_output_is_one_line():
    code, _, err = speaks(">/dev/full", PYTHONIOENCODING="utf-8")
    assert code == 2 and err.endswith(b"\n") and b"Traceback" not in err and b"Exception ignored" not in err


def test_a_parser_says_what_is_wrong_in_one_line():
    parser = entry.Parser(prog="python -m something")
    parser.add_argument("--count", type=int)
    for words, said in ((["--count", "many"], "argument --count: invalid int value: 'many'"), (["more"], "more")):
        with pytest.raises(InputError, match=f"{said} .see python -m something --help.$"):
            parser.parse_args(words)


# ---- The compilation cache


@pytest.fixture
def settings(tmp_path, monkeypatch):
    """A user without a cache of their own; JAX is put back."""
    thresholds = ("jax_persistent_cache_min_compile_time_secs", "jax_persistent_cache_min_entry_size_bytes")
    before = {name: getattr(jax.config, name) for name in (*thresholds, "jax_compilation_cache_dir")}
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    for name, value in zip(before, (1.0, 0, None), strict=True):
        jax.config.update(name, value)
    yield jax.config
    for name, value in before.items():
        jax.config.update(name, value)


def test_compiled_code_is_kept_in_the_user_s_cache_however_small_it_is(settings, tmp_path):
    entry.use_compilation_cache()
    assert settings.jax_compilation_cache_dir == str(tmp_path / "home/travjax/jax")
    assert (tmp_path / "home/travjax/jax").is_dir()
    assert settings.jax_persistent_cache_min_compile_time_secs == 0
    assert settings.jax_persistent_cache_min_entry_size_bytes == -1


def test_the_cache_can_be_moved(settings, tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "other"))
    entry.use_compilation_cache()
    assert settings.jax_compilation_cache_dir is None  # JAX read the variable when it was imported
    assert settings.jax_persistent_cache_min_compile_time_secs == 0
    assert not (tmp_path / "home").exists()


@pytest.mark.parametrize("place", ["a file", "nowhere"])
def test_without_a_place_for_it_there_is_no_cache(settings, tmp_path, monkeypatch, place):
    monkeypatch.delenv("MPLCONFIGDIR", raising=False)
    monkeypatch.setattr("atexit.register", lambda *works, **how: None)
    if place == "a file":
        (tmp_path / "home").write_text("a file")
    else:
        monkeypatch.setenv("HOME", "")
        monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    entry.use_compilation_cache()
    assert settings.jax_compilation_cache_dir is None
    assert os.access(os.environ["MPLCONFIGDIR"], os.W_OK)  # matplotlib would end in a traceback
    os.rmdir(os.environ["MPLCONFIGDIR"])
    monkeypatch.delenv("MPLCONFIGDIR")


def test_an_editable_install_is_a_path():
    # Else it is a finder, which comes after a folder called travjax where Python starts.
    pyproject = tomllib.loads((Path(entry.__file__).parents[1] / "pyproject.toml").read_text())
    assert pyproject["tool"]["setuptools"]["package-dir"] == {"": "."}


# ---- XLA's log


def test_xla_is_quiet_unless_the_user_wants_to_hear_it(monkeypatch):
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL", raising=False)
    entry.quiet_xla()
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "3"
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "0")
    entry.quiet_xla()
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "0"


@pytest.mark.parametrize("module", ["travjax.__main__", "travjax.experiments.launch"])
def test_a_program_is_quiet_before_it_imports_jax(module):
    script = f"import os, sys, {module}; print(os.environ.get('TF_CPP_MIN_LOG_LEVEL'), 'jax' in sys.modules)"
    environment = {name: value for name, value in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment)
    level = {"travjax.__main__": None, "travjax.experiments.launch": "3"}[module]  # main() of the first sets it
    assert done.stdout == f"{level} False\n", done.stderr
