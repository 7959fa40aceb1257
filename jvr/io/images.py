"""Images read and written: OpenEXR and Radiance as linear radiance, PNG and JPEG through the sRGB curve.

Inside `jvr` an image is linear radiance, `(height, width, 3)`, row 0 at the top. With an alpha, colours are associated
(multiplied by it): they are the light over black. A PNG holds colours that are not, so they are divided when one is written
and multiplied when it is read.
"""

import contextlib
import io
import os
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8

from jvr.io.volumes.errors import SIGNATURES, available_memory, first_bytes, one_line
from jvr.types import ArrayLike

Pixels = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

EXR, HDR, PNG, JPEG = b"\x76\x2f\x31\x01", b"#?", b"\x89PNG", b"\xff\xd8\xff"
KINDS = {
    ".exr": (EXR, "an OpenEXR image"),
    ".hdr": (HDR, "a Radiance .hdr image"),
    ".png": (PNG, "a PNG image"),
    ".jpg": (JPEG, "a JPEG image"),
}
KINDS[".jpeg"] = KINDS[".jpg"]


class ImageError(ValueError):
    """An image that cannot be read or written: one line that names the file, what is wrong and what would be right."""

    def __init__(self, path: str | os.PathLike, problem: str):
        super().__init__(" ".join(f"{path}: {problem}".split()))


def srgb_from_linear(linear: ArrayLike) -> Float[np.ndarray, "..."]:
    """The sRGB code (0 ... 1) of linear light (IEC 61966-2-1), which is clipped to 0 ... 1 first."""
    linear = np.clip(np.asarray(linear, np.float64), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def linear_from_srgb(code: ArrayLike) -> Float[np.ndarray, "..."]:
    """Linear light of an sRGB code between 0 and 1 (IEC 61966-2-1)."""
    code = np.asarray(code, np.float64)
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def read_image(path: str | os.PathLike) -> Pixels:
    """Linear radiance of an image file, row 0 at the top.

    - `.exr`: channels R, G, B, or Y alone (grey); half, float or integer; of a tiled file with several resolutions the finest.
      An alpha plays no part: EXR's colours are light over black already. A cropped file is placed on black where its display
      window says.
    - `.hdr`: Radiance, 8 bits per channel and a common exponent; divided by the exposure that its header states.
    - `.png`, `.jpg`: 8 or 16 bits, taken as sRGB whatever profile the file carries; with an alpha the colours are multiplied by
      it, so that the result is light over black too.

    **Raises** `FileNotFoundError`, or `ImageError` (a `ValueError`) for a file that is empty, damaged, cut short, of another kind
    than its name says, or without colour channels.
    """
    path = Path(path)
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
    reader = {EXR: _read_exr, HDR: _read_radiance}.get(magic)
    return _read_srgb(path, start) if reader is None else reader(path)


def write_image(
    path: str | os.PathLike, image: ArrayLike, alpha: ArrayLike | None = None, *, depth: ArrayLike | None = None
) -> None:
    """Writes linear radiance to `.exr` (float32, unchanged; channels A and Z for `alpha` and `depth`) or `.png` (8-bit sRGB).

    **Arguments:** `image`: `(height, width, 3)`; `alpha`, `depth`: `(height, width)`. With an `alpha`, `image` is the medium's
    light over black. A PNG then holds it divided by alpha: light beyond alpha (emission without extinction) does not fit and is
    clipped.

    The file appears under its name once it is whole; where writing fails, a file that was there before stays.
    **Raises** `ValueError` for shapes that do not fit, another extension, and, in a PNG, a depth or pixels that are not finite;
    `OSError` where the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in (".exr", ".png"):
        raise ImageError(path, f"cannot write {path.suffix or 'a name without an extension'}; use .exr (linear) or .png (sRGB)")
    pixels = np.asarray(image, np.float32)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or 0 in pixels.shape:
        raise ImageError(path, f"an image is (height, width, 3), this one {pixels.shape}")
    planes = {"alpha": alpha, "depth": depth}
    planes = {name: np.asarray(plane, np.float32) for name, plane in planes.items() if plane is not None}
    for name, plane in planes.items():
        if plane.shape != pixels.shape[:2]:
            raise ImageError(
                path, f"{name} has shape {plane.shape}, the image {pixels.shape[:2]}: give one {name} for each pixel"
            )
    if path.suffix.lower() == ".exr":
        _write_exr(path, pixels, planes.get("alpha"), planes.get("depth"))
    elif "depth" in planes:
        raise ImageError(path, "a PNG has no room for depth; write .exr, or leave depth out")
    else:
        content = _png(path, pixels, planes.get("alpha"))
        with replacing(path) as temporary:
            temporary.write_bytes(content)


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """A new, empty file beside `path`: it takes that name when the block ends well and vanishes when it does not."""
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: the folder {path.parent} does not exist; create it first")
    # Not tempfile: its files are for their owner's eyes only, and the name would keep that.
    temporary = path.with_name(f".{path.name[:80]}.{uuid.uuid4().hex[:8]}.part")
    try:
        temporary.touch(exist_ok=False)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        reason = error.strerror or one_line(error)
        raise type(error)(f"{path}: cannot be written: {reason}; choose another name or folder, or make room") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _fits_in_memory(path: Path, announced: int) -> None:
    available = available_memory()
    if available is not None and announced > available:
        raise ImageError(
            path, f"its {announced:,} bytes of pixels exceed the {available:,} bytes of free memory; crop or shrink it"
        )


def _kind(start: bytes) -> str:
    known = ((EXR, "an OpenEXR image"), (HDR, "a Radiance .hdr image"), (b"<!DOCTYPE", "a web page"), *SIGNATURES)
    printable = all(byte in b"\t\n\r" or byte >= 32 for byte in start)
    return next((name for magic, name in known if start.startswith(magic)), "text" if printable else "something else")


# --- OpenEXR ---------------------------------------------------------------------------------------------------------


def _read_exr(path: Path) -> Pixels:
    with _quiet():
        import OpenEXR

        try:
            header = OpenEXR.File(str(path), header_only=True).header()
        except Exception as error:
            raise ImageError(path, f"the OpenEXR header is damaged or cut short ({one_line(error)}); export it again") from error
    wanted = _colour_channels(path, header)
    low, high = _window(header["dataWindow"])
    _fits_in_memory(path, int(np.prod(high - low)) * 4 * len(header["channels"]))
    with _quiet():
        # OpenEXR says only on the terminal that pixels are missing, and then returns a file without parts.
        try:
            channels = OpenEXR.File(str(path), separate_channels=True).channels()
            planes = [channels[name].pixels for name in wanted]
        except Exception as error:
            raise ImageError(path, "the pixels are damaged or cut short; copy or export the file again") from error
    if any(plane.shape != tuple((high - low)[::-1]) for plane in planes):
        raise ImageError(path, f"channels {', '.join(wanted)} do not have the full resolution; save them without subsampling")
    pixels = np.stack([plane.astype(np.float32) for plane in planes] * (3 // len(planes)), axis=-1)
    return _framed(pixels, low, *_window(header["displayWindow"]))


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


def _framed(pixels: Pixels, corner: np.ndarray, low: np.ndarray, high: np.ndarray) -> Float32[np.ndarray, "rows columns 3"]:
    """Pixels whose first is at `corner` = (column, row), seen in the window from `low` to `high`; black where there are none."""
    end = corner + pixels.shape[1::-1]
    if np.array_equal(corner, low) and np.array_equal(end, high):
        return pixels
    framed = np.zeros((*(high - low)[::-1], 3), np.float32)
    first, last = np.maximum(corner, low), np.minimum(end, high)
    if np.all(first < last):
        part = lambda origin: tuple(slice(a, b) for a, b in zip((first - origin)[::-1], (last - origin)[::-1], strict=True))
        framed[part(low)] = pixels[part(corner)]
    return framed


def _write_exr(path: Path, pixels: Pixels, alpha: Plane | None, depth: Plane | None) -> None:
    planes = {name: np.ascontiguousarray(pixels[..., c]) for c, name in enumerate("RGB")}
    planes |= {name: np.ascontiguousarray(plane) for name, plane in (("A", alpha), ("Z", depth)) if plane is not None}
    with replacing(path) as temporary, _quiet():
        import OpenEXR

        try:
            OpenEXR.File({"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}, planes).write(str(temporary))
        except Exception as error:
            raise OSError(one_line(error)) from error


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Nothing on the terminal: OpenEXR prints from C++ what it also raises, or nothing that a caller could catch."""
    sys.stdout.flush()
    sys.stderr.flush()
    with contextlib.ExitStack() as stack:
        sink = stack.enter_context(open(os.devnull, "w"))
        stack.enter_context(contextlib.redirect_stdout(sink))
        for stream in (1, 2):
            try:
                kept = os.dup(stream)
            except OSError:
                continue  # closed by the caller: nothing to silence
            stack.callback(os.close, kept)
            stack.callback(os.dup2, kept, stream)
            os.dup2(sink.fileno(), stream)
        yield


# --- Radiance --------------------------------------------------------------------------------------------------------


def _read_radiance(path: Path) -> Pixels:
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
    _fits_in_memory(path, header.width * header.height * 3 * 4)
    pixels = file.read_image(OpenImageIO.FLOAT)
    if pixels is None:
        raise ImageError(path, f"the pixels are damaged or cut short ({one_line(file.geterror())}); copy or export it again")
    # Which corner comes first, numbered as in TIFF: 1 top left, 2 top right, 3 bottom right, 4 bottom left.
    corner = header.get_int_attribute("Orientation", 1)
    upright = pixels[:: -1 if corner in (3, 4) else 1, :: -1 if corner in (2, 3) else 1]
    return np.ascontiguousarray(upright, np.float32) / np.float32(exposure)


# --- PNG, JPEG -------------------------------------------------------------------------------------------------------


def _read_srgb(path: Path, start: bytes) -> Pixels:
    try:
        # Pillow would silently drop the lower 8 of 16 bits of a colour PNG (depth and colour type are bytes 24 and 25).
        code = _sixteen_bits(path) if start.startswith(PNG) and start[24] == 16 and start[25] != 0 else _eight_bits(path)
    except Exception as error:
        raise ImageError(path, f"the image is damaged or cut short ({one_line(error)}); copy or export it again") from error
    if code.ndim == 2:
        code = code[..., None]
    has_alpha = code.shape[2] in (2, 4)
    colour = linear_from_srgb(code[..., :-1] if has_alpha else code)
    pixels = colour * code[..., -1:] if has_alpha else colour
    return np.broadcast_to(pixels, (*pixels.shape[:2], 3)).astype(np.float32)


def _eight_bits(path: Path) -> Float[np.ndarray, "..."]:
    """Codes 0 ... 1 of everything but colour with 16 bits."""
    from PIL import Image

    with Image.open(path) as image:
        if image.mode.startswith("I"):
            return np.asarray(image).astype(np.float64) / 65535
        return np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB")) / 255.0


def _sixteen_bits(path: Path) -> Float[np.ndarray, "..."]:
    import SimpleITK as sitk

    with _quiet():
        return sitk.GetArrayFromImage(sitk.ReadImage(str(path))) / 65535.0


def _png(path: Path, pixels: Pixels, alpha: Plane | None) -> bytes:
    bad = ~np.isfinite(pixels).all(axis=-1) | (False if alpha is None else ~np.isfinite(alpha))
    if bad.any():
        raise ImageError(path, f"{int(bad.sum()):,} pixels are not finite, which a PNG cannot hold; write .exr, or repair them")
    if alpha is None:
        return png_bytes(_codes(srgb_from_linear(pixels)))
    divisor = np.where(alpha > 0, alpha, 1)[..., None].astype(np.float64)
    colour = np.where(alpha[..., None] > 0, pixels / divisor, 0)
    return png_bytes(np.concatenate([_codes(srgb_from_linear(colour)), _codes(np.clip(alpha, 0, 1))[..., None]], axis=-1))


def _codes(values: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    return np.rint(255 * values).astype(np.uint8)


def png_bytes(codes: UInt8[np.ndarray, "height width channels"]) -> bytes:
    """A PNG file of 8-bit codes, RGB or RGBA."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(codes).save(buffer, format="PNG")
    return buffer.getvalue()
