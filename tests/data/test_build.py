"""Building data sets in a folder by a call; what `travjax dataset` says of it is in tests/commands/test_dataset.py."""

import numpy as np
import pytest

from tests.commandline import FEW, files
from travjax.config import InputError
from travjax.data import sites
from travjax.data.build import build_from_sites, build_synthetic
from travjax.data.dataset import Dataset, DatasetConfig, generate, load
from travjax.data.provenance import Site, SitesConfig
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup

HUSKY, GRID = Robot.load("husky_a200"), Grid(4, 0.125)
SETUP = Setup(HUSKY, FEW, GRID)


def require_equal(one: Dataset, other: Dataset):
    assert one.fingerprint == other.fingerprint and one.config == other.config
    for name, array in one.arrays.items():
        np.testing.assert_array_equal(array, other.arrays[name])


def test_a_synthetic_data_set_is_made_saved_and_returned(tmp_path, capsys):
    config = DatasetConfig(4, seed=3, world=8.0)
    made = build_synthetic(config, SETUP, str(tmp_path / "set"))
    require_equal(made, generate(config, SETUP))
    require_equal(made, load(tmp_path / "set"))
    assert capsys.readouterr().out == "synthetic maps of 4 m with the features of 8 m maps\n"


def test_a_data_set_of_sites_is_made_saved_and_returned(tmp_path):
    heights = np.cumsum(np.random.default_rng(0).normal(0, 0.02, (97, 97)), axis=1)
    np.savez(tmp_path / "yard.npz", heights=heights, cell_size=0.125)
    config = SitesConfig((Site(str(tmp_path / "yard.npz"), split="test"),), stride=4.0)
    made = build_from_sites(config, SETUP, tmp_path / "set")
    require_equal(made, sites.read(config, SETUP))
    require_equal(made, load(tmp_path / "set"))


def test_something_else_is_not_replaced(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="holds something else: must be a new or empty folder, or that of a data set"):
        build_synthetic(DatasetConfig(2), SETUP, tmp_path)
    assert files(tmp_path) == {tmp_path / "thesis.txt"}
