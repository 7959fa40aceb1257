"""A parameter is declared once, beside its field: constructors, fits, configurations, saved scenes and the reference go by that."""

import tomllib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jvr
from jvr.fitting.unknowns import ExposedModel, choose_unknowns
from jvr.io.config import ConfigError, build_scene, config_from
from jvr.model.exact import Exact
from jvr.model.light import AbstractLight, LightSample
from jvr.model.parameters import GREY_OR_RGB, assign, choice, parameter
from jvr.model.phase import AbstractPhase, ScatteringAngle, components
from jvr.model.ranges import ANY, RADIANCE, Interval
from jvr.types import ArrayLike, Channels, Scalar, Triple, Vector

# --- Classes of a contributor ----------------------------------------------------------------------------------------


class LampLight(AbstractLight):
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
    with pytest.raises(TypeError, match=r"Volume is none of AbstractEmitter, .*, which files can name"):
        jvr.register("grid", jvr.Volume)
    with pytest.raises(ValueError, match="'point' or the name LampLight is that of another class"):
        jvr.register("point", LampLight)
    # As a notebook does that runs a cell again.
    jvr.register("lamp", LampLight)
