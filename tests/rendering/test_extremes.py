"""Value and gradient stay finite and right at extremes: float32 against float64 on inputs that are exact in float32.

The gradients are those of `rgb`, `alpha` and `depth`, each summed over the picture with positive weights, in every array of the
scene and the camera.
"""

import contextlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, affine, gaussian_transfer, linear_transfer, perspective, voxels

import jvr

BACKGROUND = (0.2, 0.5, 0.9)
SETTINGS = jvr.Settings(0.87, termination=0)
OUTPUTS = ("rgb", "alpha", "depth")


def _measure(inputs, rest):
    def outputs(inputs):
        image = jvr.render(*eqx.combine(inputs, rest), SETTINGS)
        return {name: getattr(image, name) for name in OUTPUTS}

    image, pull = jax.vjp(outputs, inputs)
    weight = lambda x: 0.5 + 0.3 * jnp.sin(jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape)
    one = lambda name: {k: weight(x) * (k == name) for k, x in image.items()}
    cotangents = jax.tree.map(lambda *x: jnp.stack(x), *[one(name) for name in OUTPUTS])
    return image, jax.vmap(lambda c: pull(c)[0])(cotangents)


_measured = jax.jit(_measure)
_measured_as_users_do = jax.jit(_measure)


def measure(scene, camera, double, measured=_measured):
    """Image and gradients, each with a leading axis for `OUTPUTS`, of a scene whose arrays are rounded to float32."""

    def rounded(x):
        x = np.asarray(x)
        return jnp.asarray(x.astype(np.float32), float) if np.issubdtype(x.dtype, np.floating) else jnp.asarray(x)

    with jax.enable_x64(True) if double else contextlib.nullcontext():
        inputs, rest = eqx.partition(jax.tree.map(rounded, (scene, camera)), eqx.is_inexact_array)
        image, gradient = jax.tree.map(np.asarray, measured(inputs, rest))
    named = {jax.tree_util.keystr(path): x for path, x in jax.tree_util.tree_leaves_with_path(gradient)}
    return image, {name: x[:, :3] if "world_from" in name else x for name, x in named.items()}


def check(scene, camera, floor=1e-33, kink=False):
    """`floor`: absolute error allowed everywhere. `kink`: the picture has no derivative in the geometry here, and the one of
    either side is right."""
    image, gradient = measure(scene, camera, double=False)
    true_image, true_gradient = measure(scene, camera, double=True)
    for name, true in true_image.items():
        assert np.isfinite(image[name]).all(), name
        # Chords that barely cut a corner are differences of large distances: to a few roundings of the largest value.
        np.testing.assert_allclose(image[name], true, rtol=1e-5, atol=4e-6 * np.abs(true).max() + floor, err_msg=name)
    for name, true in true_gradient.items():
        geometry = "world_from" in name or "fov" in name or "height_world" in name
        assert np.isfinite(gradient[name]).all(), name
        assert np.isfinite(true).all(), name
        if kink and geometry:
            continue
        for output, g, t in zip(OUTPUTS, gradient[name], true, strict=True):
            error, size, largest = np.abs(g - t), np.abs(t), np.abs(t).max()
            # Each entry to its own size, and to a tenth of the largest one's last digit: terms of both signs add up. Others are sums
            # of both signs over many samples, and over the picture.
            own = "transfer" in name or "background" in name
            allowed = 2e-4 * size + 1e-8 * largest if own else 1e-4 * size + 2e-5 * largest
            if "fov" in name or "height_world" in name:
                # The two sides of the picture cancel.
                pose = next(k for k in true_gradient if "world_from_camera" in k)
                allowed = allowed + 1e-6 * np.abs(true_gradient[pose][OUTPUTS.index(output)]).max()
            assert np.all(error <= allowed + floor), f"d {output} / d {name}: {error.max():.2e} of {largest:.2e}"
    return true_image, true_gradient


def scene(transfer, volume=None):
    return jvr.Scene(jvr.Volume(voxels(), OBLIQUE) if volume is None else volume, transfer, background=BACKGROUND)


def scaled(factor):
    transfer = linear_transfer()
    return jvr.LinearTransfer(transfer.positions, transfer.rgb, np.asarray(transfer.sigma_t) * factor)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1e-30, 1e-20, 1e-6, 1e-3, 1.0, 10.0, 1e2, 1e4, 1e6, 1e8])
def test_optical_depth(factor):
    """Extinction of a segment, about 0.3 times the factor, and a dozen segments a ray."""
    volume = jvr.Volume(voxels(), OBLIQUE)
    # Where all is opaque, what gradient remains is below the rounding of the radiance to two floats.
    image, _ = check(scene(scaled(factor)), perspective(volume), floor=1e-11 if factor >= 1e2 else 1e-33)
    opaque = np.asarray(image["alpha"]).max()
    assert opaque > 0.999 if factor >= 10 else opaque < 0.999


def test_nothing_there():
    """Zero extinction: the picture is the background; the gradient in the extinction is not zero."""
    volume = jvr.Volume(voxels(), OBLIQUE)
    image, gradient = check(scene(scaled(0.0)), perspective(volume))
    np.testing.assert_allclose(image["rgb"], np.broadcast_to(np.float32(BACKGROUND), image["rgb"].shape))
    assert not image["alpha"].any()
    assert not image["depth"].any()
    assert np.abs(gradient["[0].transfer.sigma_t"][:2]).min() > 0.1
    assert not gradient["[0].volume.values"].any()


@pytest.mark.parametrize("value", [0.0, 0.2, 0.4, 2.0])
def test_constant_volume(value):
    volume = jvr.Volume(np.full((5, 6, 7), value), OBLIQUE)
    check(scene(scaled(1.0), volume), perspective(volume))


@pytest.mark.parametrize("height", [1.0, 1e6])
def test_step_from_nothing_to_opaque(height):
    """Between two neighbouring floats, and so that some rays see it and some do not."""
    volume = jvr.Volume(voxels(), OBLIQUE)
    above = np.nextafter(np.float32(0.5), np.float32(1))
    transfer = jvr.LinearTransfer([0.1, 0.5, above, 0.9], linear_transfer().rgb, [0, 0, height, height])
    check(scene(transfer), perspective(volume))


UNIT = jvr.Volume(voxels())


def look(eye, target, up=(0, 0, 1), fov_y=40.0):
    return jvr.PerspectiveCamera.look_at(eye, target, up, fov_y, 6, 5)


def tilted(by):
    """A camera along -x whose rays in the middle row have a z component of about `by`."""
    pose = np.array(look([12, 2.4, 3.1], [0, 2.4, 3.1]).world_from_camera)
    pose[2, 2] = by
    return jvr.PerspectiveCamera(pose, 40.0, 6, 5)


@pytest.mark.parametrize(
    ("camera", "kink"),
    {
        "inside": (look([2.1, 2.2, 3.3], [4, 5, 6.5]), False),
        "on a voxel": (look([2, 2, 3], [4, 2, 3]), True),
        "on a face": (look([4, 2.5, 3], [0, 2.5, 3]), True),
        "along a face": (look([4, 2.5, 3], [4, 5.5, 3]), True),
        "on a corner": (look([4, 5, 6], [0, 0, 0]), True),
        "on a corner, looking away": (look([4, 5, 6], [8, 10, 12]), False),
        "through a corner": (look([8, 10, 12], [4, 5, 6]), True),
        "missing": (look([10, 10, 10], [30, 10, 10]), False),
        "middle row along an axis": (look([12, 2.4, 3.1], [0, 2.4, 3.1]), False),
        "direction of 1e-16": (tilted(1e-16), False),
        "direction of 1e-20": (tilted(1e-20), False),
        "direction of 1e-30": (tilted(1e-30), False),
        "direction of 1e-38": (tilted(1e-38), False),
        "narrow": (look([12, 2.4, 3.1], [0, 2.4, 3.1], fov_y=1e-3), False),
        "wide": (look([2.1, 2.2, 3.3], [4, 5, 6.5], fov_y=179.0), False),
        "a million voxels away, along an axis": (look([1e6, 2.5, 3.125], [2, 2.5, 3.125], fov_y=4e-4), True),
    }.values(),
    ids=lambda x: None,
)
def test_cameras(camera, kink):
    check(scene(scaled(2.0), UNIT), camera, kink=kink)


@pytest.mark.parametrize(("distance", "allowed"), [(1e3, 3e-4), (1e4, 3e-3)])
def test_far_oblique_camera(distance, allowed):
    """A unit direction in float32 points to within 6e-8 of the distance: the picture is that of a camera turned by so little."""
    center = np.array([2.0, 2.5, 3.0])
    camera = look(center + distance * np.array([0.8, 0.5, 0.33]), center, fov_y=300 / distance)
    image, gradient = measure(scene(scaled(2.0), UNIT), camera, double=False)
    true, true_gradient = measure(scene(scaled(2.0), UNIT), camera, double=True)
    np.testing.assert_allclose(image["rgb"], true["rgb"], atol=allowed)
    assert all(np.isfinite(g).all() for g in gradient.values())
    for name in ("[0].transfer.rgb", "[0].transfer.sigma_t", "[0].background"):
        largest = np.abs(true_gradient[name]).max(axis=tuple(range(1, true_gradient[name].ndim)), keepdims=True)
        assert np.all(np.abs(gradient[name] - true_gradient[name]) <= allowed * largest)


def test_spacing_of_one_to_a_thousand():
    volume = jvr.Volume(voxels(), affine((0.01, 0.01, 10.0)))
    x, y, z = np.asarray(volume.center)
    camera = look([x + 0.1, y - 0.05, z + 0.03], [x, y, z + 3], (0, 0.1, 1), 100.0)
    image, _ = check(scene(scaled(100.0), volume), camera)
    assert image["alpha"].max() > 0.5


def test_origin_far_from_the_volume():
    volume = jvr.Volume(voxels(), affine((1, 1, 1), (1e4, 1e4, 1e4)))
    # Positions are rounded to 1e-3 of a voxel: samples that near a voxel plane are on either side, and so is the slope there.
    check(scene(scaled(1.0), volume), perspective(volume), kink=True)


@pytest.mark.slow
@pytest.mark.parametrize("place", [(2.5, 3.0, 10.0), (2.5, 3.0, 5.0), (5.0, 6.0, 10.0), (2.3, 2.9, 7.7)])
def test_parallel_rays(place):
    """Rays along x exactly: through voxels, in voxel planes, in faces and along edges of the box, and edge-on beside it."""
    y, z, extent = place
    camera = jvr.OrthographicCamera.look_at([20, y, z], [0, y, z], [0, 0, 1], extent, 6, 5)
    check(scene(scaled(2.0), UNIT), camera, kink=True)


@pytest.mark.slow
@pytest.mark.parametrize("factors", [(1.0, 1.0, 1.0), (1.0, 0.0, 1.0), (1e-6, 1.0, 1e4)])
def test_coloured_extinction(factors):
    transfer = linear_transfer(coloured=True)
    transfer = jvr.LinearTransfer(transfer.positions, transfer.rgb, np.asarray(transfer.sigma_t) * factors)
    check(scene(transfer), perspective(jvr.Volume(voxels(), OBLIQUE)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    {
        "ordinary": {},
        "far tails": {"center": [5.0, 6.0, 7.0]},
        "underflow": {"center": [500.0, 600.0, 700.0]},
        "narrow": {"width": [1e-4, 1e-6, 1e-12]},
        "squares overflow": {"width": [1e-17, 1e-18, 1e-17]},
        "wide": {"width": [1e3, 1e4, 1.0]},
        "one of height zero": {"height": [0.0, 0.5, 0.0]},
        "all of height zero": {"height": [0.0, 0.0, 0.0]},
    }.values(),
    ids=lambda changes: None,
)
def test_gaussians_in_a_volume_one_voxel_thick(changes):
    base = gaussian_transfer()
    arrays = {name: getattr(base, name) for name in ("center", "width", "height", "rgb")}
    volume = jvr.Volume(voxels((5, 1, 7)), OBLIQUE)
    # In the far tails float64 still holds numbers that are zero in float32, and depths of nothing.
    if "center" in changes:
        _, gradient = measure(scene(jvr.GaussianTransfer(**arrays | changes), volume), perspective(volume), double=True)
        image, single = measure(scene(jvr.GaussianTransfer(**arrays | changes), volume), perspective(volume), double=False)
        assert all(np.isfinite(g).all() for g in (*gradient.values(), *single.values()))
        np.testing.assert_allclose(image["rgb"], np.broadcast_to(np.float32(BACKGROUND), image["rgb"].shape), rtol=1e-6)
    else:
        check(scene(jvr.GaussianTransfer(**arrays | changes), volume), perspective(volume))


def test_derivative_in_a_gaussian_of_height_zero(x64):
    """Emission is linear in the heights: its derivative is the Gaussian's own, also where the height is zero."""
    base = gaussian_transfer()

    def emission(height):
        classified = jvr.GaussianTransfer(base.center, base.width, height, base.rgb).evaluate(jnp.array(0.37))
        return jnp.stack([c * classified.sigma_t[0] for c in classified.rgb])

    each = np.exp(-((0.37 - np.asarray(base.center)) ** 2) / (2 * np.asarray(base.width) ** 2))
    expected = each * np.asarray(base.rgb).T
    np.testing.assert_allclose(jax.jit(jax.jacrev(emission))(jnp.array([0.0, 0.5, 0.0])), expected, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("depth", [0.4, 4.0, 20.0, 40.0])
def test_entries_deep_behind_an_opaque_front_keep_their_digits(depth):
    """A ramp of the scalar along the view: each entry of the table lies in a layer of its own, the last behind optical depth
    `depth`. Colours fade with depth, so that no entry is a difference of nearly equal numbers: each is right to its own size,
    down to 1e-8 of the largest. Beyond that is the rounding of radiance to two floats."""
    n = 16
    volume = jvr.Volume(np.broadcast_to(np.linspace(1, 0, 33)[:, None, None], (33, 2, 2)))
    rgb = np.linspace(1, 0.2, n)[:, None] * np.array([1.0, 0.7, 0.4])
    sigma = np.full(n, depth / 32) * (1 + 0.3 * np.sin(np.arange(n)))
    camera = jvr.OrthographicCamera.look_at([-5, 0.5, 0.5], [0, 0.5, 0.5], [0, 0, 1], 0.5, 1, 1)
    # Entry 0 of these is in front: the ray enters at the scalar 1.
    here = jvr.Scene(volume, jvr.LutTransfer(rgb[::-1], sigma[::-1], [0.0, 1.0]))
    image, gradient = measure(here, camera, double=False, measured=_measured_as_users_do)
    true_image, true = measure(here, camera, double=True)
    np.testing.assert_allclose(image["rgb"], true_image["rgb"], rtol=1e-6)
    for name, outputs in (("[0].transfer.rgb", ("rgb",)), ("[0].transfer.sigma_t", ("rgb", "alpha"))):
        for output in outputs:
            g, t = (x[name][OUTPUTS.index(output)] for x in (gradient, true))
            counted = np.abs(t) >= 1e-8 * np.abs(t).max()
            np.testing.assert_allclose(g[counted], t[counted], rtol=1e-4, err_msg=f"d {output} / d {name}")


@jax.jit
def _scene_gradient(inputs, rest):
    return jax.value_and_grad(lambda i: jnp.sum(jvr.render(*eqx.combine(i, rest), SETTINGS).rgb))(inputs)


def scene_gradient(scene, camera):
    """The sum of a picture, and its derivative in everything."""
    inputs, rest = eqx.partition((scene, camera), eqx.is_inexact_array)
    total, gradient = jax.tree.map(np.asarray, _scene_gradient(inputs, rest))
    return total, {jax.tree_util.keystr(path): x for path, x in jax.tree_util.tree_leaves_with_path(gradient)}


@pytest.mark.slow
def test_a_voxel_that_is_not_a_number_is_seen_by_the_rays_that_meet_it_alone():
    """Those that miss the volume read voxel (0, 0, 0) all the same. The box keeps all others away from it: nothing may change. (Voxels that
    a fit has made so: what is constructed so has gaps instead.)"""
    values = voxels((6, 6, 6))
    clean, values[0, 0, 0] = values.copy(), np.nan
    camera = look([20, 22, 25], [2, 2, 2], fov_y=22.0)
    box = jvr.ClippingBox([1.2, 1.2, 1.2], [9, 9, 9])
    start = jvr.Scene(jvr.Volume(clean), linear_transfer(), background=BACKGROUND, clipping=box)
    make = lambda values: eqx.tree_at(lambda s: s.volume.values, start, jnp.asarray(values))
    (total, gradient), (expected, of_clean) = (scene_gradient(make(v), camera) for v in (values, clean))
    assert 0 < (np.asarray(jvr.render(make(clean), camera, SETTINGS).alpha) == 0).sum() < 30
    assert total == expected
    for name, g in of_clean.items():
        np.testing.assert_array_equal(gradient[name], g, err_msg=name)


@pytest.mark.slow
def test_the_largest_number_marks_what_has_no_data():
    """As NaN does, with a warning; under light, with voxels half a world length apart."""
    camera = look([9, 10, 11], [2, 2, 2], fov_y=30.0)
    light = {"lights": (jvr.DirectionalLight([-1.0, -0.5, -0.7]),), "shading": jvr.Lambert(threshold=0.1)}

    def make(nothing):
        values = voxels((8, 8, 8))
        values[4:] = nothing
        return jvr.Scene(jvr.Volume(values, affine((0.5, 0.5, 0.5))), linear_transfer(), background=BACKGROUND, **light)

    with pytest.warns(UserWarning, match="256 voxels lie beyond 1e30: they count as missing"):
        largest = make(-3.4e38)
    (total, gradient), (expected, of_nan) = (scene_gradient(scene, camera) for scene in (largest, make(np.nan)))
    assert total == expected
    for name, g in of_nan.items():
        assert np.isfinite(gradient[name]).all(), name
        np.testing.assert_array_equal(gradient[name], g, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("outer", [1e-10, 1e-4, 0.01, 30.0])
def test_narrow_spots(outer):
    """Light half-way between axis and edge, against the same numbers in double precision, with derivatives by central differences there."""

    def arriving(p):
        light = jvr.SpotLight(p[:3], [0.0, 0.0, 2.0], 3.0, inner=0.2 * p[3], outer=p[3])
        zero = jnp.zeros_like(p[0])
        x = (zero + 0.5 * np.tan(np.deg2rad(outer)), zero, zero + 1.0)
        return light.sample(x, (zero, zero, zero + 1)).irradiance[0]

    p = np.array([0, 0, 0, outer])
    value, gradient = jax.value_and_grad(arriving)(jnp.asarray(p, jnp.float32))
    with jax.enable_x64(True):
        h = 1e-5 * outer * np.diag([np.pi / 180, np.pi / 180, 1, 1])
        expected = float(arriving(jnp.asarray(p)))
        slopes = [float(arriving(jnp.asarray(p + e)) - arriving(jnp.asarray(p - e))) / (2 * e.max()) for e in h]
    np.testing.assert_allclose(value, expected, rtol=1e-4)
    assert 0.5 < expected < 2.9
    # Along the axis there is less to see than across it.
    np.testing.assert_allclose(gradient, slopes, atol=1e-3 * np.abs(slopes).max())
