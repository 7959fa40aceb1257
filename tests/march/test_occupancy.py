"""Empty-space skipping: bricks, skips, and that a picture and its gradients are the same with and without."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import OBLIQUE, marched_rays, perspective

import jvr
from jvr.march.jacobian import table_jacobian
from jvr.march.march import MarchOptions
from jvr.march.occupancy import RADII, occupancy_of
from jvr.model.bricks import bricks_of

SHAPES = [(9, 9, 9), (13, 6, 17), (1, 12, 10), (2, 3, 5), (1, 1, 1)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("size", [1, 3, 4, 10**9])
def test_bricks_bound_the_voxels_around_each_of_their_points(shape, size):
    values = np.random.default_rng(0).integers(-50, 50, shape, dtype=np.int16)
    bricks = bricks_of(jnp.asarray(values), size)
    assert bricks.lower.dtype == values.dtype
    for brick in np.ndindex(bricks.lower.shape):
        inside = values[tuple(slice(b * size, b * size + size + 1) for b in brick)]
        assert (bricks.lower[brick], bricks.upper[brick]) == (inside.min(), inside.max())
    assert bricks.lower.shape == tuple(max(1, -(-(n - 1) // size)) for n in shape)


@pytest.mark.slow
def test_the_empty_radius_is_the_largest_known_empty_cube():
    """Against the definition, by brute force."""
    rng = np.random.default_rng(1)
    values = np.where(rng.random((31, 26, 29)) < 2e-3, 1.0, 0.0)
    table = jvr.LinearTransfer([0.0, 0.5, 1.0], np.ones((3, 3)), [0.0, 0.0, 1.0])
    bricks = bricks_of(jnp.asarray(values), 1)
    empty_radius = np.asarray(occupancy_of(bricks, jnp.asarray(1.0), jnp.asarray(0.0), table).empty_radius)
    visible = np.argwhere(np.asarray(bricks.upper) > 0.5)
    cells = np.stack(np.meshgrid(*map(np.arange, empty_radius.shape), indexing="ij"), -1)
    nearest = np.abs(cells[..., None, :] - visible).max(-1).min(-1)
    radii = np.asarray(RADII)
    largest = radii[np.searchsorted(radii, nearest - 1, side="right") - 1] + 1
    np.testing.assert_array_equal(empty_radius, np.where(nearest == 0, 0, largest))


TABLES = st.integers(2, 9).flatmap(lambda n: st.lists(st.sampled_from([0.0, 0.0, 1e-30, 0.05, 3.0]), min_size=n, max_size=n))


@pytest.mark.slow
@given(st.data())
@settings(max_examples=100, deadline=None)
def test_a_range_is_visible_where_something_in_it_is(data):
    """Against NumPy: a range called invisible has no extinction, one called visible has some in it or within a rounding of it."""
    sigma_t = data.draw(TABLES)
    low, high = sorted(data.draw(st.tuples(*[st.floats(-0.5, 1.5, width=32) | st.sampled_from([0.0, 0.25, 0.5, 1.0])] * 2)))
    positions = np.linspace(0, 1, len(sigma_t))
    table = data.draw(
        st.sampled_from(
            [
                jvr.LutTransfer(np.ones((len(sigma_t), 3)), sigma_t, (0.0, 1.0)),
                jvr.LinearTransfer(positions, np.ones((len(sigma_t), 3)), sigma_t),
                jvr.GradientTransfer(np.ones((len(sigma_t), 2, 3)), np.outer(sigma_t, [0.0, 1.0]), (0.0, 1.0), (0.0, 1.0)),
            ]
        )
    )

    def has_extinction(low, high):
        inside = positions[(positions >= low) & (positions <= high)]
        return np.interp([low, high, *inside], positions, sigma_t).any()

    # In single precision, an end this close to an entry but not at it may be either side of it.
    close = 1e-6
    away = np.abs(positions[:, None] - [low, high])
    unsure = np.any((away > 0) & (away < close))
    at_all, nearby = (bool(table.is_visible(jnp.float32(low), jnp.float32(high), nearby=n)) for n in (False, True))
    assert at_all or unsure or not has_extinction(low, high)
    assert not at_all or has_extinction(low - close, high + close)
    # At an entry the neighbouring interval is nearby, so that a derivative that is not zero is never left out.
    assert nearby or unsure or not has_extinction(low - close, high + close)
    assert not nearby or has_extinction(low - close, high + close)


@pytest.mark.parametrize("of", ["first", "last"])
def test_beyond_its_ends_a_table_shows_its_ends_alone(of):
    """A table that begins (or ends) with no extinction: what lies in front of it is empty, and has no derivative either."""
    order = 1 if of == "first" else -1
    sigma_t, outside = np.array([0.0, 0.4, 0.9])[::order], jnp.float32(0.1 if of == "first" else 0.9)
    at_end = jnp.float32(0.25 if of == "first" else 0.75)
    positions, rgb = np.array([0.25, 0.5, 0.75]), np.ones((3, 3))
    tables = [
        jvr.LinearTransfer(positions, rgb, sigma_t),
        jvr.LutTransfer(rgb, sigma_t, (0.25, 0.75)),
        jvr.GradientTransfer(np.ones((3, 2, 3)), np.outer(sigma_t, [1.0, 1.0]), (0.25, 0.75), (0.0, 1.0)),
        jvr.GradientOpacity(jvr.LinearTransfer(positions, rgb, sigma_t), 0.0, 1.0),
    ]
    for table in tables:
        assert not table.is_visible(outside, outside)
        assert not table.is_visible(outside, outside, nearby=True)
        assert not table.is_visible(at_end, at_end)
        assert table.is_visible(at_end, at_end, nearby=True)
        assert table.is_visible(jnp.minimum(outside, 0.3), jnp.maximum(outside, 0.7))


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
    # Half of the tables cover a part of the values alone.
    domain = sorted(slope * np.array(rng.choice([[0.0, 250.0], [30.0, 170.0]])) + 7)
    return jvr.Volume(values, OBLIQUE, slope=slope, intercept=7.0), jvr.LutTransfer(rng.random((12, 3)), sigma_t, domain)


pictures = jax.jit(
    lambda scene, camera, skipping: jvr.render(scene, camera, jvr.Settings(0.6, skipping=skipping)), static_argnums=2
)


@pytest.mark.slow
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


@pytest.mark.slow
def test_gradient_where_matter_begins_is_the_same(x64):
    """Voxels at the very value where extinction begins to rise: they are empty, and the derivative in them is not zero. (A fit of voxels
    that starts from an empty volume lives on it.) Light that no picture needs is looked up there, too."""
    values = np.zeros((9, 9, 9))
    values[4:7, 4:7, 4:7] = 0.7
    transfer = jvr.LinearTransfer([-1.0, 0.0, 1.0], np.full((3, 3), 0.8), [0.0, 0.0, 0.5])
    volume = jvr.Volume(values)
    scene = jvr.Scene(
        volume,
        transfer,
        lights=[jvr.DirectionalLight((0.3, -0.5, -0.8), 2.0)],
        scattering=jvr.SingleScattering(albedo=0.8),
        shadows=jvr.ShadowRays(2.0),
    )
    camera = perspective(volume, 5, 4)

    def loss(values, skipping):
        changed = eqx.tree_at(lambda s: s.volume.values, scene, values)
        return jnp.sum(jvr.render(changed, camera, jvr.Settings(1.0, skipping=skipping)).rgb)

    on, off = (jax.jit(jax.grad(loss), static_argnums=1)(jnp.asarray(values), skipping) for skipping in (True, False))
    np.testing.assert_allclose(on, off, rtol=1e-9, atol=1e-12 * np.abs(off).max())
    assert np.sum(on[:3] != 0) > 20


@pytest.mark.slow
def test_the_jacobian_is_the_same(x64):
    """Those of extinctions skip nothing; those of colours, alone, what is empty."""
    volume, transfer = scene_of(np.random.default_rng(2), (9, 8, 11), float, 1.0)
    scene, camera = jvr.Scene(volume.bricked(2), transfer), perspective(volume, 6, 5)

    both = ("sigma_t",)

    def rows(skipping, of):
        choices = jvr.Settings(0.6, skipping=skipping)
        return table_jacobian(MarchOptions(0.0, False), *marched_rays(scene, camera, choices), of=of)[1]

    exact, everything, colours = (jax.jit(lambda o=o: rows(*o))() for o in ((False, both), (True, both), (True, ())))
    compare = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
    jax.tree.map(compare, everything, exact)
    jax.tree.map(compare, colours.radiance_rgb, exact.radiance_rgb)
    assert np.any(np.stack(exact.radiance_sigma)[..., transfer.sigma_t == 0] != 0)
    assert colours.radiance_sigma == colours.tau_sigma == ()


@pytest.mark.slow
def test_forward_derivative_of_a_shadow_takes_empty_space_as_well(x64):
    """A medium of no extinction casts a shadow as soon as it has some; against float64 differences."""
    values = np.linspace(0, 1, 6)[:, None, None] * np.ones((6, 6, 6))
    volume, camera = jvr.Volume(values).bricked(1), perspective(jvr.Volume(values), 4, 4, direction=(0.0, -1.0, 0.2))
    scene = jvr.Scene(
        volume,
        jvr.LinearTransfer([0.0, 0.5, 1.0], np.full((3, 3), 0.8), [0.0, 0.0, 0.9]),
        lights=[jvr.DirectionalLight((1.0, 0.0, 0.0), 2.0)],
        scattering=jvr.SingleScattering(albedo=0.8),
        shadows=jvr.ShadowRays(0.5, termination=0),
    )

    def total(first, adjoint=jvr.Forward()):
        changed = eqx.tree_at(lambda s: s.transfer.sigma_t, scene, scene.transfer.sigma_t.at[0].set(first))
        return jnp.sum(jvr.render(changed, camera, jvr.Settings(0.5, termination=0, adjoint=adjoint)).rgb)

    step = 1e-4
    at = jax.jit(total)
    differences = (4 * at(step) - at(2 * step) - 3 * at(0.0)) / (2 * step)
    for adjoint in (jvr.Forward(), jvr.Replay()):
        of = functools.partial(total, adjoint=adjoint)
        slope = jax.jit(lambda first, of=of: jax.jvp(of, (first,), (1.0,))[1])(0.0)
        np.testing.assert_allclose(slope, differences, rtol=1e-5)


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
    """Rows of the table skip as gradients do: both give the same normal equations, and the fit still finds its target."""
    scene, camera = faint_scene(np.random.default_rng(0))
    target = jvr.render(scene, camera).rgb
    start = eqx.tree_at(lambda s: s.transfer.rgb, scene, jnp.full_like(scene.transfer.rgb, 0.5))
    result = jvr.fit(start, [camera], [target], unknowns=lambda s: s.transfer.rgb, settings=jvr.Settings(negligible=1e-3))
    error = np.sqrt(np.mean(np.square(jvr.render(result.scene, camera).rgb - target)))
    assert 1e-9 < error <= 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    "transfer",
    [
        jvr.LinearTransfer([0.0, 0.2, 1.0], np.ones((3, 3)), [0.0, 0.0, 0.3]),
        pytest.param(jvr.presets.window_level(0.8, 0.6, sigma_t=0.3), id="window"),
    ],
)
def test_empty_space_is_not_sampled(transfer):
    """A ball in a large empty box: samples are taken near the ball only, and the picture is the same to 4e-6: two programs round
    positions, which are up to 180 away from the eye, each in its own way."""
    grid = np.stack(np.meshgrid(*[np.arange(65.0) - 32] * 3, indexing="ij"))
    ball = np.clip(9 - np.sqrt((grid**2).sum(0)), 0, 1).astype(np.float32)
    volume = jvr.Volume(ball)
    camera = jvr.PerspectiveCamera.look_at((150.0, 90.0, 60.0), volume.center, (0, 0, 1), 20.0, 32, 32)
    on, off = (pictures(jvr.Scene(volume, transfer), camera, skipping) for skipping in (True, False))
    assert on.stats.steps.sum() < 0.2 * off.stats.steps.sum()
    np.testing.assert_allclose(on.rgb, off.rgb, rtol=0, atol=4e-6)


@pytest.mark.parametrize("size", [0, -1, True])
def test_size_of_bricks_is_checked(size):
    with pytest.raises(ValueError, match="size of a brick must be a positive whole number"):
        jvr.Volume(np.zeros((4, 4, 4))).bricked(size)
