"""Where fits end: from 20 starts on eight scenes, beside SciPy's bounded least squares on the same residuals and rows.

`python experiments/convergence.py [--json FILE] [--figure FILE] [--quick] [--only SCENE ...]`

In four scenes the truth is one of the model's (`random`, `bounds`, `opaque`, `coloured`), in four it is not: a finer table, pictures of
VTK's fixed-point ray caster (left out where VTK is not installed), noise of 2 %, and shading that the model lacks. A fit has reached the
bottom when its mean squared error, computed from its scene, is within 1 % of the best that anyone found there, or below 1e-8 (80 dB).
"""

import argparse
import dataclasses
import functools
import importlib.util
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr

UNKNOWNS = lambda scene: (scene.transfer.rgb, scene.transfer.sigma_t)
SETTINGS = jvr.Settings(1.0, termination=0.0)
ROWS = jvr.Settings(1.0, termination=0.0, adjoint=jvr.Rows())
FLOOR = 1e-8
NEAR = 1.01
DOMAIN = (0.0, 1.0)
BACKGROUND = (0.2, 0.3, 0.4)
FOV = 50.0


@dataclasses.dataclass(frozen=True)
class Case:
    """Pictures, and a scene whose table is to be found."""

    scene: jvr.Scene
    cameras: tuple[jvr.PerspectiveCamera, ...]
    images: list[np.ndarray]

    def start(self, seed: int) -> jvr.Scene:
        """Start 0 is grey, start 1 darker and fainter; the others are random: colours uniform, extinctions log-uniform over three
        decades."""
        rng = np.random.default_rng(seed)
        rgb, sigma_t = (array.shape for array in UNKNOWNS(self.scene))
        if seed < 2:
            tables = np.full(rgb, (0.5, 0.1)[seed]), np.full(sigma_t, (0.02, 0.004)[seed])
        else:
            tables = rng.random(rgb), 10 ** rng.uniform(-3.5, -0.5, sigma_t)
        return eqx.tree_at(UNKNOWNS, self.scene, tuple(jnp.asarray(table, jnp.float32) for table in tables))


def cases(size: int) -> dict[str, Callable[[], Case]]:
    """The scenes by name, six views of `size^2` each."""
    volume = smooth_volume()
    cameras = jvr.fibonacci_sphere(volume.center, 2.2 * float(volume.radius), 6, FOV, size, size)

    def case(transfer: jvr.LutTransfer, entries: int | None = None, noise: float = 0.0, **lit: Any) -> Case:
        """Pictures of a table, and a scene with another one of `entries` in its place that knows nothing of light."""
        truth = jvr.Scene(volume, transfer, background=BACKGROUND, **lit)
        render, rng = jax.jit(jvr.render), np.random.default_rng(7)
        images = [np.asarray(render(truth, camera, SETTINGS).rgb) for camera in cameras]
        images = [image + noise * rng.normal(size=image.shape).astype(np.float32) for image in images]
        fitted = table(entries or transfer.rgb.shape[0], coloured=transfer.sigma_t.ndim == 2)
        return Case(jvr.Scene(volume, fitted, background=BACKGROUND), cameras, images)

    made = functools.partial(functools.partial, case)
    light = {"shading": jvr.BlinnPhong(), "lights": (jvr.DirectionalLight((1.0, 0.5, -1.0)),)}
    found: dict[str, Callable[[], Case]] = {
        "random": made(table(40)),
        "bounds": made(table(32, bounds=True)),
        "opaque": made(table(32, scale=3.0)),
        "coloured": made(table(16, coloured=True)),
        "finer table": made(table(40), 32),
        "noise": made(table(32), noise=0.02),
        "shading": made(table(24), **light),
    }
    if importlib.util.find_spec("vtk"):
        found["VTK"] = lambda: vtk_case(cameras, table(24))
    return found


def smooth_volume(n: int = 48) -> jvr.Volume:
    """Waves of about two periods, values 0 ... 1 in steps of 1/255, which VTK's ray caster holds exactly."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    values = np.sin(4 * x + y) + np.cos(3 * y - 2 * z) + np.sin(4 * z + x * y)
    return jvr.Volume((np.round(255 * (values - values.min()) / np.ptp(values)) / 255).astype(np.float32))


def table(entries: int, scale: float = 0.15, bounds: bool = False, coloured: bool = False) -> jvr.LutTransfer:
    """Random entries; with `bounds` every other colour is 0 or 1 and every third entry transparent."""
    rng = np.random.default_rng(entries)
    rgb, sigma_t = rng.random((entries, 3)), scale * rng.random((entries, 3) if coloured else entries) ** 2
    if bounds:
        rgb[::2], sigma_t[::3] = np.round(rgb[::2]), 0.0
    return jvr.LutTransfer(rgb, sigma_t, DOMAIN)


def vtk_case(cameras: tuple[jvr.PerspectiveCamera, ...], transfer: jvr.LutTransfer) -> Case:
    """VTK's pictures, in 8 bits. Its rays are up to half a pixel beside ours: the truth is not in the model."""
    import vtk
    from vtkmodules.util import numpy_support

    volume = smooth_volume()
    data = vtk.vtkImageData()
    data.SetDimensions(*volume.shape)
    voxels = np.round(255 * np.asarray(volume.values)).astype(np.uint8)
    data.GetPointData().SetScalars(numpy_support.numpy_to_vtk(voxels.ravel(order="F"), deep=True))
    look, colour, opacity = vtk.vtkVolumeProperty(), vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
    rgb, sigma_t = (np.asarray(array, float) for array in UNKNOWNS(jvr.Scene(volume, transfer)))
    positions = 255 * np.asarray(transfer.positions, float)
    for s in range(256):
        colour.AddRGBPoint(s, *(np.interp(s, positions, rgb[:, c]) for c in range(3)))
        # Opacity of a unit length, at every scalar: it is not linear between entries where extinction is.
        opacity.AddPoint(s, 1 - np.exp(-np.interp(s, positions, sigma_t)))
    look.SetColor(colour)
    look.SetScalarOpacity(opacity)
    look.SetInterpolationTypeToLinear()
    mapper = vtk.vtkFixedPointVolumeRayCastMapper()
    mapper.SetInputData(data)
    mapper.SetAutoAdjustSampleDistances(False)
    mapper.SetImageSampleDistance(1.0)
    mapper.SetSampleDistance(0.5)
    actor, renderer, window = vtk.vtkVolume(), vtk.vtkRenderer(), vtk.vtkRenderWindow()
    actor.SetMapper(mapper)
    actor.SetProperty(look)
    renderer.AddVolume(actor)
    renderer.SetBackground(*BACKGROUND)
    window.SetOffScreenRendering(True)
    window.SetMultiSamples(0)
    window.SetSize(cameras[0].width, cameras[0].height)
    window.AddRenderer(renderer)
    images = [_vtk_picture(window, renderer, camera, np.asarray(volume.center, float)) for camera in cameras]
    return Case(jvr.Scene(volume, transfer, background=BACKGROUND), cameras, images)


def _vtk_picture(window: Any, renderer: Any, camera: jvr.PerspectiveCamera, center: np.ndarray) -> np.ndarray:
    import vtk
    from vtkmodules.util import numpy_support

    pose = np.asarray(camera.world_from_camera, float)
    view = renderer.GetActiveCamera()
    view.SetPosition(*pose[:3, 3])
    view.SetFocalPoint(*center)
    view.SetViewUp(*pose[:3, 1])
    view.SetViewAngle(FOV)
    renderer.ResetCameraClippingRange()
    window.Render()
    reader = vtk.vtkWindowToImageFilter()
    reader.SetInput(window)
    reader.ReadFrontBufferOff()
    reader.Update()
    pixels = numpy_support.vtk_to_numpy(reader.GetOutput().GetPointData().GetScalars())
    # VTK's row 0 is at the bottom.
    return (pixels.reshape(camera.height, camera.width, 3)[::-1] / 255).astype(np.float32)


def flat(scene: jvr.Scene) -> np.ndarray:
    """The table as one vector in float64."""
    return np.concatenate([np.ravel(array) for array in UNKNOWNS(scene)]).astype(np.float64)


class Residuals:
    """The residuals of a case and their Jacobian at a flat table, compressed by an orthogonal transform.

    With `[J | r] = Q R`, the last column of `R` and the columns before it have the lengths and the products of `r` and `J`, which is all
    that least squares sees of them; a decomposition of `J` in every step would take SciPy minutes.
    """

    def __init__(self, case: Case):
        shapes = [array.shape for array in UNKNOWNS(case.scene)]
        split = int(np.prod(shapes[0]))

        def residuals(x: jax.Array) -> jax.Array:
            parts = x[:split].reshape(shapes[0]), x[split:].reshape(shapes[1])
            return jnp.ravel(
                jnp.asarray(jvr.residuals(eqx.tree_at(UNKNOWNS, case.scene, parts), case.cameras, case.images, ROWS))
            )

        self._value, self._rows = jax.jit(residuals), jax.jit(jax.jacfwd(residuals))
        self._at, self._factor = b"", np.zeros((0, 0))

    def mean_square(self, scene: jvr.Scene) -> float:
        return float(np.mean(np.square(np.asarray(self._value(jnp.asarray(flat(scene), jnp.float32)), np.float64))))

    def compressed(self, x: np.ndarray) -> np.ndarray:
        if self._at != x.tobytes():
            point = jnp.asarray(x, jnp.float32)
            both = np.column_stack([np.asarray(self._rows(point), np.float64), np.asarray(self._value(point), np.float64)])
            self._at, self._factor = x.tobytes(), np.asarray(np.linalg.qr(both, mode="r"))
        return self._factor

    def value(self, x: np.ndarray) -> np.ndarray:
        return self.compressed(x)[:, -1]

    def rows(self, x: np.ndarray) -> np.ndarray:
        return self.compressed(x)[:, :-1]


def ours(case: Case, seed: int, residuals: Residuals) -> dict[str, Any]:
    """Our fit from one start; samples are not kept, so that its residuals are those that SciPy has."""
    keywords: dict[str, Any] = {"unknowns": UNKNOWNS, "settings": SETTINGS, "progress": False, "keep_samples": False}
    result = jvr.fit(case.start(seed), case.cameras, case.images, **keywords)
    return {
        "start": seed,
        "mse": residuals.mean_square(result.scene),
        "steps": len(result.history),
        "outcome": result.outcome.name,
        "history": [entry.loss for entry in result.history],
    }


def scipys(case: Case, seed: int, residuals: Residuals) -> dict[str, Any]:
    """SciPy's trust-region reflective method with colours in 0 ... 1 and extinctions not negative."""
    x = flat(case.start(seed))
    upper = np.where(np.arange(x.size) < UNKNOWNS(case.scene)[0].size, 1.0, np.inf)
    bounds, rows = (np.zeros_like(x), upper), cast(Any, residuals.rows)
    found = scipy.optimize.least_squares(residuals.value, x, rows, bounds, method="trf", x_scale="jac", ftol=1e-4, max_nfev=60)
    count = 3 * sum(image.shape[0] * image.shape[1] for image in case.images)
    mse = 2 * float(found.cost) / count
    return {"start": seed, "mse": mse, "steps": int(found.nfev), "status": found.message}


def run(case: Case, starts: int, references: int) -> dict[str, Any]:
    """All fits of one scene, with a line of progress for each on stderr."""
    residuals, ends = Residuals(case), {"jvr": [], "scipy": []}
    for name, method, count in (("jvr", ours, starts), ("scipy", scipys, references)):
        for seed in range(count):
            began = time.perf_counter()
            end = method(case, seed, residuals)
            ends[name].append(end)
            seconds = time.perf_counter() - began
            print(f"  {name} {seed}: {end['mse']:.4e}, {end['steps']} steps, {seconds:.1f} s", file=sys.stderr, flush=True)
    best = min(end["mse"] for end in (*ends["jvr"], *ends["scipy"]))
    at_bottom = lambda end: end["mse"] <= max(NEAR * best, FLOOR)
    return {
        "best": best,
        "at_bottom": float(np.mean([at_bottom(end) for end in ends["jvr"]])),
        "scipy_at_bottom": float(np.mean([at_bottom(end) for end in ends["scipy"]])),
        "median_steps": float(np.median([end["steps"] for end in ends["jvr"]])),
        "scipy_median_steps": float(np.median([end["steps"] for end in ends["scipy"]])),
        "falsely_converged": sum(end["outcome"] == "CONVERGED" and not at_bottom(end) for end in ends["jvr"]),
        "worst": max(end["mse"] for end in ends["jvr"]) / best,
        **ends,
    }


def figure(report: dict[str, Any], path: str) -> None:
    """The objective over steps, from every start of every scene, and SciPy's ends."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(12, 5.6), layout="constrained")
    panels = drawing.subplots(2, 4, sharex=True).ravel()
    for axes, (name, found) in zip(panels, report.items(), strict=False):
        for end in found["jvr"]:
            axes.plot(range(1, end["steps"] + 1), end["history"], color="C0", lw=0.8, alpha=0.6)
            axes.plot(end["steps"], end["mse"], ".", color="C0", ms=4)
        for end in found["scipy"]:
            axes.axhline(end["mse"], color="C1", lw=1.0, ls="--")
        axes.set(
            yscale="log", title=f"{name}: {found['at_bottom']:.0%} at the bottom", ylim=(max(0.3 * found["best"], 1e-10), 0.1)
        )
    for axes in panels[len(report) :]:
        axes.set_axis_off()
    drawing.supxlabel("steps from 20 starts (blue); dashed: where SciPy's bounded least squares ends")
    drawing.supylabel("mean squared error")
    drawing.savefig(path, dpi=130)


def main() -> None:
    """Runs the scenes, prints a line for each, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE")
    parser.add_argument("--only", nargs="+", metavar="SCENE", help="some of the scenes")
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--references", type=int, default=3, help="starts from which SciPy is run, too")
    parser.add_argument("--quick", action="store_true", help="two scenes, small pictures, two starts")
    a = parser.parse_args()
    if a.quick:
        a.only, a.starts, a.references = a.only or ["random", "noise"], 2, 1
    makers = cases(12 if a.quick else 32)
    report = {}
    print(f"{'scene':<14}{'best':>10}{'at bottom':>11}{'worst':>8}{'steps':>7}{'SciPy at bottom':>17}{'steps':>7}")
    for name in a.only or makers:
        report[name] = found = run(makers[name](), a.starts, a.references)
        print(
            f"{name:<14}{found['best']:>10.2e}{found['at_bottom']:>11.0%}{found['worst']:>8.3f}{found['median_steps']:>7.0f}"
            f"{found['scipy_at_bottom']:>17.0%}{found['scipy_median_steps']:>7.0f}",
            flush=True,
        )
        if a.json:
            Path(a.json).write_text(json.dumps(report, indent=1) + "\n")
    if a.figure:
        figure(report, a.figure)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
