"""Labelled batches: a margin that is no number is never taken for a safe one."""

from dataclasses import replace

import numpy as np
import pytest

from travjax.config import InputError
from travjax.data import map_batches
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.traverse import simulate

GRID, HUSKY = Grid(4, 0.125), Robot.load("husky_a200")
ACTIONS = ActionSpace(turns=2, arc_lengths=(0.6, 0.5), radii=(float("inf"),), interval=0.1)


@pytest.mark.parametrize("event", ["step", "obstacle", "tilt"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_margin_that_is_no_number_on_known_ground_is_an_error(monkeypatch, event, value):
    heights = np.zeros((1, *GRID.shape), np.float32)
    heights[0, -12:] = np.nan  # ahead of the first trajectory
    margins = simulate(heights, HUSKY, ACTIONS, grid=GRID)
    assert np.asarray(margins.known).tolist() == [[False, True]]
    assert not map_batches.labelled({"heights": heights}, HUSKY, ACTIONS, GRID)["failed"].any()
    spoilt = replace(margins, **{event: getattr(margins, event).at[0, 1].set(value)})
    monkeypatch.setattr(map_batches, "simulate", lambda *arguments, **options: spoilt)
    with pytest.raises(InputError, match=f"^margins of {HUSKY.name} = .*: must be finite where the ground is known$"):
        map_batches.labelled({"heights": heights}, HUSKY, ACTIONS, GRID)
