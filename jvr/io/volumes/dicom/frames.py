"""The frames of DICOM objects: a classic slice is an object of one frame, a multi-frame object holds many.

What holds for one frame is looked for in its functional groups, then in the shared ones, then in the object itself
(PS3.3 C.7.6.16). Radiotherapy dose and nuclear medicine count the positions of their frames from the first one.
"""

import dataclasses
import math
from typing import Any

import numpy as np

from jvr.io.volumes.dicom.headers import Header
from jvr.io.volumes.errors import VolumeError, check_size
from jvr.io.volumes.given import Given

# A picture of one grey compresses without bound: what takes less than this is not refused for its ratio.
HARMLESS = 1 << 26
# What sets frames at the same position apart. The first kinds are channels, the second points in time.
CHANNELS = {
    "echo time": ("EffectiveEchoTime", "EchoTime", "EchoNumbers"),
    "image type": ("ImageType",),
    "complex part": ("ComplexImageComponent",),
    "energy": ("KVP",),
    "energy window": ("EnergyWindowVector",),
    "detector": ("DetectorVector",),
    "rotation": ("RotationVector",),
}
TIMES = {
    "temporal position": ("TemporalPositionIndex", "TemporalPositionIdentifier"),
    "b-value": ("DiffusionBValue",),
    "gradient": ("DiffusionGradientOrientation",),
    "trigger time": ("NominalCardiacTriggerDelayTime", "TriggerTime"),
    "angular view": ("AngularViewVector",),
    "phase": ("PhaseVector",),
    "time slot": ("TimeSlotVector",),
    "time slice": ("TimeSliceVector",),
    "acquisition": ("AcquisitionNumber",),
    "frame time": ("FrameAcquisitionDateTime", "AcquisitionDateTime", "AcquisitionTime", "ContentTime"),
}
SEQUENCES = (
    "MREchoSequence",
    "MRImageFrameTypeSequence",
    "CTImageFrameTypeSequence",
    "PETFrameTypeSequence",
    "FrameContentSequence",
    "CardiacSynchronizationSequence",
    "MRDiffusionSequence",
    "TemporalPositionSequence",
)
# The element that a pointer to slices of nuclear medicine names: SliceVector.
SLICES = 0x00540080
UNITS = {"US": "", "UNSPECIFIED": "", "NORMALIZED": "", "BQML": "Bq/ml", "GY": "Gy", "CNTS": "", "RELATIVE": "", "NONE": ""}


@dataclasses.dataclass(eq=False)
class Frame:
    """One picture: where it lies (LPS, mm), what scales it, what tells it from others."""

    source: Header
    index: int
    size: tuple[int, int]
    position: np.ndarray | None
    axes: np.ndarray | None
    spacing: tuple[float, float] | None
    thickness: float | None
    between: float | None
    slope: float
    intercept: float
    unit: str
    separate: dict[str, str]
    told_apart: dict[str, Any]

    @property
    def name(self) -> str:
        """What a message calls it."""
        return self.source.file.name + (f" (frame {self.index + 1})" if self.source.dataset.get("NumberOfFrames") else "")


class _Groups:
    """Looks an element up for one frame."""

    def __init__(self, dataset: Any, own: Any, shared: Any):
        self.dataset, self.places = dataset, [place for place in (own, shared, dataset) if place is not None]

    def get(self, name: str, *sequences: str) -> Any:
        for place in self.places:
            for sequence in sequences:
                items = place.get(sequence)
                if items and items[0].get(name) is not None:
                    return items[0].get(name)
        return self.dataset.get(name)


def frames_of(header: Header, given: Given, notes: list[str]) -> list[Frame]:
    """All frames of an object, checked against the bytes that the file has for them."""
    dataset = header.dataset
    rows, columns = header.integer("Rows"), header.integer("Columns")
    count = header.integer("NumberOfFrames", 1) if dataset.get("NumberOfFrames") is not None else 1
    if min(rows, columns, count) < 1:
        raise VolumeError(header.file, f"it announces {columns} x {rows} pixels and {count} frames: the file is damaged")
    if (samples := header.integer("SamplesPerPixel", 1)) != 1:
        raise VolumeError(header.file, f"its pictures are in colour ({samples} samples a pixel); save them as grey ones")
    _refuse_tiles(header, rows, columns, count)
    bits = header.integer("BitsAllocated", 16)
    compressed = header.syntax.startswith("1.2.840.10008.1.2.4") or header.syntax in RATIO_UNKNOWN
    stored = max(header.bytes_stored, HARMLESS // 1100) if compressed else header.bytes_stored
    check_size(header.file, (columns, -(-rows * bits // 8), count), 1, stored, compressed=compressed)
    if compressed and count * 4 > max(header.bytes_stored, 4):
        raise VolumeError(header.file, f"it announces {count:,} frames in {header.bytes_stored:,} bytes: the file is damaged")
    per_frame = dataset.get("PerFrameFunctionalGroupsSequence")
    if per_frame and len(per_frame) != count:
        raise VolumeError(
            header.file, f"it announces {count} frames and describes {len(per_frame)}: the file is cut short or damaged"
        )
    shared = dataset.get("SharedFunctionalGroupsSequence")
    shared = shared[0] if shared else None
    labels = _segment_labels(dataset)
    groups = [_Groups(dataset, per_frame[k] if per_frame else None, shared) for k in range(count)]
    frames = [_frame(header, group, k, (columns, rows), given, labels) for k, group in enumerate(groups)]
    if not per_frame and count > 1:
        _place_from_first(header, frames, given, notes)
    return frames


def _refuse_tiles(header: Header, rows: int, columns: int, count: int) -> None:
    """Refuses pictures that are laid out beside each other, which are neither slices nor one behind the other."""
    if count == 1 and "MOSAIC" in [str(word).upper() for word in header.dataset.get("ImageType") or []]:
        problem = "its picture is a mosaic of all slices (ImageType MOSAIC)"
        raise VolumeError(header.file, f"{problem}: split it, as `dcm2niix` does, and read the NIfTI file")
    whole = [header.integer(f"TotalPixelMatrix{name}", 0) for name in ("Columns", "Rows")]
    if whole[0] > columns or whole[1] > rows:
        problem = f"its frames are tiles of one slide of {whole[0]} x {whole[1]} pixels, not slices of a volume"
        raise VolumeError(header.file, f"{problem}: export the slide as one picture")


RATIO_UNKNOWN = ("1.2.840.10008.1.2.5", "1.2.840.10008.1.2.1.99")


def _frame(header: Header, groups: _Groups, k: int, size: tuple[int, int], given: Given, labels: dict[int, str]) -> Frame:
    number = lambda name, value, ignored: (header.numbers(name, value, 1, ignored=ignored) or [None])[0]
    cosines = groups.get("ImageOrientationPatient", "PlaneOrientationSequence", "DetectorInformationSequence")
    if cosines is None:
        cosines = groups.get("ImageOrientationVolume", "PlaneOrientationVolumeSequence")
    position = groups.get("ImagePositionPatient", "PlanePositionSequence", "DetectorInformationSequence")
    if position is None:
        position = groups.get("ImagePositionVolume", "PlanePositionVolumeSequence")
    place = header.numbers("ImagePositionPatient", position, 3, ignored=given.origin is not None)
    transform = lambda name: groups.get(name, "PixelValueTransformationSequence")
    spacing = _pixel_spacing(header, groups, given)
    measures = lambda name: number(name, groups.get(name, "PixelMeasuresSequence"), True)
    slope = number("RescaleSlope", transform("RescaleSlope"), given.slope is not None)
    if (scaling := header.dataset.get("DoseGridScaling")) is not None:
        slope = number("DoseGridScaling", scaling, given.slope is not None)
    if str(header.dataset.get("SegmentationType", "")).upper() == "FRACTIONAL":
        slope = 1 / max(header.integer("MaximumFractionalValue", 1), 1)
    intercept = number("RescaleIntercept", transform("RescaleIntercept"), given.intercept is not None)
    if slope == 0 and given.slope is None:
        raise VolumeError(header.file, "its rescale slope is 0, which makes all values equal: correct it, or give slope=")
    between, thickness = measures("SpacingBetweenSlices"), measures("SliceThickness")
    return Frame(
        source=header,
        index=k,
        size=size,
        position=None if place is None else np.array(place),
        axes=_axes(header, cosines, given),
        spacing=spacing,
        thickness=thickness,
        between=between,
        slope=1.0 if slope is None else slope,
        intercept=0.0 if intercept is None else intercept,
        unit=_unit(header, transform("RescaleType")),
        separate=_separate(groups, labels),
        told_apart=_told_apart(groups, k),
    )


def _axes(header: Header, cosines: Any, given: Given) -> np.ndarray | None:
    """Unit vectors along the rows and down the columns, in the columns of a 3x2 matrix."""
    numbers = header.numbers("ImageOrientationPatient", cosines, 6, ignored=given.direction is not None)
    if numbers is None:
        return None
    axes = np.reshape(numbers, (2, 3)).T
    lengths = np.linalg.norm(axes, axis=0)
    if np.abs(lengths - 1).max() > 0.01 or abs(axes[:, 0] @ axes[:, 1]) > 0.01:
        if given.direction is not None:
            return None
        shown = "\\".join(f"{x:g}" for x in numbers)
        raise VolumeError(
            header.file,
            f"ImageOrientationPatient is '{shown}', not two perpendicular unit vectors: correct it or give direction=",
        )
    return axes / lengths


def _pixel_spacing(header: Header, groups: _Groups, given: Given) -> tuple[float, float] | None:
    """Millimetres along a row and down a column: DICOM writes them in the other order."""
    found = groups.get("PixelSpacing", "PixelMeasuresSequence")
    numbers = header.numbers("PixelSpacing", found, 2, positive=True, ignored=given.spacing is not None)
    if numbers is None:
        for name in ("ImagerPixelSpacing", "NominalScannedPixelSpacing"):
            numbers = numbers or header.numbers(name, groups.get(name), 2, positive=True, ignored=True)
    regions = header.dataset.get("SequenceOfUltrasoundRegions")
    # Unit 3 is the centimetre.
    units = [regions[0].get(f"PhysicalUnits{axis}Direction") for axis in "XY"] if regions else []
    if numbers is None and units == [3, 3]:
        steps = [abs(float(regions[0].get(name) or 0)) * 10 for name in ("PhysicalDeltaY", "PhysicalDeltaX")]
        numbers = steps if min(steps) > 0 and all(map(math.isfinite, steps)) else None
    return None if numbers is None else (numbers[1], numbers[0])


def _unit(header: Header, rescale_type: Any) -> str:
    dataset, modality = header.dataset, header.text("Modality").upper()
    name = dataset.get("DoseUnits") or dataset.get("Units") or rescale_type
    if name:
        return UNITS.get(str(name).strip().upper(), str(name).strip())
    localiser = "LOCALIZER" in [str(x).upper() for x in dataset.get("ImageType") or []]
    return "HU" if modality == "CT" and not localiser else ""


def _segment_labels(dataset: Any) -> dict[int, str]:
    items = dataset.get("SegmentSequence") or []
    return {int(item.get("SegmentNumber", 0)): str(item.get("SegmentLabel", "")) for item in items}


def _separate(groups: _Groups, labels: dict[int, str]) -> dict[str, str]:
    """What makes frames parts of different volumes, wherever they lie."""
    found = {}
    if (number := groups.get("ReferencedSegmentNumber", "SegmentIdentificationSequence")) is not None:
        found["segment"] = labels.get(int(number)) or f"segment {int(number)}"
    if (stack := groups.get("StackID", "FrameContentSequence")) is not None:
        found["stack"] = f"stack {stack}"
    return found


def _told_apart(groups: _Groups, k: int) -> dict[str, Any]:
    found = {}
    for kind, names in (CHANNELS | TIMES).items():
        for name in names:
            value = groups.get(name, *SEQUENCES)
            if name == "DiffusionGradientOrientation" and value is None:
                value = groups.get(name, "MRDiffusionSequence", "DiffusionGradientDirectionSequence")
            if value is None or value == "":
                continue
            if name.endswith("Vector"):
                value = value[k] if hasattr(value, "__len__") and len(value) > k else 0
            found[kind] = _comparable(value)
            break
    return found


def _comparable(value: Any) -> Any:
    if isinstance(value, str):
        return value
    if hasattr(value, "__iter__"):
        return tuple(_comparable(x) for x in value)
    try:
        return float(value)
    except (TypeError, ValueError):
        return str(value)


def _place_from_first(header: Header, frames: list[Frame], given: Given, notes: list[str]) -> None:
    """Positions of frames that follow each other along the normal of the first one; without any, `position` is `None`."""
    dataset, first = header.dataset, frames[0]
    pointer = dataset.get("FrameIncrementPointer")
    pointers = [int(tag) for tag in (pointer if hasattr(pointer, "__iter__") else [pointer])] if pointer is not None else []
    offsets = dataset.get("GridFrameOffsetVector")
    # Frame time and frame time vector: a film, whose frames are points in time.
    film = any(tag in (0x00181063, 0x00181065) for tag in pointers)
    # Of nuclear medicine, pictures from one detector or angle each, or counted one after the other, unless they run through slices.
    flat = any(tag >> 16 == 0x0054 for tag in pointers) and SLICES not in pointers
    for k, frame in enumerate(frames):
        if film:
            frame.told_apart["frame"] = k
        elif offsets is None and first.position is None:
            frame.position = None
    if film or flat or first.position is None or first.axes is None:
        return
    origin = first.position
    normal = np.cross(first.axes[:, 0], first.axes[:, 1])
    if offsets is not None:
        steps = np.array(header.numbers("GridFrameOffsetVector", offsets, len(frames)))
        # Offsets that do not begin at 0 are positions along z (PS3.3 C.8.8.3.2).
        if steps[0] != 0:
            normal = np.array([0.0, 0.0, 1.0])
        steps = steps - steps[0]
    elif first.between:
        slices = dataset.get("SliceVector")
        steps = np.array([float(slices[k]) - 1 if slices else k for k in range(len(frames))]) * first.between
    else:
        step = first.thickness if first.thickness and first.thickness > 0 else 1.0
        if given.spacing is None:
            notes.append(f"SpacingBetweenSlices is missing; frames are taken to be {step:g} mm apart: give spacing= in mm")
        steps = np.arange(len(frames)) * step
    for frame, step in zip(frames, steps, strict=True):
        frame.position = origin + step * normal
