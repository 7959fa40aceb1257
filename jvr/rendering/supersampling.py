"""Supersampling: several rays a pixel, and what a pixel makes of them (the course notes' section 1.2.3, on aliasing).

A picture of `n x n` rays a pixel, on a regular grid, is that of a camera with so many more pixels, of which pixels are weighted means by a
filter (`jvr.rendering.pixel_filters`). Edges are then as soft as the filter is wide, and what is finer than a pixel is averaged where a
single ray would see a part of it.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.model.camera import AbstractCamera
from jvr.model.parameters import declared
from jvr.numerics import clamp, divide_or_zero
from jvr.rendering.image import Rendering, RenderStats
from jvr.rendering.pixel_filters import AbstractPixelFilter


def finer(camera: AbstractCamera, n: int) -> AbstractCamera:
    """The camera of the same view whose pixels are divided into `n x n`: whatever of it is declared in pixels is `n` times as many."""
    about = {name: field.metadata["parameter"] for name, field in declared(type(camera)).items()}
    in_pixels = {name: n * getattr(camera, name) for name, p in about.items() if "pixels" in (p.unit, p.doc)}
    return dataclasses.replace(camera, **in_pixels)


def filtered(picture: Rendering, n: int, pixel_filter: AbstractPixelFilter) -> Rendering:
    """A picture of `n x n` rays a pixel: weighted means of radiance and opacity, the mean depth of what is seen, and sums of samples of
    each pixel's own rays. At the border the rays that there are count for all."""
    weights = weights_of(pixel_filter, n)
    # Depths are no weighted mean any more where weights cancel.
    positive = np.maximum(weights, 0.0)
    alpha, seen = mean(picture.alpha, weights), mean(picture.alpha, positive)
    depth = jnp.where(seen > 0, divide_or_zero(mean(picture.alpha * picture.depth, positive), seen), 0.0)
    steps = picture.stats.steps.reshape(alpha.shape[0], n, alpha.shape[1], n).sum(axis=(1, 3))
    stats = RenderStats(steps, picture.stats.sampling, picture.stats.shadows)
    is_mean = np.array_equal(weights, positive)
    return Rendering(mean(picture.rgb, weights), alpha if is_mean else clamp(alpha, 0.0, 1.0), depth, stats)


def weights_of(pixel_filter: AbstractPixelFilter, n: int) -> Float[np.ndarray, "pixels n"]:
    """The weights along one axis of the `n` rays of each pixel that is within the filter's radius, of which the one in the middle is that
    which is computed; their sum is 1."""
    beyond = math.ceil(pixel_filter.radius - 0.5)
    x = np.arange(-beyond, beyond + 1)[:, None] + (np.arange(n) + 0.5) / n - 0.5
    within = np.abs(x) <= pixel_filter.radius
    weights = np.zeros(x.shape)
    weights[within] = pixel_filter.weight(x[within])
    return weights / np.sum(weights)


def mean(fine: Float[Array, "_ _ *channels"], weights: Float[np.ndarray, "pixels n"]) -> Float[Array, "_ _ *channels"]:
    """Weighted means of `n x n` rays a pixel, along columns and then along rows."""
    return _along(_along(fine, 0, weights), 1, weights)


def _along(
    fine: Float[Array, "_ _ *channels"], axis: int, weights: Float[np.ndarray, "pixels n"]
) -> Float[Array, "_ _ *channels"]:
    (around, n), fine = weights.shape, jnp.moveaxis(fine, axis, 0)
    size = fine.shape[0] // n
    blocks = fine.reshape(size, n, *fine.shape[1:])
    # What each pixel's rays are to each of its neighbours. Accelerators would round factors to a few digits.
    given = jnp.einsum("in...,dn->di...", blocks, jnp.asarray(weights, fine.dtype), precision=jax.lax.Precision.HIGHEST)
    beyond = around // 2
    padded = jnp.pad(given, [(0, 0), (beyond, beyond), *[(0, 0)] * (fine.ndim - 1)])
    total = sum(padded[d, d : d + size] for d in range(around))
    there = np.pad(np.ones(size), beyond)
    whole = sum(weights[d].sum() * there[d : d + size] for d in range(around))
    return jnp.moveaxis(total / jnp.asarray(whole, fine.dtype).reshape(size, *[1] * (fine.ndim - 1)), 0, axis)
