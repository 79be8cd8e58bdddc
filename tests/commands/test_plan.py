"""`travjax plan`: what it writes and prints, and its exit codes."""

import numpy as np
import pytest

from tests.commandline import run_words
from tests.planning.sites import SPACING, walled

rasterio = pytest.importorskip("rasterio", reason="the extra geo is not installed")

QUICK = ("--headings", 8, "--spacing", SPACING, "--contact", "nearest")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A site with a wall, open in the east; its south-west node lies at (1000, 2000)."""
    path = tmp_path_factory.mktemp("site") / "site.tif"
    heights = walled().astype(np.float32)
    corner = rasterio.Affine(SPACING, 0, 1000 - SPACING / 2, 0, -SPACING, 2000 + (len(heights) - 0.5) * SPACING)
    profile = dict(driver="GTiff", count=1, height=len(heights), width=len(heights), dtype="float32", transform=corner)
    with rasterio.open(path, "w", **profile) as file:
        file.write(heights[::-1], 1)
    return path


def test_a_path_is_written_and_its_check_printed(site, tmp_path):
    words = ("plan", site, "--from", 1002, 2001.5, 0, "--to", 1002, 2006.5, *QUICK, "--to-go", "--out", tmp_path)
    code, text, err = run_words(*words)
    assert code == 0 and "planning: " in err and "travjax:" not in err  # bars, no message
    assert "poses that exceed a limit: 0" in text and "Seekur Jr, nearest, 8 headings" in text
    for name in ("plan.png", "plan.txt", "to_go.tif", "to_go.png"):
        assert str(tmp_path / name) in text and (tmp_path / name).stat().st_size > 100
    with rasterio.open(tmp_path / "to_go.tif") as file:
        assert file.descriptions == ("cost_to_go", "direction_deg")
        cost = {place: next(file.sample([place]))[0] for place in ((1002, 2006.5), (1002, 2001.5), (1002, 2004))}
    assert cost[1002, 2006.5] == 0 and cost[1002, 2001.5] > 9 and np.isnan(cost[1002, 2004])


def test_without_a_path_the_exit_code_is_1_and_the_reason_is_drawn(site, tmp_path):
    words = ("plan", site, "--from", 1002, 2001.5, "--to", 1002, 2004, *QUICK, "--out", tmp_path)
    code, text, err = run_words(*words)
    assert code == 1 and "travjax:" not in err
    assert "goal = (1002.0, 2004.0): the robot cannot stand there" in text
    assert {path.name for path in tmp_path.iterdir()} >= {"no_path.png", "no_path.txt"}


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--from", 1, 2, "--to", 1002, 2006), "start = (1.0, 2.0): must be on the site"),
        (("--from", 1002, 2004, "--to", 1002, 2006), "start = (1002.0, 2004.0): the robot cannot stand there"),
        (("--to", 1002, 2006), "--from = None: must be given, unless --to-go is"),
        (("--from", 1002, "--to", 1002, 2006), "--from = [1002.0]: must be X Y, or X Y DEG with the heading"),
        (("--from", 1002, 2001, "--to", 1002, 2006, "--unknown-cost", 0.5), "unknown_cost = 0.5: must be a factor of"),
        (("--from", 1002, 2001, "--to", 1002, 2006, "--threshold", 0), "--threshold = '0.0': must be left out without"),
        (("--from", 1002, 2001, "--to", 1002, 2006, "--route-graph", "none/graph.geojson"), "--route-graph = 'none/gr"),
        (("--from", 1002, 2001, "--to", 1002, 2006, "--coordinates", "latlon"), "x and y, since the site has no"),
        (("--from", 1002, 2001, "--to", 1002, 2006, "--primitives", "none.toml"), "none.toml: cannot be read"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(site, tmp_path, words, line):
    code, _, err = run_words("plan", site, *words, *QUICK, "--out", tmp_path / "out")
    assert code == 2 and line in err and err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_file_in_place_of_the_folder_is_refused_before_anything_is_planned(site):
    code, text, err = run_words("plan", site, "--from", 1002, 2001, "--to", 1002, 2006, *QUICK, "--out", site)
    assert (code, text, err) == (2, "", f"travjax: --out = {str(site)!r}: must be a folder\n")


def test_primitives_are_read_from_a_file(site, tmp_path):
    (tmp_path / "mine.toml").write_text("point_turns = false\nreverse = true\nrisk = 0.0\n")
    words = ("--from", 1002, 2001.5, 0, "--to", 1002, 2001, 0, "--primitives", tmp_path / "mine.toml")
    code, text, err = run_words("plan", site, *words, *QUICK, "--out", tmp_path / "out")
    assert code == 0 and "path of 0.50 m, cost 1.00" in text
    (tmp_path / "mine.toml").write_text("turns = [2, -2]\npoint_turns = false\n")
    code, _, err = run_words("plan", site, *words, *QUICK, "--out", tmp_path / "out")
    assert code == 2 and "turns = " in err and "every heading and place can be reached" in err
