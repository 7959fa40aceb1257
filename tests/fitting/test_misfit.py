"""Pictures that no unknowns explain: standard errors where residuals are structured, and values that the pictures do not determine."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from fits import CAMERAS, ENTRIES, IMAGES, SETTINGS, TRUTH, both, fit

import jvr
from jvr.fitting.continuation import MOST_INCREASE, Quadratic, continued
from jvr.fitting.identifiability import Scores, identifiability
from jvr.fitting.observations import LEAST_SIDE, observe
from jvr.fitting.problem import Problem
from jvr.fitting.unknowns import ExposedModel, choose_unknowns


def _blocks(picture: np.ndarray) -> list[np.ndarray]:
    """The squares of a picture, by slicing it."""
    height, width = picture.shape[:2]
    return [
        picture[i : i + LEAST_SIDE, j : j + LEAST_SIDE] for i in range(0, height, LEAST_SIDE) for j in range(0, width, LEAST_SIDE)
    ]


def _dense(scene: jvr.Scene, images: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals `(views, height, width, 3)`, colours, and rows with a last axis of unknowns, in float64."""
    with jax.enable_x64(True):
        found, cameras = jax.tree.map(lambda x: jnp.asarray(x, float), (scene, CAMERAS))
        settings = jvr.Settings(SETTINGS.step, termination=SETTINGS.termination, adjoint=jvr.Forward())
        of_table = lambda table: jvr.residuals(eqx.tree_at(both, found, table), cameras, images, settings)
        r, parts = jax.jit(lambda table: (of_table(table), jax.jacfwd(of_table)(table)))(both(found))
        r = np.asarray(r)
        return r, r + np.stack(images), np.concatenate([np.reshape(part, (*r.shape, -1)) for part in parts], axis=-1)


@pytest.mark.slow
def test_standard_errors_of_structured_residuals_are_those_of_a_dense_sandwich():
    """A brightness that jumps from square to square is no noise. Against sums over slices of pictures in NumPy."""
    rng = np.random.default_rng(3)
    images = [image.copy() for image in IMAGES]
    for image in images:
        for block in _blocks(image):
            block += rng.normal(0, 0.02, 3).astype(np.float32)
    result = fit(TRUTH, images, max_steps=0, smooth_undetermined=False)
    r, colours, rows = _dense(result.scene, images)
    n = rows.shape[-1]
    matrix = rows.reshape(-1, n).T @ rows.reshape(-1, n)
    scores = np.stack([block.sum((0, 1, 2)) for picture in rows * r[..., None] for block in _blocks(picture)])
    meat = scores.T @ scores * len(scores) / (len(scores) - 1)
    for c in range(3):
        live = np.any(rows[..., c, :] != 0, axis=-1)
        spread = np.mean(np.square(r[..., c][live]))
        offset, gain = rows[..., c, :].sum((0, 1, 2)), np.einsum("vyxi,vyx->i", rows[..., c, :], colours[..., c])
        meat += spread * (np.outer(offset, offset) + np.outer(gain, gain) / np.mean(np.square(colours[..., c][live])))
    inverse = np.linalg.inv(matrix)
    of_noise = np.sqrt(np.square(r).sum() / (r.size - n) * np.diag(inverse))
    expected = np.maximum(np.sqrt(np.diag(inverse @ meat @ inverse)), of_noise)
    known = np.concatenate([np.ravel(errors) for errors in result.standard_errors])
    assert result.stats.structured
    np.testing.assert_allclose(known, expected, rtol=2e-3)
    assert np.median(known / of_noise) > 1.5


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_noise_is_not_structured(seed):
    rng = np.random.default_rng(seed)
    noisy = [image + rng.normal(0, 0.01, image.shape).astype(np.float32) for image in IMAGES]
    stats = fit(TRUTH, noisy, max_steps=0).stats
    assert not stats.structured
    # Twelve blocks of three channels, whose sums vary by `sqrt(2 / 36)` of their mean.
    assert abs(stats.design_effect - 1) < 4 * np.sqrt(2 / 36)


def test_errors_of_correlated_noise_cover_the_truth():
    """A line through residuals that are common to blocks of 16: of 400 repeats at least 90 % lie within two standard errors, of which the
    plain ones cover far fewer."""
    rng, inside = np.random.default_rng(0), {"sandwich": 0, "plain": 0}
    blocks, size = 40, 16
    rows = np.stack([np.ones(blocks * size), np.repeat(np.linspace(-1, 1, blocks), size)], axis=1)
    matrix = rows.T @ rows
    for _ in range(400):
        noise = np.repeat(rng.normal(size=blocks), size) + 0.1 * rng.normal(size=blocks * size)
        r = rows @ np.linalg.solve(matrix, rows.T @ noise) - noise
        by_block = lambda x: x.reshape(blocks, size, -1).sum(1)
        nothing = np.zeros((1, 2))
        sums = np.array([[r.size, r @ r, 1.0, r @ r]])
        scores = Scores(by_block(rows * r[:, None]), by_block(r).T, nothing, nothing, sums)
        error = np.abs(np.linalg.solve(matrix, rows.T @ noise))
        for name, given in (("sandwich", scores), ("plain", None)):
            known = identifiability(matrix, float(r @ r), r.size, scores=given)
            inside[name] += np.mean(error <= 2 * known.standard_errors) / 400
    assert inside["sandwich"] > 0.9
    assert inside["plain"] < 0.5


def test_blocks_are_squares_of_pixels(monkeypatch):
    monkeypatch.setattr("jvr.fitting.observations.MOST_BLOCKS", 6)
    cameras = (*CAMERAS[:1], jvr.fibonacci_sphere((0.0, 0.0, 0.0), 30.0, 1, 30.0, 20, 9)[0])
    images = [np.zeros((camera.height, camera.width, 3), np.float32) for camera in cameras]
    seen = observe(TRUTH, cameras, images, None, SETTINGS)
    counted = np.bincount(np.ravel(seen.block)[np.ravel(seen.weight) > 0])
    # 15 x 16 pixels are one square of 16, 9 x 20 are two.
    np.testing.assert_array_equal(counted, [240, 144, 36])


def _quadratic(matrix: np.ndarray, loss: float = 1.0) -> Quadratic:
    return Quadratic(loss, np.zeros(len(matrix)), matrix, 0.0)


def _problem(unknowns=lambda m: m.scene.transfer.sigma_t) -> Problem:
    model = ExposedModel(TRUTH, None)
    return Problem(model, choose_unknowns(model, unknowns), SETTINGS, jvr.SquaredError(), (), None)


def test_what_nothing_determines_lies_between_its_neighbours():
    """Linear between entries that are determined, constant beyond the last; these stay to the bit."""
    values = np.array([0.9, 0.2, 0.9, 0.0, 0.5, 0.1, 0.7, 0.0])
    errors = np.array([np.inf, 0.01, np.inf, np.inf, 0.01, 0.01, np.inf, np.inf])
    known = np.isfinite(errors)
    around = _quadratic(np.diag(known.astype(float)))
    found, free = continued(_problem(), values, errors, around, lambda v: 1 + around.increase(v - values))
    np.testing.assert_allclose(found, [0.2, 0.2, 0.3, 0.4, 0.5, 0.1, 0.1, 0.1], atol=1e-6)
    np.testing.assert_array_equal(found[known], values[known])
    np.testing.assert_array_equal(free, ~known)


def test_what_is_weakly_determined_moves_as_far_as_the_objective_allows():
    """Against SciPy's minimum of the same roughness under the same bound on the objective."""
    rng = np.random.default_rng(1)
    values, errors = rng.random(8), np.where(np.arange(8) < 4, 0.01, 3.0)
    rows = rng.normal(size=(8, 8))
    matrix = 0.02 * rows.T @ rows
    around = _quadratic(matrix)
    found, _ = continued(_problem(), values, errors, around, lambda v: 1 + around.increase(v - values))
    assert 0.9 * MOST_INCREASE < around.increase(found - values) <= MOST_INCREASE
    with_free = lambda x: np.concatenate([values[:4], x])
    spare = {"type": "ineq", "fun": lambda x: MOST_INCREASE - around.increase(with_free(x) - values)}
    roughness = lambda x: np.sum(np.square(np.diff(with_free(x))))
    best = scipy.optimize.minimize(roughness, values[4:], bounds=[(0, None)] * 4, constraints=[spare], options={"ftol": 1e-14})
    np.testing.assert_allclose(roughness(found[4:]), best.fun, rtol=1e-3)


def test_values_stay_where_the_objective_grows_more_than_its_model():
    values, errors = np.linspace(0, 0.7, 8) ** 2, np.where(np.arange(8) < 4, 0.01, np.inf)
    around = _quadratic(np.diag(np.arange(8) < 4).astype(float))
    found, free = continued(_problem(), values, errors, around, lambda v: 1.01)
    np.testing.assert_array_equal(found, values)
    assert not free.any()


@pytest.mark.slow
def test_what_no_picture_shows_is_continued_by_a_fit():
    """The table reaches beyond the volume: its last entries, and their pictures."""
    wide = eqx.tree_at(lambda s: s.transfer.domain, TRUTH, jnp.array([0.0, 1.5]))
    rng = np.random.default_rng(2)
    noisy = [image + rng.normal(0, 0.01, image.shape).astype(np.float32) for image in IMAGES]
    left, quiet = (fit(wide, noisy, smooth_undetermined=smooth, max_steps=8) for smooth in (False, True))
    unseen = {name: ~np.isfinite(errors) for name, errors in quiet.errors_by_name.items()}
    assert 0 < unseen["transfer.sigma_t"].sum() < ENTRIES
    assert dict(quiet.stats.smoothed)["transfer.sigma_t"] >= unseen["transfer.sigma_t"].sum()
    assert left.stats.smoothed == ()
    for found in both(quiet.scene):
        last = np.asarray(found)[np.flatnonzero(~unseen["transfer.sigma_t"])[-1] :]
        np.testing.assert_allclose(last, np.broadcast_to(last[:1], last.shape), atol=1e-5)
    error = lambda result: np.mean(np.square(np.asarray(jvr.residuals(result.scene, CAMERAS, noisy, SETTINGS))))
    assert error(quiet) <= error(left) * (1 + MOST_INCREASE) * (1 + 1e-4)
    # What was continued is what is said not to be determined, of which errors that are infinite are a part.
    told = dict(zip(quiet.unknowns, quiet.determined, strict=True))
    assert {name: np.count_nonzero(~mark) for name, mark in told.items()} == dict(quiet.stats.smoothed)
    assert not any(np.any(told[name] & unseen[name]) for name in told)
    for name, errors in quiet.errors_by_name.items():
        np.testing.assert_allclose(errors, left.errors_by_name[name], rtol=1e-3)
