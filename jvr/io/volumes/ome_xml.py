"""OME-XML, parsed: voxel sizes, channels and names of the images that an OME-TIFF holds."""

import dataclasses
import re
from pathlib import Path
from typing import Any

from jvr.io.volumes.errors import VolumeError, grid_numbers, one_line
from jvr.io.volumes.given import Given
from jvr.io.volumes.units import millimetres


@dataclasses.dataclass(frozen=True)
class OmeImage:
    """One `Image` of OME-XML: its name, the attributes of its `Pixels`, and the names of its channels (empty where one has none)."""

    name: str
    pixels: dict[str, str]
    channels: list[str]


def ome_images(path: Path, text: str) -> list[OmeImage]:
    """The images that OME-XML describes, in its order.

    Entities, which may grow without bound, are refused, as is what only points to another file.
    """
    from xml.etree import ElementTree

    if re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise VolumeError(path, "its OME-XML defines entities, which are never read; export it again")
    try:
        root = ElementTree.fromstring(text.strip().strip("\x00"))
    except (ElementTree.ParseError, ValueError) as error:
        raise VolumeError(path, f"its OME-XML is damaged: {one_line(error)}; export it again") from None
    for element in root.iter():
        # Names without the schema's address, which is another one each year.
        element.tag = str(element.tag).rsplit("}", 1)[-1]
    if (elsewhere := root.find("BinaryOnly")) is not None:
        found = elsewhere.get("MetadataFile", "another file")
        raise VolumeError(path, f"it is one part of an image that '{found}' describes: export all as one OME-TIFF")
    images = []
    for image in root.findall("Image"):
        pixels = image.find("Pixels")
        if pixels is None:
            continue
        names = [channel.get("Name", "") for channel in pixels.findall("Channel")]
        images.append(OmeImage(image.get("Name") or image.get("ID", ""), dict(pixels.attrib), names if all(names) else []))
    return images


def ome_spacing(path: Path, pixels: dict[str, str], depth: int, given: Given) -> list[float]:
    """Voxel size in mm along x, y, z. A unit that is not named is a micrometre, as the schema says; a size that is missing is said."""
    if given.spacing is not None:
        return [1.0, 1.0, 1.0]
    sizes: list[Any] = [None, None, None]
    for k, axis in enumerate("XYZ"):
        field = f"PhysicalSize{axis}"
        if field in pixels and not (axis == "Z" and depth == 1):
            size = grid_numbers(path, f"its {field}", [pixels[field]], positive=True)[0]
            sizes[k] = size * millimetres(path, f"{field}Unit", pixels.get(f"{field}Unit", "µm"))
    return completed(path, sizes, depth, "PhysicalSizeX, PhysicalSizeY, PhysicalSizeZ of its OME-XML")


def completed(path: Path, sizes: list[float | None], depth: int, field: str) -> list[float]:
    """Voxel sizes where the file gives some or none: a missing one is that of x (or y), or 1 mm, with a warning that says which."""
    import warnings

    known = next((size for size in sizes if size is not None), None)
    missing = [axis for axis, size in zip("xyz", sizes, strict=True) if size is None and not (axis == "z" and depth == 1)]
    taken = 1.0 if known is None else known
    if missing:
        guess = "1 mm is taken" if known is None else f"{taken:.6g} mm is taken, as along the others"
        warnings.warn(
            f"{path}: no voxel size along {', '.join(missing)} is given ({field}): {guess}; give spacing= in mm", stacklevel=2
        )
    return [taken if size is None else size for size in sizes]
