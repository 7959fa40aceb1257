"""Volumes packed for interpolation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import lut_transfer, perspective, voxels

import jvr


def scene_of(seed, dtype=np.uint8, shape=(9, 7, 8), **options):
    values = np.random.default_rng(seed).integers(0, 256, shape).astype(dtype)
    volume = jvr.Volume(values, slope=1 / 255, **options)
    return jvr.Scene(volume, lut_transfer(), background=(0.2, 0.1, 0.3))


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


@pytest.mark.slow
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
