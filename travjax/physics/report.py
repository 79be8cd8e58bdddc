"""Drives trajectories of synthetic or real maps, and writes outcomes, a table and a picture."""

from pathlib import Path

import numpy as np

from travjax import progress
from travjax.config import require, to_json
from travjax.data.map_batches import MapStream, joined, labelled, title
from travjax.data.sensor_noise import filled
from travjax.evaluation.tables import rows_table
from travjax.files import output_folder, save_npz, save_text
from travjax.physics.drive import OUTCOMES, VERSION
from travjax.physics.labelling import ARRIVED, label_physics
from travjax.simulation.physics_table import PhysicsConfig
from travjax.simulation.setup import Setup

SHOWN = 4
"""Maps in the picture."""


def drive_maps(
    maps: MapStream, setup: Setup, physics: PhysicsConfig, count: int, out: str | Path, processes: int | None = None
) -> Path:
    """Drives `count` random known trajectories of each map; returns the path of the outcomes.

    Point turns are not driven: a trajectory begins at the start of its first arc. Raises InputError when MuJoCo is
    missing, when no trajectory is known, or when the folder holds outcomes of other settings.
    """
    folder = output_folder(out)
    batch = labelled(joined(list(maps.batches)), setup)
    known, rng = np.asarray(batch["known"]), np.random.default_rng(0)
    require(bool(known.any()), "maps", len(batch["group"]), "such that a trajectory touches known ground only")
    wanted = [np.sort(rng.permutation(np.flatnonzero(row))[:count]) for row in batch["known"]]
    with progress.bar("driving", sum(map(len, wanted)), "trajectory") as bar:
        found = label_physics(
            filled(batch["heights"]), wanted, setup, physics, folder / "driven", processes, on_progress=bar.update
        )
    simulated = np.asarray(batch["failed"].any(axis=-1))[found.map, found.trajectory]
    saved = save_npz(
        folder / "labels_physics.npz",
        **vars(found),
        failed=found.failed,
        start_ok=found.started,
        simulated=simulated,
        heights=batch["heights"],
        group=batch["group"],
        config=setup.to_json_text(files=maps.files, physics=to_json(physics), version=VERSION),
        cell_size=setup.grid.spacing,
    )
    table = _table(batch["group"], found, simulated, setup)
    shares = save_text(folder / "shares.txt", table + "\n")
    progress.say(f"\nWhat became of driven trajectories, {setup.robot.name}:\n{table}\n")
    progress.wrote(saved, shares, _picture(batch, found, setup, folder / "driven.png"))
    return saved


def _table(groups: np.ndarray, found, simulated: np.ndarray, setup: Setup) -> str:
    rows = []
    for group in (*dict.fromkeys(groups.tolist()), "overall"):
        here = np.ones(len(found.map), bool) if group == "overall" else groups[found.map] == group
        if here.any():
            shares = {name or "arrived": f"{np.mean(found.outcome[here] == i):.1%}" for i, name in _names()}
            contact = f"{setup.contact.model}: fail"
            rows.append({"": group, "driven": int(here.sum())} | shares | {contact: f"{simulated[here].mean():.1%}"})
    return rows_table(rows)


def _names() -> list[tuple[int, str]]:
    return list(enumerate((ARRIVED, *OUTCOMES)))


def _picture(batch, found, setup: Setup, path: Path) -> Path:
    """Draws the driven trajectories of a few maps, coloured by what became of them."""
    from matplotlib.figure import Figure

    from travjax.evaluation import map_figures  # matplotlib takes 0.3 s to import

    counts = np.bincount(found.map, weights=found.failed, minlength=len(batch["heights"]))
    chosen = np.argsort(-counts, kind="stable")[:SHOWN]
    figure = Figure(figsize=(3.4 * len(chosen) + 0.4, 3.6), layout="constrained")
    axes = figure.subplots(1, len(chosen), squeeze=False, sharey=True)[0]
    for ax, index in zip(axes, chosen, strict=True):
        mine = (found.map == index) & found.started
        map_figures.draw_failures(ax, batch["heights"][index], setup, found.trajectory[mine], found.failed[mine])
        ax.set_title(f"{title(batch, index)}: {found.failed[mine].sum()} of {mine.sum()} fail", fontsize=9)
        ax.set_xlabel("x, right [m]")
    axes[0].set_ylabel("y, forward [m]")
    return map_figures.save(figure, path)
