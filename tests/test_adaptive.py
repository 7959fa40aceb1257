"""Samples that are left out: in the image plane, and on slices."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import affine, compiled, perspective, voxels

import jvr

render = compiled(jvr.render)
WIDTH, HEIGHT = 45, 38


def blob(shape=(26, 25, 24), sharpness=5.0):
    """A smooth bump in the middle of nothing, 0 ... 1."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n) for n in shape], indexing="ij")
    return np.maximum(np.exp(-sharpness * (x**2 + (y - 0.2) ** 2 + z**2)) - 0.15, 0) / 0.85


def scene(values=None, transfer=None, matrix=None, **parts):
    volume = jvr.Volume(blob() if values is None else values, affine((1.0, 1.1, 1.2)) if matrix is None else matrix)
    transfer = jvr.LinearTransfer([0.2, 0.5, 0.9], voxels((3, 3, 1))[..., 0], [0.0, 0.15, 0.3]) if transfer is None else transfer
    return jvr.Scene(volume, transfer, **{"background": [0.2, 0.5, 0.9], **parts})


# Without a kink: a smooth picture.
SMOOTH = functools.partial(jvr.LinearTransfer, [0.0, 1.0], voxels((2, 3, 1))[..., 0])


def view(scene, width=WIDTH, height=HEIGHT, **where):
    return perspective(scene.volume, width, height, **{"away": 2.2, "fov_y": 50.0, **where})


def sampled(sampling, **others):
    return jvr.Settings(0.5, **{"termination": 0, "sampling": sampling, **others})


def difference(a, b):
    return max(float(jnp.max(jnp.abs(x - y))) for x, y in ((a.rgb, b.rgb), (a.alpha, b.alpha)))


def random_like(tree, seed=1):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: jnp.asarray(rng.standard_normal(x.shape)) if eqx.is_inexact_array(x) else None, tree)


# -- in the image plane


@pytest.mark.parametrize("size", [(45, 38), (1, 1), (5, 3), (2, 17)])
def test_no_tolerance_traces_every_ray(size):
    s = scene()
    every, refined = (render(s, view(s, *size), sampled(way)) for way in (jvr.Uniform(), jvr.Refinement(0, tile=4)))
    # Directions are rounded differently.
    assert difference(refined, every) < 5e-6
    np.testing.assert_allclose(refined.depth, every.depth, atol=1e-3)
    assert np.all(refined.stats.sampling.traced)
    np.testing.assert_array_equal(refined.stats.steps, every.stats.steps)


@pytest.mark.parametrize("tolerance", [0.02, 0.004])
def test_pictures_are_right_to_the_tolerance(tolerance):
    s = scene(transfer=SMOOTH([0.0, 0.15]))
    every, refined = (render(s, view(s), sampled(way)) for way in (jvr.Uniform(), jvr.Refinement(tolerance)))
    # Single pixels next to an edge of the picture may be farther off.
    assert float(jnp.sqrt(jnp.mean(jnp.square(refined.rgb - every.rgb)))) < tolerance / 4
    assert difference(refined, every) < 2 * tolerance
    assert np.sum(refined.stats.sampling.traced) < 0.8 * WIDTH * HEIGHT
    assert refined.stats.samples < 0.8 * every.stats.samples


def test_an_even_picture_takes_the_first_two_grids():
    s = scene(transfer=jvr.LinearTransfer([0.0, 1.0], np.ones((2, 3)), [0.0, 0.0]))
    picture = render(s, view(s), sampled(jvr.Refinement(0.001)))
    np.testing.assert_allclose(picture.rgb, jnp.broadcast_to(s.background, picture.rgb.shape), rtol=1e-6)
    # Every fourth ray of 45 x 38 pixels, extended to whole tiles of 8: 49 x 41.
    assert int(picture.stats.sampling.rays) == 13 * 11
    assert np.sum(picture.stats.sampling.traced) == 12 * 10


def test_refined_pictures_have_derivatives(x64):
    s = scene(transfer=SMOOTH([0.0, 0.15]))
    camera, settings = view(s, 13, 11), sampled(jvr.Refinement(0.01, tile=4))
    weights = np.random.default_rng(2).standard_normal((11, 13, 3))

    def value(tables):
        changed = eqx.tree_at(lambda s: (s.transfer.rgb, s.transfer.sigma_t), s, tables)
        picture = jvr.render(changed, camera, settings)
        return jnp.sum(picture.rgb * weights), picture.stats.sampling.rays

    tables = (s.transfer.rgb, s.transfer.sigma_t)
    value_of = compiled(value)
    gradient, rays = compiled(jax.grad(value, has_aux=True))(tables)
    assert int(rays) < 13 * 17
    along, h = random_like(tables), 1e-6
    (high, more), (low, less) = (value_of(jax.tree.map(lambda x, d, t=t: x + t * d, tables, along)) for t in (h, -h))
    # The same rays: placement is frozen as it is for the gradient.
    assert int(more) == int(less) == int(rays)
    found = sum(jnp.vdot(g, d) for g, d in zip(gradient, along, strict=True))
    np.testing.assert_allclose(found, (high - low) / (2 * h), rtol=1e-6, atol=1e-6)


# -- what is refused


class Fisheye(jvr.model.camera.AbstractCamera):
    world_from_camera: jax.Array
    width: int
    height: int

    def rays(self, pixels):
        raise NotImplementedError


@pytest.mark.parametrize("sampling", [jvr.Refinement()])
def test_what_cannot_be_rendered_is_refused(sampling):
    s = scene()
    with pytest.raises(ValueError, match=r"not a Fisheye: leave Settings"):
        jvr.render(s, Fisheye(jnp.eye(4), 4, 3), sampled(sampling))
    images = [np.zeros((3, 4, 3))]
    with pytest.raises(ValueError, match=r"every sample of every ray: leave Settings\(sampling=...\) at jvr.Uniform\(\)"):
        jvr.fit(s, [view(s, 4, 3)], images, settings=sampled(sampling), unknowns=lambda s: s.transfer.sigma_t)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jvr.Refinement(tile=6), "power of two from 2 to 64"),
        (lambda: jvr.Refinement(-1), "0 or more"),
        (lambda: jvr.Refinement(float("nan")), "0 or more"),
    ],
)
def test_values_out_of_range_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_sampling_is_an_object():
    # The tests' own check of types comes before the message.
    with pytest.raises(TypeError, match="sampling"):
        jvr.Settings(sampling="refinement")


@pytest.mark.parametrize("make", [jvr.Uniform, jvr.Refinement])
def test_samplings_are_static_and_explain_themselves(make):
    assert hash(make()) == hash(make())
    assert make() == make()
    assert not jax.tree.leaves(make())
    plan = jvr.plan(scene(), sampled(make()))
    (part,) = [part for part in plan.parts if part.name == "adaptive sampling"]
    assert part.included == (make is not jvr.Uniform)
    assert part.reason == make().explanation
