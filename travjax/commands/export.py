"""`travjax export`: a training run's estimator as one file, with its model card."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from travjax.commands import options
from travjax.config import InputError, read_text
from travjax.estimators.names import FIELD
from travjax.files import first_lines, require_replaceable, save_text, user_path
from travjax.progress import wrote

if TYPE_CHECKING:
    from travjax.runs.run import Run

PURPOSE = (
    "Predicts which trajectories of a wheeled robot fail on an elevation map, and by which event: step, obstacle, tilt."
)
"""The sentence after the title of a card."""


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "export",
        help="write a trained estimator to one file",
        description="Writes the estimator of a training run to one .safetensors file, which `travjax predict "
        "--checkpoint` takes, and beside it a model card: what it was trained on, and the tables of its evaluation. "
        "Replaces no other file.",
    )
    parser.add_argument("folder", type=user_path, metavar="RUN", help="folder of a training run")
    parser.add_argument("--checkpoint", default="best", metavar="C", help="best or latest (best)")
    parser.add_argument("--to", type=user_path, required=True, metavar="FILE", help=".safetensors file to write")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Writes the file and the card."""
    from travjax.runs.model_file import SUFFIX, write_model
    from travjax.runs.run import load_estimator

    if arguments.to.suffix != SUFFIX:
        raise InputError(f"--to {arguments.to}: must be a {SUFFIX} file")
    beside = arguments.to.with_suffix(".md")
    require_replaceable(arguments.to, _is_model, f"--to {arguments.to}", "estimator")
    require_replaceable(beside, _is_card, f"--to {arguments.to}", "model card")
    trained, network, meta = load_estimator(arguments.folder, arguments.checkpoint)
    position = meta["position"]
    notes = {"dataset": meta["dataset"], "epoch": position["epoch"], "step": position["total"]}
    write_model(arguments.to, trained, network, notes)
    tables, real = (_text(arguments.folder / name) for name in ("evaluation/tables.txt", "comparison/sites.txt"))
    wrote(arguments.to, save_text(beside, card(trained, notes, arguments.to.name, tables, real)))


def _is_model(path: Path) -> bool:
    """Whether travjax wrote a .safetensors file."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as file:
            return "travjax" in (file.metadata() or {})
    except (SafetensorError, OSError):
        return False


def _is_card(path: Path) -> bool:
    """Whether a file is a model card of this command."""
    return PURPOSE in first_lines(path, 3)


def _text(path: Path) -> str | None:
    return read_text(path).strip() if path.exists() else None


def card(trained: "Run", notes: dict, name: str, tables: str | None, real: str | None) -> str:
    """What the estimator is for, how it was made, how good it is, and for a hazard field where it is worth using.

    notes:  of the model file
    name:   of the model file
    tables: of `travjax evaluate`, if it was run
    real:   the table of real ground of the comparison, if it was run
    """
    import jax

    preset, grid = trained.preset, trained.grid
    seen, field = preset.corruption, preset.model == FIELD
    parameters = sum(leaf.size for leaf in jax.tree.leaves(trained.template(0)))
    measured = tables or "not evaluated: `travjax evaluate` writes the tables"
    corrupted = (
        f"| corrupted | {seen.share:.0%} of the maps: noise up to {seen.noise:g} m, missing nodes, half resolution |\n"
    )
    beside_simulator = _beside_simulator(real)
    margins = "Regressed margins are not told apart above four times a limit. "
    data = f"{preset.dataset.maps:,} synthetic maps of seed {preset.dataset.seed}"
    return f"""# {name}

{PURPOSE}

| | |
|---|---|
| estimator | {preset.model}, {parameters:,} parameters |
| robot | {trained.robot.name}; another one needs training: `travjax train PRESET --robot FILE` |
| maps | {grid.size:g} x {grid.size:g} m at {grid.spacing:g} m, {len(trained.actions)} trajectories |
| trained on | {data} (fingerprint {notes["dataset"]}), seed {preset.training.seed}, {notes["step"]:,} steps |
{corrupted * field}
## Evaluation

```
{measured}
```
{beside_simulator * field}
Limits: labels are those of a kinematic simulator on synthetic terrain, without friction, dynamics or soft ground.
{margins * field}Do not let it drive a robot unwatched.
"""


def _beside_simulator(table: str | None) -> str:
    """The card's section on where a hazard field is worth using, as the simulator takes the same maps."""
    command = "python -m travjax.experiments.comparison --ground real --field RUN --out RUN/comparison"
    measured = f"```\n{table}\n```" if table else f"Not measured: `{command}` does it; `--sites` takes ground of yours."
    return f"""
## Beside the simulator, on real ground

On a clean map the simulator (`travjax label`) is exact. A noisy map can be smoothed before it is simulated. Whether the
simulator or this estimator is then nearer to the labels of the clean map depends on the ground and on the noise.

{measured}
"""
