"""Each class says once which values its parameters take: constructors refuse others, and no fit leaves them, whatever its solver."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jvr
from jvr.fitting.unknowns import ExposedModel, choose_unknowns
from jvr.model.ranges import ANY

VOLUME = jvr.Volume(np.random.default_rng(0).random((4, 5, 6)))
TABLE = jvr.LutTransfer(np.full((4, 3), 0.4), np.full(4, 0.2), (-2.0, 3.0))
BY_VALUE = jvr.ByValue([-1.0, 0.5], [0.2, 0.6])
SCENE = jvr.Scene(
    VOLUME,
    TABLE,
    background=(0.1, 0.2, 0.3),
    lights=(
        jvr.PointLight((1.0, 2.0, 30.0), attenuation=(1.0, 0.1, 0.2)),
        jvr.SpotLight((1.0, 2.0, 30.0), (0.0, 0.0, -1.0), 2.0, inner=10.0, outer=25.0),
    ),
    shading=jvr.BlinnPhong(diffuse=BY_VALUE, threshold=0.5),
    scattering=jvr.SingleScattering(jvr.HenyeyGreenstein(BY_VALUE), BY_VALUE, threshold=0.3),
)
POINT, SPOT = (lambda s: s.lights[0]), (lambda s: s.lights[1])


def with_phase(phase) -> jvr.Scene:
    return eqx.tree_at(lambda s: s.scattering.phase, SCENE, phase)


def with_transfer(transfer) -> jvr.Scene:
    return eqx.tree_at(lambda s: s.transfer, SCENE, transfer)


# The scene, one of its arrays, and the ends of what physics and its docstring allow.
CASES = {
    "colours": (SCENE, lambda s: s.transfer.rgb, 0, 1),
    "extinction": (SCENE, lambda s: s.transfer.sigma_t, 0, np.inf),
    "background": (SCENE, lambda s: s.background, 0, 1),
    "width": (with_transfer(jvr.GaussianTransfer([0.5], [0.1], [0.3], [[0.5] * 3])), lambda s: s.transfer.width, 0, np.inf),
    "g by value": (SCENE, lambda s: s.scattering.phase.g.values, -1, 1),
    "albedo by value": (SCENE, lambda s: s.scattering.albedo.values, 0, 1),
    "diffuse by value": (SCENE, lambda s: s.shading.diffuse.values, 0, np.inf),
    "shininess": (SCENE, lambda s: s.shading.shininess, 1, np.inf),
    "threshold of shading": (SCENE, lambda s: s.shading.threshold, 0, np.inf),
    "threshold of scattering": (SCENE, lambda s: s.scattering.threshold, 0, np.inf),
    "attenuation": (SCENE, lambda s: POINT(s).attenuation, 0, np.inf),
    "radius": (SCENE, lambda s: POINT(s).radius, 0, np.inf),
    "intensity": (SCENE, lambda s: SPOT(s).intensity, 0, np.inf),
    "inner": (SCENE, lambda s: SPOT(s).inner, 0, 180),
    "outer": (SCENE, lambda s: SPOT(s).outer, 0, 180),
    "alpha": (with_phase(jvr.Draine(0.3, 2.0)), lambda s: s.scattering.phase.alpha, 0, np.inf),
    "diameter": (with_phase(jvr.JendersieEon(20.0)), lambda s: s.scattering.phase.diameter, 5, 50),
    "k": (with_phase(jvr.Schlick(0.3)), lambda s: s.scattering.phase.k, -1, 1),
    "weight": (with_phase(jvr.DoubleHenyeyGreenstein(0.5, -0.3, 0.7)), lambda s: s.scattering.phase.weight, 0, 1),
    "weights": (
        with_phase(jvr.Mixture((jvr.Isotropic(), jvr.Schlick(0.3)), [1.0, 2.0])),
        lambda s: s.scattering.phase.weights,
        0,
        np.inf,
    ),
    "values of a phase": (
        with_phase(jvr.TabulatedPhase([0.0, 1.0, np.pi], [1.0, 0.5, 0.2])),
        lambda s: s.scattering.phase.values,
        0,
        np.inf,
    ),
    "position of a light": (SCENE, lambda s: POINT(s).position, -np.inf, np.inf),
}


@pytest.mark.parametrize("bounds", [None, ANY], ids=["smooth", "bounded"])
@pytest.mark.parametrize("name", CASES)
def test_no_step_leaves_the_range(name, bounds):
    scene, select, low, high = CASES[name]
    model = ExposedModel(scene, None)
    chosen = choose_unknowns(model, lambda m: select(m.scene), None, bounds)
    start = chosen.unconstrained_from_model(model)
    np.testing.assert_allclose(chosen.values_from_unconstrained(start, model), np.ravel(select(scene)), rtol=2e-5, atol=2e-5)
    lower, upper, _ = chosen.limits(model, np.asarray(start))
    for far in (-1e6, 1e6):
        moved = np.clip(np.full(start.shape, far), lower, upper)
        values = np.asarray(chosen.values_from_unconstrained(jnp.asarray(moved, jnp.float32), model))
        assert np.all((values >= low) & (values <= high))
        # It comes as near to a finite end as float32 and what is open ask for, and as far as there is no end.
        end = low if far < 0 else high
        if np.isfinite(end):
            assert np.abs(values - end).max() <= 3e-6 * max(abs(end), 1.0)
        else:
            assert np.abs(values).max() > 1e4 * np.abs(select(scene)).max()


@pytest.mark.parametrize("bounds", [None, ANY], ids=["smooth", "bounded"])
@pytest.mark.parametrize("name", ["positions", "domain", "positions by value"])
def test_positions_stay_in_order(name, bounds):
    scene, select = {
        "positions": (
            with_transfer(jvr.LinearTransfer([-5.0, 1.0, 2.0], np.eye(3), [0.1, 0.2, 0.3])),
            lambda s: s.transfer.positions,
        ),
        "domain": (SCENE, lambda s: s.transfer.domain),
        "positions by value": (SCENE, lambda s: s.scattering.albedo.positions),
    }[name]
    model = ExposedModel(scene, None)
    chosen = choose_unknowns(model, lambda m: select(m.scene), None, bounds)
    start = np.asarray(chosen.unconstrained_from_model(model))
    np.testing.assert_allclose(chosen.values_from_unconstrained(jnp.asarray(start), model), select(scene), rtol=1e-5)
    lower, upper, _ = chosen.limits(model, start)
    moved = np.clip(start + np.array([-30.0, -5.0, -5.0])[: start.size], lower, upper)
    values = chosen.values_from_unconstrained(jnp.asarray(moved, jnp.float32), model)
    assert np.all(np.diff(values) > 0)
    # Scalars below zero are as good as others.
    assert values[0] < -10


def test_a_start_outside_of_its_range_is_named():
    bright = eqx.tree_at(lambda s: s.transfer.rgb, SCENE, SCENE.transfer.rgb.at[1, 2].set(1.5))
    with pytest.raises(ValueError, match=r"transfer\.rgb starts at 1\.5, outside of 0 \.\.\. 1.*jvr\.Bounded") as caught:
        choose_unknowns(ExposedModel(bright, None), lambda m: m.scene.transfer.rgb)
    assert "\n" not in str(caught.value)
    chosen = choose_unknowns(ExposedModel(bright, None), lambda m: m.scene.transfer.rgb, (jvr.Bounded(0.0, 10.0),))
    assert float(jnp.max(chosen.unconstrained_from_model(ExposedModel(bright, None)))) == 1.5


@pytest.mark.parametrize(
    "made",
    [
        lambda: jvr.HenyeyGreenstein(jvr.ByValue([0.0, 1.0], [0.5, 1.0])),
        lambda: jvr.Draine(0.2, -1.0),
        lambda: jvr.JendersieEon(60.0),
        lambda: jvr.Schlick(-1.0),
        lambda: jvr.PointLight((0, 0, 0), -1.0),
        lambda: jvr.PointLight((0, 0, 0), radius=0.0),
        lambda: jvr.SingleScattering(albedo=jvr.ByValue([0.0, 1.0], [0.5, 1.1])),
        lambda: jvr.BlinnPhong(shininess=0.5),
        lambda: jvr.LutTransfer(np.ones((2, 3)), [-0.1, 0.2], (0, 1)),
        lambda: jvr.GaussianTransfer([0.5], [0.0], [0.3], [[0.5] * 3]),
        lambda: jvr.MicrofacetBRDF(roughness=0.0),
    ],
)
def test_constructors_refuse_what_the_range_excludes(made):
    with pytest.raises(ValueError, match="must"):
        made()


# One number, made with it, and the end of its range that a constructor knows.
DECLARED = {
    "roughness": (lambda x: jvr.MicrofacetBRDF(roughness=x), 0.001),
    "diameter": (jvr.JendersieEon, 5.0),
    "eta": (lambda x: jvr.Dipole([1.0] * 3, [0.1] * 3, x), 1.0),
    "shininess": (lambda x: jvr.BlinnPhong(shininess=x), 1.0),
}


@pytest.mark.parametrize("name", DECLARED)
def test_constructors_and_fits_keep_to_one_range(name):
    """Up to its very end, and not a part in a thousand farther."""
    make, end = DECLARED[name]
    np.testing.assert_allclose(getattr(make(end), name), end)
    with pytest.raises(ValueError, match="must"):
        make(end * (1 - 1e-4))


def test_attenuation_has_a_range_for_each_entry():
    """A part that is zero, as constructors take it, is where a fit that keeps to bounds starts; the constant stays above zero."""
    lit = eqx.tree_at(lambda s: POINT(s).attenuation, SCENE, jnp.array([1.0, 0.0, 0.2]))
    model = ExposedModel(lit, None)
    chosen = choose_unknowns(model, lambda m: POINT(m.scene).attenuation, None, ANY)
    start = chosen.unconstrained_from_model(model)
    np.testing.assert_array_equal(chosen.values_from_unconstrained(start, model), np.float32([1.0, 0.0, 0.2]))
    lowest = chosen.values_from_unconstrained(jnp.asarray(chosen.limits(model, np.asarray(start))[0]), model)
    np.testing.assert_array_equal(lowest[1:], 0.0)
    assert 0 < lowest[0] < 1e-5
    for wrong in ((0.0, 1.0, 1.0), (1.0, -0.1, 0.0), (1.0, 0.0, np.nan)):
        with pytest.raises(ValueError, match="attenuation"):
            jvr.PointLight((0, 0, 0), attenuation=wrong)
    negative = eqx.tree_at(lambda s: POINT(s).attenuation, SCENE, jnp.array([1.0, -0.5, 0.2]))
    with pytest.raises(ValueError, match=r"attenuation starts at -0\.5"):
        choose_unknowns(ExposedModel(negative, None), lambda m: POINT(m.scene).attenuation)


@pytest.mark.slow
def test_a_bounded_solver_keeps_negative_positions():
    transfer = jvr.LinearTransfer([-0.5, 0.4, 0.9], [[0.9, 0.1, 0.1], [0.1, 0.9, 0.2], [0.2, 0.3, 0.9]], [0.1, 0.4, 0.2])
    truth = jvr.Scene(VOLUME, transfer)
    cameras = jvr.fibonacci_sphere(VOLUME.center, 15.0, 2, 30.0, 8, 8)
    images = [np.asarray(jax.jit(jvr.render)(truth, camera).rgb) for camera in cameras]
    start = eqx.tree_at(lambda s: s.transfer.positions, truth, jnp.array([-0.4, 0.45, 0.9]))
    result = jvr.fit(start, cameras, images, unknowns=lambda s: s.transfer.positions, solver=jvr.LBFGSB(), max_steps=40)
    assert float(result.scene.transfer.positions[0]) < -0.3
    assert result.history[-1].loss < 0.1 * result.history[0].loss
