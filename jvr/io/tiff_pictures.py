"""TIFF images of one page: grey, palettes and colours, of 8 or 16 bits or floating-point numbers."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jvr.io.image_sizes import check_pixels
from jvr.io.volumes.errors import VolumeError
from jvr.io.volumes.ome_xml import ome_images
from jvr.io.volumes.tiff import check_pages, numbers_of, opened
from jvr.pictures import ImageError

WHITE_IS_ZERO, BLACK_IS_ZERO, RGB, PALETTE, YCBCR = 0, 1, 2, 3, 6
# Of the tag ExtraSamples: what an additional channel is.
ALPHAS = {1: "associated", 2: "straight"}
PROFILE, ORIENTATION = 34675, 274


class TiffPicture(NamedTuple):
    """`numbers`: `(height, width, channels)`, codes of 8 or 16 bits or floating-point numbers, row 0 at the top; the last channel of two or
    four is the alpha, `"straight"` or `"associated"`. `profile`: of its colours, as the file has it."""

    numbers: np.ndarray
    alpha: str | None
    profile: bytes | None


def read_tiff_picture(path: Path) -> TiffPicture:
    """**Raises** `ImageError` for a file that is damaged, has several pages, or is of another kind."""
    try:
        return opened(path, lambda file, messages: _picture(path, file))
    except VolumeError as error:
        raise ImageError(path, str(error).removeprefix(f"{path}: ").replace("voxels", "pixels")) from error


def _picture(path: Path, file: Any) -> TiffPicture:
    # Whoever asks for its series has OME-XML parsed, which is checked first.
    if file.is_ome:
        ome_images(path, file.ome_metadata or "")
    if len(file.pages) != 1 or len(file.series) != 1:
        raise VolumeError(path, f"it has {len(file.pages)} pages, an image has one: export that alone")
    series = file.series[0]
    page, kind = series.keyframe, int(series.keyframe.photometric)
    if kind not in (WHITE_IS_ZERO, BLACK_IS_ZERO, RGB, PALETTE, YCBCR):
        raise VolumeError(path, "its colours are neither grey, a palette nor red, green and blue: export it as RGB")
    if series.dtype.str[1:] not in ("u1", "u2", "f2", "f4", "f8") or (kind != PALETTE and page.bitspersample % 8):
        bits = f"numbers of {page.bitspersample} bits ({series.dtype})"
        raise VolumeError(path, f"it has {bits}: export it with 8 or 16 bits, or as floating-point numbers")
    check_pages(path, series)
    check_pixels(path, "frame", page.imagewidth, page.imagelength, 12)
    numbers = _by_row(path, series.axes.upper(), numbers_of(path, 0, series))
    if kind == PALETTE:
        # Some writers scale 8 bits by 256, others by 257.
        numbers = (np.moveaxis(np.asarray(page.colormap), 0, -1) >> 8).astype(np.uint8)[numbers[..., 0]]
    elif kind == WHITE_IS_ZERO:
        numbers[..., 0] = (np.iinfo(numbers.dtype).max if numbers.dtype.kind == "u" else 1) - numbers[..., 0]
    colours = 1 if kind in (WHITE_IS_ZERO, BLACK_IS_ZERO) else 3
    if numbers.shape[2] < colours:
        raise VolumeError(
            path, f"it has {numbers.shape[2]} channels, and says that they are red, green and blue: export it again"
        )
    alpha = ALPHAS.get(int(page.extrasamples[0])) if numbers.shape[2] > colours and page.extrasamples else None
    upright = _upright(numbers[..., : colours + (alpha is not None)], int(page.tags.valueof(ORIENTATION, 1) or 1))
    return TiffPicture(upright, alpha, page.tags.valueof(PROFILE))


def _by_row(path: Path, axes: str, numbers: np.ndarray) -> np.ndarray:
    """Rows, columns and channels in this order."""
    if axes not in ("YX", "YXS", "SYX"):
        raise VolumeError(path, f"its axes are {axes}, an image has rows and columns: export one page")
    return numbers[..., None] if axes == "YX" else np.moveaxis(numbers, axes.index("S"), -1)


def _upright(numbers: np.ndarray, orientation: int) -> np.ndarray:
    """With row 0 at the top and column 0 at the left: the tag numbers where the first row and the first column are."""
    if orientation > 4:
        numbers = np.swapaxes(numbers, 0, 1)
    down, across = orientation in (3, 4, 7, 8), orientation in (2, 3, 6, 7)
    return numbers[:: -1 if down else 1, :: -1 if across else 1]
