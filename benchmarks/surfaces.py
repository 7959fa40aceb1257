"""What isosurfaces cost: the first hit against an opaque medium with the same surface, and its derivative against the first hit."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jvr
from benchmarks import scenes

SIZE, LEVEL, REPEATS = 256, 0.3, 9


def surfaces() -> dict[str, Any]:
    """First hit of a 128^3 isosurface at 256^2 over an opaque medium behind the same surface, unlit and lit, as processor time: a medium
    that is opaque within a few voxels, and one that is within a step; the derivative in the isovalue and in all voxels, over the first hit
    alone; an environment map behind the medium; samples a ray."""
    volume = scenes.gyroid()
    camera, settings = scenes.camera(volume, SIZE), jvr.Settings(0.5)
    wall = jvr.LinearTransfer([LEVEL - 0.01, LEVEL + 0.01], np.full((2, 3), 0.7), [0.0, 20.0])
    hit = jvr.Scene(volume, surfaces=jvr.Isosurfaces([LEVEL], np.full((1, 3), 0.7)))
    medium, thin = jvr.Scene(volume, scenes.opaque()), jvr.Scene(volume, wall)
    sky = jvr.Scene(volume, scenes.opaque(), background=jvr.EnvironmentMap(np.ones((128, 256, 3))))
    lit = {"lights": (jvr.DirectionalLight((-1.0, -0.6, -1.2)),), "shading": jvr.Lambert(0.2, 0.8)}
    draw = jax.jit(lambda scene: jvr.render(scene, camera, settings))
    functions: dict[str, Callable[[], Any]] = {
        name: lambda scene=scene: draw(scene) for name, scene in (("medium", medium), ("thin", thin), ("sky", sky), ("hit", hit))
    }
    for name, scene in {"medium": medium, "hit": hit}.items():
        lighted = jvr.Scene(volume, scene.transfer, surfaces=scene.surfaces, **lit)
        functions[f"lit_{name}"] = lambda lighted=lighted: draw(lighted)
    for name, into in {"isovalue": lambda s: s.surfaces.values, "voxels": lambda s: s.volume.values}.items():

        def loss(unknown: Any, into: Callable[[Any], Any] = into) -> jax.Array:
            return jnp.mean(jvr.render(eqx.tree_at(into, hit, unknown), camera, settings).depth)

        gradient = jax.jit(jax.value_and_grad(loss))
        functions[name] = lambda gradient=gradient, start=into(hit): gradient(start)
    times = processor_seconds(functions)
    over = lambda a, b: statistics.median(x / y for x, y in zip(times[a], times[b], strict=True))
    return {
        **{f"{name}_seconds": statistics.median(found) for name, found in times.items()},
        "hit_over_medium": over("hit", "medium"),
        "hit_over_thin_medium": over("hit", "thin"),
        "lit_hit_over_medium": over("lit_hit", "lit_medium"),
        "map_over_medium": over("sky", "medium"),
        "isovalue_gradient_adds": over("isovalue", "hit") - 1,
        "voxels_gradient_adds": over("voxels", "hit") - 1,
        "samples_a_ray": float(draw(hit).stats.samples) / SIZE**2,
        "samples_a_ray_medium": float(draw(medium).stats.samples) / SIZE**2,
        "samples_a_ray_thin_medium": float(draw(thin).stats.samples) / SIZE**2,
    }


def processor_seconds(functions: dict[str, Callable[[], Any]]) -> dict[str, list[float]]:
    """Processor seconds of each function, taken in turns: what others do on the machine meanwhile does not count."""
    for function in functions.values():
        jax.block_until_ready(function())
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(REPEATS):
        for name, function in functions.items():
            began = time.process_time()
            jax.block_until_ready(function())
            times[name].append(time.process_time() - began)
    return times
