"""Radiance images and environment maps: the right numbers, upright, and one line for every bad file."""

import numpy as np
import OpenEXR
import OpenImageIO
import pytest

from jvr.io.environment import read_environment
from jvr.io.images import read_image
from jvr.pictures import ImageError, write_image

HEADER = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n"


def radiance_file(path, rgbe, *, header=HEADER, axes="-Y {0} +X {1}"):
    """Uncompressed: `rgbe` is `(rows, columns, 4)`, bytes."""
    rgbe = np.asarray(rgbe, np.uint8)
    path.write_bytes(header + axes.format(*rgbe.shape[:2]).encode() + b"\n" + rgbe.tobytes())
    return path


def compressed_file(path, pixels):
    """Run-length encoded, by a library."""
    height, width, _ = pixels.shape
    out = OpenImageIO.ImageOutput.create(str(path))
    assert out.open(str(path), OpenImageIO.ImageSpec(width, height, 3, "float"))
    assert out.write_image(np.ascontiguousarray(pixels, np.float32))
    assert out.close()
    return path


def exr_file(path, pixels):
    write_image(path, pixels)
    return path


def fails(match, call, path):
    """The call raises one line that names the file and matches."""
    with pytest.raises(ImageError, match=match) as caught:
        call(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    assert len(message) < 300 + len(str(path))


@pytest.fixture
def corners():
    """Two rows and three columns with another code in each pixel; none is brighter than 255 / 256 of its exponent's power of two."""
    return np.array([[[128, 64, 32, 129], [1, 2, 3, 140], [0, 0, 0, 0]], [[255, 0, 0, 128], [0, 128, 0, 1], [9, 9, 9, 100]]])


# --- Radiance --------------------------------------------------------------------------------------------------------


def test_codes_are_mantissa_times_a_power_of_two(tmp_path, corners):
    image = read_image(radiance_file(tmp_path / "a.hdr", corners))
    # Ward 1991: value = mantissa 2^(exponent - 136), and 0 where the exponent is 0.
    wanted = corners[..., :3] * 2.0 ** (corners[..., 3:] - 136)
    assert image.dtype == np.float32
    np.testing.assert_array_equal(image, wanted.astype(np.float32))


def test_run_lengths_within_half_a_code(tmp_path):
    pixels = np.random.default_rng(0).uniform(0, 100, (8, 40, 3)) ** 2
    pixels[:, 10:30] = 7
    image = read_image(compressed_file(tmp_path / "a.hdr", pixels))
    # The brightest of three channels has at least 128 codes.
    assert np.all(np.abs(image - pixels) <= pixels.max(axis=-1, keepdims=True) / 128)


@pytest.mark.parametrize(
    ("axes", "turned"), [("+Y {0} +X {1}", np.flipud), ("-Y {0} -X {1}", np.fliplr), ("+Y {0} -X {1}", lambda a: a[::-1, ::-1])]
)
def test_files_that_begin_at_another_corner_are_upright(tmp_path, corners, axes, turned):
    wanted = read_image(radiance_file(tmp_path / "a.hdr", corners))
    np.testing.assert_array_equal(read_image(radiance_file(tmp_path / "b.hdr", turned(corners), axes=axes)), wanted)


def test_exposure_is_taken_out(tmp_path, corners):
    plain = read_image(radiance_file(tmp_path / "a.hdr", corners))
    exposed = HEADER.replace(b"\n\n", b"\nEXPOSURE=4\n\n")
    np.testing.assert_array_equal(read_image(radiance_file(tmp_path / "b.hdr", corners, header=exposed)), plain / 4)


def test_bad_radiance_files_get_one_line(tmp_path, capfd):
    pixels = np.random.default_rng(0).uniform(0, 10, (16, 32, 3))
    content = compressed_file(tmp_path / "good.hdr", pixels).read_bytes()
    start = content.index(b"+X 32\n") + 6
    bad = tmp_path / "bad.hdr"
    for part, match in (
        (b"", "the file is empty"),
        (content[: len(content) // 2], "pixels are damaged or cut short"),
        (content[:-1], "pixels are damaged or cut short"),
        (content[:start], "pixels are damaged or cut short"),
        (content[:20], "header is damaged or cut short"),
        (content[: start - 12], "header is damaged or cut short"),
        (content[: start + 40] + bytes(100) + content[start + 140 :], "pixels are damaged"),
        (b"P6" + content[2:], "not a Radiance .hdr image"),
        (b"<html>", "looks like text"),
        (HEADER + b"-Y 0 +X 0\n", "header is damaged"),
        (HEADER + b"-Y -4 +X 8\n" + bytes(128), "header is damaged"),
        (HEADER + b"-Y 1000000 +X 1000000\n" + bytes(128), "header is damaged"),
        (HEADER.replace(b"rgbe", b"xyze") + b"-Y 1 +X 2\n" + bytes(8), "header is damaged"),
        (HEADER.replace(b"\n\n", b"\nEXPOSURE=0\n\n") + b"-Y 1 +X 2\n" + bytes(8), "exposure of 0.0; it must be positive"),
        (HEADER.replace(b"\n\n", b"\nGAMMA=2.2\n\n") + b"-Y 1 +X 2\n" + bytes(8), "export linear radiance"),
    ):
        bad.write_bytes(part)
        fails(match, read_image, bad)
    assert capfd.readouterr() == ("", "")


def test_announced_pixels_must_fit_in_memory(tmp_path, monkeypatch):
    monkeypatch.setattr("jvr.io.image_sizes.available_memory", lambda: 1000)
    fails("exceed the 1,000 bytes of free memory", read_image, radiance_file(tmp_path / "a.hdr", np.zeros((10, 20, 4))))


# --- Environment maps ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [exr_file, compressed_file])
def test_a_map_keeps_its_radiance_and_its_top(tmp_path, make):
    radiance = np.zeros((4, 8, 3), np.float32)
    radiance[0], radiance[3, 2] = [0.25, 0.5, 1.0], [0.0, 0.0, 4096.0]
    path = tmp_path / ("a.exr" if make is exr_file else "a.hdr")
    found = read_environment(make(path, radiance))
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, radiance)


@pytest.mark.parametrize(
    ("name", "shape", "largest", "mean"),
    [
        ("kiara_1_dawn_1k.hdr", (512, 1024, 3), 102.5, 0.833),
        ("potsdamer_platz_1k.hdr", (512, 1024, 3), 11.8125, 0.714),
        ("studio_small_03_1k.hdr", (512, 1024, 3), 3568.0, 1.882),
        ("StageEnvLatLong.exr", (500, 1000, 3), 4096.0, 2.901),
        ("OrientationLatLong.exr", (512, 1024, 3), 0.9956, 0.9165),
    ],
)
def test_published_light_probes(data, name, shape, largest, mean):
    radiance = read_environment(data / "env" / name)
    assert radiance.shape == shape
    # Figures that are rounded to the digits given.
    np.testing.assert_allclose([radiance.max(), radiance.mean()], [largest, mean], rtol=1e-3)


def test_the_sky_is_at_the_top(data):
    """An overcast square is lit from above."""
    radiance = read_environment(data / "env" / "potsdamer_platz_1k.hdr")
    assert radiance[:128].mean() > 2 * radiance[-128:].mean()


def test_the_finest_level_of_a_tiled_map(data):
    path = data / "env" / "StageEnvLatLong.exr"
    green = OpenEXR.File(str(path), separate_channels=True).channels()["G"].pixels
    np.testing.assert_array_equal(read_environment(path)[..., 1], green.astype(np.float32))


def test_maps_that_are_no_maps_get_one_line(tmp_path):
    fine = np.ones((4, 8, 3), np.float32)
    path = tmp_path / "a.exr"
    fails(r"it is 4 x 4 pixels; a latitude-longitude map is twice as wide as high", read_environment, exr_file(path, fine[:, :4]))
    fails("it is 7 x 4 pixels", read_environment, exr_file(path, fine[:, :7]))
    fails("it is 3 x 2 pixels", read_environment, radiance_file(tmp_path / "a.hdr", np.ones((2, 3, 4))))
    spoilt = fine.copy()
    spoilt[2, 5, 1], spoilt[3, 0] = np.nan, np.inf
    fails("pixels that are not finite: 2, the first at column 5, row 2; repair", read_environment, exr_file(path, spoilt))
    spoilt = fine.copy()
    spoilt[0, 3, 0] = -1e-3
    fails("pixels that are negative.*: 1, the first at column 3, row 0; repair", read_environment, exr_file(path, spoilt))
    write_image(tmp_path / "a.png", fine)
    fails("an environment map is .exr or .hdr", read_environment, tmp_path / "a.png")
    fails("not a name without an extension", read_environment, tmp_path / "a")


def test_a_missing_map_is_named(tmp_path):
    exr_file(tmp_path / "stage.exr", np.ones((4, 8, 3), np.float32))
    with pytest.raises(FileNotFoundError, match=r"did you mean 'stage.exr'"):
        read_environment(tmp_path / "stag.exr")
