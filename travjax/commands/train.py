"""`travjax train`: trains the estimator from a preset, and goes on with a run that was interrupted."""

import argparse
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from travjax import progress
from travjax.commands import options
from travjax.config import InputError, one_line, require
from travjax.estimators.names import ESTIMATORS, RESNET
from travjax.files import find_preset, held, output_folder, put_back, user_path
from travjax.signals import going_on

if TYPE_CHECKING:
    from travjax.data.dataset import Dataset
    from travjax.devices import Devices
    from travjax.estimators.preset import Preset
    from travjax.runs.run import Run
    from travjax.training.trainer import Trainer


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "train",
        help="train the estimator",
        description="Makes or reads a data set, trains the heads on the frozen trunk, then everything, and keeps "
        "checkpoints, metrics.jsonl, TensorBoard files and a figure in one folder.",
    )
    parser.add_argument(
        "preset",
        nargs="?",
        default="laptop",
        metavar="PRESET",
        help="smoke, laptop or paper, or a .toml file (laptop)",
    )
    parser.add_argument("--model", choices=ESTIMATORS, help="the estimator: of a named preset, one of both (resnet50)")
    add_run(parser)
    parser.add_argument(
        "--data", type=user_path, metavar="DIR", help="data set of `travjax dataset`, instead of one made by the preset"
    )
    parser.add_argument(
        "--resume", action="store_true", help="go on from the latest checkpoint in --out, if there is one"
    )
    parser.add_argument(
        "--out",
        type=user_path,
        metavar="DIR",
        help="folder to write to (runs/train/ or runs/field/, and the preset's name)",
    )
    group = parser.add_argument_group("several processes that train together")
    group.add_argument("--coordinator", metavar="HOST:PORT", help="address of process 0")
    group.add_argument("--processes", type=int, metavar="N", help="how many there are")
    group.add_argument("--process", type=int, metavar="I", help="which of them this is, from 0")
    parser.set_defaults(run=run)


def add_run(parser: argparse._ActionsContainer) -> None:
    """What of a run may differ from its preset; see `run_of`."""
    parser.add_argument("--robot", metavar="R", help="another robot than the preset's: its name or a .toml file")
    parser.add_argument("--actions", type=user_path, metavar="FILE", help=".toml file of an action space (the paper's)")
    options.add_grid(parser)
    parser.add_argument(
        "--weights",
        metavar="FILE",
        help="the trunk's first weights, or none for random ones (ImageNet's: TRAVJAX_DATA, the cache, else fetched)",
    )
    parser.add_argument("--seed", type=int, metavar="S", help="seed of data set and training, instead of the preset's")


def run_of(preset: "Preset", arguments: argparse.Namespace) -> "Run":
    """The run of a preset with what `add_run` lets differ from it."""
    from travjax.runs.run import Run

    if arguments.weights:
        preset = replace(preset, weights=arguments.weights)
    if arguments.seed is not None:
        seed = options.seed(arguments)
        preset = replace(
            preset, dataset=replace(preset.dataset, seed=seed), training=replace(preset.training, seed=seed)
        )
    preset = replace(preset, robot=arguments.robot or preset.robot)
    named = argparse.Namespace(**vars(arguments) | {"robot": preset.robot})
    grid, robot, actions = options.configuration(named)
    return Run(preset, robot, actions, grid)


def run(arguments: argparse.Namespace) -> None:
    """Trains."""
    from travjax.devices import Devices, join
    from travjax.estimators.preset import Preset

    shared = (arguments.coordinator, arguments.processes, arguments.process)
    if any(value is not None for value in shared):
        given = all(value is not None for value in shared)
        require(given, "--coordinator, --processes, --process", shared, "all three or none")
        join(*shared)
    devices = Devices.all()
    path = find_preset(arguments.preset, arguments.model or RESNET)
    preset, data = Preset.load(path), arguments.data
    require(arguments.model in (None, preset.model), "--model", arguments.model, f"{preset.model}, as {path} says")
    wanted = run_of(preset, arguments)
    folder = arguments.out or Path("runs") / ESTIMATORS[preset.model].folder / path.stem
    with going_on("with --resume the same command goes on from the latest checkpoint"):
        train(wanted, folder, devices, data, resume=arguments.resume, option="--resume")
    if devices.main:
        print(f"\n{one_line(f'Next: travjax evaluate {folder}' + (f' --data {data}' if data else ''))}")


def train(
    wanted: "Run",
    folder: Path,
    devices: "Devices",
    data: Path | None = None,
    resume: bool = False,
    option: str = "--out",
) -> None:
    """Trains a run in a folder, and says what it writes there.

    data:   folder of its data set, instead of one made by the preset
    resume: goes on with the run that the folder holds, if it holds one
    option: what a message calls a folder that holds another run
    Raises InputError before it trains: another process works in the folder, it holds a run that differs or is not to be
    gone on with, first weights or data set are missing or damaged or do not fit.
    """
    with held(folder) if devices.main else nullcontext():
        _train(wanted, folder, devices, data, resume, option)


def _train(wanted: "Run", folder: Path, devices: "Devices", data: Path | None, resume: bool, option: str) -> None:
    """`train` in a folder that no other process uses."""
    from travjax.estimators.preset import find_weights
    from travjax.resnet.imagenet_weights import load_weights
    from travjax.runs.run import has_checkpoints
    from travjax.training.trainer import Trainer

    preset = wanted.preset
    resumes = has_checkpoints(folder)
    if resumes:
        _check_folder(folder, wanted, resume, option)
    devices.wait()
    file = None if resumes else find_weights(preset.weights)
    weights = load_weights(file, preset.trunk) if file else None
    estimator = None if resumes else wanted.create(preset.training.seed, weights)
    trainer = Trainer(wanted, _dataset(data, wanted, folder, devices), folder, devices)
    output_folder(folder)
    if devices.main:
        wanted.save(folder)
        print(one_line(trainer.summary()))
    if estimator is None:
        trainer.resume()
    else:
        trainer.start(estimator)
        if devices.main and wanted.kind.sees_images:
            progress.wrote(_draw_inputs(trainer, folder))
    trainer.train()
    if devices.main:
        _finish(folder)


def _check_folder(folder: Path, wanted: "Run", resume: bool, option: str) -> None:
    """A run is neither overwritten nor continued with other settings."""
    from travjax.runs.run import Run

    if not resume:
        raise InputError(f"--out {folder}: holds a training run; allowed: --resume to go on with it, or another folder")
    Run.load(folder).require_same_settings(wanted, f"{option} {folder}")


def _dataset(data: Path | None, wanted: "Run", folder: Path, devices: "Devices") -> "Dataset":
    """The data set that is given, else the run's own, made if it is not there yet."""
    from travjax.commands.dataset import made
    from travjax.data import dataset
    from travjax.runs.run import DATA

    if data:
        return dataset.load(data)
    kept, config = folder / DATA, wanted.preset.dataset
    put_back(kept)
    for split, size in zip(dataset.SPLITS[:2], config.split_sizes()[:2], strict=True):
        require(size > 0, f"the preset's [dataset]: {split} maps", size, "at least 1: more maps, other shares")
    if devices.main and not (kept / "dataset.json").exists():
        made(config, wanted.robot, wanted.actions, wanted.grid, kept)
    devices.wait()
    loaded = dataset.load(kept)
    made_anew = "remove it to have it made anew, or take another --out"
    require(loaded.config == config, f"data set {kept}", loaded.config, f"made from {config}; {made_anew}")
    return loaded


def _draw_inputs(trainer: "Trainer", folder: Path) -> Path:
    """The three channels of a few training samples."""
    import numpy as np

    from travjax.evaluation import map_figures, score_figures
    from travjax.models.input_images import render_inputs

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


def _finish(folder: Path) -> None:
    """The figure of the run, and where everything is."""
    from travjax.evaluation import map_figures, score_figures
    from travjax.runs.run import Run
    from travjax.runs.run_log import read_rows

    rows, events = folder / "metrics.jsonl", Run.load(folder).robot.event_names
    progress.say("")
    for path in (folder / "checkpoints", rows, folder / "tensorboard"):
        progress.wrote(path)
    progress.wrote(map_figures.save(score_figures.training_figure(read_rows(rows), events), folder / "training.png"))
