"""How well the images determine the unknowns."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Above this share of its square in the null space a value is not determined.
NULL_SHARE = 1e-4


class Determination(NamedTuple):
    """Standard errors and what is behind them.

    - `standard_errors`: of each unknown, in its own unit; infinite where the images do not determine it.
    - `variance`: of the residuals, `sum w r^2 / (m - rank)`.
    - `rank`: number of combinations of unknowns that the images determine.
    - `worst`: the worst-determined combination, one coefficient for each unknown (in units of its own sensitivity), unit length.
    - `condition`: largest over smallest eigenvalue that counts.
    """

    standard_errors: Float[np.ndarray, "unknowns"]
    variance: float
    rank: int
    worst: Float[np.ndarray, "unknowns"]
    condition: float


def undetermined(unknowns: int) -> Determination:
    """What stands for the determination of unknowns that are too many for their Gauss-Newton matrix: nothing but NaN."""
    nothing = np.full(unknowns, np.nan)
    return Determination(nothing, float("nan"), 0, nothing, float("nan"))


def determination(
    matrix: Float[np.ndarray, "n n"], squares: float, measurements: int, epsilon: float = float(np.finfo(np.float32).eps)
) -> Determination:
    """Standard errors of a weighted least-squares fit from its Gauss-Newton matrix `sum w J^T J` at the solution.

    The matrix is scaled to a unit diagonal and diagonalised; eigenvalues at most `n * epsilon` times the largest are rounding noise
    (`epsilon` is that of the numbers the matrix was summed from) and span the null space. The covariance is `variance` times the
    pseudo-inverse; any value with weight in the null space gets an infinite error. Priors play no part.
    """
    matrix = np.asarray(matrix, np.float64)
    diagonal = np.diag(matrix)
    unseen = diagonal <= epsilon**2 * max(diagonal.max(initial=0.0), np.finfo(np.float64).tiny)
    scale = np.where(unseen, 0.0, 1 / np.sqrt(np.where(unseen, 1.0, diagonal)))
    eigenvalues, vectors = np.linalg.eigh(scale[:, None] * matrix * scale)
    counts = eigenvalues > len(diagonal) * epsilon * max(eigenvalues.max(initial=0.0), 0.0)
    rank = int(counts.sum())
    variance = float(squares) / max(measurements - rank, 1)
    spread = np.square(vectors[:, counts]) @ (1 / eigenvalues[counts])
    null_share = np.square(vectors[:, ~counts]).sum(axis=1)
    errors = np.where(unseen | (null_share > NULL_SHARE), np.inf, np.sqrt(variance * spread) * scale)
    condition = float(eigenvalues[-1] / eigenvalues[counts][0]) if rank else np.inf
    return Determination(errors, variance, rank, vectors[:, 0], condition)
