"""`travjax export`: a training run's estimator as one file, with its model card."""

import argparse
from pathlib import Path

from travjax.commands import options
from travjax.config import InputError, read_text
from travjax.files import written_whole
from travjax.models import FIELD


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "export",
        help="write a trained estimator to one file",
        description="Writes the estimator of a training run to one .safetensors file, which `travjax predict "
        "--checkpoint` takes, and beside it a model card: what it was trained on, and the tables of its evaluation.",
    )
    parser.add_argument("folder", type=Path, metavar="RUN", help="folder of a training run")
    parser.add_argument("--checkpoint", default="best", metavar="C", help="best or latest (best)")
    parser.add_argument("--to", type=Path, required=True, metavar="FILE", help=".safetensors file to write")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Writes the file and the card."""
    from travjax.model_file import SUFFIX, write_model
    from travjax.trained import load_estimator

    if arguments.to.suffix != SUFFIX:
        raise InputError(f"--to {arguments.to}: must be a {SUFFIX} file")
    trained, network, meta = load_estimator(arguments.folder, arguments.checkpoint)
    position = meta["position"]
    notes = {"dataset": meta["dataset"], "epoch": position["epoch"], "step": position["total"]}
    write_model(arguments.to, trained, network, notes)
    print(arguments.to)
    card = arguments.to.with_suffix(".md")
    with written_whole(card) as temporary:
        temporary.write_text(_card(arguments.folder, trained, notes, arguments.to.name))
    print(card)


def _card(folder: Path, trained, notes: dict, name: str) -> str:
    """What the estimator is for, how it was made, and how good it is."""
    import jax

    preset, tables = trained.preset, folder / "evaluation" / "tables.txt"
    grid, actions, seen = trained.grid, trained.actions, preset.corruption
    parameters = sum(leaf.size for leaf in jax.tree.leaves(trained.template(0)))
    measured = read_text(tables).strip() if tables.exists() else "not evaluated: `travjax evaluate` writes the tables"
    field = preset.model == FIELD
    corrupted = (
        f"| corrupted | {seen.share:.0%} of the maps: noise up to {seen.noise:g} m, missing nodes, half resolution |\n"
    )
    margins = "Regressed margins are not told apart above four times a limit. "
    data = f"{preset.dataset.maps:,} synthetic maps of seed {preset.dataset.seed}"
    return f"""# {name}

Predicts which trajectories of a wheeled robot fail on an elevation map, and by which event: step, obstacle, tilt.

| | |
|---|---|
| estimator | {preset.model}, {parameters:,} parameters |
| robot | {trained.robot.name}; another one needs training: `travjax train PRESET --robot FILE` |
| maps | {grid.size:g} x {grid.size:g} m at {grid.spacing:g} m, {len(actions)} trajectories |
| trained on | {data} (fingerprint {notes["dataset"]}), seed {preset.training.seed}, {notes["step"]:,} steps |
{corrupted * field}
## Evaluation

```
{measured}
```

Limits: labels are those of a kinematic simulator on synthetic terrain, without friction, dynamics or soft ground.
{margins * field}Do not let it drive a robot unwatched.
"""
