"""Derivatives of what is not compiled itself run as compiled programs, which are kept as long as somebody may want them."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import linear_transfer, perspective, small, voxels

import jvr

MAPS = Path("/proc/self/maps")
compilations = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **_: compilations.append(event) if event == "/jax/core/compile/backend_compile_duration" else None
)


def scene(**parts):
    return jvr.Scene(jvr.Volume(voxels(), None), linear_transfer(), background=[0.1, 0.2, 0.3], **parts)


SUN = jvr.DirectionalLight([-0.4, 1.0, -0.5])
LIT = {"lights": (SUN,), "shading": jvr.Lambert()}
FORWARD, ROWS = jvr.Settings(adjoint=jvr.Forward()), jvr.Settings(adjoint=jvr.Rows())
CASES = {
    "plain": ({}, jvr.Settings()),
    "shadow rays": ({**LIT, "shadows": jvr.ShadowRays(2.0)}, jvr.Settings()),
    "shadow volume": ({**LIT, "shadows": jvr.ShadowVolume(1.0)}, jvr.Settings()),
    "scattering": ({"lights": (SUN,), "scattering": jvr.SingleScattering()}, jvr.Settings()),
    "refinement": ({}, jvr.Settings(sampling=jvr.Refinement(tile=2))),
    "forward": ({}, FORWARD),
    "forward, clipped": ({"clipping": jvr.ClippingBox([1.0, 1.0, 1.0], [3.0, 4.0, 5.0])}, FORWARD),
    "rows": ({}, ROWS),
}


def moving(base, camera, what):
    """What is differentiated, and the scene and the camera for a value of it."""
    if what == "voxels":
        return base.volume.values, lambda v: (dataclasses.replace(base, volume=jvr.Volume(v, None)), camera)
    if what == "camera":
        return camera.world_from_camera, lambda m: (base, dataclasses.replace(camera, world_from_camera=m))
    if what == "light":
        light = lambda d: dataclasses.replace(SUN, direction=d)
        return SUN.direction, lambda d: (dataclasses.replace(base, lights=(light(d),)), camera)
    return base.transfer, lambda t: (dataclasses.replace(base, transfer=t), camera)


@pytest.mark.slow
def test_another_step_compiles_nothing():
    """Of a picture that is not part of somebody's program; it is the one of that step."""
    base, camera = scene(), perspective(jvr.Volume(voxels(), None))
    jvr.render(base, camera, jvr.Settings(0.5))
    before = len(compilations)
    coarse = jvr.render(base, camera, jvr.Settings(2.0))
    assert len(compilations) == before
    fresh = jax.jit(lambda s, c: jvr.render(s, c, jvr.Settings(2.0)))(base, camera)
    np.testing.assert_allclose(coarse.rgb, fresh.rgb, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(coarse.stats.steps, fresh.stats.steps)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "what"),
    [
        ("shadow volume", "transfer"),
        ("forward, clipped", "camera"),
        ("plain", "transfer"),
        ("rows", "transfer"),
        ("shadow rays", "transfer"),
        ("shadow rays", "voxels"),
        ("shadow rays", "camera"),
        ("shadow volume", "light"),
        ("scattering", "light"),
        ("refinement", "transfer"),
        ("forward", "voxels"),
    ],
)
def test_derivatives_that_are_not_compiled_are_one_program(case, what):
    """Few programs are compiled for the first call, where every operation would be one by itself, and none for the second; the values are
    those of a derivative that is compiled as a whole."""
    parts, settings = CASES[case]
    base = scene(**parts)
    value, changed = moving(base, perspective(base.volume), what)
    along = jax.tree.map(jnp.ones_like, value)

    def loss(value):
        rgb = jvr.render(*changed(value), settings).rgb
        return jnp.vdot(rgb, jnp.arange(float(rgb.size)).reshape(rgb.shape) / rgb.size)

    def derivative(value):
        if isinstance(settings.adjoint, jvr.Forward):
            return jax.jvp(loss, (value,), (along,))[1]
        return jax.grad(loss)(value)

    other = jax.tree.map(lambda x: 1.001 * x, value)
    jax.clear_caches()
    compilations.clear()
    found = derivative(value)
    assert 0 < len(compilations) < 25
    compilations.clear()
    again = derivative(other)
    assert not compilations
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(again))
    expected = jax.jit(derivative)(value)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * np.abs(b).max())


def code():
    """Bytes of machine code that the process has made: memory that may be executed and comes from no file. Linux alone lists it. (Other
    memory comes and goes with threads, and with how much else the machine has to do.)"""
    lines = [line.split() for line in MAPS.read_text().splitlines()] if MAPS.exists() else []
    ends = [fields[0].split("-") for fields in lines if "x" in fields[1] and len(fields) == 5]
    return sum(int(last, 16) - int(first, 16) for first, last in ends)


@pytest.mark.slow
def test_fits_of_one_kind_share_their_programs_and_cleared_ones_are_gone():
    """With other numbers and another function that names the unknowns nothing is compiled."""
    jax.clear_caches()
    before = code()

    def fit(seed):
        truth = dataclasses.replace(scene(), transfer=linear_transfer(seed=seed))
        camera = perspective(truth.volume, 4, 3)
        image = np.full((3, 4, 3), 0.1 * seed, np.float32)
        jvr.fit(truth, [camera], [image], unknowns=lambda s: s.transfer.sigma_t, max_steps=1, progress=False)

    fit(1)
    held = code()
    compilations.clear()
    fit(2)
    assert not compilations
    if MAPS.exists():
        assert code() == held > before + 100_000
        jax.clear_caches()
        assert code() <= before


@pytest.mark.slow
def test_measurements_share_their_programs():
    """Whichever function names the unknowns."""
    base = scene()

    def measure():
        jvr.measure(base, perspective(base.volume, 7, 5), [jvr.Settings()], unknowns=lambda s: s.transfer.sigma_t, repeats=1)

    measure()
    compilations.clear()
    measure()
    assert not compilations


@pytest.mark.slow
def test_under_vmap_a_sample_on_a_voxel_reads_that_voxel():
    """The ray in the middle has samples in voxels: the index of a voxel and the weights that go with it come from one position, also where
    the compiler computes both in kernels of their own."""
    scene, camera = small(), perspective(small().volume, 9, 5)
    alpha = lambda rgb: jvr.render(eqx.tree_at(lambda s: s.transfer.rgb, scene, rgb), camera).alpha
    both = jnp.stack([scene.transfer.rgb, 0.5 * scene.transfer.rgb])
    one = jax.jit(alpha)(both[0])
    np.testing.assert_allclose(jax.jit(jax.vmap(alpha))(both), jnp.stack([one, one]), atol=2e-6)
