"""Benchmark of site maps by each contact model: poses a second, and how much of the time goes into files."""

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from travjax import progress
from travjax.config import InputError
from travjax.evaluation.simulator_benchmark import write_rows
from travjax.files import output_folder
from travjax.simulation.contact import CONTACTS
from travjax.site.ground import SiteGround
from travjax.site.kernel import tiles_of
from travjax.site.mapping import setup_of
from travjax.site.primitives import all_poses
from travjax.site.tiling import executor, parts_of

COLUMNS = {
    "what": "what",
    "places": "places",
    "poses": "poses",
    "poses_per_s": "poses/s",
    "simulating_s": "simulating s",
    "whole_s": "travjax map s",
    "files_share": "share in files",
    "peak_mib": "peak memory MiB",
}


class _Timed:
    """A site that counts the seconds in which its ground is read."""

    def __init__(self, site: SiteGround):
        self.site, self.shape, self.seconds = site, site.shape, 0.0

    def part(self, rows: slice, cols: slice) -> np.ndarray:
        """Reads a part of the site."""
        start = time.perf_counter()
        part = self.site.part(rows, cols)
        self.seconds += time.perf_counter() - start
        return part


def measure(path: Path, robot: str, out: str | Path) -> None:
    """Maps a site by each contact model, without files and as `travjax map` does; prints a table and writes it as TSV.

    Raises InputError when the site cannot be read or mapped.
    """
    folder, site = output_folder(out), SiteGround.open(path)
    rows = [_row(site, robot, contact) for contact in CONTACTS]
    write_rows(rows, COLUMNS, folder / "site.tsv")


def _row(site: SiteGround, robot: str, contact: str) -> dict:
    setup, ground = setup_of(robot, spacing=site.spacing, contact=contact), _Timed(site)
    lattice = setup.lattice(site.shape)
    start = time.perf_counter()
    with executor() as pool, progress.bar(contact, len(tiles_of(lattice, setup)), "tile") as bar:
        for _ in parts_of(ground, setup, pool):
            bar.update()
    seconds = time.perf_counter() - start
    whole = _whole(site, robot, contact)
    poses = int(np.prod(lattice)) * int(np.prod(all_poses(setup.primitives, setup.interval).shape[:2]))
    return {
        "what": contact,
        "places": int(np.prod(lattice)),
        "poses": poses,
        "poses_per_s": round(poses / seconds),
        "simulating_s": round(seconds, 2),
        "whole_s": round(whole, 2),
        "files_share": round(max(whole - seconds + ground.seconds, 0) / whole, 3),
        "peak_mib": resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024,
    }


def _whole(site: SiteGround, robot: str, contact: str) -> float:
    """Returns the seconds that the command takes, files and figures included."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        command = [sys.executable, "-m", "travjax", "map", site.path, "--robot", robot, "--contact", contact]
        done = subprocess.run([*command, "--out", folder], capture_output=True, text=True)
        if done.returncode:
            raise InputError(f"{' '.join(command)}: {done.stderr.strip().splitlines()[-1:]}")
        return time.perf_counter() - start
