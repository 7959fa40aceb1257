"""A parameter is declared once, beside its field: constructors, fits, configurations, saved scenes and the reference go by that."""

import dataclasses
import re
import tomllib
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jvr
from jvr.fitting.bijectors import bijector_of
from jvr.fitting.unknowns import ExposedModel, choose_unknowns
from jvr.io.config import ConfigError, build_scene, config_from
from jvr.io.config.schema.parts import table_of
from jvr.io.kinds import KINDS, PARTS
from jvr.io.reference import markdown, public_parameters
from jvr.model.exact import Exact
from jvr.model.light import AbstractDeltaLight, LightSample
from jvr.model.parameters import GREY_OR_RGB, alternatives, assign, choice, declared, parameter, parts_of, range_at
from jvr.model.phase import AbstractPhase, ScatteringAngle, components
from jvr.model.ranges import ANY, RADIANCE, Interval
from jvr.types import ArrayLike, Channels, Scalar, Triple, Vector

# --- Classes of a contributor ----------------------------------------------------------------------------------------


class LampLight(AbstractDeltaLight):
    """A light of a user: far away, stronger or weaker than it says."""

    direction: Vector = parameter(doc="x, y, z, the way that the light travels")
    strength: Any = parameter(RADIANCE, shapes=GREY_OR_RGB, doc="irradiance")
    gain: Scalar = parameter(Interval(0.5, 2.0), doc="factor", hint="1 is a good start")
    power: int = choice(Interval(low=1), doc="exponent of the factor")

    def __init__(self, direction: ArrayLike, strength: ArrayLike = 1.0, *, gain: ArrayLike = 1.0, power: int = 1):
        assign(self, direction=direction, strength=strength, gain=gain, power=power)

    def sample(self, x: Triple, w_o: Triple) -> LightSample:
        w_i = -self.direction / jnp.linalg.norm(self.direction)
        irradiance = self.gain**self.power * jnp.broadcast_to(self.strength, (3,))
        return LightSample((w_i[0], w_i[1], w_i[2]), jnp.full_like(x[0], jnp.inf), (irradiance[0], irradiance[1], irradiance[2]))

    def moved(self, origin: Exact) -> "LampLight":
        return self


class LinearPhase(AbstractPhase):
    """A phase function of a user: `(1 + b cos theta) / (4 pi)`."""

    b: Any = parameter(Interval(-1.0, 1.0), shapes=GREY_OR_RGB, by_scalar=True, doc="slope")

    def __init__(self, b: ArrayLike | jvr.ByValue):
        assign(self, b=b)

    def evaluate(self, angle: ScatteringAngle) -> Channels:
        return tuple((1 + b * angle.cos) / (4 * jnp.pi) for (b,) in components(self.b))

    def draw(self, u: Any) -> tuple[ScatteringAngle, ...]:
        return tuple(ScatteringAngle.of_cosine(2 * u - 1) for _ in components(self.b))

    @property
    def mean_cosine(self) -> Channels:
        return tuple(b / 3 for (b,) in components(self.b))


@pytest.fixture(scope="module", autouse=True)
def _registered(_registry):
    jvr.register("lamp", LampLight)
    jvr.register("linear", LinearPhase)


CONFIG = """
[volume]
builtin = "demo"
[transfer]
kind = "window"
[[lights]]
kind = "lamp"
direction = [0, 0, -1]
gain = 1.5
power = 2
[scattering]
phase = { kind = "linear", b = 0.25 }
"""
SCENE = jvr.Scene(
    jvr.Volume(np.random.default_rng(0).random((4, 5, 6), np.float32)),
    jvr.LinearTransfer([0.0, 1.0], [[1, 1, 1], [1, 1, 1]], [0.1, 0.3]),
    lights=[LampLight((0.0, 0.0, -1.0), gain=1.5, power=2)],
    scattering=jvr.SingleScattering(LinearPhase(0.25)),
)
CAMERA = jvr.PerspectiveCamera.look_at((2.0, 2.5, 30.0), (1.5, 2.0, 2.5), (0, 1, 0), 15.0, 4, 4)


def scene_of(text: str, *sets: str) -> jvr.Scene:
    return build_scene(config_from(tomllib.loads(text), "config.toml", Path(), sets))


def test_a_contributors_classes_are_named_in_a_configuration():
    scene = scene_of(CONFIG)
    (light,) = scene.lights
    assert isinstance(light, LampLight)
    assert (float(light.gain), light.power, float(light.strength)) == (1.5, 2, 1.0)
    assert isinstance(scene.scattering.phase, LinearPhase)
    by_value = scene_of(CONFIG, "scattering.phase.b={positions=[0,1],values=[-1,1]}").scattering.phase.b
    np.testing.assert_array_equal(by_value.values, [-1, 1])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("lights.0.gain=3", "--set: lights[0].gain: must be in [0.5, 2] (factor; 1 is a good start), not 3"),
        ("lights.0.power=0", "--set: lights[0].power: must be a whole number of at least 1 (exponent of the factor), not 0"),
        ("lights.0.power=1.5", "lights[0].power: must be a whole number of at least 1"),
        ("lights.0.strenght=1", "lights[0].strenght: unknown key; did you mean 'strength'?"),
        (
            "scattering.phase.b=-1.5",
            "scattering.phase.b: must be in [-1, 1] (slope, or a table with positions and values), not -1.5",
        ),
        ("scattering.phase.b={positions=[0,1],values=[0,2]}", "scattering.phase.b.values: entry 1 must be in [-1, 1]"),
        ("lights.0.kind=lmap", "lights[0].kind: unknown choice \"lmap\"; did you mean 'lamp'?"),
    ],
)
def test_mistakes_about_a_contributors_classes_are_named(change, said):
    with pytest.raises(ConfigError) as caught:
        scene_of(CONFIG, change)
    assert said in str(caught.value)


def test_a_contributors_classes_are_saved_and_loaded(tmp_path):
    jvr.save_scene(SCENE, tmp_path / "a.toml")
    found = jvr.load_scene(tmp_path / "a.toml")
    assert jax.tree.structure(found) == jax.tree.structure(SCENE)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(SCENE), strict=True))
    (tmp_path / "a.toml").write_text((tmp_path / "a.toml").read_text().replace("gain = 1.5", "gain = 2.5"))
    with pytest.raises(ValueError, match=r"a\.toml: lights\[0\]: gain must be in \[0\.5, 2\] \(factor"):
        jvr.load_scene(tmp_path / "a.toml")


def test_a_contributors_classes_are_rendered():
    """Scattered light is linear in the irradiance, which goes with the square of the gain here."""
    picture = jax.jit(lambda gain: jvr.render(scene_with_gain(gain), CAMERA, jvr.Settings(1.0)).rgb)
    one, half, two = (picture(jnp.float32(gain)) for gain in (1.0, 1.5, 2.0))
    assert float(jnp.max(two - one)) > 1e-3
    np.testing.assert_allclose(half - one, (1.5**2 - 1) / 3 * (two - one), rtol=1e-3, atol=1e-6)


def test_what_a_contributors_light_has_no_strength_by_is_told_by_its_declaration():
    dark = jvr.Scene(SCENE.volume, SCENE.transfer, lights=[LampLight((0.0, 0.0, -1.0), 0.0)], scattering=SCENE.scattering)
    remarks = ["; ".join(scene.lights[0].remarks("light", scene, None)) for scene in (SCENE, dark)]
    assert remarks == ["", "light LampLight has no strength: it is computed and adds nothing"]


def scene_with_gain(gain: Any) -> jvr.Scene:
    light = LampLight((0.0, 0.0, -1.0), gain=gain, power=2)
    return jvr.Scene(SCENE.volume, SCENE.transfer, lights=[light], scattering=SCENE.scattering)


@pytest.mark.parametrize("bounds", [None, ANY], ids=["smooth", "bounded"])
def test_a_contributors_parameters_are_fitted_in_their_range(bounds):
    model = ExposedModel(SCENE, None)
    chosen = choose_unknowns(model, lambda m: (m.scene.lights[0].gain, m.scene.scattering.phase.b), None, bounds)
    lower, upper, _ = chosen.limits(model, np.asarray(chosen.unconstrained_from_model(model)))
    for far, ends in ((-1e6, [0.5, -1.0]), (1e6, [2.0, 1.0])):
        moved = jnp.asarray(np.clip([far, far], lower, upper), jnp.float32)
        np.testing.assert_allclose(chosen.values_from_unconstrained(moved, model), ends, atol=1e-5)


def test_only_families_and_free_names_are_registered():
    with pytest.raises(TypeError, match=r"Volume is none of AbstractLight, .*, which files can name"):
        jvr.register("grid", jvr.Volume)
    with pytest.raises(ValueError, match="'point' or the name LampLight is that of another class"):
        jvr.register("point", LampLight)
    # As a notebook does that runs a cell again.
    jvr.register("lamp", LampLight)


# --- Every public class ----------------------------------------------------------------------------------------------

RGB = [[0.2, 0.3, 0.4], [0.5, 0.6, 0.7]]
POSE = np.eye(4)
# What a constructor needs, for every public class with parameters.
EXAMPLES: dict[str, dict[str, Any]] = {
    "AmbientLight": {},
    "AnalyticGradient": {},
    "AnisotropicGGX": {"direction": [1.0, 0.0, 0.0]},
    "BlinnPhong": {},
    "BlinnPhongBRDF": {},
    "ByGradient": {"positions": [0.0, 1.0], "values": [0.2, 0.4]},
    "ByValue": {"positions": [0.0, 1.0], "values": [0.2, 0.4]},
    "CentralDifferences": {},
    "ClippingBox": {"lower": [0.0, 0.0, 0.0], "upper": [1.0, 1.0, 1.0]},
    "ClippingPlane": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 2.0]},
    "DeepShadowMap": {},
    "DepthImage": {"depth": [[1.0]], "rgb": [[[0.1, 0.2, 0.3]]]},
    "Dipole": {"sigma_s_prime": [1.0, 2.0, 3.0], "sigma_a": [0.1, 0.2, 0.3]},
    "DirectionalLight": {"direction": [0.0, 0.0, 1.0]},
    "DoubleHenyeyGreenstein": {"g1": 0.3, "g2": -0.3, "weight": 0.5},
    "Draine": {"g": 0.3, "alpha": 1.0},
    "EnvironmentLight": {"coefficients": [[1.0, 1.0, 1.0]]},
    "EnvironmentMap": {"pixels": [[[1.0, 0.5, 0.2]] * 2]},
    "ForwardDifferences": {},
    "GaussianTransfer": {"center": [0.0, 1.0], "width": [0.1, 0.2], "height": [1.0, 2.0], "rgb": RGB, "emission": RGB},
    "GradientOpacity": {"transfer": jvr.LinearTransfer([0.0, 1.0], RGB, [0.0, 1.0]), "low": 0.1, "high": 0.2},
    "GradientTransfer": {
        "rgb": [RGB, RGB],
        "sigma_t": [[0.1, 0.2], [0.3, 0.4]],
        "domain": [0.0, 1.0],
        "magnitudes": [0.0, 1.0],
        "emission": [RGB, RGB],
    },
    "HarmonicMaterial": {"tinted": None, "plain": None, "positions": [0.0, 1.0]},
    "HeadLight": {},
    "HenyeyGreenstein": {"g": 0.3},
    "HistogramOcclusion": {"radius": 3.0, "offset": 0.5, "gamma": 2.0, "bleeding": 0.5},
    "Specular": {"reflectance": 0.5, "index": 1.5},
    "InScattering": {"radius": 3.0, "offset": 0.5},
    "Isosurfaces": {"values": [0.0, 1.0], "rgb": RGB, "opacity": [0.5, 0.5], "band": 0.1},
    "JendersieEon": {"diameter": 10.0},
    "Lambert": {},
    "LambertBRDF": {},
    "LinearTransfer": {"positions": [0.0, 1.0], "rgb": RGB, "sigma_t": [0.1, 0.2], "emission": RGB},
    "LocalOcclusion": {"radius": 3.0, "offset": 0.5, "gamma": 2.0, "glow": 1.0},
    "LutTransfer": {"rgb": RGB, "sigma_t": [0.1, 0.2], "domain": [0.0, 1.0], "emission": RGB},
    "Mesh": {"vertices": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], "faces": [[0, 1, 2]], "rgb": [0.1, 0.2, 0.3]},
    "MaterialByValue": {"positions": [0.0, 1.0], "materials": [jvr.LambertBRDF(), jvr.LambertBRDF()]},
    "MerlBRDF": {"table": np.full((2, 2, 2, 3), 0.1)},
    "MicrofacetBRDF": {},
    "Mixture": {"phases": [jvr.Isotropic(), jvr.Rayleigh()], "weights": [1.0, 2.0]},
    "OpacityShadowMap": {},
    "OrthographicCamera": {"world_from_camera": POSE, "height_world": 1.0, "width": 2, "height": 2},
    "PerspectiveCamera": {"world_from_camera": POSE, "fov_y": 30.0, "width": 2, "height": 2},
    "PinholeCamera": {
        "world_from_camera": POSE,
        "focal_lengths": (2.0, 3.0),
        "width": 2,
        "height": 2,
        "principal_point": (0.5, 1.5),
    },
    "PhaseBRDF": {"phase": jvr.Isotropic()},
    "PhenomenologicalBSDF": {},
    "Phong": {},
    "PhongBRDF": {},
    "PiecewiseShadows": {},
    "PointLight": {"position": [0.0, 0.0, 1.0], "attenuation": [1.0, 0.5, 0.5]},
    "PrecomputedGradient": {},
    "RadianceTransfer": {"chromaticity": 1, "bleeding": jvr.TransferBleeding()},
    "Scene": {"volume": SCENE.volume, "transfer": SCENE.transfer, "background": [0.1, 0.2, 0.3]},
    "Schlick": {"k": 0.3},
    "ShadowMap": {},
    "ShadowRays": {},
    "ShadowVolume": {},
    "SingleScattering": {"threshold": 0.5},
    "SobelDifferences": {},
    "SpotLight": {"position": [0.0, 0.0, 1.0], "direction": [0.0, 0.0, -1.0], "attenuation": [1.0, 0.5, 0.5]},
    "SurfaceOcclusion": {"factor": 2.0, "softness": 0.1},
    "TabulatedPhase": {"angles": [0.0, 1.0, np.pi], "values": [1.0, 0.5, 0.2]},
    "Volume": {"values": np.zeros((2, 2, 2), np.float32)},
}
# Ends that another parameter forbids.
FORBIDDEN = {
    ("SpotLight", "inner", 180.0): "outer is larger",
    ("SpotLight", "outer", 0.0): "inner is smaller",
    ("GradientOpacity", "high", 0.0): "low is smaller",
    ("RadianceTransfer", "order", 0): "chromaticity is at most that",
    ("RadianceTransfer", "chromaticity", 10): "the order is at least that",
}
# Arrays that are no parameters, and why.
UNDECLARED = {
    ("HarmonicMaterial", "tinted"): "made by project",
    ("HarmonicMaterial", "plain"): "made by project",
    ("LocalHistograms", "weights"): "made of a volume",
    ("LocalHistograms", "positions"): "made of a volume",
    ("LocalHistograms", "codes"): "made of a volume",
    ("LocalHistograms", "extents"): "made of a volume",
    ("LocalHistograms", "beyond"): "made of a volume",
    ("LocalHistograms", "cache_key"): "made of a volume",
    ("Mesh", "faces"): "whole numbers, checked on their own",
    ("PrecomputedGradient", "gradients"): "made of a volume",
    ("Volume", "values"): "voxels of any type, checked on their own",
    ("Volume", "world_from_grid"): "an affine transform, checked on its own",
    ("Volume", "bricks"): "made of the voxels",
    ("Volume", "squares"): "made of the voxels",
    ("Volume", "gradients"): "made of the voxels",
    ("Volume", "sobel_gradients"): "made of the voxels",
}
# Where a configuration says a part of a family.
PLACES = {
    "AbstractLight": "lights",
    "AbstractShading": "shading",
    "AbstractShadows": "shadows",
    "AbstractScattering": "scattering",
    "AbstractPhase": "scattering.phase",
    "AbstractNormals": "normals",
    "AbstractSurfaces": "surfaces",
    "AbstractSpecular": "specular",
    "AbstractBRDF": "material",
    "AbstractTransfer": "transfer",
    "AbstractRadianceTransfer": "radiance_transfer",
    "AbstractOcclusion": "occlusion",
}


def public_class(name: str) -> type:
    return getattr(jvr, name)


def test_every_public_class_with_parameters_has_an_example():
    with_parameters = {name for name in PARTS if name[0].isupper() and not isinstance(PARTS[name], type)}
    assert {name for name in with_parameters if declared(public_class(name))} == set(EXAMPLES)


def test_no_public_array_is_undeclared():
    fields = [(name, f) for name in PARTS if not isinstance(PARTS[name], type) for f in dataclasses.fields(public_class(name))]
    found = {(name, f.name) for name, f in fields if "parameter" not in f.metadata and not f.metadata.get("static")}
    parts = {(name, f.name) for name, f in fields if (name, f.name) in found and issubclass_of_part(f.type)}
    assert found - parts == set(UNDECLARED) - parts


def issubclass_of_part(annotation: Any) -> bool:
    """Whether a field holds another public class, which declares its own."""
    return any(cls.__name__ in PARTS or cls.__name__.startswith("Abstract") for cls in parts_of(annotation))


def ends_of(within: Interval, step: float) -> tuple[list[float], list[float]]:
    """Values at the ends of an interval that belong to it, and that do not."""
    inside, outside = [], []
    for end, sign, mark in ((within.low, -1, within.ends[0]), (within.high, 1, within.ends[1])):
        if not np.isfinite(end):
            continue
        is_open = mark in "()"
        near, far = (end - sign * step, end) if is_open else (end, end + sign * step)
        inside.append(near)
        outside.append(far)
    return inside, outside


def cases() -> list[Any]:
    """Class, parameter, a value of it in its range or just outside, and which of the two."""
    found = []
    for name in EXAMPLES:
        for field in declared(public_class(name)).values():
            within, is_whole = field.metadata["parameter"].within, int in alternatives(field.type)
            if isinstance(within, Interval) and not parts_of(field.type) and field.type is not bool:
                inside, outside = ends_of(
                    within, 1 if is_whole else 1e-3 * max(abs(within.low), 1.0) if np.isfinite(within.low) else 1e-3
                )
                kind = int if is_whole else float
                # Brighter light than fits make is taken.
                outside = [x for x in outside if not (within.light and x > 0)]
                found += [pytest.param(name, field.name, kind(x), True, id=f"{name}.{field.name}={x:g}") for x in inside]
                found += [pytest.param(name, field.name, kind(x), False, id=f"{name}.{field.name}!={x:g}") for x in outside]
    return found


def with_value(name: str, field: str, value: float | int) -> dict[str, Any]:
    """The keywords of an example with a value in place of a parameter's first number."""
    before = np.asarray(getattr(public_class(name)(**EXAMPLES[name]), field))
    if before.ndim == 0:
        return EXAMPLES[name] | {field: value}
    array = np.array(before, np.float64)
    array.flat[0] = value
    return EXAMPLES[name] | {field: array.tolist()}


@pytest.mark.parametrize(("name", "field", "value", "is_inside"), cases())
def test_constructors_and_configurations_keep_to_what_is_declared(name, field, value, is_inside):
    keywords, cls = with_value(name, field, value), public_class(name)
    if (name, field, value) in FORBIDDEN:
        return
    if is_inside:
        part = cls(**keywords)
        assert np.asarray(getattr(part, field)).flat[0] == pytest.approx(value, rel=1e-6)
    else:
        with pytest.raises(ValueError, match=rf"^{field} must be "):
            cls(**keywords)
    family = next((base for base, kinds in KINDS.items() if name in kinds.values() and base.__name__ in PLACES), None)
    if family is None or field not in table_of(cls).model_fields:
        return
    place, kind = PLACES[family.__name__], next(kind for kind, known in KINDS[family].items() if known == name)
    plain = {key: given for key, given in keywords.items() if not isinstance(given, eqx.Module | list) or is_numbers(given)}
    table = {"kind": kind} | plain | OTHERWISE.get(name, {})
    data = data_with(place, table)
    if is_inside:
        config_from(data, "config.toml")
    else:
        key = f"{place}[0].{field}" if place == "lights" else f"{place}.{field}"
        with pytest.raises(ConfigError, match=rf"^config\.toml: {re.escape(key)}(\[0\])*: .*must be .*, not "):
            config_from(data, "config.toml")


# In place of parts, what a configuration calls them.
OTHERWISE: dict[str, dict[str, Any]] = {
    "Mixture": {"phases": ["isotropic", "rayleigh"]},
    "PhaseBRDF": {"phase": "isotropic"},
    "RadianceTransfer": {"bleeding": "transfer"},
}


def is_numbers(value: Any) -> bool:
    return isinstance(value, list) and not any(isinstance(entry, eqx.Module) for entry in value)


def data_with(place: str, table: dict[str, Any]) -> dict[str, Any]:
    """A configuration with a table at its place, and whatever else is needed."""
    data: dict[str, Any] = {
        "volume": {"builtin": "demo"},
        "transfer": {"kind": "window"},
        "lights": [{"kind": "directional", "direction": [0, 0, 1]}, {"kind": "ambient"}],
        "shading": {"kind": "lambert"},
        "surfaces": {"values": [0.5], "rgb": [[1, 1, 1]]},
        "environment": "constant",
        "material": "lambert",
    }
    if place == "scattering.phase":
        return data | {"scattering": {"phase": table}}
    return data | {place: [table] if place == "lights" else table}


@pytest.mark.parametrize("name", EXAMPLES)
def test_fits_keep_to_what_is_declared(name):
    """Whatever a solver asks for, an array ends up in its range, and comes to its ends."""
    part = public_class(name)(**EXAMPLES[name])
    for path, leaf in jax.tree_util.tree_leaves_with_path(part):
        within = range_at(part, path)
        if not isinstance(within, Interval) or not jnp.issubdtype(leaf.dtype, jnp.floating):
            continue
        for bounds in (None, ANY):
            bijector = bijector_of(within, leaf, jnp.ones(()), bounds)
            lower, upper = bijector.bounds(np.zeros(leaf.shape))
            for far, end in ((-1e6, within.low), (1e6, within.high)):
                values = np.asarray(bijector.forward(jnp.asarray(np.clip(np.full(leaf.shape, far), lower, upper), jnp.float32)))
                assert np.all(within.closed.holds(values) | np.isinf(values))
                if np.isfinite(end):
                    # Open ends are kept away from by a millionth of the interval's length.
                    length = within.high - within.low if np.isfinite(within.high - within.low) else 1.0
                    np.testing.assert_allclose(values, end, atol=3e-6 * max(abs(end), length, 1.0))


# --- The reference ---------------------------------------------------------------------------------------------------


def test_the_reference_says_what_is_declared():
    found = public_parameters()
    g, *_ = found["HenyeyGreenstein"]
    assert (g.name, g.shape, g.range, g.default) == (
        "g",
        "() or (3,) or jvr.ByValue or jvr.ByGradient",
        "between -1 and 1, without either",
        "",
    )
    diameter = found["JendersieEon"][0]
    assert (diameter.range, diameter.unit) == ("in [5, 50]", "micrometres")
    assert {e.name: e.default for e in found["ShadowRays"]} == {"step": "1", "termination": "0.001"}
    assert "remainder" not in {e.name for e in found["PointLight"]}
    assert all(e.doc for entries in found.values() for e in entries)
    rows = markdown(found["OpacityShadowMap"]).splitlines()
    assert rows[2] == "| `texels` | rays along each axis of the map |  | whole, of at least 2 | `128` |"
