"""A loop over many rays in a pool of few lanes: a lane whose ray has finished takes the next ray from the queue."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

Inputs = TypeVar("Inputs")
State = TypeVar("State")
Shared = TypeVar("Shared")
Results = TypeVar("Results")

# Lanes in the pool: enough for every core to have work at each step, few enough for their state to stay in the cache.
POOL = 8192
# The share of lanes that may idle before they are filled again.
IDLE = 0.25


def pooled_while(
    alive: Callable[[Inputs, State], Bool[Array, "lanes"]],
    advance: Callable[[Inputs, State, Shared], tuple[State, Shared]],
    start: Callable[[Inputs], State],
    finish: Callable[[State], Results],
    inputs: Inputs,
    shared: Shared,
    work: Int[Array, "rays"],
) -> tuple[Results, Shared]:
    """`while any(alive): advance` for every ray, of which at most `POOL` are in flight.

    `inputs` and what `finish` returns are pytrees of arrays with a leading axis of rays; `start` makes the state of a batch from its
    inputs; `shared` is carried along. `advance` must leave a finished lane as it is. Rays with more `work` to do start first, so
    that no long ray is left alone at the end. Results come in the order of `inputs`.

    Finished rays are thus not paid for, memory in flight does not grow with the picture, and there is one loop to compile.
    """
    size = work.shape[0]
    if size <= POOL:
        state, shared = jax.lax.while_loop(
            lambda carry: jnp.any(alive(inputs, carry[0])), lambda carry: advance(inputs, *carry), (start(inputs), shared)
        )
        return finish(state), shared
    queue = jnp.argsort(-work).astype(jnp.int32)
    take = lambda index: jax.tree.map(lambda x: x[index], inputs)
    index = queue[:POOL]
    own = take(index)
    state = start(own)
    results = jax.tree.map(lambda x: jnp.zeros((size, *x.shape[1:]), x.dtype), jax.eval_shape(finish, state))

    def working(carry):
        own, state, _, _, following, _ = carry
        return (following < size) | jnp.any(alive(own, state))

    def drain_and_fill(carry):
        own, state, shared, index, following, results = carry
        enough = jnp.where(following < size, int(POOL * (1 - IDLE)), 0)
        state, shared = jax.lax.while_loop(
            lambda c: jnp.sum(alive(own, c[0])) > enough, lambda c: advance(own, *c), (state, shared)
        )
        results = jax.tree.map(lambda all_, some: all_.at[index].set(some, unique_indices=True), results, finish(state))
        idle = ~alive(own, state)
        place = following + jnp.cumsum(idle, dtype=jnp.int32) - 1
        fill = idle & (place < size)
        index = jnp.where(fill, queue[jnp.minimum(place, size - 1)], index)
        own = take(index)
        state = jax.tree.map(lambda old, new: _where(fill, new, old), state, start(own))
        following = jnp.minimum(following + jnp.sum(idle, dtype=jnp.int32), size)
        return own, state, shared, index, following, results

    carry = (own, state, shared, index, jnp.int32(POOL), results)
    _, _, shared, _, _, results = jax.lax.while_loop(working, drain_and_fill, carry)
    return results, shared


def _where(mask: Bool[Array, "lanes"], new: Array, old: Array) -> Array:
    return jnp.where(mask.reshape(-1, *(1,) * (old.ndim - 1)), new, old)
