"""travjax: which of the trajectories in front of a wheeled robot will fail, and why.

    heights = travjax.generate_terrain("rough", range(32))   # or travjax.load_dem("site.tif").heights
    margins = travjax.simulate(heights)                      # step, obstacle, tilt margins of 3042 trajectories a map
    failed = travjax.label(heights)                          # [32, 3042, 3]

Arrays, frames and units are in the module docstrings: grid.py for maps, actions.py for trajectories, traverse.py for
margins and failures.
"""

from importlib.metadata import version

from travjax.actions import ActionSpace
from travjax.config import InputError
from travjax.dem import load_dem
from travjax.grid import Grid
from travjax.robot import Robot
from travjax.terrain import STYLES, TerrainParams, elevation, generate_terrain, sample_params
from travjax.traverse import EVENTS, Margins, failures, label, simulate

__version__ = version("travjax")

__all__ = [
    "EVENTS",
    "STYLES",
    "ActionSpace",
    "Grid",
    "InputError",
    "Margins",
    "Robot",
    "TerrainParams",
    "elevation",
    "failures",
    "generate_terrain",
    "label",
    "load_dem",
    "sample_params",
    "simulate",
]
