"""A wheel holds all that the package needs: it is built, installed in an environment and used in an empty folder."""

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tests.commandline import FEW_TOML
from travjax.files import PRESETS
from travjax.terrain.styles import generate_terrain

REPOSITORY = Path(__file__).parents[1]

TOML = """
model = "field"
weights = "none"
[dataset]
maps = 10
validation = 0.2
test = 0.1
[field]
stem = 4
widths = [4]
channels = 3
hidden = 4
[training]
optimizer = "adamw"
batch_size = 4
head_epochs = 0
epochs = 1
trajectories_per_map = 3
failing_per_map = 0
"""
"""A preset of the hazard field that trains in seconds."""

SMALL = ("--robot", "husky_a200", "--actions", "few.toml", "--size", "4", "--spacing", "0.125")


def ran(*words: str | Path, cwd: Path, **variables: str) -> str:
    """What a program prints that ends well, without the variables that lead to this repository or to data."""
    left_out = ("PYTHONPATH", "PYTHONHOME", "TRAVJAX_DATA")
    environment = {name: value for name, value in os.environ.items() if name not in left_out} | variables
    done = subprocess.run([*map(str, words)], cwd=cwd, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel of this repository, built from a copy without a network."""
    source = tmp_path_factory.mktemp("source")
    shutil.copytree(REPOSITORY / "travjax", source / "travjax", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, source)
    options = ("--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--wheel-dir", source)
    ran(sys.executable, "-m", "pip", "wheel", *options, source, cwd=source)
    return next(source.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """The programs of an environment that has the wheel, and all else from the environment of the tests."""
    place = tmp_path_factory.mktemp("environment")
    ran(sys.executable, "-m", "venv", "--without-pip", place, cwd=place)
    python = place / "bin/python"
    options = ("--quiet", "--no-deps", "--no-index", "--no-compile")
    ran(sys.executable, "-m", "pip", "--python", python, "install", *options, wheel, cwd=place)
    # Afterwards, or pip would take the travjax of the tests for the one that is wanted.
    libraries = sysconfig.get_path("purelib"), sysconfig.get_path("platlib")
    packages = Path(ran(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=place).strip())
    (packages / "libraries.pth").write_text("\n".join(dict.fromkeys(libraries)) + "\n")
    return place / "bin"


@pytest.fixture(scope="module")
def variables(tmp_path_factory) -> dict[str, str]:
    """A home of its own; code is compiled in the quickest way and kept there."""
    home = str(tmp_path_factory.mktemp("home"))
    quick = {"JAX_PLATFORMS": "cpu", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    return quick | {"HOME": home, "XDG_CACHE_HOME": home, "JAX_COMPILATION_CACHE_DIR": f"{home}/code"}


def test_the_wheel_holds_every_file_of_the_package(wheel):
    ours = {path.relative_to(REPOSITORY) for path in (REPOSITORY / "travjax").rglob("*") if path.is_file()}
    ours = {str(path) for path in ours if "__pycache__" not in path.parts and path.name != "README.md"}
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert held == ours
    assert {"travjax/py.typed", "travjax/__init__.pyi", "travjax/presets/transfer/laptop.toml"} <= held


def test_it_works_in_an_empty_folder(installed, variables, tmp_path):
    def travjax(*words: str) -> str:
        return ran(installed / "travjax", *words, cwd=tmp_path, **variables)

    assert "--from FILE" in travjax("weights", "--help")
    travjax("label", "--count", "1", "--out", "labelled")
    assert (tmp_path / "labelled/labels.npz").is_file()
    np.save(tmp_path / "map.npy", np.asarray(generate_terrain("rough", 3)))
    travjax("predict", "map.npy", "--cell-size", "0.0625", "--no-figures", "--out", "predicted")
    assert (tmp_path / "predicted/predictions.npz").is_file()
    (tmp_path / "few.toml").write_text(FEW_TOML)
    (tmp_path / "tiny.toml").write_text(TOML)
    assert "Next: travjax evaluate trained" in travjax("train", "tiny.toml", *SMALL, "--out", "trained")


def test_it_finds_its_presets_by_name(installed, variables, tmp_path):
    # Training at the preset smoke itself takes a minute.
    names = [(path.parent.name, path.stem) for path in sorted(PRESETS.glob("*/*.toml"))]
    program = f"""
from pathlib import Path
import travjax
from travjax.config import load_toml
from travjax.data.provenance import SitesConfig
from travjax.experiments.gpu.config import GpuConfig
from travjax.experiments.physics import PhysicsExperiment
from travjax.experiments.transfer_runs import TransferConfig
from travjax.files import find_preset
from travjax.navigation.tasks import NavigationConfig
from travjax.estimators.preset import Preset

kinds = {{"physics": PhysicsExperiment, "sites": SitesConfig, "transfer": TransferConfig}} | {{
    "navigation": NavigationConfig, "gpu": GpuConfig
}}
for kind, name in {names}:
    path = find_preset(name, kind)
    assert path.is_relative_to({str(installed.parent)!r}), path
    config = load_toml(path, kinds.get(kind, Preset))
    if kind == "transfer":
        SitesConfig.load(path.parent / config.sites)
        Preset.load(path.parent / config.synthetic)
print(Path(travjax.__file__))
"""
    printed = ran(installed / "python", "-c", program, cwd=tmp_path, **variables)
    assert Path(printed.strip()).is_relative_to(installed.parent)
    assert {("resnet50", "smoke"), ("field", "smoke"), ("transfer", "smoke"), ("sites", "real")} <= set(names)
