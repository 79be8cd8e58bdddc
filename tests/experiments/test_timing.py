"""`python -m travjax.experiments.timing`: its rows, table, figure and report, on a small action space."""

import contextlib
import csv
import io
import re
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

from tests.commandline import FEW, FEW_TOML, Terminal
from tests.conftest import HUSKY, SEEKUR_JR
from travjax.config import InputError
from travjax.evaluation import map_figures, simulator_benchmark
from travjax.evaluation.tables import rows_table
from travjax.experiments import timing
from travjax.resnet.network import ResNetConfig
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.setup import Setup
from travjax.training import network_benchmark

GRID_WORDS = ("--size", 4, "--spacing", 0.125)
PAPER = ["paper: sequential simulator", "paper: network"]
OURS = ["sequential simulator", "batched simulator, 1 map", "batched simulator, 32 maps at once"]


def run(folder: Path, *words) -> tuple[int, str, str]:
    """The experiment in this process: exit code, standard output and errors."""
    out, err = io.StringIO(), Terminal()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        return timing.main([*map(str, words), "--out", str(folder)]), out.getvalue(), err.getvalue()


def rows_of(folder: Path) -> list[dict]:
    with (folder / "timing.tsv").open(newline="") as file:
        return list(csv.DictReader(file, delimiter="\t"))


@pytest.fixture(scope="module")
def done(tmp_path_factory, few) -> tuple[Path, str, str]:
    """A run with a small network: its folder and what it said."""
    folder = tmp_path_factory.mktemp("timing")
    (folder / "small.toml").write_text('weights = "none"\n[trunk]\nblocks = [1]\nwidth = 4\ndtype = "bfloat16"\n')
    words = ("--robot", "husky_a200", "--actions", few, *GRID_WORDS, "--network", folder / "small.toml")
    over_samples, sizes = network_benchmark.over_samples, []

    def recorded(*arguments):
        sizes.append(arguments[-1])
        return over_samples(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(network_benchmark, "over_samples", recorded)
        code, out, err = run(folder / "out", *words, "--batch", 9, "--repeats", 2)
    assert code == 0, err
    assert sizes == [9, 9, 9]
    return folder / "out", out, err


# ---- A run


def test_every_way_is_measured_once(done):
    rows = rows_of(done[0])
    assert [row["what"] for row in rows] == [*OURS, "network, bfloat16, batches of 9"]
    sequential = float(rows[0]["seconds"])
    for row in rows:
        seconds = float(row["seconds"])
        assert 0 < seconds < 60
        assert float(row["trajectories_per_s"]) == pytest.approx(len(FEW) / seconds)
        assert float(row["speed_up"]) == pytest.approx(sequential / seconds)
        assert row["repeats"] == "2"
        assert row["machine"] == simulator_benchmark.machine()
        assert row["device"].startswith(simulator_benchmark.processor())
    assert rows[0]["device"].endswith(", one core")
    assert float(rows[2]["seconds"]) < float(rows[0]["seconds"])


def test_the_paper_s_figures_are_left_out_where_the_trajectories_are_others(done):
    folder, out, _ = done
    assert "paper:" not in out + (folder / "timing.tsv").read_text()


def test_everything_that_is_written_is_printed(done):
    folder, out, _ = done
    names = {"timing.tsv", "timing.png", "report.md"}
    assert {path.name for path in folder.iterdir()} == names
    assert {line for line in out.splitlines() if line.startswith(str(folder))} == {str(folder / name) for name in names}


def test_the_report_holds_machine_table_and_figure(done):
    folder, out, _ = done
    report = (folder / "report.md").read_text()
    lines = out.strip().splitlines()
    assert lines[0] == f"Husky A200, 18 trajectories of a map; {simulator_benchmark.machine()}"
    table = "\n".join(lines[1:7])
    assert len(re.findall("batched simulator", table)) == 2 and "s a map" in table
    assert report.startswith(f"# All trajectories of a map\n\n{lines[0]}.\n\n```\n{table}\n```\n")
    assert report.endswith("\n\n![Timing](timing.png)\n")
    with Image.open(folder / "timing.png") as image:
        assert len(np.unique(np.asarray(image.convert("L")))) > 50


def test_progress_is_shown(done):
    err = done[2].replace("\r", "\n")
    assert re.search(r"^sequential simulator: 100%.* 36/36 ", err, re.MULTILINE)
    assert re.search(r"^batched simulator, network: 100%.* 3/3 ", err, re.MULTILINE)


# ---- Figures


def test_times_are_those_of_the_benchmarks_and_fit_together(monkeypatch):
    """4 s in sequence, 0.5 s one map, 0.1 s a map of 32, 2 s by the network."""
    asked = []

    def reference_row(setup, on_progress, repeats):
        asked.append(("sequential", repeats))
        return {"ms_per_map": 4000.0}

    def labelling_row(maps, setup, repeats):
        asked.append((maps, repeats))
        return {"ms_per_map": {1: 500.0, 32: 100.0}[maps]}

    class Network:
        def __init__(self, setup, repeats, trunk):
            asked.append(trunk)

        def all_trajectories(self, batch, repeats):
            asked.append((batch, repeats))
            return {"ms": 2000.0}

    monkeypatch.setattr(simulator_benchmark, "reference_row", reference_row)
    monkeypatch.setattr(simulator_benchmark, "labelling_row", labelling_row)
    monkeypatch.setattr(timing, "Bench", Network)
    monkeypatch.setattr(timing, "_device", lambda: "NVIDIA H100")
    rows = timing.measured(Setup(HUSKY, FEW, Grid(4, 0.125)), ResNetConfig((2,), 8), batch=64, repeats=7)
    assert asked == [("sequential", 7), (1, 7), (32, 7), ResNetConfig((2,), 8), (64, 7)]
    assert [row["seconds"] for row in rows] == [4.0, 0.5, 0.1, 2.0]
    assert [row["speed_up"] for row in rows] == [1, 8, 40, 2]
    assert [row["trajectories_per_s"] for row in rows] == pytest.approx([18 / 4, 36, 180, 9])
    assert [row["device"] for row in rows] == [f"{simulator_benchmark.processor()}, one core", *["NVIDIA H100"] * 3]


@pytest.fixture
def beside(tmp_path, monkeypatch) -> tuple[Path, str]:
    """A run on the paper's action space that measures nothing: its folder and standard output."""
    row = timing._row("sequential simulator", "here", 5.0, 3042, 5.0, 5)
    monkeypatch.setattr(timing, "measured", lambda *arguments: [row])
    code, out, err = run(tmp_path / "out", "--robot", "husky_a200")
    assert code == 0, err
    return tmp_path / "out", out


def test_the_paper_s_figures_stand_beside_ours(beside):
    folder, out = beside
    rows = rows_of(folder)
    assert [row["what"] for row in rows] == [*PAPER, "sequential simulator"]
    assert [float(row["seconds"]) for row in rows] == [58, 17, 5]
    assert [row["device"] for row in rows[:2]] == ["Intel i5-6500", "NVIDIA GTX 1050"]
    assert float(rows[0]["trajectories_per_s"]) == pytest.approx(3042 / 58)
    assert [float(row["speed_up"]) for row in rows] == pytest.approx([1, 58 / 17, 1])
    assert [row["repeats"] for row in rows] == ["", "", "5"]
    assert re.search(r"^paper: network +NVIDIA GTX 1050 +17 ", out, re.MULTILINE)


def test_the_paper_s_figures_are_not_those_of_this_machine(beside):
    machines = [row["machine"] for row in rows_of(beside[0])]
    assert machines == ["the paper's, Intel i5-6500", "the paper's, NVIDIA GTX 1050", simulator_benchmark.machine()]


def test_bars_are_as_long_as_the_times_and_the_paper_s_stand_out():
    rows = [*timing._of_paper(), timing._row("network", "here", 0.25, 3042, 5.0, 5)]
    (ax,) = map_figures.timing_figure(rows).axes
    assert [bar.get_width() for bar in ax.patches] == [58, 17, 0.25]
    assert ax.get_xscale() == "log" and ax.yaxis_inverted()
    assert [text.get_text() for text in ax.texts] == ["58 s", "17 s", "0.25 s"]
    assert [label.get_text() for label in ax.get_yticklabels()] == [f"{row['what']}\n{row['device']}" for row in rows]
    colours = [bar.get_facecolor() for bar in ax.patches]
    assert colours[0] == colours[1] != colours[2]


def test_a_table_has_all_columns():
    lines = rows_table(timing._of_paper(), timing.COLUMNS).splitlines()
    assert all(heading in lines[0] for heading in timing.COLUMNS.values()) and len(lines) == 4


def test_several_devices_are_counted(monkeypatch):
    class Device:
        platform, device_kind = "gpu", "NVIDIA H100"

    for count, name in ((1, "NVIDIA H100"), (4, "4 x NVIDIA H100")):
        monkeypatch.setattr(jax, "devices", lambda count=count: [Device()] * count)
        assert timing._device() == name


# ---- Pieces of the benchmarks


def test_the_sequential_simulator_s_time_is_the_median_of_its_calls(monkeypatch):
    ticks, done = iter([0, 5, 10, 11, 20, 23]), []
    monkeypatch.setattr(simulator_benchmark.time, "perf_counter", lambda: next(ticks))
    row = simulator_benchmark.reference_row(Setup(SEEKUR_JR, FEW, Grid(4, 0.125)), done.append, repeats=3)
    assert row["ms_per_map"] == 3000 and row["repeats"] == 3
    assert done == [*range(1, 19)] * 3


def test_the_processor_is_named_in_one_line():
    assert len(simulator_benchmark.processor().splitlines()) == 1


@pytest.mark.parametrize(
    ("described", "name"),
    [
        ("processor: 0\ncpu family\t: 25\nmodel\t\t: 17\nmodel name\t: AMD EPYC\n", "AMD EPYC (family 25, model 17)"),
        ("model name: A (B)\ncpu family: 6\nmodel: 143\n\nmodel name: C\nmodel: 2\n", "A (B) (family 6, model 143)"),
        ("processor: 0\nmodel name\t: ARMv7 Processor\n", "ARMv7 Processor"),
        ("processor: 0\nBogoMIPS: 50\n", None),
        (None, None),
    ],
)
def test_the_processor_has_its_generation_where_the_system_gives_it(monkeypatch, described, name):
    def read(path):
        if described is None:
            raise OSError
        return described

    monkeypatch.setattr(Path, "read_text", read)
    monkeypatch.setattr(simulator_benchmark.platform, "processor", lambda: "")
    assert simulator_benchmark.processor() == (name or simulator_benchmark.platform.machine()) != ""


# ---- Bad input


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--repeats", 0), "--repeats = 0: must be at least 1"),
        (("--batch", 0), "--batch = 0: must be at least 1"),
        (("--network", "none.toml"), "none.toml: cannot be read: "),
        (("--robot", "tank"), "robot"),
        (("--spacing", 1), "seekur_jr: spacing = 1: too coarse for Seekur Jr"),
    ],
)
def test_bad_input_is_one_line_before_anything_is_measured(tmp_path, monkeypatch, words, message):
    monkeypatch.setattr(timing, "measured", lambda *arguments: pytest.fail("measured before it looked"))
    code, out, err = run(tmp_path / "out", *words)
    assert code == 2 and out == "" and err.count("\n") == 1
    assert err.startswith("travjax: ") and message in err
    assert not (tmp_path / "out").exists()


def test_trajectories_that_leave_the_map_are_one_line(tmp_path):
    (tmp_path / "far.toml").write_text(FEW_TOML.replace("0.5, 0.6", "3.0, 3.0"))
    code, _, err = run(tmp_path / "out", "--actions", tmp_path / "far.toml")
    assert code == 2 and "trajectories leave the 8 m map" in err and err.count("\n") == 1


@pytest.mark.parametrize(("part", "name"), [(simulator_benchmark, "check"), (timing.Devices, "check_batch")])
def test_what_simulator_or_devices_refuse_is_found_before_anything_is_measured(tmp_path, monkeypatch, part, name):
    def refuse(*arguments):
        raise InputError("does not fit")

    monkeypatch.setattr(part, name, refuse)
    monkeypatch.setattr(timing, "measured", lambda *arguments: pytest.fail("measured before it looked"))
    assert run(tmp_path / "out") == (2, "", "travjax: does not fit\n")


def test_the_paper_s_time_is_of_its_action_space():
    assert len(ActionSpace()) == 3042
