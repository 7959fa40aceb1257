"""The part of the world that is rendered."""

from typing import Any, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.model.checks import require
from jvr.model.exact import Exact, Remainder
from jvr.model.parameters import assign, parameter
from jvr.model.parts import AbstractPart, PlanEntry
from jvr.model.ranges import UNLIMITED
from jvr.model.volume import Volume
from jvr.numerics import larger, ray_box, smaller
from jvr.types import ArrayLike, Triple, Vector

# Where a ray begins, and its direction for each unit of world length.
Line: TypeAlias = tuple[Triple, Triple]


class ClippingBox(AbstractPart):
    """An axis-aligned box in world coordinates; what lies outside of it is not rendered.

    **Arguments:** `lower`, `upper`: `(3,)`, differentiable (moving a face changes where rays enter and leave); `remainders`: of corners
    that JAX holds already (see `jvr.model.exact`).
    **Raises** `ValueError` where `lower` is not below `upper` on every axis.
    """

    lower: Vector = parameter(UNLIMITED, doc="x, y, z", unit="mm")
    upper: Vector = parameter(UNLIMITED, doc="x, y, z", unit="mm")
    remainders: tuple[Remainder, Remainder] = parameter(doc="what single precision leaves of the corners")

    def __init__(self, lower: ArrayLike, upper: ArrayLike, *, remainders: tuple[Remainder, Remainder] | None = None):
        assign(self, lower=lower, upper=upper)
        given = remainders or (None, None)
        self.remainders = (Remainder.left(lower, self.lower, given[0]), Remainder.left(upper, self.upper, given[1]))
        require(self.upper - self.lower, lambda d: d > 0, "ClippingBox needs lower < upper on every axis")

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        return (PlanEntry(name, True, "rays are cut"),)

    def moved(self, origin: Exact) -> "ClippingBox":
        """The same box in a world whose origin is at `origin`."""
        corners = zip((self.lower, self.upper), self.remainders, strict=True)
        # A face that is infinitely far away stays there.
        lower, upper = (jnp.where(jnp.isfinite(x), Exact(x, rest.beside(x)).minus(origin).rounded(), x) for x, rest in corners)
        return ClippingBox(lower, upper)


def interval_inside(
    volume: Volume, clipping: ClippingBox | None, world: Line, grid: Line
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Distances at which a ray enters and leaves what is rendered of a volume, as those of `jvr.numerics.ray_box`. `world`, `grid`: the ray
    in coordinates of either."""
    near, far = ray_box(*grid, *volume.domain)
    if clipping is None:
        return near, far
    enters, leaves = ray_box(*world, tuple(clipping.lower), tuple(clipping.upper))
    return larger(near, enters), smaller(far, leaves)
