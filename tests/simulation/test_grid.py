"""The node grid of a map."""

import math

import numpy as np
import pytest

from travjax.config import InputError
from travjax.simulation.grid import Grid


def test_the_paper_grid_has_129_nodes_from_minus_4_to_4_metres():
    grid = Grid()
    assert (grid.cells, grid.nodes, grid.shape) == (128, 129, (129, 129))
    np.testing.assert_array_equal(grid.axis(), -4 + 0.0625 * np.arange(129))


def test_the_robot_starts_on_the_middle_node():
    assert Grid().axis()[64] == 0.0
    assert Grid(4, 0.125).axis()[16] == 0.0


@pytest.mark.parametrize(("size", "spacing", "nodes"), [(4, 0.125, 33), (10, 0.1, 101), (0.3, 0.1, 4), (1, 1, 2)])
def test_other_grids_span_their_size_in_steps_of_their_spacing(size, spacing, nodes):
    grid = Grid(size, spacing)
    axis = grid.axis()
    assert grid.shape == axis.shape * 2 == (nodes, nodes)
    assert axis.dtype == np.float64
    np.testing.assert_allclose(axis[[0, -1]], [-size / 2, size / 2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.diff(axis), spacing, rtol=0, atol=1e-12)


def test_an_odd_number_of_cells_has_its_centre_between_nodes():
    np.testing.assert_allclose(Grid(0.3, 0.1).axis(), [-0.15, -0.05, 0.05, 0.15], rtol=0, atol=1e-12)


def test_equal_grids_are_one_key():
    assert {Grid(8, 0.0625): 1}[Grid()] == 1
    assert Grid(8, 0.125) != Grid()


@pytest.mark.parametrize("size", [0, 1e-40, -8, 1001, math.nan, math.inf, "8", None, True])
def test_a_bad_size_is_refused(size):
    with pytest.raises(InputError, match="^size = .*: must be a length in metres from 0.001 to 1000$"):
        Grid(size, 0.0625)


@pytest.mark.parametrize("spacing", [0, 1e-40, 0.00099, -0.1, 8.5, math.nan, math.inf, "0.1", None, True])
def test_a_bad_spacing_is_refused(spacing):
    with pytest.raises(
        InputError, match="^spacing = .*: must be a distance in metres, from 0.001 and at most the map's"
    ):
        Grid(8, spacing)


@pytest.mark.parametrize("spacing", [0.06, 0.3, 5])
def test_a_spacing_that_does_not_divide_the_size_is_refused(spacing):
    with pytest.raises(InputError, match=f"^spacing = {spacing}: must be a whole fraction of the size 8 m$"):
        Grid(8, spacing)


def test_a_grid_of_too_many_cells_is_refused():
    assert Grid(8, 8 / 4096).cells == 4096
    with pytest.raises(InputError, match="^spacing = .*: must be such that an edge has at most 4096 cells$"):
        Grid(8, 8 / 4097)
