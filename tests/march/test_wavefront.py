"""The wavefront: every ray is advanced as often as it has work, whatever the sizes, and results keep their order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jvr.march import wavefront


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    for name, value in {"WAVEFRONT": 64, "TAIL": 8, "TOGETHER": 4}.items():
        monkeypatch.setattr(wavefront, name, value)


@jax.jit
def run(work: jax.Array):
    """Counts steps per ray, sums a ray's own number once a step, and counts all steps in the shared state."""

    def advance(inputs, state, shared):
        number, work = inputs
        alive = state[0] < work
        return (state[0] + alive, state[1] + jnp.where(alive, number, 0)), shared + jnp.sum(alive)

    def start(inputs):
        return jnp.zeros_like(inputs[1]), jnp.zeros_like(inputs[0])

    inputs = (jnp.arange(1, work.size + 1), work)
    alive = lambda inputs, state: state[0] < inputs[1]
    finish = lambda state: {"steps": state[0], "sum": state[1]}
    return wavefront.wavefront_while(alive, advance, start, finish, inputs, jnp.int32(0), inputs[1])


@given(st.sampled_from([1, 64, 65, 203, 400]), st.integers(0, 2**31), st.sampled_from([0.0, 0.5, 0.95]))
@settings(max_examples=60, deadline=None)
def test_every_ray_is_worked_off(size, seed, idle):
    rng = np.random.default_rng(seed)
    work = rng.geometric(0.05, size).astype(np.int32) * (rng.random(size) >= idle)
    results, total = run(work)
    np.testing.assert_array_equal(results["steps"], work)
    np.testing.assert_array_equal(results["sum"], work * np.arange(1, size + 1))
    assert total == work.sum()


@pytest.mark.parametrize("size", [63, 64, 65, 71, 72, 73, 257])
@pytest.mark.parametrize("fill", [0, 3])
def test_edges(size, fill):
    """Nothing to do at all, everything alike, and one straggler."""
    work = np.full(size, fill, np.int32)
    work[-1] = 50
    results, total = run(work)
    np.testing.assert_array_equal(results["steps"], work)
    assert total == work.sum()


def test_a_wavefront_smaller_than_its_tail_counts_no_ray_twice(monkeypatch):
    """The queue is empty while all rays are alive, so none of them can fill up the smaller wavefront."""
    monkeypatch.setattr(wavefront, "TAIL", 100)
    jax.clear_caches()
    work = np.repeat(np.array([50, 10, 5], np.int32), [48, 16, 16])
    results, total = run(work)
    np.testing.assert_array_equal(results["steps"], work)
    assert total == work.sum()


def test_a_batch_goes_on_together():
    """Of queues that end at different times, without a condition for each, which is a selection of the whole state in every step."""
    rng = np.random.default_rng(3)
    batch = np.stack([rng.geometric(0.05, 203), np.where(np.arange(203) == 7, 90, 0), rng.geometric(0.5, 203)]).astype(np.int32)
    results, total = jax.jit(jax.vmap(run))(batch)
    np.testing.assert_array_equal(results["steps"], batch)
    np.testing.assert_array_equal(results["sum"], batch * np.arange(1, 204))
    np.testing.assert_array_equal(total, batch.sum(axis=1))
    assert conditions(jax.make_jaxpr(jax.vmap(run))(batch)) == [(), (), ()]


def conditions(program):
    """The shapes of the conditions of loops."""
    found = []
    for equation in program.eqns:
        if equation.primitive.name == "while":
            found += [condition.shape for condition in equation.params["cond_jaxpr"].out_avals]
        for inner in equation.params.values():
            found += conditions(inner) if hasattr(inner, "eqns") else []
    return found
