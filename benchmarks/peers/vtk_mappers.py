"""VTK: its fixed-point ray caster on the CPU, and its GPU mapper on the software rasteriser."""

import numpy as np
import vtk
from vtkmodules.util import numpy_support

from benchmarks.peers.errors import rmse
from benchmarks.peers.scenes import Scene
from benchmarks.peers.settings import THREADS

# Looking for a display that is not there is no news.
vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_ERROR)


def version() -> str:
    return vtk.vtkVersion.GetVTKVersion()


class _Window:
    """One scene in an off-screen window."""

    def __init__(self, scene: Scene, mapper: vtk.vtkFixedPointVolumeRayCastMapper | vtk.vtkGPUVolumeRayCastMapper):
        self.scene, self.mapper, self.look = scene, mapper, vtk.vtkVolumeProperty()
        self.mapper.SetInputData(image_data(scene.voxels, scene.spacing, scene.origin))
        self.look.SetInterpolationTypeToLinear()
        self.look.ShadeOff()
        volume, renderer, self.window = vtk.vtkVolume(), vtk.vtkRenderer(), vtk.vtkRenderWindow()
        volume.SetMapper(mapper)
        volume.SetProperty(self.look)
        renderer.AddVolume(volume)
        renderer.SetBackground(0, 0, 0)
        self.window.SetOffScreenRendering(True)
        self.window.SetMultiSamples(0)
        self.window.SetSize(scene.view.width, scene.view.height)
        self.window.AddRenderer(renderer)
        _place(renderer, scene)

    def prepare(self, step: float) -> None:
        """Opacity is that of one sample distance, so that VTK has nothing to correct."""
        distance = step * min(self.scene.spacing)
        self.mapper.SetSampleDistance(distance)
        colour, opacity = _functions(self.scene, distance)
        self.look.SetColor(colour)
        self.look.SetScalarOpacity(opacity)
        self.look.SetScalarOpacityUnitDistance(distance)

    def draw(self) -> None:
        self.window.Render()
        self.window.WaitForCompletion()

    def picture(self) -> np.ndarray:
        return shown(self.window)


def shown(window: vtk.vtkRenderWindow) -> np.ndarray:
    """What a window shows, row 0 at the top."""
    reader = vtk.vtkWindowToImageFilter()
    reader.SetInput(window)
    reader.ReadFrontBufferOff()
    reader.ShouldRerenderOff()
    reader.Update()
    scalars = numpy_support.vtk_to_numpy(reader.GetOutput().GetPointData().GetScalars())
    width, height = window.GetSize()
    return scalars.reshape(height, width, 3)[::-1] / 255


class Renderer(_Window):
    """`vtkFixedPointVolumeRayCastMapper`."""

    def __init__(self, scene: Scene):
        mapper = vtk.vtkFixedPointVolumeRayCastMapper()
        mapper.SetAutoAdjustSampleDistances(False)
        mapper.SetImageSampleDistance(1.0)
        mapper.SetNumberOfThreads(THREADS)
        super().__init__(scene, mapper)
        self.rays = mapper

    def error(self, reference: np.ndarray) -> float:
        return rmse(self.picture(), self.shown(reference))

    def shown(self, picture: np.ndarray) -> np.ndarray:
        """A picture as VTK shows its own.

        The mapper casts rays through the centres of pixels, but only in the rectangle that the volume covers, and draws these `n`
        colours as a texture whose outer texels sit on the edges of the rectangle: stretched by `n / (n - 1)`.
        """
        image = self.rays.GetRayCastImage()
        (width, height), (left, bottom) = image.GetImageInUseSize(), image.GetImageOrigin()
        return _stretch(_stretch(picture[::-1], 0, bottom, height), 1, left, width)[::-1]


class GpuRenderer(_Window):
    """`vtkGPUVolumeRayCastMapper`, whatever OpenGL this machine has; without a graphics card that is Mesa's rasteriser."""

    def __init__(self, scene: Scene):
        mapper = vtk.vtkGPUVolumeRayCastMapper()
        mapper.SetAutoAdjustSampleDistances(False)
        mapper.SetImageSampleDistance(1.0)
        mapper.UseJitteringOff()
        super().__init__(scene, mapper)

    def error(self, reference: np.ndarray) -> float:
        return rmse(self.picture(), reference)

    def device(self) -> str:
        report = self.window.ReportCapabilities()
        return next((line.split(":", 1)[1].strip() for line in report.splitlines() if "renderer string" in line), "unknown")


def image_data(voxels: np.ndarray, spacing: tuple[float, ...], origin: tuple[float, ...]) -> vtk.vtkImageData:
    data = vtk.vtkImageData()
    data.SetDimensions(*voxels.shape)
    data.SetSpacing(*spacing)
    data.SetOrigin(*origin)
    data.GetPointData().SetScalars(numpy_support.numpy_to_vtk(voxels.ravel(order="F"), deep=True))
    return data


def _functions(scene: Scene, distance: float) -> tuple[vtk.vtkColorTransferFunction, vtk.vtkPiecewiseFunction]:
    """The table as VTK's two functions. Opacity is not linear between entries where extinction is, hence sixteen points for each."""
    low, high = scene.domain
    at = np.linspace(low, high, len(scene.sigma_t))
    fine = np.linspace(low, high, 16 * (len(at) - 1) + 1)
    alpha = -np.expm1(-np.interp(fine, at, scene.sigma_t) * distance)
    colour, opacity = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
    for s, rgb in zip(at, scene.rgb, strict=True):
        colour.AddRGBPoint(s, *rgb)
    opacity.FillFromDataPointer(len(fine), np.stack([fine, alpha], axis=1).ravel().tolist())
    return colour, opacity


def _stretch(picture: np.ndarray, axis: int, start: int, count: int) -> np.ndarray:
    """Pixels `start ... start + count - 1` as texels that reach to the edges of what they cover; black outside."""
    at = (np.arange(picture.shape[axis]) + 0.5 - start) / count * (count - 1)
    inside = (at >= 0) & (at <= count - 1)
    below = np.clip(at.astype(int), 0, count - 2)
    column = lambda x: np.expand_dims(x, [other for other in range(3) if other != axis])
    low, high = np.take(picture, start + below, axis), np.take(picture, start + below + 1, axis)
    return (low + column(at - below) * (high - low)) * column(inside)


def _place(renderer: vtk.vtkRenderer, scene: Scene) -> None:
    camera = renderer.GetActiveCamera()
    camera.SetPosition(*scene.view.eye)
    camera.SetFocalPoint(*scene.view.target)
    camera.SetViewUp(*scene.view.up)
    camera.SetViewAngle(scene.view.fov_y)
    renderer.ResetCameraClippingRange()
