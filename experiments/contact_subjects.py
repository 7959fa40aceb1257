"""What the contact sheet shows: a CT of a head (`ct_head_quarter`, looked for in `$JVR_DATA`) and the embedded volume, from configurations
(`configs/real/ct_head_lit.toml`, `configs/lit.toml`), made alike so that each effect is compiled once for both."""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

import jvr
from experiments.protocols import DATA, HEAD
from jvr.io.config import build_cameras, build_scene, build_settings, read_config

CONFIGS = Path(__file__).parents[1] / "configs"
# Voxels of every volume.
SHAPE = (64, 64, 93)


@dataclasses.dataclass(frozen=True)
class Subject:
    """A lit scene, what sees it, and what depends on its units: lengths of the gradient of its surfaces, the share of its extinction that
    makes it a cloud, where a detail is looked at, two isovalues, of a thing and of what is in it, with their colours,
    and which of them has the smoother surface."""

    name: str
    scene: jvr.Scene
    camera: Any
    settings: jvr.Settings
    surface: float
    cloud: float
    detail: Sequence[float]
    isovalues: tuple[float, float]
    colours: tuple[Sequence[float], Sequence[float]]
    smooth: float

    @property
    def table(self) -> jvr.LutTransfer:
        assert isinstance(self.scene.transfer, jvr.LutTransfer)
        return self.scene.transfer

    @property
    def up(self) -> np.ndarray:
        """The way along z that is upwards in the picture."""
        return np.array([0.0, 0.0, np.sign(np.asarray(self.camera.world_from_camera)[2, 1])])

    def beside(self, sideways: float, upwards: float, back: float) -> np.ndarray:
        """A place in the world, in radii of the volume from its middle: to the right, upwards in the picture, and towards the eye."""
        axes = np.asarray(self.camera.world_from_camera)[:3, :3]
        offset = axes @ np.array([sideways, upwards, back])
        return np.asarray(self.scene.volume.center) + float(self.scene.volume.radius) * offset


def subjects(size: int) -> list[Subject]:
    """The head where it is there, and the embedded volume."""
    found = []
    if (DATA / HEAD).exists():
        numbers: Any = {"surface": 150.0, "cloud": 0.1, "detail": (60.0, 40.0, 60.0)}
        numbers |= {"isovalues": (500.0, 1180.0), "colours": ((0.85, 0.50, 0.36), (0.95, 0.88, 0.75)), "smooth": 500.0}
        found.append(_subject("CT of a head", "real/ct_head_lit.toml", size, **numbers))
    else:
        print(f"{HEAD} is not in $JVR_DATA: the sheet shows the embedded volume alone", file=sys.stderr)
    numbers = {"surface": 0.04, "cloud": 0.06, "detail": (0.0, -4.0, 12.0)}
    numbers |= {"isovalues": (0.15, 0.45), "colours": ((0.25, 0.45, 0.90), (0.92, 0.60, 0.18)), "smooth": 0.45}
    found.append(_subject("embedded volume", "lit.toml", size, **numbers))
    return found


def _subject(name: str, config: str, size: int, **numbers: Any) -> Subject:
    read = read_config(CONFIGS / config, [f"camera.width={size}", f"camera.height={size}"])
    scene = build_scene(read)
    (camera,) = build_cameras(read, scene.volume)
    return Subject(name, alike(scene), camera, build_settings(read), **numbers)


def alike(scene: jvr.Scene) -> jvr.Scene:
    """The scene with as many voxels, entries and lights as every other, so that an effect is compiled once for all subjects."""
    old = scene.volume
    grid = np.meshgrid(*[np.linspace(0, m - 1, n) for m, n in zip(old.shape, SHAPE, strict=True)], indexing="ij")
    values = jax.jit(jax.vmap(old.sample))(tuple(jnp.asarray(x.ravel(), float) for x in grid))
    scale = np.diag([*((m - 1) / (n - 1) for m, n in zip(old.shape, SHAPE, strict=True)), 1.0])
    volume = jvr.Volume(np.asarray(values).reshape(SHAPE), np.asarray(old.world_from_grid) @ scale)
    key, threshold = cast(Any, scene.lights[0]), cast(Any, scene.shading).threshold
    box = scene.clipping or jvr.ClippingBox([-1e3] * 3, [1e3] * 3)
    lights = (dataclasses.replace(key, irradiance=0.65 * key.irradiance), jvr.HeadLight(0.15), jvr.AmbientLight(0.6))
    shading = jvr.BlinnPhong(0.15, 0.85, 0.4, 30.0, threshold=threshold)
    parts = {"background": scene.background, "clipping": box, "lights": lights, "shading": shading}
    return jvr.Scene(volume, _table(scene.transfer), normals=jvr.PrecomputedGradient(), **parts)


def _table(transfer: Any) -> jvr.LutTransfer:
    ends = transfer.positions[0], transfer.positions[-1]
    at = jax.vmap(transfer.evaluate)(jnp.linspace(*ends, 256))
    return jvr.LutTransfer(np.stack(at.rgb, axis=-1), np.asarray(at.sigma_t[0]), ends)
