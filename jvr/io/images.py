"""Images read: OpenEXR and Radiance as linear radiance, PNG and JPEG through the sRGB curve. `jvr.pictures` writes them."""

import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Integer

from jvr.io.image_sizes import check_exr, check_pixels, check_radiance, sixteen_bits
from jvr.io.volumes.errors import SIGNATURES, first_bytes, one_line
from jvr.model.checks import colours
from jvr.pictures import ImageError, Pixels, Plane, linear_from_srgb, quiet
from jvr.types import ArrayLike

EXR, HDR, PNG, JPEG = b"\x76\x2f\x31\x01", b"#?", b"\x89PNG", b"\xff\xd8\xff"
KINDS = {
    ".exr": (EXR, "an OpenEXR image"),
    ".hdr": (HDR, "a Radiance .hdr image"),
    ".png": (PNG, "a PNG image"),
    ".jpg": (JPEG, "a JPEG image"),
}
KINDS[".jpeg"] = KINDS[".jpg"]


def read_image(path: str | bytes | os.PathLike, *, background: ArrayLike | None = None) -> Pixels:
    """Linear radiance of an image file, row 0 at the top.

    `background`, `(3,)` linear RGB, is what shows through where a file has an alpha below 1; without one that is black, with a warning
    where the colours of the file are not over black already.

    - `.exr`: channels R, G, B, or Y alone (grey); half, float or integer; of a tiled file with several resolutions the finest.
      EXR's colours are light over black already, to which its alpha adds the background. A cropped file is placed on black where its
      display window says.
    - `.hdr`: Radiance, 8 bits per channel and a common exponent; divided by the exposure that its header states.
    - `.png`, `.jpg`: 8 or 16 bits, taken as sRGB, with a warning where the file says otherwise; turned as its EXIF says; with an
      alpha the colours are multiplied by it, which makes them light over black too.

    **Raises** `FileNotFoundError`, or `ImageError` (a `ValueError`) for a file that is empty, damaged, cut short, of another kind
    than its name says, or without colour channels.
    """
    path = Path(os.fsdecode(path))
    if path.suffix.lower() not in KINDS:
        raise ImageError(path, f"cannot read {path.suffix or 'a name without an extension'}; images are .exr, .hdr, .png or .jpg")
    if path.is_dir():
        raise ImageError(path, "this is a folder; name one image")
    if path.exists() and path.stat().st_size == 0:
        raise ImageError(path, "the file is empty (0 bytes); copy or export it again")
    start = first_bytes(path, 64)
    magic, kind = KINDS[path.suffix.lower()]
    if not start.startswith(magic):
        raise ImageError(path, f"this is not {kind}, the content looks like {_kind(start)}; give the file its right extension")
    behind = None if background is None else np.asarray(colours(background, "background", (3,)))
    if magic == HDR:
        return _read_radiance(path)
    pixels, alpha = _read_exr(path) if magic == EXR else _read_srgb(path, start)
    through = None if alpha is None else np.clip(1 - alpha, 0, 1)
    if through is None or not through.any():
        return pixels
    if behind is not None:
        return (pixels + through[..., None] * behind).astype(np.float32)
    if magic != EXR:
        count = np.count_nonzero(through)
        warnings.warn(
            f"{path}: {count:,} pixels are transparent and read as light over black: background= puts them over a colour",
            stacklevel=2,
        )
    return pixels


def _kind(start: bytes) -> str:
    known = ((EXR, "an OpenEXR image"), (HDR, "a Radiance .hdr image"), (b"<!DOCTYPE", "a web page"), *SIGNATURES)
    printable = all(byte in b"\t\n\r" or byte >= 32 for byte in start)
    return next((name for magic, name in known if start.startswith(magic)), "text" if printable else "something else")


# --- OpenEXR ---------------------------------------------------------------------------------------------------------


def _read_exr(path: Path) -> tuple[Pixels, Plane | None]:
    check_exr(path)
    with quiet():
        import OpenEXR

        try:
            header = OpenEXR.File(str(path), header_only=True).header()
        except Exception as error:
            raise ImageError(path, f"the OpenEXR header is damaged or cut short ({one_line(error)}); export it again") from error
    colour = _colour_channels(path, header)
    wanted = (*colour, *("A" for channel in header["channels"] if channel.name == "A"))
    low, high = _window(header["dataWindow"])
    with quiet():
        # OpenEXR says only on the terminal that pixels are missing, and then returns a file without parts.
        try:
            channels = OpenEXR.File(str(path), separate_channels=True).channels()
            planes = [channels[name].pixels for name in wanted]
        except Exception as error:
            raise ImageError(path, "the pixels are damaged or cut short; copy or export the file again") from error
    if any(plane.shape != tuple((high - low)[::-1]) for plane in planes):
        raise ImageError(path, f"channels {', '.join(wanted)} do not have the full resolution; save them without subsampling")
    if any(not np.issubdtype(plane.dtype, np.floating) for plane in planes[len(colour) :]):
        wanted, planes = colour, planes[: len(colour)]
    pixels = np.stack([plane.astype(np.float32) for plane in planes], axis=-1)
    framed = _framed(pixels, low, *_window(header["displayWindow"]))
    picture = np.broadcast_to(framed[..., : len(colour)], (*framed.shape[:2], 3))
    return np.ascontiguousarray(picture), None if len(wanted) == len(colour) else framed[..., -1]


def _colour_channels(path: Path, header: dict[str, Any]) -> tuple[str, ...]:
    names = [channel.name for channel in header["channels"]]
    if "deep" in str(header.get("type")):
        raise ImageError(path, "this is a deep image, with many samples in a pixel; flatten it first")
    if {"R", "G", "B"} <= set(names):
        return "R", "G", "B"
    if "Y" in names and not {"RY", "BY"} & set(names):
        return ("Y",)
    raise ImageError(path, f"its channels are {', '.join(names) or 'none'}; an image needs R, G and B, or Y alone")


def _window(window: Any) -> tuple[np.ndarray, np.ndarray]:
    """First column and row, and those after the last."""
    return np.asarray(window[0], np.int64), np.asarray(window[1], np.int64) + 1


def _framed(
    pixels: Float32[np.ndarray, "height width channels"], corner: np.ndarray, low: np.ndarray, high: np.ndarray
) -> Float32[np.ndarray, "rows columns channels"]:
    """Pixels whose first is at `corner` = (column, row), seen in the window from `low` to `high`; black where there are none."""
    end = corner + pixels.shape[1::-1]
    if np.array_equal(corner, low) and np.array_equal(end, high):
        return pixels
    framed = np.zeros((*(high - low)[::-1], pixels.shape[2]), np.float32)
    first, last = np.maximum(corner, low), np.minimum(end, high)
    if np.all(first < last):
        part = lambda origin: tuple(slice(a, b) for a, b in zip((first - origin)[::-1], (last - origin)[::-1], strict=True))
        framed[part(low)] = pixels[part(corner)]
    return framed


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


# --- PNG, JPEG -------------------------------------------------------------------------------------------------------


def _read_srgb(path: Path, start: bytes) -> tuple[Pixels, Plane | None]:
    if start.startswith(PNG):
        bits = start[24] * {2: 3, 4: 2, 6: 4}.get(start[25], 1) if len(start) > 25 else 0
        width, height = (int.from_bytes(start[k : k + 4], "big") for k in (16, 20))
        check_pixels(path, "png", width, height, bits / 8)
    try:
        # Pillow would silently drop the lower 8 of 16 bits of a colour PNG (depth and colour type are bytes 24 and 25).
        code = sixteen_bits(path) if start.startswith(PNG) and start[24] == 16 and start[25] != 0 else _eight_bits(path)
    except ImageError:
        raise
    except Exception as error:
        raise ImageError(path, f"the image is damaged or cut short ({one_line(error)}); copy or export it again") from error
    if code.ndim == 2:
        code = code[..., None]
    # One number for each code: a picture takes no more memory on its way than at its end.
    codes = np.arange(np.iinfo(code.dtype).max + 1) / np.iinfo(code.dtype).max
    linear = linear_from_srgb(codes).astype(np.float32)
    has_alpha = code.shape[2] in (2, 4)
    picture = linear[np.broadcast_to(code[..., :-1] if has_alpha else code, (*code.shape[:2], 3))]
    if not has_alpha:
        return picture, None
    alpha = codes.astype(np.float32)[code[..., -1]]
    picture *= alpha[..., None]
    return picture, alpha


def _eight_bits(path: Path) -> Integer[np.ndarray, "..."]:
    """Codes of everything but colour with 16 bits."""
    from PIL import Image, ImageOps

    # Of all that Pillow knows, some formats start other programs.
    with Image.open(path, formats=("PNG", "JPEG", "MPO")) as image:
        check_pixels(path, "jpeg", *image.size, 1)
        for guess in _guesses(image):
            warnings.warn(f"{path}: {guess}", stacklevel=4)
        image = ImageOps.exif_transpose(image)
        if image.mode.startswith("I"):
            return np.asarray(image).astype(np.uint16)
        return np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))


def _guesses(image: Any) -> Iterator[str]:
    """What a file says of itself that plays no part in how it is read."""
    if getattr(image, "n_frames", 1) > 1:
        yield f"holds {image.n_frames} pictures, the first is read"
    if image.mode == "CMYK":
        yield "holds inks (CMYK), converted without their profile; export it as sRGB"
    profile, gamma = image.info.get("icc_profile"), image.info.get("gamma", 1 / 2.2)
    if profile and b"sRGB" not in profile and b"s\0R\0G\0B" not in profile:
        yield "carries a colour profile that is not sRGB, its codes are taken as sRGB; export it as sRGB"
    elif not profile and "srgb" not in image.info and abs(gamma * 2.2 - 1) > 0.02:
        yield f"states a gamma of 1 / {1 / gamma:.3g}, its codes are taken as sRGB; export it as sRGB"
