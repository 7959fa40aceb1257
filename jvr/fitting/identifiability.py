"""Identifiability: how well the images determine the unknowns, from the Gauss-Newton matrix."""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

# Relative rounding of a column of the Jacobian, in units of its number format's epsilon. Positions in a grid of some hundred voxels
# are rounded to as many units, and the weights of interpolation inherit that. (Against float64 the demo's columns are off by up to 140.)
ROUNDING = 256
# Above this fraction of its square in the null space a value is not determined.
NULL_FRACTION = 1e-4
TINY = 1e-30
# Residuals are structured where their sums over blocks vary by so many standard deviations more than those of independent ones ...
SIGNIFICANT = 5
# ... of at least so many blocks.
FEWEST_BLOCKS = 8


class Scores(NamedTuple):
    """Sums that tell misfit from noise, over all rays that see an unknown: a residual `r`, a weight `w`, a rendered colour `c`, a row `J`.

    - `score`: `sum w J^T r` over the pixels and channels of each block, `(blocks, n)`.
    - `residual`: `sum w r` of each channel and block, `(3, blocks)`.
    - `offset`, `gain`: `sum w J^T` and `sum w J^T c` of each channel, `(3, n)`: what an error of its brightness moves.
    - `sums`: of each channel `sum w`, `sum w r^2`, `sum w c^2` and `sum (w r)^2`, `(3, 4)`.
    """

    score: Any
    residual: Any
    offset: Any
    gain: Any
    sums: Any

    @property
    def design_effect(self) -> float:
        """`sum_blocks (sum w r)^2 / sum (w r)^2`: 1 for independent residuals, up to the number of pixels of a block for a common one
        (Kish 1965)."""
        return float(np.sum(np.square(self.residual)) / max(np.sum(self.sums[:, 3]), TINY))

    @property
    def is_structured(self) -> bool:
        """Whether neighbouring residuals have more in common than independent ones would."""
        blocks = np.count_nonzero(np.any(self.residual, axis=0))
        return bool(blocks >= FEWEST_BLOCKS) and self.design_effect > 1 + SIGNIFICANT * math.sqrt(2 / blocks)

    def meat(self) -> Float[np.ndarray, "n n"]:
        """The covariance of `sum w J^T r` where residuals have something in common within blocks (Liang and Zeger 1986), and all over the
        images as much in the two ways that the unknowns may have absorbed: an offset and a gain of each channel, each as large as the
        residuals that are left."""
        blocks = np.count_nonzero(np.any(self.score, axis=1))
        found = self.score.T @ self.score * (blocks / max(blocks - 1, 1))
        for offset, gain, (weight, residuals, colours, _) in zip(self.offset, self.gain, self.sums, strict=True):
            variance = residuals / max(weight, TINY)
            found += variance * np.outer(offset, offset) + residuals / max(colours, TINY) * np.outer(gain, gain)
        return found


class Identifiability(NamedTuple):
    """How well the images determine the unknowns: standard errors and what is behind them.

    - `standard_errors`: of each unknown, in its own unit; infinite where the images do not determine it.
    - `variance`: of the residuals, `sum w r^2 / (m - rank)`.
    - `information`: the Gauss-Newton matrix over that variance, the inverse of the covariance of plain noise.
    - `rank`: number of combinations of unknowns that the images determine.
    - `least_determined`: the least-determined direction among the unknowns that are seen at all, one coefficient for each (in units of
      its own sensitivity), unit length.
    - `condition`: largest over smallest eigenvalue that counts.
    - `design_effect`: see `Scores`; `structured`: whether the errors are those of structured residuals.
    """

    standard_errors: Float[np.ndarray, "unknowns"]
    variance: float
    information: Float[np.ndarray, "unknowns unknowns"] | None
    rank: int
    least_determined: Float[np.ndarray, "unknowns"]
    condition: float
    design_effect: float
    structured: bool


def undetermined(unknowns: int) -> Identifiability:
    """What stands for the identifiability of unknowns that are too many for their Gauss-Newton matrix: nothing but NaN."""
    nothing = np.full(unknowns, np.nan)
    return Identifiability(nothing, float("nan"), None, 0, nothing, float("nan"), float("nan"), False)


def identifiability(
    matrix: Float[np.ndarray, "n n"],
    squares: float,
    measurements: int,
    epsilon: float = float(np.finfo(np.float32).eps),
    scores: Scores | None = None,
) -> Identifiability:
    """Standard errors of a weighted least-squares fit from its Gauss-Newton matrix `sum w J^T J` at the solution.

    An unknown with a zero column is seen by no ray. The others are scaled to columns of unit length and the matrix is diagonalised;
    eigenvalues at most `_noise` are rounding and span the null space. The covariance is `variance` times the pseudo-inverse; a value
    with weight in the null space gets an infinite error. Priors play no part.

    Where the residuals are structured (`Scores.is_structured`: whatever its unknowns, the model cannot explain the images), errors are
    those of the sandwich `H^+ M H^+` with the pseudo-inverse `H^+` and `M = Scores.meat()` (Huber 1967; White 1982), at least the above.

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
    inverse = (vectors[:, counts] / eigenvalues[counts]) @ vectors[:, counts].T
    spread = variance * np.diag(inverse)
    structured = False
    if scores is not None and scores.is_structured:
        structured = True
        meat = scale[:, None] * scores.meat()[np.ix_(seen, seen)] * scale
        spread = np.maximum(spread, np.einsum("ij,jk,ki->i", inverse, meat, inverse, optimize=True))
    null_fraction = np.square(vectors[:, ~counts]).sum(axis=1)
    errors, weakest = np.full(diagonal.size, np.inf), np.zeros(diagonal.size)
    errors[seen] = np.where(null_fraction > NULL_FRACTION, np.inf, np.sqrt(spread) * scale)
    weakest[seen] = vectors[:, 0] if seen.size else 0.0
    condition = float(eigenvalues[-1] / eigenvalues[counts][0]) if rank else np.inf
    effect = float("nan") if scores is None else scores.design_effect
    return Identifiability(errors, variance, matrix / max(variance, TINY), rank, weakest, condition, effect, structured)


def _noise(eigenvalues: Float[np.ndarray, "n"], epsilon: float) -> float:
    """The largest eigenvalue that rounding can make out of zero.

    `n` columns of unit length, each rounded by `e = ROUNDING * epsilon`, change the Jacobian by at most `sqrt(n) e` (its Frobenius
    norm), hence also each singular value (Weyl), and a zero eigenvalue of its square by `n e^2`. Summing and diagonalising the square
    in float64 adds `n` times that format's epsilon of the largest eigenvalue.
    """
    largest = eigenvalues.max(initial=0.0)
    return eigenvalues.size * max((ROUNDING * epsilon) ** 2, float(np.finfo(np.float64).eps) * largest)
