"""First hits of isosurfaces: where they are, against closed forms and dense sampling in double precision, and what is never missed.

Most tests share a shape of volume and a number of rays, and so a program."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

import jvr
from jvr.march.first_hit import next_hit, start
from jvr.march.steps import Rays
from jvr.rendering.medium import bricks

SHAPE, COUNT = (9, 10, 11), 200


def grid(shape=SHAPE):
    return np.indices(shape).astype(float)


def waves():
    """Smooth, with many crossings of 0 on a ray."""
    x, y, z = grid()
    return np.sin(0.9 * x + 0.4) * np.cos(0.7 * y) + 0.6 * np.sin(0.8 * z - 0.3 * x)


def rays_through(count=COUNT, shape=SHAPE, axes=(0, 1, 2)):
    """Lines between points of two opposite faces of a volume in voxels."""
    rng = np.random.default_rng(0)
    a, b = rng.random((3, count)), rng.random((3, count))
    axis, side = rng.choice(axes, size=count), rng.integers(2, size=count)
    a[axis, np.arange(count)], b[axis, np.arange(count)] = side, 1 - side
    last = np.array(shape)[:, None] - 1
    a, b = a * last, b * last
    length = np.linalg.norm(b - a, axis=0)
    as_triple = lambda v: tuple(jnp.asarray(c, float) for c in v)
    return Rays(as_triple(a), as_triple((b - a) / length), jnp.asarray(length, float))


def search_of(values, levels, **choices):
    surfaces = jvr.Isosurfaces(levels, np.ones((len(levels), 3)), **choices)
    volume = jvr.Volume(values)
    scene = jvr.Scene(volume, jvr.LinearTransfer([0, 1], np.ones((2, 3)), [0, 0]), surfaces=surfaces)
    return surfaces.prepare(scene, bricks(volume))


@jax.jit
def first(search, rays):
    return next_hit(search, rays, start(search, rays))


def ends(rays):
    """Where rays enter and which way they go, in double precision."""
    return tuple(np.stack([np.asarray(c, float) for c in v]) for v in (rays.entry, rays.direction))


def along(values, rays, u):
    """The interpolated scalar at distances from the entry, by SciPy."""
    e, d = ends(rays)
    return map_coordinates(values, e[:, None] + u * d[:, None], order=1, mode="nearest")


def truth(values, level, rays, fine=400):
    """Distances to the first crossing by dense sampling and bisection, infinite where there is none."""
    u = np.linspace(0, 1, fine + 1)[:, None] * np.asarray(rays.length, float)
    above = along(values, rays, u) >= level
    crosses = above[1:] != above[:-1]
    k, ray = np.argmax(crosses, axis=0), np.arange(u.shape[1])
    low, high, side = u[k, ray], u[k + 1, ray], above[k, ray]
    for _ in range(50):
        middle = (low + high) / 2
        same = (along(values, rays, middle[None])[0] >= level) == side
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return np.where(crosses.any(axis=0), low, np.inf)


def found(hits):
    return np.where(hits.found, hits.u, np.inf)


@pytest.mark.slow
@pytest.mark.parametrize("choices", [{"step": 0.25}, {"guaranteed": True}], ids=["step", "guaranteed"])
def test_a_hit_is_the_first_crossing_of_the_interpolant(choices):
    values, rays = waves(), rays_through()
    wanted = truth(values, 0.2, rays)
    hits = found(first(search_of(values, [0.2], **choices), rays))
    same = np.isclose(hits, wanted, atol=1e-4, rtol=0) | (hits == wanted)
    assert np.mean(np.isfinite(wanted)) > 0.8
    # A ray that dips through a surface within less than a step may go on to the next.
    assert np.mean(~same) <= (0.01 if "step" in choices else 0)
    assert np.all(same | (hits > wanted))


def test_a_ball_is_hit_where_it_is():
    """Distances from its middle on a grid, of which the interpolant is wrong by a fraction of a voxel: as much as the field is curved."""
    center, radius = np.array([4.2, 4.6, 5.1]), 3.5
    values, rays = np.linalg.norm(grid() - center[:, None, None, None], axis=0), rays_through()
    e, d = ends(rays)
    b, c = np.sum((e - center[:, None]) * d, axis=0), np.sum((e - center[:, None]) ** 2, axis=0) - radius**2
    root = np.sqrt(np.maximum(b * b - c, 0))
    hits, steep = first(search_of(values, [radius]), rays), root / radius > 0.3
    assert steep.sum() > 50
    # Between voxels the interpolant of a distance r is too large by 3 / (8 r) at most.
    np.testing.assert_allclose(np.asarray(hits.u)[steep], (-b - root)[steep], atol=3 / (8 * radius) / 0.3)
    assert not np.asarray(hits.found)[b * b - c < -radius].any()


def test_a_plane_is_hit_exactly_without_a_further_sample():
    """Where the scalar is linear the straight line between two samples is it, however coarse the tolerance."""
    normal, level, rays = np.array([0.3, -0.8, 0.5]), 1.3, rays_through()
    e, d = ends(rays)
    wanted = (level - normal @ e) / (normal @ d)
    inside = (wanted > 1e-4) & (wanted < np.asarray(rays.length) - 1e-4)
    hits = first(search_of(np.tensordot(normal, grid(), 1), [level], tolerance=0.5), rays)
    np.testing.assert_array_equal(np.asarray(hits.found)[inside], True)
    # Float32 resolves a scalar of 8 to 1e-6.
    np.testing.assert_allclose(np.asarray(hits.u)[inside], wanted[inside], atol=2e-6 / np.abs(normal @ d)[inside].min())


def test_hits_lie_on_the_triangles_of_marching_cubes():
    """Whose vertices lie where the surface crosses an edge between voxels. Between them they are flat, which is less than a tenth of a
    voxel away from a surface that is curved as little as this one."""
    x, y, z = grid() / 3
    values, rays, level = np.sin(0.9 * x + 0.4) * np.cos(0.7 * y) + 0.6 * np.sin(0.8 * z - 0.3 * x), rays_through(), 0.2
    vertices, faces, _, _ = marching_cubes(values, level)
    weights = np.array([(i, j, 16 - i - j) for i in range(17) for j in range(17 - i)]) / 16
    surface = cKDTree(np.einsum("wk,fkd->wfd", weights, vertices[faces]).reshape(-1, 3))
    hits, (e, d) = first(search_of(values, [level], step=0.25), rays), ends(rays)
    points = (e + np.asarray(hits.u) * d).T[np.asarray(hits.found)]
    distance = surface.query(points)[0]
    assert len(points) > 100
    assert distance.max() < 0.1


@pytest.mark.slow
def test_a_sheet_thicker_than_a_step_is_never_missed():
    """A layer of voxels of 1 in zeros is at the level `v` a sheet of thickness `2 (1 - v)`."""
    values, rays = np.zeros(SHAPE), rays_through(axes=(2,))
    values[:, :, 5] = 1
    missed = lambda v, **choices: np.mean(~np.asarray(first(search_of(values, [v], **choices), rays).found))
    assert missed(0.7, step=0.5) == 0
    assert missed(0.7, step=0.5, band=1.0, coarse=8) == 0
    # One of a fifth of a step is missed by more than half of them, and by none where gradients bound the steps.
    assert missed(0.95, step=0.5) > 0.5
    assert missed(0.95, step=0.5, guaranteed=True) == 0


@pytest.mark.slow
def test_two_rates_find_the_same_with_fewer_samples():
    """Of distances to a ball, which change by at most one in a voxel: no surface is missed, though no brick is skipped."""
    values = np.linalg.norm(grid() - 2.5, axis=0) - 2
    rays = rays_through()
    one, two = search_of(values, [0.0], step=0.25), search_of(values, [0.0], step=0.25, band=1.05, coarse=4)
    a, b = (first(dataclasses.replace(search, occupancy=None), rays) for search in (one, two))
    np.testing.assert_array_equal(a.found, b.found)
    np.testing.assert_allclose(a.u, b.u, atol=1e-4)
    assert np.sum(b.steps) < 0.5 * np.sum(a.steps)


def all_hits(search, rays, most):
    """Distances and surfaces of successive hits."""
    reached, u, surface = start(search, rays), [], []
    for _ in range(most):
        hits = following(search, rays, reached)
        reached = hits.reached
        u.append(found(hits))
        surface.append(np.where(hits.found, hits.surface, -1))
    return np.array(u), np.array(surface)


following = jax.jit(next_hit)


def test_surfaces_are_met_in_their_order():
    """Also several within one step, and two that are 1e-4 voxels apart."""
    normal, levels = np.array([0.2, 0.1, 0.9]), np.array([3.0, 3.00009, 3.3, 5.0])
    values, rays = np.tensordot(normal, grid(), 1), rays_through(axes=(2,))
    u, surface = all_hits(search_of(values, levels, tolerance=1e-5), rays, 5)
    e, d = ends(rays)
    wanted = (levels[:, None] - normal @ e) / (normal @ d)
    assert np.all((wanted > 0) & (wanted < np.asarray(rays.length)))
    order = np.where(normal @ d > 0, np.arange(4)[:, None], np.arange(4)[::-1, None])
    np.testing.assert_array_equal(surface[:4], order)
    np.testing.assert_allclose(u[:4], np.take_along_axis(wanted, order, axis=0), atol=2e-5)
    assert np.all(np.isinf(u[4]))


def test_a_ray_leaves_what_it_has_entered():
    """Between hits the scalar is above and below the isovalue in turns."""
    values, rays = waves(), rays_through()
    u, _ = all_hits(search_of(values, [0.2], step=0.125), rays, 4)
    above = along(values, rays, np.zeros((1, COUNT)))[0] >= 0.2
    for k, (one, other) in enumerate(itertools.pairwise(u)):
        there = np.isfinite(other)
        assert np.all(other[there] > one[there])
        between = along(values, rays, np.where(there, one + other, 0)[None] / 2)[0] >= 0.2
        # A ray may dip through a surface in between.
        assert np.mean((between == above)[there] == (k % 2 == 1)) > 0.97


def test_derivatives_are_those_of_the_implicit_function(x64):
    """In the isovalue, the voxels and the ray, in both modes and under `vmap`, against differences."""
    values, rays, rng = waves(), rays_through(60), np.random.default_rng(3)
    tangents = (0.7, rng.normal(size=SHAPE), tuple(rng.normal(size=(3, 60))), tuple(0.1 * rng.normal(size=(3, 60))))
    tangents = jax.tree.map(jnp.asarray, tangents)
    base = (jnp.asarray(0.2), jnp.asarray(values), rays.entry, rays.direction)
    search = dataclasses.replace(search_of(values, [0.2], step=0.25, tolerance=1e-6), occupancy=None)

    def distance(level, voxels, entry, direction):
        moved = dataclasses.replace(search, volume=jvr.Volume(voxels), values=level[None])
        way = Rays(entry, direction, rays.length)
        return next_hit(moved, way, start(moved, way))

    at = jax.jit(distance)
    before, after = (at(*jax.tree.map(lambda x, t, h=h: x + h * t, base, tangents)) for h in (-1e-4, 1e-4))
    hits, difference = at(*base), (np.asarray(after.u) - np.asarray(before.u)) / 2e-4
    tangent = jax.jit(lambda: jax.jvp(lambda *a: distance(*a).u, base, tangents)[1])()
    # Rays that graze a surface meet another one.
    steady = np.asarray(hits.found) & (np.abs(difference) < 30)
    assert steady.sum() > 40
    # The third derivative, and the kinks of the interpolant at faces between voxels.
    error = np.abs(np.asarray(tangent) - difference)[steady] / (1 + np.abs(difference[steady]))
    assert np.median(error) < 1e-6
    assert error.max() < 2e-2
    weights = jnp.where(jnp.asarray(steady), jnp.asarray(rng.normal(size=60)), 0.0)
    pull = jax.jit(lambda w: jax.vjp(lambda *a: distance(*a).u, *base)[1](w))
    products = lambda gradient: sum(jnp.sum(g * t) for g, t in zip(*map(jax.tree.leaves, (gradient, tangents)), strict=True))
    np.testing.assert_allclose(products(pull(weights)), jnp.sum(weights * tangent), rtol=1e-10)
    both = jax.vmap(pull)(jnp.stack([weights, 2 * weights]))
    np.testing.assert_allclose(both[0], float(pull(weights)[0]) * np.array([1, 2]), rtol=1e-10)


def test_hard_cases_are_finite():
    """A plateau at the isovalue, an isovalue outside of the data, a ray along a surface, one that begins on it, one without a length."""
    values = np.minimum(grid((6, 6, 6))[0], 3.0)
    search = dataclasses.replace(search_of(values, [1.0]), occupancy=None)
    entry = np.array([[0, 2, 2], [3, 0, 2], [4, 4, 0], [5, 1, 1], [2.5, 2, 2]]).T
    direction = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [1, 0, 0]]).T
    length = np.array([5.0, 5, 5, 5, 0])
    rays = Rays(tuple(jnp.asarray(entry, float)), tuple(jnp.asarray(direction, float)), jnp.asarray(length))

    def total(level, voxels, rays):
        moved = dataclasses.replace(search, volume=jvr.Volume(voxels), values=level[None])
        hits = next_hit(moved, rays, start(moved, rays))
        return jnp.sum(hits.u), hits

    differentiated = jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True))
    for level, hit in ((3.0, [True, False, False, True, False]), (7.0, [False] * 5), (2.0, [True, False, False, True, False])):
        (_, hits), gradient = differentiated(jnp.asarray(level), jnp.asarray(values), rays)
        assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((hits.u, gradient)))
        assert np.asarray(hits.found).tolist() == hit
        if not any(hit):
            assert not any(np.any(x) for x in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_a_hit_in_the_last_half_segment_is_found():
    """The last sample is where the ray leaves, and what is missing hides what is there."""
    values, rays = grid()[2], rays_through(axes=(2,))
    up = np.asarray(rays.direction[2]) > 0
    for level in (9.999, 9.6):
        depth = found(first(search_of(values, [level], step=2.0), rays)) * np.asarray(rays.direction[2])
        np.testing.assert_allclose(depth[up], level, atol=2e-4)
    values[:, :, 3] = np.nan
    hit = lambda level: np.asarray(first(search_of(values, [level], step=0.5), rays).found)[up]
    assert [(hit(level).all(), hit(level).any()) for level in (1.3, 2.6, 3.4, 5.2)] == [
        (True, True),
        *[(False, False)] * 2,
        (True, True),
    ]
