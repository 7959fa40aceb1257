"""Views that are lit each by lights of its own: against float64 differences, and against the same light for all."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jvr

SETTINGS = jvr.Settings(0.9, termination=0.0)
NOISE = 0.005
LIGHTS = tuple(jvr.DirectionalLight(direction, 2.0) for direction in ((1.0, 0.3, -0.5), (-0.6, 1.0, 0.2), (0.2, -0.7, 1.0)))


def _scene() -> jvr.Scene:
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n) for n in (9, 8, 10)], indexing="ij")
    volume = jvr.Volume((1.2 - np.sqrt(x * x + 1.2 * y * y + z * z) + 0.1 * np.sin(4 * x + 2 * z)).astype(np.float32))
    rgb = [[0.2, 0.3, 0.5], [0.6, 0.4, 0.2], [0.8, 0.5, 0.4]]
    transfer = jvr.LutTransfer(rgb, [0.02, 0.2, 0.5], (0.0, 1.2))
    return jvr.Scene(volume, transfer, shading=jvr.Phong(0.2, 0.6, 0.3, 8.0), lights=(LIGHTS[0],))


SCENE = _scene()
CAMERAS = jvr.fibonacci_sphere(SCENE.volume.center, 22.0, 3, 34.0, 9, 8)


def shading(scene: jvr.Scene):
    # The diffuse coefficient and colours show as their product.
    return scene.transfer.rgb, scene.shading.specular, scene.shading.shininess


def under(scene: jvr.Scene, light: jvr.DirectionalLight) -> jvr.Scene:
    return dataclasses.replace(scene, lights=(light,))


def pictures(lights, noise: float = NOISE, cameras=CAMERAS) -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    render = jax.jit(lambda light, camera: jvr.render(under(SCENE, light), camera, SETTINGS).rgb)
    made = [np.asarray(render(light, camera)) for light, camera in zip(lights, cameras, strict=True)]
    return [(image + noise * rng.standard_normal(image.shape)).astype(np.float32) for image in made]


def fit(start=SCENE, images=None, lights=LIGHTS, cameras=CAMERAS, **keywords) -> jvr.FitResult:
    images = pictures(LIGHTS) if images is None else images
    keywords = {"unknowns": shading, "settings": SETTINGS, "progress": False, "max_steps": 0, **keywords}
    return jvr.fit(start, cameras, images, lights=lights, smooth_undetermined=False, **keywords)


@pytest.mark.slow
def test_the_matrix_is_that_of_each_view_under_its_own_lights():
    """Columns by central differences of pictures in float64."""
    found = fit()
    with jax.enable_x64(True):
        scene, cameras, lights = jax.tree.map(lambda x: jnp.asarray(x, float), (SCENE, CAMERAS, LIGHTS))
        settings = jvr.Settings(SETTINGS.step, termination=0.0)
        leaves, structure = jax.tree.flatten(shading(scene))
        values = np.concatenate([np.ravel(leaf) for leaf in leaves])
        ends = np.cumsum([leaf.size for leaf in leaves])[:-1]
        render = jax.jit(lambda scene, camera: jvr.render(scene, camera, settings).rgb)

        def look(values: np.ndarray) -> np.ndarray:
            parts = [p.reshape(leaf.shape) for p, leaf in zip(np.split(values, ends), leaves, strict=True)]
            moved = eqx.tree_at(shading, scene, jax.tree.unflatten(structure, map(jnp.asarray, parts)))
            views = [render(under(moved, light), camera) for light, camera in zip(lights, cameras, strict=True)]
            return np.concatenate([np.ravel(view) for view in views])

        step = 1e-5
        rows = np.stack([(look(values + step * e) - look(values - step * e)) / (2 * step) for e in np.eye(values.size)], axis=1)
    assert found.information is not None
    wanted = rows.T @ rows
    scale = np.sqrt(np.maximum(np.outer(np.diag(wanted), np.diag(wanted)), 1e-12))
    np.testing.assert_allclose(found.information * found.stats.residual_variance / scale, wanted / scale, atol=1e-4)


@pytest.mark.slow
def test_one_light_for_all_views_is_that_of_the_scene():
    images = pictures([LIGHTS[1]] * 3)
    one = fit(under(SCENE, LIGHTS[1]), images, lights=None)
    each = fit(SCENE, images, lights=[LIGHTS[1]] * 3)
    np.testing.assert_array_equal(each.information, one.information)
    assert each.scene.lights == SCENE.lights


@pytest.mark.slow
def test_a_step_counts_priors_once_and_views_that_are_kept_aside_have_their_lights():
    strength = 0.05
    prior, start = jvr.ColourSmoothness(strength), eqx.tree_at(lambda s: s.transfer.rgb, SCENE, jnp.full((3, 3), 0.5))
    exact = pictures(LIGHTS, 0.0)
    aside = (CAMERAS[:1], exact[:1], [LIGHTS[0]])
    found = fit(start, exact, priors=(prior,), held_out=aside, max_steps=2)
    last = found.history[-1]
    assert last.loss - 10 ** (-last.psnr / 10) == pytest.approx(float(prior.value(found.scene)), rel=1e-3)
    picture = jax.jit(jvr.render)(under(found.scene, LIGHTS[0]), CAMERAS[0], SETTINGS).rgb
    assert found.stats.held_out[0][0] == pytest.approx(-10 * np.log10(np.mean((picture - exact[0]) ** 2)), abs=1e-3)


@pytest.mark.slow
def test_surfaces_are_known_better_from_pictures_under_several_lights():
    """Three pictures from one place: variances are smaller than the mean of those under each light alone, as the inverse is convex. A fit
    from a wrong start comes to the truth within three and a half errors."""
    there = CAMERAS[:1] * 3
    alone = [fit(images=pictures([light] * 3, cameras=there), lights=[light] * 3, cameras=there) for light in LIGHTS]
    several = fit(images=pictures(LIGHTS, cameras=there), cameras=there)
    for name, after in several.errors_by_name.items():
        before = np.sqrt(np.mean([np.square(one.errors_by_name[name]) for one in alone], axis=0))
        assert np.all(np.isfinite(after))
        assert np.all(after < 0.9 * before), name
    start = eqx.tree_at(shading, SCENE, (jnp.full((3, 3), 0.5), jnp.asarray(0.1), jnp.asarray(4.0)))
    found = fit(start, max_steps=40)
    for value, true, error in zip(shading(found.scene), shading(SCENE), found.standard_errors, strict=True):
        assert np.all(np.abs(value - true) < 3.5 * np.asarray(error))


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["minimiser", "whole residuals"])
def test_solvers_of_others_see_all_views(solver):
    import optimistix as optx

    chosen = optx.BFGS(rtol=1e-6, atol=1e-8) if solver == "minimiser" else optx.LevenbergMarquardt(rtol=1e-6, atol=1e-8)
    start = eqx.tree_at(lambda s: s.transfer.rgb, SCENE, jnp.full((3, 3), 0.5))
    # Colours alone: along extinctions as well a quasi-Newton method takes hundreds of steps.
    found = fit(start, pictures(LIGHTS, 0.0), unknowns=lambda s: s.transfer.rgb, solver=chosen, max_steps=60)
    np.testing.assert_allclose(found.scene.transfer.rgb, SCENE.transfer.rgb, atol=2e-3)


@pytest.mark.slow
def test_lights_that_do_not_go_together_are_refused():
    images = [np.zeros((8, 9, 3))] * 3
    for lights, error, wanted in (
        (LIGHTS[:2], ValueError, "lights for 2 views and 3 cameras"),
        (LIGHTS[0], TypeError, "a sequence with the lights of each view"),
        ([*LIGHTS[:2], (3.0,)], TypeError, "lights of view 2 must be jvr's lights"),
    ):
        with pytest.raises(error, match=wanted):
            fit(images=images, lights=lights)
    with pytest.raises(ValueError, match=r"leave these out of the unknowns"):
        fit(images=images, unknowns=lambda s: s.lights[0].irradiance)
    with pytest.raises(ValueError, match="nothing shows the lights of the views"):
        fit(dataclasses.replace(SCENE, shading=None), images, unknowns=lambda s: s.transfer.rgb)
    shadowed = dataclasses.replace(SCENE, shadows=jvr.ShadowVolume(1.0))
    with pytest.raises(ValueError, match="lights of view 1: there are shadows and no light"):
        fit(shadowed, images, lights=[LIGHTS[0], jvr.AmbientLight(1.0), LIGHTS[1]])
    with pytest.raises(ValueError, match="lights for 1 held-out views and 3 cameras"):
        fit(images=images, held_out=(CAMERAS, images, LIGHTS[:1]))
