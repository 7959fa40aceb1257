"""Readers of our own against others': SimpleITK, pynrrd, nibabel and VTK; and headers that must be refused before anything is read."""

import bz2
import itertools
import os
import zlib

import nibabel
import nrrd
import numpy as np
import pytest
import SimpleITK as sitk

from jvr.io.volumes import VolumeError, read_volume

SHAPE = (7, 5, 3)
TURN = np.linalg.qr(np.array([[2.0, -1.0, 0.3], [0.9, 2.0, -0.4], [0.1, 0.7, 1.5]]))[0]


def voxels(*shape, dtype="<i2"):
    return (np.arange(np.prod(shape)) * 7 % 251).reshape(shape).astype(dtype)


def same_as_itk(path, **keywords):
    image = sitk.ReadImage(str(path))
    volume = read_volume(path, **keywords)
    matrix = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    np.testing.assert_array_equal(np.asarray(volume.values), sitk.GetArrayFromImage(image).T)
    np.testing.assert_allclose(np.asarray(volume.world_from_grid)[:3, :3], matrix, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(np.asarray(volume.world_from_grid)[:3, 3], image.GetOrigin(), rtol=1e-5, atol=1e-4)


def meta(path, content, **fields):
    lines = {"ObjectType": "Image", "NDims": 3, "DimSize": "7 5 3", "ElementType": "MET_SHORT", "ElementSpacing": "0.5 1.25 3"}
    lines |= fields
    lines["ElementDataFile"] = lines.pop("ElementDataFile", "LOCAL")
    path.write_bytes("".join(f"{key} = {value}\n" for key, value in lines.items()).encode() + content)
    return path


@pytest.mark.parametrize("fields", [
    {"Offset": "1 2 3", "TransformMatrix": " ".join(str(x) for x in TURN.T.ravel())},
    {"Position": "1 2 3", "Orientation": " ".join(str(x) for x in TURN.T.ravel())},
    {"Origin": "1 2 3", "Rotation": " ".join(str(x) for x in TURN.T.ravel()), "ElementSize": "9 9 9"},
])  # fmt: skip
def test_metaimages_lie_where_itk_puts_them(tmp_path, fields):
    same_as_itk(meta(tmp_path / "a.mha", voxels(*SHAPE).tobytes(order="F"), **fields))


def test_metaimages_in_text_lists_patterns_and_behind_headers(tmp_path):
    values = voxels(*SHAPE)
    text = " ".join(map(str, values.ravel(order="F"))).encode()
    np.testing.assert_array_equal(np.asarray(read_volume(meta(tmp_path / "a.mha", text, BinaryData=False)).values), values)
    for k in range(3):
        (tmp_path / f"{k}.raw").write_bytes(b"head" + values[:, :, k].tobytes(order="F"))
    names = "LIST\n" + "\n".join(f"{k}.raw" for k in range(3))
    same_as_itk(meta(tmp_path / "b.mhd", b"", HeaderSize=4, ElementDataFile=names))
    same_as_itk(meta(tmp_path / "c.mhd", b"", HeaderSize=4, ElementDataFile="%d.raw 0 2 1"))
    (tmp_path / "d.raw").write_bytes(b"any head" + values.tobytes(order="F"))
    same_as_itk(meta(tmp_path / "d.mhd", b"", HeaderSize=-1, ElementDataFile="d.raw"))


def test_one_channel_and_one_time_of_a_metaimage(tmp_path):
    values = voxels(2, *SHAPE, 4)
    fields = {"NDims": 4, "DimSize": "7 5 3 4", "ElementSpacing": "1 1 1 0", "ElementNumberOfChannels": 2}
    path = meta(tmp_path / "a.mha", values.tobytes(order="F"), **fields)
    np.testing.assert_array_equal(np.asarray(read_volume(path, channel=1, time=2).values), values[1, ..., 2])
    with pytest.raises(VolumeError, match="2 channels; choose one with channel="):
        read_volume(path)
    with pytest.raises(VolumeError, match="4 points in time; choose one with time="):
        read_volume(path, channel=0)


def test_what_metaimages_leave_open_is_said(tmp_path):
    content = voxels(*SHAPE).tobytes(order="F")
    with pytest.warns(UserWarning, match="AnatomicalOrientation says LAS"):
        read_volume(meta(tmp_path / "a.mha", content, AnatomicalOrientation="LAS"))
    with pytest.warns(UserWarning, match="4 bytes behind the 210"):
        read_volume(meta(tmp_path / "a.mha", content + b"more"))
    path = meta(tmp_path / "a.mha", content, DistanceUnits="um")
    np.testing.assert_allclose(np.asarray(read_volume(path).spacing), np.array([0.5, 1.25, 3]) * 1e-3, rtol=1e-6)
    path.write_bytes(path.read_bytes().replace(b"ElementSpacing = 0.5 1.25 3\n", b"").replace(b"DistanceUnits = um\n", b""))
    with pytest.warns(UserWarning, match="lacks 'ElementSpacing"):
        read_volume(path)


# ITK has no bzip2.
@pytest.mark.parametrize("encoding", ["raw", "gzip", "ASCII"])
@pytest.mark.parametrize("space", ["right-anterior-superior", "left-anterior-superior", "left-posterior-superior"])
def test_nrrd_of_pynrrd_lies_where_itk_puts_it(tmp_path, encoding, space):
    header = {"space": space, "space directions": (TURN * [0.5, 1.25, 3]).T, "space origin": [1, 2, 3], "encoding": encoding}
    nrrd.write(str(tmp_path / "a.nrrd"), voxels(*SHAPE), header)
    same_as_itk(tmp_path / "a.nrrd")


@pytest.mark.parametrize("at", range(4))
def test_a_list_axis_of_a_nrrd_anywhere(tmp_path, at):
    values = voxels(*SHAPE[:at], 2, *SHAPE[at:])
    directions = np.insert(np.diag([0.5, 1.25, 3]), at, np.nan, axis=0)
    kinds = ["domain"] * 3
    kinds.insert(at, "list")
    nrrd.write(str(tmp_path / "a.nrrd"), values, {"space": "LPS", "space directions": directions, "kinds": kinds})
    volume = read_volume(tmp_path / "a.nrrd", channel=1)
    np.testing.assert_array_equal(np.asarray(volume.values), np.take(values, 1, axis=at))
    np.testing.assert_allclose(np.asarray(volume.spacing), [0.5, 1.25, 3], rtol=1e-6)


def test_nrrd_with_hex_digits_skips_and_units(tmp_path):
    values = voxels(*SHAPE)
    head = "NRRD0005\ntype: int16\ndimension: 3\nsizes: 7 5 3\nendian: little\nspacings: 500 1250 3000\nsample units: HU\n"
    head += 'units: "um" "µm" "micron"\ndata file: a.txt\n'
    (tmp_path / "a.txt").write_bytes(b"a line\n" + values.tobytes(order="F").hex().encode())
    (tmp_path / "a.nhdr").write_text(head + "encoding: hex\nline skip: 1\n", encoding="latin-1")
    volume = read_volume(tmp_path / "a.nhdr")
    np.testing.assert_array_equal(np.asarray(volume.values), values)
    np.testing.assert_allclose(np.asarray(volume.spacing), [0.5, 1.25, 3], rtol=1e-6)
    (tmp_path / "a.txt").write_bytes(bz2.compress(b"12345" + values.tobytes(order="F")))
    (tmp_path / "a.nhdr").write_text(head + "encoding: bzip2\nbyte skip: 5\n", encoding="latin-1")
    np.testing.assert_array_equal(np.asarray(read_volume(tmp_path / "a.nhdr").values), values)


@pytest.mark.parametrize("kind", [nibabel.Nifti1Image, nibabel.Nifti2Image, nibabel.Nifti1Pair])
@pytest.mark.parametrize("form", ["qform", "sform"])
@pytest.mark.parametrize("mirror", [1, -1])
def test_nifti_lies_where_nibabel_puts_it(tmp_path, kind, form, mirror):
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = TURN * [0.5, 1.25, 3 * mirror], (1, 2, 3)
    image = kind(voxels(*SHAPE), affine)
    image.header.set_xyzt_units("mm")
    image.set_sform(affine if form == "sform" else None, int(form == "sform"))
    image.set_qform(affine if form == "qform" else None, int(form == "qform"))
    path = tmp_path / ("a.img" if kind is nibabel.Nifti1Pair else "a.nii.gz")
    nibabel.save(image, path)
    volume = read_volume(path)
    wanted = np.diag([-1, -1, 1, 1]) @ nibabel.load(path).affine
    np.testing.assert_allclose(np.asarray(volume.world_from_grid), wanted, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(np.asarray(volume.values), voxels(*SHAPE))


def test_nifti_that_contradicts_itself_or_leaves_open(tmp_path):
    image = nibabel.Nifti1Image(voxels(*SHAPE, 4), np.diag([2.0, 2, 2, 1]))
    image.header["pixdim"][1:4] = 1
    nibabel.save(image, tmp_path / "a.nii")
    raw = bytearray((tmp_path / "a.nii").read_bytes())
    raw[80:92] = np.array([1, 1, 1], "<f4").tobytes()
    (tmp_path / "a.nii").write_bytes(raw)
    with (
        pytest.warns(UserWarning, match="pixdim says voxels of 1 x 1 x 1, the sform 2 x 2 x 2"),
        pytest.warns(UserWarning, match="xyzt_units"),
    ):
        volume = read_volume(tmp_path / "a.nii", time=2)
    np.testing.assert_array_equal(np.asarray(volume.values), voxels(*SHAPE, 4)[..., 2])


def test_vti_and_legacy_vtk_as_vtk_writes_them(tmp_path):
    vtk = pytest.importorskip("vtk", reason="needs the optional package vtk")
    from vtkmodules.util.numpy_support import numpy_to_vtk

    values, flow = voxels(*SHAPE), np.random.default_rng(0).normal(size=(*SHAPE, 3)).astype("f4")
    image = vtk.vtkImageData()
    image.SetDimensions(*SHAPE)
    for name, array in (("a b", values.ravel(order="F")), ("flow", flow.transpose(2, 1, 0, 3).reshape(-1, 3))):
        side = numpy_to_vtk(array, deep=True)
        side.SetName(name)
        image.GetPointData().AddArray(side)
    image.GetPointData().SetActiveScalars("a b")
    for mode, packed, head, order in itertools.product(
        ("Ascii", "Binary", "Appended"), ("None", "ZLib", "LZMA"), (32, 64), (0, 1)
    ):
        writer = vtk.vtkXMLImageDataWriter()
        writer.SetInputData(image)
        writer.SetFileName(str(tmp_path / "a.vti"))
        getattr(writer, f"SetDataModeTo{mode}")()
        getattr(writer, f"SetCompressorTypeTo{packed}")()
        writer.SetHeaderType(head)
        writer.SetByteOrder(order)
        writer.SetBlockSize(64)
        writer.SetEncodeAppendedData(head == 32)
        writer.Write()
        np.testing.assert_array_equal(np.asarray(read_volume(tmp_path / "a.vti").values), values)
        np.testing.assert_allclose(
            np.asarray(read_volume(tmp_path / "a.vti", array="flow", channel=1).values), flow[..., 1], rtol=1e-5
        )
    for text in (True, False):
        writer = vtk.vtkStructuredPointsWriter()
        writer.SetInputData(image)
        writer.SetFileName(str(tmp_path / "a.vtk"))
        writer.SetFileTypeToASCII() if text else writer.SetFileTypeToBinary()
        writer.Write()
        np.testing.assert_array_equal(np.asarray(read_volume(tmp_path / "a.vtk").values), values)
        np.testing.assert_allclose(
            np.asarray(read_volume(tmp_path / "a.vtk", array="flow", channel=2).values), flow[..., 2], rtol=1e-5
        )


def test_headers_that_would_harm_are_refused(tmp_path):
    def refused(path, match):
        with pytest.raises(VolumeError, match=match):
            read_volume(path)

    for axes in (5000, 4294967295):
        refused(meta(tmp_path / "a.mha", b"", NDims=axes), f"NDims is {axes}")
    refused(meta(tmp_path / "a.mhd", b"", ElementDataFile="/dev/zero"), "no ordinary file")
    os.mkfifo(tmp_path / "pipe")
    refused(meta(tmp_path / "a.mhd", b"", ElementDataFile="pipe"), "no ordinary file")
    os.mkfifo(tmp_path / "b.nii")
    refused(tmp_path / "b.nii", "no ordinary file")
    bomb = zlib.compress(bytes(10**8), 9)
    with pytest.warns(UserWarning, match="more is packed than the 210 bytes"):
        read_volume(meta(tmp_path / "a.mha", bomb, CompressedData=True))
    kinds = "NRRD0005\ntype: short\ndimension: 3\nsizes: 7 5 3\nencoding: raw\nkinds: " + "domain " * 200 + "\n\n"
    (tmp_path / "a.nrrd").write_bytes(kinds.encode())
    refused(tmp_path / "a.nrrd", "cut short")
    laughs = '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "ha">]><VTKFile type="ImageData"></VTKFile>'
    (tmp_path / "a.vti").write_text(laughs)
    refused(tmp_path / "a.vti", "document type or entities")
