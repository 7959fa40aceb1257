"""Shadows that isosurfaces cast: of exact size on each other, and on the medium by their opacity."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import render

import jvr
from jvr.march.first_hit import passed
from jvr.march.steps import Rays
from jvr.rendering.medium import bricks

SIDE = 24
MIDDLE, RADIUS, FLOOR = np.array([12.0, 12.0, 14.0]), 4.0, 3.0
SUN = jvr.DirectionalLight([0.5, 0.0, -1.0])


def ball_over_floor():
    """Above zero in a ball and below a floor: distances from both."""
    at = np.indices((SIDE, SIDE, SIDE)).astype(float)
    return jvr.Volume(np.maximum(RADIUS - np.linalg.norm(at - MIDDLE[:, None, None, None], axis=0), FLOOR - at[2]))


def clear():
    return jvr.LinearTransfer([-30.0, 30.0], np.zeros((2, 3)), [0.0, 0.0])


@pytest.mark.slow
@pytest.mark.parametrize("method", [jvr.ShadowRays(), jvr.ShadowVolume()], ids=["rays", "volume"])
def test_the_umbra_of_a_ball_is_an_ellipse_and_no_surface_shades_itself(method):
    """Beyond the umbra, and on the lit half of the ball, all is as without shadows, whichever method those of the medium have."""
    volume, n = ball_over_floor(), 46
    surfaces = jvr.Isosurfaces([0.0], [[1.0, 1.0, 1.0]])
    parts = {"lights": (SUN,), "shading": jvr.Lambert(), "normals": jvr.CentralDifferences(), "surfaces": surfaces}
    camera = jvr.OrthographicCamera.look_at([11.5, 11.5, 60], [11.5, 11.5, 0], [0, 1, 0], 23.0, n, n)
    lit, dark = (
        np.asarray(render(jvr.Scene(volume, clear(), **parts, shadows=shadows), camera).rgb)[..., 0] for shadows in (None, method)
    )
    x = 11.5 + ((np.arange(n) + 0.5) / n - 0.5) * 23.0
    x, y = np.meshgrid(x, 23.0 - x)
    of_ball = np.hypot(x - MIDDLE[0], y - MIDDLE[1]) / RADIUS
    # A vertical unit of the way moves the shadow by half a unit, and a slanted section of the beam is longer by the cosine's inverse.
    umbra = np.hypot((x - MIDDLE[0] - 0.5 * (MIDDLE[2] - FLOOR)) / (RADIUS * np.sqrt(1.25)), (y - MIDDLE[1]) / RADIUS)
    inside, outside = (umbra < 0.93) & (of_ball > 1.1), (umbra > 1.07) & (of_ball > 1.1)
    assert inside.sum() > 100
    assert np.all(lit[inside] > 0.8)
    np.testing.assert_array_equal(dark[inside], 0)
    np.testing.assert_allclose(dark[outside], lit[outside], rtol=1e-6)
    faces = (of_ball < 0.95) & (lit > 0.1)
    assert faces.sum() > 100
    np.testing.assert_allclose(dark[faces], lit[faces], rtol=1e-6)


def fog_below(opacity, shadows, **choices):
    """Fog and, in it, a black sheet, seen from below; light straight down."""
    values = np.broadcast_to(np.arange(9.0), (6, 6, 9))
    fog = jvr.LinearTransfer([0.0, 8.0], np.zeros((2, 3)), [0.2, 0.2])
    parts = {"lights": (jvr.DirectionalLight([0.0, 0.0, -1.0]),), "shadows": shadows, "scattering": jvr.SingleScattering()}
    surfaces = None if opacity is None else jvr.Isosurfaces([2.75], np.zeros((1, 3)), opacity, **choices)
    camera = jvr.OrthographicCamera.look_at([2.5, 2.5, -9], [2.5, 2.5, 0], [0, 1, 0], 2.0, 2, 2)
    return jvr.Scene(jvr.Volume(values), fog, surfaces=surfaces, **parts), camera


SETTINGS = jvr.Settings(0.25, termination=0)
PHASE = 1 / (4 * np.pi)


@pytest.mark.slow
def test_the_medium_lies_in_the_shadow_of_what_a_sheet_holds_back():
    """Closed form: light that comes down to `z` has passed `8 - z` of fog, and goes back down through `z` of it; what is below the sheet
    lacks its opacity once, what is above it is seen through it. Its derivative in the opacity is exact, too."""
    scene, camera = fog_below([0.4], jvr.ShadowRays(0.25, termination=0))

    def seen(opacity):
        moved = eqx.tree_at(lambda s: s.surfaces.opacity, scene, opacity[None])
        return jvr.render(moved, camera, SETTINGS).rgb[0, 0, 0]

    value, slope = jax.jit(jax.value_and_grad(seen))(jnp.asarray(0.4))
    below, above = (PHASE * 0.2 * np.exp(-0.2 * 8) * length for length in (2.75, 8 - 2.75))
    np.testing.assert_allclose(value, 0.6 * (below + above), rtol=2e-3)
    np.testing.assert_allclose(slope, -(below + above), rtol=2e-3)
    uncast = dataclasses.replace(scene, surfaces=jvr.Isosurfaces([2.75], np.zeros((1, 3)), [0.4], casts_shadows=False))
    np.testing.assert_allclose(jvr.render(uncast, camera, SETTINGS).rgb[0, 0, 0], below + 0.6 * above, rtol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "choices", [{}, {"band": 2.0, "coarse": 2}, {"guaranteed": True}], ids=["one rate", "two rates", "guaranteed"]
)
def test_light_passes_the_product_of_what_surfaces_leave(choices):
    """Of all that it crosses, twice of one that it enters and leaves, and no more than `most`; its derivative is that of the product."""
    at = np.indices((9, 9, 17)).astype(float)
    volume = jvr.Volume(-np.abs(at[2] - 8.0) + 0.01 * at[0])
    surfaces = jvr.Isosurfaces([-5.0, -2.0], np.ones((2, 3)), [0.25, 0.5], **choices)
    scene = jvr.Scene(volume, clear(), surfaces=surfaces)
    search = surfaces.prepare(scene, bricks(volume))
    # Through all, from the middle on, from between the two on, away from all.
    begin, length = jnp.array([0.5, 8.0, 4.5, 14.5]), jnp.array([15.0, 7.0, 11.0, 1.0])
    still = jnp.full(4, 3.3), jnp.full(4, 4.1)
    rays = Rays((*still, begin), (jnp.zeros(4), jnp.zeros(4), jnp.ones(4)), length)
    through = jax.jit(lambda opacity, most: passed(search, rays, opacity, most), static_argnums=1)
    a, b = 0.75, 0.5
    np.testing.assert_allclose(through(surfaces.opacity, 6), [a * a * b * b, a * b, a * b * b, 1], rtol=1e-6)
    np.testing.assert_allclose(through(surfaces.opacity, 1), [a, b, b, 1], rtol=1e-6)
    np.testing.assert_array_equal(passed(search, rays, None, 4), [0, 0, 0, 1])
    slope = jax.jacrev(lambda opacity: passed(search, rays, opacity, 6))(surfaces.opacity)
    np.testing.assert_allclose(slope, [[-2 * a * b * b, -2 * a * a * b], [-b, -a], [-b * b, -2 * a * b], [0, 0]], rtol=1e-6)


def test_a_plan_says_who_casts_shadows():
    said = lambda scene: next(part.reason for part in jvr.plan(scene).parts if part.name == "surfaces")
    scene, _ = fog_below([0.4], jvr.ShadowRays())
    assert said(scene).endswith("they cast shadows")
    assert "shadows" not in said(fog_below([0.4], jvr.ShadowRays(), casts_shadows=False)[0])
    assert "shadows" not in said(fog_below([0.4], None)[0])
