"""`python -m travjax.experiments.synthetic`: the estimator on synthetic maps, the first half of the paper.

Trains at a preset of the ResNet50 and evaluates on the test maps: the paper's first table beside ours, figures,
and a report. The recorded runs are under experiments/synthetic.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

from travjax import options, progress
from travjax.config import read_text
from travjax.devices import Devices
from travjax.estimators.names import RESNET
from travjax.estimators.preset import Preset
from travjax.evaluation.metrics import OVERALL, PAPER_SYNTHETIC, Confusion, Evaluation
from travjax.evaluation.simulator_benchmark import machine
from travjax.experiments import launch
from travjax.files import find_preset, held, user_path
from travjax.runs.run import Run
from travjax.runs.run_log import read_rows
from travjax.signals import going_on
from travjax.training.evaluation_report import evaluate_run
from travjax.training.fit import fit

DESCRIPTION = (
    "Makes synthetic maps, trains the estimator on them and evaluates it on maps that it has not seen: the first half "
    "of the paper. A run that was interrupted goes on."
)

EVALUATION = ("predictions", "precision_recall", "reliability")
TRAINING = ("training", "inputs")
"""Names of figures in the order of the report."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the experiment; returns the exit code, 2 for bad input."""
    parser = launch.parser("synthetic", DESCRIPTION)
    parser.add_argument(
        "preset",
        nargs="?",
        default="laptop",
        metavar="PRESET",
        help="smoke, laptop, workstation or paper, or a .toml file (laptop)",
    )
    options.add_run(parser)
    parser.add_argument(
        "--out", type=user_path, metavar="DIR", help="folder to write to (runs/synthetic/ and the preset's name)"
    )
    return launch.launch(parser, run, argv)


def run(arguments: argparse.Namespace) -> None:
    """Trains unless that is done, evaluates, and writes the report."""
    path = find_preset(arguments.preset, RESNET)
    wanted = options.run_of(Preset.load(path), arguments)
    folder = arguments.out or Path("runs/synthetic") / path.stem
    with held(folder), going_on(launch.GOES_ON):
        fit(wanted, folder, Devices.all(), resume=True)
        scores = evaluate_run(folder, out=folder / "evaluation")
        progress.wrote(
            launch.write_report(folder, f"Synthetic maps, preset {path.stem}", _pieces(wanted, scores, folder))
        )


def _pieces(wanted: Run, scores: Evaluation, folder: Path) -> list[launch.Piece]:
    """Returns the texts and figures of the report."""
    epochs = [row for row in read_rows(folder / "metrics.jsonl") if type(row.get("samples_per_s")) in (int, float)]
    steps = [f"{row['step']:,} steps, {row['samples_per_s']:,.0f} samples/s in the last epoch" for row in epochs[-1:]]
    trained = (
        f"{wanted.robot.name}, {len(wanted.actions)} trajectories a map; {wanted.preset.dataset.maps:,} maps; "
        f"{''.join(steps) or 'steps are not recorded'} on {machine()}."
    )
    places = [folder / "evaluation" / f"{name}.png" for name in EVALUATION]
    places += [folder / f"{name}.png" for name in TRAINING]
    figures = [path for path in places if path.exists()]
    return [
        trained,
        *_beside_the_paper(wanted, scores.scores[OVERALL].confusion),
        "## Tables",
        launch.verbatim(read_text(folder / "evaluation" / "tables.txt").strip()),
        "## Figures",
        *figures,
        "## Configuration",
        launch.verbatim(read_text(folder / "run.json").strip(), "json"),
    ]


def _beside_the_paper(wanted: Run, ours: Confusion) -> list[str]:
    """Returns one line on all events pooled, if robot and action space are the paper's."""
    if not wanted.setup.as_in_paper:
        return []
    shown = lambda value: "-" if math.isnan(value) else f"{value:.3f}"
    paper = PAPER_SYNTHETIC[OVERALL]
    pairs = {
        "recall": (ours.recall, paper.recall),
        "precision": (ours.precision, paper.precision),
        "F1": (ours.f1, paper.f1),
    }
    figures = ", ".join(f"{name} {shown(one)} ({shown(other)})" for name, (one, other) in pairs.items())
    return [f"Over the three events, the paper's in brackets: {figures}. Its maps and robot are not published in full."]


if __name__ == "__main__":
    raise SystemExit(main())
