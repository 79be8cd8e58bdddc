"""An estimator of one's own is one class and one entry; trainer, evaluator and predictor take it from there."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from tests.commandline import FEW
from tests.small_training import PRESET, SETUP, dataset, require_equal, rows_of, saved_state
from travjax.config import InputError
from travjax.devices import Devices
from travjax.estimators.inference import over_samples
from travjax.estimators.kind import EstimatorKind, Phase
from travjax.estimators.names import ESTIMATORS, Entry
from travjax.estimators.trajectory_samples import TrajectorySamples
from travjax.jax_flags import key_of
from travjax.models.input_images import elevation_channel
from travjax.models.variables import merge_model
from travjax.runs.evaluator import Evaluator
from travjax.runs.model_file import write_model
from travjax.runs.predictor import Predictor
from travjax.runs.run import Run, load_estimator
from travjax.training.trainer import Trainer

# ---- The estimator: all that is to be written


class Pooled(nnx.Module):
    """A linear layer on the map's elevation in 4 x 4 places, with weights of each trajectory's own."""

    def __init__(self, trajectories: int, rngs: nnx.Rngs):
        self.heads = nnx.Linear(16, 3 * trajectories, rngs=rngs)

    def __call__(self, elevation, map_index, trajectory_index):
        pooled = jax.image.resize(elevation[map_index], (len(map_index), 4, 4), "linear").reshape(-1, 16)
        logits = self.heads(pooled).reshape(len(map_index), -1, 3)
        return logits[jnp.arange(len(map_index)), trajectory_index]


def loss(network, inputs, failed, key):
    return optax.sigmoid_binary_cross_entropy(network(*inputs), failed).sum(axis=-1)


@partial(jax.jit, static_argnames="graph")
def logits(graph, variables, elevation, map_index, trajectory_index):
    return merge_model(graph, variables)(elevation, map_index, trajectory_index)


class PooledEstimator(EstimatorKind):
    phases = {2: Phase(("heads",), loss)}

    def create(self, preset, robot, seed=0, weights=None):
        return Pooled(len(FEW), nnx.Rngs(key_of(seed)))

    def source(self, preset, heights, setup, on_progress=lambda count: None):
        return elevation_channel(heights, preset.elevation_scale)

    def data(self, preset, dataset):
        return TrajectorySamples(dataset, preset.training)

    def logits(self, placed, samples, batch_size, on_progress=lambda count: None):
        return over_samples(logits, placed, samples, batch_size, on_progress)


@pytest.fixture(scope="module", autouse=True)
def entry():
    """The entry, which an estimator of the package has in names.py."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ESTIMATORS, "pooled", Entry(f"{__name__}:PooledEstimator", folder="pooled"))
        yield


# ---- What comes of it


@pytest.fixture(scope="module")
def run(entry) -> Run:
    training = replace(PRESET.training, head_epochs=0, epochs=6, learning_rate=0.05, resample_each_epoch=False)
    return Run(replace(PRESET, model="pooled", training=training), SETUP)


@pytest.fixture(scope="module")
def folder(run, tmp_path_factory):
    """The folder of a finished run."""
    folder = tmp_path_factory.mktemp("pooled")
    run.save(folder)
    trainer = Trainer(run, dataset(), folder, Devices.all(), quiet=True)
    trainer.start(run.create(seed=0))
    trainer.train()
    return folder


def test_its_loss_falls(folder):
    losses = [row["loss"] for row in rows_of(folder) if "validation_loss" in row]
    assert len(losses) == 6 and losses[-1] < 0.7 * losses[0]


def test_an_interrupted_run_goes_on_bit_for_bit(folder, run, tmp_path):
    def interrupted(step, *arguments):
        save(step, *arguments)
        if step == 10:
            raise KeyboardInterrupt

    first, again = (Trainer(run, dataset(), tmp_path, Devices.all(), quiet=True) for _ in range(2))
    save, first.checkpoints.save = first.checkpoints.save, interrupted
    first.start(run.create(seed=0))
    with pytest.raises(KeyboardInterrupt):
        first.train()
    again.resume()
    again.train()
    require_equal(saved_state(tmp_path), saved_state(folder))


def test_it_is_evaluated_and_predicts_like_others(folder, tmp_path):
    run, network, meta = load_estimator(folder, "latest")
    evaluator = Evaluator.from_run(run, dataset(), Devices.all())
    samples = evaluator.samples(0, 0)
    probability = evaluator.probabilities(network, samples)
    assert evaluator.scores(probability, samples, [0.9]).samples == len(samples[0])
    write_model(tmp_path / "pooled.safetensors", run, network, {})
    found = Predictor.load(tmp_path / "pooled.safetensors").predict(dataset().heights)
    assert found.margins is None
    np.testing.assert_allclose(found.probability[samples], probability, atol=1e-6)
    assert (meta["optimizer"], meta["position"]["phase"]) == (2, 2)


def test_it_has_the_phases_that_it_names(run):
    with pytest.raises(InputError, match=r"head_epochs = 1: must be 0: the estimator has no frozen trunk"):
        replace(run.preset, training=replace(run.preset.training, head_epochs=1))
    with pytest.raises(InputError, match=r"phase of the estimator = 1: must be one of \[0, 2\]"):
        run.template(1)


def test_a_model_without_an_entry_is_refused_with_those_that_there_are(run):
    with pytest.raises(InputError, match="model = 'pool': must be one of resnet50, field, pooled"):
        replace(run.preset, model="pool")
