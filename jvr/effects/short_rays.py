"""Short rays: what the medium within a ball around a point lets through, along rays in all directions."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.march.medium import Medium
from jvr.march.secondary import SecondaryRays, channel_count, secondary_rays, take_midpoint
from jvr.model.clipping import Clipping
from jvr.model.parts import Knob, multiples
from jvr.model.scene import Scene
from jvr.model.transfer import Classified
from jvr.model.volume import Volume
from jvr.numerics import clamp, divide_or_zero, larger, mean_transmittance
from jvr.types import Channels, Scalar, Triple

# Radius and offset where a scene says none, in voxels of the smallest spacing.
RADIUS, OFFSET = 16.0, 1.0
# Azimuth between one direction and the next, the golden angle.
GOLDEN = math.pi * (3 - math.sqrt(5))


class Reach(eqx.Module):
    """How far rays go. `ends`: of their segments, distances from where they begin, all the same where there is nothing between `offset` and
    `radius` of an occlusion; `length`: from the one to the other; `beyond`: the fraction of it that lies behind the last segment, out of
    the volume, which no ray is longer than."""

    ends: Float[Array, "ends"]
    length: Scalar
    beyond: Scalar

    @classmethod
    def of(cls, part: Any, volume: Volume) -> "Reach":
        """How far those of a part with `radius`, `offset` and `samples` go."""
        spacing = jnp.min(volume.spacing)
        offset = OFFSET * spacing if part.offset is None else part.offset
        radius = RADIUS * spacing if part.radius is None else part.radius
        length = larger(radius - offset, 0.0)
        inside = clamp(2 * volume.radius - offset, jnp.zeros_like(length), length)
        ends = offset + inside * jnp.linspace(0.0, 1.0, part.samples + 1, dtype=spacing.dtype)
        return cls(ends, length, divide_or_zero(length - inside, length))


def short_rays(volume: Volume, clipping: Clipping, number: int, p: Float[Array, "nodes 3"]) -> SecondaryRays:
    """A `number` of rays from each of some grid positions in all directions, those of a position one after the other."""
    dtype = volume.slope.dtype
    origin = tuple(jnp.repeat(c.astype(dtype), number) for c in p.T)
    along = tuple(jnp.tile(jnp.asarray(d, dtype), p.shape[0]) for d in _sphere(number).T)
    grid = origin, volume.grid_from_world(along, direction=True)
    return secondary_rays(volume, clipping, (volume.world_from_point(origin), along), grid)


def knobs_of_rays(part: Any, resolution: Knob) -> tuple[Knob, ...]:
    """The knobs of a part with `rays` and `samples` at nodes; of what has been computed beforehand none, since nothing can be saved."""
    if part.is_frozen:
        return ()
    return (
        multiples("rays", part.rays, (1 / 4, 1 / 2, 1), 4, least=1),
        multiples("samples", part.samples, (1 / 4, 1 / 2, 1), 2, least=1),
        resolution,
    )


def _sphere(rays: int) -> Float[np.ndarray, "rays 3"]:
    """Unit directions on a spiral of equal areas."""
    index = np.arange(rays)
    cosine = 1 - (2 * index + 1) / rays
    sine = np.sqrt((1 - cosine) * (1 + cosine))
    return np.stack([sine * np.cos(GOLDEN * index), sine * np.sin(GOLDEN * index), cosine], axis=1)


def mean_light(
    medium: Medium,
    volume: Volume,
    reach: Reach,
    rays: SecondaryRays,
    *,
    lights: Callable[[Triple], list[Channels]] | None = None,
    glow: Scalar | None = None,
) -> Channels:
    """The mean over the length of each ray of the light that comes to its start: of the transmittance, times what each of the `lights` has
    at grid positions of the volume, where these are given; all channels of the first, then of the next. With a `glow` there is more light
    where the medium emits some, `1 + glow` times its emission."""

    def lit(seen: Channels, at: Scalar) -> Channels:
        if lights is None:
            return seen
        p = tuple(jnp.clip(c + at * d, *ends) for c, d, *ends in zip(rays.p, rays.along, *volume.domain, strict=True))
        n = len(seen)
        return tuple(L * T for light in lights(p) for L, T in zip(light * (n // len(light)), seen, strict=True))

    def step(state: tuple[Channels, Channels], ends: tuple[Scalar, Scalar]) -> tuple[tuple[Channels, Channels], None]:
        tau, total = state
        begin, end = ends
        dtau, classified, _ = take_midpoint(medium, volume, rays, begin, end, True)
        before, inside = fractions_inside(rays, begin, end)
        behind = 1 - before - inside
        # Light of the medium's own is attenuated like that from behind it.
        lit_inside = (inside,) * len(tau) if glow is None else tuple(inside * (1 + glow * c) for c in _own_light(classified))
        dtau = dtau * (len(tau) // len(dtau))
        seen = tuple(
            jnp.exp(-t) * (before + own * mean_transmittance(d) + behind * jnp.exp(-d))
            for t, d, own in zip(tau, dtau, lit_inside, strict=True)
        )
        total = tuple(a + b for a, b in zip(total, lit(seen, 0.5 * (begin + end)), strict=True))
        return (tuple(t + d for t, d in zip(tau, dtau, strict=True)), total), None

    zero = (jnp.zeros_like(rays.t_out),) * (channel_count(medium, volume, rays) if glow is None else 3)
    count = len(jax.eval_shape(lambda: lit(zero, reach.length)))
    start = (zero, zero[:1] * count)
    (tau, total), _ = jax.lax.scan(jax.checkpoint(step), start, (reach.ends[:-1], reach.ends[1:]))
    segments = reach.ends.shape[0] - 1
    far = lit(tuple(jnp.exp(-t) for t in tau), reach.ends[-1])
    return tuple((1 - reach.beyond) * c / segments + reach.beyond * t for c, t in zip(total, far, strict=True))


def _own_light(classified: Classified) -> Channels:
    if not classified.emission:
        raise ValueError("nothing glows: give the transfer function emission=..., or leave glow out")
    return classified.emission


def fractions_inside(rays: SecondaryRays, begin: Scalar, end: Scalar) -> tuple[Float[Array, "rays"], Float[Array, "rays"]]:
    """What of a segment of each ray lies before the medium, and in it."""
    enters, leaves = clamp(rays.t_in, begin, end), clamp(rays.t_out, begin, end)
    length = jnp.broadcast_to(end - begin, enters.shape)
    return divide_or_zero(enters - begin, length), divide_or_zero(larger(leaves - enters, 0.0), length)


def sources_of_rays(scene: Scene) -> list[Any]:
    """The parts of a scene that decide what its rays of light pass."""
    volume, graded = scene.volume, scene.transfer.takes_gradient
    parts = [volume.values, volume.gaps, volume.slope, volume.intercept, volume.world_from_grid, volume.interpolation]
    return [parts, scene.transfer, scene.clipping, scene.normals if graded else None]
