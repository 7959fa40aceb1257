"""The hard cases of `experiments/stability.py`: float32 against float64, and nothing that is not finite."""

import sys
from pathlib import Path

import jax
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from experiments import stability

# Values are sums of a dozen terms, of rounding 6e-8 each, of light that itself went through exponentials of sums of a dozen terms.
VALUE = 1e-5
# Entries of a gradient are sums of both signs over the picture, of terms that are up to a hundred times the sum.
GRADIENT = 1e-3


# Structures of scenes among the hard cases, each with programs of its own.
STRUCTURES = 11


@pytest.fixture(scope="module")
def groups():
    return stability.groups(quick=True)


@pytest.mark.slow
def test_every_hard_case_is_in_a_group(groups):
    assert len(groups) == STRUCTURES
    assert {placed.row for group in groups for placed in group} == set(stability.rows(quick=True))


@pytest.mark.slow
@pytest.mark.parametrize("number", range(STRUCTURES))
def test_hard_cases(number, groups):
    ways = stability.compiled_ways()
    for row, case, modes in groups[number]:
        found = stability.measured(case, ways, modes=modes)
        assert not found.infinite, (row, case.label, found)
        assert found.value < VALUE, (row, case.label, found)
        assert found.gradient < GRADIENT, (row, case.label, found)
    jax.clear_caches()
