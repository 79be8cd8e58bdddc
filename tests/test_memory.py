"""What fits is said before it is taken."""

import pytest

from travjax import memory
from travjax.config import InputError


def test_what_is_there_is_some_memory_and_no_more_than_the_machine_has():
    assert 2**26 < memory.available() < 2**50


def test_a_container_that_may_take_less_counts(tmp_path, monkeypatch):
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(memory, "CGROUP", limit)
    limit.write_text("1000000\n")
    assert memory.available() == 1_000_000
    limit.write_text("max\n")
    assert memory.available() > 2**26


def test_more_than_there_is_is_refused_with_both_sizes(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda: 3 * 2**30)
    memory.require_memory(3 * 2**30, "heights")
    with pytest.raises(
        InputError, match="^heights: takes 4.0 GiB of memory: must be at most 3.0 GiB, which is free; hm$"
    ):
        memory.require_memory(4 * 2**30, "heights", "; hm")
