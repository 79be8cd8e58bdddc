"""The long campaign, `python -m tests.fuzz`: prints what was tried and which cases failed; seeds make them again."""

import argparse
import importlib
import itertools
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from tabulate import tabulate
from tqdm import tqdm

from . import campaign
from .worker import ACCEPTED, FAILED, REFUSED

SHOWN = 10
"""Failing cases of a format that are printed; all of them are kept."""


def main() -> int:
    """Runs the campaign; returns 1 where a case failed, else 0."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz",
        description="Damages files of every kind that travjax reads and has them read: each must give something valid, "
        "or one line that names the file.",
    )
    parser.add_argument("--minutes", type=float, default=5, metavar="M", help="how long new cases are begun (5)")
    parser.add_argument("--formats", nargs="+", metavar="F", help="kinds of files (all): see formats.py")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the first case of each format (0)")
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="processes (2)")
    parser.add_argument("--case", nargs="+", metavar="FORMAT:SEED", help="these cases alone")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/fuzz"), metavar="DIR", help="where files of failing cases go (runs/fuzz)"
    )
    given = parser.parse_args()
    known = list(importlib.import_module(campaign.FORMATS).FORMATS)
    pairs = [(name, int(seed)) for name, _, seed in (case.rpartition(":") for case in given.case or ())]
    names = list(dict.fromkeys(name for name, _ in pairs)) if pairs else given.formats or known
    if unknown := sorted(set(names) - set(known)):
        parser.error(f"unknown formats: {', '.join(unknown)}; there are: {', '.join(known)}")
    cases = iter(pairs) if pairs else _until(time.monotonic() + 60 * given.minutes, names, given.seed)
    with tqdm(desc="cases", unit="case") as bar:
        found = campaign.run(cases, names, workers=given.workers, keep=given.out, on_finding=lambda _: bar.update())
    _print(found, names, bool(pairs))
    return int(any(finding.result == FAILED for finding in found))


def _until(end: float, names: list[str], first: int) -> Iterator[campaign.Case]:
    """Cases of the formats in turn; the clock begins to count with the first one."""
    for seed in itertools.count(first):
        for name in names:
            if time.monotonic() > end:
                return
            yield name, seed


def _print(found: list[campaign.Finding], names: list[str], all_of_them: bool) -> None:
    counts = Counter((finding.case[0], finding.result) for finding in found)
    results = (ACCEPTED, REFUSED, FAILED)
    rows = [[name, *(counts[name, result] for result in results)] for name in names]
    rows.append(["all", *(sum(row[column] for row in rows) for column in range(1, 4))])
    print(tabulate(rows, ["format", *results]))
    for name in names:
        own = [finding for finding in found if finding.case[0] == name and (all_of_them or finding.result == FAILED)]
        print(*own[:SHOWN], sep="\n", end="\n" if own else "")
        if len(own) > SHOWN:
            print(f"{name}: {len(own) - SHOWN} more")


if __name__ == "__main__":
    sys.exit(main())
