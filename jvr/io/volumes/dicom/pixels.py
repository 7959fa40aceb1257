"""Pixels of frames: unpacked, sign-extended, rescaled where every slice has its own scale.

Uncompressed and run-length coded pixels are read here; compressed ones go to a process of its own (`decode`).
"""

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.apart import decoded
from jvr.io.volumes.dicom.frames import HARMLESS, Frame
from jvr.io.volumes.dicom.geometry import Placed
from jvr.io.volumes.dicom.headers import Header, guarded, parsed
from jvr.io.volumes.errors import VolumeError, check_size
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import Stored

NATIVE = ("1.2.840.10008.1.2", "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.1.99", "1.2.840.10008.1.2.2")
BIG_ENDIAN, RUN_LENGTH = "1.2.840.10008.1.2.2", "1.2.840.10008.1.2.5"
JPEG = "1.2.840.10008.1.2.4."
CODECS = {"50": "jpeg", "51": "jpeg", "57": "ljpeg", "70": "ljpeg", "80": "jpegls", "81": "jpegls"}
CODECS |= {"90": "jpeg2k", "91": "jpeg2k", "201": "jpeg2k", "202": "jpeg2k", "203": "jpeg2k"}
# Bytes of decoded pixels that one process delivers.
BATCH = 1 << 28


def stored_pixels(path: Path, placed: Placed, given: Given, notes: list[str]) -> Stored:
    """The volume of placed frames."""
    frames = [frame for frame in placed.frames if frame is not None]
    scales = {(frame.slope, frame.intercept) for frame in frames}
    scales = {(given.slope or s, i if given.intercept is None else given.intercept) for s, i in scales}
    types = {frame.source: _type(frame.source) for frame in frames}
    columns, rows = frames[0].size
    stored_type = np.result_type(*types.values())
    uniform = len(scales) == 1
    dtype = stored_type if uniform else np.dtype(np.float32 if stored_type.itemsize <= 2 else np.float64)
    compressed = any(frame.source.syntax not in NATIVE[:2] for frame in frames)
    bytes_stored = sum(source.bytes_stored for source in types)
    sparse = len(frames) < len(placed.frames)
    check_size(path, (columns, rows, len(placed.frames)), dtype.itemsize, None)
    check_size(path, (columns, rows, len(frames)), 1, max(8 * bytes_stored, HARMLESS // 1100), compressed=compressed)
    slope, intercept = next(iter(scales)) if uniform else (given.slope or 1.0, given.intercept or 0.0)
    slots = {(frame.source, frame.index): k for k, frame in enumerate(placed.frames) if frame is not None}
    values = (np.zeros if sparse else np.empty)((len(placed.frames), rows, columns), dtype)
    missing = None
    for source, index, pixels in _frames(frames):
        k = slots[source, index]
        frame = placed.frames[k]
        assert frame is not None
        stored, padding = _padded(source, _interpreted(source, pixels, types[source], notes))
        if uniform:
            values[k], scaled = stored, padding
        else:
            s, i = given.slope or frame.slope, frame.intercept if given.intercept is None else given.intercept
            values[k] = (stored * s + (i - intercept)) / slope
            scaled = None if padding is None else np.float32((padding * s + (i - intercept)) / slope)
        if scaled is not None:
            if missing is not None and missing != scaled:
                values[k][stored == padding] = missing
            missing = float(scaled) if missing is None else missing
    if any(source.text("PhotometricInterpretation") == "MONOCHROME1" for source in types):
        notes.append(
            "MONOCHROME1: small values are meant to be shown bright; the values are kept as they are: slope=-1 turns them round"
        )
    _say_what_is_left_out(frames[0], notes)
    return Stored(values.T, placed.world_from_grid, slope, intercept, missing, frames[0].unit)


def _say_what_is_left_out(frame: Frame, notes: list[str]) -> None:
    dataset = frame.source.dataset
    if "ModalityLUTSequence" in dataset and "RescaleSlope" not in dataset:
        notes.append("its Modality LUT is not applied: values are those stored")
    if frame.source.text("PhotometricInterpretation") == "PALETTE COLOR":
        notes.append("its colour palette is not applied: values are the indices into it")
    if (mapping := _real_world(frame)) is not None:
        slope, intercept = (
            float(mapping.get(f"RealWorldValue{name}") or default) for name, default in (("Slope", 1), ("Intercept", 0))
        )
        if (slope, intercept) != (frame.slope, frame.intercept):
            name = str(mapping.get("LUTLabel") or "").strip()[:40]
            notes.append(
                f"its real-world values {name!r}, {slope:g} * stored + {intercept:g}, are not applied: slope= and intercept= do"
            )
    imager = dataset.get("ImagerPixelSpacing")
    if (
        imager is not None
        and dataset.get("PixelSpacing") != imager
        and frame.source.text("Modality") in ("CR", "DX", "MG", "RF", "XA")
    ):
        kind = (
            "PixelSpacing, which is calibrated" if dataset.get("PixelSpacing") else "ImagerPixelSpacing, the size at the detector"
        )
        notes.append(f"a projection radiograph, no slice: its pixel size is {kind}")


def _real_world(frame: Frame) -> Any:
    """The mapping of a frame to real-world values by a slope, where it has one."""
    dataset = frame.source.dataset
    places = [
        (dataset.get("PerFrameFunctionalGroupsSequence") or [])[frame.index :],
        dataset.get("SharedFunctionalGroupsSequence") or [],
    ]
    for place in (*(place[0] for place in places if place), dataset):
        for mapping in place.get("RealWorldValueMappingSequence") or []:
            if mapping.get("RealWorldValueSlope") is not None:
                return mapping
    return None


def _type(header: Header) -> np.dtype:
    """The type of stored values."""
    if header.dataset.get("BitsAllocated") == 1:
        return np.dtype(np.uint8)
    bits = header.integer("BitsAllocated")
    if bits not in (8, 16, 32, 64):
        raise VolumeError(header.file, f"BitsAllocated is {bits}; 1, 8, 16, 32 or 64 would be right: export it again")
    if header.is_float:
        if bits < 32:
            raise VolumeError(header.file, f"BitsAllocated is {bits} for floating-point pixels; 32 or 64 would be right")
        return np.dtype(f"f{bits // 8}")
    stored, high = header.integer("BitsStored", bits), header.integer("HighBit", header.integer("BitsStored", bits) - 1)
    if not 1 <= stored <= high + 1 <= bits:
        raise VolumeError(header.file, f"BitsStored {stored} and HighBit {high} do not fit {bits} bits: its header is wrong")
    return np.dtype(f"{'i' if header.integer('PixelRepresentation', 0) == 1 else 'u'}{bits // 8}")


def _interpreted(header: Header, pixels: np.ndarray, dtype: np.dtype, notes: list[str]) -> np.ndarray:
    """Stored values of containers: the bits from HighBit down, with their sign; the others may hold an overlay."""
    if pixels.dtype.kind == "f" or header.dataset.get("BitsAllocated") == 1:
        return pixels
    bits = 8 * dtype.itemsize
    stored = header.integer("BitsStored", bits)
    high = header.integer("HighBit", stored - 1)
    up, down = bits - 1 - high, bits - stored
    if not down:
        return pixels.view(dtype)
    found = pixels.view(dtype)
    # Shifting to the top and back drops the other bits and extends the sign.
    kept = (pixels << up).view(dtype) >> down
    overlay = any(header.dataset.get((group, 0x0102)) for group in range(0x6000, 0x6020, 2))
    if high == stored - 1 and not overlay and not np.array_equal(kept, found):
        text = f"{header.file.name}: pixels use more than the {stored} bits that BitsStored announces; the bits above are dropped"
        if not any("BitsStored announces" in note for note in notes):
            notes.append(text)
    return kept


def _padded(header: Header, stored: np.ndarray) -> tuple[np.ndarray, float | None]:
    """The stored number of pixels without data, put in the place of a whole range of such numbers."""
    kind = "" if stored.dtype.kind in "iu" else "Float" if stored.dtype.itemsize == 4 else "DoubleFloat"
    value = _padding(header, f"{kind}PixelPaddingValue", stored.dtype)
    if value is None:
        return stored, None
    limit = _padding(header, f"{kind}PixelPaddingRangeLimit", stored.dtype)
    if limit is not None and limit != value:
        low, high = min(value, limit), max(value, limit)
        stored = np.where((stored >= low) & (stored <= high), np.array(value, stored.dtype), stored)
    return stored, value


def _padding(header: Header, name: str, dtype: np.dtype) -> float | None:
    """Files write the padding value signed where pixels are not, and the other way round: the bits count."""
    number = header.numbers(name, header.dataset.get(name), 1, ignored=True)
    if number is None or dtype.kind == "f":
        return None if number is None else number[0]
    info = np.iinfo(dtype)
    if info.min <= number[0] <= info.max:
        return number[0]
    wrapped = int(number[0]) % (1 << info.bits)
    return float(wrapped - (1 << info.bits) if wrapped > info.max else wrapped)


def _frames(frames: list[Frame]) -> Iterator[tuple[Header, int, np.ndarray]]:
    """Containers `[row, column]` of all frames, object by object."""
    wanted: dict[Header, list[int]] = {}
    for frame in frames:
        wanted.setdefault(frame.source, []).append(frame.index)
    waiting: list[tuple[Frame, bytes]] = []
    by_key = {(frame.source, frame.index): frame for frame in frames}
    for header, indices in wanted.items():
        if header.syntax in NATIVE:
            yield from _native(header, sorted(indices))
        elif header.syntax == RUN_LENGTH:
            yield from _run_length(header, sorted(indices))
        else:
            for index, stream in _streams(header, sorted(indices)):
                waiting.append((by_key[header, index], stream))
                if sum(_frame_bytes(frame) for frame, _ in waiting) >= BATCH:
                    yield from _decoded(waiting)
                    waiting = []
    if waiting:
        yield from _decoded(waiting)


def _frame_bytes(frame: Frame) -> int:
    return frame.size[0] * frame.size[1] * max(frame.source.integer("BitsAllocated") // 8, 1)


def _native(header: Header, indices: list[int]) -> Iterator[tuple[Header, int, np.ndarray]]:
    columns, rows = header.integer("Columns"), header.integer("Rows")
    bits = header.integer("BitsAllocated")
    count = header.integer("NumberOfFrames", 1) if header.dataset.get("NumberOfFrames") is not None else 1
    wanted = -(-rows * columns * count * bits // 8)
    dataset = parsed(header.file, pixels=wanted)
    name = next((name for name in ("PixelData", "FloatPixelData", "DoubleFloatPixelData") if name in dataset), None)
    if name is None:
        raise VolumeError(header.file, "its pixel data are missing: it is cut short or damaged; copy it again")
    data = dataset[name].value
    if not isinstance(data, bytes) or len(data) < wanted:
        problem = f"its header announces {wanted:,} bytes of pixels, {len(data) if isinstance(data, bytes) else 0:,} follow"
        raise VolumeError(header.file, f"{problem}: it is cut short or damaged; copy it again")
    if bits == 1:
        for k in indices:
            first, last = k * rows * columns, (k + 1) * rows * columns
            part = np.unpackbits(np.frombuffer(data[first // 8 : -(-last // 8)], np.uint8), bitorder="little")
            yield header, k, part[first % 8 : first % 8 + rows * columns].reshape(rows, columns)
        return
    order = ">" if header.syntax == BIG_ENDIAN else "<"
    kind = "u" if name == "PixelData" else "f"
    words = np.frombuffer(data, "u2").byteswap().view("u1") if order == ">" and bits == 8 and dataset[name].VR == "OW" else None
    pixels = np.frombuffer(data, f"{order}{kind}{bits // 8}", rows * columns * count) if words is None else words
    for k in indices:
        part = pixels[k * rows * columns : (k + 1) * rows * columns].reshape(rows, columns)
        yield header, k, part.astype(part.dtype.newbyteorder("="), copy=False)


def _run_length(header: Header, indices: list[int]) -> Iterator[tuple[Header, int, np.ndarray]]:
    from pydicom.pixels import get_decoder
    from pydicom.uid import RLELossless

    dataset = parsed(header.file, pixels=0)
    decoder = get_decoder(RLELossless)
    with guarded(header.file):
        arrays = decoder.iter_array(dataset, indices=indices, raw=True, decoding_plugin="pydicom")
        for k, (pixels, _) in zip(indices, arrays, strict=True):
            yield header, k, np.ascontiguousarray(pixels).view(f"u{pixels.dtype.itemsize}")


def _streams(header: Header, indices: list[int]) -> list[tuple[int, bytes]]:
    """The codestreams of compressed frames."""
    from pydicom.encaps import generate_frames

    codec = CODECS.get(header.syntax.removeprefix(JPEG))
    if codec is None:
        raise VolumeError(
            header.file, f"its transfer syntax {_syntax_name(header)} is not supported; decompress it, as `gdcmconv --raw` does"
        )
    if importlib.util.find_spec("imagecodecs") is None:
        raise VolumeError(header.file, f"{_syntax_name(header)} pixels need a decoder: pip install imagecodecs")
    dataset = parsed(header.file, pixels=0)
    count = header.integer("NumberOfFrames", 1) if dataset.get("NumberOfFrames") is not None else 1
    offsets = [dataset.get(name) for name in ("ExtendedOffsetTable", "ExtendedOffsetTableLengths")]
    with guarded(header.file):
        extended: Any = tuple(offsets) if all(offsets) else None
        streams = list(generate_frames(dataset.PixelData, number_of_frames=count, extended_offsets=extended))
    if len(streams) < count:
        raise VolumeError(header.file, f"it announces {count} frames, {len(streams)} follow: it is cut short or damaged")
    return [(k, streams[k]) for k in indices]


def _syntax_name(header: Header) -> str:
    from pydicom.uid import UID

    return UID(header.syntax).name


def _decoded(waiting: list[tuple[Frame, bytes]]) -> Iterator[tuple[Header, int, np.ndarray]]:
    """Pictures of codestreams, from a process of its own."""
    frames = [
        {
            "codec": CODECS[frame.source.syntax.removeprefix(JPEG)],
            "bytes": len(stream),
            "rows": frame.size[1],
            "columns": frame.size[0],
            "itemsize": max(frame.source.integer("BitsAllocated") // 8, 1),
        }
        for frame, stream in waiting
    ]
    sizes = [task["rows"] * task["columns"] * task["itemsize"] for task in frames]
    task = {"kind": "streams", "frames": frames, "bytes": max(sizes)}
    found = decoded(waiting[0][0].source.file, task, sum(sizes), (stream for _, stream in waiting))
    for (frame, _), task, part in zip(waiting, frames, np.split(found, np.cumsum(sizes)[:-1]), strict=True):
        yield frame.source, frame.index, part.view(f"u{task['itemsize']}").reshape(task["rows"], task["columns"])
