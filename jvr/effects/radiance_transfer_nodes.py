"""The projection of radiance transfer at nodes: rays that are sent out from each, and what they carry, as spherical harmonics (Lindemann
and Ropinski 2010, section 4.1)."""

import functools
import itertools
import math
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.effects.environment_lighting import EnvironmentLighting
from jvr.effects.radiance_transfer import RadianceTransfer
from jvr.effects.shading import surface_weight
from jvr.march.medium import Medium
from jvr.march.secondary import SecondaryRays, channel_count, points, secondary_rays, take_midpoint
from jvr.march.segments import classify_at
from jvr.model.clipping import Clipping
from jvr.model.harmonics.basis import basis
from jvr.model.volume import Volume
from jvr.numerics import direction_and_length, one_minus_exp, perpendicular
from jvr.types import Channels, Triple

Numbers: TypeAlias = Float[Array, "..."]

# A change of transparency that is a smaller fraction of `RadianceTransfer.surface` is none: it moves the cone's rim by less than 1e-6.
FLAT = 1e-3
# Of such changes, those of a larger fraction than this have a direction.
DIRECTED = 0.1
# Azimuth between one direction and the next, the golden angle.
GOLDEN = math.pi * (3 - math.sqrt(5))


class Cone(NamedTuple):
    """The part of the sphere that rays of a node are sent into: unit axis in the world, and `sin alpha`."""

    axis: Triple
    sine: Numbers


def project_nodes(
    radiance_transfer: RadianceTransfer,
    volume: Volume,
    clipping: Clipping,
    medium: Medium,
    albedo: EnvironmentLighting | None,
    surfaces: bool,
    p: Float[Array, "nodes 3"],
) -> tuple[Float[Array, "nodes channels bands"], Float[Array, "nodes 4"]]:
    """Coefficients of the radiance transfer at grid positions, and beside each other `solid` and `facing` of `ProjectedRadianceTransfer`.

    **Arguments:** `medium`: what rays pass; `albedo`: where they pick up the material's colour, that under light of one from everywhere;
    `surfaces`: whether the material has a normal, so that light from below it does not count.
    """
    nodes = tuple(p.T.astype(volume.slope.dtype))
    around = _surroundings(radiance_transfer, volume, medium, nodes)
    strength = around.solid * around.strength if surfaces else jnp.zeros_like(around.strength)
    cone = Cone(around.axis, jnp.sin(0.5 * math.pi * (1 - strength)))
    directions = _spread(cone, radiance_transfer.rays)
    wide = lambda c: jnp.broadcast_to(c[:, None], (c.shape[0], radiance_transfer.rays)).ravel()
    along = tuple(d.ravel() for d in directions)
    lift = volume.grid_from_world(tuple(strength * radiance_transfer.lift(volume) * c for c in around.axis), direction=True)
    origins = tuple(c + d for c, d in zip(nodes, lift, strict=True))
    origins = tuple(map(wide, origins))
    grid = origins, volume.grid_from_world(along, direction=True)
    rays = secondary_rays(volume, clipping, (volume.world_from_point(origins), along), grid)
    carried = _carried(radiance_transfer, volume, medium, albedo, rays, tuple(-d for d in along))
    functions = jnp.stack(basis(radiance_transfer.order, directions), axis=-1)
    # Each sample counts by the inverse of its density, 2 pi (1 + sin alpha). Directions without rays count as the mean of those with: no
    # light of theirs is reflected, and a step at the horizon would ring. What is the same from everywhere has no error of the quadrature.
    weight = 2 * math.pi * (1 + cone.sine) / radiance_transfer.rays
    values = jnp.stack([c.reshape(p.shape[0], radiance_transfer.rays) for c in carried], axis=1)
    mean = jnp.mean(values, axis=-1)
    rest = jnp.einsum("ncr,nrb->ncb", values - mean[..., None], functions) * weight[:, None, None]
    coefficients = rest.at[..., 0].add(math.sqrt(4 * math.pi) * mean)
    # Not zero, which says that nothing was projected.
    solid = jnp.maximum(strength, jnp.finfo(strength.dtype).tiny)
    return coefficients, jnp.stack([solid, *(around.directed * c for c in around.axis)], axis=-1)


class Surroundings(NamedTuple):
    """Transparency of a node's width of medium at a node; how much of a surface there is, from 0 to 1, and the unit vector away from the
    medium."""

    solid: Numbers
    strength: Numbers
    directed: Numbers
    axis: Triple


def _surroundings(radiance_transfer: RadianceTransfer, volume: Volume, medium: Medium, p: Triple) -> Surroundings:
    """From the opacity of a node's width of medium at the node and one node further in all 26 directions, by Sobel's weights: both the
    nodes below a surface and those above it know where it faces."""
    width = radiance_transfer.node_width(volume)
    lower, upper = volume.domain
    sides = [(-1, 0, 1) if n > 1 else (0,) for n in volume.shape]
    offsets = np.array(list(itertools.product(*sides)), np.float32)
    weights = np.prod(np.where(offsets == 0, 2.0, 1.0), axis=1)
    step = 1 / radiance_transfer.resolution
    at = [jnp.clip(c[:, None] + step * o, low, high) for c, o, low, high in zip(p, offsets.T, lower, upper, strict=True)]
    flat = tuple(c.ravel() for c in at)
    sigma_t = classify_at(medium, points(flat, flat), jnp.ones(flat[0].shape, bool))[0].sigma_t
    tau = (width * sum(sigma_t[1:], sigma_t[0]) / len(sigma_t)).reshape(p[0].shape[0], -1)
    # Not 1 less the transparency: thin media keep their digits.
    opacity = one_minus_exp(tau)
    differences = []
    for axis, n in enumerate(volume.shape):
        ahead, behind = (weights * (offsets[:, axis] == side) for side in (1, -1))
        if n == 1:
            differences.append(jnp.zeros_like(p[0]))
            continue
        span = jnp.clip(p[axis] + step, 0, n - 1) - jnp.clip(p[axis] - step, 0, n - 1)
        change = opacity @ jnp.asarray((behind - ahead) / ahead.sum(), opacity.dtype)
        differences.append(change / span)
    inverse = volume.axes_inverse
    gradient = tuple(sum((inverse[j, i] * differences[j] for j in range(3)), jnp.zeros_like(p[0])) for i in range(3))
    axis, length = direction_and_length(gradient)
    # Without a surface the axis only turns the spiral; inside of an opaque medium a gradient would be made of roundings.
    flat_there = length * width <= FLAT * radiance_transfer.surface
    axis = tuple(jnp.where(flat_there, fixed, c) for fixed, c in zip((0.0, 0.0, 1.0), axis, strict=True))
    strength = surface_weight(2 * length * width, jnp.asarray(radiance_transfer.surface, length.dtype))
    directed = surface_weight(2 * length * width, jnp.asarray(DIRECTED * radiance_transfer.surface, length.dtype))
    strength, directed = (jnp.where(flat_there, 0.0, x) for x in (strength, directed))
    return Surroundings(jnp.max(opacity, axis=1), strength, directed, axis)


def _spread(cone: Cone, rays: int) -> Triple:
    """Unit directions `(nodes, rays)`, on a spiral of equal areas about each cone's axis."""
    index = jnp.arange(rays, dtype=cone.sine.dtype)
    cosine = 1 - (1 + cone.sine[:, None]) * (index + 0.5) / rays
    sine = jnp.sqrt(jnp.maximum((1 - cosine) * (1 + cosine), 0.0))
    a, b = perpendicular(cone.axis)
    u, v = sine * jnp.cos(GOLDEN * index), sine * jnp.sin(GOLDEN * index)
    return tuple(u * a[i][:, None] + v * b[i][:, None] + cosine * cone.axis[i][:, None] for i in range(3))


def _carried(
    radiance_transfer: RadianceTransfer,
    volume: Volume,
    medium: Medium,
    albedo: EnvironmentLighting | None,
    rays: SecondaryRays,
    toward_origin: Triple,
) -> Channels:
    """What rays carry from far away to where they begin: transmittance, or with bleeding white light behind the colours of what they pass.
    `toward_origin`: unit directions in the world."""
    ends = jnp.asarray(radiance_transfer.boundaries(volume.shape), rays.t_out.dtype) * 2 * volume.radius
    opaque = -math.log(radiance_transfer.termination) if radiance_transfer.termination > 0 else math.inf
    is_clear = lambda tau: functools.reduce(jnp.minimum, tau) < opaque

    def one_step(state: tuple[Channels, Channels], ends: tuple[Numbers, Numbers]) -> tuple[Channels, Channels]:
        tau, colour = state
        dtau, classified, sample = take_midpoint(medium, volume, rays, *ends, is_clear(tau))
        if colour:
            rgb = _colour(classified.rgb, sample, albedo, toward_origin)
            before = [jnp.exp(-t) for t in tau] * (3 // len(tau))
            thick = dtau * (3 // len(dtau))
            colour = tuple(c - T * jnp.expm1(-d) * e for c, T, d, e in zip(colour, before, thick, rgb, strict=True))
        return tuple(t + d for t, d in zip(tau, dtau, strict=True)), colour

    # Checkpointed: the reverse pass computes a step again rather than keep all of its voxels.
    @jax.checkpoint
    def step(state: tuple[Channels, Channels], ends: tuple[Numbers, Numbers]) -> tuple[tuple[Channels, Channels], None]:
        alive = (ends[0] < rays.t_out) & (ends[1] > rays.t_in) & is_clear(state[0])
        return jax.lax.cond(jnp.any(alive), lambda s: one_step(s, ends), lambda s: s, state), None

    zero = jnp.zeros_like(rays.t_out)
    channels = channel_count(medium, volume, rays)
    state = ((zero,) * channels, () if radiance_transfer.bleeding is None else (zero,) * 3)
    (tau, colour), _ = jax.lax.scan(step, state, (ends[:-1], ends[1:]))
    clear = tuple(jnp.exp(-t) for t in tau)
    return tuple(c + T for c, T in zip(colour, clear * (3 // channels), strict=True)) if colour else clear


def _colour(rgb: Triple, sample: Any, albedo: EnvironmentLighting | None, w_o: Triple) -> Triple:
    """What a ray picks up of a sample: the colour of the transfer function, or what the material reflects of light from everywhere."""
    if albedo is None:
        return rgb

    def one(s: Numbers, gradient: Triple, w_o: Triple) -> tuple[Triple, Triple]:
        normal, magnitude = direction_and_length(tuple(-g for g in gradient))
        return albedo.reflect(s, magnitude, normal, w_o, ())

    # A material without a normal asks for no gradient.
    gradient = sample.gradient or (jnp.zeros_like(sample.s),) * 3
    tinted, unmodulated = jax.vmap(one)(sample.s, gradient, w_o)
    return tuple(c * a + b for c, a, b in zip(rgb, tinted, unmodulated, strict=True))
