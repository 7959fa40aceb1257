"""What ambient occlusion costs: beforehand, in each picture once it is kept, and of histograms with another transfer function."""

import dataclasses
import statistics
import time
from typing import Any

import jax
import numpy as np

import jvr
from benchmarks import scenes
from benchmarks.surfaces import LEVEL, SIZE, processor_seconds
from jvr.rendering.medium import absorbing

RESOLUTION, RAYS, PROJECTIONS = 0.5, 32, 3


def occlusion() -> dict[str, Any]:
    """Occlusion of 128^3 voxels with 32 rays from every second along each axis: seconds of the projection, of a clock and of processors;
    pictures of 256^2 under two lights, with what is kept over those without, as processor time; isosurfaces with rays from each hit over
    those without; a new transfer function of histograms that are kept."""
    volume = scenes.gyroid()
    camera, settings = scenes.camera(volume, SIZE), jvr.Settings(0.5)
    lights = (jvr.AmbientLight(0.5), jvr.DirectionalLight((-1.0, -0.6, -1.2)))
    plain = jvr.Scene(volume, scenes.opaque(), lights=lights, shading=jvr.Lambert())
    surface = jvr.Isosurfaces([LEVEL], np.full((1, 3), 0.7))
    hit = jvr.Scene(volume, surfaces=surface, lights=lights, shading=jvr.Lambert())
    numbers = {"rays": RAYS, "resolution": RESOLUTION}
    methods = {"local": jvr.LocalOcclusion(**numbers), "histogram": jvr.HistogramOcclusion(**numbers)}
    found: dict[str, Any] = {}
    kept = {}
    for name, method in methods.items():
        scene = dataclasses.replace(plain, occlusion=method)
        clock, processor = _projection_seconds(scene)
        found |= {f"{name}_projection_seconds": clock, f"{name}_projection_processor_seconds": processor}
        kept[name] = jvr.precompute(scene)
    draw = jax.jit(lambda scene: jvr.render(scene, camera, settings))
    look = jax.jit(lambda scene: scene.occlusion.visibility(scene, lambda graded: absorbing(scene, None, graded)))
    shaded = dataclasses.replace(hit, occlusion=jvr.SurfaceOcclusion(RAYS))
    drawn = {"plain": plain, "local": kept["local"], "hit": hit, "surface": shaded}
    functions: dict[str, Any] = {name: lambda scene=scene: draw(scene) for name, scene in drawn.items()}
    functions["transfer"] = lambda: look(kept["histogram"])
    times = processor_seconds(functions)
    over = lambda a, b: statistics.median(x / y for x, y in zip(times[a], times[b], strict=True))
    return found | {
        "picture_seconds": statistics.median(times["plain"]),
        "local_over_plain": over("local", "plain"),
        "surface_over_hit": over("surface", "hit"),
        "new_transfer_processor_seconds": statistics.median(times["transfer"]),
        "histogram_bytes": sum(x.nbytes for x in jax.tree.leaves(kept["histogram"].occlusion.projected)),
    }


def _projection_seconds(scene: jvr.Scene) -> tuple[float, float]:
    """Of the clock and of processors, the least of several, after a first time."""
    times = []
    for _ in range(PROJECTIONS + 1):
        clock, processor = time.perf_counter(), time.process_time()
        jax.block_until_ready(jax.tree.leaves(jvr.precompute(scene).occlusion))
        times.append((time.perf_counter() - clock, time.process_time() - processor))
    clocks, processors = zip(*times[1:], strict=True)
    return min(clocks), min(processors)
