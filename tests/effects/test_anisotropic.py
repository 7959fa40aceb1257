"""Anisotropic surfaces: their lobe by the slopes of microfacets and by quadrature, its samples by statistics, and its derivatives."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from directions import chance, histogram, towards, triple
from scenes import perspective, render

import jvr

# Not in the plane of the surface.
TILTED = (0.8, 0.36, 0.48)


def hemisphere(down, around):
    """Gauss-Legendre nodes in the square root of 1 - cosine, dense where the lobe is narrow, and even ones around: (n, 3), (n,)."""
    x, w = np.polynomial.legendre.leggauss(down)
    r, weight = (x + 1) / 2, w / 2
    cosine, weight = 1 - r**4, weight * 4 * r**3
    azimuth = 2 * np.pi * (np.arange(around) + 0.5) / around
    z, phi = (a.ravel() for a in np.meshgrid(cosine, azimuth, indexing="ij"))
    sine = np.sqrt(1 - z * z)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], axis=-1), np.repeat(weight, around) * 2 * np.pi / around


def covariance(direction, along, across):
    """Of slopes, in the plane of a surface that faces along z: the tensor of this model, restricted to it."""
    d = np.asarray(direction) / np.linalg.norm(direction)
    return (across**4 * np.eye(3) + (along**4 - across**4) * np.outer(d, d))[:2, :2]


def distribution(h, m):
    """GGX by the slopes of microfacets: a bivariate Student distribution of two degrees of freedom with the covariance `m`."""
    slopes = -h[..., :2] / h[..., 2:]
    length = np.einsum("...i,ij,...j", slopes, np.linalg.inv(m), slopes)
    return 1 / (np.pi * np.sqrt(np.linalg.det(m)) * (1 + length) ** 2) / h[..., 2] ** 4


def reference(w_o, w_i, m):
    """The lobe by Smith's masking with correlated heights, of which nothing but the area of microfacets that are seen is asked."""
    h, weight = hemisphere(300, 400)
    seen = lambda w: np.sum(weight * distribution(h, m) * np.maximum(h @ w, 0)) / w[2] - 1
    half = (w_o + w_i) / np.linalg.norm(w_o + w_i)
    return distribution(half, m) / (1 + seen(w_o) + seen(w_i)) / (4 * w_o[2])


@jax.jit
def evaluated(direction, roughness, normal, w_o, w_i):
    """The lobe of a surface that faces along z, and what one that is turned with all of it in the world reflects."""
    of = lambda d: jvr.AnisotropicGGX(d, diffuse=0.0, specular=0.9, roughness_along=roughness[0], roughness_across=roughness[1])
    turned = (triple(TURN @ w) for w in (normal, w_o, w_i))
    return of(direction).value(triple(w_o), triple(w_i)), of(TURN @ direction).reflect(jnp.ones(()), *turned)[1]


TURN = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
DIRECTIONS = {"in the plane": (0.6, 0.8, 0.0), "tilted": TILTED, "upright": (0.0, 0.0, 2.0)}


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
def test_the_lobe_is_that_of_the_slopes(direction, x64):
    """Whichever way is rougher, and of a surface that is turned in the world."""
    h, weight = hemisphere(200, 300)
    for roughness in ((0.3, 0.7), (0.8, 0.4), (0.5, 0.5)):
        m = covariance(direction, *roughness)
        np.testing.assert_allclose(np.sum(weight * distribution(h, m) * h[:, 2]), 1.0, rtol=1e-7)
        for w_o, w_i in (
            (towards(20, 30), towards(35, 190)),
            (towards(70, 100), towards(60, 250)),
            (towards(0), towards(80, 10)),
        ):
            wanted = 0.9 * reference(w_o, w_i, m)
            value, reflected = evaluated(np.asarray(direction), np.asarray(roughness), towards(0), w_o, w_i)
            np.testing.assert_allclose(value, wanted, rtol=1e-6)
            np.testing.assert_allclose(reflected, np.pi * wanted, rtol=1e-6)
            other, _ = evaluated(np.asarray(direction), np.asarray(roughness), towards(0), w_i, w_o)
            np.testing.assert_allclose(other / w_o[2], value / w_i[2], rtol=1e-12)


def test_of_one_roughness_it_is_isotropic(x64):
    """The lobe of `jvr.MicrofacetBRDF` without Fresnel's factor, at every angle, and Lambert's diffuse part."""
    rng = np.random.default_rng(3)
    w_o, w_i = (triple((v / np.linalg.norm(v, axis=1)[:, None]).T) for v in np.abs(rng.normal(size=(2, 50, 3))))

    @jax.jit
    def both(roughness):
        bsdf = jvr.AnisotropicGGX(TILTED, diffuse=0.4, specular=0.5, roughness_along=roughness, roughness_across=roughness)
        _, unmodulated = jvr.MicrofacetBRDF(0.0, 0.0, roughness, 1.0).evaluate(w_o, w_i)
        return bsdf.value(w_o, w_i), 0.5 * unmodulated[0] + 0.4 * w_i[2] / np.pi

    for roughness in (0.05, 0.4, 1.0):
        np.testing.assert_allclose(*both(jnp.asarray(roughness)), rtol=1e-10)


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
def test_samples_have_their_density(direction):
    """A chi-square test, with what falls below the surface as one cell more; no weight is above 1, and no more leaves than arrives."""
    bsdf = jvr.AnisotropicGGX(direction, diffuse=0.2, specular=0.8, roughness_along=0.4, roughness_across=0.8)
    w_o, n = triple(towards(65, 40)), 200_000
    u = jax.random.uniform(jax.random.key(1), (3, n))
    w_i, right = jax.jit(lambda u: bsdf.sample(w_o, tuple(u)))(u)
    np.testing.assert_allclose(np.sum(np.square(w_i), axis=0), 1.0, atol=1e-5)
    # Midpoints of 20 x 20 parts of each cell of the test.
    z, azimuth = (np.arange(240) + 0.5) / 240, np.pi * ((np.arange(480) + 0.5) / 240 - 1)
    z, azimuth = (a.ravel() for a in np.meshgrid(z, azimuth, indexing="ij"))
    nodes = triple((np.sqrt(1 - z * z) * np.cos(azimuth), np.sqrt(1 - z * z) * np.sin(azimuth), z))
    density, each = np.asarray(bsdf.pdf(w_o, nodes), float), 2 * np.pi / z.size
    expected = histogram(nodes, low=0.0, weights=density * each)
    assert abs(expected.sum() - np.mean(right)) < 0.005
    assert chance(w_i, np.asarray(right), expected, low=0.0) > 1e-3
    values = np.asarray(bsdf.value(w_o, nodes), float)
    assert np.all(values < density * (1 + 1e-5))
    # The mean weight of samples is what is reflected of light from everywhere.
    weights = np.where(right, bsdf.value(w_o, w_i) / bsdf.pdf(w_o, w_i), 0.0)
    assert abs(np.mean(weights) - np.sum(values) * each) < 5 * np.std(weights) / math.sqrt(n)
    assert 0.5 < np.mean(weights) < np.mean(right)


def reflected(x, w_o, w_i):
    """Of direction, normal, diffuse, specular, and both roughnesses, each as given."""
    normal = x[3:6] / jnp.linalg.norm(x[3:6])
    bsdf = jvr.AnisotropicGGX(x[:3], 0.1, x[6], x[7], x[8], x[9])
    return jnp.stack(bsdf.reflect(jnp.asarray(0.8), triple(normal), triple(w_o), triple(w_i)))


@pytest.mark.slow
def test_derivatives_are_those_of_differences(x64):
    """Also where there is no tangent, and where both roughnesses are the same, at which a fit may begin."""
    w_o, w_i, h = towards(30, 10), towards(40, 200), 1e-6
    of = jax.jit(lambda x: reflected(x, w_o, w_i))
    forwards, backwards = (jax.jit(d(lambda x: reflected(x, w_o, w_i))) for d in (jax.jacfwd, jax.jacrev))
    normal = towards(12, 70)
    for direction, roughness in ((TILTED, (0.3, 0.7)), (TILTED, (0.7, 0.3)), (TILTED, (0.5, 0.5)), (2 * normal, (0.3, 0.7))):
        x = jnp.asarray(np.concatenate([direction, normal, [0.6, 0.3], roughness]))
        differences = np.stack([(of(x.at[i].add(h)) - of(x.at[i].add(-h))) / (2 * h) for i in range(x.size)], axis=1)
        np.testing.assert_allclose(forwards(x), differences, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(backwards(x), forwards(x), rtol=1e-10, atol=1e-12)
        moved = np.abs(differences).max(axis=0) > 1e-5
        # Turning the direction at the pole, or one of a round lobe, changes nothing in the first order.
        assert np.all(moved[3:8])
        assert np.all(moved[8:]) or np.allclose(direction, 2 * normal)
        assert np.all(moved[:3]) == (direction is TILTED and roughness != (0.5, 0.5))


def test_extremes_are_finite():
    """In single precision, in value and derivatives: mirrors, one beside a diffuse surface, no normal, fibres that end, grazing light."""
    derivative = jax.jit(jax.vmap(lambda x, o, i: (reflected_or_none(x, o, i), jax.jacrev(reflected_or_none)(x, o, i))))
    cases = []
    for roughness in ((0.001, 0.001), (0.001, 1.0), (1.0, 0.001), (1.0, 1.0)):
        for normal in ((0, 0, 1), (0, 0, 0), (0, 0, -1), (1e-20, 0, 1), (0.6, 0, 0.8)):
            for direction in ((0, 0, 1), (1, 0, 0), (0.6, 0, 0.8), (1e-25, 0, 1)):
                for w_o, w_i in ((0, 0), (60, 60), (90, 90), (30, 210), (89.9999, 20), (0, 180)):
                    x = np.concatenate([direction, normal, [0.5, 0.5], roughness])
                    cases.append((x, towards(w_o), towards(w_i, 180)))
    values, gradients = derivative(*(np.stack(a).astype(np.float32) for a in zip(*cases, strict=True)))
    assert np.isfinite(values).all()
    assert np.isfinite(gradients).all()
    assert (np.asarray(values) >= 0).all()
    of = lambda r, d: jvr.AnisotropicGGX(d, 0.1, 0.0, 1.0, r[0], r[1]).sample(triple(towards(0)), (jnp.zeros(()),) * 3)[0]
    drawn = jax.jit(lambda r, d: (of(r, d), jax.jacfwd(of)(r, d)))
    for direction, *roughness in (((0, 0, 1), 0.001, 1.0), ((1, 0, 0), 0.001, 0.001), ((1, 0, 0), 1.0, 0.001)):
        found = drawn(jnp.asarray(roughness), jnp.asarray(direction, jnp.float32))
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))


def reflected_or_none(x, w_o, w_i):
    """As `reflected`, of a normal as it is."""
    bsdf = jvr.AnisotropicGGX(x[:3], 0.1, x[6], x[7], x[8], x[9])
    return jnp.stack(bsdf.reflect(jnp.asarray(0.8), triple(x[3:6]), triple(w_o), triple(w_i)))


def test_pictures_show_the_lobe():
    """A ramp along z that is opaque at once, seen from above under light of irradiance 1, with fibres along x and along y."""
    values = np.broadcast_to(np.linspace(1.0, 0.0, 9, dtype=np.float32), (4, 4, 9)).copy()
    transfer = jvr.LinearTransfer([0.0, 0.3, 0.31, 1.0], np.full((4, 3), 0.5), [0.0, 0.0, 500.0, 500.0])
    camera = jvr.OrthographicCamera.look_at([1.5, 1.5, 30.0], [1.5, 1.5, 0.0], [0, 1, 0], 1.0, 2, 2)
    light = towards(50, 0)
    for direction in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)):
        shading = jvr.AnisotropicGGX(direction, diffuse=0.4, specular=0.5, roughness_along=0.3, roughness_across=0.8)
        scene = jvr.Scene(jvr.Volume(values), transfer, lights=(jvr.DirectionalLight(-light),), shading=shading)
        lobe = np.pi * 0.5 * reference(towards(0), light, covariance(direction, 0.3, 0.8))
        found = render(scene, camera, jvr.Settings(0.5)).rgb[0, 0, 0]
        np.testing.assert_allclose(found, 0.5 * 0.4 * light[2] + lobe, rtol=1e-3)


@pytest.mark.slow
def test_a_fit_finds_fibres():
    """Their direction, up to its sign, and both roughnesses, from pictures of a ball."""
    x = np.arange(12) - 5.5
    ball = 6.0 - np.sqrt(sum(np.square(x).reshape(np.roll((12, 1, 1), k)) for k in range(3)))
    transfer = jvr.LinearTransfer([0.0, 1.0, 6.0], np.full((3, 3), 0.6), [0.0, 3.0, 3.0])
    lights = (jvr.DirectionalLight([1.0, -0.5, -0.6]), jvr.DirectionalLight([-0.4, 0.9, -0.7], [0.4, 0.7, 0.9]))
    of = lambda direction, *roughness: jvr.Scene(
        jvr.Volume(ball), transfer, lights=lights, shading=jvr.AnisotropicGGX(direction, 0.0, 0.4, 0.5, *roughness)
    )
    truth, start = of((0.6, 0.0, 0.8), 0.35, 0.8), of((0.0, 0.2, 1.0), 0.6, 0.6)
    cameras = [perspective(truth.volume, 12, 12, direction=d) for d in ((1, -0.6, 0.4), (-0.3, 1, 0.5), (-0.8, -0.7, 0.1))]
    settings = jvr.Settings(0.5)
    images = [render(truth, camera, settings).rgb for camera in cameras]
    unknowns = lambda s: (s.shading.direction, s.shading.roughness_along, s.shading.roughness_across)
    found = jvr.fit(start, cameras, images, unknowns=unknowns, settings=settings).scene.shading
    direction = np.asarray(found.direction) / np.linalg.norm(found.direction)
    np.testing.assert_allclose(direction * np.sign(direction[2]), [0.6, 0.0, 0.8], atol=1e-3)
    np.testing.assert_allclose([found.roughness_along, found.roughness_across], [0.35, 0.8], atol=1e-3)


def test_numbers_out_of_range_are_refused():
    for given, said in (
        ({"direction": (0, 0, 0)}, "direction must have a direction"),
        ({"roughness_along": 0.0}, r"roughness_along must be in \[0.001, 1\]"),
        ({"roughness_across": jvr.ByGradient([0, 1], [0.5, 2])}, r"roughness_across must be in \[0.001, 1\]"),
        ({"specular": -1.0}, "specular"),
    ):
        with pytest.raises(ValueError, match=said):
            jvr.AnisotropicGGX(**{"direction": (1, 0, 0), **given})
