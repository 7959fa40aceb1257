"""Rays over three devices against one: cases that `test_execution.py` runs in a process of their own."""

import functools
import warnings
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import perspective, small

import jvr
from jvr.execution import devices

slow = pytest.mark.slow


plain = functools.cache(small)


def lit(shadows):
    lights = (jvr.PointLight((20.0, -5.0, 9.0), 300.0), jvr.AmbientLight(0.3))
    scene = plain()
    return jvr.Scene(scene.volume, scene.transfer, lights=lights, shading=jvr.BlinnPhong(), shadows=shadows)


def with_surfaces():
    surfaces = jvr.Isosurfaces([0.4, 0.6], np.full((2, 3), 0.8), [0.5, 0.6])
    return eqx.tree_at(lambda s: s.surfaces, lit(jvr.ShadowRays()), surfaces, is_leaf=lambda x: x is None)


SCENES = {
    "plain": (plain, jvr.Settings(0.7)),
    "tiles": (plain, jvr.Settings(0.7, tile=32)),
    "refinement": (plain, jvr.Settings(0.7, sampling=jvr.Refinement())),
    "shadow volume": (lambda: lit(jvr.ShadowVolume()), jvr.Settings(0.7)),
    "shadow rays": (lambda: lit(jvr.ShadowRays()), jvr.Settings(0.7)),
    "surfaces": (with_surfaces, jvr.Settings(0.7)),
    "deep map": (lambda: lit(jvr.DeepShadowMap(16)), jvr.Settings(0.7)),
}


def on_one_device(function, *arguments):
    """The same with all arrays on one device, over which nothing is spread."""
    with jax.default_device(jax.devices()[0]):
        moved = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)) if eqx.is_array(x) else x, arguments)
        return function(*moved)


def close(a, b, relative=1e-5):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=relative, atol=relative * float(np.max(np.abs(y)))), a, b)


def test_there_are_three():
    assert devices.shares() == 3
    assert jvr.plan(plain()).parts[-1].included
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert on_one_device(devices.shares) == 1


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("plain", (15, 13)),
        pytest.param("plain", (1, 1), marks=slow),
        # An even number of columns: the ray in the middle of an odd one has a sample in a voxel, where the gradient jumps, and rounding
        # decides on which side it is.
        *(pytest.param(name, (16, 13), marks=slow) for name in SCENES if name != "plain"),
    ],
)
def test_pictures(name, size):
    make, settings = SCENES[name]
    scene, camera = make(), perspective(plain().volume, *size)
    draw = lambda scene, camera: jvr.render(scene, camera, settings)
    close(draw(scene, camera), on_one_device(draw, scene, camera))


@pytest.mark.parametrize(
    ("name", "by"),
    [
        ("plain", "eager"),
        *(pytest.param(*case, marks=slow) for case in (("plain", "jit"), ("shadow volume", "eager"), ("shadow rays", "jit"))),
    ],
)
def test_gradients_in_everything(name, by):
    make, settings = SCENES[name]
    scene, camera = make(), perspective(plain().volume, 15, 13)
    arrays, rest = eqx.partition((scene, camera), eqx.is_inexact_array)
    gradient = jax.grad(lambda arrays: jnp.mean(jnp.sin(3 * jvr.render(*eqx.combine(arrays, rest), settings).rgb)))
    gradient = jax.jit(gradient) if by == "jit" else gradient
    close(gradient(arrays), on_one_device(gradient, arrays), 2e-4)


@slow
@pytest.mark.parametrize("adjoint", [jvr.Replay(), jvr.Forward(), jvr.Rows()])
def test_tangents(adjoint):
    scene, camera = plain(), perspective(plain().volume, 9, 5)
    of = lambda sigma: (
        jvr.render(eqx.tree_at(lambda s: s.transfer.sigma_t, scene, sigma), camera, jvr.Settings(adjoint=adjoint)).rgb
    )
    sigma = scene.transfer.sigma_t
    along = lambda sigma: jax.jvp(of, (sigma,), (jnp.ones_like(sigma),))
    close(along(sigma), on_one_device(along, sigma))


@slow
def test_vmap():
    scene, camera = plain(), perspective(plain().volume, 9, 5)
    of = lambda rgb: jvr.render(eqx.tree_at(lambda s: s.transfer.rgb, scene, rgb), camera).rgb
    both = jnp.stack([scene.transfer.rgb, 0.5 * scene.transfer.rgb])
    close(jax.vmap(of)(both), jnp.stack([of(rgb) for rgb in both]))


@slow
@pytest.mark.parametrize("keep", [True, False])
def test_fits(keep):
    scene, cameras = plain(), [perspective(plain().volume, 12, 9), perspective(plain().volume, 7, 10)]
    images = [np.asarray(jvr.render(scene, camera).rgb) for camera in cameras]
    start = eqx.tree_at(lambda s: s.transfer.rgb, scene, jnp.full_like(scene.transfer.rgb, 0.5))

    def run(start):
        colours = lambda s: s.transfer.rgb
        result = jvr.fit(start, cameras, images, unknowns=colours, keep_samples=keep, max_steps=6, progress=False)
        return result.scene.transfer.rgb, result.standard_errors, jnp.asarray(result.history[-1].psnr)

    found, alone = run(start), on_one_device(run, start)
    close(found[0], alone[0], 1e-3)
    assert found[2] > 60


@slow
def test_somebody_else_spreads():
    """Inside of a `shard_map` of the user's, over their own mesh, each picture stays on its device."""
    mesh, here = jax.sharding.Mesh(np.array(jax.devices()), ("pictures",)), jax.sharding.PartitionSpec("pictures")
    scene, camera = plain(), perspective(plain().volume, 9, 5)

    def pictures(rgb):
        one = lambda rgb: jvr.render(eqx.tree_at(lambda s: s.transfer.rgb, scene, rgb), camera).rgb
        return jax.vmap(one)(rgb)

    tables = jnp.stack([k * scene.transfer.rgb for k in (1.0, 0.5, 0.2)])
    spread = jax.shard_map(pictures, mesh=mesh, in_specs=here, out_specs=here, check_vma=False)
    close(spread(tables), pictures(tables))
    loss = lambda f: lambda tables: jnp.sum(jnp.sin(f(tables)))
    close(jax.grad(loss(spread))(tables), jax.grad(loss(pictures))(tables))


def test_voxels_are_shared_and_not_copied():
    volume = jvr.Volume(np.zeros((16, 16, 16), np.float32) + 0.5)
    places = {shard.data.unsafe_buffer_pointer() for shard in volume.values.addressable_shards}
    assert len(volume.values.sharding.device_set) == 3
    assert len(places) == 1


def test_a_volume_keeps_its_voxels_when_their_array_changes():
    values = np.full((16, 16, 16), 0.5, np.float32)
    volume = jvr.Volume(values)
    values[:] = 7
    np.testing.assert_array_equal(volume.values, 0.5)


def test_arrays_that_take_the_place_of_voxels_are_shared():
    """Also what is made of them, once: one copy of each."""
    volume = jvr.Volume(np.random.default_rng(0).random((9, 7, 8)).astype(np.float32))
    other = eqx.tree_at(lambda v: v.values, volume, 0.5 * volume.values.addressable_data(0))
    for made in (other.current(), other.bricked(), other.graded(), other.packed()):
        for array in jax.tree.leaves((made.values, made.bricks, made.gradients, made.squares)):
            assert len(array.sharding.device_set) == 3
            assert len({shard.data.unsafe_buffer_pointer() for shard in array.addressable_shards}) == 1
    kinds = [lambda v: v.bricked(), lambda v: v.graded(), lambda v: v.packed()]
    for kind in kinds:
        ours, alone = jax.tree.leaves(kind(other)), jax.tree.leaves(on_one_device(kind, other))
        close(ours, alone, 0)


def test_threads_that_render_at_once():
    """Four threads, pictures and gradients of scenes of their own, eagerly and within a `jit` of theirs."""
    scene, camera = plain(), perspective(plain().volume, 9, 5)
    with_colours = lambda rgb: eqx.tree_at(lambda s: s.transfer.rgb, scene, rgb)
    draw = lambda rgb: jvr.render(with_colours(rgb), camera).rgb
    slope = jax.grad(lambda rgb: jnp.mean(jnp.sin(draw(rgb))))
    functions = [draw, jax.jit(draw), slope, jax.jit(slope)]
    tables = [scene.transfer.rgb * k for k in np.linspace(0.1, 1.0, 10)]
    expected = [[np.asarray(function(rgb)) for rgb in tables] for function in functions]
    with ThreadPoolExecutor(4) as pool:
        found = [pool.submit(lambda f: [np.asarray(f(rgb)) for rgb in tables], function) for function in functions]
        for pictures, of in zip(found, expected, strict=True):
            close(pictures.result(timeout=120), of)


@slow
def test_a_fit_goes_on_with_another_number_of_devices(tmp_path):
    scene, camera = plain(), perspective(plain().volume, 12, 9)
    images = [np.asarray(jvr.render(scene, camera).rgb)]
    start = eqx.tree_at(lambda s: s.transfer.rgb, scene, jnp.full_like(scene.transfer.rgb, 0.5))

    def run(start, steps, resume):
        options = {"unknowns": lambda s: s.transfer.rgb, "progress": False, "checkpoint": tmp_path / "checkpoint.npz"}
        return len(jvr.fit(start, [camera], images, max_steps=steps, resume=resume, **options).history)

    assert on_one_device(run, start, 1, False) == 1
    assert run(start, 2, True) == 2
