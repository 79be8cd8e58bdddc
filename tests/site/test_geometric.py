"""The geometric cost map: equal to a plain transcription of its formulas, and compared with the map of passes."""

import math

import numpy as np
import pytest

from tests.commandline import run_words
from travjax.simulation.robot import Robot
from travjax.site.geometric import disc, geometric_tile
from travjax.site.ground import ArrayGround
from travjax.site.kernel import tiles_of
from travjax.site.mapping import setup_of
from travjax.terrain.styles import generate_terrain

ROBOT = Robot.load("seekur_jr")


def by_the_formulas(heights: np.ndarray, row: int, col: int, spacing: float) -> list[float]:
    """The tests and the cost of one place."""
    radius = math.hypot(ROBOT.overall_length, ROBOT.overall_width) / 2
    y, x = (np.arange(edge) * spacing for edge in heights.shape)
    inside = np.hypot(y[:, None] - y[row], x - x[col]) <= radius + 1e-9
    at_row, at_col = np.nonzero(inside)
    z = heights[at_row, at_col]
    matrix = np.stack([x[at_col], y[at_row], np.ones(len(z))], axis=1)
    plane = np.linalg.lstsq(matrix, z, rcond=None)[0]
    error = z - matrix @ plane
    shares = [
        np.linalg.norm(error) / 5 / ROBOT.ride_height,
        math.degrees(math.acos(1 / math.sqrt(plane[0] ** 2 + plane[1] ** 2 + 1))) / 36,
        error.max() / ROBOT.ride_height,
    ]
    tests = [math.floor(255 * min(1, share)) for share in shares]
    return [*tests, 255 if max(tests) > 245 else math.floor(np.mean(tests))]


def test_costs_are_those_of_the_formulas():
    heights = np.asarray(generate_terrain("scattered_sharp", [4])[0], np.float64)
    heights[60, 70] = np.nan
    setup = setup_of(ROBOT, 1, 0.25)
    lattice = setup.lattice(heights.shape)
    (tile,) = tiles_of(lattice, setup)
    ground = ArrayGround(heights.astype(np.float32)).part(*tile.ground(setup))
    found = np.asarray(geometric_tile(ground, setup))[:, : lattice[0], : lattice[1]]
    reach = math.hypot(ROBOT.overall_length, ROBOT.overall_width) / 2
    rows, cols = np.mgrid[: lattice[0], : lattice[1]] * 4
    edge = np.minimum(np.minimum(rows, 128 - rows), np.minimum(cols, 128 - cols)) * 0.0625
    known = (edge >= reach) & (np.hypot(rows - 60, cols - 70) * 0.0625 > reach)
    np.testing.assert_array_equal(~np.isnan(found[-1]), known)
    places = np.argwhere(known)[::7]
    wanted = [by_the_formulas(heights, *(4 * place), 0.0625) for place in places]
    differences = np.abs(found[:, places[:, 0], places[:, 1]].T - wanted)
    assert (differences > 0).mean() < 0.01 and np.delete(
        differences, 3, axis=1
    ).max() <= 1  # a share near a whole number
    assert (found[-1] == 255).any() and (found[-1] < 255).any()


def test_the_disc_is_that_of_the_robot_s_diagonal():
    offsets = disc(ROBOT, 0.0625)
    assert len(offsets) == 429 and (offsets[len(offsets) // 2] == 0).all() and (offsets.sum(axis=0) == 0).all()


def test_the_command_compares_it_with_the_map_of_passes(tmp_path):
    rasterio = pytest.importorskip("rasterio", reason="the extra geo is not installed")
    np.savez(tmp_path / "site.npz", heights=generate_terrain("scattered_sharp", [4])[0], cell_size=0.0625)
    words = ("map", tmp_path / "site.npz", "--headings", 2, "--out", tmp_path / "out")
    code, text, err = run_words(*words, "--method", "geometric")
    assert code == 0 and "beside that of passes" not in text, err
    with rasterio.open(tmp_path / "out/geometric.tif") as file:
        assert file.descriptions == ("roughness", "slope", "obstacle", "cost") and file.res == (0.25, 0.25)
    assert run_words(*words)[0] == 0
    code, text, err = run_words(*words, "--method", "geometric")
    assert code == 0 and "forbidden by the geometric map" in text, err
    assert (tmp_path / "out/nav2/geometric.yaml").exists()
    code, text, err = run_words(*words, "--method", "geometric", "--stride", 0.5)
    assert code == 0 and "beside that of passes" not in text, err  # of other places
    code, _, err = run_words(*words, "--method", "geometric", "--scheduler", "local")
    assert code == 2 and "--scheduler = 'local': must be left out with --method geometric" in err
