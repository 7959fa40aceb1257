"""Triangle meshes as opaque geometry: which triangle a ray meets first, by blocks of triangles with boxes around them, and where.

The search is detached. Where a ray meets the triangle that was found is computed anew, by Möller and Trumbore 1997 ("Fast, minimum storage
ray-triangle intersection"), and is differentiable.
"""

import functools
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jvr.model.checks import known
from jvr.model.clipping import Line
from jvr.model.exact import Exact
from jvr.model.geometry import AbstractGeometry
from jvr.model.parameters import assign, parameter
from jvr.model.parts import PlanEntry
from jvr.model.ranges import RADIANCE
from jvr.numerics import cross, dot
from jvr.types import ArrayLike, Triple

# Triangles in a block, and rays that look at a block together.
BLOCK, TOGETHER = 32, 1024
# Steps along each axis of the curve that puts neighbouring triangles into one block.
STEPS = 1024
# How far beyond an edge a ray still meets a triangle, of its sides: between two that share an edge no ray gets through.
EDGE = 1e-6


class Mesh(AbstractGeometry):
    """Opaque geometry as triangles, seen from both sides in its own colours; lights do not change them. It shades the medium: it ends the
    rays of the lights of a scene with shadows, and no derivative knows how its shadows move.

    **Arguments:** `vertices`: `(n, 3)`, positions in the world; `faces`: `(m, 3)`, whole numbers: which three vertices a triangle has;
    `rgb`: the linear radiance of each vertex, `(n, 3)`, between which it is interpolated, or of all, `(3,)`. Differentiable in `vertices`
    and `rgb`, and in where rays run; which triangle a ray meets is detached: what comes into sight at a silhouette has no derivative.

    **Raises** `ValueError` for a mesh without faces, vertices that are not finite and faces of vertices that there are not.
    """

    faces: Int[Array, "faces 3"]
    vertices: Float[Array, "vertices 3"] = parameter(doc="x, y, z", unit="mm")
    rgb: Float[Array, "..."] = parameter(RADIANCE, doc="radiance of each vertex, or of all", shapes=(("vertices", 3), (3,)))

    def __init__(self, vertices: ArrayLike, faces: ArrayLike, rgb: ArrayLike):
        points = known(vertices)
        if points is not None and not np.all(np.isfinite(np.asarray(points, float))):
            raise ValueError("vertices of a mesh must be finite: take those that are not out of it, with their faces")
        assign(self, vertices=vertices, rgb=rgb)
        self.faces = _triangles(faces, len(self.vertices))

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        return (PlanEntry(name, True, f"rays end at a mesh of {len(self.faces):,} triangles"),)

    def moved(self, origin: Exact) -> "Mesh":
        return Mesh(Exact(self.vertices, jnp.zeros_like(self.vertices)).minus(origin).rounded(), self.faces, self.rgb)

    def hit(
        self,
        rays: Line,
        behind: Float[Array, "rays"] | float,
        nearest: Float[Array, "rays"] | float,
        pixels: Int[Array, "rays"] | None,
    ) -> tuple[Float[Array, "rays"], Triple]:
        found = first_triangle(self, rays, jnp.broadcast_to(nearest, rays[0][0].shape))
        corners = self.faces[jnp.maximum(found, 0)]
        t, weights = _meet(_components(self.vertices[corners]), rays)
        at = lambda c: self.rgb[c] if self.rgb.ndim == 1 else dot(weights, tuple(self.rgb[corners[:, i], c] for i in range(3)))
        rgb = tuple(jnp.broadcast_to(at(c), t.shape) for c in range(3))
        return jnp.where(found < 0, jnp.inf, t), rgb


class _Blocks(NamedTuple):
    """Triangles in blocks, `BLOCK` each, whose places are near each other: their corners, their numbers, and the box around each block."""

    corners: Float[Array, "blocks triangles 3 3"]
    number: Int[Array, "blocks triangles"]
    lower: Float[Array, "blocks 3"]
    upper: Float[Array, "blocks 3"]


# The nearest distance at which each ray has met a triangle so far, and the index of that.
_Best: TypeAlias = tuple[Float[Array, "rays"], Int[Array, "rays"]]
# Rays, and how near they may meet anything.
_Some: TypeAlias = tuple[Line, Float[Array, "rays"]]


def first_triangle(mesh: Mesh, rays: Line, nearest: Float[Array, "rays"]) -> Int[Array, "rays"]:
    """The index of the triangle that each ray meets first, from a distance on, or -1."""
    mesh, *some = jax.lax.stop_gradient((mesh, rays, nearest))
    blocks, count = _blocks(mesh), nearest.size
    together = min(TOGETHER, count)
    split = lambda x: jnp.pad(x, (0, -count % together), mode="edge").reshape(-1, together)

    def of_some(some: _Some) -> Int[Array, "rays"]:
        nearest = some[1]

        def look(best: _Best, block: _Blocks) -> tuple[_Best, None]:
            enters, leaves = _through_box(tuple(block.lower), tuple(block.upper), some[0])
            wanted = (leaves >= jnp.maximum(enters, nearest)) & (enters <= best[0])
            return jax.lax.cond(jnp.any(wanted), _look_at, lambda best, *_: best, best, block, some), None

        start = jnp.full_like(nearest, jnp.inf), jnp.full(nearest.shape, -1, jnp.int32)
        return jax.lax.scan(look, start, blocks)[0][1]

    return jax.lax.map(of_some, jax.tree.map(split, tuple(some))).reshape(-1)[:count]


def _look_at(best: _Best, block: _Blocks, some: _Some) -> _Best:
    """The nearest of what was met before and the triangles of a block."""
    rays, nearest = some
    t, weights = _meet(jax.tree.map(lambda x: x[:, None], _components(block.corners)), rays)
    least = jnp.minimum(jnp.minimum(weights[0], weights[1]), weights[2])
    t = jnp.where((least >= -EDGE) & (t >= nearest), t, jnp.inf)
    one = jnp.argmin(t, axis=0)
    nearer = jnp.min(t, axis=0)
    return jnp.minimum(nearer, best[0]), jnp.where(nearer < best[0], block.number[one], best[1])


def _components(corners: Float[Array, "*many 3 3"]) -> tuple[Triple, ...]:
    """Three corners of each triangle, by components."""
    return tuple(tuple(corners[..., i, axis] for axis in range(3)) for i in range(3))


def _meet(corners: tuple[Triple, ...], rays: Line) -> tuple[Float[Array, "..."], Triple]:
    """How far along rays the planes of triangles are, and the weights of the corners there, -1 for rays along a plane."""
    origin, direction = rays
    first, second, third = corners
    minus = lambda a, b: tuple(x - y for x, y in zip(a, b, strict=True))
    side, other, offset = minus(second, first), minus(third, first), minus(origin, first)
    p, q = cross(direction, other), cross(offset, side)
    volume = dot(side, p)
    flat = volume == 0
    inverse = jnp.where(flat, 0.0, 1.0 / jnp.where(flat, 1.0, volume))
    u, v = dot(offset, p) * inverse, dot(direction, q) * inverse
    weights = tuple(jnp.where(flat, -1.0, w) for w in (1 - u - v, u, v))
    return dot(other, q) * inverse, weights


def _through_box(lower: Triple, upper: Triple, rays: Line) -> tuple[Float[Array, "rays"], Float[Array, "rays"]]:
    """Where lines enter and leave a box: nowhere, or everywhere along an axis, for those that run across it."""
    lows, highs = [], []
    for low, high, o, d in zip(lower, upper, *rays, strict=True):
        still, within = d == 0, (o >= low) & (o <= high)
        inverse = 1.0 / jnp.where(still, 1.0, d)
        a, b = (low - o) * inverse, (high - o) * inverse
        lows.append(jnp.where(still, jnp.where(within, -jnp.inf, jnp.inf), jnp.minimum(a, b)))
        highs.append(jnp.where(still, jnp.where(within, jnp.inf, -jnp.inf), jnp.maximum(a, b)))
    return functools.reduce(jnp.maximum, lows), functools.reduce(jnp.minimum, highs)


def _blocks(mesh: Mesh) -> _Blocks:
    """The triangles of a mesh along a curve that keeps neighbours together (Morton 1966), so many at a time."""
    corners = mesh.vertices[mesh.faces]
    middle = jnp.mean(corners, axis=1)
    low, high = jnp.min(middle, axis=0), jnp.max(middle, axis=0)
    step = jnp.clip((middle - low) / jnp.where(high > low, high - low, 1.0) * STEPS, 0, STEPS - 1).astype(jnp.int32)
    bits = range(STEPS.bit_length() - 1)
    code = sum(
        (((step[:, axis] >> bit) & 1) << (3 * bit + axis) for bit in bits for axis in range(3)), jnp.zeros_like(step[:, 0])
    )
    order = jnp.argsort(code)
    # The last one again fills the last block up.
    order = jnp.pad(order, (0, -len(order) % BLOCK), mode="edge").reshape(-1, BLOCK)
    placed = corners[order]
    lower, upper = jnp.min(placed, axis=(1, 2)), jnp.max(placed, axis=(1, 2))
    # Boxes around flat blocks, too, hold what is met a rounding beside them.
    margin = EDGE * (upper - lower + jnp.max(high - low))
    return _Blocks(placed, order.astype(jnp.int32), lower - margin, upper + margin)


def _triangles(faces: ArrayLike, vertices: int) -> Int[Array, "faces 3"]:
    """Indices of corners, checked."""
    given = known(faces)
    if given is not None and (given.ndim != 2 or given.shape[1] != 3 or not len(given)):
        if given.size == 0:
            raise ValueError("a mesh has at least one face: leave geometry out where there is none")
        raise ValueError(f"faces has shape {given.shape}; it must be (n, 3): split what has more corners into triangles")
    if given is not None and given.dtype.kind not in "iu":
        raise ValueError(f"faces must be whole numbers, indices of vertices, not {given.dtype}")
    if given is not None and (given.min() < 0 or given.max() >= vertices):
        wrong = given[(given < 0) | (given >= vertices)].flat[0]
        raise ValueError(f"a face has the vertex {wrong}, and they are 0 to {vertices - 1}: counting begins at 0")
    return jnp.asarray(faces, jnp.int32)
