"""`python -m travjax.experiments.physics`: the contact models against trajectories driven in a physics engine.

Trajectories are sampled by their margins, most where a small change of a limit would matter, on synthetic maps that
nothing was trained on and on windows of a real site; weights undo the sampling. Some are driven again with a little
other friction and start, which says how well any model could agree. The recorded run is experiments/physics.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from travjax import progress
from travjax.config import load_toml, require, require_number
from travjax.data.dem import load_dem
from travjax.data.sensor_noise import filled
from travjax.evaluation import map_figures
from travjax.evaluation.tables import rows_table
from travjax.experiments import launch
from travjax.files import find_data, find_preset, output_folder, save_npz, save_text, user_path
from travjax.physics.agreement import Driven, agreement, by_event, by_margin, event_factors, repeats
from travjax.physics.drive import OUTCOMES, VERSION
from travjax.physics.labelling import Variation, label_physics
from travjax.simulation.contact import CONTACTS
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup
from travjax.terrain.styles import STYLES, generate_terrain
from travjax.traversal.traverse import margins_of

DESCRIPTION = (
    "Drives sampled trajectories in MuJoCo, and compares with them what the contact models call failing. Labels of a "
    "declared physics model, not ground truth."
)

STRATA = ((0.0, 0.7, 0.2), (0.7, 3.0, 0.65), (3.0, np.inf, 0.15))
"""Bounds of the largest margin in limits, and the share of the sample that is drawn between them."""


@dataclass(frozen=True)
class PhysicsExperiment:
    """What is driven.

    robot:        name or TOML file of a robot with a [physics] table
    maps, seed:   synthetic maps, the styles in turn, and the first seed
    site, windows: elevation map, and how many of its windows without unknown ground, spread evenly; "" for none
    trajectories: sampled in all; repeats: share of them that are driven a second time

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    robot: str
    maps: int
    seed: int
    trajectories: int
    site: str = ""
    windows: int = 0
    repeats: float = 0.08

    def __post_init__(self):
        require(self.maps > 0, "maps", self.maps, "at least 1")
        require(self.trajectories > 0, "trajectories", self.trajectories, "at least 1")
        require(self.windows >= 0, "windows", self.windows, "0 or more")
        require_number("repeats", self.repeats, -1e-9, 1, "a share from 0 to 1")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the experiment; returns the exit code, 2 for bad input."""
    parser = launch.parser("physics", DESCRIPTION)
    parser.add_argument("preset", nargs="?", default="laptop", metavar="PRESET", help="smoke, laptop, or a .toml file")
    parser.add_argument("--processes", type=int, metavar="N", help="processes that drive (the number of cores)")
    parser.add_argument(
        "--out", type=user_path, metavar="DIR", help="folder to write to (runs/physics/ and the preset's name)"
    )
    return launch.launch(parser, run, argv)


def run(arguments: argparse.Namespace) -> None:
    """Samples, drives, compares, and writes report and figures; goes on where it was stopped."""
    path = find_preset(arguments.preset, "physics")
    config = load_toml(path, PhysicsExperiment)
    robot, physics = Robot.load(config.robot), Robot.load_physics(config.robot)
    folder = output_folder(arguments.out or Path("runs/physics") / path.stem)
    heights, grounds = _maps(config)
    margins = {contact: _in_limits(heights, robot, contact) for contact in CONTACTS}
    known = np.logical_and.reduce([np.isfinite(one).all(axis=-1) for one in margins.values()])
    sample = _kept_sample(folder, margins["tyre"].max(axis=-1), known, config)
    wanted = sample.wanted(len(heights))
    setup = Setup.chosen(robot, None, Setup(robot).grid)
    rng = np.random.default_rng(config.seed)
    again = [np.sort(rng.permutation(one)[: round(config.repeats * len(one))]) for one in wanted]
    changes = [Variation(float(rng.uniform(0.95, 1.05)), float(rng.uniform(-0.02, 0.02))) for _ in wanted]
    total = sum(map(len, wanted)) + sum(map(len, again))
    with progress.bar("driving", total, "trajectory") as bar:
        first = label_physics(heights, wanted, setup, physics, folder / "driven", arguments.processes, None, bar.update)
        second = label_physics(
            heights, again, setup, physics, folder / "again", arguments.processes, changes, bar.update
        )
    _report(folder, grounds, margins, sample, first, second, setup, heights)


def _maps(config: PhysicsExperiment) -> tuple[np.ndarray, np.ndarray]:
    """Returns maps [n, rows, cols], without unknown nodes, and the name of each one's ground."""
    styles = [STYLES[i % len(STYLES)] for i in range(config.maps)]
    maps = [np.asarray(generate_terrain(styles, range(config.seed, config.seed + config.maps)))]
    grounds = ["synthetic"] * config.maps
    if config.site and config.windows:
        site = find_data(config.site, "site of real ground")
        whole = [one for one in load_dem(site, stride=4.0).heights if np.isfinite(one).mean() > 0.98]
        require(len(whole) > 0, "site", config.site, "a map with windows of known ground")
        chosen = np.unique(np.linspace(0, len(whole) - 1, min(config.windows, len(whole))).round().astype(int))
        maps.append(filled(np.stack([whole[i] for i in chosen])))
        grounds += [site.stem] * len(chosen)
    return np.concatenate(maps), np.array(grounds)


def _in_limits(heights: np.ndarray, robot: Robot, contact: str) -> np.ndarray:
    """Returns each margin as a multiple of its limit, [n, t, k]; NaN where unknown. No point turns: none are driven."""
    margins = margins_of(heights, Setup.chosen(robot, None, Setup(robot).grid, contact, turn=False))
    return np.asarray(margins.events()) / np.asarray(robot.limits)


@dataclass(frozen=True)
class _Sample:
    """Sampled trajectories: of which map, which, and how many trajectories each stands for; [k] sorted by map."""

    map: np.ndarray
    trajectory: np.ndarray
    weight: np.ndarray

    def wanted(self, maps: int) -> list[np.ndarray]:
        """Returns the trajectories of each map."""
        return [self.trajectory[self.map == index] for index in range(maps)]


def _sampled(largest: np.ndarray, known: np.ndarray, config: PhysicsExperiment) -> _Sample:
    """Draws trajectories by their largest margin in limits [n, t]."""
    rng = np.random.default_rng(config.seed)
    weights = np.zeros(largest.shape)
    for low, high, share in STRATA:
        candidates = np.flatnonzero((known & (largest >= low) & (largest < high)).ravel())
        chosen = rng.permutation(candidates)[: round(share * config.trajectories)]
        weights.ravel()[chosen] = len(candidates) / max(len(chosen), 1)
    which, trajectory = np.nonzero(weights)
    return _Sample(which, trajectory, weights[which, trajectory])


def _kept_sample(folder: Path, largest: np.ndarray, known: np.ndarray, config: PhysicsExperiment) -> _Sample:
    """Returns the sample that the folder holds, so that an experiment goes on, or draws one and keeps it there."""
    path = folder / "sampled.npz"
    if not path.exists():
        save_npz(path, **vars(_sampled(largest, known, config)))
    with np.load(path) as kept:
        return _Sample(kept["map"], kept["trajectory"], kept["weight"])


def _report(folder, grounds, margins, sample, first, second, setup, heights) -> None:
    started, names = first.started, setup.robot.event_names
    at = first.map[started], first.trajectory[started]
    driven = {
        contact: Driven(margins[contact][at], first.failed[started], sample.weight[started], at[0])
        for contact in CONTACTS
    }
    on = {ground: grounds[at[0]] == ground for ground in dict.fromkeys(grounds.tolist())}
    rows = [
        {"ground": ground, "contact": contact, "driven": int(here.sum())} | agreement(driven[contact].only(here))
        for ground, here in (on | {"all": np.ones(len(at[0]), bool)}).items()
        for contact in CONTACTS
    ]
    factors = [{"contact": contact} | event_factors(one, names) for contact, one in driven.items()]
    bands = [{"contact": contact} | by_margin(one) for contact, one in driven.items()]
    alone = [{"contact": contact} | by_event(one, names) for contact, one in driven.items()]
    outcomes = {name: float(np.mean(first.outcome == code)) for code, name in enumerate(("arrived", *OUTCOMES))}
    noise = repeats(first, second)
    results: dict[str, Any] = {
        "version": VERSION,
        "scores": rows,
        "factors on limits": factors,
        "share failing by largest margin in limits": bands,
        "share failing where one event fails": alone,
        "repeats": noise,
        "outcomes": outcomes,
    }
    saved = save_text(folder / "results.json", json.dumps(results, indent=1) + "\n")
    kept = save_npz(
        folder / "driven.npz",
        map=at[0],
        trajectory=at[1],
        failed=first.failed[started],
        weight=sample.weight[started],
        outcome=first.outcome[started],
        **{contact: margins[contact][at] for contact in CONTACTS},
    )
    table = rows_table(rows)
    pieces: list[launch.Piece] = [
        f"{len(first.map)} trajectories of {setup.robot.name} on {len(heights)} maps, driven in MuJoCo (controller and "
        f"thresholds version {VERSION}). Shares and scores are weighted by how the sample was drawn. {DESCRIPTION}",
        "## Agreement",
        launch.verbatim(table),
        "*factor* is the factor on all limits that gives the best F1 on this very sample.",
        "## A factor on the limit of each event",
        launch.verbatim(rows_table(factors)),
        "Chosen for the best F1 on every other map; the scores are those on the other maps.",
        "## Share that fails, by the largest margin in limits",
        launch.verbatim(rows_table(bands)),
        "## Share that fails where one event alone exceeds its limit",
        launch.verbatim(rows_table(alone)),
        "## Outcomes, unweighted",
        launch.verbatim(rows_table([outcomes])),
        "## Driven twice, with another friction (5 %) and start (2 cm)",
        launch.verbatim(rows_table([noise])),
        map_figures.save(_bands_figure(bands), folder / "bands.png"),
        map_figures.save(_paths_figure(heights, first, setup, margins), folder / "paths.png"),
    ]
    report = launch.write_report(folder, f"Contact models against a physics engine, {setup.robot.name}", pieces)
    progress.say("\n" + table)
    progress.wrote(saved, kept, report)


def _bands_figure(bands: list[dict]):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3.6), layout="constrained")
    ax = figure.subplots()
    names = [name for name in bands[0] if name != "contact"]
    for row, (colour, marker) in zip(bands, ((map_figures.SAFE, "o"), (map_figures.FAILED, "s")), strict=True):
        ax.plot(names, [row[name] for name in names], color=colour, marker=marker, label=row["contact"])
    ax.axvline(names.index("1 to 1.4") - 0.5, color="gray", linestyle=":", label="limit")
    ax.set(xlabel="largest margin, in limits", ylabel="share that fails in physics", ylim=(0, 1))
    ax.legend(title="contact model")
    return figure


def _paths_figure(heights: np.ndarray, first, setup: Setup, margins: dict[str, np.ndarray], most: int = 4):
    """Draws the driven trajectories of the maps with the most failures, and what the contact models say of them."""
    from matplotlib.figure import Figure

    counts = np.bincount(first.map, weights=first.failed, minlength=len(heights))
    chosen = np.argsort(-counts, kind="stable")[:most]
    figure = Figure(figsize=(9.5, 3.1 * len(chosen)), layout="constrained")
    axes = figure.subplots(len(chosen), 3, squeeze=False, sharex=True, sharey=True)
    for row, index in zip(axes, chosen, strict=True):
        mine = first.map == index
        trajectories = first.trajectory[mine]
        drawn = {"driven": first.failed[mine]}
        drawn |= {contact: margins[contact][index, trajectories].max(axis=-1) > 1 for contact in CONTACTS}
        for ax, (name, failed) in zip(row, drawn.items(), strict=True):
            map_figures.draw_failures(ax, heights[index], setup, trajectories, failed)
            ax.set_title(f"{name}: {failed.mean():.0%} of {len(failed)} fail", fontsize=9)
        row[0].set_ylabel("y, forward [m]")
    for ax in axes[-1]:
        ax.set_xlabel("x, right [m]")
    return figure


if __name__ == "__main__":
    raise SystemExit(main())
