"""Hard cases of lit scenes: a volume of random voxels under lights, with shadows, and under an environment."""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

import jvr

RAYS = jvr.ShadowRays(0.9, termination=0)
SHAPE = (5, 6, 7)


class Case(NamedTuple):
    """A scene and a camera whose arrays are exact in float32. `kink`: the picture has no derivative in where things are, and that of
    either side is right; it is then asked to be finite only."""

    label: str
    scene: jvr.Scene
    camera: jvr.PerspectiveCamera
    kink: bool = False


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


def lit_rows(quick: bool) -> dict[str, list[Case]]:
    """Hard cases of lights and of the media that they shine through."""
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
    missing_data = base(values=unknown, extinction=(0.0, 0.5, 0.3, 0.6), world=np.eye(4), label="-3.4e38")
    if quick:
        # A box around everything: the program of the row before.
        everything = jvr.ClippingBox([-99.0] * 3, [99.0] * 3)
        missing_data = missing_data._replace(scene=dataclasses.replace(missing_data.scene, clipping=everything))
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
        "no data: voxels of -3.4e38": [missing_data],
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
    # Each order of the exact product has programs of its own, which grow with it.
    order = 1 if quick else 3
    exact = lambda **settings: jvr.RadianceTransfer(order, 8, 1.0, exact=True, **settings)
    bleeds = jvr.RadianceTransfer(3, 8, 1.0, bleeding=jvr.MaterialBleeding())
    surfaces = {"alpha 0": exact(surface=1e-6), "alpha 90 degrees": exact(surface=1e6)}
    usual = surfaces["alpha 0"] if quick else exact()
    return {
        "transfer: optical depth 0 ... 1e8, shortcut": [under_environment(sigma=f, label=f"{f:g}") for f in depths],
        "transfer: optical depth 0 ... 1e8, exact": [
            under_environment(order=order, sigma=f, transfer=usual, label=f"{f:g}") for f in depths
        ],
        "transfer: material bleeding, order 0 and 3": [
            under_environment(transfer=bleeds, label="3"),
            under_environment(order=0, transfer=jvr.RadianceTransfer(0, 8, 1.0), label="0"),
        ],
        "transfer: no gradient, all gradient": [
            under_environment(values=np.full(SHAPE, 0.5), label="constant"),
            *(under_environment(order=order, transfer=transfer, label=label) for label, transfer in surfaces.items()),
        ],
        "microfacets: roughness 0.01 ... 1": [
            under_environment(material=jvr.MicrofacetBRDF(roughness=r), label=f"{r:g}") for r in rough
        ],
    }
