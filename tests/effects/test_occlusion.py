"""Ambient occlusion: closed forms, brute force in NumPy, derivatives, what is kept, hard cases."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, affine, linear_transfer, perspective, render, voxels
from scipy.ndimage import map_coordinates

import jvr
from jvr.effects.local_histograms import LocalHistograms
from jvr.effects.occlusion import ProjectedOcclusion
from jvr.fitting.kinds import has_table_jacobian
from jvr.io.config import build_cameras, build_scene, read_config
from jvr.io.precompute import as_precomputed
from jvr.march.steps import Point
from jvr.rendering.advise import effects_of, remarks_on
from jvr.rendering.medium import absorbing

CONFIG = Path(__file__).parents[2] / "configs" / "occlusion.toml"
SHAPE = (7, 7, 7)
METHODS = {"local": jvr.LocalOcclusion, "histogram": jvr.HistogramOcclusion}


def ambient():
    return (jvr.AmbientLight((0.9, 0.6, 0.3)),)


def and_sun():
    return (*ambient(), jvr.DirectionalLight((0.3, -0.5, -1.0)))


# Scenes of one structure, most of them: their numbers go through one program.


def local(radius, offset=0.0, **numbers):
    return jvr.LocalOcclusion(128, radius=radius, offset=offset, samples=8, resolution=1.0, **numbers)


def scene(occlusion=None, shape=SHAPE, **parts):
    given = {"volume": jvr.Volume(voxels(shape), OBLIQUE), "transfer": linear_transfer(), "lights": ambient()}
    return jvr.Scene(**({"shading": jvr.Lambert(0.8), "occlusion": occlusion} | given | parts))


def homogeneous(sigma, occlusion):
    """One extinction wherever there is a volume."""
    transfer = jvr.LinearTransfer([0.0, 0.3, 0.6, 1.0], [[1.0, 1.0, 1.0]] * 4, [sigma] * 4)
    return scene(occlusion, volume=jvr.Volume(voxels(SHAPE)), transfer=transfer)


@jax.jit
def visibility(one: jvr.Scene):
    return one.occlusion.visibility(one, lambda graded: absorbing(one, None, graded))


def factors(one: jvr.Scene) -> np.ndarray:
    """What every node leaves of ambient light, visible or not."""
    grid = visibility(one).grid
    return (1 - np.asarray(grid.rows, np.float64).reshape(*[n + 1 for n in grid.cells], -1)) ** 2


def picture(one: jvr.Scene) -> np.ndarray:
    return np.asarray(render(one, perspective(one.volume)).rgb, np.float64)


def phi1(x):
    return np.where(np.equal(x, 0), 1.0, -np.expm1(-x) / np.where(np.equal(x, 0), 1.0, x))


def on_the_sphere(count: int) -> np.ndarray:
    """Directions at random."""
    directions = np.random.default_rng(5).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1)[:, None]


def around(one: jvr.Scene, start, radius, offset, rays=4000, steps=48) -> tuple[np.ndarray, np.ndarray]:
    """Scalars at distances along rays from a grid position, and which of them are inside, without jvr and in double precision."""
    matrix, values = np.asarray(one.volume.world_from_grid, np.float64), np.asarray(one.volume.values, np.float64)
    along = on_the_sphere(rays) @ np.linalg.inv(matrix[:3, :3]).T
    at = start + along[:, None] * (offset + (radius - offset) * (np.arange(steps) + 0.5) / steps)[:, None]
    inside = np.all((at >= 0) & (at <= np.array(values.shape) - 1), axis=-1)
    return map_coordinates(values, at.reshape(-1, 3).T, order=1, mode="nearest").reshape(inside.shape), inside


def brute_force(one: jvr.Scene, p: np.ndarray, radius: float, offset: float) -> np.ndarray:
    """The factor at grid positions `(n, 3)`, by the midpoint rule along many rays."""
    found = []
    for start in p:
        s, inside = around(one, start, radius, offset)
        sigma = np.interp(s, np.asarray(one.transfer.positions), np.asarray(one.transfer.sigma_t))
        dtau = np.where(inside, sigma, 0.0) * (radius - offset) / s.shape[1]
        found.append(np.mean(np.exp(-(np.cumsum(dtau, axis=1) - 0.5 * dtau))))
    return np.array(found)


# --- Closed forms ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.0, 1e-3, 0.5, 20.0])
def test_a_homogeneous_ball_has_the_closed_form(sigma):
    """`phi1(sigma (R - a))` at a node whose ball lies in the volume, whatever scalars are in it."""
    histograms = jvr.HistogramOcclusion(4, 8, shells=3, radius=3.0, offset=0.5, samples=8, resolution=1.0)
    assert factors(homogeneous(sigma, local(3.0, 0.5)))[3, 3, 3, 0] == pytest.approx(phi1(2.5 * sigma), abs=3e-6)
    # Rays that leave the volume just before they end may be in one cluster with those that do not.
    assert factors(homogeneous(sigma, histograms))[3, 3, 3, 0] == pytest.approx(phi1(2.5 * sigma), abs=5e-4)


@pytest.mark.slow
def test_what_glows_lights_what_is_near():
    """`(1 + c_E) phi1(sigma (R - a))` with `c_E` the `glow` times the emission, in each colour; and its derivative in the emission."""
    one, emission = homogeneous(0.5, local(3.0, 0.5, glow=2.0)), np.array([0.0, 0.1, 3.0])
    one = dataclasses.replace(one, transfer=dataclasses.replace(one.transfer, emission=jnp.asarray([emission] * 4)))
    np.testing.assert_allclose(factors(one)[3, 3, 3], (1 + 2 * emission) * phi1(1.25), rtol=1e-5)

    def lit(emission):
        glowing = dataclasses.replace(one, transfer=dataclasses.replace(one.transfer, emission=emission))
        return jnp.sum((1 - visibility(glowing).grid.rows.reshape(*SHAPE, 3)[3, 3, 3]) ** 2)

    slope = jax.grad(lit)(one.transfer.emission)
    np.testing.assert_allclose(np.sum(slope, axis=0), 2 * phi1(1.25), rtol=1e-5)
    with pytest.raises(ValueError, match=r"nothing glows: give the transfer function emission="):
        visibility(homogeneous(0.5, local(3.0, glow=1.0)))


def test_a_half_space_leaves_half():
    """A node on a face of the volume, with nothing beyond: `(1 + phi1(sigma (R - a))) / 2`, a half where that is opaque; on an edge and
    in a corner what is left is that of three and seven octants more."""
    for sigma in (0.7, 60.0):
        found, inside = factors(homogeneous(sigma, local(3.0)))[..., 0], phi1(3 * sigma)
        # The two hemispheres about z have as many rays; about other axes within what 128 directions know.
        assert found[3, 3, 0] == pytest.approx((1 + inside) / 2, abs=2e-6)
        for node, share in (((0, 3, 3), 1 / 2), ((0, 0, 3), 1 / 4), ((0, 0, 0), 1 / 8)):
            assert found[node] == pytest.approx(1 - share * (1 - inside), abs=0.012)


def test_a_ball_larger_than_the_volume_sees_all_of_it():
    """With all samples of a ray inside, what is left is the transmittance to where the volume ends."""
    length = np.min(3 / np.abs(on_the_sphere(4000)), axis=1)
    found = factors(homogeneous(0.3, local(1e6)))
    assert found[3, 3, 3, 0] == pytest.approx(np.mean(np.exp(-0.3 * length)), abs=0.01)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the occlusion was computed for another")
def test_ambient_light_alone_is_multiplied():
    """With `(bias + (1 - bias) I)^gamma`."""

    def drawn(taken, radiance=1.0, **numbers):
        kept = ProjectedOcclusion(jnp.full((2, 2, 2, 1), 1 - np.sqrt(1 - taken)), jnp.zeros((0, 2), jnp.uint32), pinned=True)
        lights = (jvr.AmbientLight(radiance * ambient()[0].radiance), and_sun()[1])
        return picture(scene(jvr.LocalOcclusion(**numbers).with_projected(kept), lights=lights))

    sun, both = drawn(0.0, radiance=0.0), drawn(0.0)
    np.testing.assert_allclose(both, picture(scene(lights=and_sun())), atol=1e-6)
    np.testing.assert_allclose(drawn(1.0), sun, atol=1e-6)
    assert np.ptp(both - sun) > 0.1
    for numbers, factor in (({}, 0.25), ({"bias": 0.2}, 0.4), ({"bias": 0.2, "gamma": 0.5}, 0.4**0.5), ({"gamma": 2.0}, 0.0625)):
        np.testing.assert_allclose(drawn(0.75, **numbers), sun + factor * (both - sun), atol=2e-6)


def test_coloured_extinction_has_a_factor_for_each_channel():
    table = linear_transfer()
    with_sigma = lambda sigma_t: scene(local(4.0), transfer=jvr.LinearTransfer(table.positions, table.rgb, sigma_t))
    apart = [factors(with_sigma(c * table.sigma_t)) for c in (1, 2, 3)]
    found = factors(with_sigma(np.asarray(table.sigma_t)[:, None] * [1, 2, 3]))
    np.testing.assert_allclose(found, np.concatenate(apart, axis=-1), atol=1e-6)


# --- Brute force -----------------------------------------------------------------------------------------------------


def test_nodes_are_those_of_brute_force():
    """At random nodes of an oblique volume with noise in it, of which samples half a voxel apart know so much."""
    one = scene(local(4.0, 0.5))
    node = np.random.default_rng(1).integers(0, 7, (16, 3))
    error = factors(one)[*node.T, 0] - brute_force(one, node, 4.0, 0.5)
    assert np.sqrt(np.mean(np.square(error))) < 0.01


@pytest.mark.slow
def test_more_rays_and_samples_come_nearer():
    one, node, errors = scene(), np.random.default_rng(1).integers(0, 7, (30, 3)), []
    truth = brute_force(one, node, 4.0, 0.5)
    for rays, samples in ((8, 4), (32, 8), (256, 32)):
        occlusion = jvr.LocalOcclusion(rays, radius=4.0, offset=0.5, samples=samples, resolution=1.0)
        found = factors(dataclasses.replace(one, occlusion=occlusion))[*node.T, 0]
        errors.append(np.sqrt(np.mean(np.square(found - truth))))
    assert errors[2] < 0.5 * errors[1] < 0.4 * errors[0]


def test_extinction_is_gone_beyond_a_clipping_box():
    """As in a volume that ends there."""
    values = voxels(SHAPE)
    box = jvr.ClippingBox((-9, -9, -9), (4, 99, 99))
    clipped = scene(local(3.0, 0.3), volume=jvr.Volume(values), clipping=box)
    at = np.array([[2, 3, 3], [4, 3, 3], [0, 1, 6]])
    expected = brute_force(scene(volume=jvr.Volume(values[:5])), at, 3.0, 0.3)
    np.testing.assert_allclose(factors(clipped)[*at.T, 0], expected, atol=0.02)


# --- Histograms ------------------------------------------------------------------------------------------------------

# Of three rays, as many clusters as rays.
FEW = {"shells": 3, "clusters": 65536, "radius": 0.9, "offset": 0.3, "samples": 6, "resolution": 1.0}


def along_rays(one: jvr.Scene, occlusion, node) -> tuple[np.ndarray, np.ndarray]:
    """Scalars along the rays of a node, each in the middle of a segment, in shells, and which of them are inside."""
    index = np.arange(occlusion.rays)
    cosine = 1 - (2 * index + 1) / occlusion.rays
    turn = np.pi * (3 - np.sqrt(5)) * index
    sine = np.sqrt(1 - cosine**2)
    directions = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=1)
    matrix, values = np.asarray(one.volume.world_from_grid, np.float64), np.asarray(one.volume.values, np.float64)
    length = (float(occlusion.radius) - float(occlusion.offset)) / occlusion.samples
    distance = float(occlusion.offset) + length * (np.arange(occlusion.samples) + 0.5)
    at = np.array(node) + (directions @ np.linalg.inv(matrix[:3, :3]).T)[:, None] * distance[:, None]
    inside = np.all((at >= 0) & (at <= np.array(values.shape) - 1), axis=-1)
    scalars = map_coordinates(values, at.reshape(-1, 3).T, order=1, mode="nearest")
    shape = (occlusion.rays, occlusion.shells, -1)
    return scalars.reshape(shape), inside.reshape(shape)


@pytest.mark.slow
def test_histograms_are_those_of_brute_force():
    """With as many clusters as rays nothing is lost: hats around the scalars of each bin, in each shell of each ray. What a transfer
    function makes of them is marched through the shells."""
    occlusion = jvr.HistogramOcclusion(9, 3, **FEW)
    values = voxels((3, 3, 3))
    one = scene(occlusion, volume=jvr.Volume(values))
    kept = jvr.precompute(one)
    held: LocalHistograms = kept.occlusion.projected
    np.testing.assert_allclose(held.extents, [0.2] * 3, rtol=1e-5)
    positions = np.asarray(held.positions, np.float64)
    np.testing.assert_allclose(positions, np.linspace(np.min(values), np.max(values), 9), rtol=1e-5)
    node = (1, 1, 1)
    s, inside = along_rays(one, occlusion, node)
    assert np.all(inside)
    expected = np.mean(np.maximum(0, 1 - np.abs(s[..., None] - positions) / (positions[1] - positions[0])), axis=2)
    np.testing.assert_allclose(np.asarray(held.weights)[np.asarray(held.codes)[:, *node]], expected, atol=2e-5)
    # The extinction of each bin, as its hat sees it.
    table, looks = linear_transfer(), positions[:, None] + np.arange(-8, 9) / 9 * (positions[1] - positions[0])
    hat = 1 - np.abs(np.arange(-8, 9)) / 9
    extinction = np.interp(np.clip(looks, positions[0], positions[-1]), table.positions, table.sigma_t) @ (hat / hat.sum())
    tau = expected @ extinction * 0.2
    left = np.mean(np.exp(-(np.cumsum(tau, axis=1) - tau)) * phi1(tau))
    assert factors(kept)[node][0] == pytest.approx(left, abs=2e-5)


@pytest.mark.slow
def test_a_new_transfer_function_changes_no_histogram():
    """What is invisible takes nothing; what is homogeneous sends on its own colour."""
    one = scene(jvr.HistogramOcclusion(4, 8, bleeding=0.5, **FEW | {"radius": 4.0}))
    kept = jvr.precompute(one)
    rgb, sigma = np.array([0.2, 0.5, 1.0]), 0.7
    like = lambda sigma: dataclasses.replace(kept, transfer=jvr.LinearTransfer([0.0, 0.3, 0.6, 1.0], [rgb] * 4, [sigma] * 4))
    assert like(sigma).occlusion.stale(like(sigma)) == ()
    plain = factors(dataclasses.replace(like(sigma), occlusion=kept.occlusion.rebuilt(bleeding=0.0)))
    assert np.ptp(plain) > 0.1
    np.testing.assert_allclose(factors(like(sigma)), plain + 0.5 * (1 - plain) * rgb, atol=2e-6)
    np.testing.assert_array_equal(factors(like(0.0)), 1.0)


@pytest.mark.slow
def test_histograms_know_what_stands_in_front_of_what():
    """A wall and, far behind it, another: the second takes next to nothing of what the first has left."""
    values = np.zeros((13, 13, 13), np.float32)
    values[8] = 1.0
    far = values.copy()
    far[10:12] = 1.0
    opaque = jvr.LinearTransfer([0.0, 0.4, 0.6, 1.0], [[1.0, 1.0, 1.0]] * 4, [0.0, 0.0, 9.0, 9.0])
    occlusion = jvr.HistogramOcclusion(16, radius=6.0, offset=0.5, resolution=0.5)
    walls = lambda v: scene(occlusion, volume=jvr.Volume(v), transfer=opaque)
    one, two = (factors(walls(v))[6, 6, 6, 0] for v in (values, far))
    (truth,) = brute_force(walls(values), np.array([[6, 6, 6]]), 6.0, 0.5)
    assert one == pytest.approx(truth, abs=0.03)
    assert two == pytest.approx(one, abs=0.02)


@pytest.mark.slow
def test_clusters_come_nearer_as_there_are_more():
    one = scene(jvr.HistogramOcclusion(32, 16, **FEW | {"radius": 4.0}))
    errors, truth = [], factors(one)
    for clusters in (1, 16, 256, 4096):
        occlusion = jvr.HistogramOcclusion(32, 16, **FEW | {"radius": 4.0, "clusters": clusters})
        errors.append(np.sqrt(np.mean(np.square(factors(dataclasses.replace(one, occlusion=occlusion)) - truth))))
    assert errors == sorted(errors, reverse=True)
    assert errors[3] < 0.003 < 0.1 * errors[0]


def test_histograms_know_no_gradients():
    one = scene(jvr.HistogramOcclusion(), transfer=jvr.GradientOpacity(linear_transfer(), 0.1, 0.5))
    with pytest.raises(ValueError, match=r"histograms know nothing of gradients.*use jvr\.LocalOcclusion"):
        visibility(one)


# --- Derivatives -----------------------------------------------------------------------------------------------------

ARRAYS = {
    "sigma_t": lambda s: s.transfer.sigma_t,
    "positions": lambda s: s.transfer.positions,
    "voxels": lambda s: s.volume.values,
    "radius": lambda s: s.occlusion.radius,
    "offset": lambda s: s.occlusion.offset,
    "bias": lambda s: s.occlusion.bias,
    "gamma": lambda s: s.occlusion.gamma,
}


def differentiable(method: str) -> jvr.Scene:
    """A scene with what is not visible in it: entries of the table, and bricks with no other value, far from all that is."""
    values = voxels((25, 4, 4))
    values[5:] *= 0.2
    transfer = jvr.LinearTransfer([0.1, 0.3, 0.6, 0.9], voxels((4, 3)), [0.0, 0.0, 0.4, 0.7])
    numbers = {"radius": 2.7, "offset": 0.4, "samples": 3, "resolution": 0.6, "bias": 0.1, "gamma": 0.8}
    return scene(METHODS[method](rays=6, **numbers), volume=jvr.Volume(values), transfer=transfer, lights=and_sun())


# What histograms have no derivative in.
DETACHED = {"voxels", "radius", "offset"}


def compare_with_differences(loss, one: jvr.Scene) -> None:
    """Reverse mode against central differences; of voxels and entries some."""
    without = DETACHED if isinstance(one.occlusion, jvr.HistogramOcclusion) else set()
    gradient = eqx.filter_jit(eqx.filter_grad(loss))(one)
    rng, loss = np.random.default_rng(3), jax.jit(loss)
    for name, of in ARRAYS.items():
        if of(one) is None or name in without:
            continue
        array, found = np.asarray(of(one)), np.asarray(of(gradient))
        assert np.any(found != 0), name
        for place in rng.choice(array.size, min(array.size, 6), replace=False):
            direction = (np.arange(array.size) == place).reshape(array.shape)
            shifted = lambda by, of=of, array=array, direction=direction: eqx.tree_at(
                of, one, jnp.asarray(array + by * direction)
            )
            # No table is below zero: there the derivative is that to one side.
            low, high = (0.0, 1e-6) if name == "sigma_t" and array.flat[place] == 0 else (-1e-6, 1e-6)
            expected = float(loss(shifted(high)) - loss(shifted(low))) / (high - low)
            assert found.flat[place] == pytest.approx(expected, rel=3e-5, abs=2e-7), (name, place)


def test_derivatives_of_nodes_are_those_of_differences(x64):
    def loss(one):
        at = jnp.asarray(np.random.default_rng(2).uniform(0, 3, (3, 9)))
        points = Point(tuple(at), tuple(at), *(jnp.zeros(9, jnp.int32),) * 2)
        (left,) = visibility(one).transmittances(points, jnp.ones(9, bool), reverse=True).ambient
        return jnp.sum(left * at[0])

    one = differentiable("local")
    compare_with_differences(loss, eqx.tree_at(lambda s: s.volume.values, one, one.volume.values[:6]))


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_derivatives_of_pictures_are_those_of_differences(x64, method):
    """Entries that nothing visible has any part in among them: what becomes visible does so in the light that reaches it."""
    one = differentiable(method)
    settings, camera = jvr.Settings(0.7, termination=0), perspective(one.volume, 5, 4)

    def loss(one):
        rgb = jvr.render(one, camera, settings).rgb
        return jnp.sum(rgb * jnp.asarray(np.random.default_rng(2).random(rgb.shape)))

    compare_with_differences(loss, one)


@pytest.mark.slow
def test_what_becomes_visible_does_so_in_the_light_that_is_left_there(x64):
    """Far from all that is visible: an entry of zero there has a derivative, by the light that the visible part leaves, although no picture
    needs to know that light before."""
    values = np.full((25, 12, 12), 0.2)
    values[:5] = 0.6 + 0.3 * voxels((5, 12, 12))
    transfer = jvr.LinearTransfer([0.1, 0.3, 0.6, 0.9], voxels((4, 3)), [0.0, 0.0, 3.0, 5.0])
    occlusion = jvr.LocalOcclusion(64, radius=32.0, offset=0.5, samples=16)
    one = scene(occlusion, volume=jvr.Volume(values), transfer=transfer)
    camera = jvr.OrthographicCamera.look_at([20, 5.5, 40], [20, 5.5, 0], [0, 1, 0], 2.0, 2, 2)

    @jax.jit
    def seen(one, sigma):
        moved = eqx.tree_at(lambda s: s.transfer.sigma_t, one, sigma)
        return jnp.sum(jvr.render(moved, camera, jvr.Settings(0.7, termination=0)).rgb)

    sigma, h = one.transfer.sigma_t, 1e-6
    expected = (seen(one, sigma.at[0].add(h)) - seen(one, sigma)) / h
    gradient = jax.jit(jax.grad(seen, argnums=1))
    assert gradient(one, sigma)[0] == pytest.approx(float(expected), rel=1e-4)
    bare = one.replaced(occlusion=None)
    assert gradient(bare, sigma)[0] > 1.01 * expected


@pytest.mark.slow
def test_forward_mode_agrees_with_reverse_mode(x64):
    one = differentiable("local")
    moving, still = eqx.partition(one, eqx.is_inexact_array)
    along = jax.tree.map(lambda x: jnp.asarray(np.random.default_rng(x.size).normal(size=x.shape)), moving)
    camera = perspective(one.volume, 4, 4)

    def loss(moving, adjoint):
        rgb = jvr.render(eqx.combine(moving, still), camera, jvr.Settings(0.7, termination=0, adjoint=adjoint)).rgb
        return jnp.sum(rgb * jnp.asarray(np.random.default_rng(2).random(rgb.shape)))

    _, tangent = jax.jit(lambda moving: jax.jvp(lambda m: loss(m, jvr.Forward()), (moving,), (along,)))(moving)
    gradient = jax.jit(jax.grad(lambda moving: loss(moving, jvr.Replay())))(moving)
    expected = sum(jnp.sum(g * t) for g, t in zip(jax.tree.leaves(gradient), jax.tree.leaves(along), strict=True))
    assert tangent == pytest.approx(float(expected), rel=1e-10)


# --- What is kept ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("method", ["local", "histogram"])
def test_what_is_computed_beforehand_is_kept(method, tmp_path):
    """And knows what it was computed of; camera and lights may change."""
    one, done = scene(METHODS[method](rays=6, radius=3.0, samples=3, resolution=0.6)), []
    kept = jvr.precompute(one, cache=tmp_path, report=done.append)
    assert (done[0].part, done[0].cached) == ("occlusion", False)
    assert kept.occlusion.is_frozen
    np.testing.assert_allclose(factors(kept), factors(one), atol=1e-6)
    again = jvr.precompute(one, cache=tmp_path, report=done.append)
    assert done[1].cached
    assert eqx.tree_equal(again, kept)
    assert eqx.tree_equal(jvr.precompute(kept), kept)
    brighter = dataclasses.replace(kept, lights=and_sun())
    assert brighter.occlusion.stale(brighter) == ()
    other = dataclasses.replace(kept, volume=jvr.Volume(voxels(SHAPE, seed=9), OBLIQUE))
    assert list(remarks_on(other, None)) == list(other.occlusion.stale(other)) != []
    with pytest.raises(ValueError, match=r"call jvr.precompute\(scene\) again.*occlusion.pinned\(\)"):
        other.current()
    with pytest.warns(RuntimeWarning, match="occlusion was computed for another"):
        dataclasses.replace(other, occlusion=other.occlusion.pinned()).current()
    assert not jvr.precompute(other).occlusion.stale(other)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_pictures_are_the_same_with_what_is_kept(method):
    """Nodes that nothing visible is near to are left out, and no picture shows it."""
    one = dataclasses.replace(differentiable(method), volume=jvr.Volume(np.asarray(differentiable(method).volume.values)))
    np.testing.assert_allclose(picture(jvr.precompute(one)), picture(one), atol=1e-6)
    skips_nothing = jvr.render(one, perspective(one.volume), jvr.Settings(skipping=False)).rgb
    np.testing.assert_allclose(jvr.render(one, perspective(one.volume)).rgb, skips_nothing, atol=1e-6)


def test_plans_and_advice_say_what_it_is():
    one = scene(jvr.LocalOcclusion(4, samples=2))
    (entry,) = (part for part in jvr.plan(one).parts if part.name == "occlusion")
    assert entry.included
    assert "computed in each picture: jvr.precompute" in entry.reason
    (kept,) = (part for part in jvr.plan(as_precomputed(one)).parts if part.name == "occlusion")
    assert "computed beforehand" in kept.reason
    drop = next(candidate for candidate in effects_of(one) if candidate.title.startswith("occlusion"))
    assert drop.change(one, jvr.Settings())[0].occlusion is None
    assert one.replaced(lights=()).occlusion is None
    assert one.replaced(shading=None).occlusion is None
    assert one.replaced(lights=and_sun()).occlusion is not None


def test_a_fit_knows_what_follows_the_transfer_function():
    """Kept histograms do, of which the table's own Jacobian knows nothing; what rays have found does not."""
    assert has_table_jacobian(as_precomputed(scene(jvr.LocalOcclusion(4, samples=2))))
    assert not has_table_jacobian(as_precomputed(scene(jvr.HistogramOcclusion(4, 2, samples=2))))


# --- Hard cases ------------------------------------------------------------------------------------------------------


def test_hard_cases_are_finite_and_right():
    """Balls without extent, and of a voxel's; opaque and empty media, one value everywhere; volumes of one voxel along an axis or all."""
    for radius, offset in ((0.0, 0.0), (0.5, 0.5), (0.3, 0.6), (2e3, 1e3)):
        np.testing.assert_allclose(factors(scene(local(radius, offset))), 1.0, atol=1e-6)
    for sigma in (0.0, 1e6, 1e30):
        found = factors(homogeneous(sigma, local(2.0, 0.1)))
        assert np.all(found == 1.0) if sigma == 0 else np.all((found > 0) & (found < 0.95))
        assert sigma == 0 or found[3, 3, 3] < 0.01
    few = {"rays": 8, "radius": 2.0, "samples": 2, "resolution": 1.0}
    for make in METHODS.values():
        found = factors(scene(make(**few), volume=jvr.Volume(np.full((1, 4, 1), 0.5))))
        assert np.all((found > 0) & (found <= 1))
        assert found.min() < 1


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_pictures_of_hard_cases_are_finite(method):
    make = lambda **numbers: METHODS[method](rays=8, samples=2, resolution=1.0, **numbers)
    for parts in ({"shape": (1, 1, 1)}, {"transfer": linear_transfer(scale=0.0)}, {"transfer": linear_transfer(scale=1e30)}):
        assert np.all(np.isfinite(picture(scene(make(radius=1e6), **parts))))
    np.testing.assert_allclose(picture(scene(make(radius=0.0))), picture(scene()), atol=1e-6)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"lights": and_sun()[1:]}, r"add a jvr\.AmbientLight to lights="),
        ({"shading": None}, r"set shading=jvr\.Lambert\(\) or scattering="),
    ],
)
def test_what_does_not_go_together_says_what_would(parts, message):
    with pytest.raises(ValueError, match=message):
        scene(**({"occlusion": jvr.LocalOcclusion()} | parts))


@pytest.mark.slow
def test_the_configuration_says_what_it_draws():
    """At four pixels a side and a few nodes."""
    few = ["occlusion.rays=4", "occlusion.samples=2", "occlusion.resolution=0.1", "settings.step=8"]
    config = read_config(CONFIG, ["camera.width=4", "camera.height=4", *few])
    one = build_scene(config)
    (camera,) = build_cameras(config, one.volume)
    assert isinstance(one.occlusion, jvr.LocalOcclusion)
    plain, occluded = (jvr.render(x, camera, jvr.Settings(8.0)).rgb for x in (dataclasses.replace(one, occlusion=None), one))
    assert np.all(occluded <= plain + 1e-6)
    assert np.max(plain - occluded) > 0.05


def test_lengths_are_by_default_those_of_voxels():
    """16 and one of the smallest spacing."""
    small = jvr.Volume(np.full((5, 5, 5), 0.5), affine((0.1, 0.2, 0.3)))
    one = scene(jvr.LocalOcclusion(4, samples=4), volume=small)
    reach = one.occlusion.projection(one, lambda graded: absorbing(one, None, graded)).reach
    # The diagonal, beyond which there is nothing, is 1.5 long.
    np.testing.assert_allclose(reach.ends, np.linspace(0.1, np.sqrt(0.14) * 4, 5), rtol=1e-5)
    np.testing.assert_allclose(reach.length, 1.5, rtol=1e-5)
