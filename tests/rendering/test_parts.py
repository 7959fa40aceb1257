"""Parts: what `plan`, `advise` and `tune` ask of them, none of which knows one by name."""

import ast
import dataclasses
from pathlib import Path

import pytest
from scenes import OBLIQUE, linear_transfer, voxels

import jvr
from jvr.model.parts import Knob, multiples, parts_of, with_part

LOOPS = [Path(jvr.__file__).parent / "rendering" / f"{name}.py" for name in ("plan", "advise", "tune", "foretelling")]
# The parts that have knobs, each as coarse as it makes sense to begin with.
PARTS = {
    "shadows": (
        jvr.ShadowRays(2.0),
        jvr.ShadowVolume(2.0),
        jvr.ShadowMap(2),
        jvr.OpacityShadowMap(2, 1),
        jvr.DeepShadowMap(3, 2, error=0.02),
        jvr.PiecewiseShadows(2, 0.25),
        jvr.InScattering(),
    ),
    "normals": (jvr.AnalyticGradient(), jvr.CentralDifferences(True), jvr.SobelDifferences(), jvr.PrecomputedGradient()),
    "occlusion": (jvr.LocalOcclusion(), jvr.HistogramOcclusion(2, 3, resolution=1.0)),
    "radiance_transfer": (
        jvr.RadianceTransfer(0, 1),
        jvr.RadianceTransfer(10, 8, 0.8, exact=True, bleeding=jvr.TransferBleeding(), chromaticity=10),
    ),
}
HELD = [(field, part) for field, parts in PARTS.items() for part in parts]


def scene(**parts):
    lit = {"lights": (jvr.DirectionalLight((1.0, 0.0, 0.0)), jvr.AmbientLight()), "shading": jvr.Lambert()}
    around = {"environment": jvr.EnvironmentLight.constant(1.0, order=1), "material": jvr.LambertBRDF()}
    return jvr.Scene(jvr.Volume(voxels(), OBLIQUE), **({"transfer": linear_transfer()} | lit | around | parts))


@pytest.mark.parametrize("path", LOOPS, ids=lambda path: path.stem)
def test_no_part_is_known_by_name(path):
    """Neither by its class nor by the field of a scene that it is in."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    read = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not read & {field.name for field in dataclasses.fields(jvr.Scene)}
    allowed = {"jvr.model.camera", "jvr.model.parts", "jvr.model.scene"}
    assert {name for name in imported if name.startswith(("jvr.model", "jvr.march", "jvr.effects"))} <= allowed


@pytest.mark.parametrize(("field", "part"), HELD, ids=lambda x: type(x).__name__ if not isinstance(x, str) else "")
def test_every_value_of_a_knob_makes_a_scene(field, part):
    """In range of the constructor, the coarsest first, the part's own among them, and none finer than the reference."""
    held = scene(**{field: part})
    name = field.replace("_", " ")
    for knob in part.knobs(held):
        assert len(set(knob.values)) == len(knob.values)
        for value in (*knob.values, knob.reference):
            turned = with_part(held, name, part.turned(knob.name, value))
            assert dict(parts_of(turned))[name] == part.turned(knob.name, value)
        own = getattr(part, knob.name, part)
        # What is left to the part is among the values as what it comes to.
        if own is not None:
            assert own in knob.values
            assert part.turned(knob.name, own) == part
        assert knob.coarser(knob.values[0]) is None
    for notch in part.coarser(held):
        assert notch != part
        with_part(held, name, notch)


def test_settings_have_knobs_that_fit_the_scene():
    turned = {knob.name: knob.values for knob in jvr.Settings().knobs(scene())}
    assert turned["quadrature"] == (jvr.Midpoint(), jvr.PreIntegrated())
    assert turned["step"][0] > turned["step"][-1]
    gaussian = jvr.GaussianTransfer([0.5], [0.1], [1.0], [[1.0, 1.0, 1.0]])
    turned = {knob.name: knob.values for knob in jvr.Settings().knobs(scene(transfer=gaussian, optical=jvr.EmissionOnly()))}
    assert turned["quadrature"] == (jvr.Midpoint(),)
    # Nothing ends a ray where nothing absorbs.
    assert "termination" not in turned


def test_multiples_stay_in_range():
    assert multiples("n", 3, (1 / 4, 1 / 2, 1), 4, least=2) == Knob("n", (2, 3), 12)
    knob = multiples("x", 0.5, (1 / 2, 1, 2, 4), 8, most=1.0)
    assert knob == Knob("x", (0.25, 0.5, 1.0), 1.0)
    assert [knob.coarser(v) for v in (0.25, 0.5, 0.3)] == [None, 0.25, 0.25]


def test_what_cannot_be_alone_goes_along():
    lit = scene(shadows=jvr.ShadowVolume())
    assert lit.replaced(shading=None).shadows is None
    assert lit.replaced(lights=lit.lights[1:]).shadows is None
    assert lit.replaced(lights=lit.lights[:1]).shadows is not None
    dark = scene(radiance_transfer=jvr.RadianceTransfer()).replaced(environment=None)
    assert (dark.material, dark.radiance_transfer) == (None, None)
    with pytest.raises(ValueError, match="no shadows to replace"):
        with_part(scene(), "shadows", jvr.ShadowVolume())
