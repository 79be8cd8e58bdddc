"""The public names and where they come from; __init__.py reads this file."""

from .config import InputError
from .data.dataset import load_dataset
from .data.dem import load_dem
from .models.input_images import render_inputs
from .planning.motions import Motions
from .planning.no_path import NoPathError
from .planning.planner import Plan, Planner, plan
from .planning.to_go import CostToGo
from .runs.predictor import Predictor, predict
from .runs.run import load_estimator
from .simulation.actions import ActionSpace
from .simulation.events import EVENTS, Margins, Where
from .simulation.grid import Grid
from .simulation.robot import Robot
from .site.ground import SiteGround
from .site.kernel import simulate_site
from .site.mapping import SiteMap, map_site
from .site.primitives import Primitive, straight_passes
from .terrain.styles import STYLES, TerrainParams, elevation, generate_terrain, sample_params
from .training.evaluation_report import evaluate_run
from .training.fit import fit, run_from_preset
from .traversal.pose_by_pose import Traverse, traverse
from .traversal.traverse import failures, label, simulate

__version__: str

__all__ = [
    "EVENTS",
    "STYLES",
    "ActionSpace",
    "CostToGo",
    "Grid",
    "InputError",
    "Margins",
    "Motions",
    "NoPathError",
    "Plan",
    "Planner",
    "Predictor",
    "Primitive",
    "Robot",
    "SiteGround",
    "SiteMap",
    "TerrainParams",
    "Traverse",
    "Where",
    "elevation",
    "evaluate_run",
    "failures",
    "fit",
    "generate_terrain",
    "label",
    "load_dataset",
    "load_dem",
    "load_estimator",
    "map_site",
    "plan",
    "predict",
    "render_inputs",
    "run_from_preset",
    "sample_params",
    "simulate",
    "simulate_site",
    "straight_passes",
    "traverse",
]
