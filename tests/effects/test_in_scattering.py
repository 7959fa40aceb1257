"""First-order in-scattering: closed forms, brute force in NumPy, derivatives, what is kept, hard cases."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import linear_transfer, perspective, render, voxels
from scipy.integrate import quad
from scipy.ndimage import map_coordinates

import jvr
from jvr.io.config import build_cameras, build_scene, read_config
from jvr.march.steps import Point
from jvr.rendering.medium import occupancy, visibility

CONFIG = Path(__file__).parents[2] / "configs" / "inscattering.toml"


def sun():
    return jvr.DirectionalLight((0.0, 0.0, -1.0))


def scene(shadows, volume, transfer, lights=None, **parts):
    lights = (sun(),) if lights is None else lights
    return jvr.Scene(volume, transfer, lights=lights, shadows=shadows, scattering=jvr.SingleScattering(), **parts)


def points(p) -> Point:
    p = tuple(jnp.asarray(c, float) for c in np.asarray(p).T)
    return Point(p, p, *(jnp.zeros(p[0].shape, jnp.int32),) * 2)


@jax.jit
def lights_at(one: jvr.Scene, at: Point):
    """What reaches grid positions of each light, skipping nothing."""
    return visibility(one, None).transmittances(at, jnp.ones(at.p[0].shape, bool), reverse=True).lights


def found(one: jvr.Scene, p) -> np.ndarray:
    """`(lights, channels, points)`."""
    return np.asarray([light for light in lights_at(one, points(p)) if light])


def phi1(x):
    return -np.expm1(-x) / x if x else 1.0


def solid(sigma):
    return jvr.LinearTransfer([0.0, 1.0], np.zeros((2, 3)), [sigma, sigma])


RAYS = {"direct": jvr.ShadowRays(termination=0.0), "resolution": 1.0}


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [1e-3, 0.2, 0.6])
def test_deep_in_a_homogeneous_medium_it_has_the_closed_form(sigma, x64):
    """`exp(-sigma z) / 2 integral_-1^1 exp(-sigma mu a) phi1(sigma (1 + mu) (R - a)) dmu` at the depth `z` below a face that light falls
    straight onto; a light that casts no shadow is as it was."""
    radius, offset, depth = 3.0, 0.5, 5.0
    volume = jvr.Volume(np.ones((9, 9, 11)))
    lights = (jvr.HeadLight(), sun())
    one = scene(jvr.InScattering(200, radius=radius, offset=offset, samples=12, **RAYS), volume, solid(sigma), lights)
    along = lambda mu: np.exp(-sigma * mu * offset) * phi1(sigma * (1 + mu) * (radius - offset))
    expected = np.exp(-sigma * depth) / 2 * quad(along, -1, 1)[0]
    nothing, lit = lights_at(one, points([[4.0, 4, 10 - depth]]))
    assert nothing == ()
    # Light is trilinear between nodes: of second order, `sigma^2 / 12` of it on average.
    assert float(lit[0][0]) == pytest.approx(expected, rel=1e-3 + sigma**2 / 8)


@pytest.mark.slow
def test_a_ball_without_extent_leaves_direct_light():
    """At the nodes; and more than none of it is `bias`."""
    volume, p = jvr.Volume(voxels((5, 6, 4))), np.array([[1.0, 2, 3], [4, 0, 1], [2, 5, 0]])
    lamp = (jvr.PointLight((7.0, 9.0, 8.0)),)
    make = lambda s: scene(s, volume, linear_transfer(coloured=True), lamp)
    direct = found(make(RAYS["direct"]), p)
    few = {"rays": 4, "samples": 2, **RAYS}
    point = jvr.InScattering(**few, radius=0.0, offset=0.0)
    np.testing.assert_allclose(found(make(point), p), direct, rtol=2e-5)
    biased = found(make(point.rebuilt(bias=0.25)), p)
    np.testing.assert_allclose(biased, 0.25 + 0.75 * direct, rtol=2e-5)


@pytest.mark.slow
def test_it_is_that_of_brute_force(x64):
    """Thousands of random directions, samples a fifth of a voxel apart in double precision, and light that is trilinear between the voxels.
    (Without that it is 2 % less in this blob, which is as wide as four voxels.)"""
    n, radius, offset = 9, 3.0, 0.5
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    values = np.exp(-4 * ((x - 0.2) ** 2 + y**2 + (z - 0.4) ** 2)) + 0.1
    one = scene(jvr.InScattering(128, radius=radius, offset=offset, **RAYS), jvr.Volume(values), solid(0.0))
    one = dataclasses.replace(one, transfer=jvr.LinearTransfer([0.0, 1.2], np.zeros((2, 3)), [0.0, 0.5]))
    sigma = lambda at: np.interp(map_coordinates(values, np.moveaxis(at, -1, 0), order=1, mode="nearest"), [0.0, 1.2], [0.0, 0.5])
    inside = lambda at: np.all((at >= 0) & (at <= n - 1), axis=-1)
    directions = np.random.default_rng(5).normal(size=(3000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    steps, up = 12, np.arange(0.1, n, 0.2)
    nodes = np.stack(np.meshgrid(*[np.arange(float(n))] * 3, indexing="ij"), axis=-1)
    above = nodes[..., None, :] + up[:, None] * np.array([0.0, 0, 1])
    direct = np.exp(-0.2 * np.sum(np.where(inside(above), sigma(above), 0.0), axis=-1))
    p, expected = np.array([[4.0, 4, 2], [5, 3, 4], [2, 5, 6]]), []
    for at in p:
        s = offset + (radius - offset) * (np.arange(steps) + 0.5) / steps
        x = at + s[:, None] * directions[:, None]
        dtau = np.where(inside(x), sigma(x), 0.0) * (radius - offset) / steps
        light = map_coordinates(direct, np.moveaxis(np.clip(x, 0, n - 1), -1, 0), order=1)
        expected.append(np.mean(light * np.exp(-(np.cumsum(dtau, axis=1) - 0.5 * dtau))))
    np.testing.assert_allclose(found(one, p)[0, 0], expected, rtol=0.01)


@pytest.mark.slow
def test_derivatives_are_those_of_differences(x64):
    """Of table, voxels, lamp, lengths and bias, in both modes."""
    lamp = jvr.PointLight((3.1, 4.7, 6.2))
    shadows = jvr.InScattering(
        5, radius=1.7, offset=0.3, samples=2, resolution=0.7, bias=0.1, direct=jvr.PiecewiseShadows(1.4, 0.6)
    )
    one = scene(shadows, jvr.Volume(voxels((4, 3, 4))), linear_transfer(), (sun(), lamp))
    at = points(np.random.default_rng(3).uniform(0, 2, (7, 3)))
    of = lambda s: s.shadows
    arrays = lambda s: (s.transfer.sigma_t, s.volume.values, s.lights[1].position, of(s).radius, of(s).offset, of(s).bias)
    held = arrays(one)

    @jax.jit
    def loss(moved):
        lights = lights_at(eqx.tree_at(arrays, one, moved), at)
        return sum(jnp.sum(jnp.sin(jnp.arange(1.0, 8.0) + i) * light[0]) for i, light in enumerate(lights))

    gradient = jax.jit(jax.grad(loss))(held)
    slope = jax.jit(lambda move: jax.jvp(loss, (held,), (move,))[1])
    rng = np.random.default_rng(4)
    for k, x in enumerate(held):
        move = tuple(
            jnp.asarray(rng.standard_normal(np.shape(x)) if i == k else np.zeros(np.shape(y))) for i, y in enumerate(held)
        )
        expected = float(loss(jax.tree.map(lambda x, d: x + 1e-6 * d, held, move)))
        expected = (expected - float(loss(jax.tree.map(lambda x, d: x - 1e-6 * d, held, move)))) / 2e-6
        assert abs(expected) > 1e-4, k
        assert float(jnp.vdot(gradient[k], move[k])) == pytest.approx(expected, rel=1e-5, abs=1e-8), k
        assert float(slope(move)) == pytest.approx(expected, rel=1e-5, abs=1e-8), k


def small(**numbers):
    shadows = jvr.InScattering(6, samples=2, resolution=0.6, **({"radius": 2.0} | numbers))
    return scene(shadows, jvr.Volume(voxels((6, 5, 4))), linear_transfer())


@pytest.mark.slow
def test_what_is_computed_beforehand_is_kept(tmp_path):
    """And knows what it was computed of: lights among it, `bias` not."""
    one, done = small(), []
    kept = jvr.precompute(one, cache=tmp_path, report=done.append)
    assert (done[0].part, done[0].cached) == ("shadows", False)
    assert kept.shadows.is_frozen
    p = np.random.default_rng(1).uniform(0, 3, (20, 3))
    np.testing.assert_allclose(found(kept, p), found(one, p), atol=1e-6)
    assert eqx.tree_equal(jvr.precompute(one, cache=tmp_path, report=done.append), kept)
    assert done[1].cached
    brighter = dataclasses.replace(kept, shadows=kept.shadows.rebuilt(bias=0.5))
    assert brighter.shadows.stale(brighter) == ()
    other = dataclasses.replace(kept, lights=(jvr.DirectionalLight((1.0, 0.0, 0.0)),))
    with pytest.raises(ValueError, match=r"in-scattering was computed for another light.*replace shadows by shadows.pinned\(\)"):
        other.current()


@pytest.mark.slow
def test_pictures_of_hard_cases_are_finite():
    """Opaque and empty media, balls larger than the volume, light inside; and pictures show what is kept."""
    camera = perspective(small().volume, 4, 3)
    drawn = lambda one: np.asarray(render(one, camera).rgb)
    lamp = jvr.PointLight((2.5, 2.0, 1.5))
    for one in (small(radius=1e6), dataclasses.replace(small(radius=1e6), lights=(lamp,))):
        for scale in (0.0, 0.6, 1e30):
            assert np.all(np.isfinite(drawn(dataclasses.replace(one, transfer=linear_transfer(scale=scale)))))
    np.testing.assert_allclose(drawn(jvr.precompute(small())), drawn(small()), atol=1e-6)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match=r"first order: set direct=jvr\.PiecewiseShadows\(\)"):
        jvr.InScattering(direct=jvr.InScattering())
    with pytest.raises(ValueError, match="bias"):
        jvr.InScattering(bias=1.5)


@pytest.mark.slow
def test_the_configuration_says_what_it_draws():
    """At four pixels a side and a few nodes: softer shadows than those without."""
    few = ["shadows.rays=4", "shadows.samples=2", "shadows.resolution=0.1", "settings.step=8"]
    config = read_config(CONFIG, ["camera.width=4", "camera.height=4", *few])
    one = build_scene(config)
    (camera,) = build_cameras(config, one.volume)
    assert isinstance(one.shadows, jvr.InScattering)
    direct, scattered = (
        jvr.render(x, camera, jvr.Settings(8.0)).rgb for x in (dataclasses.replace(one, shadows=one.shadows.direct), one)
    )
    assert np.max(np.abs(scattered - direct)) > 0.02


@pytest.mark.slow
def test_empty_places_around_lie_in_the_shadow_of_what_is_far():
    """A sheet above throws its shadow on the sheet below, and on the empty space that the ball of that one reaches into."""
    values = np.zeros((9, 9, 41))
    values[:, :, 36:39] = values[:, :, 2:5] = 1.0
    transfer = jvr.LinearTransfer([0.0, 0.5, 1.0], np.zeros((3, 3)), [0.0, 0.0, 3.0])
    shadows = jvr.InScattering(direct=jvr.PiecewiseShadows(4.0), radius=10.0, resolution=1.0)
    one = scene(shadows, jvr.Volume(values), transfer)
    at = np.array([[4.0, 4.0, 6.0], [4.0, 4.0, 37.0]])
    skipping = occupancy(one, jvr.Settings())
    assert skipping is not None
    there = jax.jit(lambda one: visibility(one, skipping).transmittances(points(at), jnp.ones(2, bool), reverse=True).lights)
    (dark, bright) = np.asarray(there(one)[0][0])
    assert dark < 0.01 < bright


@pytest.mark.slow
def test_surfaces_in_empty_places_lie_in_the_shadow_of_what_is_far():
    """An isosurface where the medium is invisible, a way behind a sheet that takes all light."""
    values = np.zeros((9, 9, 41))
    values[:, :, 36:39], values[:, :, :9] = 1.0, np.linspace(0.4, 0.0, 9)
    transfer = jvr.LinearTransfer([0.0, 0.5, 1.0], np.zeros((3, 3)), [0.0, 0.0, 9.0])
    looking = jvr.OrthographicCamera.look_at((4.0, -20.0, 12.0), (4.0, 4.0, 4.0), (0, 0, 1), 2.0, 3, 3)
    shown = {"surfaces": jvr.Isosurfaces([0.2], [[1.0, 1.0, 1.0]]), "shading": jvr.Lambert(), "lights": (sun(),)}
    lit = jvr.Scene(jvr.Volume(values), transfer, **shown)
    shadowed = dataclasses.replace(lit, shadows=jvr.PiecewiseShadows(4.0))
    assert np.max(render(shadowed, looking).rgb) < 0.01 < np.min(render(lit, looking).rgb)
