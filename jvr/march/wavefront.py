"""A loop over many rays in a wavefront of few: where a ray has finished, the next one of the queue starts (ray regeneration)."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from equinox.internal import unvmap_any
from jaxtyping import Array, Bool, Int

from jvr.march.compact import select

Inputs = TypeVar("Inputs")
State = TypeVar("State")
Shared = TypeVar("Shared")
Results = TypeVar("Results")

# Rays in flight: enough to outweigh what it costs to start an operation, few enough for their state to stay in the cache.
WAVEFRONT = 3072
# How many times as many an accelerator keeps in flight: as many as a large one has threads. (Chosen, not measured.)
ON_ACCELERATORS = 64
# The fraction of the wavefront that may idle before rays are regenerated.
IDLE = 0.25
# Neighbouring rays that are put in order together.
TOGETHER = 16
# Rays of the smaller wavefront that the last ones are compacted into, so that a few long ones do not pay for the width of all.
TAIL = 512


def wavefront_while(
    alive: Callable[[Inputs, State], Bool[Array, "active"]],
    advance: Callable[[Inputs, State, Shared], tuple[State, Shared]],
    start: Callable[[Inputs], State],
    finish: Callable[[State], Results],
    inputs: Inputs,
    shared: Shared,
    work: Int[Array, "rays"],
    idle_fraction: float = IDLE,
) -> tuple[Results, Shared]:
    """`while any(alive): advance` for every ray, of which at most `WAVEFRONT` are in flight (more on accelerators).

    `inputs` and what `finish` returns are pytrees of arrays with a leading axis of rays; `start` makes the state of a batch from its
    inputs; `shared` is carried along. `advance` must leave a finished ray as it is. Rays with more `work` to do start first, so
    that no long ray is left alone at the end; rays without any are not started, and their results are zero. Results come in the
    order of `inputs`.

    Finished rays are thus not paid for, and memory in flight does not grow with the picture. `idle_fraction`: of the wavefront that may
    idle before rays are regenerated, which costs as much as several steps: where rays take few, more than for long ones.

    Under `vmap` loops go on for all of a batch while one of it has something to do: a condition for each would make JAX select between all
    of the old state and the new in every step, `shared` included.
    """
    width, tail = (n if jax.default_backend() == "cpu" else ON_ACCELERATORS * n for n in (WAVEFRONT, TAIL))
    if work.shape[0] <= width:
        state, shared = jax.lax.while_loop(
            lambda carry: unvmap_any(alive(inputs, carry[0])), lambda carry: advance(inputs, *carry), (start(inputs), shared)
        )
        return finish(state), shared
    queue, size = _longest_first(work)
    take = lambda index: jax.tree.map(lambda x: x[index], inputs)
    index = queue[:width]
    own = take(index)
    state = start(own)
    results = jax.tree.map(lambda x: jnp.zeros((work.shape[0], *x.shape[1:]), x.dtype), jax.eval_shape(finish, state))
    put = lambda results, index, state: jax.tree.map(lambda r, x: r.at[index].set(x, mode="drop"), results, finish(state))

    def filling(carry):
        own, state, _, _, following, _ = carry
        return unvmap_any((following < size) | (jnp.sum(alive(own, state)) > tail))

    def drain_and_regenerate(carry):
        own, state, shared, index, following, results = carry
        enough = jnp.where(following < size, int(width * (1 - idle_fraction)), tail)
        state, shared = jax.lax.while_loop(
            lambda c: unvmap_any(jnp.sum(alive(own, c[0])) > enough), lambda c: advance(own, *c), (state, shared)
        )
        results = put(results, index, state)
        idle = ~alive(own, state)
        place = following + jnp.cumsum(idle, dtype=jnp.int32) - 1
        fill = idle & (place < size)
        index = jnp.where(fill, queue[jnp.minimum(place, size - 1)], index)
        own = take(index)
        state = jax.tree.map(lambda old, new: _where(fill, new, old), state, start(own))
        following = jnp.minimum(following + jnp.sum(idle, dtype=jnp.int32), size)
        return own, state, shared, index, following, results

    carry = (own, state, shared, index, jnp.int32(width), results)
    own, state, shared, index, _, results = jax.lax.while_loop(filling, drain_and_regenerate, carry)
    # Rays that are not alive are done and written; one of them fills up the smaller wavefront, and is written again. Where all are alive,
    # in a wavefront no larger than the smaller one, none may be taken twice: what it adds to `shared` would count twice.
    living = alive(own, state)
    selection, place = select(living), jnp.arange(min(tail, width), dtype=jnp.int32)
    compacted = jnp.where(place < selection.number, selection.element(place), jnp.argmin(living))
    index, state = index[compacted], jax.tree.map(lambda x: x[compacted], state)
    own = take(index)
    state, shared = jax.lax.while_loop(lambda c: unvmap_any(alive(own, c[0])), lambda c: advance(own, *c), (state, shared))
    return put(results, index, state), shared


def _longest_first(work: Int[Array, "rays"]) -> tuple[Int[Array, "queue"], Int[Array, ""]]:
    """Indices of rays by falling `work`, and how many of them there are to start. Neighbours stay together: sorting rays one by one
    takes ten times as long, and rays side by side read the same voxels."""
    rays = work.shape[0]
    most = jnp.max(jnp.pad(work, (0, -rays % TOGETHER)).reshape(-1, TOGETHER), axis=1)
    first = jnp.argsort(-most).astype(jnp.int32) * TOGETHER
    queue = (first[:, None] + jnp.arange(TOGETHER, dtype=jnp.int32)).ravel()
    busy = TOGETHER * jnp.sum(most > 0, dtype=jnp.int32)
    if queue.size > rays:
        # The last group is not full. What fills up its end is no ray and must not be started.
        place = jnp.arange(rays, dtype=jnp.int32)
        queue = queue[jnp.where(place < jnp.argmax(queue >= rays), place, place + queue.size - rays)]
        busy -= jnp.where(most[-1] > 0, -rays % TOGETHER, 0).astype(jnp.int32)
    return queue, busy


def _where(mask: Bool[Array, "active"], new: Array, old: Array) -> Array:
    return jnp.where(mask.reshape(-1, *(1,) * (old.ndim - 1)), new, old)
