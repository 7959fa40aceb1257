"""The machine's own limit: `loop.cpp`, compiled here for this machine and called through ctypes."""

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.peers.errors import rmse
from benchmarks.peers.rays import enter
from benchmarks.peers.scenes import Scene
from benchmarks.peers.settings import TERMINATION, THREADS

FLAGS = ("-O3", "-march=native", "-ffast-math", "-std=c++17", "-shared", "-fPIC", "-pthread")
# 4096 entries of 16 bytes stay in the cache.
SHIFT = 4


def compiler() -> str:
    """**Raises** `ImportError` where there is none, as a missing package does."""
    for name in ("g++", "clang++", "c++"):
        if path := shutil.which(name):
            return path
    raise ImportError("no C++ compiler (g++, clang++ or c++)")


def version() -> str:
    return subprocess.run([compiler(), "--version"], capture_output=True, text=True, check=True).stdout.splitlines()[0]


class Renderer:
    """One scene in the compiled loop. Packing and finding empty bricks are not part of the timed call."""

    def __init__(self, scene: Scene):
        self.library = _compile()
        self.rgb, self.sigma_t, self.domain = scene.rgb, scene.sigma_t, scene.domain
        self.size = (scene.view.height, scene.view.width)
        self.spacing = min(scene.spacing)
        self.rays = [np.ascontiguousarray(x, np.float32) for x in enter(scene)]
        low, high = float(scene.voxels.min()), float(scene.voxels.max())
        self.low, self.scale = low, (high - low or 1.0) / 65535
        voxels = np.ascontiguousarray(_quantise(scene.voxels, self.low, self.scale))
        self.volume = self.library.make_volume(_pointer(voxels), *voxels.shape)

    def prepare(self, step: float) -> None:
        """A table of what a segment of `step` voxels adds, and the bricks that are empty under it."""
        self.step = step * self.spacing
        middle = (np.arange(65536 >> SHIFT) + 0.5) * 2**SHIFT
        s, at = self.low + self.scale * middle, np.linspace(*self.domain, len(self.sigma_t))
        opacity = -np.expm1(-np.interp(s, at, self.sigma_t) * self.step)
        colours = [np.interp(s, at, channel) * opacity for channel in self.rgb.T]
        table = np.ascontiguousarray(np.stack([*colours, opacity], axis=1), np.float32)
        self.library.classify(self.volume, _pointer(table), SHIFT)

    def draw(self) -> None:
        height, width = self.size
        self.drawn = np.empty((height, width, 3), np.float32)
        rays = [_pointer(x) for x in self.rays]
        self.library.render(self.volume, *rays, width, height, self.step, TERMINATION, THREADS, _pointer(self.drawn))

    def picture(self) -> np.ndarray:
        return self.drawn

    def error(self, reference: np.ndarray) -> float:
        return rmse(self.drawn, reference)


def _quantise(voxels: np.ndarray, low: float, scale: float) -> np.ndarray:
    """To 16 bits, a slice at a time: the volume may be large."""
    result = np.empty(voxels.shape, np.uint16)
    for source, target in zip(voxels, result, strict=True):
        target[...] = np.round((source.astype(np.float32) - low) / scale)
    return result


def _compile() -> ctypes.CDLL:
    # The folder may go once the library is loaded.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "loop.so"
        command = [compiler(), *FLAGS, "-o", str(path), str(Path(__file__).with_name("loop.cpp"))]
        subprocess.run(command, check=True, capture_output=True, text=True)
        library = ctypes.CDLL(str(path))
    pointer, number, real = ctypes.c_void_p, ctypes.c_int, ctypes.c_float
    library.make_volume.restype, library.make_volume.argtypes = pointer, [pointer, *[number] * 3]
    library.classify.restype, library.classify.argtypes = None, [pointer, pointer, number]
    library.render.restype, library.render.argtypes = None, [*[pointer] * 4, number, number, real, real, number, pointer]
    return library


def _pointer(array: np.ndarray) -> int:
    return array.ctypes.data
