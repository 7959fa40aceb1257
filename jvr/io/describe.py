"""What a volume holds, for a person at a terminal and, as JSON, for a program: `jvr info` prints it."""

import itertools
import os
from typing import Any

import numpy as np

from jvr.model.volume import Volume

BINS = 32
PERCENTILES = (1, 5, 25, 50, 75, 95, 99)
# Percentiles need a sort: of so many voxels at most, evenly spread over the volume.
MOST_SORTED = 1 << 24
BARS = " ▁▂▃▄▅▆▇█"
WORDS = {"L": "left", "R": "right", "P": "posterior", "A": "anterior", "S": "superior", "I": "inferior"}


def describe(volume: Volume, path: str | os.PathLike | None = None) -> dict[str, Any]:
    """Shape, type, place in the world and distribution of values of a volume, as plain numbers, strings and lists.

    Lengths are millimetres; values are in data units (slope and intercept applied) and of voxels that hold data only, the
    others are counted in `missing`, and `missing_value` is the number in the file
    that means so, `None` where that is NaN. `orientation` names where the axes i, j, k of the grid point, in LPS: "LPS" is the
    identity, "RAS" points to the right, anterior and superior; `oblique_degrees` is the largest angle between an axis of the
    grid and the axis of the world that names it. `histogram` has 32 equal bins between the smallest and the largest value
    (`counts`) and their 33 `edges`. Percentiles of more than 2^24 voxels are those of an even subset. `mean`, `minimum`,
    `maximum` are `None` and the lists empty where no voxel is finite.

    **Arguments:** `volume`, on concrete arrays; `path`, only repeated in the result.
    """
    values = np.asarray(volume.values)
    affine = np.asarray(volume.world_from_grid, float)
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    code, degrees = orientation(affine)
    return {
        "file": None if path is None else os.fspath(path),
        "shape": list(values.shape),
        "dtype": str(values.dtype),
        "bytes": int(values.nbytes),
        "spacing": _rounded(spacing),
        "origin": _rounded(affine[:3, 3]),
        "extent": _rounded(spacing * [n - 1 if n > 1 else 1 for n in values.shape]),
        "orientation": code,
        "oblique": degrees > 0.1,
        "oblique_degrees": round(degrees, 2),
        "slope": float(volume.slope),
        "intercept": float(volume.intercept),
        "unit": volume.unit,
        "missing": int(values.size - _data(volume).size),
        "missing_value": _missing_value(volume),
        **_distribution(_data(volume), float(volume.slope), float(volume.intercept)),
    }


def orientation(world_from_grid: np.ndarray) -> tuple[str, float]:
    """Letters for where the axes of the grid point in an LPS world, and the largest angle between the two in degrees."""
    directions = world_from_grid[:3, :3] / np.linalg.norm(world_from_grid[:3, :3], axis=0)
    # Each axis of the world names one axis of the grid, also where a grid lies at 45 degrees.
    axes = max(itertools.permutations(range(3)), key=lambda order: sum(abs(directions[order[i], i]) for i in range(3)))
    along = [directions[axes[i], i] for i in range(3)]
    letters = "".join(("LR", "PA", "SI")[axis][int(d < 0)] for axis, d in zip(axes, along, strict=True))
    return letters, float(np.degrees(np.arccos(np.clip(np.abs(along).min(), 0, 1))))


def _missing_value(volume: Volume) -> float | None:
    """The number of missing voxels, in data units."""
    return None if volume.missing is None else float(f"{float(volume.slope) * volume.missing + float(volume.intercept):.7g}")


def _rounded(numbers: np.ndarray) -> list[float]:
    """float32 numbers as a person wrote them: 0.8125, 2.4, not 2.4000000953674316."""
    return [float(f"{x:.7g}") for x in numbers]


def _data(volume: Volume) -> np.ndarray:
    """Voxels that hold data, as they are stored."""
    values = volume.data()
    return values if values.dtype.kind in "iu" or np.isfinite(values).all() else values[np.isfinite(values)]


def _distribution(finite: np.ndarray, slope: float, intercept: float) -> dict[str, Any]:
    if finite.size == 0:
        empty = {"counts": [], "edges": []}
        nothing = {"minimum": None, "maximum": None, "mean": None}
        return {**nothing, "percentiles": {}, "histogram": empty}
    low, high = float(finite.min()), float(finite.max())
    subset = finite[:: -(-finite.size // MOST_SORTED)]
    quantiles = np.percentile(subset, PERCENTILES if slope > 0 else [100 - p for p in PERCENTILES]).astype(float)
    counts, edges = _histogram(finite, low, high)
    ends = sorted((slope * low + intercept, slope * high + intercept))
    return {
        "minimum": ends[0],
        "maximum": ends[1],
        "mean": slope * float(finite.mean(dtype=np.float64)) + intercept,
        "percentiles": {str(p): slope * float(q) + intercept for p, q in zip(PERCENTILES, quantiles, strict=True)},
        "histogram": {
            "counts": [int(n) for n in (counts if slope > 0 else counts[::-1])],
            "edges": sorted(slope * float(edge) + intercept for edge in edges),
        },
    }


def _histogram(values: np.ndarray, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Counts in equal bins and their edges, in chunks and in float64: float32 bins of a narrow range would coincide."""
    if low == high:
        half = max(0.5, 1e-6 * abs(low))
        low, high = low - half, high + half
    counts = np.zeros(BINS, np.int64)
    for chunk in np.array_split(values, -(-values.size // (1 << 20))):
        index = ((chunk.astype(np.float64) - low) * (BINS / (high - low))).astype(np.int64)
        counts += np.bincount(np.clip(index, 0, BINS - 1), minlength=BINS)
    return counts, np.linspace(low, high, BINS + 1)


def format_description(description: dict[str, Any]) -> str:
    """The result of `describe` as aligned lines for a terminal, with bars of the logarithm of the histogram's counts."""
    d = description
    triple = lambda name, between: between.join(f"{x:g}" for x in d[name])
    towards = ", ".join(WORDS[letter] for letter in d["orientation"])
    tilted = f", oblique by {d['oblique_degrees']:g} degrees" if d["oblique"] else ""
    rows = [
        *([("file", d["file"])] if d["file"] else []),
        ("voxels", f"{triple('shape', ' x ')}, {d['dtype']}, {_size(d['bytes'])}"),
        ("spacing", f"{triple('spacing', ' x ')} mm"),
        ("extent", f"{triple('extent', ' x ')} mm"),
        ("origin", f"{triple('origin', ', ')} mm"),
        ("orientation", f"{d['orientation']} (i, j, k to {towards}){tilted}"),
        *([("rescaling", f"{d['slope']:g} * voxel + {d['intercept']:g}")] if (d["slope"], d["intercept"]) != (1, 0) else []),
        *([("missing", _missing(d))] if d["missing"] else []),
    ]
    if d["mean"] is not None:
        rows.append(("values", f"{d['minimum']:g} ... {d['maximum']:g} {d['unit']}".rstrip() + f", mean {d['mean']:g}"))
        rows.append(("percentiles", "   ".join(f"{p} %: {value:g}" for p, value in d["percentiles"].items())))
    lines = [f"{name:<13}{text}" for name, text in rows]
    return "\n".join(lines + _chart(d["histogram"]))


def _missing(d: dict[str, Any]) -> str:
    value = "NaN" if d["missing_value"] is None else f"{d['missing_value']:g}"
    return f"{d['missing']:,} voxels ({100 * d['missing'] / np.prod(d['shape']):.3g} %), which are {value}"


def _size(count: int) -> str:
    for unit, bytes_each in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= bytes_each:
            return f"{count / bytes_each:.3g} {unit}"
    return f"{count} bytes"


def _chart(histogram: dict[str, list], rows: int = 4) -> list[str]:
    """Bars of log(1 + count), `rows` lines high, and the ends of the axis below."""
    if not histogram["counts"]:
        return []
    heights = np.log1p(histogram["counts"])
    # A bin of a single voxel must not look empty.
    eighths = np.where(heights > 0, np.maximum(np.round(heights / heights.max() * rows * 8), 1), 0).astype(int)
    lines = []
    for row in reversed(range(rows)):
        name = "histogram" if row == rows - 1 else "(log counts)" if row == rows - 2 else ""
        lines.append(f"{name:<13}" + "".join(BARS[int(np.clip(e - 8 * row, 0, 8))] for e in eighths).rstrip())
    first, last = f"{histogram['edges'][0]:g}", f"{histogram['edges'][-1]:g}"
    return [*lines, " " * 13 + first + last.rjust(max(BINS - len(first), len(last) + 1))]
