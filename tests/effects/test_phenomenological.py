"""The phenomenological BSDF: its lobes and its samples against quadrature and statistics, Snell's law, and light through a slab."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from directions import chance, histogram, towards, triple
from scenes import render

import jvr

LOBES = {"diffuse": (0.6, 0.0, 0.0), "specular": (0.0, 0.7, 0.0), "transmissive": (0.0, 0.0, 0.8), "all": (0.3, 0.25, 0.4)}


def sphere(down=400, around=400):
    """Gauss-Legendre nodes in the cosine, on either side of the surface, and even ones around."""
    x, w = np.polynomial.legendre.leggauss(down // 2)
    cosine, weight = np.concatenate([(x - 1) / 2, (x + 1) / 2]), np.concatenate([w, w]) / 2
    azimuth = 2 * np.pi * (np.arange(around) + 0.5) / around
    z, phi = (a.ravel() for a in np.meshgrid(cosine, azimuth, indexing="ij"))
    sine = np.sqrt(1 - z * z)
    return (sine * np.cos(phi), sine * np.sin(phi), z), np.repeat(weight, around) * 2 * np.pi / around


@pytest.mark.parametrize("name", LOBES)
def test_lobes_integrate_to_their_shares(name, x64):
    """Straight down nothing is lost; of eyes at an angle what lies on the wrong side, which a quadrature of the cosine's power tells."""
    w_i, weight = sphere()
    lost = jvr.PhenomenologicalBSDF(*LOBES[name], s=3.0, q=6.0)
    down = np.sum(weight * np.asarray(lost.value(triple(towards(0)), triple(w_i))))
    np.testing.assert_allclose(down, sum(LOBES[name]), rtol=1e-6)
    w_o = towards(55)
    k_d, k_s, k_t = LOBES[name]
    right = lambda axis, e, side: np.sum(
        weight * np.where(side, np.maximum(np.tensordot(axis, np.stack(w_i), 1), 0) ** e, 0) * (e + 1) / (2 * np.pi)
    )
    mirrored, above = w_o * [-1, -1, 1], w_i[2] > 0
    expected = k_d + k_s * right(mirrored, 3.0, above) + k_t * right(-w_o, 6.0, ~above)
    found = np.sum(weight * np.asarray(lost.value(triple(w_o), triple(w_i))))
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert expected <= sum(LOBES[name]) + 1e-12


@pytest.mark.parametrize(("index", "polar"), [(None, 35.0), (1.5, 60.0), (0.7, 60.0)])
def test_samples_have_their_density(index, polar):
    """A chi-square test over 12 x 24 cells of the sphere, with what is on the wrong side as one more; in the last case all is reflected."""
    bsdf = jvr.PhenomenologicalBSDF(*LOBES["all"], s=4.0, q=9.0, index=index)
    w_o, n = towards(polar, 20.0), 200_000
    u = jax.random.uniform(jax.random.key(1), (3, n))
    w_i, right = jax.vmap(lambda *u: bsdf.sample(triple(w_o), u))(*u)
    x, y, z = (np.asarray(c, float) for c in w_i)
    np.testing.assert_allclose(x * x + y * y + z * z, 1.0, atol=1e-5)
    nodes, weight = sphere(240, 480)
    expected = histogram(nodes, weights=np.asarray(bsdf.pdf(triple(w_o), triple(nodes)), float) * weight)
    assert abs(expected.sum() - np.mean(right)) < 0.005
    assert chance(w_i, np.asarray(right), expected) > 1e-3


@pytest.mark.parametrize("index", [1.5, 1.0, 0.75])
def test_what_is_let_through_obeys_snells_law(index, x64):
    sharp = jvr.PhenomenologicalBSDF(0.0, 0.0, 1.0, q=1e6, index=index)
    for polar in (0.0, 20.0, 40.0):
        behind = math.degrees(math.asin(math.sin(math.radians(polar)) / index))
        found = sharp.value(triple(towards(polar)), triple(-towards(behind)))
        np.testing.assert_allclose(found, (1e6 + 1) / (2 * math.pi), rtol=1e-6)
        assert sharp.value(triple(towards(polar)), triple(-towards(behind + 1.0))) < 1e-20


def test_behind_the_critical_angle_all_is_reflected(x64):
    """Into the mirrored direction; just below it the lobe lies along the surface."""
    index, critical = 0.7, math.degrees(math.asin(0.7))
    bsdf = jvr.PhenomenologicalBSDF(0.0, 0.0, 1.0, q=50.0, index=index)
    at = towards(critical + 1)
    np.testing.assert_allclose(bsdf.value(triple(at), triple(at * [-1, -1, 1])), 51 / (2 * math.pi), rtol=1e-9)
    assert bsdf.value(triple(at), triple(-at)) == 0
    gradient = jax.grad(lambda i, polar: jvr.PhenomenologicalBSDF(0.1, 0.1, 0.8, index=i).value(triple(polar), triple(-polar)))
    for polar in (critical, critical - 1e-9, critical + 1e-9, 90.0, 0.0):
        assert np.isfinite(gradient(jnp.asarray(index), towards(polar)))


def test_derivatives_are_those_of_differences(x64):
    w_o, w_i = triple(towards(30, 10)), (triple(towards(35, 200)), triple(-towards(25, 15)))

    def function(x, normalised):
        bsdf = jvr.PhenomenologicalBSDF(x[0], x[1], x[2], x[3], x[4], x[5], normalised=normalised)
        normal = triple(towards(12, 70))
        return jnp.stack([part for w in w_i for part in (*bsdf.reflect(jnp.asarray(0.8), normal, w_o, w), bsdf.value(w_o, w))])

    x, h = jnp.array([0.3, 0.2, 0.4, 12.0, 7.0, 1.3]), 1e-6
    for normalised in (True, False):
        of = lambda x, normalised=normalised: function(x, normalised)
        forwards, backwards = jax.jacfwd(of)(x), jax.jacrev(of)(x)
        differences = np.stack([(of(x.at[i].add(h)) - of(x.at[i].add(-h))) / (2 * h) for i in range(6)], axis=1)
        np.testing.assert_allclose(forwards, differences, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(backwards, forwards, rtol=1e-12, atol=1e-14)
        assert np.all(np.abs(differences).max(axis=0) > 1e-4)


def slab(**given):
    """A ramp along z that is opaque at once, seen from above, with a light of irradiance 1 from a polar angle; its one colour."""

    def seen(polar):
        values = np.broadcast_to(np.linspace(1.0, 0.0, 9, dtype=np.float32), (4, 4, 9)).copy()
        transfer = jvr.LinearTransfer([0.0, 0.3, 0.31, 1.0], np.full((4, 3), 0.5), [0.0, 0.0, 500.0, 500.0])
        light = jvr.DirectionalLight(-towards(polar))
        scene = jvr.Scene(jvr.Volume(values), transfer, lights=(light,), shading=jvr.PhenomenologicalBSDF(**given))
        camera = jvr.OrthographicCamera.look_at([1.5, 1.5, 30.0], [1.5, 1.5, 0.0], [0, 1, 0], 1.0, 2, 2)
        return float(render(scene, camera, jvr.Settings(0.5)).rgb[0, 0, 0])

    return seen


@pytest.mark.slow
def test_pictures_show_the_notes_to_the_letter():
    seen = slab(k_d=0.4, k_s=0.3, k_t=0.2, s=5.0, q=3.0, normalised=False)
    for polar in (0.0, 40.0):
        c = math.cos(math.radians(polar))
        np.testing.assert_allclose(seen(polar), 0.5 * 0.4 * c + 0.3 * c**5, rtol=1e-3)
    # From behind, straight through: in the colour of the surface.
    np.testing.assert_allclose(seen(150.0), 0.5 * 0.2 * math.cos(math.radians(30.0)) ** 3, rtol=1e-3)
    np.testing.assert_allclose(slab(k_d=0.0, k_s=0.0, k_t=0.2, q=3.0)(180.0), 0.5 * 0.2 * 2, rtol=1e-3)


def test_numbers_out_of_range_are_refused():
    for given, said in (({"k_d": 1.5}, "k_d"), ({"s": -1.0}, "s "), ({"index": 0.0}, "index"), ({"q": np.nan}, "q ")):
        with pytest.raises(ValueError, match=said):
            jvr.PhenomenologicalBSDF(**given)
