"""Fifty damaged files of each format: each is read or refused in one line, soon, in little memory, with nothing on the terminal."""

import pytest
from parent import findings
from seeds import all_seeds

COUNT = 50


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    return list(all_seeds(tmp_path_factory.mktemp("seeds")))


@pytest.mark.slow
def test_damaged_files_are_read_or_refused_in_one_line(names):
    found = findings(names, COUNT)
    assert len(found) >= 95
    assert {name: outcome.faults[:5] for name, outcome in found.items() if outcome.faults} == {}
    # Damage shows: of every format some files are refused, but where few are read.
    assert [name for name, outcome in found.items() if outcome.accepted > 2 and not outcome.refused] == []


KINDS = ("signal", "exception", "time", "terminal", "memory", "no more than announced")


@pytest.mark.slow
def test_the_fuzzer_sees_signals_exceptions_time_and_memory():
    found = findings([f"faulty: {kind}" for kind in KINDS], 0)
    (signal,), (exception,), (time,), (terminal,), (memory,), none = (outcome.faults for outcome in found.values())
    assert "ended the process with -11" in signal
    assert "KeyError" in exception
    assert "took 2." in time
    assert "wrote b'libx: odd' on the terminal" in terminal
    assert "took 40 MiB, announced 1.0 MiB" in memory
    assert none == []
