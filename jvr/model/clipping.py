"""The part of the world that is rendered.

Each part of a clipping leaves a convex region, a half-space or a box, and what all of them leave is rendered: so a ray is inside of it
between two distances, the largest at which it enters one of them and the smallest at which it leaves one.
"""

import abc
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.model.checks import affine, require
from jvr.model.exact import Exact, Remainder
from jvr.model.parameters import assign, parameter
from jvr.model.parts import AbstractPart, PlanEntry
from jvr.model.ranges import DIRECTION, UNLIMITED
from jvr.model.volume import Volume
from jvr.numerics import direction_and_length, dot, inverse_of_axes, larger, ray_box, smaller, turned
from jvr.types import Affine, ArrayLike, Scalar, Triple, Vector

# Where a ray begins, and its direction for each unit of world length.
Line: TypeAlias = tuple[Triple, Triple]
Interval: TypeAlias = tuple[Float[Array, "..."], Float[Array, "..."]]


class AbstractClipping(AbstractPart):
    """A convex region of the world; what lies outside of it is not rendered."""

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        return (PlanEntry(name, True, f"rays are cut by a {type(self).__name__}"),)

    @abc.abstractmethod
    def moved(self, origin: Exact) -> "AbstractClipping":
        """The same region in a world whose origin is at `origin`."""

    @abc.abstractmethod
    def interval(self, line: Line) -> Interval:
        """Distances at which a ray of the world enters and leaves it, as those of `jvr.numerics.ray_box`."""

    @abc.abstractmethod
    def outward(self, x: Triple, weight: Callable[[Scalar], Scalar]) -> tuple[Triple, Scalar]:
        """Of a point inside: the sum of the outward unit normals of the faces near it, each with the `weight` of how deep behind it the
        point lies, and the largest of the weights."""


# What a scene takes: one part or several.
Clipping: TypeAlias = AbstractClipping | tuple[AbstractClipping, ...] | None


def parts_of_clipping(clipping: Clipping) -> tuple[AbstractClipping, ...]:
    """One part, several or none as a row of them."""
    return clipping if isinstance(clipping, tuple) else () if clipping is None else (clipping,)


def moved_clipping(clipping: Clipping, origin: Exact) -> Clipping:
    """The same parts in a world whose origin is at `origin`."""
    moved = tuple(part.moved(origin) for part in parts_of_clipping(clipping))
    return moved if isinstance(clipping, tuple) else next(iter(moved), None)


class ClippingBox(AbstractClipping):
    """A box; what lies outside of it is not rendered.

    **Arguments:** `lower`, `upper`: `(3,)`, differentiable (moving a face changes where rays enter and leave); `world_from_box`: 4x4
    affine from the coordinates of these corners to the world, differentiable, so that a box may be oblique, or `None`: those of the world;
    `remainders`: of corners that JAX holds already (see `jvr.model.exact`).
    **Raises** `ValueError` where `lower` is not below `upper` on every axis, and for a singular transform.
    """

    lower: Vector = parameter(UNLIMITED, doc="x, y, z", unit="mm")
    upper: Vector = parameter(UNLIMITED, doc="x, y, z", unit="mm")
    world_from_box: Affine | None = parameter(doc="rows of an affine transform to the world")
    remainders: tuple[Remainder, ...] = parameter(doc="what single precision leaves of the corners, or of the transform")

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        world_from_box: ArrayLike | None = None,
        remainders: tuple[Remainder, ...] | None = None,
    ):
        assign(self, lower=lower, upper=upper)
        require(self.upper - self.lower, lambda d: d > 0, "ClippingBox needs lower < upper on every axis")
        matrix = self.world_from_box = None if world_from_box is None else affine(world_from_box, "world_from_box")
        # Positions in the world are what is far away: those of the corners, or that of the box.
        placed = [(lower, self.lower), (upper, self.upper)] if matrix is None else [(world_from_box, matrix)]
        given = remainders or (None,) * len(placed)
        self.remainders = tuple(Remainder.left(*pair, rest) for pair, rest in zip(placed, given, strict=True))

    def moved(self, origin: Exact) -> "ClippingBox":
        if self.world_from_box is not None:
            matrix, (remainder,) = self.world_from_box, self.remainders
            at = Exact(matrix[:3, 3], remainder.beside(matrix)[:3, 3]).minus(origin).rounded()
            return ClippingBox(self.lower, self.upper, world_from_box=matrix.at[:3, 3].set(at))
        corners = zip((self.lower, self.upper), self.remainders, strict=True)
        # A face that is infinitely far away stays there.
        lower, upper = (jnp.where(jnp.isfinite(x), Exact(x, rest.beside(x)).minus(origin).rounded(), x) for x, rest in corners)
        return ClippingBox(lower, upper)

    def interval(self, line: Line) -> Interval:
        if self.world_from_box is not None:
            inverse = self._box_from_world(self.world_from_box)
            line = turned(inverse, self._beside(line[0], self.world_from_box)), turned(inverse, line[1])
        return ray_box(*line, tuple(self.lower), tuple(self.upper))

    def outward(self, x: Triple, weight: Callable[[Scalar], Scalar]) -> tuple[Triple, Scalar]:
        """Detached: which of two opposite faces is nearer."""
        matrix, scales, rows = self.world_from_box, (1.0,) * 3, None
        if matrix is not None:
            inverse = self._box_from_world(matrix)
            rows, x = [tuple(row) for row in inverse], turned(inverse, self._beside(x, matrix))
            scales = tuple(1 / jnp.sqrt(dot(row, row)) for row in rows)
        along, fraction = [], jnp.zeros_like(x[0])
        for c, low, high, scale in zip(x, self.lower, self.upper, scales, strict=True):
            from_low = c - low < high - c
            depth = jnp.where(from_low, c - low, high - c)
            near = weight(depth if matrix is None else depth * scale)
            along.append(jnp.where(from_low, -near, near))
            fraction = jnp.maximum(fraction, near)
        if rows is None:
            return tuple(along), fraction
        # A face is across the direction in which its coordinate grows fastest.
        turn = lambda i: sum((a * s * row[i] for a, s, row in zip(along, scales, rows, strict=True)), jnp.zeros_like(fraction))
        return tuple(turn(i) for i in range(3)), fraction

    def _beside(self, x: Triple, matrix: Affine) -> Triple:
        return tuple(c - matrix[i, 3] for i, c in enumerate(x))

    def _box_from_world(self, matrix: Affine) -> Float[Array, "3 3"]:
        return inverse_of_axes(matrix[:3, :3])


class ClippingPlane(AbstractClipping):
    """A plane; what its normal points to is cut away.

    **Arguments:** `point`: `(3,)`, any point of the plane in the world; `normal`: `(3,)`, of any length but zero. Both differentiable:
    moving or turning the plane changes where rays enter and leave. `remainder`: of a point that JAX holds already (see `jvr.model.exact`).
    **Raises** `ValueError` for a normal without a direction, numbers that are not finite, and other shapes.
    """

    point: Vector = parameter(doc="x, y, z of a point of the plane", unit="mm")
    normal: Vector = parameter(DIRECTION, doc="x, y, z, to the side that is cut away")
    remainder: Remainder = parameter(doc="what single precision leaves of the point")

    def __init__(self, point: ArrayLike, normal: ArrayLike, *, remainder: Remainder | None = None):
        assign(self, point=point, normal=normal)
        self.remainder = Remainder.left(point, self.point, remainder)

    def remarks(self, name: str, scene: Any, stats: Any) -> Iterator[str]:
        volume = scene.volume
        x, y, z = (c.ravel() for c in jnp.meshgrid(*map(jnp.asarray, zip(*volume.domain, strict=True)), indexing="ij"))
        height = np.asarray(self._height(volume.world_from_point((x, y, z))))
        if np.all(height > 0):
            yield f"{name} cuts all of the volume away: turn its normal round, or move its point"
        elif np.all(height <= 0):
            yield f"{name} cuts nothing of the volume away"

    def moved(self, origin: Exact) -> "ClippingPlane":
        point = Exact(self.point, self.remainder.beside(self.point)).minus(origin).rounded()
        return ClippingPlane(point, self.normal)

    def interval(self, line: Line) -> Interval:
        x, direction = line
        height, climb = self._height(x), dot(self._unit(), direction)
        # As in `ray_box`: a ray along the plane is inside always or never, and its quotient is not formed.
        parallel = jnp.abs(climb) <= jnp.finfo(climb.dtype).eps ** 2
        at = -height / jnp.where(parallel, 1.0, climb)
        outside = parallel & (height > 0)
        enter = jnp.where(outside, jnp.inf, jnp.where(~parallel & (climb < 0), at, -jnp.inf))
        leave = jnp.where(outside, -jnp.inf, jnp.where(~parallel & (climb > 0), at, jnp.inf))
        return enter, leave

    def outward(self, x: Triple, weight: Callable[[Scalar], Scalar]) -> tuple[Triple, Scalar]:
        near = weight(-self._height(x))
        return tuple(near * n for n in self._unit()), near

    def _unit(self) -> Triple:
        return direction_and_length((self.normal[0], self.normal[1], self.normal[2]))[0]

    def _height(self, x: Triple) -> Float[Array, "..."]:
        """How far a point lies on the side that is cut away."""
        return dot(self._unit(), tuple(c - p for c, p in zip(x, self.point, strict=True)))


def interval_inside(volume: Volume, clipping: Clipping, world: Line, grid: Line) -> Interval:
    """Distances at which a ray enters and leaves what is rendered of a volume, as those of `jvr.numerics.ray_box`. `world`, `grid`: the ray
    in coordinates of either."""
    near, far = ray_box(*grid, *volume.domain)
    for part in parts_of_clipping(clipping):
        enters, leaves = part.interval(world)
        near, far = larger(near, enters), smaller(far, leaves)
    return near, far
