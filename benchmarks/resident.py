"""What a process holds in memory, to be run in one of its own."""

import resource
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jvr
from benchmarks import scenes


def peak(what: str, count: int, n: int) -> int:
    """Largest resident memory in bytes of this process, after three pictures of an `n^3` volume, or gradients in its voxels, on so many
    devices."""
    jax.config.update("jax_num_cpu_devices", count)
    volume = jvr.Volume(np.random.default_rng(0).random((n, n, n), np.float32))
    scene, camera = jvr.Scene(volume, scenes.translucent()), scenes.camera(volume, 64)
    draw = lambda values: jvr.render(eqx.tree_at(lambda s: s.volume.values, scene, values), camera).rgb
    function = draw if what == "picture" else jax.grad(lambda values: jnp.mean(jnp.square(draw(values))))
    for _ in range(3):
        jax.block_until_ready(function(volume.values))
    return _resident()


def fit_bytes_per_ray(count: int) -> float:
    """By how much the largest resident memory of this process grows in a fit of 16 views of 512^2 beyond that of one such view, for each
    ray, on so many devices. Samples along the rays are kept; the images take 12 bytes of it."""
    jax.config.update("jax_num_cpu_devices", count)
    volume = jvr.Volume(np.random.default_rng(0).random((16, 16, 16), np.float32))
    start = jvr.Scene(volume, jvr.flat_transfer(volume, 8))
    unknowns: Any = lambda s: (s.transfer.rgb, s.transfer.sigma_t)

    def fit(views: int) -> int:
        cameras = jvr.fibonacci_sphere(volume.center, 40.0, views, 30.0, 512, 512)
        images = [np.full((512, 512, 3), 0.3, np.float32) for _ in cameras]
        jvr.fit(start, cameras, images, unknowns=unknowns, max_steps=2, progress=False)
        return _resident()

    one = fit(1)
    return (fit(16) - one) / (15 * 512**2)


def _resident() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
