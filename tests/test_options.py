"""The typed values that options stand for."""

import pytest

from tests.commandline import FEW
from travjax import options
from travjax.config import InputError
from travjax.data.map_batches import WindowOptions
from travjax.entry import Parser
from travjax.rasters.reading_options import DemOptions
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup


def parser() -> Parser:
    """Options of maps, and of where and how their trajectories run."""
    made = Parser(prog="test")
    made.add_argument("dem", nargs="*")
    options.add_synthetic(made, count=7, each="maps")
    options.add_dem(made, stride=8.0)
    options.add_robot(made)
    options.add_grid(made)
    return made


def test_defaults_are_those_of_the_library():
    arguments = parser().parse_args([])
    assert options.setup(arguments) == Setup(Robot.load("seekur_jr"))
    assert options.windows(arguments) == WindowOptions()
    assert (options.count(arguments), options.seed(arguments)) == (7, 0)


def test_what_is_given_is_taken(few):
    words = ["--robot", "husky_a200", "--actions", few, "--size", 4, "--spacing", 0.125, "--stride", 3, "--up", "y"]
    words += ["--keep-holes", "--allow-coarse", "--classes", "2,9", "--gdal-driver", "BAG", "--count", 2, "--seed", 5]
    arguments = parser().parse_args([*map(str, words)])
    assert options.setup(arguments) == Setup(Robot.load("husky_a200"), FEW, Grid(4, 0.125))
    reading = DemOptions(classes=(2, 9), up="y", gdal_drivers=("BAG",))
    assert options.windows(arguments) == WindowOptions(reading, 3.0, fill_holes=False, allow_coarse=True)
    assert (options.count(arguments), options.seed(arguments)) == (2, 5)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a.tif", "--seed", "0"], "--seed = 0: must be left out where DEM files are given"),
        (["--keep-holes"], "--keep-holes = True: must be left out where no DEM file is given"),
        (["--count", "0"], "--count = 0: must be at least 1"),
    ],
)
def test_options_of_other_maps_are_refused(words, message):
    with pytest.raises(InputError, match=f"^{message}$"):
        options.maps(parser().parse_args(words), Grid())


def test_all_options_of_a_run_are_named():
    made = Parser(prog="test")
    options.add_run(made)
    assert set(vars(made.parse_args([]))) == set(options.RUN_OPTIONS)
