"""How far a result is from the reference."""

import numpy as np


def rmse(picture: np.ndarray, reference: np.ndarray) -> float:
    """Root of the mean squared difference over pixels and channels, radiance 0 ... 1."""
    return float(np.sqrt(np.mean(np.square(picture - reference))))


def relative(found: np.ndarray, reference: np.ndarray) -> float:
    """Root mean square of the difference over that of the reference."""
    return rmse(found, reference) / rmse(reference, np.zeros_like(reference))
