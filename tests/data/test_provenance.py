"""Sites from TOML files, the one line for each wrong one, and what a data set keeps of where its maps come from."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest

from travjax.config import InputError, from_json, to_json
from travjax.data.provenance import LEAST_GAP, SIDES, Provenance, Site, SiteRecord, SitesConfig
from travjax.files import find_preset

TOML = """
stride = 2
gap = 12
max_unknown = 0
rotations = false

[[site]]
file = "terrain/quarry.tif"
test_strip = ["north", 40]
validation_strip = ["south", 24.5]

[[site]]
file = "scan.npy"
name = "the scan"
split = "test"
cell_size = 0.05
height_scale = 0.001
nodata = -1
"""

CONFIG = SitesConfig(
    (
        Site("terrain/quarry.tif", test_strip=("north", 40), validation_strip=("south", 24.5)),
        Site("scan.npy", "the scan", "test", cell_size=0.05, height_scale=0.001, nodata=-1),
    ),
    stride=2,
    gap=12,
    max_unknown=0,
    rotations=False,
)


@pytest.fixture
def sites_file(tmp_path):
    """Writes a text to sites.toml and returns its path."""

    def write(text):
        path = tmp_path / "sites.toml"
        path.write_text(text)
        return path

    return write


def test_a_file_gives_sites_and_settings(sites_file):
    config = SitesConfig.load(sites_file(TOML))
    assert config == CONFIG and hash(config) == hash(CONFIG)
    assert [site.group for site in config.site] == ["quarry", "the scan"]
    assert config.site[0].strips == {"test": ("north", 40), "validation": ("south", 24.5)}


def test_what_is_left_out_is_as_in_the_issue(sites_file):
    config = SitesConfig.load(sites_file('[[site]]\nfile = "a.tif"'))
    assert config == SitesConfig((Site("a.tif"),))
    assert (config.stride, config.gap, config.max_unknown, config.rotations) == (
        4,
        LEAST_GAP,
        0.1,
        True,
    ) and LEAST_GAP == 8
    assert config.site[0].split == "train" and not any(config.site[0].strips.values())


def test_sites_come_back_from_json():
    assert from_json(json.loads(json.dumps(to_json(CONFIG))), SitesConfig) == CONFIG


def test_the_sites_of_the_experiment_are_right():
    config = SitesConfig.load(find_preset("real", "sites"))
    splits = {site.group: site.split for site in config.site}
    trained = dict.fromkeys(("quarry", "rover_field", "alpine_pasture", "mars_marias_pass"), "train")
    assert splits == trained | {"mars_live_site": "test"}
    assert [site.group for site in config.site if site.test_strip] == ["quarry"]
    assert all(site.file == f"terrain/{site.group}.tif" for site in config.site)
    assert config.gap >= 8 and config.rotations


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"file": ""}, "file = '': must be a non-empty text"),
        ({"file": 3}, "file = 3: must be a non-empty text"),
        ({"name": "a\nb"}, r"name = 'a\\nb': must be a text of one line"),
        ({"name": None}, "name = None: must be a text of one line"),
        ({"split": "dev"}, "split = 'dev': must be one of train, validation, test"),
        (
            {"test_strip": ("up", 3)},
            r"test_strip = \('up', 3\): must be of one of north, east, south, west, then metres",
        ),
        ({"test_strip": ("north",)}, r"test_strip = \('north',\): must be a side and metres, or left out"),
        ({"test_strip": "north"}, "test_strip = 'north': must be a side and metres, or left out"),
        ({"validation_strip": ("east", 0)}, "validation_strip east = 0: must be metres, above 0"),
        ({"validation_strip": ("east", "40")}, "validation_strip east = '40': must be metres, above 0"),
        ({"split": "test", "test_strip": ("east", 9)}, "test_strip = .*: must be left out where split is test"),
        (
            {"split": "test", "validation_strip": ("east", 9)},
            "validation_strip = .*: must be left out where split is test",
        ),
        (
            {"split": "validation", "validation_strip": ("east", 9)},
            "validation_strip = .*: must be left out where split is validation",
        ),
        ({"cell_size": 0}, "cell_size = 0: must be metres, above 0 and at most 1000"),
        ({"height_scale": "1"}, "height_scale = '1': must be metres"),
        ({"nodata": "none"}, "nodata = 'none': must be a number"),
    ],
)
def test_a_wrong_site_is_named(values, message):
    with pytest.raises(InputError, match=f"^{message}"):
        Site(**({"file": "a.tif"} | values))


@pytest.mark.parametrize("side", SIDES)
def test_every_side_may_have_a_strip(side):
    assert Site("a.tif", split="validation", test_strip=(side, 0.5)).strips["test"] == (side, 0.5)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"site": ()}, r"site = \(\): must be at least one \[\[site\]\]"),
        ({"site": ("a.tif",)}, r"site = \('a.tif',\): must be at least one \[\[site\]\]"),
        ({"site": (Site("a/x.tif"), Site("b/x.npy"))}, r"names of sites = \['x'\]: must be different; give a name"),
        ({"stride": 0}, "stride = 0: must be a distance in metres, above 0"),
        ({"gap": 7.99}, "gap = 7.99: must be a distance in metres, at least 8"),
        ({"gap": "8"}, "gap = '8': must be a distance in metres, at least 8"),
        ({"max_unknown": -0.01}, "max_unknown = -0.01: must be a share from 0 to 1"),
        ({"max_unknown": 1.01}, "max_unknown = 1.01: must be a share from 0 to 1"),
        ({"rotations": 1}, "rotations = 1: must be true or false"),
        ({"fill_holes": "no"}, "fill_holes = 'no': must be true or false"),
        ({"allow_coarse": None}, "allow_coarse = None: must be true or false"),
    ],
)
def test_a_wrong_setting_is_named(values, message):
    with pytest.raises(InputError, match=f"^{message}"):
        SitesConfig(**({"site": (Site("a.tif"),)} | values))


def test_a_name_tells_sites_of_like_files_apart():
    config = SitesConfig((Site("a/x.tif"), Site("b/x.tif", "other x")), max_unknown=1, gap=8)
    assert [site.group for site in config.site] == ["x", "other x"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "missing site"),
        ("[site]\nfile = 'a'", "site = {'file': 'a'}: must be a list of tables [[site]]"),
        ("[[site]]\nfile = 'a'\n[[site]]\nname = 'b'", "site 2: missing file"),
        ("[[site]]\nfile = 'a'\nsplits = 'test'", "site 1: unknown key 'splits'; allowed: file, name, split, "),
        ("[[site]]\nfile = 'a'\ntest_strip = ['north', -1]", "site 1: test_strip north = -1: must be metres, above 0"),
        ("strides = 3\n[[site]]\nfile = 'a'", "unknown key 'strides'; allowed: site, stride, gap, "),
        ("gap = 1\n[[site]]\nfile = 'a'", "gap = 1: must be a distance in metres, at least 8"),
    ],
)
def test_what_is_wrong_in_a_file_is_said_in_one_line(sites_file, text, message):
    path = sites_file(text)
    with pytest.raises(InputError) as raised:
        SitesConfig.load(path)
    assert str(raised.value).startswith(f"{path}: {message}") and "\n" not in str(raised.value)


# ---- What is kept


def record(name: str) -> SiteRecord:
    return SiteRecord(name, f"/data/{name}.tif", "ab" * 32, None, 0.0625, 12.0, 0.9, 0.001, 0.2, 9, 4, 1, 1, 1, 1, 1)


def provenance(**changes) -> Provenance:
    arrays = {"origin": np.array([[0.5, 1.0], [2.0, 3.0]]), "quarter_turns": np.array([0, 3], np.uint8)}
    records = (record("quarry"), record("the scan"))
    return Provenance(**({"config": CONFIG, "sites": records} | arrays | changes))


def test_provenance_comes_back_from_json_and_arrays():
    made = provenance()
    again = Provenance.from_json(json.loads(json.dumps(made.to_json(), allow_nan=False)), **made.arrays)
    assert again.config == CONFIG and again.sites == made.sites
    assert again.arrays.keys() == made.arrays.keys() == {"origin", "quarter_turns"}
    assert all(again.arrays[name] is array for name, array in made.arrays.items())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"quarter_turns": np.array([0, 4], np.uint8)}, r"quarter_turns = \[4\]: must be from 0 to 3"),
        ({"sites": (record("quarry"),)}, r"records of sites = \['quarry'\]: must be of quarry, the scan"),
    ],
)
def test_provenance_that_does_not_fit_is_refused(changes, message):
    with pytest.raises(InputError, match=f"^{message}"):
        replace(provenance(), **changes)


def test_everything_is_explained():
    for kind in (Site, SitesConfig, SiteRecord, Provenance):
        for field in fields(kind):
            assert field.name in kind.__doc__, field.name


def test_a_site_whose_maps_have_heights_of_their_own_has_no_common_offset():
    values = dict(name="a", file="a.npz", sha256="0", crs=None, cell_size=0.1, covered=1.0, filled=0.0, unknown=0.0)
    counts = dict.fromkeys(("windows", "train", "validation", "test", "too_unknown", "near_test", "shared"), 1)
    assert SiteRecord(**values, **counts, height_offset=None).height_offset is None
