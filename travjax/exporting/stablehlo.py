"""A hazard field or the simulator as one StableHLO file for CPUs and NVIDIA GPUs, which needs jax alone.

from jax import export
function = export.deserialize(bytearray(file.read_bytes())).call
results = function(heights)  # by name
"""

from pathlib import Path

import jax
import jax.numpy as jnp
from jax import export

from travjax.exporting import exported_file
from travjax.exporting.functions import Function, field_function, known_function, map_by_map, simulator_function
from travjax.files import user_path
from travjax.jax_flags import usual_flags
from travjax.runs.predictor import Predictor
from travjax.simulation.grid import Grid
from travjax.simulation.setup import Setup

SUFFIX = ".stablehlo"

PLATFORMS = ("cpu", "cuda")


def export_field(to: str | Path, predictor: Predictor) -> tuple[Path, Path]:
    """Writes the function of a hazard field, and its description; returns where both are.

    to: .stablehlo file; a file that travjax did not write is never replaced
    The results are those of `Predictor.predict`. It takes every map; `known` are the trajectories that touch known
    ground alone, those that `simulate` knows with the contact model that the field was trained for.
    Raises InputError for an estimator of another kind, and when something else is in the way.
    """
    path, setup = user_path(to), predictor.run.setup
    exported_file.require_place(path, SUFFIX)
    data = _serialized(map_by_map(field_function(predictor), known_function(setup)), setup.grid)
    shape = f"[b, {len(setup.actions)}, {len(setup.robot.events)}] float32"
    outputs = {
        "probability": f"{shape}, of each event",
        "margin": f"{shape}, metres or radians",
        "known": f"[b, {len(setup.actions)}] bool, whether a trajectory touches known ground alone",
    }
    return exported_file.write(path, data, setup, predictor.title, outputs)


def export_simulator(to: str | Path, setup: Setup) -> tuple[Path, Path]:
    """Writes the function of the simulator for a setup, and its description; returns where both are.

    to: as of `export_field`
    The results are those of `simulate` for each map alone, to the bit on the same machine, and those of `failures`.
    Raises InputError when the parts of the setup do not fit together, and when something else is in the way.
    """
    path = user_path(to)
    exported_file.require_place(path, SUFFIX)
    setup.require_fit()
    data = _serialized(map_by_map(simulator_function(setup)), setup.grid)
    shape = f"[b, {len(setup.actions)}"
    margins = {event.name: f"{shape}] float32 {event.unit}, NaN where not known" for event in setup.robot.events}
    outputs = margins | {
        "known": f"{shape}] bool, whether a trajectory touches known ground alone",
        "failed": f"{shape}, {len(margins)}] bool, of each event; False where not known",
    }
    return exported_file.write(path, data, setup, f"simulator, contact model {setup.contact.model}", outputs)


@usual_flags()
def _serialized(function: Function, grid: Grid) -> bytes:
    """Lowers a function for maps of a grid, any number of them, and returns it as the bytes of a file."""
    (maps,) = export.symbolic_shape("b")
    heights = jax.ShapeDtypeStruct((maps, *grid.shape), jnp.float32)
    return bytes(export.export(jax.jit(function), platforms=PLATFORMS)(heights).serialize())
