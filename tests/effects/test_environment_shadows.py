"""Environment lighting against brute force: directional lights with shadow rays, which know no harmonics and no nodes."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import rotation
from scipy.ndimage import map_coordinates
from scipy.special import expn

import jvr
from jvr.effects.self_shadow import SelfShadow, ShadedSegment
from jvr.model.transfer import Classified

TILT = rotation(0.25, 0.1, 0.35)
TOWARDS, HALF_ANGLE = np.array([0.5, -0.45, 0.74]) / np.linalg.norm([0.5, -0.45, 0.74]), 12.0
SOLID_ANGLE = 2 * math.pi * (1 - math.cos(math.radians(HALF_ANGLE)))
SETTINGS = jvr.Settings(0.5)


def distance(name, x, n):
    """From the surface of a body, positive outside."""
    if name == "ball":
        return np.linalg.norm(x, axis=-1) - 0.36 * n
    if name == "box":
        out = np.abs(x @ TILT) - 0.27 * n
        return np.linalg.norm(np.maximum(out, 0), axis=-1) + np.minimum(np.max(out, -1), 0)
    return x @ TILT[:, 2] + 0.5


def body(name, n, **parts):
    """An opaque body with an edge of three voxels."""
    x = np.stack(np.meshgrid(*[np.arange(n) - (n - 1) / 2] * 3, indexing="ij"), axis=-1)
    values = np.clip(0.5 - distance(name, x, n) / 3, 0, 1)
    opaque = jvr.LinearTransfer([0.0, 0.05, 1.0], [[1, 1, 1]] * 3, [0.0, 0.0, 5.0])
    return jvr.Scene(jvr.Volume(values).bricked(), opaque, **parts)


def spiral(number, top):
    """Directions of equal solid angle about z, up to `1 - z = top`."""
    index = np.arange(number) + 0.5
    z = 1 - top * index / number
    around = math.pi * (3 - math.sqrt(5)) * index
    return np.stack([np.sqrt(1 - z * z) * np.cos(around), np.sqrt(1 - z * z) * np.sin(around), z], axis=-1)


# A disc lamp whose irradiance is pi where it is faced, a sky of radiance 1, or both.
LIGHTS = {"lamp": ("lamp",), "sky": ("sky",), "both": ("lamp", "sky")}


def environment_of(which):
    lamp = jvr.EnvironmentLight.disc(TOWARDS, HALF_ANGLE, math.pi / SOLID_ANGLE)
    sky = jvr.EnvironmentLight.constant(1.0, 3)
    return {"lamp": lamp, "sky": sky, "both": lamp + sky}[which]


def directions_of(part):
    """The lamp or the sky as directions with irradiance over pi, as `jvr.Lambert` counts it."""
    if part == "sky":
        return spiral(32, 2.0), 4 / 32
    across = np.linalg.svd(TOWARDS[None])[2]
    frame = np.stack([across[1], across[2], TOWARDS])
    return spiral(8, 1 - math.cos(math.radians(HALF_ANGLE))) @ frame, 1 / 8


@jax.jit
def lit_from(scene, camera, direction, irradiance):
    """The picture under a light with shadow rays, its opacity and its depth."""
    lit = dataclasses.replace(
        scene,
        lights=(jvr.DirectionalLight(-direction, irradiance * jnp.ones(3)),),
        shading=jvr.Lambert(0.0, 1.0),
        shadows=jvr.ShadowRays(0.5),
    )
    found = jvr.render(lit, camera, SETTINGS)
    return found.rgb[..., 0], found.alpha, found.depth


@functools.cache
def brute_force(name, part, n, size):
    """A body under all directions of the lamp or the sky, one after the other, its opacity and its depth."""
    scene = body(name, n)
    directions, irradiance = directions_of(part)
    camera = view(scene, size)
    pictures = [lit_from(scene, camera, jnp.asarray(d, jnp.float32), jnp.float32(irradiance)) for d in directions]
    return np.sum([np.asarray(p[0], float) for p in pictures], axis=0), *map(np.asarray, pictures[0][1:])


def view(scene, size):
    center = np.asarray(scene.volume.center)
    eye = center + 1.6 * float(scene.volume.radius) * np.array([1.2, -1.6, 2.0])
    return jvr.PerspectiveCamera.look_at(eye, center, (0, 0, 1), 22.0, size, size)


def seen(scene, camera, alpha, depth):
    """Pixels of whole faces: no edge of the body in the picture, and nothing where the volume cuts it."""
    whole = alpha > 0.98
    around = [np.roll(whole, shift, (0, 1)) for shift in ((0, 1), (0, -1), (1, 0), (-1, 0))]
    origin, direction = camera.rays(jnp.arange(alpha.size))
    p = np.stack([np.asarray(o) + depth.ravel() * np.asarray(d) for o, d in zip(origin, direction, strict=True)], axis=-1)
    n = scene.volume.shape[0]
    uncut = np.all(np.abs(p - (n - 1) / 2) < 0.37 * n, axis=-1).reshape(alpha.shape)
    return np.all([whole, uncut, *around], axis=0)


def compared(name, which, n, size, transfer):
    """Mean over brute force, and the spread of what is one where both are alike, over pixels that are lit."""
    plain = body(name, n)
    camera = view(plain, size)
    parts = [brute_force(name, part, n, size) for part in LIGHTS[which]]
    exact, (_, alpha, depth) = sum(part[0] for part in parts), parts[0]
    lit = dataclasses.replace(plain, environment=environment_of(which), material=jvr.LambertBRDF(), radiance_transfer=transfer)
    found = np.asarray(jax.jit(jvr.render, static_argnums=2)(lit, camera, SETTINGS).rgb, float)[..., 0]
    wanted = seen(plain, camera, alpha, depth)
    wanted &= exact > 0.1 * np.max(exact[wanted])
    ratio = found[wanted] / exact[wanted]
    assert wanted.sum() > 20
    return np.sum(found[wanted]) / np.sum(exact[wanted]), np.std(ratio) / np.mean(ratio)


@pytest.mark.slow
def test_shares_of_the_light_against_brute_force():
    """Of 40 lights. The mean; and no blotches: what is left is a twentieth, mostly of the shadow rays' own steps."""
    mean, spread = compared("ball", "both", 20, 16, jvr.RadianceTransfer(rays=16))
    assert abs(mean - 1) < 0.05
    assert spread < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("which", LIGHTS)
@pytest.mark.parametrize("name", ["ball", "box", "half space"])
def test_bodies_against_brute_force(name, which, exact):
    """The faces of a box meet in edges that a third of the voxels does not resolve."""
    mean, spread = compared(name, which, 36, 40, jvr.RadianceTransfer(exact=exact))
    assert abs(mean - 1) < 0.05
    assert spread < (0.08 if name == "box" else 0.05)


@pytest.mark.parametrize("strength", [1.0, 0.5])
@pytest.mark.parametrize("tau", [0.0, 0.05, 0.4, 2.0, 8.0])
def test_the_shadow_that_a_surface_casts_on_itself(tau, strength):
    """Bands against SciPy's exponential integrals, for a scalar that falls to 0 within the width; of half a surface, up to half of it."""
    # From 1 to 0 over a distance of 3 the integral of the scalar is 1.5, up to its middle 1.125.
    linear = jvr.LinearTransfer([0.0, 1.0], [[1, 1, 1]] * 2, [0.0, tau / 1.5])
    shadow = SelfShadow(linear, jnp.asarray(3.0), of_opacity=False, bleeds=False)
    up, s = tuple(map(jnp.asarray, (0.0, 0.0, 1.0))), jnp.asarray(1.0)
    slope = tuple(map(jnp.asarray, (0.0, 0.0, -1 / 3)))
    here = ShadedSegment(Classified((s, s, s), (jnp.asarray(tau / 1.5),)), slope, jnp.asarray(0.0))
    found = [band[0] for band in shadow.remaining(s, jnp.asarray(1 / 3), up, up, here, jnp.asarray(strength))]
    e = {n: expn(n, tau * (1.0 if strength == 1 else 0.75)) for n in (3, 4, 5)}
    # The rule of four places is a few percent of the depth off.
    np.testing.assert_allclose(found, [2 * e[3], 3 * e[4], 4 * (3 * e[5] - e[3])], atol=0.02)


@pytest.mark.slow
def test_a_shadow_of_what_is_densest_is_dark():
    """Without an overflow, in value and derivative."""

    def kept(sigma):
        shadow = SelfShadow(jvr.LinearTransfer([0.0, 1.0], [[1, 1, 1]] * 2, [sigma, sigma]), jnp.asarray(3.0), False, False)
        up, s = tuple(map(jnp.asarray, (0.0, 0.0, 1.0))), jnp.asarray(1.0)
        here = ShadedSegment(Classified((s, s, s), (sigma,)), up, jnp.asarray(1.0))
        return shadow.remaining(s, s, up, up, here, s)[0][0]

    value, slope = jax.value_and_grad(kept)(jnp.asarray(1e25))
    assert 0 <= value < 1e-30
    assert slope == 0


@pytest.mark.slow
@pytest.mark.parametrize("bleeding", [jvr.TransferBleeding(), jvr.MaterialBleeding()], ids=lambda b: type(b).__name__)
def test_a_surface_that_bleeds_into_itself(bleeding):
    """A ball under a uniform sky by a sum in float64 over eye rays and 200 directions in steps of half a voxel, each of which carries the
    colour of what it has passed, or what the material reflects of that."""
    n, reflectance, colour = 16, 0.6, np.array([0.9, 0.5, 0.2])
    center, radius = (n - 1) / 2, 0.36 * n
    scene = body("ball", n)
    scene = dataclasses.replace(
        scene,
        transfer=jvr.LinearTransfer([0.0, 0.05, 1.0], [colour] * 3, [0.0, 0.0, 5.0]),
        environment=jvr.EnvironmentLight.constant(1.0, 3),
        material=jvr.LambertBRDF(reflectance),
        radiance_transfer=jvr.RadianceTransfer(bleeding=bleeding),
    )
    camera = jvr.OrthographicCamera.look_at([center, center, 60.0], [center] * 3, [0, 1, 0], radius, 5, 5)
    found = np.asarray(jax.jit(jvr.render, static_argnums=2)(scene, camera, SETTINGS).rgb, float).reshape(-1, 3)

    values = np.asarray(scene.volume.values, float)
    sigma = lambda p: 5 * np.maximum(map_coordinates(values, np.moveaxis(p, -1, 0), order=1, cval=0.0) - 0.05, 0) / 0.95
    origin, direction = (np.stack([np.asarray(c, float) for c in side], -1) for side in camera.rays(jnp.arange(25)))
    step, t = 0.2, np.arange(0, 6, 0.2) + 0.1
    enters = 60 - center - radius - 2
    eye = (origin + enters * direction)[:, None] + t[:, None] * direction[:, None]
    dtau = step * sigma(eye)
    seen_share = np.exp(-(np.cumsum(dtau, axis=1) - dtau)) * -np.expm1(-dtau)
    normal = (eye - center) / np.linalg.norm(eye - center, axis=-1, keepdims=True)
    sphere = spiral(200, 2.0)
    near = colour * (reflectance if isinstance(bleeding, jvr.MaterialBleeding) else 1.0)
    arriving = np.zeros((*eye.shape[:2], 3))
    for w in sphere:
        facing = np.maximum(normal @ w, 0.0) / math.pi * 4 * math.pi / len(sphere)
        tau = 0.5 * sum(sigma(eye + (k + 0.5) * 0.5 * w) for k in range(3 * n))
        arriving += facing[..., None] * (near + (1 - near) * np.exp(-tau)[..., None])
    expected = np.sum(seen_share[..., None] * colour * reflectance * arriving, axis=1)
    assert np.all(seen_share.sum(axis=1) > 0.98)
    np.testing.assert_allclose(found.mean(axis=0) / expected.mean(axis=0), 1, atol=0.05)
    ratio = found / expected
    assert np.std(ratio) < 0.05
