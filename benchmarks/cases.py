"""The measurements, one function each; every one returns a flat dictionary of numbers."""

import functools
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jvr
from benchmarks import scenes, yardsticks
from benchmarks.light import light
from benchmarks.mirrors import mirrors
from benchmarks.occlusion import occlusion
from benchmarks.poses import pose_step
from benchmarks.preparation import preparation
from benchmarks.surface_peers import surface_peers
from benchmarks.surfaces import surfaces
from benchmarks.timing import median, ratio, seconds
from benchmarks.voxels import voxel_step
from jvr.march.march import MarchOptions, march
from jvr.rendering.medium import Prepared, medium
from jvr.rendering.trace import enter, step_length

SIZE = 256


def forward() -> dict[str, Any]:
    """Forward march of a translucent 128^3 float32 volume at 256^2, half-voxel steps, against `vmap` of a `fori_loop`."""
    volume, settings = scenes.gyroid(), jvr.Settings(0.5, termination=0.0)
    scene = jvr.Scene(volume, scenes.translucent())
    camera = scenes.camera(volume, SIZE)
    rays, _ = jax.jit(lambda: enter(scene, *camera.rays(jnp.arange(SIZE * SIZE, dtype=jnp.int32))))()
    dt = step_length(scene, settings)
    ours = jax.jit(lambda scene, rays, dt: march(MarchOptions(0.0, False), medium(Prepared(scene, settings, dt)), rays, dt))
    gathered = ours(scene, rays, dt)
    segments = int(gathered.steps.max())
    plain = jax.jit(lambda volume, transfer, rays, dt: yardsticks.vmapped_march(volume, transfer, rays, dt, segments))
    difference = np.abs(np.stack(gathered.radiance, -1) - plain(volume, scene.transfer, rays, dt)[0]).max()
    times = seconds({"jvr": lambda: ours(scene, rays, dt), "vmap": lambda: plain(volume, scene.transfer, rays, dt)}, repeats=5)
    samples = int(gathered.steps.sum())
    return {
        "samples": samples,
        "seconds": median(times, "jvr"),
        "samples_per_second": samples / median(times, "jvr"),
        "vmap_fori_loop_over_jvr": ratio(times, "vmap", "jvr"),
        "largest_difference": float(difference),
    }


def gradient() -> dict[str, Any]:
    """Image and gradient of a scalar loss over the image alone: opaque scene, 64-entry transfer function, and all voxels. Nothing is
    skipped: gradients in a transfer function may not, and an image that does would be no measure of them."""
    volume, settings = scenes.gyroid(), jvr.Settings(0.5, skipping=False)
    scene, camera = jvr.Scene(volume, scenes.opaque()), scenes.camera(volume, SIZE)
    image = jax.jit(lambda scene: jvr.render(scene, camera, settings))
    into_entries = lambda s: (s.transfer.rgb, s.transfer.sigma_t)
    entries = into_entries(scene)
    into_voxels = lambda s: s.volume.values

    def loss(unknown: Any, into: Any) -> jax.Array:
        return jnp.mean(jnp.square(jvr.render(eqx.tree_at(into, scene, unknown), camera, settings).rgb - 0.5))

    of_entries = jax.jit(jax.value_and_grad(lambda u: loss(u, into_entries)))
    of_voxels = jax.jit(jax.value_and_grad(lambda u: loss(u, into_voxels)))
    times = seconds(
        {"image": lambda: image(scene), "transfer": lambda: of_entries(entries), "voxels": lambda: of_voxels(volume.values)}
    )
    return {
        "image_seconds": median(times, "image"),
        "transfer_gradient_over_image": ratio(times, "transfer", "image"),
        "voxel_gradient_over_image": ratio(times, "voxels", "image"),
    }


def skipping() -> dict[str, Any]:
    """The CT of a torso through presets whose first position lies above air, at 192^2: everything over what skips empty bricks, for
    pictures and for gradients in voxels, colours and extinctions."""
    path = Path(os.environ.get("JVR_DATA", "data")) / "ct_torso" / "example_ct.nii.gz"
    if not path.exists():
        return {"skipped": "needs the CT of a torso of the public volumes: set JVR_DATA to their folder"}
    scanned, found = jvr.read_volume(path), {}
    volume = jvr.Volume(scanned.values.astype(np.float32), scanned.world_from_grid)
    camera = scenes.camera(volume, 192)
    into = {"voxels": lambda s: s.volume.values, "colours": lambda s: s.transfer.rgb, "extinctions": lambda s: s.transfer.sigma_t}
    for name in ("ct_bone", "ct_soft_tissue", "ct_vessels"):
        scene = jvr.Scene(volume, getattr(jvr.presets, name)())
        functions: dict[str, Any] = {}
        for kind, choices in (("on", jvr.Settings()), ("off", jvr.Settings(skipping=False))):
            functions[f"image_{kind}"] = lambda choices=choices, scene=scene: jvr.render(scene, camera, choices).rgb
            for unknown, place in into.items() if name == "ct_bone" else ():
                loss = lambda u, choices=choices, scene=scene, place=place: jnp.mean(
                    jnp.square(jvr.render(eqx.tree_at(place, scene, u), camera, choices).rgb - 0.5)
                )
                gradient = jax.jit(jax.value_and_grad(loss))
                functions[f"{unknown}_{kind}"] = lambda gradient=gradient, start=place(scene): gradient(start)
        times = seconds(functions, repeats=5)
        for measured in sorted({key.rsplit("_", 1)[0] for key in functions}):
            found[f"{name}_{measured}_seconds"] = median(times, f"{measured}_on")
            found[f"{name}_{measured}_everything_over_visible"] = ratio(times, f"{measured}_off", f"{measured}_on")
    return found


def devices() -> dict[str, Any]:
    """Image and gradient in a transfer function within the caller's own `jax.jit`: over all devices, over the first alone."""
    found, settings = {}, jvr.Settings(0.5)
    for kind, transfer in {"opaque": scenes.opaque, "translucent": scenes.translucent}.items():
        for size in (128, 400):
            functions = _of_size(transfer, size, settings)
            with jax.default_device(jax.devices()[0]):
                alone = _of_size(transfer, size, settings)
            for name in functions:
                times = seconds({"all": functions[name], "one": functools.partial(_alone, alone[name])})
                found[f"{kind}_{size}_{name}_all_over_one"] = ratio(times, "all", "one")
    return found


def _of_size(transfer: Callable[[], Any], size: int, settings: jvr.Settings) -> dict[str, Callable[[], Any]]:
    """Image and gradient of a gyroid."""
    scene = jvr.Scene(scenes.gyroid(), transfer())
    camera = scenes.camera(scene.volume, size)
    draw = lambda t, volume: jvr.render(eqx.tree_at(lambda s: (s.volume, s.transfer), scene, (volume, t)), camera, settings).rgb
    loss = jax.jit(jax.value_and_grad(lambda t, volume: jnp.mean(jnp.square(draw(t, volume) - 0.5))))
    image = jax.jit(draw)
    return {"image": lambda: image(scene.transfer, scene.volume), "gradient": lambda: loss(scene.transfer, scene.volume)}


def _alone(function: Callable[[], Any]) -> Any:
    with jax.default_device(jax.devices()[0]):
        return function()


def memory() -> dict[str, Any]:
    """Compiled temporary memory of a gradient, per ray in flight beyond two volumes, at two step lengths."""
    volume = scenes.gyroid(64)
    scene, camera = jvr.Scene(volume, scenes.translucent()), scenes.camera(volume, SIZE)

    def temporary(into: Any, unknown: Any, step: float) -> int:
        def loss(unknown: Any) -> jax.Array:
            return jnp.mean(jvr.render(eqx.tree_at(into, scene, unknown), camera, jvr.Settings(step)).rgb)

        analysis = jax.jit(jax.value_and_grad(loss)).lower(unknown).compile().memory_analysis()
        assert analysis is not None
        return analysis.temp_size_in_bytes

    result: dict[str, Any] = {}
    for name, into in {"transfer": lambda s: s.transfer.sigma_t, "voxels": lambda s: s.volume.values}.items():
        coarse, fine = (temporary(into, into(scene), step) for step in (0.5, 0.03))
        result[f"{name}_bytes_per_ray"] = (coarse - 2 * volume.values.nbytes * (name == "voxels")) / SIZE**2
        result[f"{name}_fine_over_coarse_step"] = fine / coarse
    return result


def resident() -> dict[str, Any]:
    """Largest resident memory of a process that draws a 256^3 float32 volume, or takes the gradient in its voxels, on one device and on
    two, less that of the same with 16^3 voxels (the interpreter and the compiler), in copies of the voxels; and the bytes that a fit
    takes for each ray."""
    found: dict[str, Any] = {f"fit_on_{count}_bytes_per_ray": float(_measured("fit_bytes_per_ray", count)) for count in (1, 2)}
    for what in ("picture", "gradient"):
        for count in (1, 2):
            small, large = (int(_measured("peak", what, count, n)) for n in (16, 256))
            found[f"{what}_on_{count}_bytes"] = large
            found[f"{what}_on_{count}_in_volumes"] = (large - small) / (4 * 256**3)
        found[f"{what}_two_over_one"] = found[f"{what}_on_2_bytes"] / found[f"{what}_on_1_bytes"]
    return found


def _measured(function: str, *arguments: str | int) -> str:
    """What a function of `benchmarks.resident` returns in a process of its own."""
    program = f"from benchmarks.resident import {function}; print({function}(*{arguments!r}))"
    return subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout


def fitting() -> dict[str, Any]:
    """The CT head protocol (docs/fitting.md): time to 60 dB in evaluations of a plain forward march over the same kept samples, a step of
    all poses of its views in pictures of these, and an evaluation of voxels (`experiments/tomography.py`) likewise."""
    from experiments.protocols import ct_head
    from jvr.fitting.observations import inside, keep_samples, observe, observed_medium, prepare_in_fit

    protocol = ct_head()
    if protocol is None:
        return {"skipped": "needs the CT head of the public volumes: set JVR_DATA to their folder"}
    start, cameras, images, settings = protocol.start, protocol.cameras, protocol.images, protocol.settings
    chunk = sum(camera.width * camera.height for camera in cameras)
    observations = observe(start, cameras, images, None, settings, chunk)
    kept = keep_samples(start, observations, settings, 2**31, clamped=True)
    assert kept is not None
    tile = kept[1].tile(0)
    through, rays = observed_medium(tile, kept[0], prepare_in_fit(start, settings, False)), inside(start, tile.rays)
    plain = jax.jit(yardsticks.kept_march)
    dt = step_length(start, settings)
    jax.block_until_ready(plain(through, rays, dt))
    unknowns = lambda s: (s.transfer.rgb, s.transfer.sigma_t)
    run = lambda settings=settings: jvr.fit(start, cameras, images, settings=settings, unknowns=unknowns, progress=False)
    seconds_to_60 = lambda result: next((entry.seconds for entry in result.history if entry.psnr >= 60), float("nan"))
    result = run()
    evaluations, to_60 = [], []
    for _ in range(3):
        began = time.perf_counter()
        for _ in range(5):
            jax.block_until_ready(plain(through, rays, dt))
        evaluations.append((time.perf_counter() - began) / 5)
        result = run()
        to_60.append(seconds_to_60(result))
    less = {}
    for negligible in (1e-3, 1e-2):
        bounded = jvr.Settings(settings.step, termination=settings.termination, negligible=negligible)
        run(bounded)
        short = run(bounded)
        less[str(negligible)] = {"seconds_to_60_db": seconds_to_60(short), "psnr_at_convergence": short.history[-1].psnr}
    return {
        "psnr_at_convergence": result.history[-1].psnr,
        "iterations": len(result.history),
        "seconds_to_60_db": statistics.median(to_60),
        "plain_evaluation_seconds": statistics.median(evaluations),
        "evaluations_to_60_db": statistics.median(a / b for a, b in zip(to_60, evaluations, strict=True)),
        "kept_bytes": result.stats.kept_bytes,
        "negligible": less,
        "poses": pose_step(protocol.truth, cameras, images, settings, repeats=5),
        "voxels": voxel_step(),
    }


def startup() -> dict[str, Any]:
    """Seconds of `import jvr` beyond `import jax`, and of `jvr render` of a 256^2 picture from a cold process, cache cold and warm."""

    def run(*command: str, **environment: str) -> float:
        began = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True, env={**os.environ, **environment})
        return time.perf_counter() - began

    imports = [run(sys.executable, "-c", "import jvr") - run(sys.executable, "-c", "import jax") for _ in range(5)]
    with tempfile.TemporaryDirectory() as folder:
        picture = str(Path(folder) / "picture.png")
        config = str(Path(__file__).parents[1] / "configs" / "demo.toml")
        command = (str(Path(sys.executable).with_name("jvr")), "render", config, "-o", picture, "--set", "camera.width=256")
        command += ("--set", "camera.height=256", "--set", "camera.count=1")
        cold = run(*command, XDG_CACHE_HOME=folder)
        warm = run(*command, XDG_CACHE_HOME=folder)
    return {"import_beyond_jax": statistics.median(imports), "render_cold": cold, "render_warm": warm}


CASES = {
    "forward": forward,
    "gradient": gradient,
    "skipping": skipping,
    "devices": devices,
    "memory": memory,
    "resident": resident,
    "preparation": preparation,
    "light": light,
    "mirrors": mirrors,
    "surfaces": surfaces,
    "occlusion": occlusion,
    "surface_peers": surface_peers,
    "fitting": fitting,
    "startup": startup,
}
