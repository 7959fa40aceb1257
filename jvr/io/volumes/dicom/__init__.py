"""DICOM: the frames of one series become one volume, whether they lie in one file each or in one file together.

`headers` finds and parses objects, `frames` says what holds for each of their frames, `geometry` chooses and orders those
of one volume, `pixels` reads them. pydicom parses; no native code sees a file but in a process of its own.
"""

import warnings
from pathlib import Path

from jvr.io.volumes.dicom.frames import frames_of
from jvr.io.volumes.dicom.geometry import chosen, placed
from jvr.io.volumes.dicom.headers import Header, guarded, header, headers_in, looks_like_dicom, parsed, quiet
from jvr.io.volumes.dicom.pixels import stored_pixels
from jvr.io.volumes.errors import VolumeError, first_bytes, mislabelled
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import Stored

__all__ = ["looks_like_dicom", "read_dicom_file", "read_dicom_folder"]


def read_dicom_file(path: Path, given: Given) -> Stored:
    """One DICOM file: a single slice, or a multi-frame object."""
    start = first_bytes(path)
    if not looks_like_dicom(start):
        raise mislabelled(path, start, "a DICOM file ('DICM' at byte 128)")
    notes: list[str] = []
    with quiet(), guarded(path):
        found = header(path)
        if found is None and (path.name.upper() == "DICOMDIR" or "DirectoryRecordSequence" in parsed(path)):
            raise VolumeError(path, "this is a DICOMDIR, a list of files: give the folder that holds it")
        if found is None:
            raise VolumeError(path, "this DICOM object holds no picture (a report, plan, structure set or presentation state)")
        stored = _read(path, [found], given, notes)
    return _said(path, stored, notes)


def read_dicom_folder(folder: Path, given: Given) -> Stored:
    """The one series in a folder, or the one whose id is `series`; localisers give way to other series."""
    notes: list[str] = []
    with quiet(), guarded(folder):
        pictures, without = headers_in(folder, notes)
        if not pictures:
            also = f" ({sum(without.values())} DICOM objects without a picture)" if without else ""
            raise VolumeError(folder, f"the folder holds no DICOM series{also}; give a folder of DICOM slices, or a volume file")
        stored = _read(folder, _series(folder, pictures, given, notes), given, notes)
    return _said(folder, stored, notes)


def _said(path: Path, stored: Stored, notes: list[str]) -> Stored:
    for note in dict.fromkeys(notes):
        warnings.warn(f"{path}: {note}", stacklevel=4)
    return stored


def _series(folder: Path, pictures: list[Header], given: Given, notes: list[str]) -> list[Header]:
    """The objects of the one series that is asked for."""
    series: dict[str, list[Header]] = {}
    for picture in pictures:
        series.setdefault(picture.text("SeriesInstanceUID"), []).append(picture)
    shown = ", ".join(f"'{name}' ({_contents(found)})" for name, found in list(series.items())[:8])
    shown += f" and {len(series) - 8} more" if len(series) > 8 else ""
    if given.series is not None:
        if given.series not in series:
            raise VolumeError(folder, f"the folder holds no DICOM series '{given.series}'; it holds {shown}")
        return series[given.series]
    if len(series) == 1:
        return pictures
    volumes = [name for name, found in series.items() if not all(_localiser(picture) for picture in found)]
    if len(volumes) != 1:
        raise VolumeError(folder, f"the folder holds {len(series)} DICOM series; choose one with series=: {shown}")
    notes.append(f"it holds {len(series)} DICOM series, all but '{volumes[0]}' localisers, which are left out: series= chooses")
    return series[volumes[0]]


def _contents(found: list[Header]) -> str:
    count = f"{len(found)} slice{'s' if len(found) > 1 else ''}"
    words = (found[0].text("Modality"), found[0].text("SeriesDescription")[:40], count)
    return ", ".join(word for word in words if word)


def _localiser(picture: Header) -> bool:
    return "LOCALIZER" in [str(word).upper() for word in picture.dataset.get("ImageType") or []]


def _read(path: Path, pictures: list[Header], given: Given, notes: list[str]) -> Stored:
    frames = [frame for picture in _once(pictures, notes) for frame in frames_of(picture, given, notes)]
    kept, alike = chosen(path, frames, given)
    return stored_pixels(path, placed(path, kept, alike, given, notes), given, notes)


def _once(pictures: list[Header], notes: list[str]) -> list[Header]:
    """Copies of an object count once."""
    found: dict[str, Header] = {}
    for picture in pictures:
        name = picture.text("SOPInstanceUID") or str(picture.file)
        if name in found:
            notes.append(f"{picture.file.name} is a copy of {found[name].file.name}, and left out")
        found.setdefault(name, picture)
    return list(found.values())
