"""Labels an elevation map of your own.

    python examples/label_dem.py site.tif

Without a file it makes a site of 24 x 24 m. It prints, for that site,

    9 windows of 8 x 8 m, 0.0 % of the site unknown
    step      23.5 % of the trajectories fail
    obstacle  44.8 % of the trajectories fail
    tilt       2.0 % of the trajectories fail
    safest start: window 4 at x = 8.0 m, y = 8.0 m, where 89.1 % are safe
"""

import sys
from pathlib import Path

import numpy as np

import travjax


def make_site(path: Path) -> Path:
    """Writes a synthetic site as .npz: heights [rows, cols] from south to north, and the metres between them."""
    grid = travjax.Grid(size=24)
    heights = np.asarray(travjax.generate_terrain("scattered_sharp", [3], grid=grid, world=8))[0]
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, heights=heights, cell_size=grid.spacing)
    return path


def main(path: str | Path | None = None, stride: float = 8.0) -> None:
    """Prints what fails on a site, and where it is best to start."""
    site = travjax.load_dem(path or make_site(Path("runs/examples/site.npz")), stride)
    margins = travjax.simulate(site.heights)
    known = np.asarray(margins.known)
    failed = np.asarray(travjax.failures(margins))

    print(f"{len(site)} windows of 8 x 8 m, {100 * site.unknown:.1f} % of the site unknown")
    for event, name in enumerate(travjax.EVENTS):
        print(f"{name:<9}{100 * failed[known][:, event].mean():5.1f} % of the trajectories fail")

    safe = (known & ~failed.any(axis=-1)).mean(axis=-1)
    best = int(safe.argmax())
    x, y = site.origins[best]
    print(f"safest start: window {best} at x = {x:.1f} m, y = {y:.1f} m, where {100 * safe[best]:.1f} % are safe")


if __name__ == "__main__":
    main(*sys.argv[1:2])
