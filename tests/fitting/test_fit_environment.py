"""Environment lighting, materials, dipoles and the transfer function under them are recovered from pictures."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jvr
from jvr.fitting.kinds import has_table_jacobian, march_unknowns
from jvr.fitting.normal_equations import light_tangents, normal_equations
from jvr.fitting.objective import residuals, value
from jvr.fitting.observations import observe
from jvr.fitting.problem import Problem
from jvr.fitting.unknowns import ExposedModel, choose_unknowns

SETTINGS = jvr.Settings(1.5)
TRANSFER = jvr.RadianceTransfer(order=1, rays=12, resolution=0.4, step=2.0, growth=1.5)


@pytest.fixture(scope="module")
def volume():
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 7)] * 3, indexing="ij"))
    ripple = 0.15 * np.sin(4 * grid[0]) * np.cos(5 * grid[1])
    return jvr.Volume(np.clip(1.1 - np.sqrt((grid**2).sum(0)) + ripple, 0, 1).astype(np.float32))


@pytest.fixture(scope="module")
def frozen(volume):
    return jvr.precompute(scene(volume, radiance_transfer=TRANSFER))


def light(order=2, seed=0):
    coefficients = 0.3 * np.random.default_rng(seed).normal(size=((order + 1) ** 2, 3))
    coefficients[0] = [4.0, 3.5, 3.0]
    return jvr.EnvironmentLight(coefficients, clamped=False)


def scene(volume, sigma=0.5, **parts):
    transfer = jvr.LutTransfer(np.linspace(0.2, 0.9, 9).reshape(3, 3), sigma * np.array([0.0, 0.3, 1.0]) + 1e-3, (0.0, 1.0))
    return jvr.Scene(volume, transfer, **({"environment": light(), "material": jvr.LambertBRDF(0.8)} | parts))


def views(one, noise=0.0):
    cameras = jvr.fibonacci_sphere(one.volume.center, 16.0, 4, 34.0, 8, 8)
    render = jax.jit(jvr.render, static_argnums=2)
    images = [np.asarray(render(one, camera, SETTINGS).rgb) for camera in cameras]
    rng = np.random.default_rng(0)
    return cameras, [image + noise * rng.standard_normal(image.shape) for image in images]


def fit(start, cameras, images, unknowns, **keywords):
    return jvr.fit(start, cameras, images, unknowns=unknowns, settings=SETTINGS, progress=False, **keywords)


def problem_of(one, unknowns):
    """A fit's problem, with the values at which it starts."""
    model = ExposedModel(one, None)
    chosen = choose_unknowns(model, lambda m: unknowns(m.scene))
    problem = Problem(model, chosen, SETTINGS, jvr.SquaredError(), (), None)
    return problem, jnp.concatenate([jnp.ravel(x) for x in chosen.values(model)])


@pytest.mark.slow
def test_the_light_of_a_picture_in_one_step(volume):
    """It acts linearly: the first step of Gauss and Newton is the solution, within its own standard errors."""
    truth = scene(volume)
    cameras, images = views(truth, noise=0.01)
    start = dataclasses.replace(truth, environment=jvr.EnvironmentLight(jnp.zeros((9, 3)), clamped=False))
    result = fit(start, cameras, images, lambda s: s.environment.coefficients, solver=jvr.GaussNewton(), max_steps=1)
    deviation = (result.scene.environment.coefficients - truth.environment.coefficients) / result.standard_errors
    assert np.all(np.isfinite(result.standard_errors))
    # 27 numbers with fixed noise.
    assert np.all(np.abs(deviation) < 3.5)
    assert 0.5 < np.sqrt(np.mean(np.square(deviation))) < 1.5


@pytest.mark.slow
def test_only_products_of_light_and_material_are_determined(volume):
    truth = scene(volume, environment=jvr.EnvironmentLight(np.linspace(2.0, 1.0, 12).reshape(4, 3), clamped=False))
    cameras, images = views(truth)
    start = dataclasses.replace(truth, material=jvr.LambertBRDF(0.6))
    unknowns = lambda s: (s.environment.coefficients, s.material.reflectance)
    result = fit(start, cameras, images, unknowns, max_steps=4)
    of_light, of_material = result.standard_errors
    assert np.all(np.isinf(of_light))
    assert np.isinf(of_material)
    assert result.stats.rank == 12
    found = result.scene.material.reflectance * result.scene.environment.coefficients
    np.testing.assert_allclose(found, 0.8 * truth.environment.coefficients, atol=2e-3)


def test_what_a_fit_takes_for_an_unknown(volume):
    """The defaults keep values where constructors demand them, and let the coefficients of light be anything."""
    surfaces = (jvr.PhongBRDF(), jvr.MicrofacetBRDF())
    material = jvr.MaterialByValue([0.0, 1.0], surfaces)
    transfer = jvr.RadianceTransfer(scattering=jvr.Dipole.preset("cream"))
    one = scene(volume, material=material, radiance_transfer=transfer)
    glossy, metal = (lambda s, i=i: s.material.materials[i] for i in (0, 1))
    dipole = lambda s: s.radiance_transfer.scattering
    bounds = {
        (lambda s: glossy(s).diffuse): (0, 1),
        (lambda s: glossy(s).specular): (0, 1),
        (lambda s: glossy(s).exponent): (0, np.inf),
        (lambda s: metal(s).base): (0, 1),
        (lambda s: metal(s).metallic): (0, 1),
        (lambda s: metal(s).reflectance_at_normal): (0, 1),
        (lambda s: metal(s).roughness): (1e-3, 1),
        (lambda s: dipole(s).sigma_a): (0, np.inf),
        (lambda s: dipole(s).sigma_s_prime): (0, np.inf),
        (lambda s: dipole(s).eta): (1, 3),
        (lambda s: s.environment.coefficients): (-np.inf, np.inf),
    }
    for select, (low, high) in bounds.items():
        (bijector,) = choose_unknowns(ExposedModel(one, None), lambda m, select=select: select(m.scene)).bijectors
        far = np.array([-40.0, 40.0])
        ends = [low if np.isfinite(low) else -40.0, high if np.isfinite(high) else float(bijector.forward(jnp.asarray(40.0)))]
        # What is positive stays a millionth of its typical size, here of 5, above zero.
        np.testing.assert_allclose(jax.vmap(bijector.forward)(jnp.asarray(far)), ends, atol=1e-5)
        start = select(one)
        np.testing.assert_allclose(bijector.forward(bijector.inverse(start)), start, rtol=1e-5, atol=2e-3)


def test_colours_of_light_share_a_march(volume):
    unknowns = lambda s: (s.environment.coefficients, s.material.reflectance)
    assert march_unknowns(problem_of(scene(volume), unknowns)[0]) == 9 + 1


def test_entries_act_through_a_transfer_that_is_not_frozen(volume, frozen):
    recomputed = scene(volume, radiance_transfer=TRANSFER)
    unknowns = lambda s: s.transfer.sigma_t
    assert not has_table_jacobian(recomputed)
    assert march_unknowns(problem_of(recomputed, unknowns)[0]) == 3
    assert has_table_jacobian(frozen)
    assert march_unknowns(problem_of(frozen, unknowns)[0]) == 0


@pytest.mark.parametrize("unknown", ["transfer function", "light"])
def test_rows_refuse_light_that_changes_on_its_way(volume, unknown):
    one = scene(volume, radiance_transfer=TRANSFER)
    select = lambda s: s.transfer.sigma_t if unknown == "transfer function" else s.environment.coefficients
    (camera, *_) = jvr.fibonacci_sphere(volume.center, 16.0, 1, 34.0, 4, 4)
    image = lambda x: jvr.render(eqx.tree_at(select, one, x), camera, jvr.Settings(adjoint=jvr.Rows())).rgb
    with pytest.raises(ValueError, match="nor a radiance transfer or its light"):
        jax.eval_shape(jax.jacfwd(image), select(one))


@pytest.mark.slow
def test_least_squares_of_what_scatters_around_nodes_are_not_differentiated_by_rows(frozen):
    """A dipole changes light on its way as the environment does, also where the radiance transfer itself is kept."""
    scattering = lambda s: s.radiance_transfer.scattering
    one = eqx.tree_at(scattering, frozen, jvr.Dipole.preset("cream"), is_leaf=lambda x: x is None)
    problem, values = problem_of(one, lambda s: scattering(s).sigma_a)
    cameras = jvr.fibonacci_sphere(one.volume.center, 16.0, 1, 34.0, 8, 8)
    tiles = observe(one, cameras, [np.zeros((8, 8, 3))], None, SETTINGS)
    jacobian = jax.eval_shape(jax.jacfwd(lambda v: residuals(problem, v, tiles, jnp.ones(()))), values)
    assert jacobian.shape == (tiles.weight.size * 3, 3)


@pytest.mark.slow
def test_rows_under_a_frozen_transfer(volume, frozen):
    """Where in a segment light is looked up depends on its extinction: that is part of the rows."""
    (camera, *_) = jvr.fibonacci_sphere(volume.center, 16.0, 1, 34.0, 6, 6)

    def jacobian(adjoint):
        image = lambda sigma_t: (
            jvr.render(eqx.tree_at(lambda s: s.transfer.sigma_t, frozen, sigma_t), camera, jvr.Settings(1.5, adjoint=adjoint)).rgb
        )
        return jax.jit(jax.jacfwd(image))(frozen.transfer.sigma_t)

    by_rows, forward = jacobian(jvr.Rows()), jacobian(jvr.Forward())
    np.testing.assert_allclose(by_rows, forward, rtol=1e-4, atol=1e-5 * np.abs(forward).max())


def both_ways(one, unknowns):
    """The gradient of a fit's objective, by the normal equations and by reverse mode."""
    problem, values = problem_of(one, unknowns)
    cameras, images = views(scene(one.volume, sigma=0.3))
    observations = observe(one, cameras, images, None, SETTINGS, 128)
    total = jnp.asarray(3.0 * observations.size)
    around = light_tangents(problem, values)
    vectors = [normal_equations(problem, values, observations, i, around=around).vector for i in range(observations.tile_count())]
    # In unconstrained space every value is itself.
    identity = eqx.tree_at(lambda p: p.unknowns.bijectors, problem, tuple(jvr.Identity() for _ in problem.unknowns.bijectors))
    gradient = jax.jit(jax.grad(lambda v: value(identity, v, observations, total)))(values)
    return 2 * sum(np.asarray(v, np.float64) for v in vectors) / float(total), gradient


@pytest.mark.slow
def test_rows_of_a_fit_under_a_frozen_transfer_have_the_gradient(frozen):
    by_rows, by_replay = both_ways(frozen, lambda s: (s.transfer.sigma_t, s.transfer.rgb))
    np.testing.assert_allclose(by_rows, by_replay, rtol=2e-4, atol=2e-6 * np.abs(by_replay).max())


@pytest.mark.slow
@pytest.mark.parametrize("scattering", [None, jvr.Dipole([1.0, 0.6, 0.4], [0.02, 0.05, 0.1])])
def test_a_transfer_made_once_for_all_chunks_has_the_gradient(volume, scattering):
    """Of the transfer function, the light, the material that rays pick up and the dipole, through projection and scattering pass."""
    one = scene(
        volume,
        radiance_transfer=jvr.RadianceTransfer(
            order=1, rays=8, resolution=0.4, step=2.0, growth=1.5, bleeding=jvr.MaterialBleeding(), scattering=scattering
        ),
    )
    own = lambda s: () if scattering is None else (s.radiance_transfer.scattering.sigma_a,)
    unknowns = lambda s: (s.transfer.sigma_t, s.environment.coefficients, s.material.reflectance, *own(s))
    by_forward, by_replay = both_ways(one, unknowns)
    np.testing.assert_allclose(by_forward, by_replay, rtol=5e-4, atol=5e-6 * np.abs(by_replay).max())


@pytest.mark.slow
def test_roughness_and_base_of_a_material(frozen):
    # Materials may be exchanged after the transfer has been computed.
    of = lambda base, roughness: dataclasses.replace(frozen, material=jvr.MicrofacetBRDF(base, roughness=roughness))
    cameras, images = views(of([0.9, 0.6, 0.3], 0.5), noise=1e-3)
    unknowns = lambda s: (s.material.base, s.material.roughness)
    result = fit(of([0.5] * 3, 0.7), cameras, images, unknowns, max_steps=15)
    truth = unknowns(of(np.array([0.9, 0.6, 0.3]), 0.5))
    for found, true, error in zip(unknowns(result.scene), truth, result.standard_errors, strict=True):
        assert np.all(error < 0.1)
        assert np.all(np.abs(found - true) < 3 * np.asarray(error))


@pytest.mark.slow
def test_coefficients_of_a_dipole(volume):
    """The scattering pass is left to each picture. What it changes on a tiny volume is the share of the light that comes back,
    which one coefficient of two determines."""
    of = lambda sigma_a: scene(
        volume,
        radiance_transfer=jvr.RadianceTransfer(
            order=1, rays=12, resolution=0.4, neighbourhood=0.5, scattering=jvr.Dipole([1.0, 0.6, 0.4], sigma_a)
        ),
    )
    truth, start = (jvr.precompute(of(a), keep_unscattered=True) for a in ([0.02, 0.05, 0.1], [0.05] * 3))
    cameras, images = views(truth, noise=1e-3)
    unknowns = lambda s: s.radiance_transfer.scattering.sigma_a
    result = fit(start, cameras, images, unknowns, max_steps=15)
    assert np.all(result.standard_errors < 0.01)
    assert np.all(np.abs(unknowns(result.scene) - unknowns(truth)) < 3 * np.asarray(result.standard_errors))


@pytest.mark.slow
def test_the_transfer_function_through_its_own_shadows(volume):
    """Recomputed in each step it is recovered; frozen as it was at the start it ends elsewhere."""
    truth, start = (scene(volume, sigma=sigma, radiance_transfer=TRANSFER) for sigma in (0.5, 0.25))
    cameras, images = views(truth)
    unknowns = lambda s: s.transfer.sigma_t
    recomputed = fit(start, cameras, images, unknowns, max_steps=20)
    np.testing.assert_allclose(unknowns(recomputed.scene)[1:], unknowns(truth)[1:], rtol=2e-2)
    frozen = fit(jvr.precompute(start), cameras, images, unknowns, max_steps=20)
    assert frozen.history[-1].loss > 10 * recomputed.history[-1].loss
    with pytest.warns(RuntimeWarning, match="computed for another transfer function"):
        jvr.render(frozen.scene, cameras[0], SETTINGS)


@pytest.mark.slow
def test_optimistix_finds_the_light_too(volume):
    """Through a frozen transfer: its least squares are differentiated in forward mode, and not by rows."""
    import optimistix as optx

    truth = jvr.precompute(scene(volume, environment=light(1), radiance_transfer=TRANSFER))
    cameras, images = views(truth)
    start = dataclasses.replace(truth, environment=jvr.EnvironmentLight.constant(1.0, 1))
    solver = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-8)
    result = fit(start, cameras, images, lambda s: s.environment.coefficients, solver=solver, max_steps=15)
    np.testing.assert_allclose(result.scene.environment.coefficients, truth.environment.coefficients, atol=1e-2)
