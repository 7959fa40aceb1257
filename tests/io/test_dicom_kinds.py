"""Kinds of DICOM objects beside slices of CT and MR: floats, nuclear medicine, ultrasound, mosaics, tiles, and odd files in a folder."""

import imagecodecs
import numpy as np
import pytest
from pydicom.dataset import Dataset
from pydicom.encaps import encapsulate
from pydicom.uid import UID as PydicomUID
from test_dicom import AXIAL, SPACING, UID, data, elements, enhanced, fails, nested, picture, reads, saved, slices, voxels

from jvr.io.volumes import read_volume

FLOATS = (voxels("f8") / 7 - 3).T
WITHOUT = {"RescaleSlope": None, "RescaleIntercept": None}
NO_PLACE = {"ImagePositionPatient": None, "ImageOrientationPatient": None}


@pytest.mark.parametrize(("name", "dtype"), [("FloatPixelData", "f4"), ("DoubleFloatPixelData", "f8")])
@pytest.mark.parametrize("stated", [True, False])
def test_floating_point_pixels_are_not_taken_for_integers(tmp_path, name, dtype, stated):
    """The standard leaves BitsStored, HighBit and PixelRepresentation out; writers leave them in."""
    kept = {} if stated else {"BitsStored": None, "HighBit": None, "PixelRepresentation": None}
    dataset = picture(FLOATS.astype(f"u{dtype[1]}"), SpacingBetweenSlices=3.0, PixelData=None, **kept, **WITHOUT)
    setattr(dataset, name, FLOATS.astype(dtype).tobytes())
    volume = reads(saved(dataset, tmp_path / "a.dcm"))
    np.testing.assert_allclose(volume.values, FLOATS.T, rtol=1e-6)
    setattr(dataset, name.replace("Data", "PaddingValue"), float(FLOATS.astype(dtype)[1, 1, 1]))
    volume = reads(saved(dataset, tmp_path / "a.dcm"), "1 of 105 voxels are")
    assert np.argwhere(np.asarray(volume.gaps) & 1).tolist() == [[1, 1, 1]]


def test_slices_of_floating_point_pixels(tmp_path):
    for k, plane in enumerate(FLOATS.astype("f4")):
        dataset = picture(
            plane.view("u4"), k + 1, ImagePositionPatient=[10.0, -20.0, 30.5 + 3 * k], PixelData=None, RescaleSlope=2
        )
        dataset.FloatPixelData = plane.tobytes()
        saved(dataset, tmp_path / "a" / f"{k}.dcm")
    np.testing.assert_allclose(data(reads(tmp_path / "a")), 2 * FLOATS.T - 1024, rtol=1e-6)


def test_mosaics_and_tiles_of_slides_are_no_slices(tmp_path):
    mosaic = picture(voxels()[:, :, 0].T, ImageType=["ORIGINAL", "PRIMARY", "M", "MOSAIC"])
    fails("a mosaic of all slices.*dcm2niix", saved(mosaic, tmp_path / "a.dcm"))
    slide = picture(np.ascontiguousarray(voxels().T), TotalPixelMatrixColumns=14, TotalPixelMatrixRows=10, **NO_PLACE)
    fails("tiles of one slide of 14 x 10 pixels", saved(slide, tmp_path / "b.dcm"))


def nuclear(values, **keywords):
    dataset = picture(np.ascontiguousarray(values.T).astype("u2"), Modality="NM", **NO_PLACE, **WITHOUT)
    dataset.DetectorInformationSequence = nested(ImagePositionPatient=[10.0, -20.0, 30.5], ImageOrientationPatient=AXIAL)
    return elements(dataset, SpacingBetweenSlices=3.0, **keywords)


@pytest.mark.parametrize("order", [(1, 2, 3), (3, 2, 1), (2, 3, 1)])
def test_slices_of_nuclear_medicine_lie_where_their_vector_says(tmp_path, order):
    """Slice 1 is at the position that is given, wherever in the file it is."""
    values = voxels()
    dataset = nuclear(values[:, :, [k - 1 for k in order]], FrameIncrementPointer=0x00540080, SliceVector=list(order))
    volume = reads(saved(dataset, tmp_path / "a.dcm"))
    np.testing.assert_array_equal(volume.values, values)
    np.testing.assert_allclose(volume.world_from_grid[:3, 3], [10, -20, 30.5])
    np.testing.assert_allclose(volume.spacing, SPACING)


@pytest.mark.parametrize(
    ("pointer", "vectors", "message", "keywords"),
    [
        (0x00540020, {"DetectorVector": [1, 2, 3]}, "detector 1", {"channel": "1"}),
        ([0x00540050, 0x00540090], {"RotationVector": [1, 1, 1], "AngularViewVector": [1, 2, 3]}, "angular view 1", {"time": 1}),
    ],
)
def test_projections_of_nuclear_medicine_are_not_stacked(tmp_path, pointer, vectors, message, keywords):
    path = saved(nuclear(voxels(), FrameIncrementPointer=pointer, **vectors), tmp_path / "a.dcm")
    fails(message, path)
    np.testing.assert_array_equal(reads(path, **keywords).values[:, :, 0], voxels()[:, :, 1])


@pytest.mark.parametrize(("units", "lengths"), [((3, 3), (0.1, 0.2)), ((4, 3), (1, 1)), ((3, 4), (1, 1))])
def test_regions_of_ultrasound_are_lengths_only_along_both_axes(tmp_path, units, lengths):
    """Unit 3 is the centimetre, 4 the second."""
    dataset = picture(voxels("u1")[:, :, 0].T, Modality="US", PixelSpacing=None, **NO_PLACE, **WITHOUT)
    dataset.SequenceOfUltrasoundRegions = nested(
        PhysicalUnitsXDirection=units[0], PhysicalUnitsYDirection=units[1], PhysicalDeltaX=0.01, PhysicalDeltaY=0.02
    )
    said = [] if lengths != (1, 1) else ["PixelSpacing is missing"]
    np.testing.assert_allclose(reads(saved(dataset, tmp_path / "a.dcm"), *said).spacing[:2], lengths)


def test_an_ultrasound_volume_lies_in_its_own_world(tmp_path):
    dataset = enhanced(voxels("u1"), Modality="US")
    for k, item in enumerate(dataset.PerFrameFunctionalGroupsSequence):
        del item.PlanePositionSequence
        item.PlanePositionVolumeSequence = nested(ImagePositionVolume=[1.0, 2.0, 3.0 * k])
    shared = dataset.SharedFunctionalGroupsSequence[0]
    del shared.PlaneOrientationSequence
    shared.PlaneOrientationVolumeSequence = nested(ImageOrientationVolume=AXIAL)
    volume = reads(saved(dataset, tmp_path / "a.dcm"))
    np.testing.assert_array_equal(volume.values, voxels("u1"))
    np.testing.assert_allclose(volume.world_from_grid[:3, 3], [1, 2, 0])


def test_what_is_left_out_is_said(tmp_path):
    dataset = enhanced(voxels("u2"), Modality="MR")
    dataset.SharedFunctionalGroupsSequence[0].RealWorldValueMappingSequence = nested(
        RealWorldValueSlope=0.1, RealWorldValueIntercept=5.0, LUTLabel="ADC"
    )
    path = saved(dataset, tmp_path / "a.dcm")
    reads(path, "its real-world values 'ADC', 0.1 * stored + 5, are not applied: slope= and intercept= do")
    oblong = picture(voxels()[:, :, 0].T, PixelSpacing=None, PixelAspectRatio=[2, 1])
    reads(saved(oblong, tmp_path / "b.dcm"), "as high, though PixelAspectRatio is 2 to 1")
    grey = picture(voxels()[:, :, 0].T, PhotometricInterpretation="MONOCHROME1")
    volume = reads(saved(grey, tmp_path / "c.dcm"), "slope=-1 turns them round")
    assert float(volume.slope) == 1


def test_a_probability_map_is_a_share(tmp_path):
    dataset = enhanced(voxels("u1"), Modality="SEG", SegmentationType="FRACTIONAL", MaximumFractionalValue=250)
    np.testing.assert_allclose(data(reads(saved(dataset, tmp_path / "a.dcm"))), voxels("u1") / 250, rtol=1e-6)


def test_high_throughput_jpeg_2000(tmp_path):
    pixels = np.ascontiguousarray(voxels("u2")[:, :, 1].T)
    dataset = picture(pixels, PixelData=encapsulate([imagecodecs.htj2k_encode(pixels)]), **WITHOUT)
    dataset["PixelData"].is_undefined_length = True
    path = saved(dataset, tmp_path / "a.dcm", PydicomUID("1.2.840.10008.1.2.4.201"))
    np.testing.assert_array_equal(reads(path).values[:, :, 0], pixels.T)


def echoes(folder):
    for echo in (1, 2):
        for k in range(3):
            place = {"ImagePositionPatient": [10.0, -20.0, 30.5 + 3 * k], "EchoTime": float(echo)}
            dataset = picture(np.ascontiguousarray((voxels()[:, :, k] + 1000 * echo).T), 10 * echo + k, Modality="MR", **place)
            saved(dataset, folder / f"{echo}{k}")
    return folder


def test_a_channel_is_chosen_as_the_command_line_and_numpy_say(tmp_path):
    folder = echoes(tmp_path / "a")
    for channel in ("1", np.int64(1), 1, "echo time 2"):
        np.testing.assert_array_equal(read_volume(folder, channel=channel).values, voxels() + 2000)
    fails("channel=True is not there", folder, channel=True)


def test_gaps_are_compared_with_one_that_is_there(tmp_path):
    folder = slices(tmp_path / "a", voxels(), position=lambda k: (10.0, -20.0, (0.0, 3.0, 9.0)[k]))
    fails("unevenly spaced: 6 mm between .*, 3 mm elsewhere", folder)


@pytest.mark.parametrize("kind", ["empty", "text", "link"])
def test_slices_that_were_left_behind_are_said(tmp_path, kind):
    """Without its first slice a series is as even as before."""
    folder = slices(tmp_path / "a", voxels())
    first = next(file for file in folder.iterdir() if read_volume(file).world_from_grid[2, 3] == 30.5)
    first.unlink()
    if kind == "empty":
        first.write_bytes(b"")
    elif kind == "text":
        first.write_text("error 404")
    else:
        first.symlink_to("annex/b1946ac9")
    (folder / "notes.txt").write_text("of no account")
    assert reads(folder, f"files that are empty or no DICOM, and left out: {first.name};").shape == (7, 5, 2)


def test_a_list_of_files_is_named(tmp_path):
    listing = elements(Dataset(), SOPClassUID="1.2.840.10008.1.3.10", SOPInstanceUID=UID + "5", FileSetID="A")
    fails("a DICOMDIR, a list of files: give the folder", saved(listing, tmp_path / "DICOMDIR"))
