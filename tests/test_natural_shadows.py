"""Light from all around against brute force: directional lights with shadow rays, which know no harmonics and no nodes."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from scenes import rotation

import jvr

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


def lamp_and_sky(name):
    """A disc lamp whose irradiance is pi where it is faced, a sky of radiance 1, or both: as an environment, and as directions with
    irradiance over pi, as `jvr.Lambert` counts it."""
    lamp = jvr.EnvironmentLight.disc(TOWARDS, HALF_ANGLE, math.pi / SOLID_ANGLE)
    sky = jvr.EnvironmentLight.constant(1.0, 3)
    across = np.linalg.svd(TOWARDS[None])[2]
    frame = np.stack([across[1], across[2], TOWARDS])
    of_lamp, of_sky = spiral(8, 1 - math.cos(math.radians(HALF_ANGLE))) @ frame, spiral(32, 2.0)
    return {
        "lamp": (lamp, of_lamp, np.full(8, 1 / 8)),
        "sky": (sky, of_sky, np.full(32, 4 / 32)),
        "both": (lamp + sky, np.concatenate([of_lamp, of_sky]), np.concatenate([np.full(8, 1 / 8), np.full(32, 4 / 32)])),
    }[name]


def brute_force(scene, camera, directions, irradiance):
    """The picture under lights with shadow rays, one after the other, and where it shows the inside of a face."""

    def one(direction, irradiance):
        lit = dataclasses.replace(
            scene,
            lights=(jvr.DirectionalLight(-direction, irradiance * jnp.ones(3)),),
            shading=jvr.Lambert(0.0, 1.0),
            shadows=jvr.ShadowRays(0.5),
        )
        found = jvr.render(lit, camera, SETTINGS)
        return found.rgb[..., 0], found.alpha, found.depth

    one = jax.jit(one)
    pictures = [one(jnp.asarray(d, jnp.float32), jnp.float32(e)) for d, e in zip(directions, irradiance, strict=True)]
    return np.sum([np.asarray(p[0], float) for p in pictures], axis=0), *map(np.asarray, pictures[0][1:])


def view(scene, size):
    center = np.asarray(scene.volume.center)
    eye = center + 1.6 * float(scene.volume.radius) * np.array([1.2, -1.6, 2.0])
    return jvr.PerspectiveCamera.look_at(eye, center, (0, 0, 1), 28.0, size, size)


def seen(scene, camera, alpha, depth):
    """Pixels inside of a face: not at the border of the picture of a body, nor where the volume cuts it."""
    origin, direction = camera.rays(jnp.arange(alpha.size))
    p = np.stack([np.asarray(o) + depth.ravel() * np.asarray(d) for o, d in zip(origin, direction, strict=True)], axis=-1)
    border = 0.16 * scene.volume.shape[0]
    inside = np.all((p > border) & (p < scene.volume.shape[0] - 1 - border), axis=-1).reshape(alpha.shape)
    whole = alpha > 0.98
    around = [np.roll(whole, shift, (0, 1)) for shift in ((0, 1), (0, -1), (1, 0), (-1, 0))]
    return np.all([whole, *around], axis=0) & (inside if np.all(whole[alpha.shape[0] // 2, alpha.shape[1] // 2]) else whole)


def compared(name, which, n, size, transfer):
    """Mean over brute force, and the spread of what is one where both are alike, over pixels that are lit."""
    environment, directions, irradiance = lamp_and_sky(which)
    plain = body(name, n)
    camera = view(plain, size)
    exact, alpha, depth = brute_force(plain, camera, directions, irradiance)
    lit = dataclasses.replace(plain, environment=environment, material=jvr.LambertBRDF(), radiance_transfer=transfer)
    found = np.asarray(jax.jit(jvr.render, static_argnums=2)(lit, camera, SETTINGS).rgb, float)[..., 0]
    wanted = seen(plain, camera, alpha, depth) if name == "half space" else seen_of_body(alpha)
    wanted &= exact > 0.1 * np.max(exact[wanted])
    ratio = found[wanted] / exact[wanted]
    assert wanted.sum() > 30
    return np.sum(found[wanted]) / np.sum(exact[wanted]), np.std(ratio) / np.mean(ratio)
