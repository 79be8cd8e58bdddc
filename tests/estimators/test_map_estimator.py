"""Training of the hazard field: the loss falls, a run goes on bit for bit, the margins count, checkpoints come back."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.commandline import FEW
from tests.field_runs import CONFIG, PRESET, RUN, begun, trainer
from tests.small_training import copy, dataset, host, require_equal, rows_of, saved_state
from travjax.config import InputError
from travjax.devices import Devices
from travjax.estimators.inference import Placed
from travjax.estimators.map_estimator import hazards
from travjax.models.variables import merge_model, split_model
from travjax.runs.evaluator import Evaluator
from travjax.runs.run import load_estimator
from travjax.simulation.events import EVENTS

pytestmark = pytest.mark.usefixtures("shared_code")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of eight epochs."""
    folder = tmp_path_factory.mktemp("field") / "whole"
    begun(folder, epochs=8).train()
    return folder


def test_the_loss_falls_and_failures_are_told_apart(whole):
    rows = [row for row in rows_of(whole) if "validation_loss" in row]
    assert [row["epoch"] for row in rows] == list(range(1, 9))
    assert rows[-1]["loss"] < 0.5 * rows[0]["loss"]
    assert rows[-1]["validation_loss"] < 0.9 * rows[0]["validation_loss"]


def test_a_run_that_was_interrupted_goes_on_bit_for_bit(tmp_path):
    one = begun(tmp_path / "one")
    one.train()
    stopped = begun(tmp_path / "two")
    save, saved = stopped.checkpoints.save, []

    def stop(step, *arguments):
        save(step, *arguments)
        saved.append(step)
        if step == 7:
            raise KeyboardInterrupt

    stopped.checkpoints.save = stop
    with pytest.raises(KeyboardInterrupt):
        stopped.train()
    assert saved == [2, 4, 5, 7]  # in the middle of the second epoch
    on = trainer(tmp_path / "two")
    on.resume()
    on.train()
    require_equal(saved_state(tmp_path / "one"), saved_state(tmp_path / "two"))
    assert rows_of(tmp_path / "one")[-1] == rows_of(tmp_path / "two")[-1]


def test_margins_count_by_their_weight(tmp_path):
    made = begun(tmp_path)
    batch = next(made._batches())
    inputs = made.phase.place(made.source, batch.inputs, made.devices)
    weighted = [replace(PRESET, field=replace(CONFIG, margin_weight=weight)) for weight in (0.0, 1.0, 3.0)]
    networks = [split_model(replace(RUN, preset=preset).create(0)) for preset in weighted]

    @jax.jit
    def losses_of(variables):
        merged = [merge_model(graph, variables) for graph, _ in networks]
        return [made.phase.loss(network, inputs, batch.targets, jax.random.key(0)).mean() for network in merged]

    losses = np.array(losses_of(networks[0][1]))
    assert losses[0] < losses[1]
    assert losses[2] - losses[0] == pytest.approx(3 * (losses[1] - losses[0]), rel=1e-3)


def test_the_kernels_of_the_heads_decay_under_rmsprop(tmp_path):
    """With a learning rate of each number's own, a strong decay alone drives them towards zero; else 2 % are lost."""
    made = begun(tmp_path, optimizer="rmsprop", weight_decay=10.0, epochs=1)
    layers = [f"heads/{layer}/kernel" for layer in ("first", "second", "hazard")]
    before = host(made.state["heads"])
    made.train()
    after = host(made.state["heads"])
    of_all = lambda heads: sum((heads[layer] ** 2).sum() for layer in layers)
    assert of_all(after) < 0.7 * of_all(before)


def test_a_trained_field_predicts_margins(whole):
    run, network, meta = load_estimator(whole)
    evaluator = Evaluator.from_run(run, dataset(), Devices.all())
    samples = evaluator.samples(0, 0)
    predicted, true = evaluator.margins(network, samples)
    assert predicted.shape == true.shape == (len(samples[0]), len(EVENTS)) and true.max() <= 4
    failed = evaluator.failed(samples)
    np.testing.assert_array_equal(true > 1, failed)
    placed = Placed.from_network(network, evaluator.source, evaluator.devices)
    whole_maps = hazards(placed, np.unique(samples[0]))
    np.testing.assert_allclose(predicted, np.minimum(whole_maps[..., 3:].reshape(predicted.shape), 4), atol=1e-5)
    assert meta["position"]["phase"] == 2 and network.trunk.config == CONFIG


def test_whole_maps_and_samples_agree(whole):
    run, network, _ = load_estimator(whole)
    evaluator = Evaluator.from_run(run, dataset(), Devices.all())
    maps = dataset().maps_of("test")[[2, 0]]
    by_map = evaluator.whole_maps(network, maps)
    samples = (np.array([maps[1], maps[0], maps[1]]), np.array([3, 5, len(FEW) - 1]))
    np.testing.assert_allclose(evaluator.probabilities(network, samples), by_map[[1, 0, 1], samples[1]], atol=1e-6)


def test_a_damaged_latest_checkpoint_is_passed_over(whole, tmp_path):
    spoilt = copy(whole, tmp_path / "spoilt")
    latest = sorted(path for path in (spoilt / "checkpoints").iterdir() if "step-40" in path.name)[0]
    (latest / "meta.json").write_text("{")
    assert load_estimator(spoilt, "latest")[2]["position"]["total"] < 40


def test_the_hazard_field_begins_with_random_weights():
    with pytest.raises(InputError, match='"none": the hazard field begins with random ones'):
        RUN.create(0, weights=object())


def test_the_hazard_field_has_no_first_phase():
    with pytest.raises(InputError, match="head_epochs = 1: must be 0"):
        replace(PRESET, training=replace(PRESET.training, head_epochs=1))


@pytest.mark.parametrize("total", [1, 7])
def test_a_field_that_diverges_ends_in_one_line_and_its_numbers_are_never_saved(tmp_path, total):
    made = begun(tmp_path)
    step = made._step

    def spoilt(*batch):
        loss = step(*batch)
        if made.position.total == total:  # an update may spoil the state with the loss still a number
            made.state = made.state | {"heads": jax.tree.map(lambda leaf: leaf * np.inf, made.state["heads"])}
        return loss

    made._step = spoilt
    with pytest.raises(InputError, match="that is no number|loss = nan") as raised:
        made.train()
    assert "training stopped; the last checkpoint is kept" in str(raised.value) and "\n" not in str(raised.value)
    if total == 7:
        for which in ("latest", "best"):
            assert all(np.isfinite(array).all() for array in saved_state(tmp_path, which).values())
        assert load_estimator(tmp_path, "latest")
