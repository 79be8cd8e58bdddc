"""Stand-in sites: when they take the place of real maps, and what they are."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from travjax.config import InputError
from travjax.data.dem import load_dem
from travjax.estimators.preset import TrainingConfig
from travjax.experiments.stand_ins import DESCRIPTION, StandIns, chosen_stand_ins
from travjax.experiments.transfer_runs import TransferConfig
from travjax.files import find_preset
from travjax.terrain.rock_field import SITES, site_heights

CONFIG = TransferConfig(training=TrainingConfig(epochs=0))

REAL = """
rotations = false
[[site]]
file = "quarry.npz"
test_strip = ["north", 8]
[[site]]
file = "pasture.npz"
"""


@pytest.fixture
def real(tmp_path, monkeypatch) -> Path:
    """A file of two real sites with the stand-ins described beside it, and no data."""
    monkeypatch.setenv("TRAVJAX_DATA", str(tmp_path / "data"))
    (tmp_path / "presets").mkdir()
    shutil.copy(find_preset("stand_in", "sites"), tmp_path / "presets" / DESCRIPTION)
    path = tmp_path / "presets" / "sites.toml"
    path.write_text(REAL)
    return path


def place(folder: Path, *names: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_bytes(b"")


def test_they_are_chosen_where_no_real_map_is_there(real, tmp_path):
    found = chosen_stand_ins(real, tmp_path / "out", False, None)
    assert [site.group for site in found.sites.site] == [f"{name} (stand-in)" for name in SITES]
    assert not found.sites.rotations  # as the real sites are read
    assert all(name in found.sentence for name in SITES) and "no evidence about real ground" in found.sentence


@pytest.mark.parametrize("names", [["quarry.npz"], ["quarry.npz", "pasture.npz"]])
def test_real_maps_that_are_there_come_first_and_one_that_is_missing_is_an_error(real, tmp_path, names):
    place(tmp_path / "data", *names)
    assert chosen_stand_ins(real, tmp_path / "out", False, None) is None
    assert chosen_stand_ins(real, tmp_path / "out", True, None) is not None


def test_a_data_set_comes_first(real, tmp_path):
    assert chosen_stand_ins(real, tmp_path / "out", False, tmp_path / "given") is None
    place(tmp_path / "out" / "data", "dataset.json")
    assert chosen_stand_ins(real, tmp_path / "out", False, None) is None
    with pytest.raises(InputError, match="^--data = .*given.*: must be left out where --stand-ins is given$"):
        chosen_stand_ins(real, tmp_path / "out", True, tmp_path / "given")


def test_sites_of_ones_own_have_no_stand_ins(real, tmp_path):
    (real.parent / DESCRIPTION).unlink()
    assert chosen_stand_ins(real, tmp_path / "out", False, None) is None
    with pytest.raises(InputError, match=f"{DESCRIPTION}: cannot be read"):
        chosen_stand_ins(real, tmp_path / "out", True, None)


def test_real_maps_do_not_go_on_with_what_stand_ins_began(real, tmp_path):
    place(tmp_path / "out" / "stand_ins")
    place(tmp_path / "out" / "data", "dataset.json")
    assert chosen_stand_ins(real, tmp_path / "out", False, None) is not None
    place(tmp_path / "data", "quarry.npz")
    assert chosen_stand_ins(real, tmp_path / "out", True, None) is not None
    with pytest.raises(InputError, match="holds an experiment on stand-in sites; allowed: another folder, or --stand-"):
        chosen_stand_ins(real, tmp_path / "out", False, None)


def test_the_rasters_are_the_sites(real, tmp_path):
    found = StandIns.load(real, tmp_path / "out")
    found.write()
    for site, (name, made) in zip(found.sites.site, SITES.items(), strict=True):
        windows = load_dem(site.file, stride=8.0)
        assert len(windows) == made.size[0] * made.size[1] / 64
        heights = site_heights(name)[:129, :129]
        np.testing.assert_allclose(windows.heights[0] + windows.height_offset, heights, rtol=0, atol=1e-6)


def test_the_experiment_shows_the_last_of_them(real, tmp_path):
    config = StandIns.load(real, tmp_path).in_place_of_real(replace(CONFIG, sites="../sites.toml"))
    assert (config.sites, config.shown) == (f"../{DESCRIPTION}", "crater_plain (stand-in)")


def test_the_figure_names_sites_splits_and_units(real, tmp_path):
    figure = StandIns.load(real, tmp_path).figure()
    left, right, bar = figure.axes
    assert [left.get_title(), right.get_title()] == ["bedrock_flats (stand-in): train", "crater_plain (stand-in): test"]
    assert {text.get_text() for text in left.texts} == {"test", "validation"}
    assert [left.get_xlabel(), left.get_ylabel(), bar.get_ylabel()] == ["x, east [m]", "y, north [m]", "elevation [m]"]


def test_a_site_that_is_not_built_in_is_named(real, tmp_path):
    path = real.parent / DESCRIPTION
    path.write_text(path.read_text().replace('"crater_plain.npz"', '"moon.npz"'))
    with pytest.raises(InputError, match="file = 'moon.npz': must be bedrock_flats, crater_plain, and .npz$"):
        StandIns.load(real, tmp_path)
