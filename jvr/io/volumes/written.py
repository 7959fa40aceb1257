"""Writing a volume as a MetaImage (.mha), which `jvr.read_volume`, ITK and what is built on it read."""

import os

import numpy as np

from jvr.atomic import replacing
from jvr.model.volume import Volume
from jvr.model.voxels import VOXEL


def write_metaimage(path: str | os.PathLike, volume: Volume) -> None:
    """Writes the scalars of a volume, `slope * v + intercept` in single precision and NaN where they are missing, with the place of its
    grid in double precision. The file is replaced at once or not at all."""
    matrix = np.asarray(volume.world_from_grid, np.float64) + np.asarray(
        volume.remainder.beside(volume.world_from_grid), np.float64
    )
    spacing = np.linalg.norm(matrix[:3, :3], axis=0)
    scalars = float(volume.slope) * np.asarray(volume.values, np.float64) + float(volume.intercept)
    if volume.gaps is not None:
        scalars = np.where(np.asarray(volume.gaps) & VOXEL != 0, np.nan, scalars)
    words = lambda numbers: " ".join(repr(float(number)) for number in np.ravel(numbers))
    header = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False",
        # Each row is the direction of one axis.
        "TransformMatrix": words((matrix[:3, :3] / spacing).T),
        "Offset": words(matrix[:3, 3]),
        "ElementSpacing": words(spacing),
        "DimSize": " ".join(map(str, volume.shape)),
        "ElementType": "MET_FLOAT",
        "ElementDataFile": "LOCAL",
    }
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write("".join(f"{key} = {value}\n" for key, value in header.items()).encode())
        # The first axis changes fastest.
        file.write(scalars.astype("<f4").tobytes(order="F"))
