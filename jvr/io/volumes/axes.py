"""Axes of an array by their names: which are space, which time or channel, and the volume that is chosen of them."""

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from jvr.io.volumes.errors import VolumeError
from jvr.io.volumes.given import Given

NAMES = {"x": "x", "width": "x", "column": "x", "columns": "x", "y": "y", "height": "y", "row": "y", "rows": "y"}
NAMES |= {"z": "z", "depth": "z", "slice": "z", "slices": "z", "plane": "z", "planes": "z"}
NAMES |= {"t": "t", "time": "t", "times": "t", "frame": "t", "frames": "t"}
NAMES |= {"c": "c", "channel": "c", "channels": "c", "band": "c", "component": "c", "components": "c"}
CHOICES = {"c": "channel", "t": "time"}


@dataclasses.dataclass(frozen=True)
class Chosen:
    """One volume of an array: `index` takes it (integers drop an axis), `kept` holds the positions of the axes x, y, z among the array's.

    An axis of space that the array lacks is `None` in `kept`: one voxel.
    """

    index: tuple[int | slice, ...]
    kept: tuple[int | None, int | None, int | None]

    def of(self, values: Any) -> np.ndarray:
        """The voxels `[x, y, z]` of the array; a chunked array is asked for what is chosen alone."""
        return self.arranged(np.asanyarray(values[self.index]))

    def arranged(self, taken: np.ndarray) -> np.ndarray:
        """`array[index]`, with its axes in the order x, y, z."""
        left = [k for k, one in enumerate(self.index) if isinstance(one, slice)]
        values = taken.transpose([left.index(k) for k in self.kept if k is not None])
        return values[tuple(np.newaxis if k is None else slice(None) for k in self.kept)]


def chosen(
    path: str | os.PathLike, shape: Sequence[int], names: Sequence[str] | str, given: Given, channels: Sequence[str] = ()
) -> Chosen:
    """The volume that `given.channel` and `given.time` choose of an array.

    **Arguments:** `shape` of the array and `names` of its axes in the same order, as in "tczyx" or ("time", "z", "y", "x"), upper
    or lower case; `channels`: names of its channels, where the file has some.

    Axes of length one drop, whatever their names. Longer ones that are neither space, channel nor time are refused, as are
    several channels or times of which none is chosen: neither is ever taken for depth.
    """
    letters = [NAMES.get(str(name).lower(), str(name)) for name in names]
    if len(letters) != len(shape):
        raise VolumeError(
            path, f"{len(letters)} axes are named ({', '.join(letters)}), the array of shape {tuple(shape)} has {len(shape)}"
        )
    doubled = [name for k, name in enumerate(letters) if name in letters[:k] and name in "xyzct"]
    if doubled:
        raise VolumeError(path, f"two axes are called {doubled[0]} in {', '.join(letters)}: each must have its own name")
    for letter, keyword in CHOICES.items():
        if letter not in letters and getattr(given, keyword) not in (None, 0, "0"):
            shown = f"axes {', '.join(letters)}, shape {tuple(shape)}"
            raise VolumeError(
                path, f"{keyword}={getattr(given, keyword)!r}: it has no axis of {keyword}s ({shown}); leave {keyword}= out"
            )
    index: list[int | slice] = []
    for letter, count in zip(letters, shape, strict=True):
        if letter in CHOICES:
            index.append(_one(path, CHOICES[letter], int(count), given, channels if letter == "c" else ()))
        elif letter in ("x", "y", "z"):
            index.append(slice(None))
        elif count == 1:
            index.append(0)
        else:
            problem = f"its axis '{letter}' of length {count} is neither x, y, z, channel nor time (shape {tuple(shape)})"
            raise VolumeError(path, f"{problem}; save one of its {count} as a volume")
    x, y, z = (letters.index(axis) if axis in letters else None for axis in "xyz")
    return Chosen(tuple(index), (x, y, z))


def named(path: str | os.PathLike, shape: Sequence[int], axes: str) -> list[str]:
    """Names of all axes of an array of `shape` from the caller's `axes`, such as "zyx" or "tczyx".

    Axes of length one beyond the letters, trailing ones first, are nameless ("-"). A 1-D or 2-D array may be called "xyz" in any
    order: letters beyond its axes count as absent.
    """
    letters = axes.lower()
    known = set(letters) <= set("xyzct") and len(set(letters)) == len(letters)
    if sorted(letters) == ["x", "y", "z"] and len(shape) < 3:
        letters = "".join(letter for letter in letters if letter in "xyz"[: len(shape)])
    absent: set[int] = set()
    for k in reversed(range(len(shape))):
        if len(shape) - len(absent) > len(letters) and shape[k] == 1:
            absent.add(k)
    if not known or len(letters) != len(shape) - len(absent):
        wanted = "'zyx'" if len(shape) <= 3 else "'czyx'" if len(shape) == 4 else "'tczyx'"
        problem = f"axes='{axes}' must be letters of x, y, z, c (channel) and t (time), one for each axis of the array"
        raise VolumeError(path, f"{problem} (shape {tuple(shape)}), such as {wanted}")
    rest = iter(letters)
    return ["-" if k in absent else next(rest) for k in range(len(shape))]


def _one(path: str | os.PathLike, keyword: str, count: int, given: Given, names: Sequence[str]) -> int:
    """Index of the channel or point in time that is asked for; the only one where there is one."""
    asked = getattr(given, keyword)
    shown = ", ".join(f"{k} '{name}'" for k, name in enumerate(names[:8])) if names else f"0 to {count - 1}"
    if asked is None and count == 1:
        return 0
    kind = "channels" if keyword == "channel" else "points in time"
    if asked is None:
        raise VolumeError(path, f"it holds {count} {kind}; choose one with {keyword}= (--{keyword}): {shown}")
    if isinstance(asked, str) and asked in names:
        if list(names).count(asked) > 1:
            raise VolumeError(path, f"several {kind} are called '{asked}'; give its index: {keyword}= {shown}")
        return list(names).index(asked)
    if isinstance(asked, str) and asked.isdecimal():
        asked = int(asked)
    if isinstance(asked, bool | str) or not isinstance(asked, int | np.integer) or not 0 <= asked < count:
        raise VolumeError(path, f"it has no {keyword} {asked!r}; {keyword}= may be {shown}")
    return int(asked)
