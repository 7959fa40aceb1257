"""Triangle meshes: which triangle a ray meets, by a linear system for each pair of them in double precision; pictures; derivatives."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, SETTINGS, linear_transfer, perspective, render, voxels

import jvr
from jvr.io.config import build_scene, read_config

SIDE, EYE = 3.0, 9.0
COLOUR, BACKGROUND, SIGMA = np.array([0.9, 0.6, 0.3]), np.array([0.4, 0.1, 0.7]), 0.4
STEP = jvr.Settings(0.25, termination=0)
# What is seen of the corners of a square, red to the right and green upwards.
SHADES = np.array([[0.1, 0.2, 0.5], [0.9, 0.2, 0.5], [0.1, 0.8, 0.5], [0.9, 0.8, 0.5]])


def square(z, half=50.0, rgb=SHADES, centre=1.5):
    """Across the view of `above`, at a height."""
    corners = [[centre + half * x, centre + half * y, z] for y in (-1.0, 1.0) for x in (-1.0, 1.0)]
    return jvr.Mesh(corners, [[0, 1, 2], [1, 2, 3]], rgb)


def fog(**parts):
    transfer = jvr.LinearTransfer([0.0, 1.0], [COLOUR, COLOUR], [SIGMA, SIGMA])
    return jvr.Scene(jvr.Volume(np.full((4, 4, 4), 0.5)), transfer, **{"background": BACKGROUND, **parts})


def above(size=4):
    return jvr.OrthographicCamera.look_at([1.5, 1.5, EYE], [1.5, 1.5, -9.0], [0.0, 1.0, 0.0], 1.5, size, size)


def rays(n, seed=0):
    """From all around towards all of the unit cube."""
    rng = np.random.default_rng(seed)
    origin = rng.normal(size=(n, 3)) * 2
    direction = rng.random((n, 3)) - origin
    return origin, direction / np.linalg.norm(direction, axis=1, keepdims=True)


def met(mesh, origin, direction, nearest=0.0):
    of = lambda x: tuple(jnp.asarray(x, mesh.vertices.dtype).T)
    return jax.jit(lambda m, o, d: m.hit((of(o), of(d)), 0.0, nearest, None)[:2])(mesh, origin, direction)


def solved(vertices, faces, origin, direction, nearest=0.0):
    """`o + t d = a + u (b - a) + v (c - a)` for each ray and triangle: the least `t`, and with which triangle and weights."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    shape = (len(origin), len(faces), 3)
    columns = [np.broadcast_to(x, shape) for x in (-direction[:, None], (b - a)[None], (c - a)[None])]
    t, u, v = np.moveaxis(np.linalg.solve(np.stack(columns, -1), (origin[:, None] - a)[..., None])[..., 0], -1, 0)
    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= nearest)
    t = np.where(inside, t, np.inf)
    first, each = t.argmin(axis=1), np.arange(len(origin))
    u, v = u[each, first], v[each, first]
    return t[each, first], first, np.stack([1 - u - v, u, v], axis=1)


def test_rays_meet_the_first_of_many_triangles(x64):
    """Of more than fill a block, at all angles; also from a distance on."""
    rng = np.random.default_rng(1)
    centre = rng.random((75, 1, 3))
    vertices, faces = (centre + 0.2 * rng.normal(size=(75, 3, 3))).reshape(-1, 3), np.arange(225).reshape(-1, 3)
    rgb, (origin, direction) = rng.random((225, 3)), rays(300)
    for nearest in (0.0, 2.5):
        t, colours = met(jvr.Mesh(vertices, faces, rgb), origin, direction, nearest)
        wanted, first, weights = solved(vertices, faces, origin, direction, nearest)
        there = np.isfinite(wanted)
        assert 50 < there.sum() < 290
        np.testing.assert_allclose(t, wanted, rtol=1e-9)
        seen = np.einsum("rc,rck->rk", weights[there], rgb[faces[first[there]]])
        np.testing.assert_allclose(np.stack(colours, axis=1)[there], seen, rtol=1e-7)


def test_no_ray_gets_through_where_triangles_meet():
    """In single precision, through the very edges and corners of a closed surface that has vertices in the way of every ray."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32) / 3
    quads = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
    faces = [[q[i] for i in t] for q in quads for t in ((0, 1, 2), (0, 2, 3))]
    rng = np.random.default_rng(2)
    at = rng.integers(0, 12, 2000)
    triangle = corners[np.array(faces)[at]]
    share = rng.random((2000, 1)) * (rng.random((2000, 1)) < 0.8)
    target = share * triangle[:, 0] + (1 - share) * triangle[:, 1]
    direction = -target / np.linalg.norm(target, axis=1, keepdims=True)
    t, _ = met(jvr.Mesh(corners, faces, (1.0, 1.0, 1.0)), -3 * direction, direction)
    np.testing.assert_allclose(t, 3 - np.linalg.norm(target, axis=1), atol=1e-4)


def test_triangles_without_area_are_met_by_no_ray():
    """In single precision, in which two corners that are the same still have a volume with most directions."""
    rng = np.random.default_rng(3)
    first, second = rng.random((2, 40, 3)).astype(np.float32)
    vertices, faces = np.concatenate([first, second]), [[i, i + 40, i + 40] for i in range(40)]
    along, at = rng.normal(size=(8000, 3)), np.arange(8000) % 40
    direction = along / np.linalg.norm(along, axis=1, keepdims=True)
    target = first[at] + rng.random((8000, 1)) * (second - first)[at]
    t, _ = met(jvr.Mesh(vertices, faces, (1.0, 1.0, 1.0)), target - 3 * direction, direction)
    assert np.all(np.isinf(t))


@pytest.mark.slow
def test_a_square_in_fog_is_seen_through_what_is_in_front(x64):
    """As a depth image of the same distances is."""
    picture = render(fog(geometry=square(1.9)), above(), STEP)
    x, y = (np.asarray(above().rays(jnp.arange(16))[0][i]).reshape(4, 4) - 1.5 for i in (0, 1))
    rgb = np.stack([0.5 + 0.4 * x / 50, 0.5 + 0.3 * y / 50, 0.5 + 0 * x], axis=-1)
    T = np.exp(-SIGMA * (SIDE - 1.9))
    np.testing.assert_allclose(picture.rgb, (1 - T) * COLOUR + T * rgb, rtol=1e-9)
    image = jvr.DepthImage(np.full((4, 4), EYE - 1.9), rgb)
    np.testing.assert_allclose(picture.rgb, render(fog(geometry=image), above(), STEP).rgb, rtol=1e-12)
    np.testing.assert_allclose(picture.alpha, 1, rtol=1e-12)
    beside = render(fog(geometry=square(1.9, half=0.2, centre=8.0)), above(), STEP)
    np.testing.assert_allclose(beside.rgb, render(fog(), above(), STEP).rgb, rtol=1e-12)


@pytest.mark.slow
def test_derivatives_in_its_vertices_are_those_of_the_closed_form(x64):
    """Raised as a whole, less fog is in front."""

    def red(height, rgb):
        mesh = square(0.0, rgb=rgb)
        return jvr.render(
            fog(geometry=eqx.tree_at(lambda m: m.vertices, mesh, mesh.vertices.at[:, 2].set(height))), above(), STEP
        ).rgb[1, 2, 0]

    by_height, by_rgb = jax.jit(jax.grad(red, argnums=(0, 1)))(1.9, jnp.asarray(0.3 * np.ones(3)))
    T = np.exp(-SIGMA * (SIDE - 1.9))
    np.testing.assert_allclose(by_height, -SIGMA * T * (COLOUR[0] - 0.3), rtol=1e-9)
    np.testing.assert_allclose(by_rgb, [T, 0, 0], rtol=1e-9)


@pytest.mark.slow
def test_derivatives_in_each_vertex_and_the_pose_are_those_of_differences(x64):
    volume, rng = jvr.Volume(voxels(), OBLIQUE), np.random.default_rng(3)
    centre, radius = np.asarray(volume.center), float(volume.radius)
    vertices, faces = centre + 0.8 * radius * rng.normal(size=(5, 3)), [[0, 1, 2], [1, 2, 3], [2, 3, 4]]
    view, weights = perspective(volume), rng.random((5, 6, 3))

    def loss(vertices, angle):
        seen = jvr.Scene(volume, linear_transfer(), geometry=jvr.Mesh(vertices, faces, np.eye(5)[:, :3]))
        found = jvr.render(seen, dataclasses.replace(view, fov_y=angle), SETTINGS)
        return jnp.sum(weights * found.rgb) + 0.01 * jnp.sum(found.depth)

    loss, angle = jax.jit(loss), jnp.asarray(38.0)
    by_vertices, by_angle = jax.jit(jax.grad(loss, argnums=(0, 1)))(jnp.asarray(vertices), angle)
    # Steps in which no pixel changes its triangle.
    for along in rng.normal(size=(3, 5, 3)):
        difference = (loss(vertices + 1e-6 * along, angle) - loss(vertices - 1e-6 * along, angle)) / 2e-6
        np.testing.assert_allclose(np.sum(along * by_vertices), difference, rtol=1e-5)
    np.testing.assert_allclose(by_angle, (loss(vertices, angle + 1e-6) - loss(vertices, angle - 1e-6)) / 2e-6, rtol=1e-5)


@pytest.mark.slow
def test_adaptive_pictures_and_fits_of_several_views_see_it():
    volume, rng = jvr.Volume(voxels(), OBLIQUE), np.random.default_rng(3)
    vertices = np.asarray(volume.center) + 0.6 * float(volume.radius) * rng.normal(size=(5, 3))
    mesh = jvr.Mesh(vertices, [[0, 1, 2], [1, 2, 3], [2, 3, 4]], np.eye(5)[:, :3])
    scene = jvr.Scene(volume, linear_transfer(), geometry=mesh)
    views = [perspective(volume, 12, 12), perspective(volume, 10, 12, direction=(-0.3, 1.0, 0.4))]
    images = [render(scene, view, SETTINGS).rgb for view in views]
    refined = render(scene, views[0], jvr.Settings(0.37, termination=0, sampling=jvr.Refinement(0.0))).rgb
    assert np.mean(np.abs(refined - images[0]) > 1e-4) < 0.01
    start = scene.replaced(
        transfer=jvr.LinearTransfer(scene.transfer.positions, scene.transfer.rgb, 0.5 * scene.transfer.sigma_t)
    )
    found = jvr.fit(start, views, images, unknowns=lambda s: s.transfer.sigma_t, settings=SETTINGS)
    np.testing.assert_allclose(found.scene.transfer.sigma_t, scene.transfer.sigma_t, rtol=1e-3)


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (np.eye(3), np.zeros((0, 3), int), "a mesh has at least one face: leave geometry out where there is none"),
        (np.eye(3) * np.nan, [[0, 1, 2]], "vertices of a mesh must be finite: take those that are not out of it"),
        (np.eye(3), [[0, 1, 3]], "a face has the vertex 3, and they are 0 to 2: counting begins at 0"),
        (np.eye(3), [[0, 1, 2, 0]], r"faces has shape \(1, 4\); it must be \(n, 3\): split what has more corners"),
        (np.eye(3), [[0.0, 1.0, 2.0]], "faces must be whole numbers, indices of vertices, not float"),
    ],
)
def test_bad_meshes_are_refused_in_a_line(vertices, faces, message):
    with pytest.raises(ValueError, match=message) as error:
        jvr.Mesh(vertices, faces, (1.0, 1.0, 1.0))
    assert "\n" not in str(error.value)


CONFIG = """
[volume]
builtin = "demo"
[transfer]
kind = "window"
[geometry]
kind = "mesh"
vertices = [[0, 0, 0], [30, 0, 0], [0, 30, 0]]
faces = [[0, 1, 2]]
rgb = [0.2, 0.6, 0.5]
"""


def test_configurations_and_plans_name_it(tmp_path):
    (tmp_path / "a.toml").write_text(CONFIG)
    scene = build_scene(read_config(tmp_path / "a.toml"))
    assert "rays end at a mesh of 1 triangles" in str(jvr.plan(scene))
    np.testing.assert_array_equal(scene.geometry.faces, [[0, 1, 2]])
    with pytest.raises(ValueError, match="geometry: a face has the vertex 3"):
        build_scene(read_config(tmp_path / "a.toml", ["geometry.faces=[[0,1,3]]"]))
