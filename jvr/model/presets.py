"""First pictures of one's own scan: a ramp by window and level, and presets for CT in Hounsfield units.

Extinctions are per millimetre, the unit of the world in every medical format.
"""

import numpy as np

from jvr.model.transfer import LinearTransfer
from jvr.types import ArrayLike


def window_level(
    window: float | int, level: float | int, *, sigma_t: float | int = 0.05, rgb: ArrayLike = (1.0, 1.0, 1.0)
) -> LinearTransfer:
    """Extinction that rises from 0 to `sigma_t` across the window `level - window / 2 ... level + window / 2`.

    **Arguments:** `window`, `level`: in the data's units, `window` positive; `sigma_t`: extinction at the top, per world length;
    `rgb`: colour at the top, half as bright at the bottom. **Raises** `ValueError` where `window` is not positive.
    """
    if not window > 0:
        raise ValueError(f"window must be positive, not {window}")
    top = np.asarray(rgb, dtype=float)
    return LinearTransfer([level - window / 2, level + window / 2], [top / 2, top], [0.0, sigma_t])


def ct_bone() -> LinearTransfer:
    """Bone in ivory, everything softer transparent; HU, per millimetre."""
    return _points(
        [(150, 0.55, 0.25, 0.15, 0.0), (300, 0.85, 0.65, 0.45, 0.05), (700, 1.0, 0.93, 0.82, 0.4), (1500, 1.0, 1.0, 1.0, 0.8)]
    )


def ct_soft_tissue() -> LinearTransfer:
    """Skin, fat and muscle as translucent layers over bone; HU, per millimetre."""
    return _points(
        [
            (-200, 0.85, 0.55, 0.40, 0.0),
            (-80, 0.90, 0.65, 0.45, 0.012),
            (0, 0.80, 0.35, 0.25, 0.008),
            (60, 0.75, 0.20, 0.15, 0.03),
            (200, 0.90, 0.60, 0.45, 0.05),
            (600, 1.0, 0.95, 0.85, 0.4),
        ]
    )


def ct_lung() -> LinearTransfer:
    """The tissue of the lungs, between air and fat; HU, per millimetre."""
    return _points(
        [
            (-960, 0.15, 0.25, 0.45, 0.0),
            (-850, 0.45, 0.55, 0.80, 0.008),
            (-600, 0.85, 0.70, 0.70, 0.03),
            (-450, 0.90, 0.45, 0.40, 0.015),
            (-300, 0.90, 0.45, 0.40, 0.0),
        ]
    )


def ct_vessels() -> LinearTransfer:
    """Contrast-filled vessels in red, bone in ivory; HU, per millimetre."""
    return _points(
        [
            (120, 0.45, 0.03, 0.02, 0.0),
            (180, 0.80, 0.08, 0.05, 0.15),
            (350, 0.95, 0.30, 0.15, 0.30),
            (500, 1.0, 0.90, 0.75, 0.35),
            (1200, 1.0, 1.0, 1.0, 0.7),
        ]
    )


def _points(rows: list[tuple[float | int, ...]]) -> LinearTransfer:
    table = np.asarray(rows, dtype=float)
    return LinearTransfer(table[:, 0], table[:, 1:4], table[:, 4])
