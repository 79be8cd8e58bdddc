"""Exports a run's estimator to a file with a model card: what it was trained on, and how good it is."""

from pathlib import Path

import jax
from safetensors import SafetensorError, safe_open

from travjax.config import InputError, read_json, read_text
from travjax.files import first_lines, require_replaceable, save_text, user_path
from travjax.runs.model_file import SUFFIX, write_model
from travjax.runs.run import Run, load_estimator

PURPOSE = (
    "Predicts which trajectories of a wheeled robot fail on an elevation map, and by which event: step, obstacle, tilt."
)
"""The sentence after the title of a card."""


def export_run(folder: str | Path, to: str | Path, checkpoint: str = "best") -> tuple[Path, Path]:
    """Writes the estimator of a training run to one file, and a model card beside it; returns where both are.

    to: .safetensors file; a file that travjax did not write is never replaced
    Raises InputError when the run or its checkpoint is missing or damaged, and when something else is in the way.
    """
    run, path = user_path(folder), user_path(to)
    if path.suffix != SUFFIX:
        raise InputError(f"--to {path}: must be a {SUFFIX} file")
    beside = path.with_suffix(".md")
    require_replaceable(path, _is_model, f"--to {path}", "estimator")
    require_replaceable(beside, _is_card, f"--to {path}", "model card")
    trained, network, meta = load_estimator(run, checkpoint)
    position = meta["position"]
    notes = {"dataset": meta["dataset"], "epoch": position["epoch"], "step": position["total"]}
    text = card(trained, notes, path.name, _tables(run, position["total"]), _text(run / "comparison/sites.txt"))
    write_model(path, trained, network, notes)
    return path, save_text(beside, text)


def _is_model(path: Path) -> bool:
    """Tells whether travjax wrote a .safetensors file."""
    try:
        with safe_open(path, framework="np") as file:
            return "travjax" in (file.metadata() or {})
    except (SafetensorError, OSError):
        return False


def _is_card(path: Path) -> bool:
    """Tells whether a file is a model card."""
    return PURPOSE in first_lines(path, 3)


def _tables(run: Path, step: int) -> str | None:
    """Returns the tables of an evaluation of a run's checkpoint of a step; None where there is none."""
    for path in sorted(run.glob("evaluation*/evaluation.json")):
        found = read_json(path)
        sample = found.get("sample") if isinstance(found, dict) else None
        if isinstance(sample, dict) and sample.get("steps") == step:
            return _text(path.with_name("tables.txt"))
    return None


def _text(path: Path) -> str | None:
    return read_text(path).strip() if path.exists() else None


def card(trained: Run, notes: dict, name: str, tables: str | None, real: str | None) -> str:
    """Returns a model card: what the estimator is for, how it was made, and how good it is.

    notes:  the notes of the model file
    name:   the name of the model file
    tables: the tables of `travjax evaluate`, if it was run
    real:   the comparison's table for real ground, if it was run
    """
    preset, grid = trained.preset, trained.grid
    seen, field = preset.corruption, trained.kind.reads_whole_maps
    parameters = sum(leaf.size for leaf in jax.tree.leaves(trained.template(0)))
    measured = tables or "not evaluated: `travjax evaluate` writes the tables"
    corrupted = beside_simulator = margins = ""
    if field:
        maps = f"{seen.probability:.0%} of the maps: noise up to {seen.noise:g} m, missing nodes, half resolution"
        corrupted = f"| corrupted | {maps} |\n"
        beside_simulator = _beside_simulator(real)
        margins = "Regressed margins are not told apart above four times a limit. "
    data = f"{preset.dataset.maps:,} synthetic maps of seed {preset.dataset.seed}"
    return f"""# {name}

{PURPOSE}

| | |
|---|---|
| estimator | {preset.model}, {parameters:,} parameters |
| robot | {trained.robot.name}; another one needs training: `travjax train PRESET --robot FILE` |
| contact model | {trained.setup.contact.model}; what it predicts are failures of this one |
| maps | {grid.size:g} x {grid.size:g} m at {grid.spacing:g} m, {len(trained.actions)} trajectories |
| trained on | {data} (fingerprint {notes["dataset"]}), seed {preset.training.seed}, {notes["step"]:,} steps |
{corrupted}
## Evaluation

```
{measured}
```
{beside_simulator}
Limits: labels are those of a kinematic simulator on synthetic terrain, without friction, dynamics or soft ground.
{margins}Do not let it drive a robot unwatched.
"""


def _beside_simulator(table: str | None) -> str:
    """Writes the section that compares a hazard field with the simulator, which takes the same maps."""
    command = "python -m travjax.experiments.comparison --ground real --field RUN --out RUN/comparison"
    measured = f"```\n{table}\n```" if table else f"Not measured: `{command}` does it; `--sites` takes ground of yours."
    return f"""
## Beside the simulator, on real ground

On a clean map the simulator (`travjax label`) is exact. A noisy map can be smoothed before it is simulated. Whether the
simulator or this estimator is then nearer to the labels of the clean map depends on the ground and on the noise.

{measured}
"""
