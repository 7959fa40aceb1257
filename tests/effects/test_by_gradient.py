"""Coefficients by the length of the gradient: what a number would be where the gradient is such, its derivatives, and what is refused."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from directions import towards, triple
from scenes import linear_transfer, perspective, render, voxels

import jvr
from jvr.model.by_value import at_sample

COLOUR = np.array([0.9, 0.5, 0.2])
SUN, AMBIENT = jvr.DirectionalLight([-0.7, 0.2, -0.3]), jvr.AmbientLight(0.3)
# Steeper than where the coefficients end, between, and no gradient at all; per world length.
SLOPES = (0.5, 0.07, 0.0)


def ramp(slope):
    """Along x, in voxels that are twice as long there; wherever it is looked at, its gradient is the same."""
    values = 0.5 + slope * 2 * (np.arange(6) - 2.5)
    return jvr.Volume(np.broadcast_to(values[:, None, None], (6, 4, 4)), np.diag([2.0, 1.0, 1.0, 1.0]))


def kinds(coefficient):
    """Parts of scenes with every coefficient between two numbers, and whether they see a surface."""
    c = coefficient
    return {
        "medium": dict(
            shading=jvr.BlinnPhong(c(0.1, 0.9), c(0.2, 0.8), c(0.0, 0.5), c(1.0, 40.0)),
            scattering=jvr.SingleScattering(jvr.HenyeyGreenstein(c(-0.5, 0.7)), c(0.2, 1.0)),
        ),
        "scattering alone": dict(scattering=jvr.SingleScattering(jvr.Schlick(c(-0.5, 0.7)), c(0.2, 1.0))),
        "surface": dict(
            surfaces=jvr.Isosurfaces([0.5], [COLOUR]),
            shading=jvr.PhenomenologicalBSDF(c(0.1, 0.5), c(0.4, 0.2), c(0.0, 0.3), c(3.0, 40.0), c(2.0, 9.0)),
        ),
        "fibres": dict(
            surfaces=jvr.Isosurfaces([0.5], [COLOUR]),
            shading=jvr.AnisotropicGGX([0, 1, 2], c(0.1, 0.5), c(0.4, 0.2), c(0.1, 0.3), c(0.3, 0.8), c(0.7, 0.2)),
        ),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", ["medium", "scattering alone", "surface", "fibres"])
def test_it_is_a_number_where_the_gradient_is_one(name, x64):
    pictures = []
    for slope in SLOPES:
        at = lambda low, high, slope=slope: low + np.clip((slope - 0.02) / 0.1, 0, 1) * (high - low)
        for coefficient in (lambda low, high: jvr.ByGradient([0.02, 0.12], [low, high]), at):
            transfer = jvr.LinearTransfer([0.0, 1.0], [COLOUR, COLOUR], [0.2, 0.2])
            scene = jvr.Scene(ramp(slope), transfer, lights=(SUN, AMBIENT), **kinds(coefficient)[name])
            camera = jvr.OrthographicCamera.look_at([20, 2, 9], [5, 1.5, 1.5], [0, 0, 1], 1.0, 2, 2)
            pictures.append(np.asarray(render(scene, camera, jvr.Settings(0.4)).rgb))
    np.testing.assert_allclose(pictures[0::2], pictures[1::2], rtol=1e-10)
    # Each slope has a picture of its own, but for a surface that is not there.
    assert np.abs(pictures[0] - pictures[2]).max() > 0.01


def crooked(coefficient, surfaces):
    """A scene whose gradients differ from place to place."""
    parts = dict(surfaces=jvr.Isosurfaces([0.45], [COLOUR], tolerance=1e-6)) if surfaces else {}
    return jvr.Scene(
        jvr.Volume(voxels((4, 5, 4), seed=3)),
        linear_transfer(scale=0.1 if surfaces else 0.6),
        lights=(SUN, AMBIENT),
        shading=jvr.Phong(0.3, coefficient, 0.4, jvr.ByGradient([0.1, 0.9], [3.0, 20.0])),
        **parts,
    )


@pytest.mark.parametrize("surfaces", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_derivatives_are_those_of_differences(surfaces, x64):
    """In values, positions and voxels, along random directions; finite where nothing has a gradient."""
    scene = crooked(jvr.ByGradient([0.2, 0.5, 0.8], [0.2, 0.9, 0.4]), surfaces)
    where = lambda s: (s.shading.diffuse.values, s.shading.diffuse.positions, s.shading.shininess.positions, s.volume.values)
    camera, settings = perspective(scene.volume, 4, 3), jvr.Settings(0.5, skipping=False)
    weights = np.random.default_rng(0).random((3, 4, 3))
    loss = lambda arrays: jnp.sum(weights * jvr.render(eqx.tree_at(where, scene, arrays), camera, settings).rgb)
    base, rng, h = where(scene), np.random.default_rng(1), 1e-6
    backwards = jax.jit(jax.value_and_grad(loss))
    _, gradient = backwards(base)
    forwards = jax.jit(lambda t: jax.jvp(loss, (base,), (t,))[1])
    for i, x in enumerate(base):
        tangent = [jnp.zeros_like(y) for y in base]
        tangent[i] = jnp.asarray(rng.normal(size=x.shape))
        moved = lambda step, tangent=tangent: backwards(tuple(y + step * t for y, t in zip(base, tangent, strict=True)))[0]
        difference = (moved(h) - moved(-h)) / (2 * h)
        assert abs(difference) > 1e-3
        np.testing.assert_allclose(jnp.vdot(gradient[i], tangent[i]), difference, rtol=1e-5)
        np.testing.assert_allclose(forwards(tuple(tangent)), difference, rtol=1e-5)
    # Where nothing has a gradient they are finite, and the first coefficient, which is taken there, has the derivative of a difference.
    even = lambda first: (base[0].at[0].set(first), *base[1:3], jnp.full_like(base[3], 0.3))
    _, still = backwards(even(base[0][0]))
    assert all(np.isfinite(g).all() for g in still)
    difference = (backwards(even(base[0][0] + h))[0] - backwards(even(base[0][0] - h))[0]) / (2 * h)
    assert abs(difference) > 1e-3
    np.testing.assert_allclose(still[0], [difference, 0, 0], rtol=1e-5)


def test_drawn_directions_see_what_a_prefiltered_map_shows():
    """Notes, section 9.2.2: the exponent of the mirror is that of the gradient, by samples as by the map for the same exponent, and both as
    the mean of a linear radiance over a lobe, `1 + (s + 1) / (s + 2) a . r`. Listing 9.4 takes the length itself for a weight of its
    lobe and does not divide by the sum of its cosines."""
    a, n = np.array([0.3, -0.4, 0.5]), 40_000
    bsdf = jvr.PhenomenologicalBSDF(0.0, 1.0, 0.0, jvr.ByGradient([0.1, 0.5], [2.0, 50.0]))
    y, x = np.meshgrid(np.pi * (np.arange(64) + 0.5) / 64, 2 * np.pi * (0.5 - (np.arange(128) + 0.5) / 128), indexing="ij")
    chart = jvr.EnvironmentMap(
        1 + np.stack([np.sin(y) * np.sin(x), np.cos(y), np.sin(y) * np.cos(x)], axis=-1) @ a[:, None] * np.ones(3)
    )
    u = jax.random.uniform(jax.random.key(2), (3, n))
    drawn = jax.jit(lambda m: at_sample(bsdf, jnp.zeros(()), m).sample(triple(towards(0)), tuple(u)))
    seen_by, mirror = jax.jit(lambda d: chart.radiance(d)), jax.jit(lambda s: chart.prefiltered(s).radiance([[0, 0, 1]])[0, 0])
    for magnitude, exponent in ((0.05, 2.0), (0.3, 26.0), (3.0, 50.0)):
        w_i, above = drawn(magnitude)
        assert above.all()
        seen = np.asarray(seen_by(np.stack(w_i, axis=1))[:, 0], float)
        wanted = 1 + (exponent + 1) / (exponent + 2) * a[2]
        assert abs(seen.mean() - wanted) < 4 * seen.std() / math.sqrt(n)
        np.testing.assert_allclose(mirror(exponent), wanted, rtol=1e-3)


@pytest.mark.slow
def test_a_fit_finds_its_values():
    truth = crooked(jvr.ByGradient([0.2, 0.5, 0.8], [0.2, 0.9, 0.4]), False)
    start = crooked(jvr.ByGradient([0.2, 0.5, 0.8], [0.5, 0.5, 0.5]), False)
    cameras = [perspective(truth.volume, 6, 5, direction=d) for d in ((1.0, -0.6, 0.4), (-0.3, 1.0, 0.5))]
    images = [render(truth, camera, jvr.Settings(0.5)).rgb for camera in cameras]
    found = jvr.fit(start, cameras, images, unknowns=lambda s: s.shading.diffuse.values, settings=jvr.Settings(0.5))
    np.testing.assert_allclose(found.scene.shading.diffuse.values, [0.2, 0.9, 0.4], atol=1e-3)


def test_what_goes_with_it_is_said():
    by_gradient = jvr.ByGradient([0.0, 1.0], [0.2, 0.4])
    scene = jvr.Scene(ramp(0.1), linear_transfer(), lights=(SUN,), scattering=jvr.SingleScattering(albedo=by_gradient))
    assert "asked for by scattering" in str(jvr.plan(scene))
    assert not scene.replaced(scattering=jvr.SingleScattering()).needs_gradient
    with pytest.raises(ValueError, match="goes by the gradient of the scalar: set normals="):
        scene.replaced(normals=jvr.AnalyticGradient(of_opacity=True))
    with pytest.raises(ValueError, match=r"albedo must be in \[0, 1\]"):
        jvr.SingleScattering(albedo=jvr.ByGradient([0, 1], [0.5, 1.1]))
    with pytest.raises(ValueError, match=r"take jvr\.MaterialByValue"):
        jvr.PhaseBRDF(jvr.HenyeyGreenstein(by_gradient))


def test_ambient_light_on_shares_by_scalar_is_remarked_on_only_where_they_are_zero():
    for share, seen in ((0.0, False), (0.3, True)):
        shading = jvr.PhenomenologicalBSDF(jvr.ByValue([0, 1], [0.0, share]), 0.0, 0.0)
        scene = jvr.Scene(ramp(0.1), linear_transfer(), lights=(AMBIENT,), shading=shading)
        assert any("is not seen" in said for said in AMBIENT.remarks("lights[0]", scene, None)) is not seen
