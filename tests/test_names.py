"""Public names: whatever has been one is one, or says what it is called."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import linear_transfer, voxels

import jvr
from jvr.model.transfer import Classified

# Each with what is public in it: names that users of a version may have written down.
KNOWN = dict(
    (line.split()[0], line.split()[1:]) for line in (Path(__file__).parent / "public_names.txt").read_text().splitlines()
)


def missing(name):
    thing = getattr(jvr, name)
    fields = {f.name for f in dataclasses.fields(thing)} if dataclasses.is_dataclass(thing) else set()
    return [member for member in KNOWN[name] if member not in fields and not hasattr(thing, member)]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_what_was_public_is_public():
    assert {name: missing(name) for name in KNOWN if missing(name)} == {}


ONE = jnp.ones(())
Z = (0 * ONE, 0 * ONE, ONE)
LIGHT = jvr.PointLight((1.0, 2.0, 3.0), 5.0)
ENVIRONMENT = {"environment": jvr.EnvironmentLight.constant(), "material": jvr.LambertBRDF()}
SCENE = jvr.Scene(jvr.Volume(voxels()), linear_transfer(), **ENVIRONMENT, radiance_transfer=jvr.RadianceTransfer(1, 4))
MEDIUM = Classified((0.5 * ONE, 0.4 * ONE, 0.3 * ONE), (2 * ONE,))


@pytest.mark.parametrize(
    ("part", "before", "name", "arguments"),
    [
        (jvr.EmissionOnly(), "segment", "evaluate_segment", (MEDIUM, ONE)),
        (LIGHT, "arrives", "sample", (Z, Z)),
        (jvr.Lambert(0.25), "ambient_share", "ambient_reflectance", ()),
        (jvr.Lambert(threshold=0.5), "surface_share", "surface_weight", (ONE,)),
        (jvr.Phong(), "gloss", "specular_lobe", (Z, Z, Z)),
        (jvr.SingleScattering(threshold=0.5), "share", "medium_weight", (ONE,)),
        (jvr.LambertBRDF(), "about", "symmetry_axis", None),
        (jvr.CentralDifferences(), "prepared", "with_gradients", (SCENE.volume, SCENE.transfer)),
        (jvr.ShadowRays(), "prepared", "visibility", None),
        (SCENE.radiance_transfer, "outdated", "stale", (SCENE,)),
        (SCENE.radiance_transfer, "made_for", "cache_key", (SCENE,)),
        (jvr.Softplus(), "reach", "trust_radius", (np.zeros(2),)),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_has_another_name_warns_and_works(part, before, name, arguments):
    said = rf"{type(part).__name__}\.{before} is called {name}; the next release knows that name alone"
    with pytest.warns(DeprecationWarning, match=said):
        found = getattr(part, before)
    wanted = getattr(part, name)
    if arguments is None:
        assert found == wanted
    else:
        for a, b in zip(*(jax.tree.leaves(call(*arguments)) for call in (found, wanted)), strict=True):
            np.testing.assert_array_equal(a, b)
