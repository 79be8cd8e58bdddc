"""`travjax train`: trains the estimator from a preset, and goes on with a run that was interrupted."""

import argparse
from pathlib import Path

from travjax import options
from travjax.config import one_line, require
from travjax.estimators.names import ESTIMATORS
from travjax.files import user_path
from travjax.signals import going_on


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "train",
        help="train the estimator",
        description="Makes or reads a data set, trains on it, of the ResNet50 first the heads, and keeps "
        "checkpoints, metrics.jsonl, TensorBoard files and a figure in one folder.",
    )
    parser.add_argument(
        "preset",
        nargs="?",
        default="laptop",
        metavar="PRESET",
        help="smoke, laptop, workstation (ResNet50 only) or paper, or a .toml file (laptop)",
    )
    parser.add_argument("--model", choices=ESTIMATORS, help="the estimator: of a named preset, one of both (resnet50)")
    options.add_run(parser)
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


def run(arguments: argparse.Namespace) -> None:
    """Trains, alone or as one of several processes."""
    from travjax.devices import Devices, join
    from travjax.estimators.preset import load_preset
    from travjax.training.fit import fit

    shared = (arguments.coordinator, arguments.processes, arguments.process)
    if any(value is not None for value in shared):
        given = all(value is not None for value in shared)
        require(given, "--coordinator, --processes, --process", shared, "all three or none")
        join(*shared)
    devices = Devices.all()
    preset, data = load_preset(arguments.preset, arguments.model), arguments.data
    wanted = options.run_of(preset, arguments)
    folder = arguments.out or Path("runs") / ESTIMATORS[preset.model].folder / Path(arguments.preset).stem
    with going_on("with --resume the same command goes on from the latest checkpoint"):
        fit(wanted, folder, devices, data, resume=arguments.resume, option="--resume")
    if devices.main:
        print(f"\n{one_line(f'Next: travjax evaluate {folder}' + (f' --data {data}' if data else ''))}")
