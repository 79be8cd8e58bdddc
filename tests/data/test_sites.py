"""Real maps as a data set: places and heights against the function that the sites are made of, splits against loops."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from tests.conftest import SETUPS
from travjax.config import InputError
from travjax.data import sites
from travjax.data.dataset import Dataset, load, save
from travjax.data.dem import load_dem
from travjax.data.provenance import SPLITS, Site, SitesConfig
from travjax.data.sites import read, turned
from travjax.files import sha256
from travjax.traversal.reference import simulate_trajectory
from travjax.traversal.traverse import unpacked

SETUP = SETUPS["coarse small map"]
ROBOT, ACTIONS, GRID = SETUP.robot, SETUP.actions, SETUP.grid
SIZE, CELL = GRID.size, GRID.spacing


def ground(x, y):
    """Metres: gentle between steep ridges; no direction is like another."""
    return (
        0.05 * np.sin(1.3 * x + 0.2) * np.cos(0.7 * y) + 0.02 * x + 2 * np.maximum(0, np.sin(0.8 * x - 0.5 * y) - 0.8)
    )


def site_file(path: Path, east=26.0, north=40.0, origin=(500.0, 9000.0), crs="LOCAL_CS[]", holes=(), shift=0.0) -> Path:
    """A file of the ground. holes: (west, south, east, north) in metres from the origin."""
    x, y = np.meshgrid(np.arange(round(east / CELL) + 1) * CELL, np.arange(round(north / CELL) + 1) * CELL)
    heights = ground(x + origin[0], y + origin[1]) + shift
    for west, south, to_east, to_north in holes:
        heights[(x >= west) & (x <= to_east) & (y >= south) & (y <= to_north)] = np.nan
    np.savez(path, heights=heights, cell_size=CELL, origin=origin, crs=crs)
    return path


def made(config: SitesConfig, **options) -> Dataset:
    return read(config, SETUP, **options)


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, str]:
    """Sites by name: hill and dale are local, east and west overlap, far is in the place of east in another zone."""
    folder = tmp_path_factory.mktemp("sites")
    holes = ((2, 2, 9, 6), (14, 25, 14.2, 29), (20, 34, 26, 40))
    paths = {
        "hill": site_file(folder / "hill.npz", holes=holes),
        "dale": site_file(folder / "dale.npz", 14, 12, (512.0, 9010.0), shift=0.1),
        "west": site_file(folder / "west.npz", 30, 13, (100.0, 200.0), "EPSG:32632", shift=0.2),
        "east": site_file(folder / "east.npz", 30, 13, (121.0, 203.0), "EPSG:32632", shift=0.3),
        "far": site_file(folder / "far.npz", 30, 13, (121.0, 203.0), "EPSG:32633", shift=0.4),
    }
    return {name: str(path) for name, path in paths.items()}


def config_of(files: dict[str, str], *named: tuple[str, dict], **settings) -> SitesConfig:
    given = {"stride": 2.0, "max_unknown": 0.2} | settings
    return SitesConfig(tuple(Site(files[name], **site) for name, site in named), **given)


HILL = ("hill", {"test_strip": ("north", 12.0), "validation_strip": ("south", 6.0)})
CONFIGS = {
    "two strips": (HILL,),
    "validation in the east": (("hill", {"test_strip": ("west", 5.0), "validation_strip": ("east", 7.5)}),),
    "a strip of one window": (("hill", {"test_strip": ("south", 4.0)}),),
    "a strip and a local test site in the same place": (HILL, ("dale", {"split": "test"})),
    "test site that overlaps": (("west", {}), ("east", {"split": "test"})),
    "test site elsewhere in another zone": (("west", {}), ("far", {"split": "test"})),
    "validation site that overlaps": (("west", {}), ("east", {"split": "validation"}), ("far", {})),
    "strip beside an overlapping site": (("west", {"test_strip": ("east", 4.0)}), ("east", {"split": "validation"})),
    "validation site with a test strip": (("hill", {"split": "validation", "test_strip": ("south", 9.0)}),),
}


@pytest.fixture(scope="module", params=CONFIGS)
def case(request, files) -> tuple[SitesConfig, Dataset]:
    """Configurations in turn, and the data set of each."""
    config = config_of(files, *CONFIGS[request.param])
    return config, made(config)


@pytest.fixture(scope="module")
def hill(files) -> tuple[SitesConfig, Dataset]:
    config = config_of(files, HILL)
    return config, made(config)


# ---- Splits


def nodes_of(origin) -> list[np.ndarray]:
    """The x and the y of a window's nodes."""
    return [start + CELL * np.arange(GRID.nodes) for start in origin]


def distance(one, other) -> float:
    """Between the nearest nodes of two windows, along the axis on which they are farther apart."""
    pairs = zip(nodes_of(one), nodes_of(other), strict=True)
    return max(np.abs(a[:, None] - b[None, :]).min() for a, b in pairs)


def ground_of(config: SitesConfig, dataset: Dataset) -> list[str]:
    """The name of the ground of each map."""
    systems = {s.name: s.crs if s.crs.startswith("EPSG") else s.name for s in dataset.provenance.sites}
    return [systems[name] for name in dataset.group.tolist()]


def pairs(case, one: str, other: str):
    """The places of any two maps of two splits on the same ground."""
    config, dataset = case
    grounds, origins = ground_of(config, dataset), dataset.provenance.origin
    first, second = (dataset.maps_of(split) for split in (one, other))
    places = lambda maps: {(grounds[index], *origins[index].tolist()) for index in maps}
    return [(a[1:], b[1:]) for a in places(first) for b in places(second) if a[0] == b[0]]


def test_nothing_near_a_test_window_is_trained_on(case):
    for split in ("train", "validation"):
        for place, test in pairs(case, split, "test"):
            assert distance(place, test) > 8 - 1e-6


def test_training_and_validation_share_no_node(case):
    for place, validation in pairs(case, "train", "validation"):
        assert distance(place, validation) > CELL / 2


def in_zone(code: int, lon: float, lat: float) -> tuple[float, float]:
    return Transformer.from_crs("EPSG:4326", f"EPSG:{code}", always_xy=True).transform(lon, lat)


@pytest.mark.parametrize("code", [25832, 32633, 25833, 3044])
@pytest.mark.parametrize(("apart", "left_out"), [(0.0, True), (13.0, True), (60.0, False)])
def test_the_same_ground_by_another_code_is_not_trained_on(tmp_path, code, apart, left_out):
    lon, lat = 11.999, 47.0
    x, y = in_zone(32632, lon, lat)
    east, north = in_zone(code, lon, lat)
    files = {
        "here": str(site_file(tmp_path / "here.npz", 4, 4, (x, y), "EPSG:32632")),
        "again": str(site_file(tmp_path / "again.npz", 4, 4, (east + apart, north), f"EPSG:{code}", shift=0.1)),
        "away": str(site_file(tmp_path / "away.npz", 4, 4, (x - 500, y), "EPSG:32632")),
    }
    config = config_of(files, ("here", {}), ("again", {"split": "test"}), ("away", {}), rotations=False)
    if left_out:
        with pytest.raises(InputError, match="site here: split = train: .* 1 near the test"):
            made(config)
    else:
        assert made(config).split.tolist() == [0, 2, 0]


def slow_fates(config: SitesConfig, dataset: Dataset) -> dict[tuple, str]:
    """What becomes of each window of each site by the rules one after the other, in loops."""
    cut = {site.group: load_dem(site.file, config.stride, grid=GRID) for site in config.site}
    systems = {name: windows.crs if windows.crs.startswith("EPSG") else name for name, windows in cut.items()}
    assignments: dict[tuple, str] = {}
    wanted: dict[tuple, str] = {}
    for site in config.site:
        origins, heights = cut[site.group].origins, cut[site.group].heights
        for origin, window in zip(origins, heights, strict=True):
            key = (site.group, *origin.tolist())
            known = np.isnan(window).mean() <= config.max_unknown and any_known(window)
            assignments[key] = "" if known else "too_unknown"
            wanted[key] = site.split
            for split in ("validation", "test"):
                strip = getattr(site, f"{split}_strip")
                if strip:
                    beyond = {
                        "north": origins[:, 1].max() - origin[1],
                        "south": origin[1] - origins[:, 1].min(),
                        "east": origins[:, 0].max() - origin[0],
                        "west": origin[0] - origins[:, 0].min(),
                    }[strip[0]]
                    wanted[key] = split if beyond + SIZE <= strip[1] else wanted[key]
    touching = lambda key, split, reach: any(
        systems[key[0]] == systems[other[0]] and distance(key[1:], other[1:]) < reach
        for other, assignment in assignments.items()
        if assignment == split
    )
    for split, reach, left_out in (("test", 8.0, "near_test"), ("validation", CELL / 2, "shared")):
        for key in assignments:
            if not assignments[key] and wanted[key] == split:
                assignments[key] = split
        near = [key for key, assignment in assignments.items() if not assignment and touching(key, split, reach)]
        assignments |= dict.fromkeys(near, left_out)
    return {key: assignment or "train" for key, assignment in assignments.items()}


def any_known(window: np.ndarray) -> bool:
    """Whether any trajectory of a window is known, by the sequential simulator."""
    known = (simulate_trajectory(window, ROBOT, ACTIONS, index, CELL).known for index in range(len(ACTIONS)))
    return not np.isnan(window).any() or any(known)


def test_each_window_is_where_the_rules_put_it(case):
    config, dataset = case
    assignments = slow_fates(config, dataset)
    upright = np.flatnonzero(dataset.provenance.quarter_turns == 0)
    origins = dataset.provenance.origin[upright].tolist()
    found = {
        (name, *origin): SPLITS[split]
        for name, origin, split in zip(
            dataset.group[upright].tolist(), origins, dataset.split[upright].tolist(), strict=True
        )
    }
    assert len(found) == len(upright)
    assert found == {key: assignment for key, assignment in assignments.items() if assignment in SPLITS}
    for record in dataset.provenance.sites:
        mine = [assignment for key, assignment in assignments.items() if key[0] == record.name]
        assert record.windows == len(mine)
        for assignment in (*SPLITS, "too_unknown", "near_test", "shared"):
            assert getattr(record, assignment) == mine.count(assignment), assignment


def test_every_fate_occurs(hill):
    record = hill[1].provenance.sites[0]
    assert all(getattr(record, assignment) for assignment in (*SPLITS, "too_unknown", "near_test", "shared"))


def test_a_larger_gap_leaves_out_more(files, hill):
    config, dataset = hill
    wider = made(replace(config, gap=14.0))
    assert wider.provenance.sites[0].near_test > dataset.provenance.sites[0].near_test
    assert min(distance(a, b) for a, b in pairs((config, wider), "train", "test")) >= 14
    assert min(distance(a, b) for a, b in pairs(hill, "train", "test")) == 8


def test_ground_is_compared_within_a_coordinate_system_only(files):
    places = [made(config_of(files, ("west", {}), (other, {"split": "test"}))) for other in ("east", "far")]
    near, apart = ([site.near_test for site in dataset.provenance.sites] for dataset in places)
    assert near[0] > 0 and apart == [0, 0] and near[1] == 0


# ---- Heights and labels


def test_maps_are_the_ground_at_their_places_turned_anticlockwise(hill):
    _, dataset = hill
    axis, provenance = GRID.axis(), dataset.provenance
    right, forward = np.meshgrid(axis, axis)
    assert set(provenance.quarter_turns.tolist()) == {0, 1, 2, 3}
    for heights, origin, quarter in zip(dataset.heights, provenance.origin, provenance.quarter_turns, strict=True):
        angle = -int(quarter) * np.pi / 2  # back to where the ground was before it was turned
        x = right * np.cos(angle) - forward * np.sin(angle) + origin[0] + SIZE / 2
        y = right * np.sin(angle) + forward * np.cos(angle) + origin[1] + SIZE / 2
        expected = ground(x, y) - provenance.sites[0].height_offset
        filled = (x > 513.9) & (x < 514.3) & (y > 9024.9) & (y < 9029.1)
        given = ~np.isnan(heights) & ~filled
        np.testing.assert_allclose(heights[given], expected[given], rtol=0, atol=2e-6)


def test_ground_in_the_east_lies_in_the_north_after_a_turn():
    heights = np.zeros(GRID.shape)
    heights[:, -1] = 1  # the east
    for quarter, edge in enumerate((np.s_[:, -1], np.s_[-1, :], np.s_[:, 0], np.s_[0, :])):
        assert turned(heights, quarter)[edge].all()


def test_labels_are_those_of_the_sequential_simulator(hill):
    _, dataset = hill
    rng = np.random.default_rng(0)
    failed, known = (np.asarray(part) for part in unpacked(dataset.labels))
    assert 0.02 < failed[known].any(axis=-1).mean() < 0.9 and 0 < (~known).mean() < 0.2
    limits = np.array([ROBOT.max_step, ROBOT.ride_height, ROBOT.max_tilt])
    for index, trajectory in zip(rng.integers(0, len(failed), 60), rng.integers(0, len(ACTIONS), 60), strict=True):
        slow = simulate_trajectory(dataset.heights[index], ROBOT, ACTIONS, trajectory, CELL)
        assert slow.known == known[index, trajectory]
        margins = np.array([slow.step, slow.obstacle, slow.tilt])
        sure = np.abs(margins - limits) > 1e-5
        if slow.known:
            np.testing.assert_array_equal(failed[index, trajectory][sure], (margins > limits)[sure])


def test_on_turned_ground_the_turned_trajectory_meets_the_same(hill):
    # Of four point turns the next one is a quarter turn anticlockwise, as the ground's.
    _, dataset = hill
    by_place = {}
    for index, (origin, quarter) in enumerate(
        zip(dataset.provenance.origin.tolist(), dataset.provenance.quarter_turns.tolist(), strict=True)
    ):
        by_place[(*origin, quarter)] = dataset.labels[index].reshape(ACTIONS.turns, -1)
    copies = [key for key in by_place if key[2]]
    assert len(copies) == 3 * dataset.provenance.sites[0].train
    alike = [(np.roll(by_place[(x, y, 0)], q, axis=0) == by_place[(x, y, q)]).mean() for x, y, q in copies]
    assert np.mean(alike) > 0.999  # nodes midway between two are not the same after a turn
    unlike = [(by_place[(x, y, 0)] == by_place[(x, y, q)]).mean() for x, y, q in copies]
    assert np.mean(unlike) < 0.97


def test_only_training_windows_are_turned_and_all_of_them(hill):
    _, dataset = hill
    provenance = dataset.provenance
    assert (dataset.split[provenance.quarter_turns > 0] == 0).all()
    for quarter in range(4):
        places = [provenance.origin[(provenance.quarter_turns == one) & (dataset.split == 0)] for one in (0, quarter)]
        np.testing.assert_array_equal(*places)
        assert len(places[0]) == provenance.sites[0].train


def test_without_rotations_nothing_is_turned(files, hill):
    dataset = made(config_of(files, HILL, rotations=False))
    upright = hill[1].provenance.quarter_turns == 0
    assert not dataset.provenance.quarter_turns.any()
    np.testing.assert_array_equal(dataset.heights, hill[1].heights[upright])
    np.testing.assert_array_equal(dataset.labels, hill[1].labels[upright])


# ---- What is kept


def test_windows_keep_where_they_come_from(files):
    config = config_of(files, HILL, ("dale", {"split": "test", "name": "the dale"}))
    dataset = made(config)
    hill, dale = dataset.provenance.sites
    assert set(dataset.group.tolist()) == {"hill", "the dale"} == {hill.name, dale.name}
    windows = load_dem(files["dale"], 2.0, grid=GRID)
    assert (dale.file, dale.sha256, dale.crs) == (files["dale"], windows.sha256, "LOCAL_CS[]")
    assert (dale.cell_size, dale.height_offset, dale.covered) == (CELL, windows.height_offset, windows.covered)
    assert hill.unknown > 0 and dale.unknown == 0
    assert dataset.provenance.config == config and dataset.config is None and not dataset.seed.any()
    mine = dataset.group == "the dale"
    np.testing.assert_array_equal(dataset.provenance.origin[mine], windows.origins)
    np.testing.assert_array_equal(dataset.heights[mine], windows.heights)


def test_the_data_set_is_read_back_as_it_was_saved(hill, tmp_path):
    _, dataset = hill
    save(dataset, tmp_path / "set")
    again = load(tmp_path / "set")
    for name, array in dataset.arrays.items():
        np.testing.assert_array_equal(again.arrays[name], array)
    assert again.provenance.to_json() == dataset.provenance.to_json()
    assert again.provenance.config == dataset.provenance.config and again.provenance.sites == dataset.provenance.sites
    assert again.fingerprint == dataset.fingerprint


def test_the_same_sites_give_the_same_data_set(files, hill, monkeypatch):
    monkeypatch.setattr(sites, "MAPS_AT_ONCE", 32)
    added: list[int] = []
    again = made(hill[0], on_progress=added.append)
    assert again.fingerprint == hill[1].fingerprint
    record = hill[1].provenance.sites[0]
    most = record.windows + 3 * record.train
    assert max(added) == 32 and most - record.too_unknown <= sum(added) <= most


def test_files_are_found_under_travjax_data(files, tmp_path, monkeypatch):
    folder = Path(files["dale"]).parent
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TRAVJAX_DATA", str(folder.parent))
    dataset = made(SitesConfig((Site(f"{folder.name}/dale.npz"),)))
    (record,) = dataset.provenance.sites
    assert (record.file, record.sha256) == (f"{folder.name}/dale.npz", sha256(Path(files["dale"])))


def test_reading_setups_are_those_of_the_site_and_the_config(tmp_path):
    heights = np.rint(1000 * ground(*np.meshgrid(np.arange(65) * 0.25, np.arange(49) * 0.25))).astype(np.int16)
    heights[10:14, 10:14] = 7
    np.save(tmp_path / "map.npy", heights)
    site = Site(str(tmp_path / "map.npy"), cell_size=0.25, height_scale=0.001, nodata=7)
    dataset = made(SitesConfig((site,), stride=4.0, max_unknown=0.5, allow_coarse=True, rotations=False))
    assert dataset.provenance.sites[0].cell_size == 0.25 and np.isnan(dataset.heights).any()
    assert np.nanmax(np.abs(dataset.heights)) < 1.5
    with pytest.raises(InputError, match=r"map.npy: cell_size = 0\.25: must be at most 0\.125 m"):
        made(SitesConfig((site,)))


def test_holes_are_filled_unless_they_are_to_be_kept(files):
    kept = made(config_of(files, HILL, fill_holes=False))
    filled = made(config_of(files, HILL))
    assert filled.provenance.sites[0].filled > 0 == kept.provenance.sites[0].filled
    assert kept.provenance.sites[0].unknown > filled.provenance.sites[0].unknown


# ---- What is wrong

BAD = {
    "strip smaller than a window": (
        [("hill", {"test_strip": ("north", 3.9)})],
        r"site hill: test_strip = north 3\.9 m: must leave at least one of 228 windows, which are 4 m and span 26 x 40 "
        r"m; now 206 train, 0 validation, 22 left out as unknown, 0 near the test, 0 sharing ground with validation$",
    ),
    "strip over the whole site": (
        [("hill", {"test_strip": ("north", 100)})],
        r"site hill: split = train: must leave at least one of .*; now 0 validation, \d+ test, ",
    ),
    "gap over the rest of the site": (
        [("dale", {"test_strip": ("west", 4.0)})],
        r"site dale: split = train: must leave .* span 14 x 12 m; now 0 validation, 5 test, .*, 25 near the test",
    ),
    "validation strip in the gap": (
        [("hill", {"test_strip": ("north", 10), "validation_strip": ("north", 18)})],
        "site hill: validation_strip = north 18 m: must leave",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_split_without_windows_is_one_line(files, name):
    named, message = BAD[name]
    with pytest.raises(InputError, match=f"^{message}") as raised:
        made(config_of(files, *named))
    assert "\n" not in str(raised.value)


def test_a_site_without_known_ground_leaves_no_window(tmp_path):
    path = site_file(tmp_path / "fog.npz", 8, 8, holes=((0, 0, 7, 8),))
    with pytest.raises(
        InputError, match=r"^site fog: split = test: .*; now 0 train, 0 validation, 9 left out as unknown"
    ):
        made(SitesConfig((Site(str(path), split="test"),), stride=2.0))


def test_windows_without_a_known_trajectory_are_left_out_however_much_is_allowed(tmp_path):
    around = ((3.5, 3.5, 4.5, 4.5),)  # every trajectory of the middle window starts there
    path = site_file(tmp_path / "pit.npz", 8, 8, holes=around)
    dataset = made(SitesConfig((Site(str(path)),), stride=2.0, max_unknown=1.0, rotations=False))
    assert dataset.provenance.sites[0].too_unknown == 1
    assert [502.0, 9002.0] not in dataset.provenance.origin.tolist() and len(dataset.split) == 8


def test_a_missing_file_is_one_line_that_says_where_it_was_looked_for(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TRAVJAX_DATA", "/nowhere")
    with pytest.raises(InputError) as raised:
        made(SitesConfig((Site("terrain/moon.tif"),)))
    assert str(raised.value) == (
        "site moon: file terrain/moon.tif: no such file here, nor under TRAVJAX_DATA=/nowhere; "
        "allowed: a file here or under TRAVJAX_DATA"
    )


def test_the_same_file_twice_is_refused(files, tmp_path):
    copy = tmp_path / "copy.npz"
    copy.write_bytes(Path(files["hill"]).read_bytes())
    config = SitesConfig((Site(files["hill"]), Site(str(copy), split="test")), stride=8.0)
    with pytest.raises(InputError, match=r"copy\.npz: holds the same as .*hill\.npz: must be given once$"):
        made(config)


def test_what_load_dem_refuses_names_the_file(tmp_path):
    (tmp_path / "bad.npy").write_text("none")
    with pytest.raises(InputError, match=r"bad\.npy: cannot be read as \.npy: "):
        made(SitesConfig((Site(str(tmp_path / "bad.npy")),)))


def test_a_robot_that_does_not_fit_is_refused_before_anything_is_read():
    with pytest.raises(InputError, match="leave the"):
        read(SitesConfig((Site("none.tif"),)), replace(SETUP, actions=SETUPS["paper"].actions))
