"""Isosurfaces beside other parts of a scene: what is in the way of light, what glows, what is in front and behind, other voxels."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import render
from scipy.ndimage import map_coordinates
from scipy.optimize import brentq

import jvr
from jvr.march.first_hit import next_hit, start
from jvr.march.steps import Point, Rays
from jvr.rendering.medium import absorbing, bricks, occupancy, visibility

SETTINGS = jvr.Settings(0.5, termination=0)


def ramp(shape=(8, 8, 9)):
    """The scalar is the last coordinate."""
    return np.indices(shape).astype(float)[2]


def from_above(volume, size=4, extent=3.0):
    x, y, z = np.asarray(volume.center)
    return jvr.OrthographicCamera.look_at([x, y, z + 20], [x, y, z], [0, 1, 0], extent, size, size)


# --- Far from the visible medium -------------------------------------------------------------------------------------


def far_away(surfaces=True, **parts):
    """An opaque slab at one end of a volume, and a surface bricks away from it."""
    values = np.indices((33, 33, 33)).astype(float)[0]
    slab = jvr.LinearTransfer([0.0, 2.0, 2.001, 32.0], np.ones((4, 3)), [5.0, 5.0, 0.0, 0.0])
    there = jvr.Isosurfaces([26.0], [[1.0, 0.5, 0.2]]) if surfaces else None
    return jvr.Scene(jvr.Volume(values), slab, surfaces=there, **parts)


def occluded(surfaces=True):
    occlusion = jvr.LocalOcclusion(500, radius=40.0, offset=0.0, samples=40, resolution=0.25)
    return far_away(surfaces, lights=(jvr.AmbientLight(1.0),), shading=jvr.Lambert(), occlusion=occlusion)


def under_a_sky(surfaces=True):
    sky, transfer = jvr.EnvironmentLight.constant(1.0), jvr.RadianceTransfer(2, 8, 0.25)
    return far_away(surfaces, environment=sky, material=jvr.LambertBRDF(), radiance_transfer=transfer)


@pytest.mark.slow
def test_nodes_near_surfaces_are_worth_it_where_no_medium_is_visible():
    for make in (occluded, under_a_sky):
        for surfaces in (True, False):
            scene = make(surfaces)
            medium = absorbing(scene, occupancy(scene, SETTINGS), False)
            part = getattr(scene, scene.precomputable[0])
            assert bool(jnp.all(part.projection(scene, lambda _, medium=medium: medium).active())) == surfaces


def test_what_was_kept_without_surfaces_is_stale_beside_them():
    for make in (occluded, under_a_sky):
        with_, without = make(), make(False)
        name = with_.precomputable[0]
        part = getattr(without, name)
        assert np.any(part.cache_key(with_) != part.cache_key(without))
        assert "presence of surfaces" in part.stale_message


@pytest.mark.slow
def test_the_medium_occludes_a_surface_that_is_far_from_it():
    """A direction that meets the slab before it leaves the volume is free for so much of the radius. By brute force over directions."""
    at = Point((jnp.array([26.0]), jnp.array([16.0]), jnp.array([16.0])), (jnp.ones(1),) * 3, *(jnp.zeros(1, jnp.int32),) * 2)
    left = jax.jit(lambda s: visibility(s, occupancy(s, SETTINGS)).transmittances(at, jnp.ones(1, bool), reverse=False).ambient)
    d = np.random.default_rng(0).normal(size=(100_000, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    # It is opaque within a mean free path of 1 / 5.
    way = 24 / np.maximum(-d[:, 0], 1e-9)
    meets = np.all(np.abs(d[:, 1:] * way[:, None]) < 16, axis=1)
    taken = 1 - np.mean(np.where(meets, np.minimum((way + 0.2) / 40, 1), 1.0))
    assert taken > 0.02
    np.testing.assert_allclose(1 - left(occluded())[0][0], taken, rtol=0.1)


# --- Along one ray ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("sampling", [jvr.Uniform(), jvr.Refinement(0.0)], ids=["uniform", "refinement"])
def test_a_glow_a_mesh_and_surfaces_are_seen_in_their_order(sampling):
    """Closed form, from above: glowing air without extinction, a sheet, on one side a mesh above it, on the other one below, and a
    clipping plane between that takes the second surface away; four rays a pixel."""
    volume = jvr.Volume(ramp())
    glow, colours = np.array([0.01, 0.03, 0.02]), np.array([[0.1, 0.3, 1.0], [1.0, 0.2, 0.1]])
    air = jvr.LinearTransfer([-20.0, 20.0], np.zeros((2, 3)), np.zeros(2), emission=np.stack([glow, glow]))
    a = 0.6
    surfaces = jvr.Isosurfaces([4.0, 4.75], colours[::-1], [0.5, a])
    quad = lambda left, right, z: [[x, y, z] for x in (left, right) for y in (0.0, 7.0)]
    corners = quad(0.0, 3.5, 6.5) + quad(3.5, 7.0, 3.25)
    mesh = jvr.Mesh(corners, [[0, 1, 2], [1, 2, 3], [4, 5, 6], [5, 6, 7]], (0.2, 0.7, 0.4))
    clipping = jvr.ClippingPlane([0.0, 0.0, 4.4], [0.0, 0.0, -1.0])
    scene = jvr.Scene(volume, air, surfaces=surfaces, geometry=mesh, clipping=clipping)
    settings = dataclasses.replace(SETTINGS, sampling=sampling, pixel_samples=2)
    rgb = np.asarray(render(scene, from_above(volume), settings).rgb)
    in_front = glow * (8 - 6.5) + np.array([0.2, 0.7, 0.4])
    behind = glow * (8 - 4.75) + a * colours[0] + (1 - a) * (glow * (4.75 - 4.4) + np.array([0.2, 0.7, 0.4]))
    np.testing.assert_allclose(rgb[:, 0], np.broadcast_to(in_front, (4, 3)), rtol=1e-5)
    np.testing.assert_allclose(rgb[:, 3], np.broadcast_to(behind, (4, 3)), rtol=1e-5)


@pytest.mark.slow
def test_a_matte_surface_under_a_sky_of_one_colour_shows_its_own():
    """A furnace: what is white sends on all that it gets."""
    colour, sky = np.array([0.9, 0.5, 0.2]), jvr.EnvironmentLight.constant(1.0)
    volume = jvr.Volume(ramp())
    clear = jvr.LinearTransfer([-20.0, 20.0], np.zeros((2, 3)), np.zeros(2))
    scene = jvr.Scene(
        volume,
        clear,
        surfaces=jvr.Isosurfaces([3.5], [colour]),
        environment=sky,
        material=jvr.LambertBRDF(),
        background=(0, 0, 0),
    )
    furnace = np.asarray(render(scene, from_above(volume), SETTINGS).rgb)
    np.testing.assert_allclose(furnace, np.broadcast_to(colour, furnace.shape), rtol=1e-3)


# --- Other voxels ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("choices", [{}, {"guaranteed": True}], ids=["one rate", "guaranteed"])
def test_hits_of_splines_are_those_of_scipy(choices, x64):
    """Distances to the tricubic B-spline of random voxels, within the tolerance of roots that SciPy finds; derivatives by its slope."""
    values = np.cumsum(np.random.default_rng(4).random((9, 8, 10)), axis=2)
    volume = jvr.Volume(values, interpolation=jvr.Tricubic())
    surfaces = jvr.Isosurfaces([2.4], np.ones((1, 3)), tolerance=1e-5, **choices)
    clear = jvr.LinearTransfer([0.0, 10.0], np.zeros((2, 3)), np.zeros(2))
    search = surfaces.prepare(jvr.Scene(volume, clear, surfaces=surfaces), bricks(volume))
    p = np.random.default_rng(5).uniform([1, 1, 0], [7, 6, 0], (40, 3))
    d = np.random.default_rng(6).uniform([-0.1, -0.1, 1], [0.1, 0.1, 1], (40, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    length = 9 / d[:, 2] * 0.999
    rays = Rays(tuple(jnp.asarray(p.T)), tuple(jnp.asarray(d.T)), jnp.asarray(length))

    def distances(value):
        moved = dataclasses.replace(search, values=value[None])
        hits = next_hit(moved, rays, start(moved, rays))
        return jnp.where(hits.found, hits.u, jnp.nan)

    u, slope = jax.jit(lambda value: jax.jvp(distances, (value,), (jnp.ones_like(value),)))(jnp.asarray(2.4))
    spline = lambda u, i: map_coordinates(values, (p[i] + u * d[i])[:, None], order=3, mode="mirror", prefilter=False)[0] - 2.4
    checked = 0
    for i in range(40):
        t = np.linspace(0, length[i], 400)
        s = np.array([spline(x, i) for x in t])
        if s[0] >= 0 or not np.any(s > 0):
            continue
        k = int(np.argmax(s > 0))
        root = brentq(spline, t[k - 1], t[k], args=(i,), xtol=1e-12)
        assert u[i] == pytest.approx(root, abs=2e-5)
        rate = (spline(root + 1e-5, i) - spline(root - 1e-5, i)) / 2e-5
        assert slope[i] == pytest.approx(1 / rate, rel=1e-4)
        checked += 1
    assert checked > 15
