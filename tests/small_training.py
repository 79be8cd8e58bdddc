"""What tests of training and evaluation share: a tiny data set, a tiny network, and runs of them."""

import functools
import json
import shutil
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from tests.commandline import FEW, run_words
from travjax.data.dataset import Dataset, DatasetConfig, generate, save
from travjax.devices import Devices
from travjax.estimators.preset import EvaluationConfig, Preset, TrainingConfig
from travjax.models.trajectory_resnet import Estimator, HeadsConfig, create
from travjax.models.variables import merge_model, split_model
from travjax.resnet.network import ResNetConfig
from travjax.runs.checkpoint import Checkpoints
from travjax.runs.run import Run
from travjax.runs.run_log import read_rows
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup
from travjax.training.trainer import Trainer

HUSKY, GRID = Robot.load("husky_a200"), Grid(4, 0.125)
SETUP = Setup(HUSKY, FEW, GRID)
GRID_WORDS = ("--size", 4, "--spacing", 0.125)

TOML = """
robot = "husky_a200"
weights = "none"
elevation_scale = 0.5
[dataset]
maps = 30
seed = 5
validation = 0.2
test = 0.2
[trunk]
blocks = [1]
width = 4
momentum = 0.9
[heads]
hidden = 16
[training]
batch_size = 8
head_epochs = 2
epochs = 2
learning_rate = 1e-3
warmup_steps = 3
trajectories_per_map = 3
failing_per_map = 2
resample_each_epoch = true
checkpoint_steps = 3
[evaluation]
maps = 4
trajectories_per_map = 6
"""

PRESET = Preset(
    robot="husky_a200",
    weights="none",
    elevation_scale=0.5,
    dataset=DatasetConfig(30, seed=5, validation=0.2, test=0.2),
    trunk=ResNetConfig(blocks=(1,), width=4, momentum=0.9),
    heads=HeadsConfig(16),
    training=TrainingConfig(
        batch_size=8,
        head_epochs=2,
        epochs=2,
        learning_rate=1e-3,
        warmup_steps=3,
        trajectories_per_map=3,
        failing_per_map=2,
        resample_each_epoch=True,
        checkpoint_steps=3,
    ),
    evaluation=EvaluationConfig(4, 6),
)
"""The same; 7 steps an epoch, the last of which is filled up: phase 1 ends at step 14, phase 2 at 28."""


@functools.cache
def dataset() -> Dataset:
    """The data set of PRESET: all three events fail in each split."""
    return generate(PRESET.dataset, SETUP)


@functools.cache
def estimator(seed: int = 0) -> Estimator:
    """One of PRESET's size with random parameters and statistics, not to be changed."""
    made = create(PRESET.trunk, PRESET.heads, seed)
    random = np.random.default_rng(seed)
    for name in ("conv1", "res2a"):
        part = getattr(made.trunk, name)
        for layer in [part] if name == "conv1" else [getattr(part, f"branch{b}") for b in ("2a", "2b", "2c", "1")]:
            for variable in (layer.scale, layer.bias, layer.mean, layer.var):
                variable.set_value(jax.numpy.asarray(random.uniform(0.2, 1.0, variable.shape), np.float32))
    return made


@functools.partial(jax.jit, static_argnums=0)
def forward(graph, variables, images):
    """Logits of images, in one piece of code: the same operations one by one take seconds to compile."""
    return merge_model(graph, variables)(images)


@functools.partial(jax.jit, static_argnums=0)
def features_of(graph, variables, images):
    """The trunk's features of images."""
    return merge_model(graph, variables).trunk(images)[0]


@functools.partial(jax.jit, static_argnums=0)
def in_training(graph, variables, images, key):
    """Logits of a forward pass with dropout and batch statistics, and the variables after it."""
    made = merge_model(graph, variables)
    return made(images, train=True, key=key), split_model(made)[1]


def run_of(**training) -> Run:
    """PRESET's run with other settings of training."""
    return Run(replace(PRESET, training=replace(PRESET.training, **training)), SETUP)


def trainer(folder: Path, data: Dataset | None = None, **training) -> Trainer:
    """A trainer that has not begun."""
    folder.mkdir(parents=True, exist_ok=True)
    return Trainer(run_of(**training), data or dataset(), folder, Devices.all(), quiet=True)


def begun(folder: Path, data: Dataset | None = None, **training) -> Trainer:
    """A trainer that has begun with an estimator of `create`."""
    made = trainer(folder, data, **training)
    made.start(create(PRESET.trunk, PRESET.heads, made.config.seed))
    return made


def host(tree) -> dict[str, np.ndarray]:
    """The leaves by path, as copies on the host."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    named = {jax.tree_util.keystr(path, simple=True, separator="/"): np.array(leaf) for path, leaf in leaves}
    return {name.removesuffix("/value"): array for name, array in named.items()}


def require_equal(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    """Equal bit for bit."""
    assert one.keys() == other.keys()
    for name, array in one.items():
        assert array.dtype == other[name].dtype and array.tobytes() == other[name].tobytes(), name


def differing(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> set[str]:
    """Names of the arrays that differ."""
    assert one.keys() == other.keys()
    return {name for name, array in one.items() if array.tobytes() != other[name].tobytes()}


def saved_state(folder: Path, which: str = "latest") -> dict[str, np.ndarray]:
    """What a checkpoint of a run holds, by path."""
    return host(Checkpoints(folder / "checkpoints").restore(which=which)[0])


def rows_of(folder: Path) -> list[dict]:
    """The rows of metrics.jsonl without the one number that depends on the time."""
    rows = read_rows(folder / "metrics.jsonl")
    for row in rows:
        assert row["epoch"] == 0 or row.pop("samples_per_s") >= 0  # 0: the first state, eval sets alone
    return rows


def validations(folder: Path) -> list[dict]:
    """The rows of the ends of epochs."""
    return [row for row in rows_of(folder) if "validation_loss" in row]


def files_of_run(folder: Path) -> tuple[Path, Path]:
    """The data set and the preset of a run, written to a folder."""
    save(dataset(), folder / "set")
    (folder / "tiny.toml").write_text(TOML)
    return folder / "set", folder / "tiny.toml"


def words_of(files: tuple[Path, Path], few: Path) -> tuple:
    """`train` on these files."""
    return ("train", files[1], "--data", files[0], "--actions", few, *GRID_WORDS)


def train(words: tuple) -> tuple[str, str]:
    """`travjax words` in this process: standard output and errors."""
    code, out, err = run_words(*words)
    assert code == 0, err
    return out, err


def copy(folder: Path, place: Path) -> Path:
    """A copy of a run, which may be spoilt."""
    return Path(shutil.copytree(folder, place))


def loads(text: str):
    """JSON, without the NaN that Python would take."""

    def refuse(name):
        raise ValueError(name)

    return json.loads(text, parse_constant=refuse)
