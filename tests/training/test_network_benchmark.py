"""The benchmark of the network: its rows, and that PyTorch is given the same network."""

import jax
import numpy as np
import pytest
from flax import nnx

from tests.commandline import FEW
from tests.conftest import HUSKY
from travjax.evaluation import simulator_benchmark
from travjax.models.trajectory_resnet import create
from travjax.resnet.network import ResNetConfig
from travjax.simulation.grid import Grid
from travjax.simulation.setup import Setup
from travjax.training.network_benchmark import COLUMNS, FLAX, TORCH, Bench, torch_estimator, with_ratio


@pytest.fixture(scope="module")
def rows() -> list[dict]:
    """The rows of a small network, without PyTorch."""
    small = Bench(Setup(HUSKY, FEW, Grid(4, 0.125)), repeats=2, trunk=ResNetConfig((1,), 4))
    return [small.inputs(), small.training_step(), small.all_trajectories()]


def test_rows_have_the_columns_and_agree_with_each_other(rows):
    for row in rows:
        assert list(row) == list(COLUMNS)
        assert row["ms"] == pytest.approx(row["ms_per_sample"] * row["batch"])
        assert row["samples_per_s"] == pytest.approx(1e3 / row["ms_per_sample"])
        assert row["repeats"] >= 1 and row["peak_mib"] > 50
    assert rows[1]["first_call_s"] * 1e3 > rows[1]["ms"]  # it compiles


def test_all_trajectories_are_those_of_the_action_space(rows):
    assert rows[2]["batch"] == len(FEW)


def test_the_ratio_is_that_of_the_training_steps():
    measured = with_ratio([{"what": FLAX, "ms": 30.0}, {"what": TORCH, "ms": 20.0}])
    assert [row["ratio"] for row in measured] == [1.5, None]
    assert with_ratio([{"what": FLAX, "ms": 30.0}])[0]["ratio"] is None


def test_rows_are_written_as_tsv(rows, tmp_path):
    simulator_benchmark.write_tsv(with_ratio(rows), tmp_path / "network.tsv", COLUMNS)
    lines = [line.split("\t") for line in (tmp_path / "network.tsv").read_text().splitlines()]
    assert lines[0] == [*COLUMNS, "machine"]
    assert [float(line[2]) for line in lines[1:]] == [row["ms"] for row in rows]


def test_pytorch_has_the_same_network():
    torch = pytest.importorskip("torch")
    trunk, heads = torch_estimator()
    ours = nnx.eval_shape(create)
    count = lambda module: sum(parameter.numel() for parameter in module.parameters())
    sizes = lambda part: sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(nnx.state(part, nnx.Param)))
    assert count(trunk) == sizes(ours.trunk)
    assert count(heads) == sizes(ours.heads)
    with torch.no_grad():
        pixels = torch.zeros(1, 3, 129, 129)
        for layer in trunk[:-2]:
            pixels = layer(pixels)
    images = jax.ShapeDtypeStruct((1, 129, 129, 3), "float32")
    stages = nnx.eval_shape(lambda estimator, x: estimator.trunk(x)[1], ours, images)
    assert stages["stage5"].shape == (1, *pixels.shape[2:], pixels.shape[1])
