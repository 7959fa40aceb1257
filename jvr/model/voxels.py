"""Voxels as a volume keeps them in memory: their type, those that are missing, and the range of the others."""

import os
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Num, Shaped, UInt8

from jvr.model.checks import known

# Bits of `gaps`: the voxel itself is missing; so is a corner of the cell that begins at it.
VOXEL, CELL = 1, 2
# Larger numbers are no measurement: files mark missing data with them.
HUGE = 1e30
# How far beside data a missing voxel can be part of a gradient.
STENCIL = 2
# Voxels that are filled at a time.
SLAB = 1 << 18
# Voxels that are so few and lie so far out that they are no part of the range of values.
FEW, FAR = 1e-6, 1.0
SUBSET = 1 << 20


def in_memory(values: Any) -> Shaped[Array, "..."]:
    """An array that JAX holds, of what NumPy holds: whatever its byte order, truth values as 0 and 1, integers of 64 bits as narrow as they
    fit, floats of 64 bits as JAX's own (with a warning where that takes what sets them apart).

    **Raises** `TypeError` for what is no real number, or has names for its axes, `ValueError` for integers that fit no type and for floats
    that become infinite.
    """
    if isinstance(values, Array):
        return values.astype(jnp.uint8) if values.dtype == bool else values
    values = _array(values)
    if values.dtype.kind == "b":
        return jnp.asarray(values.astype(np.uint8))
    if values.dtype.kind == "f" and values.dtype.itemsize >= 8:
        with np.errstate(over="ignore"):
            narrow = values.astype(jax.dtypes.canonicalize_dtype(np.float64))
        _check_narrowed(values, narrow)
        return jnp.asarray(narrow)
    return jnp.asarray(values.astype(integer_type(values), copy=False))


def _array(values: Any) -> np.ndarray:
    """An array of numbers as NumPy holds it."""
    if isinstance(values, str | bytes | os.PathLike):
        raise TypeError(f"voxels must be an array, not the name {str(values)!r}: jvr.read_volume reads files")
    if hasattr(values, "dims") and hasattr(values, "coords"):
        shown = ", ".join(str(name) for name in values.dims)
        raise TypeError(
            f"voxels are a {type(values).__name__} with axes {shown}: give .transpose('x', 'y', 'z').values, "
            "and world_from_grid= for its coordinates"
        )
    is_array = any(hasattr(values, name) for name in ("__array__", "__array_interface__", "__dlpack__"))
    if not is_array and not isinstance(values, Sequence | int | float):
        raise TypeError(f"voxels must be an array of real numbers, not {type(values).__name__}")
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise TypeError(f"voxels must be an array of real numbers with axes x, y, z: {error}") from None
    # The small types of machine learning, such as bfloat16, are no kind of NumPy's own.
    if array.dtype.kind not in "biuf" and not jnp.issubdtype(array.dtype, jnp.floating):
        found = array.dtype if isinstance(values, np.ndarray) else type(values).__name__
        raise TypeError(f"voxels must be real or integer numbers, not {found}; give an array of them")
    return array


def as_missing(number: Any) -> float | int | None:
    """The number that means "no data" as Python's own; NaN needs none.

    **Raises** `TypeError` for what is no number.
    """
    if number is None:
        return None
    if isinstance(number, bool | str) or np.ndim(number) != 0 or np.asarray(number).dtype.kind not in "iuf":
        raise TypeError(f"missing must be the stored number that means no data, or None, not {number!r}")
    plain = np.asarray(number).item()
    return None if np.isnan(plain) else plain


def masked_voxels(values: Any) -> np.ndarray | None:
    """Where a masked array of NumPy is masked, or `None` where it is not, or no such array."""
    mask = np.ma.getmaskarray(values) if isinstance(values, np.ma.MaskedArray) else None
    return mask if mask is not None and mask.any() else None


def _check_narrowed(wide: np.ndarray, narrow: np.ndarray) -> None:
    """Raises where numbers became infinite, and warns where a large offset (1e9 + something small) takes what sets them apart."""
    lost = int(np.count_nonzero(np.isinf(narrow) & ~np.isinf(wide)))
    if lost:
        raise ValueError(f"{lost:,} voxels exceed the range of float32 (3.4e38): rescale them or enable x64 in JAX")
    finite = wide[np.isfinite(wide)]
    if narrow.dtype == wide.dtype or finite.size == 0:
        return
    low, high = float(finite.min()), float(finite.max())
    finest = float(np.finfo(narrow.dtype).eps) * max(abs(low), abs(high))
    if finest > 1e-3 * (high - low) > 0 and not np.array_equal(wide, narrow, equal_nan=True):
        message = f"float32 resolves only {finest:.2g} in voxels from {low:.9g} to {high:.9g}"
        warnings.warn(f"{message}: subtract the offset or enable x64 in JAX", stacklevel=4)


def integer_type(values: np.ndarray) -> np.dtype:
    """The narrowest type that integers of more than 16 bits fit in; others stay as they are. **Raises** `ValueError` where none does."""
    if values.dtype.kind == "f" or values.dtype.itemsize <= 2 or values.size == 0:
        return values.dtype.newbyteorder("=")
    low, high = int(values.min()), int(values.max())
    wide = jax.dtypes.canonicalize_dtype(np.int64) == np.int64
    types = [np.uint8, np.int8, np.int16, np.uint16, np.int32, np.uint32, *([np.int64, np.uint64] if wide else [])]
    for dtype in types:
        if np.iinfo(dtype).min <= low and high <= np.iinfo(dtype).max:
            return np.dtype(dtype)
    raise ValueError(f"integers from {low} to {high} do not fit 32 bits: rescale them or enable x64 in JAX")


def without_gaps(
    values: Num[Array, "x y z"], missing: float | int | None, masked: np.ndarray | None = None, gaps: Any = None
) -> tuple[Num[Array, "x y z"], UInt8[Array, "x y z"] | None]:
    """Voxels of which those that are missing, because they equal `missing`, are NaN, lie beyond 1e30, are `masked` or so in the `gaps` of
    another volume, are filled in, and where those are (gaps): `None` where there are none.

    Near data the mean of what lies around is filled in, so that a gradient sees no step, elsewhere the smallest voxel: the range of values
    stays that of the data. Traced voxels that are NaN stay, since their number would have to be known. **Raises** `ValueError` where every
    voxel is missing.
    """
    if gaps is not None and np.shape(gaps) != values.shape:
        raise ValueError(f"gaps have shape {np.shape(gaps)}, the voxels {values.shape}: give one for each voxel")
    voxels = known(values)
    is_float = jnp.issubdtype(values.dtype, jnp.floating)
    if voxels is None or isinstance(gaps, Tracer):
        return values, None if gaps is None else jnp.asarray(gaps)
    if missing is None and masked is None and gaps is None and not is_float:
        return values, None
    absent = np.isnan(voxels) if is_float else np.zeros(voxels.shape, bool)
    if masked is not None:
        absent |= masked
    if gaps is not None:
        absent |= np.asarray(gaps) & VOXEL != 0
    reaches = is_float and float(jnp.finfo(values.dtype).max) > HUGE
    if reaches and (count := np.count_nonzero(huge := (np.abs(voxels) >= HUGE) & np.isfinite(voxels) & ~absent)):
        if missing is None or abs(missing) < HUGE:
            warnings.warn(f"{count:,} voxels lie beyond 1e30: they count as missing data and stay empty", stacklevel=4)
        absent |= huge
    if missing is not None:
        # Compared as the voxels are stored: a number that their type rounds means the same voxels.
        absent |= voxels == (np.asarray(missing).astype(voxels.dtype) if is_float else missing)
    if not absent.any():
        return values, None
    if absent.all():
        raise ValueError("every voxel is missing: there are no data")
    return _filled(voxels, absent), _gaps(jnp.asarray(absent))


def _filled(values: Num[np.ndarray, "x y z"], absent: Bool[np.ndarray, "x y z"]) -> Num[Array, "x y z"]:
    """By slabs, each with the planes around it that its voxels are filled from: while it is filled a voxel takes forty bytes."""
    lowest = float(np.min(values, where=~absent, initial=np.inf if values.dtype.kind == "f" else np.iinfo(values.dtype).max))
    planes = max(SLAB // (values.shape[1] * values.shape[2]), 1)
    # All slabs have one size, so that they share a program.
    filled, size = np.empty(values.shape, values.dtype), min(planes + 2 * STENCIL, len(values))
    for start in range(0, len(values), planes):
        first = min(max(start - STENCIL, 0), len(values) - size)
        slab = _slab(jnp.asarray(values[first : first + size]), jnp.asarray(absent[first : first + size]), lowest)
        filled[start : start + planes] = slab[start - first : start - first + planes]
    return jnp.asarray(filled)


@jax.jit
def _slab(values: Num[Array, "x y z"], absent: Bool[Array, "x y z"], lowest: float | Float[Array, ""]) -> Num[Array, "x y z"]:
    kind = jnp.result_type(float)
    left, numbers = absent, jnp.where(absent, 0, values).astype(kind)
    for _ in range(STENCIL):
        count, total = _around((~left).astype(kind)), _around(jnp.where(left, 0.0, numbers))
        numbers, left = jnp.where(left & (count > 0), total / jnp.maximum(count, 1), numbers), left & (count == 0)
    numbers = jnp.where(left, jnp.where(jnp.isfinite(lowest), lowest, 0.0), numbers)
    if jnp.issubdtype(values.dtype, jnp.integer):
        numbers = jnp.round(numbers)
    return jnp.where(absent, numbers.astype(values.dtype), values)


@jax.jit
def _gaps(absent: Bool[Array, "x y z"]) -> UInt8[Array, "x y z"]:
    corner = absent
    for axis, n in enumerate(absent.shape):
        last = jax.lax.slice_in_dim(corner, n - 1, n, axis=axis)
        corner |= jnp.concatenate([jax.lax.slice_in_dim(corner, 1, n, axis=axis), last], axis=axis)
    return absent.astype(jnp.uint8) * VOXEL + corner.astype(jnp.uint8) * CELL


def _around(x: Num[Array, "x y z"]) -> Num[Array, "x y z"]:
    """Sums of the 27 voxels around each, those beyond the border zero."""
    for axis, n in enumerate(x.shape):
        padding = [(0, 0)] * 3
        padding[axis] = (1, 1)
        wide = jnp.pad(x, padding)
        before, here, after = (jax.lax.slice_in_dim(wide, k, k + n, axis=axis) for k in range(3))
        x = before + here + after
    return x


def typical_range(flat: np.ndarray, *, few: float = FEW, least: int = 1) -> tuple[float, float]:
    """Smallest and largest of some numbers, but for a few that lie far out: no more than a fraction `few` of them, or `least`, more than
    the range of all others but a few thousandths beyond it. One hot voxel does not decide what a range is cut into."""
    flat = flat.reshape(-1)
    low, high = float(flat.min()), float(flat.max())
    subset = flat[:: max(flat.size // SUBSET, 1)].astype(np.float64)
    inner_low, inner_high = np.quantile(subset, [0.001, 0.999])
    spread = float(inner_high - inner_low)
    count = max(least, int(few * flat.size))
    if spread > 0 and high > inner_high + FAR * spread:
        beyond = flat > inner_high + FAR * spread
        high = float(flat[~beyond].max()) if np.count_nonzero(beyond) <= count else high
    if spread > 0 and low < inner_low - FAR * spread:
        beyond = flat < inner_low - FAR * spread
        low = float(flat[~beyond].min()) if np.count_nonzero(beyond) <= count else low
    return low, high
