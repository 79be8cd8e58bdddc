"""Benchmark of terrain and labelling for several batch sizes, and of the sequential simulator, in one run.

Times are medians of repeated calls on compiled code; compile time is separate. `travjax bench` prints the table and
writes it as TSV.
"""

import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from travjax import progress
from travjax.config import InputError
from travjax.evaluation import map_figures
from travjax.evaluation.tables import rows_table
from travjax.files import atomic_write, output_folder
from travjax.simulation.contact import CONTACTS, Contact
from travjax.simulation.setup import Setup
from travjax.terrain.styles import STYLES, generate_terrain
from travjax.traversal import reference
from travjax.traversal.traverse import margins_of, packed_labels

COLUMNS = {
    "what": "what",
    "maps": "maps at once",
    "ms_per_map": "ms a map",
    "trajectories_per_s": "trajectories/s",
    "speed_up": "x sequential",
    "first_call_s": "first call s (compiles)",
    "repeats": "repeats",
    "peak_mib": "peak memory so far MiB",
}

BATCHES = (1, 8, 32, 128)
LABELLING = {"nearest": "labelling", "tyre": "labelling, tyre"}
STREAM_CHUNK = 320
SEQUENTIAL = "sequential NumPy simulator"
_GENERATION = {"family": "cpu family", "model": "model"}


def machine() -> str:
    """Returns a line with the device and the versions that timings belong to."""
    device = jax.devices()[0]
    name = processor() if device.platform == "cpu" else device.device_kind
    versions = f"jax {jax.__version__}, Python {platform.python_version()}"
    return f"{device.platform} {name}, {os.cpu_count()} cores, {platform.machine()}, {versions}"


def processor() -> str:
    """Returns the processor's name, with family and model where it is of an x86, or else the name of its architecture.

    Family and model tell generations apart that a virtual machine calls by one name: AMD EPYC is family 25 as Zen 4,
    which has half the width of Zen 5, family 26.
    """
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    # the first processor's entries
    entries = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in reversed(lines))}
    if name := entries.get("model name"):
        generation = [f"{key} {entries[entry]}" for key, entry in _GENERATION.items() if entry in entries]
        return f"{name} ({', '.join(generation)})" if generation else name
    return platform.processor() or platform.machine()


def check(setup: Setup) -> None:
    """Raises InputError when the sequential simulator refuses robot, actions and grid that `node_table` accepts."""
    robot, actions, grid = setup.robot, setup.actions, setup.grid
    try:
        for trajectory in range(0, len(actions), len(actions.radii) ** 2):
            reference.simulate_trajectory(np.zeros(grid.shape), robot, actions, trajectory, grid.spacing)
    except ValueError as error:
        raise InputError(f"sequential simulator: {' '.join(str(error).split())}") from None


def measure(setup: Setup, out: str | Path, repeats: int = 15, stream: int = 0) -> None:
    """Measures terrain, labelling and the sequential simulator; prints the table and writes it as TSV and a figure.

    repeats: number of timed calls; the median is reported
    stream:  number of maps to make and label in a stream as well, 0 for none
    Raises InputError as `check` does, and when nothing can be written to `out`.
    """
    check(setup)
    folder, rows = output_folder(out), [start_row()]
    # First calls must compile rather than read the cache.
    jax.config.update("jax_enable_compilation_cache", False)
    measured = kernel_rows(setup, repeats)
    rows += list(progress.bar("kernels", (1 + len(CONTACTS)) * len(BATCHES), "row", iterable=measured))
    with progress.bar("sequential simulator", len(setup.actions), "trajectory") as bar:
        rows.append(reference_row(setup, lambda done: bar.update(done - bar.n)))
    if stream:
        with progress.bar("stream", stream, "map") as bar:
            rows.append(stream_row(stream, setup, bar.update))
    rows = with_speed_up(rows)
    write_rows(rows, COLUMNS, folder / "bench.tsv")
    kernels = [row for row in rows if row["what"] in ("terrain", *LABELLING.values())]
    progress.wrote(map_figures.save(map_figures.speed_figure(kernels), folder / "bench.png"))


def write_rows(rows: list[dict], columns: dict[str, str], path: Path) -> None:
    """Prints the table of measured rows under the machine, and writes it as TSV; columns: headings by key."""
    progress.say(f"\n{machine()}\n{rows_table(rows, columns)}\n")
    with atomic_write(path) as temporary:
        write_tsv(rows, temporary, columns)
    progress.wrote(path)


def kernel_rows(setup: Setup, repeats: int) -> Iterator[dict]:
    """Measures terrain, and labelling by each contact model, on compiled code; yields a row for each batch size."""
    for maps in BATCHES:
        yield terrain_row(maps, setup, repeats)
    for contact in CONTACTS:
        for maps in BATCHES:
            yield labelling_row(maps, replace(setup, contact=Contact.from_model(contact)), repeats)


def terrain_row(maps: int, setup: Setup, repeats: int) -> dict:
    """Measures making this many maps at once, on compiled code."""
    styles, seeds = _mixture(0, maps)
    return _timed("terrain", maps, lambda: generate_terrain(styles, seeds, grid=setup.grid), repeats, 0)


def labelling_row(maps: int, setup: Setup, repeats: int) -> dict:
    """Measures labelling of this many maps at once, on compiled code."""
    made = mixed_maps(maps, setup)
    heights = made[0] if maps == 1 else made
    return _timed(LABELLING[setup.contact.model], maps, lambda: margins_of(heights, setup), repeats, len(setup.actions))


def mixed_maps(maps: int, setup: Setup) -> jax.Array:
    """Makes maps [n, rows, cols] of all styles in turn."""
    return generate_terrain(*_mixture(0, maps), grid=setup.grid)


def reference_row(setup: Setup, on_progress: Callable[[int], object], repeats: int = 1) -> dict:
    """Measures the sequential simulator on all trajectories of one map.

    on_progress: called with the number of trajectories of a call that are done
    """
    robot, actions, grid = setup.robot, setup.actions, setup.grid
    heights = np.asarray(generate_terrain("rough", [0], grid=grid)[0], np.float64)
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        reference.simulate(heights, robot, actions, cell_size=grid.spacing, on_progress=on_progress)
        seconds.append(time.perf_counter() - start)
    return _row(SEQUENTIAL, 1, statistics.median(seconds), len(actions), None, repeats)


def stream_row(maps: int, setup: Setup, on_progress: Callable[[int], object]) -> dict:
    """Measures generating and labelling maps in chunks, with labels kept in memory at one byte per trajectory."""
    labels = np.empty((maps, len(setup.actions)), np.uint8)
    start = time.perf_counter()
    for first in range(0, maps, STREAM_CHUNK):
        count = min(STREAM_CHUNK, maps - first)
        heights = generate_terrain(*_mixture(first, count), grid=setup.grid)
        labels[first : first + count] = packed_labels(heights, setup)
        on_progress(count)
    return _row("terrain and labelling, streamed", maps, time.perf_counter() - start, len(setup.actions), None, 1)


def start_row() -> dict:
    """Measures a new process that labels one map, when an earlier process has filled the compilation cache."""
    seconds = []
    for _ in range(4):
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            command = [sys.executable, "-m", "travjax", "label", "--count", "1", "--no-figures", "--out", folder]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode:
                raise InputError(f"{' '.join(command)}: {done.stderr.strip().splitlines()[-1:]}")
            seconds.append(time.perf_counter() - start)
    return _row("command line, one map", 1, statistics.median(seconds[1:]), 0, None, 3, resource.RUSAGE_CHILDREN)


def with_speed_up(rows: list[dict]) -> list[dict]:
    """Adds to each row how many times faster than the sequential simulator it labels a map."""
    sequential = next(row["ms_per_map"] for row in rows if row["what"] == SEQUENTIAL)
    simulates = lambda row: row["trajectories_per_s"] is not None
    return [row | {"speed_up": sequential / row["ms_per_map"] if simulates(row) else None} for row in rows]


def write_tsv(rows: list[dict], path: Path, columns: Iterable[str] = COLUMNS) -> None:
    """Writes a line per row with the keys in `columns` and `machine`, which is this one unless the row has its own."""
    here = machine()
    cells = [
        [*("" if row[key] is None else str(row[key]) for key in columns), row.get("machine", here)] for row in rows
    ]
    path.write_text("\n".join("\t".join(line) for line in [[*columns, "machine"], *cells]) + "\n")


def _mixture(first: int, count: int) -> tuple[list[str], range]:
    return [STYLES[number % len(STYLES)] for number in range(first, first + count)], range(first, first + count)


def median_time(run: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Returns the median seconds of `repeats` calls whose results are ready, and those of the call before them."""
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[1:]), seconds[0]


def _timed(what: str, maps: int, run: Callable[[], object], repeats: int, trajectories: int) -> dict:
    seconds, first = median_time(run, repeats)
    return _row(what, maps, seconds, trajectories, first, repeats)


def _row(
    what: str,
    maps: int,
    seconds: float,
    trajectories: int,
    first: float | None,
    repeats: int,
    whose: int = resource.RUSAGE_SELF,
) -> dict:
    return {
        "what": what,
        "maps": maps,
        "ms_per_map": seconds / maps * 1e3,
        "trajectories_per_s": maps * trajectories / seconds if trajectories else None,
        "speed_up": None,
        "first_call_s": first,
        "repeats": repeats,
        "peak_mib": resource.getrusage(whose).ru_maxrss / 1024,
    }
