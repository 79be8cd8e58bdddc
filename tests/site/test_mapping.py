"""Maps of sites: costs and bands by the letter of SPEC section 13, files as GIS and Nav2 read them, and going on."""

import importlib.util
import math
import os
import re
import signal
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from tests.commandline import run_words
from travjax.config import InputError
from travjax.rasters.grid_maps import read_grid_map, write_grid_map
from travjax.rasters.reading_options import DemOptions
from travjax.simulation.events import Margins
from travjax.simulation.robot import Robot
from travjax.site import kernel, mapping
from travjax.site.costs import band_names, products
from travjax.site.ground import ArrayGround, SiteGround
from travjax.site.kernel import simulate_site
from travjax.site.mapping import map_site, save_map, setup_of
from travjax.site.primitives import straight_passes
from travjax.site.site_figures import EVENT_COLOURS
from travjax.site.store import FOLDER

rasterio = pytest.importorskip("rasterio", reason="the extra geo is not installed")

ROBOT = Robot.load("leo_rover")
EASTING, NORTHING = 300_000.5, 5_000_000.25
"""Metres, the middle of the site's south-west cell."""


def heights() -> np.ndarray:
    """An asymmetric site of 60 x 75 nodes: a wall in the west, a ramp in the north-east, a hole, row 0 in the south."""
    y, x = np.mgrid[:60, :75] * 0.0625
    ground = 0.4 * np.maximum(x + y - 4.5, 0) ** 2 + np.where((x > 1.0) & (x < 1.3) & (y < 2.5), 0.8, 0.0)
    ground[40:43, 30:34] = np.nan
    return ground + 812.0


@pytest.fixture(scope="module")
def site_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("site") / "site.tif"
    corner = rasterio.Affine(0.0625, 0, EASTING - 0.03125, 0, -0.0625, NORTHING + 59.5 * 0.0625)
    profile = dict(driver="GTiff", count=1, height=60, width=75, dtype="float32", crs="EPSG:32632", transform=corner)
    with rasterio.open(path, "w", nodata=-9999, **profile) as file:
        file.write(np.nan_to_num(heights()[::-1], nan=-9999).astype(np.float32), 1)
    return path


@pytest.fixture(scope="module")
def mapped(site_file, tmp_path_factory):
    """The folder of a map by four headings, and what the command printed."""
    out = tmp_path_factory.mktemp("map")
    words = ("map", site_file, "--robot", "leo_rover", "--headings", 4, "--keep-holes", "--out", out)
    code, text, err = run_words(*words)
    assert code == 0, err
    return out, text


def by_the_letter(margins: Margins, limits) -> tuple[np.ndarray, np.ndarray]:
    """Bands and costs of SPEC section 13, place by place."""
    values = (
        np.stack([margins.step, margins.obstacle, margins.tilt]) / np.array(limits, np.float32)[:, None, None, None]
    )
    known, (headings, rows, cols) = np.asarray(margins.known), margins.step.shape
    bands, costs = np.full((8, rows, cols), np.nan), np.full((headings, rows, cols), 255)
    for row, col in np.ndindex(rows, cols):
        ratios = {h: values[:, h, row, col] for h in range(headings) if known[h, row, col]}
        bands[1, row, col] = len(ratios)
        if not ratios:
            continue
        for h, ratio in ratios.items():
            worst = max(float(ratio.max()), 0.0)
            costs[h, row, col] = 100 if worst > 1 else math.floor(np.float32(99) * np.float32(worst))
        of_known = [costs[h, row, col] for h in ratios]
        largest = np.max(list(ratios.values()), axis=0)
        bands[0, row, col] = sum(ratio.max() <= 1 for ratio in ratios.values())
        bands[2:4, row, col] = min(of_known), max(of_known)
        bands[4:7, row, col] = largest
        bands[7, row, col] = 1 + largest.argmax() if largest.max() > 1 else 0
    return bands, costs


def test_bands_and_costs_are_those_of_the_specification():
    rng = np.random.default_rng(0)
    known = rng.random((5, 6, 7)) < 0.7
    known[:, 0, 0] = False
    fields = [np.where(known, rng.normal(0.5, 0.6, known.shape) * limit, np.nan) for limit in ROBOT.limits]
    margins = Margins(*(field.astype(np.float32) for field in fields), known)
    bands, costs = products(margins, ROBOT)
    wanted_bands, wanted_costs = by_the_letter(margins, ROBOT.limits)
    np.testing.assert_allclose(bands, wanted_bands, rtol=1e-6)
    np.testing.assert_array_equal(costs, wanted_costs)


def test_a_further_event_has_a_band_behind_the_others():
    robot = replace(ROBOT, max_roll=0.2)
    assert band_names(robot) == (*band_names(ROBOT), "roll")
    slope = 0.5 * np.arange(40)[:, None] * 0.0625 + np.zeros((40, 40))
    found = map_site(slope, robot, headings=4)
    middle = found.bands["known_headings"] == 4
    np.testing.assert_allclose(found.bands["roll"][middle], math.atan(0.5) / 0.2, rtol=1e-3)
    assert (found.bands["blocking_event"][middle] == 4).all()


def test_the_geotiffs_lie_where_the_site_does_and_hold_the_simulated_margins(mapped, site_file):
    out, _ = mapped
    margins = simulate_site(heights(), ROBOT, straight_passes(4))
    bands, costs = by_the_letter(margins, ROBOT.limits)
    with rasterio.open(out / "map.tif") as file:
        assert file.descriptions == band_names(ROBOT)
        assert file.crs.to_epsg() == 32632 and file.res == (0.25, 0.25) and math.isnan(file.nodata)
        assert file.xy(file.height - 1, 0) == pytest.approx((EASTING, NORTHING))
        np.testing.assert_allclose(file.read()[:, ::-1], bands, atol=2e-3)  # the file holds float32 heights at 812 m
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert file.tags()["blocking_event"] == "0 none, 1 step, 2 obstacle, 3 tilt"
    with rasterio.open(out / "headings.tif") as file:
        assert file.descriptions == ("heading 0 deg", "heading 90 deg", "heading 180 deg", "heading 270 deg")
        assert file.nodata == 255
        found = file.read()[:, ::-1]
    np.testing.assert_allclose(found.astype(int), costs, atol=1)
    assert len(np.unique(found)) > 5 and (found == 100).any() and (found == 255).any()


def test_what_blocks_has_colours_and_names(mapped):
    out, _ = mapped
    with rasterio.open(out / "map.tif") as file:
        wanted = np.nan_to_num(file.read(8), nan=255)
    with rasterio.open(out / "blocking.tif") as file:
        codes, colours = file.read(1), file.colormap(1)
        assert file.dtypes == ("uint8",) and file.nodata == 255 and file.descriptions == ("blocking_event",)
        assert file.crs.to_epsg() == 32632 and file.colorinterp[0].name == "palette"
        assert file.xy(file.height - 1, 0) == pytest.approx((EASTING, NORTHING))
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG" and not file.dataset_mask().all()
    np.testing.assert_array_equal(codes, wanted)
    assert {0, 255} < set(np.unique(codes).tolist())
    assert ["#" + bytes(colours[code][:3]).hex() for code in range(4)] == list(EVENT_COLOURS[:4])
    rasterio.shutil.copy(out / "blocking.tif", out / "copy.vrt", driver="VRT")
    names = re.findall("<Category>(.*?)</Category>", (out / "copy.vrt").read_text())
    assert names == ["none", "step", "obstacle", "tilt"]


def decoded(yaml) -> tuple[np.ndarray, dict[str, str]]:
    """Reads a map as Nav2's map_io does: [rows, cols] from the south-west, 0 to 100 and -1."""
    said = dict(line.split(": ", 1) for line in yaml.read_text().splitlines())
    image = np.asarray(Image.open(yaml.parent / said["image"]))
    shade = (image[..., 0] if image.ndim == 3 else image) / 255.0
    assert said["negate"] == "0"
    if said["mode"] == "raw":
        values = np.rint(shade * 255).astype(int)
        values[values > 100] = -1
    else:
        occupied, free = float(said["occupied_thresh"]), float(said["free_thresh"])
        occupancy = 1 - shade
        values = np.rint((occupancy - free) / (occupied - free) * 100).astype(int)
        values[occupancy > occupied], values[occupancy < free] = 100, 0
        values[image[..., 1] != 255] = -1
    return values[::-1], said


@pytest.mark.parametrize("name", ["worst", "best", "mean"])
@pytest.mark.parametrize("twin", ["", "_scale"])
def test_nav2_reads_the_costs_over_headings(mapped, name, twin):
    out, _ = mapped
    with rasterio.open(out / "headings.tif") as file:
        costs = np.where(file.read() == 255, np.nan, file.read().astype(float))[:, ::-1]
    values, said = decoded(out / "nav2" / f"{name}{twin}.yaml")
    known = ~np.isnan(costs).all(axis=0)
    over = {"worst": np.nanmax, "best": np.nanmin, "mean": np.nanmean}[name]
    np.testing.assert_array_equal(values[known], np.rint(over(costs[:, known], axis=0)))
    assert (values[~known] == -1).all() and known.any() and not known.all()
    origin = [float(number) for number in said["origin"].strip("[]").split(",")]
    assert origin == pytest.approx([EASTING - 0.125, NORTHING - 0.125, 0.0]) and float(said["resolution"]) == 0.25


def test_everything_that_is_written_is_printed(mapped):
    out, text = mapped
    files = {path for path in out.rglob("*") if path.suffix in (".tif", ".png", ".yaml", ".txt")}
    assert {path for path in files if str(path) in text} == files - set(out.glob("nav2/*.png"))
    assert "passable in" in text and "every known direction" in text
    for name in ("map.png", "why.png"):
        Image.open(out / name).verify()


def test_arrays_in_memory_are_the_same(mapped, site_file):
    out, _ = mapped
    site = SiteGround.open(site_file, fill_holes=False)
    found = map_site(site, "leo_rover", headings=4)
    with rasterio.open(out / "map.tif") as file:
        for band, name in enumerate(file.descriptions, 1):
            np.testing.assert_array_equal(found.bands[name], file.read(band)[::-1])
    assert found.x[:2].tolist() == [EASTING, EASTING + 0.25] and found.y[0] == NORTHING and found.crs == "EPSG:32632"
    assert sum(found.shares().values()) == pytest.approx(1)
    np.testing.assert_allclose(found.heights, heights()[::4, ::4], atol=1e-3)


def test_arrays_that_know_where_they_lie_are_mapped_there():
    ground = ArrayGround(np.zeros((30, 40), np.float32), 812.0, 0.1, (5.0, 6.0), "EPSG:32632")
    found = map_site(ground, "leo_rover", headings=1, contact="nearest")
    assert found.x[:2] == pytest.approx([5.0, 5.3]) and found.y[0] == 6.0 and found.crs == "EPSG:32632"
    assert (found.heights == 812.0).all() and (found.bands["known_headings"] == 1).any()
    plain = map_site(np.zeros((30, 40)), "leo_rover", headings=1, spacing=0.1, contact="nearest")
    assert plain.x[:2] == pytest.approx([0.0, 0.3]) and plain.crs is None


def test_xarray_gets_names_and_coordinates_and_its_absence_is_named(monkeypatch):
    pytest.importorskip("xarray", reason="xarray is not installed")
    found = map_site(np.zeros((40, 40)), headings=4, contact="nearest")
    data = found.to_xarray()
    assert data["cost"].dims == ("heading", "y", "x") and data["heading"].values.tolist() == [0, 90, 180, 270]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r'^xarray: not installed; needed: pip install "travjax\[xarray\]"$'):
        found.to_xarray()


def test_a_run_that_was_stopped_goes_on_with_the_missing_tiles(site_file, tmp_path, monkeypatch, mapped):
    monkeypatch.setattr(kernel, "TILE", 8)
    site, setup = SiteGround.open(site_file, fill_holes=False), setup_of("leo_rover", 4)
    simulated, parts_of = [], mapping.parts_of

    def stopping(*of, after):
        for number, part in parts_of(*of):
            simulated.append(number)
            yield number, part
            if len(simulated) == after:
                raise KeyboardInterrupt

    monkeypatch.setattr(mapping, "parts_of", lambda *of: stopping(*of, after=2))
    with pytest.raises(KeyboardInterrupt):
        save_map(site, setup, tmp_path)
    assert (tmp_path / FOLDER).is_dir() and not (tmp_path / "map.tif").exists()
    monkeypatch.setattr(mapping, "parts_of", lambda *of: stopping(*of, after=-1))
    save_map(site, setup, tmp_path)
    assert (
        simulated == list(range(len(kernel.tiles_of(setup.lattice(site.shape), setup))))
        and not (tmp_path / FOLDER).exists()
    )
    with rasterio.open(tmp_path / "map.tif") as one, rasterio.open(mapped[0] / "map.tif") as other:
        np.testing.assert_array_equal(one.read(), other.read())


def test_a_cluster_makes_the_same_map_though_a_worker_dies(site_file, tmp_path, monkeypatch, mapped):
    distributed = pytest.importorskip("distributed", reason="the extra dask is not installed")
    monkeypatch.setattr(kernel, "TILE", 8)
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        with distributed.Client(cluster) as client:
            pids = client.run(os.getpid)
        parts_of = mapping.parts_of

        def losing_a_worker(*of):
            for number, part in parts_of(*of):
                if number == 0:
                    os.kill(next(iter(pids.values())), signal.SIGKILL)
                yield number, part

        monkeypatch.setattr(mapping, "parts_of", losing_a_worker)
        site = SiteGround.open(site_file, fill_holes=False)
        save_map(site, setup_of("leo_rover", 4), tmp_path, scheduler=cluster.scheduler_address)
    with rasterio.open(tmp_path / "map.tif") as one, rasterio.open(mapped[0] / "map.tif") as other:
        np.testing.assert_array_equal(one.read(), other.read())


def test_what_is_unfinished_was_read_alike(site_file):
    one, other = SiteGround.open(site_file, fill_holes=False), SiteGround.open(site_file)
    assert one.sha256 == other.sha256 and one.reading != other.reading


def test_what_is_unfinished_of_another_setup_is_not_used(site_file, tmp_path):
    (tmp_path / FOLDER).mkdir()
    (tmp_path / FOLDER / "settings.json").write_text("{}")
    np.save(tmp_path / FOLDER / "done.npy", np.ones(1, bool))
    save_map(SiteGround.open(site_file), setup_of("leo_rover", 2, contact="nearest"), tmp_path)
    with rasterio.open(tmp_path / "headings.tif") as file:
        assert file.count == 2 and (file.read() != 255).any()


def test_coarse_cells_are_refused_unless_allowed_and_then_explained(tmp_path):
    np.savez(tmp_path / "coarse.npz", heights=np.zeros((40, 40)), cell_size=0.5)
    words = ("map", tmp_path / "coarse.npz", "--out", tmp_path / "out", "--headings", 2, "--contact", "nearest")
    code, _, err = run_words(*words)
    assert code == 2 and "cell_size = 0.5: must be at most 0.125 m (--allow-coarse takes it)" in err
    code, text, err = run_words(*words, "--allow-coarse")
    assert code == 0, err
    assert "cells of 0.5 m: tilt is that of ground averaged over 0.5 m (wheelbase 0.425 m)" in text
    with rasterio.open(tmp_path / "out/map.tif") as file:
        assert file.res == (0.5, 0.5) and (file.read(2) == 2).any()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--stride", 0.1), "stride = 0.1: must be a whole number of nodes, 0.0625 m each"),
        (("--stride", 100), "stride = 100.0: must be at most 30.25 m"),
        (("--headings", 0), "headings = 0: must be a whole number from 1 to 360"),
        (("--spacing", 0), "spacing = 0.0: must be"),
        (("--robot", "nobody"), "robot"),
        (("--scheduler", "nowhere"), "--scheduler nowhere: cannot be reached"),
        (
            ("--grid-map", "out.bag"),
            "--grid-map = 'out.bag': must be a file in a folder that exists, its name ending in .mcap or .db3",
        ),
    ],
)
def test_bad_options_are_one_line(site_file, tmp_path, more, message):
    code, _, err = run_words("map", site_file, "--out", tmp_path / "out", *more)
    assert code == 2 and message in err and err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_margin_just_above_its_limit_fails():
    limits = np.array([0.095, 0.031, 0.224], np.float32)
    robot = replace(ROBOT, max_step=0.095, ride_height=0.031, max_tilt=0.224)
    for event in range(3):
        fields = [np.zeros((1, 1, 1), np.float32) for _ in range(3)]
        fields[event][...] = np.nextafter(limits[event], np.float32(1))
        bands, costs = products(Margins(*fields, np.ones((1, 1, 1), bool)), robot)
        assert costs[0, 0, 0] == 100 and bands[0, 0, 0] == 0 and bands[7, 0, 0] == 1 + event and bands[4 + event] > 1
        fields[event][...] = limits[event]
        bands, costs = products(Margins(*fields, np.ones((1, 1, 1), bool)), robot)
        assert costs[0, 0, 0] == 99 and bands[0, 0, 0] == 1 and bands[7, 0, 0] == 0


def test_the_site_itself_is_not_overwritten(site_file, tmp_path):
    for name, more in (("map.tif", ()), ("blocking.tif", ()), ("geometric.tif", ("--method", "geometric"))):
        written = tmp_path / name
        written.write_bytes(site_file.read_bytes())
        code, _, err = run_words("map", written, "--headings", 1, "--out", tmp_path, *more)
        assert code == 2 and f"--out = {str(tmp_path)!r}: must be a folder other than that of the site" in err
        assert written.read_bytes() == site_file.read_bytes()


@pytest.mark.parametrize(("shape", "cell"), [((2, 96), 0.0625), ((40, 40), 0.2)])
def test_narrow_lattices_and_coarse_cells_are_mapped(tmp_path, shape, cell):
    np.savez(tmp_path / "site.npz", heights=np.zeros(shape), cell_size=cell, origin=(2.0, 3.0))
    words = ("map", tmp_path / "site.npz", "--headings", 1, "--contact", "nearest", "--allow-coarse")
    code, _, err = run_words(*words, "--out", tmp_path / "out")
    assert code == 0, err
    _, said = decoded(tmp_path / "out/nav2/best.yaml")
    stride = 0.25 if cell < 0.1 else 0.4
    assert float(said["resolution"]) == stride and said["origin"] == f"[{2 - stride / 2!r}, {3 - stride / 2!r}, 0.0]"


def test_a_recording_keeps_its_frame_and_its_heights(tmp_path):
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    ground = np.full((50, 60), 1834.25, np.float32)
    write_grid_map(tmp_path / "in.mcap", {"z": ground}, 0.0625, (1.0, 2.0), "odom")
    words = ("map", tmp_path / "in.mcap", "--headings", 1, "--contact", "nearest", "--out", tmp_path / "out")
    code, _, err = run_words(*words, "--grid-map", tmp_path / "out.mcap")
    assert code == 0, err
    raster = read_grid_map(tmp_path / "out.mcap", DemOptions(layer="elevation"))
    assert raster.frame == "odom" and raster.origin == pytest.approx((1.0, 2.0))
    assert raster.heights[0:2, 0:2].tolist() == [[1834.25, 1834.25]] * 2


def test_several_maps_in_one_file_are_no_site(tmp_path):
    np.savez(tmp_path / "two.npz", heights=np.zeros((2, 40, 40)), cell_size=0.0625)
    with pytest.raises(InputError, match="two.npz: maps = 2: must be one for a site"):
        map_site(tmp_path / "two.npz")
