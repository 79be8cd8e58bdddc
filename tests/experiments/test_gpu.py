"""`python -m travjax.experiments.gpu`: a rehearsal of all parts on the CPU, what work takes at least, and bad input."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.conftest import SETUPS
from tests.small_training import loads, run_of
from travjax.config import InputError, load_toml
from travjax.data.provenance import SitesConfig
from travjax.estimators.preset import Preset
from travjax.evaluation.simulator_benchmark import machine
from travjax.evaluation.tables import rows_table
from travjax.experiments.gpu import __main__ as gpu
from travjax.experiments.gpu import kernels, parts
from travjax.experiments.gpu.config import PARTS, GpuConfig, Plan
from travjax.experiments.gpu.estimate import estimate
from travjax.experiments.gpu.kernels import Kernels, Measured, labelling_work
from travjax.experiments.gpu.limits import DEVICES, Work
from travjax.experiments.gpu.programs import read_program, training_step
from travjax.experiments.transfer_runs import TransferConfig
from travjax.files import find_preset
from travjax.runs.model_file import read_model
from travjax.simulation.contact import Contact

# ---- A rehearsal: the same program as on a GPU, where nothing is installed that it could do without

REHEARSAL = """
import json, sys, time
for name in ("rasterio", "opensimplex", "tensorflow_datasets", "torch", "h5py", "keras", "mujoco", "xarray"):
    sys.modules[name] = None
from types import SimpleNamespace
from travjax.evaluation import map_figures
from travjax.experiments.gpu import __main__ as gpu
from travjax.training import trainer

def command(*words):
    code = gpu.main(["smoke", "--out", "out", *words])
    assert code == 0, code
    return json.load(open("out/summary.json"))


def save(figure, path):  # drawing would take a fifth of the time
    path.touch()
    return path

map_figures.save = save
ticks = iter([0.0] * 4)
trainer.time = SimpleNamespace(monotonic=lambda: next(ticks, float("inf")), perf_counter=time.perf_counter)
first = command("--parts", "field")
trainer.time = time
second = command("--time", "600")
before = {path: path.stat().st_mtime_ns for path in gpu.Path("out").rglob("*") if path.is_file()}
third = command()
after = {path: path.stat().st_mtime_ns for path in gpu.Path("out").rglob("*") if path.is_file()}
json.dump([first, second, third, sorted(str(p) for p in after if after[p] != before.get(p))], open("said.json", "w"))
"""


@pytest.fixture(scope="module")
def rehearsed(tmp_path_factory) -> tuple[list, Path]:
    """What three calls noted, the first of which had time for four steps of the field, and their folder."""
    place = tmp_path_factory.mktemp("rehearsal")
    left_out = ("TRAVJAX_DATA",)
    quick = {
        "JAX_PLATFORMS": "cpu",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "PYTHONPATH": str(Path(__file__).parents[2]),
    }
    environment = {name: value for name, value in os.environ.items() if name not in left_out} | quick
    command = [sys.executable, "-c", REHEARSAL]
    done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return loads((place / "said.json").read_text()), place / "out"


def test_a_part_that_runs_out_of_time_is_evaluated_and_goes_on(rehearsed):
    (first, second, *_), _ = rehearsed
    assert list(first) == ["field"]
    early, late = first["field"], second["field"]
    assert (early["finished"], early["steps"], early["evaluated"]) == (False, 4, "latest")
    assert (late["finished"], late["steps"], late["epochs"], late["evaluated"]) == (True, 12, 2, "best")


def test_all_parts_are_finished_and_not_begun_again(rehearsed):
    (_, second, third, written), _ = rehearsed
    assert list(second) == ["field", "bench", "resnet50", "transfer"] and set(second) == set(PARTS)
    assert all(result["finished"] and "failed" not in result for result in second.values())
    assert third == second
    assert written == []


def test_everything_small_lies_in_the_folder(rehearsed):
    (_, second, *_), out = rehearsed
    found = {
        str(path.relative_to(out)) for path in out.rglob("*") if path.is_file() and out / "work" not in path.parents
    }
    assert {"report.md", "summary.json", "config.json", "bench.tsv", "field.safetensors", "field.md"} <= found
    for name in ("field", "resnet50"):
        assert {f"{name}/{file}" for file in ("tables.txt", "evaluation.json", "metrics.jsonl", "run.json")} <= found
    assert {"transfer/report.md", "transfer/results.json", "transfer/f1.png"} <= found
    assert "stand-in sites take the place of real maps" in (out / "transfer/report.md").read_text()
    run, _, notes = read_model(out / "field.safetensors")
    assert run.preset.model == "field" and notes["step"] <= 12
    assert (out / "field/tables.txt").read_text().strip() in (out / "field.md").read_text()


def test_the_report_says_how_far_each_part_is_and_what_was_measured(rehearsed):
    (_, second, *_), out = rehearsed
    report, rows = (out / "report.md").read_text(), second["bench"]["rows"]
    assert "\n- Hazard field: finished, " in report and "\n- Transfer: finished, " in report
    whats = [row["what"] for row in rows]
    assert len(rows) == len((out / "bench.tsv").read_text().splitlines()) - 1
    for what in ("labelling by nearest", "labelling by tyre", "ResNet50 training", "terrain", "site by tyre"):
        assert any(one.startswith(what) for one in whats) and what in report
    assert all(row["limited_by"] == "unknown" and row["share"] is None for row in rows)  # a CPU
    assert (out / "resnet50/tables.txt").read_text().strip() in report
    assert "## Transfer\n\n[Report](transfer/report.md)\n" in report


def test_what_the_device_refuses_is_said_and_left_out(monkeypatch, capsys):
    def refused():
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory.\nlong table")

    plan = Plan.load(find_preset("smoke", "gpu"), "none")
    done = lambda: Measured(0.5, 1.0, Work(1, {"float32": 1}))
    listed = [("large maps", 9, refused), ("small maps", 1, done), ("maps", 4, done), ("kept maps", 2, refused)]
    monkeypatch.setattr(Kernels, "measurements", lambda kernels: listed)
    kept = {"what": "kept maps", "at_once": 2, "repeats": plan.config.repeats, "machine": machine()}
    measured = list(Kernels(plan.config, plan.runs["resnet50"]).rows([kept], float("inf")))
    assert [len(rows) for rows in measured] == [1, 2, 3, 4] and measured[0] == [kept]
    rows = measured[-1]
    assert [row["what"] for row in rows] == ["large maps", "small maps", "maps", "kept maps"] and rows[-1] == kept
    assert rows[0]["limited_by"] == kernels.REFUSED and rows[0]["ms"] is None
    assert rows_table(rows[:3], kernels.COLUMNS).count(kernels.REFUSED) == 1
    assert capsys.readouterr().out.startswith("large maps, 9 at once: left out: RESOURCE_EXHAUSTED")
    assert list(Kernels(plan.config, plan.runs["resnet50"]).rows([kept], -1.0)) == [[kept]]
    assert list(Kernels(plan.config, plan.runs["resnet50"]).rows(rows, float("inf"))) == [rows]


@pytest.mark.parametrize("changed", [{"machine": "cpu of another"}, {"repeats": 99}])
def test_rows_of_another_machine_or_of_other_repeats_are_measured_again(monkeypatch, changed):
    plan = Plan.load(find_preset("smoke", "gpu"), "none")
    listed = [("maps", 4, lambda: Measured(0.5, 1.0, Work(1, {"float32": 1})))]
    monkeypatch.setattr(Kernels, "measurements", lambda measured: listed)
    row = listed[0][2]().row("maps", 4, plan.config.repeats)
    of = lambda kept: list(Kernels(plan.config, plan.runs["resnet50"]).rows(kept, float("inf")))
    assert of([row]) == [[row]]
    assert of([row | changed]) == [[], [row]]


# ---- Calls that go on


def session_of(folder: Path, **settings) -> parts.Session:
    """A session of the smoke preset, with some of its settings changed."""
    plan = Plan.load(find_preset("smoke", "gpu"), "none")
    return parts.Session.load(replace(plan, config=replace(plan.config, **settings)), folder)


def test_a_folder_is_that_of_one_preset(tmp_path):
    session_of(tmp_path).note("bench", {"finished": True, "rows": []})
    assert session_of(tmp_path).is_finished("bench")
    with pytest.raises(InputError, match=f"^--out {tmp_path}: holds results of another preset; allowed: another"):
        session_of(tmp_path, field_epochs=1)
    (tmp_path / "summary.json").write_text('{"bench": 3}')
    with pytest.raises(InputError, match="summary.json = .*: must be results by part; remove it to begin anew"):
        session_of(tmp_path)


def test_a_benchmark_is_finished_for_its_machine_only(tmp_path):
    session = session_of(tmp_path)
    for name, finished in ((machine(), True), ("cpu of another", False)):
        session.note("bench", {"finished": True, "rows": [{"machine": name}]})
        assert session.is_finished("bench") == finished


def test_rows_are_kept_as_they_are_measured(tmp_path, monkeypatch):
    def killed():
        raise KeyboardInterrupt

    done = lambda: Measured(0.5, 1.0, Work(1, {"float32": 1}))
    monkeypatch.setattr(Kernels, "measurements", lambda measured: [("maps", 4, done), ("more maps", 8, killed)])
    with pytest.raises(KeyboardInterrupt):
        session_of(tmp_path).bench({}, float("inf"))
    result = session_of(tmp_path).results["bench"]
    assert not result["finished"] and [row["what"] for row in result["rows"]] == ["maps"]
    assert len((tmp_path / "bench.tsv").read_text().splitlines()) == 2


def test_a_transfer_is_from_one_state_of_the_resnet50(tmp_path, monkeypatch, capsys):
    begun = tmp_path / "work/transfer/runs/imagenet_0"

    def experiment(path, folder, base_of, synthetic, stand_ins, until):
        found.append(begun.exists())
        begun.mkdir(parents=True, exist_ok=True)
        return True

    found, steps = [], iter([7, 7, 7, 9, 9])
    monkeypatch.setattr(parts, "_best_step", lambda folder: next(steps))
    monkeypatch.setattr(parts.transfer, "experiment", experiment)
    session = session_of(tmp_path)
    for _ in range(2):
        session.note("transfer", session.transfer(session.results.get("transfer", {}), float("inf")))
    assert session.is_finished("transfer")  # with 7 steps
    assert not session.is_finished("transfer")  # with 9
    assert session.transfer(session.results["transfer"], float("inf")) == {"finished": True, "synthetic_steps": 9}
    assert found == [False, True, False]
    assert "from 9 steps of the ResNet50, not 7: begins anew" in capsys.readouterr().out


def test_what_failed_in_an_earlier_call_is_no_failure_of_this_one(tmp_path, monkeypatch):
    monkeypatch.setattr(parts.Session, "bench", lambda session, before, until: {"finished": True, "rows": []})
    assert gpu.main(["smoke", "--parts", "transfer", "--out", str(tmp_path)]) == 2
    assert gpu.main(["smoke", "--parts", "bench", "--out", str(tmp_path)]) == 0


def test_a_preset_of_another_estimator_is_refused():
    plan = Plan.load(find_preset("smoke", "gpu"), "none")
    wrong = replace(plan, config=replace(plan.config, field=plan.config.resnet50))
    with pytest.raises(InputError, match="^model = 'field': must be resnet50, as .* says$"):
        wrong.to_json()


# ---- What work takes at least


def test_the_larger_of_two_times_is_the_limit():
    device = DEVICES["NVIDIA H100 80GB HBM3"]
    assert Work(3.35e12, {"float32": 33.5e12}).limit(device) == (1.0, "memory")
    assert Work(0, {"bfloat16": 989e12, "float32": 67e12}).limit(device) == (2.0, "arithmetic")
    assert Work(8, {"float32": 6}).divided(2) == Work(4, {"float32": 3})


def test_a_row_has_its_share_of_the_limit_on_a_known_device(monkeypatch):
    device = type("Device", (), {"device_kind": "NVIDIA H200", "platform": "gpu"})
    monkeypatch.setattr(kernels.jax, "devices", lambda: [device])
    row = Measured(0.02, 1.0, Work(4.8e9, {"float32": 1.0}), poses=50).row("maps", 10, 3)
    assert (row["us_each"], row["per_s"], row["poses_per_s"]) == (2000.0, 500.0, 25_000.0)
    assert (row["limit_us"], row["share"], row["limited_by"]) == (pytest.approx(1000), pytest.approx(0.5), "memory")
    assert row["machine"].startswith("gpu NVIDIA H200, ")


@pytest.mark.parametrize("name", ["paper", "coarse small map"])
def test_labelling_reads_the_nodes_under_the_chassis_at_every_pose(name):
    setup = SETUPS[name]
    table = setup.node_table()
    poses = sum(1 for arc in table.poses for _ in arc) * len(table.layout.views)
    nodes = sum(int(row[2]) for arc in table.chassis for pose in arc for row in pose.T) * len(table.layout.views)
    work, counted = labelling_work(setup)
    assert counted == poses
    assert work.operations == {"float32": kernels.OPERATIONS * (nodes + 4 * poses)}
    assert work.bytes == 4 * setup.grid.nodes**2 + 13 * len(setup.actions)
    tyre = labelling_work(replace(setup, contact=Contact.from_model("tyre")))[0]
    assert tyre.operations["float32"] > 2 * work.operations["float32"]


def test_products_gathers_and_scatters_of_a_program_are_counted():
    def program(images, kernel, matrix, places):
        seen = jax.lax.conv_general_dilated(images, kernel, (1, 1), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC"))
        rows = matrix.at[places].get(mode="promise_in_bounds")
        return seen.sum(), rows @ rows.T, matrix.at[places].add(rows)

    arrays = (
        jnp.zeros((2, 5, 5, 3), jnp.bfloat16),
        jnp.zeros((3, 3, 3, 4), jnp.bfloat16),
        np.zeros((10, 6), np.float32),
    )
    found = read_program(jax.jit(program).lower(*arrays, np.arange(4)))
    convolved = 2 * (2 * 5 * 5 * 3 + 3 * 3 * 3 * 4 + 2 * 3 * 3 * 4)
    assert (found.products, found.products_bytes) == (2, convolved + 4 * (24 + 24 + 16))
    assert (found.gathers, found.gathers_bytes) == (2, 4 * 24 * 2)
    assert found.operations["tf32"] == 2 * 16 * 6
    assert found.operations["bfloat16"] >= 2 * (2 * 3 * 3 * 4) * 27


def test_a_training_step_has_the_products_of_a_forward_pass_and_of_two_gradients():
    run = run_of()
    found = read_program(training_step(run, 8))
    # One 7 x 7 convolution and a block of four, two dense layers of three heads; the images have no gradient.
    assert found.products >= 3 * (5 + 6) - 1
    assert found.operations["tf32"] > 0 and "bfloat16" not in found.operations


def test_the_estimate_names_the_device_and_says_that_nothing_was_measured():
    said = estimate(Plan.load(find_preset("smoke", "gpu"), "none"))
    assert said.startswith("Estimates for NVIDIA H100 80GB HBM3, preset smoke; nothing was measured on it.")
    for what in ("field training", "resnet50 prediction", "labelling by tyre", "field: 48 samples in 2 epochs take"):
        assert what in said


# ---- Presets and bad input


WEIGHTS = {"paper": "imagenet/resnet50_imagenet.npz", "smoke": "none"}


@pytest.mark.parametrize("name", WEIGHTS)
def test_presets_and_what_they_name_can_be_read(name):
    plan = Plan.load(find_preset(name, "gpu"), "none")
    assert [run.preset.model for run in plan.runs.values()] == ["field", "resnet50"]
    assert plan.runs["field"].setup == plan.runs["resnet50"].setup
    path = plan.file(plan.config.transfer)
    transfer = load_toml(path, TransferConfig)
    assert SitesConfig.load(path.parent / transfer.sites) == SitesConfig.load(find_preset("real", "sites"))
    assert Preset.load(path.parent / transfer.synthetic) == replace(plan.runs["resnet50"].preset, weights=WEIGHTS[name])
    assert Kernels(plan.config, plan.runs["resnet50"]).measurements()


NAMED = {"field": "a.toml", "resnet50": "b.toml", "transfer": "c.toml"}


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"shares": (0.5, 0.5)}, "shares = (0.5, 0.5): must be 4 numbers, for bench, field, resnet50, transfer"),
        ({"shares": (0.5, 0.5, 0.0, 1.0)}, "shares = 0.0: must be above 0 and at most 1"),
        ({"evaluating": 1.0}, "evaluating = 1.0: must be from 0, below 1"),
        ({"field_epochs": -1}, "field_epochs = -1: must be a whole number from 0"),
        ({"maps": ()}, "maps = (): must be one or more whole numbers from 1"),
        ({"repeats": 0}, "repeats = 0: must be a whole number from 1"),
        ({"field": 3}, "field = 3: must be a text"),
    ],
)
def test_settings_that_cannot_be_are_refused_by_name(settings, said):
    with pytest.raises(ValueError) as raised:
        GpuConfig(**NAMED | settings)
    assert str(raised.value).startswith(said)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("laptop",), "preset laptop: no such gpu preset; allowed: paper, smoke, or a .toml file"),
        (("smoke", "--time", "0"), "--time = 0.0: must be seconds above 0"),
        (("smoke", "--parts", "all"), "argument --parts: invalid choice: 'all'"),
        (("smoke", "--weights", "w.npz"), "weights w.npz: no such file here"),
    ],
)
def test_bad_words_are_one_line(words, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert gpu.main(words) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"travjax: {said}") and printed.count("\n") == 1


def test_a_part_that_fails_is_reported_and_the_others_run(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(gpu.Session, "bench", lambda session, before, until: {"finished": True, "rows": []})
    code = gpu.main(["smoke", "--parts", "transfer", "bench", "--out", str(tmp_path)])
    assert code == 2
    said = capsys.readouterr().err
    assert said.startswith("travjax: transfer: ") and "needed: more --time for resnet50" in said
    results = json.loads((tmp_path / "summary.json").read_text())
    assert results["bench"]["finished"] and not results["transfer"]["finished"]
    assert "\n- Transfer: failed, " in (tmp_path / "report.md").read_text()
