"""Transfer function presets: a ramp by window and level, presets for CT in Hounsfield units, for scans whose values have no unit,
and for labels.

Extinctions are per millimetre, the unit of the world in every medical format.
"""

import colorsys

import numpy as np

from jvr.model.transfer import LinearTransfer, LutTransfer
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


def ct() -> LinearTransfer:
    """Bone in ivory, muscle and organs in translucent red, a veil of skin and fat; HU, per millimetre."""
    return _points(
        [
            (-200, 0.80, 0.50, 0.40, 0.0),
            (-120, 0.85, 0.60, 0.45, 0.003),
            (-40, 0.85, 0.55, 0.40, 0.003),
            (10, 0.60, 0.12, 0.09, 0.006),
            (60, 0.62, 0.13, 0.10, 0.03),
            (130, 0.75, 0.25, 0.18, 0.05),
            (190, 0.95, 0.82, 0.65, 0.18),
            (350, 0.98, 0.93, 0.82, 0.6),
            (1500, 1.0, 1.0, 0.97, 1.2),
        ]
    )


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


WARM = [[0.35, 0.10, 0.06], [0.70, 0.30, 0.18], [0.90, 0.60, 0.38], [0.97, 0.85, 0.65], [1.0, 1.0, 0.95]]
IVORY = [[0.45, 0.40, 0.35], [0.80, 0.75, 0.66], [0.95, 0.92, 0.85], [1.0, 0.99, 0.95]]


def scan(low: float | int, high: float | int, *, sigma_t: float | int) -> LinearTransfer:
    """Layers from a red veil to solid white, for values without a unit.

    **Arguments:** `low`, `high`: where there begins to be something to see, and the brightest, in the data's units, here and below;
    `sigma_t`: extinction at `high`, per world length.
    """
    return _layers(low, high, [0.0, 0.25, 0.5, 0.75, 1.0], WARM, np.array([0.0, 0.08, 0.25, 0.6, 1.0]) * sigma_t)


def mr(low: float | int, high: float | int, *, sigma_t: float | int) -> LinearTransfer:
    """Tissue that is solid from its surface on, as MR shows it."""
    return _layers(low, high, [0.0, 0.15, 0.4, 0.7, 1.0], WARM, np.array([0.0, 0.15, 0.6, 1.0, 1.0]) * sigma_t)


def micro_ct(low: float | int, high: float | int, *, sigma_t: float | int) -> LinearTransfer:
    """One solid material in ivory, such as bone, rock or foam, in nothing that is to be seen."""
    return _layers(low, high, [0.1, 0.3, 0.6, 1.0], IVORY, np.array([0.0, 0.7, 1.0, 1.0]) * sigma_t)


def labels(count: int, *, sigma_t: float | int) -> LutTransfer:
    """A colour for each of the labels 1 ... `count`, label 0 transparent; neighbours differ in hue by the golden ratio."""
    if not count >= 1:
        raise ValueError(f"there must be at least one label, not {count}")
    hues = [colorsys.hsv_to_rgb(i * 0.618034 % 1, 0.55 + 0.125 * (7 * i % 3), 0.95) for i in range(count + 1)]
    extinction = np.full(count + 1, float(sigma_t))
    extinction[0] = 0.0
    return LutTransfer(np.square(hues), extinction, [0, count])


def _layers(
    low: float | int, high: float | int, positions: list[float], rgb: list[list[float]], sigma_t: np.ndarray
) -> LinearTransfer:
    if not low < high:
        raise ValueError(f"a preset needs low < high, not {low:g} and {high:g}")
    return LinearTransfer(low + (high - low) * np.asarray(positions), rgb, sigma_t)


def _points(rows: list[tuple[float | int, ...]]) -> LinearTransfer:
    table = np.asarray(rows, dtype=float)
    return LinearTransfer(table[:, 0], table[:, 1:4], table[:, 4])
