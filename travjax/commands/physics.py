"""`travjax physics`: trajectories driven in a physics engine."""

import argparse
from dataclasses import asdict

from travjax import options, progress
from travjax.config import require


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "physics",
        help="drive trajectories in a physics engine (MuJoCo)",
        description="Drives random trajectories of synthetic maps, or of the windows of elevation maps, in MuJoCo, and "
        "says how they fail: labels of a declared physics model, not ground truth. The robot's file needs [physics].",
    )
    options.add_maps(parser)
    options.add_synthetic(parser, count=5, each="maps in all, the styles in turn")
    options.add_dem(parser, stride=8.0)
    options.add_robot(parser)
    options.add_grid(parser)
    parser.add_argument("--check", action="store_true", help="only check the model against the robot's data sheet")
    parser.add_argument(
        "--trajectories", type=int, default=40, metavar="N", help="known trajectories driven on each map (40)"
    )
    parser.add_argument("--processes", type=int, metavar="N", help="processes that drive (the number of cores)")
    options.add_out(parser, "runs/physics")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Checks the model, drives, and writes the outcomes; exit code 1 when the model fails its check."""
    from travjax.evaluation.tables import rows_table
    from travjax.physics.check import check, passed
    from travjax.physics.report import drive_maps
    from travjax.simulation.robot import Robot

    require(arguments.trajectories > 0, "--trajectories", arguments.trajectories, "at least 1")
    physics = Robot.load_physics(arguments.robot)
    setup = options.setup(arguments)
    checks = check(setup.robot, physics)
    rows = [asdict(one) | {"passed": "yes" if one.passed else "NO"} for one in checks]
    progress.say(rows_table(rows))
    if not passed(checks):
        progress.say("The model does not do what the data sheet says: nothing is driven.")
        raise SystemExit(1)
    if not arguments.check:
        maps = options.maps(arguments, setup.grid)
        drive_maps(maps, setup, physics, arguments.trajectories, arguments.out, arguments.processes)
