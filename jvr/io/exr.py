"""OpenEXR images read: the channels of one of their layers, in the frame of their display window."""

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32

from jvr.io.image_sizes import check_exr
from jvr.io.volumes.errors import one_line
from jvr.pictures import ImageError, Pixels, Plane, quiet

# What programs call the channels of a layer.
ROLES = {"red": "R", "green": "G", "blue": "B", "alpha": "A"}
DEPTH = "Z"


class Layer(NamedTuple):
    """Colours, `(R, G, B)` or `(Y,)`, and `(A,)` or none, by the names of their channels in one of the parts of a file."""

    part: int
    colour: tuple[str, ...]
    alpha: tuple[str, ...]


def read_exr(path: Path, layer: str | None) -> tuple[Pixels, Plane | None]:
    """Colours and alpha of a layer. Without its name that is R, G and B (or Y) of the first part, or the only one that there is.

    **Raises** `ImageError` for a file that is damaged, deep or subsampled, and where it is not clear which layer is meant.
    """
    headers = _headers(path)
    part, colour, alpha = _chosen(path, headers, layer)
    wanted = (*colour, *alpha)
    low, high = _window(headers[part]["dataWindow"])
    planes = _planes(path, part, wanted, (high - low)[::-1])
    if any(not np.issubdtype(plane.dtype, np.floating) for plane in planes[len(colour) :]):
        wanted, planes = colour, planes[: len(colour)]
    pixels = np.stack([plane.astype(np.float32) for plane in planes], axis=-1)
    framed = _framed(pixels, low, *_window(headers[part]["displayWindow"]))
    picture = np.broadcast_to(framed[..., : len(colour)], (*framed.shape[:2], 3))
    return np.ascontiguousarray(picture), None if len(wanted) == len(colour) else framed[..., -1]


def read_depth(path: str | os.PathLike) -> Plane:
    """The channel Z of the first part that has one, 0 where there are no pixels. **Raises** as `read_exr`, and where there is none."""
    path = Path(path)
    headers = _headers(path)
    part = next((i for i, header in enumerate(headers) if any(c.name == DEPTH for c in header["channels"])), None)
    if part is None or _is_deep(headers[part]):
        raise ImageError(path, f"it has no channel {DEPTH} of distances: `jvr render` writes one into each .exr")
    low, high = _window(headers[part]["dataWindow"])
    (plane,) = _planes(path, part, (DEPTH,), (high - low)[::-1])
    return _framed(plane[..., None].astype(np.float32), low, *_window(headers[part]["displayWindow"]))[..., 0]


def _headers(path: Path) -> list[dict[str, Any]]:
    check_exr(path)
    with quiet():
        import OpenEXR

        try:
            file = OpenEXR.File(str(path), header_only=True)
            return [file.header(part) for part in range(len(file.parts))]
        except Exception as error:
            raise ImageError(path, f"the OpenEXR header is damaged or cut short ({one_line(error)}); export it again") from error


def _planes(path: Path, part: int, wanted: tuple[str, ...], shape: np.ndarray) -> list[np.ndarray]:
    """Channels of a part, each of the whole data window, so many rows and columns."""
    with quiet():
        import OpenEXR

        # OpenEXR says only on the terminal that pixels are missing, and then returns a file without parts.
        try:
            channels = OpenEXR.File(str(path), separate_channels=True).channels(part)
            planes = [channels[name].pixels for name in wanted]
        except Exception as error:
            raise ImageError(path, "the pixels are damaged or cut short; copy or export the file again") from error
    if any(plane.shape != tuple(shape) for plane in planes):
        raise ImageError(path, f"channels {', '.join(wanted)} do not have the full resolution; save them without subsampling")
    return planes


def _chosen(path: Path, headers: list[dict[str, Any]], name: str | None) -> Layer:
    layers = _layers(headers)
    if name is not None and name in layers:
        chosen = layers[name]
    elif name is not None:
        known = f"its layers are {', '.join(sorted(filter(None, layers)))}" if any(layers) else "it has no layers with a name"
        raise ImageError(path, f"there is no layer '{name}'; {known}")
    elif "" in layers or len(set(layers.values())) == 1:
        chosen = layers.get("", next(iter(layers.values())))
    elif layers:
        raise ImageError(path, f"its layers are {', '.join(sorted(layers))}: name one of them with layer=")
    else:
        names = [channel.name for header in headers for channel in header["channels"]]
        if any(map(_is_deep, headers)):
            raise ImageError(path, "this is a deep image, with many samples in a pixel; flatten it first")
        raise ImageError(path, f"its channels are {', '.join(names) or 'none'}; an image needs R, G and B, or Y alone")
    return chosen


def _is_deep(header: dict[str, Any]) -> bool:
    return "deep" in str(header.get("type"))


def _layers(headers: list[dict[str, Any]]) -> dict[str, Layer]:
    """What has colours, by its name: what stands before the last dot of its channels, or the name of its part, or both. What has neither
    in the first part is called ""."""
    found: dict[str, Layer] = {}
    for part, header in enumerate(headers):
        groups: dict[str, dict[str, str]] = {}
        for channel in [] if _is_deep(header) else header["channels"]:
            prefix, _, role = channel.name.rpartition(".")
            groups.setdefault(prefix, {})[ROLES.get(role.lower()) or role.upper()] = channel.name
        own = str(header.get("name") or "")
        for prefix, channels in groups.items():
            roles = _colours_among(set(channels))
            layer = Layer(part, tuple(channels[role] for role in roles), (channels["A"],) if "A" in channels else ())
            for name in {prefix, ".".join(filter(None, (own, prefix)))}:
                if roles and (name or part == 0):
                    found.setdefault(name, layer)
    return found


def _colours_among(roles: set[str]) -> tuple[str, ...]:
    if {"R", "G", "B"} <= roles:
        return "R", "G", "B"
    # Y is luminance, beside X a coordinate, and beside RY and BY a part of colours.
    return ("Y",) if "Y" in roles and not {"RY", "BY", "X"} & roles else ()


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
