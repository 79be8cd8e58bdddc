"""Tables about a data set: failure shares of its groups, splits and balanced subsets, beside the paper's shares.

Packed labels are counted a few maps at a time, since a data set of the paper's size has 173 million of them.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from travjax.config import to_json
from travjax.data.dataset import SPLITS, Dataset
from travjax.data.provenance import Provenance
from travjax.data.sampling import MAPS_AT_ONCE, Samples, are_known, balanced_subset
from travjax.evaluation.tables import ANY, PAPER_SHARES, rows_table
from travjax.files import first_lines
from travjax.simulation.events import EVENTS, FAILED, label_bit, label_codes
from travjax.simulation.robot import Robot

WINDOW_COLUMNS = {
    "name": "site",
    "cell_size": "cells\n(m)",
    "filled": "filled",
    "unknown": "unknown",
    "windows": "windows",
    **{split: split for split in SPLITS},
    "too_unknown": "left out:\nunknown",
    "near_test": "left out:\nnear test",
    "shared": "left out:\nshared",
}


def columns_of(robot: Robot) -> dict[str, str]:
    """Returns the keys and headings of the columns of `statistics_table` for a robot's data set."""
    same = {name: name for name in ("maps", "samples", *robot.event_names, ANY)}
    return {"what": ""} | same | {"none": "maps with none", "known": "known"}


def are_headings(line: str) -> bool:
    """Tells whether a line is the first line of `statistics_table`, whatever events the robot has."""
    first, last = ["maps", "samples", *EVENTS], [*ANY.split(), "maps", "with", "none", "known"]
    words = line.split()
    return words[: len(first)] == first and words[len(first) :][-len(last) :] == last


def dataset_tables(dataset: Dataset) -> dict[str, str]:
    """Returns tables by headline: the failure shares and, for real maps, how the windows were used."""
    in_paper = dataset.config is not None and dataset.setup.as_in_paper
    sizes = ", ".join(f"{len(dataset.maps_of(split))} {split}" for split in SPLITS)
    trajectories = f"{dataset.robot.name}, {len(dataset.actions)} trajectories a map"
    headline = f"{len(dataset.split)} maps ({sizes}), {trajectories}; shares that fail:"
    tables = {headline: statistics_table(dataset, as_in_paper=in_paper)}
    if dataset.provenance:
        copies = int((dataset.provenance.quarter_turns > 0).sum())
        headline = f"Windows of the sites, beside which {copies} maps are turned copies:"
        tables[headline] = windows_table(dataset.provenance)
    return tables


def are_statistics(path: Path) -> bool:
    """Tells whether a file holds the tables of a data set: its first line must hold the headings."""
    return [are_headings(line) for line in first_lines(path, 1)] == [True]


def statistics_table(dataset: Dataset, subsets: dict[str, Samples] | None = None, as_in_paper: bool = True) -> str:
    """Tabulates failure shares of known trajectories for each group, split and subset.

    subsets:     samples by name; the balanced subsets of training and validation unless given
    as_in_paper: whether the paper's shares can be compared with these, and get a row
    """
    return rows_table(statistics_rows(dataset, subsets, as_in_paper), columns_of(dataset.robot))


def statistics_rows(
    dataset: Dataset, subsets: dict[str, Samples] | None = None, as_in_paper: bool = True
) -> Iterator[dict]:
    """Yields the rows of `statistics_table`; a site with several splits also has a row for each of them."""
    robot = dataset.robot
    counts = label_counts(dataset.labels, label_codes(len(robot.events)))
    for name in dict.fromkeys(dataset.group.tolist()):
        members = dataset.group == name
        yield _row(name, counts[members], robot)
        splits = np.unique(dataset.split[members]) if dataset.config is None else ()
        for index in splits if len(splits) > 1 else ():
            yield _row(f"{name}, {SPLITS[index]}", counts[members & (dataset.split == index)], robot)
    yield _row("all maps", counts, robot)
    for index, name in enumerate(SPLITS):
        yield _row(name, counts[dataset.split == index], robot)
    if as_in_paper:
        shares = {name: f"{share:.2%}" for name, share in PAPER_SHARES.items()}
        yield dict.fromkeys(columns_of(robot)) | {"what": "paper's test set"} | shares
    for name, samples in (balanced_subsets(dataset) if subsets is None else subsets).items():
        yield _subset_row(name, dataset.labels, samples, robot)


def windows_table(provenance: Provenance) -> str:
    """Tabulates how each site was read, how many of its windows each split has, and how many were left out and why."""
    rows = [to_json(site) for site in provenance.sites]
    totals = {name: sum(row[name] for row in rows) for name in list(WINDOW_COLUMNS)[4:]}
    for row in rows:
        row |= {"filled": f"{row['filled']:.3%}", "unknown": f"{row['unknown']:.1%}"}
    if len(rows) > 1:
        rows.append(dict.fromkeys(WINDOW_COLUMNS) | {"name": "all sites"} | totals)
    return rows_table(rows, WINDOW_COLUMNS)


def balanced_subsets(dataset: Dataset) -> dict[str, Samples]:
    """Draws the fixed balanced subsets of training and validation."""
    seed = dataset.config.seed if dataset.config else 0
    splits = ("train", "validation")
    return {f"{name}, balanced": balanced_subset(dataset.labels, dataset.maps_of(name), seed) for name in splits}


def label_counts(labels: np.ndarray, codes: int) -> np.ndarray:
    """Counts how often each label below `codes` occurs on each map: labels [n, t] uint8, result [n, codes]."""
    counts = np.zeros((len(labels), codes), np.int64)
    for start in range(0, len(labels), MAPS_AT_ONCE):
        chunk = labels[start : start + MAPS_AT_ONCE]
        places = np.arange(len(chunk))[:, None] * codes + chunk
        counted = np.bincount(places.ravel(), minlength=len(chunk) * codes)
        counts[start : start + MAPS_AT_ONCE] = counted.reshape(-1, codes)
    return counts


def _row(name: str, counts: np.ndarray, robot: Robot) -> dict:
    """Makes the table row of maps with these label counts [n, codes]."""
    codes = np.arange(counts.shape[1])
    known = counts[:, are_known(codes)].sum(axis=1)
    fails = counts[known > 0][:, are_known(codes) & (codes > 0)].sum(axis=1)
    total = counts.sum()
    return {
        "what": name,
        "maps": len(counts),
        "samples": int(known.sum()),
        **_shares(counts.sum(axis=0), robot),
        "none": f"{(fails == 0).mean():.1%}" if len(fails) else "-",
        "known": f"{known.sum() / total:.1%}" if total else "-",
    }


def _subset_row(name: str, labels: np.ndarray, samples: Samples, robot: Robot) -> dict:
    maps, trajectories = samples
    counts = np.bincount(labels[maps, trajectories], minlength=label_codes(len(robot.events)))
    size = {"what": name, "maps": len(np.unique(maps)), "samples": len(maps)}
    return dict.fromkeys(columns_of(robot)) | size | _shares(counts, robot)


def _shares(counts: np.ndarray, robot: Robot) -> dict[str, str]:
    """Formats the shares of known trajectories with each event and with any, from the label counts [codes]."""
    codes = np.arange(len(counts))
    total = counts[are_known(codes)].sum()
    wanted = {name: 1 << label_bit(event) for event, name in enumerate(robot.event_names)} | {ANY: FAILED}
    fails = {name: counts[are_known(codes) & ((codes & bits) > 0)].sum() for name, bits in wanted.items()}
    return {name: f"{count / total:.2%}" if total else "-" for name, count in fails.items()}
