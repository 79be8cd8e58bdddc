"""Bars are drawn on a terminal alone, and lines are printed wherever output goes."""

import io
import sys

from tests.commandline import Terminal
from travjax import progress


def drawn() -> None:
    with progress.bar("maps", 3, "map") as bar:
        for _ in range(3):
            bar.update()
    assert list(progress.bar("rows", 2, "row", iterable=[1, 2])) == [1, 2]


def test_a_terminal_has_bars(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    drawn()
    assert "maps: 100%" in sys.stderr.getvalue() and "rows: 100%" in sys.stderr.getvalue()


def test_a_log_file_has_none(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    drawn()
    assert sys.stderr.getvalue() == ""


def test_a_quiet_terminal_has_none(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    with progress.bar("maps", 3, "map", quiet=True) as bar:
        bar.update()
    assert sys.stderr.getvalue() == ""


def test_closed_streams_are_no_reason_to_fail(monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    drawn()
    progress.say("one")
    monkeypatch.setattr(sys, "stdout", None)
    progress.say("two")


def test_lines_have_no_carriage_returns(monkeypatch, capsys):
    with progress.bar("maps", 3, "map") as bar:
        bar.update()
        progress.say("one")
    assert capsys.readouterr() == ("one\n", "")
