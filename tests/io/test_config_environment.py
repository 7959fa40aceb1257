"""Configurations of scenes under environment lighting: tables become what Python would make, and mistakes are one line."""

import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_config_light import BASE, config, refusal, same, scene_of

import jvr
from jvr.io.config import build_fit, build_scene, read_config
from jvr.pictures import write_image

ENVIRONMENT = 'environment = "constant"\nmaterial = "lambert"\n' + BASE
DISC = "{kind='disc',towards=[0,0,1],half_angle=20}"
PHASE = jvr.HenyeyGreenstein(0.4)


@pytest.fixture
def sky(tmp_path):
    """A map with a bright half, in a file."""
    pixels = np.ones((8, 16, 3), np.float32)
    pixels[:4] *= (3.0, 2.0, 1.0)
    write_image(tmp_path / "sky.exr", pixels)
    return tmp_path / "sky.exr"


@pytest.mark.parametrize(
    ("key", "text", "wanted"),
    [
        ("environment", "'constant'", jvr.EnvironmentLight.constant()),
        ("environment", "{kind='constant',radiance=[1,2,3],order=2}", jvr.EnvironmentLight.constant([1, 2, 3], order=2)),
        ("environment", DISC, jvr.EnvironmentLight.disc([0, 0, 1], 20)),
        (
            "environment",
            "{kind='disc',towards=[0,0,1],half_angle=20,radiance=[1,2,3],order=1}",
            jvr.EnvironmentLight.disc([0, 0, 1], 20, [1, 2, 3], order=1),
        ),
        (
            "environment",
            "{kind='disc',towards=[0,0,1],half_angle=20,clamped=false}",
            jvr.EnvironmentLight(jvr.EnvironmentLight.disc([0, 0, 1], 20).coefficients, clamped=False),
        ),
        ("material", "'lambert'", jvr.LambertBRDF()),
        ("material", "{kind='lambert',reflectance=[0.1,0.2,0.3]}", jvr.LambertBRDF([0.1, 0.2, 0.3])),
        ("material", "{kind='phong',diffuse=0.5,specular=0.25,exponent=10}", jvr.PhongBRDF(0.5, 0.25, 10)),
        ("material", "'blinn-phong'", jvr.BlinnPhongBRDF()),
        (
            "material",
            "{kind='microfacet',base=0.9,metallic=1,roughness=0.25,reflectance_at_normal=[0.1,0.2,0.3]}",
            jvr.MicrofacetBRDF(0.9, 1, 0.25, [0.1, 0.2, 0.3]),
        ),
        ("material", "{kind='phase',albedo=0.5,phase={kind='henyey-greenstein',g=0.4}}", jvr.PhaseBRDF(PHASE, 0.5)),
        ("radiance_transfer", "{}", jvr.RadianceTransfer()),
        ("radiance_transfer", "{frozen=false}", jvr.RadianceTransfer()),
        (
            "radiance_transfer",
            "{order=2,rays=8,resolution=1,bleeding='transfer',chromaticity=1,neighbourhood=0.2,exact=true,step=2,growth=1,"
            "termination=0,surface=0.5,memory=1e6}",
            jvr.RadianceTransfer(
                2,
                8,
                1,
                bleeding=jvr.TransferBleeding(),
                chromaticity=1,
                neighbourhood=0.2,
                exact=True,
                step=2,
                growth=1,
                termination=0,
                surface=0.5,
                memory=1e6,
            ),
        ),
        ("radiance_transfer", "{bleeding='material'}", jvr.RadianceTransfer(bleeding=jvr.MaterialBleeding())),
        ("radiance_transfer", "{scattering='marble'}", jvr.RadianceTransfer(scattering=jvr.Dipole.preset("marble"))),
        (
            "radiance_transfer",
            "{scattering={sigma_s_prime=[1,2,3],sigma_a=[0,0.1,0.2],eta=1.5}}",
            jvr.RadianceTransfer(scattering=jvr.Dipole([1, 2, 3], [0, 0.1, 0.2], 1.5)),
        ),
    ],
)
def test_a_part_is_a_name_or_a_table(key, text, wanted):
    assert same(getattr(scene_of(ENVIRONMENT, f"{key}={text}"), key), wanted)


def test_environments_of_a_list_are_summed():
    found = scene_of(ENVIRONMENT, f"environment=['constant',{DISC}]").environment
    assert same(found, jvr.EnvironmentLight.constant() + jvr.EnvironmentLight.disc([0, 0, 1], 20))


def test_an_environment_is_read_from_an_image(sky):
    found = scene_of(ENVIRONMENT, f"environment={{kind='image',path='{sky}',order=2,window=4.5}}").environment
    assert same(found, jvr.EnvironmentLight.from_image(sky, 2, window=4.5))
    half = scene_of(ENVIRONMENT, f"environment={{kind='image',path='{sky}',scale=0.5}}").environment
    np.testing.assert_allclose(half.coefficients, 0.5 * jvr.EnvironmentLight.from_image(sky).coefficients, rtol=1e-6)


def test_an_environment_is_turned_about_its_axes_in_their_order():
    """Counter-clockwise, seen from the tip of the axis: first +z to -y about x, then -y to +x about z."""
    first = "{axis=[2,0,0],degrees=90}"
    found = scene_of(ENVIRONMENT, f"environment={{kind='disc',towards=[0,0,1],half_angle=20,rotation={first}}}").environment
    np.testing.assert_allclose(found.coefficients, jvr.EnvironmentLight.disc([0, -1, 0], 20).coefficients, atol=1e-6)
    turns = f"[{first},{{axis=[0,0,1],degrees=90}}]"
    found = scene_of(ENVIRONMENT, f"environment={{kind='disc',towards=[0,0,1],half_angle=20,rotation={turns}}}").environment
    np.testing.assert_allclose(found.coefficients, jvr.EnvironmentLight.disc([1, 0, 0], 20).coefficients, atol=1e-6)


def test_a_material_with_a_threshold_is_projected_up_to_the_order_of_the_light():
    found = scene_of(ENVIRONMENT, f"environment=['constant',{DISC}]", "material={kind='lambert',threshold=0.5}").material
    assert same(found, jvr.HarmonicMaterial.project(jvr.LambertBRDF(), 3, threshold=0.5))


def test_materials_by_value():
    text = "{positions=[0.1,0.9],materials=['lambert',{kind='phong',diffuse=0.5}]}"
    assert same(
        scene_of(ENVIRONMENT, f"material={text}").material,
        jvr.MaterialByValue([0.1, 0.9], [jvr.LambertBRDF(), jvr.PhongBRDF(0.5)]),
    )
    found = scene_of(
        ENVIRONMENT,
        f"material={text.replace(chr(39) + 'lambert' + chr(39), '{kind=' + chr(39) + 'lambert' + chr(39) + ',threshold=0.5}')}",
    )
    assert float(found.material.projected(0).threshold) == 0.5


def test_a_measured_material_is_read_from_a_file(tmp_path):
    path = tmp_path / "red.binary"
    with path.open("wb") as file:
        np.array([90, 90, 180], "<i4").tofile(file)
        np.full(3 * 90 * 90 * 180, 150.0).tofile(file)
    found = scene_of(ENVIRONMENT, f"material={{kind='merl',path='{path}'}}").material
    assert same(found, jvr.MerlBRDF.read(path))


def test_a_volume_keeps_the_gradients_that_a_material_asks_for():
    assert scene_of(ENVIRONMENT, "normals=precomputed").volume.gradients is not None
    assert scene_of(ENVIRONMENT, "normals=precomputed", "material={kind='phase',phase='isotropic'}").volume.gradients is None


@pytest.mark.parametrize(
    ("change", "key", "hint"),
    [
        ("environment=constnt", "environment", "did you mean 'constant'?"),
        ("environment={kind='constant',radiance=-1}", "environment.radiance", "not negative"),
        ("environment=['constant',{kind='disc',towards=[0,0,1]}]", "environment[1].half_angle", "missing"),
        ("environment={kind='disc',towards=[0,0,0],half_angle=5}", "environment.towards", "must have a direction"),
        ("environment={kind='disc',towards=[0,0,1],half_angle=0}", "environment.half_angle", "must be above 0 and at most 180"),
        ("environment={kind='disc',towards=[0,0,1],half_angle=5,order=11}", "environment.order", "from 0 to 10"),
        ("environment={kind='constant',rotation={axis=[0,0,0],degrees=9}}", "environment.rotation.axis", "must have a direction"),
        ("environment={kind='constant',rotation=90}", "environment.rotation", "table"),
        ("environment={kind='constant',scale=2}", "environment.scale", 'only kind = "image" has it'),
        ("environment=3", "environment", "or one of 'image', 'constant', 'disc', not 3"),
        ("environment={kind='image',path='sky.hdr'}", "environment.path", "$JVR_DATA"),
        ("environment={kind='image',pth='sky.hdr'}", "environment.pth", "did you mean 'path'?"),
        ("environment={kind='image',path='PROJECT'}", "environment.path", ".exr or .hdr"),
        ("material=lamber", "material", "did you mean 'lambert'?"),
        ("material={kind='lambert',reflectance=1.5}", "material.reflectance", "in [0, 1]"),
        ("material={kind='microfacet',roughness=0}", "material.roughness", "in [0.001, 1]"),
        ("material={kind='microfacet',shininess=3}", "material.shininess", "unknown key"),
        ("material={kind='phong',threshold=-1}", "material.threshold", "gradient"),
        ("material={kind='phase'}", "material.phase", "missing"),
        ("material={kind='phase',phase='rayliegh'}", "material.phase", "did you mean 'rayleigh'?"),
        ("material={kind='phase',phase={kind='jendersie-eon',diameter=4}}", "material.phase.diameter", "micrometres"),
        ("material={kind='merl',path='PROJECT'}", "material.path", "not a MERL BRDF"),
        ("material={positions=[0,1],materials=['lambert']}", "material.materials", "1 entries"),
        ("material={positions=[1,0],materials=['lambert','lambert']}", "material.positions", "increasing"),
        ("material={positions=[0,1],materials=['lambert','lamber']}", "material.materials[1]", "did you mean"),
        ("material={positions=[0],materials=[{kind='phong',exponent=-1}]}", "material.materials[0].exponent", "not negative"),
        (
            "material={positions=[0,1],materials=['lambert',{kind='lambert',threshold=1}]}",
            "material.materials",
            "threshold of the first",
        ),
        (
            "material={positions=[0,1],materials=['lambert',{kind='phase',phase='isotropic'}]}",
            "material",
            "no place beside surfaces",
        ),
        ("radiance_transfer={rays=0}", "radiance_transfer.rays", "at least 1"),
        ("radiance_transfer={order=11}", "radiance_transfer.order", "from 0 to 10"),
        ("radiance_transfer={resolution=0}", "radiance_transfer.resolution", "above 0"),
        ("radiance_transfer={resolution=2}", "radiance_transfer.resolution", "at most 1"),
        ("radiance_transfer={bleeding='transfr'}", "radiance_transfer.bleeding", "did you mean 'transfer'?"),
        ("radiance_transfer={chromaticity=1}", "radiance_transfer.chromaticity", "add bleeding"),
        ("radiance_transfer={chromaticity=4,bleeding='transfer'}", "radiance_transfer", "chromaticity"),
        ("radiance_transfer={scattering='marbel'}", "radiance_transfer.scattering", "marble"),
        ("radiance_transfer={scattering={sigma_s_prime=[1,1,1]}}", "radiance_transfer.scattering.sigma_a", "missing"),
        (
            "radiance_transfer={scattering={preset='skin1',eta=1.2}}",
            "radiance_transfer.scattering.preset",
            "excludes",
        ),
        ("radiance_transfer={scatering='skin1'}", "radiance_transfer.scatering", "did you mean 'scattering'?"),
        ("radiance_transfer={frozen='yes'}", "radiance_transfer.frozen", "true or false"),
    ],
)
def test_mistakes_about_environment_lighting_are_named(change, key, hint):
    line = refusal(build_scene, ENVIRONMENT, change.replace("PROJECT", str(Path(__file__).parents[2] / "pyproject.toml")))
    assert f"{key}: " in line
    assert hint in line


@pytest.mark.parametrize(
    ("sets", "key", "hint"),
    [
        (["environment=constant"], "environment", "add [material]"),
        (["material=lambert"], "material", "add [environment]"),
        (["radiance_transfer={}"], "radiance_transfer", "add [environment]"),
    ],
)
def test_parts_that_do_not_go_together_are_refused(sets, key, hint):
    line = refusal(build_scene, BASE, *sets)
    assert line.startswith(f"--set: {key}: ")
    assert hint in line


@pytest.mark.parametrize("name", ["cut.hdr", "square.exr", "cut.binary"])
def test_files_that_cannot_be_read_are_named(name, tmp_path):
    path = tmp_path / name
    if name == "square.exr":
        write_image(path, np.ones((4, 4, 3), np.float32))
    else:
        path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 8\n\x02")
    text = f"material={{kind='merl',path='{path}'}}" if name == "cut.binary" else f"environment={{kind='image',path='{path}'}}"
    line = refusal(build_scene, ENVIRONMENT, text)
    assert line.count(str(path)) == 1
    assert "path: " in line


# --- fits ------------------------------------------------------------------------------------------------------------

FIT = (
    ENVIRONMENT.replace("[transfer]", "[truth]").replace('kind = "window"', "PLAIN")
    + "[settings]\nstep = 8\n[camera]\nwidth = 3\nheight = 3\n"
)
FIT = FIT.replace("PLAIN", 'kind = "linear"\npositions = [0, 1]\nrgb = [[1, 1, 1], [1, 1, 1]]\nsigma_t = [0, 0.1]')
TRANSFER = "radiance_transfer={rays=4,resolution=0.1,scattering='skin1'}"


def job(unknowns, *sets, precompute=jvr.precompute):
    return build_fit(config(f"{FIT}[fit]\nunknowns = {unknowns}\n", *sets), precompute=precompute)


def asked_for(unknowns, *sets):
    """What of the scene that a fit starts from is computed beforehand, and with which keywords; and the fit."""
    calls = []

    def note(scene, **keywords):
        calls.append((scene, keywords))
        return scene

    found = job(unknowns, TRANSFER, *sets, precompute=note)
    scene, keywords = calls[0]
    return scene.radiance_transfer is not None, keywords["keep_material"], keywords["keep_unscattered"], found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("unknowns", "keep_material", "keep_unscattered", "keeps_radiance_transfer"),
    [
        (["environment.coefficients"], False, False, False),
        (["material.reflectance"], True, False, False),
        (["radiance_transfer.scattering.sigma_a", "environment.coefficients"], False, True, False),
        (["transfer.sigma_t"], False, False, True),
        (["volume.values", "material.reflectance"], True, False, True),
    ],
)
def test_a_fit_computes_beforehand_what_it_does_not_find(unknowns, keep_material, keep_unscattered, keeps_radiance_transfer):
    *asked, found = asked_for(unknowns)
    assert asked == [True, keep_material, keep_unscattered]
    assert found.keeps_radiance_transfer == keeps_radiance_transfer
    # Told to follow, it leaves to each picture what the unknowns change, and that alone.
    *asked, found = asked_for(unknowns, "radiance_transfer.frozen=false")
    assert asked == [not keeps_radiance_transfer, keep_material, keep_unscattered]
    assert not found.keeps_radiance_transfer
    assert found.scene.radiance_transfer is not None


@pytest.mark.slow
def test_radiance_transfer_with_the_materials_colour_is_that_of_the_start():
    """Kept for an unknown material as it is, and not announced as that of another."""
    found = job(["material.reflectance"], "radiance_transfer={rays=4,resolution=0.1,bleeding='material'}")
    assert found.keeps_radiance_transfer
    assert found.scene.radiance_transfer.is_frozen
    assert isinstance(found.scene.material, jvr.LambertBRDF)
    assert found.scene.radiance_transfer.stale(found.scene) == ()


@pytest.mark.slow
def test_a_fit_of_the_light_starts_from_another_environment(sky):
    """A table that names its kind replaces the whole: nothing of the image's keys is left."""
    start = "fit.initial={environment={kind='constant',order=2},material={reflectance=0.5}}"
    image = f"environment={{kind='image',path='{sky}'}}"
    found = job(["environment.coefficients"], image, "material={kind='lambert'}", start)
    assert same(found.scene.environment, jvr.EnvironmentLight.constant(order=2))
    assert same(found.scene.material, jax.jit(lambda m: m.projected(3))(jvr.LambertBRDF(0.5)))


@pytest.mark.slow
def test_a_white_furnace_is_white():
    """A matte white medium that hides its surroundings, under light of one from everywhere."""
    made = build_scene(config(ENVIRONMENT, "transfer={kind='linear',positions=[-1,2],rgb=[[1,1,1],[1,1,1]],sigma_t=[9,9]}"))
    camera = jvr.PerspectiveCamera.look_at((0.0, -200.0, 0.0), (0.0, 0.0, 0.0), (0, 0, 1), 5.0, 3, 3)
    picture = jvr.render(jvr.precompute(made), camera, jvr.Settings(1.0))
    assert math.isclose(float(jnp.max(jnp.abs(picture.rgb - 1))), 0, abs_tol=1e-3)


# --- configurations of the repository ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["natural_light.toml", "real/ct_head_natural.toml"])
def test_the_configurations_are_valid(name, request, monkeypatch):
    if name.startswith("real"):
        monkeypatch.setenv("JVR_DATA", str(request.getfixturevalue("data")))
    made = build_scene(read_config(Path(__file__).parents[2] / "configs" / name))
    assert made.radiance_transfer is not None
