"""`travjax train`: what it makes and says, going on after kills, several devices and processes, and bad input."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from tests.commandline import FEW_TOML, files, printed_files, run, run_words
from tests.commandline import Run as Done
from tests.small_training import (
    GRID_WORDS,
    PRESET,
    SETUP,
    TOML,
    copy,
    dataset,
    files_of_run,
    require_equal,
    rows_of,
    saved_state,
    train,
    validations,
    words_of,
)
from travjax.data.dataset import ARRAYS, load, save
from travjax.runs.run import Run

pytestmark = pytest.mark.usefixtures("shared_code")

FEW_STEPS = TOML.replace("head_epochs = 2", "head_epochs = 1").replace("\nepochs = 2", "\nepochs = 1")
FEW_STEPS = FEW_STEPS.replace("1e-3", "3e-5")  # RMSprop makes much of the last digits of small gradients

STOPPED = """
import os, signal, sys, time
from travjax import cli
from travjax.training.trainer import Trainer
step, total = Trainer._step, int(sys.argv[1])

def stopped(self, *batch):
    if self.position.total == total:
        {stop}
    return step(self, *batch)

Trainer._step = stopped
sys.exit(cli.main(sys.argv[2:]))
"""
KILLED = STOPPED.format(stop="os.kill(os.getpid(), signal.SIGKILL)")
HELD = STOPPED.format(stop="time.sleep(600)")


@pytest.fixture(scope="module")
def words(tmp_path_factory, few) -> tuple:
    """`train` with the preset of `trained`."""
    return words_of(files_of_run(tmp_path_factory.mktemp("words")), few)


def refusal(words: tuple) -> str:
    """The one line of a command that fails."""
    code, _, err = run_words(*words)
    line = err.replace("\r", "\n").strip().splitlines()[-1]
    assert code == 2 and line.startswith("travjax: ")
    assert err.count("travjax: ") == 1
    return line.removeprefix("travjax: ")


def program(words: tuple, *, script: str | None = None, devices: int = 1) -> subprocess.Popen:
    """A command in a process of its own."""
    start = ["-c", script] if script else ["-m", "travjax"]
    environment = os.environ | {
        "TF_CPP_MIN_LOG_LEVEL": "3",  # JAX has set it to 1 in the tests' own process
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}",
        "PYTHONWARNINGS": "error",
    }
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [sys.executable, *start, *map(str, words)], env=environment, stdout=pipe, stderr=pipe, text=True
    )


def finished(*processes: subprocess.Popen, code: int = 0) -> list[tuple[str, str]]:
    try:
        said = [process.communicate(timeout=400) for process in processes]
        for process, (_, err) in zip(processes, said, strict=True):
            assert process.returncode == code, err
        return said
    finally:
        for process in processes:
            process.kill()


# ---- What it makes


def test_everything_that_is_written_is_printed(trained):
    names = {"run.json", "metrics.jsonl", "tensorboard", "checkpoints", "inputs.png", "training.png"}
    assert {path.name for path in trained.iterdir()} == names
    out = (trained.parent / "out.txt").read_text()
    assert printed_files(Done(0, out, "", trained)) == {trained / name for name in names - {"run.json"}}
    assert f"\nNext: travjax evaluate {trained} --data {trained.parent / 'set'}\n" in out
    for name in ("inputs.png", "training.png"):
        Image.open(trained / name).verify()


def test_each_epoch_is_summed_up_in_a_line(trained):
    out = (trained.parent / "out.txt").read_text()
    lines = [line for line in out.splitlines() if line.startswith("phase ")]
    assert len(lines) == 4
    best = -1.0
    for line, row in zip(lines, validations(trained), strict=True):
        assert line.startswith(f"phase {row['phase']}, epoch {row['epoch']}: loss {row['loss']:.3f}, ")
        assert f"validation {row['validation_loss']:.3f} (constant {row['constant_loss']:.3f})" in line
        assert f"average precision: step {row['average_precision']['step']:.3f}, obstacle" in line
        assert re.search(r"; \d+ samples/s", line)
        overall = row["average_precision"]["overall"]
        assert line.endswith("best so far") == (overall > best)
        best = max(best, overall)


def test_progress_is_shown_with_the_loss_a_rate_and_the_time_left(trained):
    err = (trained.parent / "err.txt").read_text().replace("\r", "\n")
    for what in ("phase 1, epoch 1", "phase 2, epoch 2", "training features", "validation"):
        assert f"\n{what}: " in f"\n{err}"
    assert re.search(r"phase 2, epoch 1: .*<.*(sample/s|s/sample), loss=\d\.\d{3}\]", err)


def test_the_run_is_what_was_asked_for(trained):
    assert Run.load(trained) == Run(PRESET, SETUP)


def test_a_run_makes_its_own_data_set_unless_one_is_given(tmp_path, few):
    (tmp_path / "tiny.toml").write_text(FEW_STEPS.replace("\nepochs = 1", "\nepochs = 0"))
    done = run(tmp_path / "run", "train", tmp_path / "tiny.toml", "--actions", few, *GRID_WORDS, "--seed", 5)
    assert done.code == 0, done.err
    made = load(tmp_path / "run/data")
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(made, name), getattr(dataset(), name))
    preset = Run.load(tmp_path / "run").preset
    assert preset.dataset.seed == preset.training.seed == 5
    assert len(validations(tmp_path / "run")) == 1


def test_the_folder_is_named_after_the_preset(tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs/train/tiny/checkpoints/000001-step-1").mkdir(parents=True)
    assert refusal(words).startswith("--out runs/train/tiny: holds a training run; ")


# ---- Going on


def test_a_run_that_was_interrupted_and_killed_ends_like_one_that_was_not_and_its_folder_is_its_own(
    trained, tmp_path, words
):
    words = (*words, "--out", tmp_path / "run")
    first, log = program((5, *words), script=HELD), tmp_path / "run/metrics.jsonl"
    try:
        while not (log.exists() and '"step": 5' in log.read_text()):
            assert first.poll() is None
            time.sleep(0.01)
        rows = rows_of(tmp_path / "run")
        assert re.fullmatch(
            f"--out {tmp_path}/run: in use by process {first.pid} on .+; allowed: a folder that no other run uses",
            refusal((*words, "--resume")),
        )
        assert rows and rows == rows_of(tmp_path / "run") == rows_of(trained)[: len(rows)]
        first.send_signal(signal.SIGINT)
        _, err = first.communicate(timeout=100)
    finally:
        first.kill()
    assert first.returncode == 130, err
    assert err == "travjax: interrupted; with --resume the same command goes on from the latest checkpoint\n"
    finished(program((26, *words, "--resume"), script=KILLED), code=-signal.SIGKILL)
    assert {row["phase"] for row in rows_of(tmp_path / "run")} == {1, 2}
    train((*words, "--resume"))
    assert rows_of(tmp_path / "run") == rows_of(trained)
    for which in ("latest", "heads", "best"):
        require_equal(saved_state(tmp_path / "run", which), saved_state(trained, which))


def test_a_run_that_was_killed_before_its_first_checkpoint_goes_on_from_the_start(trained, tmp_path, words):
    words = (*words, "--out", tmp_path / "run")
    (tmp_path / "run").mkdir()
    Run.load(trained).save(tmp_path / "run")
    (tmp_path / "run/metrics.jsonl").write_text('{"step": 1, "lo')
    train((*words, "--resume"))
    assert rows_of(tmp_path / "run") == rows_of(trained)


def test_a_finished_run_that_goes_on_stays_as_it_is(trained, tmp_path, words):
    folder = copy(trained, tmp_path / "run")
    before = files(folder / "checkpoints")
    out, _ = train((*words, "--out", folder, "--resume"))
    assert rows_of(folder) == rows_of(trained)
    assert files(folder / "checkpoints") == before
    assert f"{folder}/training.png" in out


def test_a_damaged_checkpoint_is_said_to_be_passed_over(trained, tmp_path, words):
    folder = copy(trained, tmp_path / "run")
    last = max(path for path in (folder / "checkpoints").iterdir() if "-step-" in path.name)
    (last / "SHA256SUMS").unlink()
    out, err = train((*words, "--out", folder, "--resume"))
    assert f"{last}: damaged checkpoint passed over: SHA256SUMS cannot be read: No such file or directory" in out + err
    assert rows_of(folder) == rows_of(trained)


# ---- Several devices, several processes


@pytest.fixture(scope="module")
def alone(tmp_path_factory, words):
    """A short run on one device: its words, and its folder."""
    folder = tmp_path_factory.mktemp("alone")
    (folder / "short.toml").write_text(FEW_STEPS)
    short = (words[0], folder / "short.toml", *words[2:])
    train((*short, "--out", folder / "run"))
    return short, folder / "run"


def require_close(folder, other):
    """The same rows but for the order in which sums are added up."""
    one, two = rows_of(folder), rows_of(other)
    assert [row["step"] for row in one] == [row["step"] for row in two]
    assert one[-1]["step"] == 14
    for a, b in zip(one, two, strict=True):
        for name in {"loss", "validation_loss"} & a.keys():
            assert a[name] == pytest.approx(b[name], rel=1e-4), (name, a["step"])


def test_two_processes_of_two_devices_train_like_one_device_and_go_on_together(alone, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    words = (*alone[0], "--out", tmp_path / "run", "--coordinator", address, "--processes", 2, "--process")
    (out, _), (quiet, _) = finished(*(program((*words, process), devices=2) for process in (0, 1)))
    require_close(tmp_path / "run", alone[1])
    assert "phase 2, epoch 1: loss" in out
    assert [line for line in quiet.splitlines() if not line.startswith("[Gloo]")] == []
    one, two = saved_state(tmp_path / "run"), saved_state(alone[1])
    assert one.keys() == two.keys()
    train((*alone[0], "--out", tmp_path / "run", "--resume"))  # on one device


# ---- Bad input; each is found before training


def test_a_folder_that_holds_a_run_is_refused(trained, words):
    before = files(trained)
    message = f"--out {trained}: holds a training run; allowed: --resume to go on with it, or another folder"
    assert refusal((*words, "--out", trained)) == message
    assert files(trained) == before


@pytest.mark.parametrize(
    ("line", "other", "message"),
    [
        ("learning_rate = 1e-3", "learning_rate = 2e-3", "preset.training.learning_rate = 0.002: must be 0.001"),
        ("hidden = 16", "hidden = 8", "preset.heads.hidden = 8: must be 16"),
        ("seed = 5", "seed = 6", "preset.dataset.seed = 6: must be 5"),
        ("elevation_scale = 0.5", "elevation_scale = 1", "preset.elevation_scale = 1: must be 0.5"),
    ],
)
def test_a_run_does_not_go_on_with_another_preset(trained, tmp_path, words, line, other, message):
    (tmp_path / "other.toml").write_text(TOML.replace(line, other))
    said = refusal((words[0], tmp_path / "other.toml", *words[2:], "--out", trained, "--resume"))
    assert said == f"--resume {trained}: {message}, as in the run so far"


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--robot", "leo_rover"), "robot.name = 'Leo Rover': must be 'Husky A200', as in the run so far"),
        (("--seed", 3), "preset.dataset.seed = 3: must be 5, as in the run so far"),
        (("--size", 5), "grid.size = 5.0: must be 4.0, as in the run so far"),
    ],
)
def test_a_run_does_not_go_on_with_other_options(trained, words, more, message):
    assert refusal((*words, "--out", trained, "--resume", *more)) == f"--resume {trained}: {message}"


def test_missing_weights_are_one_line(tmp_path, monkeypatch, words):
    monkeypatch.delenv("TRAVJAX_DATA", raising=False)
    said = refusal((*words, "--out", tmp_path / "run", "--weights", "imagenet/w.npz"))
    assert said == (
        "weights imagenet/w.npz: no such file here, and TRAVJAX_DATA is not set; "
        "allowed: --weights FILE, or none for random ones"
    )
    assert not (tmp_path / "run/run.json").exists()


def test_weights_that_are_none_are_one_line(tmp_path, words):
    np.savez(tmp_path / "w.npz", kernel=np.ones(3))
    said = refusal((*words, "--out", tmp_path / "run", "--weights", tmp_path / "w.npz"))
    assert said.startswith(f"{tmp_path / 'w.npz'}: ")
    assert not (tmp_path / "run/run.json").exists()


@pytest.mark.parametrize(
    ("line", "other", "message"),
    [
        ("hidden = 16", "hiden = 16", "[heads] unknown key 'hiden'; allowed: hidden, dropout"),
        (
            "[heads]",
            "[head]",
            "unknown key 'head'; allowed: model, robot, weights, elevation_scale, dataset, trunk, heads,",
        ),
        ("batch_size = 8", "batch_size = 0", "[training] batch_size = 0: must be a whole number, at least 1"),
    ],
)
def test_a_wrong_preset_is_one_line(tmp_path, words, line, other, message):
    (tmp_path / "other.toml").write_text(TOML.replace(line, other))
    said = refusal((words[0], tmp_path / "other.toml", *words[2:], "--out", tmp_path / "run"))
    assert said.startswith(f"{tmp_path / 'other.toml'}: {message}")
    assert not (tmp_path / "run").exists()


def test_a_missing_preset_is_one_line(tmp_path):
    said = refusal(("train", tmp_path / "none.toml", "--out", tmp_path / "run"))
    assert said == f"{tmp_path / 'none.toml'}: cannot be read: No such file or directory"


def test_a_data_set_of_another_robot_or_action_space_is_one_line(tmp_path, words):
    said = refusal((*words, "--out", tmp_path / "run", "--robot", "leo_rover"))
    assert said.startswith("robot of the data set: name = 'Husky A200'") and "must be as here: name = 'Leo" in said
    (tmp_path / "other.toml").write_text(FEW_TOML.replace("turns = 2", "turns = 3"))
    said = refusal((*words, "--out", tmp_path / "run", "--actions", tmp_path / "other.toml"))
    assert said == "actions of the data set: turns = 2; must be as here: turns = 3"
    assert not (tmp_path / "run/run.json").exists()


def test_a_damaged_data_set_is_one_line(tmp_path, words):
    save(replace(dataset(), heights=dataset().heights + 1), tmp_path / "set")
    path = tmp_path / "set/labels.npy"
    path.write_bytes(path.read_bytes()[:-1])
    said = refusal((*words, "--data", tmp_path / "set", "--out", tmp_path / "run"))
    assert said.startswith(f"{path}: ") and "truncated" in said
    assert refusal((*words, "--data", tmp_path / "none", "--out", tmp_path / "run")).startswith("data set = ")


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--processes", 2), "--coordinator, --processes, --process = (None, 2, None): must be all three or none"),
        (("--coordinator", "x:1", "--processes", 2), "--coordinator, --processes, --process = ('x:1', 2, None): "),
        (("--coordinator", "x:1", "--processes", 0, "--process", 0), "--processes = 0: must be at least 1"),
        (("--coordinator", "x:1", "--processes", 2, "--process", 2), "--process = 2: must be from 0 to 1"),
        (("--seed", -1), "--seed = -1: must be from 0 to 2147483647"),
    ],
)
def test_options_that_do_not_fit_together_are_one_line(tmp_path, words, more, message):
    assert refusal((*words, "--out", tmp_path / "run", *more)).startswith(message)
    assert files(tmp_path) == set()


def test_a_data_set_in_the_folder_that_was_made_from_something_else_is_not_trained_on(words, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    other = replace(dataset(), config=replace(dataset().config, seed=6))
    save(other, folder / "data")
    assert words[2] == "--data"
    line = refusal((*words[:2], *words[4:], "--out", folder))
    assert f"data set {folder / 'data'}" in line and "seed=6" in line and "seed=5" in line and "remove it" in line
    assert not (folder / "checkpoints").exists()


def test_a_run_does_not_go_on_with_another_data_set(trained, tmp_path, words):
    other = replace(dataset(), labels=np.roll(dataset().labels, 1, axis=1))
    save(other, tmp_path / "other")
    assert words[2] == "--data"
    said = refusal(
        (*words[:2], "--data", tmp_path / "other", *words[4:], "--out", copy(trained, tmp_path / "run"), "--resume")
    )
    assert said.startswith(f"data set = '{other.fingerprint}': must be {dataset().fingerprint}, the one that")
