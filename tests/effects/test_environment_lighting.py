"""Environment lighting, materials under it, and radiance transfer: closed forms, white furnace, independent sums, gradients."""

import dataclasses
import itertools
import math
import shutil

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, linear_transfer, perspective, rotation, voxels

import jvr
from jvr.effects.diffusion import kernel_of, scatter
from jvr.effects.environment_lighting import environment_lighting
from jvr.effects.radiance_transfer_grid import RadianceTransferProjection
from jvr.model.harmonics.projection import sphere_nodes
from jvr.rendering.medium import absorbing

SETTINGS = jvr.Settings(0.7, termination=0)
CONSTANT = math.sqrt(4 * math.pi)


def light(order=3, seed=0, clamped=True):
    c = 0.3 * np.random.default_rng(seed).normal(size=((order + 1) ** 2, 3))
    c[0] = 4.0
    return jvr.EnvironmentLight(c, clamped=clamped)


def scene(material=None, transfer=None, shape=(5, 6, 7), **parts):
    parts = {"environment": light(), "material": material or jvr.LambertBRDF(), "radiance_transfer": transfer} | parts
    return jvr.Scene(jvr.Volume(voxels(shape), OBLIQUE), linear_transfer(), **parts)


def low(transfer, **parts):
    """A scene whose light and transfer have four bands: what is the same for any number of them is tested with few."""
    return scene(transfer=transfer, environment=light(1), **parts)


def picture(scene, settings=SETTINGS):
    camera = perspective(scene.volume, width=6, height=5)
    return jax.jit(jvr.render, static_argnums=2)(scene, camera, settings).rgb


def transfer_at(scene):
    """Coefficients at the nodes of a scene, `(nodes, channels, bands)`, and `solid` and `facing` side by side."""
    return jax.jit(
        lambda s: RadianceTransferProjection.of(s, absorbing(s, None, s.radiance_transfer.rays_need_gradient)).all_nodes()
    )(scene)


@pytest.mark.slow
def test_environment_lights_among_the_lights_add_up():
    """Each has coefficients of its own; together they are their sum, and ask for what shows them."""
    probe, lamp = light(), light(order=2, seed=5)
    apart = scene(environment=probe, lights=(lamp,))
    np.testing.assert_allclose(picture(apart), picture(scene(environment=probe + lamp)), rtol=1e-6, atol=1e-7)
    assert [x.coefficients.shape[0] for x in apart.environment_lights] == [16, 9]
    assert apart.replaced(environment=None).material is not None
    assert apart.replaced(environment=None, lights=()).material is None
    with pytest.raises(ValueError, match="nothing shows the environment"):
        jvr.Scene(apart.volume, apart.transfer, lights=(lamp,))


# --- light -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_radiance_of_a_disc_is_that_of_its_projection():
    towards, half_angle = np.array([0.3, -0.5, 0.8]), 35.0
    towards /= np.linalg.norm(towards)
    with jax.enable_x64(True):
        disc = jvr.EnvironmentLight.disc(towards, half_angle, [1.0, 2.0, 3.0], order=4)
        inside = lambda d: (
            jnp.where(d @ towards >= math.cos(math.radians(half_angle)), 1.0, 0.0)[:, None] * jnp.array([1.0, 2, 3])
        )
        by_quadrature = jvr.sh.project(inside, 4, degree=800)
    np.testing.assert_allclose(disc.coefficients, by_quadrature, atol=5e-3)


@pytest.mark.parametrize("degrees", [0.2665, 0.05, 0.01, 1e-4])
def test_a_small_lamp_keeps_its_light(degrees):
    """The sun and smaller: in float32 as in closed form, where all bands are those of a point of that solid angle."""
    disc = jvr.EnvironmentLight.disc([0.3, -0.5, 0.8], degrees, order=4)
    towards = np.array([[0.3, -0.5, 0.8]]) / math.sqrt(0.98)
    solid_angle = 4 * math.pi * math.sin(math.radians(degrees) / 2) ** 2
    np.testing.assert_allclose(disc.coefficients[:, 0], solid_angle * jvr.sh.evaluate(4, towards)[0], rtol=2e-4)


def test_rotating_the_light_and_the_directions_is_the_same():
    turn, d = rotation(0.2, 0.9, -0.4), np.random.default_rng(0).normal(size=(10, 3))
    np.testing.assert_allclose(light().rotated(turn).radiance(d @ turn.T), light().radiance(d), rtol=1e-5)


def test_environments_add_up():
    both = light(3) + light(1, seed=1)
    d = np.random.default_rng(0).normal(size=(10, 3))
    np.testing.assert_allclose(both.radiance(d), light(3).radiance(d) + light(1, seed=1).radiance(d), rtol=1e-5)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.ones((8, 8, 3)), "2:1"),
        (np.full((4, 8, 3), np.nan), "finite"),
        (np.full((4, 8, 3), -1.0), "negative"),
        (np.ones((4, 8)), "shape"),
    ],
)
def test_maps_that_are_none_are_refused(image, message):
    with pytest.raises(ValueError, match=message):
        jvr.EnvironmentLight.from_image(image)


# --- materials -------------------------------------------------------------------------------------------------------


reflect = eqx.filter_jit(lambda lighting, s, n, w_o: lighting.reflect(jnp.asarray(s), jnp.asarray(1.0), n, w_o, ()))
evaluate = eqx.filter_jit(lambda brdf, w_o, w_i: brdf.evaluate(tuple(map(jnp.asarray, w_o)), tuple(map(jnp.asarray, w_i))))

MATERIALS = {
    "lambert": jvr.LambertBRDF(0.8),
    "blinn-phong": jvr.BlinnPhongBRDF(0.5, 0.4, 12.0),
    "microfacet": jvr.MicrofacetBRDF(roughness=0.6),
    "phase": jvr.PhaseBRDF(jvr.HenyeyGreenstein(0.4), 0.9),
}


@pytest.mark.parametrize(
    "name", ["lambert", *(pytest.param(name, marks=pytest.mark.slow) for name in ("blinn-phong", "microfacet")), "phase"]
)
def test_what_is_reflected_is_the_integral_of_material_and_light(name):
    """Against the sum over directions of the material's own projection in the world."""
    brdf, env = MATERIALS[name], light()
    with jax.enable_x64(True):
        brdf, env = jax.tree.map(lambda x: x.astype(float), (brdf, env))
        material = jvr.HarmonicMaterial.project(brdf, 3, directions=64, nodes=48)
        lighting = environment_lighting(material, env.coefficients, clamped=False, order=3, from_samples=False)
        nodes, weights = sphere_nodes(160)
        functions, radiance = np.asarray(jvr.sh.evaluate(3, nodes)), np.asarray(env.coefficients)
        rng = np.random.default_rng(0)
        for _ in range(3):
            n, w_o = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
            n = n if n @ w_o > 0 else -n
            t = w_o - (w_o @ n) * n
            frame = np.stack([t / np.linalg.norm(t), np.cross(n, t / np.linalg.norm(t)), n])
            own_o, own_i = frame @ w_o, frame @ nodes.T
            parts = evaluate(brdf, tuple(own_o), tuple(own_i))
            found = reflect(lighting, 0.5, tuple(n), tuple(w_o))
            for part, value in zip(parts, found, strict=True):
                expected = [
                    (functions.T @ (weights * np.asarray(part[c % len(part)]))) @ radiance[:, c] if part else 0.0
                    for c in range(3)
                ]
                np.testing.assert_allclose(value, expected, atol=4e-3)


@pytest.mark.slow
@pytest.mark.parametrize("order", [0, 3])
@pytest.mark.parametrize("material", [jvr.LambertBRDF(1.0), jvr.PhaseBRDF(jvr.HenyeyGreenstein(0.7))])
def test_white_furnace(material, order):
    """A material that absorbs nothing under light of one shows the colour of the medium."""
    lit = scene(material, environment=jvr.EnvironmentLight.constant(1.0, order))
    unlit = dataclasses.replace(lit, environment=None, material=None)
    np.testing.assert_allclose(picture(lit), picture(unlit), atol=2e-5)


@pytest.mark.slow
def test_a_vanishing_gradient_shows_the_mean_of_the_light():
    flat = jvr.Volume(np.full((4, 4, 4), 0.5))
    lit = dataclasses.replace(scene(), volume=flat)
    unlit = dataclasses.replace(lit, environment=None, material=None)
    mean = np.asarray(light().coefficients[0]) / CONSTANT
    np.testing.assert_allclose(picture(lit), picture(unlit) * mean, rtol=1e-4)


@pytest.mark.slow
def test_materials_by_value_are_linear_between_their_positions():
    kinds = jvr.LambertBRDF(0.2), jvr.BlinnPhongBRDF(0.6, 0.0)
    both = jvr.MaterialByValue([0.0, 1.0], kinds).projected(3)
    alone = [kind.projected(3) for kind in kinds]
    n, w_o = (jnp.array(v) / np.linalg.norm(v) for v in ([1.0, 2, 3], [1.0, 0, 2]))
    at = lambda m, s: reflect(
        environment_lighting(m, light().coefficients, clamped=True, order=3, from_samples=False), s, tuple(n), tuple(w_o)
    )[0]
    values = [np.array(at(m, 0.0)) for m in alone]
    for s in (-1.0, 0.0, 0.25, 1.0, 2.0):
        share = min(max(s, 0.0), 1.0)
        np.testing.assert_allclose(at(both, s), (1 - share) * values[0] + share * values[1], rtol=1e-4)


def test_phase_functions_and_surfaces_do_not_mix_by_value():
    with pytest.raises(ValueError, match="phase function"):
        jvr.MaterialByValue([0.0, 1.0], [jvr.LambertBRDF(), MATERIALS["phase"]]).projected(2)


@pytest.mark.slow
def test_ringing_is_cut_off_unless_it_is_asked_for():
    lamp = jvr.EnvironmentLight.disc([0, 0, 1], 3.0, 1e4)
    assert np.min(picture(scene(jvr.PhaseBRDF(jvr.HenyeyGreenstein(0.9)), environment=lamp))) >= 0
    rings = jvr.EnvironmentLight(lamp.coefficients, clamped=False)
    assert np.min(picture(scene(jvr.PhaseBRDF(jvr.HenyeyGreenstein(0.9)), environment=rings))) < 0


# --- radiance transfer -----------------------------------------------------------------------------------------------


def test_nothing_in_the_way_is_a_transfer_of_one():
    empty = jvr.LinearTransfer([0.0, 1.0], [[1, 1, 1]] * 2, [0.0, 0.0])
    c, around = transfer_at(dataclasses.replace(scene(transfer=jvr.RadianceTransfer(rays=8)), transfer=empty))
    np.testing.assert_allclose(around, 0.0, atol=1e-6)
    np.testing.assert_allclose(c[:, 0, 0], CONSTANT, rtol=1e-5)
    np.testing.assert_allclose(c[:, 0, 1:], 0.0, atol=1e-5)


@pytest.mark.parametrize("material", [jvr.LambertBRDF(), jvr.PhaseBRDF(jvr.Isotropic())])
def test_above_an_opaque_half_space(material):
    """A medium without surfaces is lit from above the horizon, and not from below: coefficients of the cap in closed form. For a surface
    everything is open that it could be lit from, and what is below the horizon counts alike, from below the surface too."""
    values = np.broadcast_to(np.linspace(1, 0, 21)[None, None], (41, 41, 21))
    opaque = jvr.LinearTransfer([0.0, 0.499, 0.501, 1.0], [[1, 1, 1]] * 4, [0.0, 0.0, 1e3, 1e3])
    half_space = jvr.Scene(
        jvr.Volume(values),
        opaque,
        environment=light(),
        material=material,
        radiance_transfer=jvr.RadianceTransfer(rays=1024, resolution=0.1),
    )
    projection = RadianceTransferProjection.of(half_space, absorbing(half_space, None, False))
    c, around = jax.jit(lambda q, p: q.project(p))(projection, jnp.array([[20.0, 20.0, 10.2], [20.0, 20.0, 9.0]]))
    from jvr.model.harmonics.projection import cap

    expected = np.zeros((2, 16))
    if material.needs_gradient:
        expected[:, 0] = CONSTANT
        np.testing.assert_allclose(around, [[1, 0, 0, 1]] * 2, atol=0.02)
    else:
        expected[0, np.arange(4) * np.arange(1, 5)] = jnp.stack(cap(jnp.asarray(1.0), 3))
    np.testing.assert_allclose(c[:, 0], expected, atol=0.05)


@pytest.mark.slow
def test_transfer_is_a_plain_sum_over_rays():
    """A loop over directions and steps, by the equations, in NumPy."""
    transfer = jvr.RadianceTransfer(order=2, rays=7, resolution=1.0, growth=1.3, termination=0.0)
    lit = scene(transfer=transfer)
    c, around = transfer_at(lit)
    p = np.array([2.0, 3.0, 3.0])
    index = int(np.ravel_multi_index((2, 3, 3), (5, 6, 7)))
    volume, table = lit.volume, lit.transfer
    extinction = lambda p: float(table.evaluate(volume.sample(tuple(jnp.asarray(p, jnp.float32)))).sigma_t[0])
    spacing, axes = float(jnp.min(volume.spacing)), OBLIQUE[:3, :3]
    opacity = {o: 1 - math.exp(-spacing * extinction(p + o)) for o in itertools.product((-1, 0, 1), repeat=3)}
    sobel = [sum(-o[i] * 2 ** (3 - np.count_nonzero(o)) * v for o, v in opacity.items()) / 32 for i in range(3)]
    gradient = np.linalg.inv(axes).T @ sobel
    m, most = 2 * np.linalg.norm(gradient) * spacing, max(opacity.values())
    axis, solid = gradient / np.linalg.norm(gradient), most * m**2 / (m**2 + 0.1**2)
    np.testing.assert_allclose(around[index], [solid, *(m**2 / (m**2 + 0.01**2) * axis)], rtol=1e-4)
    sine = math.sin(math.pi / 2 * (1 - solid))
    begin = p + np.linalg.inv(axes) @ (1.75 * spacing * solid * axis)
    sign = 1.0 if axis[2] >= 0 else -1.0
    a = -1 / (sign + axis[2])
    b = axis[0] * axis[1] * a
    frame = np.array([[1 + sign * axis[0] ** 2 * a, sign * b, -sign * axis[0]], [b, sign + axis[1] ** 2 * a, -axis[1]], axis])
    ends = 2 * float(volume.radius) * transfer.boundaries(volume.shape)
    carried, functions = [], []
    for k in range(7):
        cosine = 1 - (1 + sine) * (k + 0.5) / 7
        around_axis, radius = math.pi * (3 - math.sqrt(5)) * k, math.sqrt(1 - cosine**2)
        d = np.array([radius * math.cos(around_axis), radius * math.sin(around_axis), cosine]) @ frame
        along = np.linalg.inv(axes) @ d
        with np.errstate(divide="ignore"):
            out = min(np.maximum((0 - begin) / along, (np.array(volume.shape) - 1 - begin) / along))
        tau = 0.0
        for near, far in itertools.pairwise(ends):
            low, high = min(near, out), min(far, out)
            tau += (high - low) * extinction(begin + 0.5 * (low + high) * along) if high > low else 0.0
        carried.append(math.exp(-tau))
        functions.append(np.asarray(jvr.sh.evaluate(2, d[None])[0]))
    # Directions without rays count as the mean of the others.
    mean = np.mean(carried)
    total = 2 * math.pi * (1 + sine) / 7 * (np.array(carried) - mean) @ np.array(functions)
    total[0] += CONSTANT * mean
    np.testing.assert_allclose(c[index, 0], total, rtol=2e-3, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("exact", [False, True])
def test_a_white_medium_that_bleeds_hides_nothing(exact):
    """What rays pass is as bright as what is behind it."""
    transfer = jvr.RadianceTransfer(resolution=1.0, bleeding=jvr.TransferBleeding(), exact=exact, surface=1e6)
    white = jvr.LinearTransfer([0.0, 1.0], [[1, 1, 1]] * 2, [0.1, 1.5])
    lit = dataclasses.replace(scene(transfer=transfer), transfer=white)
    without = dataclasses.replace(lit, radiance_transfer=None)
    np.testing.assert_allclose(picture(lit), picture(without), rtol=0.03)


@pytest.mark.slow
def test_material_and_transfer_bleed_alike_where_the_material_reflects_all():
    kinds = [jvr.RadianceTransfer(resolution=1.0, bleeding=kind) for kind in (jvr.TransferBleeding(), jvr.MaterialBleeding())]
    coefficients = [transfer_at(scene(jvr.LambertBRDF(1.0), kind))[0] for kind in kinds]
    np.testing.assert_allclose(*coefficients, atol=2e-3)
    grey = transfer_at(scene(jvr.LambertBRDF(0.5), kinds[1]))[0]
    assert np.all(np.asarray(grey[:, :, 0]) < np.asarray(coefficients[1][:, :, 0]))


def test_clipped_medium_is_not_in_the_way():
    clip = jvr.ClippingBox([-100, -100, -100], [100, 100, -99])
    c, _ = transfer_at(scene(transfer=jvr.RadianceTransfer(surface=1e6), clipping=clip))
    np.testing.assert_allclose(c[:, 0, 0], CONSTANT, rtol=1e-5)


@pytest.mark.slow
def test_luma_and_colour_differences_are_the_same_colours():
    transfer = jvr.RadianceTransfer(resolution=1.0, bleeding=jvr.TransferBleeding(), chromaticity=3)
    whole = picture(scene(transfer=jvr.RadianceTransfer(resolution=1.0, bleeding=jvr.TransferBleeding())))
    np.testing.assert_allclose(picture(scene(transfer=transfer)), whole, rtol=1e-4)


@pytest.mark.parametrize("dipole", ["marble", "skin1"])
def test_the_scattering_pass_is_the_direct_sum(dipole):
    dipole, shape = jvr.Dipole.preset(dipole), (4, 5, 3)
    volume = jvr.Volume(voxels((10, 13, 7)), OBLIQUE)
    rng = np.random.default_rng(0)
    c, there = rng.normal(size=(*shape, 1, 4)).astype(np.float32), rng.random(shape) > 0.3
    found = scatter(dipole, 0.5, volume, jnp.asarray(c), jnp.asarray(there))
    kernel = np.asarray(kernel_of(dipole, 0.5, volume, shape))
    half = np.array(kernel.shape[1:]) // 2
    for i in np.ndindex(*shape):
        weights = np.zeros((3, *shape))
        for j in np.ndindex(*shape):
            offset = np.array(i) - np.array(j) + half
            if there[j] and np.all(offset >= 0) and np.all(offset < kernel.shape[1:]):
                weights[(slice(None), *j)] = kernel[(slice(None), *offset)]
        for channel in range(3):
            if not there[i]:
                np.testing.assert_array_equal(found[i][channel], 0)
                continue
            mean = np.tensordot(weights[channel], c[..., 0, :], axes=3) / weights[channel].sum()
            np.testing.assert_allclose(found[i][channel], dipole.total[channel] * mean, rtol=2e-3, atol=2e-4)


@pytest.mark.slow
def test_computed_beforehand_and_in_the_picture_are_the_same(tmp_path):
    lit = low(jvr.RadianceTransfer(1, rays=16), shape=(7, 9, 8))
    shares = []
    frozen = jvr.precompute(lit, cache=tmp_path, progress=shares.append)
    assert shares[-1] == 1.0
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    again = jvr.precompute(lit, cache=tmp_path)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == kept
    for other in (frozen, again):
        np.testing.assert_allclose(picture(other), picture(lit), atol=1e-5)
    for path in kept:
        path.write_bytes(path.read_bytes()[:100])
    np.testing.assert_allclose(picture(jvr.precompute(lit, cache=tmp_path)), picture(lit), atol=1e-5)


@pytest.mark.slow
def test_what_is_kept_may_be_deleted_at_any_time(tmp_path):
    """One file, all of the folder, or the folder while a result is on its way to it."""
    folder, lit = tmp_path / "kept", scene(transfer=jvr.RadianceTransfer(0, rays=1, resolution=0.1), shape=(4, 4, 4))

    def cached(lit, after=lambda part: None):
        parts = []
        jvr.precompute(lit, cache=folder, report=lambda part: (parts.append(part), after(part)))
        return [part.cached for part in parts]

    plain = dataclasses.replace(lit, radiance_transfer=None)
    assert cached(plain) == [False]
    assert cached(plain) == [True]
    next(folder.glob("*.npz")).unlink()
    assert cached(plain) == [False]
    shutil.rmtree(folder)
    assert cached(plain) == [False]
    with pytest.warns(RuntimeWarning, match="radiance transfer is used and not kept"):
        assert cached(lit, lambda part: shutil.rmtree(folder, ignore_errors=True)) == [True, False]


@pytest.mark.slow
@pytest.mark.parametrize("bleeding", [None, jvr.MaterialBleeding()])
def test_what_was_computed_for_another_scene_is_refused(bleeding):
    """With concrete arrays, and where the scene is an argument of a compiled function."""
    frozen = jvr.precompute(low(jvr.RadianceTransfer(1, rays=4, resolution=0.4, bleeding=bleeding)))
    camera, volume = perspective(frozen.volume, width=4, height=4), frozen.volume
    compiled_render = jax.jit(lambda s: jvr.render(s, camera, SETTINGS).rgb)
    expected = compiled_render(frozen)
    assert np.any(expected > 0)
    # Equal numbers in other arrays are no other scene.
    np.testing.assert_array_equal(compiled_render(jax.tree.map(jnp.array, frozen)), expected)
    relit = dataclasses.replace(frozen, environment=light(1, seed=7))
    assert relit.radiance_transfer.stale(relit) == ()
    changed = {
        "transfer function": dataclasses.replace(frozen, transfer=linear_transfer(seed=5)),
        "volume": dataclasses.replace(frozen, volume=jvr.Volume(voxels(volume.shape, seed=9), OBLIQUE)),
        "one voxel": eqx.tree_at(lambda s: s.volume.values, frozen, volume.values.at[2, 3, 1].add(1e-6)),
        "slope": eqx.tree_at(lambda s: s.volume.slope, frozen, 1.5 * volume.slope),
        "place": eqx.tree_at(lambda s: s.volume.world_from_grid, frozen, 1.1 * volume.world_from_grid),
        "interpolation": dataclasses.replace(
            frozen, volume=jvr.Volume(volume.values, volume.world_from_grid, interpolation=jvr.Nearest())
        ),
        "clipping": dataclasses.replace(frozen, clipping=jvr.ClippingBox(volume.center - 2, volume.center + 2)),
    }
    if bleeding is not None:
        changed["material"] = dataclasses.replace(frozen, material=jvr.LambertBRDF(0.3))
    for name, other in changed.items():
        with pytest.raises(ValueError, match=r"another .*jvr.precompute\(scene\) again"):
            jvr.render(other, camera, SETTINGS)
        assert other.radiance_transfer.stale(other), name
    for name in ("transfer function", "one voxel"):
        with pytest.raises(Exception, match=r"another .*jvr.precompute\(scene\) again"):
            jax.block_until_ready(compiled_render(changed[name]))


@pytest.mark.slow
def test_what_is_refused_is_computed_again_or_pinned(tmp_path):
    """Also where all but what changed is closed over."""
    lit = low(jvr.RadianceTransfer(1, rays=8, resolution=0.4))
    changed = dataclasses.replace(lit, volume=jvr.Volume(voxels(lit.volume.shape, seed=9), OBLIQUE))
    frozen = jvr.precompute(lit, cache=tmp_path)
    camera = perspective(lit.volume, width=6, height=5)
    of_voxels = jax.jit(lambda v: jvr.render(eqx.tree_at(lambda s: s.volume.values, frozen, v), camera, SETTINGS).rgb)
    np.testing.assert_allclose(of_voxels(lit.volume.values), picture(lit), atol=1e-5)
    with pytest.raises(Exception, match=r"another .*jvr.precompute\(scene\) again"):
        jax.block_until_ready(of_voxels(changed.volume.values))
    stale = dataclasses.replace(frozen, volume=changed.volume)
    np.testing.assert_allclose(picture(jvr.precompute(stale, cache=tmp_path)), picture(changed), atol=1e-5)
    pinned = dataclasses.replace(stale, radiance_transfer=stale.radiance_transfer.pinned())
    with pytest.warns(RuntimeWarning, match="computed for another"):
        shown = jvr.render(pinned, perspective(pinned.volume, width=6, height=5), SETTINGS).rgb
    assert np.abs(shown - picture(changed)).max() > 1e-3


@pytest.mark.slow
def test_single_voxels_and_opaque_insides_have_no_nan():
    for shape in ((1, 1, 1), (1, 4, 4)):
        assert np.all(np.isfinite(picture(low(jvr.RadianceTransfer(1, rays=8), shape=shape))))
    opaque = jvr.LinearTransfer([0.0, 1.0], [[1, 1, 1]] * 2, [1e6, 1e6])
    assert np.all(np.isfinite(picture(dataclasses.replace(low(jvr.RadianceTransfer(1, rays=8)), transfer=opaque))))


@pytest.mark.parametrize(
    ("transfer", "message"),
    [
        ({"order": -1}, "order"),
        ({"rays": 0}, "rays"),
        ({"resolution": 2.0}, "resolution"),
        ({"termination": 1.0}, "termination"),
        ({"chromaticity": 1}, "bleeding"),
        ({"growth": 0.5}, "growth"),
        ({"surface": 0}, "surface"),
    ],
)
def test_settings_that_cannot_be_met_are_refused(transfer, message):
    with pytest.raises(ValueError, match=message):
        jvr.RadianceTransfer(**transfer)


def test_a_transfer_that_takes_too_much_memory_is_refused():
    with pytest.raises(ValueError, match="a resolution of"):
        picture(scene(transfer=jvr.RadianceTransfer(memory=100)))


@pytest.mark.parametrize(
    "parts",
    [
        {"material": None},
        {"environment": None},
        {"environment": None, "material": None, "radiance_transfer": jvr.RadianceTransfer()},
    ],
)
def test_parts_that_do_not_go_together_are_refused(parts):
    with pytest.raises(ValueError, match=r"set environment|set material|radiance transfer"):
        jvr.Scene(jvr.Volume(voxels()), linear_transfer(), **({"environment": light(), "material": jvr.LambertBRDF()} | parts))


@pytest.mark.slow
def test_rays_inside_of_an_opaque_medium_do_not_turn_with_roundings():
    """There the transparency is below the precision, and a gradient of it would have any direction."""
    lit = dataclasses.replace(scene(transfer=jvr.RadianceTransfer(rays=8, resolution=1.0)), transfer=linear_transfer(scale=1e2))
    single = transfer_at(lit)[0]
    with jax.enable_x64(True):
        double = transfer_at(jax.tree.map(lambda x: x.astype(float), lit))[0]
    np.testing.assert_allclose(single, double, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("order", [0, 1])
def test_a_light_of_low_order_casts_the_shadows_of_its_transfer(order):
    """The exact product under a light and under the same with bands of zeros; so does what was computed beforehand."""
    lower = light(order)
    padded = jvr.EnvironmentLight(jnp.pad(lower.coefficients, ((0, 9 - (order + 1) ** 2), (0, 0))))
    transfer = jvr.RadianceTransfer(2, 16, 1.0, exact=True)
    one, other = (scene(transfer=transfer, environment=e) for e in (lower, padded))
    np.testing.assert_allclose(picture(one), picture(other), atol=1e-5)
    np.testing.assert_allclose(picture(jvr.precompute(one)), picture(other), atol=1e-5)


def test_what_was_computed_under_a_plain_light_serves_another():
    plain, other = scene(environment=jvr.EnvironmentLight.constant()), scene()
    relit = dataclasses.replace(jvr.precompute(plain), environment=other.environment)
    np.testing.assert_allclose(picture(relit), picture(other), atol=1e-5)


def test_a_medium_without_surface_bleeds():
    """Rays ask for no gradient of a material that has no normal. White clouds lose nothing, so nothing is dark."""
    cloud = jvr.PhaseBRDF(jvr.Isotropic())
    lit = scene(cloud, jvr.RadianceTransfer(rays=8, bleeding=jvr.MaterialBleeding()), shape=(3, 3, 4))
    colour = jax.tree.map(jnp.ones_like, lit.transfer.rgb)
    lit = dataclasses.replace(lit, transfer=jvr.LinearTransfer(lit.transfer.positions, colour, lit.transfer.sigma_t))
    uniform = dataclasses.replace(lit, environment=jvr.EnvironmentLight.constant(order=3))
    coefficients, _ = transfer_at(uniform)
    np.testing.assert_allclose(coefficients[:, :, 0], CONSTANT, rtol=1e-4)


def test_scattering_over_no_distance_leaves_everything_in_its_place():
    """Voxels of a decimetre: all of the kernel underflows."""
    volume = jvr.Volume(voxels((4, 4, 4)), np.diag([300.0, 300, 300, 1]))
    found = scatter(jvr.Dipole.preset("ketchup"), 0.5, volume, jnp.ones((4, 4, 4, 1, 1)), jnp.ones((4, 4, 4), bool))
    assert np.all(np.isfinite(found))


def test_a_neighbourhood_is_a_ball_in_the_world():
    volume = jvr.Volume(voxels((60, 60, 12)), np.diag([1.0, 1, 5, 1]))
    kernel = kernel_of(jvr.Dipole.preset("skin1"), 0.1, volume, volume.shape)[0]
    i, j, k = (np.arange(n) - n // 2 for n in kernel.shape)
    distance = np.sqrt(i[:, None, None] ** 2 + j[:, None] ** 2 + (5.0 * k) ** 2)
    np.testing.assert_array_equal(np.asarray(kernel) > 0, distance <= 5.9)


@pytest.mark.parametrize(
    ("materials", "error"),
    [
        ((jvr.LambertBRDF().projected(0), jvr.PhongBRDF().projected(3)), ValueError),
        ((jvr.PhongBRDF().projected(2), jvr.PhongBRDF().projected(3)), ValueError),
        ((jvr.MaterialByValue([0.0, 1.0], [jvr.LambertBRDF()] * 2), jvr.LambertBRDF()), TypeError),
    ],
)
def test_materials_that_have_no_place_beside_each_other(materials, error):
    with pytest.raises(error, match=r"order|materials"):
        jvr.MaterialByValue([0.0, 1.0], materials).projected(3)


@pytest.mark.parametrize(
    "wrong",
    [{"bleeding": jvr.TransferBleeding}, {"bleeding": "material"}, {"scattering": "skin1"}],
)
def test_parts_of_another_kind_are_refused(wrong):
    with pytest.raises(TypeError, match=r"jvr\."):
        jvr.RadianceTransfer(**wrong)


@pytest.mark.slow
def test_memory_counts_every_channel():
    coloured = linear_transfer(coloured=True)
    transfer = jvr.RadianceTransfer(1, 4, 1.0, memory=4 * 5 * 6 * 7 * 8)
    picture(low(transfer))
    with pytest.raises(ValueError, match="raise memory"):
        picture(dataclasses.replace(low(transfer), transfer=coloured))


@pytest.mark.slow
def test_nothing_to_scatter_may_be_kept_unscattered():
    lit = scene(transfer=jvr.RadianceTransfer(rays=16), shape=(7, 9, 8))
    assert jvr.precompute(lit, keep_unscattered=True).radiance_transfer.is_final


# --- gradients -------------------------------------------------------------------------------------------------------


GRADIENTS = {
    "light": ("environment.coefficients", jvr.LambertBRDF(0.8), None),
    "roughness": ("material.roughness", jvr.MicrofacetBRDF(roughness=0.6), None),
    "lambert, shares": ("environment.coefficients", jvr.LambertBRDF(0.8), jvr.RadianceTransfer(2, rays=8, resolution=1.0)),
    "transfer function through the transfer": (
        "transfer.sigma_t",
        jvr.LambertBRDF(0.8),
        jvr.RadianceTransfer(2, rays=8, resolution=0.5, exact=True),
    ),
    "transfer function through bleeding": (
        "transfer.rgb",
        jvr.LambertBRDF(0.8),
        jvr.RadianceTransfer(2, rays=8, resolution=0.5, bleeding=jvr.MaterialBleeding()),
    ),
    "voxels": ("volume.values", jvr.LambertBRDF(0.8), jvr.RadianceTransfer(2, rays=8, resolution=0.5)),
    "dipole": (
        "radiance_transfer.scattering.sigma_a",
        jvr.PhaseBRDF(jvr.Isotropic()),
        jvr.RadianceTransfer(2, rays=8, resolution=1.0, scattering=jvr.Dipole.preset("skin1"), neighbourhood=0.5),
    ),
}


# Each takes ten seconds and more to compile.
SLOW = (
    "roughness",
    "transfer function through the transfer",
    "transfer function through bleeding",
    "voxels",
    "lambert, shares",
    "dipole",
)


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in GRADIENTS])
def test_gradients_against_differences(name):
    """Reverse mode, forward mode and central differences in float64, in a random direction of the unknowns."""
    path, material, transfer = GRADIENTS[name]

    with jax.enable_x64(True):
        lit = jax.tree.map(
            lambda x: x.astype(float), scene(material, transfer, shape=(4, 4, 5), environment=light(2, clamped=False))
        )
        where = lambda s: eval(f"s.{path}", {"s": s})
        camera = perspective(lit.volume, width=3, height=3)
        weights = jnp.asarray(np.random.default_rng(3).normal(size=(3, 3, 3)))
        settings = jvr.Settings(1.1, termination=0, skipping=False)

        def f(x, adjoint=jvr.Replay()):
            chosen = dataclasses.replace(settings, adjoint=adjoint)
            return jnp.sum(weights * jvr.render(eqx.tree_at(where, lit, x), camera, chosen).rgb)

        x = where(lit)
        along = jnp.asarray(np.random.default_rng(4).normal(size=x.shape)) * jnp.maximum(jnp.abs(x), 1e-3)
        h = 1e-6
        value_and_forward = jax.jit(lambda x: jax.jvp(lambda x: f(x, jvr.Forward()), (x,), (along,)))
        _, forward = value_and_forward(x)
        difference = (value_and_forward(x + h * along)[0] - value_and_forward(x - h * along)[0]) / (2 * h)
        reverse = jnp.sum(jax.jit(jax.grad(f))(x) * along)
    assert abs(float(difference)) > 1e-6
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    np.testing.assert_allclose(reverse, difference, rtol=1e-5, atol=1e-9)
