"""Trains a small hazard field, and compares it with the simulator on noisy maps.

    python examples/train_field.py

It takes a minute or two on two cores: 300 maps are far too few for a good field, and the one that comes with travjax
is shown beside it. After what training prints, it prints

    F1 on 20 maps with 3 cm of noise, against the labels of the clean maps
    simulator             0.211
    field, just trained   0.536
    field of the package  0.807
"""

from pathlib import Path

import numpy as np

import travjax
from travjax.data.sensor_noise import noisy

NOISE = 0.03
"""Metres, standard deviation of the noise at each node."""


def f1(predicted: np.ndarray, failed: np.ndarray) -> float:
    """Returns F1 over the three events."""
    return 2 * (predicted & failed).sum() / (predicted.sum() + failed.sum())


def main(preset: str = "smoke", out: str = "runs/examples/field", maps: int = 20) -> None:
    """Trains a preset of the hazard field into a folder, and prints F1 on noisy maps."""
    if not Path(out, "training.png").exists():
        travjax.fit(travjax.run_from_preset(preset, model="field"), out, resume=True)
    clean = np.asarray(travjax.generate_terrain("rough", range(9000, 9000 + maps)))
    noise = np.random.default_rng(0)
    seen = noisy(clean, NOISE, noise)
    failed = np.asarray(travjax.label(clean))
    print(f"F1 on {maps} maps with {100 * NOISE:.0f} cm of noise, against the labels of the clean maps")
    print(f"simulator             {f1(np.asarray(travjax.label(seen)), failed):.3f}")
    for name, source in (("field, just trained", out), ("field of the package", None)):
        print(f"{name:<22}{f1(travjax.Predictor.load(source).predict(seen).probability >= 0.5, failed):.3f}")


if __name__ == "__main__":
    main()
