"""An exported function as a file, and beside it what it is as JSON, from which travjax knows it as its own."""

import json
from pathlib import Path

import jax

from travjax.config import InputError
from travjax.files import atomic_write, require_replaceable, save_text, sha256
from travjax.simulation.setup import Setup


def require_place(to: Path, suffix: str) -> None:
    """Raises InputError unless a file has the suffix, and travjax may write it and its description."""
    if to.suffix != suffix:
        raise InputError(f"--to {to}: must be a {suffix} file")
    require_replaceable(to, _is_described, f"--to {to}", "exported file")
    require_replaceable(_beside(to), lambda path: bool(_sum_in(path)), f"--to {to}", "description")


def write(to: Path, data: bytes, setup: Setup, source: str, outputs: dict[str, str]) -> tuple[Path, Path]:
    """Writes an exported function and its description, a .json beside it; returns where both are.

    source:  what the function is
    outputs: what its results are, by name
    Raises InputError when one of them cannot be written.
    """
    rows, cols = setup.grid.shape
    with atomic_write(to) as temporary:
        temporary.write_bytes(data)
        described = setup.to_json_text(
            function=source,
            inputs={"heights": f"[b, {rows}, {cols}] float32 metres, NaN unknown"},
            outputs=outputs,
            events=setup.robot.event_names,
            limits=setup.robot.limits,
            trajectories=len(setup.actions),
            jax=jax.__version__,
            sha256=sha256(temporary),
        )
        description = save_text(_beside(to), f"{described}\n")  # first: a file without it would count as another's
    return to, description


def _beside(to: Path) -> Path:
    """Returns where the description of a file is."""
    return to.with_name(f"{to.name}.json")


def _is_described(path: Path) -> bool:
    """Tells whether the description beside a file is the file's."""
    return _sum_in(_beside(path)) == sha256(path)


def _sum_in(path: Path) -> str | None:
    """Returns the SHA-256 that a description names; None if a file is none."""
    try:
        described = json.loads(path.read_bytes())
        return described["sha256"] if "travjax" in described else None
    except (OSError, ValueError, LookupError, TypeError):
        return None
