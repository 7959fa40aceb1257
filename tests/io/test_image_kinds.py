"""Pictures that other programs wrote: what their numbers mean is said or asked for, never guessed in silence."""

import warnings

import imageio.v3 as imageio
import numpy as np
import OpenEXR
import OpenImageIO
import pytest
import tifffile
from PIL import Image, ImageOps, PngImagePlugin

from jvr.io.images import read_image
from jvr.pictures import ImageError, linear_from_srgb, write_image

RNG = np.random.default_rng(2)
CODES = RNG.integers(0, 256, (6, 5, 4)).astype(np.uint8)
# 8-bit codes of a translucent cloud, (1, 1/2, 1/4) times its opacity, in the middle of a picture and in its corner, as VTK 9.7's ray
# casters hand them to vtkPNGWriter from a window with alpha planes: over black, and over a background of (0.2, 0.4, 0.6).
VTK_BLACK = np.array([[[137, 68, 34, 137], [0, 0, 0, 0]]], np.uint8)
VTK_BLUE = np.array([[[161, 115, 105, 137], [51, 102, 153, 0]]], np.uint8)
# Rounding to 8 bits twice: in VTK's opacity and in its colours.
CODE = 1.5 / 255


@pytest.fixture(autouse=True)
def _nothing_is_said_unless_a_test_expects_it():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def said(path, match, **keywords):
    """The picture, about which one line is said."""
    with pytest.warns(UserWarning, match=match) as caught:
        found = read_image(path, **keywords)
    assert len(caught) == 1
    assert "\n" not in str(caught[0].message)
    return found


def with_openimageio(path, pixels, kind, names=None, tile=0):
    spec = OpenImageIO.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    spec.tile_width = spec.tile_height = tile
    if names:
        spec.channelnames = names
    spec.attribute("oiio:UnassociatedAlpha", 1)
    file = OpenImageIO.ImageOutput.create(str(path))
    assert file.open(str(path), spec), file.geterror()
    file.write_image(pixels)
    file.close()


# --- What whole numbers mean -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_codes_are_what_is_said_of_them(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    imageio.imwrite(path, CODES[..., :3])
    codes = imageio.imread(path) / 255
    np.testing.assert_allclose(read_image(path, encoding="linear"), codes, rtol=1e-6)
    np.testing.assert_allclose(read_image(path, encoding="srgb"), linear_from_srgb(codes), rtol=1e-6)
    guessed = said(path, r"do not say their encoding are taken as sRGB: say encoding = \"srgb\", or \"linear\" for what VTK")
    np.testing.assert_array_equal(guessed, read_image(path, encoding="srgb"))


def test_of_many_files_that_is_said_once(tmp_path):
    for name in "ab":
        imageio.imwrite(tmp_path / f"{name}.png", CODES[..., :3])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for name in "ab":
            read_image(tmp_path / f"{name}.png")
    assert len(caught) == 1


def test_nothing_is_said_of_files_that_say_it_themselves(tmp_path):
    write_image(tmp_path / "ours.png", linear_from_srgb(CODES[..., :3] / 255))
    chunks = PngImagePlugin.PngInfo()
    chunks.add(b"sRGB", b"\0")
    Image.fromarray(CODES[..., :3]).save(tmp_path / "theirs.png", pnginfo=chunks)
    for name in ("ours.png", "theirs.png"):
        np.testing.assert_allclose(read_image(tmp_path / name), linear_from_srgb(CODES[..., :3] / 255), rtol=1e-6)
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 1
    Image.fromarray(CODES[..., :3]).save(tmp_path / "camera.jpg", exif=exif)
    read_image(tmp_path / "camera.jpg")


def test_a_gamma_is_named_until_somebody_says_what_the_codes_are(tmp_path):
    chunks = PngImagePlugin.PngInfo()
    chunks.add(b"gAMA", (100_000).to_bytes(4, "big"))
    Image.fromarray(CODES[..., :3]).save(tmp_path / "a.png", pnginfo=chunks)
    said(tmp_path / "a.png", r"a\.png: states a gamma of 1 / 1, .*or give encoding=")
    np.testing.assert_allclose(read_image(tmp_path / "a.png", encoding="linear"), CODES[..., :3] / 255, rtol=1e-6)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_sixteen_bits_of_every_number_of_channels(tmp_path, channels):
    codes = RNG.integers(0, 65536, (4, 5, channels)).astype(np.uint16)
    codes[0, 0] = 65535
    with_openimageio(tmp_path / "a.png", codes, OpenImageIO.UINT16)
    colours, alpha = (codes[..., :-1], codes[..., -1:] / 65535) if channels in (2, 4) else (codes, 1)
    found = read_image(tmp_path / "a.png", encoding="linear", background=(0, 0, 0))
    np.testing.assert_allclose(found, np.broadcast_to(colours / 65535 * alpha, (4, 5, 3)), rtol=1e-5)


def test_grey_and_palettes_are_linear_where_that_is_said(tmp_path):
    Image.fromarray(CODES[..., 0]).save(tmp_path / "grey.png")
    np.testing.assert_allclose(read_image(tmp_path / "grey.png", encoding="linear")[..., 2], CODES[..., 0] / 255, rtol=1e-6)
    palette = Image.fromarray(CODES[..., :3]).quantize(8)
    palette.save(tmp_path / "palette.png")
    np.testing.assert_allclose(
        read_image(tmp_path / "palette.png", encoding="linear"), np.asarray(palette.convert("RGB")) / 255, rtol=1e-6
    )


# --- What an alpha means ---------------------------------------------------------------------------------------------


def test_straight_colours_are_multiplied_by_their_alpha(tmp_path):
    imageio.imwrite(tmp_path / "a.png", CODES)
    alpha, behind = CODES[..., 3:] / 255, np.array([0.2, 0.4, 0.8])
    for encoding, light in (("linear", CODES[..., :3] / 255), ("srgb", linear_from_srgb(CODES[..., :3] / 255))):
        found = read_image(tmp_path / "a.png", encoding=encoding, background=behind)
        np.testing.assert_allclose(found, alpha * light + (1 - alpha) * behind, atol=1e-6)


def test_what_vtk_saves_is_multiplied_already_or_over_its_background(tmp_path):
    imageio.imwrite(tmp_path / "black.png", VTK_BLACK)
    imageio.imwrite(tmp_path / "blue.png", VTK_BLUE)
    opacity, behind = 137 / 255, np.array([0.2, 0.4, 0.6])
    cloud = np.array([[opacity * np.array([1, 0.5, 0.25]), [0, 0, 0]]])
    over = cloud + (1 - np.array([[[opacity], [0]]])) * behind
    found = read_image(tmp_path / "black.png", encoding="linear", alpha="associated", background=(0, 0, 0))
    np.testing.assert_allclose(found, cloud, atol=CODE)
    found = read_image(tmp_path / "black.png", encoding="linear", alpha="associated", background=behind)
    np.testing.assert_allclose(found, over, atol=CODE)
    np.testing.assert_allclose(read_image(tmp_path / "blue.png", encoding="linear", alpha="ignored"), over, atol=CODE)
    said(tmp_path / "black.png", 'give alpha="associated", or alpha="straight"', encoding="linear", background=behind)


def test_an_exr_may_be_straight(tmp_path):
    planes = {name: np.full((2, 3), value, np.float32) for name, value in zip("RGBA", (0.8, 0.4, 0.2, 0.25), strict=True)}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, planes).write(str(tmp_path / "a.exr"))
    found = read_image(tmp_path / "a.exr", alpha="straight", background=(1, 1, 1))
    np.testing.assert_allclose(found[0, 0], 0.25 * np.array([0.8, 0.4, 0.2]) + 0.75, rtol=1e-6)
    np.testing.assert_allclose(read_image(tmp_path / "a.exr", alpha="ignored", background=(1, 1, 1))[0, 0], [0.8, 0.4, 0.2])


# --- OpenEXR of others -----------------------------------------------------------------------------------------------

HALVES = RNG.normal(1, 3, (40, 50, 4)).astype(np.float16)


def test_tiles_of_halves(tmp_path):
    with_openimageio(tmp_path / "a.exr", HALVES[..., :3], OpenImageIO.HALF, tile=16)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), HALVES[..., :3].astype(np.float32))


def test_a_layer_is_found_by_its_name(tmp_path):
    """Channels as Blender and Nuke call them."""
    names = ["View.Combined.R", "View.Combined.G", "View.Combined.B", "View.Combined.A", "key.red", "key.green", "key.blue"]
    names += ["View.Normal.X", "View.Normal.Y", "View.Normal.Z", "mask.Y"]
    pixels = RNG.random((6, 7, len(names))).astype(np.float32)
    with_openimageio(tmp_path / "a.exr", pixels, OpenImageIO.FLOAT, names)
    found = lambda layer: read_image(tmp_path / "a.exr", layer=layer, alpha="ignored")
    np.testing.assert_array_equal(found("View.Combined"), pixels[..., :3])
    np.testing.assert_array_equal(found("key"), pixels[..., 4:7])
    np.testing.assert_array_equal(found("mask"), np.stack([pixels[..., 10]] * 3, -1))
    over = read_image(tmp_path / "a.exr", layer="View.Combined", background=(0.1, 0.2, 0.3))
    np.testing.assert_allclose(over, pixels[..., :3] + (1 - pixels[..., 3:4]) * [0.1, 0.2, 0.3], rtol=1e-6)
    for layer, message in (
        (None, "its layers are View.Combined, key, mask: name one of them with layer="),
        ("View.Normal", "there is no layer 'View.Normal'; its layers are View.Combined, key, mask"),
    ):
        with pytest.raises(ImageError, match=rf"a\.exr: {message}"):
            found(layer)


def test_the_only_layer_needs_no_name(tmp_path):
    pixels = RNG.random((6, 7, 4)).astype(np.float32)
    names = ["Scene.Combined.R", "Scene.Combined.G", "Scene.Combined.B", "Scene.Depth.Z"]
    with_openimageio(tmp_path / "a.exr", pixels, OpenImageIO.FLOAT, names)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), pixels[..., :3])


def test_parts_are_layers(tmp_path):
    planes = lambda k: {name: np.full((4, 5), k + i, np.float32) for i, name in enumerate("BGR")}
    parts = [OpenEXR.Part({"name": name, "type": OpenEXR.scanlineimage}, planes(k)) for k, name in ((1, "beauty"), (5, "glow"))]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    for layer, first in ((None, 3), ("beauty", 3), ("glow", 7)):
        np.testing.assert_array_equal(read_image(tmp_path / "a.exr", layer=layer)[0, 0], [first, first - 1, first - 2])


# --- What does not go together ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "keywords", "message"),
    [
        ("a.png", {"encoding": "sRGB"}, "encoding must be 'srgb' or 'linear', not 'sRGB'"),
        ("a.png", {"alpha": "premultiplied"}, "alpha must be 'straight', 'associated' or 'ignored', not 'premultiplied'"),
        ("a.png", {"layer": "beauty"}, r"a\.png: only OpenEXR images have layers: leave layer out"),
        ("a.exr", {"encoding": "srgb"}, r"a\.exr: the format holds linear radiance: leave encoding out"),
        ("a.exr", {"layer": "beauty"}, r"a\.exr: there is no layer 'beauty'; it has no layers with a name"),
    ],
)
def test_choices_that_a_file_cannot_have(tmp_path, name, keywords, message):
    write_image(tmp_path / name, np.zeros((2, 3, 3)))
    with pytest.raises(ValueError, match=message):
        read_image(tmp_path / name, **keywords)


# --- TIFF ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("planar", ["contig", "separate"])
@pytest.mark.parametrize("kind", ["u1", "u2"])
@pytest.mark.parametrize("compression", [None, "deflate"])
def test_codes_of_a_tiff(tmp_path, kind, planar, compression):
    codes = RNG.integers(0, np.iinfo(kind).max + 1, (6, 5, 3)).astype(kind)
    stored = np.moveaxis(codes, -1, 0) if planar == "separate" else codes
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", planarconfig=planar, compression=compression)
    found = read_image(tmp_path / "a.tif", encoding="linear")
    np.testing.assert_allclose(found, codes / np.iinfo(kind).max, rtol=1e-6)
    guessed = said(tmp_path / "a.tif", "do not say their encoding")
    np.testing.assert_allclose(guessed, linear_from_srgb(codes / np.iinfo(kind).max), rtol=1e-6)


def test_floating_point_numbers_of_a_tiff_are_radiance(tmp_path):
    pixels = RNG.normal(1, 3, (6, 5, 3)).astype(np.float32)
    pixels[0, 0] = np.nan
    tifffile.imwrite(tmp_path / "a.tiff", pixels, photometric="rgb", compression="lzw", predictor=True)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tiff"), pixels)
    tifffile.imwrite(tmp_path / "grey.tif", pixels[..., 0].astype(np.float64), photometric="minisblack")
    np.testing.assert_array_equal(read_image(tmp_path / "grey.tif"), np.stack([pixels[..., 0]] * 3, -1))
    with pytest.raises(
        ImageError, match=r"a\.tiff: it holds floating-point numbers, which are linear radiance: leave encoding out"
    ):
        read_image(tmp_path / "a.tiff", encoding="srgb")


def test_a_tiff_says_what_its_alpha_is(tmp_path):
    alpha, behind = CODES[..., 3:] / 255, np.array([0.2, 0.4, 0.8])
    for kind, colours in (("unassalpha", CODES[..., :3] / 255 * alpha), ("assocalpha", CODES[..., :3] / 255)):
        tifffile.imwrite(tmp_path / "a.tif", CODES, photometric="rgb", extrasamples=[kind])
        found = read_image(tmp_path / "a.tif", encoding="linear", background=behind)
        np.testing.assert_allclose(found, colours + (1 - alpha) * behind, atol=1e-6)
    tifffile.imwrite(tmp_path / "a.tif", CODES, photometric="rgb", extrasamples=["unspecified"])
    np.testing.assert_allclose(read_image(tmp_path / "a.tif", encoding="linear"), CODES[..., :3] / 255, rtol=1e-6)


def test_palettes_and_inverted_greys_of_pillow(tmp_path):
    palette = Image.fromarray(CODES[..., :3]).quantize(8)
    palette.save(tmp_path / "palette.tif")
    wanted = np.asarray(palette.convert("RGB")) / 255
    np.testing.assert_allclose(read_image(tmp_path / "palette.tif", encoding="linear"), wanted, atol=1e-6)
    tifffile.imwrite(tmp_path / "white.tif", CODES[..., 0], photometric="miniswhite")
    np.testing.assert_allclose(read_image(tmp_path / "white.tif", encoding="linear")[..., 0], 1 - CODES[..., 0] / 255, atol=1e-6)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_tiff_is_upright_as_pillow_turns_it(tmp_path, orientation):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, CODES[..., :3], photometric="rgb", extratags=[(274, 3, 1, orientation, True)])
    turned = np.asarray(ImageOps.exif_transpose(Image.open(path)))
    np.testing.assert_allclose(read_image(path, encoding="linear"), turned / 255, rtol=1e-6)


@pytest.mark.parametrize(
    ("numbers", "keywords", "message"),
    [
        (CODES.reshape(4, 6, 5), {}, "it has 4 pages, an image has one: export that alone"),
        (CODES[..., 0].astype(np.int16), {}, r"it has numbers of 16 bits \(int16\): export it with 8 or 16 bits, or as floating"),
        (CODES[..., 0] > 99, {}, "it has numbers of 1 bits"),
        (CODES, {"photometric": "separated"}, "its colours are neither grey, a palette nor red, green and blue"),
    ],
)
def test_what_is_no_picture_of_a_tiff(tmp_path, numbers, keywords, message):
    tifffile.imwrite(tmp_path / "a.tif", numbers, **{"photometric": "minisblack", **keywords})
    with pytest.raises(ImageError, match=rf"a\.tif: {message}"):
        read_image(tmp_path / "a.tif", encoding="linear")


def test_a_tiff_whose_tags_contradict_each_other(tmp_path):
    """With 0 bits for each number, pages come out in another shape than the one that is announced."""
    path, bits = tmp_path / "a.tif", np.array([8, 8, 8], "<u2").tobytes()
    tifffile.imwrite(path, CODES[..., :3], photometric="rgb", byteorder="<", compression="deflate")
    content = path.read_bytes()
    assert content.count(bits) == 1
    path.write_bytes(content.replace(bits, bytes(6)))
    with pytest.raises(ImageError, match=r"a\.tif: its pages are .* where it says \(6, 5, 3\): export it again"):
        read_image(path, encoding="linear")
