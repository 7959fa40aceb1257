"""Mitsuba 3: path tracing through a medium, homogeneous or not. It has no transfer function: extinction is a grid of its own."""

import drjit  # pyright: ignore[reportMissingImports]
import mitsuba  # pyright: ignore[reportMissingImports]
import numpy as np

from benchmarks.peers.errors import rmse
from benchmarks.peers.scenes import Scene
from benchmarks.peers.settings import THREADS

# Older ones end the process: they do not know an instruction that Mitsuba needs.
OLDEST_LLVM = 17


def _variant() -> str:
    """LLVM where a new enough library is found (`DRJIT_LIBLLVM_PATH` names another one), otherwise the interpreter."""
    try:
        mitsuba.set_variant("llvm_ad_rgb")
        drjit.set_thread_count(THREADS)
        drjit.eval(drjit.arange(mitsuba.Float, 4) + 1)
        if drjit.detail.llvm_version()[0] >= OLDEST_LLVM:
            return "llvm_ad_rgb"
    except (ImportError, RuntimeError):
        pass
    mitsuba.set_variant("scalar_rgb")
    return "scalar_rgb"


VARIANT = _variant()


def version() -> str:
    return f"{mitsuba.__version__} ({VARIANT})"


class Renderer:
    """A scene that only absorbs, before a white environment, or that scatters light once; its error falls with the root of the number
    of samples per pixel."""

    def __init__(self, scene: Scene):
        if not scene.absorption and scene.scattering is None:
            raise ValueError("only media that absorb or scatter: Mitsuba's have neither a transfer function nor emission")
        self.scene, self.seed = mitsuba.load_dict(_description(scene)), 0

    def prepare(self, samples: int) -> None:
        self.samples = samples

    def draw(self) -> None:
        """Pictures are independent of each other."""
        self.seed += 1
        self.drawn = np.asarray(mitsuba.render(self.scene, spp=self.samples, seed=mitsuba.UInt32(self.seed)))

    def picture(self) -> np.ndarray:
        return self.drawn

    def error(self, reference: np.ndarray) -> float:
        return rmse(self.drawn, reference)


def _description(scene: Scene) -> dict:
    transform = mitsuba.ScalarTransform4f
    extinction = np.interp(scene.voxels, np.linspace(*scene.domain, len(scene.sigma_t)), scene.sigma_t).astype(np.float32)
    low, spacing = np.asarray(scene.origin), np.asarray(scene.spacing)
    box = lambda corner, size: transform().translate(corner.tolist()).scale(size.tolist())
    # Voxels are the centres of cells that fill Mitsuba's grid: it reaches half a voxel beyond them.
    grid = {
        "type": "gridvolume",
        "grid": mitsuba.VolumeGrid(np.ascontiguousarray(extinction.transpose(2, 1, 0))[..., None]),
        "to_world": box(low - spacing / 2, spacing * scene.voxels.shape),
        "wrap_mode": "clamp",
        "raw": True,
    }
    view, scattering = scene.view, scene.scattering
    if np.ptp(extinction) > 0:
        interior = {"type": "heterogeneous", "sigma_t": grid}
    else:
        interior = {"type": "homogeneous", "sigma_t": float(extinction.flat[0])}
    if scattering is None:
        deepest, light = -1, {"type": "constant", "radiance": 1.0}
        interior |= {"albedo": 0.0}
    else:
        # One edge from the light to where it is scattered, one from there to the eye.
        deepest = 2
        light = {"type": "directional", "direction": list(scattering.direction), "irradiance": scattering.irradiance}
        interior |= {"albedo": scattering.albedo, "phase": {"type": "hg", "g": scattering.g}}
    return {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": deepest, "rr_depth": 1000},
        "light": light,
        "medium": {
            "type": "cube",
            "to_world": box(low + scene.hull / 2, scene.hull / 2),
            "bsdf": {"type": "null"},
            "interior": interior,
        },
        "camera": {
            "type": "perspective",
            "fov": view.fov_y,
            "fov_axis": "y",
            "to_world": transform().look_at(origin=list(view.eye), target=list(view.target), up=list(view.up)),
            "film": {
                "type": "hdrfilm",
                "width": view.width,
                "height": view.height,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
            },
            "sampler": {"type": "independent"},
        },
    }
