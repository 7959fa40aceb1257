"""Hard cases: float32 against float64, in value and in gradient, and whether anything is not finite.

`python experiments/stability.py [--json FILE] [--figure FILE] [--quick] [--rows TEXT]`

Every case is rendered in both precisions from the same numbers, which float32 holds exactly: lit media with shading, single scattering
and shadows (`stability_lit.py`), isosurfaces, occlusion, glow and surroundings (`stability_surfaces.py`). Two errors are measured, each
relative to the largest number of its kind in float64, so that an entry which is small because others cancel in it is not held to digits
that float32 does not have:

- of the value: the largest difference of a pixel, over the largest pixel;
- of the gradient: for each array of the scene (transfer function, voxels, pose, each light, shading, phase function, albedo) and of the
  camera, the largest difference of an entry of the derivative of a weighted sum of all pixels, over the largest entry for that array;
  an array in which a relative change `x d/dx` is below 1e-6 of the picture counts by that bound instead, and the camera's angle of view,
  in which the two sides of a picture cancel, by the largest entry of its pose. The worst array counts.

A row is the worst of its cases. "Finite" is said of value, reverse mode, forward mode and `vmap` of reverse mode, all in float32.
"""

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from experiments.stability_lit import Case, lit_rows
from experiments.stability_surfaces import surface_rows

SETTINGS = jvr.Settings(0.87, termination=0)
# What a relative change of an array moves the picture by, at least, to be held to digits of its own.
FELT = 1e-6


class Found(NamedTuple):
    """What one case came to: errors of value and gradient, the array with the worst gradient, what was not finite, and whether pixels
    differ from each other."""

    value: float
    gradient: float
    worst: str
    infinite: tuple[str, ...]
    varies: bool


def rows(quick: bool = False) -> dict[str, list[Case]]:
    """The hard cases by their row of the table; those of surfaces, whose programs take long to compile, not where that is to be `quick`."""
    return lit_rows(quick) if quick else lit_rows(quick) | surface_rows(quick)


def _loss(inputs: Any, rest: Any, settings: jvr.Settings):
    scene, camera = eqx.combine(inputs, rest)
    rgb = jvr.render(scene, camera, settings).rgb
    weight = 0.5 + 0.3 * jnp.sin(jnp.arange(rgb.size, dtype=rgb.dtype)).reshape(rgb.shape)
    return jnp.sum(weight * rgb), rgb


def _reverse(inputs: Any, rest: Any):
    (_, rgb), gradient = jax.value_and_grad(lambda i: _loss(i, rest, SETTINGS), has_aux=True)(inputs)
    return rgb, gradient


def _forward(inputs: Any, rest: Any):
    settings = jvr.Settings(SETTINGS.step, termination=0, adjoint=jvr.Forward())
    return jax.jvp(lambda i: _loss(i, rest, settings)[0], (inputs,), (jax.tree.map(jnp.ones_like, inputs),))[1]


def _batched(inputs: Any, rest: Any):
    both = jax.tree.map(lambda x: jnp.stack([x, x]), inputs)
    return jax.vmap(lambda i: _reverse(i, rest)[1])(both)


class Ways(NamedTuple):
    """The compiled ways to measure a case."""

    reverse: Callable[..., Any]
    forward: Callable[..., Any]
    batched: Callable[..., Any]


def compiled_ways() -> Ways:
    """One program of each for all cases of the same structure."""
    return Ways(jax.jit(_reverse), jax.jit(_forward), jax.jit(_batched))


def split(case: Case) -> tuple[Any, Any]:
    """The arrays of a case rounded to float32 and put into the precision of the moment, and the rest."""

    def rounded(x: Any) -> Any:
        x = np.asarray(x)
        return jnp.asarray(x.astype(np.float32), float) if np.issubdtype(x.dtype, np.floating) else jnp.asarray(x)

    return eqx.partition(jax.tree.map(rounded, (case.scene, case.camera)), eqx.is_inexact_array)


def measured(case: Case, ways: Ways, *, modes: bool = True) -> Found:
    """Errors of one case; with `modes`, forward mode and `vmap` are looked at too."""
    inputs, rest = split(case)
    rgb, gradient = jax.tree.map(np.asarray, ways.reverse(inputs, rest))
    infinite = [] if np.isfinite(rgb).all() else ["value"]
    if not all_finite(gradient):
        infinite.append("reverse")
    if modes and not all_finite(ways.forward(inputs, rest)):
        infinite.append("forward")
    if modes and not all_finite(ways.batched(inputs, rest)):
        infinite.append("vmap")
    with jax.enable_x64(True):
        true_inputs, rest = split(case)
        true_rgb, true_gradient = jax.tree.map(np.asarray, ways.reverse(true_inputs, rest))
        true_inputs = jax.tree.map(np.asarray, true_inputs)
    value = float(np.abs(rgb - true_rgb).max() / np.abs(true_rgb).max())
    worst, name = 0.0, ""
    pose = float(np.abs(true_gradient[1].world_from_camera[:3]).max())
    triples = zip(*(jax.tree_util.tree_leaves_with_path(t) for t in (gradient, true_gradient, true_inputs)), strict=True)
    for (path, g), (_, t), (_, x) in triples:
        label = jax.tree_util.keystr(path)
        if "world_from" in label:
            g, t, x = g[:3], t[:3], x[:3]
        if case.kink and any(part in label for part in ("world_from", "position", "direction", "fov")):
            continue
        least = FELT * float(np.sum(np.abs(true_rgb))) / max(float(np.nanmax(np.abs(x))), 1e-30)
        if "fov" in label:
            least = max(least, pose)
        error = float(np.abs(g.astype(float) - t).max() / max(float(np.abs(t).max()), least))
        if not error <= worst:
            worst, name = (error if math.isfinite(error) else math.inf), label
    return Found(value, worst, name, tuple(infinite), bool(np.ptp(true_rgb, axis=(0, 1)).max() > 0))


def all_finite(tree: Any) -> bool:
    return all(bool(np.isfinite(np.asarray(x)).all()) for x in jax.tree.leaves(tree))


class Placed(NamedTuple):
    """A case in its row of the table; `modes`: whether forward mode and `vmap` are looked at too."""

    row: str
    case: Case
    modes: bool


def groups(quick: bool = False, part: str = "") -> list[list[Placed]]:
    """All cases of rows whose name has a `part`, those of one structure together, which share their programs."""
    found: dict[str, list[Placed]] = {}
    for number, (row, cases) in enumerate(rows(quick).items()):
        if part not in row:
            continue
        for k, case in enumerate(cases):
            structure = str(jax.tree.map(lambda x: (np.shape(x), np.asarray(x).dtype), (case.scene, case.camera)))
            # Forward mode and vmap take longest to compile and say the least.
            placed = Placed(row, case, not quick or (k == 0 and number % 4 == 0))
            found.setdefault(structure, []).append(placed)
    return list(found.values())


def table(quick: bool = False, part: str = "", report: Callable[[str, Case, Found], None] | None = None):
    """For each row whose name has a `part` the worst error of value and of gradient, and what is not finite."""
    found: dict[str, list[Found]] = {row: [] for row in rows(quick) if part in row}
    for group in groups(quick, part):
        # Programs of other structures are of no more use, and hundreds of them exhaust a process's memory mappings.
        jax.clear_caches()
        ways = compiled_ways()
        for row, case, modes in group:
            found[row].append(measured(case, ways, modes=modes))
            if report:
                report(row, case, found[row][-1])
    return [_row(row, of_row) for row, of_row in found.items()]


def _row(name: str, found: list[Found]) -> dict[str, Any]:
    """The worst of a row's cases. **Raises** `ValueError` where each of them shows nothing but one colour, such as the background."""
    if not any(f.varies for f in found):
        raise ValueError(f"{name}: no case shows what it is about")
    return {
        "case": name,
        "value": max(f.value for f in found),
        "gradient": max(f.gradient for f in found),
        "worst": max(found, key=lambda f: f.gradient).worst,
        "not finite": sorted({mode for f in found for mode in f.infinite}),
    }


def figure(result: list[dict[str, Any]], path: str) -> None:
    """The table as bars on a logarithmic axis."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(9, 0.36 * len(result) + 1.2), layout="constrained")
    axes = drawing.subplots()
    at = np.arange(len(result))[::-1]
    axes.barh(at + 0.2, [max(r["value"], 1e-9) for r in result], 0.38, label="value", color="C0")
    axes.barh(at - 0.2, [max(r["gradient"], 1e-9) for r in result], 0.38, label="gradient", color="C1")
    axes.set_yticks(at, [r["case"] for r in result])
    axes.set(xscale="log", xlim=(1e-8, 1e-1), xlabel="worst error of float32, relative to the largest entry")
    axes.legend(loc="lower right", frameon=False)
    drawing.savefig(path, dpi=130)


def main() -> None:
    """Measures, prints the table, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of the table")
    parser.add_argument("--quick", action="store_true", help="few cases of each row")
    parser.add_argument(
        "--rows", metavar="TEXT", default="", help="those with TEXT in their names; others stay as they are in the JSON"
    )
    parser.add_argument("--verbose", action="store_true", help="a line for each case")
    arguments = parser.parse_args()

    def report(name: str, case: Case, found: Found) -> None:
        line = f"  {name} | {case.label}: {found.value:.1e} {found.gradient:.1e} {found.worst} {' '.join(found.infinite)}"
        print(line if arguments.verbose else f"  {name} ...", file=sys.stderr, flush=True)

    result = table(arguments.quick, arguments.rows, report)
    if arguments.rows and arguments.json and Path(arguments.json).exists():
        measured = {row["case"]: row for row in (*json.loads(Path(arguments.json).read_text()), *result)}
        result = [measured[row] for row in rows() if row in measured]
    width = max(len(r["case"]) for r in result)
    print(f"{'case':<{width}}  {'value':>8}  {'gradient':>8}  not finite")
    for r in result:
        print(f"{r['case']:<{width}}  {r['value']:>8.1e}  {r['gradient']:>8.1e}  {', '.join(r['not finite']) or 'nothing'}")
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(result, indent=2) + "\n")
    if arguments.figure:
        figure(result, arguments.figure)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
