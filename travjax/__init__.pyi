"""The public names and where they come from; __init__.py reads this file."""

from .config import InputError
from .data.dem import load_dem
from .models.input_images import render_inputs
from .runs.predictor import predict
from .simulation.actions import ActionSpace
from .simulation.events import EVENTS, Margins
from .simulation.grid import Grid
from .simulation.robot import Robot
from .simulation.traverse import failures, label, simulate
from .terrain.styles import STYLES, TerrainParams, elevation, generate_terrain, sample_params

__version__: str

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
    "predict",
    "render_inputs",
    "sample_params",
    "simulate",
]
