"""Fits find what made the images, whichever way they are solved, and say how well they know it."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from fits import CAMERAS, ENTRIES, IMAGES, SETTINGS, START, TRUTH, VOLUME, both, fit
from scenes import perspective

import jvr
from jvr.fitting import checkpoint
from jvr.fitting.identifiability import identifiability
from jvr.fitting.normal_equations import normal_equations
from jvr.fitting.objective import value
from jvr.fitting.observations import keep_samples, observe
from jvr.fitting.problem import Problem
from jvr.fitting.unknowns import ExposedModel, choose_unknowns


def psnr(result: jvr.FitResult) -> float:
    squares = np.mean(np.square(np.asarray(jvr.residuals(result.scene, CAMERAS, IMAGES, SETTINGS))))
    return float(-10 * np.log10(squares))


def test_levenberg_marquardt_recovers_the_table():
    result = fit(max_steps=30)
    assert result.outcome is jvr.Outcome.CONVERGED
    assert psnr(result) > 80
    determined = np.isfinite(np.asarray(result.standard_errors[1]))
    assert determined.sum() >= ENTRIES - 2
    np.testing.assert_allclose(result.scene.transfer.sigma_t[determined], TRUTH.transfer.sigma_t[determined], atol=2e-3)
    losses = [entry.loss for entry in result.history]
    assert losses[-1] < 1e-4 * losses[0]


@pytest.mark.parametrize(
    ("solver", "steps", "least"),
    [
        pytest.param(jvr.GaussNewton(), 30, 60, id="gauss-newton"),
        pytest.param(jvr.Dogleg(), 40, 60, id="dogleg"),
        pytest.param(optx.BFGS(rtol=1e-8, atol=1e-10), 150, 38, marks=pytest.mark.slow, id="bfgs"),
        pytest.param(optx.LBFGS(rtol=1e-8, atol=1e-10), 150, 38, marks=pytest.mark.slow, id="lbfgs"),
        pytest.param(optx.OptaxMinimiser(optax.adam(0.2), rtol=0.0, atol=0.0), 150, 38, marks=pytest.mark.slow, id="adam"),
        pytest.param(optx.LevenbergMarquardt(rtol=1e-6, atol=1e-8), 40, 60, marks=pytest.mark.slow, id="optimistix-lm"),
        pytest.param(jvr.LBFGSB(upper=1.0), 80, 38, marks=pytest.mark.slow, id="lbfgsb"),
    ],
)
def test_every_solver_gets_near(solver, steps, least):
    # Gauss-Newton has no guard: it starts where a few damped steps have led.
    start = fit(max_steps=4).scene if isinstance(solver, type(jvr.GaussNewton())) else START
    result = fit(start, solver=solver, max_steps=steps)
    assert psnr(result) > least
    assert result.outcome in (jvr.Outcome.CONVERGED, jvr.Outcome.STEP_LIMIT)


def test_kept_samples_change_nothing_and_report_their_bytes():
    kept, resampled, limited = fit(max_steps=6), fit(max_steps=6, keep_samples=False), fit(max_steps=6, keep_samples=100)
    assert kept.stats.kept_bytes > 0
    assert resampled.stats.kept_bytes == limited.stats.kept_bytes == 0
    # 16 bits over the range of the volume: 8e-6 of it at most, times the slope of the table.
    np.testing.assert_allclose(kept.scene.transfer.sigma_t, resampled.scene.transfer.sigma_t, atol=2e-3)
    np.testing.assert_array_equal(resampled.scene.transfer.sigma_t, limited.scene.transfer.sigma_t)


@pytest.mark.slow
def test_kept_samples_are_the_samples():
    problem, observations = _problem(), observe(START, CAMERAS, IMAGES, None, SETTINGS)
    samples, kept = keep_samples(START, observations, SETTINGS, 2**30, clamped=True)
    values = problem.unknowns.values_from_unconstrained(problem.unknowns.unconstrained_from_model(problem.model), problem.model)
    direct = normal_equations(problem, values, observations)
    stored = normal_equations(problem.with_samples(samples), values, kept)
    np.testing.assert_allclose(stored.matrix, direct.matrix, rtol=1e-3, atol=1e-4 * np.abs(direct.matrix).max())


def _problem(loss=None, exposure=None, unknowns=both) -> Problem:
    model = ExposedModel(TRUTH, exposure)
    chosen = choose_unknowns(model, lambda m: (unknowns(m.scene), m.exposure))
    return Problem(model, chosen, SETTINGS, loss or jvr.SquaredError(), (), None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("names", "loss"), [("entries", jvr.SquaredError()), ("everything", jvr.Huber(0.05)), ("coloured", jvr.AbsoluteError(0.01))]
)
def test_normal_equations_have_the_gradient_of_the_objective(loss, names, x64):
    scene = jax.tree.map(lambda x: x.astype(float), TRUTH)
    if names == "coloured":
        coloured = scene.transfer.sigma_t[:, None] * jnp.array([1.0, 0.7, 1.3])
        scene = eqx.tree_at(lambda s: s.transfer.sigma_t, scene, coloured)
    model = ExposedModel(scene, jnp.ones(()) * 1.1 if names == "everything" else None)
    pick = lambda s: (*both(s), s.background, s.transfer.domain) if names == "everything" else both(s)
    unknowns = choose_unknowns(model, lambda m: (pick(m.scene), m.exposure))
    unknowns = eqx.tree_at(lambda u: u.bijectors, unknowns, (jvr.Identity(),) * len(unknowns.bijectors))
    problem = Problem(model, unknowns, SETTINGS, loss, (), None)
    observations = observe(scene, CAMERAS, [0.8 * image for image in IMAGES], None, SETTINGS)
    values = unknowns.unconstrained_from_model(model)
    normal = normal_equations(problem, values, observations)
    objective, gradient = jax.value_and_grad(lambda v: value(problem, v, observations, jnp.ones(())))(values)
    np.testing.assert_allclose(normal.loss, objective, rtol=1e-10)
    np.testing.assert_allclose(2 * normal.vector, gradient, rtol=1e-7, atol=1e-9 * np.abs(gradient).max())


@pytest.mark.parametrize("every", [1, 3])
def test_rays_that_fill_up_the_last_tile_count_for_nothing(every):
    """A tile of 100 rays does not divide 720 pixels, and every third of these is one of 240."""
    observations = observe(TRUTH, CAMERAS, IMAGES, None, SETTINGS, 100)
    tiles = [observations.tile(i, every) for i in range(observations.tile_count(every))]
    assert sum(float(tile.weight.sum()) for tile in tiles) == 720 / every
    targets = [np.asarray(tile.target)[np.asarray(tile.weight) > 0] for tile in tiles]
    if every == 1:
        everything = np.concatenate([image.reshape(-1, 3) for image in IMAGES])
        np.testing.assert_array_equal(np.sort(np.concatenate(targets), axis=0), np.sort(everything, axis=0))


@pytest.mark.slow
def test_chunks_do_not_matter(monkeypatch):
    whole = fit(max_steps=5)
    monkeypatch.setattr("jvr.fitting.observations.CHUNK", 160)
    np.testing.assert_allclose(fit(max_steps=5).scene.transfer.rgb, whole.scene.transfer.rgb, atol=2e-3)


def test_exposure_and_background_are_found():
    images = [1.7 * image for image in IMAGES]
    start = eqx.tree_at(lambda s: s.background, TRUTH, jnp.full(3, 0.4))
    result = fit(start, images, lambda s: (s.transfer.sigma_t, s.background), exposure=True, max_steps=40)
    assert result.exposure == pytest.approx(1.7, abs=1e-3)
    np.testing.assert_allclose(result.scene.background, TRUTH.background, atol=1e-3)
    assert len(result.standard_errors) == 2


def test_colours_and_exposure_together_are_reported_as_undetermined():
    pick = lambda s: (s.transfer.rgb, s.background)
    result = fit(TRUTH, IMAGES, pick, exposure=True, transforms=(jvr.Identity(), jvr.Identity()), max_steps=10)
    assert result.stats.rank < 3 * ENTRIES + 3 + 1
    assert np.all(np.isinf(result.standard_errors[1]))


@pytest.mark.slow
def test_robust_losses_ignore_outliers():
    rng = np.random.default_rng(1)
    spoiled = [np.where(rng.random(image.shape) < 0.05, 1.0, image).astype(np.float32) for image in IMAGES]
    error = lambda result: np.abs(np.asarray(result.scene.transfer.sigma_t) - np.asarray(TRUTH.transfer.sigma_t)).max()
    squared, huber, absolute = (
        error(fit(images=spoiled, loss=loss, max_steps=60))
        for loss in (jvr.SquaredError(), jvr.Huber(0.01), jvr.AbsoluteError(1e-3))
    )
    assert huber < squared / 3
    assert absolute < squared / 3


@pytest.mark.slow
def test_unknowns_are_told_apart_by_their_place():
    """Not by their shape, and not by which array they hold: here two fields hold the same one."""
    table = jnp.asarray(TRUTH.transfer.rgb)
    scene = eqx.tree_at(lambda s: (s.transfer.rgb, s.transfer.sigma_t), TRUTH, (table, table))
    assert scene.transfer.rgb is scene.transfer.sigma_t
    pick = lambda s: {"sigma_t": s.transfer.sigma_t, "more": (s.transfer.domain, s.transfer.rgb)}
    chosen = choose_unknowns(ExposedModel(scene, None), lambda m: pick(m.scene))
    # Dictionaries are flattened in the order of their keys.
    assert chosen.names == ("transfer.domain", "transfer.rgb", "transfer.sigma_t")
    assert len(set(chosen.indices)) == 3
    result = fit(scene, unknowns=pick, max_steps=1)
    assert result.unknowns == ("transfer.domain", "transfer.rgb", "transfer.sigma_t")
    np.testing.assert_array_equal(result.errors_by_name["transfer.sigma_t"], result.standard_errors["sigma_t"])
    assert jax.tree.map(np.shape, result.determined) == jax.tree.map(np.shape, result.standard_errors)


def test_weights_take_pixels_out():
    spoiled = [image.copy() for image in IMAGES]
    weights = [np.ones(image.shape[:2]) for image in IMAGES]
    for image, weight in zip(spoiled, weights, strict=True):
        image[:7], weight[:7] = 5.0, 0.0
    assert psnr(fit(images=spoiled, weights=weights, max_steps=30)) > 60
    assert psnr(fit(images=spoiled, max_steps=30)) < 30


@pytest.mark.slow
def test_priors_pull_where_images_are_silent():
    flat = eqx.tree_at(lambda s: s.volume.values, START, START.volume.values * 0.5)
    smooth = fit(flat, max_steps=30, priors=(jvr.ColourSmoothness(1e-3), jvr.ExtinctionSmoothness(1e-3)))
    rough = fit(flat, max_steps=30)
    roughness = lambda r: float(jnp.sum(jnp.square(jnp.diff(r.scene.transfer.rgb, axis=0))))
    assert roughness(smooth) < roughness(rough)
    sparse = fit(max_steps=30, priors=(jvr.Sparsity(0.1),))
    assert float(jnp.sum(sparse.scene.transfer.sigma_t)) < float(jnp.sum(fit(max_steps=30).scene.transfer.sigma_t))


def test_dssim_needs_a_solver_that_uses_gradients():
    with pytest.raises(ValueError, match="BFGS"):
        fit(loss=jvr.DSSIM())


@pytest.mark.slow
def test_dssim_falls():
    result = fit(loss=jvr.DSSIM(), solver=optx.OptaxMinimiser(optax.adam(0.2), rtol=0.0, atol=0.0), max_steps=12)
    assert result.history[-1].loss < 0.5 * result.history[0].loss


@pytest.mark.slow
@pytest.mark.parametrize("keywords", [{"loss": jvr.AbsoluteError()}, {"priors": (jvr.ColourSmoothness(1e-2),)}])
def test_psnr_is_that_of_the_pictures_whatever_is_made_small(keywords):
    result = fit(solver=optx.OptaxMinimiser(optax.adam(0.1), rtol=0.0, atol=0.0), max_steps=6, **keywords)
    rendered = np.concatenate([np.ravel(jvr.render(result.scene, c, SETTINGS).rgb) for c in CAMERAS])
    target = np.concatenate([np.ravel(image) for image in IMAGES])
    best = max(result.history, key=lambda entry: -entry.loss)
    assert best.psnr == pytest.approx(-10 * np.log10(np.mean(np.square(rendered - target))), abs=0.01)


@pytest.mark.slow
def test_standard_errors_cover_the_truth():
    """Of 200 noisy repeats, 68 % of the fitted values lie within one standard error of the truth."""
    rng = np.random.default_rng(0)
    inside = []
    for _ in range(200):
        noisy = [image + rng.normal(0, 0.01, image.shape).astype(np.float32) for image in IMAGES]
        result = fit(TRUTH, noisy, max_steps=3, transforms=(jvr.Identity(), jvr.Identity()))
        for found, true, error in zip(both(result.scene), both(TRUTH), result.standard_errors, strict=True):
            finite = np.isfinite(error)
            inside.append((np.abs(found - true) <= error)[finite])
    share = np.mean(np.concatenate([x.ravel() for x in inside]))
    # Values of one fit are correlated, so the share scatters more than a binomial's 0.006: 200 independent fits bound it by 0.033.
    assert abs(share - 0.6827) < 0.035


def test_determination_of_a_known_matrix():
    rows = np.random.default_rng(0).normal(size=(500, 4))
    rows[:, 3] = rows[:, 0] + rows[:, 1]
    known = identifiability(rows.T @ rows, squares=5.0, measurements=500)
    assert known.rank == 3
    assert np.all(np.isinf(known.standard_errors[[0, 1, 3]]))
    alone = np.sqrt(5.0 / 497 * np.linalg.pinv(rows.T @ rows)[2, 2])
    assert known.standard_errors[2] == pytest.approx(alone, rel=1e-6)
    assert known.least_determined[2] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("angle", "determined"), [(1.0, True), (3e-2, True), (1e-3, True), (1e-6, False)])
def test_nearly_parallel_columns_are_told_apart_down_to_the_rounding_of_float32(angle, determined):
    """Columns of one unit each, but for one of a thousandth; 3 and 4 enclose `angle`."""
    columns, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3000, 5)))
    columns[:, 4] = np.cos(angle) * columns[:, 3] + np.sin(angle) * columns[:, 4]
    columns[:, 0] *= 1e-3
    rounded = columns.astype(np.float32).astype(np.float64)
    known = identifiability(rounded.T @ rounded, squares=3.0, measurements=3000)
    exact = np.sqrt(3.0 / (3000 - known.rank) * np.diag(np.linalg.inv(columns.T @ columns)))
    assert known.rank == (5 if determined else 4)
    # Rounding turns a column by 3e-8, which is 3e-5 of the smallest angle that is determined.
    np.testing.assert_allclose(known.standard_errors[:3], exact[:3], rtol=1e-5)
    if determined:
        np.testing.assert_allclose(known.standard_errors[3:], exact[3:], rtol=1e-4)
    else:
        assert np.all(np.isinf(known.standard_errors[3:]))


@pytest.mark.slow
def test_standard_errors_are_those_of_a_dense_float64_computation():
    """Also of an entry whose colour changes the image a thousandth as much as others do; those beyond the volume are infinite."""
    weak, beyond = 2, 6
    faint = TRUTH.transfer.sigma_t.at[weak - 1 : weak + 2].set(1e-4)
    scene = eqx.tree_at(lambda s: (s.transfer.sigma_t, s.transfer.domain), TRUTH, (faint, jnp.array([0.0, 1.5])))
    target = IMAGES[0] + np.random.default_rng(5).normal(0, 0.01, IMAGES[0].shape).astype(np.float32)
    result = jvr.fit(
        scene, CAMERAS[:1], [target], unknowns=both, settings=SETTINGS, max_steps=0, transforms=(jvr.Identity(),) * 2
    )
    with jax.enable_x64(True):
        found, camera = jax.tree.map(lambda x: jnp.asarray(x, float), (result.scene, CAMERAS[0]))
        settings = jvr.Settings(SETTINGS.step, termination=SETTINGS.termination, adjoint=jvr.Forward())
        of_table = lambda table: jvr.residuals(eqx.tree_at(both, found, table), (camera,), [target], settings).ravel()
        r, parts = jax.jit(lambda table: (of_table(table), jax.jacfwd(of_table)(table)))(both(found))
    rows = np.concatenate([np.reshape(part, (r.size, -1)) for part in parts], axis=1)
    norms = np.linalg.norm(rows, axis=0)
    seen = norms > 0
    assert 3e-4 < norms[3 * weak] / norms[: 3 * ENTRIES].max() < 3e-3
    unit = rows[:, seen] / norms[seen]
    variance = np.sum(np.square(r)) / (r.size - seen.sum())
    known = np.concatenate([np.ravel(errors) for errors in result.standard_errors])
    np.testing.assert_array_equal(np.isfinite(known), seen)
    assert all(np.all(np.isinf(errors[beyond:])) for errors in result.standard_errors)
    # A relative rounding of 1e-5 in the columns, times their condition number of 60.
    np.testing.assert_allclose(known[seen], np.sqrt(variance * np.diag(np.linalg.inv(unit.T @ unit))) / norms[seen], rtol=1e-3)


def test_unseen_entries_are_infinite():
    domain = jnp.array([0.0, 3.0])
    start = eqx.tree_at(lambda s: s.transfer.domain, START, domain)
    result = fit(start, max_steps=5)
    assert np.all(np.isinf(result.standard_errors[1][-4:]))
    assert np.all(np.isfinite(result.standard_errors[1][:2]))


def test_colours_given_extinction_are_exact():
    start = eqx.tree_at(lambda s: s.transfer.rgb, TRUTH, jnp.full_like(TRUTH.transfer.rgb, 0.5))
    solved = jvr.colours_given_extinction(start, CAMERAS, IMAGES, SETTINGS)
    np.testing.assert_allclose(solved.transfer.rgb, TRUTH.transfer.rgb, atol=5e-3)


@pytest.mark.slow
def test_voxels_are_found_by_a_first_order_solver():
    start = eqx.tree_at(lambda s: s.volume.values, TRUTH, TRUTH.volume.values + 0.05)
    solver = optx.OptaxMinimiser(optax.adam(0.01), rtol=0.0, atol=0.0)
    result = fit(start, unknowns=lambda s: s.volume.values, solver=solver, max_steps=60)
    assert result.history[-1].loss < 0.02 * result.history[0].loss
    assert np.all(np.isnan(result.standard_errors))
    assert result.determined is None
    with pytest.raises(ValueError, match="LBFGS"):
        fit(start, unknowns=lambda s: s.volume.values)


@pytest.mark.parametrize("solver", [None, pytest.param(optx.BFGS(rtol=1e-8, atol=1e-10), marks=pytest.mark.slow)])
def test_a_fit_that_was_killed_goes_on_to_the_same_answer(tmp_path, solver):
    path = tmp_path / "fit.npz"
    whole = fit(solver=solver, max_steps=8)
    fit(solver=solver, max_steps=3, checkpoint=path)
    resumed = fit(solver=solver, max_steps=8, checkpoint=path, resume=True)
    np.testing.assert_array_equal(resumed.scene.transfer.sigma_t, whole.scene.transfer.sigma_t)
    assert [entry.loss for entry in resumed.history] == [entry.loss for entry in whole.history]
    with pytest.raises(checkpoint.CheckpointError, match=r"\(images changed since\)"):
        fit(images=[image + 0.1 for image in IMAGES], solver=solver, checkpoint=path, resume=True)
    path.write_bytes(b"nonsense")
    with pytest.raises(checkpoint.CheckpointError, match="damaged"):
        fit(solver=solver, checkpoint=path, resume=True)


def test_a_failed_save_keeps_the_last_checkpoint(tmp_path, monkeypatch):
    path = tmp_path / "fit.npz"
    checkpoint.save(path, {"x": np.ones(3)}, [], {"solver": "mark"})
    monkeypatch.setattr(np, "savez", lambda *_, **__: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        checkpoint.save(path, {"x": np.zeros(3)}, [], {"solver": "mark"})
    monkeypatch.undo()
    state, _ = checkpoint.load(path, {"x": np.zeros(3)}, {"solver": "mark"})
    np.testing.assert_array_equal(state["x"], np.ones(3))
    assert list(tmp_path.iterdir()) == [path]


def test_non_finite_values_end_the_fit_with_the_last_good_iterate():
    broken = eqx.tree_at(lambda s: s.volume.values, START, START.volume.values.at[5, 5, 5].set(jnp.nan))
    result = fit(broken)
    assert result.outcome is jvr.Outcome.NON_FINITE
    np.testing.assert_allclose(result.scene.transfer.rgb, START.transfer.rgb, atol=1e-5)


def test_held_out_views_are_scored():
    camera = jvr.PerspectiveCamera.look_at(VOLUME.center + jnp.array([0.0, -30.0, 3.0]), VOLUME.center, (0, 0, 1), 30.0, 16, 15)
    image = jvr.render(TRUTH, camera, SETTINGS).rgb
    ((decibels, similarity),) = fit(max_steps=30, held_out=((camera,), [image])).stats.held_out
    assert decibels > 60
    # A fit without an error: what is above 1 is the rounding of single precision.
    assert 0.99 < similarity <= 1 + 1e-6


@pytest.mark.slow
def test_held_out_views_may_differ_in_size():
    wide = jvr.PerspectiveCamera(CAMERAS[0].world_from_camera, 30.0, 9, 8)
    result = fit(max_steps=1, held_out=((*CAMERAS, wide), [*IMAGES, np.zeros((8, 9, 3))]), exposure=True)
    assert len(result.stats.held_out) == 4


def test_progress_is_called_with_every_iteration():
    seen = []
    result = fit(max_steps=3, progress=seen.append)
    assert tuple(seen) == result.history
    json.dumps([entry._asdict() for entry in seen])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": IMAGES[:2]}, "2 images for 3 cameras"),
        ({"images": [IMAGES[0], IMAGES[1], IMAGES[2][:, :5]]}, "target image 2 has shape"),
        ({"images": [IMAGES[0], IMAGES[1], np.full_like(IMAGES[2], np.nan)]}, "not finite"),
        ({"unknowns": lambda s: s.transfer.rgb * 1.0}, "arrays of the scene itself"),
        ({"unknowns": lambda s: ()}, "no array"),
        ({"unknowns": lambda s: (s.transfer.rgb, s.transfer.rgb)}, "twice"),
        ({"transforms": (None,)}, "1 transforms for 2"),
        ({"weights": [np.ones((2, 2))] * 3}, "weights 0"),
        ({"max_steps": -1}, "max_steps must be at least 0"),
    ],
)
def test_bad_input_is_named(change, message):
    with pytest.raises(ValueError, match=message) as caught:
        fit(**change)
    assert "\n" not in str(caught.value)


def test_integer_voxels_cannot_be_fitted():
    labels = jvr.Scene(jvr.Volume(np.arange(27, dtype=np.uint8).reshape(3, 3, 3)), TRUTH.transfer)
    with pytest.raises(ValueError, match="integer"):
        fit(labels, unknowns=lambda s: s.volume.values)


def test_bijectors_are_inverted():
    values = [
        (jvr.Softplus(2.0), [0.5, 3.0, 40.0]),
        (jvr.Sigmoid(), [0.1, 0.5, 0.99]),
        (jvr.Identity(), [-3.0, 0.0, 2.0]),
        (jvr.Ordered(0.5), [-1.0, 0.2, 7.0]),
    ]
    for bijector, expected in values:
        np.testing.assert_allclose(bijector.forward(bijector.inverse(jnp.array(expected))), expected, rtol=2e-5)
    # At the end of its range a bijector has no slope: the start is moved inside.
    assert np.all(np.isfinite(jvr.Sigmoid().inverse(jnp.array([0.0, 1.0]))))
    assert np.isfinite(jvr.Softplus(1.0).inverse(jnp.array(0.0)))


def test_residuals_are_rendered_minus_target():
    stacked = jvr.residuals(START, CAMERAS, IMAGES, SETTINGS)
    assert stacked.shape == (3, 15, 16, 3)
    np.testing.assert_allclose(stacked[1], jvr.render(START, CAMERAS[1], SETTINGS).rgb - IMAGES[1], atol=1e-6)
    wide = jvr.PerspectiveCamera(CAMERAS[0].world_from_camera, 30.0, 4, 3)
    parts = jvr.residuals(START, (CAMERAS[0], wide), [IMAGES[0], np.zeros((3, 4, 3))], SETTINGS)
    assert [part.shape for part in parts] == [(15, 16, 3), (3, 4, 3)]


@pytest.mark.slow
@pytest.mark.parametrize("of", ["colours", "voxels"])
def test_a_fit_skips_what_has_no_derivative(of):
    """Mostly empty at the start: the same iterations with skips and without."""
    values = np.zeros((17, 17, 17), np.float32)
    values[6:10, 6:10, 6:10] = np.random.default_rng(0).uniform(0.3, 1.0, (4, 4, 4))
    transfer = jvr.LinearTransfer([0.1, 0.5, 1.0], np.random.default_rng(1).random((3, 3)), [0.0, 0.2, 0.6])
    truth = jvr.Scene(jvr.Volume(values), transfer)
    camera = perspective(truth.volume, 10, 9)
    image = jvr.render(truth, camera).rgb
    if of == "colours":
        start, unknowns = eqx.tree_at(lambda s: s.transfer.rgb, truth, jnp.full((3, 3), 0.5)), lambda s: s.transfer.rgb
    else:
        start, unknowns = eqx.tree_at(lambda s: s.volume.values, truth, 0.8 * truth.volume.values), lambda s: s.volume.values
    # Most voxels are not seen: a first step as long as for unknowns that all count would be halved sixteen times.
    solver, steps = (None, 4) if of == "colours" else (optx.LBFGS(rtol=1e-6, atol=1e-8), 8)
    on, off = (
        jvr.fit(start, [camera], [image], unknowns=unknowns, settings=jvr.Settings(skipping=s), solver=solver, max_steps=steps)
        for s in (True, False)
    )
    np.testing.assert_allclose([h.loss for h in on.history], [h.loss for h in off.history], rtol=1e-3, atol=1e-10)
    np.testing.assert_allclose(unknowns(on.scene), unknowns(off.scene), atol=2e-3)
    assert on.history[-1].loss < 0.8 * off.history[0].loss
