"""Costs of a site as maps of Nav2's map server: an image and a YAML file for each (SPEC section 13).

A raw map is a PGM of 0 to 100, and 255 where unknown. Its twin in scale mode is a PNG, dark where the cost is high and
transparent where unknown. Row 0 of an image is the northernmost.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from travjax.files import atomic_write, output_folder, save_text
from travjax.site.costs import UNKNOWN_COST
from travjax.site.geotiff import Frame

Image.MAX_IMAGE_PIXELS = None


def save_nav2(folder: Path, maps: Mapping[str, UInt8[np.ndarray, "r c"]], frame: Frame) -> list[Path]:
    """Writes maps by name, each in raw and in scale mode; returns the YAML files.

    maps: costs, UNKNOWN_COST where unknown, row 0 in the north
    """
    output_folder(folder)
    files = []
    for name, values in maps.items():
        files += [_raw(folder, name, values, frame), _scale(folder, name, values, frame)]
    return files


def over_headings(costs: UInt8[np.ndarray, "h r c"]) -> dict[str, UInt8[np.ndarray, "r c"]]:
    """Returns the worst, best and mean cost of each place over its known headings, rows in the same order."""
    rows, cols = costs.shape[1:]
    maps = {name: np.empty((rows, cols), np.uint8) for name in ("worst", "best", "mean")}
    for top in range(0, rows, 256):
        strip = np.asarray(costs[:, top : top + 256])
        known = strip != UNKNOWN_COST
        count = known.sum(axis=0)
        total = np.where(known, strip, 0).sum(axis=0, dtype=np.int32)
        found = {
            "worst": np.where(known, strip, 0).max(axis=0),
            "best": strip.min(axis=0),  # UNKNOWN_COST is the largest
            "mean": np.rint(total / np.maximum(count, 1)),
        }
        for name, values in found.items():
            maps[name][top : top + 256] = np.where(count > 0, values, UNKNOWN_COST)
    return maps


def _raw(folder: Path, name: str, values: np.ndarray, frame: Frame) -> Path:
    with atomic_write(folder / f"{name}.pgm") as temporary:
        Image.fromarray(values).save(temporary, format="PPM")  # a gray image becomes a PGM
    return _describe(folder, name, ".pgm", "raw", frame)


def _scale(folder: Path, name: str, values: np.ndarray, frame: Frame) -> Path:
    shade = np.rint(255 * (1 - np.minimum(values, 100) / 100)).astype(np.uint8)
    alpha = np.where(values == UNKNOWN_COST, 0, 255).astype(np.uint8)
    with atomic_write(folder / f"{name}_scale.png") as temporary:
        Image.fromarray(np.stack([shade, alpha], axis=-1), mode="LA").save(temporary, format="PNG")
    return _describe(folder, f"{name}_scale", ".png", "scale", frame)


def _describe(folder: Path, name: str, suffix: str, mode: str, frame: Frame) -> Path:
    """Writes the YAML file; the origin is the outer corner of the south-west cell."""
    x, y = (axis - frame.cell_size / 2 for axis in frame.origin)
    lines = {
        "image": name + suffix,
        "mode": mode,
        "resolution": repr(frame.cell_size),
        "origin": f"[{x!r}, {y!r}, 0.0]",
        "negate": 0,
        "occupied_thresh": 1.0,
        "free_thresh": 0.0,
    }
    return save_text(folder / f"{name}.yaml", "".join(f"{key}: {value}\n" for key, value in lines.items()))
