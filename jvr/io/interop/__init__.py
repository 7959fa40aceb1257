"""Cameras and presets of other programs, none of which is imported: `from jvr.io import interop`."""

from jvr.io.interop.camera_files import read_cameras as read_cameras
from jvr.io.interop.cameras import CameraError as CameraError
from jvr.io.interop.cameras import from_opencv as from_opencv
from jvr.io.interop.cameras import from_paraview as from_paraview
from jvr.io.interop.cameras import from_vtk as from_vtk
from jvr.io.interop.cameras import to_opencv as to_opencv
from jvr.io.interop.cameras import to_vtk as to_vtk
from jvr.io.interop.opacity import extinction_from_opacity as extinction_from_opacity
from jvr.io.interop.opacity import opacity_from_extinction as opacity_from_extinction
from jvr.io.interop.paraview import read_paraview as read_paraview
from jvr.io.interop.paraview import write_paraview as write_paraview
from jvr.io.interop.preset_files import PresetError as PresetError
from jvr.io.interop.presets import Preset as Preset
from jvr.io.interop.slicer import read_slicer as read_slicer
from jvr.io.interop.slicer import slicer_preset as slicer_preset
from jvr.io.interop.slicer import slicer_presets as slicer_presets
from jvr.io.interop.slicer import write_slicer as write_slicer
from jvr.io.interop.transforms import read_transforms as read_transforms
from jvr.io.interop.vtk_property import from_vtk_property as from_vtk_property
from jvr.io.interop.vtk_property import to_vtk_property as to_vtk_property
