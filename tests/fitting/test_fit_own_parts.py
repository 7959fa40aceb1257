"""A transfer function, a light and a material that jvr has never heard of go through a fit as its own do."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

import jvr
from jvr.fitting.kinds import march_unknowns
from jvr.fitting.normal_equations import normal_equations
from jvr.fitting.objective import value
from jvr.fitting.observations import observe
from jvr.fitting.problem import Problem
from jvr.fitting.unknowns import ExposedModel, choose_unknowns
from jvr.model.effects import AbstractMaterial
from jvr.model.light import AbstractDeltaLight, LightSample
from jvr.model.parameters import parameter
from jvr.model.ranges import DIRECTION, INCREASING, NOT_NEGATIVE, UNIT_INTERVAL
from jvr.model.transfer import AbstractTable, Classified

SETTINGS = jvr.Settings(0.9, termination=0.0)


class SquareRoots(AbstractTable):
    """A table whose entries lie evenly in the square root of the scalar, from `first` to `last`."""

    span: Float[Array, "2"] = parameter(INCREASING, doc="span")
    rgb: Float[Array, "n 3"] = parameter(UNIT_INTERVAL, doc="rgb")
    sigma_t: Float[Array, "n"] = parameter(NOT_NEGATIVE, doc="sigma_t")

    @property
    def ends(self):
        return self.span[0], self.span[1]

    def coordinate(self, s):
        low, high = jnp.sqrt(self.span)
        last = self.rgb.shape[0] - 1
        return jnp.clip((jnp.sqrt(jnp.maximum(s, 1e-6)) - low) / (high - low) * last, 0, last)

    def evaluate(self, s, magnitude=None):
        weights = jnp.maximum(0.0, 1.0 - jnp.abs(self.coordinate(s) - jnp.arange(self.rgb.shape[0])))
        r, g, b = weights @ self.rgb
        return Classified((r, g, b), (weights @ self.sigma_t,))


class Sun(AbstractDeltaLight):
    """Parallel light."""

    heading: Float[Array, "3"] = parameter(DIRECTION, doc="direction")
    glow: Float[Array, "3"] = parameter(NOT_NEGATIVE, by_channel=True, doc="glow")

    def sample(self, x, w_o):
        towards = -self.heading / jnp.linalg.norm(self.heading)
        return LightSample(tuple(towards), jnp.full_like(x[0], jnp.inf), tuple(self.glow))

    def moved(self, origin):
        return self


class Paint(AbstractMaterial):
    """A diffuse material whose reflectance is the square of its `depth`."""

    depth: Float[Array, ""] = parameter(UNIT_INTERVAL, doc="depth")

    @property
    def needs_gradient(self):
        return True

    def projected(self, order):
        return jvr.LambertBRDF(jnp.square(self.depth)).projected(order)


def volume(shape=(9, 8, 7)):
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n) for n in shape], indexing="ij")
    return jvr.Volume((0.5 + 0.3 * np.sin(2 * x + y) + 0.15 * np.cos(2 * y - 3 * z)).astype(np.float32))


def table(span=(0.1, 0.9)):
    rgb = np.linspace([0.2, 0.9, 0.5], [0.9, 0.3, 0.6], 5)
    return SquareRoots(*map(jnp.float32, (span, rgb, [0.02, 0.3, 0.05, 0.25, 0.1])))


def lit(heading=(0.4, -0.5, -1.0), glow=(2.0, 3.0, 1.5), depth=0.8):
    heading = np.asarray(heading) / np.linalg.norm(heading)
    environment = jvr.EnvironmentLight.constant((0.6, 0.4, 0.5), order=1)
    return jvr.Scene(
        volume(),
        table(),
        lights=(Sun(jnp.float32(heading), jnp.float32(glow)),),
        scattering=jvr.SingleScattering(jvr.HenyeyGreenstein(0.6), 0.9),
        environment=environment,
        material=Paint(jnp.float32(depth)),
    )


def views(scene):
    cameras = jvr.fibonacci_sphere(scene.volume.center, 18.0, 2, 34.0, 8, 8)
    return cameras, [np.asarray(jvr.render(scene, camera, SETTINGS).rgb) for camera in cameras]


def fit(start, truth, unknowns, **keywords):
    cameras, images = views(truth)
    return jvr.fit(start, cameras, images, unknowns=unknowns, settings=SETTINGS, progress=False, **keywords)


@pytest.mark.slow
def test_kept_samples_reach_beyond_the_first_ends_of_a_table_that_moves():
    """Scalars beyond the ends look alike to a table, so that kept samples may end there; but not where the ends are to be found."""
    truth = jvr.Scene(volume(), table())
    start = jvr.Scene(volume(), table((0.3, 0.6)))
    result = fit(start, truth, lambda s: s.transfer.span, max_steps=15)
    assert result.stats.kept_bytes > 0
    assert result.unknowns == ("transfer.span",)
    np.testing.assert_allclose(result.scene.transfer.span, truth.transfer.span, atol=2e-3)


def _problem(scene, unknowns):
    model = ExposedModel(scene, None)
    chosen = choose_unknowns(model, lambda m: unknowns(m.scene))
    return Problem(model, chosen, SETTINGS, jvr.SquaredError(), (), None)


def own(scene):
    return scene.lights[0].heading, scene.lights[0].glow, scene.material.depth, scene.transfer.sigma_t, scene.transfer.rgb


def test_each_takes_the_way_that_its_class_declares():
    """Entries come by rows, three channels of light by one march, all else by a march each."""
    # Of the transfer function none, of the light three and one, of the material one.
    assert march_unknowns(_problem(lit(), own)) == 3 + 1 + 1


@pytest.mark.slow
def test_derivatives_are_those_of_reverse_mode():
    scene = lit()
    problem = _problem(scene, own)
    cameras, images = views(lit(depth=0.6, glow=(1.0, 2.5, 2.0)))
    observations = observe(scene, cameras, images, None, SETTINGS)
    values = jnp.concatenate([jnp.ravel(x) for x in own(scene)])
    normal = normal_equations(problem, values, observations)
    identity = eqx.tree_at(lambda p: p.unknowns.bijectors, problem, (jvr.Identity(),) * 5)
    gradient = jax.jit(jax.grad(lambda v: value(identity, v, observations, jnp.ones(()))))(values)
    np.testing.assert_allclose(2 * np.asarray(normal.vector), gradient, rtol=2e-3, atol=2e-5 * np.abs(gradient).max())


@pytest.mark.slow
def test_a_light_and_a_material_are_found():
    """The length of a heading says nothing: its standard error is not that of an unknown that the images do not determine."""
    truth, unknowns = lit(), lambda s: own(s)[:3]
    result = fit(lit((0.1, -0.2, -1.0), (1.0, 1.0, 1.0), 0.5), truth, unknowns, max_steps=15)
    for found, true, error in zip(unknowns(result.scene), unknowns(truth), result.standard_errors, strict=True):
        assert np.all(np.isfinite(error))
        np.testing.assert_allclose(found, true, atol=5e-3)
    assert result.stats.rank == 7
