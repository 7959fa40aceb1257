"""Piecewise shadows: closed forms, brute force in NumPy, orders, derivatives, hard cases. (Pictures are in `test_shadows.py`.)"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, linear_transfer, voxels
from scipy.ndimage import map_coordinates

import jvr
from jvr.march.steps import Point
from jvr.rendering.medium import visibility


def sun():
    return jvr.DirectionalLight((0.5, 0.4, -0.6))


def scene(shadows, volume, transfer, lights, **parts):
    return jvr.Scene(volume, transfer, lights=lights, shadows=shadows, scattering=jvr.SingleScattering(), **parts)


def points(p) -> Point:
    p = tuple(jnp.asarray(c, float) for c in np.asarray(p).T)
    return Point(p, p, *(jnp.zeros(p[0].shape, jnp.int32),) * 2)


@functools.partial(jax.jit, static_argnames="reverse")
def lights_at(one: jvr.Scene, at: Point, reverse: bool = True):
    """Transmittance between each light and grid positions, skipping nothing."""
    return visibility(one, None).transmittances(at, jnp.ones(at.p[0].shape, bool), reverse=reverse).lights


def found(one: jvr.Scene, p) -> np.ndarray:
    """Of each of the lights with a shadow, and each channel, at the points: `(lights, channels, points)`."""
    return np.asarray([light for light in lights_at(one, points(p)) if light])


def way(one: jvr.Scene, light, p) -> tuple[np.ndarray, np.ndarray]:
    """Unit direction to a light, and how far it is there inside of the volume and in front of the light, in double precision."""
    matrix = np.asarray(one.volume.world_from_grid, np.float64)
    x = p @ matrix[:3, :3].T + matrix[:3, 3]
    if isinstance(light, jvr.DirectionalLight):
        to, distance = np.broadcast_to(-np.asarray(light.direction, np.float64), x.shape), np.inf
    else:
        to = np.asarray(light.position, np.float64) - x
        distance = np.linalg.norm(to, axis=1)
    to = to / np.linalg.norm(to, axis=1, keepdims=True)
    along = to @ np.linalg.inv(matrix[:3, :3]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        leaves = np.where(along > 0, np.array(one.volume.shape) - 1 - p, -p) / along
    return along, np.minimum(np.nanmin(np.where(along == 0, np.inf, leaves), axis=1), distance)


def brute_force(one: jvr.Scene, light, p, steps=1500) -> np.ndarray:
    """The transmittance at grid positions by the midpoint rule, through trilinear scalars."""
    along, length = way(one, light, p)
    u = length[:, None] * (np.arange(steps) + 0.5) / steps
    at = p[:, None] + u[..., None] * along[:, None]
    s = map_coordinates(np.asarray(one.volume.values, np.float64), at.reshape(-1, 3).T, order=1, mode="nearest")
    sigma = np.interp(s, np.asarray(one.transfer.positions), np.asarray(one.transfer.sigma_t))
    return np.exp(-np.sum(sigma.reshape(u.shape), axis=1) * length / steps)


@pytest.mark.slow
def test_a_homogeneous_medium_is_exact():
    """Whatever the piece and the distance of nodes, for oblique light and lamps inside and outside, each with its own shadow."""
    volume = jvr.Volume(np.ones((6, 5, 7)), OBLIQUE)
    center, radius = np.asarray(volume.center), float(volume.radius)
    lamps = (
        jvr.PointLight(center + 1.4 * radius * np.array([0.6, 0.0, 0.8])),
        jvr.PointLight(center + np.array([0.3, -0.2, 0.5])),
    )
    lights = (sun(), jvr.HeadLight(), *lamps)
    transfer = jvr.LinearTransfer([0.0, 1.0], np.zeros((2, 3)), [[0.02, 0.2, 1.0]] * 2)
    p = np.random.default_rng(0).uniform(0, 1, (40, 3)) * (np.array(volume.shape) - 1)
    for shadows in (jvr.PiecewiseShadows(0, 0.4), jvr.PiecewiseShadows(1.3, 0.4)):
        one = scene(shadows, volume, transfer, lights)
        lit = found(one, p)
        for light, of_light in zip((sun(), *lamps), lit, strict=True):
            _, length = way(one, light, p)
            np.testing.assert_allclose(of_light, np.exp(-np.outer([0.02, 0.2, 1.0], length)), rtol=2e-4, atol=1e-6)


def waves(n=25) -> np.ndarray:
    """Voxels without kinks of note."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    return 0.5 + 0.3 * np.sin(4 * x + 1) * np.cos(3 * y) * np.cos(5 * z + 0.3)


RAMP = jvr.LinearTransfer([0.0, 1.0], np.zeros((2, 3)), [0.0, 0.2])


@pytest.mark.slow
def test_the_error_falls_with_the_square_of_the_distance_between_nodes(x64):
    """Of the sun and of a lamp."""
    lights = (sun(), jvr.PointLight((40.0, 30.0, 50.0)))
    one = functools.partial(scene, volume=jvr.Volume(waves()), transfer=RAMP, lights=lights)
    p = np.random.default_rng(1).uniform(2, 22, (200, 3))
    exact = [brute_force(one(jvr.PiecewiseShadows()), light, p) for light in lights]
    errors = [np.sqrt(np.mean((found(one(jvr.PiecewiseShadows(4, n / 6)), p)[:, 0] - exact) ** 2, axis=1)) for n in (1, 2, 4)]
    order = -np.polyfit(np.log([1, 2, 4]), np.log(errors), 1)[0]
    assert np.all(order > 1.5), (errors, order)


@pytest.mark.slow
def test_near_shadows_are_sharper_than_those_of_a_shadow_volume_of_as_many_nodes(x64):
    """Under the edge of an opaque sheet, two voxels below it."""
    values = np.zeros((24, 24, 24))
    values[:12, :, 15:17] = 1.0
    light = jvr.DirectionalLight((0.0, 0.3, -1.0))
    one = functools.partial(
        scene, volume=jvr.Volume(values), transfer=jvr.LinearTransfer([0.4, 0.6], np.zeros((2, 3)), [0.0, 5.0])
    )
    p = np.random.default_rng(2).uniform((6, 4, 11), (18, 20, 13), (300, 3))
    exact, errors = brute_force(one(jvr.PiecewiseShadows(), lights=(light,)), light, p), []
    # 7^3 nodes, as many as the other has along 3 axes as long as the diagonal.
    for shadows in (jvr.PiecewiseShadows(8, 1 / 4), jvr.ShadowVolume(6 / np.sqrt(3 * 23**2))):
        lit = found(one(shadows, lights=(light,)), p)[0, 0]
        errors.append(np.sqrt(np.mean((lit - exact) ** 2)))
    assert 0.2 < np.mean(exact) < 0.8
    assert errors[0] < 0.1 * errors[1], errors


@pytest.mark.slow
def test_derivatives_are_those_of_differences(x64):
    """In both modes; of some voxels, of entries of the table, of where lights are."""
    lamp = jvr.PointLight((3.1, 9.7, 12.2))
    one = scene(jvr.PiecewiseShadows(1.4, 0.6), jvr.Volume(voxels((4, 5, 4)), OBLIQUE), linear_transfer(), (sun(), lamp))
    at = points(np.random.default_rng(3).uniform(0, 3, (9, 3)))
    weigh = lambda lights: sum(jnp.sum(jnp.sin(jnp.arange(1.0, 10.0) + i) * light[0]) for i, light in enumerate(lights))
    arrays = lambda s: (s.transfer.sigma_t, s.transfer.positions, s.volume.values, s.lights[0].direction, s.lights[1].position)
    held = arrays(one)

    def loss(moved, reverse):
        return weigh(lights_at(eqx.tree_at(arrays, one, moved), at, reverse))

    gradient = jax.grad(loss)(held, True)
    rng = np.random.default_rng(4)
    moves = [tuple(rng.standard_normal(x.shape) * (i == k) for i, x in enumerate(held)) for k in range(len(held))]
    for k, move in enumerate(moves):
        move = jax.tree.map(jnp.asarray, move)
        ends = [loss(jax.tree.map(lambda x, d, h=h: x + h * d, held, move), False) for h in (1e-6, -1e-6)]
        expected = float(ends[0] - ends[1]) / 2e-6
        reverse = float(jnp.vdot(gradient[k], move[k]))
        _, forward = jax.jvp(lambda moved: loss(moved, False), (held,), (move,))
        assert abs(expected) > 1e-3
        assert reverse == pytest.approx(expected, rel=2e-6, abs=1e-8)
        assert float(forward) == pytest.approx(reverse, rel=1e-9)


@pytest.mark.slow
def test_hard_cases_are_finite_and_right():
    """Opaque and empty media; a lamp on a node; volumes of one voxel; a clipping box with nodes outside of it."""
    solid = lambda sigma: jvr.LinearTransfer([0.0, 1.0], np.zeros((2, 3)), [sigma, sigma])
    lamp = jvr.PointLight((4.0, 4.0, 4.0))
    total = lambda one, at: sum(jnp.sum(light[0]) for light in lights_at(one, at))
    slope = eqx.filter_jit(eqx.filter_grad(total))
    at = np.array([[4.0, 4, 4 + 1e-3], [0, 0, 0], [4, 4, 4.5], [8, 8, 8], [1, 7, 3]])
    for lights in ((lamp,), (sun(),)):
        for sigma, everything in ((0.0, 1.0), (1e30, 0.0)):
            one = scene(jvr.PiecewiseShadows(2, 0.25), jvr.Volume(np.ones((9, 9, 9))), solid(sigma), lights)
            _, length = way(one, lights[0], at)
            lit = found(one, at)[0, 0]
            np.testing.assert_allclose(lit[length > 0.1], everything, atol=1e-12)
            assert np.all(np.isfinite(lit))
            gradient = slope(one, points(np.array([[4.0, 4, 4], *at])))
            assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(gradient))
    # Light leaves a single voxel through its side.
    thin = scene(jvr.PiecewiseShadows(2), jvr.Volume(np.ones((1, 1, 1))), solid(1.0), (sun(),))
    np.testing.assert_allclose(found(thin, np.zeros((1, 3))), np.exp(-0.5 * np.sqrt(0.77) / 0.6), rtol=1e-5)
    # The clipped part is opaque.
    values = np.where(np.arange(9) > 5, 1.0, 0.1) * np.ones((9, 9, 9))
    box = jvr.ClippingBox((-1, -1, -1), (9, 9, 5))
    clear = jvr.LinearTransfer([0.2, 0.3], np.zeros((2, 3)), [0.05, 1e4])
    cut = scene(
        jvr.PiecewiseShadows(0.3, 0.4), jvr.Volume(values), clear, (jvr.DirectionalLight((0.0, 0.0, -1.0)),), clipping=box
    )
    z = np.array([4.9, 4.3, 2.2, 0.0])
    lit = found(cut, np.stack([0 * z + 4.2, 0 * z + 3.3, z], axis=1))[0, 0]
    np.testing.assert_allclose(lit, np.exp(-0.05 * (5 - z)), rtol=1e-5)
