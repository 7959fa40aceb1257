"""Rays that meet surfaces on their way: what is behind an opaque one is not marched, others are blended at their place."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jvr.march.march import Marched
from jvr.march.medium import Medium
from jvr.march.segments import channel_counts
from jvr.march.steps import End, Rays
from jvr.numerics import one_minus_exp
from jvr.rendering.integrator import Radiance
from jvr.rendering.medium import Prepared, marched
from jvr.rendering.trace import behind
from jvr.types import Channels


def ended_at_surfaces(prepared: Prepared, medium: Medium, rays: Rays) -> tuple[Rays, Int[Array, "rays"]]:
    """Rays that end where they meet an opaque surface, which is what they see there, and how many samples it took to find it."""
    surfaces = prepared.scene.surfaces
    assert surfaces is not None
    way = rays.without_end
    hits = surfaces.next_hit(prepared.search, way, surfaces.start(prepared.search, way))
    rgb, opaque = surfaces.shown(medium, way, hits)
    end = End(rgb, opaque, hits.u)
    if rays.end is not None:
        end = jax.tree.map(lambda near, far: jnp.where(hits.found, near, far), end, rays.end)
    return rays._replace(length=jnp.where(hits.found, hits.u, rays.length), end=end), hits.steps


class Seen(NamedTuple):
    """What a ray has brought up to the distance `u`: radiance, and for each channel of optical depth transmittance, opacity and
    opacity-weighted distance; `steps`: samples that took."""

    radiance: Channels
    clear: Channels
    opacity: Channels
    distance: Channels
    u: Float[Array, "rays"]
    steps: Int[Array, "rays"]


def nothing_seen(rays: Rays, n: int) -> Seen:
    """The beginning, with `n` channels of optical depth."""
    zero = jnp.zeros_like(rays.length)
    return Seen((zero,) * 3, (zero + 1,) * n, (zero,) * n, (zero,) * n, zero, jnp.zeros_like(rays.length, jnp.int32))


def blended_with_surfaces(prepared: Prepared, medium: Medium, rays: Rays) -> Radiance:
    """What rays bring through surfaces that they meet: stretches of the medium between them, `L <- L1 + T1 (a c + (1 - a) L2)`."""
    settings, surfaces = prepared.settings, prepared.scene.surfaces
    assert surfaces is not None
    way = rays.without_end
    n = max(channel_counts(medium, way, prepared.dt)[1], 1)
    # Not alive, but not to be lost either: a ray that is no number is marched, and brings none.
    start = surfaces.start(prepared.search, way)

    def stretch(state: tuple[Seen, Bool[Array, "rays"], Any], index: Int[Array, ""]) -> tuple[Any, None]:
        seen, on, reached = state
        hits = surfaces.next_hit(prepared.search, way, reached._replace(on=on & (index < surfaces.most) & reached.on))
        end = jnp.where(hits.found, hits.u, way.length)
        entry = tuple(e + seen.u * d for e, d in zip(way.entry, way.direction, strict=True))
        part = Rays(entry, way.direction, jnp.where(on, end - seen.u, 0.0))
        gathered = marched(prepared, medium, part)
        passed = behind_stretch(seen, gathered)
        rgb, opacity = surfaces.shown(medium, way, hits)
        passed = behind_layer(passed, rgb, opacity, hits.u)
        # Where nothing absorbs and no surface is opaque a ray goes on for ever.
        bright = jnp.max(jnp.stack(passed.clear), axis=0) > settings.termination
        on = on & hits.found & bright
        assert gathered.steps is not None
        steps = passed.steps + hits.steps + gathered.steps
        return (passed._replace(u=jnp.where(on, hits.u, passed.u), steps=steps), on, hits.reached), None

    beginning = (nothing_seen(rays, n), start.k == start.k, start)
    (seen, _, _), _ = jax.lax.scan(stretch, beginning, jnp.arange(surfaces.most + 1, dtype=jnp.int32))
    return _resolved(prepared, rays, seen)


def spread(channels: Channels, n: int) -> Channels:
    """One channel or three as `n`."""
    return channels * (n // len(channels))


def behind_stretch(seen: Seen, gathered: Marched) -> Seen:
    """What has been seen behind a stretch of the medium that begins at `seen.u`."""
    tau = gathered.tau or (jnp.zeros_like(seen.u),)
    distance = gathered.distance or (jnp.zeros_like(seen.u),)
    opaque = tuple(map(one_minus_exp, tau))
    radiance = seen.radiance
    if gathered.radiance:
        radiance = tuple(L + T * c for L, T, c in zip(radiance, spread(seen.clear, 3), gathered.radiance, strict=True))
    opacity = tuple(a + T * o for a, T, o in zip(seen.opacity, seen.clear, opaque, strict=True))
    along = (T * (x + seen.u * o) for T, x, o in zip(seen.clear, distance, opaque, strict=True))
    clear = tuple(T * jnp.exp(-x) for T, x in zip(seen.clear, tau, strict=True))
    return seen._replace(radiance=radiance, clear=clear, opacity=opacity, distance=tuple(map(jnp.add, seen.distance, along)))


def behind_layer(seen: Seen, rgb: Channels, opacity: Float[Array, "rays"], u: Float[Array, "rays"]) -> Seen:
    """What has been seen behind a layer of a colour and an opacity."""
    light = (opacity * T * c for T, c in zip(spread(seen.clear, 3), rgb, strict=True))
    return seen._replace(
        radiance=tuple(map(jnp.add, seen.radiance, light)),
        clear=tuple(T * (1 - opacity) for T in seen.clear),
        opacity=tuple(a + T * opacity for a, T in zip(seen.opacity, seen.clear, strict=True)),
        distance=tuple(x + T * opacity * u for x, T in zip(seen.distance, seen.clear, strict=True)),
    )


def _resolved(prepared: Prepared, rays: Rays, seen: Seen) -> Radiance:
    """The radiance of rays with what is behind all of it."""
    far, zero = behind(prepared.scene, rays), jnp.zeros_like(rays.length)
    if far is not None:
        seen = seen._replace(radiance=tuple(L + T * b for L, T, b in zip(seen.radiance, spread(seen.clear, 3), far, strict=True)))
    if rays.end is not None:
        seen = behind_layer(seen, (zero,) * 3, rays.end.opaque, rays.end.distance)
    mean = lambda channels: sum(channels[1:], channels[0]) / len(channels)
    poison = jnp.where(jnp.isnan(rays.length), jnp.nan, 0.0)
    rgb = jnp.stack(seen.radiance, axis=-1) + poison[:, None]
    return Radiance(rgb, jnp.asarray(mean(seen.opacity)) + poison, jnp.asarray(mean(seen.distance)), seen.steps)
