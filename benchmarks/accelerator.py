"""Large pictures on an accelerator, beside the same march written by hand in CUDA (`march.cu`).

`python -m benchmarks accelerator [--quick]`; scenes from formulas, so that nothing has to be carried there. Without a CUDA compiler the
kernel is left out; without an accelerator both run on the processor, which takes minutes and says little.
"""

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jvr
from benchmarks import scenes
from benchmarks.peers.compiled import compiler
from benchmarks.timing import median, seconds
from jvr.execution.tiles import dealt_blocks, picture_of, pixels_of
from jvr.rendering.medium import prepare
from jvr.rendering.trace import camera_rays, near_volume, step_length

SOURCE = Path(__file__).with_name("march.cu")
TERMINATION = 1e-3
# How far apart two pictures of the same samples may be: rounding moves where a ray ends.
SAME = 3e-3


class _March(ctypes.Structure):
    """`March` of the source."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("voxels", "table", "radius", "rays")),
        *((name, ctypes.c_int * 3) for name in ("n", "bricks")),
        *((name, ctypes.c_int) for name in ("brick", "entries", "count")),
        *((name, ctypes.c_float) for name in ("low", "high", "dt", "termination")),
    )


class HandWritten:
    """A picture by the kernel, on the host where `device` is false: of emission and absorption in a `LutTransfer`, no background, voxels of
    slope 1 and intercept 0."""

    def __init__(self, scene: jvr.Scene, camera: jvr.PerspectiveCamera, settings: jvr.Settings, *, device: bool):
        self.library, self.device = _compiled(device), device
        size = self.size = (camera.height, camera.width)
        scene, camera = near_volume(scene, camera)
        prepared = jax.jit(prepare, static_argnums=1)(scene, settings, step_length(scene, settings))
        inside, _ = jax.jit(camera_rays)(scene, camera, pixels_of(dealt_blocks(*size), *size))
        assert isinstance(scene.transfer, jvr.LutTransfer)
        assert prepared.occupancy is not None
        table = jnp.concatenate([scene.transfer.rgb, scene.transfer.sigma_t[:, None]], axis=1)
        rays = jnp.stack([*inside.entry, *inside.direction, inside.length])
        low, high = np.asarray(scene.transfer.domain)
        kinds = {"voxels": np.float32, "table": np.float32, "radius": np.uint8, "rays": np.float32}
        found = (scene.volume.values, table, prepared.occupancy.empty_radius, rays)
        self.arrays = {name: np.ascontiguousarray(x, kind) for (name, kind), x in zip(kinds.items(), found, strict=True)}
        shapes = {"n": scene.volume.shape, "bricks": prepared.occupancy.empty_radius.shape}
        self.march = _March(
            **{name: x.ctypes.data for name, x in self.arrays.items()},
            **{name: (ctypes.c_int * 3)(*shape) for name, shape in shapes.items()},
            brick=prepared.occupancy.size,
            entries=table.shape[0],
            count=rays.shape[1],
            low=low,
            high=high,
            dt=float(prepared.dt),
            termination=settings.termination,
        )
        self.out = np.zeros((rays.shape[1], 4), np.float32)

    def seconds(self, repeats: int) -> float:
        """The median launch. **Raises** `RuntimeError` where CUDA reports an error."""
        times = np.zeros(repeats, np.float32)
        error = self.library.march_on_device(ctypes.byref(self.march), self.out.ctypes.data, times.ctypes.data, repeats)
        if error:
            raise RuntimeError(f"CUDA error {error}")
        return float(np.median(times)) / 1000

    def on_host(self) -> int:
        """Renders on the processor; the number of samples."""
        return self.library.march_on_host(ctypes.byref(self.march), self.out.ctypes.data)

    def picture(self) -> np.ndarray:
        return np.asarray(picture_of(jnp.asarray(self.out[:, :3]), *self.size))


def accelerator(quick: bool = False) -> dict[str, Any]:
    """Pictures of 1024^2 of volumes of 256^3 and 512^3, translucent and opaque, at half-voxel steps: samples a second, the gradient in
    the transfer function and the voxels over the picture, and the hand-written kernel's time."""
    size, sides = (128, (32,)) if quick else (1024, (256, 512))
    result: dict[str, Any] = {"device": jax.devices()[0].device_kind}
    for side in sides:
        volume = scenes.gyroid(side).bricked()
        for name, transfer in (("translucent", scenes.translucent()), ("opaque", scenes.opaque())):
            # As deep in all sizes.
            transfer = eqx.tree_at(lambda t: t.sigma_t, transfer, transfer.sigma_t * 128 / side)
            scene, camera = jvr.Scene(volume, transfer), scenes.camera(volume, size)
            result[f"{name} {side}^3, {size}^2"] = _measured(scene, camera, repeats=2 if quick else 5)
            jax.clear_caches()
    return result


def _measured(scene: jvr.Scene, camera: jvr.PerspectiveCamera, repeats: int) -> dict[str, Any]:
    settings = jvr.Settings(0.5, termination=TERMINATION, tile=camera.width * camera.height)
    image = jax.jit(lambda scene: jvr.render(scene, camera, settings))
    loss = lambda unknown, into: jnp.mean(jnp.square(image(eqx.tree_at(into, scene, unknown)).rgb - 0.5))
    unknowns = {"transfer": lambda s: (s.transfer.rgb, s.transfer.sigma_t), "voxels": lambda s: s.volume.values}
    functions = {"image": lambda: image(scene)}
    for name, into in unknowns.items():
        of = jax.jit(jax.value_and_grad(lambda unknown, into=into: loss(unknown, into)))
        functions[name] = lambda of=of, into=into: of(into(scene))
    times, picture = seconds(functions, repeats), image(scene)
    samples = int(np.asarray(picture.stats.steps, np.int64).sum())
    result = {
        "samples": samples,
        "seconds": median(times, "image"),
        "samples_per_second": samples / median(times, "image"),
        **{f"{name}_gradient_over_image": median(times, name) / median(times, "image") for name in unknowns},
    }
    if jax.default_backend() != "gpu" or shutil.which("nvcc") is None:
        return result | {"hand_written": "needs an NVIDIA device and its compiler, nvcc"}
    kernel = HandWritten(scene, camera, settings, device=True)
    by_hand = kernel.seconds(repeats)
    difference = float(np.abs(kernel.picture() - np.asarray(picture.rgb)).max())
    if difference > SAME:
        raise RuntimeError(f"the picture by hand differs by {difference:.1e} from that of jvr")
    return result | {
        "hand_written_seconds": by_hand,
        "over_hand_written": median(times, "image") / by_hand,
        "largest_difference": difference,
    }


def _compiled(device: bool) -> ctypes.CDLL:
    """The source as a library. **Raises** `ImportError` without a compiler for it."""
    if device:
        command = ["nvcc", "-O3", "-arch=native", "--shared", "-Xcompiler", "-fPIC"]
    else:
        command = [compiler(), "-O2", "-std=c++17", "-x", "c++", "-shared", "-fPIC"]
    # The folder may go once the library is loaded.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "march.so"
        subprocess.run([*command, "-o", str(path), str(SOURCE)], check=True, capture_output=True, text=True)
        library = ctypes.CDLL(str(path))
    library.march_on_host.restype = ctypes.c_longlong
    library.march_on_host.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
    if device:
        library.march_on_device.restype = ctypes.c_int
        library.march_on_device.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int]
    return library
