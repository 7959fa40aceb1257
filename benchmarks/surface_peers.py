"""First hits of isosurfaces beside VTK's, in turns."""

from typing import Any

import jax
import numpy as np
from scipy import ndimage

import jvr
from benchmarks import scenes
from benchmarks.surfaces import LEVEL, SIZE
from benchmarks.timing import median, ratio, seconds


def surface_peers() -> dict[str, Any]:
    """Seconds of a lit picture of a 128^3 isosurface at 256^2 by jvr, by VTK's GPU mapper in isosurface mode (on the software rasteriser
    where there is no graphics card), and by flying edges with and without extraction; and which pixels either shows and the other does
    not."""
    try:
        from benchmarks.peers import vtk_surfaces
    except ImportError:
        return {"skipped": "needs vtk: pip install vtk"}
    volume = scenes.gyroid()
    camera, center = scenes.camera(volume, SIZE), np.asarray(volume.center)
    towards = center - np.asarray(camera.world_from_camera[:3, 3])
    scene = jvr.Scene(
        volume,
        surfaces=jvr.Isosurfaces([LEVEL], np.full((1, 3), 0.7)),
        lights=(jvr.DirectionalLight(towards),),
        shading=jvr.Lambert(0.2, 0.8),
    )
    draw = jax.jit(lambda scene: jvr.render(scene, camera, jvr.Settings(0.5)))
    view = {"eye": center - towards, "target": center, "up": (0, 0, 1), "fov_y": float(camera.fov_y)}
    given = np.asarray(volume.values), LEVEL, view, SIZE
    mapper, edges = vtk_surfaces.IsosurfaceMapper(*given), vtk_surfaces.FlyingEdges(*given)
    times = seconds(
        {"jvr": lambda: draw(scene), "vtk_mapper": mapper.draw, "flying_edges": edges.draw, "with_extraction": edges.draw_anew}
    )
    ours = np.asarray(draw(scene).alpha) > 0.5
    theirs = {name: np.any(one.picture() > 0, axis=-1) for name, one in {"vtk_mapper": mapper, "flying_edges": edges}.items()}
    return {
        **{f"{name}_seconds": median(times, name) for name in times},
        **{f"jvr_over_{name}": ratio(times, "jvr", name) for name in times if name != "jvr"},
        "pixels": int(ours.sum()),
        **{f"other_pixels_{name}": int(np.sum(ours != seen)) for name, seen in theirs.items()},
        **{f"away_from_silhouettes_{name}": int(np.sum((ours != seen) & ~_silhouettes(ours))) for name, seen in theirs.items()},
    }


def _silhouettes(seen: np.ndarray) -> np.ndarray:
    """Pixels next to one of which the other is shown."""
    return np.logical_and(ndimage.binary_dilation(seen), np.logical_not(ndimage.binary_erosion(seen)))
