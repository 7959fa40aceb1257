"""Derivatives of gradients against central differences of these, in double precision."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, perspective

import jvr

# Central differences: the rounding of a gradient divided by h = 1e-6, and h^2.
DIFFERENCES = 1e-7


def scene_and_camera():
    """Half of the volume is empty, as bricks are, and the colours of what is empty matter once it has extinction."""
    values = np.random.default_rng(0).random((13, 5, 6))
    values[:8] = 0.2 * values[:8]
    colours = np.random.default_rng(1).random((6, 3))
    table = jvr.LutTransfer(colours, [0.0, 0.0, 0.4, 0.1, 0.3, 0.5], [0.0, 1.0])
    volume = jvr.Volume(values, OBLIQUE)
    return jvr.Scene(volume, table, background=(0.1, 0.3, 0.2)), perspective(volume, 4, 3)


INTO = {
    "table": lambda s: (s.transfer.rgb, s.transfer.sigma_t),
    "voxels": lambda s: (s.transfer.rgb, s.transfer.sigma_t, s.volume.values, s.volume.world_from_grid),
}


def make_loss(unknowns, adjoint, depth=True):
    scene, camera = scene_and_camera()
    settings = jvr.Settings(0.7, adjoint=adjoint, termination=0)

    def loss(arrays):
        picture = jvr.render(eqx.tree_at(INTO[unknowns], scene, arrays), camera, settings)
        return jnp.sum(jnp.sin(3 * picture.rgb)) + (jnp.sum(jnp.cos(picture.depth)) if depth else 0.0)

    if depth:
        # The depth jumps to 0 where nothing is: then there is something everywhere.
        scene = eqx.tree_at(lambda s: s.transfer.sigma_t, scene, scene.transfer.sigma_t + 0.05)
    start = INTO[unknowns](scene)
    rng = np.random.default_rng(2)
    along = tuple(jnp.asarray(rng.standard_normal(x.shape)) for x in start)
    if unknowns == "voxels":
        along = (*along[:3], along[3].at[3].set(0.0))
    return loss, start, along


def differences(function, start, along, h=1e-6):
    at = lambda t: jax.tree.map(lambda x, v: x + t * v, start, along)
    return jax.tree.map(lambda a, b: (a - b) / (2 * h), function(at(h)), function(at(-h)))


def close(found, expected):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=DIFFERENCES, atol=DIFFERENCES * float(np.max(np.abs(b))))
        assert np.max(np.abs(b)) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("unknowns", "adjoint", "depth"), [("voxels", jvr.Replay(), True), ("table", jvr.Rows(), False), ("table", jvr.Rows(), True)]
)
def test_hessian_vector_products(unknowns, adjoint, depth, x64):
    loss, start, along = make_loss(unknowns, adjoint, depth)
    gradient = jax.jit(jax.grad(loss))
    product = jax.jit(lambda x, v: jax.jvp(jax.grad(loss), (x,), (v,))[1])
    close(product(start, along), differences(gradient, start, along))


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [jvr.Replay(), jvr.Rows()])
def test_the_gradient_in_colours_along_extinctions_that_are_zero(adjoint, x64):
    """What a gradient in colours alone skips has a derivative in the extinction."""
    loss, (rgb, sigma_t), (_, along) = make_loss("table", adjoint, depth=False)
    along = jnp.abs(along)
    gradient = lambda sigma_t: jax.grad(lambda rgb: loss((rgb, sigma_t)))(rgb)
    product = jax.jit(lambda sigma_t: jax.jvp(gradient, (sigma_t,), (along,))[1])
    close(product(sigma_t), differences(jax.jit(gradient), sigma_t, along))


@pytest.mark.parametrize("adjoint", [jvr.Forward(), jvr.Replay()])
def test_forward_mode_twice(adjoint, x64):
    loss, start, along = make_loss("table", adjoint)
    slope = lambda x: jax.jvp(loss, (x,), (along,))[1]
    twice = jax.jit(lambda x: jax.jvp(slope, (x,), (along,))[1])
    close(twice(start), differences(jax.jit(slope), start, along))


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [jvr.Replay(), jvr.Rows()])
def test_reverse_mode_twice_is_refused_with_what_to_use(adjoint):
    loss, start, along = make_loss("table", adjoint, depth=False)
    along = lambda x: sum(jnp.vdot(g, v) for g, v in zip(jax.grad(loss)(x), start, strict=True))
    with pytest.raises(ValueError, match=r"use jax.jvp\(jax.grad\(loss\), \(x,\), \(v,\)\)"):
        jax.eval_shape(jax.grad(along), start)


def test_reverse_mode_through_forward_mode_is_refused_with_what_to_use():
    loss, start, _ = make_loss("table", jvr.Replay(), depth=False)
    with pytest.raises(ValueError, match=r"use jax.jvp\(jax.grad\(loss\), \(x,\), \(v,\)\)"):
        jax.eval_shape(jax.grad(lambda x: jax.jvp(loss, (x,), (start,))[1]), start)


def test_forward_mode_has_no_gradient_to_differentiate():
    loss, start, _ = make_loss("table", jvr.Forward(), depth=False)
    with pytest.raises(ValueError, match=r"jvr.Forward\(\) has no reverse mode: use Settings\(adjoint=jvr.Replay\(\)\)"):
        jax.eval_shape(lambda x: jax.jvp(jax.grad(loss), (x,), (start,)), start)
