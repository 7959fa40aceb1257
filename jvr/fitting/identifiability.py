"""Identifiability: how well the images determine the unknowns, from the Gauss-Newton matrix."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Relative rounding of a column of the Jacobian, in units of its number format's epsilon. Positions in a grid of some hundred voxels
# are rounded to as many units, and the weights of interpolation inherit that. (Against float64 the demo's columns are off by up to 140.)
ROUNDING = 256
# Above this fraction of its square in the null space a value is not determined.
NULL_FRACTION = 1e-4


class Identifiability(NamedTuple):
    """How well the images determine the unknowns: standard errors and what is behind them.

    - `standard_errors`: of each unknown, in its own unit; infinite where the images do not determine it.
    - `variance`: of the residuals, `sum w r^2 / (m - rank)`.
    - `rank`: number of combinations of unknowns that the images determine.
    - `least_determined`: the least-determined direction among the unknowns that are seen at all, one coefficient for each (in units of
      its own sensitivity), unit length.
    - `condition`: largest over smallest eigenvalue that counts.
    """

    standard_errors: Float[np.ndarray, "unknowns"]
    variance: float
    rank: int
    least_determined: Float[np.ndarray, "unknowns"]
    condition: float


def undetermined(unknowns: int) -> Identifiability:
    """What stands for the identifiability of unknowns that are too many for their Gauss-Newton matrix: nothing but NaN."""
    nothing = np.full(unknowns, np.nan)
    return Identifiability(nothing, float("nan"), 0, nothing, float("nan"))


def identifiability(
    matrix: Float[np.ndarray, "n n"], squares: float, measurements: int, epsilon: float = float(np.finfo(np.float32).eps)
) -> Identifiability:
    """Standard errors of a weighted least-squares fit from its Gauss-Newton matrix `sum w J^T J` at the solution.

    An unknown with a zero column is seen by no ray. The others are scaled to columns of unit length and the matrix is diagonalised;
    eigenvalues at most `_noise` are rounding and span the null space. The covariance is `variance` times the pseudo-inverse; a value
    with weight in the null space gets an infinite error. Priors play no part.

    **Arguments:** `matrix`, summed in float64 from a Jacobian of a number format with the given `epsilon`; `squares`: `sum w r^2`;
    `measurements`: number of residuals.
    """
    matrix = np.asarray(matrix, np.float64)
    diagonal = np.diag(matrix)
    seen = np.flatnonzero(diagonal > 0)
    scale = 1 / np.sqrt(diagonal[seen])
    eigenvalues, vectors = np.linalg.eigh(scale[:, None] * matrix[np.ix_(seen, seen)] * scale)
    counts = eigenvalues > _noise(eigenvalues, epsilon)
    rank = int(counts.sum())
    variance = float(squares) / max(measurements - rank, 1)
    spread = np.square(vectors[:, counts]) @ (1 / eigenvalues[counts])
    null_fraction = np.square(vectors[:, ~counts]).sum(axis=1)
    errors, weakest = np.full(diagonal.size, np.inf), np.zeros(diagonal.size)
    errors[seen] = np.where(null_fraction > NULL_FRACTION, np.inf, np.sqrt(variance * spread) * scale)
    weakest[seen] = vectors[:, 0] if seen.size else 0.0
    condition = float(eigenvalues[-1] / eigenvalues[counts][0]) if rank else np.inf
    return Identifiability(errors, variance, rank, weakest, condition)


def _noise(eigenvalues: Float[np.ndarray, "n"], epsilon: float) -> float:
    """The largest eigenvalue that rounding can make out of zero.

    `n` columns of unit length, each rounded by `e = ROUNDING * epsilon`, change the Jacobian by at most `sqrt(n) e` (its Frobenius
    norm), hence also each singular value (Weyl), and a zero eigenvalue of its square by `n e^2`. Summing and diagonalising the square
    in float64 adds `n` times that format's epsilon of the largest eigenvalue.
    """
    largest = eigenvalues.max(initial=0.0)
    return eigenvalues.size * max((ROUNDING * epsilon) ** 2, float(np.finfo(np.float64).eps) * largest)
