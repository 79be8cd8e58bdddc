"""The public names and where they come from; __init__.py reads this file."""

from .actions import ActionSpace
from .config import InputError
from .dem import load_dem
from .grid import Grid
from .inputs import render_inputs
from .predictor import predict
from .robot import Robot
from .terrain import STYLES, TerrainParams, elevation, generate_terrain, sample_params
from .traverse import EVENTS, Margins, failures, label, simulate

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
