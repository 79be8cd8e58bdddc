"""A module of travjax imports only modules below it: of a package further down, or of its own further down."""

import argparse
import ast
from pathlib import Path

import pytest

import travjax
from tests.conftest import LONGEST, SLOW

LAYERS = {
    "": "config signals locks memory files npz_stream progress jax_flags batching devices",
    "simulation": "arrays grid heights events contact physics_table robot actions footprint tyre_tables setup",
    "traversal": "arcs nearest steps tyre tyre_trajectories traverse reference tyre_reference pose_by_pose",
    "terrain": "noise landforms rock_field styles",
    "rasters": "coordinates reading_options formats raster gdal_files recordings grid_maps array_files holes surface",
    "point_clouds": "points gridding text_points geokeys laz las ply pcd meshes clouds",
    "data": "dem map_batches sensor_noise sampling provenance dataset_json dataset sites build tfds_export",
    "resnet": "winograd convolution network stored_arrays keras_files weight_files namings preprocessing "
    "imagenet_weights fetched_weights",
    "models": "variables input_images trajectory_resnet pose_stencil hazard_field",
    "evaluation": "metrics baselines map_figures tables score_figures dataset_tables map_reports simulator_benchmark",
    "site": "primitives ground kernel costs tiling geotiff nav2 store site_figures mapping geometric site_benchmark",
    "estimators": "names preset inference kind trajectory_samples map_samples trajectory_estimator map_estimator",
    "runs": "quiet_orbax checkpoint run_log run model_file model_card predictor prediction_report evaluator",
    "exporting": "functions exported_file stablehlo onnx_graph",
    "planning": "biarcs motions path judges costs endpoints search no_path planner to_go field_judge action_space",
    "plan_results": "path_files route_graph plan_figures plan_report plan_benchmark",
    "navigation": "tasks methods trials scores",
    "training": "step trunk_features trainer fit evaluation_report network_benchmark",
    "physics": "model drive labelling agreement check report",
    "programs": "entry options",
    "experiments": "launch transfer_scores transfer_runs stand_ins robustness robustness_scores synthetic transfer "
    "timing comparison physics navigation",
    "experiments.gpu": "limits config programs kernels estimate parts __main__",
    "commands": "terrain label map plan dataset weights train evaluate export predict physics bench",
    "program": "cli",
}
"""Packages from the bottom to the top, those of TOP being travjax itself; in each, its modules likewise."""

TOP = ("", "programs", "program")
"""Layers of modules that lie in no package."""

MOST = 12
"""Modules in a package."""

ORDER = [
    f"{package}.{module}" if package not in TOP else module
    for package, modules in LAYERS.items()
    for module in modules.split()
]
FREE = ["__init__", "__main__", *(f"{package}.__init__" for package in LAYERS if package not in TOP)]
PACKAGES = ["travjax", *(f"travjax.{package}" for package in LAYERS if package not in TOP)]
PACKAGE = Path(travjax.__file__).parent
MODULES = sorted(".".join(path.relative_to(PACKAGE).with_suffix("").parts) for path in PACKAGE.rglob("*.py"))


def imports_of(source: str) -> set[str]:
    """The travjax modules that a module of travjax imports anywhere; "" stands for the package itself."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(part for part in ("travjax" if node.level else "", node.module) if part)
            found.update({f"{base}.{alias.name}" for alias in node.names} if base in PACKAGES else {base})
    return {name.removeprefix("travjax").removeprefix(".") for name in found if name.split(".")[0] == "travjax"}


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("import numpy", set()),
        ("import travjax", {""}),
        ("import travjax.config as c", {"config"}),
        ("from travjax import config, files", {"config", "files"}),
        ("from travjax.config import require", {"config"}),
        ("from .config import require", {"config"}),
        ("from . import config", {"config"}),
        ("def f():\n    from travjax.config import require", {"config"}),
        ("if TYPE_CHECKING:\n    import travjax.config", {"config"}),
        ("from travjax.simulation import grid, robot", {"simulation.grid", "simulation.robot"}),
        ("from travjax.simulation.grid import Grid", {"simulation.grid"}),
        ("import travjaxes", set()),
    ],
)
def test_imports_are_found_however_they_are_written(source, expected):
    assert imports_of(source) == expected


@pytest.mark.parametrize("module", MODULES)
def test_every_module_has_its_place(module):
    assert module in ORDER + FREE


@pytest.mark.parametrize("module", [module for module in MODULES if module in ORDER])
def test_a_module_imports_only_modules_below_it(module):
    below = ORDER[: ORDER.index(module)]
    package = [""] if module == "cli" else []  # for the version
    assert imports_of((PACKAGE / f"{module.replace('.', '/')}.py").read_text()) <= {*below, *package}


@pytest.mark.parametrize("package", LAYERS)
def test_a_package_can_be_taken_in_at_a_glance(package):
    assert len(LAYERS[package].split()) <= MOST


def test_the_sequential_simulator_shares_no_code_with_the_package():
    assert imports_of((PACKAGE / "traversal/reference.py").read_text()) == set()


def test_modules_are_found_at_all():
    assert {"config", "traversal.reference", "traversal.traverse", "__init__"} <= set(MODULES)


# ---- Commands parse, call and print; the library and the experiments do without them


@pytest.mark.parametrize("module", [module for module in MODULES if module != "cli"])
def test_only_the_command_line_imports_commands(module):
    imported = imports_of((PACKAGE / f"{module.replace('.', '/')}.py").read_text())
    assert [name for name in imported if name.split(".")[0] == "commands"] == []


def misused(source: str) -> list[str]:
    """What of argparse a module should leave alone: private attributes, and namespaces that are built by hand."""
    tree = ast.parse(source)
    if not any(
        "argparse" in ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)
    ):
        return []
    parser = argparse.ArgumentParser()
    private = {
        name
        for thing in (argparse, parser, parser.add_subparsers(), parser.add_argument_group())
        for name in dir(thing)
        if name.startswith("_") and not name.startswith("__")
    }
    called = [ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)]
    read = [node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    named = [alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names]
    namespaces = [name for name in called if name.split(".")[-1] == "Namespace"]
    return namespaces + [name for name in read + named if name in private]


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("def f(arguments: argparse.Namespace): return arguments.out", []),
        ("argparse.Namespace(out=1)", ["argparse.Namespace"]),
        ("from argparse import Namespace\nNamespace(**vars(given))", ["Namespace"]),
        ("from argparse import _SubParsersAction", ["_SubParsersAction"]),
        ("Commands = argparse._SubParsersAction", ["_SubParsersAction"]),
        ("for action in group._group_actions: pass", ["_group_actions"]),
        ("self._parser.parse_args(), self.__doc__", []),
    ],
)
def test_misuse_of_argparse_is_found(source, expected):
    assert misused(f"import argparse\n{source}") == expected


@pytest.mark.parametrize("module", MODULES)
def test_no_module_builds_namespaces_or_reads_what_is_private_to_argparse(module):
    assert misused((PACKAGE / f"{module.replace('.', '/')}.py").read_text()) == []


@pytest.mark.parametrize("file", sorted({*LONGEST, *SLOW}))
def test_what_is_said_of_tests_is_of_tests_that_are_there(file):
    text = (Path(__file__).parent / file).read_text()
    for part in SLOW.get(file, ()):
        assert (
            f"def {part.split('[')[0]}" in text if part.startswith("test_") else part.strip("[]").split("-")[0] in text
        )


def test_no_public_name_is_that_of_a_module_which_would_hide_it():
    assert set(travjax.__all__) & {name.split(".")[0] for name in MODULES} == set()
