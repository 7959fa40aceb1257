"""Which arrays a derived one was made of, by identity.

What is computed once and kept beside the arrays that it was made of goes stale when one of these is replaced. JAX's arrays do not change,
so that the very same array in the same place is proof that nothing was replaced; traced arrays prove nothing.
"""

import weakref

import jax
from jax.core import Tracer
from jaxtyping import Array

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
