"""The benchmark's rows, table and file, on a small action space; `travjax bench` itself takes minutes."""

import contextlib
import csv
import io
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

from tests.commandline import Terminal
from travjax import cli
from travjax.evaluation import simulator_benchmark
from travjax.evaluation.tables import rows_table
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup
from travjax.terrain.styles import generate_terrain
from travjax.traversal.traverse import label, unpacked

SEEKUR_JR = Robot.load("seekur_jr")
FRAIL = replace(SEEKUR_JR, max_step=0.02, ride_height=0.04, max_tilt=0.1)
FEW = ActionSpace(turns=2, arc_lengths=(0.5, 0.6), radii=(math.inf, 1.5, -1.5), interval=0.1)
FEW_TOML = "turns = 2\narc_lengths = [0.5, 0.6]\nradii = [inf, 1.5, -1.5]\ninterval = 0.1\n"
GRID = Grid(3.75, 0.125)  # no other test compiles for it: the first call here is the one that compiles
SETUP = Setup(SEEKUR_JR, FEW, GRID)


@pytest.fixture(scope="module")
def kernels() -> list[dict]:
    """The rows of terrain and labelling for one and for two maps at once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulator_benchmark, "BATCHES", (1, 2))
        return list(simulator_benchmark.kernel_rows(SETUP, repeats=3))


def is_whole(row: dict) -> bool:
    """Whether a row has all columns, and times and memory that can be."""
    return (
        list(row) == list(simulator_benchmark.COLUMNS)
        and 0 < row["ms_per_map"] < 60_000
        and row["repeats"] >= 1
        and 50 < row["peak_mib"] < 100_000
    )


def test_there_is_a_row_for_terrain_and_labelling_at_every_batch_size(kernels):
    assert [(row["what"], row["maps"]) for row in kernels] == [
        *(("terrain", 1), ("terrain", 2)),
        *(("labelling", 1), ("labelling", 2)),
        *(("labelling, tyre", 1), ("labelling, tyre", 2)),
    ]
    assert all(is_whole(row) and row["repeats"] == 3 for row in kernels)


def test_the_issues_batch_sizes_are_measured():
    assert simulator_benchmark.BATCHES == (1, 8, 32, 128)


def test_trajectories_a_second_follow_from_the_time_of_a_map(kernels):
    for row in kernels:
        if row["what"].startswith("labelling"):
            assert row["trajectories_per_s"] == pytest.approx(18 / (row["ms_per_map"] / 1e3), rel=1e-9)
        else:
            assert row["trajectories_per_s"] is None


def test_the_time_to_compile_stands_apart(kernels):
    for row in kernels:
        assert row["first_call_s"] > 3 * row["maps"] * row["ms_per_map"] / 1e3


def test_a_time_is_the_median_of_the_calls_after_the_first(monkeypatch):
    ticks = iter([0, 100, 200, 201, 300, 305, 400, 402])
    monkeypatch.setattr(simulator_benchmark.time, "perf_counter", lambda: next(ticks))
    row = simulator_benchmark._timed("work", 4, lambda: None, repeats=3, trajectories=10)
    assert row["first_call_s"] == 100
    assert row["ms_per_map"] == 2 / 4 * 1e3
    assert row["trajectories_per_s"] == 4 * 10 / 2


def test_a_call_is_timed_until_its_result_is_there(monkeypatch):
    waited = []
    monkeypatch.setattr(jax, "block_until_ready", waited.append)
    simulator_benchmark._timed("work", 1, lambda: "result", repeats=2, trajectories=0)
    assert waited == ["result"] * 3


def test_the_sequential_simulator_goes_through_every_trajectory_of_one_map():
    done = []
    row = simulator_benchmark.reference_row(SETUP, done.append)
    assert is_whole(row)
    assert row["maps"] == row["repeats"] == 1
    assert row["what"].startswith("sequential")
    assert row["trajectories_per_s"] == pytest.approx(18 / (row["ms_per_map"] / 1e3), rel=1e-9)
    assert done[-1] == len(FEW)
    assert done == sorted(done)


def test_a_stream_labels_every_map_once_and_reports_its_progress(monkeypatch):
    monkeypatch.setattr(simulator_benchmark, "STREAM_CHUNK", 2)
    stored, done, packed = [], [], simulator_benchmark.packed_labels
    monkeypatch.setattr(
        simulator_benchmark, "packed_labels", lambda *maps: stored.append(np.asarray(packed(*maps))) or stored[-1]
    )
    row = simulator_benchmark.stream_row(3, replace(SETUP, robot=FRAIL), done.append)
    assert is_whole(row)
    assert row["maps"] == 3
    assert done == [2, 1]
    failed, known = unpacked(np.concatenate(stored))
    for number, style in enumerate(["mountain_crater", "smooth", "rough"]):
        expected = label(generate_terrain(style, [number], grid=GRID), FRAIL, FEW, grid=GRID)
        np.testing.assert_array_equal(failed[number], expected[0])
    assert known.all()
    assert len(np.unique(failed, axis=0)) == 3  # maps that can be told apart


def test_a_start_is_the_median_of_new_processes_after_a_first_that_fills_the_cache(monkeypatch):
    commands, folders = [], []
    ticks = iter([0, 50, 100, 103, 200, 201, 300, 302])
    monkeypatch.setattr(simulator_benchmark.time, "perf_counter", lambda: next(ticks))

    def start(command, **options):
        assert options["capture_output"]
        commands.append(command[:-1])
        folders.append(Path(command[-1]))
        assert folders[-1].is_dir()
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(subprocess, "run", start)
    row = simulator_benchmark.start_row()
    words = ["-m", "travjax", "label", "--count", "1", "--no-figures", "--out"]
    assert commands == [[sys.executable, *words]] * 4
    assert not any(folder.exists() for folder in folders)
    assert list(row) == list(simulator_benchmark.COLUMNS)
    assert row["ms_per_map"] == 2000
    assert row["repeats"] == 3


def parsed(path: Path) -> list[dict]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file, delimiter="\t"))


def test_a_tsv_file_reads_back_as_the_rows(kernels, tmp_path):
    simulator_benchmark.write_tsv(kernels, tmp_path / "bench.tsv")
    back = parsed(tmp_path / "bench.tsv")
    assert [list(row) for row in back] == [[*simulator_benchmark.COLUMNS, "machine"]] * len(kernels)
    for row, expected in zip(back, kernels, strict=True):
        assert row["what"] == expected["what"]
        for key in list(simulator_benchmark.COLUMNS)[1:]:
            assert (float(row[key]) if row[key] else None) == expected[key]


def test_the_table_has_a_line_for_every_row_under_the_headings(kernels):
    lines = rows_table(kernels, simulator_benchmark.COLUMNS).splitlines()
    assert len(lines) == 2 + len(kernels)
    assert all(heading in lines[0] for heading in simulator_benchmark.COLUMNS.values())


def test_the_machine_is_named_with_its_device_and_versions():
    line = simulator_benchmark.machine()
    assert len(line.splitlines()) == 1
    for part in (jax.devices()[0].platform, f"jax {jax.__version__}", f"Python {sys.version.split()[0]}", "cores"):
        assert part in line


@pytest.fixture
def restored_cache():
    """`travjax bench` compiles without the cache; JAX is put back for other tests."""
    names = (
        "jax_enable_compilation_cache",
        "jax_persistent_cache_min_compile_time_secs",
        "jax_persistent_cache_min_entry_size_bytes",
    )
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def test_the_command_prints_the_table_and_the_speed_up_and_writes_it_and_a_figure(
    tmp_path, monkeypatch, restored_cache
):
    (tmp_path / "few.toml").write_text(FEW_TOML)
    monkeypatch.setattr(simulator_benchmark, "BATCHES", (1, 32))
    monkeypatch.setattr(simulator_benchmark, "start_row", lambda: simulator_benchmark._row("start", 1, 2.0, 0, None, 3))
    folder = tmp_path / "out"
    words = ["bench", "--repeats", "1", "--stream", "2", "--size", "3.75", "--spacing", "0.125"]
    out, err = io.StringIO(), Terminal()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        assert cli.main([*words, "--actions", str(tmp_path / "few.toml"), "--out", str(folder)]) == 0
    rows = parsed(folder / "bench.tsv")
    what = [row["what"] for row in rows]
    assert what[:5] == ["start", "terrain", "terrain", "labelling", "labelling"]
    assert what[5:7] == ["labelling, tyre", "labelling, tyre"]
    assert what[7].startswith("sequential")
    assert "streamed" in what[8]
    assert len(what) == 9
    times = {(row["what"], row["maps"]): float(row["ms_per_map"]) for row in rows}
    speed_up = {maps: times[what[7], "1"] / times["labelling", maps] for maps in ("1", "32")}
    for maps, expected in speed_up.items():
        (row,) = (row for row in rows if (row["what"], row["maps"]) == ("labelling", maps))
        assert float(row["speed_up"]) == pytest.approx(expected)
    assert "x sequential" in out.getvalue()
    assert simulator_benchmark.machine() in out.getvalue()
    for name in ("bench.tsv", "bench.png"):
        assert str(folder / name) in out.getvalue().splitlines()
    with Image.open(folder / "bench.png") as image:
        assert len(np.unique(np.asarray(image.convert("L")))) > 50
    assert {path.name for path in folder.iterdir()} == {"bench.tsv", "bench.png"}
    for bar in ("kernels: 100%", "sequential simulator: 100%", "stream: 100%"):
        assert bar in err.getvalue()


@pytest.mark.parametrize("text", ["radii = [inf, 0.2]", "turns = 2\nradii = [inf]\narc_lengths = [3.0, 3.0]"])
def test_the_command_refuses_actions_that_do_not_fit_before_it_measures(tmp_path, monkeypatch, restored_cache, text):
    (tmp_path / "bad.toml").write_text(text)
    monkeypatch.setattr(simulator_benchmark, "start_row", lambda: pytest.fail("measured before it looked"))
    err = io.StringIO()
    with contextlib.redirect_stderr(err):
        assert cli.main(["bench", "--actions", str(tmp_path / "bad.toml"), "--out", str(tmp_path / "out")]) == 2
    assert len(err.getvalue().splitlines()) == 1
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())
