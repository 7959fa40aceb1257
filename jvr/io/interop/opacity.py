"""Opacity per unit distance, as VTK and the programs built on it say it, and extinction, as jvr does.

VTK corrects an opacity for the distance `d` between two samples, `a' = 1 - (1 - a)^(d / unit)` (`SetScalarOpacityUnitDistance`): that is
Beer's law with the extinction `sigma_t = -log(1 - a) / unit`.
"""

import numpy as np
from jaxtyping import Float

from jvr.types import ArrayLike

# Of an opacity of 1, whose extinction is infinite: a unit distance lets 1 / 65536 of the light through.
MOST_OPAQUE = 1 - 2.0**-16


def extinction_from_opacity(opacity: ArrayLike, unit_distance: float | int = 1.0) -> Float[np.ndarray, "..."]:
    """`-log(1 - opacity) / unit_distance`, the extinction per world length, of opacities between 0 and 1, any shape.

    Those above `1 - 2^-16` count as that: an opacity of 1 hides everything within no distance at all, which no extinction does.
    **Raises** `ValueError` for other opacities, and where `unit_distance` is not positive.
    """
    alpha = np.asarray(opacity, np.float64)
    if not np.all((alpha >= 0) & (alpha <= 1)):
        raise ValueError("opacity must be between 0 and 1")
    return np.asarray(-np.log1p(-np.minimum(alpha, MOST_OPAQUE)) / _positive(unit_distance))


def opacity_from_extinction(sigma_t: ArrayLike, unit_distance: float | int = 1.0) -> Float[np.ndarray, "..."]:
    """`1 - exp(-sigma_t unit_distance)`, the opacity of a unit distance, of any shape.

    **Raises** `ValueError` for a negative extinction, and where `unit_distance` is not positive.
    """
    sigma = np.asarray(sigma_t, np.float64)
    if not np.all(sigma >= 0):
        raise ValueError("extinction must not be negative")
    return np.asarray(-np.expm1(-sigma * _positive(unit_distance)))


def _positive(distance: float | int) -> float:
    if not 0 < distance < np.inf:
        raise ValueError(f"unit_distance must be positive and finite (world length), not {distance:g}")
    return float(distance)
