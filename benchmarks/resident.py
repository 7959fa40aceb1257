"""What a process holds in memory, to be run in one of its own."""

import resource

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
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
