"""Images read and written: what goes in comes out, upright, and no file is ever half of one."""

import io
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest
import SimpleITK as sitk
from PIL import Image

from jvr.atomic import replacing
from jvr.io.images import read_image
from jvr.pictures import ImageError, linear_from_srgb, srgb_from_linear, write_image

SHAPE = (9, 7)


@pytest.fixture
def pixels():
    return np.random.default_rng(1).uniform(0, 1, (*SHAPE, 3)).astype(np.float32)


@pytest.fixture
def red_top():
    """Red in row 0, blue in the last row, black between."""
    image = np.zeros((*SHAPE, 3), np.float32)
    image[0, :, 0], image[-1, :, 2] = 1, 1
    return image


def write_exr(path, channels, header=None):
    OpenEXR.File({"type": OpenEXR.scanlineimage, **(header or {})}, channels).write(str(path))


def fails(match, call, *arguments, error=ImageError, **keywords):
    """The call raises one line that matches."""
    with pytest.raises(error, match=match) as caught:
        call(*arguments, **keywords)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# --- The sRGB curve --------------------------------------------------------------------------------------------------


def test_srgb_curve_has_the_values_of_the_standard():
    # Code 118 of 255 is 18 % grey, 188 is half of the light; the linear toe ends at code 0.04045.
    np.testing.assert_allclose(255 * srgb_from_linear([0.0, 0.18, 0.5, 1.0]), [0, 117.6, 187.5, 255], atol=0.1)
    np.testing.assert_allclose(linear_from_srgb([0.04045, 0.5, 1.0]), [0.04045 / 12.92, 0.21404114, 1.0], rtol=1e-7)
    codes = np.linspace(0, 1, 1001)
    # The two branches of the standard meet only to 8 digits.
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(codes)), codes, atol=1e-7)


def test_srgb_clips_what_has_no_code():
    np.testing.assert_allclose(srgb_from_linear([-1.0, 7.0, np.inf]), [0, 1, 1], rtol=1e-15)


# --- Round trips -----------------------------------------------------------------------------------------------------


def test_exr_returns_every_bit(tmp_path, pixels):
    pixels[0, 0] = [1e-38, -3.5, 65_504e3]
    pixels[1, 1] = [np.nan, np.inf, -np.inf]
    write_image(tmp_path / "a.exr", jnp.asarray(pixels))
    found = read_image(tmp_path / "a.exr")
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, pixels)


def test_exr_keeps_alpha_and_depth_as_channels(tmp_path, pixels):
    alpha, depth = pixels[..., 0], 100 * pixels[..., 1]
    write_image(tmp_path / "a.exr", pixels, alpha, depth=depth)
    channels = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).channels()
    assert set(channels) == set("RGBAZ")
    np.testing.assert_array_equal(channels["A"].pixels, alpha)
    np.testing.assert_array_equal(channels["Z"].pixels, depth)
    assert channels["G"].pixels.dtype == np.float32
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), pixels)


def test_png_is_within_half_a_code(tmp_path, pixels):
    write_image(tmp_path / "a.png", pixels)
    difference = srgb_from_linear(read_image(tmp_path / "a.png")) - srgb_from_linear(pixels)
    # Reading rounds to float32.
    assert np.abs(255 * difference).max() <= 0.5 + 1e-4


def test_png_holds_colours_without_alpha(tmp_path):
    """Half-covered red at full brightness: linear 0.5 over black, code 255 and alpha 128 in the file."""
    alpha = np.full(SHAPE, 128 / 255, np.float32)
    image = np.stack([alpha, 0 * alpha, 0 * alpha], -1)
    image[0], alpha[0] = 0, 0
    write_image(tmp_path / "a.png", image, alpha)
    codes = np.asarray(Image.open(tmp_path / "a.png"))
    assert codes.shape == (*SHAPE, 4)
    assert codes[1, 1].tolist() == [255, 0, 0, 128]
    assert codes[0, 0].tolist() == [0, 0, 0, 0]
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), image, atol=1e-6)


def test_png_clips_light_beyond_its_range(tmp_path, pixels):
    write_image(tmp_path / "a.png", np.where(pixels > 0.5, 7.0, -3.0))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), (pixels > 0.5).astype(np.float32))


# --- Orientation -----------------------------------------------------------------------------------------------------


def test_row_0_is_at_the_top_for_other_readers(tmp_path, red_top):
    write_image(tmp_path / "a.png", red_top)
    write_image(tmp_path / "a.exr", red_top)
    by_pillow = np.asarray(Image.open(tmp_path / "a.png"))
    by_itk = sitk.GetArrayFromImage(sitk.ReadImage(str(tmp_path / "a.png")))
    by_openexr = OpenEXR.File(str(tmp_path / "a.exr")).channels()["RGB"].pixels
    for picture in (by_pillow / 255, by_itk / 255, by_openexr):
        np.testing.assert_array_equal(picture, red_top)


def test_row_0_is_at_the_top_of_other_writers_files(tmp_path, red_top):
    Image.fromarray((255 * red_top).astype(np.uint8)).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), red_top)
    planes = {name: np.ascontiguousarray(red_top[..., c]) for c, name in enumerate("RGB")}
    write_exr(tmp_path / "a.exr", planes, {"lineOrder": OpenEXR.DECREASING_Y})
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), red_top)


# --- Kinds of EXR ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "shape"), [("StageEnvLatLong", (500, 1000, 3)), ("OrientationLatLong", (512, 1024, 3))])
def test_finest_level_of_a_tiled_half_float_file(data, name, shape):
    image = read_image(data / "env" / f"{name}.exr")
    assert (image.shape, image.dtype) == (shape, np.float32)
    channels = OpenEXR.File(str(data / "env" / f"{name}.exr"), separate_channels=True).channels()
    np.testing.assert_array_equal(image[..., 2], channels["B"].pixels.astype(np.float32))


def test_grey_and_half_float(tmp_path, pixels):
    half = np.ascontiguousarray(pixels[..., 0].astype(np.float16))
    write_exr(tmp_path / "a.exr", {"Y": half})
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), np.stack([half.astype(np.float32)] * 3, -1))


def test_cropped_file_sits_where_its_window_says(tmp_path, pixels):
    planes = {name: np.ascontiguousarray(pixels[..., c]) for c, name in enumerate("RGB")}
    corner = lambda x, y: np.array([x, y], np.int32)
    windows = {"dataWindow": (corner(-2, 5), corner(4, 13)), "displayWindow": (corner(0, 0), corner(19, 14))}
    write_exr(tmp_path / "a.exr", planes, windows)
    wanted = np.zeros((15, 20, 3), np.float32)
    wanted[5:14, 0:5] = pixels[:, 2:]
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), wanted)


def test_missing_channels_are_named(tmp_path, pixels):
    plane = np.ascontiguousarray(pixels[..., 0])
    write_exr(tmp_path / "a.exr", {"R": plane, "G": plane, "Z": plane})
    fails("a.exr: its channels are G, R, Z; an image needs R, G and B", read_image, tmp_path / "a.exr")


# --- Kinds of PNG and JPEG -------------------------------------------------------------------------------------------


def test_sixteen_bits_are_all_used(tmp_path):
    codes = (np.arange(4 * 5 * 3).reshape(4, 5, 3) * 1111 + 7).astype(np.uint16)
    sitk.WriteImage(sitk.GetImageFromArray(codes, isVector=True), str(tmp_path / "rgb.png"))
    np.testing.assert_allclose(read_image(tmp_path / "rgb.png"), linear_from_srgb(codes / 65535), rtol=1e-6)
    Image.fromarray(codes[..., 0]).save(tmp_path / "grey.png")
    np.testing.assert_allclose(read_image(tmp_path / "grey.png")[..., 1], linear_from_srgb(codes[..., 0] / 65535), rtol=1e-6)


@pytest.mark.parametrize("mode", ["L", "LA", "P", "1", "RGBA"])
def test_every_kind_of_png_is_colour_in_the_end(tmp_path, mode):
    Image.new("RGB", (7, 9), (255, 255, 255)).convert(mode).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), np.ones((9, 7, 3), np.float32))


def test_what_a_file_says_of_itself_and_is_not_used_is_named(tmp_path):
    red = Image.new("RGB", (3, 2), (255, 0, 0))
    red.save(tmp_path / "profile.png", icc_profile=b"some camera's own")
    red.save(tmp_path / "many.png", save_all=True, append_images=[Image.new("RGB", (3, 2))])
    red.convert("CMYK").save(tmp_path / "inks.jpg")
    for name, match in (("profile.png", "profile that is not sRGB"), ("many.png", "2 pictures, the first"), ("inks.jpg", "inks")):
        with pytest.warns(UserWarning, match=f"{name}: .*{match}"):
            read_image(tmp_path / name)


def test_a_photograph_is_upright(tmp_path):
    """Orientation 6: what is the left column of the file is the top row for the eye."""
    image = Image.new("L", (2, 4))
    image.putpixel((0, 3), 255)
    exif = Image.Exif()
    exif[0x0112] = 6
    image.save(tmp_path / "a.png", exif=exif)
    found = read_image(tmp_path / "a.png")
    assert found.shape == (2, 4, 3)
    assert np.argwhere(found[..., 0]).tolist() == [[0, 0]]


def test_jpeg_is_srgb_too(tmp_path):
    Image.new("RGB", (16, 8), (188, 188, 188)).save(tmp_path / "a.JPG", format="JPEG", quality=95)
    np.testing.assert_allclose(read_image(tmp_path / "a.JPG"), np.full((8, 16, 3), 0.503), atol=0.01)


# --- Bad files and bad arguments -------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".exr", ".png", ".jpg"])
def test_bad_files_get_one_line(tmp_path, pixels, ending, capfd):
    path = tmp_path / f"good{ending}"
    noise = np.random.default_rng(0).uniform(size=(64, 64, 3))
    if ending == ".jpg":
        Image.fromarray((255 * noise).astype(np.uint8)).save(path)
    else:
        write_image(path, noise)
    content = path.read_bytes()
    bad = tmp_path / f"bad{ending}"
    for part, match in (
        (content[: len(content) // 2], "cut short"),
        (content[:40], "cut short"),
        (b"", "empty"),
        (b"<html>", "text"),
    ):
        bad.write_bytes(part)
        assert str(bad) in fails(match, read_image, bad)
    fails(f"did you mean 'good{ending}'", read_image, tmp_path / f"goood{ending}", error=FileNotFoundError)
    assert capfd.readouterr() == ("", "")


def test_damaged_pixels_of_an_exr(tmp_path):
    write_image(tmp_path / "a.exr", np.random.default_rng(0).normal(size=(64, 64, 3)))
    content = bytearray((tmp_path / "a.exr").read_bytes())
    content[len(content) // 2 : len(content) // 2 + 500] = bytes(500)
    (tmp_path / "a.exr").write_bytes(content)
    fails("damaged or cut short", read_image, tmp_path / "a.exr")


def test_wrong_names(tmp_path, pixels):
    write_image(tmp_path / "a.png", pixels)
    (tmp_path / "a.png").rename(tmp_path / "a.exr")
    fails("looks like a PNG image; give the file its right extension", read_image, tmp_path / "a.exr")
    fails("cannot read .tga; images are .exr, .hdr, .png, .jpg or .tif", read_image, tmp_path / "a.tga")
    (tmp_path / "b.png").mkdir()
    fails("this is a folder", read_image, tmp_path / "b.png")
    fails("cannot write .jpg; use .exr", write_image, tmp_path / "c.jpg", pixels)


def test_bad_arguments(tmp_path, pixels):
    fails(r"an image is \(height, width, 3\)", write_image, tmp_path / "a.png", pixels[..., 0])
    fails(r"alpha has shape \(7,\)", write_image, tmp_path / "a.exr", pixels, pixels[0, :, 0])
    fails("no room for depth; write .exr", write_image, tmp_path / "a.png", pixels, depth=pixels[..., 0])
    pixels[0, 0, 0], pixels[2, 3] = np.nan, np.inf
    fails("2 pixels are not finite, which a PNG cannot hold; write .exr", write_image, tmp_path / "a.png", pixels)
    assert not list(tmp_path.iterdir())


# --- Nothing half written --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".exr", ".png"])
def test_missing_folder(tmp_path, pixels, ending):
    fails("does not exist; create it first", write_image, tmp_path / "none" / f"a{ending}", pixels, error=FileNotFoundError)


@pytest.mark.parametrize("ending", [".exr", ".png"])
def test_folder_in_the_way(tmp_path, pixels, ending):
    (tmp_path / f"a{ending}").mkdir()
    fails("cannot be written: Is a directory", write_image, tmp_path / f"a{ending}", pixels, error=OSError)
    assert [p.name for p in tmp_path.iterdir()] == [f"a{ending}"]


def test_failure_in_the_middle_keeps_the_old_exr(tmp_path, pixels, monkeypatch):
    write_image(tmp_path / "a.exr", pixels)

    def breaks(self, name):
        with open(name, "wb") as file:
            file.write(b"half")
        raise RuntimeError("no space left")

    monkeypatch.setattr(OpenEXR.File, "write", breaks)
    fails("a.exr: cannot be written: no space left", write_image, tmp_path / "a.exr", 2 * pixels, error=OSError)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), pixels)
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


def test_any_failure_keeps_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def interrupted():
        with replacing(path) as temporary:
            assert temporary.parent == tmp_path
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    with replacing(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_what_frames_or_tiles_a_picture_is_checked_before_it_is_decoded(tmp_path, monkeypatch):
    """The library takes memory for the whole of a tile, and a frame is filled with black."""
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 64
    planes = {name: np.ones((8, 16), np.float32) for name in "RGB"}
    path = tmp_path / "a.exr"
    OpenEXR.File({"type": OpenEXR.tiledimage, "tiles": tiles}, dict(planes)).write(str(path))
    assert read_image(path).shape == (8, 16, 3)
    whole, sizes = path.read_bytes(), np.array([64, 64], "<u4").tobytes()
    assert whole.count(sizes) == 1
    path.write_bytes(whole.replace(sizes, np.array([20000, 20000], "<u4").tobytes()))
    fails("tiles of 20,000 x 20,000", read_image, path)
    corner = np.array([0, 0, 15, 7], "<i4").tobytes()
    at = whole.index(b"displayWindow")
    path.write_bytes(whole[:at] + whole[at:].replace(corner, np.array([0, 0, 19999, 19999], "<i4").tobytes(), 1))
    monkeypatch.setattr("jvr.io.image_sizes.available_memory", lambda: 4_000_000_000)
    fails("4,800,000,000 bytes of pixels exceed the 4,000,000,000", read_image, path)


def test_reading_png_needs_no_openexr():
    """Importing the module and reading a PNG leave OpenEXR and ITK alone."""
    buffer = io.BytesIO()
    Image.new("RGB", (2, 2)).save(buffer, format="PNG")
    program = (
        "import sys, tempfile, pathlib, jvr.io.images as images\n"
        "path = pathlib.Path(tempfile.mkdtemp()) / 'a.png'\n"
        f"path.write_bytes({buffer.getvalue()!r})\n"
        "images.read_image(path)\n"
        "assert not {'OpenEXR', 'OpenImageIO', 'SimpleITK', 'matplotlib'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
