"""A short campaign of damaged files against every reader; and whether a campaign catches what it should."""

import gzip
import io
import itertools
import zipfile

import numpy as np
import pytest

from tests.fuzz import campaign, faults
from tests.fuzz.formats import FORMATS
from tests.fuzz.mutations import KINDS, mutated
from tests.fuzz.worker import ACCEPTED, FAILED, REFUSED

CASES = 10
"""Cases of each format; `python -m tests.fuzz --case FORMAT:SEED` repeats one."""


@pytest.fixture(scope="module")
def findings() -> list[campaign.Finding]:
    """What the cases of all formats find."""
    return campaign.run(itertools.product(FORMATS, range(CASES)), list(FORMATS))


@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_file_gives_something_valid_or_one_line_that_names_it(findings, name):
    own = [finding for finding in findings if finding.case[0] == name]
    assert [finding.case[1] for finding in own] == list(range(CASES))
    failed = [str(finding) for finding in own if finding.result == FAILED]
    assert not failed, "\n".join(failed)


def test_the_short_campaign_gets_past_what_reads_a_file_first(findings):
    """If nothing were accepted or nothing refused, damage would be too strong or too weak to test anything."""
    results = [finding.result for finding in findings]
    assert results.count(ACCEPTED) > len(results) / 20 and results.count(REFUSED) > len(results) / 4


# ---- The campaign itself


@pytest.fixture(scope="module")
def caught() -> dict[str, campaign.Finding]:
    """One case of each reader of faults.py that accepts its seed, but for the one that hangs."""
    names = [name for name in faults.FORMATS if name not in ("hangs", "refuses all")]
    found = campaign.run([(name, 0) for name in names], names, module="tests.fuzz.faults")
    return {finding.case[0]: finding for finding in found}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("raises", "KeyError at faults.py:"),
        ("returns nonsense", "Invalid at faults.py:"),
        ("aborts", "the process ended by signal SIGABRT"),
        ("exits", "the process ended by exit code 3"),
        ("takes memory", "MemoryError at faults.py:"),
        ("warns", "RuntimeWarning at faults.py:"),
        ("prints", "words on standard error: libtiff: bad"),
        ("says two lines", "a message that is not one line: "),
        ("names no file", "a message that names no file: cannot be read"),
    ],
)
def test_a_fault_is_caught(caught, name, message):
    assert caught[name].result == FAILED and caught[name].message.startswith(message)
    assert set(faults.FAULTS) <= set(caught)


def test_what_is_valid_or_refused_in_one_line_is_no_fault(caught):
    assert (caught["accepts"].result, caught["refuses"].result) == (ACCEPTED, REFUSED)


def test_a_process_that_hangs_is_ended_and_its_files_are_kept(tmp_path):
    cases = [("hangs", 0), ("hangs", 1)]
    found = campaign.run(cases, ["hangs"], workers=1, module="tests.fuzz.faults", patience=1, keep=tmp_path)
    assert [finding.case for finding in found] == cases
    for finding in found:
        assert finding.result == FAILED and finding.message == "no answer within 1 s"
        assert finding.kept and (finding.kept / "it").read_bytes() != faults.WHOLE


def test_a_seed_that_its_reader_refuses_is_an_error_of_the_table():
    with pytest.raises(RuntimeError, match="refuses all: an undamaged file is not accepted: .*: no file of ours"):
        campaign.run([], ["refuses all"], module="tests.fuzz.faults")


# ---- Damage


def text(seed: int) -> bytes:
    return b"".join(b"name_%d = %d.5 # word\n" % (n, n * seed) for n in range(200))


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_damage_does_something_and_the_same_for_a_seed(kind):
    made = [kind(text(3), np.random.default_rng(seed)) for seed in (*range(20), *range(20))]
    assert made[:20] == made[20:]
    assert sum(data != text(3) for data, _ in made[:20]) > 15
    for data in (b"", b"x"):
        kind(data, np.random.default_rng(0))


def test_archives_are_damaged_within_and_packed_again():
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as file:
        file.writestr("a.npy", text(1))
        file.writestr("b.npy", text(2))
    for whole in (packed.getvalue(), gzip.compress(text(1), mtime=0)):
        opened = 0
        for seed in range(40):
            data, said = mutated(whole, np.random.default_rng(seed))
            if said.startswith("in "):
                with zipfile.ZipFile(io.BytesIO(data)) as file:
                    assert sorted(file.namelist()) == ["a.npy", "b.npy"] and file.testzip() is None
                    opened += {file.read("a.npy"), file.read("b.npy")} != {text(1), text(2)}
            elif said.startswith("unpacked: "):
                opened += gzip.decompress(data) != text(1)
        assert opened > 10
