"""What tests of the hazard field share: a tiny preset, runs of it and estimators with random parameters."""

import functools
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from tests import small_training
from tests.small_training import SETUP, dataset
from travjax.data.sensor_noise import CorruptionConfig
from travjax.devices import Devices
from travjax.estimators.preset import EvaluationConfig, Preset, TrainingConfig
from travjax.models.hazard_field import FieldConfig, HazardField, create
from travjax.models.pose_stencil import Stencil
from travjax.models.variables import merge_model, split_model
from travjax.runs.run import Run
from travjax.training.trainer import Trainer

CONFIG = FieldConfig(stem=4, widths=(4, 8), channels=3, hidden=8, momentum=0.5)

PRESET = Preset(
    model="field",
    robot="husky_a200",
    weights="none",
    elevation_scale=0.1,
    dataset=small_training.PRESET.dataset,
    field=CONFIG,
    corruption=CorruptionConfig(0.5, 0.02, 0.2, 0.5),
    training=TrainingConfig(
        optimizer="adamw",
        batch_size=4,
        head_epochs=0,
        epochs=2,
        learning_rate=1e-2,
        max_grad_norm=1.0,
        trajectories_per_map=6,
        checkpoint_steps=2,
        validation_samples=40,
    ),
    evaluation=EvaluationConfig(),
)
"""18 training maps, so 5 steps an epoch, the last of which is filled up."""

RUN = Run(PRESET, SETUP)


def random_variables(seed: int = 0):
    """What is fixed of a tiny estimator, and variables that are random where `create` has zeros and ones."""
    graph, variables = split_model(create(CONFIG, seed))
    rng = np.random.default_rng(seed)
    # Scales and variances have to be positive; kernels are random already.
    moved = lambda leaf: leaf + rng.uniform(0, 0.3, leaf.shape).astype(np.float32) if leaf.ndim == 1 else leaf
    return graph, jax.tree.map(moved, variables)


@functools.cache
def estimator(seed: int = 0) -> HazardField:
    """A tiny one with random parameters and statistics, not to be changed."""
    return merge_model(*random_variables(seed))


@functools.partial(jax.jit, static_argnums=0)
def _forward(graph, variables, elevation, stencil):
    return merge_model(graph, variables)(elevation, stencil)


def forward(field: HazardField, elevation, stencil: Stencil):
    """Logits and margins, in one piece of code: the same operations one by one take seconds to compile."""
    return _forward(*split_model(field), elevation, stencil)


def trainer(folder: Path, run: Run = RUN, **training) -> Trainer:
    """A trainer that has not begun."""
    folder.mkdir(parents=True, exist_ok=True)
    preset = replace(run.preset, training=replace(run.preset.training, **training))
    run = replace(run, preset=preset)
    run.save(folder)
    return Trainer(run, dataset(), folder, Devices.all(), quiet=True)


def begun(folder: Path, **training) -> Trainer:
    """A trainer that has begun with an estimator of `create`."""
    made = trainer(folder, **training)
    made.start(made.run.create(made.config.seed))
    return made
