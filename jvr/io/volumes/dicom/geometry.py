"""Which frames make one volume, in which order, and where they lie.

The third axis runs through the positions of the frames, not along their normal: a CT with a tilted gantry is a sheared
grid. Positions are often rounded to 0.1 mm; what deviates by more than that from a line of even steps is refused.
"""

import collections
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.dicom.frames import CHANNELS, TIMES, Frame
from jvr.io.volumes.errors import VolumeError
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import affine_of

ROUNDING = 0.1


@dataclasses.dataclass
class Placed:
    """Frames in the order of the third axis (`None` where a segmentation leaves an empty one out) and their grid."""

    frames: list[Frame | None]
    world_from_grid: np.ndarray


def chosen(path: Path, frames: list[Frame], given: Given) -> tuple[list[Frame], list[Frame]]:
    """The frames of one volume, by `channel` and `time`; and all frames with its orientation and size."""
    for frame in frames:
        frame.separate |= {"orientation": _orientation(frame, frames), "size": _size(frame, frames)}
    separate = [kind for kind in ("size", "orientation", "stack", "segment") if len(_values(frames, kind)) > 1]
    parts = [[f for f in frames if _label(f, separate) == label] for label in _labels(frames, separate)]
    channels, times = [], []
    for part in parts:
        for kind in _kinds(part):
            (channels if kind in CHANNELS else times).append(kind)
    channels, times = separate + sorted(set(channels)), sorted(set(times))
    if not times and any(_repeats(part) for part in parts) and _rank_in_time(parts, channels):
        times = ["rank"]
    kept = _chosen_channel(path, frames, channels, given.channel)
    kept = _chosen_time(path, kept, times, given.time)
    alike = [f for f in frames if all(f.separate.get(kind) == kept[0].separate.get(kind) for kind in ("size", "orientation"))]
    return kept, alike


def _orientation(frame: Frame, frames: list[Frame]) -> str:
    """Axes that differ by less than moves the far corner by half a pixel are one orientation, the one seen first."""
    for k, other in enumerate(frames):
        if other is frame or _same_axes(frame, other):
            return f"orientation {k}"
    return ""


def _same_axes(a: Frame, b: Frame) -> bool:
    if a.axes is None or b.axes is None:
        return a.axes is b.axes
    return bool(np.abs(a.axes - b.axes).max() <= max(1e-3, 0.5 / max(a.size)))


def _size(frame: Frame, frames: list[Frame]) -> str:
    for other in frames:
        if other is frame:
            break
        if other.size == frame.size and np.allclose(other.spacing or (0, 0), frame.spacing or (0, 0), rtol=1e-3, atol=0):
            return _size_text(other)
    return _size_text(frame)


def _size_text(frame: Frame) -> str:
    text = f"{frame.size[0]} x {frame.size[1]} pixels"
    return text + (f" of {frame.spacing[0]:g} x {frame.spacing[1]:g} mm" if frame.spacing else "")


def _value(frame: Frame, kind: str) -> Any:
    return frame.separate.get(kind, frame.told_apart.get(kind, ""))


def _values(frames: list[Frame], kind: str) -> list[Any]:
    found = dict.fromkeys(_value(frame, kind) for frame in frames)
    return sorted(found, key=lambda value: (str(type(value)), value)) if kind not in ("size", "orientation") else list(found)


def _label(frame: Frame, kinds: list[str]) -> tuple[Any, ...]:
    return tuple(_value(frame, kind) for kind in kinds)


def _labels(frames: list[Frame], kinds: list[str]) -> list[tuple[Any, ...]]:
    order = {kind: {value: k for k, value in enumerate(_values(frames, kind))} for kind in kinds}
    found = dict.fromkeys(_label(frame, kinds) for frame in frames)
    return sorted(found, key=lambda label: tuple(order[kind][value] for kind, value in zip(kinds, label, strict=True)))


def _shown(kinds: list[str], label: tuple[Any, ...]) -> str:
    parts = []
    for kind, value in zip(kinds, label, strict=True):
        text = "\\".join(f"{x:g}" if isinstance(x, float) else str(x) for x in (value if isinstance(value, tuple) else (value,)))
        parts.append(text if kind in ("segment", "stack", "size", "orientation") else f"{kind} {text}")
    return ", ".join(parts)


def _depths(frames: list[Frame]) -> np.ndarray:
    """Positions along the normal; all at 0 where there are none."""
    first = frames[0]
    if first.axes is None or any(frame.position is None for frame in frames):
        return np.zeros(len(frames))
    normal = np.cross(first.axes[:, 0], first.axes[:, 1])
    return np.array([frame.position @ normal for frame in frames if frame.position is not None])


def _places(frames: list[Frame]) -> list[list[Frame]]:
    """Frames that lie at one position together, along the normal."""
    depths = _depths(frames)
    tolerance = 0.01 * min(frames[0].spacing or (1.0, 1.0))
    places, last = [], None
    for k in np.argsort(depths, kind="stable"):
        if last is None or depths[k] - last > tolerance:
            places.append([])
        places[-1].append(frames[k])
        last = depths[k]
    return places


def _repeats(frames: list[Frame]) -> int:
    """How many frames lie where another one does; frames without a position lie nowhere."""
    if any(frame.position is None or frame.axes is None for frame in frames) and "frame" not in frames[0].told_apart:
        return 0
    return len(frames) - len(_places(frames))


def _kinds(frames: list[Frame]) -> list[str]:
    """What tells the frames at each position apart: as few kinds as it takes, none with more values than a position has frames."""
    found, groups, repeats = [], [frames], _repeats(frames)
    if not repeats:
        return found
    most = max(len(place) for place in _places(frames))
    for kind in ("frame", *CHANNELS, *TIMES):
        split = [[f for f in group if _value(f, kind) == value] for group in groups for value in _values(group, kind)]
        left = sum(_repeats(group) for group in split)
        if left < repeats and len(_values(frames, kind)) <= most:
            found, groups, repeats = [*found, kind], split, left
        if not repeats:
            break
    return found


def _rank_in_time(parts: list[list[Frame]], channels: list[str]) -> bool:
    """Numbers the frames at each position where every position has equally many: by acquisition time and instance number."""
    for part in parts:
        for label in _labels(part, channels):
            places = _places([frame for frame in part if _label(frame, channels) == label])
            if len({len(place) for place in places}) > 1 or len(places) < 2:
                return False
            for place in places:
                if len({_instance(frame) for frame in place}) < len(place):
                    return False
                for rank, frame in enumerate(sorted(place, key=_instance)):
                    frame.told_apart["rank"] = rank
    return True


def _instance(frame: Frame) -> tuple[str, float]:
    number = frame.source.numbers("InstanceNumber", frame.source.dataset.get("InstanceNumber"), 1, ignored=True)
    return str(frame.told_apart.get("frame time", "")), (number or [0.0])[0] + frame.index * 1e-6


def _chosen_channel(path: Path, frames: list[Frame], kinds: list[str], channel: int | np.integer | str | None) -> list[Frame]:
    labels = _labels(frames, kinds)
    names = [_shown(kinds, label) for label in labels]
    if isinstance(channel, np.integer) or (isinstance(channel, str) and channel not in names and channel.isdecimal()):
        channel = int(channel)
    count = collections.Counter(_label(frame, kinds) for frame in frames)
    shown = ", ".join(
        f"{k}: '{name}' ({count[label]})" for k, (name, label) in enumerate(zip(names, labels, strict=True)) if k < 12
    )
    if channel is None:
        if len(labels) > 1:
            if "size" in kinds or "orientation" in kinds:
                first, other = frames[0], next(f for f in frames if _label(f, kinds[:1]) != _label(frames[0], kinds[:1]))
                problem = f"frames {first.name} and {other.name} differ in {kinds[0]}"
                raise VolumeError(path, f"{problem}: choose with channel= among {shown}, or remove the odd ones")
            raise VolumeError(path, f"frames of {len(labels)} kinds lie in one place; choose one with channel=, among {shown}")
        return frames
    if len(labels) < 2 and channel != 0:
        raise VolumeError(path, f"channel={channel}: it has a single channel, leave channel= out")
    named = next((k for k, name in enumerate(names) if name == channel), -1)
    index = channel if isinstance(channel, int) and not isinstance(channel, bool) else named
    if not 0 <= index < len(labels):
        raise VolumeError(path, f"channel={channel!r} is not there; it may be an index or a name of {shown}")
    return [frame for frame in frames if _label(frame, kinds) == labels[index]]


def _chosen_time(path: Path, frames: list[Frame], kinds: list[str], time: int | np.integer | None) -> list[Frame]:
    labels = _labels(frames, kinds)
    if time is None and len(labels) < 2:
        return frames
    if time is None:
        names = "; ".join(f"{k}: {_shown(kinds, label)}" for k, label in enumerate(labels[:12]))
        a, b = next(place for place in _places(frames) if len(place) > 1)[:2]
        problem = f"frames {a.name} and {b.name} lie at the same position"
        raise VolumeError(
            path, f"{problem}: it holds {len(labels)} points in time, choose one with time=0 to {len(labels) - 1} ({names})"
        )
    if not 0 <= time < len(labels):
        raise VolumeError(path, f"time={time} is not there; it holds {len(labels)} points in time, counted from 0")
    return [frame for frame in frames if _label(frame, kinds) == labels[time]]


def placed(path: Path, frames: list[Frame], alike: list[Frame], given: Given, notes: list[str]) -> Placed:
    """Frames of one volume along their third axis."""
    first = frames[0]
    if first.spacing is None and given.spacing is None:
        ratio = first.source.numbers("PixelAspectRatio", first.source.dataset.get("PixelAspectRatio"), 2, ignored=True)
        also = (
            ""
            if ratio is None or ratio[0] == ratio[1]
            else f" and as high, though PixelAspectRatio is {ratio[0]:g} to {ratio[1]:g}"
        )
        notes.append(f"PixelSpacing is missing; pixels are taken to be 1 mm wide{also}: give spacing= in mm")
    if first.axes is None or any(frame.position is None for frame in frames):
        return _unplaced(frames, given, notes)
    if len(frames) == 1 and len(_places(alike)) == 1:
        return Placed([first], _affine(first, _step(first, given, notes) * _normal(first)))
    if "segment" in first.separate:
        return _sparse(path, frames, alike, given)
    places = _places(frames)
    if double := next((place for place in places if len(place) > 1), None):
        problem = f"slices {double[0].name} and {double[1].name} lie at the same position"
        raise VolumeError(path, f"{problem} and nothing tells them apart: remove one of them")
    order = [place[0] for place in places]
    return Placed(list(order), _affine(order[0], _even_step(path, order, given, notes)))


def _normal(frame: Frame) -> np.ndarray:
    assert frame.axes is not None
    return np.cross(frame.axes[:, 0], frame.axes[:, 1])


def _affine(first: Frame, step: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    if first.axes is not None:
        matrix[:3, :2] = first.axes * np.array(first.spacing or (1.0, 1.0))
    matrix[:3, 2] = step
    matrix[:3, 3] = 0.0 if first.position is None else first.position
    return matrix


def _step(frame: Frame, given: Given, notes: list[str]) -> float:
    """Thickness of a single slice: what it was measured over, not the distance to others, which are not there."""
    found = next((x for x in (frame.thickness, frame.between) if x is not None and np.isfinite(x) and x > 0), None)
    if found is None and given.spacing is None:
        notes.append("SliceThickness is missing; the slice is taken to be 1 mm thick: give spacing= in mm")
    return found or 1.0


def _unplaced(frames: list[Frame], given: Given, notes: list[str]) -> Placed:
    """Frames whose positions are not known, in the order of their numbers."""
    first = frames[0]
    step = next((x for x in (first.between, first.thickness) if x is not None and np.isfinite(x) and x > 0), 1.0)
    if len(frames) > 1:
        frames = sorted(frames, key=lambda frame: (_instance(frame)[1], frame.source.file.name))
        if given.origin is None and given.spacing is None:
            notes.append(
                f"positions of the frames are missing; they are stacked in the order of their numbers, {step:g} mm apart"
            )
    affine = affine_of([*(first.spacing or (1.0, 1.0)), step])
    if first.axes is not None:
        affine = _affine(first, step * _normal(first))
    return Placed(list(frames), affine)


def _even_step(path: Path, frames: list[Frame], given: Given, notes: list[str]) -> np.ndarray:
    """The step from frame to frame, a line of least squares through their positions, which must be even."""
    positions = np.array([frame.position for frame in frames])
    count = np.arange(len(frames)) - (len(frames) - 1) / 2
    step = count @ positions / (count @ count)
    normal = _normal(frames[0])
    gaps = np.diff(positions @ normal)
    # One that is there, not the mean of two.
    typical = float(np.percentile(gaps, 50, method="lower"))
    odd = int(np.argmax(abs(gaps - typical)))
    off = positions - positions.mean(0) - count[:, None] * step
    along, across = abs(off @ normal), np.linalg.norm(off - np.outer(off @ normal, normal), axis=1)
    even = max(0.05 * typical, min(1.01 * ROUNDING, 0.3 * typical))
    pixel = min(frames[0].spacing or (1.0, 1.0))
    straight = max(0.1 * pixel, min(ROUNDING, 0.5 * pixel))
    problem = ""
    if abs(gaps[odd] - typical) > even or along.max() > even:
        pair = f"{frames[odd].name} and {frames[odd + 1].name}"
        problem = f"slices are unevenly spaced: {gaps[odd]:.4g} mm between {pair}, {typical:.4g} mm elsewhere"
    elif across.max() > straight:
        odd = int(np.argmax(across))
        problem = f"slices are not on a line: {frames[odd].name} lies {across[odd]:.3g} mm beside it"
    if problem and given.spacing is None:
        raise VolumeError(path, f"{problem}; add the missing slice, resample the series, or give spacing= to take them as even")
    if problem:
        notes.append(f"{problem}; taken as even, as spacing= says")
    # Where the ends are exact, so is this; positions of frames between them may be rounded.
    ends = (positions[-1] - positions[0]) / (len(frames) - 1)
    return ends if not problem and np.abs(ends - step).max() * len(frames) < 1e-3 else step


def _sparse(path: Path, frames: list[Frame], alike: list[Frame], given: Given) -> Placed:
    """Frames of a segmentation, which leaves out those that are empty."""
    depths = np.array([_depths(place)[0] for place in _places(alike)])
    between = frames[0].between or 0.0
    if len(depths) > 1:
        between = between if between > 0 else float(np.diff(depths).min())
    between = between if between > 0 else frames[0].thickness or 1.0
    index = np.rint((depths - depths[0]) / between).astype(int)
    if given.spacing is None and np.abs(depths - depths[0] - index * between).max() > max(
        0.05 * between, min(ROUNDING, 0.3 * between)
    ):
        raise VolumeError(path, f"frames of the segmentation do not lie at multiples of {between:g} mm; give spacing= in mm")
    lowest = _places(alike)[0][0]
    if index[-1] >= 16 * len(frames) + 4096:
        raise VolumeError(path, f"frames of the segmentation lie {depths[-1] - depths[0]:.4g} mm apart: its header is wrong")
    slots: list[Frame | None] = [None] * (int(index[-1]) + 1)
    for frame in frames:
        slot = int(np.rint((_depths([frame])[0] - depths[0]) / between))
        if slots[slot] is not None:
            raise VolumeError(path, f"frames {slots[slot].name} and {frame.name} lie at the same position: remove one of them")  # pyright: ignore[reportOptionalMemberAccess]
        slots[slot] = frame
    return Placed(slots, _affine(lowest, between * _normal(lowest)))
