"""What a data set holds: failure shares of each group and split, and of its balanced subsets, beside the paper's.

Counted from the packed labels a few maps at a time, since a data set of the paper's size has 173 million of them.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from travjax.config import to_json
from travjax.data.dataset import SPLITS, Dataset
from travjax.data.provenance import Provenance
from travjax.data.sampling import FAILED, MAPS_AT_ONCE, UNKNOWN_LABEL, Samples, balanced_subset
from travjax.evaluation.tables import PAPER_SHARES, rows_table
from travjax.files import first_lines
from travjax.simulation.traverse import EVENTS, as_in_paper

COLUMNS = {
    "what": "",
    "maps": "maps",
    "samples": "samples",
    **{name: name for name in PAPER_SHARES},
    "none": "maps with none",
    "known": "known",
}

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

CODES = 2 * UNKNOWN_LABEL
"""A label is a number below this."""


def dataset_tables(dataset: Dataset) -> dict[str, str]:
    """Returns tables by their headlines: the shares that fail and, of real maps, what became of the windows."""
    in_paper = dataset.config is not None and as_in_paper(dataset.robot, dataset.actions)
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
    """Tells whether a file holds the tables of a data set: its first line is that of the headings."""
    return [line.split() for line in first_lines(path, 1)] == [" ".join(COLUMNS.values()).split()]


def statistics_table(dataset: Dataset, subsets: dict[str, Samples] | None = None, as_in_paper: bool = True) -> str:
    """Failure shares of known trajectories for each group, split and subset, and the paper's if they compare.

    subsets: what to call them, and their samples; the balanced subsets of training and validation unless given
    """
    return rows_table(statistics_rows(dataset, subsets, as_in_paper), COLUMNS)


def statistics_rows(
    dataset: Dataset, subsets: dict[str, Samples] | None = None, as_in_paper: bool = True
) -> Iterator[dict]:
    """The rows of `statistics_table`; a site of several splits has one for each of them as well."""
    counts = label_counts(dataset.labels)
    for name in dict.fromkeys(dataset.group.tolist()):
        members = dataset.group == name
        yield _row(name, counts[members])
        splits = np.unique(dataset.split[members]) if dataset.config is None else ()
        for index in splits if len(splits) > 1 else ():
            yield _row(f"{name}, {SPLITS[index]}", counts[members & (dataset.split == index)])
    yield _row("all maps", counts)
    for index, name in enumerate(SPLITS):
        yield _row(name, counts[dataset.split == index])
    if as_in_paper:
        shares = {name: f"{share:.2%}" for name, share in PAPER_SHARES.items()}
        yield dict.fromkeys(COLUMNS) | {"what": "paper's test set"} | shares
    for name, samples in (balanced_subsets(dataset) if subsets is None else subsets).items():
        yield _subset_row(name, dataset.labels, samples)


def windows_table(provenance: Provenance) -> str:
    """How each site was read, and how many of its windows are for each split or left out, and why."""
    rows = [to_json(site) for site in provenance.sites]
    totals = {name: sum(row[name] for row in rows) for name in list(WINDOW_COLUMNS)[4:]}
    for row in rows:
        row |= {"filled": f"{row['filled']:.3%}", "unknown": f"{row['unknown']:.1%}"}
    if len(rows) > 1:
        rows.append(dict.fromkeys(WINDOW_COLUMNS) | {"name": "all sites"} | totals)
    return rows_table(rows, WINDOW_COLUMNS)


def balanced_subsets(dataset: Dataset) -> dict[str, Samples]:
    """The fixed balanced subsets of training and validation."""
    seed = dataset.config.seed if dataset.config else 0
    splits = ("train", "validation")
    return {f"{name}, balanced": balanced_subset(dataset.labels, dataset.maps_of(name), seed) for name in splits}


def label_counts(labels: np.ndarray) -> np.ndarray:
    """How often each label occurs on each map: labels [n, t] uint8, result [n, 16]."""
    counts = np.zeros((len(labels), CODES), np.int64)
    for start in range(0, len(labels), MAPS_AT_ONCE):
        chunk = labels[start : start + MAPS_AT_ONCE]
        places = np.arange(len(chunk))[:, None] * CODES + chunk
        counts[start : start + MAPS_AT_ONCE] = np.bincount(places.ravel(), minlength=chunk.shape[0] * CODES).reshape(
            -1, CODES
        )
    return counts


def _row(name: str, counts: np.ndarray) -> dict:
    """The shares of maps with these counts [n, 16]."""
    known = counts[:, :UNKNOWN_LABEL].sum(axis=1)
    fails = counts[known > 0, 1:UNKNOWN_LABEL].sum(axis=1)
    total = counts.sum()
    return {
        "what": name,
        "maps": len(counts),
        "samples": int(known.sum()),
        **_shares(counts.sum(axis=0)),
        "none": f"{(fails == 0).mean():.1%}" if len(fails) else "-",
        "known": f"{known.sum() / total:.1%}" if total else "-",
    }


def _subset_row(name: str, labels: np.ndarray, samples: Samples) -> dict:
    maps, trajectories = samples
    counts = np.bincount(labels[maps, trajectories], minlength=CODES)
    size = {"what": name, "maps": len(np.unique(maps)), "samples": len(maps)}
    return dict.fromkeys(COLUMNS) | size | _shares(counts)


def _shares(counts: np.ndarray) -> dict[str, str]:
    """The share of each event and of any among known trajectories, from how often each label occurs: [16]."""
    codes, known = np.arange(UNKNOWN_LABEL), counts[:UNKNOWN_LABEL].sum()
    wanted = [1 << event for event in range(len(EVENTS))] + [FAILED]
    shares = [counts[:UNKNOWN_LABEL][(codes & bits) > 0].sum() for bits in wanted]
    return {name: f"{share / known:.2%}" if known else "-" for name, share in zip(PAPER_SHARES, shares, strict=True)}
