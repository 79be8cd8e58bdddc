"""Training: its arithmetic against NumPy, what each phase changes, going on from checkpoints, and bad input."""

import errno
import math
import time
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from flax import nnx

from tests.commandline import FEW
from tests.small_training import (
    GRID,
    HUSKY,
    PRESET,
    SETUP,
    begun,
    copy,
    dataset,
    differing,
    estimator,
    features_of,
    forward,
    host,
    in_training,
    require_equal,
    rows_of,
    run_of,
    saved_state,
    trainer,
    validations,
)
from travjax.config import InputError
from travjax.data.sampling import balanced_subset, every_sample
from travjax.devices import Devices
from travjax.estimators.inference import probabilities
from travjax.estimators.kind import Batch
from travjax.estimators.trajectory_estimator import TrajectoryEstimator
from travjax.evaluation import metrics
from travjax.evaluation.score_figures import training_figure
from travjax.models.input_images import ImageSource, render_inputs, trajectory_bank
from travjax.models.trajectory_resnet import HeadsConfig, create
from travjax.models.variables import merge_model, split_model
from travjax.runs import checkpoint
from travjax.runs.checkpoint import load_meta
from travjax.runs.run import load_estimator
from travjax.simulation.events import EVENTS
from travjax.training import trainer as trainer_module
from travjax.training.step import StepSettings, update
from travjax.training.trainer import Trainer
from travjax.traversal.traverse import unpacked

pytestmark = pytest.mark.usefixtures("shared_code")

PHASES = TrajectoryEstimator.phases

STEPS = 7
"""Steps of an epoch of PRESET."""


def images_of(samples) -> np.ndarray:
    return np.asarray(render_inputs(dataset().heights, *samples, HUSKY, FEW, grid=GRID, elevation_scale=0.5))


def failed_of(samples) -> np.ndarray:
    return np.asarray(unpacked(dataset().labels[samples])[0])


def entropy(logits, failed) -> np.ndarray:
    """Binary cross-entropy of each sample, summed over the events: [b]."""
    z, y = np.asarray(logits, np.float64), np.asarray(failed, np.float64)
    return (np.logaddexp(0, z) - y * z).sum(axis=1)


def refusal(call, *arguments, **options) -> str:
    """The one line of an InputError."""
    with pytest.raises(InputError) as raised:
        call(*arguments, **options)
    assert "\n" not in str(raised.value)
    return str(raised.value)


# ---- A step


def state_of(made, phase: int, optimizer) -> dict:
    variables = jax.tree.map(jax.numpy.array, split_model(made)[1])  # a step takes its state apart
    return variables | {"optimizer": optimizer.init({name: variables[name] for name in PHASES[phase].trained})}


def numpy_step(heads: dict, nu: dict, features, failed, weight, rate: float, decay: float) -> tuple[dict, dict, float]:
    """The heads, RMSprop's means of squares and the loss after a step of phase 1, in float64 and by hand."""
    moved, squares, total = {}, {}, 0.0
    share = weight / weight.sum()
    for number, event in enumerate(EVENTS):
        names = [f"{event}/{layer}/{kind}" for layer in ("hidden", "logit") for kind in ("kernel", "bias")]
        kernel, bias, last, last_bias = (heads[name] for name in names)
        raw = features @ kernel + bias
        hidden = np.maximum(raw, 0)
        logits = (hidden @ last + last_bias)[:, 0]
        total += (share * (np.logaddexp(0, logits) - failed[:, number] * logits)).sum()
        towards = (share * (1 / (1 + np.exp(-logits)) - failed[:, number]))[:, None]
        inner = towards * last[:, 0] * (raw > 0)
        gradients = (
            features.T @ inner + 2 * decay * kernel,
            inner.sum(0),
            hidden.T @ towards + 2 * decay * last,
            towards.sum(0),
        )
        for name, gradient in zip(names, gradients, strict=True):
            squares[name] = 0.9 * nu[name] + 0.1 * gradient**2
            moved[name] = heads[name] - rate * gradient / (np.sqrt(squares[name]) + 1e-7)
    return moved, squares, total


def test_steps_of_the_heads_are_those_of_numpy():
    made = create(PRESET.trunk, HeadsConfig(5, dropout=0.0), seed=3)
    optimizer = replace(PRESET.training, learning_rate=0.01).make_optimizer(1, 1)
    settings, state = StepSettings(split_model(made)[0], PHASES[1], optimizer, 0.05), state_of(made, 1, optimizer)
    heads = {name: array.astype(np.float64) for name, array in host(state["heads"]["heads"]).items()}
    nu = {name: np.zeros_like(array) for name, array in heads.items()}
    random = np.random.default_rng(0)
    for step in range(3):
        features = random.standard_normal((8, PRESET.trunk.features)).astype(np.float32)
        failed = (random.random((8, 3)) < 0.4).astype(np.float32)
        weight = np.array([1, 1, 1, 1, 1, 0, 0, 0] if step == 1 else [1] * 8, np.float32)
        before = heads
        heads, nu, wanted = numpy_step(heads, nu, features.astype(float), failed, weight, 0.01, 0.05)
        state, loss = update(state, Batch(features, failed, weight), 0, step, settings=settings)
        assert float(loss) == pytest.approx(wanted, rel=1e-5)
        actual = host(state["heads"]["heads"])
        for name, array in heads.items():
            np.testing.assert_allclose(actual[name], array, rtol=1e-4, atol=2e-6, err_msg=name)
        if step == 0:  # a first step of RMSprop is as long for each number: 0.01 / sqrt(1 - 0.9)
            change = np.abs(actual["step/hidden/kernel"] - before["step/hidden/kernel"])
            np.testing.assert_allclose(change, 0.01 * math.sqrt(10), rtol=1e-2)


def test_rmsprop_adds_epsilon_outside_of_the_root():
    optimizer = PRESET.training.make_optimizer(1, 1)
    gradient = {"x": np.array([1e-7, 1e-3, -2.0], np.float32)}
    state = optimizer.init(gradient)
    moved, state = optimizer.update(gradient, state)
    small = 1e-7 / (math.sqrt(0.1) * 1e-7 + 1e-7)
    np.testing.assert_allclose(moved["x"], -1e-3 * np.array([small, 3.1613, -3.16228]), rtol=1e-4)
    moved, _ = optimizer.update({"x": gradient["x"] * 0}, state)
    np.testing.assert_array_equal(moved["x"], 0)


def test_a_step_of_everything_has_the_loss_and_statistics_of_a_forward_pass():
    samples = tuple(index[:8] for index in trainer_samples())
    made, optimizer = estimator(2), PRESET.training.make_optimizer(2, 1)
    settings = StepSettings(split_model(made)[0], PHASES[2], optimizer, PRESET.training.weight_decay)
    weight, devices = np.array([1, 1, 1, 1, 1, 1, 0, 0], np.float32), Devices.all()
    inputs = PHASES[2].place(devices.replicate(source()), samples, devices)  # as in training, whose code is compiled
    batch = Batch(inputs, *devices.shard((failed_of(samples).astype(np.float32), weight)))
    state = devices.replicate(state_of(made, 2, optimizer))
    moved, loss = update(state, batch, 11, 4, settings=settings)
    key = jax.random.fold_in(jax.random.key(11), 4)
    logits, after = in_training(*split_model(made), images_of(samples), key)
    wanted = (entropy(logits, failed_of(samples)) * weight).sum() / 6
    assert float(loss) == pytest.approx(wanted, rel=1e-4)
    for name, array in host(after["statistics"]).items():
        np.testing.assert_allclose(host(moved["statistics"])[name], array, rtol=1e-4, atol=1e-6, err_msg=name)


def source() -> ImageSource:
    return ImageSource(dataset().heights, trajectory_bank(SETUP), np.float32(0.5))


def trainer_samples(count: int = 32):
    maps = dataset().maps_of("train")
    samples = balanced_subset(dataset().labels, maps, 0, each=3, failing=2)
    return tuple(index[:count] for index in samples)


def test_a_narrow_trunk_learns_32_samples_by_heart():
    made = create(replace(PRESET.trunk, width=8), HeadsConfig(16, dropout=0.0))
    optimizer = replace(PRESET.training, learning_rate=3e-3, schedule="cosine").make_optimizer(2, 150)
    graph, state = split_model(made)[0], state_of(made, 2, optimizer)
    samples = trainer_samples(32)
    failed = failed_of(samples).astype(np.float32)
    batch = Batch((jax.device_put(source()), *samples), failed, np.ones(32, np.float32))
    settings = StepSettings(graph, PHASES[2], optimizer)
    assert len(failed) == 32 and 0.2 < failed.any(axis=1).mean() < 0.9
    losses = []
    for step in range(150):
        state, loss = update(state, batch, 0, step, settings=settings)
        losses.append(float(loss))
    assert losses[0] > 1.5
    assert losses[-1] < 0.02
    variables = {name: state[name] for name in ("trunk", "heads", "statistics")}
    logits = forward(graph, variables, images_of(samples))  # with the running statistics
    assert entropy(logits, failed).mean() < 0.1


# ---- What the phases change


def test_the_first_phase_changes_the_heads_alone_and_the_second_everything(tmp_path):
    made = begun(tmp_path, head_epochs=1, epochs=1)
    first = host(made.state)
    made.train()
    heads, last = saved_state(tmp_path, "heads"), host(made.state)
    kept = lambda state: {name: array for name, array in state.items() if not name.startswith("optimizer")}
    changed = differing(kept(first), heads)
    assert changed == {name for name in heads if name.startswith("heads/")}
    assert differing(heads, kept(last)) == set(heads)


def test_without_head_epochs_everything_is_trained_from_the_start(tmp_path):
    made = begun(tmp_path, head_epochs=0, epochs=1)
    assert made.position.phase == 2
    made.train()
    assert [row["phase"] for row in validations(tmp_path)] == [2]
    assert refusal(load_estimator, tmp_path / "none").startswith(str(tmp_path / "none"))
    with pytest.raises(InputError, match="'heads'"):
        load_meta(tmp_path / "checkpoints", "heads")


def test_the_features_of_the_frozen_trunk_are_those_of_a_forward_pass(tmp_path):
    made = trainer(tmp_path)
    made.start(merge_model(*split_model(estimator(1))))
    for name, samples in (("training", made.data.samples(1, 0)), ("validation", made.data.validation)):
        wanted = features_of(*split_model(estimator(1)), images_of(samples))
        np.testing.assert_allclose(made.features[name], wanted, rtol=1e-4, atol=1e-5)


def test_other_runs_of_the_same_trunk_take_its_features_from_the_file(tmp_path, monkeypatch):
    runs = {}
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        run, file = run_of(head_epochs=1, epochs=0), tmp_path / "features.npz"
        runs[name] = Trainer(run, dataset(), tmp_path / name, Devices.all(), quiet=True, features=file)
        runs[name].start(run.create(runs[name].config.seed))
        runs[name].train()
        monkeypatch.setattr("travjax.estimators.trajectory_estimator.over_samples", None)  # what would compute them
    assert rows_of(tmp_path / "first") == rows_of(tmp_path / "second")


# ---- Watched samples


@pytest.mark.parametrize("until", [7, 10, 14])
def test_training_that_runs_out_of_time_goes_on_to_the_same_numbers(trained, tmp_path, monkeypatch, until):
    first = begun(tmp_path)
    clock = SimpleNamespace(monotonic=lambda: first.position.total, perf_counter=time.perf_counter)
    monkeypatch.setattr(trainer_module, "time", clock)
    assert not first.train(until) and not first.train(until)
    assert first.position.total == until
    monkeypatch.undo()
    second = trainer(tmp_path)
    second.resume()
    assert second.position == first.position
    assert second.train() and second.finished
    assert rows_of(tmp_path) == rows_of(trained)
    require_equal(saved_state(tmp_path), saved_state(trained))


def eval_sets() -> dict[str, tuple]:
    """All trajectories of two test maps, and of one."""
    test = dataset().maps_of("test")
    return {"two": every_sample(dataset().labels, test[:2]), "one": every_sample(dataset().labels, test[2:3])}


@pytest.mark.parametrize("phases", [{"head_epochs": 2, "epochs": 0}, {"head_epochs": 0, "epochs": 2}])
def test_eval_sets_are_scored_before_training_and_after_each_epoch(tmp_path, phases):
    made = Trainer(run_of(**phases), dataset(), tmp_path, Devices.all(), quiet=True, eval_sets=eval_sets())
    made.start(create(PRESET.trunk, PRESET.heads, 0))
    states = [host(made._variables)]
    kept = lambda until: (train(until), states.append(host(made._variables)))
    made._train_epoch, train = kept, made._train_epoch
    made.train()
    rows = [row for row in rows_of(tmp_path) if "eval_sets" in row]
    assert [row["epoch"] for row in rows] == [0, 1, 2]
    assert rows[0]["step"] == 0
    graph = made.graph
    for row, state in zip(rows, states, strict=True):
        for name, samples in eval_sets().items():
            variables = jax.tree.unflatten(jax.tree.structure(made._variables), list(state.values()))
            probability = probabilities(np.asarray(forward(graph, variables, images_of(samples))))
            wanted = metrics.confusions(probability, made.data.failed(samples).astype(bool))
            for event, counts in wanted.items():
                assert row["eval_sets"][name][event]["confusion"] == metrics.json_ready(counts)


def test_training_does_not_depend_on_eval_sets(tmp_path):
    begun(tmp_path / "without").train()
    made = Trainer(run_of(), dataset(), tmp_path / "with", Devices.all(), quiet=True, eval_sets=eval_sets())
    (tmp_path / "with").mkdir()
    made.start(create(PRESET.trunk, PRESET.heads, made.config.seed))
    made.train()
    require_equal(saved_state(tmp_path / "without"), saved_state(tmp_path / "with"))
    rows = [{name: value for name, value in row.items() if name != "eval_sets"} for row in rows_of(tmp_path / "with")]
    assert rows[1:] == rows_of(tmp_path / "without")


# ---- Samples


def test_runs_of_other_seeds_train_on_the_same_samples_where_a_seed_of_the_subset_is_given(tmp_path):
    datas = [trainer(tmp_path, seed=seed, subset_seed=7, resample_each_epoch=False).data for seed in (0, 1)]
    drawn = [[data.samples(1, 0), data.samples(2, 1), data.validation] for data in datas]
    for one, other in zip(*drawn, strict=True):
        np.testing.assert_array_equal(one, other)
    orders = [np.concatenate([places for places, _, _ in data.batches(1, 0)]) for data in datas]
    assert not np.array_equal(*orders)
    alone = trainer(tmp_path, seed=7, resample_each_epoch=False).data
    np.testing.assert_array_equal(alone.samples(1, 0), datas[0].samples(1, 0))
    np.testing.assert_array_equal(alone.validation, datas[0].validation)


def test_fresh_samples_are_others_in_each_epoch_of_the_second_phase(tmp_path):
    fresh, fixed = trainer(tmp_path), trainer(tmp_path, resample_each_epoch=False)
    same = lambda one, other: all(np.array_equal(*pair) for pair in zip(one, other, strict=True))
    assert same(fresh.data.samples(1, 0), fresh.data.samples(1, 1))
    drawn = [fresh.data.samples(1, 0), fresh.data.samples(2, 0), fresh.data.samples(2, 1)]
    assert not any(same(drawn[i], drawn[j]) for i, j in ((0, 1), (0, 2), (1, 2)))
    assert same(fresh.data.samples(2, 1), trainer(tmp_path).data.samples(2, 1))
    wanted = balanced_subset(dataset().labels, dataset().maps_of("train"), 0, each=3, failing=2)
    for phase, epoch in ((1, 0), (1, 1), (2, 0), (2, 1)):
        assert same(fixed.data.samples(phase, epoch), wanted)
    for samples in drawn:
        assert set(dataset().split[samples[0]]) == {0}


def test_the_subset_of_an_epoch_is_drawn_once(tmp_path, monkeypatch):
    data, drawn = begun(tmp_path, head_epochs=0).data, []
    draw = type(data._sampler).epoch
    monkeypatch.setattr(type(data._sampler), "epoch", lambda self, number: drawn.append(number) or draw(self, number))
    for epoch in range(3):
        for _ in range(2):
            data.samples(2, epoch)
            data.steps(2)
            data.steps(1)
    assert sorted(set(drawn)) == sorted(drawn)


def test_an_epoch_takes_each_sample_once_and_in_another_order_each_time(tmp_path):
    made = begun(tmp_path, resample_each_epoch=False)
    count = len(made.data.samples(2, 0)[0])
    orders = []
    for phase, epoch in ((1, 0), (1, 1), (2, 0), (2, 1)):
        batches = list(made.data.batches(phase, epoch))
        samples = made.data.samples(phase, epoch)
        if phase == 2:  # from maps and trajectories to their places
            numbers = (samples[0] * len(FEW) + samples[1]).tolist()
            taken = [(batch.inputs[0] * len(FEW) + batch.inputs[1]).tolist() for batch in batches]
            places = [[numbers.index(number) for number in numbers_of_batch] for numbers_of_batch in taken]
            batches = [batch._replace(inputs=inputs) for batch, inputs in zip(batches, places, strict=True)]
        places, failed, weight = (np.concatenate(parts) for parts in zip(*batches, strict=True))
        assert len(batches) == STEPS == -(-count // 8) and weight.sum() == count
        assert sorted(places[weight > 0]) == list(range(count))
        np.testing.assert_array_equal(failed, failed_of((samples[0][places], samples[1][places])))
        orders.append(places.tolist())
    assert orders[0] != orders[1] and orders[2] != orders[3]


def test_the_validation_samples_are_the_balanced_subset_or_some_of_it(tmp_path):
    whole = balanced_subset(dataset().labels, dataset().maps_of("validation"), 0, each=3, failing=2)
    for actual, wanted in zip(trainer(tmp_path).data.validation, whole, strict=True):
        np.testing.assert_array_equal(actual, wanted)
    some = list(zip(*map(list, trainer(tmp_path, validation_samples=7).data.validation), strict=True))
    assert len(set(some)) == 7
    assert set(some) < set(zip(*map(list, whole), strict=True))
    fewer = trainer(tmp_path, validation_samples=3).data.validation
    assert set(zip(*map(list, fewer), strict=True)) < set(some)


# ---- What is reported


def test_each_row_says_where_it_stands(trained):
    rows = rows_of(trained)
    assert [row["step"] for row in rows] == sorted({row["step"] for row in rows})
    assert rows[-1]["step"] == 4 * STEPS
    for row in rows:
        number = (row["step"] - 1) // STEPS
        assert (row["phase"], row["epoch"]) == (1 + number // 2, 1 + number % 2)
        assert 0.2 < row["loss"] < 10
        assert ("validation_loss" in row) == (row["step"] % STEPS == 0)
    assert all(row["learning_rate"] == pytest.approx(1e-3) for row in rows if row["phase"] == 1)
    rates = [row["learning_rate"] for row in rows if row["phase"] == 2]
    assert rates == sorted(rates) and rates[-1] == pytest.approx(1e-3)
    training_figure(rows).savefig(trained.parent / "rows.png")


def test_the_validation_is_that_of_the_estimator(trained, tmp_path):
    samples, row = trainer(tmp_path).data.validation, validations(trained)[-1]
    logits = forward(*split_model(load_estimator(trained, "latest")[1]), images_of(samples))
    failed = failed_of(samples)
    assert row["validation_loss"] == pytest.approx(entropy(logits, failed).mean(), rel=1e-4)
    share = failed.mean(axis=0)
    odds = np.log(share / (1 - share))
    assert row["constant_loss"] == pytest.approx(entropy(np.broadcast_to(odds, failed.shape), failed).mean(), rel=1e-6)
    wanted = metrics.evaluate(1 / (1 + np.exp(-np.asarray(logits))), failed)
    for name, value in row["average_precision"].items():
        assert value == pytest.approx(wanted.average_precision[name], rel=1e-3)
    assert row["f1"] == pytest.approx(wanted.f1)


def test_the_loss_of_an_epoch_is_the_mean_over_its_samples(tmp_path):
    made = begun(tmp_path, head_epochs=1, epochs=1)
    step, losses = made._step, []

    def kept(batch):
        losses.append((step(batch), batch.weight.sum()))
        return losses[-1][0]

    made._step = kept
    made.train()
    values, counts = np.array([[float(loss), count] for loss, count in losses]).T
    assert min(counts) < 8
    for row, part in zip(validations(tmp_path), (slice(0, STEPS), slice(STEPS, None)), strict=True):
        assert row["loss"] == pytest.approx((values * counts)[part].sum() / counts[part].sum(), rel=1e-6)


def test_the_best_checkpoint_has_the_largest_average_precision(trained):
    overall = [row["average_precision"]["overall"] for row in validations(trained)]
    best = load_meta(trained / "checkpoints", "best")
    assert best["validation"]["average_precision"]["overall"] == max(overall) == best["position"]["best"]
    assert best["position"]["total"] == STEPS * (1 + overall.index(max(overall)))


def test_the_best_checkpoint_stays_when_later_epochs_are_worse(tmp_path, monkeypatch):
    made, values = begun(tmp_path, head_epochs=1, epochs=3), iter([0.2, 0.5, 0.4, 0.3])
    validated = made._validated
    change = lambda row: row | {"average_precision": row["average_precision"] | {"overall": next(values)}}
    monkeypatch.setattr(made, "_validated", lambda: change(validated()))
    made.train()
    best = load_meta(tmp_path / "checkpoints", "best")
    assert best["validation"]["average_precision"]["overall"] == 0.5
    assert (best["position"]["phase"], best["position"]["total"]) == (2, 2 * STEPS)


# ---- The same again


def test_the_same_seed_gives_the_same_numbers(trained, tmp_path):
    begun(tmp_path).train()
    assert rows_of(tmp_path) == rows_of(trained)
    require_equal(saved_state(tmp_path), saved_state(trained))


def test_another_seed_gives_others(trained, tmp_path):
    begun(tmp_path, seed=1, epochs=0).train()
    one, other = ([row["loss"] for row in rows_of(folder)] for folder in (trained, tmp_path))
    assert not set(other) & set(one)


def test_the_largest_seed_will_do(tmp_path):
    begun(tmp_path, seed=2**31 - 1, head_epochs=1, epochs=0).train()
    assert len(validations(tmp_path)) == 1


# ---- Going on; kills are in tests/commands/test_train.py


def damage(path) -> None:
    file = next(path for path in sorted(path.rglob("*")) if path.is_file() and "state" in path.parts)
    file.write_bytes(file.read_bytes()[:-1])


def newest(folder):
    return max(path for path in (folder / "checkpoints").iterdir() if "-step-" in path.name)


def test_a_damaged_newest_checkpoint_is_passed_over_with_a_notice(trained, tmp_path, capsys):
    folder = copy(trained, tmp_path / "run")
    damage(newest(folder))
    made = trainer(folder)
    made.quiet = False
    made.resume()
    said = capsys.readouterr()
    assert f"{newest(folder)}: damaged checkpoint passed over: " in said.out + said.err
    assert (made.position.total, made.position.step) == (27, 6)
    made.train()
    assert rows_of(folder) == rows_of(trained)
    require_equal(saved_state(folder), saved_state(trained))


def test_a_finished_run_stays_as_it_is(trained, tmp_path):
    folder = copy(trained, tmp_path / "run")
    names = sorted(path.name for path in (folder / "checkpoints").iterdir())
    made = trainer(folder)
    made.resume()
    made.train()
    assert rows_of(folder) == rows_of(trained)
    assert sorted(path.name for path in (folder / "checkpoints").iterdir()) == names
    require_equal(host(made.state), saved_state(trained))


def test_the_end_of_the_first_phase_is_gone_through_again(tmp_path, monkeypatch):
    """A kill between the last checkpoint of phase 1 and the one named "heads" loses neither."""
    whole, made = begun(tmp_path / "whole", head_epochs=1, epochs=1), begun(tmp_path / "cut", head_epochs=1, epochs=1)
    whole.train()

    def killed(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(made.checkpoints, "save_named", killed)
    with pytest.raises(KeyboardInterrupt):
        made.train()
    again = trainer(tmp_path / "cut", head_epochs=1, epochs=1)
    again.resume()
    again.train()
    assert rows_of(tmp_path / "cut") == rows_of(tmp_path / "whole")
    for which in ("latest", "heads", "best"):
        require_equal(saved_state(tmp_path / "cut", which), saved_state(tmp_path / "whole", which))


def test_a_run_without_checkpoints_cannot_go_on(tmp_path):
    assert str(tmp_path / "checkpoints") in refusal(trainer(tmp_path).resume)


# ---- Bad input


@pytest.mark.parametrize(("total", "where"), [(2, "batch 3 of phase 1, epoch 1"), (20, "batch 7 of phase 2, epoch 1")])
def test_a_loss_that_is_no_number_stops_training_and_names_the_batch(tmp_path, total, where):
    made = begun(tmp_path)
    step = made._step
    spoilt = lambda batch: batch._replace(targets=batch.targets * np.float32("nan"))
    made._step = lambda batch: step(spoilt(batch) if made.position.total == total else batch)
    message = refusal(made.train)
    assert f"loss = nan in {where}" in message and "the last checkpoint is kept" in message
    if total == 20:
        state, position = saved_state(tmp_path), load_meta(tmp_path / "checkpoints")["position"]
        assert position["total"] == 20
        assert all(np.isfinite(array).all() for array in state.values())


def test_a_state_that_is_no_number_is_never_the_latest_checkpoint(tmp_path):
    """The loss of a step is that before its update: an update may spoil the state with the loss still a number."""
    made = begun(tmp_path, head_epochs=1, epochs=0, checkpoint_steps=2)
    step = made._step

    def spoilt(*batch):
        loss = step(*batch)
        if made.position.total == 3:  # the fourth step, after which a checkpoint is due
            made.state["heads"] = jax.tree.map(lambda array: array * float("nan"), made.state["heads"])
        return loss

    made._step = spoilt
    refusal(made.train)
    assert all(np.isfinite(array).all() for array in saved_state(tmp_path).values())


@pytest.mark.parametrize("head_epochs", [1, 0])
def test_a_validation_of_no_numbers_stops_training(tmp_path, head_epochs):
    made = begun(tmp_path, head_epochs=head_epochs)
    made.state["heads"] = jax.tree.map(lambda array: array * float("nan"), made.state["heads"])
    assert refusal(made._validated).startswith("a validation logit that is no number in batch 0 of phase")


def test_a_full_disk_stops_training_and_keeps_the_earlier_checkpoints(tmp_path, monkeypatch):
    made = begun(tmp_path)
    save, saves = made.checkpoints.save, []

    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    def filling(step, *arguments):
        saves.append(step)
        if step == 6:
            monkeypatch.setattr(checkpoint, "sha256", full)
        save(step, *arguments)

    made.checkpoints.save = filling
    message = refusal(made.train)
    assert message.startswith(f"{tmp_path / 'checkpoints'}: checkpoint cannot be written: No space left on device")
    monkeypatch.undo()
    assert saves == [3, 6]
    assert load_meta(tmp_path / "checkpoints")["position"]["total"] == 3
    again = trainer(tmp_path)
    again.resume()
    assert again.position.total == 3


def test_a_data_set_of_another_robot_or_action_space_is_refused(tmp_path):
    other = replace(run_of(), setup=replace(SETUP, actions=replace(FEW, arc_lengths=(0.5, 0.7))))
    message = refusal(Trainer, other, dataset(), tmp_path, None)
    assert message == ("actions of the data set: arc_lengths = (0.5, 0.6); must be as here: arc_lengths = (0.5, 0.7)")
    other = replace(run_of(), setup=replace(SETUP, robot=replace(HUSKY, track=0.6)))
    assert refusal(Trainer, other, dataset(), tmp_path, None).startswith("robot of the data set: track = ")


@pytest.mark.parametrize(("split", "number"), [("train", 0), ("validation", 1)])
def test_a_data_set_without_maps_of_a_split_is_refused(tmp_path, split, number):
    data = dataset()
    other = replace(data, split=np.where(data.split == number, 2, data.split).astype(np.uint8))
    assert f"{split} split" in refusal(trainer, tmp_path, other)


def test_training_leaves_the_estimator_that_was_given_alone(tmp_path):
    made, given = trainer(tmp_path, head_epochs=1, epochs=0), create(PRESET.trunk, PRESET.heads)
    before = host(nnx.state(given))
    made.start(given)
    made.train()
    require_equal(host(nnx.state(given)), before)
