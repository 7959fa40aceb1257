"""VTK's own formats: legacy structured points (.vtk) and XML image data (.vti).

ITK reads a legacy file whose first array is scalar (it knows ASPECT_RATIO, swaps the big-endian bytes and leaves the
arrays behind it), but fills up what is missing from a file that was cut short. Everything else goes through VTK.
"""

import dataclasses
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.errors import VolumeError, check_size, first_bytes, grid_numbers, grid_shape, mislabelled, missing_extra
from jvr.io.volumes.given import Given
from jvr.io.volumes.itk import read_image, silenced
from jvr.io.volumes.stored import Stored, affine_of

SCALARS = {"char": 1, "unsigned_char": 1, "short": 2, "unsigned_short": 2, "int": 4, "unsigned_int": 4}
SCALARS |= {"long": 8, "unsigned_long": 8, "float": 4, "double": 8}


@dataclasses.dataclass
class _Legacy:
    text: bool
    fields: dict[str, list[str]]
    attribute: list[str]
    data_offset: int


def read_legacy_vtk(path: Path, given: Given) -> Stored:
    """A legacy VTK file of structured points; `array` names one where a file holds several."""
    start, array = first_bytes(path), given.array
    if not start.startswith(b"# vtk DataFile"):
        raise mislabelled(path, start, "a legacy VTK file (its first line begins with '# vtk DataFile')")
    legacy = _legacy_header(path, start)
    shape = grid_shape(path, "DIMENSIONS", legacy.fields["DIMENSIONS"])
    for key in {"SPACING", "ASPECT_RATIO"} & legacy.fields.keys():
        grid_numbers(path, key, legacy.fields[key], positive=True)
    grid_numbers(path, "ORIGIN", legacy.fields.get("ORIGIN", ["0"]), positive=False)
    keyword, name, kind, components = [*legacy.attribute, "", "", "1", ""][:4]
    remaining = path.stat().st_size - legacy.data_offset
    if "CELL_DATA" in legacy.fields:
        check_size(path, [max(n - 1, 1) for n in shape], 1, remaining)
    elif keyword.upper() == "SCALARS" and kind.lower() in SCALARS and components in ("", "1") and array in (None, name):
        itemsize = SCALARS[kind.lower()]
        check_size(path, shape, itemsize, remaining * itemsize if legacy.text else remaining)
        if legacy.text:
            _check_text(path, legacy.data_offset, math.prod(shape))
        return read_image(path, "VTKImageIO")
    check_size(path, shape, 1, remaining)
    reader = _vtk_reader(path, "vtkIOLegacy", "vtkStructuredPointsReader")
    for every in ("Scalars", "Vectors", "Fields", "Tensors", "Normals", "TCoords", "ColorScalars"):
        getattr(reader, f"ReadAll{every}On")()
    return _from_vtk(path, reader, array)


def _legacy_header(path: Path, start: bytes) -> _Legacy:
    """The lines up to the first array; the data begin behind them and behind the name of a lookup table."""
    lines = re.findall(rb"[^\n]*\n", start)
    # Line 2 is a title, which may be blank; blank lines behind it mean nothing.
    third = next((k for k, line in enumerate(lines) if k > 1 and line.strip()), len(lines))
    encoding = lines[third].strip().upper() if third < len(lines) else b""
    if encoding not in (b"ASCII", b"BINARY"):
        raise VolumeError(path, f"line 3 is '{encoding[:40].decode('latin-1')}'; it must be ASCII or BINARY")
    fields, offset = {}, sum(len(line) for line in lines[: third + 1])
    for k, line in enumerate(lines[third + 1 :], start=third + 1):
        offset += len(line)
        words = line.decode("latin-1").split()
        if not words:
            continue
        if words[0].upper() in ("SCALARS", "VECTORS", "NORMALS", "TENSORS", "FIELD", "COLOR_SCALARS", "TEXTURE_COORDINATES"):
            if "POINT_DATA" in fields or "CELL_DATA" in fields:
                table = lines[k + 1] if k + 1 < len(lines) and lines[k + 1].upper().startswith(b"LOOKUP_TABLE") else b""
                return _checked(path, _Legacy(encoding == b"ASCII", fields, words, offset + len(table)))
            continue
        fields[words[0].upper()] = words[1:]
    return _checked(path, _Legacy(encoding == b"ASCII", fields, [], offset))


def _checked(path: Path, legacy: _Legacy) -> _Legacy:
    kind = " ".join(legacy.fields.get("DATASET", ["missing"])).upper()
    if kind != "STRUCTURED_POINTS":
        raise VolumeError(path, f"DATASET is {kind}; only STRUCTURED_POINTS is a volume: resample it to image data")
    if "DIMENSIONS" not in legacy.fields or not legacy.attribute:
        wanted = "DIMENSIONS" if "DIMENSIONS" not in legacy.fields else "POINT_DATA with an array such as SCALARS"
        raise VolumeError(path, f"the header lacks {wanted}: the file is cut short or holds no volume")
    return legacy


def _check_text(path: Path, offset: int, count: int) -> None:
    """ASCII values that are all there: as many numbers as voxels before the next keyword."""
    with path.open("rb") as file:
        file.seek(offset)
        words = file.read().split(None, count)[:count]
    try:
        np.array(words, dtype="S").astype(float)
    except ValueError:
        words = [word for word in words if re.fullmatch(rb"[-+.\deEnaifNAIF]+", word)]
    if len(words) < count:
        problem = f"the header announces {count:,} voxels, fewer numbers ({len(words):,} at most) follow"
        raise VolumeError(path, f"{problem}: the file is cut short or its DIMENSIONS are wrong")


def read_vti(path: Path, given: Given) -> Stored:
    """A VTK XML image, point or cell data; `array` names one where a file holds several. Needs the extra `jvr[vtk]`."""
    start = first_bytes(path)
    kind = re.search(rb"<VTKFile[^>]*\btype\s*=\s*[\"'](\w+)", start)
    if kind is None:
        raise mislabelled(path, start, "a VTI file (XML with <VTKFile type='ImageData'>)")
    if kind[1] != b"ImageData":
        raise VolumeError(path, f"this is a VTK file of type {kind[1].decode()}; only ImageData is a volume: resample it")
    element = re.search(rb"<ImageData([^>]*)>", start)
    fields = dict(re.findall(r"(\w+)\s*=\s*[\"']([^\"']*)[\"']", element[1].decode("latin-1"))) if element else {}
    grid_numbers(path, "Spacing", fields.get("Spacing", "1 1 1"), positive=True)
    grid_numbers(path, "Origin", fields.get("Origin", "0 0 0"), positive=False)
    extent = grid_numbers(path, "WholeExtent", fields.get("WholeExtent", ""), positive=False)
    points = [int(high - low) + 1 for low, high in zip(extent[::2], extent[1::2], strict=False)]
    if len(extent) != 6 or min(points) < 1:
        raise VolumeError(
            path, f"WholeExtent is '{fields.get('WholeExtent', '')}'; it must be six numbers, first and last per axis"
        )
    check_size(path, [max(n - 1, 1) for n in points], 1, path.stat().st_size, compressed=True)
    return _from_vtk(path, _vtk_reader(path, "vtkIOXML", "vtkXMLImageDataReader"), given.array)


def _vtk_reader(path: Path, module: str, name: str) -> Any:
    import importlib

    try:
        reader = getattr(importlib.import_module(f"vtkmodules.{module}"), name)()
    except ImportError:
        raise missing_extra(path, "vtk", "this VTK file") from None
    reader.SetFileName(str(path))
    return reader


def _from_vtk(path: Path, reader: Any, array: str | None) -> Stored:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    problems = []
    reader.AddObserver("ErrorEvent", lambda *_: problems.append("error"))
    reader.AddObserver("WarningEvent", lambda *_: problems.append("warning"))
    with silenced():
        reader.Update()
    image = reader.GetOutput()
    if problems or min(image.GetDimensions()) < 1:
        raise VolumeError(path, "VTK cannot read all of it: the file is cut short or damaged; copy or export it again")
    found, on_cells = _chosen(path, image, array)
    points = image.GetDimensions()
    shape = [max(n - 1, 1) for n in points] if on_cells else points
    if found.GetNumberOfTuples() != math.prod(shape):
        raise VolumeError(
            path, f"array '{found.GetName()}' has {found.GetNumberOfTuples():,} values for {math.prod(shape):,} voxels"
        )
    directions = image.GetDirectionMatrix()
    affine = affine_of(image.GetSpacing(), image.GetOrigin(), [[directions.GetElement(i, j) for j in range(3)] for i in range(3)])
    # VTK counts voxels from the start of the extent; a cell's value sits at its centre.
    first = np.array(image.GetExtent()[::2]) + (0.5 * (np.array(points) > 1) if on_cells else 0.0)
    affine[:3, 3] += affine[:3, :3] @ first
    return Stored(vtk_to_numpy(found).reshape(shape, order="F"), affine, owner=image)


def _chosen(path: Path, image: Any, name: str | None) -> tuple[Any, bool]:
    """The array called `name`, or else the active scalars, or else the only scalar array; and whether it lies on cells."""
    sides = ((image.GetPointData(), False), (image.GetCellData(), True))
    arrays = [(side.GetArray(k), cells) for side, cells in sides for k in range(side.GetNumberOfArrays())]
    scalar = [(a, cells) for a, cells in arrays if a is not None and a.GetNumberOfComponents() == 1]
    names = ", ".join(f"'{a.GetName()}'" for a, _ in scalar)
    if not scalar:
        raise VolumeError(path, f"it holds no scalar array, only {len(arrays)} of vectors or colours; save a scalar array")
    if name is not None:
        scalar = [(a, cells) for a, cells in scalar if a.GetName() == name]
        if not scalar:
            raise VolumeError(path, f"it holds no scalar array '{name}'; array= may be {names}")
    active = [(a, cells) for a, cells in scalar if any(side.GetScalars() is a for side, _ in sides)]
    if len(scalar) > 1 and not active:
        raise VolumeError(path, f"it holds {len(scalar)} scalar arrays; choose one with array=: {names}")
    return (active or scalar)[0]
