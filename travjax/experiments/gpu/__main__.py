"""`python -m travjax.experiments.gpu`: all that a GPU is wanted for, in the order of worth, in a given time.

Measures the kernels, trains and evaluates the hazard field and the ResNet50, and transfers that to other ground. What
is not finished goes on with the same command. All that is small lies in the folder, the rest in its sub-folder work.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import jax

from travjax import progress
from travjax.config import InputError, one_line, require_number
from travjax.estimators.names import FIELD, RESNET
from travjax.estimators.preset import find_weights
from travjax.evaluation.simulator_benchmark import machine
from travjax.evaluation.tables import rows_table
from travjax.experiments import launch
from travjax.experiments.gpu import estimate
from travjax.experiments.gpu.config import BENCH, PARTS, TRANSFER, Plan
from travjax.experiments.gpu.kernels import COLUMNS
from travjax.experiments.gpu.limits import FORMULA
from travjax.experiments.gpu.parts import RESULTS, WORK, Result, Session, tables
from travjax.files import find_preset, held, output_folder, user_path
from travjax.signals import going_on

DESCRIPTION = (
    "Measures kernels on a GPU, trains the hazard field and the ResNet50 and transfers that, as far as the time goes. "
    "The same command goes on from there."
)

SECONDS = 840
"""A quarter of an hour, less a minute for what comes before and after."""

TITLES = {BENCH: "Kernels", FIELD: "Hazard field", RESNET: "ResNet50", TRANSFER: "Transfer"}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns the exit code, 2 for bad input and where a part failed."""
    parser = launch.parser("gpu", DESCRIPTION)
    parser.add_argument(
        "preset", nargs="?", default="paper", metavar="PRESET", help="paper, smoke, or a .toml file (paper)"
    )
    parser.add_argument("--time", type=float, default=SECONDS, metavar="S", help=f"seconds for all of it ({SECONDS})")
    parser.add_argument(
        "--parts", nargs="+", choices=PARTS, default=PARTS, metavar="PART", help=f"{', '.join(PARTS)} (all)"
    )
    parser.add_argument("--weights", metavar="FILE", help="first weights of the ResNet50, or none for random ones")
    parser.add_argument("--estimate", action="store_true", help="only estimate what a GPU would take; needs none")
    parser.add_argument(
        "--out", type=user_path, metavar="DIR", help="folder to write to (runs/gpu/ and the preset's name)"
    )
    return launch.launch(parser, run, argv)


def run(arguments: argparse.Namespace) -> None:
    """Runs the parts that are not finished, and writes the report after each."""
    end = time.monotonic() + arguments.time
    require_number("--time", arguments.time, 0, 1e6, "seconds above 0")
    plan = Plan.load(find_preset(arguments.preset, "gpu"), arguments.weights)
    if arguments.estimate:
        progress.say(estimate.estimate(plan))
        return
    if RESNET in arguments.parts or TRANSFER in arguments.parts:
        find_weights(plan.runs[RESNET].preset.weights)  # before minutes of work
    out = arguments.out or Path("runs/gpu") / plan.path.stem
    with held(out), going_on(launch.GOES_ON):
        _run(Session.load(plan, output_folder(out)), arguments.parts, end)


def _run(session: Session, parts: Sequence[str], end: float) -> None:
    """Runs parts until the end, a failure of one of them aside, and reports."""
    out, shares = session.out, dict(zip(PARTS, session.plan.config.shares, strict=True))
    failed = []
    progress.say(machine())
    for name in PARTS:
        began = time.monotonic()
        if name not in parts or session.is_finished(name) or began >= end:
            continue
        before = {key: value for key, value in session.results.get(name, {}).items() if key != "failed"}
        progress.say(f"\n{TITLES[name]}, {shares[name] * (end - began):.0f} s")
        try:
            result = session.part(name)(before, began + shares[name] * (end - began))
        except (InputError, jax.errors.JaxRuntimeError, MemoryError) as error:
            said = one_line(error) or "out of memory"
            failed.append(f"{name}: {said}")
            result = session.results.get(name, before) | {"finished": False, "failed": said}
        session.note(name, result | {"seconds": before.get("seconds", 0) + time.monotonic() - began})
        _report(session)
    progress.wrote(*(path for path in (out / "report.md", out / RESULTS) if path.exists()))
    if failed:
        raise InputError("; ".join(failed))


def _report(session: Session) -> None:
    """Writes report.md: what is finished, the benchmark, and the tables of all evaluations."""
    states = "\n".join(_state(name, session.results.get(name)) for name in PARTS)
    pieces: list[launch.Piece] = [f"{machine()}; preset {session.plan.path.stem}.", states]
    if rows := session.results.get(BENCH, {}).get("rows"):
        pieces += [f"## {TITLES[BENCH]}", launch.verbatim(rows_table(rows, COLUMNS)), f"{FORMULA}."]
    for name in PARTS:
        if text := tables(session.out, name):
            pieces += [f"## {TITLES[name]}", text]
    pieces.append(f"Checkpoints are in `{WORK}`.")
    launch.write_report(session.out, "On a GPU", pieces)


def _state(name: str, result: Result | None) -> str:
    """Returns a line on a part: how far it is, seconds over all calls, and what is known of it."""
    if result is None:
        return f"- {TITLES[name]}: not begun"
    state = "failed" if "failed" in result else "finished" if result["finished"] else "to go on"
    kept = {key: value for key, value in result.items() if key not in ("finished", "rows", "seconds")}
    shown = lambda value: f"{value:,.3f}" if isinstance(value, float) else str(value)
    said = "".join(f", {key.replace('_', ' ')} {shown(value)}" for key, value in kept.items())
    return f"- {TITLES[name]}: {state}, {result['seconds']:.0f} s{said}"


if __name__ == "__main__":
    raise SystemExit(main())
