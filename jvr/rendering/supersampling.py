"""Supersampling: several rays a pixel, and what a pixel makes of them (the course notes' section 1.2.3, on aliasing).

A pixel is the mean over its area, by the midpoint rule on a regular grid of `n x n` rays (a box filter of a pixel's width). Edges are then
as soft as a pixel is wide, and what is finer than a pixel is averaged where a single ray would see a part of it.
"""

import dataclasses

import jax.numpy as jnp

from jvr.model.camera import AbstractCamera
from jvr.model.parameters import declared
from jvr.numerics import divide_or_zero
from jvr.rendering.image import Rendering, RenderStats


def finer(camera: AbstractCamera, n: int) -> AbstractCamera:
    """The camera of the same view whose pixels are divided into `n x n`: whatever of it is declared in pixels is `n` times as many."""
    about = {name: field.metadata["parameter"] for name, field in declared(type(camera)).items()}
    in_pixels = {name: n * getattr(camera, name) for name, p in about.items() if "pixels" in (p.unit, p.doc)}
    return dataclasses.replace(camera, **in_pixels)


def filtered(picture: Rendering, n: int) -> Rendering:
    """A picture of `n x n` rays a pixel: means of radiance and opacity, the mean depth of what is seen, and sums of samples."""
    blocks = lambda x: x.reshape(x.shape[0] // n, n, x.shape[1] // n, n, *x.shape[2:])
    mean = lambda x: jnp.mean(blocks(x), axis=(1, 3))
    alpha = mean(picture.alpha)
    depth = jnp.where(alpha > 0, divide_or_zero(mean(picture.alpha * picture.depth), alpha), 0.0)
    stats = RenderStats(jnp.sum(blocks(picture.stats.steps), axis=(1, 3)), picture.stats.sampling, picture.stats.shadows)
    return Rendering(mean(picture.rgb), alpha, depth, stats)
