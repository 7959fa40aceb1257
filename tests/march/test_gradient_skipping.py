"""Empty space that the length of the gradient knows: bounds by brute force, and pictures that are the same with and without it."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, perspective

import jvr
from jvr.march.fields import VoxelField
from jvr.march.occupancy import visible_bricks
from jvr.march.shaders import GradientFrame
from jvr.march.steepest import steepest_gradients
from jvr.march.steps import Point
from jvr.model.bricks import bricks_of
from jvr.numerics import direction_and_length
from jvr.rendering.medium import occupancy

SOBEL = jvr.PrecomputedGradient(sobel=True)
ESTIMATORS = {
    "analytic": jvr.AnalyticGradient(),
    "forward": jvr.ForwardDifferences(),
    "central": jvr.CentralDifferences(),
    "sobel": jvr.SobelDifferences(),
    "precomputed": jvr.PrecomputedGradient(),
    "precomputed sobel": SOBEL,
}
INTERPOLATIONS = {"trilinear": jvr.Trilinear(), "tricubic": jvr.Tricubic(), "nearest": jvr.Nearest()}


def lumps(shape, seed=0):
    """Even regions of different values, beside noise."""
    rng = np.random.default_rng(seed)
    values = np.where(np.arange(shape[0])[:, None, None] < shape[0] // 2, 40.0, 180.0) * np.ones(shape)
    values[:, : shape[1] // 3] += 60 * rng.random((shape[0], shape[1] // 3, shape[2]))
    return np.rint(values)


@functools.partial(jax.jit, static_argnums=(1,))
def lengths(volume, normals, p):
    """The length of the gradient at positions of the grid, as a march finds it."""
    transfer = jvr.GradientOpacity(jvr.LinearTransfer([0.0, 1.0], np.ones((2, 3)), [1.0, 1.0]), 0.0, 1.0)
    normals = normals.with_gradients(volume, transfer)
    frame = GradientFrame(eqx.filter(normals, False), volume.axes_inverse, volume.intercept, volume.shape)

    def one(p):
        point = Point(p, (), jnp.int32(0), jnp.int32(0))
        return direction_and_length(frame.in_world(transfer, VoxelField(volume, normals).resample(point), point).gradient)[1]

    return jax.vmap(one)(p)


bounds = jax.jit(steepest_gradients, static_argnums=(1, 2))


SLOW = {("sobel", "tricubic"), ("central", "tricubic"), ("forward", "tricubic")}


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        pytest.param(name, kind, marks=pytest.mark.slow) if (name, kind) in SLOW else (name, kind)
        for name in ESTIMATORS
        for kind in INTERPOLATIONS
    ],
)
def test_no_gradient_in_a_brick_is_longer_than_its_bound(name, kind):
    """At random positions, at voxels, halfway between them and at corners of bricks, of oblique axes and a negative slope."""
    shape, rng = (9, 12, 6), np.random.default_rng(1)
    volume = jvr.Volume(lumps(shape), OBLIQUE, slope=-2.0, intercept=7.0, interpolation=INTERPOLATIONS[kind])
    last = np.array(shape)[:, None] - 1
    p = np.concatenate([rng.random((3, 4000)) * last, np.rint(2 * rng.random((3, 4000)) * last) / 2], axis=1)
    found = np.asarray(lengths(volume, ESTIMATORS[name], tuple(jnp.asarray(p, jnp.float32))))
    for size in (1, 4, 10**9):
        bound = np.asarray(bounds(volume, ESTIMATORS[name], size))
        brick = np.minimum(np.floor(p / size), np.array(bound.shape)[:, None] - 1).astype(int)
        assert np.all(found <= bound[tuple(brick)])
        # Two even regions, of which one brick or the next does not see the noise.
        assert np.any(bound == 0) or size > 1
    # Loose by what estimators average, and by the corner of the box at most; the nearest voxel's own derivative is zero.
    assert np.max(found) > 0.1 * np.max(bound) or (kind, name) == ("nearest", "analytic")


def test_even_regions_have_no_gradient_and_missing_numbers_any():
    values = np.full((13, 9, 9), -1000.0)
    volume = jvr.Volume(values, intercept=3.3)
    assert np.all(np.asarray(bounds(volume, jvr.CentralDifferences(), 4)) == 0)
    broken = eqx.tree_at(lambda v: v.values, volume, volume.values.at[1, 1, 1].set(jnp.nan))
    found = np.asarray(bounds(broken, jvr.AnalyticGradient(), 4))
    assert np.isinf(found[0, 0, 0])
    assert found[2, 1, 1] == 0


class Wild(jvr.CentralDifferences):
    """An estimator that has nothing to say of its reach."""

    reach = None


def test_of_an_estimator_of_ones_own_nothing_is_known():
    assert steepest_gradients(jvr.Volume(np.zeros((3, 3, 3))), Wild(), 4) is None


def table(rng, coloured=False):
    sigma_t = rng.choice([0.0, 0.0, 0.0, 2.0], (5, 4, 3) if coloured else (5, 4))
    return jvr.GradientTransfer(rng.random((5, 4, 3)), sigma_t, [0.0, 8.0], rng.choice([0.0, 1.0]) + np.array([0.0, 6.0]))


@functools.partial(jax.jit, static_argnums=2)
def visible_below(transfer, bounds, nearby):
    return jax.vmap(lambda *x: transfer.is_visible_below(*x, nearby=nearby))(*bounds)


extinctions = jax.jit(lambda transfer, s, g: jax.vmap(lambda s, g: jnp.stack(transfer.evaluate(s, g).sigma_t))(s, g))


@pytest.mark.parametrize("coloured", [False, True])
def test_what_is_called_invisible_has_no_extinction(coloured):
    """Rectangles of values and lengths against a fine grid; with `nearby` against one that is a little larger."""
    rng, counts = np.random.default_rng(3), np.zeros(2, int)
    for _ in range(6):
        transfer = table(rng, coloured)
        low = np.float32(rng.choice(np.arange(-2, 11, 0.5), 60))
        high, steepest = low + np.float32(rng.choice([0.0, 0.5, 1.5], 60)), np.float32(rng.choice(np.arange(0, 9, 0.5), 60))
        for nearby in (False, True):
            found, grow = np.asarray(visible_below(transfer, (low, high, steepest), nearby)), 0.01 * nearby
            for a, b, top, said in zip(low, high, steepest, found, strict=True):
                s, g = np.meshgrid(np.linspace(a - grow, b + grow, 41), np.linspace(0, top + grow, 41))
                true = np.any(np.asarray(extinctions(transfer, s.ravel(), g.ravel())) > 0)
                # Whole and half numbers of entries: what is visible is not missed by a rounding of the grid.
                assert said == true or (said and nearby)
            counts[int(nearby)] += np.count_nonzero(found)
    assert 0 < counts[0] < counts[1] < 6 * 60


def test_opacity_by_gradient_begins_above_its_low_end():
    transfer = jvr.GradientOpacity(jvr.LinearTransfer([0.0, 1.0], np.ones((2, 3)), [0.0, 1.0]), 2.0, 5.0)
    at = lambda steepest, **how: bool(transfer.is_visible_below(*map(jnp.asarray, (0.2, 0.4, steepest)), **how))
    assert [at(x) for x in (1.9, 2.0, 2.1)] == [False, False, True]
    assert [at(x, nearby=True) for x in (1.9, 2.0, 2.1)] == [False, True, True]
    assert not bool(transfer.is_visible_below(*map(jnp.asarray, (-0.4, -0.2, 9.0))))


def boundaries(low=6.0):
    """A ball in a box, each even within, seen where they touch."""
    distance = np.linalg.norm(np.indices((25, 25, 25)) - 12.0, axis=0)
    values = np.where(distance < 8, 90.0, 40.0)
    transfer = jvr.GradientOpacity(jvr.LinearTransfer([0.0, 100.0], np.ones((2, 3)), [0.0, 1.0]), low, 40.0)
    return jvr.Scene(jvr.Volume(values), transfer, background=(0.1, 0.2, 0.3))


@pytest.mark.slow
def test_bricks_without_boundaries_are_empty():
    """Of cells of 4^3 voxels those alone are visible in which both values are."""
    scene = boundaries()
    seen = np.asarray(occupancy(scene, jvr.Settings()).empty_radius) == 0
    ranges = bricks_of(scene.volume.values, 4)
    wanted = np.asarray(ranges.lower < ranges.upper)
    assert np.all(seen >= wanted)
    # The one voxel behind a brick along an axis counts, too.
    assert np.count_nonzero(seen) <= 1.3 * np.count_nonzero(wanted)
    without = visible_bricks(ranges, scene.volume.slope, scene.volume.intercept, scene.transfer)
    assert np.all(np.asarray(without))


@pytest.mark.slow
@pytest.mark.parametrize(("normals", "most"), [(jvr.AnalyticGradient(), 4.0), (SOBEL, 9.0)])
def test_pictures_and_gradients_are_the_same_and_take_fewer_samples(normals, most, x64):
    """With respect to voxels and the ends of the opacity; the latter by a replay that skips nothing. Of the 13 samples a ray are left those
    around the surface, and with Sobel's differences those from where a voxel next to it is read."""
    scene = eqx.tree_at(lambda s: s.normals, boundaries(), normals)
    camera = perspective(scene.volume, 12, 10)
    weights = np.random.default_rng(0).random((10, 12, 3))

    @functools.partial(jax.jit, static_argnums=1)
    def value(parts, skipping):
        values, low = parts
        changed = eqx.tree_at(lambda s: (s.volume.values, s.transfer.low), scene, (values, low))
        found = jvr.render(changed, camera, jvr.Settings(0.7, termination=0, skipping=skipping))
        return jnp.sum(weights * found.rgb) + jnp.sum(found.alpha), found.stats.samples

    parts = (scene.volume.values, scene.transfer.low)
    both = [jax.jit(jax.value_and_grad(value, has_aux=True), static_argnums=1)(parts, skipping) for skipping in (True, False)]
    ((on, some), of_on), ((off, all_), of_off) = both
    np.testing.assert_allclose(on, off, rtol=1e-12)
    for a, b in zip(of_on, of_off, strict=True):
        assert np.any(np.asarray(a) != 0)
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
    assert int(all_) == 13 * 120
    assert int(some) < most * 120
