"""Samples that are left out: in the image plane, and on slices."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, affine, gaussian_transfer, linear_transfer, lut_transfer, orthographic, perspective, voxels

import jvr
from jvr.integrators.image_plane import image_plane
from jvr.integrators.slices.march import SliceOptions, slice_level, synthesise
from jvr.integrators.slices.oracle import distance_field, envelope
from jvr.integrators.slices.picture import picture_of
from jvr.march.compact import for_each, map_selected, write
from jvr.model.exact import Remainder
from jvr.rendering.integrator import View
from jvr.rendering.trace import near_volume, step_length

render = jax.jit(jvr.render)
WIDTH, HEIGHT = 45, 38


def blob(shape=(26, 25, 24), sharpness=5.0):
    """A smooth bump in the middle of nothing, 0 ... 1."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n) for n in shape], indexing="ij")
    return np.maximum(np.exp(-sharpness * (x**2 + (y - 0.2) ** 2 + z**2)) - 0.15, 0) / 0.85


def scene(values=None, transfer=None, matrix=None, **parts):
    volume = jvr.Volume(blob() if values is None else values, affine((1.0, 1.1, 1.2)) if matrix is None else matrix)
    transfer = jvr.LinearTransfer([0.2, 0.5, 0.9], voxels((3, 3, 1))[..., 0], [0.0, 0.15, 0.3]) if transfer is None else transfer
    return jvr.Scene(volume, transfer, **{"background": [0.2, 0.5, 0.9], **parts})


# Without a kink: a smooth picture.
SMOOTH = functools.partial(jvr.LinearTransfer, [0.0, 1.0], voxels((2, 3, 1))[..., 0])


def view(scene, width=WIDTH, height=HEIGHT, **where):
    return perspective(scene.volume, width, height, **{"away": 2.2, "fov_y": 50.0, **where})


def sampled(sampling, **others):
    return jvr.Settings(0.5, **{"termination": 0, "sampling": sampling, **others})


def difference(a, b):
    return max(float(jnp.max(jnp.abs(x - y))) for x, y in ((a.rgb, b.rgb), (a.alpha, b.alpha)))


def rms(a, b):
    return float(jnp.sqrt(jnp.mean(jnp.square(a.rgb - b.rgb))))


def random_like(tree, seed=1):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: jnp.asarray(rng.standard_normal(x.shape)) if eqx.is_inexact_array(x) else None, tree)


# -- in the image plane


@pytest.mark.slow
@pytest.mark.parametrize("size", [(5, 3), (1, 1), (2, 17)])
def test_no_tolerance_traces_every_ray(size):
    s = scene()
    every, refined = (render(s, view(s, *size), sampled(way)) for way in (jvr.Uniform(), jvr.Refinement(0, tile=4)))
    # Directions are rounded differently.
    assert difference(refined, every) < 5e-6
    np.testing.assert_allclose(refined.depth, every.depth, atol=1e-3)
    assert np.all(refined.stats.sampling.traced)
    np.testing.assert_array_equal(refined.stats.steps, every.stats.steps)


@pytest.mark.parametrize("tolerance", [0.02, 0.004])
def test_pictures_are_right_to_the_tolerance(tolerance):
    s = scene(transfer=SMOOTH([0.0, 0.15]))
    # Rays through nothing cost nothing, traced or not: what is saved is counted without skipping.
    ways = jvr.Uniform(), jvr.Refinement(tolerance)
    every, refined = (render(s, view(s), sampled(way, skipping=False)) for way in ways)
    # Single pixels next to an edge of the picture may be farther off.
    assert rms(refined, every) < tolerance / 4
    assert difference(refined, every) < 2 * tolerance
    assert np.sum(refined.stats.sampling.traced) < 0.8 * WIDTH * HEIGHT
    assert refined.stats.samples < 0.8 * every.stats.samples


def test_an_even_picture_takes_the_first_two_grids():
    s = scene(transfer=jvr.LinearTransfer([0.0, 1.0], np.ones((2, 3)), [0.0, 0.0]))
    picture = render(s, view(s), sampled(jvr.Refinement(0.001)))
    np.testing.assert_allclose(picture.rgb, jnp.broadcast_to(s.background, picture.rgb.shape), rtol=1e-6)
    # Every fourth ray of 45 x 38 pixels, extended to whole tiles of 8: 49 x 41.
    assert int(picture.stats.sampling.rays) == 13 * 11
    assert np.sum(picture.stats.sampling.traced) == 12 * 10


@pytest.mark.slow
def test_refined_pictures_have_derivatives(x64):
    s = scene(transfer=SMOOTH([0.0, 0.15]))
    camera, settings = view(s, 13, 11), sampled(jvr.Refinement(0.01, tile=4))
    weights = np.random.default_rng(2).standard_normal((11, 13, 3))

    def value(tables):
        changed = eqx.tree_at(lambda s: (s.transfer.rgb, s.transfer.sigma_t), s, tables)
        picture = jvr.render(changed, camera, settings)
        return jnp.sum(picture.rgb * weights), picture.stats.sampling.rays

    tables = (s.transfer.rgb, s.transfer.sigma_t)
    value_of = jax.jit(value)
    gradient, rays = jax.jit(jax.grad(value, has_aux=True))(tables)
    assert int(rays) < 13 * 17
    along, h = random_like(tables), 1e-6
    (high, more), (low, less) = (value_of(jax.tree.map(lambda x, d, t=t: x + t * d, tables, along)) for t in (h, -h))
    # The same rays: placement is frozen as it is for the gradient.
    assert int(more) == int(less) == int(rays)
    found = sum(jnp.vdot(g, d) for g, d in zip(gradient, along, strict=True))
    np.testing.assert_allclose(found, (high - low) / (2 * h), rtol=1e-6, atol=1e-6)


# -- on slices: the parts


def test_levels_of_slices_are_those_of_table_1():
    options = SliceOptions(3, 8, 8, 0.0, lambda *_: ((), ()))
    assert [int(slice_level(options, jnp.int32(k))) for k in range(9)] == [3, 0, 1, 0, 2, 0, 1, 0, 3]


def test_synthesis_is_that_of_figure_5():
    """Written out as in the paper; pixel (x, y) of an array with a ring is at [y + 1, x + 1]."""
    coarse = voxels((5, 7, 1))[..., 0]
    fine = np.asarray(synthesise(jnp.asarray(coarse)))
    assert fine.shape == (8, 12)
    g = lambda x, y: coarse[y + 1, x + 1]
    for x in range(-1, 11):
        for y in range(-1, 7):
            fx, fy = x / 2 - np.floor(x / 2), y / 2 - np.floor(y / 2)
            cx, cy = int(np.ceil(x / 2)), int(np.ceil(y / 2))
            wanted = (
                (1 / 4 + fx) * (1 / 4 + fy) * g(cx - 1, cy - 1)
                + (3 / 4 - fx) * (1 / 4 + fy) * g(cx, cy - 1)
                + (1 / 4 + fx) * (3 / 4 - fy) * g(cx - 1, cy)
                + (3 / 4 - fx) * (3 / 4 - fy) * g(cx, cy)
            )
            np.testing.assert_allclose(fine[y + 1, x + 1], wanted, rtol=1e-6)


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (2.0, -0.7)])
def test_synthesis_reproduces_constant_and_linear_functions_up_to_the_border(slopes):
    place = lambda n, level: 2**level * (np.arange(n) - 0.5) - 0.5
    linear = lambda h, w, level: 3 + slopes[0] * place(h, level)[:, None] + slopes[1] * place(w, level)
    np.testing.assert_allclose(synthesise(jnp.asarray(linear(5, 7, 1))), linear(8, 12, 0), rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize(("size", "share"), [(31, 0.5), (64, 0.0), (64, 1.0), (5000, 0.01), (5000, 0.7)])
def test_every_selected_element_is_worked_on_once(size, share):
    mask = np.random.default_rng(size).random(size) < share
    values = np.arange(size)
    body = lambda index, valid, read, found: write(found, index, valid, found[index] + read + 1)
    found = jax.jit(lambda m: for_each(m, lambda i: jnp.asarray(values)[i], body, jnp.zeros(size, jnp.int32)))(mask)
    np.testing.assert_array_equal(found, np.where(mask, values + 1, 0))


def test_a_selected_map_has_the_derivative_of_the_map(x64):
    rng = np.random.default_rng(0)
    mask, x, weights = rng.random(5000) < 0.6, rng.random(5000), rng.random(5000)
    f = lambda shared, block: jnp.sin(shared * block[0]) * block[1]
    some = lambda a, x, y: jnp.sum(weights * map_selected(f, mask, a, (x, y)))
    whole = lambda a, x, y: jnp.sum(weights * jnp.where(mask, f(a, (x, y)), 0.0))
    mask = jnp.asarray(mask)
    for found, wanted in zip(*(jax.jit(jax.grad(g, (0, 1, 2)))(1.3, x, x[::-1]) for g in (some, whole)), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-12)


def test_an_envelope_is_what_is_wanted_plus_the_way_to_it():
    rng = np.random.default_rng(3)
    wanted = np.where(rng.random((7, 6, 5)) < 0.05, rng.random((7, 6, 5)), np.inf)
    thickness, farthest = (1.0, 2.0, 1.5), 4.0
    index = np.stack(np.meshgrid(*map(np.arange, wanted.shape), indexing="ij"), -1).reshape(-1, 3)
    slabs = np.maximum(np.abs(index[:, None] - index[None]) - 1, 0) * np.array(thickness)
    exact = np.minimum(np.min(np.max(slabs, -1) + wanted.reshape(-1), axis=1), farthest).reshape(wanted.shape)
    found = jax.jit(envelope)(jnp.asarray(wanted), tuple(map(jnp.asarray, thickness)), jnp.asarray(farthest))
    # Radii grow by the thinnest slab: never too far, and short by less than one of them.
    assert np.all(found <= exact + 1e-5)
    assert np.all(found > exact - 1.0)


# -- oracles

STEP = np.where(np.arange(24)[:, None, None] < 12, 0.1, 0.9) * np.ones((24, 3, 3))
ORACLES = (jvr.OpacityChange, jvr.BrickRange, jvr.LocalError)
# Of any view: these oracles do not look at it.
CAMERA = perspective(jvr.Volume(voxels()))


@functools.partial(jax.jit, static_argnums=0)
def ask(oracle, volume, transfer, optical, farthest):
    plane = image_plane(CAMERA, jnp.zeros_like(farthest))
    return distance_field(oracle, volume, transfer, optical, plane, farthest)


def field(oracle, values, transfer, farthest=100.0, optical=jvr.EmissionAbsorption()):
    return np.asarray(ask(oracle, jvr.Volume(values), transfer, optical, jnp.asarray(farthest)).distance)


def test_nothing_is_wanted_where_nothing_changes():
    for oracle in ORACLES:
        assert np.all(field(oracle(1e-6), np.full((9, 8, 7), 0.4), linear_transfer()) == 100)
    assert np.all(field(jvr.Finest(), np.full((9, 8, 7), 0.4), linear_transfer()) == 0)


def test_everything_is_wanted_where_a_voxel_is_no_number():
    """A voxel that a fit has made so."""
    volume = jvr.Volume(np.full((9, 8, 7), 0.4))
    volume = eqx.tree_at(lambda v: v.values, volume, volume.values.at[4, 4, 4].set(jnp.nan))
    for oracle in ORACLES:
        found = ask(oracle(1e-6), volume, linear_transfer(), jvr.EmissionAbsorption(), jnp.asarray(100.0))
        assert np.min(found.distance) == 0


def test_the_distance_to_a_change_of_opacity():
    transfer = jvr.LinearTransfer([0, 1], np.ones((2, 3)), [0.0, 0.5])
    found = field(jvr.OpacityChange(0.01), STEP, transfer, farthest=5.0)
    # The step is in cell 11; cells next to it touch it.
    np.testing.assert_allclose(found[:, 0, 0], np.minimum(np.maximum(np.abs(np.arange(23) - 11) - 1, 0), 5))
    assert np.all(field(jvr.OpacityChange(0.5), STEP, transfer, farthest=5.0) == 5)


def test_a_peak_between_the_values_of_two_voxels_is_seen():
    peak = jvr.LinearTransfer([0.4, 0.5, 0.6], np.ones((3, 3)), [0.0, 1.0, 0.0])
    assert np.min(field(jvr.OpacityChange(0.5), STEP, peak)) == 0


def test_a_brick_asks_for_the_distance_over_which_it_changes_by_the_tolerance():
    ramp = np.linspace(0, 1, 17)[:, None, None] * np.ones((17, 5, 5))
    transfer = jvr.LinearTransfer([0, 1], np.ones((2, 3)), [0.0, 0.02])
    change = (1 - np.exp(-0.02)) / 4
    np.testing.assert_allclose(field(jvr.BrickRange(0.002), ramp, transfer), 4 * 0.002 / change, rtol=0.02)


def test_a_linear_scalar_has_no_error_and_a_parabola_has_that_of_its_chord():
    transfer = jvr.LinearTransfer([-100, 100], np.zeros((2, 3)), [0.0, 0.002])
    x, y, z = np.meshgrid(*map(np.arange, (9, 8, 7)), indexing="ij")
    assert np.all(field(jvr.LocalError(1e-5), 0.3 * x - 0.2 * y + 0.7 * z, transfer) == 100)
    # s = x^2 / 2 has a second difference of 1; opacity is nearly the extinction, 1e-5 for one unit of s.
    found = field(jvr.LocalError(4e-5), 0.5 * x**2, transfer)
    np.testing.assert_allclose(found[2:-2], np.sqrt(8 * 4e-5 / 1e-5), rtol=1e-2)
    found = field(jvr.LocalError(2.5e-6), 0.5 * x**2, transfer)
    np.testing.assert_allclose(found[2:-2], 4 * 2.5e-6 / 1e-5, rtol=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("optical", [jvr.EmissionOnly(), jvr.AbsorptionOnly()])
def test_oracles_know_every_optical_model(optical):
    for oracle in ORACLES:
        assert np.min(field(oracle(0.01), STEP, lut_transfer(coloured=True), optical=optical)) < 1


# -- on slices: pictures


def on_slices(levels, oracle=jvr.Finest(), **others):
    return sampled(jvr.Slices(oracle, levels=levels), **others)


@pytest.fixture(scope="module")
def full():
    s = scene()
    return render(s, view(s), on_slices(0))


@pytest.mark.slow
def test_all_samples_are_those_of_pre_integration():
    """An orthographic camera in front of a face: every ray enters on the first slice, so samples are where `jvr.Uniform()` has them."""
    s = scene()
    center = np.asarray(s.volume.center)
    camera = jvr.OrthographicCamera.look_at(center + np.array([40.0, 0, 0]), center, [0, 0, 1], 27.0, 21, 19)
    reference = render(s, camera, sampled(jvr.Uniform(), quadrature=jvr.PreIntegrated()))
    picture = render(s, camera, on_slices(0))
    # Positions, and with them colours, differ by roundings.
    assert difference(picture, reference) < 2e-5
    np.testing.assert_allclose(picture.depth, reference.depth, atol=2e-3)
    assert int(picture.stats.samples) == pytest.approx(int(picture.stats.sampling.full), abs=21 * 19)
    # Every ray that hits runs through: without skipping, too.
    np.testing.assert_array_equal(picture.stats.steps.max(), np.ceil(25 / 0.5))


@pytest.mark.slow
def test_a_pyramid_that_is_sampled_everywhere_is_the_full_picture(full):
    s = scene()
    picture = render(s, view(s), on_slices(2))
    assert difference(picture, full) < 2e-6
    np.testing.assert_allclose(picture.depth, full.depth, atol=1e-3)
    assert int(picture.stats.sampling.full) == int(full.stats.sampling.full) == int(full.stats.samples)
    assert 0 <= int(picture.stats.sampling.samples[0]) - int(full.stats.samples) <= WIDTH * HEIGHT


@pytest.mark.slow
def test_the_full_picture_converges_to_the_march(full):
    """Slices lie elsewhere along each ray than its own segments, which matters as much as the step does."""
    s = scene()
    assert difference(full, render(s, view(s), jvr.Settings(0.05, termination=0))) < 2e-3


# `BrickRange` asks for every sample of a brick that changes and of those around it, 12 voxels across at the least: of a wide bump that
# is nearly the whole volume.
@pytest.mark.parametrize(("oracle", "sharpness"), [(jvr.OpacityChange, 5.0), (jvr.BrickRange, 20.0), (jvr.LocalError, 5.0)])
@pytest.mark.slow
def test_the_error_falls_with_the_tolerance(oracle, sharpness):
    s = scene(blob(sharpness=sharpness))
    full = render(s, view(s), on_slices(0))
    (coarse, some), (fine, more) = (
        (rms(p, full), int(p.stats.samples)) for p in (render(s, view(s), on_slices(2, oracle(t))) for t in (0.03, 0.001))
    )
    assert coarse < 0.03
    assert fine < 0.001
    assert fine <= coarse
    assert some <= more < 0.75 * int(full.stats.samples)


@pytest.mark.slow
def test_uniform_matter_is_exact_with_the_coarsest_samples_alone():
    s = scene(values=np.full((26, 25, 24), 0.5))
    exact = render(s, view(s), on_slices(0))
    picture = render(s, view(s), on_slices(2, jvr.LocalError(0.001)))
    assert difference(picture, exact) < 1e-5
    np.testing.assert_array_equal(picture.stats.sampling.samples[:2], 0)
    # One in 4^3, and around the border pixels and slices that reach outside.
    assert int(picture.stats.samples) < int(picture.stats.sampling.full) / 16


@pytest.mark.parametrize("size", [(1, 1), (2, 17)])
@pytest.mark.slow
def test_pictures_of_any_size(size):
    s = scene()
    exact, picture = (render(s, view(s, *size), on_slices(levels)) for levels in (0, 2))
    assert picture.rgb.shape == (size[1], size[0], 3)
    assert difference(picture, exact) < 2e-6


@pytest.mark.slow
@pytest.mark.parametrize("case", ["inside", "clipped", "beside", "parallel", "absorbing", "glowing", "coloured"])
def test_every_kind_of_scene(case):
    parts = {
        "clipped": {"clipping": jvr.ClippingBox([5.0, 4.0, 3.0], [15.0, 22.0, 24.0])},
        "absorbing": {"optical": jvr.AbsorptionOnly()},
        "glowing": {"optical": jvr.EmissionOnly(), "background": None},
        "coloured": {"transfer": linear_transfer(coloured=True, scale=0.2), "matrix": OBLIQUE},
    }
    s = scene(**parts.get(case, {}))
    camera = view(s, 15, 14, away={"inside": 0.3}.get(case, 2.2))
    if case == "parallel":
        camera = orthographic(s.volume, 15, 14)
    if case == "beside":
        camera = perspective(s.volume, 15, 14, away=-3.0, fov_y=2.0)
        camera = eqx.tree_at(lambda c: c.world_from_camera, camera, camera.world_from_camera.at[:3, 3].add(500.0))
    fine = render(s, camera, jvr.Settings(0.1, termination=0))
    picture = render(s, camera, on_slices(2, jvr.LocalError(0.001)))
    assert difference(picture, fine) < 0.02
    if case == "beside":
        np.testing.assert_allclose(picture.rgb, jnp.broadcast_to(s.background, picture.rgb.shape))


@pytest.mark.slow
def test_a_camera_that_is_no_number_gives_no_number():
    s = scene()
    camera = eqx.tree_at(lambda c: c.fov_y, view(s, 5, 3), jnp.asarray(jnp.nan))
    assert np.all(np.isnan(render(s, camera, on_slices(2)).rgb))


@pytest.mark.slow
def test_opaque_matter_ends_pixels():
    """Even matter of extinction 3 in slices half a voxel apart: 1e-4 is left behind `ln(1e4) / 1.5`, thus 7 segments, or 8 where the first
    is a part of one; pixels end with the block of 4 slices that this lies in."""
    s = scene(np.full((26, 25, 24), 0.5), jvr.LinearTransfer([0.2, 0.4], np.ones((2, 3)), [0.0, 3.0]))
    exact, early = (render(s, view(s), on_slices(2, termination=t)) for t in (0, 1e-4))
    assert difference(early, exact) < 2e-4
    every, taken = np.asarray(exact.stats.steps), np.asarray(early.stats.steps)
    assert np.mean(every > 11) > 0.3
    assert np.all(taken >= np.minimum(every, 7))
    assert np.all(taken <= np.minimum(every, 11))
    assert int(early.stats.samples) < 0.8 * int(exact.stats.samples)


# -- on slices: derivatives


def parameters():
    volume = jvr.Volume(blob((20, 18, 17), 9.0), OBLIQUE, slope=0.9, intercept=0.05)
    camera = perspective(volume, 13, 11, away=2.0)
    # Beside the middle: straight through it rays lie on edges of what oracles look at, and the samples change with the least move.
    camera = eqx.tree_at(lambda c: c.world_from_camera, camera, camera.world_from_camera.at[:3, 3].add([0.013, -0.021, 0.017]))
    return {"voxels": volume.values, "slope": volume.slope, "transfer": linear_transfer(), "camera": camera}


def loss(p, distances, optical=jvr.EmissionAbsorption()):
    """Every pixel of colour, opacity and depth, each with its own weight."""
    volume = jvr.Volume(p["voxels"], OBLIQUE, slope=p["slope"], intercept=0.05)
    s = jvr.Scene(volume, p["transfer"], background=[0.2, 0.5, 0.9], optical=optical)
    sampling = jvr.Slices(levels=2)
    settings, (s, camera) = jvr.Settings(1.5, termination=0), near_volume(s, p["camera"])
    picture = picture_of(View(s, camera, settings, step_length(s, settings)), sampling, distances=distances)
    weights = np.random.default_rng(5).standard_normal((11, 13, 5))
    total = jnp.sum(picture.rgb * weights[..., :3]) + jnp.sum(picture.alpha * weights[..., 3])
    return total + jnp.sum(picture.depth * weights[..., 4]), picture.stats.sampling


@pytest.mark.slow
@pytest.mark.parametrize("optical", [jvr.EmissionAbsorption(), jvr.EmissionOnly(), jvr.AbsorptionOnly()])
def test_gradients_against_differences_with_the_placement_frozen(x64, optical):
    p = parameters()
    if not isinstance(optical, jvr.EmissionAbsorption):
        p["transfer"] = linear_transfer(coloured=True)
    # Where nothing attenuates emission, a smaller tolerance leaves out less than a fifth of the samples.
    distances = ask(jvr.LocalError(0.03), jvr.Volume(p["voxels"], OBLIQUE), p["transfer"], optical, jnp.asarray(40.0))
    both = jax.jit(jax.value_and_grad(lambda p: loss(p, distances, optical), has_aux=True))
    (_, stats), gradient = both(p)
    assert int(stats.samples[0]) < 0.8 * int(stats.full)
    assert np.all(np.asarray(stats.samples) > 0)
    for name in p:
        along, h = random_like(p[name]), 1e-6
        moved = [{**p, name: jax.tree.map(lambda x, d, t=t: x + t * d, p[name], along)} for t in (h, -h)]
        (high, more), (low, less) = (both(q)[0] for q in moved)
        np.testing.assert_array_equal(more.samples, stats.samples, err_msg=name)
        np.testing.assert_array_equal(less.samples, stats.samples, err_msg=name)
        found = sum(jnp.vdot(g, d) for g, d in zip(jax.tree.leaves(gradient[name]), jax.tree.leaves(along), strict=True))
        # h^2, and the rounding of a loss of some hundreds over h.
        np.testing.assert_allclose(found, (high - low) / (2 * h), rtol=1e-6, atol=3e-6, err_msg=name)


@pytest.mark.slow
def test_values_and_gradients_at_extremes_are_those_of_double_precision():
    """Invisible, visible, and optical depths of thousands in one segment."""
    weights = np.arange(216.0).reshape(8, 9, 3)
    floats = lambda tree, dtype: jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, tree)

    @jax.jit
    def value_and_gradient(s, camera, weights):
        def total(transfer):
            changed = eqx.tree_at(lambda s: s.transfer, s, transfer)
            return jnp.sum(jvr.render(changed, camera, on_slices(1)).rgb * weights)

        return jax.value_and_grad(total)(s.transfer)

    for scale in (1e-12, 1.0, 1e4):
        s = scene(transfer=jvr.LinearTransfer([0.1, 0.3, 0.9], voxels((3, 3, 1))[..., 0], np.array([0.0, 0.2, 0.9]) * scale))
        single = value_and_gradient(*floats((s, view(s, 9, 8)), jnp.float32), weights)
        with jax.enable_x64(True):
            double = value_and_gradient(*floats((s, view(s, 9, 8)), jnp.float64), weights)
        for a, b in zip(jax.tree.leaves(single), jax.tree.leaves(double), strict=True):
            assert np.all(np.isfinite(a))
            # What rounding the positions costs where opacity jumps from one voxel to the next.
            np.testing.assert_allclose(a, b, rtol=2e-3, atol=5e-4 * np.max(np.abs(b)))


# -- what is refused


class Fisheye(jvr.model.camera.AbstractCamera):
    world_from_camera: jax.Array
    width: int
    height: int
    remainder: Remainder

    def rays_ahead(self, pixels, ahead):
        raise NotImplementedError


@pytest.mark.parametrize("sampling", [jvr.Refinement(), jvr.Slices()])
def test_what_cannot_be_rendered_is_refused(sampling):
    s = scene()
    with pytest.raises(ValueError, match=r"not a Fisheye: leave Settings"):
        jvr.render(s, Fisheye(jnp.eye(4), 4, 3, Remainder.left(jnp.eye(4), jnp.eye(4))), sampled(sampling))
    images = [np.zeros((3, 4, 3))]
    with pytest.raises(ValueError, match=r"every sample of every ray: leave Settings\(sampling=...\) at jvr.Uniform\(\)"):
        jvr.fit(s, [view(s, 4, 3)], images, settings=sampled(sampling), unknowns=lambda s: s.transfer.sigma_t)


def test_what_slices_cannot_render_is_refused():
    s = scene()
    refused = {
        r"Nearest\(\) volumes do not allow": (jvr.Scene(jvr.Volume(blob(), interpolation=jvr.Nearest()), s.transfer), {}),
        "tabulate it as a LutTransfer": (scene(transfer=gaussian_transfer()), {}),
        r"needs Settings\(adjoint=jvr.Replay\(\)\), not jvr.Rows": (s, {"adjoint": jvr.Rows()}),
    }
    for message, (which, others) in refused.items():
        with pytest.raises(ValueError, match=message):
            jvr.render(which, view(s, 4, 3), on_slices(2, **others))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jvr.Slices(levels=6), "from 0 to 5"),
        (lambda: jvr.Slices(levels=True), "from 0 to 5"),
        (lambda: jvr.OpacityChange(-0.1), "tolerance must be positive and finite .*; 0.01 is a good start"),
        (lambda: jvr.BrickRange(0), "positive"),
        (lambda: jvr.LocalError(float("nan")), "positive"),
        (lambda: jvr.Refinement(tile=6), "power of two from 2 to 64"),
        (lambda: jvr.Refinement(-1), "not negative"),
        (lambda: jvr.Refinement(float("nan")), "not negative"),
    ],
)
def test_values_out_of_range_are_refused(make, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make()


def test_a_sampling_is_an_object():
    # The tests' own check of types comes before the message.
    with pytest.raises(TypeError, match="sampling"):
        jvr.Settings(sampling="refinement")


@pytest.mark.parametrize("make", [jvr.Uniform, jvr.Refinement, jvr.Slices])
def test_samplings_are_static_and_explain_themselves(make):
    assert hash(make()) == hash(make())
    assert make() == make()
    assert not jax.tree.leaves(make())
    plan = jvr.plan(scene(), sampled(make()))
    (part,) = [part for part in plan.parts if part.name == "integrator"]
    assert part.reason == make().explanation
