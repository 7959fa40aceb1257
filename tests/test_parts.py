"""Pictures of arrays at hand, in parts; volumes packed for interpolation."""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import compiled, lut_transfer, orthographic, perspective, render, voxels

import jvr
from jvr import parallel
from jvr.rendering import parts, reverse


@pytest.fixture
def small_parts(monkeypatch):
    monkeypatch.setattr(parts, "LEAST", 50)
    monkeypatch.setattr(parts, "workers", lambda: 3)
    monkeypatch.setattr(parallel, "workers", lambda: 3)


def scene_of(seed, dtype=np.uint8, shape=(9, 7, 8), **options):
    values = np.random.default_rng(seed).integers(0, 256, shape).astype(dtype)
    volume = jvr.Volume(values, slope=1 / 255, **options)
    return jvr.Scene(volume, lut_transfer(), background=(0.2, 0.1, 0.3))


@pytest.mark.parametrize(("width", "height", "tile"), [(16, 13, 10**6), (16, 13, 40), (5, 2, 1), (1, 1, 1)])
def test_parts_make_the_picture_of_one_program(small_parts, width, height, tile):
    """Numbers of rows that parts do not divide, parts of one row, and more workers than rows."""
    scene, camera = scene_of(0), perspective(jvr.Volume(np.zeros((9, 7, 8))), width, height)
    ours, whole = jvr.render(scene, camera, jvr.Settings(0.7, tile=tile)), render(scene, camera, jvr.Settings(0.7))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6), ours, whole)


def test_double_precision_reaches_the_threads(small_parts, x64):
    scene = scene_of(0)
    picture = jvr.render(scene, perspective(scene.volume, 16, 13), jvr.Settings(0.7))
    assert picture.rgb.dtype == jnp.float64


def test_threads_within_threads_do_not_wait_for_each_other(small_parts):
    """As many at each level as there are threads: none is left for what they wait for."""
    table = parallel.in_threads(lambda i: parallel.in_threads(lambda j: (i, j), range(4)), range(4))
    assert table == [[(i, j) for j in range(4)] for i in range(4)]


def test_nothing_goes_on_after_an_error(small_parts):
    begun, ended = [], []

    def one(i):
        begun.append(i)
        if i == 0:
            raise ValueError("the first")
        time.sleep(0.05)
        ended.append(i)

    with pytest.raises(ValueError, match="the first"):
        parallel.in_threads(one, range(50))
    assert len(begun) == len(ended) + 1 < 50


def test_arrays_that_a_traced_function_closes_over_are_part_of_it():
    scene = scene_of(0)
    camera = perspective(scene.volume, 8, 6)
    traced = jax.make_jaxpr(lambda x: x + jvr.render(scene, camera).rgb)(0.0)
    assert "while[" in str(traced)


@pytest.mark.parametrize(("height", "width"), [(13, 10), (4, 8), (1, 7), (3, 2), (1, 1)])
def test_blocks_hold_every_pixel_once(height, width):
    order = parts.pixels_of(parts.all_blocks(height, width), height, width)
    index = jnp.arange(height * width).reshape(height, width)
    np.testing.assert_array_equal(parts.picture_of(order, height, width), index)
    # What lies beyond the border is no pixel: each number comes back once.
    np.testing.assert_array_equal(jnp.zeros(height * width).at[order].add(parts.rays_of(jnp.ones_like(index), height, width)), 1)


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_a_picture_is_dealt_out_and_joined(count):
    picture = jnp.arange(13 * 10 * 2.0).reshape(13, 10, 2)
    pieces = parts.dealt(13, 10, count, picture)
    assert len({piece.shape for piece in pieces}) == 1
    np.testing.assert_array_equal(parts.joined(13, 10, pieces), picture)


def test_out_of_memory_halves_the_parts_with_one_warning(small_parts):
    sizes = []

    def function(blocks):
        pixels = parts.pixels_of(blocks, 13, 10)
        sizes.append(pixels.size)
        if pixels.size > 20:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 bytes.")
        return 2 * pixels

    with pytest.warns(RuntimeWarning, match="out of memory") as warned:
        found = parts.joined(13, 10, parts.in_parts(function, 13, 10, 10**6))
    np.testing.assert_array_equal(found, 2 * np.arange(130).reshape(13, 10))
    assert len(warned) == 1
    assert max(sizes) == 64
    assert sizes[-1] == 16


@pytest.mark.parametrize("what", ["everything", *(pytest.param(x, marks=pytest.mark.slow) for x in ("rgb", "alpha", "depth"))])
def test_a_derivative_in_parts_is_that_of_one_program(small_parts, x64, what):
    """Of pictures that parts do not divide, in everything that is an array."""
    scene = scene_of(1, np.float64)
    camera = perspective(scene.volume, 15, 13)
    weight = jnp.asarray(np.random.default_rng(2).normal(size=(13, 15, 5)))

    def loss(arrays, rest):
        picture = jvr.render(*eqx.combine(arrays, rest), jvr.Settings(0.7))
        shown = {"rgb": picture.rgb, "alpha": picture.alpha[..., None], "depth": picture.depth[..., None]}
        seen = jnp.concatenate(list(shown.values()), axis=-1) if what == "everything" else shown[what]
        return jnp.sum(weight[..., : seen.shape[-1]] * jnp.sin(seen)), picture.rgb

    arrays, rest = eqx.partition((scene, camera), eqx.is_inexact_array)
    of = jax.value_and_grad(loss, has_aux=True)
    ours, whole = of(arrays, rest), compiled(of)(arrays, rest)
    # Each gradient is a sum over rays in another order.
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-11 * float(jnp.max(jnp.abs(b))))
    jax.tree.map(close, ours, whole)


def kinds_of_scenes():
    """Scenes whose derivatives take different ways, and the settings they are rendered with."""
    plain = scene_of(1, np.float64)
    lit = jvr.Scene(
        plain.volume,
        lut_transfer(),
        lights=(jvr.PointLight((20.0, -5.0, 9.0), 300.0), jvr.AmbientLight(0.3)),
        shading=jvr.BlinnPhong(),
        scattering=jvr.SingleScattering(jvr.HenyeyGreenstein(0.4), 0.7),
        clipping=jvr.ClippingBox((1.0, 0.5, 0.5), (7.5, 6.0, 6.5)),
    )
    rng = np.random.default_rng(4)
    graded = jvr.GradientTransfer(rng.random((4, 3, 3)), rng.random((4, 3)), (0.0, 1.0), (0.0, 0.4))
    return {
        "lit": (lit, jvr.Settings(0.7)),
        "by gradient": (eqx.tree_at(lambda s: s.transfer, plain, graded), jvr.Settings(0.7)),
        "pre-integrated, in tiles": (plain, jvr.Settings(0.7, quadrature=jvr.PreIntegrated(), tile=40)),
        "negligible": (plain, jvr.Settings(0.7, negligible=1e-3)),
    }


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lit", "by gradient", "pre-integrated, in tiles", "negligible"])
def test_every_kind_of_scene_has_its_derivative_in_parts(small_parts, x64, kind):
    scene, settings = kinds_of_scenes()[kind]
    # (Rays of no symmetry: a sample on the face of a voxel has one gradient or the other, by a rounding.)
    arrays, rest = eqx.partition((scene, orthographic(scene.volume, 9, 3, (1.0, -0.63, 0.47))), eqx.is_inexact_array)
    of = jax.grad(lambda arrays: jnp.sum(jnp.sin(jvr.render(*eqx.combine(arrays, rest), settings).rgb)))
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10 * float(jnp.max(jnp.abs(b))))
    jax.tree.map(close, of(arrays), compiled(of)(arrays))


@pytest.mark.slow
def test_numbers_of_python_have_derivatives_in_parts():
    scene = scene_of(1)
    camera = perspective(scene.volume, 8, 6)
    of_angle = jax.grad(lambda f: jnp.sum(jvr.render(scene, eqx.tree_at(lambda c: c.fov_y, camera, f)).rgb))
    assert of_angle(38.0) == of_angle(jnp.float32(38.0))
    assert of_angle(38.0) != 0


@pytest.mark.parametrize("size", [(300, 300), (255, 511), (128, 128)])
def test_there_is_one_part_for_each_core(monkeypatch, size):
    monkeypatch.setattr(parts, "workers", lambda: 3)
    assert len(parts.in_parts(lambda blocks: blocks, *size, 10**6)) == 3


@pytest.mark.slow
def test_vmap_keeps_to_its_tiles(small_parts, monkeypatch):
    sizes, camera = [], perspective(jvr.Volume(np.zeros((9, 7, 8))), 16, 12)
    monkeypatch.setattr(reverse, "pixels_of", lambda *a: sizes.append(parts.pixels_of(*a).size) or parts.pixels_of(*a))
    scene = scene_of(5)
    picture = lambda k: jvr.render(eqx.tree_at(lambda s: s.volume.slope, scene, k), camera, jvr.Settings(0.7, tile=32)).rgb
    both = jax.vmap(picture)(jnp.array([1 / 255, 1 / 200]))
    assert set(sizes) == {32}
    np.testing.assert_allclose(both[1], picture(jnp.float32(1 / 200)), rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_derivatives_in_parts_under_vmap_and_over_again(small_parts):
    """Of several scenes at a time, and of several weighted sums of one picture at a time."""
    scene = scene_of(1)
    camera = perspective(scene.volume, 8, 5)

    def picture(sigma_t):
        changed = eqx.tree_at(lambda s: s.transfer.sigma_t, scene, sigma_t)
        return jvr.render(changed, camera, jvr.Settings(0.7)).rgb

    loss, sigma_t = lambda sigma_t: jnp.sum(picture(sigma_t) ** 2), scene.transfer.sigma_t
    both = jnp.stack([sigma_t, 2 * sigma_t])
    apart = jnp.stack([jax.grad(loss)(x) for x in both])
    np.testing.assert_allclose(jax.vmap(jax.grad(loss))(both), apart, rtol=1e-4, atol=1e-6)
    jacobian = jax.jacrev(lambda x: picture(x)[2, 3])(sigma_t)
    np.testing.assert_allclose(jacobian, compiled(jax.jacrev(lambda x: picture(x)[2, 3]))(sigma_t), rtol=1e-4, atol=1e-7)


def test_what_does_not_fit_at_all_and_other_failures_are_raised(small_parts):
    def fails(message):
        def function(_):
            raise jax.errors.JaxRuntimeError(message)

        return function

    with pytest.warns(RuntimeWarning), pytest.raises(jax.errors.JaxRuntimeError, match="RESOURCE_EXHAUSTED"):
        parts.in_parts(fails("RESOURCE_EXHAUSTED: Out of memory"), 13, 10, 10**6)
    with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"):
        parts.in_parts(fails("INTERNAL: else"), 13, 10, 10**6)


def test_one_compilation_while_only_arrays_change():
    camera = perspective(jvr.Volume(np.zeros((9, 7, 8))), 12, 9)
    jvr.render(scene_of(0), camera)
    with jax.log_compiles(), _compilations() as names:
        for seed in range(1, 4):
            jvr.render(scene_of(seed), camera)
    assert names == []


class _compilations:
    """Names of what is compiled meanwhile."""

    def __enter__(self):
        import logging

        self.names, self.handler = [], logging.Handler()
        self.handler.emit = lambda record: self.names.append(record.getMessage()) if "Compiling" in record.getMessage() else None
        logging.getLogger("jax").addHandler(self.handler)
        return self.names

    def __exit__(self, *_):
        import logging

        logging.getLogger("jax").removeHandler(self.handler)


SHAPES = st.tuples(*[st.integers(1, 9)] * 3)
values_at = jax.jit(lambda volume, points: jax.vmap(volume.sample)(points))


@pytest.mark.slow
@given(st.integers(0, 2**31), SHAPES)
@settings(max_examples=20, deadline=None)
def test_packed_voxels_are_the_voxels(seed, shape):
    rng = np.random.default_rng(seed)
    volume = jvr.Volume(rng.integers(0, 256, shape).astype(np.uint8), slope=2.0, intercept=-3.0)
    points = tuple(jnp.asarray(rng.uniform(0, max(n - 1, 0.001), 50), jnp.float32) for n in shape)
    np.testing.assert_allclose(values_at(volume.packed(), points), values_at(volume, points), rtol=1e-5, atol=1e-3)
    corners = tuple(jnp.full(1, n - 1.0) for n in shape)
    assert values_at(volume.packed(), corners)[0] == 2.0 * float(volume.values[-1, -1, -1]) - 3.0


@pytest.mark.parametrize("dtype", [np.int16, np.float32, np.int8])
def test_other_voxels_are_rounded_to_256_levels(dtype):
    values = voxels((9, 7, 8)) * 100
    volume = jvr.Volume(values.astype(dtype), slope=-2.0, intercept=5.0)
    packed = volume.packed()
    exact, rounded = (np.asarray(v.slope * v.values + v.intercept, float) for v in (volume, packed))
    spread = exact.max() - exact.min()
    assert packed.values.dtype == np.uint8
    assert 0 < np.abs(exact - rounded).max() <= spread / 510 * 1.001
    np.testing.assert_allclose([rounded.min(), rounded.max()], [exact.min(), exact.max()], rtol=1e-6)


def test_packed_pictures_and_gradients_are_the_same():
    scene = scene_of(3)
    packed = eqx.tree_at(lambda s: s.volume, scene, scene.volume.packed())
    camera = perspective(scene.volume, 12, 9)

    def loss(sigma_t, slope, scene):
        scene = eqx.tree_at(lambda s: (s.transfer.sigma_t, s.volume.slope), scene, (sigma_t, slope))
        return jnp.mean(jvr.render(scene, camera, jvr.Settings(0.7)).rgb ** 2)

    of = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))
    both = [of(s.transfer.sigma_t, s.volume.slope, s) for s in (scene, packed)]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-4, atol=1e-6), *both)


def test_constant_voxels_can_be_packed():
    packed = jvr.Volume(np.full((3, 3, 3), 7.5)).packed()
    assert float(packed.sample(tuple(jnp.array([1.5, 0.5, 1.0])))) == 7.5


def test_nearest_voxels_are_not_packed():
    with pytest.raises(ValueError, match="trilinear"):
        jvr.Volume(np.zeros((3, 3, 3)), interpolation=jvr.Nearest()).packed()
