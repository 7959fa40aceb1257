"""Isosurfaces in scenes: opaque and blended, lit, in pictures, derivatives, fits and files."""

import dataclasses
import itertools
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import linear_transfer, render

import jvr
from jvr.io.config import ConfigError, build_scene, config_from

SHAPE = (8, 8, 9)
BEHIND = np.array([0.3, 0.5, 0.7])


def grid(shape=SHAPE):
    return np.indices(shape).astype(float)


def ramp():
    """The scalar is the third coordinate, from 0 to 8."""
    return grid()[2]


def ball(shape=(13, 13, 13)):
    middle = (np.array(shape) - 1) / 2
    return -np.linalg.norm(grid(shape) - middle[:, None, None, None], axis=0)


def medium(sigma_t=0.0, colour=(0.2, 0.8, 0.4), high=8.0):
    """One that is the same everywhere."""
    return jvr.LinearTransfer([-20.0, high], [colour, colour], np.full((2, *np.shape(sigma_t)), sigma_t))


def from_above(volume, size=4, extent=3.0):
    """Rays down the third axis, which all meet the volume."""
    x, y, z = np.asarray(volume.center)
    return jvr.OrthographicCamera.look_at([x, y, z + 20], [x, y, z], [0, 1, 0], extent, size, size)


SETTINGS = jvr.Settings(0.5, termination=0)


def picture(scene, camera=None, settings=SETTINGS):
    return render(scene, from_above(scene.volume) if camera is None else camera, settings)


@pytest.mark.slow
def test_a_surface_ends_rays_and_shows_its_colour():
    """Its distance is the depth, and it lies in front of the background and behind what of the medium is in front of it."""
    sigma_t, red = 0.3, (0.9, 0.1, 0.2)
    surfaces = jvr.Isosurfaces([2.75], [red])
    scene = jvr.Scene(jvr.Volume(ramp()), medium(sigma_t), background=BEHIND, surfaces=surfaces)
    found, T = picture(scene), np.exp(-sigma_t * (8 - 2.75))
    np.testing.assert_allclose(found.rgb[1, 2], (1 - T) * np.array([0.2, 0.8, 0.4]) + T * np.array(red), rtol=1e-5)
    np.testing.assert_allclose(found.alpha, 1, rtol=1e-6)
    alone = picture(eqx.tree_at(lambda s: s.transfer.sigma_t, scene, jnp.zeros(2)))
    np.testing.assert_allclose(alone.rgb, np.broadcast_to(red, (4, 4, 3)), rtol=1e-6)
    np.testing.assert_allclose(alone.depth, 16 + 8 - 2.75, rtol=1e-6)


@pytest.mark.slow
def test_a_ray_that_meets_no_surface_is_as_without():
    scene = jvr.Scene(jvr.Volume(ramp()), medium(0.3), background=BEHIND)
    beyond = dataclasses.replace(scene, surfaces=jvr.Isosurfaces([11.0], [[1, 1, 1]]))
    for a, b in zip(jax.tree.leaves(picture(scene)), jax.tree.leaves(picture(beyond)), strict=True):
        if jnp.issubdtype(a.dtype, jnp.floating):
            np.testing.assert_allclose(a, b, rtol=1e-6)


def layers(opacity, values=(2.25, 6.75), sigma_t=0.0, **choices):
    surfaces = jvr.Isosurfaces(values, [[1.0, 0.2, 0.1], [0.1, 0.3, 1.0]], opacity, **choices)
    return jvr.Scene(jvr.Volume(ramp()), medium(sigma_t), background=BEHIND, surfaces=surfaces)


def closed(opacity, values, sigma_t):
    """Parallel layers from above, the second in front, in a homogeneous medium."""
    colours, sigma_t = np.array([[1.0, 0.2, 0.1], [0.1, 0.3, 1.0]]), np.asarray(sigma_t)
    glow, ends = np.array([0.2, 0.8, 0.4]), [8, values[1], values[0], 0]
    T = [np.exp(-sigma_t * (a - b)) for a, b in itertools.pairwise(ends)]
    a1, a0 = opacity[1], opacity[0]
    rgb = (1 - T[2]) * glow + T[2] * BEHIND
    rgb = (1 - T[1]) * glow + T[1] * (a0 * colours[0] + (1 - a0) * rgb)
    rgb = (1 - T[0]) * glow + T[0] * (a1 * colours[1] + (1 - a1) * rgb)
    return rgb, 1 - np.mean(T[0] * T[1] * T[2] * np.ones(3)) * (1 - a0) * (1 - a1)


@pytest.mark.slow
@pytest.mark.parametrize("sigma_t", [0.15, (0.05, 0.2, 0.6)], ids=["grey", "coloured"])
def test_translucent_layers_are_blended_at_their_place(sigma_t):
    """`L <- L1 + T1 (a c + (1 - a) L2)`, with opacities 0 and 1 as its ends, and where they are 1e-4 voxels apart."""
    for opacity in ((0.3, 0.6), (0.0, 1.0), (1.0, 0.0), (0.0, 0.0)):
        for values in ((2.25, 6.75), (4.3, 4.3001)):
            found = picture(layers(opacity, values, sigma_t))
            rgb, alpha = closed(opacity, values, sigma_t)
            np.testing.assert_allclose(found.rgb[2, 1], rgb, rtol=2e-5)
            np.testing.assert_allclose(found.alpha[2, 1], alpha, rtol=2e-5)
    # What is behind the last surface that a ray may pass is not looked for.
    one = picture(layers((0.3, 0.6), sigma_t=sigma_t, most=1)).rgb[2, 1]
    np.testing.assert_allclose(one, closed((0.0, 0.6), (2.25, 6.75), sigma_t)[0], rtol=2e-5)


@pytest.mark.slow
def test_opaque_surfaces_are_translucent_ones_of_opacity_one():
    values = ball()
    scene = jvr.Scene(jvr.Volume(values), medium(0.1), background=BEHIND)
    camera = jvr.PerspectiveCamera.look_at([25, -8, 16], [6, 6, 6], [0, 0, 1], 30, 8, 8)
    colours = [[1.0, 0.5, 0.2], [0.2, 0.6, 1.0]]
    opaque, blended = (
        picture(dataclasses.replace(scene, surfaces=jvr.Isosurfaces([-4.5, -2.0], colours, o)), camera) for o in (None, [1, 1])
    )
    np.testing.assert_allclose(opaque.rgb, blended.rgb, atol=1e-5)
    np.testing.assert_allclose(opaque.depth, blended.depth, rtol=1e-5)


def lit(surfaces, **parts):
    light = jvr.DirectionalLight([0.6, 0.3, -1.0], [1.2, 1.0, 0.8])
    parts = {"lights": [light], "shading": jvr.Lambert(), "transfer": medium(0.0)} | parts
    return jvr.Scene(jvr.Volume(ball()), surfaces=surfaces, background=BEHIND, **parts)


@pytest.mark.slow
def test_a_lit_ball_is_lambert_s():
    """Its normals are known, but for what the interpolant of distances is wrong by; a threshold of the gradient has no say."""
    surfaces, camera = jvr.Isosurfaces([-4.5], [[1.0, 0.5, 0.25]]), from_above(jvr.Volume(ball()), 9, 7.0)
    found = picture(lit(surfaces, shading=jvr.Lambert(threshold=50.0), normals=jvr.CentralDifferences()), camera)
    offset = (np.arange(9) + 0.5) / 9 * 7 - 3.5
    x, y = np.meshgrid(offset, -offset)
    z = np.sqrt(4.5**2 - x**2 - y**2, where=x**2 + y**2 < 4.5**2, out=np.full((9, 9), np.nan))
    w_i = -np.array([0.6, 0.3, -1.0]) / np.linalg.norm([0.6, 0.3, -1.0])
    cosine = np.maximum((x * w_i[0] + y * w_i[1] + z * w_i[2]) / 4.5, 0)
    wanted = cosine[..., None] * np.array([1.2, 0.5, 0.2])
    inside = np.isfinite(z) & (z > 1.5)
    np.testing.assert_allclose(np.asarray(found.rgb)[inside], wanted[inside], atol=0.03)
    assert np.abs(np.asarray(found.rgb)[inside] - wanted[inside]).mean() < 0.01


@pytest.mark.slow
def test_a_surface_lies_in_the_shadow_of_the_medium():
    """A slab between it and a light that shines straight down takes the same light everywhere."""
    values = ramp()
    surfaces, slab = jvr.Isosurfaces([1.5], [[1.0, 1.0, 1.0]]), jvr.LinearTransfer([4, 4.001, 8], np.zeros((3, 3)), [0, 0.2, 0.2])
    down = jvr.DirectionalLight([0.0, 0.0, -1.0], 2.0)
    scene = jvr.Scene(jvr.Volume(values), slab, lights=[down], shading=jvr.Lambert(), surfaces=surfaces)
    bright = picture(scene).rgb[1, 1, 0]
    dark = picture(dataclasses.replace(scene, shadows=jvr.ShadowRays(0.5, termination=0))).rgb[1, 1, 0]
    T = np.exp(-0.2 * 4)
    np.testing.assert_allclose(bright, 2 * T, rtol=1e-3)
    np.testing.assert_allclose(dark / bright, T, rtol=1e-2)


def smooth(shape=(8, 9, 8)):
    x, y, z = grid(shape)
    return np.sin(0.5 * x + 0.3) + np.cos(0.45 * y) + 0.3 * z - 0.05 * x * z


@pytest.mark.slow
@pytest.mark.parametrize("opacity", [None, (0.6, 0.8)], ids=["opaque", "blended"])
def test_derivatives_match_differences(x64, opacity):
    """In isovalues, colours, voxels, light and pose, in both modes and under `vmap`, at pixels that meet the same surfaces on both sides of
    the difference: the part of silhouettes is missing."""
    surfaces = jvr.Isosurfaces([0.6, 1.7], [[0.9, 0.4, 0.2], [0.2, 0.5, 0.9]], opacity, tolerance=1e-6, most=2)
    volume = jvr.Volume(smooth())
    scene = jvr.Scene(
        volume,
        jvr.LinearTransfer([-1, 3], [[0.3, 0.8, 0.2], [0.9, 0.3, 0.5]], [0.02, 0.2]),
        background=BEHIND,
        surfaces=surfaces,
    )
    if opacity is None:
        light = jvr.DirectionalLight([0.6, 0.3, -1.0])
        scene = dataclasses.replace(scene, lights=(light,), shading=jvr.Lambert(0.3, 0.7))
    camera = jvr.PerspectiveCamera.look_at([20, -9, 12], [3.5, 4, 3.5], [0, 0, 1], 24, 7, 6)
    where = lambda s, c: (s.surfaces, s.volume.values, s.lights, c.world_from_camera)
    base, rng = where(scene, camera), np.random.default_rng(0)
    tangents = jax.tree.map(lambda x: jnp.asarray(0.5 * rng.normal(size=x.shape)), base)
    tangents = (*tangents[:-1], tangents[-1].at[3].set(0))

    def seen(arrays):
        s, c = eqx.tree_at(lambda sc: where(*sc), (scene, camera), arrays)
        found = jvr.render(s, c, SETTINGS)
        return jnp.concatenate([found.rgb, 0.05 * found.depth[..., None]], axis=-1)

    at, h = jax.jit(seen), 1e-6
    moved = lambda h: at(jax.tree.map(lambda x, t: x + h * t, base, tangents))
    difference, twice = ((moved(k) - moved(-k)) / (2 * k) for k in (h, 2 * h))
    steady = np.all(np.isclose(difference, twice, rtol=1e-3, atol=1e-4) & (np.abs(difference) < 30), axis=-1)
    assert steady.mean() > 0.6
    along = jax.jit(lambda t: jax.jvp(seen, (base,), (t,))[1])(tangents)
    np.testing.assert_allclose(np.asarray(along)[steady], np.asarray(difference)[steady], rtol=2e-4, atol=2e-5)
    weights = jnp.asarray(rng.normal(size=along.shape) * steady[..., None])
    pull = jax.jit(lambda w: jax.vjp(seen, base)[1](w)[0])
    products = lambda gradient: sum(jnp.sum(g * t) for g, t in zip(*map(jax.tree.leaves, (gradient, tangents)), strict=True))
    np.testing.assert_allclose(products(pull(weights)), jnp.sum(weights * along), rtol=1e-8)
    both = jax.vmap(pull)(jnp.stack([weights, -3 * weights]))
    np.testing.assert_allclose(both[1][1], -3 * pull(weights)[1], rtol=1e-8, atol=1e-12)


@pytest.mark.slow
def test_rows_and_second_derivatives_follow(x64):
    surfaces = jvr.Isosurfaces([2.3], [[0.9, 0.4, 0.2]])
    scene = jvr.Scene(jvr.Volume(ramp()), medium(0.2), background=BEHIND, surfaces=surfaces)
    camera = from_above(scene.volume, 2)

    def red(level, adjoint):
        moved = eqx.tree_at(lambda s: s.surfaces.values, scene, level[None])
        return jvr.render(moved, camera, jvr.Settings(0.5, termination=0, adjoint=adjoint)).rgb[0, 0, 0]

    T = np.exp(-0.2 * (8 - 2.3))
    slope = 0.2 * T * (0.9 - 0.2)
    for adjoint in (jvr.Replay(), jvr.Rows()):
        np.testing.assert_allclose(jax.jit(jax.grad(red), static_argnums=1)(jnp.asarray(2.3), adjoint), slope, rtol=1e-6)
    twice = jax.jit(lambda x: jax.jvp(jax.grad(lambda x: red(x, jvr.Replay())), (x,), (1.0,))[1])(jnp.asarray(2.3))
    np.testing.assert_allclose(twice, 0.2 * slope, rtol=1e-6)


@pytest.mark.slow
def test_nothing_is_seen_inside_of_an_opaque_medium():
    """And nothing there has a derivative that is not finite."""
    scene = jvr.Scene(jvr.Volume(ramp()), medium(1e6), surfaces=jvr.Isosurfaces([2.5], [[1.0, 0.0, 0.0]], [0.5]))
    camera = from_above(scene.volume, 2)
    loss = lambda s: jnp.sum(jvr.render(s, camera, SETTINGS).rgb)
    inputs, rest = eqx.partition(scene, eqx.is_inexact_array)
    value, gradient = jax.jit(jax.value_and_grad(lambda x: loss(eqx.combine(x, rest))))(inputs)
    np.testing.assert_allclose(value, 4 * 1.4, rtol=1e-5)
    assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(gradient))
    assert not np.any(gradient.surfaces.rgb)


@pytest.mark.slow
def test_isovalue_colour_and_opacity_are_found_from_pictures():
    """With standard errors, from pictures with noise."""
    truth = jvr.Isosurfaces([-4.5], [[0.8, 0.5, 0.3]], [0.7], most=2)
    scene = jvr.Scene(jvr.Volume(ball()), medium(0.05), background=BEHIND, surfaces=truth)
    cameras = [
        jvr.PerspectiveCamera.look_at(eye, [6, 6, 6], [0, 0, 1], 30, 12, 12)
        for eye in ([28, -6, 14], [-10, 25, 10], [4, -16, -8])
    ]
    rng = np.random.default_rng(0)
    images = [np.asarray(picture(scene, camera).rgb) + 1e-3 * rng.normal(size=(12, 12, 3)) for camera in cameras]
    start = jvr.Isosurfaces([-4.2], [[0.5, 0.5, 0.5]], [0.5], most=2)
    unknowns = lambda s: (s.surfaces.values, s.surfaces.rgb, s.surfaces.opacity)
    found = jvr.fit(dataclasses.replace(scene, surfaces=start), cameras, images, unknowns=unknowns, settings=SETTINGS)
    for value, error, wanted in zip(unknowns(found.scene), found.standard_errors, unknowns(scene), strict=True):
        assert np.all(np.isfinite(error))
        assert np.all(np.asarray(error) < 0.05)
        np.testing.assert_allclose(value, wanted, atol=0.02)


def test_what_cannot_work_is_refused_with_a_remedy():
    with pytest.raises(ValueError, match="values must be strictly increasing, finite numbers: sort them"):
        jvr.Isosurfaces([0.5, 0.4], np.ones((2, 3)))
    with pytest.raises(ValueError, match=r"opacity must be in \[0, 1\]"):
        jvr.Isosurfaces([0.5], np.ones((1, 3)), [1.5])
    with pytest.raises(ValueError, match="rgb"):
        jvr.Isosurfaces([0.5, 0.6], np.ones((1, 3)))
    with pytest.raises(ValueError, match="leave band out"):
        jvr.Isosurfaces([0.5], np.ones((1, 3)), band=0.1, guaranteed=True)
    surfaces = jvr.Isosurfaces([0.5], np.ones((1, 3)))
    with pytest.raises(ValueError, match=r"Volume\(interpolation=jvr.Trilinear\(\)\)"):
        jvr.Scene(jvr.Volume(ramp(), interpolation=jvr.Nearest()), linear_transfer(), surfaces=surfaces)
    with pytest.raises(ValueError, match=r"normals=\.\.\.\(of_opacity=False\)"):
        lit(surfaces, normals=jvr.CentralDifferences(of_opacity=True))
    sliced = jvr.Settings(0.5, sampling=jvr.Slices())
    with pytest.raises(ValueError, match="surfaces"):
        jvr.render(jvr.Scene(jvr.Volume(ramp()), linear_transfer(), surfaces=surfaces), from_above(jvr.Volume(ramp())), sliced)


def test_a_configuration_has_all_of_it():
    """`[surfaces]`, whose kind goes without saying; what is wrong in it is said with its key."""
    tables = {"volume": {"builtin": "demo"}, "transfer": {"kind": "window"}}
    given = {"values": [0.2, 0.5], "rgb": [[1, 0, 0], [0, 1, 0]], "opacity": [0.5, 1.0], "band": 0.1, "step": 0.5, "most": 2}
    made = build_scene(config_from(tables | {"surfaces": given}, "a.toml", Path(), ())).surfaces
    expected = jvr.Isosurfaces(**given)
    assert eqx.tree_equal(made, jax.tree.map(jnp.asarray, expected))
    for wrong, said in (({"values": [0.5, 0.2]}, "surfaces.values"), ({"opacity": [0.5, 2.0]}, "surfaces.opacity")):
        with pytest.raises(ConfigError, match=said):
            build_scene(config_from(tables | {"surfaces": given | wrong}, "a.toml", Path(), ()))


def test_plan_and_knobs_know_it():
    scene = lit(jvr.Isosurfaces([-4.5, -3.0], np.ones((2, 3)), [0.5, 0.6], band=1.0))
    said = str(jvr.plan(scene))
    assert "surfaces" in said
    assert "2 isovalues, at most 4 a ray: a sample every 1 or 8 voxels; bricks without them are skipped" in said
    assert [knob.name for knob in scene.surfaces.knobs(scene)] == ["step", "coarse", "tolerance"]
    assert scene.surfaces.without(scene).surfaces is None
