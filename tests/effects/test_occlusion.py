"""Ambient occlusion: closed forms, brute force in NumPy, derivatives, what is kept, hard cases."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, affine, linear_transfer, perspective, render, voxels
from scipy.ndimage import map_coordinates

import jvr
from jvr.effects.occlusion import ProjectedOcclusion
from jvr.rendering.advise import effects_of, remarks_on
from jvr.rendering.medium import absorbing

AMBIENT = jvr.AmbientLight((0.9, 0.6, 0.3))
SUN = jvr.DirectionalLight((0.3, -0.5, -1.0))
METHODS = {"local": jvr.LocalOcclusion, "histogram": jvr.HistogramOcclusion}


def scene(occlusion=None, shape=(5, 6, 7), **parts):
    given = {"volume": jvr.Volume(voxels(shape), OBLIQUE), "transfer": linear_transfer(), "lights": (AMBIENT,)}
    return jvr.Scene(**({"shading": jvr.Lambert(0.8), "occlusion": occlusion} | given | parts))


def homogeneous(shape, sigma, **parts):
    """One value, visible everywhere."""
    volume = jvr.Volume(np.full(shape, 0.5))
    return scene(volume=volume, transfer=jvr.LinearTransfer([0, 1], [[1, 1, 1]] * 2, [sigma, sigma]), **parts)


@jax.jit
def visibility(one: jvr.Scene):
    return one.occlusion.visibility(one, lambda graded: absorbing(one, None, graded))


def factors(one: jvr.Scene) -> np.ndarray:
    """What every node leaves of ambient light, visible or not."""
    grid = visibility(one).grid
    return np.asarray(grid.rows, np.float64).reshape(*[n + 1 for n in grid.cells], -1)


def picture(one: jvr.Scene) -> np.ndarray:
    return np.asarray(render(one, perspective(one.volume)).rgb, np.float64)


def phi1(x):
    return -np.expm1(-x) / x


def on_the_sphere(count: int) -> np.ndarray:
    """Directions at random."""
    directions = np.random.default_rng(5).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1)[:, None]


def brute_force(one: jvr.Scene, p: np.ndarray, radius: float, offset: float, rays=2000, steps=64) -> np.ndarray:
    """The factor at grid positions `(n, 3)`, by the midpoint rule along many rays, in double precision and without jvr."""
    matrix, values = np.asarray(one.volume.world_from_grid, np.float64), np.asarray(one.volume.values, np.float64)
    along = on_the_sphere(rays) @ np.linalg.inv(matrix[:3, :3]).T
    dt = (radius - offset) / steps
    distances = offset + dt * (np.arange(steps) + 0.5)
    found = []
    for start in np.asarray(p, np.float64):
        at = start + along[:, None] * distances[:, None]
        inside = np.all((at >= 0) & (at <= np.array(values.shape) - 1), axis=-1)
        s = map_coordinates(values, at.reshape(-1, 3).T, order=1, mode="nearest").reshape(inside.shape)
        sigma = np.interp(s, np.asarray(one.transfer.positions), np.asarray(one.transfer.sigma_t))
        tau = np.cumsum(np.where(inside, sigma, 0.0) * dt, axis=1)
        # To the middle of each step.
        found.append(np.mean(np.exp(-(tau - 0.5 * np.where(inside, sigma, 0.0) * dt))))
    return np.array(found)


# --- Closed forms ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.0, 1e-3, 0.5, 20.0])
def test_a_homogeneous_ball_has_the_closed_form(sigma):
    """`phi1(sigma (R - a))` at a node whose ball lies in the volume, whatever the number of rays and samples."""
    for occlusion in (
        jvr.LocalOcclusion(5, radius=3.5, offset=0.5, samples=3, resolution=1.0),
        jvr.HistogramOcclusion(2, 5, radius=3.5, offset=0.5, samples=3, resolution=1.0),
    ):
        found = factors(homogeneous((9, 9, 9), sigma, occlusion=occlusion))[4, 4, 4, 0]
        assert found == pytest.approx(phi1(3 * sigma) if sigma else 1.0, rel=2e-6)


def test_a_half_space_leaves_half():
    """A node on a face of the volume, with nothing beyond: `(1 + phi1(sigma (R - a))) / 2`, a half where that is opaque; on an edge and
    in a corner what is left is that of three and seven octants."""
    occlusion = jvr.LocalOcclusion(1024, radius=3.0, offset=0.0, samples=4, resolution=1.0)
    for sigma in (0.7, 60.0):
        found, opaque = factors(homogeneous((7, 7, 7), sigma, occlusion=occlusion))[..., 0], phi1(3 * sigma)
        # The two hemispheres about z have as many rays; about other axes within what 1024 directions know.
        assert found[3, 3, 0] == pytest.approx((1 + opaque) / 2, rel=1e-5)
        for node, share in (((0, 3, 3), 1 / 2), ((0, 0, 3), 1 / 4), ((0, 0, 0), 1 / 8)):
            assert found[node] == pytest.approx(1 - share * (1 - opaque), abs=3e-3)


def test_a_ball_larger_than_the_volume_sees_all_of_it():
    """With the few samples of a ray all inside, what is left is the transmittance to where the volume ends."""
    along = on_the_sphere(4000)
    length = np.min(4 / np.abs(along), axis=1)
    found = factors(homogeneous((9, 9, 9), 0.3, occlusion=jvr.LocalOcclusion(512, radius=1e6, offset=0.0, samples=2)))
    assert found[2, 2, 2, 0] == pytest.approx(np.mean(np.exp(-0.3 * length)), abs=5e-3)


def test_bias_and_gamma_are_applied_to_what_is_left():
    """Ambient light alone is multiplied, with `(bias + (1 - bias) I)^gamma`."""
    taken, key = jnp.full((2, 2, 2, 1), 0.75), jnp.zeros((0, 2), jnp.uint32)
    kept = ProjectedOcclusion(taken, key, pinned=True)
    made = lambda **numbers: scene(jvr.LocalOcclusion(**numbers).with_projected(kept), lights=(AMBIENT, SUN))
    plain = picture(scene(lights=(AMBIENT, SUN)))
    ambient = plain - picture(scene(lights=(SUN,)))
    for numbers, factor in (({}, 0.25), ({"bias": 0.2}, 0.4), ({"bias": 0.2, "gamma": 0.5}, 0.4**0.5), ({"gamma": 2.0}, 0.0625)):
        with pytest.warns(RuntimeWarning, match="computed for another"):
            found = picture(made(**numbers))
        np.testing.assert_allclose(found, plain - (1 - factor) * ambient, atol=2e-6)


def test_coloured_extinction_has_a_factor_for_each_channel():
    one = scene(jvr.LocalOcclusion(8, samples=4, resolution=1.0))
    table = one.transfer
    with_sigma = lambda sigma_t: dataclasses.replace(one, transfer=jvr.LinearTransfer(table.positions, table.rgb, sigma_t))
    apart = [factors(with_sigma(c * table.sigma_t)) for c in (1, 2, 3)]
    found = factors(with_sigma(np.asarray(table.sigma_t)[:, None] * [1, 2, 3]))
    np.testing.assert_allclose(found, np.concatenate(apart, axis=-1), atol=1e-6)


# --- Brute force -----------------------------------------------------------------------------------------------------


def test_nodes_converge_to_brute_force():
    """At random places of an oblique volume with noise in it; more rays and samples come nearer."""
    errors = []
    for rays, samples in ((32, 8), (512, 32)):
        one = scene(jvr.LocalOcclusion(rays, radius=4.0, offset=0.5, samples=samples, resolution=1.0))
        found = factors(one)
        node = np.random.default_rng(1).integers(0, found.shape[:3], (24, 3))
        errors.append(found[*node.T, 0] - brute_force(one, node, 4.0, 0.5))
    coarse, fine = (np.sqrt(np.mean(np.square(e))) for e in errors)
    # Brute force itself errs by 2e-3 with 2000 random directions.
    assert coarse < 0.02
    assert fine < 0.005
    assert fine < 0.5 * coarse


def test_extinction_is_gone_beyond_a_clipping_box():
    """As in a volume that ends there."""
    values = voxels((9, 6, 7))
    occlusion = jvr.LocalOcclusion(16, radius=3.0, offset=0.3, samples=8, resolution=1.0)
    whole = scene(occlusion, volume=jvr.Volume(values), clipping=jvr.ClippingBox((-9, -9, -9), (4, 99, 99)))
    part = scene(occlusion, volume=jvr.Volume(values[:5]))
    np.testing.assert_allclose(factors(whole)[:5], factors(part), atol=1e-5)


# --- Histograms ------------------------------------------------------------------------------------------------------


def test_histograms_are_those_of_brute_force():
    """Hats around the scalars of each bin, averaged over the ball with weight `1 / d^2`."""
    one = scene(jvr.HistogramOcclusion(4, 256, radius=4.0, offset=0.5, samples=32, resolution=1.0))
    projection = one.occlusion.projection(one, lambda graded: absorbing(one, None, graded))
    weights = np.asarray(jax.jit(lambda projection: projection.all_nodes())(projection)[0])
    weights = weights.reshape(*projection.shape, 4)
    matrix, values = np.asarray(one.volume.world_from_grid, np.float64), np.asarray(one.volume.values, np.float64)
    positions = np.linspace(values.min(), values.max(), 4)
    np.testing.assert_allclose(projection.positions, positions, rtol=1e-5)
    distances = 0.5 + 3.5 * (np.arange(32) + 0.5) / 32
    for node in ((2, 3, 3), (0, 5, 2)):
        at = node + (on_the_sphere(4000) @ np.linalg.inv(matrix[:3, :3]).T)[:, None] * distances[:, None]
        inside = np.all((at >= 0) & (at <= np.array(values.shape) - 1), axis=-1)
        s = map_coordinates(values, at.reshape(-1, 3).T, order=1, mode="nearest").reshape(inside.shape)
        hats = np.maximum(0, 1 - np.abs(s[..., None] - positions) / (positions[1] - positions[0]))
        np.testing.assert_allclose(weights[node], np.mean(hats * inside[..., None], axis=(0, 1)), atol=8e-3)


def test_a_new_transfer_function_leaves_histograms_as_they_are():
    """What is invisible bleeds nothing; what has the colour of white light and sends all of it on takes nothing away."""
    occlusion = jvr.HistogramOcclusion(8, 16, radius=4.0, samples=4, bleeding=1.0)
    kept = jvr.precompute(scene(occlusion))
    other = dataclasses.replace(kept, transfer=jvr.LinearTransfer([0, 1], [[1, 1, 1]] * 2, [2.0, 3.0]))
    assert other.occlusion.stale(other) == ()
    np.testing.assert_allclose(picture(other), picture(dataclasses.replace(other, occlusion=None)), atol=1e-5)
    again = dataclasses.replace(other, occlusion=occlusion)
    np.testing.assert_allclose(picture(again), picture(other), atol=1e-6)
    clear = dataclasses.replace(kept, transfer=jvr.LinearTransfer([0, 1], [[1, 0, 0]] * 2, [0.0, 0.0]))
    np.testing.assert_allclose(factors(clear), 1.0)
    # Green matter nearby takes red and blue.
    green = dataclasses.replace(kept, transfer=jvr.LinearTransfer([0, 1], [[0, 1, 0]] * 2, [2.0, 3.0]))
    red, rest, blue = np.moveaxis(factors(green), -1, 0)
    np.testing.assert_allclose(rest, 1.0, atol=1e-6)
    np.testing.assert_allclose(red, blue, atol=1e-6)
    assert red.max() < 0.95


def test_histograms_know_no_gradients():
    with pytest.raises(ValueError, match=r"histograms know nothing of gradients.*use jvr\.LocalOcclusion"):
        picture(scene(jvr.HistogramOcclusion(), transfer=jvr.GradientOpacity(linear_transfer(), 0.1, 0.5)))


# --- Derivatives -----------------------------------------------------------------------------------------------------

# Whatever has a derivative, of a scene with what is not visible in it: the first entry of the table, and bricks with nothing else.
ARRAYS = {
    "sigma_t": lambda s: s.transfer.sigma_t,
    "positions": lambda s: s.transfer.positions,
    "voxels": lambda s: s.volume.values,
    "radius": lambda s: s.occlusion.radius,
    "offset": lambda s: s.occlusion.offset,
    "bias": lambda s: s.occlusion.bias,
    "gamma": lambda s: s.occlusion.gamma,
    "radiance": lambda s: s.lights[0].radiance,
}


def differentiable(method: str) -> jvr.Scene:
    values = voxels((9, 5, 5))
    values[4:] *= 0.2
    transfer = jvr.LinearTransfer([0.1, 0.3, 0.6, 0.9], voxels((4, 3, 1))[..., 0], [0.0, 0.0, 0.4, 0.7])
    numbers = {"radius": 2.7, "offset": 0.4, "samples": 3, "resolution": 0.6, "bias": 0.1, "gamma": 0.8}
    return scene(METHODS[method](rays=6, **numbers), volume=jvr.Volume(values), transfer=transfer, lights=(AMBIENT, SUN))


@functools.cache
def weighted_picture():
    settings = jvr.Settings(0.7, termination=0)

    @jax.jit
    def loss(one):
        rgb = jvr.render(one, perspective(one.volume, 4, 4), settings).rgb
        return jnp.sum(rgb * jnp.asarray(np.random.default_rng(2).random(rgb.shape)))

    return loss


@pytest.mark.parametrize("method", METHODS)
def test_derivatives_are_those_of_differences(x64, method):
    """Reverse mode against central differences in double precision; of voxels and entries some."""
    one, loss = differentiable(method), weighted_picture()
    gradient = eqx.filter_jit(eqx.filter_grad(loss))(one)
    rng = np.random.default_rng(3)
    for name, of in ARRAYS.items():
        array, found = np.asarray(of(one)), np.asarray(of(gradient))
        for place in rng.choice(array.size, min(array.size, 4), replace=False):
            shifted = lambda by, place=place, array=array, of=of: eqx.tree_at(
                of, one, jnp.asarray(array + by * (np.arange(array.size) == place).reshape(array.shape))
            )
            # An extinction of zero has a derivative to one side: no table is below zero.
            step = 1e-6
            low, high = (0.0, step) if name == "sigma_t" and array.flat[place] == 0 else (-step, step)
            expected = (loss(shifted(high)) - loss(shifted(low))) / (high - low)
            assert found.flat[place] == pytest.approx(expected, rel=2e-5, abs=2e-7), (name, place)


def test_forward_mode_agrees_with_reverse_mode(x64):
    one, loss = differentiable("local"), weighted_picture()
    moving, still = eqx.partition(one, eqx.is_inexact_array)
    along = jax.tree.map(lambda x: jnp.asarray(np.random.default_rng(x.size).normal(size=x.shape)), moving)
    forward = dataclasses.replace(jvr.Settings(0.7, termination=0), adjoint=jvr.Forward())

    def by_forward(moving):
        rgb = jvr.render(eqx.combine(moving, still), perspective(one.volume, 4, 4), forward).rgb
        return jnp.sum(rgb * jnp.asarray(np.random.default_rng(2).random(rgb.shape)))

    _, tangent = jax.jit(lambda moving: jax.jvp(by_forward, (moving,), (along,)))(moving)
    gradient = eqx.filter_jit(eqx.filter_grad(loss))(one)
    expected = sum(jnp.sum(g * t) for g, t in zip(jax.tree.leaves(gradient), jax.tree.leaves(along), strict=True))
    assert tangent == pytest.approx(float(expected), rel=1e-10)


# --- What is kept ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_what_is_computed_beforehand_gives_the_same_picture(method, tmp_path):
    """And knows what it was computed of; camera and lights may change."""
    one = scene(METHODS[method](rays=6, radius=3.0, samples=3, resolution=0.6))
    done = []
    kept = jvr.precompute(one, cache=tmp_path, report=done.append)
    assert (done[0].part, done[0].cached) == ("occlusion", False)
    assert kept.occlusion.is_frozen
    np.testing.assert_allclose(picture(kept), picture(one), atol=1e-6)
    assert jvr.precompute(kept) is not None
    again = jvr.precompute(one, cache=tmp_path, report=done.append)
    assert done[1].cached
    assert eqx.tree_equal(again, kept)
    brighter = dataclasses.replace(kept, lights=(jvr.AmbientLight(2.0),))
    assert np.all(np.isfinite(picture(brighter)))
    other = dataclasses.replace(kept, volume=jvr.Volume(voxels(seed=9), OBLIQUE))
    assert list(remarks_on(other, None)) == list(other.occlusion.stale(other)) != []
    with pytest.raises(ValueError, match=r"call jvr.precompute\(scene\) again.*occlusion.pinned\(\)"):
        jvr.render(other, perspective(other.volume))
    pinned = dataclasses.replace(other, occlusion=other.occlusion.pinned())
    with pytest.warns(RuntimeWarning, match="occlusion was computed for another"):
        jvr.render(pinned, perspective(other.volume))
    assert not jvr.precompute(other).occlusion.stale(other)


def test_plans_and_advice_say_what_it_is():
    one = scene(jvr.LocalOcclusion(4, samples=2))
    (entry,) = (part for part in jvr.plan(one).parts if part.name == "occlusion")
    assert entry.included
    assert "computed in each picture: jvr.precompute" in entry.reason
    (kept,) = (part for part in jvr.plan(jvr.precompute(one)).parts if part.name == "occlusion")
    assert "computed beforehand" in kept.reason
    titles = {candidate.title: candidate for candidate in effects_of(one)}
    drop = next(candidate for title, candidate in titles.items() if title.startswith("occlusion"))
    assert drop.change(one, jvr.Settings())[0].occlusion is None
    assert one.replaced(lights=()).occlusion is None
    assert one.replaced(shading=None).occlusion is None
    assert one.replaced(lights=(AMBIENT, SUN)).occlusion is not None


# --- Hard cases ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_hard_cases_are_finite_and_right(method):
    """One voxel, balls without extent and larger than the volume, opaque and empty media, one value everywhere."""
    make = lambda **numbers: METHODS[method](rays=8, samples=2, resolution=1.0, **numbers)
    plain = picture(scene())
    for numbers in ({"radius": 0.0}, {"radius": 0.5, "offset": 0.5}, {"radius": 0.3, "offset": 0.6}, {"offset": 1e3}):
        np.testing.assert_allclose(picture(scene(make(**numbers))), plain, atol=1e-6)
    for shape in ((1, 1, 1), (1, 4, 3)):
        assert np.all(np.isfinite(picture(scene(make(), shape=shape))))
    for sigma in (0.0, 1e6, 1e30):
        found = picture(homogeneous((5, 5, 5), sigma, occlusion=make(radius=2.0, offset=0.1)))
        assert np.all(np.isfinite(found))
        assert np.all(found <= 0.9)
        assert (found.max() > 0) == (sigma > 0)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"lights": (SUN,)}, r"add a jvr\.AmbientLight to lights="),
        ({"shading": None}, r"set shading=jvr\.Lambert\(\) or scattering="),
        ({"occlusion": jvr.ShadowRays()}, "occlusion must be one of jvr's"),
    ],
)
def test_what_does_not_go_together_says_what_would(parts, message):
    with pytest.raises((ValueError, TypeError), match=message):
        scene(**({"occlusion": jvr.LocalOcclusion()} | parts))


def test_ranges_of_voxels_have_other_spacing():
    """By default lengths are those of 16 voxels and one of the smallest spacing."""
    small = jvr.Volume(np.full((5, 5, 5), 0.5), affine((0.1, 0.2, 0.3)))
    one = dataclasses.replace(homogeneous((5, 5, 5), 2.0, occlusion=jvr.LocalOcclusion(4, samples=4)), volume=small)
    reach = one.occlusion.projection(one, lambda graded: absorbing(one, None, graded)).reach
    # The diagonal, beyond which there is nothing, is 1.5 long.
    np.testing.assert_allclose(reach.ends, np.linspace(0.1, np.sqrt(0.14) * 4, 5), rtol=1e-5)
    np.testing.assert_allclose(reach.length, 1.5, rtol=1e-5)
