"""Empty-space skipping: bricks, leaps, and that a picture and its gradients are the same with and without."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import OBLIQUE, perspective

import jvr
from jvr.march.occupancy import RADII, occupancy_of
from jvr.model.bricks import bricks_of

SHAPES = [(9, 9, 9), (13, 6, 17), (1, 12, 10), (2, 3, 5), (1, 1, 1)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("size", [1, 3, 4])
def test_bricks_bound_the_voxels_around_each_of_their_points(shape, size):
    values = np.random.default_rng(0).integers(-50, 50, shape, dtype=np.int16)
    bricks = bricks_of(jnp.asarray(values), size)
    assert bricks.lower.dtype == values.dtype
    for brick in np.ndindex(bricks.lower.shape):
        inside = values[tuple(slice(b * size, b * size + size + 1) for b in brick)]
        assert (bricks.lower[brick], bricks.upper[brick]) == (inside.min(), inside.max())
    assert bricks.lower.shape == tuple(max(1, -(-(n - 1) // size)) for n in shape)


@pytest.mark.slow
def test_reach_is_the_largest_known_empty_cube():
    """Against the definition, by brute force."""
    rng = np.random.default_rng(1)
    values = np.where(rng.random((31, 26, 29)) < 2e-3, 1.0, 0.0)
    table = jvr.LinearTransfer([0.0, 0.5, 1.0], np.ones((3, 3)), [0.0, 0.0, 1.0])
    bricks = bricks_of(jnp.asarray(values), 1)
    reach = np.asarray(occupancy_of(bricks, jnp.asarray(1.0), jnp.asarray(0.0), table).reach)
    visible = np.argwhere(np.asarray(bricks.upper) > 0.5)
    cells = np.stack(np.meshgrid(*map(np.arange, reach.shape), indexing="ij"), -1)
    nearest = np.abs(cells[..., None, :] - visible).max(-1).min(-1)
    radii = np.asarray(RADII)
    largest = radii[np.searchsorted(radii, nearest - 1, side="right") - 1] + 1
    np.testing.assert_array_equal(reach, np.where(nearest == 0, 0, largest))


TABLES = st.integers(2, 9).flatmap(lambda n: st.lists(st.sampled_from([0.0, 0.0, 1e-30, 0.05, 3.0]), min_size=n, max_size=n))


@given(st.data())
@settings(max_examples=300, deadline=None)
def test_visibility_has_no_false_negatives(data):
    """Whatever is sampled between two values, a range called invisible has no extinction."""
    sigma_t = data.draw(TABLES)
    low, high = sorted(data.draw(st.tuples(*[st.floats(-0.5, 1.5, width=32)] * 2)))
    table = jvr.LutTransfer(np.ones((len(sigma_t), 3)), sigma_t, (0.0, 1.0))
    inside = np.linspace(low, high, 101, dtype=np.float32)
    extinction = np.interp(inside, np.linspace(0, 1, len(sigma_t)), sigma_t)
    visible = bool(table.is_visible(jnp.float32(low), jnp.float32(high)))
    assert visible or not extinction.any()
    # Not visible from afar either: an interval of two entries that are zero is empty.
    cell = np.clip(np.floor(np.array([low, high]) * (len(sigma_t) - 1)), 0, len(sigma_t) - 1).astype(int)
    assert not visible or np.any(np.asarray(sigma_t[cell[0] : cell[1] + 3]))


def test_gaussians_are_visible_as_far_as_they_do_not_underflow():
    transfer = jvr.GaussianTransfer([0.0, 5.0], [0.1, 0.2], [1.0, 0.0], np.ones((2, 3)))
    visible = jax.vmap(transfer.is_visible)
    low = np.array([-0.1, 1.3, 2.0, 4.9, -9.0])
    high = np.array([0.1, 1.5, 3.0, 5.1, -8.0])
    np.testing.assert_array_equal(visible(low, high), [True, True, False, False, False])


def scene_of(rng, shape, dtype, slope):
    """Blobs in a void, and a transfer function with gaps."""
    values = (rng.random(shape) ** 6 * 250).astype(dtype)
    values[tuple(slice(n // 3, None) for n in shape)] //= 9
    sigma_t = rng.choice([0.0, 0.0, 0.02, 0.4, 5.0], 12)
    domain = sorted(slope * np.array([0.0, 250.0]) + 7)
    return jvr.Volume(values, OBLIQUE, slope=slope, intercept=7.0), jvr.LutTransfer(rng.random((12, 3)), sigma_t, domain)


pictures = jax.jit(
    lambda scene, camera, skipping: jvr.render(scene, camera, jvr.Settings(0.6, skipping=skipping)), static_argnums=2
)


@given(st.integers(0, 2**31), st.sampled_from([1.0, -2.0]), st.sampled_from([np.uint8, float]))
@settings(max_examples=25, deadline=None)
def test_picture_is_the_same(seed, slope, dtype):
    """In double precision, because two programs round the position of a sample differently, which these voxels (250 from one to the
    next) and the steps of the transfer function magnify; a sample too many or too few would show all the same."""
    with jax.enable_x64(True):
        volume, transfer = scene_of(np.random.default_rng(seed), (17, 12, 21), dtype, slope)
        camera = perspective(volume, 24, 20)
        scene = jvr.Scene(volume, transfer, background=(0.1, 0.2, 0.3))
        on, off = (pictures(scene, camera, skipping) for skipping in (True, False))
        for name in ("rgb", "alpha", "depth"):
            np.testing.assert_allclose(getattr(on, name), getattr(off, name), rtol=1e-12, atol=1e-12)
        assert np.all(on.stats.steps <= off.stats.steps)
        bricked = eqx.tree_at(lambda s: s.volume, scene, volume.bricked())
        np.testing.assert_array_equal(pictures(bricked, camera, True).stats.steps, on.stats.steps)


@pytest.mark.slow
def test_pre_integrated_picture_is_the_same(x64):
    """A segment is left out only where no scalar between its ends is visible, also where the ends lie in two bricks."""
    program = jax.jit(jvr.render, static_argnums=2)
    for seed in range(6):
        volume, transfer = scene_of(np.random.default_rng(seed), (17, 12, 21), float, 1.0)
        scene, camera = jvr.Scene(volume, transfer, background=(0.1, 0.2, 0.3)), perspective(volume, 24, 20)
        on, off = (program(scene, camera, jvr.Settings(0.6, quadrature=jvr.PreIntegrated(), skipping=s)) for s in (True, False))
        np.testing.assert_allclose(on.rgb, off.rgb, rtol=1e-12, atol=1e-12)
        assert on.stats.steps.sum() <= off.stats.steps.sum()


def _gradient(wanted, rest, skipping):
    def loss(wanted):
        scene, camera = eqx.combine(wanted, rest)
        image = jvr.render(scene, camera, jvr.Settings(0.6, skipping=skipping, termination=1e-3))
        return jnp.sum(jnp.square(image.rgb - 0.5)) + jnp.sum(image.alpha * image.depth)

    return jax.grad(loss)(wanted)


@pytest.mark.parametrize("of", ["everything", pytest.param("voxels and camera", marks=pytest.mark.slow)])
def test_gradient_is_the_same(of, x64):
    """With the transfer function among the unknowns nothing is skipped on the way back; without, what is skipped has no gradient."""
    gradient = jax.jit(_gradient, static_argnums=2)
    for seed in range(4):
        volume, transfer = scene_of(np.random.default_rng(seed), (17, 12, 21), float, 1.0)
        both = (jvr.Scene(volume.bricked(), transfer, background=(0.1, 0.2, 0.3)), perspective(volume, 24, 20))
        floats = jax.tree.map(eqx.is_inexact_array, both)
        if of != "everything":
            floats = eqx.tree_at(lambda f: jax.tree.leaves(f[0].transfer), floats, replace_fn=lambda _: False)
        on, off = (gradient(*eqx.partition(both, floats), skipping) for skipping in (True, False))
        for a, b in zip(jax.tree.leaves(on), jax.tree.leaves(off), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11 * np.abs(b).max())
        if of == "everything":
            assert np.any(on[0].transfer.sigma_t[transfer.sigma_t == 0] != 0)


def faint_scene(rng):
    """Tenuous matter around dense blobs."""
    volume, transfer = scene_of(rng, (17, 12, 21), float, 1.0)
    sigma_t = np.where(np.arange(transfer.sigma_t.size) < 4, rng.choice([0.0, 1e-7, 1e-5], 12), 0.3)
    transfer = eqx.tree_at(lambda t: t.sigma_t, transfer, jnp.asarray(sigma_t))
    return jvr.Scene(volume.bricked(1), transfer, background=(0.1, 0.2, 0.3)), perspective(volume, 8, 6)


@pytest.mark.slow
@pytest.mark.parametrize("negligible", [1e-3, 1e-2])
def test_what_is_negligible_stays_below_its_bound(negligible, x64):
    """In every pixel, and in every entry of its derivative in the logarithms of the extinctions, by both ways to take it."""

    def pixels(sigma_t, scene, camera, settings):
        scene = eqx.tree_at(lambda s: s.transfer.sigma_t, scene, sigma_t)
        return jvr.render(scene, camera, settings).rgb

    squares = lambda *arguments: jnp.sum(jnp.square(pixels(*arguments)))
    jacobian, forward, reverse = (
        jax.jit(f, static_argnums=3) for f in (jax.jacfwd(pixels), jax.jacfwd(squares), jax.grad(squares))
    )
    saved = 0
    for seed in range(4):
        scene, camera = faint_scene(np.random.default_rng(seed))
        sigma_t = scene.transfer.sigma_t
        settings = [jvr.Settings(0.6, termination=0, negligible=n, adjoint=jvr.Forward()) for n in (0.0, negligible)]
        exact, kept = (jvr.render(scene, camera, s) for s in settings)
        assert np.abs(exact.rgb - kept.rgb).max() <= negligible
        saved += int(exact.stats.samples) - int(kept.stats.samples)
        of_exact, of_kept = (sigma_t * jacobian(sigma_t, scene, camera, s) for s in settings)
        assert np.abs(of_exact - of_kept).max() <= 2 * negligible
        backwards = reverse(sigma_t, scene, camera, jvr.Settings(0.6, termination=0, negligible=negligible))
        np.testing.assert_allclose(backwards, forward(sigma_t, scene, camera, settings[1]), rtol=1e-9, atol=1e-12)
    assert saved > 0


@pytest.mark.slow
def test_fit_leaves_out_what_is_negligible(x64):
    """Rows of the table leap as gradients do: both give the same normal equations, and the fit still finds its target."""
    scene, camera = faint_scene(np.random.default_rng(0))
    target = jvr.render(scene, camera).rgb
    start = eqx.tree_at(lambda s: s.transfer.rgb, scene, jnp.full_like(scene.transfer.rgb, 0.5))
    result = jvr.fit(start, [camera], [target], unknowns=lambda s: s.transfer.rgb, settings=jvr.Settings(negligible=1e-3))
    error = np.sqrt(np.mean(np.square(jvr.render(result.scene, camera).rgb - target)))
    assert 1e-9 < error <= 1e-3


def test_empty_space_is_not_sampled():
    """A ball in a large empty box: samples are taken near the ball only, and the picture is the same to 1e-6."""
    grid = np.stack(np.meshgrid(*[np.arange(65.0) - 32] * 3, indexing="ij"))
    ball = np.clip(9 - np.sqrt((grid**2).sum(0)), 0, 1).astype(np.float32)
    transfer = jvr.LinearTransfer([0.0, 0.2, 1.0], np.ones((3, 3)), [0.0, 0.0, 0.3])
    volume = jvr.Volume(ball)
    camera = jvr.PerspectiveCamera.look_at((150.0, 90.0, 60.0), volume.center, (0, 0, 1), 20.0, 32, 32)
    on, off = (pictures(jvr.Scene(volume, transfer), camera, skipping) for skipping in (True, False))
    assert on.stats.steps.sum() < 0.2 * off.stats.steps.sum()
    np.testing.assert_allclose(on.rgb, off.rgb, rtol=0, atol=1e-6)


@pytest.mark.parametrize("size", [0, -1, True])
def test_size_of_bricks_is_checked(size):
    with pytest.raises(ValueError, match="size of a brick must be a positive whole number"):
        jvr.Volume(np.zeros((4, 4, 4))).bricked(size)
