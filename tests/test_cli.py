"""The command line end to end, and the one line for each bad input."""

import hashlib
import json
import os
import re
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from PIL import Image

import travjax
from tests.commandline import FEW, Run, files, printed_files, run, run_words, succeeds
from travjax import cli
from travjax.config import to_json
from travjax.data import map_batches
from travjax.evaluation import map_reports
from travjax.evaluation.tables import shares_table
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot
from travjax.terrain.rock_field import RockFieldParams, rock_field
from travjax.terrain.styles import FIELDS

CELL = 0.0625
SEEKUR_JR = Robot.load("seekur_jr")


# ---- Synthetic maps


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory) -> Run:
    """Four maps labelled for the Seekur Jr and the paper's action space, with figures."""
    return succeeds(tmp_path_factory.mktemp("runs") / "synthetic", "label", "--count", 4, "--seed", 3)


def test_maps_are_of_the_styles_in_turn_with_seeds_that_count_on(synthetic):
    arrays = synthetic.arrays()
    assert arrays["group"].tolist() == ["mountain_crater", "smooth", "rough", "wavy"]
    assert arrays["seed"].tolist() == [3, 4, 5, 6]


def test_the_file_is_enough_to_make_every_map_again(synthetic):
    arrays = synthetic.arrays()
    params = travjax.TerrainParams(**{field: arrays[field] for field in FIELDS})
    again = travjax.elevation(params, arrays["noise_seed"])
    np.testing.assert_array_equal(arrays["heights"], again)
    one = travjax.TerrainParams(**{field: float(arrays[field][2]) for field in FIELDS})
    np.testing.assert_allclose(
        travjax.elevation(one, int(arrays["noise_seed"][2])), arrays["heights"][2], rtol=0, atol=1e-6
    )


def test_style_and_seed_are_enough_to_make_every_map_again(synthetic):
    arrays = synthetic.arrays()
    again = travjax.generate_terrain(arrays["group"].tolist(), arrays["seed"])
    np.testing.assert_array_equal(arrays["heights"], again)


def test_margins_and_failures_in_the_file_are_those_of_its_heights(synthetic):
    arrays = synthetic.arrays()
    margins = travjax.simulate(arrays["heights"])
    for name in ("step", "obstacle", "tilt", "known"):
        np.testing.assert_array_equal(arrays[name], getattr(margins, name))
        assert arrays[name].shape == (4, 3042)
    np.testing.assert_array_equal(arrays["failed"], travjax.label(arrays["heights"]))
    assert arrays["failed"].shape == (4, 3042, 3)
    assert 0 < arrays["failed"].any(axis=-1).mean() < 1


def test_the_configuration_in_the_file_makes_robot_actions_and_grid_again(synthetic):
    arrays = synthetic.arrays()
    config = json.loads(str(arrays["config"]))
    assert Robot(**config["robot"]) == SEEKUR_JR
    radii = [float(radius) for radius in config["actions"]["radii"]]
    assert ActionSpace(**config["actions"] | {"radii": radii}) == ActionSpace()
    assert Grid(**config["grid"]) == Grid()
    assert config["travjax"] == travjax.__version__
    assert arrays["cell_size"] == CELL


def test_the_printed_table_is_that_of_the_file(synthetic):
    arrays = synthetic.arrays()
    table = shares_table(arrays["group"], arrays["failed"], arrays["known"])
    assert table in synthetic.out
    assert "Seekur Jr, 3042 trajectories a map" in synthetic.out
    assert (synthetic.folder / "shares.txt").read_text().startswith(f"{table}\n\n")
    assert re.search(r"paper's test set +6\.23% +5\.50% +0\.42% +9\.60%", synthetic.out)


def test_every_file_that_is_written_is_printed_and_the_other_way_round(synthetic):
    names = ["shares.txt", "labels.npz", "labels.png", "robot.png", "actions.png"]
    assert printed_files(synthetic) == files(synthetic.folder) == {synthetic.folder / name for name in names}


@pytest.mark.parametrize("name", ["labels.png", "robot.png", "actions.png"])
def test_figures_can_be_opened_and_are_not_empty(synthetic, name):
    with Image.open(synthetic.folder / name) as image:
        assert min(image.size) > 400
        values = np.asarray(image.convert("L"))
    assert len(np.unique(values)) > 50


def test_progress_is_shown_with_a_rate_and_the_time_left(synthetic):
    last = synthetic.err.replace("\r", "\n").strip().splitlines()[-1]
    assert re.search(r"^labelling: 100%.* 4/4 \[\d+:\d+<\d+:\d+, +[\d.]+(map/s|s/map)\]$", last)


def test_the_same_seed_gives_equal_arrays_and_another_one_does_not(synthetic, tmp_path):
    first = synthetic.arrays()
    again = succeeds(tmp_path / "again", "label", "--count", 4, "--seed", 3, "--no-figures").arrays()
    assert set(again) == set(first)
    for name in first:
        np.testing.assert_array_equal(again[name], first[name])
    other = succeeds(tmp_path / "other", "label", "--count", 4, "--seed", 7, "--no-figures").arrays()
    assert not np.array_equal(other["heights"], first["heights"])
    assert not np.array_equal(other["failed"], first["failed"])


def test_styles_are_those_asked_for(tmp_path, few):
    words = ("label", "--style", "wavy", "smooth", "--count", 3, "--actions", few, "--no-figures")
    arrays = succeeds(tmp_path, *words).arrays()
    assert arrays["group"].tolist() == ["wavy", "smooth", "wavy"]
    assert arrays["seed"].tolist() == [0, 1, 2]
    np.testing.assert_array_equal(arrays["heights"], travjax.generate_terrain(["wavy", "smooth", "wavy"], range(3)))


def test_without_figures_there_is_a_file_of_labels_and_a_table(tmp_path, few):
    done = succeeds(tmp_path / "new" / "folder", "label", "--count", 1, "--actions", few, "--no-figures")
    assert printed_files(done) == files(done.folder) == {done.folder / "shares.txt", done.folder / "labels.npz"}


def test_a_second_run_replaces_the_files_of_the_first(tmp_path, few):
    for seed in (0, 5):
        words = ("label", "--count", 1, "--actions", few, "--no-figures", "--seed", seed)
        assert succeeds(tmp_path, *words).arrays()["seed"].tolist() == [seed]
    assert {path.name for path in files(tmp_path)} == {"shares.txt", "labels.npz"}


# ---- Robots, actions, grids


def test_a_preset_robot_labels_by_its_own_limits(tmp_path, few):
    done = succeeds(tmp_path, "label", "--count", 1, "--robot", "husky_a200", "--actions", few, "--no-figures")
    husky, arrays = Robot.load("husky_a200"), done.arrays()
    assert Robot(**json.loads(str(arrays["config"]))["robot"]) == husky
    assert f"{husky.name}, 18 trajectories a map" in done.out
    np.testing.assert_array_equal(arrays["step"], travjax.simulate(arrays["heights"], husky, FEW).step)
    np.testing.assert_array_equal(arrays["failed"], travjax.label(arrays["heights"], husky, FEW))


def test_a_robot_and_actions_of_ones_own_are_taken(tmp_path, few):
    frail = replace(SEEKUR_JR, name="Frail", max_step=1e-3, max_tilt=1.5, track=0.7)
    path = tmp_path / "frail.toml"
    path.write_text("\n".join(f"{name} = {json.dumps(value)}" for name, value in to_json(frail).items()))
    done = succeeds(tmp_path / "out", "label", "--count", 1, "--robot", path, "--actions", few, "--no-figures")
    arrays = done.arrays()
    assert "Frail, 18 trajectories a map" in done.out
    assert arrays["failed"][..., 0].all()
    assert not arrays["failed"][..., 2].any()
    np.testing.assert_array_equal(arrays["tilt"], travjax.simulate(arrays["heights"], frail, FEW).tilt)


@pytest.mark.parametrize("command", ["label", "terrain", "dataset"])
def test_a_world_makes_the_same_ground_on_a_larger_map_and_is_recorded(tmp_path, few, command):
    words = {
        "label": ("label", "--count", 5, "--actions", few, "--no-figures"),
        "terrain": ("terrain", "--count", 1),
        "dataset": ("dataset", "--maps", 5, "--actions", few),
    }[command]

    def heights(name: str, *more) -> tuple[np.ndarray, str]:
        done = succeeds(tmp_path / name, *words, "--spacing", 0.125, *more)
        if command == "dataset":
            return np.load(done.folder / "heights.npy"), done.out
        return done.arrays("labels.npz" if command == "label" else "terrain.npz")["heights"], done.out

    def world() -> float:
        if command == "dataset":
            return json.loads((tmp_path / "large/dataset.json").read_text())["config"]["world"]
        with np.load(tmp_path / "large" / ("labels.npz" if command == "label" else "terrain.npz")) as file:
            return json.loads(str(file["config"]))["world"] if command == "label" else file["world"]

    small, said = heights("small")
    assert "features" not in said
    large, said = heights("large", "--size", 12, "--world", 8)
    np.testing.assert_array_equal(large[:, 16:81, 16:81], small)
    assert "synthetic maps of 12 m with the features of 8 m maps\n" in said
    assert world() == 8
    grown, said = heights("grown", "--size", 12)
    assert not np.array_equal(grown, large)
    assert "synthetic maps of 12 m: their features grow with the map; a world of 8 m makes the ground" in said


def test_size_and_spacing_make_another_grid(tmp_path, few):
    grid = Grid(4.0, 0.125)
    words = ("label", "--count", 2, "--size", 4, "--spacing", 0.125, "--actions", few, "--no-figures")
    arrays = succeeds(tmp_path, *words).arrays()
    assert arrays["cell_size"] == 0.125
    assert Grid(**json.loads(str(arrays["config"]))["grid"]) == grid
    again = travjax.generate_terrain(["mountain_crater", "smooth"], range(2), grid=grid)
    np.testing.assert_array_equal(arrays["heights"], again)
    margins = travjax.simulate(arrays["heights"], SEEKUR_JR, FEW, grid=grid)
    np.testing.assert_array_equal(arrays["obstacle"], margins.obstacle)


# ---- Terrain


@pytest.fixture(scope="module")
def terrain(tmp_path_factory) -> Run:
    """Two maps each of two styles."""
    folder = tmp_path_factory.mktemp("runs") / "terrain"
    return succeeds(folder, "terrain", "--style", "rough", "wavy", "--count", 2, "--seed", 11)


def test_terrain_writes_maps_and_a_picture_for_each_style(terrain):
    names = ["terrain.npz", "terrain_rough.png", "terrain_wavy.png"]
    assert printed_files(terrain) == files(terrain.folder) == {terrain.folder / name for name in names}
    for name in names[1:]:
        with Image.open(terrain.folder / name) as image:
            assert len(np.unique(np.asarray(image.convert("L")))) > 50


def test_terrain_writes_the_count_of_maps_of_each_style_with_all_that_makes_them(terrain):
    arrays = terrain.arrays("terrain.npz")
    assert arrays["group"].tolist() == ["rough", "rough", "wavy", "wavy"]
    assert arrays["seed"].tolist() == [11, 12, 11, 12]
    params = travjax.TerrainParams(**{field: arrays[field] for field in FIELDS})
    np.testing.assert_array_equal(arrays["heights"], travjax.elevation(params, arrays["noise_seed"]))
    assert arrays["cell_size"] == CELL


def test_terrain_shows_progress_with_a_rate(terrain):
    assert re.search(r"terrain: 100%.*4/4 .*(map/s|s/map)", terrain.err)


def test_maps_of_the_terrain_command_can_be_labelled_from_their_file(terrain, tmp_path):
    done = succeeds(tmp_path, "label", terrain.folder / "terrain.npz", "--no-figures")
    arrays, made = done.arrays(), terrain.arrays("terrain.npz")
    assert arrays["group"].tolist() == ["terrain.npz"] * 4
    # The file's height offset is a whole number of metres, taken off in float64.
    heights = arrays["heights"] + arrays["height_offset"][:, None, None]
    np.testing.assert_allclose(heights, made["heights"], rtol=0, atol=1e-6)
    margins = travjax.simulate(made["heights"])
    np.testing.assert_allclose(arrays["step"], margins.step, rtol=0, atol=2e-6)
    np.testing.assert_array_equal(arrays["failed"], travjax.label(arrays["heights"]))


def test_rock_fields_are_written_with_all_that_makes_them(tmp_path):
    done = succeeds(tmp_path, "terrain", "--style", "rock_field", "--count", 2, "--seed", 3, "--size", 4)
    assert printed_files(done) == {tmp_path / "terrain.npz", tmp_path / "terrain_rock_field.png"}
    arrays = done.arrays("terrain.npz")
    assert arrays["heights"].shape == (2, 65, 65) and arrays["seed"].tolist() == [3, 4] and "world" not in arrays
    names = [field.name for field in fields(RockFieldParams)]
    params = RockFieldParams(**{name: float(arrays[name][1]) for name in names})
    np.testing.assert_array_equal(arrays["heights"][1], rock_field(params, 4, (65, 65), CELL).astype(np.float32))


def test_rock_fields_are_labelled_and_not_compared_with_the_paper(tmp_path):
    done = succeeds(tmp_path, "label", "--style", "rock_field", "--count", 1, "--no-figures")
    arrays = done.arrays()
    assert arrays["group"].tolist() == ["rock_field"] and "rock_abundance" in arrays
    np.testing.assert_array_equal(arrays["heights"], travjax.generate_terrain("rock_field", [0]))
    np.testing.assert_array_equal(arrays["failed"], travjax.label(arrays["heights"]))
    assert "paper" not in done.out


# ---- Elevation maps


def write_geotiff(path: Path, heights: np.ndarray, **options) -> Path:
    """Heights [rows, cols] with row 0 in the south, or bands of them, as a GeoTIFF."""
    bands = heights if heights.ndim == 3 else heights[None]
    cell = options.pop("cell", CELL)
    profile = dict(count=len(bands), height=bands.shape[1], width=bands.shape[2], dtype=bands.dtype)
    options = dict(transform=Affine(cell, 0, 500, 0, -cell, 900)) | options
    with rasterio.open(path, "w", driver="GTiff", **profile, **options) as file:
        file.write(bands[:, ::-1])
    return path


def rugged(rows: int = 140, cols: int = 150) -> np.ndarray:
    """A map on which some trajectories fail."""
    y, x = CELL * np.arange(rows)[:, None], CELL * np.arange(cols)
    bumps = 0.01 * np.random.default_rng(0).standard_normal((rows, cols))
    return (0.5 * np.sin(x) * np.cos(0.7 * y) + bumps).astype(np.float32)


def with_holes() -> np.ndarray:
    """The rugged map, a small and a large piece of it unknown."""
    heights = rugged()
    heights[40:42, 100:102] = np.nan
    heights[80:100, 60:75] = np.nan
    return heights


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    return write_geotiff(tmp_path_factory.mktemp("site") / "site.tif", with_holes(), crs="EPSG:32632")


@pytest.fixture(scope="module")
def real(tmp_path_factory, site) -> Run:
    """A GeoTIFF with holes, labelled with figures."""
    return succeeds(tmp_path_factory.mktemp("runs") / "real", "label", site)


def test_windows_of_a_geotiff_are_those_of_load_dem_with_where_they_come_from(real, site):
    windows, arrays = travjax.load_dem(site), real.arrays()
    np.testing.assert_array_equal(arrays["heights"], windows.heights)
    np.testing.assert_array_equal(arrays["origin"], windows.origins)
    assert arrays["group"].tolist() == ["site.tif"]
    assert arrays["crs"].tolist() == ["EPSG:32632"]
    assert arrays["height_offset"].tolist() == [windows.height_offset]
    (read,) = json.loads(str(arrays["config"]))["files"]
    assert read["sha256"] == hashlib.sha256(site.read_bytes()).hexdigest()
    assert read["path"] == str(site)
    assert (read["stride"], read["cell_size"], read["fill_holes"]) == (8, CELL, True)


def test_labels_can_be_labelled_again(real, tmp_path, few):
    words = ("label", real.folder / "labels.npz", "--actions", few, "--no-figures")
    again, arrays = succeeds(tmp_path / "out", *words).arrays(), real.arrays()
    np.testing.assert_array_equal(again["origin"], arrays["origin"])
    np.testing.assert_allclose(again["heights"], arrays["heights"], rtol=0, atol=1e-5)
    assert again["crs"].tolist() == arrays["crs"].tolist()


def test_labels_of_a_geotiff_are_those_of_its_heights_and_unknown_ground_fails_nowhere(real):
    arrays = real.arrays()
    margins = travjax.simulate(arrays["heights"])
    for name in ("step", "obstacle", "tilt", "known"):
        np.testing.assert_array_equal(arrays[name], getattr(margins, name))
    np.testing.assert_array_equal(arrays["failed"], travjax.label(arrays["heights"]))
    unknown = ~arrays["known"]
    assert 0.02 < unknown.mean() < 0.98
    assert np.isnan(arrays["tilt"][unknown]).all()
    assert not arrays["failed"][unknown].any()
    assert arrays["failed"][arrays["known"]].any()


def test_what_was_read_from_a_geotiff_is_printed(real, site):
    line = next(line for line in real.out.splitlines() if line.startswith(f"{site}: "))
    assert "1 windows" in line
    assert "cells of 0.0625 m" in line
    assert "crs EPSG:32632" in line
    assert f"{4 / (140 * 150):.3%} filled" in line
    assert f"{300 / (140 * 150):.1%} unknown" in line
    assert "1 windows cover 79.1%" in line
    arrays = real.arrays()
    assert shares_table(arrays["group"], arrays["failed"], arrays["known"], as_in_paper=False) in real.out


def test_figures_of_a_geotiff_are_written_and_printed(real):
    names = ["shares.txt", "labels.npz", "labels.png", "robot.png", "actions.png"]
    assert printed_files(real) == files(real.folder) == {real.folder / name for name in names}


def test_several_files_are_labelled_together(site, tmp_path, few):
    np.savez(tmp_path / "other.npz", heights=rugged(129, 257), cell_size=CELL)
    words = ("label", site, tmp_path / "other.npz", "--actions", few, "--no-figures")
    done = succeeds(tmp_path / "out", *words)
    assert done.arrays()["group"].tolist() == ["site.tif", "other.npz", "other.npz"]
    assert done.arrays()["crs"].tolist() == ["EPSG:32632", "", ""]
    assert re.search(r"overall +3 ", done.out)
    assert "labelling: 100%" in done.err
    assert "3/3" in done.err


def test_holes_can_be_kept(site, tmp_path, few):
    filled, kept = (
        succeeds(tmp_path / name, "label", site, "--actions", few, "--no-figures", *more).arrays()["heights"]
        for name, more in (("filled", []), ("kept", ["--keep-holes"]))
    )
    assert np.isnan(kept).sum() - np.isnan(filled).sum() == 4


def test_windows_overlap_by_the_stride(tmp_path, few):
    np.savez(tmp_path / "site.npz", heights=rugged(145, 129), cell_size=CELL, origin=(10.0, 20.0))
    words = ("label", tmp_path / "site.npz", "--stride", 0.5, "--actions", few, "--no-figures")
    assert succeeds(tmp_path / "out", *words).arrays()["origin"].tolist() == [[10, 20], [10, 20.5], [10, 21]]


def test_a_cell_size_and_a_missing_value_can_be_given(tmp_path, few):
    heights = np.nan_to_num(with_holes(), nan=-77)
    np.save(tmp_path / "site.npy", heights)
    words = ("label", tmp_path / "site.npy", "--cell-size", CELL, "--nodata", -77, "--actions", few, "--no-figures")
    one = succeeds(tmp_path / "out", *words).arrays()["heights"]
    assert np.isnan(one).sum() == 300
    assert np.nanmin(one) > -2


def test_coarse_cells_can_be_allowed(tmp_path, few):
    np.savez(tmp_path / "site.npz", heights=rugged(60, 60), cell_size=0.2)
    words = ("label", tmp_path / "site.npz", "--actions", few, "--no-figures")
    assert "--allow-coarse" in run(tmp_path / "out", *words).err
    assert len(succeeds(tmp_path / "out", *words, "--allow-coarse").arrays()["heights"]) == 1


# ---- Maps that are shown


@pytest.mark.parametrize("groups", [1, 2, 3, 5, 7])
@pytest.mark.parametrize("count", [1, 2, 4, 5, 6, 9, 40])
def test_up_to_five_maps_are_shown_each_once_and_from_as_many_groups_as_can_be(groups, count):
    rates = np.linspace(0, 1, groups * count)
    maps = {
        "group": np.array([f"group {number % groups}" for number in range(groups * count)]),
        "failed": np.repeat((np.arange(100) < 100 * rates[:, None])[..., None], 3, axis=-1),
        "known": np.ones((groups * count, 100), bool),
    }
    chosen = map_batches.samples(maps)
    assert len(set(chosen.tolist())) == len(chosen)
    assert 1 <= len(chosen) <= 5
    assert len(set(maps["group"][chosen])) == min(groups, 5)


# ---- Bad input


ROBOT = "\n".join(f"{name} = {json.dumps(value)}" for name, value in to_json(SEEKUR_JR).items())


@pytest.fixture(scope="module")
def bad(tmp_path_factory) -> Path:
    """A folder of files each of which is wrong in one way."""
    folder = tmp_path_factory.mktemp("bad")
    flat = np.zeros((140, 150), np.float32)
    (folder / "text.tif").write_text("no map\n")
    (folder / "folder.tif").mkdir()
    write_geotiff(folder / "photo.tif", np.zeros((3, 140, 150), np.uint8))
    write_geotiff(folder / "degrees.tif", flat, crs="EPSG:4326", cell=1e-6)
    write_geotiff(folder / "oblong.tif", flat, transform=Affine(0.06, 0, 0, 0, -0.07, 0))
    write_geotiff(folder / "turned.tif", flat, transform=Affine(0.06, 0.01, 0, 0.01, -0.06, 0))
    write_geotiff(folder / "coarse.tif", flat, cell=0.5)
    write_geotiff(folder / "cut.tif", rugged())
    np.savez(folder / "cut.npz", heights=rugged(), cell_size=CELL)
    for name in ("cut.tif", "cut.npz"):
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: len(content) // 2])
    np.save(folder / "bare.npy", flat)
    np.savez(folder / "good.npz", heights=flat, cell_size=CELL)
    for name, heights in {
        "nan": flat * np.nan,
        "inf": np.where(rugged() > 0.5, np.inf, 0),
        "absurd": flat + 1e6,
        "marked": np.where(rugged() > 0.5, -9999, 0),
        "small": flat[:100],
        "words": flat.astype("U3"),
        "flat": flat[0],
    }.items():
        np.savez(folder / f"{name}.npz", heights=heights, cell_size=CELL)
    np.savez(folder / "zero_cell.npz", heights=flat, cell_size=0.0)
    np.savez(folder / "no_cell.npz", heights=flat)
    np.savez(folder / "no_heights.npz", elevation=flat, cell_size=CELL)
    (folder / "negative.toml").write_text(ROBOT.replace("track = 0.663", "track = -0.663"))
    (folder / "incomplete.toml").write_text(ROBOT.replace("track = 0.663", ""))
    (folder / "unknown_key.toml").write_text(ROBOT + "\nwheels = 4\n")
    (folder / "not.toml").write_text("this is no TOML\n")
    (folder / "tight.toml").write_text("radii = [inf, 0.2]\n")
    (folder / "zero.toml").write_text("radii = [inf, 0.0]\n")
    (folder / "far.toml").write_text("turns = 2\nradii = [inf]\narc_lengths = [3.0, 3.0]\n")
    (folder / "turns.toml").write_text("turns = 0\n")
    return folder


BAD_DEMS = {
    "missing.tif": "no such file",
    "missing.npz": "no such file",
    "folder.tif": "",
    "text.tif": "not a raster that can be read",
    "photo.tif": "bands = 3: must be 1",
    "degrees.tif": "crs = EPSG:4326: is in degrees",
    "oblong.tif": "cell_size = 0.06 x 0.07: must be square",
    "turned.tif": "transform = .* without rotation",
    "coarse.tif": "cell_size = 0.5: must be at most 0.125 m",
    "cut.tif": ".*read",
    "cut.npz": ".*read",
    "bare.npy": "cell_size is missing",
    "no_cell.npz": "cell_size is missing",
    "zero_cell.npz": "cell_size = 0.0: must be metres, above 0",
    "no_heights.npz": "no array `heights`; it holds: elevation, cell_size",
    "nan.npz": "heights: all unknown",
    "inf.npz": "heights = inf: ",
    "absurd.npz": r"heights = 1e\+06: must lie between -12000 and 30000 m",
    "marked.npz": "heights = -9999: .*--nodata",
    "small.npz": "size = 9.3125 x 6.1875 m: must be at least 8 x 8 m",
    "words.npz": r"heights: <U3 \[140, 150\]: must be numbers",
    "flat.npz": r"heights: float32 \[150\]: must be numbers",
}

BAD_WORDS = {
    "zero count": (["label", "--count", "0"], "--count = 0: must be at least 1"),
    "zero maps of each style": (["terrain", "--count", "0"], "--count = 0: must be at least 1"),
    "negative count": (["label", "--count", "-3"], "--count = -3: must be at least 1"),
    "count that is no number": (["label", "--count", "many"], "--count.*'many'"),
    "negative seed": (["label", "--seed", "-1"], "--seed = -1: must be from 0 to"),
    "negative seed of terrain": (["terrain", "--seed", "-1"], "--seed = -1: must be from 0 to"),
    "large seed": (["label", "--seed", str(2**31)], "--seed = 2147483648: must be from 0 to 2147483647"),
    "unknown style": (["label", "--style", "bumpy"], "--style.*'bumpy'.*mountain_crater.*scattered_sharp"),
    "unknown style of terrain": (["terrain", "--style", "smooth", "bumpy"], "--style.*'bumpy'"),
    "rock fields beside other styles": (
        ["label", "--style", "rock_field", "rough"],
        r"style beside rock_field = \['rough'\]: must be left out",
    ),
    "world of rock fields": (["terrain", "--style", "rock_field", "--world", "8"], "world = 8.0: must be left out for"),
    "unknown option": (["label", "--fast"], "--fast"),
    "unknown command": (["guess"], "'guess'.*terrain.*label.*bench"),
    "no command": ([], "COMMAND|command"),
    "unknown robot": (
        ["label", "--robot", "tank"],
        "'tank': no such preset; allowed: husky_a200, leo_rover, seekur_jr",
    ),
    "missing robot": (["label", "--robot", "BAD/none.toml"], "BAD/none.toml: cannot be read: No such file"),
    "robot that is no TOML": (["label", "--robot", "BAD/not.toml"], "BAD/not.toml: not a TOML file"),
    "robot that lacks a dimension": (["label", "--robot", "BAD/incomplete.toml"], "BAD/incomplete.toml: missing track"),
    "robot with an unknown key": (["label", "--robot", "BAD/unknown_key.toml"], "unknown key 'wheels'; allowed: "),
    "negative dimension": (
        ["label", "--robot", "BAD/negative.toml"],
        "BAD/negative.toml: track = -0.663: must be a length in metres from 0.001",
    ),
    "bench with a negative dimension": (["bench", "--robot", "BAD/negative.toml"], "negative.toml: track = -0.663"),
    "missing actions": (["label", "--actions", "BAD/none.toml"], "BAD/none.toml: cannot be read"),
    "no point turns": (["label", "--actions", "BAD/turns.toml"], "BAD/turns.toml: turns = 0: must be"),
    "radius of 0": (["label", "--actions", "BAD/zero.toml"], "BAD/zero.toml: radii = 0.0: must be"),
    "radius inside the robot": (
        ["label", "--count", "1", "--actions", "BAD/tight.toml"],
        "radii = 0.2: must be at least half the track of Seekur Jr, 0.3315 m",
    ),
    "radius inside the robot on a DEM": (
        ["label", "BAD/good.npz", "--actions", "BAD/tight.toml"],
        "radii = 0.2: must be at least half the track of Seekur Jr, 0.3315 m",
    ),
    "trajectories that leave the map": (
        ["label", "--count", "1", "--actions", "BAD/far.toml"],
        "arc_lengths = .*: trajectories leave the 8 m map by 2.5 m; allowed: ",
    ),
    "trajectories that leave a small map": (
        ["label", "--count", "1", "--size", "4"],
        "arc_lengths = .*: trajectories leave the 4 m map by .* m; allowed: ",
    ),
    "trajectories that leave the window of a DEM": (
        ["label", "BAD/good.npz", "--size", "4"],
        "arc_lengths = .*: trajectories leave the 4 m map by .* m; allowed: ",
    ),
    "nodes too far apart": (["label", "--count", "1", "--spacing", "1"], "spacing = 1: too coarse for Seekur Jr"),
    "size of 0": (["label", "--size", "0"], "size = 0.0: must be"),
    "negative size": (["terrain", "--size", "-8"], "size = -8.0: must be"),
    "spacing that does not divide the size": (["label", "--spacing", "0.07"], "spacing = 0.07: must be a whole frac"),
    "count beside a DEM": (["label", "BAD/good.npz", "--count", "3"], "--count = 3: must be left out where DEM"),
    "seed beside a DEM": (["label", "BAD/good.npz", "--seed", "0"], "--seed = 0: must be left out where DEM files"),
    "style beside a DEM": (["label", "BAD/good.npz", "--style", "wavy"], "--style = .*wavy.*: must be left out where"),
    "stride of 0": (["label", "BAD/good.npz", "--stride", "0"], "stride = 0.0: must be a distance in metres, above 0"),
    "stride that is none": (["label", "BAD/good.npz", "--stride", "nan"], "stride = nan: must be"),
    "negative cell size": (["label", "BAD/bare.npy", "--cell-size", "-1"], "cell_size = -1.0: must be metres, above 0"),
    "good DEM beside a bad one": (["label", "BAD/good.npz", "BAD/nan.npz"], "BAD/nan.npz: heights: all unknown"),
    "no repeats": (["bench", "--repeats", "0"], "--repeats = 0: must be at least 1"),
    "negative stream": (["bench", "--stream", "-1"], "--stream = -1: must be at least 0"),
} | {name: (["label", f"BAD/{name}"], f"BAD/{name}: {line}") for name, line in BAD_DEMS.items()}


@pytest.mark.parametrize("name", BAD_WORDS)
def test_bad_input_is_one_line_with_exit_code_2_and_nothing_written(bad, tmp_path, name):
    words, expected = BAD_WORDS[name]
    old = tmp_path / "out" / "old.txt"
    old.parent.mkdir()
    old.write_text("old")
    words = [word.replace("BAD", str(bad)) for word in words]
    # Without a command there is no --out either.
    done = run(old.parent, *words) if words else Run(*run_words(), old.parent)
    assert done.code == 2
    assert "Traceback" not in done.err
    assert len(done.err.splitlines()) == 1, done.err
    assert done.err.startswith("travjax: ")
    assert re.search(expected.replace("BAD", re.escape(str(bad))), done.err)
    assert files(old.parent) == {old}
    assert old.read_text() == "old"


@pytest.mark.parametrize("name", ["zero count", "text.tif", "negative dimension", "radius inside the robot"])
def test_bad_input_makes_no_new_file_where_there_was_no_folder(bad, tmp_path, name):
    words = [word.replace("BAD", str(bad)) for word in BAD_WORDS[name][0]]
    assert run(tmp_path / "new" / "folder", *words).code == 2
    assert not [path for path in files(tmp_path) if path.is_file()]


@pytest.mark.parametrize("below", ["", "sub"])
@pytest.mark.parametrize(
    "words", [["label", "--count", "1"], ["terrain", "--count", "1"], ["bench"]], ids=lambda w: w[0]
)
def test_a_file_in_the_way_of_the_output_is_one_line(tmp_path, words, below):
    taken = tmp_path / "taken"
    taken.write_text("mine")
    done = run(taken / below, *words)
    assert done.code == 2
    assert len(done.err.splitlines()) == 1, done.err
    assert done.err.startswith(f"travjax: --out {taken / below}: cannot be written: ")
    assert "allowed: a folder you may write to" in done.err
    assert files(tmp_path) == {taken}
    assert taken.read_text() == "mine"


def test_a_folder_in_the_way_of_a_file_is_said_so_and_leaves_nothing_half_written(tmp_path, few):
    taken = tmp_path / "labels.npz"
    taken.mkdir()
    done = run(tmp_path, "label", "--count", 1, "--actions", few, "--no-figures")
    assert done.code == 2
    assert "Traceback" not in done.err
    assert "labels.npz" in done.err.splitlines()[-1]
    assert files(tmp_path) == {taken}


def test_an_interruption_is_one_line_and_leaves_nothing_half_written(tmp_path, few, monkeypatch):
    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(map_reports.NpzStream, "save", interrupt)
    done = run(tmp_path, "label", "--count", 1, "--actions", few, "--no-figures")
    assert done.code == 130
    assert done.err.splitlines()[-1] == "travjax: interrupted"
    assert not (tmp_path / "labels.npz").exists()


@pytest.mark.parametrize("words", [["--help"], ["label", "--help"], ["terrain", "--help"], ["bench", "--help"]])
def test_help_names_the_options(words, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(words)
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert shown.startswith("usage: travjax")
    assert ("--out" in shown) == (len(words) > 1)


def test_help_of_label_names_the_formats(capsys):
    with pytest.raises(SystemExit):
        cli.main(["label", "--help"])
    shown = " ".join(capsys.readouterr().out.split())
    for name in (
        "GeoTIFF",
        ".npz",
        ".xyz",
        ".csv",
        ".ply",
        ".laz",
        "--cell-size",
        "metres between windows of a DEM (8)",
    ):
        assert name in shown


def test_the_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"travjax {travjax.__version__}\n"


# ---- As a program


def program(*words, **environment) -> subprocess.CompletedProcess:
    """`python -m travjax words...` in a process of its own, with the environment that this one was started in."""
    ours = {"JAX_COMPILATION_CACHE_DIR", "TF_CPP_MIN_LOG_LEVEL"}  # set by conftest.py and by JAX
    variables = {"JAX_PLATFORMS": "cpu"} | {name: value for name, value in os.environ.items() if name not in ours}
    command = [sys.executable, "-m", "travjax", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=100, env=variables | environment)


def test_the_program_labels_and_a_second_start_compiles_nothing_anew(tmp_path):
    folder, cached = tmp_path / "out", tmp_path / "cache" / "travjax" / "jax"
    compiled = []
    for _ in range(2):
        words = ("label", "--count", 1, "--no-figures", "--out", folder)
        done = program(*words, XDG_CACHE_HOME=str(tmp_path / "cache"))
        assert done.returncode == 0, done.stderr[-2000:]
        # Nothing but the bar: no log lines of XLA, no warnings.
        lines = done.stderr.replace("\r", "\n").split("\n")
        assert [line[:300] for line in lines if line and not line.startswith("labelling: ")] == []
        compiled.append({path.name for path in files(cached) if path.name.endswith("-cache")})
    assert compiled[0] == compiled[1] != set()
    assert files(folder) == {folder / "labels.npz", folder / "shares.txt"}
    assert str(folder / "labels.npz") in done.stdout.splitlines()
    with np.load(folder / "labels.npz") as arrays:
        np.testing.assert_array_equal(arrays["failed"], travjax.label(arrays["heights"]))


def test_the_program_ends_with_code_2_and_one_line_on_a_file_cut_short(bad, tmp_path):
    # GDAL prints some errors by itself, which only a process of its own shows.
    done = program("label", bad / "cut.tif", "--out", tmp_path / "out")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1, done.stderr[-2000:]
    assert done.stderr.startswith(f"travjax: {bad / 'cut.tif'}: ")
    assert not [path for path in files(tmp_path) if path.is_file()]
