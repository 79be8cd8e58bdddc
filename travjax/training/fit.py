"""Fits an estimator: from a preset to a trained run in a folder; an interrupted run can be resumed."""

import math
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np

from travjax import progress
from travjax.config import InputError, one_line, require
from travjax.data import dataset
from travjax.data.build import build_synthetic
from travjax.data.dataset import Dataset
from travjax.devices import Devices
from travjax.estimators.preset import Preset, find_weights, load_preset
from travjax.evaluation import map_figures, score_figures
from travjax.files import held, output_folder, put_back, user_path
from travjax.jax_flags import usual_flags
from travjax.models.input_images import render_inputs
from travjax.resnet.imagenet_weights import load_weights
from travjax.runs.run import DATA, Run, has_checkpoints
from travjax.runs.run_log import read_rows
from travjax.simulation.setup import Setup
from travjax.training.trainer import Trainer

FEATURES = "features.npz"
"""File in the folder of a run that keeps the features of the frozen trunk while phase 1 lasts."""


def run_from_preset(
    preset: Preset | str | Path,
    *,
    model: str | None = None,
    robot: str | None = None,
    actions: str | Path | None = None,
    size: float = 8.0,
    spacing: float = 0.0625,
    contact: str | None = None,
    turn: bool = True,
    weights: str | None = None,
    seed: int | None = None,
) -> Run:
    """Returns the run of a preset, with any settings that are to differ from it.

    preset:  a preset, its TOML file, or the name of one that comes with travjax, such as "laptop"
    model:   "resnet50" or "field", whose preset a name is, the ResNet's unless given; any other preset must be of it
    robot, actions, size, spacing, contact, turn: as `Setup.load` takes them; the preset's robot unless given
    weights: file of the trunk's first weights, or "none"
    seed:    seed of the data set and of training
    Raises InputError when there is no preset of that name, when a file is missing or wrong, when preset and model, or
    robot, action space and map, do not fit together, and for a seed out of range.
    """
    if isinstance(preset, Preset):
        require(model in (None, preset.model), "model", model, f"{preset.model}, as the preset says")
    else:
        preset = load_preset(preset, model)
    if weights:
        preset = replace(preset, weights=weights)
    if seed is not None:
        preset = replace(
            preset, dataset=replace(preset.dataset, seed=seed), training=replace(preset.training, seed=seed)
        )
    preset = replace(preset, robot=robot or preset.robot)
    return Run(preset, Setup.load(preset.robot, actions, size, spacing, contact, turn))


@usual_flags()
def fit(
    run: Run,
    folder: str | Path,
    devices: Devices | None = None,
    data: str | Path | Dataset | None = None,
    resume: bool = False,
    option: str = "--out",
    until: float = math.inf,
) -> bool:
    """Trains a run in a folder, and prints what it writes there.

    devices: devices to train on, all unless given
    data:    its data set, or the folder of it, instead of one made by the preset
    resume:  whether to resume the run that the folder holds, if it holds one
    option:  what a message calls a folder that holds another run
    until:   `time.monotonic()` after which no step begins; what is done by then is in a checkpoint to resume from
    Returns whether all epochs are trained.
    Raises InputError before training starts when another process works in the folder, when it holds a run that differs
    or is not to be resumed, and when first weights or data set are missing, damaged or do not fit.
    """
    devices, place = devices or Devices.all(), user_path(folder)
    with held(place) if devices.main else nullcontext():
        return _fit(run, place, devices, data, resume, option, until)


def _fit(
    wanted: Run,
    folder: Path,
    devices: Devices,
    data: str | Path | Dataset | None,
    resume: bool,
    option: str,
    until: float,
) -> bool:
    """Trains a run in a folder that no other process uses; returns whether all epochs are trained."""
    resumes = has_checkpoints(folder)
    if resumes:
        wanted = _going_on(folder, wanted, resume, option)
    preset = wanted.preset
    devices.wait()
    file = None if resumes else find_weights(preset.weights)
    weights = load_weights(file, preset.trunk) if file else None
    estimator = None if resumes else wanted.create(preset.training.seed, weights)
    features = folder / FEATURES
    trainer = Trainer(wanted, _dataset(data, wanted, folder, devices), folder, devices, features=features)
    output_folder(folder)
    if devices.main:
        wanted.save(folder)
        progress.say(one_line(trainer.summary()))
    if estimator is None:
        trainer.resume()
    else:
        trainer.start(estimator)
        if devices.main and wanted.kind.sees_images:
            progress.wrote(_draw_inputs(trainer, folder))
    try:
        finished = trainer.train(until)
    finally:
        if devices.main and trainer.position.phase == 2:
            features.unlink(missing_ok=True)  # gigabytes for a large data set, and of no more use
    if devices.main:
        _finish(folder, wanted)
    return finished


def _going_on(folder: Path, wanted: Run, resume: bool, option: str) -> Run:
    """Returns the wanted run with the first weights that the folder's run began with.

    Raises InputError where that would be overwritten, or continued with other settings.
    """
    if not resume:
        raise InputError(f"--out {folder}: holds a training run; allowed: --resume to go on with it, or another folder")
    begun = Run.load(folder)
    begun.require_same_settings(wanted, f"{option} {folder}")
    return replace(wanted, preset=replace(wanted.preset, weights=begun.preset.weights))


def _dataset(data: str | Path | Dataset | None, wanted: Run, folder: Path, devices: Devices) -> Dataset:
    """Returns the given data set, else the run's own, which is made if it does not exist yet."""
    if data:
        return data if isinstance(data, Dataset) else dataset.load(data)
    kept, config = folder / DATA, wanted.preset.dataset
    put_back(kept)
    for split, size in zip(dataset.SPLITS[:2], config.split_sizes()[:2], strict=True):
        require(size > 0, f"the preset's [dataset]: {split} maps", size, "at least 1: more maps, other shares")
    if devices.main and not (kept / "dataset.json").exists():
        build_synthetic(config, wanted.setup, kept)
    devices.wait()
    loaded = dataset.load(kept)
    made_anew = "remove it to have it made anew, or take another --out"
    require(loaded.config == config, f"data set {kept}", loaded.config, f"made from {config}; {made_anew}")
    return loaded


def _draw_inputs(trainer: Trainer, folder: Path) -> Path:
    """Draws the three input channels of a few training samples."""
    samples, data, run = trainer.data.samples(2, 0), trainer.data.dataset, trainer.run
    chosen = np.linspace(0, len(samples[0]) - 1, 4).astype(int)
    maps, trajectories = (index[chosen] for index in samples)
    scale = run.preset.elevation_scale
    images = render_inputs(
        data.heights[maps], np.arange(4), trajectories, run.robot, run.actions, grid=run.grid, elevation_scale=scale
    )
    titles = [
        f"{one_line(group, 30)}, trajectory {index}"
        for group, index in zip(data.group[maps], trajectories, strict=True)
    ]
    return map_figures.save(
        score_figures.input_channels_figure(np.asarray(images), titles, run.grid), folder / "inputs.png"
    )


def _finish(folder: Path, run: Run) -> None:
    """Draws the training figure of the run, and prints where everything was written."""
    rows, events = folder / "metrics.jsonl", run.robot.event_names
    progress.say("")
    for path in (folder / "checkpoints", rows, folder / "tensorboard"):
        progress.wrote(path)
    progress.wrote(map_figures.save(score_figures.training_figure(read_rows(rows), events), folder / "training.png"))
