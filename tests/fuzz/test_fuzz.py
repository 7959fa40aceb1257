"""Two hundred damaged files of each format: none ends a process, takes long or much, or raises what is not documented."""

import re

import pytest
from parent import findings
from seeds import all_seeds

COUNT = 200


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    return list(all_seeds(tmp_path_factory.mktemp("seeds")))


def test_damaged_files_are_read_or_refused_in_one_line(names):
    found = findings(names, COUNT)
    assert len(found) >= 45
    assert {name: faults[:5] for name, faults in found.items() if faults} == {}


def test_the_fuzzer_sees_signals_exceptions_time_and_memory():
    found = findings(["faulty: signal", "faulty: exception", "faulty: time", "faulty: memory"], 1)
    (signal,), (exception,), (time,), (memory,) = found.values()
    assert "ended the process with -11" in signal
    assert "KeyError" in exception
    assert "took 2." in time
    assert re.search(r"took \d\d MiB", memory)
