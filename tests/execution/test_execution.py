"""Pictures and derivatives as one program, and their rays over devices."""

import logging
import os
import socket
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export
from scenes import gaussian_transfer, lut_transfer, perspective, render, small

import jvr
from jvr.execution import tiles
from jvr.march.differentiation import AbstractAdjoint

# They run in processes of their own.
SCRIPTS = Path(__file__).parents[1]


def scene_of(seed, dtype=np.uint8, shape=(9, 7, 8)):
    values = np.random.default_rng(seed).integers(0, 256, shape).astype(dtype)
    return jvr.Scene(jvr.Volume(values, slope=1 / 255), lut_transfer(), background=(0.2, 0.1, 0.3))


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height", "tile"), [(16, 13, 40), (5, 2, 1), (1, 1, 1)])
def test_tiles_make_the_picture_of_one_piece(width, height, tile):
    """Numbers of blocks that tiles do not divide, and tiles of less than a block."""
    scene, camera = scene_of(0), perspective(jvr.Volume(np.zeros((9, 7, 8))), width, height)
    ours, whole = jvr.render(scene, camera, jvr.Settings(0.7, tile=tile)), render(scene, camera, jvr.Settings(0.7))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6), ours, whole)


def test_arrays_that_a_traced_function_closes_over_are_part_of_it():
    scene = scene_of(0)
    camera = perspective(scene.volume, 8, 6)
    traced = jax.make_jaxpr(lambda x: x + jvr.render(scene, camera).rgb)(0.0)
    assert "while[" in str(traced)


@pytest.mark.parametrize(("height", "width"), [(13, 10), (4, 8), (1, 7), (3, 2), (1, 1)])
@pytest.mark.parametrize("shares", [1, 2, 5])
def test_blocks_hold_every_pixel_once(height, width, shares):
    order = tiles.pixels_of(tiles.dealt_blocks(height, width, shares), height, width)
    index = np.arange(height * width).reshape(height, width)
    assert order.size % shares == 0
    np.testing.assert_array_equal(tiles.picture_of(order, height, width, shares), index)
    # What is beside it, here another number for each ray, is dealt and joined alike.
    np.testing.assert_array_equal(tiles.picture_of(jnp.stack([order, -order], 1), height, width, shares)[..., 1], -index)


@pytest.mark.parametrize("shares", [1, 2, 3, 7])
def test_things_are_dealt_in_turn_and_joined(shares):
    order = tiles.dealt(5, shares)
    assert [int(x) for x in order[: -(-5 // shares)]] == [min(k, 4) for k in range(0, shares * -(-5 // shares), shares)]
    rows = jnp.repeat(order, 2)[:, None] * jnp.ones((1, 3))
    np.testing.assert_array_equal(tiles.joined(rows, 5, shares), np.repeat(np.arange(5), 2)[:, None] * np.ones((1, 3)))


def test_out_of_memory_halves_the_tile_with_one_warning():
    sizes = []

    def function(tile):
        sizes.append(tile)
        if tile > 20:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 bytes.")
        return jnp.float32(tile)

    with pytest.warns(RuntimeWarning, match="out of memory with 100 rays") as warned:
        found = tiles.within_memory(function, 100)
    assert found == 13
    assert sizes == [100, 50, 25, 13]
    assert len(warned) == 1


@pytest.mark.parametrize(("message", "warns"), [("RESOURCE_EXHAUSTED: Out of memory", 1), ("INTERNAL: else", 0)])
def test_what_does_not_fit_at_all_and_other_failures_are_raised(message, warns, recwarn):
    def function(_):
        raise jax.errors.JaxRuntimeError(message)

    with pytest.raises(jax.errors.JaxRuntimeError, match=message.split(":")[0]):
        tiles.within_memory(function, 8)
    assert len([w for w in recwarn if "out of memory" in str(w.message)]) == warns


@pytest.mark.slow
@pytest.mark.parametrize(("adjoint", "lit"), [(jvr.Replay(), False), (jvr.Replay(), True), (jvr.Rows(), False)])
def test_a_derivative_outside_of_jit_is_that_of_one_program(x64, adjoint, lit):
    """In everything that is an array of a picture that tiles do not divide, and compiled once."""
    scene = scene_of(1, np.float64)
    camera = perspective(scene.volume, 7, 5)
    if lit:
        lights = (jvr.PointLight((20.0, -5.0, 9.0), 300.0), jvr.AmbientLight(0.3))
        scene = jvr.Scene(scene.volume, scene.transfer, lights=lights, shading=jvr.BlinnPhong(), shadows=jvr.ShadowVolume())
    settings = jvr.Settings(0.7, adjoint=adjoint, tile=20)
    into = (lambda s: s.transfer.rgb) if isinstance(adjoint, jvr.Rows) else (lambda s: (s.transfer, s.volume.values))

    def loss(arrays):
        picture = jvr.render(eqx.tree_at(into, scene, arrays), camera, settings)
        return jnp.sum(jnp.sin(picture.rgb)) + jnp.sum(picture.alpha) + jnp.sum(picture.depth)

    of = jax.value_and_grad(loss)
    ours, whole = of(into(scene)), jax.jit(of)(into(scene))
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-11 * float(jnp.max(jnp.abs(b))))
    jax.tree.map(close, ours, whole)
    with jax.log_compiles(), compilations() as names:
        of(into(scene))
    assert names == []


@pytest.mark.slow
def test_one_compilation_while_only_arrays_change():
    camera = perspective(jvr.Volume(np.zeros((9, 7, 8))), 12, 9)
    jvr.render(scene_of(0), camera)
    with jax.log_compiles(), compilations() as names:
        for seed in range(1, 4):
            jvr.render(scene_of(seed), camera)
    assert names == []


def test_one_device_says_what_to_do():
    devices = next(part for part in jvr.plan(scene_of(0)).parts if part.name == "devices")
    assert not devices.included
    assert "one" in devices.reason


def test_cores_are_asked_for_too_late(monkeypatch):
    monkeypatch.setattr("jvr.execution.devices.cores", lambda: 7)
    with pytest.warns(RuntimeWarning, match=r"1 of 7 cores: call jvr.use_all_cores\(\) before"):
        jvr.use_all_cores()


@pytest.mark.slow
@pytest.mark.parametrize("which", ["not slow", "slow"])
def test_rays_over_three_devices(which):
    """The cases of `devices.py`, in a process whose processor is three devices."""
    cases = SCRIPTS / "devices.py"
    flags = ["-q", "-x", "-m", which, "-p", "no:cacheprovider", "-p", "no:xdist"]
    environment = os.environ | {"JVR_TEST_DEVICES": "3"}
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", str(cases), *flags], capture_output=True, text=True, env=environment, timeout=3600
    )
    assert ran.returncode == 0, ran.stdout[-4000:]


@pytest.mark.slow
def test_two_processes_make_what_one_does(tmp_path):
    """A picture, its gradient and a fit, over two devices of each."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    script, files = SCRIPTS / "processes.py", [tmp_path / f"{name}.npz" for name in ("alone", "first", "second")]
    arguments = [("1", "0"), ("2", "0"), ("2", "1")]
    started = [
        subprocess.Popen([sys.executable, script, *numbers, address, file], stderr=subprocess.PIPE, text=True)
        for numbers, file in zip(arguments, files, strict=True)
    ]
    try:
        for process in started:
            _, said = process.communicate(timeout=300)
            assert process.returncode == 0, said[-4000:]
    finally:
        for process in started:
            process.kill()
    alone, *others = [np.load(file) for file in files]
    for other in others:
        for name, expected in alone.items():
            # Sums over rays in another order; a fit goes on from what they are rounded to.
            relative = 1e-3 if name in ("fitted", "errors") else 1e-5
            np.testing.assert_allclose(other[name], expected, rtol=relative, atol=relative * np.abs(expected).max(), err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize(("patience", "seconds"), [(2, 30), (86_400, 90)])
def test_a_device_waits_for_another_one(patience, seconds):
    """The compiler's own choice ends the process 40 seconds after a warning, here the first second. That what is set from Python counts is
    seen where it is set to less. (Seconds are estimated, and may be fewer where other processes come to rest.)"""
    command = [sys.executable, SCRIPTS / "patience.py", str(patience), str(seconds)]
    environment = os.environ | {"XLA_FLAGS": "--xla_cpu_collective_call_warn_stuck_timeout_seconds=1"}
    ran = subprocess.run(command, capture_output=True, text=True, timeout=500, env=environment)
    if patience < seconds:
        assert ran.returncode < 0, ran.stdout
        assert "rendezvous" in ran.stderr.lower()
    else:
        assert ran.returncode == 0, ran.stderr[-2000:]
        assert float(ran.stdout) > 45, "no longer than the compiler's own choice"


@pytest.mark.slow
def test_functions_of_scenes_are_exported_to_another_process(tmp_path):
    jvr.use_export()
    scene, camera = small(), perspective(small().volume, 7, 5)
    loss = lambda transfer, scene: jnp.mean(jnp.sin(jvr.render(eqx.tree_at(lambda s: s.transfer, scene, transfer), camera).rgb))
    functions = {
        "picture": jax.jit(lambda scene: jvr.render(scene, camera)),
        "gradient": jax.jit(lambda scene: jax.grad(loss)(scene.transfer, scene)),
    }
    for name, function in functions.items():
        (tmp_path / name).write_bytes(export.export(function)(scene).serialize())
    command = [sys.executable, SCRIPTS / "exported.py", tmp_path]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr[-4000:]
    called, picture = np.load(tmp_path / "called.npz"), functions["picture"](scene)
    np.testing.assert_allclose(called["rgb"], picture.rgb, rtol=1e-6)
    np.testing.assert_allclose(called["depth"], picture.depth, rtol=1e-6)
    np.testing.assert_allclose(called["colours"], functions["gradient"](scene).rgb, rtol=1e-6)


def test_what_a_scene_may_hold_is_exported():
    """The structure of arguments, with every static field, is what it was."""
    jvr.use_export()
    values = np.arange(210, dtype=np.float32).reshape(5, 6, 7)
    volume = jvr.Volume(values, unit="HU", missing=209).packed().graded()
    lights = (jvr.DirectionalLight((0.0, 1.0, 0.0)), jvr.SpotLight((9.0, 9.0, 9.0), (-1.0, -1.0, -1.0), 30.0), jvr.AmbientLight())
    given = [
        jvr.Scene(volume, gaussian_transfer(), lights=lights, shading=jvr.BlinnPhong(), shadows=jvr.DeepShadowMap(8)),
        jvr.Scene(volume, gaussian_transfer(), lights=lights, scattering=jvr.SingleScattering(jvr.HenyeyGreenstein(0.3))),
        jvr.EnvironmentLight.constant(1.0),
        jvr.RadianceTransfer(2),
        perspective(volume, 4, 3),
        jvr.Settings(0.7, adjoint=jvr.Rows(), sampling=jvr.Slices(jvr.BrickRange())),
    ]
    written = export.export(jax.jit(lambda given: 0.0))(given).serialize()
    assert export.deserialize(written).in_tree == jax.tree.structure(((given,), {}))


class Odd(AbstractAdjoint):
    """With a static field that JSON does not know."""

    choice: object = eqx.field(static=True)

    def march(self, options, medium, rays, dt):
        raise NotImplementedError


def test_what_cannot_be_exported_says_so():
    jvr.use_export()
    with pytest.raises(TypeError, match=r"cannot keep a complex that is a static field of .*Odd"):
        export.export(jax.jit(lambda _: 0.0))(Odd(1j)).serialize()


class compilations:
    """What is compiled meanwhile."""

    def __enter__(self):
        self.names, self.handler = [], logging.Handler()
        self.handler.emit = lambda record: self.names.append(record.getMessage()) if "Compiling" in record.getMessage() else None
        logging.getLogger("jax").addHandler(self.handler)
        return self.names

    def __exit__(self, *_):
        logging.getLogger("jax").removeHandler(self.handler)
