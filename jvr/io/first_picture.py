"""Defaults for a volume without a configuration: what of it is shown, in which colours and which light.

What is guessed is said in a line each: `FirstPicture.notes`.
"""

import re
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jvr.io.config.transfers import LABEL_DEPTH, contents
from jvr.io.interop.slicer import slicer_presets, slicer_property
from jvr.io.volumes.dicom import looks_like_dicom
from jvr.io.volumes.errors import first_bytes
from jvr.io.volumes.slices import is_slices
from jvr.io.volumes.zarr_files import is_zarr
from jvr.model.transfer import AbstractTransfer
from jvr.model.volume import Volume
from jvr.model.voxels import typical_range
from jvr.types import Scalar

# Formats that say how a patient lies; others say nothing of what is up.
ORIENTED = (".nii", ".nii.gz", ".hdr", ".img", ".dcm", ".nrrd", ".nhdr")
SUBSET = 1 << 20
# Labels: so few different whole numbers, and so many neighbours that are equal.
MOST_LABELS, EQUAL = 256, 0.8
# Gradients, in contrasts of the volume per voxel, from which on there are surfaces.
SURFACE = 0.08
# The share of its largest extent up to which a volume is a slice.
THIN = 0.05
LIGHTS = [{"kind": "head", "irradiance": 1.0}, {"kind": "ambient", "radiance": 1.0}]
SHADING = {"kind": "blinn-phong", "ambient": 0.35, "diffuse": 0.75, "specular": 0.15, "shininess": 20.0}


class FirstPicture(NamedTuple):
    """Tables of a configuration, and what was guessed for them, a line each."""

    tables: dict[str, Any]
    notes: list[str]


def first_picture(volume: Volume, path: Path, preset: str | None = None, *, lit: bool = True) -> FirstPicture:
    """What shows a volume of which nothing is known but what it holds.

    **Arguments:** `preset`: by name, of jvr or of 3D Slicer, where somebody has chosen one; `lit`: with a light at the eye and surfaces
    where the scalar changes.
    """
    notes = []
    kind = preset
    if kind is None:
        kind, why = _kind(volume)
        notes.append(f"{why}: shown as {kind} (--preset says otherwise)")
    tables: dict[str, Any] = {"transfer": {"kind": "preset", "preset": kind}, "camera": {"frame": "visible", **_facing(volume)}}
    if kind == "labels":
        tables["volume"] = {"interpolation": "nearest"}
    if kind in slicer_presets():
        tables |= _of_slicer(kind, lit)
    elif lit:
        tables |= {"lights": LIGHTS, "shading": {**SHADING, "threshold": _surface(volume, kind)}}
    if not _says_what_is_up(path):
        notes.append("the file does not say what is up: z is taken for it (--up and --view say otherwise)")
    return FirstPicture(tables, notes)


def _of_slicer(name: str, lit: bool) -> dict[str, Any]:
    """Tables of a preset of 3D Slicer. Its colours are those of a screen."""
    said, tables = slicer_property(name), {"transfer": {"kind": "slicer", "name": name, "encoding": "srgb"}}
    if not (lit and said.shade):
        return tables
    shading = {"kind": "phong", "ambient": said.ambient, "diffuse": said.diffuse, "specular": said.specular}
    return tables | {"lights": LIGHTS, "normals": "central", "shading": {**shading, "shininess": max(said.power, 1.0)}}


def _says_what_is_up(path: Path) -> bool:
    """Whether a file or folder says how a patient lies."""
    if path.is_dir():
        return not (is_zarr(path) or is_slices(path))
    start = first_bytes(path, 4096) if path.is_file() else b""
    if path.name.lower().endswith((".mha", ".mhd")):
        return (
            re.search(rb"^\s*(TransformMatrix|Rotation|Orientation|AnatomicalOrientation)\s*=", start, re.MULTILINE) is not None
        )
    return path.name.lower().endswith(ORIENTED) or looks_like_dicom(start)


@eqx.filter_jit
def _fraction_seen(transfer: AbstractTransfer, data: Float[Array, "n"]) -> Float[Array, ""]:
    def seen(s: Scalar) -> Bool[Array, ""]:
        found = transfer.evaluate(s, jnp.zeros_like(s))
        return jnp.max(jnp.asarray((*found.sigma_t, *found.emission))) > 0

    return jnp.mean(jax.vmap(seen)(data))


def _facing(volume: Volume) -> dict[str, str]:
    """The view of a volume that is a slice, or little more: across its thinnest axis."""
    matrix = np.asarray(volume.world_from_grid, float)[:3, :3] * [n - 1 if n > 1 else 1 for n in volume.shape]
    lengths = np.abs(matrix).sum(axis=1)
    thin = int(np.argmin(lengths))
    return {"view": ("left", "front", "top")[thin]} if lengths[thin] < THIN * np.max(lengths) else {}


def what_is_seen(volume: Volume, transfer: AbstractTransfer) -> str | None:
    """A line where a transfer function shows nothing of a volume, or all of it, with the range that would show something."""
    data = _subset(volume)
    share = float(_fraction_seen(transfer, jnp.asarray(data, jnp.result_type(float))))
    if 0 < share < 0.98 or transfer.takes_gradient:
        return None
    low, high = contents(volume)
    shown = "nothing" if share == 0 else "everything"
    holds = f"the values are {data.min():g} ... {data.max():g}"
    return f"the transfer function shows {shown}: {holds}, of which {low:g} ... {high:g} is not background; --preset scan takes that range"


def _kind(volume: Volume) -> tuple[str, str]:
    """The preset for a volume, and why."""
    if _is_labels(volume):
        return "labels", "a few whole numbers in regions"
    if volume.unit == "HU":
        return "ct", "the unit is HU"
    if volume.unit == "" and _looks_like_hounsfield(_subset(volume)):
        return "ct", "the values look like Hounsfield units"
    return "scan", "values without a unit"


def _is_labels(volume: Volume) -> bool:
    values = np.asarray(volume.values)
    if values.dtype.kind not in "iu" or (float(volume.slope), float(volume.intercept)) != (1.0, 0.0):
        return False
    low, high = int(values.min()), int(values.max())
    if low < 0 or high == low or high >= MOST_LABELS:
        return False
    inside = values[:-1] > 0
    if not inside.any():
        return False
    # Regions are equal inside, also where there are two of them only; grey levels are noisy.
    equal = np.count_nonzero(inside & (values[1:] == values[:-1])) / np.count_nonzero(inside)
    return bool(equal > EQUAL) and len(np.unique(values)) <= MOST_LABELS // 4


def _looks_like_hounsfield(data: np.ndarray) -> bool:
    """Air, tissue about water, and something denser, all in their place."""
    share = lambda low, high: np.mean((data > low) & (data < high))
    return bool(data.min() > -4100 and share(-1100, -850) > 0.01 and share(-200, 200) > 0.05 and data.max() > 250)


def _surface(volume: Volume, kind: str) -> float:
    """The gradient from which on there is a surface, in data units per mm, for a preset."""
    spacing = float(np.min(np.asarray(volume.spacing)))
    if kind == "labels":
        # Of the extinction, which is smoothed over a few voxels.
        return 1e-3 * LABEL_DEPTH / spacing**2
    if kind.startswith("ct"):
        return 40.0 / spacing
    low, high = contents(volume)
    return SURFACE * (high - low) / spacing


def _subset(volume: Volume) -> np.ndarray:
    """Some data of a volume, in its unit."""
    data = volume.data()
    some = data[:: max(data.size // SUBSET, 1)].astype(np.float64) * float(volume.slope) + float(volume.intercept)
    ends = np.sort([float(volume.slope) * v + float(volume.intercept) for v in typical_range(data)])
    return np.clip(some, *ends)
