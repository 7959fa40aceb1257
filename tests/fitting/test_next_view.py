"""Which view to take next: against dense rows in float64, and against what fits to more views come to."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fits import CAMERAS, IMAGES, SETTINGS, START, TRUTH, VOLUME, both, fit

import jvr
from jvr.fitting.next_view import best_of

NOISE = 0.01
CANDIDATES = jvr.fibonacci_sphere(VOLUME.center, 30.0, 4, 30.0, 12, 11)


@pytest.fixture(scope="module")
def known() -> jvr.FitResult:
    rng = np.random.default_rng(4)
    noisy = [image + rng.normal(0, NOISE, image.shape).astype(np.float32) for image in IMAGES[:1]]
    return jvr.fit(TRUTH, CAMERAS[:1], noisy, unknowns=both, settings=SETTINGS, max_steps=3, smooth_undetermined=False)


def _dense(scene: jvr.Scene, camera: jvr.PerspectiveCamera, every: int = 1) -> np.ndarray:
    """`J^T J` of a view in float64, of the middle one of `every` pixels in rows and columns, as many times as it stands for others."""
    with jax.enable_x64(True):
        scene, camera = jax.tree.map(lambda x: jnp.asarray(x, float), (scene, camera))
        settings = jvr.Settings(SETTINGS.step, termination=SETTINGS.termination, adjoint=jvr.Forward())
        picture = lambda table: jvr.render(eqx.tree_at(both, scene, table), camera, settings).rgb
        parts = jax.jit(jax.jacfwd(picture))(both(scene))
        rows = np.concatenate([np.reshape(part, (3 * camera.height * camera.width, -1)) for part in parts], axis=1)
    pixels = [np.minimum(np.arange(every // 2, n + every // 2, every), n - 1) for n in (camera.height, camera.width)]
    taken = rows.reshape(camera.height, camera.width, 3, -1)[np.ix_(*pixels)]
    rows = taken.reshape(-1, rows.shape[1])
    return rows.T @ rows * (camera.height * camera.width / taken[..., 0, 0].size)


def _plausible(scene: jvr.Scene) -> np.ndarray:
    rgb, sigma_t = (np.asarray(x, float) for x in both(scene))
    return np.concatenate([np.ones(rgb.size), np.maximum(sigma_t, 0.1 / 0.9)])


def test_gains_and_errors_are_those_of_dense_rows(known):
    """Colours may be uncertain by 1, extinctions by their value or by 0.1 over the smallest voxel, 0.9."""
    rgb, _ = both(known.scene)
    variance = known.stats.residual_variance
    prior = np.diag(_plausible(known.scene) ** -2.0)
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


@pytest.mark.slow
def test_a_view_from_afar_brings_little_and_one_of_nothing_is_named(known):
    away = jvr.PerspectiveCamera.look_at((0, 0, 300), (0, 300, 300), (0, 0, 1), 20.0, 9, 9)
    small = jvr.PerspectiveCamera.look_at((0, 0, 300), VOLUME.center, (0, 1, 0), 20.0, 9, 9)
    with pytest.raises(ValueError, match="candidate 1: no camera sees the volume"):
        jvr.next_view(known, [small, away], SETTINGS)
    first, last = jvr.next_view(known, [small, CANDIDATES[0]], SETTINGS)
    assert (first.number, last.number) == (1, 0)
    assert 0 < last.gain < first.gain


@pytest.mark.slow
def test_views_from_all_around_are_compared_by_default(known):
    """As far away as the camera of the fit, with its lens."""
    ranked = jvr.next_view(known)
    assert len(ranked) == 32
    eyes = np.array([np.asarray(one.camera.world_from_camera)[:3, 3] for one in ranked])
    center = np.asarray(VOLUME.center)
    np.testing.assert_allclose(np.linalg.norm(eyes - center, axis=1), 30.0, rtol=1e-5)
    # Spread over the sphere: their mean is its centre.
    assert np.linalg.norm(np.mean(eyes, axis=0) - center) < 1.5
    assert {(one.camera.width, one.camera.height, float(one.camera.fov_y)) for one in ranked} == {(16, 15, 30.0)}
    best, last = ranked[0], ranked[-1]
    assert best.gain > last.gain > 0
    assert all(np.all(best.errors[name] <= best.before[name]) for name in known.unknowns)
    shown = best_of(known)
    assert shown is not None
    assert (shown.number, shown.gain) == (best.number, best.gain)


@pytest.mark.slow
def test_few_pixels_stand_for_their_neighbours(known):
    """Every second one of each row and column."""
    prior, variance = np.diag(_plausible(known.scene) ** -2.0), known.stats.residual_variance
    before = _dense(known.scene, CAMERAS[0]) / variance + prior
    for one in jvr.next_view(known, CANDIDATES[:2], SETTINGS, pixels=33):
        after = before + _dense(known.scene, one.camera, every=2) / variance
        bits = 0.5 * (np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1]) / np.log(2)
        np.testing.assert_allclose(one.gain, bits, rtol=1e-3)


def test_values_outside_of_their_range_are_no_starts(known):
    """As a fit with transforms of its own leaves them."""
    bright = eqx.tree_at(lambda s: s.transfer.rgb, known.scene, 3 * known.scene.transfer.rgb)
    (best,) = jvr.next_view(known._replace(scene=bright), CANDIDATES[:1], SETTINGS)
    assert best.gain > 0


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


@pytest.mark.slow
def test_exposure_counts_among_the_unknowns():
    result = fit(TRUTH, exposure=True, max_steps=0)
    (best, *_) = jvr.next_view(result, CANDIDATES, SETTINGS)
    assert np.shape(result.information) == (33, 33)
    assert set(best.errors) == {"transfer.rgb", "transfer.sigma_t"}


def test_what_cannot_be_ranked_is_named(known):
    with pytest.raises(ValueError, match="no candidates"):
        jvr.next_view(known, [])
    with pytest.raises(ValueError, match="no cameras of a fit to go by"):
        jvr.next_view(known._replace(cameras=()))
    with pytest.raises(ValueError, match="pixels must be at least 1"):
        jvr.next_view(known, CANDIDATES, pixels=0)
    with pytest.raises(ValueError, match="too many unknowns"):
        jvr.next_view(known._replace(information=None), CANDIDATES)


def test_residuals_of_zero_leave_gains_finite(known):
    exact = known._replace(stats=known.stats._replace(residual_variance=0.0))
    (best,) = jvr.next_view(exact, CANDIDATES[:1], SETTINGS)
    assert np.isfinite(best.gain)
    assert best.gain > 0
