"""Volumes from formulas, in place of scans: the same on every machine, at any size."""

import numpy as np


def gyroid(n: int) -> np.ndarray:
    """`sin cos + sin cos + sin cos`, values about -1.5 ... 1.5, float32."""
    x, y, z = np.meshgrid(*[np.linspace(-6, 6, n, dtype=np.float32)] * 3, indexing="ij", sparse=True)
    return np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)


def phantom(n: int) -> tuple[np.ndarray, float]:
    """A body in Hounsfield units, int16, and its spacing in millimetres: air, skin and fat, muscle, a spine, ribs and two lungs."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n, dtype=np.float32)] * 3, indexing="ij", sparse=True)
    soft = lambda inside, width=0.02: 0.5 * (1 + np.tanh(inside / width))
    body = 0.85 - np.sqrt((x / 1.0) ** 2 + (y / 0.75) ** 2 + 0.2 * z**2)
    values = -1000 + 900 * soft(body) + 150 * soft(body - 0.08)
    for side in (-1, 1):
        lung = 0.38 - np.sqrt((x - side * 0.38) ** 2 + (y / 1.1) ** 2 + (z / 1.8) ** 2)
        values = values - 800 * soft(lung)
    spine = 0.14 + 0.02 * np.cos(30 * z) - np.sqrt(x**2 + (y - 0.35) ** 2)
    # Ribs are a wall around the lungs, cut into rings that fall towards the front.
    wall = 0.03 - np.abs(np.sqrt((x / 0.95) ** 2 + (y / 0.7) ** 2 + 0.15 * z**2) - 0.72)
    ribs = np.minimum(wall, 0.05 * np.cos(22 * (z + 0.25 * y)))
    values = values + 900 * np.maximum(soft(spine), soft(ribs))
    return np.round(values).astype(np.int16), 360 / (n - 1)


def vessels(n: int) -> tuple[np.ndarray, float]:
    """A tree of winding tubes, uint8, and its spacing: brightest on the axis of a tube, 5 % of the voxels not empty (> 64)."""
    u = np.linspace(-1, 1, n, dtype=np.float32)
    x, y, z = np.meshgrid(u, u, u, indexing="ij", sparse=True)
    values = np.zeros((n, n, n), np.float32)
    for i in range(9):
        a = 2 * np.pi * i / 9
        # Each tube runs along z and winds around a line that leaves the trunk at the bottom.
        spread = 0.15 + 0.5 * (0.5 + 0.5 * z) * (0.6 + 0.4 * (i % 3) / 2)
        cx = spread * np.cos(a) + 0.12 * np.sin(5 * z + 2 * a)
        cy = spread * np.sin(a) + 0.12 * np.cos(4 * z + 3 * a)
        distance = np.square(x - cx) + np.square(y - cy)
        np.maximum(values, np.exp(-distance / (2 * (0.033 + 0.018 * (i % 3)) ** 2)), out=values)
    return np.round(255 * values).astype(np.uint8), 100 / (n - 1)
