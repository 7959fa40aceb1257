"""Phase functions: normalisation, moments, samples against the pdf, and digits of values and derivatives."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chisquare

from jvr.model.mie import Draine, JendersieEon, TabulatedPhase
from jvr.model.phase import (
    DoubleHenyeyGreenstein,
    HenyeyGreenstein,
    Isotropic,
    Mixture,
    Rayleigh,
    ScatteringAngle,
    Schlick,
    henyey_greenstein,
)

ANGLES = np.linspace(0.0, np.pi, 9)
BUMPY = np.array([9.0, 2.0, 0.0, 0.0, 1.0, 0.5, 0.0, 3.0, 1.0])
COLOURED = np.stack([BUMPY, BUMPY[::-1], 1.0 + BUMPY], axis=1)

# Made when called: within a test in double precision they are double.
PHASES = {
    "isotropic": lambda: Isotropic(),
    "rayleigh": lambda: Rayleigh(),
    **{f"hg {g}": lambda g=g: HenyeyGreenstein(g) for g in (-0.999, -0.5, -1e-8, 0.0, 1e-3, 0.3, 0.95)},
    "hg coloured": lambda: HenyeyGreenstein([-0.6, 0.2, 0.9]),
    "double hg": lambda: DoubleHenyeyGreenstein(0.8, -0.4, 0.7),
    "double hg coloured": lambda: DoubleHenyeyGreenstein([0.8, 0.5, 0.1], -0.4, [0.0, 1.0, 0.3]),
    **{f"schlick {k}": lambda k=k: Schlick(k) for k in (-0.99, -0.3, 0.0, 1e-4, 0.2499, 0.2501, 0.9)},
    **{
        f"draine {g} {alpha}": lambda g=g, alpha=alpha: Draine(g, alpha)
        for g, alpha in ((0.0, 1.0), (1e-6, 3.0), (-0.7, 0.5), (0.6, 30.0), (0.99, 1.0))
    },
    "draine coloured": lambda: Draine([0.1, 0.5, -0.5], 2.0),
    **{f"droplets {d}": lambda d=d: JendersieEon(d) for d in (5.0, 12.0, 50.0)},
    "table": lambda: TabulatedPhase(ANGLES, BUMPY),
    "table coloured": lambda: TabulatedPhase(ANGLES, COLOURED),
    "table of 2": lambda: TabulatedPhase([0.0, np.pi], [1.0, 0.0]),
    "mixture": lambda: Mixture([Rayleigh(), HenyeyGreenstein(0.7), Schlick(-0.2)], [1.0, 2.0, 0.0]),
    "mixture coloured": lambda: Mixture([Rayleigh(), HenyeyGreenstein([0.1, 0.4, 0.7])], [[3.0, 2.0, 1.0], [1.0, 1.0, 1.0]]),
    "mixture of mixtures": lambda: Mixture([Mixture([Isotropic(), Draine(0.3, 1.0)], [1.0, 1.0]), Schlick(0.5)], [1.0, 3.0]),
}


def panels():
    """Edges over `1 - cos theta` that come ever closer towards both poles and meet the tables' own angles."""
    near = np.concatenate([[0.0], np.geomspace(1e-9, 0.2, 40), np.linspace(0.2, 1.0, 20)])
    return np.unique(np.concatenate([near, 2.0 - near, 2.0 * np.sin(0.5 * ANGLES) ** 2]))


def quadrature():
    """Gauss-Legendre on each panel: angles and weights, `(panels, 12)`."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    edges = panels()
    half = 0.5 * np.diff(edges)[:, None]
    gap, rest = edges[:-1, None] + half * (1.0 + nodes), 2.0 - edges[1:, None] + half * (1.0 - nodes)
    return ScatteringAngle.of_gaps(jnp.asarray(gap), jnp.asarray(rest)), half * weights


@pytest.mark.parametrize("name", PHASES)
def test_integrates_to_one_and_has_its_mean_cosine(x64, name):
    phase = PHASES[name]()
    angle, weights = quadrature()
    values, means = phase.evaluate(angle), phase.mean_cosine
    assert len(values) == len(means)
    for value, mean in zip(values, means, strict=True):
        assert np.all(value >= 0)
        # The quadrature's own error; nothing here is random.
        np.testing.assert_allclose(2 * np.pi * np.sum(weights * value), 1.0, rtol=1e-9)
        np.testing.assert_allclose(2 * np.pi * np.sum(weights * value * angle.cos), mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(2 * np.pi * np.sum(weights * phase.pdf(angle)), 1.0, rtol=1e-9)


@pytest.mark.parametrize("name", PHASES)
def test_samples_follow_the_pdf(name):
    phase = PHASES[name]()
    n, bins = 200_000, 64
    u = jax.random.uniform(jax.random.key(7), (n,))
    drawn = phase.sample(u)
    assert np.all(np.isfinite(drawn))
    assert np.all(np.minimum(drawn.one_minus, drawn.one_plus) >= 0)
    np.testing.assert_allclose(drawn.one_minus + drawn.one_plus, 2.0, rtol=1e-6)

    with jax.enable_x64(True):
        angle, weights = quadrature()
        mass = np.sum(2 * np.pi * weights * np.asarray(PHASES[name]().pdf(angle)), axis=1)
    near, far = np.asarray(drawn.one_minus, np.float64), np.asarray(drawn.one_plus, np.float64)
    counts, _ = np.histogram(np.where(near < 1.0, near, 2.0 - far), panels())
    assert counts.sum() == n
    assert np.all(counts[mass == 0] == 0)
    # Neighbours are joined until each bin expects at least 50: the statistic then has its distribution.
    bins = np.floor(np.cumsum(mass) * n / 50).astype(int)
    counts, expected = (np.bincount(bins, each)[np.unique(bins)] for each in (counts, n * mass))
    expected, counts = np.append(expected[:-2], expected[-2:].sum()), np.append(counts[:-2], counts[-2:].sum())
    assert chisquare(counts, expected * n / expected.sum()).pvalue > 1e-4

    mean = np.mean(jnp.stack(phase.mean_cosine))
    assert abs(np.mean(drawn.cos, dtype=float) - mean) < 5 * np.std(drawn.cos, dtype=float) / np.sqrt(n) + 1e-7


def test_sampled_directions_have_their_angle_and_no_preferred_azimuth():
    n, u = 50_000, jax.random.uniform(jax.random.key(3), (2, 50_000))
    phase = HenyeyGreenstein(0.6)
    for travel in np.array([[0, 0, 1], [0, 0, -1], [0.6, 0, -0.8], [-0.48, 0.64, 0.6]], np.float32):
        towards = tuple(jnp.asarray(travel))
        direction, angle = phase.sample_direction(towards, *u)
        stacked = np.stack(direction)
        np.testing.assert_allclose(np.sum(stacked**2, axis=0), 1.0, rtol=1e-6)
        again = ScatteringAngle.between(direction, tuple(-t for t in towards))
        np.testing.assert_allclose(again.cos, angle.cos, atol=5e-7)
        # Five standard errors of a component.
        np.testing.assert_allclose(stacked.mean(axis=1), 0.6 * travel, atol=5 * 0.7 / np.sqrt(n))


def test_samples_carry_no_derivative():
    sampled = lambda g, u: DoubleHenyeyGreenstein(g, -0.2, 0.5).sample(u).cos
    value, tangent = jax.jvp(sampled, (jnp.asarray(0.3), jnp.asarray(0.4)), (jnp.asarray(1.0), jnp.asarray(1.0)))
    assert np.isfinite(value)
    assert tangent == 0


# Numbers of float32, so that both precisions see the same lobe and the same angle.
ASYMMETRIES = np.array([-0.9999, -0.99, -0.5, -1e-8, 0.0, 1e-8, 0.3, 0.99, 0.9999], np.float32)
GAPS = np.concatenate([[0.0], np.geomspace(1e-10, 1.0, 41)]).astype(np.float32)


def _value_and_derivatives(dtype, pole):
    """Value, derivative in g and derivative along `1 - cos`, `(asymmetries, gaps)`, with the gaps from one of the poles."""
    near, far = jnp.asarray(GAPS, dtype), jnp.asarray(2.0 - GAPS.astype(np.float64), dtype)
    angle = ScatteringAngle.of_gaps(*((near, far) if pole == "forward" else (far, near)))
    along = ScatteringAngle(*(jnp.full_like(near, d) for d in (-1.0, 1.0, -1.0)))
    value = henyey_greenstein
    by_g = jax.grad(value)
    by_gap = lambda g, angle, along: jax.jvp(lambda angle: value(g, angle), (angle,), (along,))[1]
    g = jnp.asarray(ASYMMETRIES, dtype)
    return [
        np.asarray(jax.jit(jax.vmap(jax.vmap(f, (None, 0, 0)), (0, None, None)))(g, angle, along), np.float64)
        for f in (lambda g, angle, _: value(g, angle), lambda g, angle, _: by_g(g, angle), by_gap)
    ]


@pytest.mark.parametrize("pole", ["forward", "backward"])
def test_henyey_greenstein_keeps_its_digits_in_float32(pole):
    single = _value_and_derivatives(jnp.float32, pole)
    with jax.enable_x64(True):
        double = _value_and_derivatives(jnp.float64, pole)
    # A few roundings of 6e-8 each; measured 3.5e-7.
    np.testing.assert_allclose(single[0], double[0], rtol=1e-6)
    np.testing.assert_allclose(single[2], double[2], rtol=1e-6)
    # The derivative in g has a zero, where a gap of float32 fixes it only up to that of `p / (1 - |g|)`, its size on both sides.
    size = np.abs(double[1]) + double[0] / (1.0 - np.abs(ASYMMETRIES.astype(float)))[:, None]
    assert np.max(np.abs(single[1] - double[1]) / size) < 1e-6


def test_directions_keep_the_digits_of_small_angles():
    w_i = np.array([0.36, 0.48, 0.8])
    side = np.array([0.8, -0.6, 0.0])
    angles = np.concatenate([[0.0], np.geomspace(1e-5, 3.0, 30)])
    # Rounded first: both precisions see the same directions, whose lengths are 1 only up to rounding.
    w_o = (-np.cos(angles) * w_i[:, None] + np.sin(angles) * side[:, None]).astype(np.float32)
    w_i = np.broadcast_to(w_i.astype(np.float32)[:, None], w_o.shape)

    def values(dtype):
        directions = (tuple(jnp.asarray(w, dtype)) for w in (w_o, w_i))
        angle = ScatteringAngle.between(*directions)
        return [np.asarray(henyey_greenstein(jnp.asarray(g, dtype), angle), float) for g in ASYMMETRIES]

    single = values(jnp.float32)
    with jax.enable_x64(True):
        double = values(jnp.float64)
    np.testing.assert_allclose(single, double, rtol=1e-6)


def test_forward_is_where_light_goes_on():
    w_i = tuple(jnp.asarray([0.6, 0.0, 0.8]))
    away = tuple(-w for w in w_i)
    lobe = HenyeyGreenstein(0.9)
    (forward,), (backward,) = (lobe.evaluate(ScatteringAngle.between(w_o, w_i)) for w_o in (away, w_i))
    assert forward > 1000 * backward


FINITE = {
    "hg": lambda x: HenyeyGreenstein(x),
    "double hg": lambda x: DoubleHenyeyGreenstein(x, -x, 0.5 + 0.5 * x),
    "schlick": lambda x: Schlick(x),
    "draine": lambda x: Draine(x, 1.0 + x),
    "droplets": lambda x: JendersieEon(30.0 + 20.0 * x),
    "table": lambda x: TabulatedPhase(ANGLES, x * x * BUMPY + 1e-3),
    "mixture": lambda x: Mixture([Isotropic(), Rayleigh(), Schlick(x)], jnp.stack([1.0 + x, x * x, 1.0 - x])),
}


@pytest.mark.parametrize("name", FINITE)
def test_values_and_derivatives_are_finite_at_extremes(name):
    w_i = tuple(jnp.asarray([0.0, 0.6, 0.8]))
    aside = [(0.0, -0.6, -0.8), (0.0, 0.6, 0.8), (1.0, 0.0, 0.0), (1e-4, -0.6, -0.8)]
    w_o = tuple(jnp.asarray(aside, jnp.float32).T)
    # The neighbours of 1 are there, and 1 itself, which only a traced parameter can be.
    x = jnp.asarray([-1.0, -0.99999994, -0.9999, -1e-20, 0.0, 1e-20, 0.5, 0.9999, 0.99999994, 1.0], jnp.float32)

    def value(x, w_o):
        return FINITE[name](x).evaluate(ScatteringAngle.between(w_o, w_i))[0]

    over = lambda f: jax.jit(jax.vmap(jax.vmap(f, (None, 0)), (0, None)))(x, w_o)
    forward = lambda x, w_o: jax.jvp(value, (x, w_o), (jnp.ones_like(x), tuple(jnp.ones_like(w) for w in w_o)))
    for f in (value, jax.grad(value, (0, 1)), forward):
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(over(f)))
    u = jnp.asarray([0.0, 1e-7, 0.5, 1.0 - 6e-8], jnp.float32)
    drawn = jax.jit(jax.vmap(lambda x: FINITE[name](x).sample(u)))(x)
    assert np.all(np.isfinite(drawn))
    assert np.all(np.minimum(drawn.one_minus, drawn.one_plus) >= 0)


def test_derivatives_at_no_asymmetry():
    c = jnp.linspace(-1.0, 1.0, 9)
    angle = ScatteringAngle.of_cosine(c)
    tangent = lambda make: jax.jvp(lambda g: make(g).evaluate(angle)[0], (jnp.asarray(0.0),), (jnp.asarray(1.0),))[1]
    # p = (1 + 3 g cos + ...) / (4 pi), and (1 + 2 k cos + ...) / (4 pi).
    np.testing.assert_allclose(tangent(HenyeyGreenstein), 3 * c / (4 * np.pi), atol=1e-7)
    np.testing.assert_allclose(tangent(Schlick), 2 * c / (4 * np.pi), atol=1e-7)


def _values(phase):
    angle = ScatteringAngle.of_cosine(jnp.linspace(-1.0, 1.0, 101))
    return np.stack(eqx.filter_jit(type(phase).evaluate)(phase, angle))


def test_closed_forms(x64):
    c = np.linspace(-1.0, 1.0, 101)
    np.testing.assert_allclose(_values(Isotropic()), np.full((1, 101), 1 / (4 * np.pi)))
    np.testing.assert_allclose(_values(Rayleigh()), 3 / (16 * np.pi) * (1 + c**2)[None])
    hg = lambda g: (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * c) ** 1.5)
    for g in (-0.8, 0.0, 0.4):
        np.testing.assert_allclose(_values(HenyeyGreenstein(g))[0], hg(g), rtol=1e-12)
        np.testing.assert_allclose(_values(Schlick(g))[0], (1 - g * g) / (4 * np.pi * (1 - g * c) ** 2), rtol=1e-12)
    # The paper's four formulas at 10 micrometres.
    g_hg, g_d, alpha, w = 0.988176691700256, 0.5556712547839497, 21.995520856274638, 0.4819554318404214
    droplets = (1 - w) * hg(g_hg) + w * hg(g_d) * (1 + alpha * c * c) / (1 + alpha * (1 + 2 * g_d**2) / 3)
    np.testing.assert_allclose(_values(JendersieEon(10.0))[0], droplets, rtol=1e-12)


def test_special_cases_agree(x64):
    same = lambda a, b: np.testing.assert_allclose(_values(a), _values(b), rtol=1e-12)
    same(HenyeyGreenstein(0.0), Isotropic())
    same(Schlick(0.0), Isotropic())
    same(DoubleHenyeyGreenstein(0.7, 0.7, 0.3), HenyeyGreenstein(0.7))
    same(DoubleHenyeyGreenstein(0.7, -0.2, 1.0), HenyeyGreenstein(0.7))
    same(Draine(0.7, 0.0), HenyeyGreenstein(0.7))
    same(Draine(0.0, 1.0), Rayleigh())
    same(Mixture([HenyeyGreenstein(0.7), HenyeyGreenstein(-0.2)], [1.0, 3.0]), DoubleHenyeyGreenstein(0.7, -0.2, 0.25))
    same(TabulatedPhase([0.0, np.pi], [5.0, 5.0]), Isotropic())
    u = jnp.linspace(0.0, 1.0, 101)
    for special, general in ((HenyeyGreenstein(-0.7), Draine(-0.7, 0.0)), (Rayleigh(), Draine(0.0, 1.0))):
        np.testing.assert_allclose(special.sample(u), general.sample(u), atol=1e-12)


def test_components_are_those_of_each_colour():
    """To rounding: programs for one and for three colours are compiled apart."""
    g, k = [-0.5, 0.0, 0.9], [0.2, 0.3, 0.4]
    same = lambda coloured, grey, c: np.testing.assert_allclose(_values(coloured)[c], _values(grey)[0], rtol=1e-6)
    for c in range(3):
        same(HenyeyGreenstein(g), HenyeyGreenstein(g[c]), c)
        same(Schlick(k), Schlick(k[c]), c)
        same(DoubleHenyeyGreenstein(g, 0.3, k), DoubleHenyeyGreenstein(g[c], 0.3, k[c]), c)
        same(TabulatedPhase(ANGLES, COLOURED), TabulatedPhase(ANGLES, COLOURED[:, c]), c)
        mixed = Mixture([HenyeyGreenstein(g), Isotropic()], [[1, 2, 3], [4, 5, 6]])
        same(mixed, Mixture([HenyeyGreenstein(g[c]), Isotropic()], [1 + c, 4 + c]), c)


def test_droplets_scatter_as_far_forward_as_clouds_do():
    # Mie theory gives water clouds in visible light a mean cosine of about 0.85, more for larger droplets.
    means = [float(JendersieEon(d).mean_cosine[0]) for d in (5.0, 10.0, 20.0, 50.0)]
    assert 0.8 < means[0] < means[1] < means[2] < means[3] < 0.9


def test_a_fine_table_converges_in_second_order(x64):
    wanted = _values(HenyeyGreenstein(0.5))
    errors = []
    for n in (51, 101, 201):
        angles = np.linspace(0.0, np.pi, n)
        table = TabulatedPhase(angles, 7.0 * HenyeyGreenstein(0.5).evaluate(ScatteringAngle.of_cosine(jnp.cos(angles)))[0])
        errors.append(np.max(np.abs(_values(table) / wanted - 1)))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(orders > 1.7)
    assert errors[-1] < 1e-3


def test_tables_keep_the_digits_of_narrow_peaks():
    near = np.concatenate([[0.0], np.geomspace(1e-4, 1.5, 40)])
    angles = np.concatenate([near, np.pi - near[::-1]]).astype(np.float32)
    values = 1.0 + 1e6 * np.exp(-(np.minimum(angles, np.pi - angles) / 1e-3)).astype(np.float32)
    # Between the entries, near each pole.
    gaps = (2 * np.sin(0.25 * (near[1:] + near[:-1])) ** 2).astype(np.float32)

    def evaluate(dtype):
        near, far = jnp.asarray(gaps, dtype), jnp.asarray(2.0 - gaps.astype(float), dtype)
        table = TabulatedPhase(jnp.asarray(angles, dtype), jnp.asarray(values, dtype))
        return [np.asarray(table.evaluate(ScatteringAngle.of_gaps(*gaps))[0], float) for gaps in ((near, far), (far, near))]

    single = evaluate(jnp.float32)
    with jax.enable_x64(True):
        double = evaluate(jnp.float64)
    np.testing.assert_allclose(single[0], double[0], rtol=1e-5)
    np.testing.assert_allclose(single[1], double[1], rtol=1e-5)


def test_derivatives_of_a_table_are_those_of_finite_differences(x64):
    angle = ScatteringAngle.of_cosine(jnp.linspace(-0.97, 0.98, 12))
    weights = jnp.linspace(1.0, 2.0, 12)
    loss = jax.jit(lambda values: jnp.sum(weights * TabulatedPhase(ANGLES, values).evaluate(angle)[0]))
    values, step = jnp.asarray(BUMPY + 0.1), 1e-5
    differences = [(loss(values + step * e) - loss(values - step * e)) / (2 * step) for e in np.eye(values.size)]
    # Central differences: an error of step squared.
    np.testing.assert_allclose(jax.grad(loss)(values), differences, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(jax.jacfwd(loss)(values), differences, rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("name", [name for name in FINITE if name != "table"])
def test_derivatives_of_parameters_are_those_of_finite_differences(x64, name):
    angle = ScatteringAngle.of_cosine(jnp.linspace(-1.0, 1.0, 7))
    value = lambda x: FINITE[name](x).evaluate(angle)[0]
    over, x = jax.jit(jax.vmap(value)), jnp.asarray([-0.6, 0.4])
    differences = (over(x + 1e-6) - over(x - 1e-6)) / 2e-6
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.jacrev(value)))(x), differences, rtol=1e-6, atol=1e-9)


ERRORS = {
    "g of 1": (lambda: HenyeyGreenstein(1.0), "g must be between -1 and 1"),
    "g of -1 in one channel": (lambda: HenyeyGreenstein([0.0, -1.0, 0.0]), "g must be between -1 and 1"),
    "g NaN": (lambda: HenyeyGreenstein(np.nan), "g must be between -1 and 1"),
    "two channels": (lambda: HenyeyGreenstein([0.0, 0.1]), "must be () or (3,)"),
    "g2 too large": (lambda: DoubleHenyeyGreenstein(0.1, 1.5, 0.5), "g2 must be between"),
    "weight above 1": (
        lambda: DoubleHenyeyGreenstein(0.1, 0.5, 1.5),
        "weight must be in [0, 1] (share of the first lobe), not 1.5",
    ),
    "k of 1": (lambda: Schlick(1.0), "k must be between -1 and 1"),
    "negative alpha": (lambda: Draine(0.5, -1.0), "alpha must be finite and not negative"),
    "small droplets": (lambda: JendersieEon(1.0), "diameter must be in [5, 50] (of the droplets, in micrometres)"),
    "large droplets": (lambda: JendersieEon(51.0), "diameter must be in [5, 50] (of the droplets, in micrometres)"),
    "nothing to mix": (lambda: Mixture([], []), "phases must not be empty"),
    "weights of other length": (lambda: Mixture([Isotropic()], [1.0, 2.0]), "weights has shape"),
    "negative weight": (lambda: Mixture([Isotropic(), Rayleigh()], [1.0, -1.0]), "weights must be finite and not negative"),
    "no weight": (lambda: Mixture([Isotropic(), Rayleigh()], [0.0, 0.0]), "positive weight"),
    "one angle": (lambda: TabulatedPhase([0.0], [1.0]), "angles must have at least 2 entries"),
    "angles fall": (lambda: TabulatedPhase([np.pi, 0.0], [1.0, 1.0]), "strictly increasing"),
    "angles repeat": (lambda: TabulatedPhase([0.0, 1.0, 1.0, np.pi], np.ones(4)), "remove duplicates"),
    "degrees": (lambda: TabulatedPhase([0.0, 180.0], [1.0, 1.0]), "numpy.deg2rad"),
    "no backward end": (lambda: TabulatedPhase([0.0, 3.0], [1.0, 1.0]), "from 0 to pi"),
    "negative value": (lambda: TabulatedPhase([0.0, np.pi], [1.0, -1.0]), "values must be finite and not negative"),
    "dark table": (lambda: TabulatedPhase([0.0, np.pi], [[0.0, 1.0, 1.0]] * 2), "values must not all be zero"),
    "values of other length": (lambda: TabulatedPhase([0.0, np.pi], [1.0, 1.0, 1.0]), "values has shape"),
}


@pytest.mark.parametrize("name", ERRORS)
def test_errors_say_what_is_wrong_in_one_line(name):
    call, says = ERRORS[name]
    with pytest.raises(ValueError, match=re.escape(says)) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 200
