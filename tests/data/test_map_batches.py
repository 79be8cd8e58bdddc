"""Batches of maps: a margin that is no number is never taken for a safe one, and streams are what was asked for."""

from dataclasses import replace

import numpy as np
import pytest

from travjax.config import InputError
from travjax.data import map_batches
from travjax.data.dem import load_dem
from travjax.data.map_batches import MapStream, WindowOptions
from travjax.rasters.reading_options import DemOptions
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup
from travjax.terrain.styles import generate_terrain
from travjax.traversal.traverse import simulate

GRID, HUSKY = Grid(4, 0.125), Robot.load("husky_a200")
ACTIONS = ActionSpace(turns=2, arc_lengths=(0.6, 0.5), radii=(float("inf"),), interval=0.1)
SETUP = Setup(HUSKY, ACTIONS, GRID)


@pytest.mark.parametrize("event", ["step", "obstacle", "tilt"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_margin_that_is_no_number_on_known_ground_is_an_error(monkeypatch, event, value):
    heights = np.zeros((1, *GRID.shape), np.float32)
    heights[0, -12:] = np.nan  # ahead of the first trajectory
    margins = simulate(heights, HUSKY, ACTIONS, grid=GRID)
    assert np.asarray(margins.known).tolist() == [[False, True]]
    assert not map_batches.labelled({"heights": heights}, SETUP)["failed"].any()
    spoilt = replace(margins, **{event: getattr(margins, event).at[0, 1].set(value)})
    monkeypatch.setattr(map_batches, "margins_of", lambda *arguments, **options: spoilt)
    with pytest.raises(InputError, match=f"^margins of {HUSKY.name} = .*: must be finite where the ground is known$"):
        map_batches.labelled({"heights": heights}, SETUP)


# ---- Streams of maps


def test_synthetic_maps_take_the_styles_in_turn_and_say_whose_features_they_have():
    said = []
    maps = MapStream.synthetic(["rough", "smooth"], [5, 6, 7], GRID, 8.0, said.append)
    assert (maps.total, maps.files, maps.world, maps.paper) == (3, (), 8.0, True)
    made = map_batches.joined(list(maps.batches))
    assert made["group"].tolist() == ["rough", "smooth", "rough"] and made["seed"].tolist() == [5, 6, 7]
    expected = generate_terrain(["rough", "smooth", "rough"], [5, 6, 7], grid=GRID, world=8.0)
    np.testing.assert_array_equal(made["heights"], expected)
    assert said == ["synthetic maps of 4 m with the features of 8 m maps"]


def test_rock_fields_have_features_of_their_own_and_do_not_compare_with_the_paper():
    said = []
    assert not MapStream.synthetic(["rock_field"], [1], GRID, say=said.append).paper
    assert said == []
    with pytest.raises(InputError, match="^world = 8.0: must be left out for rock_field"):
        MapStream.synthetic(["rock_field"], [1], GRID, 8.0)


def test_windows_of_files_are_read_as_they_are_asked_for_and_described(tmp_path):
    said = []
    for name in ("yard", "field"):
        np.savez(tmp_path / f"{name}.npz", heights=np.zeros((97, 33)) + len(name), cell_size=0.125)
    paths = [tmp_path / "yard.npz", tmp_path / "field.npz"]
    options = WindowOptions(DemOptions(height_scale=0.5), stride=4.0, fill_holes=False)
    maps = MapStream.from_files(paths, GRID, options, said.append)
    assert (maps.total, maps.world, maps.paper) == (6, None, False)
    made = map_batches.joined(list(maps.batches))
    assert made["group"].tolist() == ["yard.npz"] * 3 + ["field.npz"] * 3
    assert [line.split(": ")[0] for line in said] == [str(path) for path in paths]
    assert "3 windows cover " in said[0] and "cells of 0.125 m, crs none" in said[0]
    for read, path in zip(maps.files, paths, strict=True):
        windows = load_dem(path, grid=GRID, **options.settings)
        assert (read["sha256"], read["covered"]) == (windows.sha256, windows.covered)
        assert (read["height_scale"], read["stride"], read["fill_holes"]) == (0.5, 4.0, False)
