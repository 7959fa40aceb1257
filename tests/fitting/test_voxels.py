"""Fits of voxels: priors, bounds, grids from coarse to fine, and standard errors of single voxels."""

import dataclasses
import itertools
import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import SimpleITK as sitk
from scipy import ndimage

import jvr
from jvr import cli
from jvr.fitting.unknowns import ExposedModel, choose_unknowns
from jvr.io.config import ConfigError, build_fit, read_config
from jvr.io.demo import demo_volume
from jvr.io.volumes.written import write_metaimage
from jvr.model.grids import coarser, on_grid, resampled

OBLIQUE = np.array([[1.0, 0.3, 0.0, 5.0], [0.0, 1.5, -0.2, -3.0], [0.1, 0.0, 0.7, 2.0], [0.0, 0.0, 0.0, 1.0]])
RAMP = jvr.LinearTransfer([0.0, 1.0], [[0.2, 0.4, 0.9], [0.9, 0.5, 0.1]], [0.0, 0.4])
VOXELS = lambda s: s.volume.values
SETTINGS = jvr.Settings(1.0, termination=0.0)


def scene_of(values, matrix=OBLIQUE, transfer=RAMP, **keywords) -> jvr.Scene:
    return jvr.Scene(jvr.Volume(values, matrix, **keywords), transfer)


def linear_field(shape, matrix, slope):
    """`slope . x` at the voxels of a grid, in double precision."""
    places = np.indices(shape).reshape(3, -1)
    return (slope @ (matrix[:3, :3] @ places + matrix[:3, 3:])).reshape(shape)


# --- Priors ----------------------------------------------------------------------------------------------------------


def steepness(values, matrix):
    """`|L grad s|^2` of each cell by its corners, in double precision, one after the other."""
    inverse = np.linalg.inv(matrix[:3, :3])
    longest = max(np.linalg.norm(matrix[:3, a]) * (n - 1) for a, n in enumerate(values.shape))
    found = np.zeros([n - 1 for n in values.shape])
    for cell in np.ndindex(found.shape):
        for corner in itertools.product((0, 1), repeat=3):
            edges = np.zeros(3)
            for axis in range(3):
                ends = [tuple(cell[a] + (end if a == axis else corner[a]) for a in range(3)) for end in (0, 1)]
                edges[axis] = values[ends[1]] - values[ends[0]]
            found[cell] += np.sum((longest * inverse.T @ edges) ** 2) / 8
    return found


@pytest.mark.slow
def test_priors_are_what_their_equations_say():
    values = np.random.default_rng(0).random((4, 3, 5))
    scene, steep = scene_of(values), steepness(values, OBLIQUE)
    variation = 0.7 * np.mean(np.sqrt(steep + 0.2**2) - 0.2)
    np.testing.assert_allclose(jvr.TotalVariation(0.7, epsilon=0.2).value(scene), variation, rtol=1e-5)
    np.testing.assert_allclose(jvr.Tikhonov(0.7).value(scene), 0.7 * steep.mean(), rtol=1e-5)
    about = 0.7 * steep.mean() + 0.4 * np.mean((values - 0.3) ** 2)
    np.testing.assert_allclose(jvr.Tikhonov(0.7, 0.4, reference=0.3).value(scene), about, rtol=1e-5)
    # A reference on another grid is that of the same places.
    coarse, fine = (linear_field((n,) * 3, np.eye(4) * s, np.array([0.1, 0.0, 0.05])) for n, s in ((3, 2.0), (5, 1.0)))
    np.testing.assert_allclose(jvr.Tikhonov(values=1.0, reference=coarse).value(scene_of(fine, np.eye(4))), 0, atol=1e-12)


@pytest.mark.parametrize("shape", [(4, 3, 5), (13, 9, 17), (6, 1, 5)])
def test_units_and_resolution_do_not_change_what_a_strength_means(shape):
    """A linear field over one domain, on grids of any resolution, in millimetres and metres, in the data's unit and in 0 ... 1: closed
    form."""
    ends = OBLIQUE[:3, :3] @ np.diag([20.0, 12.0, 30.0])
    matrix = np.eye(4)
    matrix[:3, :3] = ends / np.maximum(np.array(shape) - 1, 1)
    slope = np.array([0.004, -0.007, 0.01])
    if shape[1] == 1:
        # Along an axis of one voxel nothing changes.
        slope = np.cross(ends[:, 1], [0.003, 0.002, 0.01]) / np.linalg.norm(ends[:, 1])
    values = linear_field(shape, matrix, slope)
    longest = np.linalg.norm(np.where(np.array(shape) > 1, ends, 0), axis=0).max()
    wanted = np.sqrt((longest * np.linalg.norm(slope)) ** 2 + 0.3**2) - 0.3
    metres, in_data_units = np.diag([1e-3, 1e-3, 1e-3, 1.0]) @ matrix, jvr.LinearTransfer([-1000, 1000], RAMP.rgb, RAMP.sigma_t)
    scenes = [scene_of(values, matrix), scene_of(values, metres), scene_of(2000 * values - 1000, matrix, in_data_units)]
    for scene in [*scenes, scene_of(values, matrix, in_data_units, slope=2000.0, intercept=-1000.0)]:
        np.testing.assert_allclose(jvr.TotalVariation(1.0).value(scene), wanted, rtol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("prior", [jvr.TotalVariation(1.0, epsilon=0.1), jvr.Tikhonov(1.0, 0.1)], ids=["variation", "tikhonov"])
def test_priors_are_convex_and_smooth_where_nothing_changes(prior):
    random = np.random.default_rng(1).random((3, 3, 2))
    of_voxels = lambda values: prior.value(eqx.tree_at(VOXELS, scene_of(random), values.reshape(random.shape)))
    for values in (np.full(random.size, 0.4), random.ravel(), 1e-4 * random.ravel()):
        value, gradient, curvature = (
            f(of_voxels)(jnp.asarray(values, jnp.float32)) for f in (lambda f: f, jax.grad, jax.hessian)
        )
        assert np.isfinite(value)
        assert np.all(np.isfinite(gradient))
        eigenvalues = np.linalg.eigvalsh(np.asarray(curvature, np.float64))
        assert eigenvalues.min() >= -1e-6 * eigenvalues.max()
        # No checkerboard is flat: constants alone are.
        assert eigenvalues[1] > 1e-4 * eigenvalues.max()
    constant = prior.value(scene_of(np.full((3, 3, 2), 0.0)))
    assert constant == 0


def test_priors_say_what_they_need():
    blobs = jvr.GaussianTransfer([0.5], [0.1], [1.0], [[1.0, 1.0, 1.0]])
    with pytest.raises(ValueError, match="give the prior contrast="):
        jvr.TotalVariation(1.0).value(scene_of(np.zeros((2, 2, 2)), transfer=blobs))
    assert jvr.TotalVariation(1.0, contrast=2.0).value(scene_of(np.zeros((2, 2, 2)), transfer=blobs)) == 0
    with pytest.raises(ValueError, match="epsilon must be positive"):
        jvr.TotalVariation(1.0, epsilon=0.0)
    with pytest.raises(ValueError, match="needs a strength"):
        jvr.Tikhonov()


# --- Grids -----------------------------------------------------------------------------------------------------------


def test_a_finer_grid_reproduces_linear_fields():
    with jax.enable_x64(True):
        volume = jvr.Volume(linear_field((5, 4, 3), OBLIQUE, np.array([0.1, -0.3, 0.2])), OBLIQUE)
        for shape in ((9, 7, 5), (12, 5, 8), (3, 3, 2)):
            other = on_grid(volume, shape)
            wanted = linear_field(shape, np.asarray(other.world_from_grid), np.array([0.1, -0.3, 0.2]))
            np.testing.assert_allclose(other.values, wanted, atol=1e-13)
            corners = np.array([[0, 0, 0], np.array(shape) - 1])
            matrix = np.asarray(other.world_from_grid)
            old = OBLIQUE[:3, :3] @ (np.array([[0, 0, 0], [4, 3, 2]]).T) + OBLIQUE[:3, 3:]
            np.testing.assert_allclose(matrix[:3, :3] @ corners.T + matrix[:3, 3:], old, atol=1e-13)


def test_between_voxels_it_is_scipy_s_linear_interpolation():
    values, shape = np.random.default_rng(2).random((5, 1, 4)), (7, 1, 11)
    places = np.meshgrid(*[np.linspace(0, n - 1, m) for n, m in zip(values.shape, shape, strict=True)], indexing="ij")
    with jax.enable_x64(True):
        found = resampled(jnp.asarray(values), shape)
    np.testing.assert_allclose(found, ndimage.map_coordinates(values, places, order=1), atol=1e-14)


def test_grids_keep_the_place_of_a_volume():
    far = np.array(OBLIQUE)
    far[:3, 3] = [1234.56789, -98765.4321, 1e-3]
    volume = jvr.Volume(np.zeros((6, 9, 1)), far, slope=2.0, intercept=-1.0, unit="HU")
    assert coarser(volume.shape) == (4, 5, 1)
    coarse = on_grid(volume, coarser(volume.shape))
    back = on_grid(coarse, volume.shape)
    np.testing.assert_array_equal(back.world_from_grid, volume.world_from_grid)
    np.testing.assert_allclose(back.origin.low, volume.origin.low, rtol=1e-6)
    assert (float(coarse.slope), float(coarse.intercept), coarse.unit) == (2.0, -1.0, "HU")


# --- Fits ------------------------------------------------------------------------------------------------------------


def bump(n: int) -> np.ndarray:
    """A soft ball, 0 ... 0.8, on a grid of `n` voxels an edge over one domain."""
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij"))
    return 0.8 * np.exp(-3 * np.sum(np.square(x - 0.15), axis=0))


TRUTH = jvr.Scene(jvr.Volume(bump(17), np.diag([0.75, 0.75, 0.75, 1.0])), RAMP, background=(1.0, 1.0, 1.0))
CAMERAS = jvr.orbit(TRUTH.volume.center, 40.0, 4, 24.0, 9, 9)
IMAGES = [np.asarray(jax.jit(jvr.render)(TRUTH, camera, SETTINGS).rgb) for camera in CAMERAS]
# More voxels on both of two grids than a Gauss-Newton matrix is made for.
START = eqx.tree_at(VOXELS, TRUTH, jnp.full((17, 17, 17), 0.2))
LBFGS = optx.LBFGS(rtol=1e-6, atol=1e-8)


def fit(function=jvr.fit, start=START, images=IMAGES, unknowns=VOXELS, **keywords) -> jvr.FitResult:
    keywords = {"settings": SETTINGS, "progress": False, "solver": LBFGS, **keywords}
    return function(start, CAMERAS, images, unknowns=unknowns, **keywords)


@pytest.mark.slow
def test_grids_from_coarse_to_fine_are_one_fit():
    seen = []
    prior = jvr.TotalVariation(1e-5)
    result = fit(jvr.fit_on_grids, levels=2, max_steps=10, priors=(prior,), progress=seen.append)
    assert seen == list(result.history)
    assert [entry.step for entry in seen] == list(range(1, len(seen) + 1))
    assert len(seen) > 10
    assert np.all(np.diff([entry.seconds for entry in seen]) > 0)
    assert result.stats.seconds >= seen[-1].seconds
    assert result.unknowns == ("volume.values",)
    np.testing.assert_array_equal(result.scene.volume.world_from_grid, START.volume.world_from_grid)
    # The objective of the last line is that of the pictures and the prior, its PSNR that of the pictures alone.
    pictures = [np.asarray(jvr.render(result.scene, camera, SETTINGS).rgb) for camera in CAMERAS]
    squares = np.mean(np.square(np.array(pictures) - IMAGES))
    np.testing.assert_allclose(seen[-1].psnr, -10 * np.log10(squares), atol=0.02)
    np.testing.assert_allclose(seen[-1].loss, squares + prior.value(result.scene), rtol=1e-3)
    assert seen[-1].loss < 0.5 * seen[0].loss


@pytest.mark.slow
def test_an_interrupted_fit_on_grids_goes_on(tmp_path):
    whole = fit(jvr.fit_on_grids, levels=2, max_steps=6, checkpoint=tmp_path / "whole.npz")

    class Enough(Exception):
        pass

    for stop in (3, 9):
        path = tmp_path / f"stopped_{stop}.npz"

        def interrupt(entry, stop=stop):
            if entry.step == stop:
                raise Enough

        with pytest.raises(Enough):
            fit(jvr.fit_on_grids, levels=2, max_steps=6, checkpoint=path, progress=interrupt)
        again = fit(jvr.fit_on_grids, levels=2, max_steps=6, checkpoint=path, resume=True)
        np.testing.assert_array_equal(again.scene.volume.values, whole.scene.volume.values)
        assert [entry[:3] for entry in again.history] == [entry[:3] for entry in whole.history]


@pytest.mark.parametrize(
    ("change", "keywords", "message"),
    [
        (lambda s: s, {"levels": 6}, "levels must be from 1 to 5 for 17 x 17 x 17 voxels, not 6"),
        (lambda s: s, {"unknowns": lambda s: s.transfer.rgb}, "which are not asked for: name volume.values"),
        (lambda s: eqx.tree_at(lambda s: s.volume, s, s.volume.packed()), {}, "holds integers .*values=volume.values.astype"),
        (
            lambda s: eqx.tree_at(lambda s: s.volume, s, jvr.Volume(np.where(bump(7) > 0.5, np.nan, 0.0))),
            {},
            "voxels are missing, which have no place on another grid",
        ),
    ],
    ids=["levels", "no voxels", "packed", "gaps"],
)
def test_grids_say_what_they_cannot(change, keywords, message):
    with pytest.raises(ValueError, match=message):
        fit(jvr.fit_on_grids, change(START), **keywords)


def test_the_remedy_for_stored_voxels_is_one():
    packed = TRUTH.volume.packed()
    free = dataclasses.replace(packed, values=packed.values.astype(float))
    np.testing.assert_allclose(free.slope * free.values + free.intercept, TRUTH.volume.values, atol=0.8 / 510 + 1e-6)
    assert free.values.dtype == jnp.float32


# --- Bounds ----------------------------------------------------------------------------------------------------------


STORED = jvr.Volume(np.full((17, 17, 17), 20.0), START.volume.world_from_grid, slope=-0.01, intercept=0.4)


def range_of(scene, unknowns, solver=jvr.LBFGSB()):
    """Of stored voxels, as a fit without a word about it keeps them."""
    bijector = choose_unknowns(ExposedModel(scene, None), lambda m: unknowns(m.scene), None, solver.bounds).bijectors[0]
    return (bijector.low, bijector.high) if isinstance(bijector, jvr.Bounded) else type(bijector)


def test_voxels_keep_to_the_ends_of_the_table():
    """Stored voxels have a unit of their own; where the ends may move, or what maps them to voxels, there are none to keep to."""
    scene, free = eqx.tree_at(lambda s: s.volume, START, STORED), (-np.inf, np.inf)
    assert range_of(scene, VOXELS) == (pytest.approx(-60.0), pytest.approx(40.0))
    assert range_of(scene, VOXELS, jvr.LBFGSB(upper=0.0)) == (pytest.approx(-60.0), 0.0)
    assert range_of(scene, lambda s: (s.volume.values, s.transfer.rgb)) == (pytest.approx(-60.0), pytest.approx(40.0))
    assert range_of(scene, lambda s: (s.volume.values, s.transfer.positions)) == free
    assert range_of(scene, lambda s: (s.volume.values, s.volume.slope)) == free
    blobs = jvr.GaussianTransfer([0.5], [0.1], [1.0], [[1.0, 1.0, 1.0]])
    assert range_of(eqx.tree_at(lambda s: s.transfer, scene, blobs), VOXELS) == free
    other = choose_unknowns(ExposedModel(scene, None), lambda m: m.scene.volume.values)
    assert type(other.bijectors[0]) is jvr.Identity


@pytest.mark.slow
def test_a_bounded_fit_stays_where_it_is_kept():
    """Noise drives some voxels to both ends."""
    noisy = [np.clip(image + 0.1 * np.random.default_rng(i).standard_normal(image.shape), 0, 1) for i, image in enumerate(IMAGES)]
    start = eqx.tree_at(lambda s: s.volume, START, STORED)
    found = fit(start=start, images=noisy, solver=jvr.LBFGSB(), max_steps=60, transforms=(jvr.Bounded(0.0, 30.0),)).scene.volume
    assert (float(found.values.min()), float(found.values.max())) == (0.0, 30.0)


def test_solvers_without_bounds_name_the_remedy():
    with pytest.raises(ValueError, match=r"knows no bounds.*solver=jvr\.LBFGSB\(\), or transforms=jvr\.Sigmoid\(low, high\)"):
        fit(transforms=(jvr.Bounded(0.0, 1.0),))


# --- Standard errors -------------------------------------------------------------------------------------------------


def dense(scene, cameras, prior, ridge, deviation):
    """Standard errors by the whole matrix, of pixels that are differentiated one by one."""
    of_voxels = lambda f: lambda v: f(eqx.tree_at(VOXELS, scene, v.reshape(scene.volume.shape)))
    pictures = of_voxels(lambda s: jvr.residuals(s, cameras, [jnp.zeros((5, 6, 3))] * len(cameras), SETTINGS).ravel())
    values = scene.volume.values.ravel()
    rows = np.asarray(jax.jacrev(pictures)(values))
    matrix = rows.T @ rows + ridge * np.eye(values.size)
    if prior is not None:
        matrix += rows.shape[0] / 2 * np.asarray(jax.hessian(of_voxels(prior.value))(values))
    return deviation * np.sqrt(np.diag(np.linalg.inv(matrix))), np.any(rows != 0, axis=0), rows, matrix


@pytest.mark.slow
@pytest.mark.parametrize(
    "prior", [None, jvr.TotalVariation(1e-4), jvr.Tikhonov(1e-5, 1e-3)], ids=["pictures", "variation", "tikhonov"]
)
def test_errors_of_voxels_are_those_of_the_whole_matrix(prior):
    """In double precision."""
    with jax.enable_x64(True):
        values = bump(5)[:, :4, :3]
        transfer = jvr.LinearTransfer([0.0, 1.0], np.asarray(RAMP.rgb), [0.0, 0.4])
        scene = jvr.Scene(jvr.Volume(values, np.diag([2.0, 1.8, 2.2, 1.0])), transfer)
        cameras = jvr.orbit(scene.volume.center, 30.0, 3, 14.0, 6, 5)
        images = [np.asarray(jvr.render(scene, camera, SETTINGS).rgb) for camera in cameras]
        result = jvr.fit(scene, cameras, images, unknowns=VOXELS, settings=SETTINGS, solver=LBFGS, max_steps=1, progress=False)
        deviation = 0.003
        given = {"priors": () if prior is None else (prior,), "noise": deviation}
        wanted, seen, _, _ = dense(result.scene, cameras, prior, deviation**2, deviation)
        wanted = np.where((wanted <= 0.25) & (seen | (prior is not None)), wanted, np.inf)
        assert np.isfinite(wanted).sum() > 3
        places = list(np.ndindex(*scene.volume.shape))
        exact = jvr.voxel_errors(result, cameras, images, voxels=places[::3], **given)
        np.testing.assert_allclose(exact.errors, wanted[::3], rtol=1e-3)
        assert exact.converged
        few, many = (jvr.voxel_errors(result, cameras, images, SETTINGS, probes=n, **given) for n in (16, 256))
        known = np.isfinite(wanted.reshape(values.shape)) & np.isfinite(many.errors)
        off = many.errors[known] / wanted.reshape(values.shape)[known] - 1
        # As far off as it says; an error is half that of its square.
        assert np.sqrt(np.mean(np.square(off))) < 2 * many.uncertainty
        assert many.uncertainty < 0.5 * few.uncertainty


@pytest.mark.slow
def test_errors_of_voxels_are_the_spread_of_fits_to_fresh_noise():
    """A closed end: 80 fits to noise of a known size, whose spread is known to 8 per cent."""
    values = 0.5 + 0.2 * np.sin(np.arange(64.0)).reshape(4, 4, 4)
    truth = jvr.Scene(jvr.Volume(values, np.diag([3.0, 3.0, 3.0, 1.0])), RAMP, background=(1.0, 1.0, 1.0))
    cameras = jvr.fibonacci_sphere(truth.volume.center, 40.0, 7, 22.0, 10, 10)
    images = [np.asarray(jvr.render(truth, camera, SETTINGS).rgb) for camera in cameras]
    noise, rng, found = 0.002, np.random.default_rng(5), []
    for _ in range(80):
        noisy = [image + noise * rng.standard_normal(image.shape) for image in images]
        result = jvr.fit(truth, cameras, noisy, unknowns=VOXELS, settings=SETTINGS, max_steps=10, progress=False)
        found.append(np.asarray(result.scene.volume.values))
    estimate = jvr.voxel_errors(result, cameras, noisy, SETTINGS, probes=128)
    assert estimate.noise == pytest.approx(noise, rel=0.05)
    assert estimate.freedom == pytest.approx(64, abs=1)
    known = np.isfinite(estimate.errors)
    assert known.sum() > 40
    ratio = np.std(found, axis=0, ddof=1)[known] / estimate.errors[known]
    np.testing.assert_allclose(np.median(ratio), 1, atol=0.06)
    assert np.all((ratio > 0.6) & (ratio < 1.5))


def test_errors_of_voxels_are_of_fits_of_voxels():
    of = lambda *unknowns: jvr.FitResult(TRUTH, (), None, unknowns, jvr.Outcome.CONVERGED, 1.0, None)
    with pytest.raises(ValueError, match=r"for fits of volume\.values, and this one is of transfer\.rgb"):
        jvr.voxel_errors(of("transfer.rgb"), CAMERAS, IMAGES, SETTINGS)
    with pytest.raises(ValueError, match="voxels must be inside of 0"):
        jvr.voxel_errors(of("volume.values"), CAMERAS, IMAGES, SETTINGS, voxels=[(0, 17, 0)])


# --- Configurations and the command line -----------------------------------------------------------------------------

CONFIG = """
[volume]
path = "stored.npy"
slope = 0.5
intercept = 0.1
[camera]
kind = "orbit"
count = 3
width = 6
height = 6
[settings]
step = 1.0
[truth]
kind = "linear"
positions = [0.0, 1.0]
rgb = [[0.2, 0.4, 0.9], [0.9, 0.5, 0.1]]
sigma_t = [0.0, 0.4]
[fit]
unknowns = ["volume.values"]
solver = "lbfgsb"
max_steps = 3
[fit.voxels]
start = 0.3
range = [0.0, 0.9]
levels = 2
[fit.priors]
total_variation = 1e-6
tikhonov = { values = 1e-7, reference = 0.2 }
"""


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A folder with a configuration and the voxels that it names."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JVR_CACHE", "0")
    np.save("stored.npy", bump(6))
    Path("voxels.toml").write_text(CONFIG)


@pytest.mark.slow
def test_a_configuration_says_priors_start_range_and_grids(desk):
    job = build_fit(read_config("voxels.toml"))
    assert job.levels == 2
    variation, tikhonov = job.keywords["priors"]
    assert variation == jvr.TotalVariation(1e-6)
    assert (tikhonov.gradient, tikhonov.values, float(tikhonov.reference)) == (0.0, 1e-7, pytest.approx(0.2))
    # Stored voxels have a unit of their own.
    np.testing.assert_allclose(job.scene.volume.values, 0.4)
    (within,) = job.keywords["transforms"]
    assert type(within) is jvr.Bounded
    assert (within.low, within.high) == (pytest.approx(-0.2), pytest.approx(1.6))
    smooth = build_fit(read_config("voxels.toml", ["fit.solver=lbfgs"])).keywords["transforms"][0]
    assert type(smooth) is jvr.Sigmoid
    beside = build_fit(
        read_config("voxels.toml", ['fit.unknowns=["cameras.fov_y", "volume.values", "cameras[0].world_from_camera"]'])
    )
    arrays = jax.tree.leaves(beside.keywords["unknowns"](beside.scene, beside.cameras))
    given = beside.keywords["transforms"]
    assert len(given) == len(arrays) == 5
    assert [array.ndim == 3 for array in arrays] == [transform is not None for transform in given]
    with pytest.raises(ConfigError, match=r"fit\.voxels.*name 'volume\.values' in fit\.unknowns"):
        read_config("voxels.toml", ['fit.unknowns=["transfer.rgb"]'])


@pytest.mark.slow
def test_the_command_line_fits_voxels_and_draws_what_it_found(desk, capsys):
    assert cli.run(["fit", "voxels.toml", "-o", "out"]) == 0
    found = jvr.read_volume("out/volume.mha")
    assert found.shape == (6, 6, 6)
    assert (float(found.values.min()) >= 0) & (float(found.values.max()) <= 0.9)
    assert float(found.values.std()) > 0.01
    report = json.loads(Path("out/result.json").read_text())
    assert report["standard_errors"] == {"volume.values": None} or report["rank"] > 0
    assert [entry["step"] for entry in report["history"]] == list(range(1, len(report["history"]) + 1))
    assert Path("out/checkpoint_1.npz").exists()
    assert cli.run(["render", "out/volume.mha", "-o", "found.png", "--size", "16"]) == 0
    assert cli.run(["fit", "voxels.toml", "-o", "out"]) != 0
    capsys.readouterr()
    assert cli.run(["fit", "voxels.toml", "-o", "out", "--resume"]) == 0
    again = jvr.read_volume("out/volume.mha")
    np.testing.assert_array_equal(again.values, found.values)


@pytest.mark.slow
def test_the_configuration_finds_the_embedded_volume(tmp_path, monkeypatch):
    monkeypatch.setenv("JVR_CACHE", "0")
    config = Path(__file__).parents[2] / "configs" / "voxels.toml"
    sizes = {"camera.width": 16, "camera.height": 16, "camera.count": 6, "settings.step": 2.0, "fit.max_steps": 4}
    small = [word for name, value in sizes.items() for word in ("--set", f"{name}={value}")]
    assert cli.run(["fit", str(config), "-o", str(tmp_path / "out"), *small]) == 0
    found, truth = jvr.read_volume(tmp_path / "out" / "volume.mha"), demo_volume()
    assert found.shape == truth.shape
    error = lambda values: float(np.sqrt(np.mean(np.square(np.asarray(values, float) - np.asarray(truth.values)))))
    assert error(found.values) < error(0.2) / 2


def test_a_volume_that_was_written_is_read_again(tmp_path):
    far = np.array(OBLIQUE)
    far[:3, 3] = [1234.56789, -98765.4321, 1e-3]
    values = np.random.default_rng(3).random((3, 4, 5)).astype(np.float32)
    values[1, 2, 3] = np.nan
    volume = jvr.Volume(values, far, slope=2.0, intercept=-1.0)
    write_metaimage(tmp_path / "a.mha", volume)
    read = jvr.read_volume(tmp_path / "a.mha")
    np.testing.assert_allclose(read.values, 2 * np.asarray(volume.values) - 1, atol=1e-6)
    assert read.gaps is not None
    np.testing.assert_array_equal(read.gaps, volume.gaps)
    np.testing.assert_allclose(read.world_from_grid, far, rtol=1e-6)
    image = sitk.ReadImage(str(tmp_path / "a.mha"))
    np.testing.assert_allclose(image.TransformIndexToPhysicalPoint((2, 1, 3)), (far @ [2, 1, 3, 1])[:3], rtol=1e-12)
