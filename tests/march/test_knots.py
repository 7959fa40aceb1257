"""Derivatives where data lie exactly at an entry of a table or at an end of what is clamped, as labels and backgrounds do.

There a picture is differentiable to both sides, not always equally. What is found must be the derivative to one of them, and at an end that
of the side where the table goes on.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jvr
from jvr.effects.environment_lighting import environment_lighting
from jvr.effects.grid import Grid
from jvr.effects.light_space import bilinear
from jvr.effects.shading import surface_weight
from jvr.numerics import clamp

# Entries at whole numbers, as labels are: the second goes straight on, the third is a kink.
ENTRIES, SIGMA = np.arange(1.0, 6.0), np.array([0.0, 0.2, 0.4, 0.1, 0.3])
COLOURS = np.array([[0.1, 0.3, 0.5], [0.2, 0.4, 0.4], [0.3, 0.5, 0.3], [0.9, 0.1, 0.2], [0.2, 0.8, 0.6]])
TABLES = {
    "linear": lambda: jvr.LinearTransfer(ENTRIES, COLOURS, SIGMA),
    "lut": lambda: jvr.LutTransfer(COLOURS, SIGMA, (1.0, 5.0)),
}
LENGTH, STEP = 2.0, 1e-7


def slab(s):
    """Radiance behind which nothing is, of `LENGTH` of what the table makes of a scalar, in float64."""
    colour = np.array([np.interp(s, ENTRIES, column) for column in COLOURS.T])
    return colour * -np.expm1(-LENGTH * np.interp(s, ENTRIES, SIGMA))


@pytest.mark.parametrize(
    ("kind", "adjoint"),
    [
        ("linear", jvr.Replay()),
        ("lut", jvr.Forward()),
        pytest.param("linear", jvr.Forward(), marks=pytest.mark.slow),
        pytest.param("lut", jvr.Replay(), marks=pytest.mark.slow),
    ],
)
def test_voxels_at_entries_of_a_table(kind, adjoint, x64):
    """Of a homogeneous slab, in its scalar, against one-sided differences: to the right, and at the last entry to the left."""
    camera = jvr.OrthographicCamera.look_at([1.0, 1.0, 9.0], [1.0, 1.0, 0.0], [0, 1, 0], 0.5, 1, 1)
    transfer, settings = TABLES[kind](), jvr.Settings(0.5, termination=0, adjoint=adjoint)

    def picture(s):
        return jvr.render(jvr.Scene(jvr.Volume(s * jnp.ones((3, 3, 3))), transfer), camera, settings).rgb[0, 0]

    if isinstance(adjoint, jvr.Forward):
        slope = jax.jit(lambda s: jax.jvp(picture, (s,), (jnp.ones(()),))[1])
    else:
        slope = jax.jit(jax.jacrev(picture))
    for s in ENTRIES:
        side = -STEP if s == ENTRIES[-1] else STEP
        expected = (slab(s + side) - slab(s)) / side
        np.testing.assert_allclose(slope(jnp.asarray(s)), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", TABLES)
def test_positions_of_entries_under_voxels(kind, x64):
    """In where entries lie, to one side or to the other: at a kink they differ, and their mean is neither."""
    transfer, leaf = TABLES[kind](), "positions" if kind == "linear" else "domain"
    of = lambda at, s: eqx.tree_at(lambda t: getattr(t, leaf), transfer, at).evaluate(s).sigma_t[0]
    at, values, slopes = getattr(transfer, leaf), jax.jit(jax.vmap(of, (0, None))), jax.jit(jax.grad(of))
    moved = jnp.concatenate([at + STEP * jnp.eye(at.size), at - STEP * jnp.eye(at.size)])
    for s in map(jnp.asarray, ENTRIES):
        right, left = np.split((np.asarray(values(moved, s)) - values(at[None], s)) / STEP, 2)
        sides = np.stack([right, -left])
        assert np.max(np.min(np.abs(sides - slopes(at, s)), axis=0)) < 1e-6


def test_tables_of_the_gradient(x64):
    """Bilinear in scalar and length of the gradient: at each entry and each corner, to the side where the table goes on."""
    rng = np.random.default_rng(0)
    sigma = rng.random((4, 3))
    transfer = jvr.GradientTransfer(rng.random((4, 3, 3)), sigma, (0.0, 3.0), (0.0, 2.0))
    slope = jax.jit(jax.grad(lambda s, m: transfer.evaluate(s, m).sigma_t[0], argnums=(0, 1)))

    def table(p):
        i = np.minimum(np.floor(p).astype(int), np.array(sigma.shape) - 2)
        x, y = p - i
        cell = sigma[i[0] : i[0] + 2, i[1] : i[1] + 2]
        return np.array([1 - x, x]) @ cell @ np.array([1 - y, y])

    for p in np.stack(np.meshgrid(*map(np.arange, sigma.shape), indexing="ij"), -1).reshape(-1, 2).astype(float):
        found = slope(*map(jnp.asarray, p))
        for axis in range(2):
            h = STEP * np.eye(2)[axis] * (-1 if p[axis] == sigma.shape[axis] - 1 else 1)
            expected = (table(p + h) - table(p)) / h.sum()
            np.testing.assert_allclose(found[axis], expected, atol=1e-6)


def test_opacity_by_gradient_from_zero(x64):
    """Without a gradient, where `low` is 0 and cannot be less: opacity stays zero whichever way it moves."""
    inner = jvr.LinearTransfer([0.0, 1.0], np.ones((2, 3)), [0.3, 0.3])
    of = lambda low, high, m: jvr.GradientOpacity(inner, low, high).evaluate(jnp.asarray(0.5), m).sigma_t[0]
    slope = jax.jit(jax.grad(of, argnums=(0, 1, 2)))
    zero, one = map(jnp.asarray, (0.0, 1.0))
    np.testing.assert_array_equal(slope(zero, one, zero)[:2], 0.0)
    # At `high` the side of smaller gradients, where opacity changes.
    np.testing.assert_allclose(slope(zero, one, one), [0.0, -0.3, 0.3], atol=1e-12)


def test_a_gradient_as_long_as_the_threshold(x64):
    """The share of a surface `m^2 / (m^2 + t^2)` is smooth there."""
    for m, t in ((1.0, 1.0), (1.0, 0.5), (0.5, 1.0), (3.0, 3.0)):
        found = jax.grad(surface_weight, argnums=(0, 1))(jnp.asarray(m), jnp.asarray(t))
        total = (m * m + t * t) ** 2
        np.testing.assert_allclose(found, [2 * m * t * t / total, -2 * t * m * m / total], rtol=1e-12)


def test_nodes_of_grids_and_maps(x64):
    """At nodes and at the border of what lights are kept in, to the side where nodes are."""
    nodes = np.random.default_rng(1).random((4, 3, 2, 1))
    grid, wanted = Grid.of(jnp.asarray(nodes)), jnp.ones(1, bool)
    along_x = lambda x: grid.interpolate((x[None], jnp.ones(1), jnp.zeros(1)), wanted)[0][0]
    slope = jax.jit(jax.grad(along_x))
    for x in range(4):
        expected = nodes[min(x + 1, 3), 1, 0, 0] - nodes[min(x, 2), 1, 0, 0]
        np.testing.assert_allclose(slope(jnp.asarray(float(x))), expected, atol=1e-12)
    texels = jnp.asarray(nodes[:3, :3, 0, 0])
    across = lambda u: sum(w * texels.reshape(-1)[i] for i, w in bilinear(3, u, jnp.asarray(-1.0)))
    for u, (low, high) in ((-1.0, (0, 1)), (0.0, (1, 2)), (1.0, (1, 2))):
        np.testing.assert_allclose(jax.grad(across)(jnp.asarray(u)), texels[high, 0] - texels[low, 0], atol=1e-12)


def test_clamped():
    """Value as NumPy's, in both modes the derivative of what is inside or at an end, that of the end outside."""
    x = np.array([-2.0, -1.0, 0.3, 2.0, 5.0, np.nan])
    np.testing.assert_array_equal(clamp(jnp.asarray(x), -1, 2.0), np.clip(x, -1, 2).astype(np.float32))
    of = lambda x, low, high: clamp(x, low, high)
    for value, expected in zip(x, ((0, 1, 0), (1, 0, 0), (1, 0, 0), (1, 0, 0), (0, 0, 1)), strict=False):
        at = tuple(map(jnp.asarray, (value, -1.0, 2.0)))
        np.testing.assert_array_equal(jax.grad(of, argnums=(0, 1, 2))(*at), expected)
        np.testing.assert_array_equal(jax.jacfwd(of, argnums=(0, 1, 2))(*at), expected)


def test_light_of_zero(x64):
    """From none, light that is nowhere negative adds all that it adds."""
    material = jvr.LambertBRDF().projected(1)
    up, tilted = tuple(map(jnp.asarray, (0.0, 0.0, 1.0))), tuple(map(jnp.asarray, (0.0, 0.6, 0.8)))
    s = jnp.asarray(0.5)

    @jax.jit
    def reflected(light):
        return environment_lighting(material, light, clamped=True, order=1, from_samples=False).reflect(s, s, up, tilted, ())[0][
            0
        ]

    zero, tangent = jnp.zeros((4, 3)), jnp.asarray([[1.0], [0.3], [-0.2], [0.1]]) * jnp.ones(3)
    found = jax.jvp(reflected, (zero,), (tangent,))[1]
    np.testing.assert_allclose(found, (reflected(STEP * tangent) - reflected(zero)) / STEP, rtol=1e-6)
    assert found > 0.1
