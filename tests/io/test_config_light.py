"""Configurations of lit scenes: every table becomes the object that Python would make, and mistakes are one line."""

import subprocess
import sys
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jvr
from jvr.io.config import ConfigError, build_fit, build_scene, config_from, read_transfer, write_transfer

BASE = '[volume]\nbuiltin = "demo"\n[transfer]\nkind = "window"\n'
LIT = BASE + '[[lights]]\nkind = "directional"\ndirection = [0, 1, -1]\n[shading]\nkind = "lambert"\n'
HAZY = BASE + '[[lights]]\nkind = "point"\nposition = [0, 0, 90]\n[scattering]\nphase = "isotropic"\n'
FIT = (
    HAZY.replace('[transfer]\nkind = "window"', '[truth]\nkind = "linear"\nPOINTS').replace(
        "POINTS", "positions = [0, 1]\nrgb = [[0, 0, 0], [0, 0, 0]]\nsigma_t = [0, 0.1]"
    )
    + "[settings]\nstep = 8\n[camera]\nwidth = 3\nheight = 3\n"
)


def config(text, *sets):
    return config_from(tomllib.loads(text), "config.toml", Path(), sets)


def scene_of(text, *sets):
    return build_scene(config(text, *sets))


def refusal(make, text, *sets):
    with pytest.raises(ConfigError) as caught:
        make(config(text, *sets))
    line = str(caught.value)
    assert "\n" not in line
    assert len(line) < 400
    return line


def same(found, wanted):
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    return True


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("{kind='directional',direction=[0,0,-2]}", jvr.DirectionalLight([0, 0, -2])),
        ("{kind='directional',direction=[0,0,-2],irradiance=[1,2,3]}", jvr.DirectionalLight([0, 0, -2], [1, 2, 3])),
        ("{kind='point',position=[1,2,3],intensity=4,radius=0.1}", jvr.PointLight([1, 2, 3], 4, radius=0.1)),
        ("{kind='point',position=[1,2,3],attenuation=[1,0.5,0]}", jvr.PointLight([1, 2, 3], attenuation=[1, 0.5, 0])),
        (
            "{kind='spot',position=[1,2,3],direction=[1,0,0],intensity=[1,2,3],inner=5,outer=40}",
            jvr.SpotLight([1, 2, 3], [1, 0, 0], [1, 2, 3], inner=5, outer=40),
        ),
        ("'head'", jvr.HeadLight()),
        ("{kind='head',irradiance=0}", jvr.HeadLight(0)),
        ("{kind='ambient',radiance=[0.1,0.2,0.3]}", jvr.AmbientLight([0.1, 0.2, 0.3])),
    ],
)
def test_a_light_is_a_table(text, wanted):
    assert same(scene_of(BASE, f"lights=[{text}]").lights, (wanted,))
    assert same(scene_of(BASE, f"lights={text}").lights, (wanted,))


def test_luminous_balls_and_discs_become_points_at_places_of_their_seed():
    sphere = "{kind='sphere',position=[1,2,3],radius=2,intensity=[3,2,1],seed=7,samples=5}"
    disc = "{kind='disc',position=[1,2,3],radius=2,direction=[0,0,1]}"
    lights = scene_of(BASE, f"lights=['head',{sphere},{disc}]").lights
    wanted = jvr.sphere_light((1, 2, 3), 2.0, (3, 2, 1), key=jax.random.key(7), samples=5)
    wanted += jvr.disc_light((1, 2, 3), (0, 0, 1), 2.0, 1.0, key=jax.random.key(0))
    assert same(lights, (jvr.HeadLight(), *wanted))


BY_VALUE = jvr.ByValue([0.1, 0.9], [0.2, 0.4])
TABLE = "{positions=[0.1,0.9],values=[0.2,0.4]}"
BY_GRADIENT = jvr.ByGradient([0.1, 0.9], [0.2, 0.4])


@pytest.mark.parametrize(
    ("key", "text", "wanted"),
    [
        ("shading", "'lambert'", jvr.Lambert()),
        ("shading", "'phong'", jvr.Phong()),
        ("shading", "'blinn-phong'", jvr.BlinnPhong()),
        (
            "shading",
            "{kind='lambert',ambient=0.2,diffuse=0.3,threshold=0.1,two_sided=false}",
            jvr.Lambert(0.2, 0.3, threshold=0.1, two_sided=False),
        ),
        ("shading", f"{{kind='phong',diffuse={TABLE},shininess=1}}", jvr.Phong(diffuse=BY_VALUE, shininess=1)),
        ("shading", f"{{kind='blinn-phong',specular={TABLE}}}", jvr.BlinnPhong(specular=BY_VALUE)),
        (
            "shading",
            f"{{kind='phenomenological',k_d={TABLE},index=1.3,normalised=false}}",
            jvr.PhenomenologicalBSDF(BY_VALUE, index=1.3, normalised=False),
        ),
        (
            "shading",
            f"{{kind='anisotropic',direction=[1,0,2],roughness_along={TABLE[:-1]},kind='gradient'}}}}",
            jvr.AnisotropicGGX([1, 0, 2], roughness_along=BY_GRADIENT),
        ),
        ("shadows", "'rays'", jvr.ShadowRays()),
        ("shadows", "{kind='rays',step=2,termination=0}", jvr.ShadowRays(2, termination=0)),
        ("shadows", "{kind='volume',resolution=0.5}", jvr.ShadowVolume(0.5)),
        ("shadows", "{kind='piecewise',piece=4}", jvr.PiecewiseShadows(4)),
        (
            "shadows",
            "{kind='in-scattering',rays=8,radius=3,bias=0.1,direct={kind='rays',step=2}}",
            jvr.InScattering(8, radius=3, bias=0.1, direct=jvr.ShadowRays(2)),
        ),
        ("shadows", "'map'", jvr.ShadowMap()),
        (
            "shadows",
            "{kind='map',texels=64,threshold=0.25,softness=2,bias=1}",
            jvr.ShadowMap(64, threshold=0.25, softness=2, bias=1),
        ),
        ("shadows", "{kind='opacity-map',texels=64,layers=8}", jvr.OpacityShadowMap(64, 8)),
        ("shadows", "{kind='deep-map',texels=64,layers=8,error=0.02}", jvr.DeepShadowMap(64, 8, error=0.02)),
        ("occlusion", "{rays=8,radius=3,gamma=2}", jvr.LocalOcclusion(8, radius=3, gamma=2)),
        (
            "occlusion",
            "{kind='surface',rays=8,softness=0.1}",
            jvr.SurfaceOcclusion(8, softness=0.1),
        ),
        ("occlusion", "{kind='histogram',bins=8,bleeding=0.5}", jvr.HistogramOcclusion(8, bleeding=0.5)),
    ],
)
def test_a_part_is_a_name_or_a_table(key, text, wanted):
    around = "[[lights]]\nkind = 'ambient'\n[surfaces]\nvalues = [0.5]\nrgb = [[1, 1, 1]]\n"
    assert same(getattr(scene_of(LIT + around, f"{key}={text}"), key), wanted)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("'isotropic'", jvr.Isotropic()),
        ("{kind='rayleigh'}", jvr.Rayleigh()),
        ("{kind='henyey-greenstein',g=[0.1,-0.2,0.3]}", jvr.HenyeyGreenstein([0.1, -0.2, 0.3])),
        (f"{{kind='henyey-greenstein',g={TABLE}}}", jvr.HenyeyGreenstein(BY_VALUE)),
        ("{kind='double-henyey-greenstein',g1=0.8,g2=-0.3,weight=0.9}", jvr.DoubleHenyeyGreenstein(0.8, -0.3, 0.9)),
        ("{kind='schlick',k=0.5}", jvr.Schlick(0.5)),
        ("{kind='draine',g=0.5,alpha=1}", jvr.Draine(0.5, 1)),
        ("{kind='jendersie-eon',diameter=[5,10,50]}", jvr.JendersieEon([5, 10, 50])),
        ("{kind='tabulated',degrees=[0,90,180],values=[3,1,2]}", jvr.TabulatedPhase(np.radians([0, 90, 180]), [3, 1, 2])),
        (
            "{kind='mixture',weights=[1,3],phases=['isotropic',{kind='mixture',weights=[1],phases=[{kind='schlick',k=0.1}]}]}",
            jvr.Mixture([jvr.Isotropic(), jvr.Mixture([jvr.Schlick(0.1)], [1])], [1, 3]),
        ),
    ],
)
def test_a_phase_function_is_a_name_or_a_table(text, wanted):
    assert same(scene_of(HAZY, f"scattering.phase={text}").scattering, jvr.SingleScattering(wanted))


@pytest.mark.parametrize(
    ("text", "keywords"),
    [
        ("{}", {}),
        ("{albedo=0.5,threshold=0.1}", {"albedo": 0.5, "threshold": 0.1}),
        ("{albedo=[0.1,0.2,0.3]}", {"albedo": [0.1, 0.2, 0.3]}),
        (f"{{albedo={TABLE}}}", {"albedo": BY_VALUE}),
        (f"{{albedo={TABLE[:-1]},kind='value'}}}}", {"albedo": BY_VALUE}),
        (f"{{albedo={TABLE[:-1]},kind='gradient'}}}}", {"albedo": BY_GRADIENT}),
    ],
)
def test_an_albedo_is_a_number_a_colour_or_by_value(text, keywords):
    assert same(scene_of(HAZY, f"scattering={text}").scattering, jvr.SingleScattering(**keywords))


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("analytic", jvr.AnalyticGradient),
        ("forward", jvr.ForwardDifferences),
        ("central", jvr.CentralDifferences),
        ("sobel", jvr.SobelDifferences),
        ("precomputed", jvr.PrecomputedGradient),
    ],
)
def test_normals_are_a_name_or_a_table(name, kind):
    assert same(scene_of(LIT, f"normals={name}").normals, kind())
    assert same(scene_of(LIT, f"normals={{kind='{name}',of_opacity=true}}").normals, kind(of_opacity=True))


def test_a_volume_keeps_its_gradients_where_they_are_used_and_the_voxels_are_known():
    assert scene_of(LIT, "normals=precomputed").volume.gradients is not None
    assert scene_of(LIT, "normals={kind='precomputed',of_opacity=true}").volume.gradients is None
    assert scene_of(LIT, "normals=sobel").volume.gradients is None
    assert scene_of(HAZY, "normals=precomputed").volume.gradients is None
    assert scene_of(HAZY, "normals=precomputed", "scattering.threshold=1").volume.gradients is not None
    truth = "[truth]\nkind = 'window'\n[fit]\n"
    assert scene_of(LIT + truth, "normals=precomputed", "fit.unknowns=['volume.values']").volume.gradients is None


@pytest.mark.slow
def test_a_scene_without_light_is_as_before_and_loads_no_effects():
    code = (
        "import sys; from jvr.io.config import build_scene, config_from; "
        "build_scene(config_from({'volume': {'builtin': 'demo'}, 'transfer': {'kind': 'window'}}, 'x')); "
        "print([m for m in sys.modules if m.startswith('jvr.effects.') or m == 'jvr.model.mie'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=100)
    assert done.stdout.strip() == "[]"


GRADIENT = (
    "{kind='gradient',domain=[0,1],magnitudes=[0,0.5],"
    "rgb=[[[1,0,0],[0,1,0],[0,0,1]],[[1,1,0],[0,1,1],[1,0,1]]],sigma_t=[[0,1,2],[3,4,5]]}"
)


def test_transfer_functions_of_the_gradient():
    colours = [[[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[1, 1, 0], [0, 1, 1], [1, 0, 1]]]
    wanted = jvr.GradientTransfer(colours, [[0, 1, 2], [3, 4, 5]], [0, 1], [0, 0.5])
    assert same(scene_of(BASE, f"transfer={GRADIENT}").transfer, wanted)
    scaled = scene_of(BASE, "transfer.gradient_opacity={low=0.1,high=0.5}").transfer
    assert same(scaled, jvr.GradientOpacity(scene_of(BASE).transfer, 0.1, 0.5))


@pytest.mark.parametrize(
    "transfer",
    [
        jvr.GradientTransfer(np.linspace(0, 1, 18).reshape(2, 3, 3), [[0, 0.1, 1], [2, 3, 1e-7]], [-1000, 3e3], [0, 0.3]),
        jvr.GradientTransfer(np.ones((2, 2, 3)), np.linspace(0, 0.7, 12).reshape(2, 2, 3), [0, 1], [0, 0.3]),
        jvr.GradientOpacity(jvr.LutTransfer([[0, 0, 0], [1, 0.1, 0.3]], [0, 0.7], [0, 1]), 0.1, 0.3),
    ],
)
def test_a_transfer_function_of_the_gradient_survives_a_file_bit_by_bit(transfer, tmp_path):
    write_transfer(tmp_path / "t.toml", transfer)
    assert same(read_transfer(tmp_path / "t.toml"), transfer)
    named = scene_of(BASE, f"transfer={{kind='file',path='{tmp_path / 't.toml'}'}}").transfer
    assert same(named, transfer)


@pytest.mark.parametrize(
    ("change", "key", "hint"),
    [
        ("lights=[{kind='directional'}]", "lights[0].direction", "missing"),
        ("lights=[{kind='point',position=[0,0,0]},{kind='pont'}]", "lights[1].kind", "did you mean 'point'?"),
        ("lights=[{kind='point',position=[0,0,0],intensty=1}]", "lights[0].intensty", "did you mean 'intensity'?"),
        ("lights=[{kind='point',position=[0,0,0],intensity=-1}]", "lights[0].intensity", "not negative"),
        ("lights=[{kind='point',position=[0,0,0],intensity=[1,1]}]", "lights[0].intensity", "three"),
        ("lights=[{kind='directional',direction=[0,0,0]}]", "lights[0].direction", "must have a direction"),
        ("lights=[{kind='spot',position=[0,0,0],direction=[1,0,0],inner=40}]", "lights[0]", "inner < outer"),
        ("lights=[{kind='sphere',position=[0,0,0],radius=0}]", "lights[0].radius", "positive"),
        ("lights=[{kind='disc',position=[0,0,0],radius=1,direction=[0,0,0]}]", "lights[0].direction", "must have a direction"),
        ("shading=lamber", "shading", "did you mean 'lambert'?"),
        ("shading={kind='lambert',specular=1}", "shading.specular", "unknown key"),
        ("shading={kind='phong',specular={positions=[0,1],values=[1]}}", "shading.specular.values", "1 entries"),
        (
            "shading={kind='phong',specular={positions=[0,1],values=[1,-1]}}",
            "shading.specular.values",
            "entry 1 must be finite and not negative",
        ),
        ("shading={kind='phong',shininess=0.5}", "shading.shininess", "at least 1"),
        ("shading={kind='phong',threshold=-1}", "shading.threshold", "gradient"),
        ("shadows=ray", "shadows", "did you mean 'rays'?"),
        ("shadows={kind='rays',texels=4}", "shadows.texels", 'only kind = "map" or "opacity-map" or "deep-map" has it'),
        ("shadows={kind='volume',resolution=0}", "shadows.resolution", "above 0"),
        ("shadows={kind='map',threshold=1}", "shadows.threshold", "between 0 and 1"),
        ("shadows={kind='deep-map',layers=0}", "shadows.layers", "at least 1"),
        ("shadows=['rays','volume']", "shadows", "'rays' and 'volume' exclude each other"),
        ("shadows={rays={},volume={}}", "shadows", "'rays' and 'volume' exclude each other"),
        ("shadows={kind='map',rays={}}", "shadows", "'map' and 'rays' exclude each other"),
        ("shadows={rays={step=1}}", "shadows", 'such as [shadows] kind = "rays"'),
        ("occlusion=locl", "occlusion", "did you mean 'local'?"),
        ("occlusion={bins=4}", "occlusion.bins", 'only kind = "histogram" has it'),
        ("normals=sobol", "normals", "did you mean 'sobel'?"),
        ("normals={kind='sobel',of_opacty=true}", "normals.of_opacty", "did you mean 'of_opacity'?"),
        ("scatering={}", "scatering", "did you mean 'scattering'?"),
        ("scattering={albedo=1.5}", "scattering.albedo", "in [0, 1]"),
        ("scattering={albedo='high'}", "scattering.albedo", "a table with positions and values"),
        ("scattering={albedo={positions=[0,1],values=[1,2]}}", "scattering.albedo.values", "entry 1 must be in [0, 1]"),
        (
            "scattering={albedo={kind='gradient',positions=[0,1],values=[1,2]}}",
            "scattering.albedo.values",
            "entry 1 must be in [0, 1]",
        ),
        ("scattering={albedo={kind='gradint',positions=[0],values=[1]}}", "scattering.albedo.kind", "did you mean 'gradient'?"),
        ("scattering={threshold=0}", "scattering.threshold", "positive"),
        ("scattering={phase='rayliegh'}", "scattering.phase", "did you mean 'rayleigh'?"),
        ("scattering={phase='schlick'}", "scattering.phase.k", "missing"),
        ("scattering={phase={kind='henyey-greenstein',g=1}}", "scattering.phase.g", "between -1 and 1"),
        (
            "scattering={phase={kind='henyey-greenstein',g={positions=[0,1],values=[0,1]}}}",
            "scattering.phase.g.values",
            "entry 1 must be between -1 and 1",
        ),
        ("scattering={phase={kind='jendersie-eon',diameter=4}}", "scattering.phase.diameter", "micrometres"),
        ("scattering={phase={kind='tabulated',degrees=[0,3.14],values=[1,1]}}", "scattering.phase.degrees", "180"),
        ("scattering={phase={kind='tabulated',degrees=[0,180],values=[0,0]}}", "scattering.phase", "not all be zero"),
        ("scattering={phase={kind='mixture',phases=[],weights=[]}}", "scattering.phase.phases", "too few"),
        (
            "scattering={phase={kind='mixture',phases=[{kind='schlick',k=2}],weights=[1]}}",
            "scattering.phase.phases[0].k",
            "between -1 and 1",
        ),
        ("transfer.gradient_opacity={lo=0,high=1}", "transfer.gradient_opacity.lo", "did you mean 'low'?"),
        ("transfer.gradient_opacity={low=1,high=1}", "transfer.gradient_opacity", "low < high"),
        (f"transfer={GRADIENT.replace('[0,1,2]', '[0,1]')}", "transfer.sigma_t[0]", "2 entries"),
        (f"transfer={GRADIENT.replace('magnitudes=[0,', 'magnitudes=[1,')}", "transfer.magnitudes", "strictly increasing"),
    ],
)
def test_mistakes_about_light_are_named(change, key, hint):
    line = refusal(build_scene, LIT, change)
    assert f"{key}: " in line
    assert hint in line


@pytest.mark.parametrize(
    ("text", "key", "hint"),
    [
        (BASE + "[shading]\nkind = 'lambert'\n[shadows]\nkind = 'rays'\n", "shadows", "no light that casts them"),
        (
            LIT.replace("[[lights]]", "[shadows]\nkind = 'rays'\n[[lights]]").split("[shading]")[0],
            "shadows",
            "nothing shows them",
        ),
        (BASE + "[shading]\nkind = 'lambert'\n[occlusion]\n", "occlusion", 'add [[lights]] with kind = "ambient"'),
        (BASE + "[[lights]]\nkind = 'ambient'\n[occlusion]\n", "occlusion", "nothing shows it"),
        (
            LIT + "[normals]\nof_opacity = true\n[transfer.gradient_opacity]\nlow = 0\nhigh = 1\n",
            "normals.of_opacity",
            "gradient",
        ),
    ],
)
def test_parts_that_do_not_go_together_are_refused(text, key, hint):
    line = refusal(build_scene, text)
    assert line.startswith(f"config.toml: {key}: ")
    assert hint in line


@pytest.mark.slow
def test_unknowns_of_light_are_named_by_their_paths():
    text = FIT + "[fit]\nunknowns = ['scattering.phase.g', 'lights.0.position', 'lights[0].intensity', 'scattering.albedo']\n"
    job = build_fit(config(text, "scattering.phase={kind='henyey-greenstein',g=0.5}"))
    scene, picked = job.scene, job.keywords["unknowns"](job.scene)
    light = scene.lights[0]
    for found, wanted in zip(
        picked, (scene.scattering.phase.g, light.position, light.intensity, scene.scattering.albedo), strict=True
    ):
        assert found is wanted
    # What is known of the truth is where the fit starts.
    assert same(scene.transfer, job.truth)


def test_a_fit_of_light_starts_where_it_is_told_to():
    text = FIT + "[fit]\nunknowns = ['scattering.albedo', 'lights[0].position']\n"
    start = "[fit.initial]\nscattering.albedo = 0.25\n'lights[0].position' = [9, 9, 99]\n"
    made = config(text + start)
    told, untold = build_fit(made), build_fit(config(text))
    assert float(told.scene.scattering.albedo) == 0.25
    np.testing.assert_array_equal(told.scene.lights[0].position, [9, 9, 99])
    assert float(untold.scene.scattering.albedo) == float(build_scene(made).scattering.albedo) == 1.0
    # The targets show the truth.
    np.testing.assert_array_equal(told.targets[0], untold.targets[0])


def test_a_fit_of_a_surface_starts_where_it_is_told_to():
    surface = "[surfaces]\nvalues = [0.5]\nrgb = [[1, 1, 1]]\n"
    text = FIT + surface + "[fit]\nunknowns = ['surfaces.values']\n"
    told, untold = build_fit(config(text + "[fit.initial]\nsurfaces.values = [0.4]\n")), build_fit(config(text))
    np.testing.assert_array_equal(told.scene.surfaces.values, np.float32([0.4]))
    np.testing.assert_array_equal(untold.scene.surfaces.values, [0.5])
    # The targets show the truth.
    np.testing.assert_array_equal(told.targets[0], untold.targets[0])


@pytest.mark.parametrize(
    ("change", "hint"),
    [
        ("fit.unknowns=['lights.0.positon']", "did you mean 'lights[0].position'?"),
        ("fit.unknowns=['lights[1].position']", "did you mean 'lights[0].position'?"),
        ("fit.initial={scatering={albedo=0}}", "fit.initial.scatering.albedo: unknown key; did you mean 'scattering'?"),
        ("fit.initial={scattering={albedo=2}}", "fit.initial: scattering.albedo: must be in [0, 1]"),
        ("fit.initial={lights={3={intensity=2}}}", "fit.initial: lights.3.intensity: '3' must be an index from 0 to 0"),
        ("fit.initial={volume={packed=true}}", "fit.initial.volume.packed: unknown key; known: camera, lights"),
    ],
)
def test_mistakes_about_unknown_light_are_named(change, hint):
    assert hint in refusal(build_fit, FIT + "[fit]\nunknowns = ['scattering.albedo']\n", change)


@pytest.mark.slow
def test_a_lit_configuration_renders():
    scene = scene_of(LIT, "shadows={kind='rays',step=8}", "lights=['head','ambient',{kind='point',position=[0,-90,90]}]")
    camera = jvr.PerspectiveCamera.look_at((0.0, -200.0, 0.0), (0.0, 0.0, 0.0), (0, 0, 1), 30.0, 4, 4)
    picture = jvr.render(scene, camera, jvr.Settings(4.0))
    assert bool(jnp.all(jnp.isfinite(picture.rgb)))
    assert float(picture.rgb.max()) > 0.0


EACH = FIT.replace('phase = "isotropic"', 'phase = "isotropic"\n[fit]\nunknowns = ["scattering.albedo"]\n').replace(
    "[camera]", '[camera]\nkind = "orbit"\ncount = 2'
)
ENDS = "fit.lights=[{kind='directional',direction=[1,0,0]},[{kind='head'},{kind='ambient',radiance=0.5}]]"


@pytest.mark.slow
def test_each_view_of_a_fit_may_have_lights_of_its_own():
    """The targets are rendered under them; views beyond those of [camera] have the scene's."""
    job = build_fit(config(EACH, ENDS, "fit.held_out=[0]"))
    assert same(job.keywords["lights"], ((jvr.HeadLight(), jvr.AmbientLight(0.5)),))
    assert job.held_out is not None
    _, images, lights = job.held_out
    assert same(lights, ((jvr.DirectionalLight([1, 0, 0]),),))
    elsewhere = build_fit(config(EACH, "fit.held_out=[0]"))
    assert len(elsewhere.held_out) == 2
    assert elsewhere.keywords["lights"] is None
    assert not np.allclose(images[0], elsewhere.held_out[1][0], rtol=0.1)
    extra = build_fit(config(EACH, ENDS, "fit.held_out=1"))
    assert same(extra.held_out[2], (extra.scene.lights,))


def test_lights_of_views_are_as_many_as_the_cameras():
    assert "fit.lights: 2 entries for 3 cameras" in refusal(build_fit, EACH, ENDS, "camera.count=3")
    assert "fit.lights[1][0].kind: unknown choice" in refusal(build_fit, EACH, "fit.lights=['head',[{kind='haed'}]]")
