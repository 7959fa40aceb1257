"""Voxels without data: what is made of them is empty, and nothing else knows of them. Voxels that lie far out take nothing from others."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jvr
from jvr.model import voxels
from jvr.model.voxels import typical_range

N = 9
DEPTH = 0.3
LINE = jvr.LinearTransfer([0.0, 1.0], [[0.9, 0.5, 0.1]] * 2, [DEPTH, DEPTH])
CAMERA = jvr.OrthographicCamera.look_at([4.0, 4.0, -5.0], [4.0, 4.0, 4.0], [0.0, 1.0, 0.0], height_world=1e-3, width=1, height=1)
HOLE = np.s_[:, :, 4]


def constant(hole=HOLE) -> np.ndarray:
    values = np.full((N, N, N), 0.5, np.float32)
    values[hole] = np.nan
    return values


def stored(**keywords) -> jvr.Volume:
    """The same as integers with a padding."""
    values = np.nan_to_num(constant() * 1000, nan=-2000).astype(np.int16)
    return jvr.Volume(values, slope=1e-3, missing=-2000, **keywords)


VOLUMES = {"NaN": lambda: jvr.Volume(constant()), "padding": stored, "packed": lambda: stored().packed()}
QUADRATURES = {"midpoint": jvr.Midpoint(), "pre-integrated": jvr.PreIntegrated()}
DEFAULT = [("NaN", "pre-integrated"), ("packed", "midpoint")]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "quadrature"),
    [
        pytest.param(kind, quadrature, marks=[] if (kind, quadrature) in DEFAULT else pytest.mark.slow)
        for kind in VOLUMES
        for quadrature in QUADRATURES
    ],
)
def test_a_sample_with_a_missing_neighbour_is_empty(kind, quadrature):
    """A ray through 8 voxels' lengths of a constant medium: with one plane missing, two of them are empty."""
    settings = jvr.Settings(step=0.25, quadrature=QUADRATURES[quadrature])
    found = jvr.render(jvr.Scene(VOLUMES[kind](), LINE), CAMERA, settings)
    # The ends of a pre-integrated segment lie on the faces of empty cells: those two segments are empty as well.
    seen = N - 1 - 2 - (0.25 * (quadrature == "pre-integrated"))
    np.testing.assert_allclose(found.alpha[0, 0], 1 - np.exp(-DEPTH * seen), rtol=2e-3 if kind == "packed" else 1e-5)


def test_nearest_voxels_are_empty_where_they_are_missing():
    found = jvr.render(jvr.Scene(stored(interpolation=jvr.Nearest()), LINE), CAMERA, jvr.Settings(step=0.25))
    np.testing.assert_allclose(found.alpha[0, 0], 1 - np.exp(-DEPTH * (N - 1 - 1)), rtol=1e-5)


SLOWER = [
    pytest.param(n, marks=pytest.mark.slow) for n in (jvr.CentralDifferences(), jvr.SobelDifferences(), jvr.PrecomputedGradient())
]


@pytest.mark.slow
@pytest.mark.parametrize("normals", [jvr.AnalyticGradient(), *SLOWER])
def test_there_is_no_shell_around_what_is_missing(normals):
    """The gradient of a ramp is that of the ramp up to the edge of the data: what is left of it is lit alike everywhere."""
    ramp = np.broadcast_to(np.linspace(0, 1, N, dtype=np.float32)[:, None, None], (N,) * 3).copy()
    hidden = ramp.copy()
    hidden[3:6, 3:6, :3] = np.nan
    lit = {"lights": (jvr.DirectionalLight([1.0, 0.0, 0.0]),), "shading": jvr.Lambert(), "normals": normals}
    eyes = jvr.OrthographicCamera.look_at(
        [-4.0, 4.0, -6.0], [4.0, 4.0, 2.0], [0.0, 1.0, 0.0], height_world=5.0, width=8, height=8
    )
    opaque = jvr.LinearTransfer([0.0, 1.0], [[1.0, 1.0, 1.0]] * 2, [200.0, 200.0])
    draw = lambda values: jvr.render(jvr.Scene(jvr.Volume(values), opaque, **lit), eyes, jvr.Settings(step=0.25)).rgb
    # What is filled in are means of the neighbours: they tilt a normal by up to 7 degrees in the last cell. The number that marks missing
    # data would turn it round.
    np.testing.assert_allclose(draw(hidden), draw(ramp), atol=0.02)


@pytest.mark.slow
def test_light_passes_what_is_missing():
    """Single scattering of light from the eye's side: a sample at optical depth `t` shows `exp(-2 t)`, so `(1 - exp(-2 depth)) / 2` in
    all, of which a hole takes nothing but its own depth."""
    dark = jvr.LinearTransfer([0.0, 1.0], [[0.0, 0.0, 0.0]] * 2, [DEPTH, DEPTH])
    lit = {
        "lights": (jvr.DirectionalLight([0.0, 0.0, 1.0]),),
        "scattering": jvr.SingleScattering(jvr.Isotropic(), 0.5),
        "shadows": jvr.ShadowRays(0.125),
    }
    full, hidden = np.full((2, N, N, N), 0.5, np.float32)
    hidden[:, :, 1:3] = np.nan
    draw = lambda values: jvr.render(jvr.Scene(jvr.Volume(values), dark, **lit), CAMERA, jvr.Settings(step=0.25)).rgb[0, 0]
    seen = lambda length: 1 - np.exp(-2 * DEPTH * length)
    np.testing.assert_allclose(draw(hidden) / draw(full), seen(N - 1 - 3) / seen(N - 1), rtol=2e-3)


def smooth(hole: bool = True) -> jvr.Volume:
    values = np.random.default_rng(0).uniform(0, 1, (N, N, N)).astype(np.float32)
    values[2:4, 3:6, 4] = np.nan if hole else 0.5
    return jvr.Volume(values)


TABLE = jvr.LinearTransfer([0.0, 0.4, 1.0], [[0.9, 0.5, 0.1], [0.2, 0.8, 0.3], [0.1, 0.3, 0.7]], [0.1, 0.5, 0.9])
EYES = jvr.PerspectiveCamera.look_at([9.0, 13.0, -14.0], [4.0, 4.0, 4.0], [0.0, 1.0, 0.0], fov_y=40.0, width=9, height=9)


@pytest.mark.parametrize(
    "adjoint", [jvr.Replay(), *(pytest.param(a, marks=pytest.mark.slow) for a in (jvr.Rows(), jvr.Forward()))]
)
def test_derivatives_are_those_of_differences(adjoint, x64):
    values = np.array(smooth().values, np.float64)
    values[np.asarray(smooth().gaps) & 1 > 0] = np.nan
    start = jvr.Scene(jvr.Volume(values), TABLE)

    def loss(sigma_t):
        scene = eqx.tree_at(lambda s: s.transfer.sigma_t, start, sigma_t)
        return jnp.sum(jvr.render(scene, EYES, jvr.Settings(step=0.5, adjoint=adjoint)).rgb ** 2)

    at = jnp.asarray(TABLE.sigma_t, float)
    derivative = jax.jacfwd if isinstance(adjoint, jvr.Forward) else jax.grad
    found = derivative(loss)(at)
    h = 1e-5
    wanted = [(loss(at.at[i].add(h)) - loss(at.at[i].add(-h))) / (2 * h) for i in range(3)]
    np.testing.assert_allclose(found, wanted, rtol=1e-7)


@pytest.mark.slow
def test_every_derivative_is_finite_and_missing_voxels_have_none(x64):
    """In voxels by differences, where one is missing zero; in slope and intercept, too."""
    start = jvr.Scene(jvr.Volume(np.where(np.asarray(smooth().gaps) & 1 > 0, np.nan, np.asarray(smooth().values, float))), TABLE)

    def loss(volume):
        return jnp.sum(jvr.render(eqx.tree_at(lambda s: s.volume, start, volume), EYES, jvr.Settings(step=0.5)).rgb ** 2)

    float_of = eqx.filter_grad(loss)(start.volume)
    missing = np.asarray(start.volume.gaps) & 1 > 0
    assert np.all(np.asarray(float_of.values)[missing] == 0)
    assert np.count_nonzero(float_of.values) > 100
    # The objective is some hundred: differences over less have lost more digits than are compared.
    h = 1e-5
    # Beside the hole, in a voxel that counts in whole cells and in half empty ones.
    for voxel in [(2, 3, 3), (5, 4, 4), (1, 2, 4)]:
        move = lambda d, voxel=voxel: eqx.tree_at(lambda v: v.values, start.volume, start.volume.values.at[voxel].add(d))
        np.testing.assert_allclose(float_of.values[voxel], (loss(move(h)) - loss(move(-h))) / (2 * h), rtol=1e-6, atol=1e-9)
    for name in ("slope", "intercept"):
        part = lambda v, name=name: getattr(v, name)
        move = lambda d, part=part: eqx.tree_at(part, start.volume, part(start.volume) + d)
        np.testing.assert_allclose(part(float_of), (loss(move(h)) - loss(move(-h))) / (2 * h), rtol=1e-6)


@pytest.mark.slow
def test_fits_with_kept_samples_know_of_gaps():
    scene = jvr.Scene(smooth(), TABLE)
    images = [np.asarray(jvr.render(scene, EYES, jvr.Settings(step=0.5)).rgb)]
    start = eqx.tree_at(lambda s: s.transfer.sigma_t, scene, jnp.array([0.3, 0.3, 0.3]))
    fit = lambda keep: jvr.fit(
        start, [EYES], images, unknowns=lambda s: s.transfer.sigma_t, settings=jvr.Settings(step=0.5), keep_samples=keep
    )
    kept, anew = fit(True), fit(False)
    assert kept.stats.kept_bytes > 0
    np.testing.assert_allclose(kept.scene.transfer.sigma_t, TABLE.sigma_t, atol=1e-4)
    np.testing.assert_allclose(anew.scene.transfer.sigma_t, TABLE.sigma_t, atol=1e-5)


def test_radiance_transfer_of_a_volume_without_these_gaps_is_of_another():
    """Also where what is filled in happens to be what was there."""
    values = np.full((N, N, N), 0.5, np.float32)
    cache_key = lambda values: np.asarray(jvr.RadianceTransfer().cache_key(jvr.Scene(jvr.Volume(values), TABLE)))
    full, hidden = cache_key(values), cache_key(constant())
    np.testing.assert_array_equal(jvr.Volume(constant()).values, values)
    assert full.shape != hidden.shape or not np.array_equal(full, hidden)


def test_slices_are_refused():
    with pytest.raises(ValueError, match="some are missing"):
        jvr.render(jvr.Scene(smooth(), TABLE), EYES, jvr.Settings(sampling=jvr.Slices()))


# --- Values that lie far out ------------------------------------------------------------------------------------------


def with_hot_voxel(hot: float = 1e6) -> jvr.Volume:
    values = np.array(smooth(hole=False).values)
    values[0, 0, 0] = hot
    return jvr.Volume(values)


@pytest.mark.parametrize("hot", [1e6, -1e6])
def test_a_hot_voxel_does_not_decide_ranges(hot):
    plain, spoilt = smooth(hole=False), with_hot_voxel(hot)
    ends = jvr.flat_transfer(spoilt, 16).domain
    np.testing.assert_allclose(ends, jvr.flat_transfer(plain, 16).domain, atol=0.02)
    p = (jnp.array(4.3), jnp.array(5.1), jnp.array(6.7))
    np.testing.assert_allclose(spoilt.packed().sample(p), plain.sample(p), atol=1 / 400)


def test_a_range_has_all_that_is_more_than_a_few():
    """A small bright vessel is no hot voxel, nor is the tail of a distribution, nor one of two values."""
    values = np.zeros(100_000)
    values[:20] = 50.0
    assert typical_range(values) == (0.0, 50.0)
    tail = np.random.default_rng(0).exponential(1.0, 100_000)
    assert typical_range(tail) == (tail.min(), tail.max())
    assert typical_range(np.array([0.0, 1.0])) == (0.0, 1.0)


@pytest.mark.slow
def test_a_fit_is_as_good_with_a_hot_voxel():
    settings = jvr.Settings(step=0.5)
    errors = []
    for volume in (smooth(hole=False), with_hot_voxel()):
        scene = jvr.Scene(volume, TABLE)
        image = np.asarray(jvr.render(scene, EYES, settings).rgb)
        start = jvr.Scene(volume, jvr.flat_transfer(volume, 6))
        result = jvr.fit(
            start, [EYES], [image], unknowns=lambda s: (s.transfer.rgb, s.transfer.sigma_t), settings=settings, max_steps=30
        )
        errors.append(float(np.mean((np.asarray(jvr.render(result.scene, EYES, settings).rgb) - image) ** 2)))
    # One voxel, whose cell nothing else of the table fits, is all that may be left.
    assert errors[1] < 10 * errors[0] + 1e-5


# --- What NumPy holds -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [">i2", "<u2", ">f4", "?", "i8", "u8", "f8", ">f8", "f2"])
def test_a_volume_takes_what_numpy_holds(kind):
    values = np.random.default_rng(0).integers(0, 2 if kind == "?" else 100, (3, 4, 5)).astype(kind)
    found = jvr.Volume(values)
    np.testing.assert_array_equal(np.asarray(found.values, float), values.astype(float))
    assert found.values.dtype.itemsize <= 4


def test_a_volume_says_what_single_precision_loses():
    with pytest.warns(UserWarning, match="float32 resolves only"):
        jvr.Volume(np.linspace(0, 1, 27).reshape(3, 3, 3) + 1e9)


@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_gaps_are_filled_by_slabs_as_at_once(monkeypatch, dtype):
    rng = np.random.default_rng(0)
    values = rng.integers(1, 200, (13, 5, 4)).astype(dtype)
    values[rng.random(values.shape) < 0.6] = 0
    values[4:9] = 0
    whole = jvr.Volume(values, missing=0)
    for slab in (1, 50):
        monkeypatch.setattr(voxels, "SLAB", slab)
        np.testing.assert_array_equal(jvr.Volume(values, missing=0).values, whole.values)
