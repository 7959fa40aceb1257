"""Cache keys of derived arrays: what one was made of, by identity or by content.

What is computed once and kept beside the arrays that it was made of goes stale when one of these is replaced. JAX's arrays do not change,
so that the very same array in the same place is proof that nothing was replaced; traced arrays prove nothing. Where computing anew is
cheaper than reading everything, that is what is done then; else checksums are compared.
"""

import weakref
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, UInt32

# The derived array by its identity, which is its own as long as it lives, and then its sources; nothing is kept alive by this.
_made_of: dict[int, tuple[weakref.ref, ...]] = {}


def note_sources(derived: Array, *sources: Array) -> None:
    """Remembers what `derived` was made of, as long as both are there."""
    arrays = (derived, *sources)
    if any(isinstance(x, Tracer) or not isinstance(x, jax.Array) for x in arrays):
        return
    key = id(derived)
    forget = lambda _: _made_of.pop(key, None)
    _made_of[key] = (weakref.ref(derived, forget), *map(weakref.ref, sources))


def is_made_of(derived: Array, *sources: Array) -> bool:
    """Whether `derived` is known to be made of these very arrays."""
    noted = _made_of.get(id(derived), ())
    return len(noted) == 1 + len(sources) and all(ref() is x for ref, x in zip(noted, (derived, *sources), strict=True))


def made_by(method: str) -> dict[str, str]:
    """The metadata of a field that a method makes of the others: `eqx.field(metadata=made_by("bricked"))`. What is static in the field's
    value are the arguments of the method."""
    return {"made_by": method}


_checksums: dict[int, tuple[weakref.ref, np.ndarray]] = {}


def content(tree: Any) -> UInt32[Array | np.ndarray, "parts 2"]:
    """Checksums of the structure of a tree, with its static parts, and of each of its arrays. Concrete arrays are read once in their life,
    traced ones each time; no derivative goes through it."""
    arrays, structure = jax.tree.flatten(jax.lax.stop_gradient(tree))
    shapes = [(x.shape, str(x.dtype)) for x in arrays]
    rows = [np.array([zlib.crc32(f"{structure} {shapes}".encode()), len(arrays)], np.uint32)]
    rows += [_checksum(x) if isinstance(x, Tracer) else _known_checksum(x) for x in arrays]
    return np.stack(rows) if all(isinstance(row, np.ndarray) for row in rows) else jnp.stack([jnp.asarray(r) for r in rows])


def is_same_content(one: UInt32[Array | np.ndarray, "parts 2"], other: UInt32[Array | np.ndarray, "others 2"]) -> Any:
    """Whether two trees had the same `content`: a `bool`, or a traced one."""
    if one.shape != other.shape:
        return False
    if isinstance(one, Tracer) or isinstance(other, Tracer):
        return jnp.all(one == other)
    return bool(np.all(np.asarray(one) == np.asarray(other)))


def _known_checksum(array: Any) -> np.ndarray:
    key = id(array)
    known = _checksums.get(key)
    if known is not None and known[0]() is array:
        return known[1]
    with jax.ensure_compile_time_eval():
        found = np.asarray(_checksum(array))
    if isinstance(array, jax.Array):
        _checksums[key] = (weakref.ref(array, lambda _: _checksums.pop(key, None)), found)
    return found


@jax.jit
def _checksum(array: Array) -> UInt32[Array, "2"]:
    """Two sums over a hash of each element's bits and of its place (a finaliser of two multiplications): one element alone never changes
    without the first of them, two different arrays have the same both in one of 2^64 cases."""
    array = array.astype(jnp.uint8) if array.dtype == bool else array
    word = {1: jnp.uint8, 2: jnp.uint16}.get(array.dtype.itemsize, jnp.uint32)
    bits = jax.lax.bitcast_convert_type(array, word).reshape(-1).astype(jnp.uint32)
    place = jnp.arange(bits.size, dtype=jnp.uint32)
    mixed = bits + place * jnp.uint32(0x9E3779B9)
    mixed = (mixed ^ (mixed >> 16)) * jnp.uint32(0x7FEB352D)
    mixed = (mixed ^ (mixed >> 15)) * jnp.uint32(0x846CA68B)
    mixed ^= mixed >> 16
    return jnp.stack([jnp.sum(x, dtype=jnp.uint32) for x in (mixed, mixed * (2 * place + 1))])
