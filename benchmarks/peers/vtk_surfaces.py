"""VTK's isosurfaces: its GPU mapper in isosurface mode on the software rasteriser, and flying edges drawn as triangles."""

from typing import Any

import numpy as np
import vtk

from benchmarks.peers.vtk_mappers import image_data, shown


class _Window:
    """One actor in an off-screen window, lit from the eye."""

    def __init__(self, view: dict[str, Any], size: int):
        self.renderer, self.window = vtk.vtkRenderer(), vtk.vtkRenderWindow()
        self.renderer.SetBackground(0, 0, 0)
        self.window.SetOffScreenRendering(True)
        self.window.SetMultiSamples(0)
        self.window.SetSize(size, size)
        self.window.AddRenderer(self.renderer)
        camera = self.renderer.GetActiveCamera()
        camera.SetPosition(*view["eye"])
        camera.SetFocalPoint(*view["target"])
        camera.SetViewUp(*view["up"])
        camera.SetViewAngle(view["fov_y"])

    def draw(self) -> None:
        # Else nothing is drawn again that has been.
        self.renderer.Modified()
        self.window.Render()
        self.window.WaitForCompletion()

    def picture(self) -> np.ndarray:
        return shown(self.window)


class IsosurfaceMapper(_Window):
    """`vtkGPUVolumeRayCastMapper` in isosurface mode, a sample each voxel."""

    def __init__(self, voxels: np.ndarray, value: float, view: dict[str, Any], size: int):
        super().__init__(view, size)
        mapper, look, volume = vtk.vtkGPUVolumeRayCastMapper(), vtk.vtkVolumeProperty(), vtk.vtkVolume()
        mapper.SetInputData(image_data(voxels, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)))
        mapper.SetAutoAdjustSampleDistances(False)
        mapper.SetSampleDistance(1.0)
        mapper.UseJitteringOff()
        mapper.SetBlendModeToIsoSurface()
        colour, opacity = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
        colour.AddRGBPoint(value, 0.7, 0.7, 0.7)
        opacity.AddPoint(value, 1.0)
        look.SetColor(colour)
        look.SetScalarOpacity(opacity)
        look.SetInterpolationTypeToLinear()
        look.ShadeOn()
        look.GetIsoSurfaceValues().SetValue(0, value)
        volume.SetMapper(mapper)
        volume.SetProperty(look)
        self.renderer.AddVolume(volume)
        self.renderer.ResetCameraClippingRange()


class FlyingEdges(_Window):
    """`vtkFlyingEdges3D` and its triangles, with normals."""

    def __init__(self, voxels: np.ndarray, value: float, view: dict[str, Any], size: int):
        super().__init__(view, size)
        self.edges, mapper, actor = vtk.vtkFlyingEdges3D(), vtk.vtkPolyDataMapper(), vtk.vtkActor()
        self.edges.SetInputData(image_data(voxels, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)))
        self.edges.SetValue(0, value)
        self.edges.ComputeNormalsOn()
        mapper.SetInputConnection(self.edges.GetOutputPort())
        mapper.ScalarVisibilityOff()
        actor.SetMapper(mapper)
        self.renderer.AddActor(actor)
        self.renderer.ResetCameraClippingRange()

    def draw_anew(self) -> None:
        """With extraction."""
        self.edges.Modified()
        self.draw()
