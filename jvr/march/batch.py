"""A loop over a batch of rays that shrinks as rays finish, so that finished rays are not paid for."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

Lanes = TypeVar("Lanes")
Shared = TypeVar("Shared")

# Below this many lanes one more halving costs more to compile than it saves to run.
SMALLEST_BATCH = 4096


def shrinking_while(
    alive: Callable[[Lanes, Shared], Bool[Array, "rays"]],
    advance: Callable[[Lanes, Shared], tuple[Lanes, Shared]],
    lanes: Lanes,
    shared: Shared,
) -> tuple[Lanes, Shared]:
    """`while any(alive): advance`, where the batch is halved each time half of it or more has finished.

    `lanes` is a pytree of arrays with a leading axis of rays; `shared` is carried along as it is. `advance` must leave a
    finished lane as it is. Lanes come back in their own order.
    """
    size = jax.tree.leaves(lanes)[0].shape[0]
    index, finished = jnp.arange(size, dtype=jnp.int32), lanes
    while size > 0:
        smaller = size // 2 if size >= 2 * SMALLEST_BATCH else 0

        def going(state: tuple[Lanes, Shared], smaller: int = smaller) -> Bool[Array, ""]:
            return jnp.sum(alive(*state)) > smaller

        lanes, shared = jax.lax.while_loop(going, lambda state: advance(*state), (lanes, shared))
        finished = jax.tree.map(lambda all_, some: all_.at[index].set(some, unique_indices=True), finished, lanes)
        if smaller:
            chosen = _alive_first(alive(lanes, shared))[:smaller]
            index = index[chosen]
            lanes = jax.tree.map(lambda x: x[chosen], lanes)
        size = smaller
    return finished, shared


def _alive_first(alive: Bool[Array, "rays"]) -> Array:
    """The permutation that lists living lanes first, each group in its own order."""
    living = jnp.cumsum(alive, dtype=jnp.int32)
    place = jnp.where(alive, living - 1, living[-1] + jnp.cumsum(~alive, dtype=jnp.int32) - 1)
    return jnp.zeros_like(place).at[place].set(jnp.arange(place.size, dtype=jnp.int32), unique_indices=True)
