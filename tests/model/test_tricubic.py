"""Tricubic B-splines: against SciPy's splines, their derivatives, the bounds of bricks, and what is missing."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, linear_transfer, perspective, render, voxels
from scipy import ndimage
from scipy.interpolate import NdBSpline

import jvr

SHAPES = [(9, 7, 8), (4, 3, 2), (1, 5, 4)]


def cubic(values, **options):
    return jvr.Volume(values, interpolation=jvr.Tricubic(), **options)


def everywhere(shape, n=200, seed=0):
    """Grid positions inside, at voxels and on the border."""
    p = np.random.default_rng(seed).random((n, 3)) * (np.array(shape) - 1.0)
    p[: n // 4] = np.round(p[: n // 4])
    return p


@jax.jit
def sampled(volume, p):
    return jax.vmap(lambda x: volume.sample(tuple(x)))(p)


@pytest.mark.parametrize("shape", SHAPES)
def test_values_are_those_of_scipy(shape, x64):
    """Voxels as coefficients, and the spline through the voxels, mirrored at the border."""
    values, p = voxels(shape), everywhere(shape)
    of = functools.partial(ndimage.map_coordinates, coordinates=p.T, order=3, mode="mirror")
    np.testing.assert_allclose(sampled(cubic(values), p), of(values, prefilter=False), atol=1e-13)
    through = cubic(values).prefiltered()
    np.testing.assert_allclose(through.values, ndimage.spline_filter(values, mode="mirror"), atol=1e-13)
    np.testing.assert_allclose(sampled(through, p), of(values), atol=1e-12)
    whole = np.round(p)
    np.testing.assert_allclose(sampled(through, whole), values[tuple(whole.astype(int).T)], atol=1e-12)


@pytest.mark.slow
def test_derivatives_are_those_of_the_spline(x64):
    """First and second, against those of SciPy's B-splines with mirrored coefficients; no kink from one cell to the next."""
    shape = (6, 5, 7)
    values, p = voxels(shape), everywhere(shape, 60)[15:]
    padded = np.pad(values, 1, mode="reflect")
    knots = tuple(np.arange(-3.0, n + 3) for n in shape)
    spline = NdBSpline(knots, padded, 3)
    volume = cubic(values)
    of = lambda x: volume.sample(tuple(x))
    gradients, hessians = jax.jit(jax.vmap(jax.grad(of)))(p), jax.jit(jax.vmap(jax.hessian(of)))(p)
    for i in range(3):
        order = [int(i == a) for a in range(3)]
        np.testing.assert_allclose(gradients[:, i], spline(p, nu=order), atol=1e-12)
        for j in range(3):
            np.testing.assert_allclose(hessians[:, i, j], spline(p, nu=[o + (j == a) for a, o in enumerate(order)]), atol=1e-12)
    sides = jnp.asarray([[2 - 1e-9, 1.3, 2.7], [2 + 1e-9, 1.3, 2.7]])
    before, after = jax.jit(jax.vmap(jax.hessian(of)))(sides)
    np.testing.assert_allclose(before, after, atol=1e-6)


@pytest.mark.slow
def test_converges_with_order_four(x64):
    """On a smooth field whose mirror images continue it smoothly."""
    field = lambda x: np.cos(np.pi * x[..., 0]) * np.cos(2 * np.pi * x[..., 1]) + np.cos(3 * np.pi * x[..., 2])
    where, errors, sizes = np.random.default_rng(1).random((500, 3)), [], (17, 33, 65)
    for n in sizes:
        x = np.stack(np.meshgrid(*[np.linspace(0, 1, n)] * 3, indexing="ij"), -1)
        errors.append(np.sqrt(np.mean((sampled(cubic(field(x)).prefiltered(), where * (n - 1)) - field(where)) ** 2)))
    found = -np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert abs(found - 4) < 0.3, (found, errors)


@pytest.mark.slow
def test_skipping_leaves_nothing_out(x64):
    """Single bright voxels at the borders of bricks: the spline carries them into bricks that hold none of them."""
    values = np.zeros((29, 12, 14))
    values[4, 4, 4] = values[5, 9, 8] = values[0, 11, 12] = 1.0
    transfer = jvr.LinearTransfer([0.0, 1e-3, 1.0], np.ones((3, 3)), [0.0, 5.0, 5.0])
    volume = jvr.Volume(values, OBLIQUE, interpolation=jvr.Tricubic()).bricked()
    scene, camera = jvr.Scene(volume, transfer), perspective(volume, 16, 16)
    images = [render(scene, camera, jvr.Settings(0.3, termination=0, skipping=skips)) for skips in (True, False)]
    np.testing.assert_allclose(images[0].rgb, images[1].rgb, rtol=1e-10, atol=1e-14)
    assert images[0].stats.steps.sum() < 0.8 * images[1].stats.steps.sum()
    assert np.count_nonzero(images[1].alpha > 0.1) > 8


@pytest.mark.slow
def test_every_derivative_of_a_picture(x64):
    """In voxels and in the transfer function by replay, against central differences."""
    values, transfer = jnp.asarray(voxels((5, 4, 3))), linear_transfer()
    camera = perspective(jvr.Volume(values, OBLIQUE), 4, 3)
    weight = jnp.sin(jnp.arange(1.0, 37)).reshape(3, 4, 3)

    def loss(values, sigma_t):
        volume = jvr.Volume(values, OBLIQUE, interpolation=jvr.Tricubic())
        scene = jvr.Scene(volume, jvr.LinearTransfer(transfer.positions, transfer.rgb, sigma_t))
        return jnp.sum(weight * jvr.render(scene, camera, jvr.Settings(0.7, termination=0)).rgb ** 2)

    of_values, of_sigma = jax.jit(jax.grad(loss, argnums=(0, 1)))(values, transfer.sigma_t)
    value, h = jax.jit(loss), 1e-6
    for i in (0, 23, 31, 59):
        move = lambda sign, i=i: value(values.ravel().at[i].add(sign * h).reshape(values.shape), transfer.sigma_t)
        np.testing.assert_allclose(of_values.ravel()[i], (move(1) - move(-1)) / (2 * h), rtol=1e-5, atol=1e-9)
    move = lambda sign: value(values, transfer.sigma_t.at[2].add(sign * h))
    np.testing.assert_allclose(of_sigma[2], (move(1) - move(-1)) / (2 * h), rtol=1e-6)


def test_normals_of_a_ball_have_no_facets(x64):
    """Of an analytic field: directions of the interpolant's own gradient jump from cell to cell, those of the spline do not."""
    x = np.stack(np.meshgrid(*[np.arange(16.0)] * 3, indexing="ij"), -1) - 7.4
    values = np.linalg.norm(x, axis=-1)
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    p = 7.4 + 5 * np.stack([np.cos(angle), 0.8 * np.sin(angle), 0.6 * np.sin(angle)], -1)
    truth = (p - 7.4) / np.linalg.norm(p - 7.4, axis=-1, keepdims=True)
    errors = {}
    for interpolation in (jvr.Trilinear(), jvr.Tricubic()):
        volume = jvr.Volume(values, interpolation=interpolation)
        found = np.asarray(jax.jit(jax.vmap(jax.grad(lambda x, volume=volume: volume.sample(tuple(x)))))(p))
        found = found / np.linalg.norm(found, axis=-1, keepdims=True)
        errors[type(interpolation).__name__] = np.rad2deg(np.max(np.linalg.norm(found - truth, axis=-1)))
    assert errors["Trilinear"] > 4
    assert errors["Tricubic"] < 0.6


def test_what_is_made_of_missing_voxels_is_missing():
    values = voxels((7, 6, 8)).astype(np.float32)
    values[3, 3, 3] = np.nan
    volume = cubic(values)
    p = jnp.asarray(everywhere(volume.shape, 400)[100:], jnp.float32)
    known = np.asarray(jax.jit(jax.vmap(lambda x: volume.is_known(tuple(x))))(p))
    low = np.clip(np.floor(np.asarray(p)), 0, np.array(volume.shape) - 2)
    np.testing.assert_array_equal(known, ~np.all((low >= 1) & (low <= 4), axis=1))


def test_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="set Volume"):
        jvr.Volume(voxels()).prefiltered()
    gappy = voxels()
    gappy[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="voxels are missing"):
        cubic(gappy).prefiltered()
