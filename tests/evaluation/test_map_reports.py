"""Maps that are made and labelled by a call; what is said of them is in tests/test_cli.py."""

import json

import numpy as np

from tests.commandline import FEW, files
from travjax.data.map_batches import MapStream
from travjax.evaluation.map_reports import label_maps, write_terrain
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.simulation.setup import Setup
from travjax.terrain.styles import generate_terrain
from travjax.traversal.traverse import failures, simulate

HUSKY, GRID = Robot.load("husky_a200"), Grid(4, 0.125)
SETUP = Setup(HUSKY, FEW, GRID)


def test_terrain_is_written_with_a_sheet_of_each_style(tmp_path):
    path = write_terrain(["rough", "smooth"], range(3, 5), GRID, str(tmp_path / "out"), world=8.0)
    assert files(path.parent) == {path, *(path.with_name(f"terrain_{style}.png") for style in ("rough", "smooth"))}
    with np.load(path) as made:
        assert made["seed"].tolist() == [3, 4, 3, 4] and made["world"] == 8.0
        heights = generate_terrain(["rough", "rough", "smooth", "smooth"], [3, 4, 3, 4], grid=GRID, world=8.0)
        np.testing.assert_array_equal(made["heights"], heights)


def test_labels_are_written_with_all_that_they_depend_on(tmp_path, capsys):
    maps = MapStream.synthetic(["rough"], [3, 4], GRID, 8.0)
    path = label_maps(maps, SETUP, tmp_path, figures=False)
    assert files(tmp_path) == {path, tmp_path / "shares.txt"}
    with np.load(path) as labels:
        margins = simulate(labels["heights"], HUSKY, FEW, grid=GRID)
        np.testing.assert_array_equal(labels["failed"], failures(margins, HUSKY))
        config = json.loads(str(labels["config"]))
    assert (config["world"], config["files"], config["robot"]["name"]) == (8.0, [], HUSKY.name)
    with np.load(path) as labels:
        assert labels["where_pose"].shape == (2, len(FEW), 3) and labels["where_node"].shape == (2, len(FEW), 3, 2)
    assert config["contact"] == {"model": "nearest", "turn": False}
    shown = capsys.readouterr().out
    assert all(table in shown for table in (tmp_path / "shares.txt").read_text().split("\n\n"))
