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

from jvr.model.by_value import is_varying
from jvr.model.checks import known
from jvr.model.clipping import Line
from jvr.model.exact import Exact
from jvr.model.geometry import AbstractGeometry, Face, Met
from jvr.model.material import HarmonicMaterial, MaterialByValue
from jvr.model.parameters import assign, choice, parameter
from jvr.model.parts import PlanEntry
from jvr.model.ranges import RADIANCE
from jvr.numerics import cross, direction_and_length, dot
from jvr.types import ArrayLike, Triple

# Triangles in a block, and rays that look at a block together.
BLOCK, TOGETHER = 32, 1024
# Steps along each axis of the curve that puts neighbouring triangles into one block.
STEPS = 1024
# How far beyond an edge a ray still meets a triangle, of its sides: between two that share an edge no ray gets through.
EDGE = 1e-6
# How far above a triangle rays to lights begin, in roundings of the largest number that goes into where it was met.
LIFT = 64
# Roundings of the product of its sides below which the volume of a triangle and a ray's direction is none.
FLAT = 8


class Mesh(AbstractGeometry):
    """Opaque geometry as triangles, seen from both sides.

    Without lights and shading it shows its `rgb`, as the medium does; with them each triangle is shaded by the scene's `shading`, or its
    `material` under environment lighting, with its own normal on the side of the eye. In a scene with `shadows` it shades the medium,
    isosurfaces and itself, and lies in the shadows of all of these: a ray from each point that is seen to each light, by the scene's
    `jvr.ShadowRays` or, where another method finds the shadows of the medium, by those of default steps. `occlusion` takes ambient light
    from it inside of the volume, but that of isosurfaces takes none.

    **Arguments:** `vertices`: `(n, 3)`, positions in the world; `faces`: `(m, 3)`, whole numbers: which three vertices a triangle has;
    `rgb`: the linear colour of each vertex, `(n, 3)`, between which it is interpolated, or of all, `(3,)`; `lit`: whether lights change
    it; if not, `rgb` is the radiance that is seen.

    Differentiable in `vertices`, also by its normals, and `rgb`, in where rays run, and in the lights and the medium that they pass. Which
    triangle a ray meets is detached: what comes into sight at a silhouette, and how the edges of its shadows move, has no derivative.

    **Raises** `ValueError` for a mesh without faces, vertices that are not finite and faces of vertices that there are not; and in a scene
    whose shading or material goes by the scalar or its gradient, which a mesh does not have.
    """

    faces: Int[Array, "faces 3"]
    vertices: Float[Array, "vertices 3"] = parameter(doc="x, y, z", unit="mm")
    rgb: Float[Array, "..."] = parameter(RADIANCE, doc="colour of each vertex, or of all", shapes=(("vertices", 3), (3,)))
    lit: bool = choice(doc="whether the lights of a scene change it")

    def __init__(self, vertices: ArrayLike, faces: ArrayLike, rgb: ArrayLike, *, lit: bool = True):
        points = known(vertices)
        if points is not None and not np.all(np.isfinite(np.asarray(points, float))):
            raise ValueError("vertices of a mesh must be finite: take those that are not out of it, with their faces")
        assign(self, vertices=vertices, rgb=rgb, lit=lit)
        self.faces = _triangles(faces, len(self.vertices))

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        lit = ", which is lit" if self.lit and scene.shades_surfaces else ""
        return (PlanEntry(name, True, f"rays end at a mesh of {len(self.faces):,} triangles{lit}"),)

    def moved(self, origin: Exact) -> "Mesh":
        vertices = Exact(self.vertices, jnp.zeros_like(self.vertices)).minus(origin).rounded()
        return Mesh(vertices, self.faces, self.rgb, lit=self.lit)

    def check_light(self, shading: Any, material: Any) -> None:
        by_scalar = isinstance(material, MaterialByValue | HarmonicMaterial) and material.positions.size > 1
        if self.lit and (by_scalar or is_varying((shading, material))):
            raise ValueError(
                "a mesh has no scalar or gradient for a shading or a material to go by: give numbers, or jvr.Mesh(..., lit=False)"
            )

    def hit(
        self,
        rays: Line,
        behind: Float[Array, "rays"] | float,
        nearest: Float[Array, "rays"] | float,
        pixels: Int[Array, "rays"] | None,
    ) -> Met:
        found = first_triangle(self, rays, jnp.broadcast_to(nearest, rays[0][0].shape))
        corners = self.faces[jnp.maximum(found, 0)]
        triangles = _components(self.vertices[corners])
        t, weights = _meet(triangles, rays)
        at = lambda c: self.rgb[c] if self.rgb.ndim == 1 else dot(weights, tuple(self.rgb[corners[:, i], c] for i in range(3)))
        rgb = tuple(jnp.broadcast_to(at(c), t.shape) for c in range(3))
        face = _face(triangles, rays, jnp.where(found < 0, 0.0, t)) if self.lit else None
        return Met(jnp.where(found < 0, jnp.inf, t), rgb, face)


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
    """How far along rays the planes of triangles are, and the weights of the corners there, -1 for rays along a plane, and
    for triangles without area."""
    origin, direction = rays
    first, second, third = corners
    side, other, offset = _minus(second, first), _minus(third, first), _minus(origin, first)
    p, q = cross(direction, other), cross(offset, side)
    volume = dot(side, p)
    # What rounding leaves of no volume: of a triangle without area, and of a ray in its plane.
    size = lambda v: jnp.maximum(jnp.maximum(jnp.abs(v[0]), jnp.abs(v[1])), jnp.abs(v[2]))
    flat = jnp.abs(volume) <= jax.lax.stop_gradient(FLAT * jnp.finfo(volume.dtype).eps * size(side) * size(other))
    inverse = jnp.where(flat, 0.0, 1.0 / jnp.where(flat, 1.0, volume))
    u, v = dot(offset, p) * inverse, dot(direction, q) * inverse
    weights = tuple(jnp.where(flat, -1.0, w) for w in (1 - u - v, u, v))
    return dot(other, q) * inverse, weights


def _face(corners: tuple[Triple, ...], rays: Line, t: Float[Array, "rays"]) -> Face:
    """What light falls on where rays meet triangles at a distance."""
    origin, direction = rays
    first, second, third = corners
    # Of unit sides, whose products neither overflow nor underflow.
    side, other = (direction_and_length(_minus(corner, first))[0] for corner in (second, third))
    normal, _ = direction_and_length(cross(side, other))
    away = dot(normal, direction) > 0
    normal = tuple(jnp.where(away, -c, c) for c in normal)
    largest = functools.reduce(jnp.maximum, (jnp.abs(c) for point in (origin, *corners) for c in point), jnp.abs(t))
    lift = jax.lax.stop_gradient(LIFT * jnp.finfo(t.dtype).eps * largest)
    x = tuple(o + t * d + lift * n for o, d, n in zip(origin, direction, normal, strict=True))
    return Face(x, normal, tuple(-d for d in direction))


def _minus(a: Triple, b: Triple) -> Triple:
    return tuple(x - y for x, y in zip(a, b, strict=True))


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
