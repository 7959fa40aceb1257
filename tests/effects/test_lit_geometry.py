"""Meshes in the light of a scene: closed forms of Lambert's squares in fog, umbrae, isosurfaces of the same place, derivatives."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import render

import jvr
from jvr.rendering.geometry import lit_where_rays_end
from jvr.rendering.medium import medium, prepare
from jvr.rendering.trace import camera_rays, near_volume, step_length

SIGMA, DEPTH, EXACT = 0.3, 3.0, jvr.Settings(0.25, termination=0)
RGB, IRRADIANCE = np.array([0.9, 0.6, 0.3]), 2.5
TOWARDS = np.array([0.6, -0.3, 2.0])
COSINE = TOWARDS[2] / np.linalg.norm(TOWARDS)
RAYS = jvr.ShadowRays(0.25, termination=0)


def sun():
    """In the precision of the moment."""
    return jvr.DirectionalLight(-TOWARDS, IRRADIANCE)


def square(z, half=5.0, centre=(8.0, 8.0), rgb=RGB, **choices):
    corners = [[centre[0] + half * x, centre[1] + half * y, z] for y in (-1.0, 1.0) for x in (-1.0, 1.0)]
    return jvr.Mesh(corners, [[0, 1, 2], [1, 2, 3]], rgb, **choices)


def fog(geometry, sigma_t=SIGMA, **parts):
    """A black slab, `z = 0 ... DEPTH`, of 16 x 16."""
    transfer = jvr.LinearTransfer([0.0, 1.0], np.zeros((2, 3)), [sigma_t, sigma_t])
    parts = {"lights": (sun(),), "shading": jvr.Lambert(), "shadows": RAYS} | parts
    return jvr.Scene(jvr.Volume(np.full((17, 17, 4), 0.5)), transfer, geometry=geometry, **parts)


def above(size=3, height=1.0):
    return jvr.OrthographicCamera.look_at([8.0, 8.0, 9.0], [8.0, 8.0, 0.0], [0.0, 1.0, 0.0], height, size, size)


def behind(scene, camera):
    """What the rays of a camera see where they end, without the medium in front."""
    scene, camera = near_volume(scene, camera)
    prepared = prepare(scene, dataclasses.replace(EXACT, step=1.0), step_length(scene, EXACT))
    rays, _ = camera_rays(scene, camera, jnp.arange(camera.height * camera.width, dtype=jnp.int32))
    end = lit_where_rays_end(prepared, medium(prepared), rays).end
    return jnp.stack(end.rgb, axis=-1).reshape(camera.height, camera.width, 3)


seen_behind = jax.jit(behind)


@pytest.mark.slow
@pytest.mark.parametrize("z", [1.2, -2.0])
def test_a_square_in_or_below_fog_is_lit_through_it(x64, z):
    """On the way of the light, and on that to the eye."""
    through = DEPTH - max(z, 0.0)
    seen = RGB * COSINE * IRRADIANCE * np.exp(-SIGMA * through * (1 + 1 / COSINE))
    np.testing.assert_allclose(render(fog(square(z)), above(), EXACT).rgb[1, 1], seen, rtol=1e-9)


@pytest.mark.slow
def test_without_light_or_unless_lit_it_shows_its_colour(x64):
    T = np.exp(-SIGMA * DEPTH)
    dark = render(fog(square(-2.0), lights=(), shading=None, shadows=None), above(), EXACT).rgb[1, 1]
    np.testing.assert_allclose(dark, T * RGB, rtol=1e-9)
    np.testing.assert_allclose(render(fog(square(-2.0, lit=False)), above(), EXACT).rgb[1, 1], T * RGB, rtol=1e-9)


def floor_and_block(height):
    """A floor at `z = -1`, and a square above it."""
    floor, block = square(-1.0, 7.0), square(height, 1.0, (6.5, 8.5))
    faces = [[0, 1, 2], [1, 2, 3], [4, 5, 6], [5, 6, 7]]
    return jvr.Mesh(jnp.concatenate([floor.vertices, block.vertices]), faces, (0.5, 0.5, 0.5))


@pytest.mark.slow
@pytest.mark.parametrize("shadows", [jvr.ShadowRays(), jvr.ShadowVolume()])
def test_the_umbra_of_a_block_lies_on_the_floor(shadows):
    """At its exact place, whatever finds the shadows of the medium."""
    n, height = 48, 4.0
    scene = fog(floor_and_block(height), 0.0, shadows=shadows)
    rgb = np.asarray(seen_behind(scene, above(n, 12.0)))[..., 0]
    x, y = np.meshgrid(8 + 12 * ((np.arange(n) + 0.5) / n - 0.5), 8 - 12 * ((np.arange(n) + 0.5) / n - 0.5))
    shift = -TOWARDS[:2] / TOWARDS[2] * (height + 1)
    inside = lambda dx, dy, half: (np.abs(x - 6.5 - dx) < half) & (np.abs(y - 8.5 - dy) < half)
    block = inside(0, 0, 1.0)
    # No pixel's middle is at an edge.
    umbra = inside(*shift, 1.0) & ~block
    assert umbra.sum() > 20
    np.testing.assert_array_equal(rgb[umbra], 0)
    np.testing.assert_allclose(rgb[~umbra], 0.5 * COSINE * IRRADIANCE, rtol=1e-5)


@pytest.mark.slow
def test_isosurfaces_and_mirrors_know_its_light(x64):
    """A floor below the volume is dark by what a sheet holds back. In a mirror it is seen with the same light."""
    volume = jvr.Volume(np.broadcast_to(np.arange(4.0), (17, 17, 4)))
    clear = jvr.LinearTransfer([0.0, 3.0], np.zeros((2, 3)), [0.0, 0.0])
    parts = {"lights": (sun(),), "shading": jvr.Lambert(), "shadows": RAYS}
    sheet = jvr.Isosurfaces([1.6], np.zeros((1, 3)), [0.4])
    below = jvr.Scene(volume, clear, surfaces=sheet, geometry=square(-2.0), **parts)
    np.testing.assert_allclose(seen_behind(below, above())[1, 1], 0.6 * RGB * COSINE * IRRADIANCE, rtol=1e-6)
    # A ceiling, lit from below, in a mirror that looks up.
    parts = {"lights": (jvr.DirectionalLight([0.0, 0.6, 0.8], IRRADIANCE),), "shading": jvr.Lambert(), "shadows": None}
    mirror = {"surfaces": jvr.Isosurfaces([1.6], np.zeros((1, 3))), "specular": jvr.Specular(1.0, order=1)}
    scene = jvr.Scene(volume, clear, geometry=square(20.0), **mirror, **parts)
    np.testing.assert_allclose(render(scene, above(), EXACT).rgb[1, 1], RGB * 0.8 * IRRADIANCE, rtol=1e-6)


def ball(centre, radius, n=12):
    """Triangles of a sphere: convex."""
    theta, phi = np.meshgrid(np.pi * np.arange(n + 1) / n, 2 * np.pi * np.arange(2 * n) / (2 * n), indexing="ij")
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    at = lambda i, j: i * 2 * n + j % (2 * n)
    quads = [(at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)) for i in range(n) for j in range(2 * n)]
    return jvr.Mesh(centre + radius * points.reshape(-1, 3), [[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)], RGB)


@pytest.mark.slow
@pytest.mark.parametrize("away", [0.0, 1e4])
def test_nothing_convex_lies_in_its_own_shadow(away):
    """In single precision, far from the origin of the world, with light that grazes: what it faces is lit as without shadows, and what
    it does not face is dark anyway. (Some of its triangles have no area.)"""
    offset = np.array([away, -away, away])
    mesh, lamp = ball(offset + 8.0, 5.0), jvr.PointLight(offset + np.array([8.0, 15.0, 14.0]), 300.0)
    volume = jvr.Volume(np.zeros((17, 17, 4)), np.array([*np.eye(4)[:, :3].T, [*offset, 1]]).T)
    clear = jvr.LinearTransfer([0.0, 1.0], np.zeros((2, 3)), [0.0, 0.0])
    camera = jvr.PerspectiveCamera.look_at(offset + np.array([22.0, 9.0, 25.0]), offset + 8.0, [0.0, 0.0, 1.0], 34.0, 32, 32)
    scenes = [jvr.Scene(volume, clear, geometry=mesh, lights=(lamp,), shading=jvr.Lambert(), shadows=x) for x in (None, RAYS)]
    lit, dark = (np.asarray(seen_behind(scene, camera)) for scene in scenes)
    assert (lit > 0.1).sum() > 300
    np.testing.assert_allclose(dark, lit, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_it_is_lit_as_an_isosurface_of_the_same_place(x64):
    """By a shading with a highlight, the ambient light that the medium leaves, two lights, and in the shadow of the medium."""
    volume = jvr.Volume(np.broadcast_to(np.arange(8.0), (9, 9, 8)))
    smoke = jvr.LinearTransfer([0.0, 3.0, 7.0], np.zeros((3, 3)), [0.0, 0.02, 0.2])
    lights = (jvr.AmbientLight(0.4), sun(), jvr.PointLight([2.0, 3.0, 9.0], 60.0))
    parts = {"lights": lights, "shading": jvr.BlinnPhong(0.3, 0.6, 0.4, 20.0), "shadows": RAYS}
    parts["occlusion"] = jvr.LocalOcclusion(rays=6, radius=3.0, resolution=1.0)
    camera = jvr.PerspectiveCamera.look_at([7.0, 1.0, 12.0], [4.0, 4.0, 3.3], [0.0, 1.0, 0.0], 25.0, 5, 4)
    mesh = jvr.Mesh([[-9.0, -9.0, 3.3], [30.0, -9.0, 3.3], [-9.0, 30.0, 3.3]], [[0, 1, 2]], RGB)
    of_mesh = render(jvr.Scene(volume, smoke, geometry=mesh, **parts), camera, EXACT)
    surfaces = jvr.Isosurfaces([3.3], RGB[None], tolerance=1e-6, casts_shadows=False)
    of_surface = render(jvr.Scene(volume, smoke, surfaces=surfaces, **parts), camera, EXACT)
    assert np.ptp(of_mesh.rgb) > 0.05
    np.testing.assert_allclose(of_mesh.rgb, of_surface.rgb, rtol=2e-5)


def picture(values):
    """A slanted square half in the medium, under a lamp and a block."""
    lamp, rgb, sigma_t, tilt = values
    mesh = floor_and_block(4.0)
    slope = tilt * (mesh.vertices[:, 0] - 8.0) * (jnp.arange(8) < 4)
    mesh = eqx.tree_at(lambda m: (m.vertices, m.rgb), mesh, (mesh.vertices.at[:, 2].add(slope), rgb))
    scene = fog(mesh, lights=(jvr.PointLight([0.0, 0.0, 0.0], 1.0),))
    places = lambda s: (s.lights[0].position, s.lights[0].intensity, s.transfer.sigma_t)
    return behind(eqx.tree_at(places, scene, (*lamp, sigma_t)), above(6, 10.0))


@pytest.mark.slow
def test_derivatives_are_those_of_differences(x64):
    """In where the lamp is and how bright, in colours, extinction and vertices, whose normals turn, in both modes."""
    rng = np.random.default_rng(0)
    lamp = jnp.asarray([10.1, 6.2, 7.3]), jnp.asarray([200.0, 180.0, 160.0])
    at = (lamp, jnp.asarray(RGB), jnp.asarray([0.25, 0.35]), jnp.asarray(0.21))
    weights = rng.random((6, 6, 3))
    loss = jax.jit(lambda values: jnp.sum(weights * picture(values)))
    gradient = jax.jit(jax.grad(loss))(at)
    along = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), at)
    # Of each by itself, and of all together.
    parts = [jax.tree.map(jnp.zeros_like, at) for _ in jax.tree.leaves(at)]
    parts = [eqx.tree_at(lambda t, i=i: jax.tree.leaves(t)[i], p, jax.tree.leaves(along)[i]) for i, p in enumerate(parts)]
    moved = lambda by, h: loss(jax.tree.map(lambda x, d: x + h * d, at, by))
    for by in (*parts, along):
        difference = (moved(by, 1e-6) - moved(by, -1e-6)) / 2e-6
        assert abs(difference) > 1e-3
        slope = sum(jnp.vdot(g, d) for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(by), strict=True))
        np.testing.assert_allclose(slope, difference, rtol=2e-6)
    forward = jax.jit(lambda by: jax.jvp(loss, (at,), (by,))[1])(along)
    np.testing.assert_allclose(forward, difference, rtol=2e-6)


@pytest.mark.slow
def test_hard_cases_are_finite():
    """A face without area, one much smaller than a rounding, light in the plane of a face, on it and straight from behind, opaque fog."""
    vertices = jnp.asarray([[3.0, 3, 1], [13, 3, 1], [3, 13, 1], [13, 13, 1], [8, 8, 1 + 1e-7], [8 + 1e-7, 8, 1.2]])
    faces = [[0, 1, 2], [1, 2, 3], [0, 0, 3], [4, 5, 4], [4, 5, 0]]

    def loss(position, vertices, sigma_t):
        scene = fog(jvr.Mesh(np.zeros((6, 3)), faces, RGB), lights=(jvr.PointLight([0.0, 0.0, 0.0], 9.0), sun()))
        places = lambda s: (s.lights[0].position, s.geometry.vertices, s.transfer.sigma_t)
        rgb = behind(eqx.tree_at(places, scene, (position, vertices, sigma_t)), above(5, 8.0))
        return jnp.sum(rgb), rgb

    run = jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True))
    for position in ([20.0, 8.0, 1.0], [8.0, 8.0, 1.0], [8.0, 8.0, -6.0], [8.0, 8.0, 1.0 + 1e-6]):
        for sigma_t in (0.0, 1e4):
            (_, rgb), slopes = run(jnp.asarray(position), vertices, jnp.full(2, sigma_t))
            assert np.all(np.isfinite(rgb))
            assert all(np.all(np.isfinite(x)) for x in slopes)


def test_what_goes_by_the_scalar_is_refused_in_a_line():
    shading = jvr.Lambert(jvr.ByValue([0.0, 1.0], [0.2, 0.3]))
    with pytest.raises(ValueError, match=r"give numbers, or jvr\.Mesh\(\.\.\., lit=False\)") as error:
        fog(square(0.0), shading=shading)
    assert "\n" not in str(error.value)
    assert fog(square(0.0, lit=False), shading=shading).geometry.lit is False
    assert "which is lit" in str(jvr.plan(fog(square(0.0))))
    assert "which is lit" not in str(jvr.plan(dataclasses.replace(fog(square(0.0)), geometry=square(0.0, lit=False))))
