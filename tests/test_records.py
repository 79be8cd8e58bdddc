"""Our own text files with anything in them: they are read or refused in one line, whatever another program wrote.

Each value of a whole file is replaced by each of HOSTILE, and left out.
"""

import json
import math
from collections.abc import Iterator, Sequence
from copy import deepcopy
from typing import Any

import pytest

from tests.data.test_dataset import placed_maps
from tests.small_training import run_of
from travjax.config import InputError, from_json, to_json
from travjax.data import dataset_json
from travjax.data.dataset import Dataset, is_dataset, load, save
from travjax.data.provenance import SiteRecord, SitesConfig
from travjax.estimators.preset import Preset, TrainingConfig
from travjax.evaluation.dataset_tables import statistics_table, windows_table
from travjax.experiments.transfer_runs import TransferConfig
from travjax.experiments.transfer_scores import Epoch
from travjax.runs.run import Run, checked_meta
from travjax.simulation.actions import ActionSpace
from travjax.simulation.grid import Grid
from travjax.simulation.robot import Robot

PLACED = placed_maps()
PROVENANCE = PLACED.provenance
assert PROVENANCE

DIGITS = 10**5000
"""Python writes no number of so many digits."""

LISTS = [[], [1], [0.1, 0.2], ["inf"], [None], [[1, 2]], ["north", 3], [{}], [math.nan, 1], [True, False]]
NUMBERS = [True, 0, -1, 1, 2, DIGITS, 2**63, 0.5, 1e300, -1e-300, 1e-40, math.nan, math.inf, -math.inf]
TEXTS = ["", "a", "inf", "x" * 5000, "a\nb", "\x1b[31m", "\x00", "\ud800"]
HOSTILE = [None, *NUMBERS, *TEXTS, *LISTS, {}, {"a": 1}]

CONFIGS: dict[type, dict] = {
    Robot: to_json(Robot.load("leo_rover")),
    ActionSpace: to_json(ActionSpace()),
    Grid: to_json(Grid()),
    Preset: to_json(Preset()),
    SitesConfig: to_json(PROVENANCE.config),
    SiteRecord: to_json(PROVENANCE.sites[0]),
    TransferConfig: to_json(TransferConfig(training=TrainingConfig(head_epochs=0))),
}


def places(table: Any, before: tuple = ()) -> Iterator[tuple]:
    """Yields the places of everything in nested tables and lists, from the outside to the inside."""
    for key, value in table.items() if isinstance(table, dict) else enumerate(table):
        yield (*before, key)
        if isinstance(value, dict | list):
            yield from places(value, (*before, key))


def altered(table: dict, values: Sequence = HOSTILE) -> Iterator[dict]:
    """The table with each value replaced by each of those, and left out."""
    for *before, last in places(table):
        for value in [*values, ...]:
            other = deepcopy(table)
            inner = other
            for key in before:
                inner = inner[key]
            if value is ...:
                del inner[last]
            else:
                inner[last] = value
            yield other


def refused(function, *arguments) -> bool:
    """Whether a call raises InputError, which must be one printable line of bounded length."""
    try:
        function(*arguments)
    except InputError as error:
        assert str(error).isprintable() and len(str(error)) <= 600
        return True
    return False


@pytest.mark.parametrize("kind", CONFIGS)
def test_a_configuration_is_made_or_refused_in_one_line(kind):
    def made(table):
        config = from_json(table, kind)
        hash(config)
        json.dumps(to_json(config), allow_nan=False)

    outcomes = [refused(made, table) for table in altered(CONFIGS[kind])]
    assert 0.4 < sum(outcomes) / len(outcomes) < 1


def test_a_run_is_read_or_refused_in_one_line():
    outcomes = [refused(Run.from_json, table) for table in altered(run_of().to_json())]
    assert 0.4 < sum(outcomes) / len(outcomes) < 1


def test_what_came_of_an_epoch_is_read_or_refused_in_one_line():
    counts = {"confusion": {"tn": 1, "fp": 2, "fn": 3, "tp": 4, "f1": 0.5}}
    sites = {"quarry": dict.fromkeys(("step", "obstacle", "tilt", "overall"), counts)}
    row = {"step": 1, "epoch": 1, "eval_sets": sites, "average_precision": {"overall": 0.5}}
    outcomes = [refused(Epoch.from_row, other) for other in altered(row)]
    assert 0.4 < sum(outcomes) / len(outcomes) < 1


def test_the_meta_of_a_checkpoint_is_read_or_refused_in_one_line(tmp_path):
    position = {"phase": 1, "epoch": 0, "step": 2, "total": 2, "loss": 0.5, "samples": 3.0, "best": -1.0}
    meta = {"position": position, "optimizer": 1, "dataset": "0123"}
    assert checked_meta(meta, tmp_path) == meta
    assert all(
        refused(checked_meta, {name: meta[name] for name in meta if name != left_out}, tmp_path) for left_out in meta
    )
    outcomes = [refused(checked_meta, other, tmp_path) for other in altered(meta)]
    assert 0.4 < sum(outcomes) / len(outcomes) < 1


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A data set of real maps, which has every kind of entry in its dataset.json."""
    save(PLACED, tmp_path_factory.mktemp("set") / "set")
    return tmp_path_factory.getbasetemp() / "set0" / "set"


def with_checksum(table: dict) -> str:
    """A dataset.json as another program might write it, with a checksum wherever there is one."""
    described = {key: value for key, value in table.items() if key != "sha256"}
    try:
        described |= {"sha256": dataset_json.digest(described)}
    except ValueError:  # of a number that is not finite
        described |= {"sha256": "none"}
    return json.dumps(described)


def shown(folder) -> Dataset:
    """Reads a data set and makes the tables that `travjax dataset --check` prints."""
    loaded = load(folder)
    statistics_table(loaded, as_in_paper=False)
    windows_table(loaded.provenance) if loaded.provenance else None
    return loaded


def test_a_data_set_of_another_program_is_read_or_refused_in_one_line(folder):
    path = folder / "dataset.json"
    whole = path.read_text()
    table = json.loads(whole)
    outcomes = []
    for number, other in enumerate(altered(table, [value for value in HOSTILE if value is not DIGITS])):
        if number % 7:  # reading takes a few milliseconds
            continue
        path.write_text(with_checksum(other))
        outcomes.append(refused(shown, folder))
        is_dataset(folder)
        path.write_text(whole)
    assert 0.4 < sum(outcomes) / len(outcomes) < 1
    assert not refused(shown, folder)
