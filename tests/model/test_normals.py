"""Gradients of volumes by every scheme, their derivatives, and transfer functions that take them."""

import functools

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, affine, linear_transfer, perspective, render, voxels
from scipy import ndimage

import jvr
from jvr.march.fields import VoxelField
from jvr.march.shaders import GradientFrame
from jvr.march.steps import Point

SCHEMES = (
    jvr.AnalyticGradient,
    jvr.ForwardDifferences,
    jvr.CentralDifferences,
    jvr.SobelDifferences,
    jvr.PrecomputedGradient,
)
EACH = pytest.mark.parametrize("scheme", SCHEMES, ids=lambda s: s.__name__)
# Of the values and of their opacity; the widest stencil of all takes longest to compile.
EACH_BY = pytest.mark.parametrize(
    ("scheme", "of_opacity"),
    [
        pytest.param(s, o, marks=pytest.mark.slow if o and s is jvr.SobelDifferences else [])
        for s in SCHEMES
        for o in (False, True)
    ],
)
SETTINGS = jvr.Settings(0.7, termination=0)
# Extinction `0.2 + 0.3 s`, wherever the scalar is.
PROPORTIONAL = jvr.LinearTransfer([-10.0, 10.0], np.ones((2, 3)), [-2.8 + 3, 3.2 + 3])
SLOPE = 0.3


@functools.partial(jax.jit, static_argnums=0)
def _gradients(shape, normals, volume, transfer, points):
    graded = normals.with_gradients(volume, transfer)

    def one(p):
        along = normals.gradient(transfer, shape, p, graded.resample(volume, p))
        return jnp.stack(along) @ volume.axes_inverse

    return jax.vmap(one)(tuple(points.T))


def gradients(normals, volume, points, transfer=PROPORTIONAL):
    """Gradients in the world at grid positions, `(n, 3)`."""
    return np.asarray(_gradients(volume.shape, normals, volume, transfer, jnp.asarray(points)))


def everywhere(shape, n=40, seed=0):
    """Grid positions inside, on faces, edges and corners."""
    high = np.asarray(shape) - 1.0
    p = np.random.default_rng(seed).random((n, 3)) * high
    p[:6] = np.where(np.arange(6)[:, None] // 2 == np.arange(3), np.arange(6)[:, None] % 2 * high, p[:6])
    p[6], p[7], p[8] = 0, high, [0, high[1], 0]
    return p


@EACH_BY
def test_linear_fields_are_exact(scheme, of_opacity, x64):
    """Oblique and anisotropic, up to the border."""
    shape, slope = (5, 6, 7), np.array([0.3, -0.7, 0.2])
    p = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    values = (p @ OBLIQUE[:3, :3].T + OBLIQUE[:3, 3]) @ slope / 4
    volume = jvr.Volume(values, OBLIQUE, slope=2.0, intercept=0.7)
    expected = slope / 2 * (SLOPE if of_opacity else 1)
    np.testing.assert_allclose(
        gradients(scheme(of_opacity), volume, everywhere(shape)), np.broadcast_to(expected, (40, 3)), atol=1e-12
    )


@pytest.mark.parametrize(
    ("scheme", "order"),
    [
        (jvr.AnalyticGradient, 1),
        (jvr.ForwardDifferences, 1),
        (jvr.CentralDifferences, 2),
        pytest.param(jvr.SobelDifferences, 2, marks=pytest.mark.slow),
        (jvr.PrecomputedGradient, 2),
    ],
)
def test_orders_of_convergence(scheme, order, x64):
    """On a smooth field, inside of it; the RMSE over many places, since those that a place has in its cell change the error."""
    where = 0.2 + 0.6 * np.random.default_rng(1).random((300, 3))
    field = lambda x: np.sin(3 * x[..., 0]) * np.cos(2 * x[..., 1]) + x[..., 2] ** 3
    truth = np.stack(
        [
            3 * np.cos(3 * where[:, 0]) * np.cos(2 * where[:, 1]),
            -2 * np.sin(3 * where[:, 0]) * np.sin(2 * where[:, 1]),
            3 * where[:, 2] ** 2,
        ],
        axis=1,
    )
    errors, sizes = [], (9, 17, 33)
    for n in sizes:
        x = np.stack(np.meshgrid(*[np.linspace(0, 1, n)] * 3, indexing="ij"), -1)
        volume = jvr.Volume(field(x), affine([1 / (n - 1)] * 3))
        errors.append(np.sqrt(np.mean((gradients(scheme(), volume, where * (n - 1)) - truth) ** 2)))
    found = -np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert abs(found - order) < 0.2, (found, errors)


@EACH_BY
def test_an_axis_of_one_voxel_has_no_slope(scheme, of_opacity, x64):
    values = 0.3 * np.arange(5.0)[:, None, None] + 0.1 * np.arange(7.0)
    volume = jvr.Volume(values)
    points = everywhere((5, 1, 7))
    points[:, 1] = np.linspace(-0.5, 0.5, 40)
    expected = np.array([0.3, 0, 0.1]) * (SLOPE if of_opacity else 1)
    np.testing.assert_allclose(gradients(scheme(of_opacity), volume, points), np.broadcast_to(expected, (40, 3)), atol=1e-12)
    assert not gradients(scheme(of_opacity), jvr.Volume(np.ones((1, 1, 1))), np.zeros((1, 3))).any()


@pytest.mark.slow
def test_precomputed_gradients_are_central_differences_at_voxels(x64):
    volume = jvr.Volume(voxels(), OBLIQUE, slope=1.3, intercept=-0.1)
    p = np.stack(np.meshgrid(*map(np.arange, volume.shape), indexing="ij"), -1).reshape(-1, 3).astype(float)
    expected = gradients(jvr.CentralDifferences(), volume, p)
    np.testing.assert_allclose(gradients(jvr.PrecomputedGradient(), volume, p), expected, atol=1e-12)
    np.testing.assert_allclose(gradients(jvr.PrecomputedGradient(), volume.graded(), p), expected, atol=1e-12)
    transfer = linear_transfer(coloured=True)
    of_opacity = [gradients(s(True), volume, p, transfer) for s in (jvr.CentralDifferences, jvr.PrecomputedGradient)]
    np.testing.assert_allclose(*of_opacity, atol=1e-12)


def sobel_at_voxels(values):
    """Sobel's differences at voxels by SciPy: of the mirrored border, where a difference of both sides is that of one twice."""
    padded, found = np.pad(values, 1, mode="edge"), []
    for axis in range(3):
        smooth = padded
        for other in {0, 1, 2} - {axis}:
            smooth = ndimage.convolve1d(smooth, [0.25, 0.5, 0.25], axis=other)
        inner = np.gradient(smooth[1:-1, 1:-1, 1:-1], axis=axis)
        found.append(inner)
    return np.stack(found, -1)


@pytest.mark.slow
def test_precomputed_sobel_gradients(x64):
    """At voxels those of SciPy and of `SobelDifferences`, kept or not, along axes of one voxel too; between voxels interpolated."""
    for shape in ((5, 6, 7), (4, 1, 5)):
        volume = jvr.Volume(voxels(shape), slope=1.3, intercept=-0.1)
        p = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3).astype(float)
        sobel = jvr.PrecomputedGradient(sobel=True)
        found = gradients(sobel, volume, p)
        np.testing.assert_allclose(found, gradients(jvr.SobelDifferences(), volume, p), atol=1e-12)
        np.testing.assert_allclose(gradients(sobel, volume.graded().graded_by_sobel(), p), found, atol=1e-12)
        if min(shape) > 1:
            np.testing.assert_allclose(found, 1.3 * sobel_at_voxels(volume.values).reshape(-1, 3), atol=1e-12)
    between = gradients(sobel, volume, np.array([[1.25, 0.0, 2.0]]))
    at = found.reshape(*shape, 3)
    np.testing.assert_allclose(between[0], 0.75 * at[1, 0, 2] + 0.25 * at[2, 0, 2], atol=1e-12)


def test_kept_sobel_gradients_follow_the_voxels():
    """What is kept beside other voxels is never seen in their place, and both kinds may be kept."""
    volume = jvr.Volume(voxels()).graded_by_sobel().graded()
    other = eqx.tree_at(lambda v: v.values, volume, volume.values[::-1]).current()
    assert other.sobel_gradients is not volume.sobel_gradients
    np.testing.assert_array_equal(other.sobel_gradients, jvr.Volume(other.values).graded_by_sobel().sobel_gradients)
    assert volume.current().sobel_gradients is volume.sobel_gradients
    assert not np.array_equal(volume.sobel_gradients, volume.gradients)


def test_the_analytic_gradient_is_that_of_the_interpolant(x64):
    volume = jvr.Volume(voxels(), OBLIQUE)
    points = everywhere(volume.shape)[9:]
    of_value = jax.vmap(jax.grad(lambda x: volume.sample(volume.grid_from_world(tuple(x)))))
    x = points @ OBLIQUE[:3, :3].T + OBLIQUE[:3, 3]
    np.testing.assert_allclose(gradients(jvr.AnalyticGradient(), volume, points), of_value(jnp.asarray(x)), atol=1e-12)


@pytest.mark.parametrize(
    ("scheme", "of_opacity"),
    [
        pytest.param(s, o, marks=[] if s is jvr.CentralDifferences or not (o or s is jvr.SobelDifferences) else pytest.mark.slow)
        for s in SCHEMES
        for o in (False, True)
    ],
)
def test_what_is_deposited_is_the_derivative_of_what_is_read(scheme, of_opacity, x64):
    """For random cotangents of scalar, gradient and neighbours, in voxels, slope and intercept, inside and at the border."""
    volume = jvr.Volume(voxels((3, 4, 5)), slope=0.9, intercept=0.05)
    normals = scheme(of_opacity).with_gradients(volume, linear_transfer())
    points = tuple(jnp.asarray(everywhere(volume.shape, 12).T))
    wanted = lambda v: (v.values, v.slope, v.intercept)

    def read(leaves, normals):
        return jax.vmap(lambda p: normals.resample(eqx.tree_at(wanted, volume, leaves), p))(points)

    found, pull = jax.vjp(read, wanted(volume), normals)
    rng = np.random.default_rng(3)
    cotangent = jax.tree.map(lambda x: jnp.asarray(rng.standard_normal(x.shape)), found)
    of_volume, of_normals = pull(cotangent)
    zero = jax.tree.map(jnp.zeros_like, (volume, normals))
    total, own = jax.jit(lambda zero, cotangent: normals.deposit(volume, zero, points, cotangent))(zero, cotangent)
    for a, b in zip(jax.tree.leaves((wanted(total), own)), jax.tree.leaves((of_volume, of_normals)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def lit(values, normals, transfer, shading=jvr.BlinnPhong(threshold=0.1), adjoint=jvr.Replay()):
    """The loss of a small picture of a shaded volume."""
    volume = jvr.Volume(values, OBLIQUE)
    scene = jvr.Scene(
        volume,
        transfer,
        lights=(jvr.DirectionalLight([-0.4, 1.0, -0.5]),),
        shading=shading,
        normals=normals,
    )
    return weighted(scene, adjoint)


def unlit(values, transfer):
    """The same of one that glows."""
    return weighted(jvr.Scene(jvr.Volume(values, OBLIQUE), transfer), jvr.Replay())


def weighted(scene, adjoint):
    camera = jvr.PerspectiveCamera.look_at([22.0, -9.0, 21.0], [2.0, 6.5, 13.0], [0.1, 0.2, 1.0], 30.0, 5, 4)
    image = jvr.render(scene, camera, jvr.Settings(0.7, termination=0, adjoint=adjoint))
    return jnp.sum(jnp.sin(jnp.arange(1.0, image.rgb.size + 1)).reshape(image.rgb.shape) * image.rgb)


@EACH
def test_constants_have_no_gradient(scheme):
    """Not even by rounding, at any point, whatever the units: a stored zero may be -1024 units, and units a rounding of the voxels."""
    shape = (4, 5, 6)
    for value, slope, intercept in ((0.5, 1.0, 0.0), (1.3e3, 0.7, -1024.0), (0.1, 3.7, 0.01), (1463.0, 0.7, -1024.1)):
        volume = jvr.Volume(np.full(shape, value, np.float32), slope=slope, intercept=intercept)
        found = gradients(scheme(), volume, everywhere(shape, 400))
        np.testing.assert_array_equal(found, 0.0)


@pytest.mark.parametrize("scheme", [jvr.CentralDifferences, pytest.param(jvr.SobelDifferences, marks=pytest.mark.slow)])
def test_rounding_decides_no_normal_of_an_opacity(scheme):
    """What is flat has none: a constant under a steep transfer function, and a scalar that rises where opacity is a plateau."""
    shape, normals = (6, 7, 8), scheme(True)
    points, slope = everywhere(shape, 300), np.array([0.07, 0.05, 0.03])
    rising = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1) @ slope
    plateau = jvr.LinearTransfer([-1e3, 0.6, 0.7, 1e3], np.ones((4, 3)), [0.7, 0.7, 1.9, 1.9])
    steep = jvr.LinearTransfer([0.29, 0.3, 0.31, 0.32], np.ones((4, 3)), [0.0, 90.0, 3.0, 700.0])
    volume = lambda s: jvr.Volume((s + 0.81) / 3.7, slope=3.7, intercept=-0.81)
    assert not np.any(_in_world(volume(np.full(shape, 0.301)), normals, steep, jnp.asarray(points)))
    found = np.any(np.asarray(_in_world(volume(rising), normals, plateau, jnp.asarray(points))), axis=1)
    # A neighbour farther off in all three directions, and what rounding makes of it.
    flat, rises = points @ slope + slope.sum() < 0.599, np.abs(points @ slope - 0.65) < 0.04
    assert flat.sum() > 100
    assert not np.any(found[flat])
    assert np.all(found[rises])


@jax.jit
def _in_world(volume, normals, transfer, points):
    """Gradients as shaders take them."""
    frame = GradientFrame(normals, volume.axes_inverse, volume.intercept, volume.shape)
    field = VoxelField(volume, normals.with_gradients(volume, transfer))

    def one(p):
        point = Point(tuple(p), tuple(p), jnp.int32(0), jnp.int32(0))
        return jnp.stack(frame.in_world(transfer, field.resample(point), point).gradient)

    return jax.vmap(one)(points)


DEFAULT = [(jvr.PrecomputedGradient, True)]
# Opacities of neighbours go into a gradient in one way, of which central differences are an example.
OF_OPACITY = [(jvr.AnalyticGradient, True), (jvr.CentralDifferences, True), (jvr.PrecomputedGradient, True)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scheme", "of_opacity"),
    [
        pytest.param(s, o, marks=[] if (s, o) in DEFAULT else pytest.mark.slow)
        for s, o in (*((s, False) for s in SCHEMES), *OF_OPACITY)
    ],
)
def test_gradient_of_a_shaded_picture(scheme, of_opacity, x64):
    """In every voxel and every entry of the transfer function, against central differences."""
    normals, p = scheme(of_opacity), {"values": jnp.asarray(voxels((3, 4, 5))), "transfer": linear_transfer()}
    gradient = jax.jit(jax.grad(lambda p: lit(p["values"], normals, p["transfer"])))(p)
    flat, unravel = jax.flatten_util.ravel_pytree(p)
    of = lambda v: lit(unravel(v)["values"], normals, unravel(v)["transfer"], adjoint=jvr.Forward())
    h = 1e-6 * np.eye(flat.size)
    above, below = jnp.split(jax.jit(lambda v: jax.lax.map(of, v))(flat + np.concatenate([h, -h])), 2)
    expected = unravel((above - below) / 2e-6)
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(gradient), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6 * np.abs(b).max(), err_msg=jax.tree_util.keystr(path))


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [jvr.AnalyticGradient, jvr.SobelDifferences])
def test_a_vanishing_gradient_has_no_normal_and_no_nan(scheme):
    """A constant volume: no surface, so that the picture is that of light that is faced, an unlit one of colours as dark as the material,
    with derivatives in both modes."""
    values, transfer = jnp.full((4, 5, 6), 0.5), linear_transfer()
    normals = scheme()
    plain = jax.jit(lambda v: unlit(v, eqx.tree_at(lambda t: t.rgb, transfer, 0.7 * transfer.rgb)))(values)
    reverse = jax.jit(jax.value_and_grad(lambda v, shading: lit(v, normals, transfer, shading)))
    along = lambda v, shading: jax.jvp(lambda v: lit(v, normals, transfer, shading, jvr.Forward()), (v,), (jnp.ones_like(v),))
    forward = jax.jit(along)
    for threshold in (0.0, 0.1):
        value, gradient = reverse(values, jvr.BlinnPhong(threshold=threshold))
        np.testing.assert_allclose(value, plain, rtol=1e-6)
        assert np.isfinite(gradient).all()
        tangent = forward(values, jvr.BlinnPhong(threshold=threshold))[1]
        np.testing.assert_allclose(tangent, np.sum(gradient), rtol=1e-4)


def ramp(slope, n=9):
    """A volume whose scalar rises along x from 0, by `slope` a unit."""
    return jvr.Volume(np.broadcast_to((slope * np.arange(float(n)))[:, None, None], (n, 2, 2)))


def along_x():
    return jvr.OrthographicCamera.look_at([15.0, 0.5, 0.5], [0, 0.5, 0.5], [0, 0, 1], 0.5, 1, 1)


TABLE = np.array([[0.0, 0.1], [0.4, 0.2], [0.1, 0.7]])


def test_table_of_scalar_and_gradient(x64):
    """Optical depth through a ramp: extinction is bilinear, its integral along the ramp that of a piecewise linear function."""
    rgb = np.ones((3, 2, 3))
    transfer = jvr.GradientTransfer(rgb, TABLE, [0.0, 1.0], [0.05, 0.25])
    for slope, share in ((0.125, 0.375), (0.25, 1.0), (0.03, 0.0), (0.5, 1.0)):
        column = (1 - share) * TABLE[:, 0] + share * TABLE[:, 1]
        # The scalar is above the domain from 1 / slope on.
        s = np.minimum(slope * np.linspace(0, 8, 160001), 1.0)
        tau = 8 * np.mean(np.interp(s, [0, 0.5, 1], column))
        alpha = render(jvr.Scene(ramp(slope), transfer), along_x(), jvr.Settings(0.01, termination=0)).alpha[0, 0]
        np.testing.assert_allclose(-np.log1p(-alpha), tau, rtol=1e-4)


@pytest.mark.slow
def test_opacity_by_gradient(x64):
    """None at `low` and below, all at `high` and above."""
    inner = jvr.LinearTransfer([0.0, 1.0], np.ones((2, 3)), [0.3, 0.3])
    transfer = jvr.GradientOpacity(inner, 0.1, 0.2)
    for slope, share in ((0.05, 0), (0.1, 0), (0.125, 0.25), (0.2, 1), (3.0, 1)):
        alpha = render(jvr.Scene(ramp(slope), transfer), along_x(), SETTINGS).alpha[0, 0]
        np.testing.assert_allclose(alpha, -np.expm1(-0.3 * 8 * share), rtol=1e-10, atol=1e-12)


COLOURS = np.random.default_rng(0).random((4, 3, 3))
GRADIENT_TRANSFERS = {
    "table": lambda: jvr.GradientTransfer(COLOURS, 0.5 * COLOURS[..., 0], [0.1, 0.9], [0.0, 0.4]),
    "coloured table": lambda: jvr.GradientTransfer(COLOURS, 0.5 * COLOURS[::-1], [0.1, 0.9], [0.0, 0.4]),
    "opacity": lambda: jvr.GradientOpacity(linear_transfer(), 0.05, 0.4),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["table", "opacity"])
def test_skipping_changes_nothing(kind):
    values = voxels((17, 15, 16))
    values[:, 6:, :9] = 0
    volume = jvr.Volume(values)
    hidden = np.array([0.0, 0, 1, 0.5])
    if kind == "table":
        transfer = jvr.GradientTransfer(np.ones((4, 3, 3)), hidden[:, None] * [0.1, 0.3, 0.2], [0.0, 1.0], [0.0, 1.0])
    else:
        transfer = jvr.GradientOpacity(jvr.LutTransfer(np.ones((4, 3)), 0.3 * hidden, [0.0, 1.0]), 0.1, 0.5)
    camera = perspective(volume, 12, 10)
    on, off = (render(jvr.Scene(volume, transfer), camera, jvr.Settings(0.5, termination=0, skipping=s)) for s in (True, False))
    assert np.asarray(on.stats.steps).sum() < 0.85 * np.asarray(off.stats.steps).sum()
    np.testing.assert_allclose(on.rgb, off.rgb, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["coloured table", "opacity"])
def test_derivatives_of_a_transfer_of_the_gradient(kind, x64):
    """In its table or its limits, and in the voxels, against central differences."""
    p = {"values": jnp.asarray(voxels((3, 4, 5))), "transfer": GRADIENT_TRANSFERS[kind]()}
    camera = perspective(jvr.Volume(np.zeros((3, 4, 5)), OBLIQUE), 5, 4)

    def loss(p, adjoint):
        scene = jvr.Scene(jvr.Volume(p["values"], OBLIQUE), p["transfer"])
        rgb = jvr.render(scene, camera, jvr.Settings(0.7, termination=0, adjoint=adjoint)).rgb
        return jnp.sum(jnp.sin(jnp.arange(1.0, rgb.size + 1)).reshape(rgb.shape) * rgb)

    gradient = jax.jit(jax.grad(lambda p: loss(p, jvr.Replay())))(p)
    flat, unravel = jax.flatten_util.ravel_pytree(p)
    h = 1e-6 * np.eye(flat.size)
    of = lambda v: jax.lax.map(lambda x: loss(unravel(x), jvr.Forward()), v)
    above, below = jnp.split(jax.jit(of)(flat + np.concatenate([h, -h])), 2)
    for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(unravel((above - below) / 2e-6)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6 * np.abs(b).max())


def test_gradient_of_opacity_for_a_transfer_of_the_gradient_is_refused():
    scene = jvr.Scene(ramp(0.1), GRADIENT_TRANSFERS["table"](), normals=jvr.CentralDifferences(of_opacity=True))
    with pytest.raises(ValueError, match="of_opacity=False"):
        jvr.render(scene, along_x())


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: jvr.GradientTransfer(np.ones((1, 3, 3)), np.ones((1, 3)), [0, 1], [0, 1]), ValueError, "at least 2"),
        (lambda: jvr.GradientTransfer(np.ones((2, 3, 3)), -np.ones((2, 3)), [0, 1], [0, 1]), ValueError, "not negative"),
        (lambda: jvr.GradientTransfer(np.ones((2, 3, 3)), np.ones((2, 2)), [0, 1], [0, 1]), ValueError, "shape"),
        (lambda: jvr.GradientTransfer(np.ones((2, 3, 3)), np.ones((2, 3)), [0, 1], [1, 1]), ValueError, "magnitudes"),
        (lambda: jvr.GradientOpacity(linear_transfer(), 0.2, 0.2), ValueError, "low < high"),
        (lambda: jvr.GradientOpacity(GRADIENT_TRANSFERS["table"](), 0.1, 0.2), TypeError, "of the scalar"),
    ],
)
def test_what_cannot_be_right_is_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()
