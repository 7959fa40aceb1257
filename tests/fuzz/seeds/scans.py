"""DICOM: a slice, a series in a folder, frames in one file, and each way to compress pixels."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.encaps import encapsulate
from pydicom.filewriter import dcmwrite
from pydicom.sequence import Sequence
from pydicom.uid import UID, DeflatedExplicitVRLittleEndian, ExplicitVRLittleEndian, ImplicitVRLittleEndian, RLELossless

from seeds.seed import SHAPE, SLOW, Seed, volume, voxels

JPEG = "1.2.840.10008.1.2.4."


def _with(dataset: Dataset, **values: Any) -> Dataset:
    for name, value in values.items():
        setattr(dataset, name, value)
    return dataset


def _one(**values: Any) -> Sequence:
    return Sequence([_with(Dataset(), **values)])


def _slice(k: int = 0, **values: Any) -> Dataset:
    """Slice `k` of a CT series."""
    pixels = voxels("<u2")[:, :, k].T
    position, uid = {"ImagePositionPatient": [10.0, -20.0, 30.5 + 3.0 * k]}, "1.2.826.0.1.3680043.2.1125."
    dataset = _with(
        Dataset(), SOPClassUID="1.2.840.10008.5.1.4.1.1.2", SOPInstanceUID=f"{uid}1.{k}", SeriesInstanceUID=f"{uid}1",
        Modality="CT", ImageType=["ORIGINAL", "PRIMARY", "AXIAL"], InstanceNumber=k + 1, AcquisitionTime="101112.5",
        Rows=pixels.shape[0], Columns=pixels.shape[1], SamplesPerPixel=1, PhotometricInterpretation="MONOCHROME2",
        BitsAllocated=16, BitsStored=12, HighBit=11, PixelRepresentation=0, PixelPaddingValue=7, PixelPaddingRangeLimit=9,
        PixelSpacing=[1.25, 0.5], SliceThickness=3.0, ImageOrientationPatient=[1, 0, 0, 0, 1, 0], **position,
        RescaleSlope=2, RescaleIntercept=-1024, PixelData=pixels.tobytes(),
    )  # fmt: skip
    dataset["PixelData"].VR = "OW"
    return _with(dataset, **values)


def _frames() -> Dataset:
    """All slices as frames of one object, each with a position and a slope of its own."""
    dataset = _slice(SOPClassUID="1.2.840.10008.5.1.4.1.1.2.1", NumberOfFrames=SHAPE[2], PixelData=voxels("<u2").T.tobytes())
    for name in ("PixelSpacing", "SliceThickness", "ImageOrientationPatient", "ImagePositionPatient", "RescaleSlope"):
        delattr(dataset, name)
    del dataset.RescaleIntercept
    measures = _one(PixelSpacing=[1.25, 0.5], SliceThickness=3.0, SpacingBetweenSlices=3.0)
    orientation = _one(ImageOrientationPatient=[1, 0, 0, 0, 1, 0])
    dataset.SharedFunctionalGroupsSequence = _one(PixelMeasuresSequence=measures, PlaneOrientationSequence=orientation)
    dataset.PerFrameFunctionalGroupsSequence = Sequence(
        _with(
            Dataset(),
            PlanePositionSequence=_one(ImagePositionPatient=[10.0, -20.0, 30.5 + 3.0 * k]),
            PixelValueTransformationSequence=_one(RescaleSlope=1 + k, RescaleIntercept=-1000, RescaleType="HU"),
            FrameContentSequence=_one(StackID="1", InStackPositionNumber=k + 1, TemporalPositionIndex=1),
        )
        for k in range(SHAPE[2])
    )
    return dataset


def _written(dataset: Dataset, syntax: str = ExplicitVRLittleEndian, *, meta: bool = True) -> bytes:
    file = io.BytesIO()
    if meta:
        dataset.file_meta = FileMetaDataset()
        dataset.file_meta.TransferSyntaxUID = UID(syntax)
        dataset.file_meta.MediaStorageSOPClassUID = dataset.SOPClassUID
        dataset.file_meta.MediaStorageSOPInstanceUID = dataset.SOPInstanceUID
        dcmwrite(file, dataset, enforce_file_format=True)
    else:
        dcmwrite(file, dataset, implicit_vr=True, little_endian=True)
    return file.getvalue()


def _packed(syntax: str, encode: Callable[[np.ndarray], bytes], dtype: str = "u2") -> Seed:
    """A slice whose pixels another process decodes."""
    bits = 8 * np.dtype(dtype).itemsize
    stream = encode(np.ascontiguousarray(voxels(dtype)[:, :, 0].T))
    dataset = _slice(BitsAllocated=bits, BitsStored=bits, HighBit=bits - 1, PixelData=encapsulate([stream]))
    dataset["PixelData"].VR = "OB"
    dataset["PixelData"].is_undefined_length = True
    return volume({"a.dcm": _written(dataset, JPEG + syntax)}, share=SLOW)


def scans() -> dict[str, Seed]:
    import imagecodecs

    runs = _frames()
    runs.file_meta = FileMetaDataset()
    runs.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    runs.compress(RLELossless, np.ascontiguousarray(voxels("<u2").T), encoding_plugin="pydicom")
    single = {"a.dcm": _written(_slice())}
    return {
        "dicom": volume(single),
        "dicom, no preamble": volume({"a.dcm": _written(_slice(), meta=False)}),
        "dicom, deflated": volume({"a.dcm": _written(_slice(), DeflatedExplicitVRLittleEndian)}),
        "dicom, series": volume({f"{k}": _written(_slice(k)) for k in range(SHAPE[2])}, main=""),
        "dicom, frames": volume({"a.dcm": _written(_frames(), ImplicitVRLittleEndian)}),
        "dicom, runs": volume({"a.dcm": _written(runs, RLELossless)}),
        "dicom, JPEG": _packed("50", lambda pixels: imagecodecs.jpeg_encode(pixels, level=100), "u1"),
        "dicom, lossless JPEG": _packed("57", lambda pixels: imagecodecs.ljpeg_encode(pixels, bitspersample=16)),
        "dicom, JPEG-LS": _packed("80", imagecodecs.jpegls_encode),
        "dicom, JPEG 2000": _packed(
            "90", lambda pixels: imagecodecs.jpeg2k_encode(pixels, codecformat="j2k", reversible=True, level=0)
        ),
    }
