"""Steps are the best within their bounds, and a fit says that it has converged where it has, and nowhere else."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import jvr
from jvr.fitting.least_squares import AlongDogleg, Damped, Model, Undamped
from jvr.fitting.normal_equations import Normal
from jvr.fitting.solvers import Functions, Limits

SETTINGS = jvr.Settings(1.0, termination=0.0)
ROWS = jvr.Settings(1.0, termination=0.0, adjoint=jvr.Rows())


def _model(seed: int, n: int = 9) -> Model:
    """A convex quadratic with a unit diagonal; some bounds are active, some unknowns start at one."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(2 * n, n)) @ np.diag(np.geomspace(1, 1e-2, n)) @ np.linalg.qr(rng.normal(size=(n, n)))[0]
    rows /= np.linalg.norm(rows, axis=0)
    lower, upper = -rng.uniform(0, 1, n), rng.uniform(0, 1, n)
    lower[0], upper[1], upper[2] = 0.0, 0.0, np.inf
    return Model(1.0, rng.normal(size=n), rows.T @ rows, lower, upper)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_steps_are_the_minimum_within_their_bounds(seed, damping):
    """By the conditions of Karush, Kuhn and Tucker: no unknown that is free to move has a slope left, and none at a bound is pushed in."""
    model = _model(seed)
    move = Undamped().move(model, 1.0) if damping == 0 else Damped().move(model, 1 / damping)
    assert np.all((model.lower <= move) & (move <= model.upper))
    slope = model.gradient + model.matrix @ move + damping * move
    at_lower, at_upper = move <= model.lower + 1e-9, move >= model.upper - 1e-9
    assert (at_lower | at_upper).any()
    assert np.abs(slope[~at_lower & ~at_upper]).max(initial=0.0) < 1e-8
    assert np.all(slope[at_lower] > -1e-8)
    assert np.all(slope[at_upper] < 1e-8)


@pytest.mark.parametrize("step_size", [0.01, 0.5, 1.2, 100.0])
def test_the_dogleg_stays_within_its_radius_and_bounds_and_descends(step_size):
    for seed in range(5):
        model = _model(seed)
        move = AlongDogleg().move(model, step_size)
        assert np.all((model.lower - 1e-12 <= move) & (move <= model.upper + 1e-12))
        assert np.linalg.norm(move) <= step_size * (1 + 1e-9)
        assert model.promise(move) > 0
    # Far out it is the minimum itself.
    np.testing.assert_allclose(AlongDogleg().move(model, 1e3), Undamped().move(model, 1.0), atol=1e-9)


def test_the_scaled_projected_gradient_is_a_cosine_and_stops_at_bounds():
    rng = np.random.default_rng(1)
    rows, r = rng.normal(size=(40, 3)), rng.normal(size=40)
    lengths = np.linalg.norm(rows, axis=0)
    model = Model(r @ r, 2 * rows.T @ r / lengths, 2 * rows.T @ rows / np.outer(lengths, lengths), *np.full((2, 3), [[-9], [9]]))
    cosines = np.abs(rows.T @ r) / (lengths * np.linalg.norm(r))
    assert model.steepest() == pytest.approx(cosines.max())
    inwards = model.gradient > 0
    closed = model._replace(lower=np.where(inwards, 0.0, -9.0), upper=np.where(inwards, 9.0, 0.0))
    assert closed.steepest() == 0


def _functions(expand, n: int) -> Functions:
    limits = lambda real: Limits(np.full(n, -np.inf), np.full(n, np.inf), np.full(n, np.inf))
    quadratic = lambda real, normal: (2 * normal.vector, 2 * normal.matrix)
    return Functions(None, None, (expand,), limits, quadratic, 0.0)


def _solved(solver, functions, start, steps=60):
    state = solver.init(functions, jnp.asarray(start, jnp.float32))
    while solver.outcome(state) is None and steps:
        state, steps = solver.step(functions, state), steps - 1
    return solver.outcome(state), state


@pytest.mark.parametrize("solver", [jvr.LevenbergMarquardt(), jvr.Dogleg()], ids=["lm", "dogleg"])
def test_a_slope_that_no_step_confirms_is_no_convergence(solver):
    """The gradient points uphill, as that of a wrong derivative does."""

    def expand(x):
        r = np.asarray(x, float) - np.array([3.0, -1.0])
        return float(r @ r), Normal(r @ r, r @ r, np.eye(2), -r)

    outcome, state = _solved(solver, _functions(expand, 2), [0.0, 0.0])
    assert outcome is jvr.Outcome.STALLED
    np.testing.assert_array_equal(state.unconstrained, [0.0, 0.0])


@pytest.mark.parametrize("rtol", [1e-1, 1e-3, 1e-6])
def test_rtol_is_the_decrease_that_ends_a_fit(rtol):
    """Residuals `(x^2, 1)`, singular at the bottom: a step halves `x`, and every step gains less than the one before."""

    def expand(x):
        x = np.asarray(x, float)
        loss = float(x[0] ** 4 + 1)
        return loss, Normal(loss, loss, np.diag(4 * x**2), 2 * x**3)

    functions, solver = _functions(expand, 1), jvr.LevenbergMarquardt(rtol=rtol)
    state, losses = solver.init(functions, jnp.asarray([2.0], jnp.float32)), []
    while solver.outcome(state) is None:
        losses.append(float(state.loss))
        state = solver.step(functions, state)
    losses.append(float(state.loss))
    gains = -np.diff(losses) / np.array(losses[:-1])
    assert solver.outcome(state) is jvr.Outcome.CONVERGED
    assert 0 < gains[-1] <= rtol
    assert np.all((gains[:-1] > rtol) | (gains[:-1] == 0))


def _smooth(n: int = 14) -> jvr.Volume:
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    values = np.sin(4 * x + y) + np.cos(3 * y - 2 * z) + np.sin(4 * z + x * y)
    return jvr.Volume((values - values.min()) / np.ptp(values))


VOLUME = _smooth()
CAMERAS = jvr.fibonacci_sphere(VOLUME.center, 30.0, 3, 45.0, 12, 12)
UNKNOWNS = lambda s: (s.transfer.rgb, s.transfer.sigma_t)


def _pictures(transfer) -> tuple[jvr.Scene, list[np.ndarray]]:
    truth = jvr.Scene(VOLUME, transfer, background=(0.1, 0.2, 0.3))
    return truth, [np.asarray(jax.jit(jvr.render)(truth, camera, SETTINGS).rgb) for camera in CAMERAS]


def _flat(scene: jvr.Scene) -> np.ndarray:
    return np.concatenate([np.ravel(a) for a in UNKNOWNS(scene)]).astype(float)


def _scipy(scene: jvr.Scene, images: list[np.ndarray]):
    """Residuals and rows for SciPy, in its own layout."""
    split = UNKNOWNS(scene)[0].size

    def residuals(x):
        parts = x[:split].reshape(-1, 3), x[split:]
        return jnp.ravel(jnp.asarray(jvr.residuals(eqx.tree_at(UNKNOWNS, scene, parts), CAMERAS, images, ROWS)))

    value, rows = jax.jit(residuals), jax.jit(jax.jacfwd(residuals))
    return lambda x: np.asarray(value(jnp.asarray(x, jnp.float32)), float), lambda x: np.asarray(
        rows(jnp.asarray(x, jnp.float32)), float
    )


@pytest.mark.slow
def test_a_fit_ends_where_scipys_bounded_least_squares_does():
    """The truth is a finer table, so that the bottom is not zero and some unknowns end at their bounds; from a grey and a dark start."""
    rng = np.random.default_rng(4)
    _, images = _pictures(jvr.LutTransfer(np.round(rng.random((20, 3))), 0.4 * rng.random(20) ** 2, (0.0, 1.0)))
    start = lambda grey, sigma: jvr.Scene(
        VOLUME, jvr.LutTransfer(np.full((10, 3), grey), np.full(10, sigma), (0.0, 1.0)), background=(0.1, 0.2, 0.3)
    )
    value, rows = _scipy(start(0.5, 0.1), images)
    upper = np.where(np.arange(40) < 30, 1.0, np.inf)
    x0 = _flat(start(0.5, 0.1))
    theirs = scipy.optimize.least_squares(value, x0, rows, bounds=(np.zeros(40), upper), x_scale="jac", ftol=1e-6).fun
    best = np.mean(np.square(theirs))
    for scene in (start(0.5, 0.1), start(0.1, 0.02)):
        result = jvr.fit(scene, CAMERAS, images, unknowns=UNKNOWNS, settings=SETTINGS, keep_samples=False)
        assert result.outcome is jvr.Outcome.CONVERGED
        x = _flat(result.scene)
        r, jacobian = value(x), rows(x)
        assert np.mean(np.square(r)) < 1.01 * best
        # Bounds are in use, and the projected gradient is what `rtol = 1e-3` says.
        assert np.sum((x == 0) | (x == upper)) >= 4
        slope = jacobian.T @ r
        free = ~(((x <= 0) & (slope > 0)) | ((x >= upper) & (slope < 0))) & (np.linalg.norm(jacobian, axis=0) > 0)
        cosines = np.abs(slope[free]) / (np.linalg.norm(jacobian[:, free], axis=0) * np.linalg.norm(r))
        room = np.where(slope > 0, x, upper - x)[free]
        wanted = np.abs(slope[free]) / np.sum(np.square(jacobian[:, free]), axis=0)
        # Next to a bound an unknown gains less than the cosine says.
        assert np.max(cosines * np.sqrt(np.minimum(room / wanted, 1.0))) < 1.5 * 1e-3**0.5


@pytest.mark.slow
def test_saturated_colours_and_vanishing_extinctions_come_back():
    rng = np.random.default_rng(2)
    truth, images = _pictures(jvr.LutTransfer(rng.uniform(0.2, 0.8, (6, 3)), rng.uniform(0.05, 0.3, 6), (0.0, 1.0)))
    wrong = jnp.asarray(np.round(rng.random((6, 3))), jnp.float32), truth.transfer.sigma_t.at[::2].set(0.0)
    start = eqx.tree_at(UNKNOWNS, truth, wrong)
    result = jvr.fit(start, CAMERAS, images, unknowns=UNKNOWNS, settings=SETTINGS, keep_samples=False)
    assert result.outcome is jvr.Outcome.CONVERGED
    # Entries at both ends of the domain are seen by a few samples alone.
    np.testing.assert_allclose(result.scene.transfer.sigma_t, truth.transfer.sigma_t, atol=2e-3)
    assert result.history[-1].psnr > 90
