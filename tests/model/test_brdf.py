"""Material functions: what a white furnace returns, reciprocity, closed forms, and derivatives at ordinary and extreme directions."""

import math
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jvr
from jvr.model.microfacet import ggx, reflectances, visibility

# By parameters that a test can differentiate in; made when called, so double in a test in double precision.
MADE = {
    "lambert": (lambda p: jvr.LambertBRDF(p[:3]), [0.2, 0.5, 0.9]),
    "phong": (lambda p: jvr.PhongBRDF(p[0], p[1:4], p[4]), [0.6, 0.1, 0.2, 0.4, 12.0]),
    "blinn": (lambda p: jvr.BlinnPhongBRDF(p[0], p[1:4], p[4]), [0.6, 0.1, 0.2, 0.4, 12.0]),
    "microfacet": (lambda p: jvr.MicrofacetBRDF(p[:3], p[3], p[4], p[5]), [0.9, 0.5, 0.2, 0.3, 0.45, 0.08]),
    "phase": (lambda p: jvr.PhaseBRDF(jvr.HenyeyGreenstein(p[0]), p[1:4]), [0.4, 0.9, 0.5, 0.2]),
    "merl": (lambda p: jvr.MerlBRDF(jnp.reshape(p, (2, 2, 3, 3))), list(0.1 + 0.01 * np.arange(36))),
}
SURFACES = [name for name in MADE if name != "phase"]


def towards(degrees, azimuth=0.0):
    """A unit direction at an angle from the normal, as three arrays of any shape."""
    theta, phi = np.radians(degrees), np.radians(azimuth)
    return tuple(jnp.asarray(c) for c in (np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi))


def sphere(n=160):
    """Directions and weights whose sum is 4 pi: Gauss' rule in each half of the angle to the normal, even turns."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    theta = np.concatenate([0.25 * np.pi * (nodes + 1), 0.25 * np.pi * (nodes + 3)])
    weight = np.tile(0.25 * np.pi * weights, 2) * np.sin(theta) * (np.pi / n)
    azimuth = np.pi * (np.arange(2 * n) + 0.5) / n
    return towards(np.degrees(theta)[:, None], np.degrees(azimuth)), jnp.asarray(weight)[:, None]


def pseudorandom_directions(n, seed, upper=False):
    w = np.random.default_rng(seed).normal(size=(3, n))
    w /= np.linalg.norm(w, axis=0)
    return tuple(jnp.asarray(c) for c in (w[0], w[1], abs(w[2]) if upper else w[2]))


@eqx.filter_jit
def furnace(brdf, degrees):
    """The share of even light that is reflected at each of some angles to the normal: tinted and unmodulated, summed, first component."""
    w_i, weight = sphere()

    def at(angle):
        parts = brdf.evaluate((jnp.sin(angle), jnp.zeros_like(angle), jnp.cos(angle)), w_i)
        return sum(jnp.sum(part[0] * weight) for part in parts if part)

    return jax.lax.map(at, jnp.radians(degrees))


def total(brdf, w_o, w_i):
    """All components of both parts in one array."""
    tinted, unmodulated = brdf.evaluate(w_o, w_i)
    return jnp.stack([jnp.broadcast_to(c, jnp.broadcast_shapes(w_o[2].shape, w_i[2].shape)) for c in (*tinted, *unmodulated)])


# --- Energy ----------------------------------------------------------------------------------------------------------

ANGLES = jnp.asarray([0.0, 20.0, 45.0, 70.0, 80.0])


def test_lambert_returns_its_reflectance(x64):
    np.testing.assert_allclose(furnace(jvr.LambertBRDF(0.7), ANGLES), np.full(5, 0.7), rtol=1e-6)


def test_a_phase_function_returns_its_albedo(x64):
    np.testing.assert_allclose(furnace(jvr.PhaseBRDF(jvr.HenyeyGreenstein(0.6), 0.8), ANGLES), np.full(5, 0.8), rtol=1e-6)


@pytest.mark.parametrize("make", [jvr.PhongBRDF, jvr.BlinnPhongBRDF])
@pytest.mark.parametrize("exponent", [0.0, 1.0, 5.0, 30.0])
def test_glossy_lobes_return_all_from_above_and_never_more(x64, make, exponent):
    reflected = np.asarray(furnace(make(0.3, 0.6, exponent), ANGLES))
    # Quadrature over the edge of the lobe of a small exponent: a few 1e-5.
    np.testing.assert_allclose(reflected[0], 0.9, rtol=1e-4)
    assert np.all(reflected < 0.9001)
    assert np.all(np.diff(reflected) < 1e-4)


def test_exponent_0_is_lambert(x64):
    w_o, w_i = pseudorandom_directions(50, 0, upper=True), pseudorandom_directions(50, 1)
    diffuse = jvr.LambertBRDF(0.4).evaluate(w_o, w_i)[0][0]
    np.testing.assert_allclose(jvr.BlinnPhongBRDF(0.0, 0.4, 0.0).evaluate(w_o, w_i)[1][0], diffuse, rtol=1e-12)


@pytest.mark.parametrize("roughness", [0.3, 0.5, 0.7, 1.0])
def test_coated_white_returns_everything(x64, roughness):
    # The table of shares, linear between 64 angles, and this quadrature: 0.1 % each.
    for f0 in (0.0, 0.04, 0.5):
        reflected = furnace(jvr.MicrofacetBRDF(roughness=roughness, reflectance_at_normal=f0), ANGLES)
        np.testing.assert_allclose(reflected, np.ones(5), atol=2e-3)


def test_white_metal_loses_what_bounces_between_mirrors(x64):
    lost = [1 - np.asarray(furnace(jvr.MicrofacetBRDF(metallic=1.0, roughness=r), ANGLES)) for r in (0.3, 0.5, 0.7, 1.0)]
    assert np.all(np.asarray(lost) > -1e-4)
    # Single scattering of white GGX microfacets seen straight: published tables have 1 %, 8 %, 30 % and 69 %.
    np.testing.assert_allclose([loss[0] for loss in lost], [0.0093, 0.084, 0.302, 0.693], atol=0.002)


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
def test_mirrors_cover_the_surface_and_each_view_of_it(x64, alpha):
    """The integral of D cos is 1; so is that of the microfacets seen from anywhere, `G1 max(w_o . h, 0) D / cos` (weak white furnace)."""
    # In the tangent over alpha, D is one rational function for every alpha; the last variable maps 0 ... 1 to all of it.
    u, weights = np.polynomial.legendre.leggauss(200)
    u, weights = 0.5 * (u + 1), 0.5 * weights
    tangent = alpha * u / (1 - u)
    cos = 1 / np.sqrt(1 + tangent**2)
    weight = weights * alpha / (1 - u) ** 2 * tangent * cos**3 * (np.pi / 100)
    h = towards(np.degrees(np.arctan(tangent))[:, None], 1.8 * (np.arange(200) + 0.5))
    area = np.asarray(ggx(h, jnp.asarray(alpha))) * weight[:, None]
    np.testing.assert_allclose(np.sum(area * cos[:, None]), 1.0, rtol=1e-8)
    for degrees in (0.0, 40.0, 75.0):
        w_o = towards(degrees)
        # Masking alone is masking and shadowing of light from the normal, which casts no shadow.
        masking = 4 * w_o[2] * visibility(w_o[2], jnp.asarray(1.0), jnp.asarray(alpha))
        seen = sum(np.asarray(w) * np.asarray(c) for w, c in zip(w_o, h, strict=True))
        # The edge of the visible half costs the even rule in the turn its order.
        np.testing.assert_allclose(np.sum(area * np.maximum(seen, 0) * masking / w_o[2]), 1.0, rtol=2e-4)


# Smoother microfacets need a finer quadrature than the furnace's.
@pytest.mark.parametrize("alpha", [0.25, 0.5, 1.0])
def test_table_of_shares_is_the_integral(x64, alpha):
    cosine, a, b = (np.asarray(t) for t in reflectances(jnp.asarray(alpha)))
    degrees = np.degrees(np.arccos(cosine[[20, 40, 63]]))
    white = furnace(jvr.MicrofacetBRDF(0.0, 1.0, np.sqrt(alpha)), jnp.asarray(degrees))
    np.testing.assert_allclose((a + b)[[20, 40, 63]], white, atol=2e-3)
    # Without a reflectance straight on, a coat over black reflects B alone.
    clear = furnace(jvr.MicrofacetBRDF(0.0, 0.0, np.sqrt(alpha), 0.0), jnp.asarray(degrees))
    np.testing.assert_allclose(b[[20, 40, 63]], clear, atol=1e-3)


def test_roughest_mirrors_have_a_closed_form(x64):
    """At `alpha = 1` D is even, and light straight down is reflected by the share `1 - log 2`."""
    _, a, b = reflectances(jnp.asarray(1.0))
    np.testing.assert_allclose((a + b)[-1], 1 - np.log(2), atol=1e-3)


@pytest.mark.slow
def test_metal_is_tinted_and_its_rim_is_not():
    metal = jvr.MicrofacetBRDF(metallic=1.0, roughness=0.4)
    share = lambda w_o, w_i: [float(part[0]) for part in metal.evaluate(w_o, w_i)]
    tinted, unmodulated = share(towards(10.0), towards(10.0, 180.0))
    assert unmodulated < 1e-3 * tinted
    tinted, unmodulated = share(towards(89.0), towards(89.0, 180.0))
    assert unmodulated > 5 * tinted


# --- Symmetry --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SURFACES)
def test_light_goes_both_ways(x64, name):
    make, parameters = MADE[name]
    brdf = make(jnp.asarray(parameters))
    w_o, w_i = pseudorandom_directions(200, 0, upper=True), pseudorandom_directions(200, 1, upper=True)
    np.testing.assert_allclose(total(brdf, w_o, w_i) / w_i[2], total(brdf, w_i, w_o) / w_o[2], rtol=1e-9)


@pytest.mark.parametrize("name", MADE)
def test_a_turn_about_the_normal_changes_nothing(x64, name):
    make, parameters = MADE[name]
    brdf = make(jnp.asarray(parameters))
    w_o, w_i = pseudorandom_directions(200, 2), pseudorandom_directions(200, 3)
    turn = lambda w: (0.6 * w[0] - 0.8 * w[1], 0.8 * w[0] + 0.6 * w[1], w[2])
    np.testing.assert_allclose(total(brdf, turn(w_o), turn(w_i)), total(brdf, w_o, w_i), rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("name", MADE)
def test_what_a_material_turns_with_is_true(x64, name):
    make, parameters = MADE[name]
    brdf = make(jnp.asarray(parameters))
    w_o, w_i = pseudorandom_directions(100, 4, upper=True), pseudorandom_directions(100, 5, upper=True)
    other = pseudorandom_directions(100, 6, upper=True)
    # Both directions rolled over to the side: the angle between them stays, those to the normal do not.
    roll = lambda w: (w[2], w[0], w[1])
    same_normal = np.allclose(total(brdf, w_o, w_i), total(brdf, other, w_i))
    same_angle = np.allclose(total(brdf, w_o, w_i), total(brdf, roll(w_o), roll(w_i)))
    assert (same_normal, same_angle) == {"normal": (True, False), "eye": (False, True), "both": (False, False)}[
        brdf.symmetry_axis
    ]


@pytest.mark.parametrize("name", MADE)
def test_components_and_shapes(name):
    make, parameters = MADE[name]
    brdf = make(jnp.asarray(parameters))
    one = total(brdf, *(tuple(c[7] for c in pseudorandom_directions(9, s)) for s in (1, 2)))
    w_o, w_i = (tuple(c.reshape(shape) for c in pseudorandom_directions(9, s)) for s, shape in ((1, (9, 1)), (2, (1, 9))))
    tinted, unmodulated = brdf.evaluate(w_o, w_i)
    assert len(tinted) in (0, 1, 3)
    assert len(unmodulated) in (0, 1, 3)
    np.testing.assert_allclose(total(brdf, w_o, w_i)[:, 7, 7], one, rtol=1e-5)


@pytest.mark.parametrize("name", SURFACES)
def test_nothing_comes_from_below(name):
    make, parameters = MADE[name]
    w_o, w_i = pseudorandom_directions(50, 7, upper=True), pseudorandom_directions(50, 8, upper=True)
    below = (w_i[0], w_i[1], -w_i[2])
    assert np.all(np.asarray(total(make(jnp.asarray(parameters)), w_o, below)) == 0)


# --- Derivatives and extremes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MADE)
def test_derivatives_are_those_of_finite_differences(x64, name):
    make, parameters = MADE[name]
    w_o, w_i = pseudorandom_directions(12, 9, upper=True), pseudorandom_directions(12, 10)

    def value(x):
        p, moved = x[:-6], x[-6:]
        shifted = [tuple(c + d for c, d in zip(w, moved[i : i + 3], strict=True)) for i, w in ((0, w_o), (3, w_i))]
        return total(make(p), *shifted)

    x = jnp.concatenate([jnp.asarray(parameters, float), jnp.zeros(6)])
    step = 1e-6
    over = jax.jit(jax.vmap(value))
    differences = (over(x + step * jnp.eye(x.size)) - over(x - step * jnp.eye(x.size))) / (2 * step)
    # Central differences in double precision: 1e-10 of rounding over the step, and the step squared.
    for jacobian in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(np.moveaxis(jax.jit(jacobian(value))(x), -1, 0), differences, rtol=1e-5, atol=1e-7)


def extreme_directions():
    """Pairs of `w_o` and `w_i`: straight, grazing, the same, opposite, mirrored, below."""
    tiny, up, low = [1e-4, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 1e-7]
    side, slant = [1.0, 0.0, 0.0], [0.6, 0.0, 0.8]
    flat = [float(np.sqrt(1 - 1e-6)), 0.0, 1e-3]
    mirrored = lambda w: [-w[0], -w[1], w[2]]
    opposite = lambda w: [-c for c in w]
    pairs = [(w, f(w)) for w in (up, slant, flat, low, side, tiny) for f in (list, mirrored, opposite)]
    pairs += [(up, flat), (flat, up), (low, up), (up, low), (side, up), (slant, opposite(up)), (opposite(slant), slant)]
    return [tuple(jnp.asarray(c, jnp.float32) for c in np.transpose(w)) for w in zip(*pairs, strict=True)]


EXTREMES = {
    "lambert": (lambda x: jvr.LambertBRDF(x), [0.0, 1e-30, 1.0]),
    "phong": (lambda x: jvr.PhongBRDF(1.0, 1.0, x), [0.0, 1e-10, 0.5, 1.0, 1e3, 1e7]),
    "blinn": (lambda x: jvr.BlinnPhongBRDF(1.0, 1.0, x), [0.0, 1e-10, 0.5, 1.0, 1e3, 1e7]),
    "microfacet": (
        lambda x: jvr.MicrofacetBRDF(1.0, x[1], x[0], x[2]),
        [
            [r, metallic, f0]
            for r in (1e-3, 1e-2, 0.1, 1.0)
            for metallic, f0 in ((0.0, 0.04), (1.0, 0.04), (0.5, 0.0), (0.5, 1.0))
        ],
    ),
    "phase": (lambda x: jvr.PhaseBRDF(jvr.HenyeyGreenstein(x)), [-0.9999, 0.0, 0.9999]),
    "merl": (lambda x: jvr.MerlBRDF(x * jnp.reshape(jnp.arange(2 * 2 * 3 * 3.0), (2, 2, 3, 3))), [0.0, 1.0, 1e4]),
}


@pytest.mark.parametrize("name", EXTREMES)
def test_values_and_derivatives_are_finite_at_extremes(name):
    make, values = EXTREMES[name]
    w_o, w_i = extreme_directions()
    x = jnp.asarray(values, jnp.float32)
    value = lambda x, w_o, w_i: jnp.sum(total(make(x), w_o, w_i))
    each = lambda f: jax.vmap(f, (None, 0, 0))
    over = lambda f: jax.jit(jax.vmap(f, (0, None, None)))(x, w_o, w_i)
    forward = lambda *p: jax.jvp(value, p, jax.tree.map(jnp.ones_like, p))
    # In the parameter, the sum over directions: finite only where that of each of them is.
    reverse = jax.grad(lambda *p: jnp.sum(each(value)(*p)), (0, 1, 2))
    assert np.all(np.asarray(over(each(value))) >= 0)
    for f in (each(value), reverse, each(forward)):
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(over(f)))


@pytest.mark.parametrize("roughness", [1e-3, 1e-2, 0.3])
def test_mirrors_keep_their_digits_in_float32(roughness):
    """At and beside the peak, as wide as the lobe itself."""
    base = np.radians(40.0)
    aside = base + roughness**2 * np.linspace(-3, 3, 13)
    w_o = np.array([-np.sin(base), 0.0, np.cos(base)], np.float32)
    w_i = np.stack([np.sin(aside), 0 * aside, np.cos(aside)]).astype(np.float32)

    def values(dtype):
        w_os, w_is = (tuple(jnp.asarray(c, dtype) for c in w) for w in (w_o, w_i))
        return np.asarray(jvr.MicrofacetBRDF(0.0, 1.0, jnp.asarray(roughness, dtype)).evaluate(w_os, w_is)[0][0], float)

    single = values(jnp.float32)
    with jax.enable_x64(True):
        double = values(jnp.float64)
    # A half-way direction has an error of 6e-8, which a lobe of alpha = 1e-6 sees as a good part of its width.
    np.testing.assert_allclose(single, double, rtol=1e-5 + 0.3e-6 / roughness**2)


ERRORS = {
    "reflectance above 1": (lambda: jvr.LambertBRDF(1.5), "reflectance must be in [0, 1]"),
    "two channels": (lambda: jvr.LambertBRDF([0.1, 0.2]), "reflectance has shape (2,); it must be () or (3,)"),
    "negative specular": (lambda: jvr.PhongBRDF(0.5, -0.1), "specular must be in [0, 1]"),
    "negative exponent": (lambda: jvr.BlinnPhongBRDF(exponent=-1.0), "exponent must be finite and not negative"),
    "coloured exponent": (lambda: jvr.PhongBRDF(exponent=[1.0, 2.0, 3.0]), "exponent has shape (3,)"),
    "roughness 0": (lambda: jvr.MicrofacetBRDF(roughness=0.0), "roughness must be in [0.001, 1]"),
    "roughness NaN": (lambda: jvr.MicrofacetBRDF(roughness=np.nan), "roughness must be in [0.001, 1]"),
    "metallic 2": (lambda: jvr.MicrofacetBRDF(metallic=2.0), "metallic must be in [0, 1]"),
    "albedo above 1": (lambda: jvr.PhaseBRDF(jvr.Isotropic(), 1.1), "albedo must be in [0, 1]"),
}


@pytest.mark.parametrize("name", ERRORS)
def test_errors_say_what_is_wrong_in_one_line(name):
    call, says = ERRORS[name]
    with pytest.raises(ValueError, match=re.escape(says)) as caught:
        call()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("exponent", [1.0, 30.0])
@pytest.mark.parametrize(
    ("shading", "brdf", "scale"),
    [
        (jvr.Phong, jvr.PhongBRDF, lambda e: (e + 2) / (2 * math.pi)),
        (jvr.BlinnPhong, jvr.BlinnPhongBRDF, lambda e: (e + 2) * (e + 4) / (8 * math.pi * (2 ** (-e / 2) + e))),
    ],
)
def test_shading_and_materials_have_one_lobe_by_two_conventions(shading, brdf, scale, exponent, x64):
    """The power of a cosine: as it is, and with the fraction that it reflects and the cosine of the light."""
    w_o, w_i = (w / np.linalg.norm(w, axis=0) for w in np.random.default_rng(3).normal(size=(2, 3, 200)))
    w_o[2], w_i[2] = np.abs(w_o[2]), np.abs(w_i[2])
    half = (w_o + w_i) / np.linalg.norm(w_o + w_i, axis=0)
    cosine = half[2] if shading is jvr.BlinnPhong else np.sum(w_o * w_i * [[-1], [-1], [1]], axis=0)
    lobe = 0.4 * np.maximum(cosine, 0) ** exponent
    one, (w_o, w_i) = jnp.ones(()), (tuple(map(jnp.asarray, w)) for w in (w_o, w_i))
    surface, normal = shading(0.1, 0.5, 0.4, exponent), (0 * one, 0 * one, one)
    of_shading = jax.vmap(lambda w_o, w_i: surface.reflect(one, normal, w_o, w_i))(w_o, w_i)
    np.testing.assert_allclose(of_shading[0], 0.5 * w_i[2], rtol=1e-12)
    np.testing.assert_allclose(of_shading[1], lobe, rtol=1e-9, atol=1e-12)
    (diffuse,), (specular,) = brdf(0.5, 0.4, exponent).evaluate(w_o, w_i)
    np.testing.assert_allclose(diffuse, 0.5 * w_i[2] / math.pi, rtol=1e-12)
    np.testing.assert_allclose(specular, scale(exponent) * lobe * w_i[2], rtol=1e-9, atol=1e-12)
