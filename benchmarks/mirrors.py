"""What mirrors and glass cost: each order of them over the picture without them, and the derivative in the refractive index."""

import dataclasses
import statistics
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jvr
from benchmarks import scenes
from benchmarks.surfaces import SIZE, processor_seconds

VOXELS = 128
ORDERS = (1, 2)


def mirrors() -> dict[str, Any]:
    """A ball of 128^3 voxels at 256^2 that fills most of the picture, opaque and of glass, under an environment map, as processor time: the
    first hit without mirrors, each order of mirrored rays and of glass over that, and the gradient in the index over the picture."""
    grid = np.indices((VOXELS,) * 3).astype(np.float32) - (VOXELS - 1) / 2
    volume = jvr.Volume(-np.sum(np.square(grid), axis=0))
    camera, settings = scenes.camera(volume, SIZE), jvr.Settings(0.5)
    sky = jvr.EnvironmentMap.gradient((0.1, 0.1, 0.1), (0.9, 0.8, 0.7), (0.1, 0.2, 0.6))
    level, black = [-((0.4 * VOXELS) ** 2)], np.zeros((1, 3))
    opaque = jvr.Scene(volume, surfaces=jvr.Isosurfaces(level, black), background=sky)
    glass = dataclasses.replace(opaque, surfaces=jvr.Isosurfaces(level, black, [0.0], most=2))
    draw = jax.jit(lambda scene: jvr.render(scene, camera, settings).rgb)
    pictures = {"opaque": opaque, "clear": glass}
    for order in ORDERS:
        pictures[f"mirror_{order}"] = dataclasses.replace(opaque, specular=jvr.Specular(0.9, order=order))
        pictures[f"glass_{order}"] = dataclasses.replace(glass, specular=jvr.Specular(index=1.5, order=order))
    functions: dict[str, Any] = {name: lambda scene=scene: draw(scene) for name, scene in pictures.items()}
    last: Any = pictures["glass_2"]
    of_index = lambda index: jnp.mean(jvr.render(eqx.tree_at(lambda s: s.specular.index, last, index), camera, settings).rgb)
    gradient = jax.jit(jax.value_and_grad(of_index))
    functions["index"] = lambda: gradient(last.specular.index)
    times = processor_seconds(functions)
    over = lambda a, b: statistics.median(x / y for x, y in zip(times[a], times[b], strict=True))
    held: Any = gradient.lower(last.specular.index).compile().memory_analysis()
    return {
        **{f"{name}_seconds": statistics.median(found) for name, found in times.items()},
        **{f"mirror_{order}_over_opaque": over(f"mirror_{order}", "opaque") for order in ORDERS},
        **{f"glass_{order}_over_clear": over(f"glass_{order}", "clear") for order in ORDERS},
        "index_gradient_over_glass": over("index", "glass_2"),
        "index_gradient_megabytes": held.temp_size_in_bytes / 1e6,
    }
