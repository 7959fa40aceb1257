"""What is computed once for a picture, before its rays."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jvr
from benchmarks import scenes
from benchmarks.timing import median, seconds
from jvr.effects.diffusion import scatter
from jvr.march.occupancy import occupancy_of
from jvr.model.bricks import bricks_of
from jvr.rendering.medium import visibility
from jvr.rendering.trace import near_volume


def preparation(n: int = 192) -> dict[str, Any]:
    """Seconds of each preparation of an `n^3` float32 volume, in a program that has all arrays as arguments: over all devices, over the
    first alone."""
    found = {}
    for name, (function, arguments) in _preparations(n).items():
        with jax.default_device(jax.devices()[0]):
            alone, own = jax.jit(function), jax.tree.map(lambda x: jax.device_put(np.asarray(x)), arguments)
            jax.block_until_ready(alone(*own))
        spread = jax.jit(function)

        def one(alone: Any = alone, own: Any = own) -> Any:
            with jax.default_device(jax.devices()[0]):
                return alone(*own)

        times = seconds({"all": lambda spread=spread, given=arguments: spread(*given), "one": one}, repeats=5)
        found[f"{name}_on_all_seconds"], found[f"{name}_on_one_seconds"] = median(times, "all"), median(times, "one")
    return found


def _preparations(n: int) -> dict[str, Any]:
    volume, light = scenes.gyroid(n), jvr.PointLight((3.0 * n, -2.0 * n, 2.0 * n), 1.0)
    scene = jvr.Scene(volume, scenes.translucent())
    bricks = volume.bricked().bricks
    assert bricks is not None
    normals = jvr.PrecomputedGradient()
    grid = np.random.default_rng(0).random((32, 32, 32, 3, 16)).astype(np.float32)
    dipole, there = jvr.Dipole([1.0, 1.0, 1.0], [0.1, 0.1, 0.1]), jnp.ones((32, 32, 32), bool)
    preparations: dict[str, Any] = {
        "bricks": (bricks_of, (volume.values,)),
        "occupancy": (lambda b, s: occupancy_of(b, volume.slope, volume.intercept, s.transfer), (bricks, scene)),
        "gradients": (lambda s: normals.with_gradients(s.volume, s.transfer), (scene,)),
        "diffusion": (lambda c, s: scatter(dipole, 0.2, s.volume, c, there), (grid, scene)),
    }
    for shadows in (jvr.ShadowMap(), jvr.ShadowVolume(), jvr.DeepShadowMap()):
        lit = jvr.Scene(volume, scenes.translucent(), lights=(light,), shading=jvr.Lambert(), shadows=shadows)
        preparations[type(shadows).__name__] = (lambda s: visibility(near_volume(s)[0], None), (lit,))
    return preparations
