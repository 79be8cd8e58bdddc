"""Failure shares of a data set against those counted trajectory by trajectory."""

from dataclasses import replace

import numpy as np
import pytest

from tests.conftest import SETUPS
from travjax.data.dataset import SPLITS, Dataset, DatasetConfig
from travjax.data.provenance import Provenance, Site, SiteRecord, SitesConfig
from travjax.data.sampling import balanced_subset
from travjax.evaluation import dataset_tables, tables
from travjax.evaluation.dataset_tables import (
    balanced_subsets,
    label_counts,
    statistics_rows,
    statistics_table,
    windows_table,
)
from travjax.terrain.styles import STYLES
from travjax.traversal.traverse import unpacked

SETUP = SETUPS["coarse small map"]
ROBOT, ACTIONS, GRID = SETUP.robot, SETUP.actions, SETUP.grid


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    """90 maps of three sites; a third without failures, one wholly unknown."""
    rng = np.random.default_rng(0)
    shape = 90, len(ACTIONS)
    labels = np.where(rng.random(shape) < 0.3, rng.integers(0, 8, shape), 0)
    labels[::3] = 0
    labels[rng.random(shape) < 0.2] = 8
    labels[7] = 8
    group = np.array(["b", "a", "c"])[np.arange(90) // 30]
    split = rng.choice(3, 90, p=(0.7, 0.2, 0.1)).astype(np.uint8)
    heights = np.zeros((90, *GRID.shape), np.float32)
    return Dataset(heights, labels.astype(np.uint8), group, np.zeros(90, np.uint32), split, SETUP, config=None)


def slow_row(labels: np.ndarray) -> dict:
    """Shares of a group of maps from a loop over its maps and trajectories."""
    known = fails = 0
    events, known_maps, none = [0, 0, 0], 0, 0
    for trajectories in labels.tolist():
        of_map = [label for label in trajectories if label < 8]
        known += len(of_map)
        fails += sum(label > 0 for label in of_map)
        events = [count + sum(label >> event & 1 for label in of_map) for event, count in enumerate(events)]
        known_maps += bool(of_map)
        none += bool(of_map) and not any(of_map)
    shares = dict(zip(tables.PAPER_SHARES, [*events, fails], strict=True))
    return {
        "maps": len(labels),
        "samples": known,
        **{name: f"{count / known:.2%}" for name, count in shares.items()},
        "none": f"{none / known_maps:.1%}",
        "known": f"{known / labels.size:.1%}",
    }


def rows_of(dataset, **options) -> dict[str, dict]:
    return {row["what"]: row for row in statistics_rows(dataset, **options)}


def test_the_shares_are_those_of_a_loop(dataset):
    rows = rows_of(dataset)
    chosen = {"all maps": slice(None)}
    chosen |= {name: dataset.group == name for name in "abc"}
    chosen |= {name: dataset.split == index for index, name in enumerate(SPLITS)}
    sites = [f"{site}, {split}" for site in "abc" for split in SPLITS]
    chosen |= {name: chosen[name[0]] & chosen[name[3:]] for name in sites}
    for name, maps in chosen.items():
        assert rows[name] == {"what": name} | slow_row(dataset.labels[maps])
    assert list(rows) == [
        *("b", *sites[3:6]),
        *("a", *sites[:3]),
        *("c", *sites[6:]),
        "all maps",
        *SPLITS,
        "paper's test set",
        "train, balanced",
        "validation, balanced",
    ]


def test_the_shares_are_those_of_the_table_of_labels(dataset):
    failed, known = (np.asarray(part) for part in unpacked(dataset.labels))
    table = tables.shares_table(dataset.group, failed, known, as_in_paper=False)
    overall = table.splitlines()[-1].split()
    row = rows_of(dataset)["all maps"]
    assert overall[1:] == [str(row["maps"]), *(row[name] for name in (*tables.PAPER_SHARES, "none", "known"))]


def test_balanced_subsets_have_their_own_rows(dataset):
    maps, trajectories = balanced_subset(dataset.labels, dataset.maps_of("train"), 0)
    row = rows_of(dataset)["train, balanced"]
    assert row["samples"] == len(maps)
    assert row["maps"] == len(set(maps.tolist())) == len(dataset.maps_of("train")) - (dataset.split[7] == 0)
    chosen = dataset.labels[maps, trajectories]
    assert row["any failure"] == f"{(chosen > 0).mean():.2%}"
    assert row["tilt"] == f"{(chosen >= 4).mean():.2%}"


def test_other_subsets_may_be_shown(dataset):
    subset = np.array([1, 1]), np.array([0, 1])
    rows = rows_of(dataset, subsets={"two": subset}, as_in_paper=False)
    assert list(rows)[-1] == "two" and rows["two"]["samples"] == 2 and rows["two"]["maps"] == 1
    assert "paper's test set" not in rows and "train, balanced" not in rows


def test_the_paper_stands_beside(dataset):
    row = rows_of(dataset)["paper's test set"]
    assert [row[name] for name in tables.PAPER_SHARES] == ["6.23%", "5.50%", "0.42%", "9.60%"]


def test_the_table_has_a_line_for_each_row(dataset):
    lines = statistics_table(dataset).splitlines()
    assert len(lines) == 2 + len(rows_of(dataset))
    assert lines[0].split() == [*"maps samples step obstacle tilt any failure maps with none known".split()]


def test_a_group_without_known_trajectories_has_no_shares(dataset):
    dark = np.full(90, 8, np.uint8)[:, None].repeat(len(ACTIONS), axis=1)
    whole = Dataset(dataset.heights, dark, dataset.group, dataset.seed, np.zeros(90, np.uint8), SETUP, None)
    rows = rows_of(whole)
    assert rows["all maps"]["step"] == rows["all maps"]["none"] == "-" and rows["all maps"]["known"] == "0.0%"
    assert rows["test"]["maps"] == 0 and rows["test"]["known"] == "-"
    assert rows["train, balanced"]["samples"] == 0 and rows["train, balanced"]["any failure"] == "-"


def test_labels_are_counted_alike_in_any_chunks(dataset, monkeypatch):
    expected = np.stack([np.bincount(row, minlength=16) for row in dataset.labels])
    np.testing.assert_array_equal(label_counts(dataset.labels, 16), expected)
    monkeypatch.setattr(dataset_tables, "MAPS_AT_ONCE", 7)
    np.testing.assert_array_equal(label_counts(dataset.labels, 16), expected)


def test_the_balanced_subsets_are_those_of_training_and_validation(dataset):
    subsets = balanced_subsets(dataset)
    for name in ("train", "validation"):
        assert set(subsets[f"{name}, balanced"][0].tolist()) <= set(dataset.maps_of(name).tolist())


def test_a_site_of_one_split_and_a_style_have_one_row(dataset):
    alone = replace(dataset, split=np.repeat(np.arange(3, dtype=np.uint8), 30))
    assert list(rows_of(alone))[:4] == ["b", "a", "c", "all maps"]
    config = DatasetConfig(90)
    made = replace(dataset, group=config.styles(), seed=config.seeds(), split=config.splits(), config=config)
    assert list(rows_of(made))[:6] == [*STYLES, "all maps"]


def test_what_became_of_the_windows_has_a_line_for_each_site_and_all(dataset):
    sites = SitesConfig((Site("a.tif"), Site("b.tif", split="test")))
    read = ("ab" * 32, None, 0.0625, 2000.5, 0.9, 0.00123, 0.256)
    one = SiteRecord("a", "/there/a.tif", *read, 1030, 1000, 10, 0, 5, 7, 8)
    other = SiteRecord("b", "/there/b.tif", *read, 9, 0, 0, 6, 3, 0, 0)
    places = Provenance(np.zeros((90, 2)), np.zeros(90, np.uint8), sites, (one, other))
    lines = [line.split() for line in windows_table(places).splitlines()]
    assert lines[-3] == ["a", "0.0625", "0.123%", "25.6%", "1,030", "1,000", "10", "0", "5", "7", "8"]
    assert lines[-2] == ["b", "0.0625", "0.123%", "25.6%", "9", "0", "0", "6", "3", "0", "0"]
    assert lines[-1] == ["all", "sites", "1,039", "1,000", "10", "6", "8", "7", "8"]
    alone = Provenance(np.zeros((90, 2)), np.zeros(90, np.uint8), SitesConfig((Site("a.tif"),)), (one,))
    assert windows_table(alone).splitlines()[-1].split() == lines[-3]
