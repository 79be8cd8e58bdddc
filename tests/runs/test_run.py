"""A run's folder gives back what it was made from and its estimators, and says in one line what is wrong with it."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.commandline import FEW
from tests.small_training import GRID, HUSKY, PRESET, SETUP, copy, host, loads, require_equal, run_of, saved_state
from travjax.config import InputError
from travjax.devices import Devices
from travjax.estimators.preset import EvaluationConfig
from travjax.models.trajectory_resnet import create
from travjax.models.variables import split_model
from travjax.runs.checkpoint import Checkpoints
from travjax.runs.run import Run, checked_meta, load_estimator
from travjax.simulation.contact import Contact

pytestmark = pytest.mark.usefixtures("shared_code")


def refusal(call, *arguments) -> str:
    with pytest.raises(InputError) as raised:
        call(*arguments)
    assert "\n" not in str(raised.value)
    return str(raised.value)


# ---- run.json


def test_a_run_comes_back_as_it_was_saved(tmp_path):
    path = run_of().save(tmp_path)
    assert path == tmp_path / "run.json"
    assert Run.load(tmp_path) == run_of()
    assert set(loads(path.read_text())) == {"preset", "robot", "actions", "grid", "contact"}  # the radii inf are texts


def test_a_run_from_before_contact_models_is_the_papers(tmp_path):
    path = run_of().save(tmp_path)
    path.write_text(json.dumps({name: part for name, part in loads(path.read_text()).items() if name != "contact"}))
    assert Run.load(tmp_path) == run_of() and run_of().setup.contact.model == "nearest"


def test_a_run_of_another_contact_model_is_another_run():
    other = replace(run_of(), setup=replace(run_of().setup, contact=Contact("tyre", True)))
    with pytest.raises(InputError, match="contact.model = 'tyre': must be 'nearest', as in the run so far"):
        run_of().require_same_settings(other, "--out")


def test_the_run_of_the_command_is_the_preset(trained):
    assert Run.load(trained) == Run(PRESET, SETUP)


def test_a_folder_without_a_run_is_named(tmp_path):
    wanted = f"{tmp_path}/run.json: cannot be read: No such file or directory; allowed: the folder of a training run"
    assert refusal(Run.load, tmp_path) == wanted


@pytest.mark.parametrize("text", ["", "{", "[]", "3", "{}", '{"preset": 3}', '{"preset": {}, "robot": {}}', "\xff"])
def test_a_file_that_is_not_of_a_run_is_one_line(tmp_path, text):
    (tmp_path / "run.json").write_bytes(text.encode("latin-1"))
    assert refusal(Run.load, tmp_path).startswith(f"{tmp_path / 'run.json'}: ")


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("preset", "training", "batch_size"), 0, "[training] batch_size = 0: must be a whole number, at least 1"),
        (("preset", "training", "steps"), 3, "[training] unknown key 'steps'; allowed: "),
        (("preset", "trunk"), 3, "trunk = 3: must be a table [trunk]"),
        (("robot", "track"), -1, "track = -1: must be "),
        (("grid", "spacing"), 0, "spacing = 0: must be "),
    ],
)
def test_a_setting_that_was_altered_is_named(tmp_path, place, value, message):
    path = run_of().save(tmp_path)
    table = json.loads(path.read_text())
    inner = table
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    path.write_text(json.dumps(table))
    assert refusal(Run.load, tmp_path).startswith(f"{path}: {message}")


# ---- Old keys


def aged(table: dict) -> dict:
    """What an older travjax wrote of a run."""
    text = json.dumps(table)
    for new, old in (("trajectories_per_map", "each"), ("max_grad_norm", "clip"), ("probability", "share")):
        assert f'"{new}": ' in text
        text = text.replace(f'"{new}": ', f'"{old}": ')
    return json.loads(text)


NOTICE = (
    "keys 'share', 'clip', 'each' are now called 'probability', 'max_grad_norm', 'trajectories_per_map'; "
    "the old names will not be read by the next version\n"
)


def test_a_run_of_old_keys_is_read_with_one_notice(tmp_path, capsys):
    path = run_of().save(tmp_path)
    path.write_text(json.dumps(aged(json.loads(path.read_text()))))
    assert Run.load(tmp_path) == run_of()
    assert capsys.readouterr().out == f"{path}: {NOTICE}"
    Run.load(tmp_path).save(tmp_path)
    capsys.readouterr()
    assert Run.load(tmp_path) == run_of() and capsys.readouterr().out == ""


def test_a_checkpoint_that_was_trained_with_old_keys_is_one_of_the_run(tmp_path, capsys):
    position = {"phase": 1, "epoch": 0, "step": 2, "total": 2, "loss": 0.5, "samples": 3.0, "best": -1.0}
    meta = {"position": position, "optimizer": 1, "dataset": "0123", "run": aged(run_of().to_json())}
    assert checked_meta(meta, tmp_path, run_of()) == meta
    assert capsys.readouterr().out == f"{tmp_path}: meta of a checkpoint: {NOTICE}"


# ---- Another run


def test_what_does_not_matter_to_a_run_that_has_begun_may_differ():
    preset = replace(PRESET, weights="w.npz", robot="./husky.toml", evaluation=EvaluationConfig(1, 1))
    run_of().require_same_settings(replace(run_of(), preset=preset), "the run")


@pytest.mark.parametrize(
    ("other", "name", "values"),
    [
        (run_of(learning_rate=2e-3), "preset.training.learning_rate", ("0.002", "0.001")),
        (replace(run_of(), preset=replace(PRESET, elevation_scale=2.0)), "preset.elevation_scale", ("2.0", "0.5")),
        (
            replace(run_of(), setup=replace(SETUP, robot=replace(HUSKY, track=0.6))),
            "robot.track",
            ("0.6", repr(HUSKY.track)),
        ),
        (replace(run_of(), setup=replace(SETUP, actions=replace(FEW, turns=3))), "actions.turns", ("3", "2")),
    ],
)
def test_the_first_setting_that_differs_is_named(other, name, values):
    message = refusal(run_of().require_same_settings, other, "--resume runs/a")
    assert message == f"--resume runs/a: {name} = {values[0]}: must be {values[1]}, as in the run so far"


def test_the_same_run_is_the_same():
    run_of().require_same_settings(run_of(), "--resume")


# ---- Shapes for checkpoints


@pytest.mark.parametrize("phase", [0, 1, 2])
def test_the_template_has_the_shapes_of_the_state(phase):
    run = run_of()
    state = split_model(create(PRESET.trunk, PRESET.heads))[1]
    if phase:
        trained = {name: state[name] for name in run.kind.phases[phase].trained}
        state = state | {"optimizer": PRESET.training.make_optimizer(phase, 9).init(trained)}
    sharding = Devices.all().everywhere
    template = run.template(phase, sharding)
    assert jax.tree.structure(template) == jax.tree.structure(state)
    for one, other in zip(jax.tree.leaves(template), jax.tree.leaves(state), strict=True):
        assert (one.shape, one.dtype, one.sharding) == (other.shape, other.dtype, sharding)


def test_the_graph_is_that_of_an_estimator():
    graph = split_model(create(PRESET.trunk, PRESET.heads, seed=8))[0]
    assert run_of().graph() == graph and hash(run_of().graph()) == hash(graph)


# ---- Estimators


@pytest.mark.parametrize(("which", "phase", "total"), [("latest", 2, 28), ("heads", 1, 14), ("best", None, None)])
def test_an_estimator_is_that_of_its_checkpoint(trained, which, phase, total):
    run, estimator, meta = load_estimator(trained, which)
    assert run == Run.load(trained)
    if phase:
        assert (meta["position"]["phase"], meta["position"]["total"]) == (phase, total)
    saved = {name: array for name, array in saved_state(trained, which).items() if not name.startswith("optimizer")}
    require_equal(host(split_model(estimator)[1]), saved)


def test_best_is_what_is_loaded_unless_told_otherwise(trained):
    one, other = (host(split_model(load_estimator(trained, *which)[1])[1]) for which in ((), ("best",)))
    require_equal(one, other)


def test_a_damaged_checkpoint_is_passed_over_with_a_notice(trained, tmp_path, capsys):
    folder = copy(trained, tmp_path / "run")
    last = max(path for path in (folder / "checkpoints").iterdir() if "-step-" in path.name)
    (last / "meta.json").write_text("{}")
    meta = load_estimator(folder, "latest")[2]
    assert meta["position"]["total"] == 27
    said = capsys.readouterr()
    assert f"{last}: damaged checkpoint passed over: meta.json is altered or truncated" in said.out + said.err


def test_a_checkpoint_that_is_not_there_is_one_line(trained, tmp_path):
    message = refusal(load_estimator, trained, "newest")
    assert "holds no checkpoint 'newest'; it holds: " in message and "heads" in message
    run_of().save(tmp_path)
    assert str(tmp_path / "checkpoints") in refusal(load_estimator, tmp_path)


def test_the_checkpoint_of_another_network_is_one_line(trained, tmp_path):
    folder = copy(trained, tmp_path / "run")
    replace(run_of(), preset=replace(PRESET, heads=replace(PRESET.heads, hidden=8))).save(folder)
    assert refusal(load_estimator, folder, "heads") == (
        f"{folder}/run.json: preset.heads.hidden = 8: must be 16, as in the run so far"
    )


@pytest.mark.parametrize(
    ("part", "name", "value"),
    [("preset", "elevation_scale", 9.0), ("robot", "track", 0.9), ("actions", "interval", 0.16)],
)
def test_a_run_json_with_another_number_than_was_trained_with_is_refused(trained, tmp_path, part, name, value):
    folder = copy(trained, tmp_path / "run")
    table = json.loads((folder / "run.json").read_text())
    assert table[part][name] != value
    table[part][name] = value
    (folder / "run.json").write_text(json.dumps(table))
    message = refusal(load_estimator, folder)
    assert message.startswith(f"{folder}/run.json: {part}") and name in message


def test_hidden_files_that_others_leave_in_a_checkpoint_do_not_count(trained, tmp_path):
    folder = copy(trained, tmp_path / "run")
    for checkpoint in (folder / "checkpoints").iterdir():
        (checkpoint / ".DS_Store").write_text("Finder")
        (checkpoint / "state" / ".nfs0001").write_text("NFS")
    one, other = (host(split_model(load_estimator(place)[1])[1]) for place in (folder, trained))
    require_equal(one, other)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_estimator_with_a_number_that_is_none_is_refused(tmp_path, value):
    run_of().save(tmp_path)
    variables = split_model(create(PRESET.trunk, PRESET.heads))[1]
    spoilt = jax.tree.map(lambda leaf: leaf.at[0].set(value) if leaf.ndim == 1 else leaf, variables)
    position = {"phase": 1, "epoch": 0, "step": 0, "total": 0, "loss": 0.0, "samples": 0, "best": 0.0}
    meta = {"optimizer": 0, "position": position, "dataset": "", "run": run_of().to_json()}
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    checkpoints.save(1, variables, meta, best=True)
    checkpoints.save(2, spoilt, meta)
    assert load_estimator(tmp_path, "best")
    message = refusal(load_estimator, tmp_path, "latest")
    assert message.startswith(f"{tmp_path}, checkpoint latest: heads/") and f" = {value}: must be finite" in message


def test_an_estimator_that_was_loaded_can_be_used(trained):
    images = np.zeros((2, *GRID.shape, 3), np.float32)
    assert np.isfinite(load_estimator(trained)[1](images)).all()
