"""Scenes whose picture is known in closed form, order of convergence, and what a picture must not depend on."""

import contextlib
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import _slabs, camera_rays
from scenes import OBLIQUE, affine, linear_transfer, perspective, render, voxels

import jvr
from jvr.march import wavefront

SETTINGS = jvr.Settings(0.5, termination=0)
COLOUR = np.array([0.9, 0.5, 0.2])
BACKGROUND = np.array([0.1, 0.4, 0.7])
LENGTH = 8.0

# Sums of up to 80 terms of rounding error 6e-8 or 1e-16, relative to the value.
PRECISIONS = pytest.mark.parametrize(("double", "tolerance"), [(False, 1e-5), (True, 1e-10)], ids=["float32", "float64"])


def precision(double):
    return jax.enable_x64(True) if double else contextlib.nullcontext()


def bar(profile, thickness=0.37, **options):
    """A volume that varies along x only, length `LENGTH`, seen along -x. The step is a part of the smallest spacing, so that
    `thickness`, the spacing in y, sets the step without another compilation."""
    values = np.broadcast_to(np.asarray(profile, float)[:, None, None], (9, 2, 2))
    return jvr.Volume(values, affine((1.0, thickness, 1.0)), **options)


def view(thickness=0.37):
    """Three parallel rays that enter at x = LENGTH after 5 units."""
    return jvr.OrthographicCamera.look_at([LENGTH + 5, thickness / 2, 0.5], [0, thickness / 2, 0.5], [0, 0, 1], 0.6, 1, 3)


def ramp(sigma, colour=COLOUR):
    """Extinction from 0 at s = 0 to `sigma` at s = 1, one colour."""
    return jvr.LinearTransfer([0.0, 1.0], [colour, colour], [0.0, sigma])


def close(image, rgb, alpha, tolerance):
    np.testing.assert_allclose(image.rgb, np.broadcast_to(rgb, image.rgb.shape), rtol=tolerance)
    np.testing.assert_allclose(image.alpha, np.broadcast_to(alpha, image.alpha.shape), rtol=tolerance)


@pytest.mark.slow
@PRECISIONS
@pytest.mark.parametrize("thickness", [0.37, 3.0, 0.001])
def test_homogeneous_slab_whatever_the_step(double, tolerance, thickness):
    with precision(double):
        scene = jvr.Scene(bar(np.full(9, 1.0), thickness), ramp(0.2), background=BACKGROUND)
        image = render(scene, view(thickness), SETTINGS)
    T = math.exp(-0.2 * LENGTH)
    close(image, COLOUR * (1 - T) + BACKGROUND * T, 1 - T, tolerance)
    steps = math.ceil(LENGTH / (0.5 * min(thickness, 1)))
    assert np.all(abs(np.asarray(image.stats.steps) - steps) <= 1)


@pytest.mark.slow
@PRECISIONS
def test_homogeneous_box_from_every_side(double, tolerance):
    with precision(double):
        volume = jvr.Volume(np.full((5, 6, 7), 0.5), OBLIQUE)
        camera = perspective(volume)
        scene = jvr.Scene(volume, ramp(0.4), background=BACKGROUND)
        image = render(scene, camera, SETTINGS)
        matrix = np.linalg.inv(np.asarray(volume.world_from_grid, float))
    for origin, direction, rgb, alpha in zip(
        *(a.reshape(-1, 3) for a in camera_rays(camera)), image.rgb.reshape(-1, 3), image.alpha.reshape(-1), strict=True
    ):
        near, far = _slabs(matrix[:3, :3] @ origin + matrix[:3, 3], matrix[:3, :3] @ direction, (0, 0, 0), (4, 5, 6))
        tau = 0.2 * max(far - near, 0)
        # A corner that is barely cut has a chord that is a difference of large distances: absolute in alpha, too.
        np.testing.assert_allclose(rgb, -COLOUR * np.expm1(-tau) + BACKGROUND * np.exp(-tau), rtol=tolerance)
        np.testing.assert_allclose(alpha, -np.expm1(-tau), rtol=tolerance, atol=tolerance / 10)


@PRECISIONS
def test_linear_ramp_of_extinction(double, tolerance):
    """The midpoint rule is exact for a linear integrand, and one colour telescopes."""
    with precision(double):
        image = render(jvr.Scene(bar(np.linspace(0, 1, 9)), ramp(0.7), background=BACKGROUND), view(), SETTINGS)
    T = math.exp(-0.7 * LENGTH / 2)
    close(image, COLOUR * (1 - T) + BACKGROUND * T, 1 - T, tolerance)


@PRECISIONS
def test_emission_only(double, tolerance):
    with precision(double):
        scene = jvr.Scene(bar(np.linspace(0, 1, 9)), ramp(0.7), background=BACKGROUND, optical=jvr.EmissionOnly())
        image = render(scene, view(), SETTINGS)
    close(image, COLOUR * 0.7 * LENGTH / 2 + BACKGROUND, 0.0, tolerance)
    assert not np.asarray(image.depth).any()


@PRECISIONS
def test_absorption_only(double, tolerance):
    with precision(double):
        sigma = np.array([[0.0, 0.0, 0.0], [0.3, 0.7, 0.0]])
        transfer = jvr.LinearTransfer([0.0, 1.0], [COLOUR, COLOUR], sigma)
        scene = jvr.Scene(bar(np.linspace(0, 1, 9)), transfer, background=BACKGROUND, optical=jvr.AbsorptionOnly())
        image = render(scene, view(), SETTINGS)
    T = np.exp(-sigma[1] * LENGTH / 2)
    close(image, BACKGROUND * T, 1 - T.mean(), tolerance)


@PRECISIONS
def test_two_slabs_with_vacuum_between(double, tolerance):
    """Nearest voxels make sharp slabs: 0 ... 2.5 and 5.5 ... 8, on segments' ends for a step of 1/4."""
    with precision(double):
        rgb = np.array([[0.3, 0.3, 0.3], [0.9, 0.1, 0.4], [0.2, 0.8, 0.5]])
        transfer = jvr.LinearTransfer([0.0, 1.0, 2.0], rgb, [0.0, 0.4, 0.15])
        volume = bar([1, 1, 1, 0, 0, 0, 2, 2, 2], 0.5, interpolation=jvr.Nearest())
        image = render(jvr.Scene(volume, transfer, background=BACKGROUND), view(0.5), SETTINGS)
    front, back = math.exp(-0.15 * 2.5), math.exp(-0.4 * 2.5)
    close(image, rgb[2] * (1 - front) + front * (rgb[1] * (1 - back) + back * BACKGROUND), 1 - front * back, tolerance)


def test_order_of_convergence_is_two(x64):
    """A smooth scene: a linear scalar under two Gaussians of different colour; the truth by Gauss-Legendre quadrature."""
    center, width, height = np.array([0.3, 0.7]), np.array([0.12, 0.15]), np.array([0.5, 0.8])
    rgb = np.array([[0.9, 0.2, 0.1], [0.1, 0.5, 0.8]])
    node, weight = np.polynomial.legendre.leggauss(400)
    u, weight = (node + 1) / 2, weight / 2
    # The ray enters at s = 1 and leaves at s = 0: s = 1 - u, with u in parts of LENGTH.
    each = height * np.exp(-(((1 - u)[:, None] - center) ** 2) / (2 * width**2))
    erf = np.vectorize(math.erf)
    scaled = lambda s: erf((s[:, None] - center) / (width * math.sqrt(2)))
    tau = LENGTH * ((scaled(np.ones(1)) - scaled(1 - u)) * height * width * math.sqrt(math.pi / 2)).sum(1)
    radiance = LENGTH * weight @ (np.exp(-tau)[:, None] * (each @ rgb))
    opacity = LENGTH * weight @ (np.exp(-tau) * each.sum(1))
    depth = 5 + LENGTH * (LENGTH * weight @ (np.exp(-tau) * each.sum(1) * u)) / opacity
    transfer = jvr.GaussianTransfer(center, width, height, rgb)
    steps, errors = [], []
    for segments in (32, 64, 128, 256):
        thickness = 2 * LENGTH / segments
        image = render(jvr.Scene(bar(np.linspace(0, 1, 9), thickness), transfer), view(thickness), SETTINGS)
        steps.append(LENGTH / segments)
        errors.append(
            [np.abs(image.rgb[0, 0] - radiance).max(), abs(image.depth[0, 0] - depth), abs(image.alpha[0, 0] - opacity)]
        )
    orders = np.polyfit(np.log(steps), np.log(np.array(errors)), 1)[0]
    # Optical depth alone converges faster here: the midpoint rule is exact to all orders but its boundary terms.
    assert np.all(np.abs(orders[:2] - 2) < 0.05), orders
    assert np.array(errors)[-1].max() < 1e-4


@pytest.mark.parametrize("scale", [1e-6, 1e3])
def test_unit_of_length_does_not_matter(scale):
    """One scene in millimetres, in kilometres and in micrometres."""

    def picture(scale):
        matrix = OBLIQUE.copy()
        matrix[:3] *= scale
        volume = jvr.Volume(voxels(), matrix)
        transfer = linear_transfer()
        transfer = jvr.LinearTransfer(transfer.positions, transfer.rgb, np.asarray(transfer.sigma_t) / scale)
        return render(jvr.Scene(volume, transfer, background=BACKGROUND), perspective(volume), SETTINGS)

    one, other = picture(1.0), picture(scale)
    np.testing.assert_allclose(other.rgb, one.rgb, atol=1e-5)
    np.testing.assert_allclose(other.alpha, one.alpha, atol=1e-5)
    np.testing.assert_allclose(other.depth / scale, one.depth, rtol=1e-5, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("termination", [1e-2, 0.3])
def test_error_of_early_termination_is_bounded_by_its_setting(termination):
    volume = jvr.Volume(voxels(), OBLIQUE)
    transfer, camera = linear_transfer(scale=2.0), perspective(volume)
    scene = jvr.Scene(volume, transfer, background=BACKGROUND)
    exact = render(scene, camera, SETTINGS)
    ended = render(scene, camera, jvr.Settings(0.5, termination=termination))
    brightest = max(float(transfer.rgb.max()), BACKGROUND.max())
    error = np.abs(np.asarray(ended.rgb - exact.rgb)).max()
    assert 0 < error <= termination * brightest
    assert np.abs(np.asarray(ended.alpha - exact.alpha)).max() <= termination
    assert np.asarray(ended.stats.steps).sum() < np.asarray(exact.stats.steps).sum()
    # Nothing ended early that was more transparent than the setting.
    short = np.asarray(ended.stats.steps) < np.asarray(exact.stats.steps)
    assert np.all(1 - np.asarray(ended.alpha)[short] <= termination * (1 + 1e-5))


@pytest.mark.slow
def test_tiles_and_the_wavefront_change_nothing(monkeypatch):
    """All rays at once, against a wavefront that is filled again on the way and against tiles that do not divide the picture."""
    volume = jvr.Volume(voxels(), OBLIQUE)
    camera = perspective(volume, 24, 20)

    def loss(values, tile):
        scene = jvr.Scene(jvr.Volume(values, OBLIQUE), linear_transfer(scale=3.0), background=BACKGROUND)
        image = jvr.render(scene, camera, jvr.Settings(0.5, tile=tile))
        return jnp.sum(jnp.sin(3 * image.rgb)) + jnp.sum(image.alpha**2) + 0.1 * jnp.sum(image.depth), image

    def both(width, tile):
        monkeypatch.setattr(wavefront, "WAVEFRONT", width)
        (_, image), gradient = jax.jit(jax.value_and_grad(lambda v: loss(v, tile), has_aux=True))(volume.values)
        return image, gradient

    whole, gradient = both(1000, 1000)
    for width, tile in ((100, 1000), (1000, 130)):
        image, other = both(width, tile)
        for a, b in zip(jax.tree.leaves(image), jax.tree.leaves(whole), strict=True):
            # Programs for batches of other sizes round differently. Entry and exit are distances near 30, so that a chord is
            # good to 6e-6 and its optical depth here to 1e-5.
            np.testing.assert_allclose(a, b, rtol=2e-5, atol=3e-5)
        # Sums of hundreds of terms of both signs, in another order.
        np.testing.assert_allclose(other, gradient, atol=2e-5 * np.abs(gradient).max())
