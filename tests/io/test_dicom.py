"""DICOM: every pixel where its own frame says it is, and one line for each file that holds no volume. pydicom writes the files."""

import copy
import warnings

import highdicom
import imagecodecs
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.encaps import encapsulate
from pydicom.sequence import Sequence
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, ImplicitVRLittleEndian

from jvr.io.volumes import VolumeError, read_volume
from jvr.io.volumes.dicom import read_dicom_file, read_dicom_folder
from jvr.io.volumes.given import Given

UID = "1.2.826.0.1.3680043.2.1125."
SHAPE, SPACING = (7, 5, 3), (0.5, 1.25, 3.0)
AXIAL = [1, 0, 0, 0, 1, 0]


def voxels(dtype="i2", shape=SHAPE):
    """Values that are all different, indexed [x, y, z]."""
    x, y, z = np.meshgrid(*[np.arange(n) for n in shape], indexing="ij")
    return (x + 10 * y + 80 * z).astype(dtype)


def elements(dataset, **values):
    """Sets elements, or removes those that are `None`."""
    for name, value in values.items():
        if value is None:
            delattr(dataset, name)
        else:
            setattr(dataset, name, value)
    return dataset


def nested(**values):
    """A sequence of one item."""
    return Sequence([elements(Dataset(), **values)])


def picture(pixels, number=1, *, series="1", **values):
    """A classic CT slice of `pixels[row, column]`, or frames of it."""
    bits = pixels.dtype.itemsize * 8
    dataset = elements(
        Dataset(), SOPClassUID=CTImageStorage, SOPInstanceUID=f"{UID}{series}.{number}", SeriesInstanceUID=UID + series,
        FrameOfReferenceUID=UID + "8",
        StudyInstanceUID=UID + "9", Modality="CT", InstanceNumber=number, ImageType=["ORIGINAL", "PRIMARY", "AXIAL"],
        Rows=pixels.shape[-2], Columns=pixels.shape[-1], SamplesPerPixel=1, PhotometricInterpretation="MONOCHROME2",
        BitsAllocated=bits, BitsStored=bits, HighBit=bits - 1, PixelRepresentation=int(pixels.dtype.kind == "i"),
        PixelSpacing=[SPACING[1], SPACING[0]], SliceThickness=2.0, ImageOrientationPatient=AXIAL,
        ImagePositionPatient=[10.0, -20.0, 30.5], RescaleSlope=1, RescaleIntercept=-1024, PixelData=pixels.tobytes(),
    )  # fmt: skip
    dataset["PixelData"].VR = "OW" if bits > 8 else "OB"
    if pixels.ndim > 2:
        dataset.NumberOfFrames = len(pixels)
    return elements(dataset, **values)


def saved(dataset, path, syntax=ExplicitVRLittleEndian, preamble=True):
    path.parent.mkdir(parents=True, exist_ok=True)
    meta = FileMetaDataset()
    meta.TransferSyntaxUID = syntax
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = dataset.SOPClassUID, dataset.SOPInstanceUID
    if preamble:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            encoding = {"is_implicit_VR": syntax.is_implicit_VR, "is_little_endian": syntax.is_little_endian}
            FileDataset(str(path), dataset, preamble=bytes(128), file_meta=meta, **encoding).save_as(
                path, enforce_file_format=True
            )
    else:
        dataset.save_as(path, implicit_vr=syntax.is_implicit_VR, little_endian=True)
    return path


def slices(folder, values, position=lambda k: (10.0, -20.0, 30.5 + 3.0 * k), each=lambda k: {}, **keywords):
    """A series in file names that are not in order."""
    for k in range(values.shape[2]):
        pixels = np.ascontiguousarray(values[:, :, k].T)
        dataset = picture(pixels, k + 1, ImagePositionPatient=list(position(k)), **keywords)
        saved(elements(dataset, **each(k)), folder / f"{keywords.get('series', '1')}_{(7 * k + 3) % 23}")
    return folder


def enhanced(values, position=lambda k: (10.0, -20.0, 30.5 + 3.0 * k), group=lambda k: {}, order=None, **keywords):
    """A multi-frame object with functional groups."""
    count = values.shape[2]
    order = range(count) if order is None else order
    dataset = picture(np.ascontiguousarray(values.T[list(order)]), SOPClassUID="1.2.840.10008.5.1.4.1.1.2.1", **keywords)
    elements(dataset, PixelSpacing=None, ImageOrientationPatient=None, ImagePositionPatient=None, SliceThickness=None)
    elements(dataset, RescaleSlope=None, RescaleIntercept=None)
    measures = nested(PixelSpacing=[SPACING[1], SPACING[0]], SliceThickness=2.0)
    orientation = nested(ImageOrientationPatient=AXIAL)
    dataset.SharedFunctionalGroupsSequence = nested(PixelMeasuresSequence=measures, PlaneOrientationSequence=orientation)
    dataset.PerFrameFunctionalGroupsSequence = Sequence(
        [elements(Dataset(), PlanePositionSequence=nested(ImagePositionPatient=list(position(k))), **group(k)) for k in order]
    )
    return dataset


def data(volume):
    return np.asarray(volume.values) * float(volume.slope) + float(volume.intercept)


def assert_same(volume, values, position=lambda k: (10.0, -20.0, 30.5 + 3.0 * k), spacing=SPACING):
    """Every voxel in data units, and where the corners lie."""
    np.testing.assert_allclose(data(volume), values, rtol=1e-6, atol=1e-4)
    for i, j, k in ((0, 0, 0), (2, 1, 0), (3, 2, values.shape[2] - 1)):
        wanted = np.array(position(k)) + np.array([i * spacing[0], j * spacing[1], 0])
        np.testing.assert_allclose((np.asarray(volume.world_from_grid) @ [i, j, k, 1])[:3], wanted, rtol=1e-5, atol=1e-4)


def fails(match, path, **keywords):
    with pytest.raises(VolumeError, match=match) as caught:
        read_volume(path, **keywords)
    assert "\n" not in str(caught.value)
    assert path.name in str(caught.value)


def reads(path, *said, **keywords):
    """The volume, whose reader says exactly what is `said`."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        volume = read_volume(path, **keywords)
    assert len(caught) == len(said), [str(w.message) for w in caught]
    for warning, words in zip(caught, said, strict=True):
        assert words in str(warning.message)
    return volume


# --- Series of slices ------------------------------------------------------------------------------------------------


def test_slices_are_where_itk_says(tmp_path):
    folder = slices(tmp_path / "ct", voxels())
    volume = reads(folder)
    assert_same(volume, voxels() - 1024.0)
    names = sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder))
    image = sitk.ReadImage(names)
    np.testing.assert_array_equal(data(volume), sitk.GetArrayFromImage(image).T)
    np.testing.assert_allclose(image.GetOrigin(), np.asarray(volume.world_from_grid)[:3, 3])
    assert read_dicom_folder(folder, Given()).unit == "HU"


def test_geometry_is_that_of_highdicom(tmp_path):
    cosines = [0.8, 0.6, 0.0, -0.48, 0.64, 0.6]
    normal = np.cross(cosines[:3], cosines[3:])
    folder = slices(
        tmp_path / "a", voxels(), lambda k: tuple(np.round(4.0 + 2.5 * k * normal, 6)), ImageOrientationPatient=cosines
    )
    theirs = highdicom.get_volume_from_series([pydicom.dcmread(file) for file in folder.iterdir()])
    corner = np.array([0, *(n - 1 for n in SHAPE)])
    for index in (corner * 0, corner, corner // 2):
        # highdicom counts slices, rows, columns, and may run through the slices the other way.
        ours = (np.asarray(reads(folder).world_from_grid) @ [*index[1:], 1])[:3]
        their_index = np.linalg.inv(theirs.affine) @ [*ours, 1]
        np.testing.assert_allclose(their_index[1:3], [index[2], index[1]], atol=1e-4)
        assert abs(their_index[0] - round(their_index[0])) < 1e-4
        value = theirs.array[round(their_index[0]), index[2], index[1]]
        assert value == data(reads(folder))[tuple(index[1:])]


@pytest.mark.parametrize("slopes", [[0.5, 0.5, 0.5], [1, 0.5, 2]])
def test_slopes_of_each_slice(tmp_path, slopes):
    folder = slices(tmp_path / "pet", voxels(), each=lambda k: {"RescaleSlope": slopes[k]}, Modality="PT", Units="BQML")
    assert_same(reads(folder), voxels() * np.array(slopes) - 1024.0)
    assert read_dicom_folder(folder, Given()).unit == "Bq/ml"
    assert_same(reads(folder, slope=2.0, intercept=1.0), voxels() * 2.0 + 1.0)
    assert_same(reads(folder, intercept=1.0), voxels() * np.array(slopes) + 1.0)
    assert_same(reads(folder, slope=2.0), voxels() * 2.0 - 1024.0)


def test_a_tilted_gantry_keeps_its_shear(tmp_path):
    position = lambda k: (10.0, -20.0 + k, 30.5 + 3.0 * k)
    assert_same(reads(slices(tmp_path / "ct", voxels(), position)), voxels() - 1024.0, position)


def test_positions_rounded_to_a_tenth_are_on_a_line(tmp_path):
    values = voxels(shape=(7, 5, 12))
    exact = lambda k: np.array((10.0, -20.0 + 0.137 * k, 30.5 + 0.625 * k))
    volume = reads(slices(tmp_path / "ct", values, lambda k: np.round(exact(k), 1)))
    for k in range(12):
        found = (np.asarray(volume.world_from_grid) @ [0, 0, k, 1])[:3]
        np.testing.assert_allclose(found, exact(k), atol=0.075)


def test_uneven_slices_are_named_and_spacing_takes_them_as_even(tmp_path):
    values = voxels(shape=(7, 5, 6))
    gap = slices(tmp_path / "gap", values, lambda k: (0, 0, [0, 1, 2, 4, 5, 6][k]))
    fails("unevenly spaced: 2 mm between 1_17 and 1_1, 1 mm elsewhere; .*spacing=", gap)
    volume = reads(gap, "unevenly spaced: 2 mm between 1_17 and 1_1", spacing=(1, 1, 2))
    assert_same(volume, values - 1024.0, lambda k: (0, 0, 2 * k), (1, 1, 2))
    fails(
        "unevenly",
        slices(tmp_path / "tiny", values, lambda k: (0, 0, [0, 0.01, 0.02, 0.04, 0.05, 0.06][k]), PixelSpacing=[0.01] * 2),
    )
    fails("not on a line: .* beside", slices(tmp_path / "bent", values, lambda k: (3.0 * (k == 2), 0, k)))
    fails("unevenly", slices(tmp_path / "drift", values, lambda k: (0, 0, k + 0.1 * k * k)))


def test_slices_that_do_not_belong_together(tmp_path):
    folder = slices(tmp_path / "a", voxels(), each=lambda k: {"ImageOrientationPatient": [1, 0, 0, 0, 0, -1]} if k == 1 else {})
    fails("differ in orientation: choose with channel= among 0: 'orientation 0' .1., 1: 'orientation 1' .2.", folder)
    assert reads(folder, channel=1).shape == (7, 5, 2)
    near = [np.cos(1e-4), np.sin(1e-4), 0, -np.sin(1e-4), np.cos(1e-4), 0]
    assert_same(
        reads(slices(tmp_path / "b", voxels(), each=lambda k: {"ImageOrientationPatient": near} if k else {})), voxels() - 1024.0
    )
    slices(tmp_path / "b", voxels(shape=(4, 4, 1)), series="1", each=lambda k: {"SOPInstanceUID": UID + "1.77"}, InstanceNumber=9)
    saved(picture(np.zeros((4, 4), "i2"), 9), tmp_path / "b" / "odd")
    fails("differ in size: choose with channel= among .*7 x 5 pixels.*4 x 4 pixels", tmp_path / "b")


def test_copies_count_once_and_doubles_are_named(tmp_path):
    folder = slices(tmp_path / "a", voxels())
    (folder / "copy").write_bytes((folder / "1_3").read_bytes())
    assert_same(reads(folder, "copy is a copy of 1_3"), voxels() - 1024.0)
    fails("1_10 and 1_17 lie at the same position", slices(tmp_path / "b", voxels(), lambda k: (0, 0, min(k, 1))))


@pytest.mark.parametrize(
    "name", ["EchoTime", "TemporalPositionIdentifier", "DiffusionBValue", "AcquisitionNumber", "InstanceNumber"]
)
def test_series_of_several_volumes(tmp_path, name):
    told_apart = lambda k, t: {"SOPInstanceUID": f"{UID}1.{t + 1}{k}", name: 5 + t * 3 + k * (name[0] == "I")}
    for t in range(2):
        values = voxels() + np.int16(1000 * t)
        slices(
            tmp_path,
            values,
            series="1",
            each=lambda k, t=t: told_apart(k, t),
        )
        for file in list(tmp_path.glob("1_*")):
            file.rename(tmp_path / f"{t}{file.name[1:]}")
    keyword = "channel" if name == "EchoTime" else "time"
    fails(f"{keyword}=.*0.*1", tmp_path)
    for t in range(2):
        assert_same(reads(tmp_path, **{keyword: t}), voxels() + 1000 * t - 1024.0)
    fails(f"{keyword}=2 is not there", tmp_path, **{keyword: 2})
    if keyword == "channel":
        assert_same(reads(tmp_path, channel="echo time 8"), voxels() + 1000 - 1024.0)


# --- Stored values ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2", "u4", "i4"])
@pytest.mark.parametrize("syntax", ["1.2.840.10008.1.2", "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.1.99", "1.2.840.10008.1.2.2"])
def test_types_and_byte_orders(tmp_path, dtype, syntax):
    values = voxels(dtype)
    if np.dtype(dtype).kind == "i":
        values = values - np.array(100, dtype)
    dataset = picture(values[:, :, 1].T.astype(np.dtype(dtype).newbyteorder(">" if syntax.endswith(".2.2") else "<")))
    dataset["PixelData"].VR = "OB" if dtype[1] == "1" else "OW"
    odd = dataset.PixelData + bytes(len(dataset.PixelData) % 2)
    elements(dataset, PixelData=odd)
    volume = reads(saved(dataset, tmp_path / "a.dcm", pydicom.uid.UID(syntax)))
    np.testing.assert_array_equal(data(volume)[:, :, 0], values[:, :, 1].astype(float) - 1024)


@pytest.mark.parametrize("signed", [0, 1])
def test_bits_beyond_those_stored(tmp_path, signed):
    values = np.array([[-5, 7, 2000], [-2048, 0, 1]], "i2") if signed else np.array([[5, 7, 4095], [0, 1, 2]], "u2")
    words = values.view("u2") & 0x0FFF
    keys = {"BitsStored": 12, "PixelRepresentation": signed, "RescaleIntercept": 0}
    clean = saved(picture(words, HighBit=11, **keys), tmp_path / "a.dcm")
    np.testing.assert_array_equal(data(reads(clean, *(["more than the 12 bits"] if signed else [])))[:, :, 0], values.T)
    high = saved(picture(words << 4 | 3, HighBit=15, **keys), tmp_path / "b.dcm")
    np.testing.assert_array_equal(data(reads(high))[:, :, 0], values.T)
    dirty = saved(picture(words | 0x3000, HighBit=11, **keys), tmp_path / "c.dcm")
    np.testing.assert_array_equal(data(reads(dirty, "more than the 12 bits that BitsStored announces"))[:, :, 0], values.T)


def test_padding_and_units(tmp_path):
    values = np.array([[-2000, -1990, 5], [-2000, 6, 7]], "i2")
    dataset = picture(values, RescaleIntercept=0)
    dataset.add_new("PixelPaddingValue", "US", 63536)
    stored = read_dicom_file(saved(dataset, tmp_path / "a.dcm"), Given())
    assert (stored.missing, stored.unit) == (-2000.0, "HU")
    dataset.add_new("PixelPaddingRangeLimit", "SS", -1980)
    stored = read_dicom_file(saved(dataset, tmp_path / "a.dcm"), Given())
    assert stored.missing == -2000
    np.testing.assert_array_equal(stored.values[:, :, 0].T, [[-2000, -2000, 5], [-2000, 6, 7]])
    assert read_dicom_file(saved(picture(values), tmp_path / "b.dcm"), Given()).missing is None
    for kind, unit in (("US", ""), ("HU", "HU"), ("OD", "OD")):
        assert read_dicom_file(saved(picture(values, RescaleType=kind), tmp_path / "c.dcm"), Given()).unit == unit
    assert read_dicom_file(saved(picture(values, Modality="MR"), tmp_path / "d.dcm"), Given()).unit == ""


@pytest.mark.parametrize(
    ("keys", "said", "lengths"),
    [
        ({"PhotometricInterpretation": "MONOCHROME1"}, "MONOCHROME1", (0.5, 1.25, 2)),
        ({"PixelSpacing": None}, "PixelSpacing is missing", (1, 1, 2)),
        ({"PixelSpacing": None, "ImagerPixelSpacing": [0.2, 0.1], "Modality": "DX"}, "projection radiograph", (0.1, 0.2, 2)),
        ({"SliceThickness": None}, "SliceThickness is missing", (0.5, 1.25, 1)),
        ({"SliceThickness": None, "SpacingBetweenSlices": 4}, None, (0.5, 1.25, 4)),
        ({"SpacingBetweenSlices": 4}, None, (0.5, 1.25, 2)),
    ],
)
def test_what_is_guessed_is_said(tmp_path, keys, said, lengths):
    volume = reads(saved(picture(voxels()[:, :, 0].T.copy(), **keys), tmp_path / "a.dcm"), *([said] if said else []))
    np.testing.assert_allclose(np.linalg.norm(np.asarray(volume.world_from_grid)[:3, :3], axis=0), lengths, rtol=1e-6)


def test_what_is_given_wins_over_what_would_be_refused(tmp_path):
    bad = {"ImageOrientationPatient": [1, 1, 0, 0, 1, 0], "PixelSpacing": [0, 1], "RescaleSlope": 0}
    path = saved(picture(voxels()[:, :, 0].T.copy(), **bad), tmp_path / "a.dcm")
    fails("PixelSpacing|Orientation", path)
    volume = reads(path, spacing=(1, 2, 3), direction=np.eye(3), slope=2.0)
    np.testing.assert_allclose(np.asarray(volume.world_from_grid)[:3, :3], np.diag([1, 2, 3]))
    np.testing.assert_array_equal(data(volume)[:, :, 0], voxels()[:, :, 0] * 2.0 - 1024)


# --- Compressed pixels -----------------------------------------------------------------------------------------------


def _encoded(kind, pixels):
    if kind == "57":
        return imagecodecs.ljpeg_encode(pixels, bitspersample=16)
    if kind == "50":
        return imagecodecs.jpeg_encode(pixels, level=100)
    if kind == "80":
        return imagecodecs.jpegls_encode(pixels)
    return imagecodecs.jpeg2k_encode(pixels, codecformat="j2k", reversible=True, level=0)


@pytest.mark.parametrize("kind", ["50", "57", "70", "80", "90"])
def test_compressed_pixels(tmp_path, kind):
    y, x, z = np.meshgrid(np.arange(24), np.arange(32), np.arange(3), indexing="ij")
    values = (3 * x + 2 * y + 20 * z).astype("u1" if kind == "50" else "u2")
    for k in range(3):
        dataset = picture(np.ascontiguousarray(values[:, :, k]), k + 1, ImagePositionPatient=[0, 0, k])
        stream = _encoded("57" if kind == "70" else kind, np.ascontiguousarray(values[:, :, k]))
        dataset.PixelData = encapsulate([stream])
        dataset["PixelData"].is_undefined_length = True
        saved(dataset, tmp_path / "a" / str(k), pydicom.uid.UID("1.2.840.10008.1.2.4." + kind))
    volume = reads(tmp_path / "a")
    np.testing.assert_allclose(data(volume) + 1024, values.transpose(1, 0, 2), atol=1 if kind == "50" else 0)
    stream = bytearray(dataset.PixelData)
    stream[40:80] = bytes(40)
    dataset.PixelData = bytes(stream)
    saved(dataset, tmp_path / "b.dcm", pydicom.uid.UID("1.2.840.10008.1.2.4." + kind))
    fails("compressed data are damaged", tmp_path / "b.dcm")


def test_a_codestream_that_is_larger_than_its_header_says(tmp_path):
    stream = bytearray(_encoded("90", np.zeros((24, 32), "u2")))
    size = stream.index(b"\xff\x51") + 6
    # Picture and tile of 30,000 x 30,000, 1.8 GB.
    for at in (0, 16):
        stream[size + at : size + at + 8] = (30000).to_bytes(4, "big") * 2
    dataset = picture(np.zeros((24, 32), "u2"), PixelData=encapsulate([bytes(stream)]))
    dataset["PixelData"].is_undefined_length = True
    fails("compressed data are damaged", saved(dataset, tmp_path / "a.dcm", pydicom.uid.JPEG2000Lossless))


def test_run_lengths(tmp_path):
    dataset = enhanced(voxels())
    dataset.file_meta = FileMetaDataset()
    dataset.compress(pydicom.uid.RLELossless, np.ascontiguousarray(voxels().T))
    assert_same(reads(saved(dataset, tmp_path / "a.dcm", pydicom.uid.RLELossless)), voxels())


# --- Multi-frame objects ---------------------------------------------------------------------------------------------


def test_multi_frame_objects_are_sorted_and_scaled_frame_by_frame(tmp_path):
    scale = lambda k: {"PixelValueTransformationSequence": nested(RescaleSlope=k + 1, RescaleIntercept=-k, RescaleType="HU")}
    path = saved(enhanced(voxels(), order=[2, 0, 1], group=scale), tmp_path / "a.dcm")
    assert_same(reads(path), voxels() * np.arange(1, 4) - np.arange(3))
    tilted = lambda k: (10.0, -20.0 + k, 30.5 + 3.0 * k)
    assert_same(reads(saved(enhanced(voxels(), tilted, order=[1, 2, 0]), tmp_path / "b.dcm")), voxels(), tilted)
    gap = saved(enhanced(voxels(), lambda k: (0, 0, [0, 1, 5][k])), tmp_path / "c.dcm")
    fails(r"unevenly spaced: 4 mm between c.dcm \(frame 2\) and c.dcm \(frame 3\), 1 mm elsewhere", gap)


def test_multi_frame_echoes_times_and_stacks(tmp_path):
    values = np.concatenate([voxels(), voxels() + np.int16(1000)], axis=2)
    position = lambda k: (10.0, -20.0, 30.5 + 3.0 * (k % 3))
    echo = lambda k: {"MREchoSequence": nested(EffectiveEchoTime=5.0 + 4 * (k // 3))}
    path = saved(enhanced(values, position, echo), tmp_path / "a.dcm")
    fails("channel=, among 0: 'echo time 5' .3., 1: 'echo time 9' .3.", path)
    assert_same(reads(path, channel="echo time 9"), voxels() + 1000, position)
    time = lambda k: {"FrameContentSequence": nested(TemporalPositionIndex=1 + k // 3)}
    path = saved(enhanced(values, position, time), tmp_path / "b.dcm")
    fails("time=0 to 1", path)
    assert_same(reads(path, time=1), voxels() + 1000, position)
    stack = lambda k: {"FrameContentSequence": nested(StackID=str(1 + k // 3))}
    assert_same(reads(saved(enhanced(values, position, stack), tmp_path / "c.dcm"), channel=1), voxels() + 1000, position)


def test_multi_frame_files_of_one_series(tmp_path):
    for part in range(2):
        dataset = enhanced(voxels() + np.int16(part * 240), lambda k, part=part: (10.0, -20.0, 30.5 + 3.0 * (k + 3 * part)))
        saved(elements(dataset, SOPInstanceUID=f"{UID}1.{part}"), tmp_path / "a" / str(part))
    assert_same(reads(tmp_path / "a"), voxels(shape=(7, 5, 6)))


def test_segmentations_leave_empty_frames_out(tmp_path):
    masks = np.random.default_rng(1).integers(0, 2, (7, 5, 3)).astype("u1")
    segment = lambda k: {"SegmentIdentificationSequence": nested(ReferencedSegmentNumber=[1, 1, 2][k])}
    dataset = enhanced(masks, lambda k: (10.0, -20.0, [0.0, 9.0, 3.0][k]), segment, Modality="SEG", SegmentationType="BINARY")
    bits = np.packbits(masks.T.ravel(), bitorder="little").tobytes()
    elements(dataset, BitsAllocated=1, BitsStored=1, HighBit=0, PixelData=bits + bytes(len(bits) % 2))
    dataset.SegmentSequence = Sequence(
        [elements(Dataset(), SegmentNumber=k, SegmentLabel=s) for k, s in ((1, "liver"), (2, "spleen"))]
    )
    path = saved(dataset, tmp_path / "a.dcm")
    fails("0: 'liver' .2., 1: 'spleen' .1.", path)
    empty = np.zeros((7, 5))
    place = lambda k: (10.0, -20.0, 3.0 * k)
    assert_same(reads(path, channel="liver"), np.stack([masks[:, :, 0], empty, empty, masks[:, :, 1]], 2), place)
    assert_same(reads(path, channel=1), np.stack([empty, masks[:, :, 2], empty, empty], 2), place)


@pytest.mark.parametrize("offsets", [[0, 3, 6], [30.5, 33.5, 36.5]])
def test_dose(tmp_path, offsets):
    keys = {"GridFrameOffsetVector": offsets, "DoseGridScaling": 0.25, "DoseUnits": "GY", "FrameIncrementPointer": 0x3004000C}
    dataset = picture(np.ascontiguousarray(voxels("u2").T), Modality="RTDOSE", RescaleSlope=None, RescaleIntercept=None, **keys)
    assert_same(reads(saved(dataset, tmp_path / "a.dcm")), voxels() * 0.25)
    assert read_dicom_file(tmp_path / "a.dcm", Given()).unit == "Gy"


def test_frames_without_positions(tmp_path):
    dataset = picture(np.ascontiguousarray(voxels().T), Modality="US", ImagePositionPatient=None, ImageOrientationPatient=None)
    volume = reads(saved(dataset, tmp_path / "a.dcm"), "positions of the frames are missing")
    assert_same(volume, voxels() - 1024.0, lambda k: (0, 0, 2 * k))
    film = saved(elements(dataset, FrameIncrementPointer=0x00181063, FrameTime=30), tmp_path / "b.dcm")
    fails("time=0 to 2", film)
    np.testing.assert_array_equal(data(reads(film, time=1))[:, :, 0], voxels()[:, :, 1] - 1024.0)
    colour = elements(dataset, SamplesPerPixel=3)
    fails("in colour", saved(colour, tmp_path / "c.dcm"))


# --- Folders ---------------------------------------------------------------------------------------------------------


def test_folders_with_other_things(tmp_path):
    folder = slices(tmp_path / "a" / "deep", voxels()).parent
    (folder / "notes.txt").write_text("hello")
    report = elements(Dataset(), SOPClassUID="1.2.840.10008.5.1.4.1.1.88.11", SOPInstanceUID=UID + "5", Modality="SR")
    saved(report, folder / "report.dcm")
    scout = picture(np.zeros((9, 9), "i2"), series="2", ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"])
    saved(scout, folder / "scout")
    assert_same(reads(folder, "localisers, which are left out"), voxels() - 1024.0)
    fails("holds no picture", folder / "report.dcm")
    slices(folder, voxels() + np.int16(9), series="3", SeriesDescription="Lung 2.0")
    fails(f"choose one with series=: .*'{UID}3' .CT, Lung 2.0, 3 slices", folder)
    fails("no DICOM series '7'", folder, series="7")
    assert_same(reads(folder, series=UID + "3"), voxels() + 9 - 1024.0)
    (tmp_path / "empty").mkdir()
    saved(report, tmp_path / "empty" / "a")
    fails("no DICOM series .1 DICOM objects without a picture", tmp_path / "empty")


@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian])
def test_files_without_preamble_or_ending(tmp_path, syntax):
    dataset = picture(voxels()[:, :, 0].T.copy())
    path = saved(dataset, tmp_path / "IM0001", syntax, preamble=False)
    assert_same(reads(path), voxels()[:, :, :1] - 1024.0)
    path.rename(tmp_path / "a.dcm")
    assert_same(reads(tmp_path / "a.dcm"), voxels()[:, :, :1] - 1024.0)
    assert_same(reads(saved(dataset, tmp_path / "IM2")), voxels()[:, :, :1] - 1024.0)


# --- Files that would do harm ----------------------------------------------------------------------------------------


def test_a_header_that_announces_more_than_there_is(tmp_path):
    small = picture(voxels()[:, :, 0].T.copy())
    fails("announces .* bytes", saved(elements(copy.deepcopy(small), Rows=46000, Columns=46000), tmp_path / "a.dcm"))
    fails("frames|announces", saved(elements(copy.deepcopy(small), NumberOfFrames=2**31 - 1), tmp_path / "b.dcm"))
    content = saved(small, tmp_path / "c.dcm").read_bytes()
    for cut in (140, 200, 400, len(content) - 20):
        (tmp_path / "c.dcm").write_bytes(content[:cut])
        fails("c.dcm", tmp_path / "c.dcm")
    nesting = b"\x08\x00\x40\x11SQ\x00\x00\xff\xff\xff\xff" + b"\xfe\xff\x00\xe0\xff\xff\xff\xff"
    (tmp_path / "d.dcm").write_bytes(content[:132] + content[132:350] + nesting * 5000)
    fails("d.dcm", tmp_path / "d.dcm")
