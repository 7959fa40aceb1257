"""The scenes that every renderer is given, as plain arrays that need no renderer to read."""

import dataclasses
import os
from pathlib import Path

import numpy as np

from benchmarks.peers import shapes

ENTRIES = 256


@dataclasses.dataclass(frozen=True)
class View:
    """A pinhole camera, as `jvr.PerspectiveCamera.look_at`."""

    eye: tuple[float, ...]
    target: tuple[float, ...]
    up: tuple[float, ...]
    fov_y: float
    width: int
    height: int


@dataclasses.dataclass(frozen=True)
class Scattering:
    """Light that the medium scatters once: parallel light that travels along `direction`, and a Henyey-Greenstein phase function."""

    direction: tuple[float, ...]
    irradiance: float
    albedo: float
    g: float


@dataclasses.dataclass(frozen=True)
class Scene:
    """A volume whose axes are the world's, a transfer function with equally spaced entries, and a view; black behind.

    `voxels`: `(x, y, z)`; voxel `(i, j, k)` sits at `origin + spacing * (i, j, k)`. `rgb` `(n, 3)` and `sigma_t` `(n,)`, per world
    length, interpolate linearly over `domain` and clamp outside. With `absorption`, nothing is emitted and the background is white; with
    `scattering`, nothing is emitted and all light is scattered.
    """

    name: str
    data: str
    voxels: np.ndarray
    spacing: tuple[float, ...]
    origin: tuple[float, ...]
    rgb: np.ndarray
    sigma_t: np.ndarray
    domain: tuple[float, float]
    view: View
    absorption: bool = False
    scattering: Scattering | None = None

    @property
    def hull(self) -> np.ndarray:
        """World size of the volume, from the first sample to the last, `(3,)`."""
        return (np.asarray(self.voxels.shape) - 1) * self.spacing

    def sized(self, width: int, height: int) -> "Scene":
        """The same scene in a picture of another size."""
        return dataclasses.replace(self, view=dataclasses.replace(self.view, width=width, height=height))


def four(n: int, size: int) -> list[Scene]:
    """Opaque bone, translucent skin, sparse vessels and a smooth simulation, each in a picture of `size` x `size`: from formulas
    with `n` voxels a side, and from scans where `$JVR_DATA` has them."""
    return from_formulas(n, size) + from_scans(size)


def from_formulas(n: int, size: int) -> list[Scene]:
    body, vessels = ("phantom", *shapes.phantom(n)), ("tubes", *shapes.vessels(n))
    return [_bone(*body, size), _skin(*body, size), _vessels(*vessels, size), simulation(n, size)]


def from_scans(size: int) -> list[Scene]:
    scenes = []
    torso, carotid = _scan("ct_torso/example_ct.nii.gz"), _scan("carotid/carotid.vtk")
    if torso:
        scenes += [_bone("CT of a torso", *torso, size), _skin("CT of a torso", *torso, size)]
    if carotid:
        scenes.append(_carotid(*carotid, size))
    return scenes


def growing(n: int, size: int) -> Scene:
    """The sparse scene at `n` voxels a side: the same object, 5 % of the voxels not empty."""
    return _vessels("tubes", *shapes.vessels(n), size)


def boxed(scene: Scene) -> Scene:
    """The same object in a box of 8 times the volume, empty around it."""
    before = [(n - 1) // 2 for n in scene.voxels.shape]
    after = [n - 1 - b for n, b in zip(scene.voxels.shape, before, strict=True)]
    voxels = np.pad(scene.voxels, list(zip(before, after, strict=True)), constant_values=round(scene.domain[0]))
    origin = tuple(o - b * d for o, b, d in zip(scene.origin, before, scene.spacing, strict=True))
    return dataclasses.replace(scene, voxels=voxels, origin=origin)


def simulation(n: int, size: int) -> Scene:
    """A gyroid, translucent throughout; float32."""
    x = np.linspace(0, 1, ENTRIES)
    voxels = shapes.gyroid(n)
    scene = _scene("simulation", "gyroid", voxels, 100 / (n - 1), _smooth_colours(x), 0.03 * x**2, (-1.5, 1.5), size)
    return scene


def fog(n: int, size: int) -> Scene:
    """A medium that only absorbs, its extinction linear in the scalar, so that renderers without a transfer function can show it."""
    x = np.linspace(0, 1, ENTRIES)
    scene = _scene("absorption", "gyroid", shapes.gyroid(n), 100 / (n - 1), np.zeros((ENTRIES, 3)), 0.03 * x, (-1.5, 1.5), size)
    return dataclasses.replace(scene, absorption=True)


def scattering(n: int, size: int) -> list[Scene]:
    """Media that scatter the light of the sun, which shines past the camera's shoulder: the same extinction everywhere, and the fog."""
    light = Scattering(direction=(0.7, 0.5, -0.5), irradiance=10.0, albedo=0.8, g=0.5)
    uneven = fog(n, size)
    even = dataclasses.replace(uneven, data="homogeneous", voxels=np.full_like(uneven.voxels, 0.5))
    changes = {"name": "scattering", "absorption": False, "scattering": light}
    return [dataclasses.replace(scene, **changes) for scene in (even, uneven)]


def _bone(data: str, voxels: np.ndarray, spacing: float, size: int) -> Scene:
    points = [(150, 0.55, 0.25, 0.15, 0.0), (300, 0.85, 0.65, 0.45, 0.1), (700, 1.0, 0.93, 0.82, 0.6), (1500, 1.0, 1.0, 1.0, 1.0)]
    return _scene("bone", data, voxels, spacing, *_table(points, (-1000, 1500)), size)


def _skin(data: str, voxels: np.ndarray, spacing: float, size: int) -> Scene:
    points = [
        (-500, 0.85, 0.55, 0.40, 0.0),
        (-100, 0.90, 0.65, 0.45, 0.006),
        (40, 0.80, 0.35, 0.25, 0.003),
        (200, 0.90, 0.60, 0.45, 0.02),
        (700, 1.0, 0.95, 0.85, 0.2),
    ]
    return _scene("skin", data, voxels, spacing, *_table(points, (-1000, 1500)), size)


def _vessels(data: str, voxels: np.ndarray, spacing: float, size: int) -> Scene:
    points = [(64, 0.45, 0.03, 0.02, 0.0), (128, 0.8, 0.1, 0.05, 0.15), (255, 1.0, 0.8, 0.6, 0.6)]
    return _scene("vessels", data, voxels, spacing, *_table(points, (0, 255)), size)


def _carotid(voxels: np.ndarray, spacing: float, size: int) -> Scene:
    points = [(200, 0.45, 0.03, 0.02, 0.0), (300, 0.8, 0.1, 0.05, 0.3), (580, 1.0, 0.8, 0.6, 1.0)]
    return _scene("vessels", "MR angiogram of carotids", voxels, spacing, *_table(points, (0, 580)), size)


def _scene(name, data, voxels, spacing, rgb, sigma_t, domain, size) -> Scene:
    """A volume around the origin, seen along a diagonal, the whole of it in the picture."""
    hull = (np.asarray(voxels.shape) - 1) * spacing
    radius = float(np.linalg.norm(hull)) / 2
    eye = tuple(radius * np.array([1.1, -2.2, 0.9]))
    view = View(eye, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 42.0, size, size)
    return Scene(name, data, voxels, (spacing,) * 3, tuple(-hull / 2), rgb, sigma_t, domain, view)


def _table(points: list[tuple[float, ...]], domain: tuple[float, float]) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Control points (scalar, red, green, blue, extinction) as a table over `domain`."""
    at, *columns = np.asarray(points).T
    rows = np.stack([np.interp(np.linspace(*domain, ENTRIES), at, column) for column in columns], axis=1)
    return rows[:, :3], rows[:, 3], domain


def _smooth_colours(x: np.ndarray) -> np.ndarray:
    return np.stack([0.5 + 0.4 * np.sin(5 * x), 0.5 + 0.4 * np.cos(4 * x), 0.3 + 0.5 * x], axis=1)


def _scan(name: str) -> tuple[np.ndarray, float] | None:
    """Voxels and their isotropic spacing; the scan's own orientation plays no part. `None` where it is absent."""
    path = Path(os.environ.get("JVR_DATA", "data")) / name
    if not path.exists():
        return None
    import jvr

    volume = jvr.read_volume(path)
    return np.asarray(volume.values), float(volume.spacing[0])
