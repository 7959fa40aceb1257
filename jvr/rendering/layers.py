"""Layers of a picture: what is known of the first surface that each ray meets, apart, for whoever composites pictures.

A picture of opaque surfaces in a clear medium is the sum of its diffuse and its specular layer, and what is behind where there are none.
"""

import dataclasses
import math

import jax.numpy as jnp
from jaxtyping import Array, Int

from jvr.execution.devices import everywhere, over_rays, program, shares
from jvr.execution.tiles import block_shape, dealt_blocks, in_tiles, picture_of, pixels_of
from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene
from jvr.numerics import transformed
from jvr.rendering.image import Layers, Rendering
from jvr.rendering.medium import Prepared, medium, prepare
from jvr.rendering.render import render
from jvr.rendering.settings import Settings
from jvr.rendering.trace import camera_rays, near_volume
from jvr.types import Channels, Scalar


def render_layers(scene: Scene, camera: AbstractCamera, settings: Settings = Settings()) -> Rendering:
    """`jvr.render`, with `Rendering.layers` of the first of the scene's surfaces that each ray meets, whatever its opacity.

    They are found by a pass of their own, one first hit and its light for each pixel; the picture is that of `jvr.render`. Where surfaces
    are opaque, not `Scene(specular=...)`, and the medium is clear, it is `diffuse + specular`, and the background where nothing is hit.
    Differentiable as `jvr.render` is; detached: which rays hit. **Raises** as `jvr.render`, and `ValueError` for a scene without surfaces
    and for several rays a pixel.
    """
    if scene.surfaces is None:
        raise ValueError("layers are those of surfaces: set jvr.Scene(surfaces=jvr.Isosurfaces(...)), or call jvr.render")
    if settings.pixel_samples != 1:
        raise ValueError("layers are those of one ray a pixel: leave Settings(pixel_samples=...) at 1")
    step, same = settings.step, dataclasses.replace(settings, step=1.0)
    layers = _compiled(scene.current(), camera, same, step)
    return dataclasses.replace(render(scene, camera, settings), layers=layers)


def _layers(scene: Scene, camera: AbstractCamera, settings: Settings, step: Scalar | float) -> Layers:
    origin = scene.volume.origin
    scene, camera = near_volume(scene, camera)
    height, width = camera.height, camera.width
    most = settings.tile // math.prod(block_shape(height, width))

    def share(shared: tuple[AbstractCamera, Prepared], blocks: Int[Array, "blocks"]) -> Layers:
        camera, prepared = shared
        return in_tiles(lambda tile: _of_pixels(prepared, camera, pixels_of(tile, height, width)), blocks, most)

    prepared = prepare(scene, settings, step * jnp.min(scene.volume.spacing))
    rays = everywhere(over_rays(share, (camera, prepared), dealt_blocks(height, width, shares())))
    found = picture_of(rays, height, width, shares())
    # Back in the world of the scene, where something was hit.
    hit = jnp.any(found.normal != 0, axis=-1, keepdims=True)
    return found._replace(position=found.position + jnp.where(hit, origin.rounded(), 0.0))


def _of_pixels(prepared: Prepared, camera: AbstractCamera, pixels: Int[Array, "rays"]) -> Layers:
    """The layers of some pixels, of the world near the volume."""
    surfaces, volume = prepared.scene.surfaces, prepared.scene.volume
    assert surfaces is not None
    way = camera_rays(prepared.scene, camera, pixels)[0].without_end
    hits = surfaces.next_hit(prepared.search, way, surfaces.start(prepared.search, way))
    apart = surfaces.apart(medium(prepared, graded=True), way, hits)
    p = tuple(e + hits.u * d for e, d in zip(way.entry, way.direction, strict=True))
    there = lambda channels: jnp.stack([jnp.where(hits.found, c, 0.0) for c in channels], axis=-1)
    occlusion: Channels = apart.occlusion or (jnp.ones_like(hits.u),)
    return Layers(
        there(transformed(volume.world_from_grid, p)),
        there(apart.normal),
        there((apart.value,)),
        there((apart.gradient_length,)),
        there(apart.diffuse),
        there(apart.specular),
        there(occlusion),
    )


_compiled = program(_layers, static_argnums=2)
