"""What experienced new users bring: objects, files and flags that look right, each read right or named in one line."""

import copy
import dataclasses
import json
import os
import pickle
import struct
import subprocess
import sys
import warnings

import equinox as eqx
import ml_dtypes
import nibabel
import numpy as np
import OpenEXR
import pytest
import tifffile
import zarr
from PIL import Image

import jvr
from jvr import cli
from jvr.cli.inputs import name_of
from jvr.io.config import build_cameras, build_scene, config_from
from jvr.io.config.build import build_fit
from jvr.io.config.transfers import contents
from jvr.io.first_picture import first_picture
from jvr.io.volumes import VolumeError
from jvr.model.voxels import VOXEL

N = 24
RAMP = np.arange(60, dtype=np.float32).reshape(3, 4, 5)
LINE = jvr.LinearTransfer([0.0, 60.0], [[1.0, 1.0, 1.0]] * 2, [0.0, 0.1])
CAMERA = jvr.OrthographicCamera.look_at([1.0, -9.0, 2.0], [1.0, 1.5, 2.0], [0.0, 0.0, 1.0], height_world=4.0, width=4, height=4)


def reads(path, *said, **keywords):
    """The volume, whose reader says exactly what is `said`."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        volume = jvr.read_volume(path, **keywords)
    assert len(caught) == len(said), [str(w.message) for w in caught]
    for warning, words in zip(caught, said, strict=True):
        assert words in str(warning.message)
    return volume


def missing(volume) -> np.ndarray:
    return np.zeros(volume.shape, bool) if volume.gaps is None else np.asarray(volume.gaps) & VOXEL != 0


# --- Arrays of other libraries ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["f4", "f8", "i2", "u1"])
def test_masked_voxels_are_missing(kind):
    mask = RAMP > 30
    volume = jvr.Volume(np.ma.MaskedArray(RAMP.astype(kind), mask))
    np.testing.assert_array_equal(missing(volume), mask)
    np.testing.assert_array_equal(np.asarray(volume.values)[~mask], RAMP[~mask])
    assert jvr.Volume(np.ma.MaskedArray(RAMP)).gaps is None


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ("scan.nii", "not the name 'scan.nii': jvr.read_volume reads files"),
        (RAMP + 1j, "not complex64"),
        (RAMP.astype(object), "not object"),
        ([[[1, 2], [3]]], "must be an array of real numbers with axes x, y, z"),
    ],
)
def test_what_is_no_array_of_numbers_is_named(values, message):
    with pytest.raises(TypeError, match=message):
        jvr.Volume(values)


# Calls whose arguments are of types that no annotation allows, with what is said of them.
WRONG = """
import json, nibabel, numpy as np, SimpleITK as sitk
import jvr

class Named:
    dims, coords = ("z", "y", "x"), {"x": 0}
    def __array__(self, *_, **__):
        return a

a = np.zeros((3, 4, 5), np.float32)
scene = jvr.Scene(jvr.Volume(a), jvr.LinearTransfer([0.0, 60.0], [[1.0, 1.0, 1.0]] * 2, [0.0, 0.1]))
camera = jvr.OrthographicCamera.look_at([1.0, -9.0, 2.0], [1.0, 1.5, 2.0], [0.0, 0.0, 1.0], height_world=4.0, width=4, height=4)
picture = jvr.Rendering(np.zeros((4, 4, 3)), np.zeros((4, 4)), np.zeros((4, 4)), None)
calls = {
    "with axes z, y, x: give .transpose": lambda: jvr.Volume(Named()),
    "must be an array of real numbers, not Image": lambda: jvr.Volume(sitk.GetImageFromArray(a)),
    "not Nifti1Image": lambda: jvr.Volume(nibabel.Nifti1Image(a, np.eye(4))),
    "real numbers, not NoneType": lambda: jvr.Volume(None),
    "interpolation must be jvr.Trilinear() or jvr.Nearest(), not 'nearest'": lambda: jvr.Volume(a, interpolation="nearest"),
    "missing must be the stored number": lambda: jvr.Volume(a, missing="x"),
    "volume must be a jvr.Volume, as jvr.read_volume gives it, not ndarray": lambda: jvr.Scene(a, scene.transfer),
    "this scene shows nothing: give it a transfer function": lambda: jvr.Scene(scene.volume, None),
    "a scene and a camera, not OrthographicCamera and Scene": lambda: jvr.render(camera, scene),
    "such as the rgb of a rendering, not Rendering": lambda: jvr.write_image("a.exr", picture),
    "put a single one in brackets": lambda: jvr.residuals(scene, camera, [np.zeros((4, 4, 3))]),
    "not ndarray; an array becomes a volume by jvr.Volume": lambda: jvr.read_volume(a),
    "or folder, not list": lambda: jvr.read_volume(["a.dcm"]),
    "slope='2' must be a finite number": lambda: jvr.read_volume("a.npy", slope="2"),
    "shape= must be whole numbers and dtype= a NumPy type: 5.5": lambda: jvr.read_volume("a.raw", shape=(3, 4, 5.5), dtype="f4"),
    "missing='none' must be a finite number, or False": lambda: jvr.read_volume("a.npy", missing="none"),
}
found = {}
for words, call in calls.items():
    try:
        found[words] = f"nothing: {call()}"
    except (TypeError, ValueError) as error:
        found[words] = str(error)
print(json.dumps(found))
"""


@pytest.mark.slow
def test_arguments_of_another_type_are_named(tmp_path):
    """In a process of its own, where annotations are not checked, as it is for everybody else."""
    RAMP.tofile(tmp_path / "a.raw")
    done = subprocess.run([sys.executable, "-c", WRONG], cwd=tmp_path, capture_output=True, text=True, check=True)
    for words, message in json.loads(done.stdout).items():
        assert words in message
        assert "\n" not in message
    assert os.listdir(tmp_path) == ["a.raw"]


@pytest.mark.parametrize(
    ("values", "message"), [(RAMP[0], r"give values\[:, :, None\]"), (RAMP[..., None], "one of the last axis")]
)
def test_other_numbers_of_axes_say_what_to_give(values, message):
    with pytest.raises(ValueError, match=message):
        jvr.Volume(values)


@pytest.mark.parametrize("kind", [np.float16, ml_dtypes.bfloat16])
def test_small_floats_are_taken_without_a_warning(kind):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        volume = jvr.Volume(RAMP.astype(kind))
    np.testing.assert_array_equal(np.asarray(volume.values, np.float32), RAMP)


def test_order_in_memory_and_on_disk_does_not_matter(tmp_path):
    on_disk = np.lib.format.open_memmap(tmp_path / "a.npy", "w+", "f4", RAMP.shape)
    on_disk[...] = RAMP
    for values in (np.asfortranarray(RAMP), on_disk, RAMP[::-1, ::-1][::-1, ::-1]):
        np.testing.assert_array_equal(jvr.Volume(values).values, RAMP)


# --- Copies ----------------------------------------------------------------------------------------------------------


def test_a_volume_that_is_replaced_in_part_keeps_the_rest():
    volume = jvr.Volume(RAMP, np.diag([1, 1, 2, 1.0]), missing=3.0, unit="HU").bricked()
    for found in (dataclasses.replace(volume, slope=2.0), dataclasses.replace(volume, interpolation=jvr.Nearest())):
        np.testing.assert_array_equal(missing(found), RAMP == 3)
        np.testing.assert_array_equal(found.values, volume.values)
        np.testing.assert_array_equal(found.world_from_grid, volume.world_from_grid)
        assert (found.unit, found.missing) == ("HU", 3)
    assert dataclasses.replace(volume, slope=2.0).slope == 2
    other = dataclasses.replace(volume, values=RAMP + 100)
    np.testing.assert_array_equal(missing(other), RAMP == 3)
    np.testing.assert_array_equal(np.asarray(other.values)[~missing(other)], RAMP[RAMP != 3] + 100)
    with pytest.raises(ValueError, match="gaps have shape"):
        dataclasses.replace(volume, values=RAMP[:2])


def test_levels_of_packed_voxels_are_not_taken_for_missing_ones():
    """The stored number 4 is missing; the level 4 of 256 is not."""
    volume = jvr.Volume(np.where(RAMP == 7, 4, RAMP * 4.25).astype(np.float32), missing=4.0)
    packed = volume.packed()
    assert np.any(np.asarray(packed.values) == 4)
    np.testing.assert_array_equal(missing(dataclasses.replace(packed, slope=1.0)), RAMP == 7)


@pytest.mark.slow
@pytest.mark.parametrize("through", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_scenes_and_pictures_can_be_copied_and_pickled(through):
    volume = jvr.Volume(RAMP, missing=3.0)
    for scene in (jvr.Scene(v, LINE) for v in (volume, volume.bricked(), volume.packed(), volume.graded())):
        found = through(scene)
        assert eqx.tree_equal(found, scene)
    picture = jvr.render(scene, CAMERA)
    assert eqx.tree_equal(through(picture), picture)
    np.testing.assert_array_equal(jvr.render(found, CAMERA).rgb, picture.rgb)


# --- Scenes, pictures and codes --------------------------------------------------------------------------------------

SCENE = jvr.Scene(jvr.Volume(RAMP), LINE)
PIXELS = np.full((4, 4, 3), 0.25, np.float32)
CODES = np.uint8([0, 128, 255])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: jvr.linear_from_srgb(CODES), r"whole numbers up to 255, where 1 is white: give linear_from_srgb\(codes / 255\)"),
        (lambda: jvr.linear_from_srgb(CODES.astype(np.uint16) * 257), "codes / 65535"),
        (lambda: jvr.write_image("a.png", PIXELS, np.full((4, 4), 255, np.uint8)), "alpha goes up to 255, but 1 is opaque"),
        (lambda: jvr.write_image("a.png", PIXELS, np.full((4, 4), 255.0)), "alpha goes up to 255.0"),
        (lambda: jvr.write_image("a.png", np.full((4, 4, 3), 255.0)), "whole numbers up to 255"),
        (lambda: jvr.write_image("a.exr", PIXELS + 1j), "must be an array of radiance"),
        (lambda: jvr.residuals(SCENE, [CAMERA], [np.ones((4, 4, 4))]), "four channels: give light over the scene's background"),
        (lambda: jvr.residuals(SCENE, [CAMERA], PIXELS), "put a single one in brackets"),
    ],
)
def test_what_is_no_radiance_is_named(call, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((TypeError, ValueError), match=message):
        call()
    assert os.listdir() == []


@pytest.mark.parametrize(
    ("image", "message"), [(251.3 * PIXELS * 4, "mostly brighter than white"), (-PIXELS, "48 negative values")]
)
def test_targets_that_no_scene_gives_are_said(image, message):
    with pytest.warns(UserWarning, match=message):
        jvr.residuals(SCENE, [CAMERA], [image])


def transparent(folder, kind="png"):
    """Half of a picture is white paint that covers a quarter, the other half bare."""
    path = folder / f"a.{kind}"
    alpha = np.repeat([[0.25, 0.0]], 2, axis=0).astype(np.float32)
    if kind == "png":
        codes = np.concatenate([np.full((2, 2, 3), 255), np.round(255 * alpha)[..., None]], axis=-1).astype(np.uint8)
        Image.fromarray(codes).save(path)
    else:
        planes = dict.fromkeys("RGBA", alpha)
        OpenEXR.File({"type": OpenEXR.scanlineimage}, planes).write(str(path))
    return path


@pytest.mark.parametrize("kind", ["png", "exr"])
def test_a_background_shows_through_what_is_transparent(tmp_path, kind):
    background = np.array([0.2, 0.4, 0.8])
    found = jvr.read_image(transparent(tmp_path, kind), background=background)
    np.testing.assert_allclose(found[0, 0], 0.25 + 0.75 * background, atol=2e-3)
    np.testing.assert_allclose(found[0, 1], background, atol=1e-6)


def test_transparent_pixels_are_said_where_nothing_is_behind_them(tmp_path):
    with pytest.warns(UserWarning, match="4 pixels are transparent and read as light over black: background="):
        found = jvr.read_image(transparent(tmp_path))
    np.testing.assert_allclose(found[0], [[0.25] * 3, [0] * 3], atol=2e-3)
    assert jvr.read_image(os.fsencode(transparent(tmp_path, "exr"))).shape == (2, 2, 3)


def test_targets_of_a_fit_are_over_the_background_of_its_scene(tmp_path):
    transparent(tmp_path)
    tables = {
        "volume": {"builtin": "demo"},
        "background": [0.2, 0.4, 0.8],
        "camera": {"width": 2, "height": 2},
        "fit": {"unknowns": ["transfer.sigma_t"], "images": ["a.png"]},
    }
    (target,) = build_fit(config_from(tables, "test", tmp_path)).targets
    np.testing.assert_allclose(target[0], [0.25 + 0.75 * np.array([0.2, 0.4, 0.8]), [0.2, 0.4, 0.8]], atol=2e-3)


# --- Names and keywords of files -------------------------------------------------------------------------------------


def test_names_of_every_kind_are_read(tmp_path):
    for name in ("a b.npy", "ümläut.v2.npy", "[1].NPY", "-dash.npy", os.fsdecode(b"\xff.npy")):
        with open(tmp_path / name, "wb") as file:
            np.save(file, RAMP)
        for path in (tmp_path / name, str(tmp_path / name), os.fsencode(tmp_path / name)):
            assert jvr.read_volume(path).shape == (3, 4, 5)


@pytest.mark.parametrize(
    ("path", "kind", "message"),
    [
        ("https://example.org/a.nii.gz", VolumeError, "an address, and only files are read"),
        ("", VolumeError, "no name of a file"),
        ("a\0.nii", VolumeError, "no name of a file"),
    ],
)
def test_what_names_no_file_is_named(path, kind, message):
    with pytest.raises(kind, match=message):
        jvr.read_volume(path)


def test_links_that_lead_nowhere_are_named(tmp_path):
    (tmp_path / "a.nii").symlink_to("store/b.nii")
    with pytest.raises(FileNotFoundError, match=r"a link to store/b.nii, which is not there"):
        jvr.read_volume(tmp_path / "a.nii")


@pytest.mark.parametrize(
    ("name", "message"),
    [("a.mgz", "mri_convert"), ("a.czi", "OME-TIFF"), ("a.h5", "numpy.save"), ("a.npz", "numpy.save"), ("a.nrrd.gz", "unpack"),
     ("a.zip", "unpack"), ("a.png", "the folder of all slices"), ("companion.ome", ".ome.tif"), ("a.vtu", "resample")],
)  # fmt: skip
def test_formats_that_are_not_read_have_a_remedy(tmp_path, name, message):
    (tmp_path / name).write_bytes(bytes(range(200)))
    with pytest.raises(VolumeError, match=message):
        jvr.read_volume(tmp_path / name)


def test_numbers_of_every_library_are_keywords(tmp_path):
    np.save(tmp_path / "a.npy", RAMP)
    for spacing in (np.float32(0.5), np.array(0.5)):
        np.testing.assert_allclose(jvr.read_volume(tmp_path / "a.npy", spacing=spacing).spacing, 0.5)
    assert jvr.read_volume(tmp_path / "a.npy", axes=("z", "y", "x")).shape == (5, 4, 3)
    assert jvr.read_volume(tmp_path / "a.npy", missing=np.int16(3)).missing == 3
    for keywords in ({"slope": np.nan}, {"missing": True}, {"nan_value": np.inf}):
        with pytest.raises(VolumeError, match=rf"{next(iter(keywords))}=.* must be a finite number"):
            jvr.read_volume(tmp_path / "a.npy", **keywords)


def test_where_sform_and_qform_contradict_each_other(tmp_path):
    qform = np.diag([2.0, 2.0, 3.0, 1.0])

    def saved(sform, name="a.nii"):
        image = nibabel.Nifti1Image(RAMP, None)
        image.header.set_xyzt_units("mm")
        image.set_qform(qform, 1)
        image.set_sform(sform, 1)
        nibabel.save(image, tmp_path / name)
        return tmp_path / name

    reads(saved(qform))
    moved = qform.copy()
    moved[0, 3] = 50
    np.testing.assert_allclose(
        reads(saved(moved), "the qform puts voxels up to 50 away from where the sform does").origin.high[0], -50
    )
    # An sform of zeros with a code that announces one, as some tools write it.
    content = bytearray(saved(qform).read_bytes())
    content[280:328] = bytes(48)
    (tmp_path / "b.nii").write_bytes(content)
    volume = reads(tmp_path / "b.nii", "its sform has axes of length 0; it is left out")
    np.testing.assert_allclose(volume.world_from_grid, np.diag([-1, -1, 1, 1]) @ qform)


def test_voxels_that_are_packed_are_no_wrong_shape(tmp_path):
    import gzip

    (tmp_path / "a.raw.gz").write_bytes(gzip.compress(RAMP.tobytes()))
    with pytest.raises(VolumeError, match="gzip-compressed: unpack"):
        jvr.read_volume(tmp_path / "a.raw.gz", shape=(3, 4, 5), dtype="f4")


def test_what_numpy_saves_of_other_types_is_not_called_pickled(tmp_path):
    np.save(tmp_path / "a.npy", RAMP.astype(ml_dtypes.bfloat16))
    with pytest.raises(VolumeError, match="is no type of real numbers"):
        jvr.read_volume(tmp_path / "a.npy")


@pytest.mark.parametrize("number", [1e20, -1e20, -999.0])
def test_paddings_of_simulations_are_found(tmp_path, number):
    np.save(tmp_path / "a.npy", np.where(RAMP < 6, number, RAMP).astype(np.float32))
    volume = reads(tmp_path / "a.npy", f"are {number:g}, far from all others")
    np.testing.assert_array_equal(missing(volume), RAMP < 6)


def test_the_number_of_missing_voxels_is_in_what_info_says(tmp_path, capsys):
    np.save(tmp_path / "a.npy", np.where(RAMP < 6, -2000, RAMP).astype(np.int16))
    assert cli.run(["info", str(tmp_path / "a.npy")]) == 0
    assert "missing      6 voxels (10 %), which are -2000\n" in capsys.readouterr().out
    assert cli.run(["info", str(tmp_path / "a.npy"), "--json", "--slope", "2", "--intercept", "5"]) == 0
    assert json.loads(capsys.readouterr().out)["missing_value"] == -3995
    np.save(tmp_path / "a.npy", np.where(RAMP < 6, np.nan, RAMP))
    assert cli.run(["info", str(tmp_path / "a.npy")]) == 0
    assert "which are NaN\n" in capsys.readouterr().out


def test_coordinates_beside_an_array_of_zarr_are_said(tmp_path):
    group = zarr.open_group(str(tmp_path / "a.zarr"), mode="w", zarr_format=2)
    for name, axes, values in (("t", "zyx", RAMP.T), ("x", "x", np.arange(3.0)), ("z", "z", np.arange(5.0))):
        array = group.create_array(name, shape=values.shape, dtype="f4")
        array[...] = values
        array.attrs["_ARRAY_DIMENSIONS"] = list(axes)
    volume = reads(tmp_path / "a.zarr", "the coordinates in its arrays z, x are not read", array="t")
    np.testing.assert_array_equal(volume.values, RAMP)


# --- TIFF of microscopes ---------------------------------------------------------------------------------------------

STACK = np.arange(60, dtype=np.uint16).reshape(5, 4, 3)


def tiff(path, tags, pages=STACK, summary=b""):
    """A TIFF file written by hand: `tags` of the first page as (number, type, count, content); `summary` behind the header."""
    content = bytearray(b"II*\0" + bytes(4) + summary)
    content += bytes(len(content) % 2)
    link = 4
    for k, page in enumerate(pages):
        strip = len(content)
        content += page.tobytes()
        fields = [(256, 3, 1, page.shape[1]), (257, 3, 1, page.shape[0]), (258, 3, 1, 16), (259, 3, 1, 1), (262, 3, 1, 1)]
        fields += [(273, 4, 1, strip), (277, 3, 1, 1), (278, 3, 1, page.shape[0]), (279, 4, 1, page.nbytes)]
        for number, kind, count, value in tags if k == 0 else []:
            fields.append((number, kind, count, value if isinstance(value, int) else len(content)))
            content += b"" if isinstance(value, int) else value + bytes(len(value) % 2)
        content[link : link + 4] = struct.pack("<I", len(content))
        content += struct.pack("<H", len(fields))
        for field in sorted(fields):
            content += struct.pack("<HHII", *field)
        link = len(content)
        content += bytes(4)
    path.write_bytes(content)
    return path


def test_voxel_sizes_of_zeiss_lsm(tmp_path):
    """CZ_LSMINFO: magic, size, dimensions of x, y, z, channels, time, 8-bit data, thumbnail, then voxel sizes in metres."""
    info = struct.pack("<Ii8i6d2H", 0x0400494C, 600, 3, 4, 5, 1, 1, 2, 1, 1, 1e-7, 2e-7, 5e-7, 0, 0, 0, 0, 0)
    info += bytes(600 - len(info))
    # A thumbnail follows each page.
    pages = [page for plane in STACK for page in (plane, STACK[0, :1, :1])]
    volume = reads(tiff(tmp_path / "a.lsm", [(34412, 1, 600, info)], pages))
    np.testing.assert_array_equal(volume.values, STACK.T)
    np.testing.assert_allclose(volume.spacing, [1e-4, 2e-4, 5e-4], rtol=1e-6)


def test_voxel_sizes_of_micro_manager(tmp_path):
    """Its header says where its own parts are; the summary is JSON, behind the number 2355492 and its length."""
    text = json.dumps({"PixelSize_um": 0.25, "z-step_um": 1.5, "Slices": 5, "Channels": 1, "Frames": 1, "Positions": 1}).encode()
    summary = struct.pack("<IIIIIIII", 0, 0, 0, 0, 0, 0, 2355492, len(text))[:-8] + struct.pack("<II", 2355492, len(text)) + text
    plane = json.dumps({"PixelSizeUm": 0.25}).encode() + b"\0"
    volume = reads(tiff(tmp_path / "a.tif", [(51123, 2, len(plane), plane)], summary=summary))
    np.testing.assert_array_equal(volume.values, STACK.T)
    np.testing.assert_allclose(volume.spacing, [2.5e-4, 2.5e-4, 1.5e-3], rtol=1e-6)


def metamorph(path, heights):
    """All planes lie behind the one page; UIC2 holds height and times of each, UIC1 pairs of a number and a value or its place."""
    content = bytearray(b"II*\0" + bytes(4) + STACK.tobytes())
    places = {}
    for name, value in (
        ("x", struct.pack("<II", 1, 2)),
        ("y", struct.pack("<II", 1, 4)),
        ("unit", struct.pack("<I", 3) + b"um\0"),
    ):
        places[name] = len(content)
        content += value + bytes(len(value) % 2)
    uic1 = len(content)
    content += struct.pack("<8I", 3, 1, 4, places["x"], 5, places["y"], 6, places["unit"])
    uic2 = len(content)
    content += b"".join(struct.pack("<6I", height, 10, 0, 0, 0, 0) for height in heights)
    fields = [(256, 3, 1, 3), (257, 3, 1, 4), (258, 3, 1, 16), (259, 3, 1, 1), (262, 3, 1, 1), (273, 4, 1, 8), (277, 3, 1, 1)]
    fields += [(278, 3, 1, 4), (279, 4, 1, 24), (33628, 4, 4, uic1), (33629, 5, 5, uic2)]
    content[4:8] = struct.pack("<I", len(content))
    content += struct.pack("<H", len(fields)) + b"".join(struct.pack("<HHII", *field) for field in fields) + bytes(4)
    path.write_bytes(content)
    return path


def test_voxel_sizes_of_metamorph(tmp_path):
    volume = reads(metamorph(tmp_path / "a.stk", [15] * 5))
    np.testing.assert_array_equal(volume.values, STACK.T)
    np.testing.assert_allclose(volume.spacing, [5e-4, 2.5e-4, 1.5e-3], rtol=1e-6)
    with pytest.raises(VolumeError, match="unevenly spaced"):
        jvr.read_volume(metamorph(tmp_path / "a.stk", [15, 15, 15, 30, 15]))


def test_what_tiff_says_and_is_not_read_is_said(tmp_path):
    grey = {"photometric": "minisblack"}
    tifffile.imwrite(tmp_path / "a.tif", STACK, **grey, metadata={"axes": "ZYX", "spacing": 3.0, "unit": "um"})
    reads(tmp_path / "a.tif", "spacing and unit in its JSON description are not read", "no voxel size")
    tifffile.imwrite(tmp_path / "a.tif", STACK, **grey, extratags=[(274, 3, 1, 4, True)])
    reads(tmp_path / "a.tif", "its tag Orientation is 4", "no voxel size")
    tifffile.imwrite(tmp_path / "a.tif", STACK.astype(np.int16), **grey, software="SI.8", description="state.x=1")
    reads(tmp_path / "a.tif", "what ScanImage writes of voxel sizes is not read", "no voxel size")


def test_thumbnails_are_no_images_of_their_own(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(STACK, photometric="minisblack")
        file.write(STACK[0, :2, :2], photometric="minisblack", subfiletype=1)
    np.testing.assert_array_equal(reads(tmp_path / "a.tif", "no voxel size").values, STACK.T)


def test_slices_are_turned_as_their_camera_says(tmp_path):
    exif = Image.Exif()
    exif[274] = 6
    for k in range(2):
        Image.fromarray(np.arange(12, dtype=np.uint8).reshape(4, 3) + k).save(tmp_path / f"{k}.png", exif=exif)
    # Row 0 of what is stored is the right edge.
    turned = np.rot90(np.arange(12).reshape(4, 3), -1)
    np.testing.assert_array_equal(reads(tmp_path, "1 mm is taken").values[..., 0], turned.T)


# --- The first picture -----------------------------------------------------------------------------------------------


def corner_ball(hot: int, value: float = 1e6) -> np.ndarray:
    """A ball in the corner of a large volume, and far from it a few hot voxels."""
    x = np.arange(2 * N)
    r2 = sum(np.square(c - 9.0) for c in np.meshgrid(x, x, x, indexing="ij"))
    values = np.where(r2 < 49, 1.0, 0.0).astype(np.float32) + 0.01 * np.random.default_rng(0).random(r2.shape, np.float32)
    for k in range(hot):
        values[2 * N - 2 - 7 * (k % 5), 2 * N - 2, 2 * N - 2 - 9 * (k // 5)] = value
    return values


@pytest.mark.parametrize(("hot", "value"), [(1, 1e6), (1, 1.0), (6, 1e6), (2, 0.9)])
def test_hot_voxels_do_not_move_the_frame(hot, value):
    tables = {"volume": {"builtin": "demo"}, "transfer": {"kind": "window"}, "camera": {"frame": "visible"}}
    eyes = []
    for volume in (jvr.Volume(corner_ball(0)), jvr.Volume(corner_ball(hot, value))):
        config = config_from(copy.deepcopy(tables), "test")
        (camera,) = build_cameras(config, volume, build_scene(config, volume).transfer)
        eyes.append(np.asarray(camera.world_from_camera))
    np.testing.assert_allclose(eyes[1], eyes[0], atol=1e-4)


def test_small_things_are_framed_where_they_are_many():
    """Grains of one voxel are what there is to see, and no hot voxels."""
    values = np.zeros((2 * N,) * 3, np.float32)
    values[4::10, 4::10, 4::10] = 1.0
    volume = jvr.Volume(values)
    tables = {"volume": {"builtin": "demo"}, "transfer": {"kind": "window", "window": 0.5, "level": 0.5, "sigma_t": 1.0}}
    config = config_from(tables | {"camera": {"frame": "visible", "view": "front"}}, "test")
    (camera,) = build_cameras(config, volume, build_scene(config, volume).transfer)
    # As far away as for all of them: 44 voxels at 30 degrees.
    assert float(volume.center[1] - camera.world_from_camera[1, 3]) > 44 / 2 / np.tan(np.radians(15))


@pytest.mark.parametrize("hot", [1, 5])
def test_hot_voxels_do_not_move_an_automatic_window(hot):
    np.testing.assert_allclose(contents(jvr.Volume(corner_ball(hot))), contents(jvr.Volume(corner_ball(0))), atol=0.05)


def test_names_that_are_no_text_are_printed(tmp_path):
    with open(os.fsencode(tmp_path) + b"/\xff.npy", "wb") as file:
        np.save(file, RAMP)
    done = subprocess.run(
        [sys.executable, "-c", "from jvr.cli import main; main()", "info", b"\xff.npy"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONIOENCODING": "utf-8:strict", "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
    )
    assert done.returncode == 0, done.stderr
    assert rb"\udcff.npy" in done.stdout


def test_what_is_up_is_said_by_what_a_file_holds_not_by_its_name(tmp_path):
    header = b"DimSize = 3 4 5\n%bElementType = MET_FLOAT\nElementDataFile = LOCAL\n"
    contents_of = {
        "a.mha": (header % b"", False),
        "b.mha": (header % b"TransformMatrix = 1 0 0 0 1 0 0 0 1\n", True),
        "IM0001": (bytes(128) + b"DICM", True),
        "slices/1.png": (b"1", False),
        "series/1": (bytes(128) + b"DICM", True),
        "a.zarr/.zgroup": (b"{}", False),
    }
    for name, (content, says) in contents_of.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
        path = tmp_path / name.split("/")[0]
        assert ("z is taken for it" in " ".join(first_picture(SCENE.volume, path, "scan").notes)) == (not says), name


def test_pictures_are_numbered_in_the_order_of_their_names():
    from pathlib import Path

    from jvr.cli.render import _names

    names = [path.name for path in _names(Path("a.png"), 101)]
    assert names == sorted(names)


def test_pictures_are_called_like_the_link_that_was_named(tmp_path):
    (tmp_path / "b.raw").write_bytes(b"1")
    (tmp_path / "scan.nii.gz").symlink_to("b.raw")
    assert name_of(tmp_path / "scan.nii.gz") == "scan"


def refused(command, message, capfd):
    assert cli.run(command) == 2
    assert message in capfd.readouterr().err


def test_flags_that_messages_name_are_flags_of_render_and_info(tmp_path, capfd):
    np.save(tmp_path / "a.npy", RAMP)
    path = str(tmp_path / "a.npy")
    for command in ("info", "render"):
        refused([command, path, "--array", "x"], "array= names an array", capfd)
        refused([command, path, "--series", "x"], "series= chooses among", capfd)
        refused([command, path, "--direction", "1,2"], "nine numbers", capfd)
        refused([command, path, "--slope", "0"], "the slope not 0", capfd)
    refused(["render", path, "--size", "1000000"], "1000000 x 1000000 pixels need 48,000,000,000,000 bytes", capfd)
    refused(["render", path, "--set", "volume={spacing=[1,1,1]}"], "one by one, such as volume.spacing=[1,1,2]", capfd)
    turned = ["--direction", "0,1,0,0,0,1,1,0,0", "--spacing", "0.5"]
    assert cli.run(["info", path, "--json", *turned]) == 0
    found = json.loads(capfd.readouterr().out)
    assert (found["orientation"], found["spacing"]) == ("PSL", [0.5, 0.5, 0.5])
