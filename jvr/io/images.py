"""Images read: OpenEXR and Radiance as linear radiance, PNG, JPEG and TIFF by what their codes are. `jvr.pictures` writes them."""

import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Integer

from jvr.io.exr import read_exr
from jvr.io.image_sizes import check_pixels, check_radiance, sixteen_bits
from jvr.io.tiff_pictures import read_tiff_picture
from jvr.io.volumes.errors import SIGNATURES, first_bytes, one_line
from jvr.io.volumes.tiff import MAGIC as TIFF
from jvr.model.checks import colours
from jvr.pictures import ImageError, Pixels, Plane, linear_from_srgb
from jvr.types import ArrayLike

EXR, HDR, PNG, JPEG = (b"\x76\x2f\x31\x01",), (b"#?",), (b"\x89PNG",), (b"\xff\xd8\xff",)
KINDS = {
    ".exr": (EXR, "an OpenEXR image"),
    ".hdr": (HDR, "a Radiance .hdr image"),
    ".png": (PNG, "a PNG image"),
    ".jpg": (JPEG, "a JPEG image"),
    ".tif": (TIFF, "a TIFF image"),
}
KINDS |= {".jpeg": KINDS[".jpg"], ".tiff": KINDS[".tif"]}
ENCODINGS, ALPHAS = ("srgb", "linear"), ("straight", "associated", "ignored")
# Of Exif: where its own tags begin, and the one of them that says 1 for sRGB.
EXIF, COLOUR_SPACE = 0x8769, 0xA001


def read_image(
    path: str | bytes | os.PathLike,
    *,
    background: ArrayLike | None = None,
    encoding: str | None = None,
    alpha: str | None = None,
    layer: str | None = None,
) -> Pixels:
    """Linear radiance of an image file, row 0 at the top.

    - `background`: `(3,)` linear RGB, what shows through where a file has an alpha below 1; without one that is black, with a warning
      where the colours of the file are not over black already.
    - `encoding`: what the whole numbers of a PNG, JPEG or TIFF are: `"srgb"`, codes for a screen, or `"linear"`, proportional to light, as
      VTK, PyVista, ParaView and 3D Slicer save what they have rendered. Without it they are taken as sRGB, with a warning where the file
      does not say so itself.
    - `alpha`: what an alpha means: `"straight"` colours are not multiplied by it (the standard of PNG), `"associated"` ones are (that of
      OpenEXR; VTK and PyVista save PNG so), and `"ignored"` ones are over their background already. Without it, what the format's standard
      says.
    - `layer`: which layer of an EXR: what stands before the last dot in the names of its channels (`diffuse` of `diffuse.R`), or the name
      of one of its parts.

    What is read of each kind:

    - `.exr`: channels R, G, B, or Y alone (grey); half, float or integer; of a tiled file with several resolutions the finest. A cropped
      file is placed on black where its display window says.
    - `.hdr`: Radiance, 8 bits per channel and a common exponent; divided by the exposure that its header states.
    - `.png`, `.jpg`, `.tif`: 8 or 16 bits, grey, colour or palette, turned as the file says; a TIFF of one page also with floating-point
      numbers, which are linear, and with the alpha that it says.

    **Raises** `FileNotFoundError`, or `ImageError` (a `ValueError`) for a file that is empty, damaged, cut short, of another kind
    than its name says, or without colour channels, for a layer that it has not, or one of several that is not named; `ValueError` for
    an unknown encoding or alpha.
    """
    _check_choice("encoding", encoding, ENCODINGS)
    _check_choice("alpha", alpha, ALPHAS)
    path = Path(os.fsdecode(path))
    start = _beginning(path)
    magic, _ = KINDS[path.suffix.lower()]
    if layer is not None and magic != EXR:
        raise ImageError(path, "only OpenEXR images have layers: leave layer out")
    if encoding == "srgb" and magic in (EXR, HDR):
        raise ImageError(path, "the format holds linear radiance: leave encoding out")
    behind = None if background is None else np.asarray(colours(background, "background", (3,)))
    pixels, coverage, standard = _read(path, start, layer, encoding, alpha)
    if coverage is None or alpha == "ignored":
        return pixels
    is_straight = (alpha or standard) == "straight"
    if is_straight:
        pixels *= coverage[..., None]
    through = np.clip(1 - coverage, 0, 1)
    if not through.any():
        return pixels
    if behind is not None:
        return (pixels + through[..., None] * behind).astype(np.float32)
    if is_straight:
        count = np.count_nonzero(through)
        warnings.warn(
            f"{path}: {count:,} pixels are transparent and read as light over black: background= puts them over a colour",
            stacklevel=2,
        )
    return pixels


class Read(NamedTuple):
    """Colours as they are beside their alpha, that (`None` without one), and what it means by the standard of the format."""

    pixels: Pixels
    alpha: Plane | None = None
    standard: str | None = None


def _read(path: Path, start: bytes, layer: str | None, encoding: str | None, alpha: str | None) -> Read:
    magic, _ = KINDS[path.suffix.lower()]
    if magic == EXR:
        return Read(*read_exr(path, layer), "associated")
    if magic == HDR:
        return Read(_read_radiance(path))
    return _read_tiff(path, encoding) if magic == TIFF else _read_codes(path, start, encoding, alpha)


def _check_choice(name: str, given: str | None, known: tuple[str, ...]) -> None:
    if given is not None and given not in known:
        raise ValueError(f"{name} must be {', '.join(map(repr, known[:-1]))} or {known[-1]!r}, not {given!r}")


def _beginning(path: Path) -> bytes:
    """The first bytes of a file that is an image of the kind that its name says."""
    if path.suffix.lower() not in KINDS:
        raise ImageError(
            path, f"cannot read {path.suffix or 'a name without an extension'}; images are .exr, .hdr, .png, .jpg or .tif"
        )
    if path.is_dir():
        raise ImageError(path, "this is a folder; name one image")
    if path.exists() and path.stat().st_size == 0:
        raise ImageError(path, "the file is empty (0 bytes); copy or export it again")
    start = first_bytes(path, 64)
    magic, kind = KINDS[path.suffix.lower()]
    if not start.startswith(magic):
        raise ImageError(path, f"this is not {kind}, the content looks like {_kind(start)}; give the file its right extension")
    return start


def _kind(start: bytes) -> str:
    known = ((EXR, "an OpenEXR image"), (HDR, "a Radiance .hdr image"), (b"<!DOCTYPE", "a web page"), *SIGNATURES)
    printable = all(byte in b"\t\n\r" or byte >= 32 for byte in start)
    return next((name for magic, name in known if start.startswith(magic)), "text" if printable else "something else")


# --- Radiance --------------------------------------------------------------------------------------------------------


def _read_radiance(path: Path) -> Pixels:
    check_radiance(path)
    import OpenImageIO

    file = OpenImageIO.ImageInput.open(str(path))
    if file is None:
        reason = one_line(OpenImageIO.geterror())
        raise ImageError(path, f"the Radiance header is damaged or cut short ({reason}); copy or export it again")
    header = file.spec()
    exposure, gamma = (header.get_float_attribute(name, 1.0) for name in ("hdr:exposure", "oiio:Gamma"))
    if not 0 < exposure < np.inf:
        raise ImageError(path, f"its header states an exposure of {exposure}; it must be positive: correct it")
    if abs(gamma - 1) > 1e-3:
        raise ImageError(path, "its header states a GAMMA other than 1; export linear radiance")
    pixels = file.read_image(OpenImageIO.FLOAT)
    if pixels is None:
        raise ImageError(path, f"the pixels are damaged or cut short ({one_line(file.geterror())}); copy or export it again")
    # Which corner comes first, numbered as in TIFF: 1 top left, 2 top right, 3 bottom right, 4 bottom left.
    corner = header.get_int_attribute("Orientation", 1)
    upright = pixels[:: -1 if corner in (3, 4) else 1, :: -1 if corner in (2, 3) else 1]
    return np.ascontiguousarray(upright, np.float32) / np.float32(exposure)


# --- PNG, JPEG, TIFF -------------------------------------------------------------------------------------------------


def _read_codes(path: Path, start: bytes, encoding: str | None, alpha: str | None) -> Read:
    is_png, depth, kind = start.startswith(PNG), *(start[24:26] if len(start) > 25 else (0, 0))
    if is_png:
        bits = depth * {2: 3, 4: 2, 6: 4}.get(kind, 1)
        width, height = (int.from_bytes(start[k : k + 4], "big") for k in (16, 20))
        check_pixels(path, "png", width, height, bits / 8)
    try:
        # Pillow would silently drop the lower 8 of 16 bits of a colour PNG.
        code = _codes(path, encoding, sixteen=is_png and depth == 16 and kind != 0)
    except ImageError:
        raise
    except Exception as error:
        raise ImageError(path, f"the image is damaged or cut short ({one_line(error)}); copy or export it again") from error
    code = code[..., None] if code.ndim == 2 else code
    if alpha is None and code.shape[2] in (2, 4) and _looks_associated(code):
        warnings.warn(
            f"{path}: no colour exceeds its alpha, as where they are multiplied by it already (VTK, PyVista); it is read as straight, "
            'as is the standard: give alpha="associated", or alpha="straight"',
            stacklevel=4,
        )
    return Read(*_light(code, encoding), "straight")


def _read_tiff(path: Path, encoding: str | None) -> Read:
    numbers, alpha, profile = read_tiff_picture(path)
    if numbers.dtype.kind == "u":
        if encoding is None and (remark := UNSAID if profile is None else _about(profile)):
            warnings.warn(remark if remark == UNSAID else f"{path}: {remark}", stacklevel=4)
        return Read(*_light(numbers, encoding), alpha)
    if encoding == "srgb":
        raise ImageError(path, "it holds floating-point numbers, which are linear radiance: leave encoding out")
    return Read(*_apart(numbers.astype(np.float32)), alpha)


def _light(code: Integer[np.ndarray, "height width channels"], encoding: str | None) -> tuple[Pixels, Plane | None]:
    """Linear light and alpha of codes."""
    # One number for each code: a picture takes no more memory on its way than at its end.
    codes = np.arange(np.iinfo(code.dtype).max + 1) / np.iinfo(code.dtype).max
    light = (codes if encoding == "linear" else linear_from_srgb(codes)).astype(np.float32)
    colour, alpha = _apart(code)
    return light[colour], None if alpha is None else codes.astype(np.float32)[alpha]


def _apart(channels: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Three colours, and the alpha of two or four channels."""
    has_alpha = channels.shape[2] in (2, 4)
    colour = channels[..., :-1] if has_alpha else channels
    return np.ascontiguousarray(np.broadcast_to(colour, (*colour.shape[:2], 3))), channels[..., -1] if has_alpha else None


def _looks_associated(code: Integer[np.ndarray, "height width channels"]) -> bool:
    between = (code[..., -1] > 0) & (code[..., -1] < np.iinfo(code.dtype).max)
    brightest = code[..., :-1].max(axis=-1)
    return bool(np.any(between & (brightest > 0)) and np.all(brightest <= code[..., -1]))


def _codes(path: Path, encoding: str | None, *, sixteen: bool) -> Integer[np.ndarray, "..."]:
    """The codes of all channels; `sixteen`: of colours with 16 bits."""
    from PIL import Image, ImageOps

    # Of all that Pillow knows, some formats start other programs.
    with Image.open(path, formats=("PNG", "JPEG", "MPO")) as image:
        check_pixels(path, "jpeg", *image.size, 1)
        for remark in _remarks(image, encoding):
            warnings.warn(remark if remark == UNSAID else f"{path}: {remark}", stacklevel=5)
        if sixteen:
            return sixteen_bits(path)
        image = ImageOps.exif_transpose(image)
        if image.mode.startswith("I"):
            return np.asarray(image).astype(np.uint16)
        return np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))


# The same for all files, so that Python says it once.
UNSAID = (
    'pictures of whole numbers that do not say their encoding are taken as sRGB: say encoding = "srgb", or "linear" for what VTK, '
    "PyVista, ParaView or 3D Slicer have rendered"
)


def _remarks(image: Any, encoding: str | None) -> Iterator[str]:
    """What a file says of itself that plays no part in how it is read, and what it does not say."""
    if getattr(image, "n_frames", 1) > 1:
        yield f"holds {image.n_frames} pictures, the first is read"
    if image.mode == "CMYK":
        yield "holds inks (CMYK), converted without their profile; export it as sRGB"
    if encoding is not None:
        return
    profile, gamma = image.info.get("icc_profile"), image.info.get("gamma")
    if profile and (remark := _about(profile)):
        yield remark
    elif profile or "srgb" in image.info or (image.format != "PNG" and image.getexif().get_ifd(EXIF).get(COLOUR_SPACE) == 1):
        return
    elif gamma is None:
        yield UNSAID
    elif abs(gamma * 2.2 - 1) > 0.02:
        yield f"states a gamma of 1 / {1 / gamma:.3g}, its codes are taken as sRGB; export it as sRGB, or give encoding="


def _about(profile: bytes) -> str | None:
    """What is said of an ICC profile, nothing of that of sRGB."""
    if b"sRGB" in profile or b"s\0R\0G\0B" in profile:
        return None
    return "carries a colour profile that is not sRGB, its codes are taken as sRGB; export it as sRGB, or give encoding="
