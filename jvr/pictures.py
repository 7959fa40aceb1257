"""Pictures written: OpenEXR as linear radiance, PNG through the sRGB curve.

Inside `jvr` an image is linear radiance, `(height, width, 3)`, row 0 at the top. With an alpha, colours are associated
(multiplied by it): they are the light over black. A PNG holds colours that are not, so they are divided when one is written
and multiplied when it is read.
"""

import contextlib
import io
import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8

from jvr.atomic import replacing
from jvr.types import ArrayLike

Pixels = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]


# Layers whose numbers are coordinates and no colours.
VECTORS = ("position", "normal")


class ImageError(ValueError):
    """An image that cannot be read or written: one line that names the file, what is wrong and what would be right."""

    def __init__(self, path: str | os.PathLike, problem: str):
        super().__init__(" ".join(f"{path}: {problem}".split()))


def as_radiance(image: Any, name: str) -> np.ndarray:
    """The image as an array of floating-point numbers.

    **Raises** `ValueError` for integers: they are codes of a file or a screen, of which white is 255 and the middle not half of
    the light; and for what is no array of real numbers.
    """
    array = np.asarray(image)
    if array.dtype.kind in "cOSUMm":
        found = array.dtype if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(f"{name} must be an array of radiance (height, width, 3), such as the rgb of a rendering, not {found}")
    if array.dtype.kind in "biu":
        white = 65535 if array.dtype.itemsize == 2 else 255
        raise ValueError(
            f"{name} holds whole numbers ({array.dtype}), radiance is linear with white at 1: convert codes by "
            f"jvr.linear_from_srgb(codes / {white}), or numbers that are radiance by numpy.float32(image)"
        )
    return array


def srgb_from_linear(linear: ArrayLike) -> Float[np.ndarray, "..."]:
    """The sRGB code (0 ... 1) of linear light (IEC 61966-2-1), which is clipped to 0 ... 1 first."""
    linear = np.clip(np.asarray(linear, np.float64), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def linear_from_srgb(code: ArrayLike) -> Float[np.ndarray, "..."]:
    """Linear light of an sRGB code between 0 and 1 (IEC 61966-2-1).

    **Raises** `ValueError` for integers above 1: the codes of a file are divided by the largest first, 255 or 65535.
    """
    given = np.asarray(code)
    if given.dtype.kind in "iu" and given.size and given.max() > 1:
        white = 65535 if given.max() > 255 else 255
        raise ValueError(f"codes are whole numbers up to {given.max()}, where 1 is white: give linear_from_srgb(codes / {white})")
    code = given.astype(np.float64)
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def write_image(
    path: str | bytes | os.PathLike,
    image: ArrayLike,
    alpha: ArrayLike | None = None,
    *,
    depth: ArrayLike | None = None,
    layers: Mapping[str, ArrayLike] = MappingProxyType({}),
) -> None:
    """Writes linear radiance to `.exr` (float32, unchanged; channels A and Z for `alpha` and `depth`) or `.png` (8-bit sRGB).

    **Arguments:** `image`: `(height, width, 3)`; `alpha`, `depth`: `(height, width)`; `layers`: `(height, width, 1 or 3)` by name, whose
    channels in the file are called `NAME.Y`, or `NAME.R`, `NAME.G` and `NAME.B`, of `position` and `normal` `NAME.X`, `NAME.Y` and
    `NAME.Z`. With an `alpha`, `image` is the medium's light over black. A PNG then holds it divided by alpha: light beyond alpha (emission
    without extinction) does not fit and is clipped.

    The file appears under its name once it is whole; where writing fails, a file that was there before stays.
    **Raises** `ValueError` for shapes that do not fit, integers in place of radiance, another extension, and, in a PNG, a depth, layers or
    pixels that are not finite;
    `OSError` where the file cannot be written.
    """
    path = Path(os.fsdecode(path))
    if path.suffix.lower() not in (".exr", ".png"):
        raise ImageError(path, f"cannot write {path.suffix or 'a name without an extension'}; use .exr (linear) or .png (sRGB)")
    pixels = np.asarray(as_radiance(image, f"{path}: the image"), np.float32)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or 0 in pixels.shape:
        raise ImageError(path, f"an image is (height, width, 3), this one {pixels.shape}")
    planes = {"alpha": alpha, "depth": depth}
    planes = {name: np.asarray(plane) for name, plane in planes.items() if plane is not None}
    if alpha is not None and (planes["alpha"].dtype.kind in "iu" or np.max(planes["alpha"], initial=0) > 1.001):
        largest = planes["alpha"].max()
        raise ImageError(path, f"alpha goes up to {largest}, but 1 is opaque: give floating-point numbers from 0 to 1")
    planes = {name: plane.astype(np.float32) for name, plane in planes.items()}
    for name, plane in planes.items():
        if plane.shape != pixels.shape[:2]:
            raise ImageError(
                path, f"{name} has shape {plane.shape}, the image {pixels.shape[:2]}: give one {name} for each pixel"
            )
    named = {name: plane for layer, values in layers.items() for name, plane in _channels(path, layer, values, pixels)}
    if path.suffix.lower() == ".exr":
        _write_exr(path, pixels, planes.get("alpha"), planes.get("depth"), named)
    elif named:
        raise ImageError(path, "a PNG has no room for layers; write .exr, or leave layers out")
    elif "depth" in planes:
        raise ImageError(path, "a PNG has no room for depth; write .exr, or leave depth out")
    else:
        content = _png(path, pixels, planes.get("alpha"))
        with replacing(path) as temporary:
            temporary.write_bytes(content)


def _channels(path: Path, layer: str, values: ArrayLike, pixels: Pixels) -> Iterator[tuple[str, Plane]]:
    """The channels of a layer, by their names in a file."""
    array = np.asarray(values, np.float32)
    names = {1: "Y", 3: "XYZ" if layer in VECTORS else "RGB"}
    if array.ndim != 3 or array.shape[:2] != pixels.shape[:2] or array.shape[2] not in names:
        wanted = f"({pixels.shape[0]}, {pixels.shape[1]}, 1 or 3)"
        raise ImageError(path, f"the layer {layer} has shape {array.shape}: give numbers of each pixel, {wanted}")
    yield from ((f"{layer}.{name}", array[..., c]) for c, name in enumerate(names[array.shape[2]]))


def shown(image: ArrayLike) -> bytes:
    """A PNG file of linear radiance `(height, width, 3)`, for the eye: pixels that are not finite are magenta."""
    pixels = np.asarray(image, np.float64)
    return png_bytes(_codes(srgb_from_linear(np.where(np.isfinite(pixels).all(axis=-1, keepdims=True), pixels, [1, 0, 1]))))


def _png(path: Path, pixels: Pixels, alpha: Plane | None) -> bytes:
    bad = ~np.isfinite(pixels).all(axis=-1) | (False if alpha is None else ~np.isfinite(alpha))
    if bad.any():
        raise ImageError(path, f"{int(bad.sum()):,} pixels are not finite, which a PNG cannot hold; write .exr, or repair them")
    # A photograph that was only converted to floating point would be white.
    if pixels.max() >= 16 and np.array_equal(pixels, np.rint(pixels)):
        problem = f"its pixels are whole numbers up to {pixels.max():g}, where 1 is white"
        raise ImageError(path, f"{problem}: convert codes by jvr.linear_from_srgb(codes / 255)")
    if alpha is None:
        return png_bytes(_codes(srgb_from_linear(pixels)))
    divisor = np.where(alpha > 0, alpha, 1)[..., None].astype(np.float64)
    colour = np.where(alpha[..., None] > 0, pixels / divisor, 0)
    return png_bytes(np.concatenate([_codes(srgb_from_linear(colour)), _codes(np.clip(alpha, 0, 1))[..., None]], axis=-1))


def _codes(values: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    return np.rint(255 * values).astype(np.uint8)


def png_bytes(codes: UInt8[np.ndarray, "height width channels"]) -> bytes:
    """A PNG file of 8-bit sRGB codes, RGB or RGBA, which says that they are."""
    from PIL import Image, PngImagePlugin

    buffer, chunks = io.BytesIO(), PngImagePlugin.PngInfo()
    # 0: for the eye, "perceptual".
    chunks.add(b"sRGB", b"\0")
    Image.fromarray(codes).save(buffer, format="PNG", pnginfo=chunks)
    return buffer.getvalue()


def _write_exr(path: Path, pixels: Pixels, alpha: Plane | None, depth: Plane | None, named: Mapping[str, Plane]) -> None:
    planes = {name: np.ascontiguousarray(pixels[..., c]) for c, name in enumerate("RGB")}
    planes |= {name: np.ascontiguousarray(plane) for name, plane in (("A", alpha), ("Z", depth)) if plane is not None}
    planes |= {name: np.ascontiguousarray(plane) for name, plane in named.items()}
    with replacing(path) as temporary, quiet():
        import OpenEXR

        try:
            OpenEXR.File({"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}, planes).write(str(temporary))
        except Exception as error:
            # The library names the temporary file; what counts comes after it.
            raise OSError(" ".join(str(error).rsplit('".', 1)[-1].rstrip(".").split())) from error


@contextlib.contextmanager
def quiet() -> Iterator[None]:
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
