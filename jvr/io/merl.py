"""Files of measured reflectance in the MERL binary format."""

import os
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from jvr.io.volumes.errors import first_bytes

# theta_h, theta_d, phi_d; the last runs fastest, the colour slowest.
CELLS = (90, 90, 180)
# What a unit of the file is for red, green and blue, in 1 / solid angle.
SCALES = (1.0 / 1500.0, 1.15 / 1500.0, 1.66 / 1500.0)
_HEADER = 12


class MerlError(ValueError):
    """A file of reflectance that cannot be read: one line that names the file, what is wrong and what would be right."""

    def __init__(self, path: str | os.PathLike, problem: str):
        super().__init__(" ".join(f"{path}: {problem}".split()))


def read_merl(path: str | os.PathLike) -> Float32[np.ndarray, "90 90 180 3"]:
    """BRDF in 1 / solid angle by `theta_h` (cells even in its root), `theta_d`, `phi_d` and colour.

    The file: three little-endian int32, the numbers of cells, and as many float64 for red, for green, for blue. What is negative was
    not measured and becomes 0. **Raises** `FileNotFoundError`, or `MerlError` for a file that is cut short, of another kind or
    holds values that are not finite.
    """
    path = Path(path)
    if path.is_dir():
        raise MerlError(path, "this is a folder; name one file of it")
    if path.exists() and path.stat().st_size == 0:
        raise MerlError(path, "the file is empty (0 bytes); copy it again")
    start = first_bytes(path, _HEADER)
    cells = tuple(int(n) for n in np.frombuffer(start[: len(start) // 4 * 4], "<i4"))
    if cells != CELLS:
        found = " x ".join(str(n) for n in cells) or "nothing"
        raise MerlError(path, f"this is not a MERL BRDF: its header says {found} cells, the format has 90 x 90 x 180")
    wanted, size = _HEADER + 3 * 8 * int(np.prod(CELLS)), path.stat().st_size
    if size != wanted:
        raise MerlError(path, f"the file has {size:,} bytes, a MERL BRDF {wanted:,}; it is cut short or damaged: copy it again")
    values = np.fromfile(path, "<f8", offset=_HEADER).reshape(3, *CELLS)
    with np.errstate(over="ignore", invalid="ignore"):
        reflectance = (np.where(values < 0, 0, values) * np.reshape(SCALES, (3, 1, 1, 1))).astype(np.float32)
    bad = int(np.count_nonzero(~(np.isfinite(values) & np.isfinite(reflectance))))
    if bad:
        raise MerlError(path, f"{bad:,} of its values are not finite; the file is damaged: copy it again")
    return np.ascontiguousarray(np.moveaxis(reflectance, 0, -1))
