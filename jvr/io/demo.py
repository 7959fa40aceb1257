"""A volume made by a formula, for a first picture without any data: shells around a gyroid around a torus, values 0 ... 1."""

import numpy as np

from jvr.model.volume import Volume

SHAPE = (60, 60, 50)
SPACING = (1.0, 1.0, 1.2)


def demo_volume() -> Volume:
    """A ball of about 0.3 that holds a gyroid of about 0.6, which holds a torus of about 0.95; centred on the origin."""
    extent = [(n - 1) * d / 2 for n, d in zip(SHAPE, SPACING, strict=True)]
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n) for n in SHAPE], indexing="ij")
    r = np.sqrt(x**2 + y**2 + z**2)
    wave = 6.0
    gyroid = np.sin(wave * x) * np.cos(wave * y) + np.sin(wave * y) * np.cos(wave * z) + np.sin(wave * z) * np.cos(wave * x)
    torus = np.sqrt((np.sqrt(x**2 + (0.8 * y + 0.6 * z) ** 2) - 0.42) ** 2 + (0.8 * z - 0.6 * y) ** 2)
    ball = _inside(0.92 - r, 0.08)
    lattice = ball * _inside(0.74 - r, 0.08) * _inside(gyroid - 0.55, 0.25)
    values = 0.3 * ball + 0.3 * lattice + (0.95 - 0.3 * ball - 0.3 * lattice) * _inside(0.15 - torus, 0.06)
    affine = np.diag([*SPACING, 1.0])
    affine[:3, 3] = [-e for e in extent]
    return Volume(values.astype(np.float32), affine)


def _inside(distance: np.ndarray, width: float) -> np.ndarray:
    """1 well inside, 0 well outside, smooth over `width` on both sides of the surface."""
    return 0.5 * (1 + np.tanh(distance / width))
