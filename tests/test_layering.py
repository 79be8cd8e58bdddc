"""A module of travjax imports only modules below it."""

import ast
from pathlib import Path

import pytest

import travjax

ORDER = [
    "config",
    "models",
    "signals",
    "locks",
    "flags",
    "rounding",
    "files",
    "progress",
    "arrays",
    "grid",
    "heights",
    "batching",
    "noise",
    "terrain",
    "robot",
    "actions",
    "footprint",
    "traverse",
    "reference",
    "inputs",
    "memory",
    "npz_stream",
    "coordinates",
    "dem_options",
    "formats",
    "raster",
    "raster_files",
    "array_files",
    "points",
    "gridding",
    "text_points",
    "geokeys",
    "laz",
    "las",
    "ply",
    "pcd",
    "meshes",
    "clouds",
    "holes",
    "surface",
    "dem",
    "labelling",
    "sampling",
    "provenance",
    "dataset_json",
    "dataset",
    "sites",
    "tfds_builder",
    "convolution",
    "resnet",
    "stored_arrays",
    "keras_files",
    "weight_files",
    "namings",
    "preprocessing",
    "imagenet",
    "estimator",
    "stencil",
    "corruption",
    "field",
    "checkpoint",
    "metrics",
    "parallel",
    "preset",
    "map_data",
    "prediction",
    "runlog",
    "trained",
    "training_data",
    "training_step",
    "train",
    "train_field",
    "baselines",
    "evaluate",
    "model_file",
    "predictor",
    "robustness",
    "transfer",
    "plots",
    "report",
    "transfer_scores",
    "robustness_scores",
    "curves",
    "statistics",
    "bench",
    "bench_network",
    "commands.options",
    "commands.terrain",
    "commands.label",
    "commands.dataset",
    "commands.weights",
    "commands.train",
    "commands.evaluate",
    "commands.export",
    "commands.predict",
    "commands.bench",
    "entry",
    "cli",
    "experiments.launch",
    "experiments.transfer",
    "experiments.synthetic",
    "experiments.timing",
    "experiments.comparison",
]
"""From the bottom to the top; __init__ and __main__ may import any of them."""

FREE = ["__init__", "__main__", "commands.__init__", "experiments.__init__"]
PACKAGES = ["travjax", "travjax.commands", "travjax.experiments"]
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
        ("import travjax.grid as g", {"grid"}),
        ("from travjax import grid, noise", {"grid", "noise"}),
        ("from travjax.grid import Grid", {"grid"}),
        ("from .grid import Grid", {"grid"}),
        ("from . import grid", {"grid"}),
        ("def f():\n    from travjax.grid import Grid", {"grid"}),
        ("if TYPE_CHECKING:\n    import travjax.grid", {"grid"}),
        ("from travjax.commands import label, options", {"commands.label", "commands.options"}),
        ("from travjax.commands.options import seed", {"commands.options"}),
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


def test_the_sequential_simulator_shares_no_code_with_the_package():
    assert imports_of((PACKAGE / "reference.py").read_text()) == set()


def test_modules_are_found_at_all():
    assert {"config", "reference", "traverse", "__init__"} <= set(MODULES)
