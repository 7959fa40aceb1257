"""VTK's `vtkVolumeProperty`, handed in by whoever has VTK: read and filled through its own methods."""

from typing import Any

import numpy as np

from jvr.io.interop.curves import Curve
from jvr.io.interop.presets import Preset, VolumeProperty, preset_of, property_of, warn_of

SPACES = ("RGB", "HSV", "Lab", "Diverging", "Lab/CIEDE2000", "Step", "ProLab")
INTERPOLATIONS = ("nearest", "linear", "cubic")


def from_vtk_property(property: Any, *, spacing: float | int = 1.0, encoding: str = "linear") -> Preset:
    """What jvr makes of a `vtkVolumeProperty` (PyVista's `actor.prop`, Slicer's `node.GetVolumeProperty()`), its first component.

    **Arguments:** `spacing`: the mean distance of the voxels, to which VTK's lengths of gradients belong; `encoding`: `"linear"` takes its
    colours for light, as pictures of VTK that are read so have it, `"srgb"` makes light of them, so that a picture of jvr on a screen has
    VTK's colours. **Returns** a preset whose opacities and colours are VTK's to 1/512; what is not kept is in its `lost`, and said in one
    warning. Its shading is `jvr.Phong`, that of VTK's mapper on the graphics card; the one on the processor has `jvr.BlinnPhong`.
    **Raises** `TypeError` for what is no volume property, `ValueError` for transfer functions of two dimensions.
    """
    if not all(hasattr(property, name) for name in ("GetScalarOpacity", "GetRGBTransferFunction", "GetShade")):
        raise TypeError(f"from_vtk_property takes a vtkVolumeProperty, not {type(property).__name__}")
    if _answer(property, "GetTransferFunctionMode", 0) == 1:
        raise ValueError("the property has a transfer function of two dimensions: set its mode to 1D")
    lost: dict[str, str] = {}
    said = VolumeProperty(
        _curve(property.GetScalarOpacity(), 1),
        _colours(property, lost),
        None if _answer(property, "GetDisableGradientOpacity", 0) else _curve(property.GetGradientOpacity(), 1),
        property.GetScalarOpacityUnitDistance(),
        bool(property.GetShade()),
        property.GetAmbient(),
        property.GetDiffuse(),
        property.GetSpecular(),
        property.GetSpecularPower(),
        INTERPOLATIONS[min(property.GetInterpolationType(), 2)],
        lost,
    )
    if not _answer(property, "GetIndependentComponents", 1):
        lost["dependent components"] = "the first one is taken for a scalar"
    if _answer(property, "GetNumberOfLabels", 0):
        lost["functions of labels"] = "those of the volume are taken"
    if _answer(property, "GetScatteringAnisotropy", 0.0):
        lost["scattering"] = "no light is scattered"
    preset = preset_of(said, spacing, encoding)
    warn_of(preset.lost, "vtkVolumeProperty")
    return preset


def _answer(asked: Any, method: str, default: Any) -> Any:
    """Older versions of VTK have not all of its methods."""
    return getattr(asked, method)() if hasattr(asked, method) else default


def _colours(property: Any, lost: dict[str, str]) -> Curve:
    if property.GetColorChannels() == 1:
        return _curve(property.GetGrayTransferFunction(), 1)
    function = property.GetRGBTransferFunction()
    space = SPACES[function.GetColorSpace()]
    if space == "Lab/CIEDE2000":
        lost[f"colours through {space}"] = "through Lab instead"
        space = "Lab"
    return _curve(function, 3, space=space, wrap=bool(function.GetHSVWrap()), logarithmic=function.GetScale() == 1)


def _curve(function: Any, channels: int, **keywords: Any) -> Curve:
    """Of a `vtkPiecewiseFunction` or a `vtkColorTransferFunction`."""
    rows = np.empty((function.GetSize(), channels + 3))
    for i, row in enumerate(rows):
        node = [0.0] * (channels + 3)
        function.GetNodeValue(i, node)
        row[:] = node
    for side, name in (("below", "Below"), ("above", "Above")):
        if _answer(function, f"GetUse{name}RangeColor", 0):
            keywords[side] = np.array(getattr(function, f"Get{name}RangeColor")())
        elif not function.GetClamping():
            keywords[side] = np.zeros(channels)
    keywords.setdefault("logarithmic", bool(_answer(function, "GetUseLogScale", 0)))
    return Curve.of(rows, **keywords)


def to_vtk_property(preset: Preset, property: Any) -> dict[str, str]:
    """Fills a `vtkVolumeProperty` with a preset, such as `jvr.io.interop.Preset(scene.transfer, scene.shading)`.

    Its functions of opacity, colour and gradient are emptied and filled, for opacities over `preset.unit_distance`.
    **Returns** what VTK does not hold, by name, which is said in one warning as well.
    **Raises** `ValueError` for transfer functions of more than the scalar, but for `jvr.GradientOpacity`.
    """
    said = property_of(preset)
    _fill(property.GetScalarOpacity(), said.opacity)
    _fill(property.GetGradientOpacity(), said.gradient or Curve.of(np.array([[0, 1], [255, 1]]), shaped=False))
    colour = property.GetRGBTransferFunction()
    colour.SetColorSpaceToRGB()
    colour.SetScaleToLinear()
    colour.SetUseBelowRangeColor(False)
    colour.SetUseAboveRangeColor(False)
    _fill(colour, said.colour)
    property.SetColor(colour)
    property.SetScalarOpacityUnitDistance(said.unit_distance)
    property.SetShade(said.shade)
    for name, value in (("Ambient", said.ambient), ("Diffuse", said.diffuse), ("Specular", said.specular)):
        getattr(property, f"Set{name}")(value)
    property.SetSpecularPower(said.power)
    property.SetInterpolationType(INTERPOLATIONS.index(said.interpolation))
    warn_of(said.lost, "vtkVolumeProperty")
    return said.lost


def _fill(function: Any, curve: Curve) -> None:
    function.RemoveAllPoints()
    function.SetClamping(True)
    if hasattr(function, "SetUseLogScale"):
        function.SetUseLogScale(False)
    add = function.AddRGBPoint if curve.values.shape[1] == 3 else function.AddPoint
    for row in curve.rows():
        add(*map(float, row))
