"""Stream compaction: work on the elements that a mask selects, at a cost that is proportional to their number.

The mask is packed into words of 32 bits. The `k`-th selected element is then found by a binary search over the running count of the
words and five halvings inside of one: cheaper than a list of all indices where few elements are selected.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from equinox.internal import unvmap_any
from jaxtyping import Array, Bool, Int, Shaped, UInt32

Block = TypeVar("Block")
Carry = TypeVar("Carry")

# Elements that are worked on at a time: enough to outweigh the cost of starting an operation, few enough to waste little at the end.
BLOCK = 2048
WORD = 32


class Selection(NamedTuple):
    """The compacted elements of a mask: 32 of them to a word, and how many are selected up to the end of each word."""

    words: UInt32[Array, "words"]
    through: Int[Array, "words"]

    @property
    def number(self) -> Int[Array, ""]:
        return self.through[-1]

    def element(self, k: Int[Array, "n"]) -> Int[Array, "n"]:
        """The index of the `k`-th selected element, in increasing order; anything where there are not so many."""
        word = jnp.searchsorted(self.through, k, side="right", method="scan_unrolled")
        word = jnp.minimum(word, self.words.size - 1).astype(jnp.int32)
        bits = self.words[word]
        rank = k - self.through[word] + _ones(bits)
        place = jnp.zeros_like(k)
        for width in (16, 8, 4, 2, 1):
            below = _ones(bits & jnp.uint32((1 << width) - 1))
            above = rank >= below
            rank = jnp.where(above, rank - below, rank)
            bits = jnp.where(above, bits >> width, bits)
            place = jnp.where(above, place + width, place)
        return word * WORD + place


def select(mask: Bool[Array, "n"]) -> Selection:
    """The elements where `mask` holds."""
    bits = jnp.pad(mask, (0, -mask.size % WORD)).reshape(-1, WORD).astype(jnp.uint32)
    words = jnp.sum(bits << jnp.arange(WORD, dtype=jnp.uint32), axis=1, dtype=jnp.uint32)
    return Selection(words, jnp.cumsum(_ones(words), dtype=jnp.int32))


def for_each(
    mask: Bool[Array, "n"],
    read: Callable[[Int[Array, "block"]], Block],
    body: Callable[[Int[Array, "block"], Bool[Array, "block"], Block, Carry], Carry],
    carry: Carry,
) -> Carry:
    """Calls `carry = body(index, valid, read(index), carry)` on one block of selected indices after the other.

    Elements that are not `valid` repeat index 0; `write` and `accumulate` leave them out. Not differentiable in reverse mode.
    """
    selection = select(mask)
    offsets = jnp.arange(min(BLOCK, mask.size), dtype=jnp.int32)

    def at(done: Int[Array, ""]) -> Int[Array, "block"]:
        return jnp.where(done + offsets < selection.number, selection.element(done + offsets), 0)

    def step(state: Any) -> Any:
        done, index, following, block_read, carry = state
        carry = body(index, done + offsets < selection.number, block_read, carry)
        return done + offsets.size, following, at(done + 2 * offsets.size), read(following), carry

    # Indices are found two blocks ahead and read from one ahead: the compiler does not fuse across iterations of a loop, and would
    # otherwise repeat the search in every single read.
    first = at(jnp.int32(0))
    start = (jnp.int32(0), first, at(jnp.int32(offsets.size)), read(first), carry)
    # Under `vmap` there is one count of what is done for all of a batch (`jvr.march.wavefront`).
    return jax.lax.while_loop(lambda state: unvmap_any(state[0] < selection.number), step, start)[-1]


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def map_selected(f: Callable[[Any, Any], Any], mask: Bool[Array, "n"], shared: Any, elements: Any) -> Any:
    """`f(shared, elements)` at the elements that `mask` selects, zero at the others.

    `elements` is a pytree of arrays with a leading axis of elements; `f` takes a block of them and returns a pytree of arrays of one number
    for each. Differentiable in reverse mode, at a cost that is proportional to the number of selected elements, too.
    """
    results = jax.eval_shape(f, shared, elements)
    put = lambda index, valid, block, out: jax.tree.map(lambda o, x: write(o, index, valid, x), out, f(shared, block))
    return for_each(mask, _reader(elements), put, jax.tree.map(lambda r: jnp.zeros(r.shape, r.dtype), results))


def _map_forward(f: Callable[[Any, Any], Any], mask: Array, shared: Any, elements: Any) -> tuple[Any, Any]:
    return map_selected(f, mask, shared, elements), (mask, shared, elements)


def _map_backward(f: Callable[[Any, Any], Any], residuals: Any, cotangent: Any) -> Any:
    mask, shared, elements = residuals

    def pull(index: Array, valid: Array, block: Any, total: Any) -> Any:
        own, of_results = block
        of_results = jax.tree.map(lambda g: jnp.where(valid, g, 0.0), of_results)
        to_shared, to_elements = jax.vjp(f, shared, own)[1](of_results)
        return jax.tree.map(jnp.add, total[0], to_shared), jax.tree.map(
            lambda t, g: write(t, index, valid, g), total[1], to_elements
        )

    start = jax.tree.map(jnp.zeros_like, (shared, elements))
    return None, *for_each(mask, _reader((elements, cotangent)), pull, start)


map_selected.defvjp(_map_forward, _map_backward)


def _reader(tree: Any) -> Callable[[Int[Array, "block"]], Any]:
    return lambda index: jax.tree.map(lambda x: x[index], tree)


def write(
    array: Shaped[Array, "n *row"], index: Int[Array, "block"], valid: Bool[Array, "block"], rows: Shaped[Array, "block *row"]
) -> Shaped[Array, "n *row"]:
    """`array[index] = rows` where `valid`."""
    return array.at[jnp.where(valid, index, array.shape[0])].set(rows, mode="drop", unique_indices=True)


def accumulate(
    array: Shaped[Array, "n *row"], index: Int[Array, "block"], valid: Bool[Array, "block"], rows: Shaped[Array, "block *row"]
) -> Shaped[Array, "n *row"]:
    """`array[index] += rows` where `valid`."""
    return array.at[jnp.where(valid, index, array.shape[0])].add(rows, mode="drop", unique_indices=True)


def _ones(words: UInt32[Array, "n"]) -> Int[Array, "n"]:
    return jax.lax.population_count(words).astype(jnp.int32)
