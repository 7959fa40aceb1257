"""The first hit of an isosurface over its sampling rates: one, two (course notes on GPU-based volume ray-casting, Eurographics 2009,
section 2.4.1 and figure 2.14) and steps that bounds on the gradient guarantee, against dense sampling in double precision.

`python experiments/first_hit_rates.py [--json FILE] [--figure FILE] [--quick]`: on the embedded volume, for the rays of one camera: which
miss the surface that they meet first, how far off the hits of all others are (in voxels), and how many samples that took.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import map_coordinates

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from jvr.io.demo import demo_volume
from jvr.march.first_hit import next_hit, start
from jvr.march.steps import Rays
from jvr.rendering.medium import bricks
from jvr.rendering.trace import camera_rays

ISOVALUE = 0.45
# Voxels between two samples far from the surface, and close to it: rates of 0.25 to 1, and of 1 to 8.
COARSE, FINE = (4.0, 2.0, 1.0), (1.0, 0.5, 0.25, 0.125)
# How close "close" is, in the largest change of the scalar on a coarse step: with 1 nothing more is missed.
BANDS = (1 / 16, 1 / 4, 1.0)
# Samples of the truth to a voxel.
DENSE = 64
# A hit that is further off is another surface.
ANOTHER = 0.1
# The notes' figure: rates 0.5 and 4.
NOTES = "two rates, every 2 and 0.25 voxels, band 0.25"
SHOWN = ("one rate, every 2 voxels", NOTES, "guaranteed, every 1 voxels")


class Subject(NamedTuple):
    """Rays through a volume, the first hit of each in double precision (infinite where there is none), and its surface in grey."""

    volume: jvr.Volume
    rays: Rays
    truth: np.ndarray
    grey: np.ndarray

    @property
    def voxel(self) -> float:
        return float(np.min(self.volume.spacing))


def subject(size: int) -> Subject:
    volume = demo_volume()
    camera = jvr.PerspectiveCamera.look_at([50, -110, 40], [0, 0, 0], (0, 0, 1), 24.0, size, size)
    scene = jvr.Scene(volume, jvr.LinearTransfer([0, 1], np.ones((2, 3)), [0, 0]))
    rays, _ = camera_rays(scene, camera, jnp.arange(size**2, dtype=jnp.int32))
    truth = first_crossings(volume, rays)
    return Subject(volume, rays, truth, shaded(volume, rays, truth).reshape(size, size))


def along(field: np.ndarray, rays: Rays, u: np.ndarray) -> np.ndarray:
    """The field, interpolated by SciPy at distances `(..., rays)` from where rays enter."""
    entry, direction = (np.stack([np.asarray(c, float) for c in part]) for part in (rays.entry, rays.direction))
    spread = (slice(None), *(None,) * (u.ndim - 1))
    return map_coordinates(field, entry[spread] + u * direction[spread], order=1, mode="nearest")


def first_crossings(volume: jvr.Volume, rays: Rays) -> np.ndarray:
    """Distances by sampling `DENSE` times in each voxel and bisection."""
    values, found = np.asarray(volume.values, float), []
    du = float(np.min(volume.spacing)) / DENSE
    for i in range(0, len(rays.length), 256):
        some = jax.tree.map(lambda x, i=i: x[i : i + 256], rays)
        length = np.asarray(some.length, float)
        u = np.minimum(np.arange(np.ceil(length.max() / du) + 1)[:, None] * du, length)
        above = along(values, some, u) >= ISOVALUE
        crosses = above[1:] != above[:-1]
        k, ray = np.argmax(crosses, axis=0), np.arange(len(length))
        low, high, side = u[k, ray], u[np.minimum(k + 1, len(u) - 1), ray], above[k, ray]
        for _ in range(40):
            middle = (low + high) / 2
            same = (along(values, some, middle) >= ISOVALUE) == side
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        found.append(np.where(crosses.any(axis=0), high, np.inf))
    return np.concatenate(found)


def shaded(volume: jvr.Volume, rays: Rays, u: np.ndarray) -> np.ndarray:
    """The cosine between the surface and the ray that hits it, 0 where none does."""
    at = np.where(np.isfinite(u), u, 0.0)
    gradients = np.gradient(np.asarray(volume.values, float), *np.asarray(volume.spacing, float))
    normal = np.stack([along(component, rays, at) for component in gradients])
    way = np.stack([np.asarray(c, float) for c in rays.direction]) * np.asarray(volume.spacing, float)[:, None]
    cosine = np.abs(np.sum(normal * way, axis=0)) / np.maximum(np.linalg.norm(normal, axis=0), 1e-9)
    return np.where(np.isfinite(u), cosine, 0.0)


def steepest(volume: jvr.Volume) -> float:
    """The largest change of the interpolated scalar in a voxel's length."""
    steps = zip(range(3), np.asarray(volume.spacing), strict=True)
    slopes = [np.abs(np.diff(np.asarray(volume.values, float), axis=axis)).max() / length for axis, length in steps]
    return float(np.linalg.norm(slopes) * np.min(volume.spacing))


def choices(largest: float, quick: bool) -> dict[str, dict[str, Any]]:
    """Arguments of `jvr.Isosurfaces` by name."""
    coarse, fine = (COARSE[1:2], FINE[2:3]) if quick else (COARSE, FINE)
    found: dict[str, dict[str, Any]] = {f"one rate, every {step:g} voxels": {"step": step} for step in (*coarse, *fine[1:])}
    if quick:
        found |= {f"one rate, every {step:g} voxels": {"step": step} for step in fine}
    for far in coarse:
        for near in fine:
            for share in BANDS if near < far else ():
                name = f"two rates, every {far:g} and {near:g} voxels, band {share:g}"
                found[name] = {"step": near, "coarse": round(far / near), "band": share * far * largest}
    return found | {f"guaranteed, every {step:g} voxels": {"step": step, "guaranteed": True} for step in COARSE[-1:]}


@jax.jit
def first(search: Any, rays: Rays) -> Any:
    return next_hit(search, rays, start(search, rays))


def measured(of: Subject, quick: bool) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """A row for each choice, and which rays it shows something else to."""
    clear = jvr.LinearTransfer([0, 1], np.ones((2, 3)), [0, 0])
    rows, wrong = [], {}
    for name, arguments in choices(steepest(of.volume), quick).items():
        surfaces = jvr.Isosurfaces([ISOVALUE], np.ones((1, 3)), **arguments)
        hits = first(surfaces.prepare(jvr.Scene(of.volume, clear, surfaces=surfaces), bricks(of.volume)), of.rays)
        met, there = np.asarray(hits.found), np.isfinite(of.truth)
        off = np.abs(np.asarray(hits.u, float) - np.where(there, of.truth, 0.0)) / of.voxel
        right = met & there & (off < ANOTHER)
        wrong[name] = (there | met) & ~right
        row = {
            "choice": name,
            **arguments,
            "samples": float(np.mean(hits.steps)),
            "missed": float(wrong[name].sum() / there.sum()),
        }
        row |= {"error_rms": float(np.sqrt(np.mean(off[right] ** 2))), "error_largest": float(off[right].max())}
        rows.append(row)
        print(
            f"{name:<50} {row['samples']:>7.1f} samples a ray   missed {row['missed']:>7.3%}   "
            f"RMS {row['error_rms']:.1e}, largest {row['error_largest']:.1e} voxel",
            flush=True,
        )
    return rows, wrong


def figure(of: Subject, rows: list[dict[str, Any]], wrong: dict[str, np.ndarray], path: str) -> None:
    """Misses over samples, and where they are in the picture."""
    from matplotlib.figure import Figure

    shown = [name for name in SHOWN if name in wrong]
    drawing = Figure(figsize=(4.6 + 3.0 * len(shown), 3.6), layout="constrained")
    left, *panels = drawing.subplots(1, 1 + len(shown), gridspec_kw={"width_ratios": [1.5, *[1.0] * len(shown)]})
    kinds = ("one rate", *(f"two rates, band {share:g}" for share in BANDS), "guaranteed")
    for kind, marker in zip(kinds, "os^vD", strict=True):
        beginning, *end = kind.split(", ")
        some = [row for row in rows if row["choice"].startswith(beginning) and row["choice"].endswith(tuple(end) or "voxels")]
        # What misses nothing is drawn at the bottom.
        left.plot([r["samples"] for r in some], [max(r["missed"], 1e-4) for r in some], marker, markersize=5, label=kind)
    left.set(yscale="log", xlabel="samples a ray", ylabel="first hits that are missed (1e-4: none)")
    left.legend(frameon=False, fontsize=8)
    for panel, name in zip(panels, shown, strict=True):
        rgb = np.repeat(0.15 + 0.6 * of.grey[..., None], 3, axis=-1)
        rgb[wrong[name].reshape(of.grey.shape)] = [1.0, 0.1, 0.1]
        panel.imshow(rgb)
        panel.set_title(f"{name}: {int(wrong[name].sum())} missed", fontsize=7)
        panel.set(xticks=[], yticks=[])
    drawing.savefig(path, dpi=100)


def main() -> None:
    """Measures, prints a line for each choice, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of misses over samples, and of where they are")
    parser.add_argument("--quick", action="store_true", help="a small picture, few choices")
    arguments = parser.parse_args()
    of = subject(32 if arguments.quick else 128)
    rows, wrong = measured(of, arguments.quick)
    if arguments.json:
        report = {"isovalue": ISOVALUE, "rays": len(of.truth), "hits": int(np.isfinite(of.truth).sum()), "rows": rows}
        Path(arguments.json).write_text(json.dumps(report, indent=2) + "\n")
    if arguments.figure:
        figure(of, rows, wrong, arguments.figure)


if __name__ == "__main__":
    main()
