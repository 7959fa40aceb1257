"""Values between the nodes of a grid."""

import jax.numpy as jnp
import numpy as np
import pytest
from jax import test_util
from jax.scipy.ndimage import map_coordinates

from jvr.effects.grid import Grid


@pytest.mark.parametrize("shape", [(4, 3, 5), (1, 3, 2), (4, 1, 1), (1, 1, 1)])
@pytest.mark.parametrize("channels", [1, 3, 12])
def test_interpolation_is_that_of_another_implementation(x64, shape, channels):
    """Inside, at nodes, on the border and beyond it; axes of one node are constant."""
    rng = np.random.default_rng(3)
    nodes = rng.normal(size=(*shape, channels))
    at = np.concatenate([rng.uniform(-0.7, np.array(shape) - 0.3, (40, 3)), [[0, 0, 0], np.array(shape) - 1]]).T
    found = Grid.of(jnp.asarray(nodes)).interpolate(tuple(jnp.asarray(at)), jnp.ones(at.shape[1], bool))
    inside = [np.clip(x, 0, n - 1) for x, n in zip(at, shape, strict=True)]
    for c, values in enumerate(found):
        np.testing.assert_allclose(values, map_coordinates(nodes[..., c], inside, order=1, mode="nearest"), atol=1e-14)


def test_derivatives_reach_nodes_and_positions(x64):
    rng = np.random.default_rng(4)
    nodes, at = jnp.asarray(rng.normal(size=(3, 4, 2, 2))), jnp.asarray(rng.uniform(0.1, 0.9, (3, 7)))

    def total(nodes, at):
        found = Grid.of(jnp.asarray(nodes)).interpolate(tuple(jnp.asarray(at)), jnp.ones(at.shape[1], bool))
        return sum(jnp.sum(jnp.sin(values)) for values in found)

    test_util.check_grads(total, (nodes, at), order=1, modes=("fwd", "rev"), atol=1e-7, rtol=1e-7)


def test_a_batch_of_which_nothing_is_wanted_is_finite():
    found = Grid.of(jnp.ones((2, 2, 2, 1))).interpolate((jnp.full(3, jnp.nan),) * 3, jnp.zeros(3, bool))
    assert np.all(np.isfinite(found[0]))
