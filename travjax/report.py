"""Printed tables."""

from collections.abc import Iterable, Sequence

import numpy as np
from tabulate import tabulate

PAPER_SHARES = {"step": 0.0623, "obstacle": 0.0550, "tilt": 0.0042, "any failure": 0.096}
"""Shares of the paper's synthetic test trajectories that fail (SPEC section 10); its robot is not published in full."""


def shares_table(
    groups: Sequence[str] | np.ndarray, failed: np.ndarray, known: np.ndarray, as_in_paper: bool = True
) -> str:
    """Shares of known trajectories that fail, for each group of maps and overall, the paper's below if they compare.

    groups: [n] name of each map's group; failed: [n, t, 3]; known: [n, t]
    """
    members: np.ndarray = np.asarray(groups)
    names = list(dict.fromkeys(groups))
    rows = [_shares(name, failed[members == name], known[members == name]) for name in names]
    if len(names) > 1:
        rows.append(_shares("overall", failed, known))
    if as_in_paper:
        rows.append(["paper's test set", None, *(f"{share:.2%}" for share in PAPER_SHARES.values()), None, None])
    headers = ["", "maps", *PAPER_SHARES, "maps with none", "known"]
    return tabulate(rows, headers, disable_numparse=True, stralign="right", colalign=("left",))


def _shares(name: str, failed: np.ndarray, known: np.ndarray) -> list:
    total = known.sum()
    if not total:
        return [name, len(known), *["-"] * 5, "0.0%"]
    events = [failed[..., event][known].mean() for event in range(3)]
    any_event: np.ndarray = np.asarray(failed.any(axis=-1) & known)
    none = ~any_event[known.any(axis=-1)].any(axis=-1)
    return [
        name,
        str(len(known)),
        *(f"{share:.2%}" for share in (*events, any_event[known].mean())),
        f"{none.mean():.1%}",
        f"{known.mean():.1%}",
    ]


def rows_table(rows: Iterable[dict], columns: dict[str, str]) -> str:
    """A table of dicts; columns maps keys to headings. None is left blank, numbers have four significant digits."""
    cells = [[_cell(row[key]) for key in columns] for row in rows]
    return tabulate(cells, list(columns.values()), disable_numparse=True, stralign="right", colalign=("left",))


def _cell(value) -> str:
    if value is None:
        return ""
    if isinstance(value, float) and value < 1e4:
        return f"{value:,.4g}"
    return f"{value:,.0f}" if isinstance(value, int | float) else str(value)
