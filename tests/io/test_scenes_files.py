"""Scenes as files: the same scene again to the last bit, text that a person can edit, and files that are damaged or meant to harm."""

import dataclasses
import functools
import hashlib
import io
import os
import re
import zipfile
from pathlib import Path
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from scenes import OBLIQUE, affine, gaussian_transfer, linear_transfer, lut_transfer, perspective, render, voxels

import jvr
from jvr.atomic import replacing_together
from jvr.effects.projected_radiance_transfer import ProjectedRadianceTransfer
from jvr.io.config import ConfigError, read_config
from jvr.io.scenes.kinds import PARTS, classes_of, fits
from jvr.names import NAMES

SHAPE = (5, 6, 7)
SUN = jvr.DirectionalLight((0.3, -0.5, -0.8), (1.5, 1.4, 1.2))


def by_value(low: float, high: float) -> jvr.ByValue:
    return jvr.ByValue([0.1, 0.9], [low, high])


def with_gaps() -> np.ndarray:
    values = voxels(SHAPE).astype(np.float32)
    values[1, 2:4, 3] = np.nan
    return values


def scene(volume=None, transfer=None, **parts) -> jvr.Scene:
    return jvr.Scene(volume or jvr.Volume(voxels(SHAPE), OBLIQUE), transfer or linear_transfer(), **parts)


def lit(volume=None, transfer=None, **parts) -> jvr.Scene:
    return scene(volume, transfer, **{"lights": [SUN], "shading": jvr.Lambert(0.2), **parts})


def natural(**parts) -> jvr.Scene:
    around = jvr.EnvironmentLight.disc((0.2, 0.3, 0.9), 40.0, (2.0, 1.5, 1.0), order=2)
    return scene(**{"environment": around, "material": jvr.LambertBRDF((0.9, 0.5, 0.3)), **parts})


def gradient_transfer() -> jvr.GradientTransfer:
    rng = np.random.default_rng(5)
    return jvr.GradientTransfer(rng.random((4, 3, 3)), rng.random((4, 3)), (0.1, 0.9), (0.0, 0.5))


def lights() -> jvr.Scene:
    every = [SUN, jvr.PointLight((1, 2, 3), attenuation=(1, 0.1, 0.01)), jvr.SpotLight((4.1, 5.2, 6.3), (0, 0, -1), 9.0)]
    every += [jvr.HeadLight(0.3), jvr.AmbientLight((0.1, 0.2, 0.3))]
    shading = jvr.BlinnPhong(0.1, by_value(0.2, 0.8), by_value(0, 0.5), by_value(1, 90), threshold=0.2, two_sided=False)
    return lit(lights=every, shading=shading, shadows=jvr.ShadowRays(2, termination=0.01))


def shells() -> jvr.Scene:
    return lit(shading=jvr.PhenomenologicalBSDF(0.4, by_value(0.1, 0.2), 0.3, 12.0, 7.0, 1.3, normalised=False, threshold=0.2))


def fibres() -> jvr.Scene:
    return lit(
        shading=jvr.AnisotropicGGX((0.3, 0.4, -1), 0.1, 0.5, jvr.ByGradient([0.1, 0.9], [0.2, 0.7]), 0.3, by_value(0.5, 1))
    )


def phases() -> jvr.Scene:
    every = [jvr.Isotropic(), jvr.Rayleigh(), jvr.HenyeyGreenstein((0.1, 0.2, -0.3)), jvr.Schlick(0.4), jvr.JendersieEon(12.0)]
    every += [
        jvr.DoubleHenyeyGreenstein(0.8, -0.2, 0.7),
        jvr.Draine(0.5, 1.5),
        jvr.TabulatedPhase(np.linspace(0, np.pi, 9), np.arange(9)),
    ]
    phase = jvr.Mixture([*every, jvr.Mixture(every[:2], [1, 2])], np.arange(1, 10))
    return scene(
        lights=[SUN], scattering=jvr.SingleScattering(phase, (0.9, 0.8, 0.7), threshold=0.3), shadows=jvr.DeepShadowMap(8, 3)
    )


def materials() -> jvr.Scene:
    rng = np.random.default_rng(7)
    every = [
        jvr.LambertBRDF(0.5),
        jvr.PhongBRDF(0.5, (0.1, 0.2, 0.3), 9),
        jvr.BlinnPhongBRDF(),
        jvr.MicrofacetBRDF(roughness=0.3),
    ]
    every += [jvr.MerlBRDF(rng.random((4, 3, 5, 3))), jvr.PhaseBRDF(jvr.HenyeyGreenstein(0.3), 0.8)]
    transfer = jvr.RadianceTransfer(2, 16, 0.5, bleeding=jvr.MaterialBleeding(), chromaticity=1, memory=1e8)
    return natural(material=jvr.MaterialByValue(np.arange(6.0), every), radiance_transfer=transfer)


def colours_and_scattering() -> jvr.RadianceTransfer:
    return jvr.RadianceTransfer(1, 8, 0.4, bleeding=jvr.TransferBleeding(), chromaticity=0, scattering=jvr.Dipole.preset("skin1"))


def frozen() -> jvr.Scene:
    """With numbers in place of what `jvr.precompute` takes seconds for."""
    transfer, numbers = colours_and_scattering(), np.random.default_rng(8).random((3, 3, 4, 10)).astype(np.float32)
    luminance, chroma, solid, facing = numbers[..., None, :4], numbers[..., 4:6, None], numbers[..., 6], numbers[..., 7:]
    made_for = np.arange(12, dtype=np.uint32).reshape(6, 2)
    arrays = map(jnp.asarray, (luminance, chroma, solid, facing))
    done = ProjectedRadianceTransfer(*arrays, lut_transfer(), jnp.asarray(made_for), scattered=True, pinned=True)
    return natural(radiance_transfer=transfer.with_projected(done))


def histograms() -> jvr.Scene:
    """With numbers in place of what `jvr.precompute` takes seconds for."""
    rng, made_for = np.random.default_rng(8), np.arange(12, dtype=np.uint32).reshape(6, 2)
    weights, codes = rng.random((7, 2, 5)).astype(np.float32), rng.integers(0, 7, (3, 3, 4, 6)).astype(np.uint16)
    arrays = map(jnp.asarray, (weights, codes, np.arange(5.0), np.array([1.0, 2.0]), 0.0, made_for))
    occlusion = jvr.HistogramOcclusion(5, resolution=0.4, bleeding=0.5).with_projected(jvr.LocalHistograms(*arrays, pinned=True))
    return lit(lights=[jvr.AmbientLight()], occlusion=occlusion)


def projected() -> jvr.Scene:
    parts = [jvr.HarmonicMaterial.project(brdf, 2, directions=4, nodes=8) for brdf in (jvr.PhongBRDF(), jvr.LambertBRDF(0.3))]
    return natural(material=jvr.MaterialByValue([0.2, 0.8], parts).projected(2))


def replaced() -> jvr.Scene:
    """Voxels, a light and an opacity that no constructor has seen."""
    volume = jvr.Volume(with_gaps(), affine((1, 1, 1), (4e5, 5e6, 10.25)), missing=-1.0)
    made = lit(volume, lights=[jvr.PointLight((4e5 + 0.1, 5e6 + 0.3, 20.7))])
    pick = lambda s: (s.volume.values, s.lights[0].position, s.transfer.sigma_t)
    values = jnp.asarray(voxels(SHAPE, 3), made.volume.values.dtype)
    return eqx.tree_at(pick, made, (values, made.lights[0].position + 1, 0.5 * made.transfer.sigma_t))


SCENES = {
    "plain": lambda: scene(background=(0.1, 0.2, 0.3)),
    "long table": lambda: scene(transfer=lut_transfer(n=300), optical=jvr.EmissionOnly()),
    "coloured": lambda: scene(transfer=gaussian_transfer(coloured=True), optical=jvr.AbsorptionOnly()),
    "labels": lambda: scene(jvr.Volume(np.arange(210).reshape(SHAPE) % 4 == 3, interpolation=jvr.Nearest())),
    "16 bits, missing": lambda: scene(
        jvr.Volume((300 * voxels(SHAPE)).astype(np.int16), slope=0.1, intercept=-20, missing=7, unit='H"U\\ µ\n')
    ),
    "32 bits": lambda: scene(jvr.Volume((1e6 * voxels(SHAPE)).astype(np.uint32))),
    "bfloat16": lambda: scene(jvr.Volume(jnp.asarray(voxels(SHAPE), jnp.bfloat16))),
    "float16, NaN": lambda: scene(
        jvr.Volume(with_gaps().astype(np.float16)), gradient_transfer(), normals=jvr.CentralDifferences()
    ),
    "in the world": lambda: scene(
        jvr.Volume(with_gaps(), affine((0.1, 0.1, 0.2), (448262.133, 5411932.678, 112.341), (0.1, 0.2, 0.3))),
        clipping=jvr.ClippingBox((448262.4, 5411932.9, -np.inf), (448262.9, 5411933.7, np.inf)),
    ),
    "cut open": lambda: scene(
        jvr.Volume(with_gaps(), interpolation=jvr.Tricubic()).graded_by_sobel(),
        jvr.LutTransfer(np.eye(3), [0.0, 1, 2], [0.0, 1.0], 0.1 * np.eye(3)),
        clipping=(
            jvr.ClippingPlane((448262.4, 0.5, 1), (1, -2, 0.5)),
            jvr.ClippingBox((-1, -1, -1), (1, 2, 3), world_from_box=OBLIQUE),
        ),
        normals=jvr.PrecomputedGradient(sobel=True),
    ),
    "replaced": replaced,
    "traced": lambda: jax.jit(lambda values: scene(jvr.Volume(values, OBLIQUE)))(with_gaps()),
    "lights": lights,
    "shells": shells,
    "fibres": fibres,
    "phases": phases,
    "gradient opacity": lambda: lit(
        transfer=jvr.GradientOpacity(linear_transfer(coloured=True), 0.1, 0.7),
        shading=jvr.Phong(shininess=4),
        normals=jvr.SobelDifferences(),
        shadows=jvr.ShadowVolume(0.5),
    ),
    "map": lambda: lit(shadows=jvr.ShadowMap(8, softness=0, bias=0.5), normals=jvr.ForwardDifferences()),
    "opacity map": lambda: lit(shadows=jvr.OpacityShadowMap(8, 4), normals=jvr.PrecomputedGradient(of_opacity=True)),
    "by value": lambda: scene(
        lights=[SUN], scattering=jvr.SingleScattering(jvr.HenyeyGreenstein(by_value(-0.2, 0.7)), by_value(0.3, 0.9))
    ),
    "kept": lambda: lit(jvr.Volume(voxels(SHAPE)).bricked(3).graded(), normals=jvr.PrecomputedGradient()),
    "packed": lambda: scene(jvr.Volume(voxels(SHAPE), missing=3.0).packed().bricked()),
    "natural": lambda: natural(radiance_transfer=jvr.RadianceTransfer(exact=True)),
    "occluded": lambda: lit(lights=[jvr.AmbientLight()], occlusion=jvr.LocalOcclusion(8, radius=2, samples=3, bias=0.1)),
    "histograms": histograms,
    "hollows": lambda: lit(
        lights=[jvr.AmbientLight()],
        surfaces=jvr.Isosurfaces([0.4], [[0.9, 0.5, 0.2]]),
        occlusion=jvr.SurfaceOcclusion(8, 5, factor=2.0, tilt=0.2, cosine=True, softness=0.3),
    ),
    "in-scattering": lambda: lit(shadows=jvr.InScattering(8, radius=2, bias=0.1, direct=jvr.PiecewiseShadows(3, 0.5))),
    "glass": lambda: scene(
        transfer=jvr.ClearTransfer(),
        surfaces=jvr.Isosurfaces((0.4, 0.6), voxels((2, 3)), (0.3, 1.0)),
        specular=jvr.Specular([0.2, 0.7], 1.4, order=1),
    ),
    "isosurfaces": lambda: lit(surfaces=jvr.Isosurfaces((0.4, 0.6), voxels((2, 3)), (0.3, 1.0), band=0.2, step=0.5, most=2)),
    "negative": lambda: natural(environment=jvr.EnvironmentLight(-0.0 * np.ones((4, 3)), clamped=False)),
    "seen": lambda: natural(environment=(sky := jvr.EnvironmentMap(voxels((4, 8, 3)), order=2)), background=sky),
    "geometry": lambda: scene(geometry=jvr.DepthImage(np.where(voxels((3, 4)) < 0.5, np.inf, 2.0), voxels((3, 4, 3)))),
    "mesh": lambda: scene(geometry=jvr.Mesh(voxels((4, 3)), [[0, 1, 2], [1, 2, 3]], voxels((4, 3)))),
    "materials": materials,
    "projected": projected,
    "frozen": frozen,
    "computed": lambda: jvr.precompute(natural(radiance_transfer=colours_and_scattering())),
}


def slow(*names: str) -> list:
    return [pytest.param(name, marks=pytest.mark.slow) for name in names]


@functools.cache
def _example(name: str, dtype: str) -> jvr.Scene:
    return SCENES[name]()


def example(name: str) -> jvr.Scene:
    """One of the scenes, in the precision of the moment; made once."""
    return _example(name, str(jnp.result_type(float)))


def bits(tree) -> list:
    """Every array of a tree: where it is, its type, shape and bytes."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return [(jax.tree_util.keystr(p), str(x.dtype), x.shape, np.asarray(x).tobytes()) for p, x in leaves]


def check_same(found, expected):
    assert bits(found) == bits(expected)
    assert jax.tree.structure(found) == jax.tree.structure(expected)


def again(scene, folder: Path, name: str = "a.toml") -> jvr.Scene:
    jvr.save_scene(scene, folder / name)
    return jvr.load_scene(folder / name)


@pytest.mark.parametrize("name", [name for name in SCENES if name != "computed"])
def test_a_scene_comes_back_to_the_last_bit(tmp_path, name):
    expected = example(name)
    check_same(again(expected, tmp_path), expected)


@pytest.mark.parametrize("name", ["lights", "in the world", "phases", "bfloat16", "replaced", "kept"])
def test_a_scene_in_double_precision_comes_back_to_the_last_bit(tmp_path, x64, name):
    expected = example(name)
    assert expected.volume.world_from_grid.dtype == jnp.float64
    check_same(again(expected, tmp_path), expected)


@pytest.mark.parametrize("name", ["lights", "float16, NaN", "in the world"])
def test_a_scene_in_single_precision_is_the_same_where_double_is_enabled(tmp_path, name):
    """What a constructor computes, as of voxels beside gaps, is not what it computes there."""
    expected = example(name)
    jvr.save_scene(expected, tmp_path / "a.toml")
    with jax.enable_x64(True):
        check_same(jvr.load_scene(tmp_path / "a.toml"), expected)


def public_parts() -> set[str]:
    """The public names of classes that can be somewhere in a scene, found by what fields take."""
    public = {name: getattr(jvr, name) for names in NAMES.values() for name in names if name[0].isupper()}
    classes = {name: found for name, found in public.items() if isinstance(found, type) and issubclass(found, eqx.Module)}
    takes, new = set(), {jvr.Scene}
    while new:
        takes |= new
        inside = {name for name in classes.values() if issubclass(name, tuple(takes))} | takes
        fields = [f for cls in inside for f in (dataclasses.fields(cls) if dataclasses.is_dataclass(cls) else ())]
        new = {found for f in fields for found in classes_of(f.type)} - takes
    # A coefficient by value and a dipole stand where a field takes anything.
    return {name for name, found in classes.items() if issubclass(found, tuple(takes))} | {"ByGradient", "ByValue", "Dipole"}


def parts_of(tree) -> set[str]:
    found = set()

    def note(part):
        if isinstance(part, eqx.Module):
            found.add(type(part).__name__)
            for inner in vars(part).values():
                note(inner)
        elif isinstance(part, tuple):
            for inner in part:
                note(inner)

    note(tree)
    return found


def test_every_public_part_of_a_scene_is_in_these_scenes():
    """So that a class that is added has to be written: a scene with it belongs into `SCENES`."""
    wanted = public_parts()
    assert len(wanted) >= 55
    assert wanted <= set(PARTS)
    assert wanted - set().union(*(parts_of(example(name)) for name in SCENES if name != "computed")) == set()


@pytest.mark.parametrize("name", ["16 bits, missing", *slow("lights", "phases", "computed")])
def test_pictures_of_the_loaded_scene_are_the_same(tmp_path, name):
    expected = example(name)
    found = again(expected, tmp_path)
    check_same(found, expected)
    camera = perspective(expected.volume, 4, 3)
    pictures = [render(s, camera, jvr.Settings(0.7)) for s in (found, expected)]
    assert float(pictures[1].alpha.max()) > 0.05
    np.testing.assert_array_equal(pictures[0].rgb, pictures[1].rgb)


def test_what_was_kept_of_voxels_is_known_to_be_theirs(tmp_path):
    found = again(example("kept"), tmp_path).volume
    assert found.bricks.size == 3
    assert found.current() is found


def test_the_text_can_be_read(tmp_path):
    made = lit(
        jvr.Volume(np.zeros(SHAPE, np.uint8), unit="HU").bricked(),
        jvr.LinearTransfer([0, 0.1], [[0, 0, 0], [1, 0.5, 0.25]], [0, 0.3]),
        background=(0, 0.1, 1),
        shadows=jvr.ShadowRays(),
        scattering=jvr.SingleScattering(jvr.HenyeyGreenstein(0.6)),
        clipping=jvr.ClippingBox((0, 0, 0), (1, 2, 3)),
    )
    jvr.save_scene(made, tmp_path / "head.toml")
    text = (tmp_path / "head.toml").read_text()
    assert re.sub(r'checksum = "[0-9a-f]{64}"', 'checksum = ""', text) == EXAMPLE


EXAMPLE = """\
# A scene of jvr, for jvr.load_scene. Numbers may be edited; long arrays are in head.npz, which belongs to this file.
format = 1
precision = "float32"
checksum = ""
background = [0.0, 0.1, 1.0]
optical = "EmissionAbsorption"

[volume]
values = { array = "volume.values", dtype = "uint8" }
world_from_grid = [
  [1.0, 0.0, 0.0, 0.0],
  [0.0, 1.0, 0.0, 0.0],
  [0.0, 0.0, 1.0, 0.0],
  [0.0, 0.0, 0.0, 1.0],
]
slope = 1.0
intercept = 0.0
interpolation = "Trilinear"
bricks = { size = 4 }
unit = "HU"

[transfer]
kind = "LinearTransfer"
positions = [0.0, 0.1]
rgb = [
  [0.0, 0.0, 0.0],
  [1.0, 0.5, 0.25],
]
sigma_t = [0.0, 0.3]

[clipping]
lower = [0.0, 0.0, 0.0]
upper = [1.0, 2.0, 3.0]

[[lights]]
kind = "DirectionalLight"
direction = [0.3, -0.5, -0.8]
irradiance = [1.5, 1.4, 1.2]

[shading]
kind = "Lambert"
ambient = 0.2
diffuse = 1.0
threshold = 0.0
two_sided = true

[shadows]
kind = "ShadowRays"
step = 1.0
termination = 0.001

[scattering]
kind = "SingleScattering"
albedo = 1.0

[scattering.phase]
kind = "HenyeyGreenstein"
g = 0.6

[normals]
kind = "AnalyticGradient"
of_opacity = false
"""


# --- Edited, damaged and hostile -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("saved")
    jvr.save_scene(phases(), folder / "a.toml")
    return folder


@pytest.fixture
def files(saved, tmp_path) -> Path:
    """The text of a scene, to be changed, with its arrays beside it."""
    for name in ("a.toml", "a.npz"):
        (tmp_path / name).write_bytes((saved / name).read_bytes())
    return tmp_path / "a.toml"


def edit(path: Path, old: str, new: str) -> None:
    text, count = re.subn(old, lambda _: new, path.read_text(), count=1, flags=re.M)
    assert count == 1, old
    path.write_text(text)


def refusal(path: Path) -> str:
    with pytest.raises(ValueError, match=f"^{re.escape(str(path.with_suffix('')))}") as caught:
        jvr.load_scene(path)
    message = str(caught.value)
    assert "\n" not in message
    return message.replace(f"{path.parent}/", "")


def test_numbers_and_kinds_can_be_edited(files):
    edit(files, r"^albedo = .*", "albedo = [0.25, 0.5, 1]")
    edit(files, r"^k = .*", "k = { kind = 'ByValue', positions = [0, 1], values = [0.1, 0.2] }")
    found = jvr.load_scene(files).scattering
    np.testing.assert_array_equal(found.albedo, np.float32([0.25, 0.5, 1]))
    np.testing.assert_array_equal(found.phase.phases[3].k.values, np.float32([0.1, 0.2]))


def test_what_is_left_out_has_the_default_of_its_class(files):
    edit(files, r"^albedo = .*", "")
    edit(files, r"^threshold = .*", "")
    found = jvr.load_scene(files).scattering
    assert float(found.albedo) == 1
    assert found.threshold is None


EDITS = [
    (r"^format = 1", "format = 2", "a.toml: format: is 2, and this jvr reads 1: a newer one may have written the file"),
    (r"^format = 1", "", "a.toml: format: missing: this is no scene that jvr.save_scene wrote"),
    (r"^precision = .*", 'precision = "int8"', 'a.toml: precision: must be "float32" or "float64"'),
    (r"^precision = .*", 'precision = "float64"', "a.toml: precision: float64 needs double precision: call jax.config.update"),
    (r"^checksum = .*", 'checksum = "00"', "a.toml: checksum: a.npz belongs to another scene, or is damaged"),
    (r"^albedo = .*", "albedo = [0.9, 0.8, 1.7]", "a.toml: scattering: albedo must be in [0, 1]"),
    (r"^albedo = .*", "albedo = [[1], [1, 2]]", "a.toml: scattering.albedo: its rows have different lengths"),
    (r"^albedo = .*", 'albedo = ["1", "1", "1"]', "a.toml: scattering.albedo: must be a number or a list of numbers"),
    (r"^albedo = .*", "albedo = true", "a.toml: scattering.albedo: must be a number or a list of numbers, not true"),
    (r"^albedo = .*", "albedo = 1e999999", "a.toml: scattering: albedo must be in [0, 1]"),
    (r"^albedo = .*", f"albedo = 1{'0' * 400}", "a.toml: scattering.albedo: int too large to convert to float"),
    (r"^albedo = .*", "albdo = 1", "a.toml: scattering.albdo: unknown key; did you mean 'albedo'?"),
    (r"^positions = .*", "", "a.toml: transfer.positions: missing; this key is needed here"),
    (r"^layers = .*", "layers = 0", "a.toml: shadows: layers must be a whole number of at least 1 (pieces"),
    (r"^layers = .*", "layers = 1.5", "a.toml: shadows.layers: is 1.5; it must be a whole number"),
    (r'^kind = "LinearTransfer"', 'kind = "LinearTransferr"', "; did you mean 'LinearTransfer'?"),
    (r'^kind = "LinearTransfer"', 'kind = "ShadowRays"', 'a.toml: transfer.kind: unknown choice "ShadowRays"; known: Gradient'),
    (r'^kind = "LinearTransfer"', 'kind = "os.system"', 'a.toml: transfer.kind: unknown choice "os.system"; known: '),
    (r'^kind = "LinearTransfer"', 'kind = "FitResult"', 'a.toml: transfer.kind: unknown choice "FitResult"; known: '),
    (r'^kind = "LinearTransfer"', 'kind = ["a"]', "a.toml: transfer.kind: unknown choice ['a']; known: "),
    (r'^kind = "LinearTransfer"', "", "a.toml: transfer.kind: missing; it says what this table describes: "),
    (r'^interpolation = .*', "interpolation = 3", "a.toml: volume.interpolation: is 3; it must be one of Nearest, Tricubic, Trilinear"),
    (r'^optical = .*', 'optical = "None"', "a.toml: optical: cannot be absent; it must be one of AbsorptionOnly, "),
    (r'"volume\.values"', '"../../etc/passwd"', 'there is no array the text "../../etc/passwd" in a.npz; known: volume.values'),
    (r'"volume\.values"', '["a"]', "a.toml: volume.values: an array beside the text has two keys, array and dtype"),
    (r'dtype = "float32"', 'dtype = "object"', 'a.toml: volume.values.dtype: the text "object" is no type of numbers'),
    (r'dtype = "float32"', 'dtype = "O"', 'a.toml: volume.values.dtype: the text "O" is no type of numbers'),
    (r'dtype = "float32"', 'dtype = "int32"', "a.toml: volume.values: its array in a.npz holds float32, not int32"),
    (r'dtype = "float32"', 'dtype = "complex64"', "a.toml: volume.values: its array in a.npz holds float32, not complex64"),
    (r"^\[volume\]", "[volume]\nbricks = { size = 0 }", "a.toml: volume.bricks: the size of a brick must be a positive whole number"),
    (r"^\[volume\]", "[volume]\nbricks = { length = 4 }", "a.toml: volume.bricks: "),
    (r"^\[volume\]", "[volume]\nsquares = 4", "a.toml: volume.squares: must be a table of numbers, not 4"),
    (r"^\[volume\]", "[transfer.transfer]\n[volume]", "a.toml: transfer.transfer: unknown key"),
    (r"^\[volume\]", "[lights]\n[volume]", "a.toml: not valid TOML"),
    (r"^\[volume\]", f"a = {'[' * 5000}\n[volume]", "a.toml: not valid TOML"),
    (r"^\[volume\]", f"[clipping{'.lower' * 5000}]\n[volume]", "a.toml: "),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "expected"), EDITS, ids=[expected[:60] for *_, expected in EDITS])
def test_a_wrong_edit_is_one_line_with_file_and_key(files, old, new, expected):
    edit(files, old, new)
    assert expected in refusal(files)


def test_tables_without_an_end(files):
    deep = "".join(f"[transfer{'.transfer' * n}]\nkind = 'GradientOpacity'\n" for n in range(600))
    text = files.read_text()
    start, end = text.index("[transfer]"), text.index("\n[[lights]]")
    files.write_text(text[:start] + deep + text[end:])
    assert refusal(files) == "a.toml: its tables are nested too deeply"


def test_both_files_belong_together(files, tmp_path):
    other = tmp_path / "b.toml"
    jvr.save_scene(scene(jvr.Volume(np.ones(SHAPE, np.float32))), other)
    first = files.with_suffix(".npz").read_bytes()
    files.with_suffix(".npz").write_bytes(other.with_suffix(".npz").read_bytes())
    assert refusal(files).startswith("a.toml: checksum: a.npz belongs to another scene")
    files.with_suffix(".npz").write_bytes(first[:-100])
    assert refusal(files).startswith("a.toml: checksum: a.npz belongs to another scene, or is damaged")
    files.with_suffix(".npz").unlink()
    assert refusal(files) == "a.toml: its arrays are in a.npz, which is not there: copy or rename both together"
    # Under another name they still do.
    other.rename(tmp_path / "c.toml")
    other.with_suffix(".npz").rename(tmp_path / "c.npz")
    assert float(jvr.load_scene(tmp_path / "c.toml").volume.values.mean()) == 1


class Harmful:
    """Whoever unpickles this makes a folder."""

    def __reduce__(self):
        return os.mkdir, ("harmed",)


def with_archive(path: Path, archive: bytes) -> Path:
    """A scene whose author knows how checksums are made."""
    path.with_suffix(".npz").write_bytes(archive)
    edit(path, r'checksum = ".*"', f'checksum = "{hashlib.sha256(archive).hexdigest()}"')
    return path


def archive_of(save=np.savez, **arrays) -> bytes:
    file = io.BytesIO()
    save(file, **arrays)
    return file.getvalue()


def test_nothing_in_an_archive_is_run_or_grows(files, monkeypatch):
    monkeypatch.chdir(files.parent)
    name = "volume.values"
    pickled = archive_of(**{name: np.array([[[Harmful()]]], object)})
    assert "holds object, not float32" in refusal(with_archive(files, pickled))
    assert not Path("harmed").exists()
    zeros = np.zeros((256, 256, 64), np.float32)
    assert "is compressed, as jvr.save_scene never does" in refusal(
        with_archive(files, archive_of(np.savez_compressed, **{name: zeros}))
    )
    announced = io.BytesIO()
    np.lib.format.write_array_header_1_0(announced, {"descr": "<f4", "fortran_order": False, "shape": (40000, 40000, 1)})
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr(f"{name}.npy", announced.getvalue())
    assert "the header announces 40000 x 40000 x 1 voxels" in refusal(with_archive(files, archive.getvalue()))
    assert "a.npz is damaged: " in refusal(with_archive(files, b"PK nothing"))


def test_shapes_and_types_are_checked_where_no_constructor_does(tmp_path):
    path = tmp_path / "a.toml"
    jvr.save_scene(projected(), path)
    text = path.read_text()
    path.write_text(text.replace('symmetry_axis = "both"', 'symmetry_axis = "nothing"'))
    assert 'material.tinted.symmetry_axis: is the text "nothing"; it must be "normal" or "eye" or "both"' in refusal(path)
    path.write_text(re.sub(r"(tinted\]\ncoefficients = ).*", r"\1[1, 2]", text, count=1))
    assert refusal(path).startswith("a.toml: material.tinted")


FITS = [
    (jnp.ones((2, 3)), Float[Array, "n 3"], True),
    (jnp.ones((2, 4)), Float[Array, "n 3"], False),
    (jnp.ones((2, 3), int), Float[Array, "n 3"], False),
    (jnp.ones(3), Float[Array, "n 3"] | None, False),
    (None, Float[Array, "n 3"] | None, True),
    (2, float, True),
    (True, float, False),
    (True, int, False),
    (2.0, int, False),
    ("eye", Literal["eye", "both"], True),
    ("nose", Literal["eye", "both"], False),
    ((SUN, SUN), tuple[jvr.DirectionalLight | jvr.HeadLight, ...], True),
    ((SUN, 3), tuple[jvr.DirectionalLight | jvr.HeadLight, ...], False),
    ((SUN,), tuple[jvr.DirectionalLight, jvr.DirectionalLight], False),
    (SUN, jvr.HeadLight, False),
]


def test_what_fields_take():
    """Where no constructor looks; in these tests a checker of types is before it."""
    assert [fits(value, annotation) for value, annotation, _ in FITS] == [expected for *_, expected in FITS]


def test_a_scene_in_double_precision_says_what_it_needs(tmp_path):
    with jax.enable_x64(True):
        jvr.save_scene(scene(), tmp_path / "a.toml")
    assert 'float64 needs double precision: call jax.config.update("jax_enable_x64", True) first' in refusal(tmp_path / "a.toml")


def test_configurations_and_scenes_are_told_apart(files, tmp_path):
    with pytest.raises(ConfigError, match=r"this is a scene, which jvr\.load_scene reads in Python, and no configuration"):
        read_config(files)
    (tmp_path / "config.toml").write_text('[volume]\nbuiltin = "demo"\n')
    assert "`jvr render` reads configurations" in refusal(tmp_path / "config.toml")
    with pytest.raises(FileNotFoundError, match=r"b\.toml: no such file; did you mean 'a\.toml'"):
        jvr.load_scene(tmp_path / "b.toml")
    with pytest.raises(ValueError, match=r"a\.npz: the name of a scene file ends in \.toml"):
        jvr.load_scene(tmp_path / "a.npz")


# --- What cannot be saved, and files as they were --------------------------------------------------------------------


class OwnTransfer(jvr.LinearTransfer):
    """A class of a user."""


def test_what_cannot_be_saved_says_what_to_do(tmp_path):
    own = OwnTransfer([0, 1], [[0, 0, 0], [1, 1, 1]], [0, 1])
    path = tmp_path / "a.toml"
    with pytest.raises(
        TypeError, match=r"^transfer is a test_scenes_files\.OwnTransfer, none of jvr's own classes.*put yours back"
    ):
        jvr.save_scene(scene(transfer=own), path)
    with pytest.raises(TypeError, match=r"^save_scene needs concrete arrays: call it outside of jax\.jit and jax\.grad"):
        jax.jit(lambda s: jvr.save_scene(s, path))(scene())
    with pytest.raises(TypeError, match="Scene"):
        jvr.save_scene(scene().volume, path)
    refused = eqx.tree_at(lambda s: s.transfer.positions, scene(), jnp.array([0.5, 0.2, 0.6, 0.85]))
    with pytest.raises(ValueError, match=r"a\.toml: transfer: positions must be strictly increasing"):
        jvr.save_scene(refused, path)
    assert list(tmp_path.iterdir()) == []


def test_both_files_are_replaced_or_none(files, monkeypatch):
    before = {path: path.read_bytes() for path in files.parent.iterdir()}
    replace, failing = os.replace, []

    def full(source, target):
        if Path(target).name in failing:
            failing.clear()
            raise OSError(28, "No space left on device")
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    for name in ("a.toml", "a.npz"):
        failing.append(name)
        with pytest.raises(OSError, match="cannot be written: No space left on device"):
            jvr.save_scene(scene(), files)
        assert not failing
        assert {path: path.read_bytes() for path in files.parent.iterdir()} == before
    monkeypatch.undo()
    jvr.save_scene(scene(), files)
    assert len(list(files.parent.iterdir())) == 2
    check_same(jvr.load_scene(files), scene())


def test_files_that_belong_together_go_together_where_there_were_none(tmp_path):
    def write():
        with replacing_together(tmp_path / "a", tmp_path / "b") as files:
            for path in files:
                path.write_text("new")
            (tmp_path / "a").mkdir()

    with pytest.raises(IsADirectoryError):
        write()
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").is_dir()


def test_saving_twice_gives_the_same_files(tmp_path):
    for name in ("a", "b"):
        jvr.save_scene(lights(), tmp_path / f"{name}.toml")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert (tmp_path / "a.toml").read_text() == (tmp_path / "b.toml").read_text().replace("b.npz", "a.npz")
