"""The same scene in VTK's fixed-point ray caster (`vtkFixedPointVolumeRayCastMapper`), whose pictures have 8 bits.

Where VTK's rays go is not where pixel centres are: its `N` rays across span the view from edge to edge and are drawn as a
texture, so that the picture is stretched by one pixel and each pixel is the mean of the four rays at its corners. (Least squares
over the terms of such an error gives 1.02 and 1.03 pixels, and 0.13 times the Laplacian, which is 1/8 for a shift by half a
pixel.) The test renders those rays.

What remains, as parts of 1: 1/255 where colours are rounded to 8 bits; 255/32767 = 0.008 where rays end early; 2^-15 for each
of up to 100 samples of 15 bits, 0.003; the scalar is rounded to a whole number, a relative error of the extinction of up to
0.5/70 that is mostly averaged out along a ray, 0.004. Together 0.02 at most, and in the mean over the picture mostly the first.
"""

import jax
import numpy as np
import pytest
from scenes import affine

import jvr

vtk = pytest.importorskip("vtk", reason="needs the optional package vtk")
arrays = pytest.importorskip("vtk.util.numpy_support")

SPACING, ORIGIN = (1.0, 1.5, 0.75), (-4.0, 7.0, 3.0)
EYE, UP, FOV = (30.0, -20.0, 38.0), (0.1, 0.2, 1.0), 26.0
SIZE = 64
STEP = 0.5
SIGMA = 0.35


def _voxels():
    """Three blurred balls, so that a picture upside down or mirrored is another one."""
    x, y, z = np.meshgrid(np.arange(24), np.arange(17), np.arange(29), indexing="ij")
    ball = lambda a, b, c, r: np.exp(-(((x - a) / r) ** 2 + ((y - b) / r) ** 2 + ((z - c) / r) ** 2))
    field = ball(8, 6, 9, 5) + 0.8 * ball(17, 10, 20, 4) + 0.6 * ball(15, 4, 6, 3)
    return np.round(255 * np.clip(field, 0, 1)).astype(np.uint8)


POSITIONS = [20.0, 90.0, 160.0, 255.0]
RGB = np.array([[0.1, 0.2, 0.9], [0.2, 0.9, 0.3], [0.9, 0.6, 0.1], [1.0, 1.0, 0.9]])
SIGMA_T = SIGMA * np.array([0.0, 0.3, 0.6, 1.0])


def _vtk_picture(voxels):
    data = vtk.vtkImageData()
    data.SetDimensions(*voxels.shape)
    data.SetSpacing(*SPACING)
    data.SetOrigin(*ORIGIN)
    data.GetPointData().SetScalars(arrays.numpy_to_vtk(voxels.ravel(order="F"), deep=True, array_type=vtk.VTK_UNSIGNED_CHAR))

    colour, opacity = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
    for s, rgb in zip(POSITIONS, RGB, strict=True):
        colour.AddRGBPoint(s, *rgb)
    unit = 1.0
    # Opacity of a unit length, at every scalar: opacity is not linear between control points where extinction is.
    for s in range(256):
        opacity.AddPoint(s, 1 - np.exp(-unit * np.interp(s, POSITIONS, SIGMA_T)))
    look = vtk.vtkVolumeProperty()
    look.SetColor(colour)
    look.SetScalarOpacity(opacity)
    look.SetScalarOpacityUnitDistance(unit)
    look.SetInterpolationTypeToLinear()
    look.ShadeOff()

    mapper = vtk.vtkFixedPointVolumeRayCastMapper()
    mapper.SetInputData(data)
    mapper.SetAutoAdjustSampleDistances(False)
    mapper.SetImageSampleDistance(1.0)
    mapper.SetSampleDistance(STEP * min(SPACING))
    mapper.SetNumberOfThreads(1)
    volume = vtk.vtkVolume()
    volume.SetMapper(mapper)
    volume.SetProperty(look)

    renderer, window = vtk.vtkRenderer(), vtk.vtkRenderWindow()
    renderer.AddVolume(volume)
    renderer.SetBackground(0, 0, 0)
    camera = renderer.GetActiveCamera()
    camera.SetPosition(*EYE)
    camera.SetFocalPoint(*_target(voxels))
    camera.SetViewUp(*UP)
    camera.SetViewAngle(FOV)
    renderer.ResetCameraClippingRange()
    window.SetOffScreenRendering(True)
    window.SetMultiSamples(0)
    window.SetSize(SIZE, SIZE)
    window.AddRenderer(renderer)
    window.Render()
    reader = vtk.vtkWindowToImageFilter()
    reader.SetInput(window)
    reader.ReadFrontBufferOff()
    reader.Update()
    pixels = arrays.vtk_to_numpy(reader.GetOutput().GetPointData().GetScalars()).reshape(SIZE, SIZE, 3)
    # VTK's row 0 is at the bottom.
    return pixels[::-1].astype(float) / 255


def _target(voxels):
    return [o + s * (n - 1) / 2 for o, s, n in zip(ORIGIN, SPACING, voxels.shape, strict=True)]


@pytest.mark.slow
def test_vtk_sees_the_same():
    voxels = _voxels()
    theirs = _vtk_picture(voxels)
    volume = jvr.Volume(voxels, affine(SPACING, ORIGIN))
    # VTK's rays, at the corners of pixels that are stretched by N / (N - 1).
    half = np.tan(np.deg2rad(FOV / 2)) * (SIZE - 1) / SIZE * (SIZE + 1) / SIZE
    fov_y = np.rad2deg(2 * np.arctan(half))
    camera = jvr.PerspectiveCamera.look_at(EYE, _target(voxels), UP, fov_y, SIZE + 1, SIZE + 1)
    scene = jvr.Scene(volume, jvr.LinearTransfer(POSITIONS, RGB, SIGMA_T), background=(0, 0, 0))
    rays = np.asarray(jax.jit(jvr.render)(scene, camera, jvr.Settings(STEP)).rgb)
    ours = (rays[1:, 1:] + rays[:-1, 1:] + rays[1:, :-1] + rays[:-1, :-1]) / 4
    error = np.abs(theirs - ours)
    assert error.max() < 0.02
    assert error.mean() < 1 / 255
    # The picture has something to compare, and is not its own mirror image.
    assert ours.max() > 0.7
    for mirrored in (theirs[::-1], theirs[:, ::-1], theirs[::-1, ::-1]):
        assert np.abs(mirrored - ours).max() > 0.3
