"""`python -m travjax.experiments.navigation`: which way to judge motions brings a robot to its goal.

Tasks are planned on the map that a sensor saw and driven on the true one, by the exact simulator on maps as they are
and filtered, by a geometric cost map, and by the hazard field.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from travjax import progress
from travjax.config import InputError, from_json, read_json, require, to_json
from travjax.data.sensor_noise import FILTERS
from travjax.evaluation import map_figures
from travjax.experiments import launch
from travjax.experiments.robustness import BenchmarkMaps
from travjax.experiments.robustness_scores import best_filters
from travjax.files import find_preset, held, output_folder, save_text, user_path
from travjax.navigation import scores
from travjax.navigation.tasks import NavigationConfig, grounds, tasks_on
from travjax.navigation.trials import Trial, trials_on
from travjax.runs.predictor import Predictor
from travjax.signals import going_on

DESCRIPTION = (
    "Plans tasks on the map that a sensor saw and drives the paths on the true one: how often the robot arrives, fails "
    "on the way, or finds no path, by the exact simulator, a geometric cost map and the hazard field. A run that was "
    "interrupted goes on."
)

MEANING = (
    "A task leads from a place to another, between which the exact planner finds a path on the true map. A path "
    "*arrives* if no pose of it exceeds a limit of the robot on the true map; *length* is that of paths that arrived "
    "over that of the best path, which is the cheapest one, its risk included, and not always the shortest. Intervals "
    "are Wilson's. Missing nodes have the height of the nearest known one, for every method. The best filter is that "
    "of none, a 3 x 3 median and Gaussians that gives the simulator the largest F1 on other maps with the same "
    "corruption."
)

DONE = "trials.json"
"""Name of the file with the trials so far."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the experiment; returns the exit code, 2 for bad input."""
    parser = launch.parser("navigation", DESCRIPTION)
    parser.add_argument(
        "preset", nargs="?", default="laptop", metavar="PRESET", help="smoke or laptop, or a .toml file (laptop)"
    )
    parser.add_argument(
        "--field",
        type=user_path,
        metavar="C",
        help="folder of a run, or .safetensors file, of a hazard field (the package's)",
    )
    parser.add_argument(
        "--out", type=user_path, metavar="DIR", help="folder to write to (runs/navigation/ and the preset's name)"
    )
    return launch.launch(parser, run, argv)


def run(arguments: argparse.Namespace) -> None:
    """Runs all trials, and writes tables, figure, JSON and the report."""
    preset = find_preset(arguments.preset, "navigation")
    config, field = NavigationConfig.load(preset), Predictor.load(arguments.field)
    field.require_trained_for(config.true_robot, contact=config.contact)
    out = output_folder(arguments.out or Path("runs/navigation") / preset.stem)
    with held(out), going_on(launch.GOES_ON):
        trials, chosen = _trials(config, field, out)
        _write(trials, chosen, config, out)


def _trials(config: NavigationConfig, field: Predictor, out: Path) -> tuple[list[Trial], Mapping[str, str]]:
    """Returns the trials, those of an earlier run with the same settings included, and the chosen filters."""
    settings = {"config": to_json(config), "field": field.run.setup.to_json()}
    trials, chosen = _earlier(out / DONE, settings) if (out / DONE).is_file() else ([], {})
    if not chosen:
        maps = BenchmarkMaps.synthetic(config.validation, config.seed - 1000, field.run.setup)
        chosen = best_filters(maps, config.seed)
    finished = {(one.kind, one.ground, one.corruption) for one in trials}
    for ground in grounds(config):
        wanted = [name for name in config.corruptions if (ground.kind, ground.number, name) not in finished]
        tasks = tasks_on(ground, config) if wanted else []
        for corruption in wanted:
            what = f"{ground.kind} {ground.number}, {corruption}"
            with progress.bar(what, len(tasks) * len(scores.METHODS), "trial") as bar:
                trials += trials_on(ground, tasks, corruption, chosen[corruption], config, field, bar.update)
            rows = [one.to_json() for one in trials]
            save_text(out / DONE, json.dumps(settings | {"filters": chosen, "trials": rows}, indent=1) + "\n")
    if not trials:
        raise InputError("tasks: no ground has a task; allowed: a smaller `least`, or other ground")
    return trials, chosen


def _earlier(file: Path, settings: dict) -> tuple[list[Trial], dict[str, str]]:
    """Returns the trials of an earlier run and its filters; raises InputError for other settings and damaged files."""
    saved = read_json(file)
    names = {*settings, "filters", "trials"}
    require(isinstance(saved, dict) and saved.keys() == names, str(file), type(saved).__name__, "results of navigation")
    same = {name: saved[name] for name in settings} == json.loads(json.dumps(settings))
    require(same, "--out", str(file.parent), "a folder without results of other settings")
    filters, rows = saved["filters"], saved["trials"]
    corruptions = settings["config"]["corruptions"]
    known = isinstance(filters, dict) and all(filters.get(name) in FILTERS for name in corruptions)
    require(known, f"{file}: filters", filters, "a filter for each corruption")
    require(isinstance(rows, list), f"{file}: trials", type(rows).__name__, "a list")
    try:
        return [from_json(row, Trial, file) for row in rows], filters
    except InputError as error:
        raise InputError(f"{file}: trials: {error}") from None


def _write(trials: list[Trial], chosen: Mapping[str, str], config: NavigationConfig, out: Path) -> None:
    pieces: list[launch.Piece] = [MEANING]
    drawn = map_figures.save(scores.figure(trials, config.corruptions), out / "navigation.png")
    pieces.append(drawn)
    for kind in dict.fromkeys(one.kind for one in trials):
        text = scores.table(trials, kind, config.corruptions)
        progress.say(f"\n{kind}\n{text}\n")
        pieces += [f"## {kind}", launch.verbatim(text), scores.winners(trials, kind, config.corruptions)]
    filters = "\n".join(f"- {name}: {chosen[name]}" for name in config.corruptions)
    pieces += ["## Filters", filters]
    progress.wrote(drawn, out / DONE, launch.write_report(out, "Navigation", pieces))


if __name__ == "__main__":
    raise SystemExit(main())
