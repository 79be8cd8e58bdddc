"""Measures labelling, the ResNet50, terrain and site maps on the device, beside the limits of its data sheet.

What one map, image or place takes at least, in limits.Work:

- labelling: heights are read and margins written once; OPERATIONS for each node that is read under tyre or chassis, at
  every pose of every view of the map.
- site: a height is read, and the margins of a place are written; operations as for labelling.
- terrain: a height is written; NOISE operations for each.
- ResNet50: programs.Program.work, divided by the images.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import zip_longest

import jax
import numpy as np

from travjax import progress
from travjax.config import one_line
from travjax.evaluation.simulator_benchmark import machine, median_time, mixed_maps, terrain_row
from travjax.experiments.gpu.config import GpuConfig
from travjax.experiments.gpu.limits import DEVICES, Work
from travjax.experiments.gpu.programs import prediction, read_program, training_step
from travjax.runs.run import Run
from travjax.simulation.contact import CONTACTS, Contact
from travjax.simulation.footprint import NodeTable, pose_table
from travjax.simulation.setup import Setup
from travjax.simulation.tyre_tables import TyreTable, tyre_table
from travjax.site.kernel import SiteSetup, Tile, tile_margins, tiles_of
from travjax.site.primitives import all_poses, straight_passes
from travjax.training.network_benchmark import Bench
from travjax.traversal.traverse import margins_at_once
from travjax.traversal.tyre import ROUNDS

COLUMNS = {
    "what": "what",
    "at_once": "at once",
    "ms": "ms",
    "us_each": "us each",
    "per_s": "per s",
    "poses_per_s": "poses/s",
    "limit_us": "limit us each",
    "share": "share of limit",
    "limited_by": "limited by",
    "first_call_s": "first call s (compiles)",
    "repeats": "repeats",
}

OPERATIONS = 6
"""Operations for a node under the robot: two products and two sums for the plane, a difference and a maximum."""

NOISE = 260
"""Operations for a height: three noises of five vertices, 16 for each vertex, and 20 to mix them."""

REFUSED = "refused"
"""Stands in place of a limit where the device refused to compute."""

SITE = 2048
"""Cells along an edge of the site that a tile is part of: 128 m at the paper's spacing."""


@dataclass(frozen=True)
class Measured:
    """What was measured of a number of maps, images or places.

    seconds: of a call, the median; first: of the first one, which compiles; work, poses: of one of them
    """

    seconds: float
    first: float
    work: Work
    poses: int = 0

    def row(self, what: str, at_once: int, repeats: int) -> dict:
        """Returns a row of COLUMNS."""
        device, each = DEVICES.get(jax.devices()[0].device_kind), self.seconds / at_once
        limit, by = self.work.limit(device) if device else (None, "unknown")
        return {
            "what": what,
            "at_once": at_once,
            "ms": self.seconds * 1e3,
            "us_each": each * 1e6,
            "per_s": 1 / each,
            "poses_per_s": self.poses / each if self.poses else None,
            "limit_us": None if limit is None else limit * 1e6,
            "share": None if limit is None else limit / each,
            "limited_by": by,
            "first_call_s": self.first,
            "repeats": repeats,
            "machine": machine(),
        }


def refused(what: str, at_once: int, repeats: int) -> dict:
    """Returns the row of what the device refuses, without figures."""
    row = {"what": what, "at_once": at_once, "repeats": repeats, "limited_by": REFUSED, "machine": machine()}
    return dict.fromkeys(COLUMNS) | row


@dataclass(frozen=True)
class Kernels:
    """The measurements of a preset, for robot, action space, grid and network of a ResNet50's run."""

    config: GpuConfig
    run: Run

    def rows(self, kept: list[dict], until: float) -> Iterator[list[dict]]:
        """Yields all rows in order of worth, with one more each time, while it is not later than `until`.

        kept:  rows of earlier calls, of which those of this machine and of as many repeats are not measured again
        until: of `time.monotonic()`
        What the device refuses, for want of memory for one, is said and has a row without figures.
        """
        here, wanted = machine(), self.measurements()
        of_here = [row for row in kept if (row.get("machine"), row["repeats"]) == (here, self.config.repeats)]
        there = {(row["what"], row["at_once"]): row for row in of_here}
        ordered = lambda: [there[what, at_once] for what, at_once, _ in wanted if (what, at_once) in there]
        yield ordered()
        for what, at_once, measure in wanted:
            if (what, at_once) in there or time.monotonic() >= until:
                continue
            try:
                there[what, at_once] = measure().row(what, at_once, self.config.repeats)
            except (jax.errors.JaxRuntimeError, MemoryError) as error:
                progress.say(f"{what}, {at_once} at once: left out: {one_line(error) or 'out of memory'}")
                there[what, at_once] = refused(what, at_once, self.config.repeats)
            yield ordered()

    def measurements(self) -> list[tuple[str, int, Callable[[], Measured]]]:
        """Lists what is measured: a text, how many at once, and a function; one size of each comes first."""
        maps, batches = self.config.maps, self.config.batches
        numbers, count = self.run.preset.trunk.dtype, len(self.run.actions)
        steps = [(f"ResNet50 training, {numbers}, images", size, partial(self._step, size)) for size in batches]
        whole = [
            (f"ResNet50, trajectories of a map, {size} at a time", count, partial(self._predictions, size))
            for size in batches
        ]
        nearest, tyre = (
            [(f"labelling by {contact}, maps", size, partial(self._labelling, contact, size)) for size in maps]
            for contact in CONTACTS
        )
        terrain = [("terrain, maps", size, partial(self._terrain, size)) for size in maps]
        site, site_by_tyre = (
            [(f"site by {contact}, places", self._tile(contact)[1].edge ** 2, partial(self._site, contact))]
            for contact in CONTACTS
        )
        ranks = zip_longest(nearest, steps, whole, terrain, site, tyre, site_by_tyre)
        return [one for rank in ranks for one in rank if one]

    @cached_property
    def _bench(self) -> Bench:
        return Bench(self.run.setup, self.config.repeats, self.run.preset.trunk)

    def _labelling(self, contact: str, maps: int) -> Measured:
        setup = replace(self.run.setup, contact=Contact.from_model(contact))
        heights = mixed_maps(maps, setup)
        times = median_time(lambda: margins_at_once(heights, setup), self.config.repeats)
        return Measured(*times, *labelling_work(setup))

    def _step(self, size: int) -> Measured:
        row = self._bench.training_step(size)
        work = read_program(training_step(self.run, size)).work
        return Measured(row["ms"] / 1e3, row["first_call_s"], work.divided(size))

    def _predictions(self, size: int) -> Measured:
        row = self._bench.all_trajectories(size, self.config.repeats)
        work = read_program(prediction(self.run, size)).work
        return Measured(row["ms"] / 1e3, row["first_call_s"], work.divided(size))

    def _terrain(self, maps: int) -> Measured:
        row, nodes = terrain_row(maps, self.run.setup, self.config.repeats), self.run.grid.nodes**2
        return Measured(row["ms_per_map"] * maps / 1e3, row["first_call_s"], Work(4 * nodes, _plain(NOISE * nodes)))

    def _tile(self, contact: str) -> tuple[SiteSetup, Tile]:
        spacing = self.run.grid.spacing
        stride = SiteSetup.usual_stride(spacing)
        setup = SiteSetup(self.run.robot, straight_passes(stride=stride), spacing, stride, contact=contact)
        return setup, tiles_of(setup.lattice((SITE + 1, SITE + 1)), setup)[0]

    def _site(self, contact: str) -> Measured:
        setup, tile = self._tile(contact)
        rows = tile.ground(setup)[0]
        waves = np.sin(np.arange(rows.stop - rows.start, dtype=np.float32) / 9)
        ground = waves[:, None] * waves / 10
        times = median_time(lambda: tile_margins(ground, setup), self.config.repeats)
        return Measured(*times, *site_work(setup))


def labelling_work(setup: Setup) -> tuple[Work, int]:
    """Returns what labelling a map takes, and the simulated poses of a map."""
    table, grid = setup.node_table(), setup.grid
    views = len(table.layout.views)
    poses = views * table.poses.shape[0] * table.poses.shape[1]
    if setup.contact.model == "tyre":
        nodes = views * _nodes_of_tyres(tyre_table(table.poses.reshape(-1, 3), setup.robot, grid))
    else:
        nodes = views * _nodes_of_chassis(table)
    margins = len(setup.actions) * (4 * len(setup.robot.events) + 1)
    return Work(4 * grid.nodes**2 + margins, _plain(OPERATIONS * nodes)), poses


def site_work(setup: SiteSetup) -> tuple[Work, int]:
    """Returns what a place of a site map takes, and its simulated poses."""
    poses = all_poses(setup.primitives, setup.interval)
    if setup.contact == "tyre":
        nodes = _nodes_of_tyres(tyre_table(poses.reshape(-1, 3), setup.robot, setup.grid))
    else:
        nodes = _nodes_of_chassis(pose_table(poses, setup.robot, setup.grid))
    margins = len(setup.primitives) * (4 * len(setup.robot.events) + 1)
    return Work(4 * setup.step**2 + margins, _plain(OPERATIONS * nodes)), poses.shape[0] * poses.shape[1]


def _plain(operations: float) -> dict[str, float]:
    return {"float32": operations}


def _nodes_of_chassis(table: NodeTable) -> int:
    """Counts the nodes that `nearest` reads under chassis and wheels at all poses of a table."""
    return int(table.chassis[:, :, 2].sum()) + 4 * table.poses.shape[0] * table.poses.shape[1]


def _nodes_of_tyres(table: TyreTable) -> int:
    """Counts the nodes that `tyre` reads at all poses of a table: ground in each round, steps in the last, outline."""
    return (ROUNDS + 1) * table.tyres.row.size + table.outline.row.size + 4 * table.corner.size
