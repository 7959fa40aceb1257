"""Ambient occlusion of isosurfaces: closed forms at points of planes, walls and balls, derivatives, pictures."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import linear_transfer, render

import jvr
from jvr.march.steps import OnSurface, Point
from jvr.rendering.medium import absorbing

SHAPE = (25, 25, 25)
X, Y, Z = np.meshgrid(*[np.arange(n, dtype=np.float32) - 12 for n in SHAPE], indexing="ij")
WHITE = [[1.0, 1.0, 1.0]]


def scene(values, occlusion, **parts) -> jvr.Scene:
    given = {"lights": (jvr.AmbientLight(1.0),), "shading": jvr.Lambert(), "surfaces": jvr.Isosurfaces([0.0], WHITE)}
    return jvr.Scene(jvr.Volume(values), linear_transfer(scale=0.0), occlusion=occlusion, **(given | parts))


@jax.jit
def found(one: jvr.Scene, x, gradient, value=0.0, turned=1.0):
    """What arrives at points `(n, 3)` of a surface that are seen along their gradients, or, `turned`, against them."""
    n = x.shape[0]
    column = lambda v: tuple(jnp.asarray(v).T)
    surface = OnSurface(jnp.full(n, value), column(gradient))
    points = Point(column(x), column(turned * jnp.asarray(gradient)), *(jnp.zeros(n, jnp.int32),) * 2, surface)
    visibility = one.occlusion.visibility(one, lambda graded: absorbing(one, None, graded))
    return visibility.transmittances(points, jnp.ones(n, bool), reverse=True).ambient[0]


def at(values, occlusion, x, gradient, turned=1.0) -> np.ndarray:
    x, gradient = (jnp.asarray(np.atleast_2d(v), jnp.float32) for v in (x, gradient))
    return np.asarray(found(scene(values, occlusion), x, gradient, turned=turned))


def wall(distance, rays=2048) -> np.ndarray:
    """Points on the floor, so far from a wall that is as long as the reach of rays is not."""
    occlusion = jvr.SurfaceOcclusion(rays, 10, factor=1.0, tilt=0.0)
    x = np.stack([np.asarray(distance) - 5.0, 0 * distance, 0 * distance], axis=1) + 12
    # Below the floor, or behind the wall.
    return at(np.maximum(-Z, -5 - X), occlusion, x, np.tile([0.0, 0.0, -1.0], (len(x), 1)))


def ball(**choices) -> float:
    """The lowest point of a hollow ball of radius 10, seen from inside."""
    occlusion = jvr.SurfaceOcclusion(2048, **({"steps": 10, "factor": 1.0, "tilt": 0.0} | choices))
    return at(np.sqrt(X**2 + Y**2 + Z**2) - 10, occlusion, [12, 12, 2], [0.0, 0.0, -1.0])[0]


def test_a_plane_is_free():
    assert at(-Z, jvr.SurfaceOcclusion(64, tilt=0.0), [12, 12, 12], [0.0, 0.0, -1.0])[0] == 1
    # From below, too: what is above is then what is not seen.
    assert at(-Z, jvr.SurfaceOcclusion(64, tilt=0.0), [12, 12, 12], [0.0, 0.0, -1.0], turned=-1.0)[0] == 1


def test_beside_a_wall_it_is_a_half_and_more():
    """`(1 + x / R) / 2` at a distance `x` from an infinite wall, with the reach `R`."""
    distance = np.array([0.0, 2.0, 5.0, 8.0, 10.0, 11.0])
    np.testing.assert_allclose(wall(distance), (1 + np.minimum(distance / 10, 1)) / 2, atol=0.01)


@pytest.mark.slow
def test_inside_of_a_ball():
    """`1 - min(1, R / (2 rho))`, its square where cosines count; tilted rays are those that leave the ball later."""
    assert ball() == pytest.approx(0.5, abs=0.01)
    assert ball(steps=5) == pytest.approx(0.75, abs=0.01)
    assert ball(steps=20) == pytest.approx(0.0, abs=0.01)
    assert ball(cosine=True) == pytest.approx(1 - 0.25, abs=0.01)
    height = (np.arange(4096) + 0.5) / 4096
    tilted = (height + 0.1) / np.sqrt(1 + 0.2 * height + 0.01)
    assert tilted.mean() == pytest.approx(0.563, abs=1e-3)
    assert ball(tilt=0.1) == pytest.approx(np.mean(tilted > 0.5), abs=0.01)


def test_more_rays_come_nearer():
    """At least as fast as random ones do: a sixteenth of the error with 256 times as many."""
    distance = np.linspace(1.0, 9.0, 9)
    errors = [np.sqrt(np.mean((wall(distance, rays) - (1 + distance / 10) / 2) ** 2)) for rays in (8, 2048)]
    assert errors[1] < errors[0] / 16


def test_derivatives_are_those_of_differences(x64):
    """In voxels, the isovalue and the softness, in both modes; without a softness it is a constant."""
    values = np.random.default_rng(0).normal(size=(6, 6, 6)) + np.arange(6)[::-1]
    one = scene(values, jvr.SurfaceOcclusion(4, 2, factor=0.7, softness=3.0))
    x, gradient = jnp.asarray([[2.3, 2.6, 2.4], [3.1, 1.7, 2.2]]), jnp.asarray([[-0.9, 0.1, -0.3], [-0.5, 0.4, 0.2]])

    def loss(numbers, one):
        voxels, value, softness = numbers
        one = dataclasses.replace(
            one,
            volume=dataclasses.replace(one.volume, values=voxels),
            occlusion=dataclasses.replace(one.occlusion, softness=softness),
        )
        return jnp.sum(found(one, x, gradient, value) * jnp.asarray([1.0, 0.7]))

    numbers = (jnp.asarray(values), jnp.asarray(1.3), jnp.asarray(3.0))
    along = jax.tree.map(lambda n: jnp.asarray(np.random.default_rng(n.size).normal(size=n.shape)), numbers)
    moved = lambda by: float(loss(jax.tree.map(lambda n, a: n + by * a, numbers, along), one))
    expected = (moved(1e-6) - moved(-1e-6)) / 2e-6
    assert abs(expected) > 1e-3
    gradients = jax.grad(loss)(numbers, one)
    reverse = sum(float(jnp.sum(g * a)) for g, a in zip(gradients, along, strict=True))
    assert reverse == pytest.approx(expected, rel=1e-6)
    assert float(jax.jvp(lambda n: loss(n, one), (numbers,), (along,))[1]) == pytest.approx(expected, rel=1e-6)
    hard = scene(values, jvr.SurfaceOcclusion(4, 2, factor=0.7))
    of_value = jax.grad(lambda value: jnp.sum(found(hard, x, gradient, value)))
    assert of_value(1.3) == 0


@pytest.mark.slow
def test_pictures_are_darker_in_hollows_and_nowhere_else():
    """A bowl from above; a ball from outside is as bright as without."""
    radius = np.sqrt(X**2 + Y**2 + Z**2)
    occlusion = jvr.SurfaceOcclusion(16, 6, factor=1.5, tilt=0.2)
    for values, least, most in ((8 - radius, 0.98, 1.0), (np.where(Z > 4, -1.0, radius - 9), 0.0, 0.8)):
        one = scene(values.astype(np.float32), occlusion)
        camera = jvr.PerspectiveCamera.look_at((13, 11, 70), (12, 12, 12), (0, 1, 0), 20.0, 6, 6)
        plain, occluded = (np.asarray(render(s, camera).rgb) for s in (one.replaced(occlusion=None), one))
        np.testing.assert_allclose(plain[2:4, 2:4], 1.0, atol=1e-5)
        middle = occluded[2:4, 2:4]
        assert np.all((middle >= least) & (middle <= most))


def test_hard_cases_are_finite():
    """A point without a gradient, one at a border, opposite normals, data that are all the same, steps longer than the volume."""
    gradient = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1e30]]
    x = [[12, 12, 12], [0, 0, 0], [24, 24, 24], [12, 12, 0]]
    for values in (-Z, 0 * Z):
        for factor in (1e-6, 1.0, 1e6):
            assert np.all(((o := at(values, jvr.SurfaceOcclusion(8, 2, factor=factor), x, gradient)) >= 0) & (o <= 1))


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"surfaces": None}, r"that of isosurfaces: set surfaces=jvr\.Isosurfaces"),
        ({"shading": None, "scattering": jvr.SingleScattering()}, r"without a shading: set shading=jvr\.Lambert"),
        ({"lights": ()}, r"add a jvr\.AmbientLight"),
    ],
)
def test_what_does_not_go_together_says_what_would(parts, message):
    with pytest.raises(ValueError, match=message):
        scene(Z, jvr.SurfaceOcclusion(), **parts)


def test_it_goes_with_its_surfaces():
    one = scene(Z, jvr.SurfaceOcclusion())
    assert one.replaced(surfaces=None).occlusion is None
    assert one.replaced(lights=(jvr.AmbientLight(0.5),)).occlusion is not None
    (entry,) = (part for part in jvr.plan(one).parts if part.name == "occlusion")
    assert "at each hit" in entry.reason
