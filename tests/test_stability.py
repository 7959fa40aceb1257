"""The hard cases of `experiments/stability.py`: float32 against float64, and nothing that is not finite."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from experiments import stability

# Values are sums of a dozen terms, of rounding 6e-8 each, of light that itself went through exponentials of sums of a dozen terms.
VALUE = 1e-5
# Entries of a gradient are sums of both signs over the picture, of terms that are up to a hundred times the sum.
GRADIENT = 1e-3


@pytest.mark.slow
def test_hard_cases():
    result = stability.table(quick=True)
    assert len(result) > 15
    for row in result:
        assert not row["not finite"], row
        assert row["value"] < VALUE, row
        assert row["gradient"] < GRADIENT, row
