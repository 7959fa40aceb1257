"""Volumes read from files: every voxel where the file says it is, and one clear line for each file that is not a volume."""

import gzip
import json
import re
import struct
import subprocess
import sys
import zlib

import jax.numpy as jnp
import numpy as np
import pytest
import SimpleITK as sitk
import tifffile
import zarr

from jvr.io.volumes import VolumeError, read_volume

SHAPE, SPACING, ORIGIN = (7, 5, 3), (0.5, 1.25, 3.0), (10.0, -20.0, 30.5)
# Orthonormal and far from any axis: a wrong transpose cannot go unnoticed.
TURN = np.linalg.qr(np.array([[2.0, -1.0, 0.3], [0.9, 2.0, -0.4], [0.1, 0.7, 1.5]]))[0]
TURN = TURN * np.sign(np.linalg.det(TURN))


def voxels(dtype="i2", shape=SHAPE):
    """Values that are all different, indexed [x, y, z]."""
    x, y, z = np.meshgrid(*[np.arange(n) for n in shape], indexing="ij")
    return (x + 10 * y + 80 * z).astype(dtype)


def itk_image(values, direction=TURN):
    image = sitk.GetImageFromArray(np.ascontiguousarray(values.T))
    image.SetSpacing(SPACING)
    image.SetOrigin(ORIGIN)
    image.SetDirection(direction.ravel())
    return image


def assert_same(volume, values, *, direction=None, spacing=SPACING, origin=ORIGIN, dtype=None):
    """Every voxel, the type, and the world position of three voxels by the definition of the grid."""
    assert volume.shape == values.shape
    np.testing.assert_array_equal(np.asarray(volume.values), values)
    assert volume.values.dtype == np.dtype(dtype or values.dtype)
    direction = np.eye(3) if direction is None else direction
    for index in ((0, 0, 0), (1, 2, 1), tuple(n - 1 for n in values.shape)):
        wanted = np.asarray(origin) + sum(direction[:, a] * spacing[a] * index[a] for a in range(3))
        found = np.asarray(volume.world_from_grid) @ [*index, 1.0]
        np.testing.assert_allclose(found[:3], wanted, rtol=1e-5, atol=1e-4)


def fails(match, path, error=VolumeError, **keywords):
    """Reading `path` raises one line that names the file and matches."""
    with pytest.raises(error, match=match) as caught:
        read_volume(path, **keywords)
    assert "\n" not in str(caught.value)
    assert path.name in str(caught.value)


# --- MetaImage, NRRD -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.mhd", "a.mha", "a.nrrd", "a.nhdr", "a.nii", "a.nii.gz"])
@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", ["u1", "i2", "f4"])
def test_formats_of_itk_with_an_oblique_anisotropic_grid(tmp_path, name, compressed, dtype):
    values = voxels(dtype)
    sitk.WriteImage(itk_image(values), str(tmp_path / name), compressed)
    assert_same(read_volume(tmp_path / name), values, direction=TURN)


def test_endings_in_capitals(tmp_path):
    sitk.WriteImage(itk_image(voxels()), str(tmp_path / "a.mha"))
    assert_same(read_volume((tmp_path / "a.mha").rename(tmp_path / "A.MHA")), voxels(), direction=TURN)


def metaimage(path, values, **fields):
    header = {"NDims": 3, "BinaryDataByteOrderMSB": False, "DimSize": "7 5 3", "ElementSpacing": "0.5 1.25 3"}
    header |= {"Offset": "10 -20 30.5", "ElementType": "MET_SHORT"} | fields
    header["ElementDataFile"] = header.pop("ElementDataFile", "data.raw")
    path.write_text("ObjectType = Image\n" + "".join(f"{key} = {value}\n" for key, value in header.items()))
    (path.parent / "data.raw").write_bytes(values.tobytes(order="F"))
    return path


def test_metaimage_of_compressed_big_endian_bytes(tmp_path):
    fields = {"CompressedData": True, "BinaryDataByteOrderMSB": True, "ElementDataFile": "a.zraw"}
    path = metaimage(tmp_path / "a.mhd", voxels(">i2"), **fields)
    (tmp_path / "a.zraw").write_bytes(zlib.compress(voxels(">i2").tobytes(order="F")))
    assert_same(read_volume(path), voxels())


def test_metaimage_of_big_endian_bytes_with_an_intensity_function(tmp_path):
    extra = {"ElementToIntensityFunctionSlope": 2, "ElementToIntensityFunctionOffset": -5}
    path = metaimage(tmp_path / "a.mhd", voxels(">i2"), BinaryDataByteOrderMSB=True)
    assert_same(read_volume(path), voxels())
    volume = read_volume(metaimage(tmp_path / "a.mhd", voxels(">i2"), BinaryDataByteOrderMSB=True, **extra))
    assert_same(volume, voxels())
    assert float(volume.sample((jnp.array(3.0), jnp.array(2.0), jnp.array(1.0)))) == 2 * voxels()[3, 2, 1] - 5


@pytest.mark.parametrize("spacing", ["0 1 1", "1 -1 1", "1 nan 1", "1 inf 1", "1 one 1"])
def test_metaimage_of_bad_spacing_is_refused(tmp_path, spacing):
    fails("ElementSpacing", metaimage(tmp_path / "a.mhd", voxels(), ElementSpacing=spacing))


def test_metaimages_that_are_cut_short_or_announce_too_much(tmp_path):
    fails("210 bytes.*holds 200 bytes", metaimage(tmp_path / "a.mhd", voxels().ravel()[:100]))
    fails("cut short", metaimage(tmp_path / "b.mhd", voxels(), DimSize="70000 70000 70000"))
    fails("whole numbers", metaimage(tmp_path / "c.mhd", voxels(), DimSize="7 -5 3"))
    fails("missing.raw", metaimage(tmp_path / "d.mhd", voxels(), ElementDataFile="missing.raw"))
    fails("lacks 'DimSize", _without_size(tmp_path))
    fails("HeaderSize is '1E3'", metaimage(tmp_path / "f.mhd", voxels(), HeaderSize="1E3"))
    sitk.WriteImage(itk_image(voxels()), str(tmp_path / "z.mha"), True)
    whole = (tmp_path / "z.mha").read_bytes()
    (tmp_path / "z.mha").write_bytes(whole[:-40])
    fails("cut short", tmp_path / "z.mha")


def _without_size(folder):
    path = metaimage(folder / "e.mhd", voxels())
    path.write_text("".join(line + "\n" for line in path.read_text().splitlines() if not line.startswith("DimSize")))
    return path


def test_metaimage_whose_zlib_stream_is_damaged_or_a_bomb(tmp_path):
    stream = zlib.compress(voxels().tobytes(order="F"))
    path = metaimage(tmp_path / "a.mhd", voxels(), CompressedData=True, ElementDataFile="a.zraw")
    (tmp_path / "a.zraw").write_bytes(stream)
    assert_same(read_volume(path), voxels())
    flipped = bytearray(stream)
    flipped[len(stream) // 2] ^= 4
    for damaged in (stream[: len(stream) // 2], stream[:-6], bytes(flipped), zlib.compress(bytes(200)), bytes(100)):
        (tmp_path / "a.zraw").write_bytes(damaged)
        fails("compressed data .*export it again", path)
    path = metaimage(tmp_path / "b.mhd", voxels(), CompressedData=True, ElementDataFile="a.zraw", DimSize="2000 2000 2000")
    fails("cut short", path)


@pytest.mark.parametrize("name", ["a.mha", "a.nrrd", "a.nii.gz", "a.zraw"])
def test_labels_that_pack_very_well_are_unpacked_to_the_last_voxel(tmp_path, name):
    values = np.zeros((300, 301, 100), "u1")
    for k in range(100):
        values[7 * k % 290 : 7 * k % 290 + 9, :, k] = k % 29 + 1
    if name == "a.zraw":
        # As in the public frog: ITK's reader stops where the header says, and leaves the last slices to chance.
        stream = zlib.compress(values.tobytes(order="F"), 9)
        fields = {"CompressedData": True, "ElementDataFile": name, "CompressedDataSize": len(stream) - 200}
        path = metaimage(tmp_path / "a.mhd", values, **fields, ElementType="MET_UCHAR", DimSize="300 301 100")
        (tmp_path / name).write_bytes(stream)
    else:
        path = tmp_path / name
        sitk.WriteImage(itk_image(values), str(path), True)
    junk = [np.full(values.size, 77, "u1") for _ in range(3)]
    del junk
    np.testing.assert_array_equal(np.asarray(read_volume(path).values), values)


def nrrd(path, body, **fields):
    lines = {"type": "short", "dimension": 3, "sizes": "7 5 3", "endian": "little", "encoding": "raw"} | fields
    header = "NRRD0005\n# a comment\n" + "".join(f"{key.replace('_', ' ')}: {value}\n" for key, value in lines.items())
    path.write_bytes(header.encode() + b"\n" + body)
    return path


def test_nrrd_in_ras_with_sheared_axes_becomes_lps(tmp_path):
    axes = np.array([[2.0, 0, 0], [0.7, 3, 0], [0, 0, 4]])
    directions = " ".join(f"({a},{b},{c})" for a, b, c in axes)
    fields = {"space": "right-anterior-superior", "space_directions": directions, "space_origin": "(1,2,3)"}
    volume = read_volume(nrrd(tmp_path / "a.nrrd", voxels().tobytes(order="F"), **fields))
    np.testing.assert_array_equal(np.asarray(volume.values), voxels())
    wanted = (np.array([1.0, 2, 3]) + np.array([4, 3, 2]) @ axes) * [-1, -1, 1]
    np.testing.assert_allclose((np.asarray(volume.world_from_grid) @ [4, 3, 2, 1.0])[:3], wanted, rtol=1e-6)


def test_bad_nrrd_files(tmp_path):
    body = voxels().tobytes(order="F")
    fails("holds 200 bytes", nrrd(tmp_path / "a.nrrd", body[:200]))
    fails("spacings", nrrd(tmp_path / "b.nrrd", body, spacings="1 1 0"))
    fails("spacings", nrrd(tmp_path / "c.nrrd", body, spacings="1 -1 1"))
    fails("space directions", nrrd(tmp_path / "d.nrrd", body, space="LPS", space_directions="(0,0,0) (0,1,0) (0,0,1)"))
    fails("cut short", nrrd(tmp_path / "e.nrrd", body, sizes="70000 70000 70000"))
    fails("damaged|cut short", nrrd(tmp_path / "f.nrrd", gzip.compress(body)[:50], encoding="gzip"))
    fails("sizes", nrrd(tmp_path / "g.nrrd", body, sizes="7 0 3"))
    fails(
        "2 channels; choose one with channel=",
        nrrd(tmp_path / "h.nrrd", body * 2, dimension=4, sizes="2 7 5 3", kinds="vector domain domain domain"),
    )
    fails("gone.raw", nrrd(tmp_path / "i.nhdr", b"", **{"data_file": "gone.raw"}))


# --- NIfTI -----------------------------------------------------------------------------------------------------------


def nifti(values, *, code=4, slope=0.0, inter=0.0, pixdim=SPACING, srow=None, order="<", dim=None, sform=1):
    """A NIfTI-1 file written field by field."""
    header = bytearray(352)
    dim = dim or (3, *values.shape, 1, 1, 1, 1)
    struct.pack_into(order + "i", header, 0, 348)
    struct.pack_into(order + "8h", header, 40, *dim)
    struct.pack_into(order + "2h", header, 70, code, values.dtype.itemsize * 8)
    struct.pack_into(order + "8f", header, 76, 1, *pixdim, 1, 1, 1, 1)
    struct.pack_into(order + "3f", header, 108, 352, slope, inter)
    header[123] = 2
    struct.pack_into(order + "2h", header, 252, 0, sform)
    srow = np.array([[0.5, 0, 0, -10], [0, 1.25, 0, 20], [0, 0, 3, 30.5]]) if srow is None else srow
    struct.pack_into(order + "12f", header, 280, *np.ravel(srow))
    header[344:348] = b"n+1\0"
    return bytes(header) + values.tobytes(order="F")


FLIPPED = np.diag([-1.0, -1.0, 1.0])


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
def test_nifti_keeps_integers_with_slope_and_intercept(tmp_path, order, name):
    content = nifti(voxels(order + "i2"), slope=0.25, inter=-1000.0, order=order)
    (tmp_path / name).write_bytes(gzip.compress(content) if name.endswith("gz") else content)
    volume = read_volume(tmp_path / name)
    assert_same(volume, voxels(), direction=FLIPPED)
    assert (float(volume.slope), float(volume.intercept)) == (0.25, -1000.0)
    assert float(volume.sample((jnp.array(6.0), jnp.array(4.0), jnp.array(2.0)))) == 0.25 * voxels()[6, 4, 2] - 1000


@pytest.mark.parametrize("slope", [0.0, float("nan")])
def test_nifti_slope_of_zero_or_nan_means_unscaled(tmp_path, slope):
    (tmp_path / "a.nii").write_bytes(nifti(voxels(), slope=slope, inter=7.0))
    volume = read_volume(tmp_path / "a.nii")
    assert (float(volume.slope), float(volume.intercept)) == (1.0, 0.0)


def test_nifti_with_a_sheared_sform_which_itk_refuses(tmp_path):
    srow = np.array([[2.0, 0.7, 0, 5], [0, 3, 0, 6], [0, 0, 4, 7]])
    (tmp_path / "a.nii").write_bytes(nifti(voxels(), srow=srow, pixdim=(2, 3.08, 4)))
    found = np.asarray(read_volume(tmp_path / "a.nii").world_from_grid) @ [4, 3, 2, 1]
    np.testing.assert_allclose(found[:3], (srow @ [4, 3, 2, 1]) * [-1, -1, 1], rtol=1e-6)


def test_wide_integers_become_as_narrow_as_they_fit(tmp_path):
    for low, high, dtype in ((0, 255, "u1"), (-1, 100, "i1"), (-1207, 3382, "i2"), (0, 60000, "u2"), (-1, 60000, "i4")):
        values = voxels("i4").clip(0, 1)
        values[0, 0, 0], values[1, 0, 0] = low, high
        (tmp_path / "a.nii").write_bytes(nifti(values, code=8))
        assert_same(read_volume(tmp_path / "a.nii"), values, direction=FLIPPED, dtype=dtype)


def test_bad_nifti_files(tmp_path):
    def written(name, content):
        (tmp_path / name).write_bytes(content)
        return tmp_path / name

    good = nifti(voxels())
    fails("holds 200 bytes", written("a.nii", good[:-10]))
    fails("compressed data", written("b.nii.gz", gzip.compress(good)[:-60]))
    fails("unpack to 200 bytes, the header announces 210", written("c.nii.gz", gzip.compress(good[:-10])))
    fails("looks like text", written("d.nii.gz", b"hello, this is a note"))
    fails("looks like gzip", written("e.nii", gzip.compress(good)))
    fails("not a gzip-compressed", written("f.nii.gz", good))
    fails("looks like a PNG", written("g.nii", b"\x89PNG\r\n\x1a\n" + bytes(600)))
    fails("RGB", written("h.nii", nifti(voxels(), code=128)))
    fails("complex", written("i.nii", nifti(voxels("c8"), code=32)))
    for bad in (0.0, -1.0, float("nan"), float("inf")):
        fails(r"pixdim\[2\]", written("j.nii", nifti(voxels(), pixdim=(1, bad, 1))))
    fails("cut short", written("k.nii.gz", gzip.compress(nifti(voxels(), dim=(3, 30000, 30000, 30000, 1, 1, 1, 1)))))
    fails(
        "2 points in time; choose one with time=",
        written("l.nii", nifti(np.stack([voxels()] * 2, -1), dim=(4, *SHAPE, 2, 1, 1, 1))),
    )
    flipped = bytearray(gzip.compress(good))
    flipped[-6] ^= 1
    fails("damaged", written("m.nii.gz", bytes(flipped)))


def test_four_axes_with_a_trailing_one_are_a_volume(tmp_path):
    (tmp_path / "a.nii").write_bytes(nifti(voxels(), dim=(4, *SHAPE, 1, 1, 1, 1)))
    assert_same(read_volume(tmp_path / "a.nii"), voxels(), direction=FLIPPED)


# --- VTK -------------------------------------------------------------------------------------------------------------

LEGACY_TYPES = {"u1": "unsigned_char", "i2": "short", "i4": "int", "f4": "float", "f8": "double"}


def legacy(path, values, *, text, spacing="SPACING", kind=None, extra=True, numbers="0.5 1.25 3", body=None, header=""):
    """A legacy VTK file by hand, a vector array behind the scalars."""
    name = kind or LEGACY_TYPES[values.dtype.str[1:]]
    start = f"# vtk DataFile Version 3.0\ntitle\n{'ASCII' if text else 'BINARY'}\nDATASET STRUCTURED_POINTS\n"
    start += f"DIMENSIONS 7 5 3\n{spacing} {numbers}\nORIGIN 10 -20 30.5\nPOINT_DATA {values.size}\n{header}"
    start += f"SCALARS density {name} 1\nLOOKUP_TABLE default\n"
    vectors = np.arange(3 * values.size, dtype=">f4")
    encoded = lambda a: (
        " ".join(map(str, a.ravel(order="F"))).encode() if text else a.astype(a.dtype.newbyteorder(">")).tobytes("F")
    )
    end = b"\nVECTORS flow float\n" + encoded(vectors) if extra else b""
    path.write_bytes(start.encode() + (encoded(values) if body is None else body) + end)
    return path


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("spacing", ["SPACING", "ASPECT_RATIO"])
@pytest.mark.parametrize("dtype", ["u1", "i2", "f4"])
def test_legacy_vtk(tmp_path, text, spacing, dtype):
    assert_same(read_volume(legacy(tmp_path / "a.vtk", voxels(dtype), text=text, spacing=spacing)), voxels(dtype))


def test_legacy_vtk_that_begins_with_vectors_or_holds_field_data(tmp_path):
    vectors = "VECTORS flow float\n" + "1 2 3 " * voxels().size + "\n"
    path = legacy(tmp_path / "a.vtk", voxels(), text=True, extra=False, header=vectors)
    assert_same(read_volume(path), voxels())
    numbers = " ".join(map(str, voxels().ravel(order="F")))
    field = path.read_text().split("VECTORS")[0]
    field += f"FIELD all 2\nzero 1 105 short\n{'0 ' * 105}\ndensity 1 105 short\n{numbers}\n"
    path.write_text(field)
    fails("choose one with array=: 'zero', 'density'", path)
    fails("no array 'mass'; array= may be 'zero', 'density'", path, array="mass")
    assert_same(read_volume(path, array="density"), voxels())
    path.write_text(field[: len(field) // 2])
    fails("cut short", path)


def test_bad_legacy_vtk(tmp_path):
    whole = voxels().astype(">i2").tobytes("F")
    fails("210 bytes.*200 bytes", legacy(tmp_path / "a.vtk", voxels(), text=False, extra=False, body=whole[:200]))
    fails("105 voxels, fewer", legacy(tmp_path / "b.vtk", voxels(), text=True, extra=False, body=b"1 " * 104))
    fails("105 voxels, fewer", legacy(tmp_path / "c.vtk", voxels(), text=True, extra=True, body=b"1 " * 104))
    for numbers in ("0 1 1", "1 -1 1", "nan 1 1"):
        fails("SPACING", legacy(tmp_path / "d.vtk", voxels(), text=False, numbers=numbers))
    path = legacy(tmp_path / "e.vtk", voxels(), text=False)
    path.write_bytes(path.read_bytes().replace(b"STRUCTURED_POINTS", b"UNSTRUCTURED_GRID"))
    fails("UNSTRUCTURED_GRID", path)
    path = legacy(tmp_path / "f.vtk", voxels(), text=False)
    path.write_bytes(path.read_bytes().replace(b"7 5 3", b"70000 70000 70000"))
    fails("cut short", path)
    path = legacy(tmp_path / "g.vtk", voxels(), text=True, extra=False)
    start = path.read_text().split("SCALARS")[0]
    path.write_text(start + "VECTORS flow float\n" + "1 2 3 " * 105)
    fails("no scalar array", path)


def vti(path, values, *, cells=False, extent=(2, 8, -1, 3, 0, 2), spacing="0.5 1.25 3"):
    """A VTI by hand, ASCII, with a direction and an extent that does not begin at zero; vectors come first."""
    data = "CellData" if cells else "PointData"
    numbers = " ".join(map(str, values.ravel(order="F")))
    ends = " ".join(map(str, extent))
    turn = " ".join(f"{x:.17g}" for x in TURN.ravel())
    vectors = "0 0 1 " * values.size
    path.write_text(
        f'<?xml version="1.0"?>\n<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian">\n'
        f'<ImageData WholeExtent="{ends}" Origin="10 -20 30.5" Spacing="{spacing}" Direction="{turn}"><Piece Extent="{ends}">'
        f'<{data}><DataArray type="Float32" Name="flow" NumberOfComponents="3" format="ascii">{vectors}</DataArray>'
        f'<DataArray type="Int16" Name="density" format="ascii">{numbers}</DataArray></{data}></Piece></ImageData></VTKFile>'
    )
    return path


def test_vti_with_direction_and_extent(tmp_path):
    origin = np.array(ORIGIN) + TURN @ (np.array(SPACING) * [2, -1, 0])
    assert_same(read_volume(vti(tmp_path / "a.vti", voxels())), voxels(), direction=TURN, origin=origin)
    origin = np.array(ORIGIN) + TURN @ (np.array(SPACING) * 0.5)
    path = vti(tmp_path / "b.vti", voxels(), cells=True, extent=(0, 7, 0, 5, 0, 3))
    assert_same(read_volume(path), voxels(), direction=TURN, origin=origin)


def test_bad_vti(tmp_path):
    path = vti(tmp_path / "a.vti", voxels())
    path.write_text(path.read_text()[:-400])
    fails("cut short", path)
    for spacing in ("0 1 1", "1 -2 1", "nan 1 1"):
        fails("Spacing", vti(tmp_path / "b.vti", voxels(), spacing=spacing))
    fails("cut short", vti(tmp_path / "c.vti", voxels(), extent=(0, 9999, 0, 9999, 0, 9999)))
    (tmp_path / "d.vti").write_text("<?xml version='1.0'?><VTKFile type='PolyData'></VTKFile>")
    fails("PolyData", tmp_path / "d.vti")


# --- TIFF, NumPy, Zarr, raw ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", [None, "deflate"])
def test_tiff_stack(tmp_path, compression):
    tifffile.imwrite(tmp_path / "a.tif", np.ascontiguousarray(voxels().T), compression=compression, photometric="minisblack")
    assert_same(read_volume(tmp_path / "a.tif"), voxels(), spacing=(1, 1, 1), origin=(0, 0, 0))
    assert_same(read_volume(tmp_path / "a.tif", spacing=SPACING, origin=ORIGIN), voxels())


def test_tiff_voxel_sizes_of_imagej_and_ome(tmp_path):
    stack, none = np.ascontiguousarray(voxels().T), (0, 0, 0)
    metadata = {"spacing": 3000.0, "unit": "um", "axes": "ZYX"}
    tifffile.imwrite(tmp_path / "a.tif", stack, imagej=True, resolution=(1 / 500, 1 / 1250), metadata=metadata)
    assert_same(read_volume(tmp_path / "a.tif"), voxels(), origin=none)
    sizes = {"PhysicalSizeX": 500.0, "PhysicalSizeY": 1250.0, "PhysicalSizeZ": 3.0, "PhysicalSizeZUnit": "mm"}
    tifffile.imwrite(tmp_path / "b.ome.tif", stack, metadata={"axes": "ZYX", **sizes})
    assert_same(read_volume(tmp_path / "b.ome.tif"), voxels(), origin=none)


def test_one_image_becomes_a_volume_of_one_voxel_in_depth(tmp_path):
    values = voxels()[:, :, :1]
    tifffile.imwrite(tmp_path / "a.tif", np.ascontiguousarray(values[..., 0].T))
    assert_same(read_volume(tmp_path / "a.tif"), values, spacing=(1, 1, 1), origin=(0, 0, 0))
    image = sitk.GetImageFromArray(np.ascontiguousarray(values[..., 0].T))
    image.SetSpacing(SPACING[:2])
    image.SetOrigin(ORIGIN[:2])
    sitk.WriteImage(image, str(tmp_path / "a.mha"))
    assert_same(read_volume(tmp_path / "a.mha"), values, spacing=(*SPACING[:2], 1), origin=(*ORIGIN[:2], 0))


def test_bad_tiff(tmp_path):
    rng = np.random.default_rng(0)
    for compression in (None, "deflate"):
        path = tmp_path / "a.tif"
        tifffile.imwrite(path, rng.integers(0, 99, (4, 5, 7), dtype="i2"), compression=compression, photometric="minisblack")
        whole = path.read_bytes()
        for kept in (len(whole) - 60, len(whole) // 2, 12):
            path.write_bytes(whole[:kept])
            fails("cut short|damaged", path)
    tifffile.imwrite(tmp_path / "b.tif", np.zeros((5, 7, 3), "u1"), photometric="rgb")
    fails("colour", tmp_path / "b.tif")
    with tifffile.TiffWriter(tmp_path / "c.tif") as file:
        for n in (4, 5):
            file.write(np.zeros((n, 7), "u1"))
    fails("2 images", tmp_path / "c.tif")


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["u1", ">i2", "f4"])
def test_npy(tmp_path, order, dtype):
    np.save(tmp_path / "a.npy", np.asarray(voxels(dtype), order=order))
    native = np.dtype(dtype).newbyteorder("=")
    assert_same(read_volume(tmp_path / "a.npy", spacing=SPACING, origin=ORIGIN), voxels(native))
    np.save(tmp_path / "b.npy", voxels(dtype).T)
    assert_same(read_volume(tmp_path / "b.npy", spacing=SPACING, origin=ORIGIN, axes="zyx"), voxels(native))


class Trap:
    """Unpickling this raises the exception that no test expects."""

    def __reduce__(self):
        return (pytest.fail, ("the file was unpickled",))


def test_bad_npy(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.array([[[Trap()]]], dtype=object), allow_pickle=True)
    fails("never unpickled", path)
    np.save(path, voxels("c8"))
    fails("complex", path)
    np.save(path, voxels())
    path.write_bytes(path.read_bytes()[:-10])
    fails("cut short", path)
    path.write_bytes(path.read_bytes().replace(b"(7, 5, 3)", b"(7, 5, 3000000)").replace(b" " * 6, b"", 1))
    fails("cut short", path)
    path.write_bytes(path.read_bytes().replace(b"(7, 5, ", b"((7, 5,"))
    fails("header is damaged", path)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(64))
    fails("looks like a PNG", path)
    np.save(path, np.zeros((2, 3, 4, 5), "u1"))
    fails("4 axes", path)
    np.save(path, np.zeros((2, 0, 4), "u1"))
    fails("non-empty", path)
    np.save(path, voxels())
    fails("axes='xyy'", path, axes="xyy")


def test_booleans_become_bytes(tmp_path):
    np.save(tmp_path / "a.npy", voxels() > 50)
    assert_same(read_volume(tmp_path / "a.npy", spacing=SPACING, origin=ORIGIN), (voxels() > 50).astype("u1"))


@pytest.mark.parametrize("version", [2, 3])
def test_zarr(tmp_path, version):
    array = zarr.create_array(tmp_path / "a.zarr", shape=SHAPE, dtype="i2", chunks=(4, 2, 2), zarr_format=version)
    array[...] = voxels()
    assert_same(read_volume(tmp_path / "a.zarr", spacing=SPACING, origin=ORIGIN), voxels())
    group = zarr.open_group(tmp_path / "b.zarr", mode="w", zarr_format=version)
    group.create_array("scan/a", shape=SHAPE, dtype="i2")[...] = voxels()
    assert_same(read_volume(tmp_path / "b.zarr", spacing=SPACING, origin=ORIGIN), voxels())
    group.create_array("b", shape=SHAPE[::-1], dtype="i2")[...] = voxels().T
    fails("choose one with array=.*'scan/a'", tmp_path / "b.zarr")
    fails("no array 'c'", tmp_path / "b.zarr", array="c")
    assert_same(read_volume(tmp_path / "b.zarr", array="b", axes="zyx", spacing=SPACING, origin=ORIGIN), voxels())


def test_zarr_axes_by_name_and_ome_scale(tmp_path):
    array = zarr.create_array(tmp_path / "a.zarr", shape=SHAPE[::-1], dtype="i2", dimension_names=("z", "y", "x"))
    array[...] = voxels().T
    assert_same(read_volume(tmp_path / "a.zarr"), voxels(), spacing=(1, 1, 1), origin=(0, 0, 0))
    group = zarr.open_group(tmp_path / "b.zarr", mode="w")
    for name, step in (("0", 1), ("1", 2)):
        level = voxels()[::step, ::step, ::step].T[None]
        group.create_array(name, shape=level.shape, dtype="i2")[...] = level
    axes = [{"name": "c", "type": "channel"}] + [{"name": a, "type": "space", "unit": "micrometer"} for a in "zyx"]
    steps = [{"type": "scale", "scale": [1, 3000, 1250, 500]}, {"type": "translation", "translation": [0, 30500, -20000, 10000]}]
    datasets = [{"path": "0", "coordinateTransformations": steps}, {"path": "1"}]
    group.attrs["ome"] = {"multiscales": [{"axes": axes, "datasets": datasets}]}
    assert_same(read_volume(tmp_path / "b.zarr"), voxels())


def test_bad_zarr(tmp_path):
    zarr.create_array(tmp_path / "a.zarr", shape=(9, 9, 9), dtype="i2")
    fails("no data", tmp_path / "a.zarr")
    (tmp_path / "b.zarr").mkdir()
    fails("not a Zarr", tmp_path / "b.zarr")
    array = zarr.create_array(tmp_path / "c.zarr", shape=SHAPE, dtype="i2", chunks=SHAPE)
    array[...] = voxels()
    header = json.loads((tmp_path / "c.zarr" / "zarr.json").read_text())
    (tmp_path / "c.zarr" / "zarr.json").write_text(json.dumps(header | {"shape": [70000, 70000, 700]}))
    fails("32-bit indices", tmp_path / "c.zarr")
    (tmp_path / "c.zarr" / "zarr.json").write_text(json.dumps(header))
    chunk = next(f for f in (tmp_path / "c.zarr" / "c").rglob("*") if f.is_file())
    chunk.write_bytes(chunk.read_bytes()[:9])
    fails("damaged", tmp_path / "c.zarr")


def test_raw(tmp_path):
    for name, dtype in (("a.raw", "<i2"), ("a.bin", ">i2"), ("a.vol", "u1")):
        (tmp_path / name).write_bytes(voxels(dtype).tobytes(order="F"))
        volume = read_volume(tmp_path / name, shape=SHAPE, dtype=dtype, spacing=SPACING, origin=ORIGIN)
        assert_same(volume, voxels(np.dtype(dtype).newbyteorder("=")))
    fails("give shape=.*dtype=.*spacing=", tmp_path / "a.raw")
    fails("give shape=", tmp_path / "a.raw", shape=SHAPE)
    fails("420 bytes, the file holds 210", tmp_path / "a.raw", shape=SHAPE, dtype="f4")
    fails("105 bytes, the file holds 210", tmp_path / "a.raw", shape=SHAPE, dtype="u1")
    fails("dtype=", tmp_path / "a.raw", shape=SHAPE, dtype="many")
    fails("positive sizes", tmp_path / "a.raw", shape=(7, -5, -3), dtype="i2")
    fails("unsupported extension", tmp_path / "a.vol")


# --- Values and keywords ---------------------------------------------------------------------------------------------


def test_voxels_that_are_not_finite_are_counted_or_replaced(tmp_path):
    values = voxels("f4")
    values[1, 2, 1], values[3, 0, 2], values[0, 4, 0] = np.nan, np.inf, -np.inf
    np.save(tmp_path / "a.npy", values)
    fails(r"3 of 105 voxels are not finite \(1 NaN, 2 infinite\).*nan_value=.*--nan-value", tmp_path / "a.npy")
    wanted = np.where(np.isfinite(values), values, -7)
    assert_same(read_volume(tmp_path / "a.npy", nan_value=-7, spacing=SPACING, origin=ORIGIN), wanted)
    fails("nan_value=nan", tmp_path / "a.npy", nan_value=float("nan"))
    np.save(tmp_path / "b.npy", np.where(np.isinf(values), np.nan, values))
    with pytest.warns(UserWarning, match="3 of 105 voxels are NaN; they count as missing"):
        volume = read_volume(tmp_path / "b.npy")
    np.testing.assert_array_equal(np.asarray(volume.gaps) & 1 > 0, ~np.isfinite(values))


@pytest.mark.parametrize(
    ("kind", "number", "slope", "inter"),
    [("i2", -2000, 1.0, 0.0), ("i2", -2000, 1.0, -1024.0), ("i2", -32768, 1.0, 0.0), ("f4", -9999, 1.0, 0.0)],
)
def test_padding_is_found_and_said(tmp_path, kind, number, slope, inter):
    code = {"i2": 4, "f4": 16}[kind]
    values = voxels(kind)
    values[:2] = number
    (tmp_path / "a.nii").write_bytes(nifti(values, code=code, slope=slope, inter=inter))
    with pytest.warns(UserWarning, match=r"30 of 105 voxels are .*far from all others, as padding is; .*missing=False"):
        volume = read_volume(tmp_path / "a.nii")
    np.testing.assert_array_equal(np.asarray(volume.gaps) & 1 > 0, values == number)
    assert float(jnp.min(volume.values)) == values[values != number].min()
    assert read_volume(tmp_path / "a.nii", missing=False).gaps is None


def test_numbers_beyond_all_measurement_are_missing(tmp_path):
    values = voxels("f4")
    values[:2] = -3.4028235e38
    np.save(tmp_path / "a.npy", values)
    with pytest.warns(UserWarning, match="30 voxels lie beyond 1e30: they count as missing"):
        volume = read_volume(tmp_path / "a.npy")
    np.testing.assert_array_equal(np.asarray(volume.gaps) & 1 > 0, values < -1e30)


def test_padding_is_what_the_caller_says_and_no_more(tmp_path):
    values = voxels("i2")
    (tmp_path / "a.nii").write_bytes(nifti(values, code=4, slope=2.0, inter=-10.0))
    low = int(values.min())
    volume = read_volume(tmp_path / "a.nii", missing=2.0 * low - 10)
    np.testing.assert_array_equal(np.asarray(volume.gaps) & 1 > 0, values == low)
    # Values that go on right beside a number are no padding.
    values[0, 0, :2] = -2000, -1990
    (tmp_path / "b.nii").write_bytes(nifti(values, code=4))
    assert read_volume(tmp_path / "b.nii").gaps is None
    fails("missing=nan", tmp_path / "b.nii", missing=float("nan"))


def test_nan_value_is_in_data_units(tmp_path):
    values = voxels("f4")
    values[1, 2, 1] = np.nan
    (tmp_path / "a.nii").write_bytes(nifti(values, code=16, slope=4.0, inter=100.0))
    volume = read_volume(tmp_path / "a.nii", nan_value=-300)
    assert float(volume.sample((jnp.array(1.0), jnp.array(2.0), jnp.array(1.0)))) == -300


def test_doubles_become_float32_unless_x64_is_on(tmp_path, x64):
    np.save(tmp_path / "a.npy", voxels("f8") + 1e-12)
    assert_same(read_volume(tmp_path / "a.npy", spacing=SPACING, origin=ORIGIN), voxels("f8") + 1e-12)


def test_doubles_in_float32(tmp_path):
    np.save(tmp_path / "a.npy", voxels("f8") / 8)
    assert_same(read_volume(tmp_path / "a.npy", spacing=SPACING, origin=ORIGIN), voxels("f4") / 8)
    np.save(tmp_path / "b.npy", voxels("f8") / 1000 + 1e9)
    with pytest.warns(UserWarning, match="float32 resolves only"):
        read_volume(tmp_path / "b.npy")
    np.save(tmp_path / "c.npy", voxels("f8") * 1e300)
    fails("exceed the range of float32", tmp_path / "c.npy", nan_value=0)
    np.save(tmp_path / "d.npy", voxels("i8") + 2**40)
    fails("do not fit 32 bits", tmp_path / "d.npy")


@pytest.mark.parametrize("spacing", [0, -1, (1, 0, 1), (1, float("nan"), 1), (1, 1)])
def test_bad_spacing_keyword(tmp_path, spacing):
    np.save(tmp_path / "a.npy", voxels())
    fails("spacing=.*three positive finite", tmp_path / "a.npy", spacing=spacing)


def test_keywords_replace_what_a_file_says_but_not_its_directions(tmp_path):
    sitk.WriteImage(itk_image(voxels()), str(tmp_path / "a.mha"))
    volume = read_volume(tmp_path / "a.mha", spacing=(2, 3, 4), origin=(1, 2, 3))
    assert_same(volume, voxels(), direction=TURN, spacing=(2, 3, 4), origin=(1, 2, 3))
    fails("has a header: leave shape= out", tmp_path / "a.mha", shape=SHAPE)
    fails("leave series= out", tmp_path / "a.mha", series="1")


def test_paths_that_hold_nothing(tmp_path):
    (tmp_path / "head.nii.gz").write_bytes(b"")
    fails("the file is empty", tmp_path / "head.nii.gz")
    fails("did you mean 'head.nii.gz'", tmp_path / "haed.nii.gz", error=FileNotFoundError)
    fails("no such file$", tmp_path / "nowhere" / "a.nii", error=FileNotFoundError)
    (tmp_path / "a.doc").write_bytes(b"\xff\xd8\xff")
    fails(r"unsupported extension '.doc'; supported: .mhd, .*\.zarr", tmp_path / "a.doc")
    fails("no DICOM series", tmp_path)


@pytest.mark.parametrize("name", ["a.mhd", "a.mha", "a.nrrd", "a.nii", "a.dcm", "a.vtk", "a.vti", "a.tif", "a.npy"])
@pytest.mark.parametrize("content", [b"some text\n", b"\x89PNG\r\n\x1a\n", bytes(2000), b"PK\x03\x04" + bytes(500)])
def test_content_that_is_not_what_the_name_says(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    fails("looks like (text|a PNG image|a ZIP archive|something else)", tmp_path / name)


def test_more_than_the_memory_is_refused_before_reading(tmp_path, monkeypatch):
    sitk.WriteImage(itk_image(voxels()), str(tmp_path / "a.mha"))
    np.save(tmp_path / "a.npy", voxels())
    monkeypatch.setattr("jvr.io.volumes.errors.available_memory", lambda: 200)
    for name in ("a.mha", "a.npy"):
        fails("need 210 bytes, 200 are free", tmp_path / name)


def test_nothing_is_printed_for_bad_files(tmp_path, capfd):
    path = metaimage(tmp_path / "a.mhd", voxels(), TransformMatrix="0 0 0 0 0 0 0 0 0")
    fails("axes of length 0", path)
    fails("cut short", (lambda p: (p.write_text(p.read_text()[:-300]), p)[1])(vti(tmp_path / "a.vti", voxels())))
    captured = capfd.readouterr()
    assert captured.out + captured.err == ""


def test_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    (tmp_path / "a.zarr").mkdir()
    fails(r"pip install 'jvr\[zarr\]'", tmp_path / "a.zarr")


def test_importing_the_readers_loads_no_library():
    code = "import sys, jvr.io.volumes; print({'SimpleITK', 'vtk', 'vtkmodules', 'zarr', 'tifffile'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "set()"


# --- Public volumes --------------------------------------------------------------------------------------------------

EMBRYO = {"shape": (256, 256, 256), "dtype": "uint8"}
PUBLIC = [
    ("ct_head_quarter/ct_head_quarter.mhd", {}, (64, 64, 93), "i2", (3.2, 3.2, 1.5), (0, 3926), (0, 0, 0)),
    ("ct_torso/example_ct.nii.gz", {}, (122, 101, 112), "i2", (3, 3, 3), (-1207, 3382), None),
    ("ct_head_pitch/CT_pitch.nii.gz", {}, (175, 248, 58), "u1", (0.8125, 0.8125, 2.397), (0, 255), None),
    ("embryo/embryo_256x256x256_uint8.raw", EMBRYO, (256, 256, 256), "u1", (1, 1, 1), (0, 197), (0, 0, 0)),
    ("hydrogen/hydrogen.vti", {}, (64, 64, 64), "f4", (1, 1, 1), (0, 1), (0, 0, 0)),
    ("ironprot/ironProt.vtk", {}, (68, 68, 68), "u1", (1, 1, 1), (0, 255), (0, 0, 0)),
    ("carotid/carotid.vtk", {}, (76, 49, 45), "f4", (1, 1, 1), (0, 580), (100, 80, 1)),
    ("mr_flair/FLAIR.nrrd", {}, (124, 160, 140), "u1", (1, 1, 1), (0, 255), None),
    ("frogtissue/frogtissue.mhd", {}, (500, 470, 136), "u1", (1, 1, 1.5), (0, 29), (0, 0, 0)),
    ("neghip/neghip_stack.tif", {}, (66, 66, 66), "u1", (1, 1, 1), (0, 255), (0, 0, 0)),
]


@pytest.mark.parametrize(("name", "keywords", "shape", "dtype", "spacing", "limits", "origin"), PUBLIC)
def test_public_volumes(data, name, keywords, shape, dtype, spacing, limits, origin):
    volume = read_volume(data / name, **keywords)
    assert volume.shape == shape
    assert volume.values.dtype == np.dtype(dtype)
    np.testing.assert_allclose(np.asarray(volume.spacing), spacing, rtol=2e-4)
    assert (np.asarray(volume.values).min(), np.asarray(volume.values).max()) == limits
    if origin is not None:
        np.testing.assert_allclose(np.asarray(volume.world_from_grid)[:3, 3], origin)


def test_public_labels_are_those_of_the_zlib_stream(data):
    stored = zlib.decompress((data / "frogtissue/frogtissue.zraw").read_bytes())
    values = np.asarray(read_volume(data / "frogtissue/frogtissue.mhd").values)
    assert values.tobytes(order="F") == stored


def test_public_torso_lies_where_its_own_header_says(data):
    with gzip.open(data / "ct_torso/example_ct.nii.gz") as file:
        header = file.read(352)
        stored = np.frombuffer(file.read(), "<i4").reshape((122, 101, 112), order="F")
    volume = read_volume(data / "ct_torso/example_ct.nii.gz")
    np.testing.assert_array_equal(np.asarray(volume.values), stored)
    srow = np.array(struct.unpack("<12f", header[280:328])).reshape(3, 4)
    found = np.asarray(volume.world_from_grid) @ [10, 20, 30, 1]
    np.testing.assert_allclose(found[:3], (srow @ [10, 20, 30, 1]) * [-1, -1, 1], rtol=1e-5)


def slc_slices(content):
    """Slices of a VolVis SLC: each begins with its length, runs of bytes are literal (high bit set) or repeat one byte."""
    position = content.index(b"X") + 1 + 3 * 100 * 100
    while match := re.compile(rb"\s*(\d+) X").match(content, position):
        position, voxels = match.end(), bytearray()
        data = content[position : position + int(match[1])]
        position += int(match[1])
        k = 0
        while k < len(data) and (count := data[k] & 127):
            literal = data[k] & 128
            voxels += data[k + 1 : k + 1 + count] if literal else data[k + 1 : k + 2] * count
            k += 1 + (count if literal else 1)
        yield bytes(voxels)


def test_public_neghip_stack_is_the_slc_beside_it(data):
    values = np.asarray(read_volume(data / "neghip/neghip_stack.tif").values)
    slices = list(slc_slices((data / "neghip/neghip.slc").read_bytes()))
    assert len(slices) == 66
    for k, content in enumerate(slices):
        assert values[:, :, k].tobytes(order="F") == content
    np.testing.assert_array_equal(np.asarray(read_volume(data / "neghip/neghip.slc").values), values)
