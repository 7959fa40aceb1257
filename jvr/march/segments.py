"""One segment of every ray of a wavefront: which one comes next, what it emits and absorbs, and how much light reaches it."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jvr.march.medium import DENSEST, Medium
from jvr.march.steps import Point, Rays, Sample, Transmittances, points_at, segment_count, segment_span
from jvr.model.transfer import Classified
from jvr.numerics import materialise, mean_depth
from jvr.types import Channels, Scalar

# Skips before a ray is started.
FIRST_SKIPS = 8


class ActiveRays(NamedTuple):
    """Rays of a wavefront: their indices in the whole batch and their numbers of segments."""

    rays: Rays
    ray: Int[Array, "rays"]
    segments: Int[Array, "rays"]


class SegmentBatch(NamedTuple):
    """One segment of every ray: its index, the distance of its middle from the entry, its length, and whether it is there."""

    rays: Rays
    ray: Int[Array, "rays"]
    k: Int[Array, "..."]
    u: Float[Array, "rays"]
    extent: Float[Array, "rays"]
    inside: Bool[Array, "rays"]


def active_rays(rays: Rays, dt: Scalar) -> ActiveRays:
    """All rays, numbered."""
    count = segment_count(rays.length, dt)
    return ActiveRays(rays, jnp.arange(count.size, dtype=jnp.int32), count)


def skip(medium: Medium, active: ActiveRays, dt: Scalar, k: Int[Array, "rays"]) -> Int[Array, "rays"]:
    """The next segment, from `k` on, that may have a sample in a visible brick, or the number of segments."""
    if medium.occupancy is None:
        return k
    extent, u = segment_span(k, active.segments, active.rays.length, dt)
    within = len(medium.shader.quadrature_nodes) > 1
    first = u - extent / 2 if within else u
    return jnp.minimum(k + medium.occupancy.skip(active.rays, first, dt, within=within), active.segments)


def first_visible(medium: Medium, active: ActiveRays, dt: Scalar) -> Int[Array, "rays"]:
    """The segment that each ray starts with: a few skips on from its entry. Most of the rays that see nothing end here, and what is
    left of the others says better how long they will take."""
    first = jnp.zeros_like(active.segments)
    if medium.occupancy is None:
        return first
    return jax.lax.fori_loop(0, FIRST_SKIPS, lambda _, k: skip(medium, active, dt, k), first)


def occupied_count(
    medium: Medium, active: ActiveRays, dt: Scalar, k: Int[Array, "rays"], count: Int[Array, "rays"]
) -> Int[Array, "rays"]:
    """`count`, the number of segments, and 0 for rays whose segment `k` is not to be seen. A skip may end in another empty brick; where
    empty means negligible, both directions have to take the same segments."""
    if medium.occupancy is None or not medium.occupancy.is_bounded:
        return count
    _, u = segment_span(k, count, active.rays.length, dt)
    return jnp.where(medium.occupancy.is_occupied(active.rays, u), count, 0)


def take_segment(medium: Medium, active: ActiveRays, dt: Scalar, k: Int[Array, "rays"], count: Int[Array, "rays"]):
    """Emission and optical depth of segment `k` of every ray, and the distance of its midpoint; zero beyond `count`."""
    extent, u = segment_span(k, count, active.rays.length, dt)
    sampled = node_points(medium, active.rays, active.ray, k, u, extent)
    batch = SegmentBatch(active.rays, active.ray, k, u, extent, k < count)
    samples = with_lighting(medium, batch, resample(medium, sampled, k < count), reverse=False)
    point = points_at(active.rays, active.ray, k, u)
    emitted, dtau = jax.vmap(medium.shader.evaluate_segment, in_axes=(None, 0, 0, 0))(medium.transfer, samples, point, extent)
    return emitted, dtau, u


def node_points(
    medium: Medium,
    rays: Rays,
    ray: Int[Array, "rays"],
    k: Int[Array, "..."],
    u: Float[Array, "rays"],
    extent: Float[Array, "rays"],
) -> list[Point]:
    """Where a segment around `u` is resampled."""
    return [points_at(rays, ray, k, u + at * extent if at else u) for at in medium.shader.quadrature_nodes]


def resample(medium: Medium, sampled: list[Point], mask: Bool[Array, "rays"]) -> tuple[Sample, ...]:
    """The field at each quadrature node, once for all channels of the shader; `mask` as in `materialise`, zero where it is false."""
    return tuple(_known(medium, points, mask) for points in sampled)


def _known(medium: Medium, points: Point, mask: Bool[Array, "rays"]) -> Sample:
    """The field at a batch of points. A ray that has no segment there reads some voxel all the same, which may be NaN: what it reads is
    zero, in value and in derivative."""
    sample = materialise(mask, jax.vmap(medium.field.resample)(points))
    return jax.tree.map(lambda x: jnp.where(mask.reshape(-1, *(1,) * (x.ndim - 1)), x, 0.0), sample)


def classify_at(medium: Medium, points: Point, mask: Bool[Array, "points"]) -> tuple[Classified, Sample]:
    """Colour and extinction at a batch of points, and what the shader knows of them; `mask` as in `materialise`."""
    samples = _known(medium, points, mask)
    samples = jax.vmap(medium.shader.in_world, in_axes=(None, 0, 0))(medium.transfer, samples, points)
    return jax.vmap(medium.shader.classify, in_axes=(None, 0))(medium.transfer, samples), samples


def with_lighting(medium: Medium, batch: SegmentBatch, samples: tuple[Sample, ...], *, reverse: bool) -> tuple[Sample, ...]:
    """The samples of a segment with the light that reaches it, where that is asked for."""
    if medium.visibility is None:
        return samples
    shader, middle = medium.shader, points_at(batch.rays, batch.ray, batch.k, batch.u)

    def classify(sample: Sample, point: Point) -> tuple[Channels, Channels]:
        """Extinction, and in the reverse pass how it changes with the scalar."""
        of = lambda s: shader.classify(medium.transfer, shader.in_world(medium.transfer, sample._replace(s=s), point)).sigma_t
        return jax.jvp(of, (sample.s,), (jnp.ones_like(sample.s),)) if reverse else (of(sample.s), ())

    sigma_t, slopes = zip(*(jax.vmap(classify)(sample, middle) for sample in samples), strict=True)
    light = light_at(medium, batch, sum(sigma_t, ()), reverse=reverse, slopes=sum(slopes, ()))
    return tuple(sample._replace(light=light) for sample in samples)


def light_at(
    medium: Medium, batch: SegmentBatch, sigma_t: Sequence[Array], *, reverse: bool, slopes: Sequence[Array] = ()
) -> Transmittances:
    """How much light reaches a segment with these extinctions, and these changes of them with the scalar.

    It is looked up where the segment's own emission comes from on average, in front of its middle: in the middle of an opaque one it
    is dark, though its front is not.
    """
    assert medium.visibility is not None
    dtau = jnp.minimum(sum(sigma_t[1:], sigma_t[0]) / len(sigma_t) * batch.extent, DENSEST)
    u = materialise(batch.inside, batch.u + batch.extent * (mean_depth(dtau) - 0.5))
    points = points_at(batch.rays, batch.ray, batch.k, u)
    # Without extinction there is nothing to see; but where it begins, or nothing is left out, it has a derivative, and between the ends of
    # a segment there may be what is at neither.
    everywhere = medium.occupancy is None or len(medium.shader.quadrature_nodes) > 1
    occupied = functools.reduce(jnp.logical_or, [x != 0 for x in (*sigma_t, *slopes)])
    wanted = batch.inside if everywhere else batch.inside & occupied
    return materialise(batch.inside, medium.visibility.transmittances(points, wanted, reverse=reverse))


def channel_counts(medium: Medium, rays: Rays, dt: Scalar) -> tuple[int, int]:
    """How many channels the medium emits and absorbs in, by shape alone."""
    one = active_rays(jax.tree.map(lambda x: x[:1], rays), dt)
    emitted, dtau, _ = jax.eval_shape(lambda: take_segment(medium, one, dt, jnp.zeros_like(one.segments), one.segments))
    return len(emitted), len(dtau)
