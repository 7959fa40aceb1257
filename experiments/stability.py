"""Hard cases of lit scenes: float32 against float64, in value and in gradient, and whether anything is not finite.

`python experiments/stability.py [--json FILE] [--figure FILE] [--quick]`

Every case is rendered in both precisions from the same numbers, which float32 holds exactly, with surfaces, single scattering and
shadows. Two errors are measured, each relative to the largest number of its kind in float64, so that an entry which is small because others
cancel in it is not held to digits that float32 does not have:

- of the value: the largest difference of a pixel, over the largest pixel;
- of the gradient: for each array of the scene (transfer function, voxels, pose, each light, shading, phase function, albedo) and of the
  camera, the largest difference of an entry of the derivative of a weighted sum of all pixels, over the largest entry for that array;
  an array in which a relative change `x d/dx` is below 1e-6 of the picture counts by that bound instead, and the camera's angle of view,
  in which the two sides of a picture cancel, by the largest entry of its pose. The worst array counts.

A row is the worst of its cases. "Finite" is said of value, reverse mode, forward mode and `vmap` of reverse mode, all in float32.
"""

import argparse
import dataclasses
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

SETTINGS = jvr.Settings(0.87, termination=0)
RAYS = jvr.ShadowRays(0.9, termination=0)
SHAPE = (5, 6, 7)
# What a relative change of an array moves the picture by, at least, to be held to digits of its own.
FELT = 1e-6


class Case(NamedTuple):
    """A scene and a camera whose arrays are exact in float32. `kink`: the picture has no derivative in where things are, and that of
    either side is right; it is then asked to be finite only."""

    label: str
    scene: jvr.Scene
    camera: jvr.PerspectiveCamera
    kink: bool = False


class Found(NamedTuple):
    """What one case came to: errors of value and gradient, the array with the worst gradient, and what was not finite."""

    value: float
    gradient: float
    worst: str
    infinite: tuple[str, ...]


def base(
    *,
    sigma: float = 1.0,
    values: np.ndarray | None = None,
    world: np.ndarray | None = None,
    positions: Any = (0.1, 0.35, 0.6, 0.85),
    extinction: Any = (0.2, 0.5, 0.3, 0.6),
    slope: float = 1.0,
    lights: Any = None,
    g: float = 0.4,
    albedo: float = 0.8,
    shininess: float = 30.0,
    threshold: float = 0.05,
    shadows: Any = RAYS,
    camera: tuple[Any, Any] | None = None,
    label: str = "",
    kink: bool = False,
) -> Case:
    """An oblique, anisotropic volume of random voxels under a directional and a point light."""
    rng = np.random.default_rng(0)
    volume = jvr.Volume(rng.random(SHAPE) if values is None else values, oblique() if world is None else world, slope=slope)
    rgb = np.random.default_rng(1).random((len(positions), 3))
    transfer = jvr.LinearTransfer(np.asarray(positions) * slope, rgb, sigma * np.asarray(extinction))
    center, radius = np.asarray(volume.center, float), float(volume.radius)
    if lights is None:
        lights = (
            jvr.DirectionalLight([0.5, 0.4, -0.6], [0.6, 0.8, 0.5]),
            jvr.PointLight(center + radius * np.array([0.8, 1.1, 0.4]), 2 * radius**2),
        )
    scene = jvr.Scene(
        volume,
        transfer,
        background=(0.2, 0.5, 0.9),
        lights=lights,
        shading=jvr.BlinnPhong(0.1, 0.5, 0.3, shininess, threshold=threshold * slope),  # pyright: ignore[reportCallIssue]
        shadows=shadows,
        scattering=jvr.SingleScattering(jvr.HenyeyGreenstein(g), albedo),
    )
    eye, target = (center + 2.6 * radius * np.array([0.8, -0.48, 0.36]), center) if camera is None else camera
    return Case(label, scene, jvr.PerspectiveCamera.look_at(eye, target, [0.1, 0.2, 1.0], 38.0, 6, 5), kink)


def oblique() -> np.ndarray:
    """A `world_from_grid` that is turned, anisotropic and sheared: where all corners are equally far from the middle, how far a map of a
    point light has to reach has a kink."""
    turn, _ = np.linalg.qr(np.array([[0.6, 0.3, -0.2], [0.1, 0.9, 0.4], [-0.5, 0.2, 0.8]]))
    shear = np.array([[1, 0.1, -0.05], [0, 1, 0.15], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3] = (turn * np.array([1.0, 2.1, 1.4])) @ shear
    matrix[:3, 3] = (-3.0, 4.0, 10.0)
    return matrix


def wall(factor: float) -> np.ndarray:
    """Voxels whose layer farthest from the eye is a wall between the lights and the rest."""
    values = 0.1 + 0.3 * np.random.default_rng(0).random(SHAPE)
    values[0] = 0.85 if factor else 0.1
    return values


def point(x: float, y: float, z: float, intensity: float = 20.0) -> tuple[Any, ...]:
    """A directional light, and a point light at a position in a volume whose voxels are one apart."""
    return jvr.DirectionalLight([0.5, 0.4, -0.6], [0.6, 0.8, 0.5]), jvr.PointLight([x, y, z], intensity, radius=0.5)


def along(*direction: float) -> tuple[Any, ...]:
    """A directional light, and a point light that is far away in the direction it comes from."""
    # White in three numbers: the same program as for the coloured lights of other rows.
    return jvr.DirectionalLight(direction, np.ones(3)), jvr.PointLight(
        np.array([2.0, 2.5, 3.0]) - 40 * np.array(direction), 1600.0
    )


def rows(quick: bool = False) -> dict[str, list[Case]]:
    """The hard cases by their row of the table."""
    pick = lambda values: values[:: max(1, len(values) // 3)] if quick else values
    depths = pick([0.0, 1e-20, 1e-6, 1e-3, 1.0, 1e2, 1e4, 1e6, 1e8])
    unit: dict[str, Any] = {"world": np.eye(4)}
    step = np.nextafter(np.float32(0.5), np.float32(1))
    eye, middle = np.array([9.0, -5, 7]), np.array([2.0, 2.5, 3.0])
    view = (middle - eye) / np.linalg.norm(middle - eye)
    found = {
        "optical depth to the eye and the light, 0 ... 1e8": [base(sigma=f, label=f"{f:g}") for f in depths],
        "optical depth to the light alone, 0 ... 1e8": [
            base(
                values=wall(f),
                extinction=(0.05, 0.05, 0.05, max(f, 0.05)),
                world=np.eye(4),
                lights=along(0.9, 0.3, -0.2),
                camera=(np.array([12.0, 1.5, 4]), middle),
                label=f"{f:g}",
            )
            for f in depths
        ],
        "light inside of the volume": [
            base(**unit, lights=point(*p), label=str(p)) for p in pick([(2.2, 2.7, 3.4), (0.1, 0.3, 5.8)])
        ],
        "light at a voxel": [base(**unit, lights=point(*p), label=str(p)) for p in pick([(2, 2, 3), (1, 3, 5), (3, 4, 2)])],
        "light at the border": [
            base(**unit, lights=point(*p), label=str(p), kink=True)
            for p in pick([(4, 2.3, 3.1), (4, 5, 2.2), (4, 5, 6), (0, 0, 0)])
        ],
        "light grazing a face": [
            base(**unit, lights=lights, label=label, kink=True)
            for label, lights in (("along x", along(1, 0, 0)), ("along -z", along(0, 0, -1)), ("1e-8 off", along(1, 1e-8, 0)))
        ],
        "point light in the plane of a face": [base(**unit, lights=point(4, 2.5, 12, 100), label="in x = 4", kink=True)],
        "g from -0.9999 to 0.9999": [
            base(**unit, g=g, lights=along(*(sign * view)), camera=(eye, middle), label=f"{g:g}, {name}")
            for g in pick([-0.9999, -0.99, -0.5, 0.5, 0.99, 0.9999])
            for sign, name in ((1, "from the eye"), (-1, "into the eye"))
        ],
        "g exactly 0": [base(g=0.0)],
        "specular exponent 1 ... 1e5": [
            base(**unit, shininess=e, lights=along(*view), camera=(eye, middle), label=f"{e:g}")
            for e in pick([1.0, 2.0, 1e2, 1e3, 1e5])
        ],
        "gradient of length 0": [base(values=np.full(SHAPE, v), label=f"{v:g}") for v in (0.0, 0.5)],
        "gradient of length 1e-30 ... 1e30": [base(slope=s, label=f"{s:g}") for s in pick([1e-30, 1e-10, 1.0, 1e10, 1e30])],
        "gradient beside a threshold of 0 or 1e30": [base(threshold=t, label=f"{t:g}") for t in (0.0, 1e-30, 1e30)],
        "albedo 0 and 1": [base(albedo=a, label=f"{a:g}") for a in (0.0, 1.0)],
        "transfer function with a step": [
            base(positions=(0.1, 0.5, step, 0.9), extinction=(0, 0, h, h), label=f"{h:g}") for h in pick([0.5, 10.0, 1e6])
        ],
        "deep shadow map with one layer": [
            base(sigma=f, shadows=jvr.DeepShadowMap(12, 1), label=f"{f:g}") for f in pick([1e-3, 1.0, 1e4])
        ],
    } | placed_rows(quick)
    if not quick:
        for shadows in (jvr.ShadowVolume(1.0), jvr.OpacityShadowMap(9, 7), jvr.DeepShadowMap(9, 7), jvr.PiecewiseShadows(1, 0.5)):
            cases = [base(sigma=f, shadows=shadows, label=f"depth {f:g}") for f in (0.0, 1.0, 1e4, 1e8)]
            cases += [base(**unit, lights=point(*p), shadows=shadows, label=str(p)) for p in ((2, 2.5, 3), (2.2, 2.7, 3.4))]
            found[f"{type(shadows).__name__}: optical depth 0 ... 1e8, light inside"] = cases
    return found | environment_rows(quick)


def smooth() -> np.ndarray:
    """Voxels without kinks of note."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n) for n in SHAPE], indexing="ij")
    return 0.5 + 0.4 * np.sin(2 * x + 1) * np.cos(1.5 * y) * np.cos(1.2 * z + 0.3)


def placed(
    *,
    away: float = 2.6,
    origin: Any = (0.0, 0.0, 0.0),
    clip: bool = False,
    values: np.ndarray | None = None,
    label: str = "",
    **parts: Any,
) -> Case:
    """Smooth voxels, that of index (0, 0, 0) at `origin`, seen from `away` of the volume's radii under the same angle."""
    matrix = oblique()
    matrix[:3, 3] = origin
    values = smooth() if values is None else values
    center = matrix[:3, :3] @ ((np.array(SHAPE) - 1) / 2) + origin
    radius = float(jvr.Volume(values, oblique()).radius)
    lights = (
        jvr.DirectionalLight([0.5, 0.4, -0.6], [0.6, 0.8, 0.5]),
        jvr.PointLight(center + radius * np.array([0.8, 1.1, 0.4]), 2 * radius**2),
    )
    case = base(values=values, world=matrix, lights=lights, label=label, **parts)
    eye = center + away * radius * np.array([0.8, -0.48, 0.36])
    angle = 2 * math.degrees(math.atan(2.6 * math.tan(math.radians(19)) / away))
    scene = case.scene
    if clip:
        scene = dataclasses.replace(scene, clipping=jvr.ClippingBox(center - 0.45 * radius, center + 0.37 * radius))
    return Case(label, scene, jvr.PerspectiveCamera.look_at(eye, center, [0.1, 0.2, 1.0], angle, 6, 5))


def placed_rows(quick: bool) -> dict[str, list[Case]]:
    """Hard cases of where things are: cameras far away, worlds with a far origin, cuts, and voxels that are no numbers."""
    pick = lambda values: values[:: max(1, len(values) // 2)] if quick else values
    unknown = 0.1 + 0.8 * np.random.default_rng(0).random(SHAPE)
    unknown[2:] = -3.4e38
    missing = np.random.default_rng(0).random(SHAPE)
    missing[0, 0, 0] = np.nan
    # The clipping box keeps the voxel that is NaN away from every ray.
    hidden = base(values=missing, world=np.eye(4), label="NaN")
    box = jvr.ClippingBox([1.25, 1.25, 1.25], [9.0, 9.0, 9.0])
    hidden = hidden._replace(scene=dataclasses.replace(hidden.scene, clipping=box))
    # Equal voxels but for a noise.
    noisy = lambda noise: 0.5 * (1 + noise * np.random.default_rng(0).standard_normal(SHAPE))
    labels = placed(label="two labels")
    volume = jvr.Volume((smooth() > 0.5).astype(np.uint8), oblique(), interpolation=jvr.Nearest())
    labels = labels._replace(scene=dataclasses.replace(labels.scene, volume=volume), kink=True)
    spot = lambda outer: (
        jvr.DirectionalLight([0.5, 0.4, -0.6], [0.6, 0.8, 0.5]),
        jvr.SpotLight([4.0, 9.0, 8.0], [-0.5, -1.0, -0.8], 200.0, inner=0.3 * outer, outer=outer),
    )
    return {
        "camera 10 ... 1e6 radii away": [placed(away=d, label=f"{d:g}") for d in pick([10.0, 1e2, 1e4, 1e6])],
        "world origin as in UTM": [
            placed(origin=(759186.3, -2957195.7, 1203.1), away=d, clip=True, label=f"{d:g}") for d in pick([2.6, 1e4])
        ],
        "cut by a clipping box, noise 0 ... 1e-3": [
            placed(values=noisy(noise), clip=True, label=f"{noise:g}") for noise in pick([0.0, 1e-6, 1e-3])
        ],
        "labels": [labels],
        "voxel (0, 0, 0) is NaN, and clipped": [hidden],
        "no data: voxels of -3.4e38": [base(values=unknown, extinction=(0.0, 0.5, 0.3, 0.6), world=np.eye(4), label="-3.4e38")],
        "spot of 0.01 ... 60 degrees": [base(world=np.eye(4), lights=spot(a), label=f"{a:g}") for a in pick([0.01, 1.0, 60.0])],
    }


def under_environment(
    *, order: int = 3, transfer: Any = None, material: Any = None, light: Any = None, label: str = "", **parts: Any
) -> Case:
    """The same volume under environment lighting: a dim sky and, unless told, a lamp ten thousand times as bright."""
    case = base(shadows=None, lights=(), label=label, **parts)
    if light is None:
        light = jvr.EnvironmentLight.disc([0.3, 0.5, 0.8], 2.0, 1e4, order) + jvr.EnvironmentLight.constant(1.0)
    scene = dataclasses.replace(
        case.scene,
        shading=None,
        scattering=None,
        environment=light,
        material=material or jvr.MicrofacetBRDF(roughness=0.4),
        radiance_transfer=transfer or jvr.RadianceTransfer(order, 8, 1.0),
    )
    return case._replace(scene=scene)


def environment_rows(quick: bool) -> dict[str, list[Case]]:
    """Hard cases of environment lighting."""
    depths = (1.0, 1e8) if quick else (0.0, 1e-6, 1.0, 1e2, 1e4, 1e8)
    rough = (0.05, 1.0) if quick else (0.01, 0.05, 0.2, 1.0)
    exact = lambda **settings: jvr.RadianceTransfer(3, 8, 1.0, exact=True, **settings)
    bleeds = jvr.RadianceTransfer(3, 8, 1.0, bleeding=jvr.MaterialBleeding())
    return {
        "transfer: optical depth 0 ... 1e8, shortcut": [under_environment(sigma=f, label=f"{f:g}") for f in depths],
        "transfer: optical depth 0 ... 1e8, exact": [
            under_environment(sigma=f, transfer=exact(), label=f"{f:g}") for f in depths
        ],
        "transfer: material bleeding, order 0 and 3": [
            under_environment(transfer=bleeds, label="3"),
            under_environment(order=0, transfer=jvr.RadianceTransfer(0, 8, 1.0), label="0"),
        ],
        "transfer: no gradient, all gradient": [
            under_environment(values=np.full(SHAPE, 0.5), label="constant"),
            under_environment(transfer=exact(surface=1e-6), label="alpha 0"),
            under_environment(transfer=exact(surface=1e6), label="alpha 90 degrees"),
        ],
        "microfacets: roughness 0.01 ... 1": [
            under_environment(material=jvr.MicrofacetBRDF(roughness=r), label=f"{r:g}") for r in rough
        ],
    }


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
    return Found(value, worst, name, tuple(infinite))


def all_finite(tree: Any) -> bool:
    return all(bool(np.isfinite(np.asarray(x)).all()) for x in jax.tree.leaves(tree))


class Placed(NamedTuple):
    """A case in its row of the table; `modes`: whether forward mode and `vmap` are looked at too."""

    row: str
    case: Case
    modes: bool


def groups(quick: bool = False) -> list[list[Placed]]:
    """All cases, those of one structure together, which share their programs."""
    found: dict[str, list[Placed]] = {}
    for number, (row, cases) in enumerate(rows(quick).items()):
        for k, case in enumerate(cases):
            structure = str(jax.tree.map(lambda x: (np.shape(x), np.asarray(x).dtype), (case.scene, case.camera)))
            # Forward mode and vmap take longest to compile and say the least.
            placed = Placed(row, case, not quick or (k == 0 and number % 4 == 0))
            found.setdefault(structure, []).append(placed)
    return list(found.values())


def table(quick: bool = False, report: Callable[[str, Case, Found], None] | None = None):
    """For each row the worst error of value and of gradient, and what is not finite."""
    found: dict[str, list[Found]] = {row: [] for row in rows(quick)}
    for group in groups(quick):
        # Programs of other structures are of no more use, and hundreds of them exhaust a process's memory mappings.
        jax.clear_caches()
        ways = compiled_ways()
        for row, case, modes in group:
            found[row].append(measured(case, ways, modes=modes))
            if report:
                report(row, case, found[row][-1])
    return [_row(row, of_row) for row, of_row in found.items()]


def _row(name: str, found: list[Found]) -> dict[str, Any]:
    """The worst of a row's cases."""
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
    parser.add_argument("--verbose", action="store_true", help="a line for each case")
    arguments = parser.parse_args()

    def report(name: str, case: Case, found: Found) -> None:
        line = f"  {name} | {case.label}: {found.value:.1e} {found.gradient:.1e} {found.worst} {' '.join(found.infinite)}"
        print(line if arguments.verbose else f"  {name} ...", file=sys.stderr, flush=True)

    result = table(arguments.quick, report=report)
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
