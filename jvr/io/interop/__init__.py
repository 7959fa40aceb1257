"""Cameras and presets of other programs, none of which is imported: `from jvr.io import interop`."""

from jvr.io.interop.cameras import CameraError as CameraError
from jvr.io.interop.cameras import from_opencv as from_opencv
from jvr.io.interop.cameras import from_paraview as from_paraview
from jvr.io.interop.cameras import from_vtk as from_vtk
from jvr.io.interop.cameras import to_opencv as to_opencv
from jvr.io.interop.cameras import to_vtk as to_vtk
from jvr.io.interop.transforms import read_transforms as read_transforms
