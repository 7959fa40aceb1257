"""Rays that surfaces mirror and bend, followed one after the other along the tree of their ways.

A ray that is sent on at a surface becomes two paths: what passes is followed at once, what is mirrored afterwards. One program takes a
step of one path of every ray, a stretch of the medium and the surface at its end, whatever the depth; which step of which path comes next
is known beforehand. Behind opaque surfaces there is nothing, and mirrored paths alone are followed.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from equinox.internal import unvmap_any
from jaxtyping import Array, Bool, Float

from jvr.march.medium import Medium
from jvr.march.segments import channel_counts
from jvr.march.steps import Rays
from jvr.numerics import transformed
from jvr.rendering.geometry import lit_where_rays_end
from jvr.rendering.integrator import Radiance
from jvr.rendering.medium import Prepared, marched
from jvr.rendering.surfaces import Seen, behind_layer, behind_stretch, nothing_seen, spread
from jvr.rendering.trace import behind, enter
from jvr.types import Channels, Triple


class _Path(NamedTuple):
    """A path that begins at the eye or at a surface: how much of what it brings is seen, in each channel, how far from the entry of its ray
    it begins, and whether no mirror lies in between (1, or 0: of what is seen in a mirror, opacity and distance are the mirror's)."""

    rays: Rays
    reached: Any
    clear: Channels
    u: Float[Array, "rays"]
    direct: Float[Array, "rays"]
    on: Bool[Array, "rays"]


class _Step(NamedTuple):
    """One step of paths, each a number: whether the surface at its end mirrors and bends, whether any surface is looked for, which place
    what is mirrored is kept at, and which place the next path is taken from, -1 for the one that passes."""

    specular: Any
    looks: Any
    kept: Any
    following: Any


def _steps(order: int, most: int) -> _Step:
    """The steps of the tree, down its left side first: where no more is mirrored, `most` surfaces are passed."""
    steps: list[tuple[bool, bool, int, int]] = []

    def visit(depth: int) -> None:
        if depth == order:
            steps.extend((False, i < most, order, -1) for i in range(most + 1))
            return
        steps.append((True, True, depth, -1))
        visit(depth + 1)
        steps[-1] = (*steps[-1][:3], depth)
        visit(depth + 1)

    visit(0)
    return _Step(*(np.asarray(column) for column in zip(*steps, strict=True)))


def seen_in_mirrors(prepared: Prepared, medium: Medium, rays: Rays) -> Radiance:
    """What rays bring that surfaces mirror and bend (`jvr.Specular`)."""
    scene = prepared.scene
    surfaces, specular = scene.surfaces, scene.specular
    assert surfaces is not None
    assert specular is not None
    n = max(channel_counts(medium, rays.without_end, prepared.dt)[1], 1)
    zero = jnp.zeros_like(rays.length)
    # A ray that is no number brings none, but is marched.
    path = _Path(rays, surfaces.start(prepared.search, rays.without_end), (zero + 1,) * n, zero, zero + 1, zero == 0)
    seen = nothing_seen(rays, n)
    if surfaces.is_opaque:
        flags = jnp.arange(specular.order + 1) < specular.order

        def reflect(state: tuple[_Path, Seen], flag: Bool[Array, ""]) -> tuple[tuple[_Path, Seen], None]:
            path, seen = state
            seen, mirrored, _ = _walked(prepared, medium, path, seen, _Step(flag, True, 0, 0))
            return (mirrored, seen), None

        (_, seen), _ = jax.lax.scan(reflect, (path, seen), flags)
    else:
        kept = jax.tree.map(lambda x: jnp.broadcast_to(x, (specular.order + 1, *x.shape)), path)

        def follow(state: tuple[_Path, _Path, Seen], step: _Step) -> tuple[tuple[_Path, _Path, Seen], None]:
            path, kept, seen = state
            seen, mirrored, passed = _walked(prepared, medium, path, seen, step)
            kept = jax.tree.map(lambda all, one: all.at[step.kept].set(one), kept, mirrored)
            back = step.following >= 0
            path = jax.tree.map(lambda all, one: jnp.where(back, all[step.following], one), kept, passed)
            return (path, kept, seen), None

        steps = _steps(specular.order, surfaces.most)
        (_, _, seen), _ = jax.lax.scan(follow, (path, kept, seen), steps)
    return _resolved(rays, seen)


def _walked(prepared: Prepared, medium: Medium, path: _Path, seen: Seen, step: _Step) -> tuple[Seen, _Path, _Path]:
    """One step of paths: with what is seen on it, and the paths that go on, mirrored and behind the surface."""

    def walk(path: _Path, seen: Seen) -> tuple[Seen, _Path, _Path]:
        nobody = path._replace(on=jnp.zeros_like(path.on))
        taken = lambda path, seen: _walk(prepared, medium, path, seen, step)
        # A step that nobody takes costs next to nothing.
        return jax.lax.cond(unvmap_any(path.on), taken, lambda _, seen: (seen, nobody, nobody), path, seen)

    # Reverse mode keeps where paths begin, an eighth of the memory, and takes their steps again: no slower than to read it all.
    return jax.checkpoint(walk, prevent_cse=False)(path, seen)


def _walk(prepared: Prepared, medium: Medium, path: _Path, seen: Seen, step: _Step) -> tuple[Seen, _Path, _Path]:
    scene, search = prepared.scene, prepared.search
    surfaces, specular = scene.surfaces, scene.specular
    assert surfaces is not None
    assert specular is not None
    rays = path.rays
    way = rays.without_end._replace(length=jnp.where(path.on, rays.length, 0.0))
    hits = surfaces.next_hit(search, way, path.reached._replace(on=path.reached.on & path.on & step.looks))
    stretch = way._replace(length=jnp.where(hits.found, hits.u, way.length))
    gathered = marched(prepared, medium, stretch)
    local = behind_stretch(nothing_seen(rays, len(path.clear))._replace(u=path.u), gathered)
    before, at = local.clear, path.u + hits.u
    fraction, mirror, onward = specular.deflected(scene.volume, medium, way, hits)
    fraction = jnp.where(step.specular, fraction, 0.0)
    rgb, opacity = surfaces.shown(medium, way, hits)
    nothing = (jnp.zeros_like(at),) * 3
    local = behind_layer(behind_layer(local, nothing, fraction, at), rgb, opacity, at)
    passing = local.clear
    local = _with_end(prepared, rays, local, ~hits.found, path.u)
    assert gathered.steps is not None
    seen = _added(seen, path, local)._replace(steps=seen.steps + hits.steps + gathered.steps)
    through = lambda clear: tuple(a * b for a, b in zip(path.clear, clear, strict=True))
    sent_on = lambda rays, clear, crosses: _Path(
        rays,
        surfaces.leaving(search, rays, hits, crosses),
        clear,
        at,
        path.direct,
        path.on & hits.found & _bright(prepared, clear),
    )
    crosses = jnp.ones_like(path.on)
    mirrored = sent_on(_sent(prepared, medium, way, hits, mirror), through(tuple(c * fraction for c in before)), ~crosses)
    rest = _rest(rays, hits)
    if specular.bends:
        bent = _sent(prepared, medium, way, hits, onward)
        rest = jax.tree.map(lambda a, b: jnp.where(step.specular, a, b), bent, rest)
    return seen, mirrored._replace(direct=jnp.zeros_like(at)), sent_on(rest, through(passing), crosses)


def _bright(prepared: Prepared, clear: Channels) -> Bool[Array, "rays"]:
    """Whether what a path brings can be seen."""
    return jnp.max(jnp.stack(clear), axis=0) > prepared.settings.termination


def _sent(prepared: Prepared, medium: Medium, rays: Rays, hits: Any, direction: Triple) -> Rays:
    """Rays from where others hit a surface, in a direction of the world, to where they leave the volume."""
    p = tuple(jnp.where(hits.found, e + hits.u * d, e) for e, d in zip(rays.entry, rays.direction, strict=True))
    sent = enter(prepared.scene, transformed(prepared.scene.volume.world_from_grid, p), direction)[0]
    return lit_where_rays_end(prepared, medium, sent)


def _rest(rays: Rays, hits: Any) -> Rays:
    """What is left of rays behind where they hit a surface."""
    entry = tuple(e + hits.u * d for e, d in zip(rays.entry, rays.direction, strict=True))
    end = None if rays.end is None else rays.end._replace(distance=rays.end.distance - hits.u)
    return Rays(entry, rays.direction, rays.length - hits.u, end)


def _with_end(prepared: Prepared, rays: Rays, seen: Seen, ends: Bool[Array, "rays"], u: Float[Array, "rays"]) -> Seen:
    """What is seen with what is behind all of it, on paths from `u` on that end there."""
    far, zero = behind(prepared.scene, rays), jnp.zeros_like(u)
    if far is not None:
        light = (jnp.where(ends, T * b, 0.0) for T, b in zip(spread(seen.clear, 3), far, strict=True))
        seen = seen._replace(radiance=tuple(map(jnp.add, seen.radiance, light)))
    if rays.end is not None:
        opaque = jnp.where(ends, rays.end.opaque, 0.0)
        seen = behind_layer(seen, (zero,) * 3, opaque, u + rays.end.distance)
    return seen


def _added(seen: Seen, path: _Path, local: Seen) -> Seen:
    """What is seen with what a step of a path adds to it."""
    weigh = lambda total, clear, own: tuple(a + jnp.where(path.on, T * b, 0.0) for a, T, b in zip(total, clear, own, strict=True))
    direct = tuple(path.direct * T for T in path.clear)
    return seen._replace(
        radiance=weigh(seen.radiance, spread(path.clear, 3), local.radiance),
        opacity=weigh(seen.opacity, direct, local.opacity),
        distance=weigh(seen.distance, direct, local.distance),
    )


def _resolved(rays: Rays, seen: Seen) -> Radiance:
    mean = lambda channels: sum(channels[1:], channels[0]) / len(channels)
    poison = jnp.where(jnp.isnan(rays.length), jnp.nan, 0.0)
    rgb = jnp.stack(seen.radiance, axis=-1) + poison[:, None]
    return Radiance(rgb, jnp.asarray(mean(seen.opacity)) + poison, jnp.asarray(mean(seen.distance)), seen.steps)
