"""Only what a scene calls for: absent effects leave no trace, plans say what is in, advice says what it is worth."""

import dataclasses
import functools
import itertools
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from scenes import OBLIQUE, perspective, render, voxels

import jvr
from jvr.rendering.advise import effects_of, remarks_on

MODULES = ("lighting", "shading", "scattering", "shadow_rays", "shadow_volume", "shadow_map", "deep_shadow_map", "light_space")
MODULES += (
    "piecewise_shadows",
    "in_scattering",
    "short_rays",
    "environment_lighting",
    "radiance_transfer",
    "radiance_transfer_grid",
    "diffusion",
    "occlusion",
    "histogram_occlusion",
    "surface_occlusion",
)
MODELS = ("material", "brdf", "microfacet", "merl", "dipole")
LIGHT = {"lights": (jvr.DirectionalLight((0.3, -0.5, -1.0)), jvr.AmbientLight(0.2))}
EFFECTS = {
    "shading": lambda: {"shading": jvr.BlinnPhong()},
    "scattering": lambda: {"scattering": jvr.SingleScattering(jvr.HenyeyGreenstein(0.4), 0.9)},
    "shadows": lambda: {"shading": jvr.Lambert(), "shadows": jvr.ShadowVolume(1.0)},
    "occlusion": lambda: {"shading": jvr.Lambert(), "occlusion": jvr.LocalOcclusion(4, samples=2)},
    "gradient": lambda: {"transfer": jvr.GradientOpacity(transfer(), 0.01, 0.3)},
}
# Environment lighting in the air, on surfaces, and in the way of each other; each met once by every other effect.
ENVIRONMENT = {
    "haze": lambda: around(jvr.PhaseBRDF(jvr.HenyeyGreenstein(0.4), 0.9)),
    "surfaces": lambda: around(jvr.LambertBRDF(0.8)),
    "radiance_transfer": lambda: around(
        jvr.LambertBRDF(0.8), radiance_transfer=jvr.RadianceTransfer(1, 4, bleeding=jvr.TransferBleeding())
    ),
}
PAIRS = [
    *itertools.combinations(EFFECTS, 2),
    *zip(("haze", "surfaces", "radiance_transfer", "haze", "haze"), EFFECTS, strict=True),
]


def transfer(scale=0.6):
    return jvr.LinearTransfer([0.1, 0.5, 0.9], [[0.9, 0.5, 0.2], [0.2, 0.8, 0.4], [0.7, 0.7, 0.9]], [0.0, 0.2 * scale, scale])


def around(material, **parts):
    """Parts of a scene under environment lighting."""
    return {"environment": jvr.EnvironmentLight.constant(0.7, order=1), "material": material, **parts}


def scene(**parts):
    volume = jvr.Volume(voxels((5, 6, 7)).astype(np.float32), OBLIQUE)
    return jvr.Scene(**{"volume": volume, "transfer": transfer(), **parts})


def program(one):
    """The jaxpr of a picture."""
    return str(jax.make_jaxpr(lambda s, c: jvr.render(s, c).rgb)(one, perspective(one.volume)))


BLOCKED = """
import sys
for name in {modules}:
    sys.modules[name] = None  # importing it raises ImportError
sys.path[:0] = {tests!r}
from test_effects import program, scene
print(program(scene()))
"""


def test_scene_without_effects_needs_none_of_their_modules():
    """The same program when no module of an effect can be imported."""
    folders = [str(folder) for folder in Path(__file__).parents[:2]]
    modules = [f"jvr.effects.{name}" for name in MODULES] + [f"jvr.model.{name}" for name in MODELS]
    code = BLOCKED.format(modules=modules, tests=folders)
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, encoding="utf-8")
    assert run.returncode == 0, run.stderr
    # Addresses of functions are the only difference between two processes.
    clean = lambda text: [line.split(" at 0x")[0] for line in text.strip().splitlines()]
    assert clean(run.stdout) == clean(program(scene()))


@functools.cache
def plain_program():
    return program(scene())


@pytest.mark.parametrize(
    "names", [*[(n,) for n in (*EFFECTS, *ENVIRONMENT)], *(pytest.param(p, marks=pytest.mark.slow) for p in PAIRS)]
)
def test_an_effect_is_in_the_program_only_where_the_scene_holds_it(names):
    """Plans and programs differ from the plain one by what is named; taking the effects out again restores both."""
    parts = functools.reduce(lambda a, b: a | b, [(EFFECTS | ENVIRONMENT)[name]() for name in names], dict(LIGHT))
    lit, plain = scene(**parts), scene()
    assert program(lit) != plain_program()
    assert jvr.plan(lit) != jvr.plan(plain)
    absent = {"lights": (), "shading": None, "shadows": None, "scattering": None, "transfer": transfer()}
    absent |= {"environment": None, "material": None, "radiance_transfer": None, "occlusion": None}
    restored = jvr.Scene(lit.volume, **absent)
    assert program(restored) == plain_program()
    assert jvr.plan(restored) == jvr.plan(plain)
    included = {part.name.replace(" ", "_") for part in jvr.plan(lit).parts if part.included}
    assert set(parts) - {"lights", "transfer"} <= included
    assert ("gradient" in included) == any(name not in ("scattering", "haze") for name in names)
    assert ("radiance_transfer" in included) == ("radiance_transfer" in names)


def test_lights_that_nothing_shows_are_not_in_the_program():
    """The arrays of the lights are arguments of the program, and nothing reads them."""

    def of_volume(one):
        render = lambda volume, camera: jvr.render(dataclasses.replace(one, volume=volume), camera).rgb
        return str(jax.make_jaxpr(render)(one.volume, perspective(one.volume)))

    assert of_volume(scene(**LIGHT)) == of_volume(scene())
    (lights,) = (part for part in jvr.plan(scene(**LIGHT)).parts if part.name == "lights")
    assert not lights.included
    assert "nothing reflects or scatters it" in lights.reason


@pytest.mark.slow
def test_new_numbers_compile_nothing():
    count = []

    @jax.jit
    def picture(one, camera):
        count.append(1)
        return jvr.render(one, camera).rgb

    for scale, irradiance, g in ((0.5, 1.0, 0.1), (0.9, 2.0, -0.6)):
        lights = (jvr.DirectionalLight((0.3, scale, -1.0), irradiance), jvr.PointLight((9.0, 5.0, 3.0), 50 * irradiance))
        scattering = jvr.SingleScattering(jvr.HenyeyGreenstein(g), scale)
        one = scene(transfer=transfer(scale), lights=lights, scattering=scattering, shadows=jvr.ShadowVolume(1.0))
        picture(one, perspective(one.volume))
    assert len(count) == 1
    picture(scene(), perspective(one.volume))
    assert len(count) == 2


@pytest.mark.slow
def test_new_numbers_of_environment_lighting_compile_nothing():
    """Light, material, dipole and transfer function; also once all has been computed beforehand."""
    count = []

    @jax.jit
    def picture(one, camera):
        count.append(1)
        return jvr.render(one, camera).rgb

    def under_environment(x):
        bled = jvr.RadianceTransfer(1, 4, bleeding=jvr.TransferBleeding(), scattering=jvr.Dipole([x] * 3, [0.1] * 3))
        light = jvr.EnvironmentLight.constant(x, order=1).rotated(np.array([[0, x, 0], [-x, 0, 0], [0, 0, x]]) / x)
        made = around(jvr.LambertBRDF(x), radiance_transfer=bled) | {"environment": light}
        return scene(transfer=transfer(x), **made)

    from jvr.io.precompute import as_precomputed

    # What is not traced again is not compiled again.
    for x in (0.5, 0.9):
        picture.trace(under_environment(x), perspective(under_environment(x).volume))
    assert len(count) == 1
    for x in (0.5, 0.9):
        frozen = jvr.precompute(under_environment(x))
        picture.trace(frozen, perspective(frozen.volume))
    assert len(count) == 2
    assert jvr.plan(jvr.precompute(under_environment(0.5))) == jvr.plan(as_precomputed(under_environment(0.5)))


def test_plan_says_what_effects_need():
    parts = {p.name: p for p in jvr.plan(scene(**LIGHT, **EFFECTS["shadows"]())).parts}
    assert parts["shading"].needs == ("lights", "gradient")
    assert parts["shadows"].needs == ("light march",)
    assert "ShadowVolume(resolution=1) for 1 light" in parts["shadows"].reason
    assert "asked for by shading" in parts["gradient"].reason
    parts = {p.name: p for p in jvr.plan(scene(**ENVIRONMENT["radiance_transfer"]())).parts}
    assert parts["material"].needs == ("environment", "gradient")
    assert "computed in each picture: jvr.precompute" in parts["radiance transfer"].reason


def dark_scene():
    """A light without strength, and a medium that scatters nothing; shadows of the one light that there is."""
    lights = (jvr.DirectionalLight((0.3, -0.5, -1.0), 0.0), jvr.DirectionalLight((1.0, 0.0, -1.0)))
    scattering = jvr.SingleScattering(jvr.Isotropic(), 0.0)
    one = scene(lights=lights, scattering=scattering, shading=jvr.Lambert(), shadows=jvr.ShadowVolume(0.5))
    return one, perspective(one.volume, 8, 6)


def without(one, **parts):
    return np.asarray(render(dataclasses.replace(one, **parts), perspective(one.volume, 8, 6)).rgb)


def test_effects_are_those_that_the_scene_may_do_without():
    """Each leaves a scene that can be rendered, and says how."""
    one, _ = dark_scene()
    found = {effect.place: effect.change(one, jvr.Settings())[0] for effect in effects_of(one)}
    assert set(found) == {"shadows", "shading", "scattering", "lights[0]", "lights[1]"}
    assert found["shadows"].shadows is None
    assert found["shading"].shading is None
    assert found["scattering"].scattering is None
    assert found["lights[1]"].lights == one.lights[:1]
    only = dataclasses.replace(one, scattering=None)
    (dropped,) = (effect.change(only, jvr.Settings())[0] for effect in effects_of(only) if effect.place == "shading")
    assert dropped.shadows is None


def test_advice_points_out_what_cannot_show():
    one, _ = dark_scene()
    remarks = list(remarks_on(one, None))
    assert len(remarks) == 2
    assert "lights[0] DirectionalLight has no strength" in remarks[0]
    assert "scattering.albedo is zero" in remarks[1]
    assert list(remarks_on(scene(shading=jvr.Lambert()), None)) == [
        "there is no light: shading shows black, and nothing is scattered"
    ]
    unseen = scene(lights=(jvr.AmbientLight(1.0),), shading=jvr.Lambert(ambient=0.0))
    assert "lights[0] AmbientLight is not seen: shading.ambient is zero" in list(remarks_on(unseen, None))


@pytest.mark.slow
def test_advice_measures_what_effects_show():
    one, camera = dark_scene()
    one = dataclasses.replace(one, lights=one.lights[1:], shading=None)
    found = jvr.advise(one, camera, repeats=1)
    shadows, scattering = found.contributions
    # Programs with and without an effect that adds nothing differ by rounding.
    assert scattering.rmse < 1e-7
    assert shadows.rmse < 1e-7
    assert "scattering SingleScattering(Isotropic)" in str(found)


@pytest.mark.slow
def test_proposal_keeps_its_tolerance():
    one, camera = dark_scene()
    found = jvr.advise(one, camera, tolerance=1e-2, repeats=1)
    shadows = next(c for c in found.contributions if c.effect.startswith("shadows"))
    assert shadows.rmse == pytest.approx(np.sqrt(np.mean(np.square(without(one, shadows=None) - without(one)))), rel=1e-3)
    assert found.proposal is not None
    assert "drop scattering SingleScattering(Isotropic)" in found.proposal.changes
    after = np.asarray(jvr.render(found.proposal.scene, camera, found.proposal.settings).rgb)
    difference = np.sqrt(np.mean(np.square(after - np.asarray(jvr.render(one, camera).rgb))))
    assert difference == pytest.approx(found.proposal.rmse, rel=1e-3, abs=1e-7)
    assert found.proposal.rmse <= 1e-2
    assert "together: changes the picture" in str(found)


@pytest.mark.parametrize("tolerance", [0.0, -1.0])
def test_advice_refuses_a_tolerance_that_nothing_meets(tolerance):
    with pytest.raises(ValueError, match="tolerance must be a positive difference"):
        jvr.advise(scene(), perspective(scene().volume), tolerance=tolerance)
