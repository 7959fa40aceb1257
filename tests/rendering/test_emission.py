"""Emission of its own: closed forms, quadrature in double precision, every derivative against differences, and what it leaves alone."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, affine, perspective, render, voxels

import jvr
from jvr.model.preintegration import PreIntegratedTable
from jvr.model.transfer import Classified
from jvr.rendering.advise import effects_of, remarks_on

LENGTH = 8.0
COLOUR, GLOW = np.array([0.9, 0.5, 0.2]), np.array([0.3, 0.1, 0.7])
BACKGROUND = np.array([0.1, 0.4, 0.7])
SETTINGS = jvr.Settings(0.5, termination=0)
# A table of which the first entries absorb nothing and the middle ones glow.
FLAME = {
    "positions": [0.1, 0.35, 0.6, 0.85],
    "rgb": [[0.2, 0.3, 0.1], [0.9, 0.2, 0.4], [0.1, 0.6, 0.8], [0.5, 0.5, 0.2]],
    "sigma_t": [0.0, 0.0, 0.5, 0.2],
    "emission": [[0.0, 0.0, 0.0], [0.6, 0.2, 0.1], [0.1, 0.3, 0.0], [0.0, 0.2, 0.4]],
}


def bar(profile, **options):
    """A volume that varies along x only."""
    values = np.broadcast_to(np.asarray(profile, float)[:, None, None], (9, 2, 2))
    return jvr.Volume(values, affine((1.0, 0.5, 1.0)), **options)


def view():
    return jvr.OrthographicCamera.look_at([LENGTH + 5, 0.25, 0.5], [0, 0.25, 0.5], [0, 0, 1], 0.6, 1, 3)


def pictured(volume, transfer, settings=SETTINGS, **parts):
    return render(jvr.Scene(volume, transfer, background=BACKGROUND, **parts), view(), settings)


def seen(image, rgb, alpha, tolerance=1e-12):
    np.testing.assert_allclose(image.rgb, np.broadcast_to(rgb, image.rgb.shape), rtol=tolerance)
    np.testing.assert_allclose(image.alpha, np.broadcast_to(alpha, image.alpha.shape), rtol=tolerance)


@pytest.mark.parametrize("quadrature", [jvr.Midpoint(), pytest.param(jvr.PreIntegrated(), marks=pytest.mark.slow)])
def test_homogeneous_slab_with_and_without_extinction(x64, quadrature):
    """`q (1 - exp(-sigma d)) / sigma`, and `q d` where nothing is absorbed (notes, eq. 1.3 and 1.7)."""
    settings = dataclasses.replace(SETTINGS, quadrature=quadrature)
    for sigma in (0.0, 1e-12, 0.2, 40.0):
        transfer = jvr.LinearTransfer([0.0, 1.0], [COLOUR] * 2, [sigma] * 2, [GLOW] * 2)
        depth = sigma * LENGTH
        own = GLOW * (LENGTH if sigma == 0 else -np.expm1(-depth) / sigma)
        seen(
            pictured(bar(np.full(9, 0.4)), transfer, settings),
            own - COLOUR * np.expm1(-depth) + BACKGROUND * np.exp(-depth),
            -np.expm1(-depth),
        )


@pytest.mark.slow
def test_under_each_optical_model_and_with_coloured_extinction(x64):
    sigma = np.array([0.0, 0.3, 0.7])
    transfer = jvr.LutTransfer([COLOUR] * 2, [sigma] * 2, [0.0, 1.0], [GLOW] * 2)
    T, way = np.exp(-sigma * LENGTH), np.array([LENGTH, *(-np.expm1(-sigma[1:] * LENGTH) / sigma[1:])])
    for optical, rgb, alpha in (
        (jvr.EmissionAbsorption(), GLOW * way + COLOUR * (1 - T) + BACKGROUND * T, 1 - T.mean()),
        (jvr.EmissionOnly(), (GLOW + sigma * COLOUR) * LENGTH + BACKGROUND, 0.0),
        (jvr.AbsorptionOnly(), BACKGROUND * T, 1 - T.mean()),
    ):
        seen(pictured(bar(np.full(9, 0.4)), transfer, optical=optical), rgb, alpha)


@pytest.mark.slow
def test_in_front_of_and_behind_what_absorbs(x64):
    """Nearest voxels make sharp slabs: 0 ... 2.5 glows, 2.5 ... 5.5 absorbs, 5.5 ... 8 glows; the eye is beyond 8. A flame in front is as
    bright as by itself, one behind is dimmed."""
    transfer = jvr.LinearTransfer([0.0, 1.0, 2.0], np.zeros((3, 3)), [0.0, 0.6, 0.0], np.array([1.0, 0.0, 2.0])[:, None] * GLOW)
    T = np.exp(-0.6 * 3)
    for profile, front, behind in (([0] * 3 + [1] * 3 + [2] * 3, 2.0, 1.0), ([2] * 3 + [1] * 3 + [0] * 3, 1.0, 2.0)):
        rgb = GLOW * 2.5 * (front + behind * T) + BACKGROUND * T
        seen(pictured(bar(profile, interpolation=jvr.Nearest()), transfer), rgb, 1 - T)


def quadrature_of(table, s0, s1, dt, nodes=64):
    """Radiance of a segment along which the scalar is linear, by Gauss-Legendre between the entries of the table."""
    x = np.asarray(table.positions, float)
    ends = [(e - s0) / (s1 - s0) for e in x if min(s0, s1) < e < max(s0, s1)] if s0 != s1 else []
    node, weight = np.polynomial.legendre.leggauss(nodes)
    sigma = lambda u: np.interp(s0 + u * (s1 - s0), x, np.asarray(table.sigma_t, float))
    emission = lambda u: np.stack(
        [np.interp(s0 + u * (s1 - s0), x, column) for column in np.asarray(table.emission, float).T], -1
    )
    total, tau, before = np.zeros(3), 0.0, 0.0
    for end in [*sorted(ends), 1.0]:
        u = before + (end - before) * (node + 1) / 2
        # Extinction is linear here, so that its integral up to a node is exact.
        depth = tau + dt * (u - before) * (sigma(np.array(before + 1e-13)) + sigma(u)) / 2
        total += dt * (end - before) / 2 * (weight * np.exp(-depth)) @ emission(u)
        tau += dt * (end - before) * sigma(np.array((before + end) / 2))
        before = end
    return total, tau


def segments(count=24):
    rng = np.random.default_rng(5)
    return [(rng.uniform(0, 1), rng.uniform(0, 1), rng.uniform(0.1, 2)) for _ in range(count)] + [
        (0.4, 0.4, 1.0),
        (0.4, 0.4 + 1e-9, 1.0),
    ]


def own(table, s0, s1, dt, parts=1):
    of = PreIntegratedTable(table, parts)
    one = jax.vmap(lambda a, b, d: of.evaluate_apart(jvr.EmissionAbsorption(), a, b, d)[1:])
    emitted, (dtau,) = one(*map(jnp.asarray, (s0, s1, dt)))
    return np.stack(emitted, -1), np.asarray(dtau)


@pytest.mark.slow
def test_pre_integration_against_quadrature(x64):
    """Ramps of the table in both directions, in one interval, in neighbouring ones and across several. Without extinction it is exact; else
    the rule has order 4 in its parts."""
    table = jvr.LinearTransfer(**FLAME)
    s0, s1, dt = map(np.array, zip(*segments(), strict=True))
    exact, depth = map(np.array, zip(*(quadrature_of(table, *one) for one in segments()), strict=True))
    errors = []
    for parts in (1, 2, 4):
        found, dtau = own(table, s0, s1, dt, parts)
        np.testing.assert_allclose(dtau, depth, rtol=1e-10, atol=1e-12)
        errors.append(np.abs(found - exact).max() / exact.max())
    # Measured: 2e-3, 2e-4, 1e-5 of the largest.
    assert errors[0] < 5e-3
    assert errors[2] < 5e-5
    assert errors[0] > 8 * errors[1] > 64 * errors[2]
    clear = dataclasses.replace(table, sigma_t=np.zeros(4))
    exact = [quadrature_of(clear, *one)[0] for one in segments()]
    np.testing.assert_allclose(own(clear, s0, s1, dt)[0], exact, rtol=1e-12, atol=1e-15)


@pytest.mark.slow
def test_pre_integrated_derivatives_against_differences(x64):
    s0, s1, dt = map(jnp.asarray, map(np.array, zip(*segments(), strict=True)))
    weights = jnp.sin(jnp.arange(1.0, 3 * s0.size + 1)).reshape(3, -1)

    def loss(p):
        table = jvr.LinearTransfer(jnp.asarray(FLAME["positions"]), FLAME["rgb"], p["sigma_t"], p["emission"])
        one = lambda a, b, d: jnp.stack(PreIntegratedTable(table).evaluate_segment(jvr.EmissionAbsorption(), a, b, d)[0])
        return jnp.sum(weights * jax.vmap(one)(p["s0"], p["s1"], p["dt"]).T)

    # Extinctions in the middle of their range: differences go to both sides.
    p = {
        "s0": s0,
        "s1": s1,
        "dt": dt,
        "sigma_t": jnp.array([0.1, 0.2, 0.5, 0.2]),
        "emission": 0.1 + jnp.asarray(FLAME["emission"]),
    }
    gradient = jax.jit(jax.grad(loss))(p)
    value = jax.jit(loss)
    for name, x in p.items():
        for i in range(0, x.size, 3):
            h = 1e-6
            moved = [value(p | {name: x.ravel().at[i].add(sign * h).reshape(x.shape)}) for sign in (1, -1)]
            np.testing.assert_allclose(
                gradient[name].ravel()[i], (moved[0] - moved[1]) / (2 * h), rtol=1e-6, atol=1e-7, err_msg=f"{name}[{i}]"
            )


def picture(p, settings, camera):
    transfer = jvr.LinearTransfer(jnp.asarray(FLAME["positions"]), p["rgb"], p["sigma_t"], p["emission"])
    return jvr.render(jvr.Scene(jvr.Volume(p["voxels"], OBLIQUE), transfer, background=BACKGROUND), camera, settings).rgb


@pytest.mark.slow
def test_every_derivative_against_differences(x64):
    """Reverse mode by replay, forward mode, rows in both modes, under `vmap`: against central differences, at entries without extinction
    and without emission too, where differences are one-sided."""
    p = {name: jnp.asarray(FLAME[name]) for name in ("rgb", "sigma_t", "emission")} | {
        "voxels": jnp.asarray(0.7 * voxels((3, 4, 5)))
    }
    entries = {name: p[name] for name in ("rgb", "sigma_t", "emission")}
    weights, camera = jnp.sin(jnp.arange(1.0, 37.0)).reshape(3, 4, 3), perspective(jvr.Volume(p["voxels"], OBLIQUE), 4, 3)
    loss = lambda adjoint, q: jnp.sum(weights * picture(p | q, jvr.Settings(0.7, termination=0, adjoint=adjoint), camera) ** 2)
    reverse = jax.jit(jax.grad(lambda q: loss(jvr.Replay(), q)))(p)
    value = jax.jit(lambda q: loss(jvr.Forward(), q))
    for name, i in (("emission", 0), ("emission", 4), ("sigma_t", 0), ("sigma_t", 2), ("rgb", 7), ("voxels", 17), ("voxels", 40)):
        move = lambda h, name=name, i=i: value(p | {name: p[name].ravel().at[i].add(h).reshape(p[name].shape)})
        h = 1e-4
        # One-sided, of order 4.
        difference = sum(w * move(k * h) for k, w in enumerate((-25 / 12, 4, -3, 4 / 3, -1 / 4))) / h
        np.testing.assert_allclose(reverse[name].ravel()[i], difference, rtol=1e-6, err_msg=f"{name}[{i}]")
    others = {
        "forward": jax.jacfwd(lambda q: loss(jvr.Forward(), q)),
        "rows, forward": jax.jacfwd(lambda q: loss(jvr.Rows(), q)),
        "rows, reverse": jax.grad(lambda q: loss(jvr.Rows(), q)),
        "vmap": lambda q: jax.tree.map(
            lambda g: g[1],
            jax.vmap(jax.grad(lambda q: loss(jvr.Replay(), q)))(jax.tree.map(lambda x: jnp.stack([0.5 * x, x]), q)),
        ),
    }
    for name, way in others.items():
        for key, g in jax.jit(way)(entries).items():
            np.testing.assert_allclose(g, reverse[key], rtol=1e-10, atol=1e-11, err_msg=f"{name}: {key}")


def test_nothing_is_finite(x64):
    """No extinction and no length: values and derivatives of a segment."""

    def one(q, sigma, dt):
        entry = Classified(tuple(map(jnp.asarray, COLOUR)), (sigma,), (q,) * 3)
        return jnp.stack(jvr.EmissionAbsorption().evaluate_segment(entry, dt)[0])

    both = jax.jit(lambda *x: (one(*x), jax.jacfwd(one, argnums=(0, 1, 2))(*x)))
    for q, sigma, dt in ((1.0, 0.0, 0.0), (1.0, 0.0, 2.0), (0.0, 0.0, 0.0), (1.0, 1e-30, 1.0), (1.0, 1e30, 1.0)):
        found, (of_q, of_sigma, of_dt) = both(*map(jnp.asarray, (q, sigma, dt)))
        assert np.isfinite([found, of_q, of_sigma, of_dt]).all()
        if sigma == 0:
            np.testing.assert_allclose(found, q * dt * np.ones(3))
            np.testing.assert_allclose(of_q, dt)
            np.testing.assert_allclose(of_dt, q)
            np.testing.assert_allclose(of_sigma, COLOUR * dt - q * dt**2 / 2)


GLOWING = np.array(FLAME["emission"])
TRANSFERS = {
    "linear": jvr.LinearTransfer(**FLAME),
    "table": jvr.LutTransfer(FLAME["rgb"], FLAME["sigma_t"], [0.1, 0.85], GLOWING),
    "Gaussians": jvr.GaussianTransfer([0.35, 0.7], [0.02, 0.01], [0.0, 0.5], FLAME["rgb"][:2], GLOWING[1:3]),
    "2-D": jvr.GradientTransfer(
        np.repeat(np.array(FLAME["rgb"])[:, None], 2, 1),
        np.outer(FLAME["sigma_t"], [0, 1]),
        [0.1, 0.85],
        [0.0, 0.4],
        GLOWING[:, None] * np.array([0.0, 2.0])[:, None],
    ),
    "gradient opacity": jvr.GradientOpacity(jvr.LinearTransfer(**FLAME), 0.0, 0.2),
}


@pytest.mark.parametrize("kind", TRANSFERS)
def test_each_transfer_function_knows_what_glows(kind):
    """At its entry the second one glows as it was said, here at half the length of the gradient where that counts, and is visible without
    extinction; where nothing glows nor absorbs nothing is, and glow below a bound is not."""
    transfer, half = TRANSFERS[kind], kind == "gradient opacity"
    found = transfer.evaluate(jnp.asarray(0.35), jnp.asarray(0.1 if half else 0.2))
    np.testing.assert_allclose(found.emission, GLOWING[1] * (0.5 if half else 1), rtol=1e-5)
    assert found.sigma_t[0] == 0
    visible = lambda low, high, least=0.0: bool(transfer.is_visible(jnp.asarray(low), jnp.asarray(high), least))
    assert visible(0.34, 0.36)
    assert not visible(0.0, 0.05)
    assert not visible(0.34, 0.36, 2.0)


def test_what_glows_is_not_skipped():
    """Along a ramp of the scalar the picture is the sum of what the transfer function says of samples, with skipping as without."""
    profile = np.linspace(-0.5, 0.5, 17)
    volume = jvr.Volume(np.broadcast_to(profile[:, None, None], (17, 5, 5)))
    camera = jvr.OrthographicCamera.look_at([30, 2, 2], [0, 2, 2], [0, 0, 1], 0.6, 1, 1)
    transfer = TRANSFERS["linear"]
    image = render(jvr.Scene(volume, transfer, optical=jvr.EmissionOnly()), camera, SETTINGS)
    s = (np.arange(32) + 0.5) / 32 - 0.5
    of = lambda table: np.stack([np.interp(s, FLAME["positions"], column) for column in np.array(table).T], 1)
    extinction = np.interp(s, FLAME["positions"], FLAME["sigma_t"])[:, None]
    np.testing.assert_allclose(image.rgb[0, 0], 0.5 * np.sum(of(GLOWING) + extinction * of(FLAME["rgb"]), axis=0), rtol=1e-5)
    # Below the first entry that glows there is nothing; between that and the first that absorbs there is.
    skipped = np.sum(s < 0.1)
    assert 32 - skipped <= image.stats.steps[0, 0] < 32


@pytest.mark.slow
@pytest.mark.parametrize("quadrature", [jvr.Midpoint(), jvr.PreIntegrated()])
def test_light_and_shadows_leave_it_alone(quadrature):
    """Lit black smoke shows what the unlit one shows: its emission, whatever light falls on it."""
    settings = jvr.Settings(0.5, termination=0, quadrature=quadrature)
    volume, transfer = jvr.Volume(voxels((5, 6, 7))), jvr.LinearTransfer(**FLAME | {"rgb": np.zeros((4, 3))})
    camera = perspective(volume, 4, 3)
    scene = jvr.Scene(volume, transfer)
    lit = dataclasses.replace(
        scene, lights=(jvr.DirectionalLight([0.3, 0.5, -0.8], 3.0),), shading=jvr.Lambert(0.2, 0.7), shadows=jvr.ShadowRays()
    )
    image = render(lit, camera, settings)
    np.testing.assert_allclose(image.rgb, render(scene, camera, settings).rgb, rtol=2e-5, atol=1e-7)
    assert image.rgb.max() > 0.3


@pytest.mark.slow
def test_is_fitted_with_standard_errors():
    """From noisy pictures; errors are of the size of what they foretell, and rows agree with differences in a step."""
    volume = jvr.Volume(voxels((6, 6, 6)))
    truth = jvr.Scene(volume, jvr.LinearTransfer(**FLAME))
    cameras = [perspective(volume, 10, 10, direction) for direction in ([1.0, -0.6, 0.4], [-0.4, 1.0, 0.3])]
    rng, noise = np.random.default_rng(3), 1e-3
    images = [np.asarray(render(truth, c, SETTINGS).rgb) + noise * rng.standard_normal((10, 10, 3)) for c in cameras]
    start = eqx.tree_at(lambda s: s.transfer.emission, truth, jnp.full((4, 3), 0.1))
    result = jvr.fit(start, cameras, images, unknowns=lambda s: s.transfer.emission, settings=SETTINGS)
    assert result.outcome == jvr.Outcome.CONVERGED
    error = np.asarray(result.scene.transfer.emission) - FLAME["emission"]
    expected = np.asarray(result.errors_by_name["transfer.emission"])
    inside = np.asarray(FLAME["emission"]) > 0
    assert np.all(np.abs(error)[inside] < 4 * expected[inside])
    assert 0.3 < np.sqrt(np.mean(np.square(error / expected)[inside])) < 2
    assert np.abs(error).max() < 0.02


def test_says_what_does_not_show():
    scene = jvr.Scene(jvr.Volume(voxels((4, 4, 4))), jvr.LinearTransfer(**FLAME), optical=jvr.AbsorptionOnly())
    assert any("emission does not show" in remark for remark in remarks_on(scene, None))
    dark = dataclasses.replace(scene, transfer=jvr.LinearTransfer(**FLAME | {"emission": np.zeros((4, 3))}))
    dark = dataclasses.replace(dark, optical=jvr.EmissionAbsorption())
    assert any("zero everywhere" in remark for remark in remarks_on(dark, None))
    assert not list(remarks_on(jvr.Scene(scene.volume, scene.transfer), None))
    (effect,) = effects_of(scene)
    assert effect.title == "emission of its own"
    assert effect.change(scene, SETTINGS)[0].transfer.emission is None
    assert "emission of its own" in str(jvr.plan(scene, SETTINGS))


def test_refuses_what_is_no_emission():
    with pytest.raises(ValueError, match="emission must be finite and not negative"):
        jvr.LinearTransfer(**FLAME | {"emission": -np.ones((4, 3))})
    with pytest.raises(ValueError, match=r"emission has .* it must"):
        jvr.LinearTransfer(**FLAME | {"emission": np.ones((3, 3))})


def test_is_saved_and_loaded(tmp_path):
    scene = jvr.Scene(jvr.Volume(voxels((4, 4, 4))), jvr.LinearTransfer(**FLAME))
    jvr.save_scene(scene, tmp_path / "flame.toml")
    assert eqx.tree_equal(jvr.load_scene(tmp_path / "flame.toml"), scene)
