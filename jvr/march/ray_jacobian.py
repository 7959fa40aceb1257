"""The per-ray Jacobian with respect to where the rays run, out of one replay: what cameras that move need.

A camera acts through the seven numbers of a ray, its entry, direction and length, so that one replay (`jvr.march.adjoint`) for each channel
serves any number of directions that it may move in.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jvr.march.adjoint import replay
from jvr.march.march import Marched, MarchOptions, ReplayRecord, integrate
from jvr.march.medium import Medium
from jvr.march.steps import Rays
from jvr.types import Scalar, Triple


def ray_jacobian(
    options: MarchOptions, medium: Medium, rays: Rays, dt: Scalar, colours: Callable[[Marched], Triple]
) -> tuple[Marched, tuple[Rays, ...]]:
    """The march of `jvr.march.march.march`, and the derivatives of the three `colours` that are made of it, each with respect to the
    numbers of its ray. Detached as in `march`."""
    gathered, record = integrate(options, medium, rays, dt, for_replay=True)
    assert record is not None
    final = lambda radiance, tau: colours(gathered._replace(radiance=radiance, tau=tau))
    found, pull = jax.vjp(final, gathered.radiance, gathered.tau)
    ones, zeros = jnp.ones_like(rays.length), jnp.zeros_like(rays.length)
    pulled = [pull(tuple(ones if i == c else zeros for i in range(3))) for c in range(len(found))]
    if gathered.radiance:
        return gathered, _replayed(medium, rays, dt, record, [Marched(L, tau, (), None) for L, tau in pulled])
    # Where nothing glows, channels are alike but for a factor.
    n = len(gathered.tau)
    alone = [Marched((), tuple(ones if i == c else zeros for i in range(n)), (), None) for c in range(n)]
    depths = _replayed(medium, rays, dt, record, alone)
    scaled = lambda c: jax.tree.map(lambda x: pulled[c][1][c % n] * x, depths[c % n])
    return gathered, tuple(scaled(c) for c in range(3))


def _replayed(medium: Medium, rays: Rays, dt: Scalar, record: ReplayRecord, cotangents: list[Marched]) -> tuple[Rays, ...]:
    wanted = (jax.tree.map(lambda _: None, medium), rays, None)
    fixed = (medium, jax.tree.map(lambda _: None, rays), dt)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *cotangents)
    found = jax.vmap(lambda cotangent: replay(wanted, fixed, record, cotangent)[1])(stacked)
    return tuple(jax.tree.map(lambda x, c=c: x[c], found) for c in range(len(cotangents)))
