"""Spaces of colours in which other programs go from one colour to the next: HSV, CIE Lab, ProLab, and diverging maps.

Colours are sRGB codes, 0 ... 1. Lab has the white and the rounded matrices of VTK, whose colours are met to the last digits. ProLab is
the projective space of Konovalenko, Smagina, Nikolaev and Nikolaev (IEEE Access 2021); diverging maps are those of Moreland (Diverging
color maps for scientific visualization, 2009).
"""

import numpy as np

from jvr.pictures import linear_from_srgb

HUE = "HSV"
WHITE = np.array([0.9505, 1.0, 1.089])
XYZ_FROM_RGB = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
RGB_FROM_XYZ = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
PROLAB = np.array(
    [[75.54, 486.66, 167.39, 0], [617.72, -595.45, -22.27, 0], [48.34, 194.94, -243.28, 0], [0.7554, 3.8666, 1.6739, 1]]
)


def to_space(space: str, rgb: np.ndarray) -> np.ndarray:
    """`(n, 3)` coordinates of colours in "HSV" (0 ... 1 each), "Lab" or "ProLab"."""
    if space == HUE:
        return _hsv(rgb)
    xyz = linear_from_srgb(rgb) @ XYZ_FROM_RGB.T / WHITE
    return _lab(xyz) if space == "Lab" else _projected(PROLAB, xyz)


def from_space(space: str, coordinates: np.ndarray) -> np.ndarray:
    """The colours again; those beyond what a screen shows are scaled down to it, and not negative."""
    if space == HUE:
        return _rgb_of_hsv(coordinates)
    xyz = _xyz_of_lab(coordinates) if space == "Lab" else _projected(np.linalg.inv(PROLAB), coordinates)
    return _shown(xyz * WHITE)


def _shown(xyz: np.ndarray) -> np.ndarray:
    linear = xyz @ RGB_FROM_XYZ.T
    # Not clipped at 1 before the code is taken: what is too bright keeps its hue.
    code = np.where(linear > 0.0031308, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055, 12.92 * linear)
    return np.maximum(code / np.maximum(code.max(axis=1, keepdims=True), 1), 0)


def _lab(xyz: np.ndarray) -> np.ndarray:
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116).T
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)


def _xyz_of_lab(lab: np.ndarray) -> np.ndarray:
    y = (lab[:, 0] + 16) / 116
    f = np.stack([y + lab[:, 1] / 500, y, y - lab[:, 2] / 200], axis=1)
    return np.where(f**3 > 0.008856, f**3, (f - 16 / 116) / 7.787)


def _projected(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    homogeneous = points @ matrix[:, :3].T + matrix[:, 3]
    return homogeneous[:, :3] / homogeneous[:, 3:]


def _hsv(rgb: np.ndarray) -> np.ndarray:
    high, low = rgb.max(axis=1), rgb.min(axis=1)
    span = high - low
    r, g, b = ((high[:, None] - rgb) / np.where(span > 0, span, 1)[:, None]).T
    hue = np.where(rgb[:, 0] == high, b - g, np.where(rgb[:, 1] == high, 2 + r - b, 4 + g - r)) / 6 % 1
    saturation = np.where(high > 0, span / np.where(high > 0, high, 1), 0)
    return np.stack([np.where(span > 0, hue, 0), saturation, high], axis=1)


def _rgb_of_hsv(hsv: np.ndarray) -> np.ndarray:
    hue, saturation, value = (column[:, None] for column in hsv.T)
    # The distance from red, green and blue on the circle of hues, in sixths.
    ramp = np.abs((6 * hue + np.array([0, 4, 2])) % 6 - 3) - 1
    return value * (1 - saturation + saturation * np.clip(ramp, 0, 1))


def diverging(a: np.ndarray, b: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Colours on the way from `a` to `b` in Moreland's polar Lab, through white where both are saturated and differ in hue."""
    first, second, way = _msh(a), _msh(b), way[:, None]
    apart = np.abs(first[:, 2] - second[:, 2]) % (2 * np.pi)
    through = (first[:, 1] > 0.05) & (second[:, 1] > 0.05) & (np.minimum(apart, 2 * np.pi - apart) > 0.33 * np.pi)
    white = np.zeros_like(first)
    white[:, 0] = np.maximum(np.maximum(first[:, 0], second[:, 0]), 88)
    early, late = through[:, None] & (way < 0.5), through[:, None] & (way >= 0.5)
    first, second = np.where(late, white, first), np.where(early, white, second)
    way = np.where(early, 2 * way, np.where(late, 2 * way - 1, way))
    first, second = _with_hue(first, second), _with_hue(second, first)
    # The shorter way, and of more than half of the circle its rest, as VTK has it: counted upwards, also where that misses the second hue.
    turn = np.fmod(second[:, 2] - first[:, 2], 2 * np.pi)
    second[:, 2] = first[:, 2] + np.where(np.abs(turn) > np.pi, 2 * np.pi - np.abs(turn), turn)
    mixed = (1 - way) * first + way * second
    length, angle, hue = mixed.T
    lab = np.stack([np.cos(angle), np.sin(angle) * np.cos(hue), np.sin(angle) * np.sin(hue)], axis=1) * length[:, None]
    return from_space("Lab", lab)


def _msh(rgb: np.ndarray) -> np.ndarray:
    lab = to_space("Lab", rgb)
    length = np.linalg.norm(lab, axis=1)
    angle = np.where(length > 0.001, np.arccos(np.clip(lab[:, 0] / np.maximum(length, 0.001), -1, 1)), 0)
    return np.stack([length, angle, np.where(angle > 0.001, np.arctan2(lab[:, 2], lab[:, 1]), 0)], axis=1)


def _with_hue(grey: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Colours with a hue that suits the `other` end where they have none themselves."""
    length, angle, hue = other.T
    within = np.maximum(grey[:, 0] ** 2 - length**2, 0)
    spin = angle * np.sqrt(within) / np.maximum(length * np.sin(angle), 1e-12)
    spun = np.where(length >= grey[:, 0] - 0.1, hue, np.where(hue > -0.3 * np.pi, hue + spin, hue - spin))
    found = grey.copy()
    found[:, 2] = np.where((grey[:, 1] < 0.05) & (angle > 0.05), spun, grey[:, 2])
    return found
