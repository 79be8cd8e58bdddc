"""Shared by the experiments: how they start, where their presets are, and the report that they write at the end."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from travjax.entry import Parser, guarded, use_compilation_cache
from travjax.files import save_text

GOES_ON = "the same command goes on from there"
"""Message of an experiment that is stopped."""

Piece = str | Path
"""A part of a report: text, or a figure."""


def parser(name: str, description: str) -> Parser:
    """Returns an empty parser for `python -m travjax.experiments.NAME`."""
    return Parser(prog=f"python -m travjax.experiments.{name}", description=description)


def launch(
    options: argparse.ArgumentParser, run: Callable[[argparse.Namespace], object], argv: Sequence[str] | None = None
) -> int:
    """Parses the options and runs the experiment; returns the exit code, 2 for bad input, reported in one line."""

    def work() -> None:
        arguments = options.parse_args(argv)
        use_compilation_cache()
        run(arguments)

    return guarded(work)


def write_report(folder: Path, title: str, pieces: Sequence[Piece]) -> Path:
    """Writes report.md: Markdown text, and figures in the folder, with captions after the file names."""
    shown = [piece if isinstance(piece, str) else _figure(piece.relative_to(folder)) for piece in pieces]
    return save_text(folder / "report.md", "\n\n".join([f"# {title}", *shown]) + "\n")


def _figure(path: Path) -> str:
    return f"![{path.stem.replace('_', ' ').capitalize()}]({path.as_posix()})"


def verbatim(text: str, language: str = "") -> str:
    """Returns a text as a code block of a report."""
    return f"```{language}\n{text}\n```"
