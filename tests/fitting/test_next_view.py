"""Which view to take next: against dense rows in float64, and against what fits to more views come to."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fits import CAMERAS, IMAGES, SETTINGS, START, TRUTH, VOLUME, both, fit

import jvr

NOISE = 0.01
CANDIDATES = jvr.fibonacci_sphere(VOLUME.center, 30.0, 4, 30.0, 12, 11)


@pytest.fixture(scope="module")
def known() -> jvr.FitResult:
    rng = np.random.default_rng(4)
    noisy = [image + rng.normal(0, NOISE, image.shape).astype(np.float32) for image in IMAGES[:1]]
    return jvr.fit(TRUTH, CAMERAS[:1], noisy, unknowns=both, settings=SETTINGS, max_steps=3, smooth_undetermined=False)


def _dense(scene: jvr.Scene, camera: jvr.PerspectiveCamera) -> np.ndarray:
    """`J^T J` of a view in float64."""
    with jax.enable_x64(True):
        scene, camera = jax.tree.map(lambda x: jnp.asarray(x, float), (scene, camera))
        settings = jvr.Settings(SETTINGS.step, termination=SETTINGS.termination, adjoint=jvr.Forward())
        picture = lambda table: jvr.render(eqx.tree_at(both, scene, table), camera, settings).rgb
        parts = jax.jit(jax.jacfwd(picture))(both(scene))
        rows = np.concatenate([np.reshape(part, (3 * camera.height * camera.width, -1)) for part in parts], axis=1)
    return rows.T @ rows


def test_gains_and_errors_are_those_of_dense_rows(known):
    """Colours may be uncertain by 1, extinctions by their value or by 0.1 over the smallest voxel, 0.9."""
    rgb, sigma_t = (np.asarray(x, float) for x in both(known.scene))
    size = np.concatenate([np.ones(rgb.size), np.maximum(sigma_t, 0.1 / 0.9)])
    variance = known.stats.residual_variance
    prior = np.diag(size**-2.0)
    before = _dense(known.scene, CAMERAS[0]) / variance + prior
    ranked = jvr.next_view(known, CANDIDATES, SETTINGS)
    assert sorted(candidate.number for candidate in ranked) == [0, 1, 2, 3]
    gains = [candidate.gain for candidate in ranked]
    assert gains == sorted(gains, reverse=True)
    for candidate in ranked:
        after = before + _dense(known.scene, CANDIDATES[candidate.number]) / variance
        bits = 0.5 * (np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1]) / np.log(2)
        np.testing.assert_allclose(candidate.gain, bits, rtol=1e-3)
        errors = np.sqrt(np.diag(np.linalg.inv(after)))
        np.testing.assert_allclose(np.ravel(candidate.errors["transfer.rgb"]), errors[: rgb.size], rtol=2e-3)
        np.testing.assert_allclose(candidate.errors["transfer.sigma_t"], errors[rgb.size :], rtol=2e-3)


def test_a_view_from_afar_brings_little_and_one_of_nothing_is_named(known):
    away = jvr.PerspectiveCamera.look_at((0, 0, 300), (0, 300, 300), (0, 0, 1), 20.0, 9, 9)
    small = jvr.PerspectiveCamera.look_at((0, 0, 300), VOLUME.center, (0, 1, 0), 20.0, 9, 9)
    with pytest.raises(ValueError, match="candidate 1: no camera sees the volume"):
        jvr.next_view(known, [small, away], SETTINGS)
    first, last = jvr.next_view(known, [small, CANDIDATES[0]], SETTINGS)
    assert (first.number, last.number) == (1, 0)
    assert 0 < last.gain < first.gain


@pytest.mark.slow
def test_the_best_view_makes_a_fit_surer_than_the_worst():
    """Real fits: the same noise, one more picture each. Views from afar have few pixels on the volume."""
    rng = np.random.default_rng(6)
    noisy = lambda image: image + rng.normal(0, NOISE, image.shape).astype(np.float32)
    render = jax.jit(lambda camera: jvr.render(TRUTH, camera, SETTINGS).rgb)
    targets = [noisy(IMAGES[0])]
    first = jvr.fit(START, CAMERAS[:1], targets, unknowns=both, settings=SETTINGS)
    candidates = [jvr.fibonacci_sphere(VOLUME.center, distance, 5, 30.0, 16, 15)[3] for distance in (25.0, 60.0, 150.0)]
    ranked = jvr.next_view(first, candidates, SETTINGS)
    assert [candidate.number for candidate in ranked] == [0, 1, 2]
    sure = []
    for candidate in ranked:
        more = [*targets, noisy(np.asarray(render(candidate.camera)))]
        found = jvr.fit(START, [CAMERAS[0], candidate.camera], more, unknowns=both, settings=SETTINGS)
        foretold, errors = candidate.errors["transfer.sigma_t"], found.errors_by_name["transfer.sigma_t"]
        sure.append(np.exp(np.mean(np.log(errors))))
        # The values move with the second picture, and so do their rows.
        np.testing.assert_allclose(sure[-1], np.exp(np.mean(np.log(foretold))), rtol=0.3)
    assert sure == sorted(sure)


def test_exposure_counts_among_the_unknowns():
    result = fit(TRUTH, exposure=True, max_steps=0)
    (best, *_) = jvr.next_view(result, CANDIDATES, SETTINGS)
    assert np.shape(result.information) == (33, 33)
    assert set(best.errors) == {"transfer.rgb", "transfer.sigma_t"}


def test_what_cannot_be_ranked_is_named(known):
    with pytest.raises(ValueError, match="no candidates"):
        jvr.next_view(known, [])
    with pytest.raises(ValueError, match="too many unknowns"):
        jvr.next_view(known._replace(information=None), CANDIDATES)


def test_residuals_of_zero_leave_gains_finite(known):
    exact = known._replace(stats=known.stats._replace(residual_variance=0.0))
    (best,) = jvr.next_view(exact, CANDIDATES[:1], SETTINGS)
    assert np.isfinite(best.gain)
    assert best.gain > 0
