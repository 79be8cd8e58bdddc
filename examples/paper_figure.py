"""Reproduces the paper's qualitative figure: what an estimator predicts of each trajectory, above what happens.

    python examples/paper_figure.py

It writes runs/examples/paper_figure.png, a row of predictions by the hazard field of the package and a row of labels
for each map, and prints

    mountain_crater  26.5 % fail,  96.0 % are predicted right
    rough            38.0 % fail,  94.2 % are predicted right
    runs/examples/paper_figure.png
"""

from pathlib import Path

import numpy as np

import travjax
from travjax.evaluation.map_figures import predicted_maps, save
from travjax.simulation.setup import Setup

MAPS = {"mountain_crater": 30, "rough": 9}
"""Styles of the maps and their seeds."""


def main(every: int = 3) -> Path:
    """Draws every so many trajectories on the maps; returns the picture."""
    heights = np.asarray(travjax.generate_terrain(list(MAPS), list(MAPS.values())))
    margins = travjax.simulate(heights)
    failed = np.asarray(travjax.failures(margins))
    probability = np.asarray(travjax.predict(heights))
    for style, truth, predicted in zip(MAPS, failed, probability >= 0.5, strict=True):
        agree = (truth == predicted).all(axis=-1).mean()
        print(f"{style:<16}{100 * truth.any(axis=-1).mean():5.1f} % fail, {100 * agree:5.1f} % are predicted right")

    figure = predicted_maps(
        heights,
        {"predicted": probability[:, ::every]},
        failed[:, ::every],
        np.asarray(margins.known)[:, ::every],
        list(MAPS),
        Setup(travjax.Robot.load("seekur_jr")),
        every=every,
    )
    Path("runs/examples").mkdir(parents=True, exist_ok=True)
    return save(figure, Path("runs/examples/paper_figure.png"))


if __name__ == "__main__":
    print(main())
