"""Panels of the contact sheet: isosurfaces, what is around and in a volume, and the light that near matter takes."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

import jvr
from experiments.contact_subjects import Subject
from jvr.model.harmonics.projection import map_directions

# Rows of the surroundings, in pixels.
ROWS = 512
# Linear colours of their floor, of the horizon and of what is straight above.
DARK, BRIGHT, HORIZON, ABOVE = np.array([[0.05, 0.05, 0.06], [0.42, 0.38, 0.32], [0.75, 0.75, 0.72], [0.06, 0.18, 0.55]])
# Corners of an octahedron, and of its triangles.
CORNERS = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
FACES = [[i, j, k] for i in (0, 1) for j in (2, 3) for k in (4, 5)]


def surfaces(of: Subject) -> dict[str, jvr.Scene]:
    """Isosurfaces without a medium: opaque, blended, mirrors and glass, and what their BSDFs make of light."""
    outer, inner = of.isovalues
    skin, bone = of.colours
    one = jvr.Isosurfaces([inner], [bone])
    change = lambda surfaces, **parts: dataclasses.replace(of.scene, transfer=jvr.ClearTransfer(), surfaces=surfaces, **parts)
    smooth = jvr.Isosurfaces([of.smooth], [skin if of.smooth == outer else bone])
    # From behind on the left.
    behind = (jvr.DirectionalLight(of.beside(0.3, 0.0, 1.0) - of.beside(0.0, 0.3, 0.0), 1.2), jvr.AmbientLight(0.1))
    translucent = jvr.PhenomenologicalBSDF(0.4, 0.1, 0.4, 30.0, 8.0, index=1.4)
    brushed = jvr.AnisotropicGGX(of.up, 0.15, 0.4, 0.6, 0.25, 0.7)
    return {
        "isosurface, opaque": change(one),
        "isosurfaces, blended": change(jvr.Isosurfaces([outer, inner], [skin, bone], [0.35, 1.0])),
        "mirror": change(smooth, specular=jvr.Specular(0.7, order=2), background=surroundings(of, plain=True)),
        "glass": change(
            jvr.Isosurfaces([outer, inner], [[0.0, 0.0, 0.0], bone], [0.0, 1.0], most=2),
            specular=jvr.Specular(index=[1.3, 1.5], order=2),
            background=surroundings(of),
        ),
        "translucent BSDF, light behind": change(smooth, shading=translucent, lights=behind),
        "anisotropic GGX": change(one, shading=brushed),
    }


def around(of: Subject) -> dict[str, jvr.Scene]:
    """What is behind the volume and in it, what is cut away, and light of its own."""
    change = lambda **parts: dataclasses.replace(of.scene, **parts)
    table, radius = of.table, float(of.scene.volume.radius)
    thin = lambda share: jvr.LutTransfer(table.rgb, share * of.cloud * np.asarray(table.sigma_t), table.domain)
    plane = jvr.ClippingPlane(of.beside(0.12, 0.1, 0.0), of.beside(0.6, 0.5, 0.6) - of.beside(0.0, 0.0, 0.0))
    box = of.scene.clipping
    assert isinstance(box, jvr.ClippingBox)
    bright = 1 + 0.4 * CORNERS @ (of.beside(-0.6, 0.6, 0.6) - of.beside(0.0, 0.0, 0.0))[:, None] / radius
    octahedron = jvr.Mesh(of.beside(0.0, 0.0, 0.0) + 0.3 * radius * CORNERS, FACES, bright * np.array([0.05, 0.45, 0.42]))
    return {
        "environment map behind": change(transfer=thin(3.0), background=surroundings(of)),
        "mesh in the volume": change(transfer=thin(1.5), geometry=octahedron),
        "depth image behind": change(geometry=floor(of)),
        "clipping plane, oblique": change(clipping=(box, plane)),
        "emission: a flame in smoke": change(transfer=flame(of)),
        "piecewise shadows": change(shadows=jvr.PiecewiseShadows()),
    }


def occlusion(of: Subject) -> dict[str, jvr.Scene]:
    """Ambient light alone, of which near matter takes a part, in the medium and on surfaces; and light of a lamp that is scattered on."""
    ambient = dataclasses.replace(of.scene, lights=(jvr.AmbientLight(1.0),), shading=jvr.Lambert(1.0, 0.0))
    bone = dataclasses.replace(
        ambient, transfer=jvr.ClearTransfer(), surfaces=jvr.Isosurfaces([of.isovalues[1]], [of.colours[1]])
    )
    near: Any = {"radius": 0.25 * float(of.scene.volume.radius), "resolution": 0.5}
    change = lambda scene, **parts: dataclasses.replace(scene, **parts)
    return {
        "ambient light, no occlusion": ambient,
        "local occlusion": change(ambient, occlusion=jvr.LocalOcclusion(**near)),
        "histogram occlusion": change(ambient, occlusion=jvr.HistogramOcclusion(bins=32, clusters=4096, **near)),
        "surface, no occlusion": bone,
        "surface occlusion": change(bone, occlusion=jvr.SurfaceOcclusion()),
        "in-scattering": change(of.scene, shadows=jvr.InScattering(bias=0.1, **near)),
    }


def flame(of: Subject) -> jvr.LutTransfer:
    """What is within the inner surface glows and absorbs nothing, in the thin smoke that everything else is."""
    table, (_, inner) = of.table, of.isovalues
    low, high = np.asarray(table.domain)
    at = np.linspace(low, high, len(table.sigma_t))
    heat = np.clip((at - inner) / (0.35 * (at[-1] - inner)), 0, 1)[:, None]
    glow = 5 / float(of.scene.volume.radius) * heat * (np.array([1.0, 0.22, 0.02]) + heat * np.array([0.0, 0.4, 0.15]))
    smoke = np.where(at < inner, 2 * of.cloud * np.asarray(table.sigma_t), 0.0)
    return jvr.LutTransfer(np.full_like(np.asarray(table.rgb), 0.4), smoke, table.domain, glow)


def surroundings(of: Subject, *, plain: bool = False) -> jvr.EnvironmentMap:
    """A sky over a floor of squares, which fade towards the horizon, or over a plain one, for what curved mirrors would make too small."""
    directions = np.asarray(map_directions(ROWS, 2 * ROWS)[0])
    height = (directions @ of.up)[..., None]
    sky = HORIZON + np.maximum(height, 0) * (ABOVE - HORIZON)
    place = 2.0 * directions[..., :2] / np.maximum(-height, 1e-3)
    ground = HORIZON - np.maximum(-height, 0) * (HORIZON - DARK) if plain else tiles(place, np.maximum(-height, 0), HORIZON)
    return jvr.EnvironmentMap(np.where(height < 0, ground, sky))


def tiles(place: np.ndarray, height: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Colours of a floor of unit squares `(..., 2)` that is seen under the sine of an angle, and what it is far away."""
    squares = np.where(np.sum(np.floor(place), axis=-1, keepdims=True) % 2 == 0, DARK, BRIGHT)
    return far + (1 - np.exp(-np.square(height / 0.12))) * (squares - far)


def floor(of: Subject) -> jvr.DepthImage:
    """The same floor right below the volume, as another renderer would see it: distances along the rays of the camera."""
    camera, radius = of.camera, float(of.scene.volume.radius)
    pixels = jnp.arange(camera.width * camera.height, dtype=jnp.int32)
    origin, direction = (np.stack(np.broadcast_arrays(*part), axis=-1).astype(float) for part in camera.rays(pixels))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    below = np.asarray(of.scene.volume.center) - 0.75 * radius * of.up
    sine = -direction @ of.up
    depth = np.where(sine > 1e-3, (origin - below) @ of.up / np.maximum(sine, 1e-3), np.inf)
    reached = np.isfinite(depth)
    hit = origin + np.where(reached, depth, 0.0)[:, None] * direction
    rgb = tiles((hit - below)[:, :2] / (0.4 * radius), np.maximum(sine, 0.0)[:, None], np.asarray(of.scene.background))
    shape = camera.height, camera.width
    return jvr.DepthImage(depth.reshape(shape), rgb.reshape(*shape, 3))
