"""Functions of a scalar as VTK keeps them: values at nodes, and how the curve goes from one to the next.

A node has a midpoint `m` and a sharpness `h` besides its value. With `t` the fraction of the way to the next node, half of the way is
done at the midpoint: `t / (2 m)` in front of it, `1 - (1 - t) / (2 (1 - m))` behind. A sharpness below 0.01 leaves that as it is, one
above 0.99 makes a jump at the midpoint; in between the way is bent by the power `1 + 10 h` on both sides of its half, and goes by Hermite's
cubic with slopes `1 - h`. Colours go through a space of colours. That is what `vtkPiecewiseFunction` and `vtkColorTransferFunction` of
VTK 9 compute.
"""

import dataclasses

import numpy as np

from jvr.io.interop.colours import HUE, diverging, from_space, to_space

PLAIN, JUMP = 0.01, 0.99
# Midpoints stay so far away from the ends.
LEAST = 1e-5


@dataclasses.dataclass(frozen=True)
class Curve:
    """A function of the scalar, opacity `(n, 1)` or colour `(n, 3)`.

    - `x`, `values`: of its nodes, in order of `x`, colours as they are shown; `midpoint`, `sharpness`: of the way to the next.
    - `space`: of colours, "RGB", "HSV", "Lab", "ProLab", "Diverging" or "Step", where each interval has the colour of its end; `wrap`:
      whether hues go the shorter way round; `logarithmic`: whether the way is measured in the logarithm of `x`.
    - `below`, `above`: values outside of the nodes, `None` for those of the first and the last.
    """

    x: np.ndarray
    values: np.ndarray
    midpoint: np.ndarray
    sharpness: np.ndarray
    space: str = "RGB"
    wrap: bool = True
    logarithmic: bool = False
    below: np.ndarray | None = None
    above: np.ndarray | None = None

    def __post_init__(self) -> None:
        nodes = np.column_stack([self.x, self.values, self.midpoint, self.sharpness])
        if not len(nodes) or not np.all(np.isfinite(nodes)):
            raise ValueError("a function of the scalar needs at least one point, and finite numbers")
        if np.any((nodes[:, -2:] < 0) | (nodes[:, -2:] > 1)):
            raise ValueError("midpoint and sharpness must be between 0 and 1")

    @classmethod
    def of(cls, rows: np.ndarray, *, shaped: bool = True, **keywords: object) -> "Curve":
        """A curve of rows `x, values, midpoint, sharpness`, in any order; without the last two where it is not `shaped`."""
        rows = np.asarray(rows, np.float64)
        rows = rows if shaped else np.column_stack([rows, np.full(len(rows), 0.5), np.zeros(len(rows))])
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        return cls(rows[:, 0], rows[:, 1:-2], rows[:, -2], rows[:, -1], **keywords)  # pyright: ignore[reportArgumentType]

    def rows(self) -> np.ndarray:
        """What `of` takes."""
        return np.column_stack([self.x, self.values, self.midpoint, self.sharpness])

    @property
    def is_plain(self) -> bool:
        """Whether it is linear between its nodes, in numbers as they are, and constant outside."""
        inside = slice(0, len(self.x) - 1)
        straight = np.all(self.sharpness[inside] < PLAIN) and np.all(self.midpoint[inside] == 0.5) and not self.logarithmic
        return bool(straight and self.space == "RGB" and self.below is None and self.above is None)

    def points(self, width: float) -> np.ndarray:
        """Where it bends, nodes and midpoints, and beside each jump a point at its other end, `width` away."""
        low, high = self._scaled(self.x[:-1]), self._scaled(self.x[1:])
        middle = low + np.clip(self.midpoint[:-1], LEAST, 1 - LEAST) * (high - low)
        middle = 10**middle if self._is_scaled else middle
        bends = (self.midpoint[:-1] != 0.5) | (self.sharpness[:-1] >= PLAIN)
        jumps = middle[self._jumping[:-1]]
        behind = [self.x[:-1][(np.diff(self.x) <= 0) | (self.space == "Step")], self.x[-1:] if self.above is not None else []]
        before = self.x[:1] if self.below is not None else []
        beside = [jumps - width, jumps + width, np.concatenate(behind) + width, np.subtract(before, width)]
        return np.concatenate([self.x, middle[bends], *beside])

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Values `(k, channels)` at `(k,)` scalars."""
        x, last = np.asarray(x, np.float64), len(self.x) - 1
        i = np.clip(np.searchsorted(self.x, x, side="left"), 1, max(last, 1)) - 1
        j = np.minimum(i + 1, last)
        low, high = self._scaled(self.x[i]), self._scaled(self.x[j])
        inside = np.clip(x, self.x[0], self.x[-1])
        width = high - low
        t = np.clip(np.divide(self._scaled(inside) - low, width, out=np.ones_like(x), where=width > 0), 0, 1)
        # Nodes and what lies outside are as they are said, not through a space of colours and back.
        found = np.where((x <= self.x[0])[:, None], self.values[0], self._between(t, i, j))
        found = np.where((x > self.x[-1])[:, None], self.values[-1], found)
        for end, outside in ((self.below, x < self.x[0]), (self.above, x > self.x[-1])):
            found = found if end is None else np.where(outside[:, None], end, found)
        return found

    @property
    def _jumping(self) -> np.ndarray:
        # Functions of opacity have no such jump in VTK 9.7: they are bent as they are below.
        return (self.sharpness > JUMP) & (self.values.shape[1] > 1)

    @property
    def _is_scaled(self) -> bool:
        return self.logarithmic and bool(self.x[0] > 0)

    def _scaled(self, x: np.ndarray) -> np.ndarray:
        return np.log10(x) if self._is_scaled else x

    def _between(self, t: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        a, b, sharpness = self.values[i], self.values[j], self.sharpness[i]
        middle = np.clip(self.midpoint[i], LEAST, 1 - LEAST)
        halved = np.where(t < middle, 0.5 * t / middle, 0.5 + 0.5 * (t - middle) / (1 - middle))
        jumping = self._jumping[i][:, None]
        jumped = np.where((halved < 0.5)[:, None], a, b)
        if self.space == "Step":
            return np.where(jumping, jumped, np.where((t > 0)[:, None], b, a))
        bent = _bent(halved, sharpness)
        if self.space == "Diverging":
            way = np.where(sharpness < PLAIN, halved, bent)
            return np.where(jumping, jumped, diverging(a, b, way))
        way = np.where(sharpness < PLAIN, halved, _hermite(bent, sharpness))[:, None]
        return np.where(jumping, jumped, self._mixed(a, b, way))

    def _mixed(self, a: np.ndarray, b: np.ndarray, way: np.ndarray) -> np.ndarray:
        if self.space == "RGB":
            return (1 - way) * a + way * b
        a, b = to_space(self.space, a), to_space(self.space, b)
        if self.space == HUE and self.wrap:
            # The larger hue, where they are more than half of the circle apart.
            apart = a[:, 0] - b[:, 0]
            a, b = a - np.outer(apart > 0.5, [1, 0, 0]), b - np.outer(apart < -0.5, [1, 0, 0])
        return from_space(self.space, (1 - way) * a + way * b)


def _bent(s: np.ndarray, sharpness: np.ndarray) -> np.ndarray:
    power = 1 + 10 * sharpness
    return np.where(s < 0.5, 0.5 * (2 * s) ** power, 1 - 0.5 * np.abs(2 - 2 * s) ** power)


def _hermite(s: np.ndarray, sharpness: np.ndarray) -> np.ndarray:
    """Both ends have the slope `1 - sharpness`."""
    return s * s * (3 - 2 * s) + (1 - sharpness) * s * (1 - s) * (1 - 2 * s)
